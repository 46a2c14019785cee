"""Pure mathematics on raw matrices: ranks with their gap, pencils, norms and proofs of definiteness."""
