"""Designs for other programs: C, FMU, MATLAB, numpy.

Main names: `export`; `c_source` and `dae_c_source` write C, `fmu` the archive.
"""
