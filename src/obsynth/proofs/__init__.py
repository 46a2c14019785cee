"""Proofs about matrices of floating-point numbers: outward rounding, definiteness, contraction."""
