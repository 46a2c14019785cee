"""The extended Kalman filter of nonlinear plants as a method."""
