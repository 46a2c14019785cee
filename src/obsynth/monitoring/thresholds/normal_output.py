"""Runs of a design's observer over logs without faults, from which thresholds are learned.

They give estimates and residuals.  The logs also show the sizes of outliers of each sensor, how far from the stated
initial state a log may begin, and pairs of consecutive wrong samples; the observer is then run with these.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.logs.clock import STALE
from obsynth.monitoring.logs.log_observer import DECIDING, Row
from obsynth.monitoring.logs.log_run import LogRun
from obsynth.monitoring.logs.sources import CHUNK_ROWS
from obsynth.monitoring.logs.step_observer import SteppingLogObserver
from obsynth.monitoring.thresholds.alarm_rates import rows_per_alarm
from obsynth.monitoring.thresholds.learned import NO_PAIRS, WrongPairs
from obsynth.monitoring.thresholds.learned_statistics import AGES
from obsynth.monitoring.thresholds.monitor import Evidence
from obsynth.monitoring.thresholds.normal_logs import NormalLogs
from obsynth.monitoring.thresholds.parameter_scores import Scores, before_any, parameter_walk, sample_score
from obsynth.monitoring.thresholds.watched_columns import (
    has_innovations_by_sensor,
    settling_rows,
    watched_names,
    watched_values,
)
from obsynth.monitoring.thresholds.wrong_pairs import LEAST_WRONG, NEARER, Pair, believed_pairs, taken_back, without
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.changed_options import changed
from obsynth.observers.outliers import checked_limit
from obsynth.results.design import ObserverDesign

#: Pairs may cause this share of the false alarms.  If they would cause more, they are not removed, so that the levels
#: include them.
MOST_OF_RATE = 0.5

#: If so many pairs would occur by chance with less than this probability, consecutive wrong samples have another cause.
CHANCE = 0.01


@dataclass(frozen=True, eq=False)
class NormalRuns:
    """A design with the options of its runs over logs without faults."""

    design: ObserverDesign
    columns: Mapping[str, str] | None
    scales: Mapping[str, float] | None
    gap: float | None
    warm_up: float | None
    outlier_sizes: FloatArray | None = None  # ``(ny,)``: sizes of outliers, if the logs contradict the design
    initial_covariance: FloatArray | None = None  # ``(nx, nx)``: of the states, if logs begin too far off

    def begun(self) -> LogRun:
        """Return a run before its first row."""
        stated = {"outlier_sizes": self.outlier_sizes, "initial_covariance": self.initial_covariance}
        changes = {name: value for name, value in stated.items() if value is not None}
        design = self.design
        own = design if not changes else design.replace(observer=changed(design.observer, **changes))
        return LogRun(own, self.columns, self.scales, gap=self.gap, warm_up=self.warm_up)


class NormalOutput(NamedTuple):
    """The options of runs over logs without faults, as far as these logs determine them, and the output of the runs."""

    runs: NormalRuns
    output: ObserverOutput
    pairs: WrongPairs
    dt: float  # seconds between samples
    every: float  # mean number of rows between false alarms


def output_of_normal_logs(
    runs: NormalRuns, logs: NormalLogs, false_alarms: str | float, chosen: Sequence[tuple[int, int]]
) -> NormalOutput:
    """Return the output of an observer for ``chosen`` rows of logs without faults.

    Sizes of outliers, the initial covariance and pairs of wrong samples are those of these logs.
    """
    design = runs.design
    output, runs = _with_outlier_sizes(runs, logs)
    starts = started_anywhere(design.observer, output.starts)
    if starts is not None:
        runs = replace(runs, initial_covariance=starts)
        output = output_of_logs(runs, logs.rows, logs.ends)
    every = rows_per_alarm(false_alarms, _sample_time(design, output))
    output, pairs = _without_pairs(runs, logs, output, every)
    output = output.of_rows(chosen)
    dt = _sample_time(design, output)
    return NormalOutput(runs, output, pairs, dt, rows_per_alarm(false_alarms, dt))


class ObserverOutput(NamedTuple):
    """The output of an observer in each row of logs, from which thresholds are learned."""

    numbers: NDArray[np.int64]  # ``(n,)``: numbers of the rows, from 0
    times: FloatArray  # ``(n,)`` seconds
    watched: FloatArray  # ``(n, m)``: NaN in rows that are missing or not decided
    squares: FloatArray  # ``(n,)``: mean squares of innovations in units of their deviations, NaN without these
    scores: Scores | None  # scores of the faults; `None` if the observer has none
    starts: FloatArray  # ``(nx,)``: largest distances of the estimated states from the initial state
    refused: list[FloatArray]  # ``(4, ny)`` each: state of the outlier gate after each row; empty without a gate

    def of_rows(self, ranges: Sequence[tuple[int, int]]) -> ObserverOutput:
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
        """Return the root mean square of the innovations in units of their deviations, 1 if there are none."""
        squares = self.squares[np.isfinite(self.squares) & (self.squares > 0.0)]
        return float(np.sqrt(squares.mean())) if squares.size else 1.0


def _with_outlier_sizes(runs: NormalRuns, logs: NormalLogs) -> tuple[ObserverOutput, NormalRuns]:
    """Return the output for rows without faults, and the runs with the sizes of outliers in these rows."""
    log, ends, run = logs.rows, logs.ends, runs.begun()
    if not (isinstance(run.observer, SteppingLogObserver) and run.observer.gates
            and has_innovations_by_sensor(runs.design.observer)):  # fmt: skip
        return output_of_logs(runs, log, ends), runs
    ny = len(run.observer.output_names)
    stated = run.observer.observer.outlier_sizes
    output = output_of_logs(replace(runs, outlier_sizes=np.zeros(ny)), log, ends)
    usual = checked_limit("gate", run.observer.observer.outlier_limit) * np.sqrt(
        np.nanmean(output.watched[:, -ny:] ** 2, axis=0)
    )
    inputs = np.asarray(np.isfinite(log[:, 1:-ny]).all(axis=1))
    sizes = learned_sizes(wrong_samples(output.refused, inputs), usual, np.zeros(ny) if stated is None else stated)
    own = replace(runs, outlier_sizes=sizes)
    if not sizes.any():
        return output, runs if stated is None else own
    output = output_of_logs(own, log, ends)
    return output, runs if stated is not None and np.array_equal(sizes, stated) else own


def wrong_samples(refused: Sequence[FloatArray], known: NDArray[np.bool_]) -> list[FloatArray]:
    """Return the sizes of the residuals of outliers, for each output.

    Outliers are samples that the gate rejected and did not accept later.

    Parameters
    ----------
    refused : sequence of FloatArray
        State of the gate after each row ``(4, ny)``.
    known : array of bool
        ``(n,)``: whether the inputs of the row were measured.
    """
    memory = np.array(refused)
    distances = []
    for row, total, residual, believed in np.moveaxis(memory, 2, 0).transpose(0, 2, 1):
        gone, count = np.diff(total, prepend=0.0) > 0.0, np.abs(row)
        # A sequence of rejected samples ends with the first sample that is accepted.
        run = np.cumsum((count == 0.0) | ((count == 1.0) & (np.concatenate([[0.0], count[:-1]]) != 1.0)))
        moved = np.isin(run, run[believed != 0.0])
        distances.append(np.abs(residual[gone & ~moved & known & (residual != 0.0)]))
    return distances


def learned_sizes(wrong: Sequence[FloatArray], usual: FloatArray, stated: FloatArray) -> FloatArray:
    """Return the least size of outliers of each output ``(ny,)``.

    The logarithms of the sizes are assumed to be normal, so that the distance of a further one from their mean, in
    units of their deviation, follows Student's t distribution; a further one is below the least size with the
    probability `NEARER`.  A size below ``usual`` does not distinguish an outlier from other samples; it is raised to
    ``usual``.  A stated size is never raised.  If there are few outliers, it is kept if all of them are larger, and
    replaced by ``usual`` otherwise.  Without a stated size the result is the geometric mean of ``usual`` and the least
    size: while the observer follows a fault, innovations are larger than in rows without faults, and an outlier may be
    smaller than in these.

    Parameters
    ----------
    wrong : sequence of FloatArray
        Sizes of the outliers of each output.
    usual : FloatArray
        ``(ny,)``: sizes that other samples reach.
    stated : FloatArray
        ``(ny,)``: sizes that the design states; zero: none.
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


