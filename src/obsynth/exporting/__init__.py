"""Gain sets for other programs: MATLAB, numpy, C."""
