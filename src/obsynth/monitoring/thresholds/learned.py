"""Monitors whose thresholds were learned from rows without faults: what is kept of them, and how they run."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.files.inputs import path_of
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.methods.registry import error_model
from obsynth.monitoring.thresholds.cross_validation import (
    HealthyTime,
    healthy_time,
    held_out,
    levels_of_other_parts,
    not_held_out,
    room_for_other_logs,
)
from obsynth.monitoring.thresholds.learned_events import Event, events_of, factors
from obsynth.monitoring.thresholds.learned_levels import (
    AGES,
    FORGETTING,
    HOLD,
    RARER_WHERE_SIZES_LAST,
    SETTLING,
    SIZE_LAGS,
    Statistics,
    conformal_levels,
    is_conformal,
    lasting_sizes,
    learned_levels,
    rows_needed,
)
from obsynth.monitoring.thresholds.monitor import Evidence, LinearSample, Monitor, Rule, RuleOutput, Sample
from obsynth.monitoring.thresholds.parameter_scores import (
    Scores,
    before_any,
    beyond,
    most_likely_change,
    parameter_walk,
    sample_score,
)
from obsynth.numerics.arguments import arguments_checked, is_finite_number
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.autoregression import Autoregression, fitted_autoregression
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.running import changed
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.observers.window.observer import WindowObserver
from obsynth.plants.noise import offset_state
from obsynth.results.certificate_files import opened, sealed
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import digest_of, gain_set_digest, plain, restored

#: Changes have to be so many times as large to be noticed: without events it was 1.3 at most in 600 logs with normal
#: innovations, white or coloured, and this much in one of seven logs whose innovations follow Student's t with 4.
TOLD_LEVEL_FACTOR = 2.0


#: Nothing is known of the share of healthy time in alarm.
NO_HEALTHY_TIME = HealthyTime(0.0, 0.0, 1.0)

LEARNED_KIND = "obsynth learned thresholds"

LEARNED_VERSION = 1

LEARNED = FileKind(
    "learned thresholds of obsynth", rb'\A\s*\{\s*"kind":\s*"obsynth learned thresholds"', suffix=".json"
)

#: Least share of the variance of a column that the others leave unexplained, where estimates and residuals are watched
#: together: residuals that follow from the estimates say nothing more.
LEAST_NEW = 1e-6

#: A direction whose largest part is this share of its length is that of one column.
OWN_DIRECTION = 0.99

#: Share of healthy time in alarm above which thresholds do not hold.
MOST_HEALTHY_TIME = 0.05

#: Rows without faults below which nothing is learned.
LEAST_NORMAL = 100

#: Estimates that vary by less than this share of their deviation in a log have most of it from its start.
ONE_START_SHARE = 0.5

#: Seconds of the units of time in which a rate is told.
UNITS = {
    "second": 1.0,
    "minute": 60.0,
    "hour": 3600.0,
    "day": 86400.0,
    "week": 604800.0,
    "month": 2629800.0,
    "year": 31557600.0,
}

_WRITTEN_RATE = re.compile(r"\s*([0-9.eE+-]+)\s*(?:per|/)\s*([0-9.eE+]*)\s*([a-z]+?)s?\s*")


NOTHING = read_only(np.zeros(0))


def rows_per_alarm(rate: str | float, dt: float) -> float:
    """Return how many rows, ``dt`` seconds apart, there are for each false alarm of a rate such as ``1 per week``,
    ``2 per 1000 rows``, or a number of alarms per row."""
    found: float | None = None
    if is_finite_number(rate):
        found = 1.0 / float(rate) if float(rate) > 0.0 else None
    elif isinstance(rate, str) and (match := _WRITTEN_RATE.fullmatch(rate.lower())) is not None:
        unit = 1.0 if match.group(3) in ("row", "sample") else UNITS.get(match.group(3), 0.0) / dt
        try:
            alarms, count = float(match.group(1)), float(match.group(2) or 1.0)
        except ValueError:
            alarms, count = 0.0, 0.0
        found = count * unit / alarms if alarms > 0.0 and math.isfinite(alarms) and count * unit > 0.0 else None
    if found is None or not math.isfinite(found):
        raise SpecError(
            f"false_alarms is {rate!r}: give a rate, such as '1 per week' or '1 per 1000 rows'.", path="false_alarms"
        )
    if found < 2 * HOLD:
        raise SpecError(
            f"false_alarms is {rate!r}, one per {found:.3g} rows, but an alarm lasts {HOLD} rows at least: "
            "ask for a lower rate.",
            path="false_alarms",
        )
    return found


class WrongPairs(NamedTuple):
    """Pairs of wrong samples in a row that count as not measured, as each of them would be an alarm."""

    number: int
    chance: float  # how many there are in a row, by chance

    def others(self, every: float) -> float:
        """Return how many rows there are for each alarm that is none of a pair, of one alarm per ``every`` rows."""
        return 1.0 / (1.0 / every - self.chance)


NO_PAIRS = WrongPairs(0, 0.0)


@dataclass(frozen=True, eq=False)
class LearnedThresholds:
    """Thresholds learned from rows without faults; made by `obsynth.learn_thresholds`.

    Parameters
    ----------
    columns : tuple of str
        Columns of a run that are watched.
    statistics : Statistics
        Autoregression of these columns, and the directions in which steps are looked for.
    levels : FloatArray
        ``(k,)``: level of each statistic.
    every : float
        Rows per false alarm that were asked for.
    rows, needed : int
        Rows that were learned from, and those that the rate needs.
    dt : float, seconds
        Between these rows.
    centres, scales : FloatArray
        ``(nf,)``: means and deviations of the fault estimates there.
    gains : str
        sha256 of the gain set.
    extrapolated : bool
        Whether the rate is rarer than what the bootstrap shows.
    left_out : tuple of str
        Columns that are not watched: nothing changes in them, or they are estimates that remember too much.
    seldom : tuple of str
        Those of them that most rows lack, as of sensors slower than the rows: a row is whole without them.
    settling : int
        Rows at the start of a run in which nothing is decided, as nothing was learned from such rows.
    pairs : WrongPairs
        Pairs of wrong samples in a row that count as not measured.
    innovation : float
        Root mean square of the innovations in the observer's own deviations: one where its covariances are right.
    outlier_sizes : FloatArray, optional
        ``(ny,)``: how far off the outliers of each output are at least, by these rows, in place of what the design
        says; without them, what it says agrees with these rows.
    lasting : float
        Mean autocorrelation of the size of the residuals, where it follows itself so that large ones come together and
        levels are those of a lower rate; otherwise zero.
    initial_covariance : FloatArray, optional
        ``(nx, nx)``: of the states at a start that is wherever the plant was in these rows, in place of the design's.
    repeats : FloatArray, optional
        ``(ny,)``: from which equal sample in a row on each output counts as not measured, as its sensor may be stuck;
        infinite where these rows do not show that. Without it, never.
    logs : int
        How many logs these rows are from.
    healthy_time : HealthyTime
        The share of healthy rows in alarm, with its interval, on rows that were not learned from.
    notes : tuple of str
        What in these rows is to be looked at: events that raise the levels, outputs that are stuck, errors of the model
        where inputs move.
    """

    columns: tuple[str, ...]
    statistics: Statistics
    levels: FloatArray
    every: float
    rows: int
    needed: int
    dt: float
    centres: FloatArray
    scales: FloatArray
    gains: str
    extrapolated: bool = False
    left_out: tuple[str, ...] = ()
    settling: int = 0
    pairs: WrongPairs = NO_PAIRS
    innovation: float = 1.0
    outlier_sizes: FloatArray | None = None
    lasting: float = 0.0
    notes: tuple[str, ...] = ()
    seldom: tuple[str, ...] = ()
    initial_covariance: FloatArray | None = None
    logs: int = 1
    healthy_time: HealthyTime = NO_HEALTHY_TIME
    repeats: FloatArray | None = None

    @property
    def holds(self) -> bool:
        """Whether there were rows enough for the rate that was asked for, and rows that were not learned from are in
        alarm for `MOST_HEALTHY_TIME` at most."""
        return self.rows >= self.needed and self.healthy_time.expected <= MOST_HEALTHY_TIME

    @property
    def statement(self) -> str:
        """What the thresholds mean, and whether the rows suffice for it."""
        model, lasting = self.statistics.model, self.every * self.dt
        text = (
            f"learned from {self.rows} rows without faults: at most one false alarm per {self.every:.6g} rows "
            f"({_duration(lasting)}) on average, in {_counted(len(self.columns), 'column')}"
            + (
                f", and in changes of {_counted(len(self.statistics.estimates), 'fault')}"
                if self.statistics.estimates
                else ""
            )
            + f"; alarms less than {HOLD} rows apart count as one"
            + (
                "; the level was found from the second half of these rows"
                if is_conformal(self.rows, self.pairs.others(self.every))
                else ""
            )
        )
        time = self.healthy_time
        text += (
            f"; healthy rows that were not learned from are in alarm for {100 * time.expected:.2g} % of the time (95 % "
            f"interval {100 * time.low:.2g} to {100 * time.high:.2g} %, "
            + (f"between {self.logs} logs)" if self.logs > 1 else "between parts of one log)")
        )
        if self.lasting:
            text += (
                f"; the size of the residuals follows itself (mean autocorrelation over {SIZE_LAGS} rows "
                f"{self.lasting:.2g}), so that large ones come together: the levels are those of a rate "
                f"{RARER_WHERE_SIZES_LAST:g} times as low, and single logs may alarm more often than stated"
            )
        if self.pairs.number:
            text += (
                f"; {_counted(self.pairs.number, 'pair')} of wrong samples in a row, which count as not measured: one "
                f"alarms when it comes, which is once per {1.0 / self.pairs.chance:.3g} rows by chance, and is among "
                "the false alarms"
            )
        if self.holds:
            return text
        if self.rows >= self.needed:
            return (
                f"{text}. That is more than {100 * MOST_HEALTHY_TIME:g} %: parts of these rows are unlike the others. "
                "Give several normal logs, of other starts and set points"
            )
        rarest = min(self.rows, self.every)
        other = (
            f"the lowest rate that {self.rows} rows can determine is one per {rarest:.6g} rows "
            f"({_duration(rarest * self.dt)})"
        )
        if rows_needed(model, 1.0) > self.rows:
            other = "the residuals are too strongly correlated, or too many, for any rate from these rows"
        elif self.needed > rows_needed(model, self.every):
            other = "the estimates are too strongly correlated for any rate from these rows"
        return (
            f"{text}. Too few rows for this rate ({self.rows}; about {self.needed:,} needed, "
            f"{_duration(self.needed * self.dt)}): {other}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as data."""
        model = self.statistics.model
        return {
            "gains": self.gains,
            "columns": list(self.columns),
            "left_out": list(self.left_out),
            "seldom": list(self.seldom),
            "offset": model.offset,
            "A": model.A,
            "whitener": model.whitener,
            "signatures": self.statistics.signatures,
            "age_levels": self.statistics.levels_by_age,
            "told": list(self.statistics.told),
            "levels": self.levels,
            "every": self.every,
            "rows": self.rows,
            "needed": self.needed,
            "dt": self.dt,
            "centres": self.centres,
            "scales": self.scales,
            "extrapolated": self.extrapolated,
            "settling": self.settling,
            "pairs": {"number": self.pairs.number, "chance": self.pairs.chance},
            "innovation": self.innovation,
            "estimates": list(self.statistics.estimates),
            "outlier_sizes": self.outlier_sizes,
            "lasting": self.lasting,
            "notes": list(self.notes),
            "bands": self.statistics.bands,
            "fault_bands": self.statistics.fault_bands,
            "initial_covariance": self.initial_covariance,
            "logs": self.logs,
            "healthy_time": list(self.healthy_time),
            "repeats": self.repeats,
        }

    def save(self, path: str | Path) -> Path:
        """Write the thresholds as one JSON document, atomically.

        Parameters
        ----------
        path : str or Path
            Where to write.

        Raises
        ------
        SpecError
            The file cannot be written.
        """
        return write_atomically(path, sealed(LEARNED_KIND, LEARNED_VERSION, plain(self.as_dict()), under="thresholds"))


