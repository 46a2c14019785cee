"""Monitoring a residual: one statistic, one threshold, and a sentence that says what it promises."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.estimates import Estimates

if TYPE_CHECKING:
    from obsynth.experiments.monitors.residual_model import ResidualModel

KINDS = ("paper", "pointwise", "window", "chi-square", "cusum")
STATEMENTS: Mapping[str, str] = {
    "paper": "eq. (66) of Wang et al. 2015 with the norm of the power: not a pointwise bound, may be passed without a "
    "fault, and knows no sensor noise",
    "pointwise": "never passed without a fault while disturbances, noise and the error at the start keep their bounds",
    "window": "l2 norm over a window: never passed without a fault while disturbances, noise and the error at the "
    "start keep their bounds",
    "chi-square": "passed in a run without a fault with at most the stated probability, for Gaussian noise, after the "
    "start is forgotten",
    "cusum": "cumulative sum of the whitened residual: passed in a run without a fault with at most the stated "
    "probability, for Gaussian noise, after the start is forgotten",
}
#: What a statement adds for a continuous design.
BETWEEN_SAMPLES = "; disturbances may do anything within their bounds between samples, at the stated sample time"
#: The assumption of a sampled design: what happens between its samples is not in its model.
HELD = "; inputs and disturbances are held between samples, as the sampled model has them"
SAMPLED = BETWEEN_SAMPLES + "; known inputs are held between samples"
#: The other assumptions of every bound that is never passed.
ASSUMED = "; the plant starts at rest, and known inputs are held or go in straight lines between samples"
#: Where the residual is made not to see the faults that are modelled.
OF_ESTIMATES = "the norm of the fault estimates, as the residual does not see the faults that are modelled: "


def statement_of(kind: str, model: ResidualModel, *, estimates: bool) -> str:
    """Return what a threshold promises; ``estimates``: of the fault estimates instead of the residual."""
    ending = ""
    if kind in ("pointwise", "window"):
        # Of a sampled plant disturbances may move between samples where the continuous one behind it is known.
        held = HELD if model.sampled is None else SAMPLED
        ending = held if model.flow is None else BETWEEN_SAMPLES + ASSUMED
    return (OF_ESTIMATES if estimates else "") + STATEMENTS[kind] + ending


@dataclass(frozen=True, eq=False)
class Detection:
    """What a monitor saw in one record.

    Parameters
    ----------
    kind, statement : str
        The monitor's, and what its threshold means.
    values, threshold : FloatArray
        ``(steps,)``.
    k : int or None
        First sample at which the threshold is passed.
    time : float or None, seconds
        The same.
    fault : str
        The isolated fault: largest estimate at (or a given number of samples after) the alarm, in its own deviations;
        empty without an alarm.
    """

    kind: str
    statement: str
    values: FloatArray
    threshold: FloatArray
    k: int | None
    time: float | None
    fault: str


@dataclass(frozen=True, eq=False)
class Monitor:
    """A statistic of the residual with its threshold, for records of one length; see `obsynth.monitor`.

    Parameters
    ----------
    kind, statement : str
        Which one, and what its threshold means.
    threshold : FloatArray
        ``(steps,)``; infinite where it does not decide yet.
    floor : float
        What rounding may add to the statistic.
    dt : float, seconds
        Between samples.
    window : int
        Samples that the statistic looks back.
    mean : FloatArray
        ``(nr,)``: subtracted from the residual.
    whitener : FloatArray
        ``(m, window nr)``, for the statistical kinds; empty otherwise.
    change : float
        Shift of the whitened residual that the cumulative sum is tuned for, in deviations.
    fault_scales : FloatArray
        ``(nf,)``: what fault estimates are compared in.
    fault_names : tuple of str
        Their names.
    isolation_delay : int
        Samples from the alarm to the comparison.
    watches_estimates : bool
        Whether the fault estimates stand in place of the residual, which does not see modelled faults.
    """

    kind: str
    statement: str
    threshold: FloatArray
    floor: float
    dt: float
    window: int
    mean: FloatArray
    whitener: FloatArray
    change: float
    fault_scales: FloatArray
    fault_names: tuple[str, ...]
    isolation_delay: int
    watches_estimates: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "threshold", read_only(self.threshold))

    def statistic(self, residuals: FloatArray) -> FloatArray:
        """Return the statistic ``(steps, runs)`` of many runs at once.

        Parameters
        ----------
        residuals : FloatArray
            ``(steps, runs, nr)``.

        Raises
        ------
        SpecError
            Another number of samples than the monitor was made for.
        """
        if len(residuals) != len(self.threshold):
            raise SpecError(
                f"The record has {len(residuals)} samples, but the monitor is for {len(self.threshold)}.", path="steps"
            )
        if self.kind in ("paper", "pointwise"):
            return np.asarray(np.linalg.norm(residuals, axis=2))
        if self.kind == "window":
            squares = np.sum(residuals**2, axis=2)
            sums = [np.sum(part, axis=0) for part in _windows(squares, self.window)]
            return np.asarray(np.sqrt(np.stack(sums)))
        centred = residuals - self.mean
        padded = np.concatenate([np.zeros((self.window - 1, *centred.shape[1:])), centred])
        stacked = np.concatenate([padded[i : i + len(centred)] for i in range(self.window)], axis=2)
        white = stacked @ self.whitener.T
        return np.asarray(np.sum(white**2, axis=2)) if self.kind == "chi-square" else self._sums(white)

    def _sums(self, white: FloatArray) -> FloatArray:
        increments = self.change * np.concatenate([white, -white], axis=2) - 0.5 * self.change**2
        level, values = np.zeros(increments.shape[1:]), np.zeros(white.shape[:2])
        for k in np.flatnonzero(np.isfinite(self.threshold)):
            level = np.maximum(level + increments[k], 0.0)
            values[k] = np.max(level, axis=1)
        return values

    def passed(self, residuals: FloatArray) -> np.ndarray:
        """Return at which samples of which runs the threshold is passed, ``(steps, runs)``.

        Parameters
        ----------
        residuals : FloatArray
            ``(steps, runs, nr)``.
        """
        return np.asarray(self.statistic(residuals) > self.threshold[:, None] + self.floor)

    def passed_in(self, runs: Any, residuals: slice, *, onset: int | None = None) -> np.ndarray:
        """Return the same from everything that happened in many runs.

        Parameters
        ----------
        runs : Runs
            With `rows` of the observer ``(steps, runs, rows)``.
        residuals : slice
            Which of them are residuals.
        onset : int, optional
            First sample at which something is wrong; with it, only whether a run passes before that, and where it
            passes first after that, need be right.
        """
        del onset
        return self.passed(runs.rows[:, :, residuals])

    def isolated(self, faults: FloatArray, k: int) -> int:
        """Return the number of the fault that stands out after an alarm at ``k``.

        Parameters
        ----------
        faults : FloatArray
            Fault estimates ``(steps, nf)``.
        k : int
            Sample of the alarm.
        """
        return int(np.argmax(np.abs(faults[min(k + self.isolation_delay, len(faults) - 1)]) / self.fault_scales))

    def watch(self, estimates: Estimates) -> Detection:
        """Return what this monitor sees in a record.

        Parameters
        ----------
        estimates : Estimates
            Such as ``simulation.estimates``.

        Raises
        ------
        SpecError
            Another number of samples than the monitor was made for.
        """
        residuals = (estimates.faults if self.watches_estimates else estimates.residuals)[:, None, :]
        hits = np.flatnonzero(self.passed(residuals)[:, 0])
        k = int(hits[0]) if hits.size else None
        fault = "" if k is None or not self.fault_names else self.fault_names[self.isolated(estimates.faults, k)]
        return Detection(
            self.kind,
            self.statement,
            read_only(self.statistic(residuals)[:, 0]),
            self.threshold,
            k,
            None if k is None else k * self.dt,
            fault,
        )


def _windows(values: FloatArray, window: int) -> list[FloatArray]:
    return [values[max(k - window + 1, 0) : k + 1] for k in range(len(values))]
