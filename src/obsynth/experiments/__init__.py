"""Designs at work: simulated on scenarios, watched by thresholds, counted over many runs."""
