"""Derivatives of known inputs as known inputs of their own: their names, and their values from samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Words of orders; higher derivatives of a sampled signal are noise.
_ORDERS = ("derivative of ", "second derivative of ", "third derivative of ")
MOST_DERIVATIVES = len(_ORDERS)


def derivative_name(name: str, order: int) -> str:
    """Return what the derivative of an input is called: ``derivative of u1``, ``second derivative of u1``."""
    return _ORDERS[order - 1] + name


def derivative_of(name: str, inputs: Sequence[str]) -> tuple[str, int] | None:
    """Return the input of which a name is the derivative, and its order; ``None`` where it is none of theirs."""
    for order, words in enumerate(_ORDERS, 1):
        if name.startswith(words) and (base := name.removeprefix(words)) in inputs:
            return base, order
    return None


def difference_quotients(
    times: FloatArray, values: FloatArray, order: int, before: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of samples ``(n,)`` by divided differences over the last ``order + 1`` rows, and what the next
    rows need of the last ones.

    ``before``: what the rows before left, ``(2 order,)``: their last times, the latest first, the last value, and its
    derivatives of lower order; without any, the input is taken as constant until the first row.  A polynomial of this
    order is exact at any times; else the error is of the first order in the steps, as of a backward difference.
    """
    if before is None:
        before = np.concatenate([times[0] - np.arange(1.0, order + 1.0), [values[0]], np.zeros(order - 1)])
    every = np.concatenate([before[:order][::-1], times])
    last = np.concatenate([every[: -order - 1 : -1], [values[-1]], np.zeros(order - 1)])
    quotients = values
    for k in range(order):
        spans = times - every[order - k - 1 : len(every) - k - 1]
        # Times that do not increase are refused where rows are checked.
        spans[~(spans > 0.0)] = np.nan
        quotients = (k + 1) * np.diff(quotients, prepend=before[order + k]) / spans
        if k < order - 1:
            last[order + 1 + k] = quotients[-1]
    return quotients, last
