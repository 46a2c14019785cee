"""From a log to constants with tolerances, noise covariances, and a verdict on the model.

Main names: `calibrate`, `validate`, `validity`, `Calibration`.
"""
