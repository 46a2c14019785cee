"""Monitors of residuals and parameters: statistics, thresholds, and their guarantees.

Main names: `Monitor`, `monitor`, `online_monitor`, `learn_thresholds`, `AdaptiveRule`.
"""
