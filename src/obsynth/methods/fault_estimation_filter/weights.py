"""The free residual weight W against the paper's: gains and noise with each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from obsynth.analysis.existence.restricted_equivalent import PreparedPlant
from obsynth.methods.fault_estimation_filter.convex_problem import centred, gain_problem
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.central_filter import search_least_gain
from obsynth.numerics.norms import output_covariance
from obsynth.observers.linear.observer import LinearObserver

#: A least gain below this share of what disturbances can do is zero but for rounding.
AS_NOTHING = 1e-9


def price_in_words(gamma: float, gains: Mapping[str, FloatArray], observer: LinearObserver) -> str:
    """Return gamma, the norm of W and the H2 norm of the fault estimates from unit noise on each output."""
    to_faults, direct = observer.Cz[observer.fault_rows], observer.Dy[observer.fault_rows]
    noise = float(np.sqrt(np.trace(output_covariance(observer.Az, observer.By, to_faults, direct))))
    return f"gamma {gamma:.5g}, |W| {np.linalg.norm(gains['W'], 2):.4g}, noise {noise:.4g}"


def least_gains_by_weight(prepared: PreparedPlant) -> tuple[float, float]:
    """Return the least gain found with the paper's W and with a free one; one number twice where no W is free."""
    free, _ = gain_problem(prepared, free_weight=True)
    fixed, parts = gain_problem(prepared, free_weight=False)
    fixed, _ = centred(fixed, prepared, parts)
    upper = search_least_gain(fixed).gain
    lower = search_least_gain(free).gain if free.measured else upper
    nothing = AS_NOTHING * max(free.disturbance_size, upper)
    return tuple(gain if gain > nothing else 0.0 for gain in (upper, lower))  # type: ignore[return-value]
