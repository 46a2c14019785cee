"""Specs: a plant, a method and a scenario as a YAML document, read strictly and never executed.

`schema` and its sections say what a document may hold, `documents` reads it with readable refusals, `loader` makes the
plant and the scenario.

Main names: `load_spec`, `Spec`, `SpecDocument`.
"""
