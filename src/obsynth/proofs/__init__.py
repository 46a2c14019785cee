"""Proofs: outward rounding, definiteness, and exact rational arithmetic."""
