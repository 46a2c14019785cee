"""Proofs in outward rounding and exact arithmetic: balls, definiteness."""
