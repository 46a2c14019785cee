"""Derivatives of known inputs as further known inputs: their names, and their values from samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Prefixes of the names, by order; derivatives of higher order of a sampled signal are mostly noise.
_PREFIXES = ("derivative of ", "second derivative of ", "third derivative of ")
MOST_DERIVATIVES = len(_PREFIXES)


def derivative_name(name: str, order: int) -> str:
    """Return the name of a derivative of an input: ``derivative of u1``, ``second derivative of u1``."""
    return _PREFIXES[order - 1] + name


def derivative_of(name: str, inputs: Sequence[str]) -> tuple[str, int] | None:
    """Return the input and the order of the derivative that a name stands for; ``None`` for any other name."""
    for order, prefix in enumerate(_PREFIXES, 1):
        if name.startswith(prefix) and (base := name.removeprefix(prefix)) in inputs:
            return base, order
    return None


def difference_quotients(
    times: FloatArray, values: FloatArray, order: int, before: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of samples ``(n,)`` by backward divided differences, and the memory for the next samples.

    The memory ``(2 order,)`` holds the last ``order`` times, the latest first, the last value, and its derivatives of
    lower order.  ``before`` is the memory of the earlier samples; without it the input is constant before the first
    sample.  The derivative of a polynomial of this degree is exact at any times; otherwise the error is of first order
    in the steps.
    """
    if before is None:
        before = np.concatenate([times[0] - np.arange(1.0, order + 1.0), [values[0]], np.zeros(order - 1)])
    every = np.concatenate([before[:order][::-1], times])
    last = np.concatenate([every[: -order - 1 : -1], [values[-1]], np.zeros(order - 1)])
    quotients = values
    for k in range(order):
        spans = times - every[order - k - 1 : len(every) - k - 1]
        # Times that do not increase raise an error where rows are checked.
        spans[~(spans > 0.0)] = np.nan
        quotients = (k + 1) * np.diff(quotients, prepend=before[order + k]) / spans
        if k < order - 1:
            last[order + 1 + k] = quotients[-1]
    return quotients, last
