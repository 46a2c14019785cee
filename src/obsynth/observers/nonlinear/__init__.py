"""Observers of nonlinear differential-algebraic plants."""
