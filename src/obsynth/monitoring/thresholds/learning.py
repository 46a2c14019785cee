"""From logs without faults to learned thresholds: the observer runs on them, and its residuals are learned from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.monitoring.logs.clock import STALE
from obsynth.monitoring.logs.log_observer import DECIDING, Row
from obsynth.monitoring.logs.log_run import LogRun
from obsynth.monitoring.logs.log_tables import parsed_rows
from obsynth.monitoring.logs.measured_columns import mostly_missing
from obsynth.monitoring.logs.signals import TIME_HEADER, LogSignals
from obsynth.monitoring.logs.sources import CHUNK_ROWS, Data, Logs, chunks
from obsynth.monitoring.logs.stamps import Stamps
from obsynth.monitoring.logs.step_observer import SteppingLogObserver
from obsynth.monitoring.logs.stuck_sensors import Unrepeated, longest_repeats, rising, stuck_rows
from obsynth.monitoring.logs.unit_check import UnitCheck
from obsynth.monitoring.thresholds.alarm_rates import rows_per_alarm
from obsynth.monitoring.thresholds.learned import NO_PAIRS, LearnedThresholds, WrongPairs
from obsynth.monitoring.thresholds.learned_from_rows import (
    LEAST_NORMAL,
    divided_at_starts,
    left_out_estimates,
    raised_levels,
    thresholds_from_rows,
    watched_rows,
)
from obsynth.monitoring.thresholds.learned_ranges import ranges_of_rows
from obsynth.monitoring.thresholds.learned_statistics import AGES
from obsynth.monitoring.thresholds.monitor import Evidence
from obsynth.monitoring.thresholds.normal_notes import (
    notes_of_left_out,
    notes_of_normal_rows,
    notes_of_sizes,
    notes_of_starts,
)
from obsynth.monitoring.thresholds.parameter_scores import Scores, before_any, parameter_walk, sample_score
from obsynth.monitoring.thresholds.range_rates import range_rates
from obsynth.monitoring.thresholds.sensor_drifts import (
    DRIFT_ROWS,
    LIMIT_ROWS,
    SensorDrifts,
    drift_limits,
    drifts_by_runs,
    linear_drifts,
    sensor_deviations,
)
from obsynth.monitoring.thresholds.watched_columns import (
    has_innovations_by_sensor,
    settling_rows,
    watched_names,
    watched_values,
)
from obsynth.monitoring.thresholds.wrong_pairs import LEAST_WRONG, NEARER, Pair, believed_pairs, taken_back, without
from obsynth.numerics.arguments import NonNegative, Seed, arguments_checked
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.outliers import checked_limit
from obsynth.observers.running import changed
from obsynth.results.design import ObserverDesign

#: Pairs may take this share of the rate of false alarms; where they would take more the levels are to hold with them.
MOST_OF_RATE = 0.5


#: Probability below which so many pairs are no chance: wrong samples, or something else, come in a row here.
CHANCE = 0.01


#: One false alarm in so many rows, where nothing else is asked for.
FALSE_ALARM_RATE = "1 per 1000 rows"

#: Deviations of its noise by which each sensor may drift, where nothing else is asked for.
SENSOR_DRIFT = 0.0


@arguments_checked
def learn_thresholds(
    design: ObserverDesign,
    data: Logs,
    *,
    false_alarms: str | float = FALSE_ALARM_RATE,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    time_column: str | None = None,
    time_zone: str | None = None,
    time_unit: str | None = None,
    scales: Mapping[str, float] | None = None,
    gap: float | None = None,
    warm_up: float | None = None,
    seed: Seed = 0,
    units_as_is: bool = False,
    sensor_drift: NonNegative = SENSOR_DRIFT,
) -> LearnedThresholds:
    """Learn the thresholds of a design from rows of its plant without faults.

    Offsets, covariance and colour of the fault estimates and residuals are taken from the rows, whatever the design
    assumes of them: they are whitened by a fitted autoregression and watched by Hotelling's T2, exponentially weighted
    means and likelihood ratios of steps; where faults are parameters that walk, by likelihood ratios of a change of
    each fault and by its estimate, too.  Levels come from a bootstrap of all that is estimated, so that a short log
    gives higher ones.

    Parameters
    ----------
    design : ObserverDesign
        Of any method.
    data : path, text stream, pandas.DataFrame or list of these
        As for `obsynth.run_on_data`: a log without faults; or several, of which each is a run of its own, or the folder
        that they are in.  Starts, set points and offsets of sensors differ from log to log: how far, is learned from
        three and more.
    false_alarms : str or float, optional
        Rate of false alarms, such as ``"1 per week"`` or ``"2 per 1000 rows"``, or a number of them per row.  Alarms
        closer than 20 rows are one.
    rows : str, slice or pair of int, optional
        Rows of each log that are free of faults, as Python counts; all by default.  The observer runs over all before.
    columns, time_column, time_zone, time_unit, scales, gap, warm_up
        As for `obsynth.run_on_data`.
    seed : int, optional
        Of the bootstrap.
    units_as_is : bool, optional
        As for `obsynth.run_on_data`: by default a log in which one signal is likely in another unit than the plant's is
        refused, as its levels would be those of the wrong unit.
    sensor_drift : float, optional
        Deviations of its noise by which each sensor may drift slowly without an alarm, whether the logs show that or
        not; 0: none.  The noise is the one that the design states, or else that of the log; the statement names sensors
        for which there is neither, and which get no room.

    Returns
    -------
    LearnedThresholds
        For `obsynth.online_monitor`; ``statement`` says what they mean, and ``holds`` whether the rows suffice;
        ``notes`` name rows to be looked at: events that raise the levels, outputs that are stuck, and whether errors of
        the model where inputs move raise them.

    Raises
    ------
    SpecError
        The log cannot be read, holds too few rows, or nothing moves in it; the rate is none; a signal is likely in
        another unit than the plant's; a ``sensor_drift`` where no sensor has noise, or the design integrates.

    References
    ----------
    Alwan & Roberts (1988), Lowry et al. (1992), Willsky & Jones (1976), Politis & Romano (1994), Gandy & Kvaloy (2013).

    Examples
    --------
    >>> import pandas as pd
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     Bd=[[0], [1]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = obsynth.simulate(design, obsynth.Scenario(horizon=2000, noise=1.0)).outputs
    >>> normal = pd.DataFrame({"time": range(len(log)), "y1": log[:, 0], "y2": log[:, 1]})
    >>> learned = obsynth.learn_thresholds(design, normal, false_alarms="1 per 100 rows")
    >>> learned.columns
    ('fhat[f1]',)
    """
    # Both are refused before the log is read.
    watched_names(design)
    rows_per_alarm(false_alarms, 1.0 if design.observer.dt == 0.0 else design.observer.dt)
    if time_column is not None:
        columns = {**(columns or {}), TIME_HEADER: time_column}

    def new_run(sizes: FloatArray | None = None, starts: FloatArray | None = None) -> LogRun:
        changes = {} if sizes is None else {"outlier_sizes": sizes}
        if starts is not None:
            changes["initial_covariance"] = starts
        own = design if not changes else design.replace(observer=changed(design.observer, **changes))
        return LogRun(own, columns, scales, gap=gap, warm_up=warm_up)

    signals = new_run().signals
    read = [_read(log, signals, time_zone, time_unit) for log in several(data)]
    if not units_as_is:
        _require_units(design, signals, [log_rows for log_rows, _ in read])
    logs = _NormalLogs.of([log_rows for log_rows, _ in read], signals)
    output, sizes = _output_and_outlier_sizes(design, new_run, logs.rows, logs.ends)
    starts = started_anywhere(design.observer, output.starts)
    if starts is not None:
        output = _output_of_logs(design, lambda: new_run(sizes, starts), logs.rows, logs.ends)
    every = rows_per_alarm(false_alarms, _sample_time(design, output))
    output, pairs = _without_pairs(design, lambda: new_run(sizes, starts), logs.rows, logs.ends, output, every)
    wanted = [(a + first, a + last) for a, b in logs.ends for first, last in [parsed_rows(rows, b - a)]]
    output = output.of_rows(wanted)
    dt = _sample_time(design, output)
    known_inputs = len(signals.names) - len(logs.repeats)
    deviations = signals.deviations(logs.rows)
    offsets = sensor_deviations(design, deviations[:, -len(logs.repeats) :])
    drifts = _drifts(design, lambda: new_run(sizes, starts), logs, sensor_drift * offsets) if sensor_drift else None
    options: dict[str, Any] = {
        "every": rows_per_alarm(false_alarms, dt), "dt": dt, "seed": seed, "pairs": pairs,
        "logs": logs.slices_of(output.numbers), "repeats": logs.repeats,
        "drifts": drifts, "sensor_drift": sensor_drift,
    }  # fmt: skip
    learned = thresholds_from_rows(
        design,
        output.watched,
        scores=output.scores,
        innovation=output.innovation_size(),
        outlier_sizes=sizes,
        initial_covariance=starts,
        missing=logs.missing(signals),
        **options,
    )
    raised = raised_levels(design, learned, output.watched, output.scores, **options)
    notes = notes_of_normal_rows(
        raised, output.numbers, logs.rows[:, 0], wanted, logs.stuck, logs.ends, [stamps for _, stamps in read]
    )
    white = learned.statistics.model.whitened(watched_rows(design, learned, output.watched))
    inputs = logs.rows[output.numbers, 1 : 1 + signals.inputs]
    ranges = ranges_of_rows(signals, deviations[np.unique(output.numbers)], known_inputs)
    distances = ranges.distances(deviations[output.numbers, :known_inputs])
    rates = range_rates(distances, white, learned, output.scores, options["logs"])
    divided = divided_at_starts(design.observer, output.scores if learned.statistics.estimates else None)
    without_room = np.flatnonzero([] if drifts is None else drifts.sensors_without())
    return replace(
        learned,
        notes=(
            *_notes_of_cells([stamps for _, stamps in read], signals),
            *notes,
            *notes_of_left_out(left_out_estimates(design, learned, output.watched), learned),
            *notes_of_sizes(white, inputs),
            *notes_of_starts(divided),
        ),
        without_drift=tuple(signals.names[signals.inputs + i] for i in without_room),
        drift_limits=_drift_limits(design, lambda: new_run(sizes, starts), logs, offsets, learned)
        if drifts is None and len(logs.ends) == 1
        else {},
        ranges=ranges._replace(rates=rates),
    )


def _require_units(design: ObserverDesign, signals: LogSignals, logs: Sequence[FloatArray]) -> None:
    """Raise `SpecError` where a signal of a log is likely in another unit than that of the plant."""
    for rows in logs:
        units = UnitCheck(design, signals)
        units.take(signals.deviations(rows))
        units.finish()


@dataclass(frozen=True, eq=False)
class _NormalLogs:
    """Logs without faults, one after the other, and what is stuck in them."""

    rows: FloatArray  # ``(n, 1 + nu + ny)``: NaN for what a stuck sensor repeats
    borders: NDArray[np.int64]  # of the logs, from 0 to n
    stuck: dict[str, list[tuple[int, int]]]  # by output: first and last rows
    repeats: FloatArray  # ``(ny,)``: from which equal sample on an output counts as not measured

    @classmethod
    def of(cls, logs: Sequence[FloatArray], signals: LogSignals) -> _NormalLogs:
        """Return logs that hold enough rows, with the samples that a stuck sensor repeats taken as not measured."""
        rows, borders = np.vstack(logs), np.cumsum([0, *map(len, logs)])
        if len(rows) < LEAST_NORMAL:
            raise SpecError(f"The log has {len(rows)} rows: give {LEAST_NORMAL} and more.", path="normal")
        before = 1 + signals.inputs
        ends = _ends_of(borders)
        stuck = [
            [(first + a, last + a) for a, b in ends for first, last in stuck_rows(column[a:b])]
            for column in rows[:, before:].T
        ]
        # As runs do it: a sample counts as not measured before it is known for how long it is repeated.
        repeats = longest_repeats([rows[a:b, before:] for a, b in ends])
        parts = [rows[a:b] for a, b in ends if a < b]
        unrepeated = [Unrepeated(repeats).of_rows(part[:, before:], rising(part[:, 0].tolist()))[0] for part in parts]
        by_output = dict(zip(signals.names[signals.inputs :], stuck, strict=True))
        return cls(np.hstack([rows[:, :before], np.vstack(unrepeated)]), borders, by_output, repeats)

    @property
    def ends(self) -> list[tuple[int, int]]:
        """First row of each log, and the one after its last."""
        return _ends_of(self.borders)

    def missing(self, signals: LogSignals) -> str:
        """Return which signals many rows are without, as a sentence; empty where there are none."""
        return mostly_missing(self.rows, {name: i for i, (_, name) in enumerate(signals.columns_and_signals(), 1)})

    def slices_of(self, numbers: NDArray[np.int64]) -> tuple[slice, ...]:
        """Return for each log which of some ascending row numbers are its own."""
        return tuple(slice(a, b) for a, b in _ends_of(np.searchsorted(numbers, self.borders)))


def _drifts(
    design: ObserverDesign,
    started: Callable[[], LogRun],
    logs: _NormalLogs,
    offsets: FloatArray,
    most: int = DRIFT_ROWS,
) -> SensorDrifts:
    """Return what drifts of sensors by ``offsets (ny,)`` do to the rows that a design makes of normal logs, from
    ``most`` of these where it has to run for it."""
    if not offsets.any():
        raise SpecError(
            "No noise of any sensor is stated, and the log shows none: a drift in deviations of it is nothing. State "
            "the noise (sensor_noise), or leave sensor_drift at 0.",
            path="sensor_drift",
        )
    if isinstance(design.observer, LinearObserver):
        return linear_drifts(design.observer, offsets)
    signals, ny = started().signals, len(offsets)
    first, last = max(logs.ends, key=lambda ends: ends[1] - ends[0])
    log = logs.rows[first : min(last, first + most)]

    def run(added: FloatArray) -> _ObserverOutput:
        moved = log.copy()
        moved[:, -ny:] += added / signals.scale[-ny:]
        return _output_of_log(design, started(), moved, first)

    return drifts_by_runs(run, offsets)


def _drift_limits(
    design: ObserverDesign,
    started: Callable[[], LogRun],
    logs: _NormalLogs,
    offsets: FloatArray,
    learned: LearnedThresholds,
) -> dict[str, float]:
    """Return by which share of one of its deviations, ``offsets (ny,)``, a slow drift of a sensor alarms for as long as
    it lasts, where it is below one: one log says nothing of those of other logs."""
    try:
        drifts = _drifts(design, started, logs, offsets, LIMIT_ROWS)
    except SpecError:
        return {}
    columns = [watched_names(design).index(name) for name in learned.columns]
    limits = drift_limits(learned.statistics, learned.levels, drifts, columns)
    signals = started().signals
    names = signals.names[signals.inputs :]
    return {name: float(limit) for name, limit in zip(names, limits, strict=True) if np.isfinite(limit)}


def _ends_of(borders: NDArray[np.int64]) -> list[tuple[int, int]]:
    return list(zip(borders[:-1].tolist(), borders[1:].tolist(), strict=True))


def _sample_time(design: ObserverDesign, output: _ObserverOutput) -> float:
    """Return the seconds between samples: the design's, or the median of the log's where it is continuous in time."""
    return design.observer.dt or float(np.median(np.diff(output.times)))


def _output_and_outlier_sizes(
    design: ObserverDesign,
    new_run: Callable[[FloatArray | None], LogRun],
    log: FloatArray,
    ends: Sequence[tuple[int, int]],
) -> tuple[_ObserverOutput, FloatArray | None]:
    """Return what a design says of rows without faults, and how far off outliers are by these rows ``(ny,)``; `None`
    where that is what the design says."""
    run = new_run(None)
    if not (isinstance(run.observer, SteppingLogObserver) and run.observer.gates
            and has_innovations_by_sensor(design.observer)):  # fmt: skip
        return _output_of_logs(design, lambda: new_run(None), log, ends), None
    ny = len(run.observer.output_names)
    stated = run.observer.observer.outlier_sizes
    output = _output_of_logs(design, lambda: new_run(np.zeros(ny)), log, ends)
    usual = checked_limit("gate", run.observer.observer.outlier_limit) * np.sqrt(
        np.nanmean(output.watched[:, -ny:] ** 2, axis=0)
    )
    inputs = np.asarray(np.isfinite(log[:, 1:-ny]).all(axis=1))
    sizes = learned_sizes(wrong_samples(output.refused, inputs), usual, np.zeros(ny) if stated is None else stated)
    if not sizes.any():
        return (output, None) if stated is None else (output, sizes)
    return _output_of_logs(design, lambda: new_run(sizes), log, ends), None if stated is not None and np.array_equal(
        sizes, stated
    ) else sizes


def wrong_samples(refused: Sequence[FloatArray], known: NDArray[np.bool_]) -> list[FloatArray]:
    """Return how far off the samples of each output were that a gate left out, and none of which it believed later, by
    its memory after each row ``(4, ny)``; ``known (n,)``: whether the inputs of the row were."""
    memory = np.array(refused)
    distances = []
    for row, total, residual, believed in np.moveaxis(memory, 2, 0).transpose(0, 2, 1):
        gone, count = np.diff(total, prepend=0.0) > 0.0, np.abs(row)
        # A run of samples that are far ends where the next one is near.
        run = np.cumsum((count == 0.0) | ((count == 1.0) & (np.concatenate([[0.0], count[:-1]]) != 1.0)))
        moved = np.isin(run, run[believed != 0.0])
        distances.append(np.abs(residual[gone & ~moved & known & (residual != 0.0)]))
    return distances


def learned_sizes(wrong: Sequence[FloatArray], usual: FloatArray, stated: FloatArray) -> FloatArray:
    """Return how far off outliers of each output are at least ``(ny,)``, of which some were so far off ``wrong``: what
    is ``stated`` where these are few and further off.

    Their logarithms are taken as normal: one more is nearer with the probability `NEARER`, as its distance from their
    mean in units of their deviation follows Student's t. Where that is within what any sample reaches (``usual``), it
    says nothing of a sample that it is further off: the gate alone judges then. What is stated is not raised, and
    without it the size stands half the way on a logarithmic scale: while a fault is followed, innovations are wider
    than in rows without faults, and an outlier may be nearer than in these.
    """
    from scipy.special import stdtrit

    least_sizes = stated.copy()
    for i, sizes in enumerate(wrong):
        n = len(sizes)
        if n >= LEAST_WRONG:
            logarithms = np.log(sizes)
            reach = float(stdtrit(n - 1, 1.0 - NEARER)) * np.sqrt(1.0 + 1.0 / n) * float(logarithms.std(ddof=1))
            least = max(float(np.exp(logarithms.mean() - reach)), usual[i])
            least_sizes[i] = min(stated[i], least) if stated[i] > 0.0 else np.sqrt(usual[i] * least)
        elif n and sizes.min() < stated[i]:
            least_sizes[i] = usual[i]
    return least_sizes


class _ObserverOutput(NamedTuple):
    """What an observer returns in each row of a log, as thresholds are learned from it."""

    numbers: NDArray[np.int64]  # ``(n,)``: of rows, from 0
    times: FloatArray  # ``(n,)`` seconds
    watched: FloatArray  # ``(n, m)``: NaN where nothing is decided, or rows are missing
    squares: FloatArray  # ``(n,)``: mean squares of innovations in the observer's own deviations, where it has these
    scores: Scores | None  # of the faults, where it is known what samples say of these
    starts: FloatArray  # ``(nx,)``: how far the estimated states have been from those at the start
    refused: list[FloatArray]  # ``(4, ny)`` each: what a gate remembers after each row; empty without a gate

    def of_rows(self, ranges: Sequence[tuple[int, int]]) -> _ObserverOutput:
        """Return the rows whose numbers are in some ranges."""
        chosen = np.any([(first <= self.numbers) & (self.numbers < last) for first, last in ranges], axis=0)
        return self._replace(
            numbers=self.numbers[chosen],
            times=self.times[chosen],
            watched=self.watched[chosen],
            squares=self.squares[chosen],
            scores=None if self.scores is None else self.scores.chosen(chosen),
        )

    def innovation_size(self) -> float:
        """Return the root mean square of the innovations in the observer's own deviations, 1 where it has none."""
        squares = self.squares[np.isfinite(self.squares) & (self.squares > 0.0)]
        return float(np.sqrt(squares.mean())) if squares.size else 1.0


def _output_of_logs(
    design: ObserverDesign, started: Callable[[], LogRun], log: FloatArray, ends: Sequence[tuple[int, int]]
) -> _ObserverOutput:
    """Return what a design says of rows ``(n, 1 + nu + ny)`` of logs that begin and end where ``ends`` says, one after
    the other with so many unknown rows between them that no statistic looks from one into another."""
    parts = []
    for first, last in ends:
        part = _output_of_log(design, started(), log[first:last], first)
        parts += [part] if last == ends[-1][1] else [part, _unknown_rows(part, last - 1)]
    if len(parts) == 1:
        return parts[0]
    nonempty = [part for part in parts if len(part.numbers)]
    scores = None
    if all(part.scores is not None for part in nonempty):
        columns = [[getattr(part.scores, field.name) for part in nonempty] for field in fields(Scores)]
        scores = Scores(*(np.concatenate(column) for column in columns))
    return _ObserverOutput(
        np.concatenate([part.numbers for part in nonempty]),
        np.concatenate([part.times for part in nonempty]),
        np.concatenate([part.watched for part in nonempty]),
        np.concatenate([part.squares for part in nonempty]),
        scores,
        np.max([part.starts for part in parts], axis=0),
        [row for part in parts for row in part.refused],
    )


def _rows(run: LogRun, log: FloatArray, together: int) -> Iterator[Row]:
    """Yield the rows of a log, so many taken together."""
    for begin in range(0, len(log), together):
        yield from run.read(log[begin : begin + together])


def _without_pairs(
    design: ObserverDesign,
    started: Callable[[], LogRun],
    log: FloatArray,
    ends: Sequence[tuple[int, int]],
    observation: _ObserverOutput,
    every: float,
) -> tuple[_ObserverOutput, WrongPairs]:
    """Return what a design says of rows without pairs of wrong samples, and what there was of these."""
    from scipy.special import pdtrc

    if not observation.refused:
        return observation, NO_PAIRS
    before = log.shape[1] - observation.refused[0].shape[1]
    y = log[:, before:]
    pairs = believed_pairs(observation.refused, y)
    if not pairs:
        return observation, NO_PAIRS

    def again(chosen: Sequence[Pair]) -> _ObserverOutput:
        return _output_of_logs(design, started, np.hstack([log[:, :before], without(y, chosen)]), ends)

    hidden = again(pairs)
    wrong = taken_back(pairs, hidden.refused, y)
    measured = np.isfinite(y).sum(axis=0)
    # All of a pair are wrong samples: those that were believed too.
    last = np.sum([hidden.refused[end - 1][1] for _, end in ends], axis=0)
    refused = last + 2.0 * np.bincount([output for _, _, output in wrong], minlength=len(measured))
    # A second comes with the same probability as the first, and in half of the cases on the same side.
    chance = float(0.5 * np.sum((refused / np.maximum(measured, 1)) ** 2))
    # So many pairs are what single wrong samples make at this rate, and leave most of the alarms to others.
    are_chance = chance * every <= MOST_OF_RATE and float(pdtrc(len(wrong) - 1, chance * len(y))) >= CHANCE
    if not wrong or not are_chance:
        return observation, NO_PAIRS
    return hidden if len(wrong) == len(pairs) else again(wrong), WrongPairs(len(wrong), chance)


def several(data: Logs) -> list[Data]:
    """Return the logs that are given: one, several, or all files of a folder by their names."""
    if isinstance(data, Sequence) and not isinstance(data, str):
        if not data:
            raise SpecError("There is no log: give one without faults.", path="normal")
        return list(data)
    if not (isinstance(data, str | Path) and Path(data).is_dir()):
        return [data]
    files = sorted(file for file in Path(data).iterdir() if file.is_file() and not file.name.startswith("."))
    if not files:
        raise SpecError(f"There is no log in {data}: give one without faults.", path="normal")
    return [*files]


def _read(data: Data, signals: LogSignals, time_zone: str | None, time_unit: str | None) -> tuple[FloatArray, Stamps]:
    """Return the rows of a log ``(n, 1 + nu + ny)``, and how to write its times."""
    stamps = Stamps(time_zone, time_unit)
    return np.vstack([np.zeros((0, 1 + len(signals.names))), *chunks(data, signals, stamps, CHUNK_ROWS)]), stamps


def _notes_of_cells(logs: Sequence[Stamps], signals: LogSignals) -> list[str]:
    """Return what is to be said of the cells of logs."""
    return [
        f"Log {number}: {text}" if len(logs) > 1 else text
        for number, stamps in enumerate(logs, 1)
        for text in (*stamps.warnings(), *stamps.measured.notes(signals.columns_and_signals(), signals.inputs))
    ]


def started_anywhere(observer: Any, reached: FloatArray) -> FloatArray | None:
    """Return the covariance ``(nx, nx)`` of states at a start that may be wherever the plant has been, so far from the
    observer's own ``(nx,)``; `None` where that is what the observer has."""
    if not reached.size:
        return None
    stated = np.asarray(observer.initial_covariance)
    missing = np.maximum(reached**2 - np.diag(stated), 0.0)
    return stated + np.diag(missing) if missing.any() else None


def _unknown_rows(like: _ObserverOutput, number: int) -> _ObserverOutput:
    """Return rows in which nothing is known, after those of a log whose last one has this number."""
    count = max(AGES)
    scores = None
    if like.scores is not None:
        like_scores = like.scores
        fills = (
            (like_scores.score, 0.0),
            (like_scores.information, 0.0),
            (like_scores.theta, np.nan),
            (like_scores.deviations, np.nan),
        )
        scores = Scores(*(np.full((count, *part.shape[1:]), fill) for part, fill in fills))
    last = float(like.times[-1]) if len(like.times) else 0.0
    return _ObserverOutput(
        np.full(count, number), np.full(count, last), np.full((count, *like.watched.shape[1:]), np.nan),
        np.full(count, np.nan), scores, like.starts, [],
    )  # fmt: skip


def _output_of_log(design: ObserverDesign, run: LogRun, log: FloatArray, first: int) -> _ObserverOutput:
    """Return what a design says of rows ``(n, 1 + nu + ny)`` of one log, of which the first one has this number."""
    nothing = np.full(len(watched_names(design)), np.nan)
    residuals = [i for i, name in enumerate(run.observer.columns) if name.startswith("r[")]
    records, refused = list[tuple[int, float, FloatArray, float, Scores]](), list[FloatArray]()
    walk, taken = parameter_walk(design.observer), 0
    faults = len(design.observer.fault_names)
    before, nothing_of_faults = before_any(faults), np.full(faults, np.nan)
    silent = Scores(np.zeros(faults), np.zeros((faults, faults)), nothing_of_faults, nothing_of_faults)
    settling = settling_rows(design)
    gate = run.observer if isinstance(run.observer, SteppingLogObserver) and run.observer.gates else None
    # Others than those with a covariance at the start cannot be told how far off a start may be.
    stated = getattr(design.observer, "initial_state", ()) if hasattr(design.observer, "initial_covariance") else ()
    initial = np.asarray(stated, dtype=np.float64)
    starts = np.zeros(len(initial))
    for count, last in enumerate(_rows(run, log, CHUNK_ROWS if gate is None else 1)):
        if gate is not None:
            refused.append(gate.state.refused)
        # Rows that are missing are among those that a monitor takes.
        for row in () if last.status in STALE else (*last.missed, last):
            watched = watched_values(row.values[residuals], row.evidence)
            taken += 1
            if row.status not in DECIDING or taken <= settling:
                watched = None
            if row.status in DECIDING and starts.size:
                starts = np.fmax(starts, np.abs(row.values[: len(starts)] - initial))
            square, score = np.nan, silent
            if walk is not None and isinstance(row.evidence, Evidence):
                before, score = sample_score(before, row.evidence, walk, row.skipped + 1)
            if watched is not None and isinstance(row.evidence, Evidence) and np.isfinite(watched).all():
                own = row.evidence.whitened
                square = float(np.mean(own**2)) if own.size else np.nan
            # Longer gaps than the statistics look back are all the same.
            missing = min(row.skipped, max(AGES))
            records += [(first + count, row.time, nothing, np.nan, silent)] * missing
            records.append((first + count, row.time, nothing if watched is None else watched, square, score))
        if len(last.missed) > max(AGES):
            del records[-1 - len(last.missed) : -1 - max(AGES)]
    numbers, times, rows, squares, scores = zip(*records, strict=True) if records else ((),) * 5
    columns = [np.array([getattr(score_of_row, part.name) for score_of_row in scores]) for part in fields(Scores)]
    return _ObserverOutput(
        np.array(numbers),
        np.array(times),
        np.array(rows),
        np.array(squares),
        None if walk is None or not scores else Scores(*columns),
        starts,
        refused,
    )