def _duration(seconds: float) -> str:
    """Return seconds in the largest unit of which there is one."""
    name, size = next(((n, s) for n, s in reversed(UNITS.items()) if seconds >= s), ("second", 1.0))
    count = seconds / size
    return f"{count:.3g} {name}{'' if count == 1.0 else 's'}"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


@arguments_checked
def load_thresholds(path: str | Path) -> LearnedThresholds:
    """Read learned thresholds.

    Parameters
    ----------
    path : str or Path
        File that ``LearnedThresholds.save``, or ``obsynth thresholds``, wrote.

    Returns
    -------
    LearnedThresholds
        As they were saved.

    Raises
    ------
    SpecError
        The file is none of these, or was changed.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
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
    >>> with TemporaryDirectory() as folder:
    ...     _ = obsynth.learn_thresholds(design, normal, false_alarms="1 per 100 rows").save(f"{folder}/t.json")
    ...     print(obsynth.load_thresholds(f"{folder}/t.json").columns)
    ('fhat[f1]',)
    """
    file = path_of(path)
    again = "learn the thresholds again (obsynth thresholds)"
    _, body, intact = opened(
        file, (LEARNED_KIND,), LEARNED_VERSION, "file of learned thresholds", again, under="thresholds"
    )
    if not intact:
        raise SpecError(f"{file} was changed after it was written: its digest does not match.", path=str(file))
    try:
        return _from_dict(restored(body))
    except SpecError:
        raise
    except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError, RecursionError) as error:
        raise SpecError(f"{file} is damaged, its parts do not fit together: {again}.", path=str(file)) from error


