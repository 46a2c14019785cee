"""Proofs that a matrix is nonsingular: an approximate inverse with a residual below one, rounded outwards.

With ``|I - B M| < 1`` in any norm of matrices ``B M`` is nonsingular, and so is M (S. M. Rump, Acta Numerica 2010,
section 10).
"""

from __future__ import annotations

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import equilibrate
from obsynth.proofs.balls import Ball, rounded_up

#: An inverse with entries above this, of a matrix with entries near one, leaves the verdict to whoever asks: what was
#: computed may have such an entry by its own rounding alone.
LARGEST_INVERSE = 1e6

#: Primes modulo which a determinant is looked at: a number that is not zero is zero modulo both by a chance of 1e-37.
PRIMES = (2**61 - 1, 2**62 - 57)


def is_nonsingular_exactly(matrix: FloatArray) -> bool:
    """Return whether a square matrix of doubles, taken exactly, is proved nonsingular: its determinant modulo a prime
    is not zero.  False says nothing, but is wrong by a chance of 1e-37 alone."""
    count = len(matrix)
    if matrix.shape != (count, count):
        return False
    mantissas, exponents = np.frexp(matrix)
    integers, places = np.ldexp(mantissas, 53).astype(np.int64).ravel().tolist(), exponents.ravel().tolist()
    for prime in PRIMES:
        powers = {place: pow(2, place, prime) for place in set(places)}
        entries = [number * powers[place] % prime for number, place in zip(integers, places, strict=True)]
        if flint.nmod_mat(count, count, entries, prime).rank() == count:
            return True
    return False


def is_proved_nonsingular(matrix: FloatArray) -> bool:
    """Return whether a square matrix is proved nonsingular, and no rounding of dense data makes it so; False says
    nothing."""
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        return False
    if np.count_nonzero(matrix) == np.count_nonzero(np.diagonal(matrix)):
        return bool(np.all(np.diagonal(matrix)))
    # Powers of two change no verdict.
    scaled = equilibrate(matrix)
    try:
        inverse = np.asarray(np.linalg.inv(scaled), dtype=np.float64)
    except np.linalg.LinAlgError:
        return False
    if not np.max(np.abs(inverse)) <= LARGEST_INVERSE:
        return False
    missing = Ball.exact(np.eye(len(matrix))) - Ball.exact(inverse) @ Ball.exact(scaled)
    return bool(np.max(rounded_up(missing.magnitude.sum(axis=1), len(matrix) + 2)) < 1.0)
