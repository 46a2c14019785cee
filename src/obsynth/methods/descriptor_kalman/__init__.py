"""The descriptor Kalman filter as a method."""
