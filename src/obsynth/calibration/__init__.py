"""From a log to constants with their tolerances, noise covariances, and a verdict on the model."""
