"""From a design to a monitor for data of any length.

Rows without faults: what a design says of them, and the thresholds that are learned from that.

Pairs of wrong samples in rows without faults: a gate believes the second, which the rows after it take back.

A gate leaves the first sample of a fault out and believes the second.  Two wrong samples of one sensor in a row, as far
off on one side, look the same; but once both are left out, the next sample is where it was predicted.  In rows without
faults that decides.  They count as not measured there, and the rate at which single ones come together by chance, at
which each will alarm, is taken off the rate of false alarms.

What in rows without faults is to be looked at before a monitor is learned from them: events that raise the levels,
outputs that are stuck, and residuals that are larger where inputs move.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.data.log_observers import DECIDING, STALE, Row, SteppingLogObserver
from obsynth.data.run import LogRun
from obsynth.data.sources import CHUNK_ROWS, TIME_HEADER, Data, Stamps, chunks, parsed_rows
from obsynth.data.stuck_sensors import stuck_rows, stuck_texts, without_repeats
from obsynth.errors import SpecError
from obsynth.experiments.assumptions import Assumptions
from obsynth.experiments.monitors.adaptive import NO_TOLERANCE, noisy_design, over_box, tolerances_of
from obsynth.experiments.monitors.guaranteed import data_monitor
from obsynth.experiments.monitors.learned import (
    LEAST_NORMAL,
    NO_PAIRS,
    LearnedThresholds,
    Raised,
    WrongPairs,
    divided_at_starts,
    has_innovations_by_sensor,
    learned_monitor,
    load_thresholds,
    raised_levels,
    rows_per_alarm,
    settling_rows,
    thresholds_from_rows,
    watched_names,
    watched_rows,
    watched_values,
)
from obsynth.experiments.monitors.learned_levels import (
    AGES,
    CHANCE_DEVIATIONS,
    Scores,
    before_any,
    normal_scores,
    parameter_walk,
    sample_score,
)
from obsynth.experiments.monitors.monitor import MONITOR_KINDS, Evidence, Monitor, Rule, statement_of
from obsynth.experiments.monitors.options import LINEAR_OPTIONS, PARAMETER_OPTIONS, checked_options
from obsynth.experiments.monitors.residual_model import (
    ResidualModel,
    residual_model,
    samples_of,
    scaled_inputs,
    steady_mean,
    unlimited_bound,
    unlimited_paper,
    watches_estimates,
    whitened,
)
from obsynth.experiments.monitors.residual_monitor import RESIDUAL_ROUNDING_SHARE, bounds_of
from obsynth.experiments.monitors.rules import (
    ANY_LENGTH,
    GapGrowth,
    NormRule,
    WhitenedRule,
    gap_growth,
    parameter_monitor,
)
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.numerics.arguments import FloatArray, Seed, arguments_checked, is_finite_number
from obsynth.numerics.continuous import first_order_hold
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.outliers import checked_limit
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.running import changed
from obsynth.plants.constants import shown
from obsynth.plants.noise_model import require_noise
from obsynth.results.design import ObserverDesign, require_verified
from obsynth.simulation.scenario import Scenario

#: An input moves where it changes by more than so many times what is usual for it: one that is held moves where it
#: changes at all, a sine nowhere.
MOVES = 5.0
#: Rows from a move on whose residuals are compared with those of as many rows without one, the least number of moves,
#: the share of the residuals that counts as large, and how many times as large these must be to be told.
AFTER_A_MOVE, LEAST_MOVES, LARGE_SHARE, LARGER = 3, 20, 0.1, 2.0


def notes_of_normal_rows(
    raised: Raised,
    numbers: NDArray[np.int64],
    times: FloatArray,
    rows: slice,
    stuck: Mapping[str, Sequence[tuple[int, int]]],
    stamps: Stamps,
) -> tuple[str, ...]:
    """Return the notes on ``rows`` of a log with ``times (n,)``, from 0: on events that stand in rows of these
    ``numbers``, and on outputs, by name, that are stuck."""

    def shown(first: int, last: int) -> str:
        begin, end = (stamps.shown(float(times[row])) for row in (first, last))
        return f"row {first} ({begin})" if first == last else f"rows {first} to {last} ({begin} to {end})"

    def found() -> Iterator[str]:
        if raised.events:
            where = ", ".join(
                f"{event.signal} in {shown(int(numbers[event.first]), int(numbers[event.last]))}"
                for event in raised.events
            )
            yield (
                f"What stands out of {where} raises the levels: without these rows, a change {raised.factor:.2g} times "
                f"smaller would pass that of {raised.statistic!r}. Look whether the plant was as usual there; if it "
                "was not, blank its outputs in these rows, or give another log."
            )
        told = {
            name: [(begin, end) for begin, end in runs if end >= rows.start and begin < rows.stop]
            for name, runs in stuck.items()
        }
        yield from stuck_texts(told, shown, ": what it repeats there counts as not measured")

    return tuple(found())


def notes_of_sizes(white: FloatArray, inputs: FloatArray) -> tuple[str, ...]:
    """Return what is to be known where whitened residuals ``(n, m)`` are larger after moves of ``inputs (n, nu)``."""
    count, ratio = _larger_at_moves(np.sum(white**2, axis=1), inputs)
    if ratio < LARGER:
        return ()
    return (
        f"Where inputs move, and in the {AFTER_A_MOVE - 1} rows after, large residuals are {ratio:.2g} times as "
        f"large as elsewhere ({count} moves): errors of the model raise the levels, more than noise does. A "
        "design that follows the plant there has lower levels: with calibrated constants, or a nonlinear observer "
        "in place of that of a linearised plant.",
    )


def notes_of_starts(divided: Mapping[str, float]) -> tuple[str, ...]:
    """Return what is to be known of faults that are ``divided`` from the offset of a sensor anew at each start."""
    return tuple(
        f"The estimate of {name} stays what the start of this log made of it and of the unknown offset of a sensor: it "
        f"varies by {share:.2g} of its standard deviation here. A run with another start may alarm without a fault: go "
        "on from the state of this log (--state), or state the offset."
        for name, share in divided.items()
    )


def _larger_at_moves(sizes: FloatArray, inputs: FloatArray) -> tuple[int, float]:
    """Return how many moves of ``inputs (n, nu)`` there are, and how many times as large residuals of squares ``sizes
    (n,)`` are after these; zero where that may be chance."""
    windows = np.lib.stride_tricks.sliding_window_view(sizes, AFTER_A_MOVE).mean(axis=1)
    changes = np.abs(np.diff(inputs, axis=0, prepend=inputs[:1]))
    moves = np.any(changes > MOVES * np.nanmedian(changes, axis=0), axis=1)
    close = np.convolve(moves, np.ones(2 * AFTER_A_MOVE - 1), mode="same") > 0.0
    known = np.isfinite(windows)
    after, others = windows[known & moves[: len(windows)]], windows[known & ~close[: len(windows)]]
    count = len(after)
    if min(count, len(others)) < LEAST_MOVES:
        return count, 0.0
    lead = float(normal_scores(np.concatenate([after, others]))[:count].mean() * np.sqrt(count))
    large = 1.0 - LARGE_SHARE
    return count, float(np.sqrt(np.quantile(after, large) / np.quantile(others, large))) * (lead > CHANCE_DEVIATIONS)


#: Probability below which so many pairs are no chance: wrong samples, or something else, come in a row here.
CHANCE = 0.01
#: Probability with which an outlier is nearer than what is taken as their least size, and how many show that.
NEARER, LEAST_WRONG = 1e-3, 4
#: Pairs may take this share of the rate of false alarms; where they would take more the levels are to hold with them.
MOST_OF_RATE = 0.5


#: Samples of one output: the first and the last of their rows, and which output.
Pair: TypeAlias = tuple[int, int, int]


def believed_pairs(refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the samples that a gate believed after those before them in a row, which it left out, with these: from its
    memory after each row ``(4, ny)``, and what was measured ``(n, ny)``."""
    found, begun = [], np.full(y.shape[1], -1)
    for k, (memory, seen) in enumerate(zip(refused, np.isfinite(y), strict=True)):
        before = refused[k - 1] if k else np.zeros_like(memory)
        begun[seen & (np.abs(memory[0]) == 1.0)] = k
        believed = seen & (np.abs(memory[0]) >= 2.0) & (memory[3] != 0.0) & (before[3] == 0.0)
        found += [(int(begun[i]), k, int(i)) for i in np.flatnonzero(believed)]
    return found


