"""The adaptive observer of nonlinear differential-algebraic plants."""
