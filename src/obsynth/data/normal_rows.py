"""Rows without faults: what a design says of them, and the thresholds that are learned from that.

Pairs of wrong samples in rows without faults: a gate believes the second, which the rows after it take back.

A gate leaves the first sample of a fault out and believes the second.  Two wrong samples of one sensor in a row, as far
off on one side, look the same; but once both are left out, the next sample is where it was predicted.  In rows without
faults that decides.  They count as not measured there, and the rate at which single ones come together by chance, at
which each will alarm, is taken off the rate of false alarms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.data.log_estimator import DECIDING, STALE, Row
from obsynth.data.log_run import LogRun
from obsynth.data.signals import TIME_HEADER, Stamps
from obsynth.data.sources import CHUNK_ROWS, Data, chunks, parsed_rows
from obsynth.data.step_log import SteppingLogObserver
from obsynth.errors import SpecError
from obsynth.experiments.monitors.learned import (
    LEAST_NORMAL,
    NO_PAIRS,
    LearnedThresholds,
    WrongPairs,
    rows_per_alarm,
    settling_rows,
    thresholds_from_rows,
    watched_names,
    watched_values,
)
from obsynth.experiments.monitors.learned_levels import AGES
from obsynth.experiments.monitors.monitor import Evidence
from obsynth.experiments.monitors.parameter_scores import Scores, before_any, parameter_walk, sample_score
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray
from obsynth.results.design import ObserverDesign

#: Probability below which so many pairs are no chance: wrong samples, or something else, come in a row here.
CHANCE = 0.01
#: Pairs may take this share of the rate of false alarms; where they would take more the levels are to hold with them.
MOST_OF_RATE = 0.5


class Pair(NamedTuple):
    """Two samples of one output: rows, and which output."""

    first: int
    second: int
    output: int


def believed_pairs(refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the samples that a gate believed as the second in a row, with the first, which it left out: from its
    memory after each row ``(4, ny)``, and what was measured ``(n, ny)``."""
    found, latest = [], np.full(y.shape[1], -1)
    for k, (memory, seen) in enumerate(zip(refused, np.isfinite(y), strict=True)):
        before = refused[k - 1] if k else np.zeros_like(memory)
        believed = seen & (np.abs(memory[0]) == 2.0) & (memory[1] == before[1]) & (latest >= 0)
        found += [Pair(int(latest[i]), k, int(i)) for i in np.flatnonzero(believed)]
        latest[seen] = k
    return found


def without(y: FloatArray, pairs: Sequence[Pair]) -> FloatArray:
    """Return what was measured ``(n, ny)`` without these pairs."""
    left = y.copy()
    for pair in pairs:
        left[[pair.first, pair.second], pair.output] = np.nan
    return left


