"""Thresholds from rows without faults: the choice of columns, their autoregression, and the levels of alarms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.methods.registry import error_model, follows_later_rows
from obsynth.monitoring.thresholds.cross_validation import (
    HealthyTime,
    healthy_time,
    held_out,
    levels_of_other_parts,
    not_held_out,
    room_for_other_logs,
)
from obsynth.monitoring.thresholds.learned import NO_PAIRS, LearnedThresholds, WrongPairs
from obsynth.monitoring.thresholds.learned_events import Event, events_of, factors
from obsynth.monitoring.thresholds.learned_levels import (
    RARER_WHERE_SIZES_LAST,
    conformal_levels,
    is_conformal,
    lasting_sizes,
    learned_levels,
    offset_size,
    rows_needed,
)
from obsynth.monitoring.thresholds.learned_statistics import Statistics
from obsynth.monitoring.thresholds.parameter_scores import Scores
from obsynth.monitoring.thresholds.sensor_drifts import SensorDrifts, with_room_for_drifts
from obsynth.monitoring.thresholds.watched_columns import settling_rows, watched_names
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.autoregression import Autoregression, fitted_autoregression
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.plants.noise import offset_state
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import gain_set_digest

#: Events are reported if they raise a level so much that a change must be so many times larger to exceed it.  In 600
#: logs without events and with normal innovations, white or coloured, the factor was 1.3 at most; it reached this
#: number in one of seven logs whose innovations follow Student's t distribution with 4 degrees of freedom.
REPORTED_LEVEL_FACTOR = 2.0

#: Least share of the variance of a column that the columns before it leave unexplained: a residual that follows from
#: the estimates is not watched beside them.
LEAST_NEW = 1e-6

#: A direction is that of a single column if its largest component is at least this share of its length.
OWN_DIRECTION = 0.99

#: Least number of rows without faults from which thresholds are learned.
LEAST_NORMAL = 100

#: An estimate that varies within a log by less than this share of its stated deviation is mostly determined at the
#: start of the log.
ONE_START_SHARE = 0.5


def thresholds_from_rows(
    design: ObserverDesign,
    rows: FloatArray,
    *,
    every: float,
    dt: float,
    seed: int = 0,
    pairs: WrongPairs = NO_PAIRS,
    innovation: float = 1.0,
    scores: Scores | None = None,
    outlier_sizes: FloatArray | None = None,
    like: LearnedThresholds | None = None,
    logs: Sequence[slice] = (),
    initial_covariance: FloatArray | None = None,
    repeats: FloatArray | None = None,
    validated: bool = True,
    drifts: SensorDrifts | None = None,
    sensor_drift: float = 0.0,
    missing: str = "",
) -> LearnedThresholds:
    """Return thresholds that are learned from rows without faults.

    The residuals alone are watched where the fault estimates have a longer memory than the rows can show, or nearly
    follow from the residuals.  A fault that the estimates follow leaves no trace in the residuals.  With ``scores``,
    changes of the faults are therefore tested beside the residuals, and so are the estimates in units of their
    deviations, which follow from the scores.

    Parameters
    ----------
    design : ObserverDesign
        The design whose estimates and residuals are watched.
    rows : FloatArray
        ``(n, m)``: all columns that may be watched; NaN where a value is missing.
    every : float
        Mean number of rows between false alarms.
    dt : float, seconds
        Time between rows.
    seed : int, optional
        Seed of simulated levels.
    pairs : WrongPairs, optional
        Pairs of wrong samples that are missing in ``rows`` but cause alarms.
    innovation : float, optional
        Size of the innovations, relative to the deviations that the observer states.
    scores : Scores, optional
        Information of each row on the faults, where it is known.
    outlier_sizes : FloatArray, optional
        Sizes of outliers, in place of those of the design.
    like : LearnedThresholds, optional
        Thresholds whose columns and directions are taken.
    logs : sequence of slice, optional
        Rows of each log.
    initial_covariance : FloatArray, optional
        Covariance of the states at any start of the observer.
    repeats : FloatArray, optional
        Number of equal samples after which an output counts as not measured.
    validated : bool, optional
        Whether levels come from rows that were held out of the fit.
    drifts : SensorDrifts, optional
        Effects of the sensor drifts that must not cause alarms.
    sensor_drift : float, optional
        Size of these drifts, in deviations.
    missing : str, optional
        Sentence on what a log with too few rows lacks.
    """
    names, faults = watched_names(design), len(design.observer.fault_names)
    seldom = seldom_known(rows, faults) if like is None else [names.index(name) for name in like.seldom]
    usual = [i for i in range(len(names)) if i not in seldom]
    complete = np.asarray(np.isfinite(rows[:, usual]).all(axis=1))
    every_other = pairs.others(every)
    count = _checked_count(complete, missing)
    conformal = is_conformal(count, every_other)
    scores = None if scores is None else _usual_scores(scores, complete)
    choices = _column_choices(rows[complete], names, usual, faults, like, with_scores=scores is not None)
    chosen, model = _fitted_columns(choices, rows, complete)
    x = np.where(complete[:, None], rows[:, chosen], np.nan)
    centres, scales = rows[complete, :faults].mean(axis=0), rows[complete, :faults].std(axis=0)
    if scores is not None:
        centres = scores.chosen(slice(len(rows) // 2 if conformal else None)).centre()
    directions = _directions(design, chosen, x, like)
    statistics = Statistics(model, *directions, estimates=() if scores is None else names[:faults])
    lasting, extrapolated = 0.0, False
    if conformal:
        statistics, levels = conformal_levels(x, every_other, statistics, scores, logs)
    else:
        lasting = lasting_sizes(model.whitened(x)) if like is None else like.lasting
        rarer = RARER_WHERE_SIZES_LAST if lasting else 1.0
        statistics, levels, extrapolated = learned_levels(x, every_other * rarer, statistics, seed, scores, logs)
    if drifts is not None:
        size = offset_size(statistics, x, logs)
        statistics, levels = with_room_for_drifts(statistics, levels, drifts, chosen, size)
    levels, time = _validated_levels(levels, x, statistics, scores, logs, every_other, validated=validated)
    return LearnedThresholds(
        tuple(names[i] for i in chosen),
        statistics,
        read_only(levels),
        every,
        count,
        rows_needed(statistics.model, every, scores),
        dt,
        read_only(centres),
        read_only(np.where(scales > 0.0, scales, 1.0)),
        gain_set_digest(design),
        extrapolated,
        tuple(name for i, name in enumerate(names) if i not in chosen and name not in statistics.estimates),
        settling_rows(design),
        pairs,
        innovation,
        outlier_sizes,
        lasting,
        seldom=tuple(names[i] for i in seldom),
        initial_covariance=None if initial_covariance is None else read_only(initial_covariance),
        logs=max(len(logs), 1),
        healthy_time=time,
        repeats=None if repeats is None else read_only(repeats),
        sensor_drift=0.0 if drifts is None else sensor_drift,
    )


def _directions(
    design: ObserverDesign, chosen: list[int], x: FloatArray, like: LearnedThresholds | None
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the directions of faults in the ``chosen`` columns x ``(n, k)``, or those of ``like``, and their names."""
    if like is not None:
        return like.statistics.signatures, like.statistics.signature_names
    return signatures(design, chosen, np.sqrt(np.nanvar(x, axis=0)))


