"""Rows of a parity relation: each sum is rounded once, whatever cancels in it."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from obsynth.methods.functional_filter.parity_relation import _rows


def test_rows_that_cancel_keep_their_digits() -> None:
    rng = np.random.default_rng(52)
    a, c, w = rng.normal(size=(5, 5)), np.eye(5), rng.normal(size=(2, 5))
    # What the second row moves is taken away, but for the rounding of doubles.
    w[0] = -(w[1] @ c @ a)
    rows = _rows(w, a, c)
    exact = [[sum(Fraction(p) * Fraction(q) for p, q in zip(w[1], column, strict=True)) for column in c.T]]
    last = rows[1]
    assert all(float(value) == found for value, found in zip(exact[0], last, strict=True))
    first = [
        sum(Fraction(p) * Fraction(q) for p, q in zip([*w[0], *last], [*c[:, j], *a[:, j]], strict=True))
        for j in range(5)
    ]
    plain = w[0] @ c + last @ a
    exactly = [abs(Fraction(value) - one) for value, one in zip(rows[0], first, strict=True)]
    in_doubles = [abs(Fraction(value) - one) for value, one in zip(plain, first, strict=True)]
    # Of terms of size one: twice the digits of a double, against a double's.
    assert max(exactly) < Fraction(2) ** -95
    assert max(in_doubles) > Fraction(2) ** -60
