"""Many runs and many designs: evaluate, compare, sweep, sensor sets, what tolerances cost.

Main names: `evaluate`, `compare`, `sweep`, `sensor_sets`, `tolerance_study`, `robustness`.
"""
