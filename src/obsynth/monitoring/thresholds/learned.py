"""Learned thresholds: the result of learning from rows without faults, in words and in files."""

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

#: Nothing is known of the share of healthy time in alarm.
NO_HEALTHY_TIME = HealthyTime(0.0, 0.0, 1.0)

LEARNED_KIND = "obsynth learned thresholds"

LEARNED_VERSION = 1

LEARNED = FileKind(
    "learned thresholds of obsynth", rb'\A\s*\{\s*"kind":\s*"obsynth learned thresholds"', suffix=".json"
)

#: Share of healthy time in alarm above which thresholds do not hold.
MOST_HEALTHY_TIME = 0.05

#: Faults are followed so many times more slowly than offsets of residuals, which no fault of the design explains.
FAULTS_SLOWER = 2.0

#: Logs from which on their differences show how far offsets of other logs go: the spread of two has one degree of
#: freedom, and the interval that holds a third one reaches eleven times as far as they are apart.
LOGS_FOR_OFFSETS = 3

#: Thresholds of fewer logs do not tell an offset of another log from a fault that is there from its first row on: an
#: alarm that stands when so many rows of a run have been decided ends there.  The means of all these rows are what is
#: usual from then on; a change that came meanwhile has moved them by its share only, and stays an alarm.
OWN_ROWS = (100, 200)

#: Rows over which offsets of residuals are followed where one log does not tell them from drifts, and in a run whose
#: first rows were taken for what is usual, of which they are an estimate: half as many again as the oldest change that
#: statistics look for, of which three quarters remain.
FOLLOWED_ROWS = 1.5 * max(AGES)


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
    sensor_drift : float
        Deviations of its noise by which each sensor may drift slowly without an alarm; zero: none is allowed for.
    without_drift : tuple of str
        Sensors for which none is allowed for all the same, as nothing is known of their noise or of what a drift does.
    drift_limits : mapping of str to float
        Where no drift is allowed for: by how many deviations of its noise, of one log below one and of several below
        four, a slow drift of a sensor alarms for as long as it lasts; with a ``memory``, an offset that is there from
        the first row on.
    memory : float
        Rows over which slow offsets of the residuals are followed, and twice those over which faults are, so that they
        alarm nothing; zero: none is.  One log does not distinguish drifts of a plant from faults that come as slowly.
    ranges : LearnedRanges, optional
        Least and largest values of inputs and outputs in these rows: beyond those of an input levels are raised.
    notes : tuple of str
        What in these rows is to be looked at: events that raise the levels, outputs that are stuck, errors of the model
        where inputs move.

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
        """Return what the thresholds mean, and what is monitored, in a few lines."""
        lines = [f"{self.statement[0].upper()}{self.statement[1:]}.", f"Monitored: {', '.join(self.columns)}."]
        lines += [f"Left out: {', '.join(self.left_out)}."] if self.left_out else []
        return "\n".join([*lines, *self.notes])

    @property
    def holds(self) -> bool:
        """Whether there were rows enough for the rate that was asked for, and rows that were not learned from are in
        alarm for `MOST_HEALTHY_TIME` at most."""
        return self.rows >= self.needed and self.healthy_time.expected <= MOST_HEALTHY_TIME

    @property
    def takes_first_rows(self) -> bool:
        """Whether the first rows of a run are taken for what is usual in its log, where they alarm: the logs are too
        few to show which offsets others have, or have none themselves, so that those of a few deviations alarm."""
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
        """Yield what is promised of false alarms, and what rows that were not learned from show of it."""
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
        """Yield which slow drifts of sensors are allowed for, which would alarm, and what one log does not say."""
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
        """Yield what it means that large residuals come together, and that wrong samples come in pairs."""
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
    """Return which normal logs do something, as subject and verb, with what is ``joined`` to the subject between."""
    without = " without offsets of sensors" if logs >= LOGS_FOR_OFFSETS else ""
    return f"one log{joined} does" if logs == 1 else f"{logs} logs{without}{joined} do"


def duration(seconds: float) -> str:
    """Return seconds in the largest unit of which there is one."""
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
