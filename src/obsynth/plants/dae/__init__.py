"""Nonlinear differential-algebraic plants."""