def without(y: FloatArray, pairs: Sequence[Pair]) -> FloatArray:
    """Return what was measured ``(n, ny)`` without these pairs."""
    left = y.copy()
    for first, last, output in pairs:
        left[first : last + 1, output] = np.nan
    return left


def taken_back(pairs: Sequence[Pair], refused: Sequence[FloatArray], y: FloatArray) -> list[Pair]:
    """Return the pairs after which the next sample is no outlier, by the memory of a gate to which none of them was
    shown."""
    far = np.array([memory[0] != 0.0 for memory in refused])
    found = []
    for first, last, output in pairs:
        later = np.flatnonzero(np.isfinite(y[last + 1 :, output]))
        if later.size and not far[last + 1 + later[0], output]:
            found.append((first, last, output))
    return found


#: One false alarm in so many rows, where nothing else is asked for.
FALSE_ALARM_RATE = "1 per 1000 rows"


@arguments_checked
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
    seed: Seed = 0,
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
        For `obsynth.online_monitor`; ``statement`` says what they mean, and ``holds`` whether the rows suffice;
        ``notes`` name rows to be looked at: events that raise the levels, outputs that are stuck, and whether errors of
        the model where inputs move raise them.

    Raises
    ------
    SpecError
        The log cannot be read, holds too few rows, or nothing moves in it; the rate is none.

    References
    ----------
    Alwan & Roberts (1988), Lowry et al. (1992), Willsky & Jones (1976), Politis & Romano (1994), Gandy & Kvaloy (2013).
    """
    # Both are refused before the log is read.
    watched_names(design)
    rows_per_alarm(false_alarms, 1.0 if design.observer.dt == 0.0 else design.observer.dt)
    if time_column is not None:
        columns = {**(columns or {}), TIME_HEADER: time_column}

    def started(sizes: FloatArray | None = None) -> LogRun:
        known = design if sizes is None else design.replace(observer=changed(design.observer, outlier_sizes=sizes))
        return LogRun(known, columns, scales, gap=gap, warm_up=warm_up)

    first_run, stamps = started(), Stamps()
    log = np.vstack(
        [np.zeros((0, 1 + len(first_run.signals.names))), *chunks(data, first_run.signals, stamps, CHUNK_ROWS)]
    )
    if len(log) < LEAST_NORMAL:
        raise SpecError(f"The log has {len(log)} rows: give {LEAST_NORMAL} and more.", path="normal")
    before = 1 + first_run.signals.inputs
    stuck = [stuck_rows(column) for column in log[:, before:].T]
    log = np.hstack([log[:, :before], without_repeats(log[:, before:], stuck)])
    said, sizes = _sized(design, started, log)
    dt = design.observer.dt or float(np.median(np.diff(said.times)))
    every = rows_per_alarm(false_alarms, dt)
    said, pairs = _without_pairs(design, lambda: started(sizes), log, said, every)
    first, last = parsed_rows(rows, int(said.numbers[-1]) + 1)
    chosen = (first <= said.numbers) & (said.numbers < last)
    dt = design.observer.dt or float(np.median(np.diff(said.times[chosen])))
    watched, scores = said.watched[chosen], None if said.scores is None else said.scores.chosen(chosen)
    squares = said.squares[chosen]
    squares = squares[np.isfinite(squares) & (squares > 0.0)]
    given: dict[str, Any] = {"every": rows_per_alarm(false_alarms, dt), "dt": dt, "seed": seed, "pairs": pairs}
    found = thresholds_from_rows(
        design,
        watched,
        scores=scores,
        innovation=float(np.sqrt(squares.mean())) if squares.size else 1.0,
        outlier_sizes=sizes,
        **given,
    )
    raised = raised_levels(design, found, watched, scores, **given)
    outputs = first_run.signals.names[first_run.signals.inputs :]
    by_name = dict(zip(outputs, stuck, strict=True))
    notes = notes_of_normal_rows(raised, said.numbers[chosen], log[:, 0], slice(first, last), by_name, stamps)
    white = found.statistics.model.whitened(watched_rows(design, found, watched))
    inputs = log[said.numbers[chosen], 1 : 1 + first_run.signals.inputs]
    divided = notes_of_starts(divided_at_starts(design.observer, scores if found.statistics.estimates else None))
    return replace(found, notes=(*notes, *notes_of_sizes(white, inputs), *divided))


def _sized(
    design: ObserverDesign, started: Callable[[FloatArray | None], LogRun], log: FloatArray
) -> tuple[_Said, FloatArray | None]:
    """Return what a design says of rows without faults, and how far off outliers are by these rows ``(ny,)``; `None`
    where that is what the design says."""
    run = started(None)
    if not (isinstance(run.observer, SteppingLogObserver) and run.observer.gates
            and has_innovations_by_sensor(design.observer)):  # fmt: skip
        return _said(design, run, log), None
    ny = len(run.observer.output_names)
    stated = run.observer.observer.outlier_sizes
    whole = _said(design, started(np.zeros(ny)), log)
    usual = checked_limit("gate", run.observer.observer.outlier_limit) * np.sqrt(
        np.nanmean(whole.watched[:, -ny:] ** 2, axis=0)
    )
    inputs = np.asarray(np.isfinite(log[:, 1:-ny]).all(axis=1))
    sizes = learned_sizes(wrong_samples(whole.refused, inputs), usual, np.zeros(ny) if stated is None else stated)
    if not sizes.any():
        return (whole, None) if stated is None else (whole, sizes)
    return _said(design, started(sizes), log), None if stated is not None and np.array_equal(sizes, stated) else sizes


def wrong_samples(refused: Sequence[FloatArray], known: NDArray[np.bool_]) -> list[FloatArray]:
    """Return how far off the samples of each output were that a gate left out, and none of which it believed later, by
    its memory after each row ``(4, ny)``; ``known (n,)``: whether the inputs of the row were."""
    memory = np.array(refused)
    found = []
    for row, total, left, believed in np.moveaxis(memory, 2, 0).transpose(0, 2, 1):
        gone, count = np.diff(total, prepend=0.0) > 0.0, np.abs(row)
        # A run of samples that are far ends where the next one is near.
        run = np.cumsum((count == 0.0) | ((count == 1.0) & (np.concatenate([[0.0], count[:-1]]) != 1.0)))
        moved = np.isin(run, run[believed != 0.0])
        found.append(np.abs(left[gone & ~moved & known & (left != 0.0)]))
    return found


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

    found = stated.copy()
    for i, sizes in enumerate(wrong):
        n = len(sizes)
        if n >= LEAST_WRONG:
            logarithms = np.log(sizes)
            reach = float(stdtrit(n - 1, 1.0 - NEARER)) * np.sqrt(1.0 + 1.0 / n) * float(logarithms.std(ddof=1))
            least = max(float(np.exp(logarithms.mean() - reach)), usual[i])
            found[i] = min(stated[i], least) if stated[i] > 0.0 else np.sqrt(usual[i] * least)
        elif n and sizes.min() < stated[i]:
            found[i] = usual[i]
    return found


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
    found, refused = list[tuple[int, float, FloatArray, float, Scores]](), list[FloatArray]()
    walk, taken = parameter_walk(design.observer), 0
    faults = len(design.observer.fault_names)
    before, nothing_of_faults = before_any(faults), np.full(faults, np.nan)
    silent = Scores(np.zeros(faults), np.zeros((faults, faults)), nothing_of_faults, nothing_of_faults)
    settling = settling_rows(design)
    gate = run.observer if isinstance(run.observer, SteppingLogObserver) and run.observer.gates else None
    for count, last in enumerate(_rows(run, log, CHUNK_ROWS if gate is None else 1)):
        if gate is not None:
            refused.append(gate.state.refused)
        # Rows that are missing are among those that a monitor takes.
        for row in () if last.status in STALE else (*last.missed, last):
            said = watched_values(row.values[residuals], row.evidence)
            taken += 1
            if row.status not in DECIDING or taken <= settling:
                said = None
            square, score = np.nan, silent
            if walk is not None and isinstance(row.evidence, Evidence):
                before, score = sample_score(before, row.evidence, walk, row.skipped + 1)
            if said is not None and isinstance(row.evidence, Evidence) and np.isfinite(said).all():
                own = row.evidence.whitened
                square = float(np.mean(own**2)) if own.size else np.nan
            # Longer gaps than the statistics look back are all the same.
            missing = min(row.skipped, max(AGES))
            found += [(count, row.time, nothing, np.nan, silent)] * missing
            found.append((count, row.time, nothing if said is None else said, square, score))
        if len(last.missed) > max(AGES):
            del found[-1 - len(last.missed) : -1 - max(AGES)]
    numbers, times, rows, squares, scores = zip(*found, strict=True) if found else ((),) * 5
    both = [np.array([getattr(one, part.name) for one in scores]) for part in fields(Scores)]
    return _Said(
        np.array(numbers),
        np.array(times),
        np.array(rows),
        np.array(squares),
        None if walk is None or not scores else Scores(*both),
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
    from scipy.special import pdtrc

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
    refused = hidden.refused[-1][1] + 2.0 * np.bincount([output for _, _, output in wrong], minlength=len(seen))
    # A second comes with the same probability as the first, and in half of the cases on the same side.
    chance = float(0.5 * np.sum((refused / np.maximum(seen, 1)) ** 2))
    # So many pairs are what single wrong samples make at this rate, and leave most of the alarms to others.
    are_chance = chance * every <= MOST_OF_RATE and float(pdtrc(len(wrong) - 1, chance * len(y))) >= CHANCE
    if not wrong or not are_chance:
        return said, NO_PAIRS
    return hidden if len(wrong) == len(pairs) else again(wrong), WrongPairs(len(wrong), chance)


_AFTER_WARM_UP = "; it holds once the initial-condition response has settled (the warm-up)"
_AFTER_A_GAP = " (after a gap likewise)"
_FROM_THE_FIRST = "; from the first row on; after a gap, once settled"
_GROWS = "; after missing outputs it is larger by the possible error of the plant's model"
_WAITS = "; until the effect of a gap has settled nothing is decided, as {reason}"
_NOT_CLOSER = "; rows are no closer than {dt} s"
_JITTERING = "; stamps that jitter by up to a fifth of the interval are taken as regular"
_UNEVEN = "; while rows are not equally far apart there is no bound"
_REGULAR = "; no row is further than {dt} s from the last"


@arguments_checked
def online_monitor(
    design: ObserverDesign,
    kind: str = "pointwise",
    *,
    scenario: Scenario | None = None,
    disturbance_bounds: Mapping[str, float] | None = None,
    noise_bound: float | None = None,
    initial_error: float | None = None,
    gamma: float | None = None,
    window: int | None = None,
    false_alarms: float | None = None,
    change: float | None = None,
    nominal: Mapping[str, float] | None = None,
    sample_time: float | None = None,
    constants: Any = None,
    initial_set: Mapping[str, Any] | None = None,
    normal: Any = None,
    unverified: bool = False,
) -> Monitor:
    """Return a monitor for measured data, for `run_on_data`: its threshold holds however long the data are.

    Parameters
    ----------
    design : ObserverDesign
        Of any method.  Linear ones are monitored by their residual, recursive ones by their parameters and innovations,
        nonlinear ones likewise (to first order, as their covariances).
    kind : {"pointwise", "paper", "window", "chi-square", "cusum", "nis", "learned"}, optional
        The first three for linear designs, as for `obsynth.monitor`; ``nis`` for the others (all that the model does
        not explain), where ``chi-square`` is on the parameters against their nominal values.  ``learned``, for every
        design: from rows without faults, whatever the model assumes of noise.
    scenario : Scenario, optional
        Linear designs: whose disturbances and noise are those to be expected; its length, start, inputs and faults do
        not count.  Without one, the noise is the plant's own, once, and disturbances need bounds.
    disturbance_bounds, noise_bound, gamma
        As for `obsynth.monitor`.
    initial_error : float, optional
        Bound on the norm of the observer's error at the start, and after each gap; without one the bounds hold once its
        effect has settled.
    window : int, optional
        Samples that ``window``, ``chi-square`` and ``cusum`` of linear designs look back; 20 by default.
    false_alarms : float, optional
        For the statistical kinds: probability of a false alarm in a whole run, at most, however long it is; 0.01 by
        default.
    change : float, optional
        For ``cusum``: shift it is tuned for, in standard deviations of the whitened residual (linear designs), or in
        parameter units; 1 by default.
    nominal : mapping, optional
        Nominal value of parameters by name; those at the observer's start by default.
    sample_time : float, optional, seconds
        Continuous designs: between the rows of the data; the scenario's by default.
    constants : mapping, ConstantsBox, Uncertainty or DescriptorSystem, optional
        ``pointwise``, linear designs: tolerances as `obsynth.uncertain_system` takes them; those of the
        design's plant by ``plant.uncertainty``.  The threshold adapts to the signals and holds for every plant within
        them; without, it assumes an exact model (but ``obsynth run`` takes the plant's own).  Continuous designs need
        rows ``sample_time`` apart and known inputs that are held between them.  Columns of `run_on_data` tell
        thresholds, guaranteed intervals of faults, and shares of the constants.
    initial_set : mapping, optional
        ``pointwise``, linear designs: bounds of the plant's states at the first row (deviations), each a
        number or ``[low, high]``; the threshold then holds from the first row on, for the plant's own tolerances where
        no others are given.
    normal : LearnedThresholds, path or pandas.DataFrame, optional
        ``learned``: from `obsynth.learn_thresholds`, the file in which they were saved (``.json``), or a log without
        faults, whose rate is one false alarm per 1,000 rows.
    unverified : bool, optional
        Whether a design whose report fails is watched all the same; nothing is promised then.

    Returns
    -------
    Monitor
        With a sentence that says what its threshold means.

    Raises
    ------
    SpecError
        The kind does not go with the design, an option is out of range or does nothing for this kind, or a signal has
        no bound or covariance.
    PreconditionError
        No bound exists over the tolerances: the message says why.
    VerificationError
        The report of the design fails.
    """
    require_verified(design, unverified=unverified)
    recursive = isinstance(design.observer, (RecursiveObserver, DAEObserver))
    given = {
        "scenario": scenario, "disturbance_bounds": disturbance_bounds, "noise_bound": noise_bound,
        "initial_error": initial_error, "gamma": gamma, "window": window, "false_alarms": false_alarms,
        "change": change, "sample_time": sample_time, "constants": constants, "initial_set": initial_set,
        "normal": normal,
    }  # fmt: skip
    window, false_alarms, change = checked_options(PARAMETER_OPTIONS if recursive else LINEAR_OPTIONS, kind, given)
    if kind == "learned":
        return _learned(design, normal)
    if isinstance(design.observer, (RecursiveObserver, DAEObserver)):
        return parameter_monitor(design.observer, kind, nominal or {}, change, false_alarms)
    _require_linear_kind(kind, nominal)
    if is_guaranteed(design):
        return data_monitor(design, kind, given)
    design, adaptive = tolerances_of(design, constants, initial_set, initial_error)
    estimates = watches_estimates(design) and kind in ("pointwise", "window")
    model, dt = _endless_model(design, scenario, window, sample_time, estimates=estimates)
    require_noise(noise_bound, noisy=model.noisy)
    bounds = bounds_of(design, model, disturbance_bounds)
    if scenario is None:
        # Only those that are given are known.
        stated = [name in (disturbance_bounds or {}) for name in design.linear[0].disturbance_names]
        bounds = np.where(np.array(stated, dtype=bool), bounds, np.inf)
    noisy = noisy_design(design, scenario)
    limited = kind in ("pointwise", "window")

    def made(statement: str, rule: Rule) -> Monitor:
        return Monitor(
            kind,
            statement,
            rule,
            residuals=len(design.linear[1].residual_names),
            fault_names=design.linear[1].fault_names,
            fault_scales=model.fault_scales(),
        )

    rule: Rule
    if limited or kind == "paper":
        start = 0.0 if initial_error is None else float(initial_error)
        norm, limit = _norm_rule(design, kind, model, bounds, noise_bound, start, gamma, window, dt, estimates)
        if adaptive:
            rule, told = over_box(noisy, norm, bounds, noise_bound, initial_error, initial_set, sample_time=dt)
            first = _AFTER_WARM_UP if initial_error is None else _AFTER_A_GAP
            return made(told + (first if initial_set is None else _FROM_THE_FIRST), rule)
        _require_above_rounding(kind, limit, model, bounds)
        gaps = gap_growth(model, bounds, noise_bound) if kind == "pointwise" else ""
        rule = norm.over_gaps(gaps) if isinstance(gaps, GapGrowth) else norm
        ending = (_AFTER_WARM_UP if initial_error is None else _AFTER_A_GAP) + _more_words(kind, model, limit, dt)
        ending += _UNEVEN * bool(norm.irregular is not None and np.isinf(norm.irregular[1]))
        ending += _WAITS.format(reason=gaps) if isinstance(gaps, str) and gaps else _GROWS * bool(gaps)
    else:
        rule = _whitened(kind, model, bounds if scenario is None else None, window, change, false_alarms, dt)
        ending = ANY_LENGTH + (_JITTERING if model.continuous is not None else "")
    numbers = {"window": window, "false_alarms": false_alarms, "change": change, "dt": dt}
    assumed = Assumptions(noisy.linear[0], bounds, noise_bound or 0.0, initial_error=initial_error) if limited else None
    return made(statement_of(kind, model, assumed, estimates=estimates, **numbers) + ending + NO_TOLERANCE, rule)


def _learned(design: ObserverDesign, normal: Any) -> Monitor:
    """Return the monitor of thresholds that were learned, or are to be."""
    if normal is None:
        raise SpecError(
            "learned needs rows without faults: give a log, or what obsynth thresholds wrote (normal, --normal).",
            path="normal",
        )
    if isinstance(normal, (str, Path)) and Path(normal).suffix.lower() == ".json":
        normal = load_thresholds(normal)
    if not isinstance(normal, LearnedThresholds):
        normal = learn_thresholds(design, normal)
    return learned_monitor(design, normal)


def _require_linear_kind(kind: str, nominal: Mapping[str, float] | None) -> None:
    if kind not in MONITOR_KINDS:
        hint = " glr is a decision on parameters, which a linear design has none of: cusum is nearest to it."
        raise SpecError(
            f"The monitor {kind!r} is not for this design: use one of {', '.join(MONITOR_KINDS)}, learned."
            f"{hint if kind == 'glr' else ''}",
            path="kind",
        )
    if nominal:
        raise SpecError("nominal is for recursive designs, which estimate parameters.", path="nominal")


def _require_above_rounding(kind: str, limit: float, model: ResidualModel, bounds: FloatArray) -> None:
    """Refuse a bound that rounding of what it is made of would pass: of disturbances that cancel."""
    plant = model.errors.plant
    # They come by the states, of which a row may show others than those that they enter.
    entering = np.abs(model.errors.own) @ np.abs(plant.Bd) @ np.where(np.isfinite(bounds), bounds, 0.0)
    size = float(np.linalg.norm(model.C, 2) * np.linalg.norm(entering))
    if not limit > RESIDUAL_ROUNDING_SHARE * size:
        raise SpecError(
            "As stated, no disturbance reaches the residual, and (66) bounds nothing else: use pointwise, which bounds "
            "noise too, or give a threshold yourself (thresholds)."
            if kind == "paper"
            else "As stated, no disturbance and no noise reaches the residual: its bound would be zero but for "
            "rounding, which exceeds it. State noise (noise_bound, sensor_noise of the plant), or give a threshold "
            "yourself (thresholds).",
            path="kind" if kind == "paper" else "noise_bound",
        )


def _norm_rule(
    design: ObserverDesign,
    kind: str,
    model: ResidualModel,
    bounds: FloatArray,
    noise_bound: float | None,
    start: float,
    gamma: float | None,
    window: int,
    dt: float,
    estimates: bool,
) -> tuple[NormRule, float]:
    """Return the rule of a bound on the norm of the residual, or of the fault estimates, and the bound in the end."""
    irregular = None
    if kind == "paper":
        table, limit = unlimited_paper(model, bounds, start, gamma)
    else:
        names = design.linear[0].disturbance_names
        table, limit = unlimited_bound(kind, model, scaled_inputs(model, bounds, noise_bound, names), start, window)
        if model.continuous is not None:
            inputs = scaled_inputs(model, bounds, noise_bound, names, any_stamps=True)
            irregular = unlimited_bound(kind, model, inputs, start, window)
    driven = None
    if kind != "paper" and model.continuous is not None and design.linear[0].nu:
        driven = model.continuous.between.input_response(model.continuous.observer)
    rule = NormRule(
        table,
        limit,
        window=window if kind == "window" else 1,
        dt=dt,
        irregular=irregular,
        watched=design.linear[1].fault_rows if estimates else None,
        driven=driven,
    )
    return rule, limit


def _more_words(kind: str, model: ResidualModel, limit: float, dt: float) -> str:
    """Return what else the sentence of a bound must say."""
    if kind == "paper" or model.continuous is None:
        return ""
    # The noise of the plant itself is what is gathered between samples: the closer they are, the less, but in all the
    # more of it that is of one sign.
    is_gathered = bool(model.Bw[:, model.continuous.sensors.sum() :].any())
    return (
        _NOT_CLOSER.format(dt=shown(dt)) * is_gathered
        + _REGULAR.format(dt=shown(dt))
        + model.continuous.between.lasting_words(limit)
    )


def _endless_model(
    design: ObserverDesign, scenario: Scenario | None, window: int, sample_time: float | None, *, estimates: bool
) -> tuple[ResidualModel, float]:
    """Return a model with as many samples as an error at the start needs to decay, and their distance."""
    plant, observer = design.linear
    if plant.is_discrete and sample_time is not None:
        raise SpecError("sample_time is for continuous designs: this one is sampled already.", path="sample_time")
    asked = sample_time if sample_time is not None or scenario is None else scenario.sample_time
    dt = plant.dt if plant.is_discrete else asked
    if dt is None or not (is_finite_number(dt) and dt > 0.0):
        raise SpecError(
            "A continuous design needs the sample_time of its data, in seconds, for a threshold.", path="sample_time"
        )
    transition = observer.Az if plant.is_discrete else first_order_hold(observer.Az, observer.By, dt)[0]
    steps = samples_of(transition, window)
    expected = Scenario(horizon=dt, noise=1.0 if plant.nw else 0.0) if scenario is None else scenario
    expected = expected.replace(
        horizon=(steps - 0.5) * dt,
        sample_time=None if plant.is_discrete else dt,
        inputs={},
        faults={},
        sensors={},
        initial_state={},
        observer_state=None,
        stabilise=False,
    )
    return residual_model(design, expected, endless=True, estimates=estimates), dt


def _whitened(
    kind: str,
    model: ResidualModel,
    unknown: FloatArray | None,
    window: int,
    change: float,
    false_alarms: float,
    dt: float,
) -> WhitenedRule:
    reached = model.Bd.any(axis=0) | model.Dd.any(axis=0)
    if unknown is not None and reached.any():
        raise SpecError(
            f"{kind} needs to know what disturbances are to be expected: give a scenario (a spec with one, --system), "
            "or use pointwise with disturbance bounds.",
            path="disturbances",
        )
    whitener, white = whitened(kind, model, window)
    return WhitenedRule(
        whitener,
        steady_mean(model),
        window=window,
        change=None if kind == "chi-square" else change,
        false_alarms=false_alarms,
        dt=dt,
        white=white,
    )
