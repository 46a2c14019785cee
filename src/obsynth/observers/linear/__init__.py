"""Linear time-invariant observers: one realisation."""
