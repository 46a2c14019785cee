"""Monitors of residuals and parameters: statistics, thresholds, and what they promise."""
