"""Monitors of residuals and parameters: statistics, thresholds, and what they promise.

Main names: `Monitor`, `monitor`, `online_monitor`, `learn_thresholds`, `AdaptiveRule`.
"""