def _validated_levels(
    levels: FloatArray,
    x: FloatArray,
    statistics: Statistics,
    scores: Scores | None,
    logs: Sequence[slice],
    every: float,
    *,
    validated: bool,
) -> tuple[FloatArray, HealthyTime]:
    """Return levels with one false alarm per ``every`` rows in held-out parts and other logs, and the share of healthy
    time in alarm."""
    held, room = held_out(x, statistics, scores, logs), room_for_other_logs(statistics, logs)
    time = healthy_time(levels, held, every, room)
    parts = held if validated else not_held_out(x, statistics, scores)
    return room * levels_of_other_parts(levels, parts, every), time


def _checked_count(complete: NDArray[np.bool_], missing: str) -> int:
    """Return the number of complete rows; raise `SpecError`, with the sentence ``missing``, if there are too few."""
    count = int(complete.sum())
    if count < LEAST_NORMAL:
        raise SpecError(
            f"Only {count} rows of the log can be used, as warm-up, gaps and what a stuck sensor repeats do not count: "
            f"give {LEAST_NORMAL} and more.{missing}",
            path="normal",
        )
    return count


def _column_choices(
    rows: FloatArray,
    names: Sequence[str],
    usual: list[int],
    faults: int,
    like: LearnedThresholds | None,
    *,
    with_scores: bool,
) -> list[list[int]]:
    """Return the sets of columns that may be watched, the preferred one first.

    With ``like``, its columns are the only set.  Otherwise the sets are the independent estimates and residuals, and
    the residuals alone; if there are scores of the faults, only the residuals.
    """
    if like is not None:
        choices = [[names.index(name) for name in like.columns]]
    else:
        candidates = [usual[i] for i in independent(rows[:, usual])]
        residuals = [usual[i] for i in varying(rows[:, usual], faults)]
        choices = [part for part in ((residuals or candidates,) if with_scores else (candidates, residuals)) if part]
    if not choices:
        raise SpecError("No monitored signal changes in these rows: there is no noise to learn from.", path="normal")
    return choices


