"""Functional filter: estimates faults, or shows them in residuals, and nothing else."""
