"""The descriptor Kalman filter."""