def started_anywhere(observer: Any, reached: FloatArray) -> FloatArray | None:
    """Return the covariance ``(nx, nx)`` of the initial states if a run may begin anywhere in the logs.

    ``reached (nx,)`` are the largest distances of the states from the observer's initial state.  The result is `None`
    if the observer's own covariance includes them.
    """
    if not reached.size:
        return None
    stated = np.asarray(observer.initial_covariance)
    missing = np.maximum(reached**2 - np.diag(stated), 0.0)
    return stated + np.diag(missing) if missing.any() else None


def output_of_logs(runs: NormalRuns, log: FloatArray, ends: Sequence[tuple[int, int]]) -> ObserverOutput:
    """Return the output for the rows ``(n, 1 + nu + ny)`` of several logs, which ``ends`` divide.

    Between two logs there are so many unknown rows that no statistic depends on rows of both.
    """
    parts = []
    for first, last in ends:
        part = output_of_log(runs, log[first:last], first)
        parts += [part] if last == ends[-1][1] else [part, _unknown_rows(part, last - 1)]
    if len(parts) == 1:
        return parts[0]
    nonempty = [part for part in parts if len(part.numbers)]
    scores = None
    if all(part.scores is not None for part in nonempty):
        columns = [[getattr(part.scores, field.name) for part in nonempty] for field in fields(Scores)]
        scores = Scores(*(np.concatenate(column) for column in columns))
    return ObserverOutput(
        np.concatenate([part.numbers for part in nonempty]),
        np.concatenate([part.times for part in nonempty]),
        np.concatenate([part.watched for part in nonempty]),
        np.concatenate([part.squares for part in nonempty]),
        scores,
        np.max([part.starts for part in parts], axis=0),
        [row for part in parts for row in part.refused],
    )


