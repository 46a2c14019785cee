"""Mathematics with guarantees: every result holds for all roundings.

Balls (matrices with error bounds), exact rationals, affine arithmetic, definiteness, contraction and sums over all
time. Plants and designs stand elsewhere: `verification` applies these to them.

Main names: `Ball`, `prove_positive_definite`, `contraction`, `peak_sums`, `AffineMatrix`, `rational_matrix`.
"""