def _from_dict(data: Mapping[str, Any]) -> LearnedThresholds:
    columns, m = tuple(map(str, data["columns"])), len(data["columns"])
    parts = ("offset", "A", "whitener", "signatures", "age_levels", "levels")
    offset, a, whitener, signatures, by_age, levels = (np.asarray(data[name], dtype=np.float64) for name in parts)
    told, estimates = (tuple(map(str, data[name])) for name in ("told", "estimates"))
    optional = ("bands", "fault_bands", "initial_covariance")
    arrays = {
        name: None if data[name] is None else read_only(np.asarray(data[name], dtype=np.float64)) for name in optional
    }
    bands, of_faults = arrays["bands"], arrays["fault_bands"]
    statistics = Statistics(Autoregression(offset, a, whitener), signatures, told, estimates, by_age, bands, of_faults)
    shapes = (offset.shape, a.shape[1:], whitener.shape, signatures.shape[1:], levels.shape)
    fits = shapes == ((m,), (m, m), (m, m), (m,), (len(statistics.names),)) and len(told) == len(signatures)
    fits &= by_age.shape == (2 * len(told), len(AGES)) and bool((by_age > 0.0).all() and (levels > 0.0).all())
    fits &= bands is None or (bands.shape == (len(told),) and bool((bands >= 0.0).all()))
    fits &= of_faults is None or (of_faults.shape == (len(estimates),) and bool((of_faults >= 0.0).all()))
    if not (fits and all(np.isfinite(part).all() for part in (offset, a, whitener, signatures, by_age))):
        raise ValueError("its parts do not fit together")
    for part in (offset, a, whitener, signatures, by_age):
        part.setflags(write=False)
    return LearnedThresholds(
        columns,
        statistics,
        read_only(levels),
        float(data["every"]),
        int(data["rows"]),
        int(data["needed"]),
        float(data["dt"]),
        read_only(np.asarray(data["centres"])),
        read_only(np.asarray(data["scales"])),
        str(data["gains"]),
        bool(data["extrapolated"]),
        tuple(map(str, data["left_out"])),
        int(data["settling"]),
        WrongPairs(int(data["pairs"]["number"]), float(data["pairs"]["chance"])),
        float(data["innovation"]),
        None if data["outlier_sizes"] is None else read_only(np.asarray(data["outlier_sizes"], dtype=np.float64)),
        float(data["lasting"]),
        tuple(map(str, data["notes"])),
        tuple(map(str, data["seldom"])),
        arrays["initial_covariance"],
        int(data["logs"]),
        HealthyTime(*map(float, data["healthy_time"])),
        None if data.get("repeats") is None else read_only(np.asarray(data["repeats"], dtype=np.float64)),
    )


