"""Evaluation of alarms over many random runs of a scenario: false, late, missed and misattributed ones."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from functools import partial
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.monitor import Monitor
from obsynth.monitoring.thresholds.parameter_decisions import ParameterMonitor
from obsynth.numerics.arguments import OpenUnitInterval, arguments_checked, whole_number
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.progress import RunsProgress, as_they_come, progress_of_runs
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.results.design import ObserverDesign
from obsynth.results.registered import registered
from obsynth.simulation.benches import Bench, Runs, bench_of, drawn_designs, make_bench
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.simulate import aligned_errors

#: Numbers that a batch of runs may hold at once, per signal: what keeps memory small and one task worth sending.
BATCH_SAMPLES = 100_000


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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(
    ...     horizon=30,
    ...     faults={"f1": obsynth.Step(size=1.0, start=10)},
    ...     disturbances={"d1": obsynth.Uniform(low=-0.1, high=0.1)},
    ... )
    >>> rates = obsynth.evaluate(design, scenario, runs=10, monitor=obsynth.monitor(design, scenario))
    >>> rates.false_alarm_rate.low, round(rates.false_alarm_rate.high, 2)  # of no alarm in ten runs
    (0.0, 0.31)
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
    centre = float(np.mean(known)) if known.size else float("nan")
    if known.size < 2:
        return Interval(centre, float("nan"), float("nan"), int(known.size))
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
    fault_warm_up, state_warm_up : float or None
        Seconds after which less than 1 % of the start is left in the estimates, and errors count; ``None`` where the
        record ends before that: errors are of all its rows.
    recursive : bool
        Whether the design is recursive: what it estimates as faults are parameters of the plant.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(
    ...     horizon=30,
    ...     faults={"f1": obsynth.Step(size=1.0, start=10)},
    ...     disturbances={"d1": obsynth.Uniform(low=-0.1, high=0.1)},
    ... )
    >>> rates = obsynth.evaluate(design, scenario, runs=10, monitor=obsynth.monitor(design, scenario))
    >>> rates.false_alarm_rate.value, rates.detection_delay.value
    (0.0, 1.0)
    """

    runs: int
    confidence: float
    false_alarm_rate: Interval
    missed_detection_rate: Interval
    detection_delay: Interval
    isolation_error_rate: Interval
    fault_rmse: Mapping[str, Interval]
    state_rmse: Mapping[str, Interval]
    fault_warm_up: float | None = None
    state_warm_up: float | None = None
    recursive: bool = False

    def __repr__(self) -> str:
        """Return rates, delays and errors as tables."""
        return str(registered("text_of_evaluation")(self))

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data."""
        data: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, Mapping):
                data[name] = {signal: asdict(item) for signal, item in value.items()}
            else:
                data[name] = asdict(value) if isinstance(value, Interval) else value
        return data


def _run(
    task: tuple[Bench, tuple[int, ...]],
    *,
    watched: Monitor | ParameterMonitor | None,
    warm_ups: tuple[int, int],
    fault_names: tuple[str, ...],
) -> dict[str, FloatArray]:
    """Return what counts of a batch of runs on a bench, by their seeds, one row per run; NaN for what did not happen.
    ``fault_names`` are those of the plant."""
    bench, seeds = task
    runs, observer = bench.run(seeds), bench.observer
    rmse, nx = dict[str, FloatArray](), len(observer.state_names)
    for name, rows, truth, delays, warm_up in (
        ("states", slice(0, nx), bench.true_states(runs.states), observer.state_delays, warm_ups[0]),
        (
            "faults",
            slice(nx, nx + len(observer.fault_names)),
            runs.faults[:, :, list(bench.estimated)],
            observer.fault_delays,
            warm_ups[1],
        ),
    ):
        errors = aligned_errors(runs.rows[:, :, rows], truth, delays)[max(warm_up, *delays, 0) :]
        # A record no longer than the delays has no error to speak of.
        rmse[name] = np.sqrt(np.mean(errors**2, axis=0)) if len(errors) else np.full(errors.shape[1:], np.nan)
    judged = np.full((3, len(seeds)), np.nan)
    if isinstance(watched, Monitor):
        judged = _judged_residuals(watched, bench, runs, fault_names)
    elif watched is not None:
        decided = [_judged_parameters(watched, bench, estimates) for estimates in runs.estimates]
        judged = np.array(decided).T
    return {**rmse, "false": judged[0], "alarm": judged[1], "wrong": judged[2]}


@arguments_checked
def evaluate(
    design: ObserverDesign,
    scenario: Scenario,
    *,
    runs: int = 100,
    monitor: Monitor | ParameterMonitor | None = None,
    executor: Executor | None = None,
    progress: RunsProgress | bool | None = None,
    confidence: OpenUnitInterval = 0.95,
    plants: int | None = None,
) -> Evaluation:
    """Run a scenario many times, with the seeds ``scenario.seed``, ``scenario.seed + 1``, ...

    Parameters
    ----------
    design : ObserverDesign
        Of any method.
    scenario : Scenario
        With random disturbances or noise; as `simulate` takes it.
    runs : int, optional
        How many.
    monitor : Monitor or ParameterMonitor, optional
        From `obsynth.monitor`, or how a recursive or nonlinear design decides on its parameters; without one only
        errors of the estimates are counted.
    executor : concurrent.futures.Executor, optional
        Where batches of runs go; by default they run here.  The result does not depend on it.
    progress : callable or bool, optional
        Called with the number of runs done and their total after each batch; `True` shows a bar on standard error.
    confidence : float, optional
        Of every interval: Clopper-Pearson for shares, Student for means.
    plants : int, optional
        Plants drawn from the box of the plant's constants, half of them vertices, each with its share of the runs (at
        least one); by default all runs are of the nominal plant.

    Returns
    -------
    Evaluation
        Rates, delays and errors.

    Raises
    ------
    SpecError
        An option is out of range, or as for `simulate`.
    PreconditionError
        As for `simulate`.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(
    ...     horizon=30,
    ...     faults={"f1": obsynth.Step(size=1.0, start=10)},
    ...     disturbances={"d1": obsynth.Uniform(low=-0.1, high=0.1)},
    ... )
    >>> rates = obsynth.evaluate(design, scenario, runs=20, monitor=obsynth.monitor(design, scenario))
    >>> rates.false_alarm_rate.value, rates.detection_delay.value
    (0.0, 1.0)
    """
    runs = max(whole_number(runs, "runs"), 1 if plants is None else whole_number(plants, "plants"))
    seeds = range(scenario.seed, scenario.seed + runs)
    bench = bench_of(design, scenario)
    _require_fit(design, bench, monitor, plants)
    designs = [] if plants is None else drawn_designs(design, plants, scenario.seed)
    benches = [make_bench(variant, scenario) for variant in designs] or [bench]
    size = max(1, BATCH_SAMPLES // bench.signals.steps)
    # The first row of a plant with parameters is what was known before: no sample has been used.
    ends = (1, 1) if isinstance(bench.observer, (RecursiveObserver, DAEObserver)) else bench.warm_ups()
    names = design.linear[0].fault_names if isinstance(bench.observer, LinearObserver) else ()
    tasks = [
        (own_bench, tuple(seeds[i] for i in part[begin : begin + size]))
        for own_bench, part in zip(benches, np.array_split(np.arange(runs), len(benches)), strict=True)
        for begin in range(0, len(part), size)
    ]
    work = partial(_run, watched=monitor, warm_ups=(ends[0] or 0, ends[1] or 0), fault_names=names)
    results, finished = [dict[str, FloatArray]() for _ in tasks], 0
    with progress_of_runs(progress) as report_runs:
        for i, batch in as_they_come(work, tasks, executor):
            results[i], finished = batch, finished + len(batch["false"])
            if report_runs is not None:
                report_runs(finished, runs)
    parts = {name: np.concatenate([part[name] for part in results]) for name in results[0]}
    return _evaluation(parts, design, bench, ends, watched=monitor is not None, level=confidence)


def _require_fit(
    design: ObserverDesign, bench: Bench, monitor: Monitor | ParameterMonitor | None, plants: int | None
) -> None:
    """Raise `SpecError` where a monitor, or drawing plants, is not for such a design."""
    if isinstance(bench.observer, LinearObserver):
        if isinstance(monitor, ParameterMonitor):
            raise SpecError("This design is linear: give monitor=obsynth.monitor(design, scenario).", path="monitor")
        uncertain = design.linear[0].uncertainty
        if plants is not None and (uncertain is None or not uncertain.box.names):
            raise SpecError(
                "plants are drawn from the tolerances of the plant's constants, and it has none.", path="plants"
            )
        return
    if plants is not None:
        raise SpecError("plants are drawn for linear designs of a plant with tolerances.", path="plants")
    if monitor is not None and isinstance(bench.observer, (ScheduledObserver, RegionObserver)):
        raise SpecError(
            "Of a design over a region errors are counted, not alarms: leave monitor out, and run it on simulated logs "
            "(obsynth.run_on_data) with learned thresholds.",
            path="monitor",
        )
    if isinstance(monitor, Monitor):
        raise SpecError(
            "This design is recursive or nonlinear: give monitor=obsynth.ParameterMonitor(...).", path="monitor"
        )


def _judged_residuals(watched: Monitor, bench: Bench, runs: Runs, fault_names: tuple[str, ...]) -> FloatArray:
    """Return ``(3, runs)``: whether an alarm is false, when a fault is found, and whether another one is blamed."""
    observer = cast(LinearObserver, bench.observer)
    begin = len(runs.rows) if bench.onset is None else bench.onset
    passed = watched.passed_in(runs, onset=begin)
    judged = np.full((3, passed.shape[1]), np.nan)
    judged[0] = passed[:begin].any(axis=0)
    for run in np.flatnonzero(passed[begin:].any(axis=0)):
        k = begin + int(np.argmax(passed[begin:, run]))
        end = min(k + watched.isolation_delay, len(passed) - 1) + 1
        if watched.groups:
            group = watched.groups[watched.isolated(runs.rows[:, run, watched.watched.rows(observer)], k)]
            acted = np.any(runs.faults[:end, run] != 0.0, axis=0)
            wrong = not acted[[fault_names.index(name) for name in group]].any()
        else:
            acted = np.any(runs.faults[:end, run, list(bench.estimated)] != 0.0, axis=0)
            wrong = acted.any() and not acted[watched.isolated(runs.rows[:, run, observer.fault_rows], k)]
        judged[1:, run] = k, float(wrong) if acted.any() else np.nan
    return judged


def _judged_parameters(watched: ParameterMonitor, bench: Bench, estimates: Estimates) -> tuple[float, float, float]:
    """Return the same of one run of an observer of parameters."""
    decision = watched.watch(cast("RecursiveObserver | DAEObserver", bench.observer), estimates)
    passed = decision.values > decision.thresholds
    begin = len(passed) if bench.onset is None else bench.onset
    false, later = float(passed[:begin].any()), np.flatnonzero(passed[begin:])
    if not later.size:
        return false, float("nan"), float("nan")
    k, alarm, names = begin + int(later[0]), decision.alarm, bench.observer.fault_names
    acted = np.any(bench.signals.at_begin[: k + 1, -len(names) :] != 0.0, axis=0)
    if alarm is None or alarm.k != k or not alarm.parameter or not acted.any():
        return false, float(k), float("nan")
    return false, float(k), float(not acted[names.index(alarm.parameter)])


def _evaluation(
    parts: Mapping[str, FloatArray],
    design: ObserverDesign,
    bench: Bench,
    ends: tuple[int | None, int | None],
    *,
    watched: bool,
    level: float,
) -> Evaluation:
    onset = bench.onset
    states, faults = (None if end is None else end * bench.signals.dt for end in ends)
    runs, observer = len(parts["false"]), design.observer
    detected, judged = ~np.isnan(parts["alarm"]), ~np.isnan(parts["wrong"])
    counted = runs if watched else 0
    faulty = counted if onset is not None else 0
    delays = np.array([]) if not watched or onset is None else (parts["alarm"] - onset) * bench.signals.dt

    def errors(name: str, signals: tuple[str, ...]) -> Mapping[str, Interval]:
        return MappingProxyType({signal: mean(parts[name][:, i], level) for i, signal in enumerate(signals)})

    return Evaluation(
        runs,
        level,
        false_alarm_rate=share(int(np.nansum(parts["false"])), counted, level),
        missed_detection_rate=share(faulty - int(np.sum(detected)) if faulty else 0, faulty, level),
        detection_delay=mean(delays, level),
        isolation_error_rate=share(int(np.nansum(parts["wrong"])), int(np.sum(judged)), level),
        fault_rmse=errors("faults", observer.fault_names),
        state_rmse=errors("states", observer.state_names),
        fault_warm_up=faults,
        state_warm_up=states,
        recursive=isinstance(bench.observer, (RecursiveObserver, DAEObserver)),
    )
