"""What delay buys: the least deviation of a fault estimate against its lag, for walks of the fault.

One Riccati equation for each walk: smoothing over L samples takes ``sum_j G_j C M_j`` from the error covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.methods.functional_filter.kalman_gain import filter_model, kalman_gain
from obsynth.methods.functional_filter.rates import default_rates, settling_time
from obsynth.methods.riccati import riccati_solution
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exosystems import exosystem

#: Lags in samples, and walks relative to the middle one.
LAGS, FACTORS = (0, 1, 2, 5, 10, 25), (0.3, 1.0, 3.0)


@dataclass(frozen=True, eq=False)
class DelayCurve:
    """Fields: fault; rates: walks per sample; lags: samples; deviations ``(rates, lags)`` of the delayed error."""

    fault: str
    rates: tuple[float, ...]
    lags: tuple[int, ...]
    deviations: FloatArray

    @property
    def sentence(self) -> str:
        """What the first sample of delay is worth at the middle walk, and five of them."""
        row = self.deviations[len(self.rates) // 2]
        rate = self.rates[len(self.rates) // 2]
        at = {lag: float(value) for lag, value in zip(self.lags, row, strict=True)}
        return (
            f"{self.fault}: for a walk of {rate:.3g} per sample one sample of delay takes the deviation from "
            f"{at[0]:.3g} to {at[1]:.3g}, five samples to {at[5]:.3g}."
        )


def delay_curve(
    plant: DescriptorSystem, fault: int, rate: float | None = None, lags: Sequence[int] = LAGS
) -> DelayCurve | None:
    """Return the curve of a fault of a sampled plant, free of all others; ``None`` where it cannot be estimated."""
    if not plant.dt > 0.0 or not plant.nw:
        return None
    removed = [j for j in range(plant.nf) if j != fault]
    model = filter_model(plant, exosystem("step", plant.fault_names, plant.dt), removed=removed, faults=[fault])
    if not len(model.M) or decide_rank(model.M, expected=len(model.M)).rank < len(model.M):
        return None
    try:
        middle = float(default_rates(model, settling_time(plant), lag=0)[0][0]) if rate is None else rate
        rows = []
        for factor in FACTORS:
            walks = np.array([factor * middle])
            gain = kalman_gain(model, walks, lag=max(lags))
            states = np.diag(np.r_[np.ones(model.order), np.zeros(len(model.A) - model.order)])
            process = model.N @ model.N.T + (model.drive * walks**2) @ model.drive.T + gain.added**2 * states
            p = riccati_solution(model.A, model.C, process, model.M @ model.M.T, model.N @ model.M.T)
            if p is None:
                return None
            rows.append(_smoothed(p, model.C, model.A - gain.K @ model.C, model.estimate, gain.lag, lags))
    except ObsynthError:
        return None
    rates = tuple(factor * middle for factor in FACTORS)
    return DelayCurve(plant.fault_names[fault], rates, tuple(lags), np.array(rows))


def _smoothed(
    p: FloatArray, c: FloatArray, closed: FloatArray, estimate: FloatArray, gains: Sequence[FloatArray],
    lags: Sequence[int],
) -> list[float]:  # fmt: skip
    known, moved, found = np.zeros_like(p), p.copy(), {}
    for lag in range(max(lags) + 1):
        known = known + gains[lag] @ c @ moved
        moved = closed @ moved
        found[lag] = float(np.sqrt(max((estimate @ (p - known) @ estimate.T)[0, 0], 0.0)))
    return [found[lag] for lag in lags]