def as_learned(observer: Any, learned: LearnedThresholds) -> Any:
    """Return an observer as the one from which thresholds were learned judged outliers."""
    given = {"outlier_sizes": learned.outlier_sizes, "initial_covariance": learned.initial_covariance}
    known = {name: value for name, value in given.items() if value is not None}
    return changed(observer, **known) if known else observer


def watched_names(design: ObserverDesign) -> tuple[str, ...]:
    """Return what may be watched of a design: fault estimates, then residuals (or innovations)."""
    observer = design.observer
    if isinstance(observer, WindowObserver):
        raise SpecError(
            f"Design {design.name!r} is a test whose weights change with k: the threshold of each row is proved, so "
            "none is learned (use the monitor pointwise).",
            path="design",
        )
    if isinstance(observer, (LinearObserver, RegionObserver, ScheduledObserver)):
        names = observer.row_names
        return (*names[observer.fault_rows], *names[observer.residual_rows])
    return (*(f"fhat[{name}]" for name in observer.fault_names), *(f"r[{name}]" for name in innovation_names(observer)))


def settling_rows(design: ObserverDesign) -> int:
    """Return how many rows at a start are not like those that follow: linear designs have a warm-up for these."""
    return 0 if isinstance(design.observer, (LinearObserver, RegionObserver, ScheduledObserver)) else SETTLING


def has_innovations_by_sensor(observer: Any) -> bool:
    """Whether each residual is the innovation of one sensor, which says the same where another one is missing."""
    return not isinstance(
        observer, (LinearObserver, RecursiveObserver, RegionObserver, ScheduledObserver, WindowObserver)
    )


def innovation_names(observer: Any) -> tuple[str, ...]:
    """Return the names of the innovations of a recursive or nonlinear observer, as columns of runs have them."""
    if isinstance(observer, RecursiveObserver):
        # H_k has as many directions beside the state as there are parity innovations.
        return tuple(f"innovation {i + 1}" for i in range(observer.innovation_count))
    names: tuple[str, ...] = observer.plant.output_names
    return names


