"""What many runs of a scenario say: rates, delays and errors, each with its confidence interval."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray


@dataclass(frozen=True)
class Interval:
    """A number estimated from runs.

    Parameters
    ----------
    value : float
        The share, or the mean; NaN without any run that counts.
    low, high : float
        Confidence interval; NaN where too few runs count.
    count : int
        Runs that count.
    """

    value: float
    low: float
    high: float
    count: int


def share(hits: int, count: int, confidence: float) -> Interval:
    """Return a share with its exact (Clopper-Pearson) interval."""
    from scipy.special import betaincinv

    if count == 0:
        return Interval(float("nan"), float("nan"), float("nan"), 0)
    tail = (1.0 - confidence) / 2.0
    low = 0.0 if hits == 0 else float(betaincinv(hits, count - hits + 1, tail))
    high = 1.0 if hits == count else float(betaincinv(hits + 1, count - hits, 1.0 - tail))
    return Interval(hits / count, low, high, count)


def mean(values: FloatArray, confidence: float) -> Interval:
    """Return a mean with Student's interval; NaN among the values does not count."""
    from scipy.special import stdtrit

    known = values[~np.isnan(values)]
    if known.size < 2:
        centre = float(known[0]) if known.size else float("nan")
        return Interval(centre, float("nan"), float("nan"), int(known.size))
    centre = float(np.mean(known))
    half = float(stdtrit(known.size - 1, (1.0 + confidence) / 2.0) * np.std(known, ddof=1) / np.sqrt(known.size))
    return Interval(centre, centre - half, centre + half, int(known.size))


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What many runs of a scenario say, each number with its confidence interval.

    Parameters
    ----------
    runs : int
        Run i has the scenario's seed plus i.
    confidence : float
        Of the intervals.
    false_alarm_rate : Interval
        Share of the runs with an alarm before the first fault; of all runs where the scenario has none.
    missed_detection_rate : Interval
        Share of the runs without an alarm from the first fault on; of no runs without a fault.
    detection_delay : Interval
        Seconds from the first fault to the first alarm after it, mean over the runs that have one.
    isolation_error_rate : Interval
        Share of the detections that name a fault which did not act until then; of no runs where no fault of the plant
        acts.
    fault_rmse, state_rmse : mapping of str to Interval
        Root mean square error after warm-up of each estimate, mean over runs; of recursive designs, which state how
        uncertain they are from the start, over the whole record but its first row.
    """

    runs: int
    confidence: float
    false_alarm_rate: Interval
    missed_detection_rate: Interval
    detection_delay: Interval
    isolation_error_rate: Interval
    fault_rmse: Mapping[str, Interval]
    state_rmse: Mapping[str, Interval]

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data."""
        found: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, Mapping):
                found[name] = {signal: asdict(item) for signal, item in value.items()}
            else:
                found[name] = asdict(value) if isinstance(value, Interval) else value
        return found
