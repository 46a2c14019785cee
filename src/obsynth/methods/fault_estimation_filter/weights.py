"""The free residual weight W compared with the paper's: gain and noise with each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from obsynth.analysis.existence.restricted_equivalent import PreparedPlant
from obsynth.methods.fault_estimation_filter.convex_problem import centred, gain_problem, with_output_noise
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.central_filter import LeastGain, search_least_gain
from obsynth.numerics.norms import output_covariance
from obsynth.observers.linear.observer import LinearObserver

#: A least gain below this share of what disturbances can do is zero but for rounding.
AS_NOTHING = 1e-9


def price_in_words(gamma: float, gains: Mapping[str, FloatArray], observer: LinearObserver) -> str:
    """Return gamma, the norm of W and the H2 norm of the fault estimates from unit noise on each output."""
    to_faults, direct = observer.Cz[observer.fault_rows], observer.Dy[observer.fault_rows]
    noise = float(np.sqrt(np.trace(output_covariance(observer.Az, observer.By, to_faults, direct))))
    return f"gamma {gamma:.5g}, |W| {np.linalg.norm(gains['W'], 2):.4g}, noise {noise:.4g}"


class LeastByWeight(NamedTuple):
    """The least gain with the paper's W and with a free one, and the searches that found them, as a design begins."""

    paper: float
    free: float
    paper_search: LeastGain
    free_search: LeastGain


def least_by_weight(prepared: PreparedPlant) -> LeastByWeight:
    """Return the least gain found with the paper's W and with a free one; one number twice where no W is free."""
    free, parts = gain_problem(prepared, free_weight=True)
    fixed, fixed_parts = gain_problem(prepared, free_weight=False)
    fixed, _ = centred(fixed, prepared, fixed_parts)
    if prepared.Bw.shape[1] == 0:
        free = with_output_noise(free, parts)
    paper = search_least_gain(replace(fixed, judged_exactly=False))
    best = search_least_gain(replace(free, judged_exactly=False)) if free.measured else paper
    nothing = AS_NOTHING * max(free.disturbance_size, paper.gain)
    upper, lower = (found.gain if found.gain > nothing else 0.0 for found in (paper, best))
    return LeastByWeight(upper, lower, paper, best)