def _fitted_columns(
    choices: list[list[int]], rows: FloatArray, complete: NDArray[np.bool_]
) -> tuple[list[int], Autoregression]:
    """Return the first set of columns whose autoregression needs no more rows than are complete, with that model; if
    there is none, the set that needs the fewest."""
    fits = [
        (columns, fitted_autoregression(np.where(complete[:, None], rows[:, columns], np.nan))) for columns in choices
    ]
    count = int(complete.sum())
    enough = [fit for fit in fits if rows_needed(fit[1], 1.0) <= count and (fit is fits[-1] or fit[1].is_regular)]
    return enough[0] if enough else min(fits, key=lambda fit: rows_needed(fit[1], 1.0))


class LeftOut(NamedTuple):
    """An estimate of a fault that is not watched, although it varies."""

    name: str
    largest: float  # largest absolute value in the rows without faults
    is_redundant: bool  # whether it is a linear combination of other columns
    needed: int  # number of rows with which it would be watched; 0 where this number is unknown


def left_out_estimates(design: ObserverDesign, learned: LearnedThresholds, rows: FloatArray) -> list[LeftOut]:
    """Return the estimates that thresholds which were ``learned`` from ``rows (n, m)`` do not watch."""
    names, faults = watched_names(design), len(design.observer.fault_names)
    complete = complete_rows(design, learned, rows)
    values = rows[complete]
    left_out = [i for i in varying(values, 0) if i < faults and names[i] in learned.left_out]
    if not left_out:
        return []
    usual = [i for i, name in enumerate(names) if name not in learned.seldom]
    together = [usual[i] for i in independent(values[:, usual])]
    model = fitted_autoregression(np.where(complete[:, None], rows[:, together], np.nan))
    needed = rows_needed(model, 1.0) if model.is_regular else 0
    return [
        LeftOut(names[i], float(np.abs(values[:, i]).max()), i not in together, needed if needed > len(values) else 0)
        for i in left_out
    ]


def seldom_known(rows: FloatArray, faults: int) -> list[int]:
    """Return the residuals that most rows lack, as those of sensors that are slower than the rows.

    Without these residuals at least half of the rows ``(n, m)`` are complete.  The first ``faults`` columns are
    estimates, which are kept, and so is at least one residual.
    """
    present = np.isfinite(rows)
    present = present[present.any(axis=1)]
    columns = list(range(rows.shape[1]))
    while len(columns) > faults + 1 and 2 * present[:, columns].all(axis=1).sum() < len(present):
        columns.remove(min(columns[faults:], key=lambda i: int(present[:, i].sum())))
    return [i for i in range(rows.shape[1]) if i not in columns]


def divided_at_starts(observer: Any, scores: Scores | None) -> dict[str, float]:
    """Return the faults whose estimates hardly change after the start of a log, with their variation.

    The variation is in units of the deviation that the observer states.  Where offsets of sensors are states, the start
    of a log divides its first residuals between a fault and these offsets, and later rows hardly change that.
    """
    if scores is None or not isinstance(observer, DAEObserver):
        return {}
    if not any(offset_state(name) in observer.plant.state_names for name in observer.plant.output_names):
        return {}
    shares = np.nanstd(scores.theta / scores.deviations, axis=0)
    by_name = zip(observer.fault_names, shares.tolist(), strict=True)
    return {name: share for name, share in by_name if share < ONE_START_SHARE}


class Raised(NamedTuple):
    """Events that raise levels, the statistic whose level they raise most, and the factor by which a change must be
    larger to exceed that level."""

    events: tuple[Event, ...] = ()
    statistic: str = ""
    factor: float = 1.0


def raised_levels(
    design: ObserverDesign, learned: LearnedThresholds, rows: FloatArray, scores: Scores | None, **options: Any
) -> Raised:
    """Return the events in ``rows (n, m)`` that raise the ``learned`` levels; none if the levels rise by little.

    ``options`` are those of `thresholds_from_rows` with which the levels were learned.
    """
    complete = complete_rows(design, learned, rows)
    usual = _usual_scores(scores, complete) if learned.statistics.estimates and scores is not None else None
    x = watched_rows(design, learned, rows)
    events = events_of(x, learned.columns, learned.statistics, learned.levels, usual, learned.centres)
    without_events = rows.copy()
    for event in events:
        without_events[event.begun : event.ended + 1] = np.nan
    count = int(complete_rows(design, learned, without_events).sum())
    every_other = learned.pairs.others(learned.every)
    if (
        not events
        or count < LEAST_NORMAL
        or is_conformal(count, every_other) != is_conformal(learned.rows, every_other)
    ):
        return Raised()

    def compared(before: LearnedThresholds, *, validated: bool) -> tuple[float, str]:
        relearned = thresholds_from_rows(
            design, without_events, scores=scores, like=learned, validated=validated, **options
        )
        if relearned.statistics.names != before.statistics.names:
            return 1.0, ""
        by_statistic = factors(before.statistics, before.levels, relearned.statistics, relearned.levels)
        most = max(by_statistic, key=lambda name: by_statistic[name])
        return by_statistic[most], most

    # Levels from held-out parts depend on a few maxima: whether events stand out is decided without these parts.
    inside = thresholds_from_rows(design, rows, scores=scores, like=learned, validated=False, **options)
    if compared(inside, validated=False)[0] < REPORTED_LEVEL_FACTOR:
        return Raised()
    factor, most = compared(learned, validated=True)
    return Raised(events, most, factor) if factor >= REPORTED_LEVEL_FACTOR else Raised()


