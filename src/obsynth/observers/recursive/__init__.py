"""Recursive observers of time-varying plants."""
