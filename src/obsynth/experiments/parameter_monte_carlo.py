"""Many runs of a recursive design: how large errors are, and what its decisions on parameters are worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.monitor import Monitor
from obsynth.experiments.parameter_batch_simulation import RecursiveBench, RowEstimates
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.alarms import Decision
from obsynth.observers.decisions import STATISTICS, decide
from obsynth.observers.recursive.estimates import RecursiveEstimates
from obsynth.observers.recursive.observer import RecursiveObserver


@dataclass(frozen=True)
class ParameterMonitor:
    """How decisions on parameters are made in every run: the options of `obsynth.decide`.

    Parameters
    ----------
    statistic : {"chi-square", "cusum", "glr", "nis"}, optional
        As for `obsynth.decide`.
    nominal : tuple of float, optional
        ``(nq,)``: nominal parameters; the observer's initial ones by default.
    false_alarms : float, optional, dimensionless
        Probability of a false alarm in a whole run.
    change : float or tuple of float, optional
        Change that ``cusum`` is tuned for, in parameter units.

    Raises
    ------
    SpecError
        The statistic is unknown.
    """

    statistic: str = "chi-square"
    nominal: tuple[float, ...] | None = None
    false_alarms: float = 0.01
    change: float | tuple[float, ...] = 0.1

    def __post_init__(self) -> None:
        if self.statistic not in STATISTICS:
            raise SpecError(f"statistic is {self.statistic!r}: use one of {', '.join(STATISTICS)}.", path="statistic")

    def watch(self, observer: RecursiveObserver, estimates: RecursiveEstimates) -> Decision:
        """Return the decision on one run.

        Parameters
        ----------
        observer : RecursiveObserver
            That gave the estimates.
        estimates : RecursiveEstimates
            Of a whole run.

        Raises
        ------
        SpecError
            As for `obsynth.decide`.
        """
        return decide(
            observer, estimates, statistic=self.statistic, nominal=self.nominal, false_alarms=self.false_alarms,
            change=self.change,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class RecursiveTask:
    """What a worker needs.

    Fields: bench: Plant, scenario and observer; watched: How to decide; seeds: One per run.
    """

    bench: RecursiveBench
    watched: ParameterMonitor | None
    seeds: tuple[int, ...]

    def __call__(self) -> dict[str, FloatArray]:
        """Return what counts of a batch of runs, one row per run; NaN for what did not happen."""
        runs = self.bench.run(self.seeds)
        count, nq = len(self.seeds), len(self.bench.observer.fault_names)
        states = np.stack([found.states for found in runs.estimates], axis=1) - runs.states
        faults = np.stack([found.parameters - runs.parameters[:, :nq] for found in runs.estimates], axis=1)
        # The first row is what was known before: no sample has been used.
        found = {
            name: np.sqrt(np.mean(errors[1:] ** 2, axis=0)) if len(errors) > 1 else np.full(errors.shape[1:], np.nan)
            for name, errors in (("states", states), ("faults", faults))
        }
        false, found_at, wrong = np.full(count, np.nan), np.full(count, np.nan), np.full(count, np.nan)
        if self.watched is not None:
            for run, estimates in enumerate(runs.estimates):
                false[run], found_at[run], wrong[run] = self._decided(self.watched, estimates)
        return {**found, "false": false, "found": found_at, "wrong": wrong}

    def _decided(self, watched: ParameterMonitor, estimates: RowEstimates) -> tuple[float, float, float]:
        """Return whether there is a false alarm, when the change is found, and whether another one is blamed."""
        # `recursive_tasks` sees to it that nothing else is watched.
        decision = watched.watch(cast(RecursiveObserver, self.bench.observer), cast(RecursiveEstimates, estimates))
        passed = decision.values > decision.thresholds
        onset = self.bench.onset
        begin = len(passed) if onset is None else onset
        false = float(passed[:begin].any())
        later = np.flatnonzero(passed[begin:])
        if not later.size:
            return false, float("nan"), float("nan")
        k, alarm = begin + int(later[0]), decision.alarm
        names = self.bench.observer.fault_names
        acted = np.any(self.bench.drive.left[: k + 1, -len(names) :] != 0.0, axis=0)
        if alarm is None or alarm.k != k or not alarm.parameter or not acted.any():
            return false, float(k), float("nan")
        return false, float(k), float(not acted[names.index(alarm.parameter)])


def recursive_tasks(
    bench: RecursiveBench, monitor: ParameterMonitor | Monitor | None, seeds: Sequence[int], size: int
) -> list[RecursiveTask]:
    """Return batches of runs."""
    observer = bench.observer
    if isinstance(monitor, Monitor):
        raise SpecError("This design is recursive: give monitor=obsynth.ParameterMonitor(...).", path="monitor")
    if monitor is not None and not isinstance(observer, RecursiveObserver):
        raise SpecError(
            "Decisions are for time-varying plants: the innovations of a nonlinear one are only nearly white. Leave "
            "monitor out, and read the errors.", path="monitor",
        )  # fmt: skip
    return [RecursiveTask(bench, monitor, tuple(seeds[i : i + size])) for i in range(0, len(seeds), size)]
