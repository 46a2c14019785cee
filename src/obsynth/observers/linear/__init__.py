"""Linear observers: one realisation."""
