"""Measured data: logs and streams in, estimates out."""
