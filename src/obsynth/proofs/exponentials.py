"""Enclosures of matrix exponentials, from python-flint's ball arithmetic, as balls of double precision."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import UNDERFLOW, UNIT_ROUNDOFF, Ball

#: Digits in which exponentials are formed, in bits.
BITS = 160


def exponential(matrix: FloatArray, time: float) -> Ball:
    """Return a ball that holds ``e^{A t}`` of ``A (n, n)``; its radius is infinite where nothing is known."""
    import flint

    n = len(matrix)
    if not n:
        return Ball.exact(np.zeros((0, 0)))
    with flint.ctx.workprec(BITS):
        scaled = flint.arb_mat(n, n, [flint.arb(value) for value in np.ravel(matrix).tolist()]) * flint.arb(float(time))
        return as_ball(scaled.exp())


def held_input(a: FloatArray, b: FloatArray, time: float) -> Ball:
    r"""Return a ball that holds ``\int_0^t e^{A s} ds B``, for ``A (n, n)``, ``B (n, m)``."""
    n, m = b.shape
    chain = np.zeros((n + m, n + m))
    chain[:n, :n], chain[:n, n:] = a, b
    whole = exponential(chain, time)
    return Ball(whole.midpoint[:n, n:], whole.radius[:n, n:])


def energy(a: FloatArray, b: FloatArray, time: float) -> Ball:
    r"""Return a ball that holds ``\int_0^t e^{A s} B B' e^{A' s} ds`` (Van Loan), for ``A (n, n)``, ``B (n, m)``."""
    import flint

    n = len(a)
    with flint.ctx.workprec(2 * BITS):
        rows = [[flint.arb(0)] * (2 * n) for _ in range(2 * n)]
        inputs = flint.arb_mat(b.shape[0], b.shape[1], [flint.arb(value) for value in np.ravel(b).tolist()])
        square = inputs * inputs.transpose()
        for i in range(n):
            for j in range(n):
                rows[i][j], rows[n + i][n + j] = flint.arb(-float(a[i, j])), flint.arb(float(a[j, i]))
                rows[i][n + j] = square[i, j]
        whole = (flint.arb_mat(rows) * flint.arb(float(time))).exp()
        late = flint.arb_mat([[whole[n + j, n + i] for j in range(n)] for i in range(n)])
        upper = flint.arb_mat([[whole[i, n + j] for j in range(n)] for i in range(n)])
        return as_ball(late * upper)


def as_ball(content: object) -> Ball:
    """Return a matrix of python-flint's balls as a `Ball`: midpoints rounded, radii rounded up."""
    rows, columns = int(content.nrows()), int(content.ncols())  # type: ignore[attr-defined]
    midpoint, radius = np.empty((rows, columns)), np.empty((rows, columns))
    for i in range(rows):
        for j in range(columns):
            entry = content[i, j]  # type: ignore[index]
            middle = float(entry.mid()) if entry.is_finite() else np.nan
            midpoint[i, j] = middle
            radius[i, j] = float(entry.rad()) if entry.is_finite() else np.inf
    # Both conversions round to nearest.
    return Ball(midpoint, radius * (1.0 + 4.0 * UNIT_ROUNDOFF) + UNIT_ROUNDOFF * np.abs(midpoint) + 2.0 * UNDERFLOW)