def watched_rows(design: ObserverDesign, learned: LearnedThresholds, rows: FloatArray) -> FloatArray:
    """Return the watched columns of ``rows (n, m)``, NaN in rows that are not complete."""
    places = [watched_names(design).index(name) for name in learned.columns]
    return np.where(complete_rows(design, learned, rows)[:, None], rows[:, places], np.nan)


def complete_rows(design: ObserverDesign, learned: LearnedThresholds, rows: FloatArray) -> NDArray[np.bool_]:
    """Return which of ``rows (n, m)`` are complete ``(n,)``: no value is missing but those that most rows lack."""
    usual = [name not in learned.seldom for name in watched_names(design)]
    return np.asarray(np.isfinite(rows[:, usual]).all(axis=1))


def _usual_scores(scores: Scores, complete: NDArray[np.bool_]) -> Scores | None:
    """Return the scores of complete rows, with zeros for the others; `None` if they do not determine the faults."""
    usual = replace(
        scores,
        score=np.where(complete[:, None], scores.score, 0.0),
        information=np.where(complete[:, None, None], scores.information, 0.0),
        theta=np.where(complete[:, None], scores.theta, np.nan),
    )
    return usual if usual.chosen(slice(len(complete) // 2)).determine and usual.determine else None


def signatures(design: ObserverDesign, places: Sequence[int], sizes: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the directions ``(s, m)`` in which steps of the watched columns are tested, and the name of each.

    They are the single columns, whose deviations are ``sizes (m,)``, and for a linear design the steady effects of
    constant faults, if these are not single columns themselves.
    """
    names = [watched_names(design)[i] for i in places]
    directions = list(np.diag(sizes))
    linear = isinstance(design.observer, LinearObserver) and not follows_later_rows(design)
    if not linear or expects_fault_profiles(design):
        return np.array(directions), tuple(names)
    errors = error_model(design)
    observer, plant = errors.observer, errors.plant
    c, direct, *_ = errors.output(slice(len(observer.state_names), None))
    held = (np.eye(observer.order) if observer.dt > 0.0 else np.zeros_like(observer.Az)) - observer.Az
    try:
        gains = (direct - c @ np.linalg.solve(held, errors.fault))[places]
    except np.linalg.LinAlgError:
        return np.array(directions), tuple(names)
    for name, gain in zip(plant.fault_names, gains.T, strict=True):
        scaled = gain / sizes
        size = float(np.linalg.norm(scaled))
        if np.isfinite(size) and size > 0.0 and float(np.abs(scaled).max()) < OWN_DIRECTION * size:
            directions.append(gain / size)
            names.append(f"fault {name}")
    return np.array(directions), tuple(names)


def expects_fault_profiles(design: ObserverDesign) -> bool:
    """Whether a linear observer expects faults of a certain profile, such as a step.

    Once its estimates have converged, such a fault no longer changes the residuals.
    """
    linear = isinstance(design.observer, LinearObserver) and not follows_later_rows(design)
    return linear and error_model(design).Phi is not None


def varying(rows: FloatArray, first: int) -> list[int]:
    """Return the columns of ``(n, m)`` from the ``first`` one on that are not constant."""
    return [i for i in range(first, rows.shape[1]) if float(np.ptp(rows[:, i])) > 0.0]


def independent(rows: FloatArray) -> list[int]:
    """Return the columns of ``(n, m)`` that are not linear combinations of those before them and a constant."""
    independent_columns: list[int] = []
    basis = np.zeros((len(rows), 0))
    for i, column in enumerate(rows.T):
        residual = column - column.mean()
        power = float(residual @ residual)
        # Orthogonalised twice, since rounding errors of large components remain after once.
        for _ in range(2):
            residual = residual - basis @ (basis.T @ residual)
        if power > 0.0 and float(residual @ residual) > LEAST_NEW * power:
            independent_columns.append(i)
            basis = np.column_stack([basis, residual / np.linalg.norm(residual)])
    return independent_columns
