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
    """Return divided differences of samples ``(n,)`` from row to row, and what the next rows need of the last one.

    ``before``: what the rows before left, ``(1 + order,)``: their last time, value, and its derivatives of lower order;
    without any, the input is taken as constant until the first row.  A quotient has the error of a first-order
    backward difference: half the step times the next derivative.
    """
    if before is None:
        before = np.concatenate([[times[0] - 1.0, values[0]], np.zeros(order - 1)])
    last = np.concatenate([[times[-1], values[-1]], np.zeros(order - 1)])
    steps = np.diff(times, prepend=before[0])
    # Times that do not increase are refused where rows are checked.
    steps[~(steps > 0.0)] = np.nan
    quotients = values
    for k in range(order):
        quotients = np.diff(quotients, prepend=before[1 + k]) / steps
        if k < order - 1:
            last[2 + k] = quotients[-1]
    return quotients, last