def watched_values(residuals: FloatArray, evidence: Any) -> FloatArray | None:
    """Return fault estimates and residuals of a row, in the order of `watched_names`; `None` where there are none."""
    if isinstance(evidence, Evidence):
        return np.concatenate([evidence.theta, residuals])
    return evidence.faults_and_residuals if isinstance(evidence, LinearSample) else None


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
) -> LearnedThresholds:
    """Return thresholds from ``rows (n, m)`` of all that may be watched, NaN where nothing is known; ``pairs``: what
    does not stand in them, but alarms; ``innovation``: how large innovations are in the observer's own deviations;
    ``scores``: what these rows say of faults, where that is known; ``outlier_sizes``: what the design is to say
    instead; ``like``: thresholds of which columns and directions are taken; ``logs``: which rows are of one log each;
    ``initial_covariance``: that of the states at a start anywhere; ``repeats``: from which equal sample on outputs
    count as not measured; ``validated``: whether the levels are those that
    rows keep which are not learned from.

    Where the fault estimates remember more than the rows can tell, or nearly follow from the residuals (the gains of a
    filter move them, and what is left is how these change with the inputs), the residuals alone are watched.  A fault
    that the estimates follow leaves nothing in these: where it is known what each sample says of the faults, changes of
    these are looked for beside them, and the estimates in units of their deviations, which follow from the same.
    """
    names, faults = watched_names(design), len(design.observer.fault_names)
    seldom = seldom_known(rows, faults) if like is None else [names.index(name) for name in like.seldom]
    usual = [i for i in range(len(names)) if i not in seldom]
    known = np.asarray(np.isfinite(rows[:, usual]).all(axis=1))
    others = pairs.others(every)
    count = int(known.sum())
    if count < LEAST_NORMAL:
        raise SpecError(
            f"Only {count} rows of the log can be used, as warm-up, gaps and what a stuck sensor repeats do not count: "
            f"give {LEAST_NORMAL} and more.",
            path="normal",
        )
    conformal = is_conformal(count, others)
    scores = None if scores is None else _usual_scores(scores, known)
    if like is None:
        both = [usual[i] for i in independent(rows[known][:, usual])]
        residuals = [usual[i] for i in varying(rows[known][:, usual], faults)]
        choices = [part for part in ((both, residuals) if scores is None else (residuals or both,)) if part]
    else:
        choices = [[names.index(name) for name in like.columns]]
    if not choices:
        raise SpecError("No monitored signal changes in these rows: there is no noise to learn from.", path="normal")
    fits = [(kept, fitted_autoregression(np.where(known[:, None], rows[:, kept], np.nan))) for kept in choices]
    enough = [fit for fit in fits if rows_needed(fit[1], 1.0) <= count and (fit is fits[-1] or fit[1].is_regular)]
    kept, model = enough[0] if enough else min(fits, key=lambda fit: rows_needed(fit[1], 1.0))
    x = np.where(known[:, None], rows[:, kept], np.nan)
    told = tuple(names[i] for i in kept)
    centres, scales = rows[known, :faults].mean(axis=0), rows[known, :faults].std(axis=0)
    if scores is not None:
        centres = scores.chosen(slice(len(rows) // 2 if conformal else None)).centre()
    found = (
        signatures(design, kept, np.sqrt(np.nanvar(x, axis=0)))
        if like is None
        else (like.statistics.signatures, like.statistics.told)
    )
    statistics = Statistics(model, *found, estimates=() if scores is None else names[:faults])
    lasting, extrapolated = 0.0, False
    if conformal:
        statistics, levels = conformal_levels(x, others, statistics, scores, logs)
    else:
        lasting = lasting_sizes(model.whitened(x)) if like is None else like.lasting
        rarer = RARER_WHERE_SIZES_LAST if lasting else 1.0
        statistics, levels, extrapolated = learned_levels(x, others * rarer, statistics, seed, scores, logs)
    left, room = held_out(x, statistics, scores, logs), room_for_other_logs(statistics, logs)
    time = healthy_time(levels, left, others, room)
    judged = left if validated else not_held_out(x, statistics, scores)
    levels = room * levels_of_other_parts(levels, judged, others)
    return LearnedThresholds(
        told,
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
        tuple(name for i, name in enumerate(names) if i not in kept and name not in statistics.estimates),
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
    )


def seldom_known(rows: FloatArray, faults: int) -> list[int]:
    """Return the residuals of rows ``(n, m)``, after so many estimates of ``faults``, without which at least half of
    the rows are whole: those of sensors that are slower than the rows.  One residual is left."""
    there = np.isfinite(rows)
    there = there[there.any(axis=1)]
    left = list(range(rows.shape[1]))
    while len(left) > faults + 1 and 2 * there[:, left].all(axis=1).sum() < len(there):
        left.remove(min(left[faults:], key=lambda i: int(there[:, i].sum())))
    return [i for i in range(rows.shape[1]) if i not in left]


def divided_at_starts(observer: Any, scores: Scores | None) -> dict[str, float]:
    """Return the faults between which and the offset of a sensor each start divides what it sees, and how much of the
    deviation that the observer states their estimates vary by in one log: little, as they stay what a start made."""
    if scores is None or not isinstance(observer, DAEObserver):
        return {}
    if not any(offset_state(name) in observer.plant.state_names for name in observer.plant.output_names):
        return {}
    shares = np.nanstd(scores.theta / scores.deviations, axis=0)
    found = zip(observer.fault_names, shares.tolist(), strict=True)
    return {name: share for name, share in found if share < ONE_START_SHARE}


class Raised(NamedTuple):
    """Events that raise levels, and how many times as large a change must be to pass that of a statistic: the one for
    which this is most."""

    events: tuple[Event, ...] = ()
    statistic: str = ""
    factor: float = 1.0


def raised_levels(
    design: ObserverDesign, found: LearnedThresholds, rows: FloatArray, scores: Scores | None, **given: Any
) -> Raised:
    """Return what in ``rows (n, m)`` raises the levels that were ``found`` with what was ``given`` to
    `thresholds_from_rows`: no events where none do by much."""
    known = whole_rows(design, found, rows)
    said = _usual_scores(scores, known) if found.statistics.estimates and scores is not None else None
    x = watched_rows(design, found, rows)
    events = events_of(x, found.columns, found.statistics, found.levels, said, found.centres)
    left = rows.copy()
    for event in events:
        left[event.begun : event.ended + 1] = np.nan
    count = int(whole_rows(design, found, left).sum())
    others = found.pairs.others(found.every)
    if not events or count < LEAST_NORMAL or is_conformal(count, others) != is_conformal(found.rows, others):
        return Raised()

    def compared(before: LearnedThresholds, *, validated: bool) -> tuple[float, str]:
        other = thresholds_from_rows(design, left, scores=scores, like=found, validated=validated, **given)
        if other.statistics.names != before.statistics.names:
            return 1.0, ""
        each = factors(before.statistics, before.levels, other.statistics, other.levels)
        most = max(each, key=lambda name: each[name])
        return each[most], most

    # The largest of few parts say little of rare rows: these alone tell whether events stand out.
    inside = thresholds_from_rows(design, rows, scores=scores, like=found, validated=False, **given)
    if compared(inside, validated=False)[0] < TOLD_LEVEL_FACTOR:
        return Raised()
    factor, most = compared(found, validated=True)
    return Raised(events, most, factor) if factor >= TOLD_LEVEL_FACTOR else Raised()


def watched_rows(design: ObserverDesign, found: LearnedThresholds, rows: FloatArray) -> FloatArray:
    """Return the columns that are watched of ``rows (n, m)``, NaN in rows of which a part is not known."""
    places = [watched_names(design).index(name) for name in found.columns]
    return np.where(whole_rows(design, found, rows)[:, None], rows[:, places], np.nan)


def whole_rows(design: ObserverDesign, found: LearnedThresholds, rows: FloatArray) -> NDArray[np.bool_]:
    """Return in which of ``rows (n, m)`` nothing is missing but what most of them lack ``(n,)``."""
    usual = [name not in found.seldom for name in watched_names(design)]
    return np.asarray(np.isfinite(rows[:, usual]).all(axis=1))


def _usual_scores(scores: Scores, known: NDArray[np.bool_]) -> Scores | None:
    """Return what rows say of faults, and nothing of those that are not known; `None` where they do not determine
    them."""
    found = replace(
        scores,
        score=np.where(known[:, None], scores.score, 0.0),
        information=np.where(known[:, None, None], scores.information, 0.0),
        theta=np.where(known[:, None], scores.theta, np.nan),
    )
    return found if found.chosen(slice(len(known) // 2)).determine and found.determine else None


def signatures(design: ObserverDesign, kept: Sequence[int], sizes: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
    """Return directions ``(s, m)`` of a step in the columns that are watched, of deviations ``sizes (m,)``, and what
    each shows: a column alone, and what a constant fault of a linear design does to all of them where this is another
    direction."""
    names = [watched_names(design)[i] for i in kept]
    found = list(np.diag(sizes))
    if not isinstance(design.observer, LinearObserver) or expects_fault_courses(design):
        return np.array(found), tuple(names)
    errors = error_model(design)
    observer, plant = errors.observer, errors.plant
    c, direct, *_ = errors.output(slice(len(observer.state_names), None))
    held = (np.eye(observer.order) if observer.dt > 0.0 else np.zeros_like(observer.Az)) - observer.Az
    try:
        gains = (direct - c @ np.linalg.solve(held, errors.fault))[kept]
    except np.linalg.LinAlgError:
        return np.array(found), tuple(names)
    for name, gain in zip(plant.fault_names, gains.T, strict=True):
        scaled = gain / sizes
        size = float(np.linalg.norm(scaled))
        if np.isfinite(size) and size > 0.0 and float(np.abs(scaled).max()) < OWN_DIRECTION * size:
            found.append(gain / size)
            names.append(f"fault {name}")
    return np.array(found), tuple(names)


def expects_fault_courses(design: ObserverDesign) -> bool:
    """Whether a linear observer expects faults of a course, such as a step, which leave nothing in its residuals once
    it has followed them."""
    return isinstance(design.observer, LinearObserver) and error_model(design).Phi is not None


def varying(rows: FloatArray, first: int) -> list[int]:
    """Return the columns of ``(n, m)`` from the ``first`` on in which anything changes."""
    return [i for i in range(first, rows.shape[1]) if float(np.ptp(rows[:, i])) > 0.0]


def independent(rows: FloatArray) -> list[int]:
    """Return the columns of ``(n, m)`` that those before them do not explain."""
    kept: list[int] = []
    basis = np.zeros((len(rows), 0))
    for i, column in enumerate(rows.T):
        left = column - column.mean()
        power = float(left @ left)
        # Twice, as once leaves rounding of large parts.
        for _ in range(2):
            left = left - basis @ (basis.T @ left)
        if power > 0.0 and float(left @ left) > LEAST_NEW * power:
            kept.append(i)
            basis = np.column_stack([basis, left / np.linalg.norm(left)])
    return kept


class LearnedState(NamedTuple):
    """The state of `LearnedRule`."""

    past: FloatArray  # ``(order, m)``: rows, latest first
    white: FloatArray  # ``(ages, m)``: whitened rows, latest last
    means: FloatArray  # exponentially weighted, one row for each weight
    last: float | None = None
    taken: int = 0
    waiting: int = 0  # rows until the effect of the last one in which something was missing has settled
    before: FloatArray = NOTHING  # ``(1 + nf, nf)``: estimates and covariance of the faults after the last sample
    scores: FloatArray = NOTHING  # ``(ages, 2 nf)``: what samples said of faults, scores and information, latest last


class LearnedRule(Rule):
    """The largest of all statistics in units of its level, row by row.  A row that is missing, or in which nothing may
    be decided, is as the autoregression predicts it: it adds no evidence, and takes none away.

    Where the gain follows what is measured (all but linear observers, which recover from a gap first), a missing sample
    moves the estimates otherwise than was learned.  Rows that are predicted from it count by no more than the
    observer's own covariance, which has grown, makes of their innovation, by as much as it was wrong in the rows that
    were learned from.  In that row itself the innovations of
    ``by_sensor`` residuals are what they always are: those that are there decide, and the rest is as they make it most
    likely."""

    def __init__(
        self,
        learned: LearnedThresholds,
        names: Sequence[str],
        faults: Sequence[str] = (),
        *,
        by_sensor: bool = False,
        walk: FloatArray | None = None,
    ) -> None:
        self.learned, self.by_sensor = learned, by_sensor
        self._walk = walk if learned.statistics.estimates else None
        self._residual = np.array([not name.startswith("fhat[") for name in learned.columns])
        self._faults = {f"fault {name}": i for i, name in enumerate(faults)}
        self._places = np.array([names.index(name) for name in learned.columns])
        self._usual = np.array([name not in learned.seldom for name in names])
        templates = learned.statistics.templates()
        self._templates = templates.reshape(len(templates) * len(AGES), -1)
        self._model = learned.statistics.model
        effects = learned.statistics.offset_effects() / np.sqrt(learned.statistics.levels_by_age)
        self._effects = effects.ravel()
        bands = learned.statistics.fault_bands
        self._bands = np.zeros(len(learned.centres)) if bands is None else bands

    def init(self) -> LearnedState:
        """Return the state before the first sample."""
        model = self._model
        white, means = np.zeros((max(AGES), model.channels)), np.zeros((len(FORGETTING), model.channels))
        found = LearnedState(np.tile(model.mean, (model.order, 1)), white, means)
        if self._walk is None:
            return found
        return found._replace(before=before_any(len(self._walk)), scores=np.zeros((max(AGES), 2 * len(self._walk))))

    def step(self, state: LearnedState, sample: Sample) -> tuple[LearnedState, RuleOutput]:
        """Return the largest statistic in units of its level, one as threshold, and the fault whose step it is."""
        missing = 0 if state.last is None else round((sample.time - state.last) / self.learned.dt) - 1
        for _ in range(min(max(missing, 0), max(AGES))):
            state = self._added(state, None)
        state = state._replace(last=sample.time, taken=state.taken + 1)
        state = self._scored(state, sample.said, max(missing, 0))
        found = watched_values(sample.residuals, sample.said)
        whole = found is not None and sample.deciding and bool(np.isfinite(found[self._usual]).all())
        shown = None if found is None or not sample.deciding else self._completed(state, found, whole=whole)
        counts = shown is not None and state.taken > self.learned.settling
        most, varying = math.inf if counts else 0.0, isinstance(sample.said, Evidence)
        if counts and state.waiting and isinstance(sample.said, Evidence):
            most = float(np.linalg.norm(sample.said.whitened)) / self.learned.innovation
        if not whole and varying:
            state = state._replace(waiting=self._model.order + 1)
        state = state._replace(waiting=max(state.waiting - 1, 0))
        if found is None or not (whole or (varying and (counts or np.isfinite(found[self._places]).all()))):
            return self._added(state, None), RuleOutput(math.nan, math.nan)
        seen = found[self._places]
        kept = seen if shown is None else np.where(np.isfinite(seen), seen, shown)
        state = self._added(state, kept, most, shown)
        if not counts:
            return state, RuleOutput(math.nan, math.nan)
        # Products of numbers that overflow have passed any level.
        with np.errstate(all="ignore"):
            fits = np.maximum(np.abs(self._templates @ state.white.ravel()) - self._effects, 0.0)
            ratios = (fits**2).reshape(-1, len(AGES)).max(axis=1)
            weights = np.array([(2.0 - share) / share for share in FORGETTING])
            smooth = weights * np.sum(state.means**2, axis=1)
            first = [np.sum(state.white[-1] ** 2)]
            changes = self._changes(state)
            squares = self._squares(sample.said)
            values = np.concatenate([first, smooth, ratios, changes.max(axis=0), squares]) / self.learned.levels
        values = np.where(np.isnan(values), np.inf, values)
        which = self._fault(found, ratios) if self._walk is None else most_likely_change(changes)
        return state, RuleOutput(float(values.max()), 1.0, which)

    def _scored(self, state: LearnedState, said: Any, missing: int) -> LearnedState:
        """Return the state with what a sample says of the faults."""
        if self._walk is None or not isinstance(said, Evidence):
            return state
        before, found = sample_score(state.before, said, self._walk, missing + 1)
        row = np.concatenate([found.away(self.learned.centres), np.diag(found.information)])
        gone = min(missing, max(AGES))
        kept = np.vstack([state.scores, np.zeros((gone, len(row))), row])[-max(AGES) :]
        return state._replace(before=before, scores=kept)

    def _changes(self, state: LearnedState) -> FloatArray:
        """Return twice the log likelihood ratios of changes of each age and fault, ``(ages, nf)``."""
        if self._walk is None:
            return np.zeros((1, 0))
        sums = np.cumsum(state.scores[::-1], axis=0)[np.array(AGES) - 1]
        away, power = np.hsplit(sums, 2)
        return np.asarray(np.where(power > 0.0, beyond(away, self._bands * power) ** 2 / power, 0.0))

    def _squares(self, said: Any) -> FloatArray:
        """Return the squares of the estimates, from where they were, in units of their deviations, ``(nf,)``."""
        if self._walk is None or not isinstance(said, Evidence):
            return np.zeros(0 if self._walk is None else len(self._walk))
        away = beyond(said.theta - self.learned.centres, self._bands)
        return np.asarray(away**2 / np.diag(said.parameter_covariance))

    def _fault(self, found: FloatArray, ratios: FloatArray) -> int | None:
        """Return the fault whose step or ramp explains most, or whose estimate is furthest from where it was."""
        names, count = self.learned.columns, len(self.learned.scales)
        told = self.learned.statistics.told[int(np.argmax(ratios)) % len(self.learned.statistics.told)]
        if told.startswith("fhat["):
            return int(self._places[names.index(told)])
        if told in self._faults:
            return self._faults[told]
        return None if not count else int(np.argmax(np.abs(found[:count] - self.learned.centres) / self.learned.scales))

    def _predicted(self, state: LearnedState) -> FloatArray:
        """Return what the autoregression says of the next row."""
        model = self._model
        rows = zip(model.A, state.past, strict=True)
        return np.asarray(model.offset + sum((a @ row for a, row in rows), np.zeros(model.channels)))

    def _completed(self, state: LearnedState, found: FloatArray, *, whole: bool) -> FloatArray | None:
        """Return the watched values of a row; where some are missing, as those of sensors that are there make them most
        likely, and `None` without any."""
        x = found[self._places]
        seen = self._residual & np.isfinite(x)
        if whole or not (self.by_sensor and seen.any()):
            return x if whole else None
        predicted, precision = self._predicted(state), self._model.whitener.T @ self._model.whitener
        away = (x - predicted)[seen]
        rest = np.linalg.solve(precision[np.ix_(~seen, ~seen)], -precision[np.ix_(~seen, seen)] @ away)
        completed = np.where(seen, x, predicted)
        completed[~seen] += rest
        return completed

    def _added(
        self, state: LearnedState, x: FloatArray | None, most: float = 0.0, shown: FloatArray | None = None
    ) -> LearnedState:
        """Return the state after a row, or after one that is as predicted (`None`): of a norm of ``most`` at most, with
        what is ``shown`` of it for evidence (``(m,)``, as it is by default)."""
        model, predicted = self._model, self._predicted(state)
        shown = x if shown is None else shown
        with np.errstate(over="ignore", invalid="ignore"):
            e = np.zeros(model.channels) if shown is None or not most else model.whitener @ (shown - predicted)
            size = float(np.linalg.norm(e))
            e = e * (most / size) if size > most else e
        shares = np.array(FORGETTING)[:, None]
        past = np.vstack([predicted if x is None else x, state.past[:-1]]) if model.order else state.past
        means = (1.0 - shares) * state.means + shares * e
        return state._replace(past=past, white=np.vstack([state.white[1:], e]), means=means)

    def restart(self, state: LearnedState, skipped: int = 0) -> LearnedState:
        """Keep everything: rows that are missing are predicted over."""
        return state

    def options(self) -> Any:
        """Return the digest of what was learned."""
        return digest_of(plain(self.learned.as_dict()))


def learned_monitor(design: ObserverDesign, learned: LearnedThresholds) -> Monitor:
    """Return the monitor of thresholds that were learned with a design; raise `SpecError` for another design."""
    if learned.gains != gain_set_digest(design):
        raise SpecError("The thresholds were learned with another gain set: learn them again.", path="normal")
    observer, names = design.observer, watched_names(design)
    missing = [name for name in learned.columns if name not in names]
    if missing:
        raise SpecError(
            f"The thresholds are for {missing[0]!r}, which the design does not have: learn them again for this design.",
            path="normal",
        )
    if learned.outlier_sizes is not None and not has_innovations_by_sensor(observer):
        raise SpecError(
            "The thresholds hold sizes of outliers, and this design judges none of one sensor: learn them again.",
            path="normal",
        )
    residuals = (
        len(observer.residual_names) if isinstance(observer, LinearObserver) else len(innovation_names(observer))
    )
    return Monitor(
        "learned",
        learned.statement,
        LearnedRule(
            learned,
            names,
            observer.fault_names,
            by_sensor=has_innovations_by_sensor(observer),
            walk=parameter_walk(observer),
        ),
        residuals=residuals,
        fault_names=observer.fault_names,
        fault_scales=learned.scales,
    )
