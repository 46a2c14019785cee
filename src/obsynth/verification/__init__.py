"""Every claim again, from the plant and the stored numbers alone: no solver, no synthesis.

`error_system` is where plant and observer become an error system; `claims`, `identities`, `inequalities` and
`stored_numbers` are the checks that methods share; `over_tolerances` holds what is proved for every plant of a box.
"""
