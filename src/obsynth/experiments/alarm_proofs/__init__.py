"""Proofs of alarms: a window of data that no plant within its tolerances explains without a fault."""
