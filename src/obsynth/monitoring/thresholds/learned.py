"""Learned thresholds: the result of learning from rows without faults, with its statement and its file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import path_of
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.monitoring.thresholds.alarm_rates import UNITS
from obsynth.monitoring.thresholds.cross_validation import HealthyTime
from obsynth.monitoring.thresholds.learned_levels import (
    HOLD,
    RARER_WHERE_SIZES_LAST,
    SIZE_LAGS,
    is_conformal,
    rows_needed,
)
from obsynth.monitoring.thresholds.learned_ranges import LearnedRanges
from obsynth.monitoring.thresholds.learned_statistics import AGES, Statistics
from obsynth.numerics.arguments import arguments_checked, real_number
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.autoregression import Autoregression
from obsynth.results.certificate_files import opened, sealed
from obsynth.results.gain_set_writing import plain, restored

#: The share of healthy time in alarm is unknown.
NO_HEALTHY_TIME = HealthyTime(0.0, 0.0, 1.0)

LEARNED_KIND = "obsynth learned thresholds"

LEARNED_VERSION = 1

LEARNED = FileKind(
    "learned thresholds of obsynth", rb'\A\s*\{\s*"kind":\s*"obsynth learned thresholds"', suffix=".json"
)

#: Share of healthy time in alarm above which thresholds are not valid.
MOST_HEALTHY_TIME = 0.05

#: Estimates of faults are followed so many times more slowly than offsets of the residuals, which no fault explains.
FAULTS_SLOWER = 2.0

#: Least number of logs whose differences show how large the offsets of other logs can be.  The spread of two logs has
#: one degree of freedom: the 95 % interval of the offset of a third one extends from their mean by eleven times their
#: distance.
LOGS_FOR_OFFSETS = 3

#: Thresholds from fewer logs do not distinguish an offset of another log from a fault that is present from its first
#: row on.  An alarm that is present when so many rows of a run have been decided therefore ends, and the means of these
#: rows are usual from then on.  A change within these rows has moved the means by a part of its size only, so that it
#: stays an alarm.
OWN_ROWS = (100, 200)

#: Rows over which offsets of residuals are followed: where one log does not distinguish them from drifts, and in a run
#: whose first rows were taken as usual.  With one and a half times the age of the oldest change that is tested, three
#: quarters of such a change remain.
FOLLOWED_ROWS = 1.5 * max(AGES)


class WrongPairs(NamedTuple):
    """Pairs of consecutive wrong samples; they count as not measured, since each of them would cause an alarm."""

    number: int
    chance: float  # mean number of pairs per row, by chance

    def others(self, every: float) -> float:
        """Return the mean number of rows between alarms that no pair causes, if there is one alarm per ``every`` rows
        in all."""
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
        Autoregression of these columns, and the directions of the steps that are tested.
    levels : FloatArray
        ``(k,)``: level of each statistic.
    every : float
        Mean number of rows between false alarms, as chosen by the user.
    rows, needed : int
        Number of rows that the thresholds were learned from, and number of rows that this rate needs.
    dt : float, seconds
        Time between these rows.
    centres, scales : FloatArray
        ``(nf,)``: means and standard deviations of the fault estimates in these rows.
    gains : str
        sha256 of the gain set.
    extrapolated : bool
        Whether alarms of this rate are rarer than those in the bootstrap.
    left_out : tuple of str
        Columns that are not watched: constant ones, redundant ones, and estimates whose memory is too long for these
        rows.
    seldom : tuple of str
        Those of them that most rows lack, such as those of sensors slower than the rows.  A row is complete without
        them.
    settling : int
        Rows at the start of a run that are not decided, since none of them was learned from.
    pairs : WrongPairs
        Pairs of consecutive wrong samples, which count as not measured.
    innovation : float
        Root mean square of the innovations in units of the deviations that the observer states; one if its covariances
        are right.
    outlier_sizes : FloatArray, optional
        ``(ny,)``: least size of the outliers of each output according to these rows, in place of that of the design;
        without it, that of the design agrees with these rows.
    lasting : float
        Mean autocorrelation of the size of the residuals if large residuals come in clusters, so that the levels are
        those of a lower rate; otherwise zero.
    initial_covariance : FloatArray, optional
        ``(nx, nx)``: covariance of the states at a start anywhere in these rows, in place of that of the design.
    repeats : FloatArray, optional
        ``(ny,)``: number of equal consecutive samples from which on each output counts as not measured, since its
        sensor may be stuck; infinite where these rows do not show it.  Without it, repeated samples count as measured.
    logs : int
        Number of logs that these rows are from.
    healthy_time : HealthyTime
        Share of healthy rows in alarm, with its interval, in rows that the levels were not learned from.
    sensor_drift : float
        Slow drift of each sensor that must not cause an alarm, in deviations of its noise; zero: none is allowed for.
    without_drift : tuple of str
        Sensors for which no drift is allowed for nevertheless, since their noise or the effect of a drift is unknown.
    drift_limits : mapping of str to float
        If no drift is allowed for: the slow drift of a sensor, in deviations of its noise, that causes an alarm for as
        long as it lasts; with a ``memory``, the offset from the first row on that causes one.  Only limits below one
        deviation (one log) or four (several) are listed.
    memory : float
        Number of rows over which slow offsets of the residuals are followed, so that they cause no alarm; faults are
        followed over twice as many.  Zero: neither is followed.  One log does not distinguish drifts of a plant from
        faults that develop as slowly.
    ranges : LearnedRanges, optional
        Least and largest values of inputs and outputs in these rows.  Levels are raised for inputs beyond them.
    notes : tuple of str
        What a user should look at in these rows: events that raise the levels, outputs that are stuck, errors of the
        model where inputs move.

    Examples
    --------
    >>> import pandas as pd
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> log = obsynth.simulate(design, obsynth.Scenario(horizon=600, noise=1.0)).outputs
    >>> normal = pd.DataFrame({"time": range(len(log)), "y1": log[:, 0], "y2": log[:, 1]})
    >>> learned = obsynth.learn_thresholds(design, normal, false_alarms="1 per 100 rows")
    >>> learned.every, bool((learned.levels > 0.0).all())
    (100.0, True)
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
    sensor_drift: float = 0.0
    without_drift: tuple[str, ...] = ()
    drift_limits: Mapping[str, float] = field(default_factory=dict)
    ranges: LearnedRanges | None = None
    memory: float = 0.0

    def __repr__(self) -> str:
        """Return the statement of the thresholds, the monitored columns and the notes."""
        lines = [f"{self.statement[0].upper()}{self.statement[1:]}.", f"Monitored: {', '.join(self.columns)}."]
        lines += [f"Left out: {', '.join(self.left_out)}."] if self.left_out else []
        return "\n".join([*lines, *self.notes])

    @property
    def holds(self) -> bool:
        """Whether there were enough rows for the chosen rate, and healthy rows that were not learned from are in alarm
        for a share of at most `MOST_HEALTHY_TIME`."""
        return self.rows >= self.needed and self.healthy_time.expected <= MOST_HEALTHY_TIME

    @property
    def takes_first_rows(self) -> bool:
        """Whether the first rows of a run are taken as usual in its log if they are in alarm.

        This is so if the logs are too few to show the offsets of other logs, or have no such offsets themselves, so
        that an offset of a few deviations causes an alarm.
        """
        return self.logs < LOGS_FOR_OFFSETS or bool(self.drift_limits)

    @property
    def statement(self) -> str:
        """What the thresholds mean, and whether the rows suffice for it."""
        text = "; ".join((*self._rate_in_words(), *self._drifts_in_words(), *self._dependence_in_words()))
        if self.holds:
            return text
        if self.rows >= self.needed:
            return (
                f"{text}. That is more than {100 * MOST_HEALTHY_TIME:g} %: parts of these rows are unlike the others. "
                "Give several normal logs, of other starts and set points"
            )
        return (
            f"{text}. Too few rows for this rate ({self.rows}; about {self.needed:,} needed, "
            f"{duration(self.needed * self.dt)}): {self._possible_rate_in_words()}"
        )

    def _rate_in_words(self) -> Iterator[str]:
        """Yield the stated rate of false alarms, and the share of alarms in rows that were not learned from."""
        estimates = self.statistics.estimates
        changes = f", and in changes of {_counted(len(estimates), 'fault')}" if estimates else ""
        yield (
            f"learned from {self.rows} rows without faults: at most one false alarm per {self.every:.6g} rows "
            f"({duration(self.every * self.dt)}) on average, in {_counted(len(self.columns), 'column')}{changes}"
        )
        yield f"alarms less than {HOLD} rows apart count as one"
        if is_conformal(self.rows, self.pairs.others(self.every)):
            yield "the level was found from the second half of these rows"
        time = self.healthy_time
        compared = f"between {self.logs} logs" if self.logs > 1 else "between parts of one log"
        yield (
            f"healthy rows that were not learned from are in alarm for {100 * time.expected:.2g} % of the time (95 % "
            f"interval {100 * time.low:.2g} to {100 * time.high:.2g} %, {compared})"
        )

    def _drifts_in_words(self) -> Iterator[str]:
        """Yield which slow drifts are allowed for, which cause alarms, and which question one log leaves open."""
        if self.logs == 1:
            yield (
                "one log does not say how far constants of the plant drift in others: while one is further off than in "
                "this log, healthy rows may be in alarm; three normal logs that hold such drifts show it"
            )
        if self.memory:
            slower = FAULTS_SLOWER * self.memory
            changes = f", and changes of the faults over more than {slower:.6g}," if self.statistics.estimates else ""
            yield (
                "one log does not distinguish slow faults from drifts: offsets of the residuals that come over more "
                f"than about {self.memory:.6g} rows ({duration(self.memory * self.dt)}){changes} are followed and "
                "alarm nothing"
            )
        if self.takes_first_rows:
            later = "" if self.memory else f", and followed over {FOLLOWED_ROWS:.6g} rows from then on"
            yield (
                f"{logs_that_do(self.logs)} not distinguish a fault that is there from the first row of a run on from "
                f"an offset of that log: an alarm that stands after {OWN_ROWS[0]} decided rows (or {OWN_ROWS[1]}) ends "
                f"there, as the means of these rows are taken for what is usual in this log{later}, and levels rise by "
                "what the alarm reached"
            )
        if self.sensor_drift:
            unknown = ", ".join(self.without_drift)
            why = f" (for {unknown} no noise is stated and the log shows none, or nothing is known with such a drift)"
            yield (
                f"a slow drift of each sensor{f' but {unknown}' if unknown else ''} by "
                f"{_counted_number(self.sensor_drift, 'deviation')} of its noise is allowed for{why if unknown else ''}"
            )
        if self.drift_limits:
            limits = " or of ".join(f"{name} by {limit:.2g}" for name, limit in self.drift_limits.items())
            wrong = (
                f"an offset from the first row on of {limits} deviations of its noise may alarm until it is followed"
                if self.memory
                else f"a slow drift of {limits} deviations of its noise alarms as long as it lasts"
            )
            if self.logs == 1:
                yield (
                    f"one log does not rule out that sensors drift otherwise in others, and {wrong}: give three normal "
                    "logs, or allow for it (sensor_drift)"
                )
            else:
                yield (
                    f"none of these {self.logs} logs holds such offsets of sensors that levels are above them, and "
                    f"{wrong}: give normal logs that hold them, or allow for them (sensor_drift)"
                )

    def _dependence_in_words(self) -> Iterator[str]:
        """Yield the consequences of clustered large residuals, and of wrong samples in pairs."""
        if self.lasting:
            yield (
                f"the size of the residuals follows itself (mean autocorrelation over {SIZE_LAGS} rows "
                f"{self.lasting:.2g}), so that large ones come together: the levels are those of a rate "
                f"{RARER_WHERE_SIZES_LAST:g} times as low, and single logs may alarm more often than stated"
            )
        if self.pairs.number:
            yield (
                f"{_counted(self.pairs.number, 'pair')} of wrong samples in a row, which count as not measured: one "
                f"alarms when it comes, which is once per {1.0 / self.pairs.chance:.3g} rows by chance, and is among "
                "the false alarms"
            )

    def _possible_rate_in_words(self) -> str:
        """Return the lowest rate that these rows can determine, or why there is none."""
        model = self.statistics.model
        if rows_needed(model, 1.0) > self.rows:
            return "the residuals are too strongly correlated, or too many, for any rate from these rows"
        if self.needed > rows_needed(model, self.every):
            return "the estimates are too strongly correlated for any rate from these rows"
        rarest = min(self.rows, self.every)
        return (
            f"the lowest rate that {self.rows} rows can determine is one per {rarest:.6g} rows "
            f"({duration(rarest * self.dt)})"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the thresholds as plain data."""
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
            "told": list(self.statistics.signature_names),
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
            "sensor_drift": self.sensor_drift,
            "without_drift": list(self.without_drift),
            "drift_limits": dict(self.drift_limits),
            "ranges": None if self.ranges is None else self.ranges.as_dict(),
            **({"memory": self.memory} if self.memory else {}),
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
        text = sealed(LEARNED_KIND, LEARNED_VERSION, plain(self.as_dict()), under="thresholds")
        return write_atomically(path, text, kind=LEARNED)


