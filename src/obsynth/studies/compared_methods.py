"""One method of a comparison: figures, responses and estimates for each fault, or why it does not exist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.methods.fault_figures import FaultFigures
from obsynth.methods.optimal_filter.least_possible import LeastPossible
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import number
from obsynth.studies.ranking import NO_DELAYS, mean_delay, relative_error


@dataclass(frozen=True)
class FaultComparison:
    """How one method estimates one fault.

    Parameters
    ----------
    figures : FaultFigures
        In closed form, on the nominal plant.
    rms : float
        Root mean square of ``fhat - f`` over the drawn runs of the scenario, not shifted by any delay.
    size : float
        Root mean square of the fault itself in these runs; where it does not happen, the largest `rms` of any method.
    bias : float
        Largest absolute mean over the runs of the estimate without a fault: what tolerances and disturbances make.
    threshold : float
        Level of an alarm, calibrated on the fault-free runs.
    detection_delay : float, seconds
        Median over the runs, from the start of the fault.
    smallest_found : float
        Size of a step that half of the runs find.
    bound : float
        What the estimate of the exact model never passes without a fault, with disturbances as large as in the scenario
        that are held between samples, and three deviations of noise: sums of absolute values.
    least : float
        The least such bound that any test with the same delay on at most `LONGEST_WINDOW` samples of inputs and outputs
        can have (fewer of plants with more than 78 states), linear or not: of a fault of any time course where the
        estimate is one sample of it, else of a constant one.  An observer uses all samples before, and its bound may be
        smaller.
    equal_delay : float, seconds
        On a log: from the fault to its alarm, with the level that 1 % of the normal rows pass; median over its begins,
        infinite where it is not found.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1})
    >>> comparison = obsynth.compare(plant, methods=["functional-filter"], runs=2)
    >>> fault = comparison.methods[0].faults[0]
    >>> fault.figures.fault, fault.rms >= 0.0
    ('f1', True)
    """

    figures: FaultFigures
    rms: float
    size: float
    bias: float
    threshold: float
    detection_delay: float
    smallest_found: float
    bound: float = float("nan")
    least: float = float("nan")
    equal_delay: float = float("nan")


@dataclass(frozen=True, eq=False)
class ComparedMethod:
    """One method, or why there is none.

    Parameters
    ----------
    method : str
        Its id.
    refused : str
        Why it does not exist, in one line; empty where it does.
    design : ObserverDesign or None
        The design, verified.
    order : int
        States of the observer on the common clock.
    milliseconds : float
        To design and verify.
    faults : tuple of FaultComparison
        One for each fault.
    fast_enough : bool
        Whether 90 % of every step is shown within the time asked for.
    responses : FloatArray
        ``(steps, faults)``: estimates of a unit step of each fault.
    estimates : FloatArray
        ``(steps, faults)``: on the first drawn run, or on the log.
    beside : LeastPossible or None
        Gain from the unknown inputs, and deviation for the noise, with the least of any causal filter that responds to
        the faults as this one does, in the design's own time; ``None`` where that is not known.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1})
    >>> comparison = obsynth.compare(plant, methods=["functional-filter"], runs=2)
    >>> method = comparison.methods[0]
    >>> method.method, method.refused, method.order
    ('functional-filter', '', 2)
    """

    method: str
    refused: str
    design: ObserverDesign | None
    order: int
    milliseconds: float
    faults: tuple[FaultComparison, ...]
    fast_enough: bool
    responses: FloatArray
    estimates: FloatArray
    beside: LeastPossible | None = None

    @property
    def shares(self) -> tuple[float, float]:
        """Gain and deviation in times the least possible; NaN where that is not known."""
        beside = self.beside
        return (np.nan, np.nan) if beside is None else (beside.gain_share, beside.deviation_share)

    @property
    def relative_error(self) -> float:
        """Root mean square over all faults of each one's error, as a share of its size: the same in all units."""
        return relative_error([vars(fault) for fault in self.faults])

    @property
    def equal_delay(self) -> tuple[int, float] | None:
        """How many faults raise no alarm, and the mean delay of the others (s), at equal healthy time in alarm on a
        log; `None` without one."""
        return mean_delay([fault.equal_delay for fault in self.faults])

    @property
    def label(self) -> str:
        """What it is called in a picture: with its delay at equal healthy time in alarm, on a log."""
        delay = self.equal_delay
        if delay is None:
            return self.method
        return f"{self.method} ({f'{number(delay[1])} s' if np.isfinite(delay[1]) else 'no alarm'})"

    @property
    def ranked_by(self) -> tuple[float, ...]:
        """What methods are ranked by, the least first."""
        return (*(self.equal_delay or NO_DELAYS), self.relative_error)