def _unknown_rows(like: ObserverOutput, number: int) -> ObserverOutput:
    """Return unknown rows, with the ``number`` of the last row of the log before them."""
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
    return ObserverOutput(
        np.full(count, number), np.full(count, last), np.full((count, *like.watched.shape[1:]), np.nan),
        np.full(count, np.nan), scores, like.starts, [],
    )  # fmt: skip


def output_of_log(runs: NormalRuns, log: FloatArray, first: int) -> ObserverOutput:
    """Return the output for the rows ``(n, 1 + nu + ny)`` of one log, whose first row has the number ``first``."""
    design, run = runs.design, runs.begun()
    nothing = np.full(len(watched_names(design)), np.nan)
    residuals = [i for i, name in enumerate(run.observer.columns) if name.startswith("r[")]
    records, refused = list[tuple[int, float, FloatArray, float, Scores]](), list[FloatArray]()
    walk, taken = parameter_walk(design.observer), 0
    faults = len(design.observer.fault_names)
    before, nothing_of_faults = before_any(faults), np.full(faults, np.nan)
    silent = Scores(np.zeros(faults), np.zeros((faults, faults)), nothing_of_faults, nothing_of_faults)
    settling = settling_rows(design)
    gate = run.observer if isinstance(run.observer, SteppingLogObserver) and run.observer.gates else None
    # Only observers with an initial covariance can take into account how far off a start may be.
    stated = getattr(design.observer, "initial_state", ()) if hasattr(design.observer, "initial_covariance") else ()
    initial = np.asarray(stated, dtype=np.float64)
    starts = np.zeros(len(initial))
    for count, last in enumerate(_rows(run, log, CHUNK_ROWS if gate is None else 1)):
        if gate is not None:
            refused.append(gate.state.refused)
        # A monitor also receives rows for missing samples.
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
            # Gaps that are longer than the memory of the statistics all have the same effect.
            missing = min(row.skipped, max(AGES))
            records += [(first + count, row.time, nothing, np.nan, silent)] * missing
            records.append((first + count, row.time, nothing if watched is None else watched, square, score))
        if len(last.missed) > max(AGES):
            del records[-1 - len(last.missed) : -1 - max(AGES)]
    numbers, times, rows, squares, scores = zip(*records, strict=True) if records else ((),) * 5
    columns = [np.array([getattr(score_of_row, part.name) for score_of_row in scores]) for part in fields(Scores)]
    return ObserverOutput(
        np.array(numbers),
        np.array(times),
        np.array(rows),
        np.array(squares),
        None if walk is None or not scores else Scores(*columns),
        starts,
        refused,
    )


def _rows(run: LogRun, log: FloatArray, together: int) -> Iterator[Row]:
    """Yield the rows of a log, read in parts of ``together`` rows."""
    for begin in range(0, len(log), together):
        yield from run.read(log[begin : begin + together])


def _without_pairs(
    runs: NormalRuns, logs: NormalLogs, observation: ObserverOutput, every: float
) -> tuple[ObserverOutput, WrongPairs]:
    """Return the output for rows without the pairs of wrong samples, and their number and probability."""
    from scipy.special import pdtrc

    if not observation.refused:
        return observation, NO_PAIRS
    log, ends = logs.rows, logs.ends
    before = log.shape[1] - observation.refused[0].shape[1]
    y = log[:, before:]
    pairs = believed_pairs(observation.refused, y)
    if not pairs:
        return observation, NO_PAIRS

    def again(chosen: Sequence[Pair]) -> ObserverOutput:
        return output_of_logs(runs, np.hstack([log[:, :before], without(y, chosen)]), ends)

    hidden = again(pairs)
    wrong = taken_back(pairs, hidden.refused, y)
    measured = np.isfinite(y).sum(axis=0)
    # Both samples of a pair are wrong, although the gate accepted the second one.
    last = np.sum([hidden.refused[end - 1][1] for _, end in ends], axis=0)
    refused = last + 2.0 * np.bincount([output for _, _, output in wrong], minlength=len(measured))
    # The second wrong sample has the same probability as the first, and is on the same side in half of the cases.
    chance = float(0.5 * np.sum((refused / np.maximum(measured, 1)) ** 2))
    # Chance explains this number of pairs if they are about as frequent as independent wrong samples make them, and
    # they must leave at least half of the false alarms to other causes.
    are_chance = chance * every <= MOST_OF_RATE and float(pdtrc(len(wrong) - 1, chance * len(y))) >= CHANCE
    if not wrong or not are_chance:
        return observation, NO_PAIRS
    return hidden if len(wrong) == len(pairs) else again(wrong), WrongPairs(len(wrong), chance)


def _sample_time(design: ObserverDesign, output: ObserverOutput) -> float:
    """Return the sample time: that of the design, or the median of the log for a continuous design."""
    return design.observer.dt or float(np.median(np.diff(output.times)))