def taken_back(pairs: Sequence[Pair], refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the pairs after which the next sample is no outlier, by the memory of a gate to which none of them was
    shown."""
    far = np.array([memory[0] != 0.0 for memory in refused])
    found = []
    for pair in pairs:
        later = np.flatnonzero(np.isfinite(y[pair.second + 1 :, pair.output]))
        if later.size and not far[pair.second + 1 + later[0], pair.output]:
            found.append(pair)
    return found


def chance_of_pairs(refused: FloatArray, seen: NDArray[np.int64]) -> float:
    """Return how many pairs there are in a row by chance, where so many samples were left out ``(ny,)`` of so many that
    were measured: a second comes with the same probability as the first, and in half of the cases on the same side."""
    shares = refused / np.maximum(seen, 1)
    return float(0.5 * np.sum(shares**2))


def are_chance(pairs: int, rate: float, rows: int, every: float) -> bool:
    """Whether so many pairs in rows are what single wrong samples make at this rate, and leave most of one alarm per
    ``every`` rows to others."""
    from scipy.special import pdtrc

    return rate * every <= MOST_OF_RATE and float(pdtrc(pairs - 1, rate * rows)) >= CHANCE


#: One false alarm in so many rows, where nothing else is asked for.
FALSE_ALARM_RATE = "1 per 1000 rows"


def learn_thresholds(
    design: ObserverDesign,
    data: Data,
    *,
    false_alarms: str | float = FALSE_ALARM_RATE,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    time_column: str | None = None,
    scales: Mapping[str, float] | None = None,
    gap: float | None = None,
    warm_up: float | None = None,
    seed: int = 0,
) -> LearnedThresholds:
    """Learn the thresholds of a design from rows of its plant without faults.

    Offsets, covariance and colour of the fault estimates and residuals are taken from the rows, whatever the design
    assumes of them: they are whitened by a fitted autoregression and watched by Hotelling's T2, exponentially weighted
    means and likelihood ratios of steps; where faults are parameters that walk, by likelihood ratios of a change of
    each fault, too.  Levels come from a bootstrap of all that is estimated, so that a short log gives higher ones.

    Parameters
    ----------
    design : ObserverDesign
        Of any method.
    data : path, text stream or pandas.DataFrame
        As for `obsynth.run_on_data`: a log without faults.
    false_alarms : str or float, optional
        Rate of false alarms, such as ``"1 per week"`` or ``"2 per 1000 rows"``, or a number of them per row.  Alarms
        closer than 20 rows are one.
    rows : str, slice or pair of int, optional
        Rows of the log that are free of faults, as Python counts; all by default.  The observer runs over all before.
    columns, time_column, scales, gap, warm_up
        As for `obsynth.run_on_data`.
    seed : int, optional
        Of the bootstrap.

    Returns
    -------
    LearnedThresholds
        For `obsynth.online_monitor`; ``statement`` says what they mean, and ``holds`` whether the rows suffice.

    Raises
    ------
    SpecError
        The log cannot be read, holds too few rows, or nothing moves in it; the rate is none.

    References
    ----------
    Alwan & Roberts (1988), Lowry et al. (1992), Willsky & Jones (1976), Politis & Romano (1994), Gandy & Kvaloy (2013).
    """
    require_kind(design, ObserverDesign, "design", "an ObserverDesign, such as obsynth.load(path)")
    # Both are refused before the log is read.
    watched_names(design)
    rows_per_alarm(false_alarms, 1.0 if design.observer.dt == 0.0 else design.observer.dt)
    if time_column is not None:
        columns = {**(columns or {}), TIME_HEADER: time_column}

    def started() -> LogRun:
        return LogRun(design, columns, scales, gap=gap, warm_up=warm_up)

    first_run = started()
    log = np.vstack(
        [np.zeros((0, 1 + len(first_run.signals.names))), *chunks(data, first_run.signals, Stamps(), CHUNK_ROWS)]
    )
    if len(log) < LEAST_NORMAL:
        raise SpecError(f"The log has {len(log)} rows: give {LEAST_NORMAL} and more.", path="normal")
    said = _said(design, first_run, log)
    dt = design.observer.dt or float(np.median(np.diff(said.times)))
    every = rows_per_alarm(false_alarms, dt)
    said, pairs = _without_pairs(design, started, log, said, every)
    first, last = parsed_rows(rows, int(said.numbers[-1]) + 1)
    chosen = (first <= said.numbers) & (said.numbers < last)
    dt = design.observer.dt or float(np.median(np.diff(said.times[chosen])))
    return thresholds_from_rows(
        design,
        said.watched[chosen],
        every=rows_per_alarm(false_alarms, dt),
        dt=dt,
        seed=seed,
        pairs=pairs,
        innovation=_usual_innovation(said.squares[chosen]),
        scores=None if said.scores is None else said.scores.chosen(chosen),
    )


def _usual_innovation(squares: FloatArray) -> float:
    """Return the root mean square of innovations in the observer's own deviations, from mean squares of rows."""
    known = squares[np.isfinite(squares) & (squares > 0.0)]
    return float(np.sqrt(known.mean())) if known.size else 1.0


class _Said(NamedTuple):
    """What a design says of a log."""

    numbers: NDArray[np.int64]  # ``(n,)``: of rows, from 0
    times: FloatArray  # ``(n,)`` seconds
    watched: FloatArray  # ``(n, m)``: NaN where nothing is decided, or rows are missing
    squares: FloatArray  # ``(n,)``: mean squares of innovations in the observer's own deviations, where it has these
    scores: Scores | None  # of the faults, where it is known what samples say of these
    refused: list[FloatArray]  # ``(4, ny)`` each: what a gate remembers after each row; empty without a gate


def _said(design: ObserverDesign, run: LogRun, log: FloatArray) -> _Said:
    """Return what a design says of rows ``(n, 1 + nu + ny)``."""
    nothing = np.full(len(watched_names(design)), np.nan)
    residuals = [i for i, name in enumerate(run.observer.columns) if name.startswith("r[")]
    numbers, times, rows, refused = list[int](), list[float](), list[FloatArray](), list[FloatArray]()
    squares, scores, walk = list[float](), list[Scores](), parameter_walk(design.observer)
    faults = len(design.observer.fault_names)
    before, silent = before_any(faults), Scores(np.zeros(faults), np.zeros((faults, faults)))
    settling = settling_rows(design)
    gate = run.observer if isinstance(run.observer, SteppingLogObserver) and run.observer.gates else None
    for count, row in enumerate(_rows(run, log, CHUNK_ROWS if gate is None else 1)):
        if gate is not None:
            refused.append(gate.state.refused)
        if row.status in STALE:
            continue
        said = watched_values(row.values[residuals], row.evidence)
        if row.status not in DECIDING or count < settling:
            said = None
        # Longer gaps than the statistics look back are all the same.
        missing = min(row.skipped, max(AGES))
        rows += [nothing] * missing + [nothing if said is None else said]
        square, score = np.nan, silent
        if walk is not None and isinstance(row.evidence, Evidence):
            before, score = sample_score(before, row.evidence, walk, row.skipped + 1)
        if said is not None and isinstance(row.evidence, Evidence) and np.isfinite(said).all():
            own = row.evidence.whitened
            square = float(np.mean(own**2)) if own.size else np.nan
        squares += [np.nan] * missing + [square]
        scores += [silent] * missing + [score]
        times += [row.time] * (missing + 1)
        numbers += [count] * (missing + 1)
    both = [np.array(part) for part in zip(*((one.score, one.information) for one in scores), strict=True)]
    return _Said(
        np.array(numbers),
        np.array(times),
        np.array(rows),
        np.array(squares),
        None if walk is None or not both else Scores(*both),
        refused,
    )


def _rows(run: LogRun, log: FloatArray, together: int) -> Iterator[Row]:
    """Yield the rows of a log, so many taken together."""
    for begin in range(0, len(log), together):
        yield from run.read(log[begin : begin + together])


def _without_pairs(
    design: ObserverDesign, started: Callable[[], LogRun], log: FloatArray, said: _Said, every: float
) -> tuple[_Said, WrongPairs]:
    """Return what a design says of rows without pairs of wrong samples, and what there was of these."""
    if not said.refused:
        return said, NO_PAIRS
    before = log.shape[1] - said.refused[0].shape[1]
    y = log[:, before:]
    pairs = believed_pairs(said.refused, y)
    if not pairs:
        return said, NO_PAIRS

    def again(chosen: Sequence[Pair]) -> _Said:
        return _said(design, started(), np.hstack([log[:, :before], without(y, chosen)]))

    hidden = again(pairs)
    wrong = taken_back(pairs, hidden.refused, y)
    seen = np.isfinite(y).sum(axis=0)
    # All of a pair are wrong samples: those that were believed too.
    chance = chance_of_pairs(
        hidden.refused[-1][1] + 2.0 * np.bincount([p.output for p in wrong], minlength=len(seen)), seen
    )
    if not wrong or not are_chance(len(wrong), chance, len(y), every):
        return said, NO_PAIRS
    return hidden if len(wrong) == len(pairs) else again(wrong), WrongPairs(len(wrong), chance)