def logs_that_do(logs: int, *, joined: str = "") -> str:
    """Return "one log does" or "n logs do", the subject and verb of a sentence on normal logs, with the text ``joined``
    to the subject."""
    without = " without offsets of sensors" if logs >= LOGS_FOR_OFFSETS else ""
    return f"one log{joined} does" if logs == 1 else f"{logs} logs{without}{joined} do"


def duration(seconds: float) -> str:
    """Return a duration as text, in the largest unit of which it has at least one."""
    name, size = next(((n, s) for n, s in reversed(UNITS.items()) if seconds >= s), ("second", 1.0))
    count = seconds / size
    return f"{count:.3g} {name}{'' if count == 1.0 else 's'}"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _counted_number(count: float, noun: str) -> str:
    return f"one {noun}" if count == 1.0 else f"{count:.6g} {noun}s"


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
    >>> log = obsynth.simulate(design, obsynth.Scenario(horizon=600, noise=1.0)).outputs
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
    shown_by, estimates = (tuple(map(str, data[name])) for name in ("told", "estimates"))
    optional = ("bands", "fault_bands", "initial_covariance")
    arrays = {
        name: None if data[name] is None else read_only(np.asarray(data[name], dtype=np.float64)) for name in optional
    }
    bands, of_faults = arrays["bands"], arrays["fault_bands"]
    statistics = Statistics(
        Autoregression(offset, a, whitener), signatures, shown_by, estimates, by_age, bands, of_faults
    )
    shapes = (offset.shape, a.shape[1:], whitener.shape, signatures.shape[1:], levels.shape)
    fits = shapes == ((m,), (m, m), (m, m), (m,), (len(statistics.names),)) and len(shown_by) == len(signatures)
    fits &= by_age.shape == (2 * len(shown_by), len(AGES)) and bool((by_age > 0.0).all() and (levels > 0.0).all())
    fits &= bands is None or (bands.shape == (len(shown_by),) and bool((bands >= 0.0).all()))
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
        real_number(data.get("sensor_drift", 0.0), "sensor_drift", "deviations, 0 or more", least=0.0),
        tuple(map(str, data.get("without_drift", ()))),
        {str(name): float(limit) for name, limit in data.get("drift_limits", {}).items()},
        None if data.get("ranges") is None else LearnedRanges.from_dict(data["ranges"]),
        real_number(data.get("memory", 0.0), "memory", "rows, 0 or more", least=0.0),
    )
