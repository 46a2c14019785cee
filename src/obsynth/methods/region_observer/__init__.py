"""The observer of nonlinear plants over a region: one proof for every trajectory inside it."""
