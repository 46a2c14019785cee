"""A design on measured data: a log or a stream in, estimates out.

Where estimates go: CSV and Parquet files that appear whole or not at all, data frames, and streams.

What runs a log: rows of data to rows of output, what is counted, and the saved state with which it goes on.

States of the plant as it was written, from the estimates for the plant it was made into.

Logs are read afterwards: estimates from what came later as well, on arrays and on logs.
"""

from __future__ import annotations

import math
import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TextIO, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.transformations.linear_plants import StateRecovery
from obsynth.data.alarm_events import NO_DECISION, AlarmEvent, AlarmLog
from obsynth.data.log_observers import (
    DECIDING,
    GAP,
    RECOVERING,
    STALE,
    Clock,
    LogObserver,
    Row,
    SteppingLogObserver,
    log_observer,
)
from obsynth.data.sources import CHUNK_ROWS, TIME_HEADER, Data, Signals, Stamps, check_suffix, chunks, samples
from obsynth.data.stuck_sensors import RepeatedValues, stuck_texts
from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.monitors.learned import LearnedRule, as_learned
from obsynth.experiments.monitors.learned_levels import HOLD
from obsynth.experiments.monitors.monitor import LinearSample, Monitor, Sample
from obsynth.files.outputs import (
    FileKind,
    HeldSignals,
    check_output,
    ending_signals,
    read_json,
    remove_left_parts,
    replacement_of,
    require_distinct,
    write_atomically,
)
from obsynth.files.tables import table_writer
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.methods.guaranteed_test.windows import rows_before
from obsynth.numerics.arguments import (
    FloatArray,
    arguments_checked,
    is_finite_number,
    is_number,
    read_only,
    real_number,
    require_kind,
    whole_number,
)
from obsynth.observers.linear.observer import SETTLED_TO, LinearObserver, transient
from obsynth.observers.recursive.observer import deviations_in
from obsynth.observers.running import BY_COLUMNS, Estimates, changed
from obsynth.observers.smoothing import (
    Chain,
    Smoothed,
    checked_lag,
    links_of,
    parameters_of,
    smoothed_estimates,
    smoothed_record,
)
from obsynth.plants.descriptor import DescriptorSystem, index_of
from obsynth.results.design import ObserverDesign, digest_of, gain_set_digest, plain, restored, sealed

if TYPE_CHECKING:
    import pandas as pd


#: Of plants with more states as written none is recovered unless asked for: each row would take too long.
MOST_RECOVERED = 300
#: Its column says of which time the recovered states are.
LATE = "recovered states"


class RecoveredStates:
    """Estimates of states that a transformation took away: ``x_source = from_state x + from_input u + from_fault f``.
    Disturbances, noise and faults that are not estimated count as zero.  Where the fault estimate lags more than that
    of the state, both are taken of the older moment."""

    def __init__(self, recovery: StateRecovery, observer: LogObserver, names: Sequence[str]) -> None:
        wanted = set(names)
        places = [i for i, name in enumerate(recovery.names) if name in wanted and not _kept(recovery, observer, name)]
        self.names = tuple(recovery.names[i] for i in places)
        self.columns = tuple(
            f"xhat[{name}]" if name not in observer.state_names else f"xhat[{name} as written]" for name in self.names
        )
        flags = recovery.flags()
        self.flags: Mapping[str, str] = {recovery.names[i]: flags[i] for i in places}
        self.point = np.array([recovery.operating_point.get(name, 0.0) for name in self.names])
        states, faults = len(observer.state_names), recovery.from_fault.shape[1]
        known = faults if faults == len(observer.fault_names) else 0
        self._map = np.hstack([recovery.from_state, recovery.from_fault[:, :known]])[places]
        self._inputs = recovery.from_input[places]
        used = self._map.any(axis=0)
        delays = np.array([*observer.state_delays, *observer.fault_delays[:known]], dtype=np.int64)
        self.delay = int(np.max(delays[used], initial=0))
        self._ages = np.where(used, self.delay - delays, 0)
        self._used, self._columns = used, np.arange(states + known)
        self._rows: deque[FloatArray] = deque(maxlen=self.delay + 1)
        self._known = np.zeros(len(observer.input_names))

    @classmethod
    def of(
        cls, recovery: StateRecovery | None, observer: LogObserver, asked: str | Sequence[str] | None = None
    ) -> RecoveredStates | None:
        """Return the recovery of a design, of all states or of those asked for; `None` where there is nothing."""
        if recovery is None:
            return None
        names = _asked_for(recovery, asked)
        if not names:
            return None
        # Of a large map its operator knows the number of states from which the others follow.
        operator = recovery.by_operator
        states = recovery.from_state.shape[1] if operator is None else operator.state_count
        if states != len(observer.state_names):
            return None
        found = cls(recovery, observer, names)
        return found if found.names else None

    def take(self, row: Row) -> FloatArray:
        """Return the recovered states, deviations; NaN where they are not known."""
        if row.skipped:
            self._rows.clear()
        inputs = self._known if row.deviations is None else row.deviations[: len(self._known)]
        self._known = np.where(np.isfinite(inputs), inputs, self._known)
        self._rows.append(np.concatenate([row.values[self._columns], self._known]))
        if len(self._rows) <= self.delay:
            return np.full(len(self.names), np.nan)
        rows = np.array(self._rows)[::-1]
        estimates = np.where(self._used, rows[self._ages, self._columns], 0.0)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(self._map @ estimates + self._inputs @ rows[self.delay, len(self._columns) :])

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {"rows": list(self._rows), "known": self._known}

    def resume(self, data: Mapping[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        self._rows.clear()
        self._rows.extend(data["rows"])
        self._known = data["known"]


def _asked_for(recovery: StateRecovery, asked: str | Sequence[str] | None) -> tuple[str, ...]:
    if asked is None:
        return recovery.names if len(recovery.names) <= MOST_RECOVERED else ()
    if isinstance(asked, str) and asked in ("all", "none"):
        return recovery.names if asked == "all" else ()
    names = (asked,) if isinstance(asked, str) else tuple(asked)
    for name in names:
        index_of(name, recovery.names, what="The plant as written")
    return names


def _kept(recovery: StateRecovery, observer: LogObserver, name: str) -> bool:
    """Whether a state of the source is one of the observer's own, by name and as it is."""
    if name not in observer.state_names:
        return False
    row = recovery.names.index(name)
    own = np.arange(len(observer.state_names)) == observer.state_names.index(name)
    others = (recovery.from_input, recovery.from_fault, recovery.from_disturbance)
    return bool(np.array_equal(recovery.from_state[row], own)) and not any(matrix[row].any() for matrix in others)


#: Seconds of data that are compared with the operating point, and rows at most: a fast plant moves in a second.
FIRST_SECONDS, MOST_FIRST_ROWS = 1.0, 100
#: Rows that are taken in one piece at most.
ROWS_AT_ONCE = 4096
#: A signal is far from its operating point when its mean differs by this share of it.
FAR_FROM_POINT = 0.2


class OperatingPointCheck:
    """Gathers the first second of data, to tell whether they begin near the operating point."""

    def __init__(self, signals: Signals) -> None:
        self._signals = signals
        self._begin: float | None = None
        self.status = ""  # of the first row
        self._taken = 0
        self._start = np.full(len(signals.names), np.nan)
        self._sum, self._count = np.zeros(len(signals.names)), np.zeros(len(signals.names))

    def take(self, times: Sequence[float], deviations: FloatArray) -> None:
        """Take rows: seconds, and deviations ``(n, nu + ny)`` of which some may be missing."""
        for time, row in zip(times, deviations, strict=True):
            if self._begin is None:
                self._begin, self._start = time, np.array(row)
            if not (time - self._begin <= FIRST_SECONDS and self._taken < MOST_FIRST_ROWS):
                break
            self._taken += 1
            known = np.isfinite(row)
            self._sum[known] += row[known]
            self._count[known] += 1.0

    def alarm_of_the_start(self, design: ObserverDesign, alarms: Sequence[AlarmEvent]) -> tuple[str, ...]:
        """Return a text where an alarm of a linear design may be its initial-condition response: when the warm-up
        ends, `SETTLED_TO` of it are left, which is more than the noise where the outputs begin far from the start.
        Other designs leave out the first row as an outlier where it is so far away."""
        observer, plant = design.observer, design.plant
        refused = self.status == GAP and bool(np.isfinite(self._start).all())
        if refused and any(event.first_row <= HOLD for event in alarms):
            return (
                f"All outputs of the first row are left out as outliers, and an alarm comes within {HOLD} rows: the "
                "log may begin at other states than the design. State those at which it begins (states, or "
                "initial_state), or a larger initial_covariance.",
            )
        if not (isinstance(observer, LinearObserver) and isinstance(plant, DescriptorSystem)) or self._begin is None:
            return ()
        noise = np.linalg.norm(plant.Dw, axis=1)
        started = np.abs(self._start[len(self._start) - observer.By.shape[1] :])
        if len(noise) != len(started) or not np.any(known := np.isfinite(started) & (noise > 0.0)):
            return ()
        shares = np.where(known, started, 0.0) / np.where(known, noise, 1.0)
        worst = int(np.argmax(shares))
        if shares[worst] * SETTLED_TO <= 1.0:
            return ()
        lasting = transient(observer) * math.log(shares[worst]) / -math.log(SETTLED_TO)
        if not any(event.start < self._begin + lasting for event in alarms):
            return ()
        name = plant.output_names[worst]
        is_stated = name in self._signals.point
        where = "its operating point" if is_stated else "zero (no operating point is stated)"
        advice = "Give" if is_stated else "State the operating point at which the log begins, or give"
        return (
            f"An alarm in the first {lasting:.3g} s may be the initial-condition response: {name} begins "
            f"{shares[worst]:.3g} deviations of its noise from {where}, and when the warm-up ends "
            f"{100.0 * SETTLED_TO:g} % of that response are left. {advice} a longer warm-up (--warm-up {lasting:.3g}).",
        )

    def warnings(self) -> tuple[str, ...]:
        """Return a text for each signal with a stated operating point, not zero, that begins far from it."""
        texts = []
        for i, name in enumerate(self._signals.names):
            point = self._signals.point.get(name, 0.0)
            if point == 0.0 or self._count[i] == 0.0:
                continue
            away = self._sum[i] / self._count[i]
            if abs(away) > FAR_FROM_POINT * abs(point):
                texts.append(
                    f"{name} begins at {point + away:.6g}, far from its operating point {point:.6g}: the linear model "
                    "may not hold there, or the data are deviations already, or in another unit."
                )
        return tuple(texts)


def damaged_state(path: Path) -> SpecError:
    """Return the error for a saved state whose parts do not fit."""
    return SpecError(f"{path} is damaged: it is no state of this design and these options.", path=str(path))


class LogRun:
    """A design over a log, from its start: rows of data to estimates (`read`), and to rows of output (`take`).

    ``thresholds`` are levels by column; ``recovered`` is which states of the plant as written stand beside the others;
    other options are those of `run_on_data`.
    """

    def __init__(
        self,
        design: ObserverDesign,
        columns: Mapping[str, str] | None = None,
        scales: Mapping[str, float] | None = None,
        *,
        gap: float | None = None,
        warm_up: float | None = None,
        outliers: str | None = None,
        thresholds: Mapping[str, float] = MappingProxyType({}),
        monitor: Monitor | None = None,
        recovered: str | Sequence[str] | None = "none",
        stamps: Stamps | None = None,
    ) -> None:
        if monitor is not None and isinstance(monitor.rule, LearnedRule):
            design = design.replace(observer=as_learned(design.observer, monitor.rule.learned))
        self.observer = observer = log_observer(design, gap=gap, warm_up=warm_up, outliers=outliers)
        self.clock, self.signals = Clock(observer.dt, gap), Signals.of(observer, columns, scales)
        self.stamps, self.monitor = stamps, monitor
        #: What rows wait in for those after them, if they do.
        self.later: Any = None
        self._watching: Any = None if monitor is None else monitor.init()
        self.recovered = RecoveredStates.of(design.recovery, observer, recovered)
        extra = () if self.recovered is None else self.recovered.columns
        names = (*observer.columns, *extra)
        for name, level in thresholds.items():
            if name not in names:
                raise SpecError(
                    f"There is no column {name!r} to monitor: there are {', '.join(names)}.", path="thresholds"
                )
            real_number(level, f"The threshold of {name!r}", "a positive number", above=0.0, path="thresholds")
        self._levels = tuple((name, names.index(name), level) for name, level in thresholds.items())
        lags = observer.lags
        if self.recovered is not None and self.recovered.delay:
            lags.append((LATE, self.recovered.delay))
        self._lags = [delay * observer.dt for _, delay in lags]
        self._point = self.signals.estimates_point(observer)
        if self.recovered is not None:
            self._point = np.concatenate([self._point, self.recovered.point])
        states, faults = len(observer.state_names), len(observer.fault_names)
        self._faults = slice(states, states + faults)
        residuals = [i for i, name in enumerate(observer.columns) if name.startswith("r[")]
        self._residuals = slice(residuals[0], residuals[-1] + 1) if residuals else slice(0, 0)
        if monitor is not None:
            monitor.require_fit(len(residuals), observer.fault_names)
        self.header = (
            TIME_HEADER,
            "status",
            *(f"time of {name}" for name, _ in lags),
            *names,
            *((*monitor.columns, "statistic", "threshold") if monitor is not None else ()),
            *(("alarm",) if thresholds or monitor is not None else ()),
        )
        # Intervals of faults are in their own units, like the estimates.
        point = dict(zip(observer.fault_names, self._point[self._faults].tolist(), strict=True))
        ends = {f"{end} {name}": value for name, value in point.items() for end in ("lowest", "highest")}
        self._shifts = np.array([ends.get(name, 0.0) for name in (() if monitor is None else monitor.columns)])
        self.first, self.rows = OperatingPointCheck(self.signals), 0
        #: The file of the state that the first rows go on from: only they show whether its parts fit together.
        self.resumed_from: Path | None = None
        self.statuses, self.alarms, self.isolated = Counter[str](), dict[str, float](), ""
        self.alarm_rows = dict[str, int]()
        self.events = AlarmLog(self.header)
        self.repeated = RepeatedValues(len(observer.output_names))

    def take(self, chunk: FloatArray) -> list[list[Any]]:
        """Take rows ``[time, u, y]`` as read; return rows of output (``chunk (rows, 1 + nu + ny)``)."""
        if self.resumed_from is None:
            return self._taken(chunk)
        try:
            found = self._taken(chunk)
        except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError) as error:
            raise damaged_state(self.resumed_from) from error
        self.resumed_from = None
        return found

    def _taken(self, chunk: FloatArray) -> list[list[Any]]:
        if self.later is None:
            return self._shown(self.read(chunk))
        # What waits for a row is smoothed by it before the next one is taken.
        return self._shown(
            [ready for row in chunk for took in self.read(row[None]) for ready, *_ in self.later.take(took)]
        )

    def read(self, chunk: FloatArray) -> list[Row]:
        """Take rows ``[time, u, y]`` as read; return the estimates at them (``chunk (rows, 1 + nu + ny)``)."""
        return self.estimates(chunk[:, 0].tolist(), self.signals.deviations(chunk))

    def estimates(self, times: Sequence[float], values: FloatArray) -> list[Row]:
        """Return the estimates at rows as they come, deviations ``values (rows, nu + ny)``; those whose stamps do not
        rise are left out."""
        found, at = list[Row](), list[float]()
        complete = np.asarray(np.isfinite(values).all(axis=1))
        while (done := len(found)) < len(times):
            status = self.clock.stale(times[done])
            if status:
                found.append(Row(status, np.full(len(self.observer.columns), np.nan)))
                at.append(math.nan)
                continue
            if self.observer.takes_pieces and complete[done]:
                bad = np.flatnonzero(~complete[done : done + ROWS_AT_ONCE])
                end = done + (int(bad[0]) if bad.size else ROWS_AT_ONCE)
                intervals = self.clock.regular(times[done:end])
                own = [self.clock.at(time, -i) for i, time in enumerate(times[done : done + len(intervals)], 1)]
                taken = self.observer.take_piece(own, values[done:end], intervals) if intervals else []
                if taken:
                    self.clock.take(times[done : done + len(taken)], intervals[: len(taken)])
                    found += taken
                    at += own[: len(taken)]
                    continue
            found.append(self._single(times[done], values[done], self.rows + done + 1))
            at.append(self.clock.at(times[done]))
        if found and self.rows == 0:
            self.first.status = found[0].status
        self.rows += len(found)
        self.first.take(times, values)
        return [
            row._replace(time=time, deviations=v, at=own)
            for row, time, v, own in zip(found, times, values, at, strict=True)
        ]

    def _single(self, time: float, values: FloatArray, number: int) -> Row:
        """Take one row; one that is refused leaves nothing behind, so that a run may go on after it."""
        parts = (self.observer, self.clock)
        before = [dict(vars(part)) for part in parts]
        try:
            seconds, missing = self.clock.advance(time, number)
            missed = tuple(self._missed(time, missing)) if missing and self.observer.follows(missing) else ()
            if self.clock.dt > 0.0:
                missing -= len(missed)
                seconds = (missing + 1) * self.clock.dt
            own, longest = self.clock.at(time), self.clock.longest
            row = self.observer.take(own, values, seconds=seconds, missing=missing, longest=longest)
            return row._replace(missed=missed) if missed else row
        except ObsynthError as error:
            for part, kept in zip(parts, before, strict=True):
                vars(part).update(kept)
            place = f"row {number}"
            if isinstance(error, SpecError):
                if error.path == place:
                    raise
                error.path = place
            error.args = (f"Row {number}: {error}",)
            raise

    def _missed(self, time: float, missing: int) -> Iterator[Row]:
        """Take rows of a sampled design that are missing before one, as if they stood in the log without signals."""
        nothing = np.full(len(self.signals.names), np.nan)
        for before in range(missing, 0, -1):
            at = self.clock.at(time, before)
            row = self.observer.take(at, nothing, seconds=self.clock.dt, missing=0, longest=self.clock.longest)
            yield row._replace(time=time, deviations=nothing, at=at)

    def finish(self) -> list[list[Any]]:
        """Return the rows of output that waited for what does not come any more."""
        return [] if self.later is None else self._shown([ready for ready, *_ in self.later.flush()])

    def _shown(self, taken: Sequence[Row]) -> list[list[Any]]:
        if not taken:
            return []
        estimates = [row.values for row in taken]
        if self.recovered is not None:
            estimates = [np.concatenate([row.values, self._recovered_in(row)]) for row in taken]
        self.statuses.update(row.status for row in taken)
        self.repeated.take(np.array([self._outputs_of(row) for row in taken]))
        shown: list[list[float]] = (np.array(estimates) + self._point).tolist()
        rows: list[list[Any]] = [
            [row.time, row.status, *(row.time - lag for lag in self._lags), *cells]
            for row, cells in zip(taken, shown, strict=True)
        ]
        if self._levels or self.monitor is not None:
            first = self.rows - len(rows) + 1
            for number, (row, values, cells) in enumerate(zip(taken, estimates, rows, strict=True), first):
                cells.extend(self._decided(row, values, number, cells))
        return rows

    def _outputs_of(self, row: Row) -> FloatArray:
        """Return what was measured of the outputs ``(ny,)``, nothing in a row that is left out."""
        count = len(self.observer.output_names)
        if row.deviations is None or row.status in STALE:
            return np.full(count, np.nan)
        return row.deviations[len(row.deviations) - count :]

    def _recovered_in(self, row: Row) -> FloatArray:
        if self.recovered is None or row.status in STALE:
            return np.full(0 if self.recovered is None else len(self.recovered.columns), np.nan)
        for missed in row.missed:
            self.recovered.take(missed)
        return self.recovered.take(row)

    def _decided(self, row: Row, values: FloatArray, number: int, before: Sequence[Any]) -> list[Any]:
        """Return statistic and threshold, if there is a monitor, and what alarms there are; ``before``: other cells."""
        time = row.time
        if row.status in STALE:
            self.events.silent[row.status] += 1
            return [*([math.nan] * (0 if self.monitor is None else len(self.monitor.columns) + 2)), ""]
        self.events.advance(row.skipped + len(row.missed))
        deciding = row.status in DECIDING
        above = [
            (name, abs(float(values[i])) / grown)
            for name, i, level in self._levels
            if math.isfinite(grown := level * self._share(row, i) + self._excess(row, i))
        ]
        passed = [(name, evidence) for name, evidence in above if evidence > 1.0]
        names = [name for name, _ in passed]
        for name in names:
            self.alarms.setdefault(name, time)
            self.alarm_rows.setdefault(name, number)
        cells: list[Any] = []
        undecided = not deciding and not above
        if self.monitor is not None:
            for missed in row.missed:
                self._watching, _ = self.monitor.step(self._watching, self._sample(self.monitor, missed))
            self._watching, seen = self.monitor.step(self._watching, self._sample(self.monitor, row))
            more = seen.more or (math.nan,) * len(self.monitor.columns)
            cells = [*(np.array(more) + self._shifts).tolist(), seen.statistic, seen.threshold]
            undecided = math.isnan(seen.statistic) and (undecided or not self._levels)
            if seen.alarm:
                evidence = seen.statistic / seen.threshold if seen.threshold else math.inf
                kind, known = self.monitor.kind, bool(seen.fault) or not self.monitor.fault_names
                self.events.take(kind, seen.fault, evidence, time, number, [*before, *cells], distinguished=known)
                self.alarms.setdefault(self.monitor.kind, time)
                self.isolated = self.isolated or seen.fault
                self.alarm_rows.setdefault(self.monitor.kind, number)
                names.append(f"{self.monitor.kind}: {seen.fault}" if seen.fault else self.monitor.kind)
        for name, evidence in passed:
            fault = name[5:-1] if name.startswith("fhat[") else ""
            self.events.take(name, fault, evidence, time, number, [*before, *cells])
        if undecided:
            self.events.silent[row.status if row.status not in DECIDING else NO_DECISION] += 1
        return [*cells, "; ".join(names)]

    def _sample(self, monitor: Monitor, row: Row) -> Sample:
        """Return what a monitor takes of a row."""
        deciding = row.status in DECIDING and (row.settled or not monitor.guarantees)
        if monitor.rule.bridges and row.bridged:
            deciding = row.status in (*DECIDING, RECOVERING)
        residuals, faults = row.values[self._residuals], row.values[self._faults]
        return Sample(row.at, residuals, faults, self._evidence(row), deciding, row.skipped, row.bridged)

    def _share(self, row: Row, column: int) -> float:
        """Return by how many times a level is higher than stated: as less certain as a fault estimate is."""
        place = column - self._faults.start
        return 1.0 if row.unsure is None or not 0 <= place < len(row.unsure) else float(row.unsure[place])

    def _excess(self, row: Row, column: int) -> float:
        """Return by how much more than its level a column must be for an alarm: infinite where nothing is decided."""
        if row.status in DECIDING:
            return 0.0
        if row.status != RECOVERING or row.excess is None or column >= len(row.excess):
            return math.inf
        return float(row.excess[column])

    def _evidence(self, row: Row) -> Any:
        """Return what was learnt from a row; of one with missing samples, to who takes these, what there is."""
        if row.evidence is not None or self.monitor is None or not self.monitor.rule.takes_gaps:
            return row.evidence
        nu, deviations = len(self.observer.input_names), row.deviations
        if deviations is None:
            return None
        return LinearSample(row.values, deviations[:nu], deviations[nu:], len(self.observer.state_names))

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {
            "observer": self.observer.as_dict(),
            "clock": self.clock.as_dict(),
            "recovered": None if self.recovered is None else self.recovered.as_dict(),
            "inputs": None if self.stamps is None else self.stamps.earlier,
            "numeric": None if self.stamps is None else sorted(self.stamps.numeric),
            "monitor": None if self.monitor is None else self.monitor.as_data(self._watching),
        }

    def resume(self, data: dict[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        if (data["monitor"] is None) != (self.monitor is None):
            raise SpecError("The saved state is of a run with another monitor: use the same options.", path="state")
        self.observer.resume(data["observer"])
        self.clock.resume(data["clock"])
        if self.stamps is not None:
            self.stamps.earlier, self.stamps.numeric = data["inputs"], set(data["numeric"])
        if self.recovered is not None:
            self.recovered.resume(data["recovered"])
        if self.monitor is not None:
            self._watching = self.monitor.from_data(data["monitor"])


RUN_STATE_KIND = "obsynth run state"
RUN_STATE_VERSION = 12
STATE = FileKind("a saved state of obsynth", rb'\A\s*\{\s*"kind":\s*"obsynth run state"', suffix=".json")
#: Parts that are seconds, or nothing before the first row.
_TIME_PARTS = frozenset({"last", "longest"})


def save_state(path: Path, run: LogRun, digest: str) -> None:
    """Write what a run carries from row to row, atomically."""
    body = plain({"gains": digest, "state": run.as_dict()})
    write_atomically(path, sealed(RUN_STATE_KIND, RUN_STATE_VERSION, body, under="run"))


def resume_state(path: Path, run: LogRun, digest: str) -> None:
    """Let a run go on from a saved state."""
    # The state is written again at the end, so it is no input that has to be kept.
    document = read_json(path, is_protected=False)
    known = isinstance(document, dict) and document.get("kind") == RUN_STATE_KIND
    if not known or document.get("schema_version") != RUN_STATE_VERSION:
        raise SpecError(f"{path} is no saved state of a run.", path=str(path))
    body = document.get("run")
    try:
        intact = isinstance(body, dict) and document.get("sha256") == digest_of(body)
    except (ValueError, RecursionError):  # a number too large for a float
        intact = False
    if not intact:
        raise SpecError(f"{path} was changed after it was written: its digest does not match.", path=str(path))
    if body.get("gains") != digest:
        raise SpecError(f"{path} is the state of a run with another gain set.", path=str(path))
    own = run.as_dict()
    try:
        state = restored(body.get("state"))
        run.resume(state)
        fits = _fits(own, state)
    except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError):
        fits = False
    if not fits:
        raise damaged_state(path)
    run.resumed_from = path


def _fits(own: Any, saved: Any) -> bool:
    """Whether a saved state has the parts of a run's own one; what has no value yet may hold numbers and arrays."""
    if isinstance(own, np.ndarray):
        found = saved.get(BY_COLUMNS) if isinstance(saved, dict) else saved
        return isinstance(found, np.ndarray) and _alike(own.shape, found.shape)
    if isinstance(own, Mapping):
        if not isinstance(saved, dict) or saved.keys() != own.keys():
            return False
        return all(
            _fits(own[key], saved[key])
            and (key not in _TIME_PARTS or saved[key] is None or is_finite_number(saved[key]))
            for key in own
        )
    if isinstance(own, (bool, np.bool_)):
        return isinstance(saved, bool)
    if isinstance(own, str):
        return isinstance(saved, str)
    if isinstance(own, (list, tuple)):
        return isinstance(saved, list)
    return saved is None or is_number(saved) or (own is None and isinstance(saved, (np.ndarray, dict, list)))


def _alike(own: tuple[int, ...], saved: tuple[int, ...]) -> bool:
    """Whether an array can stand for another one: windows fill up, and factors of covariances change their width."""
    if len(own) == 2 and len(saved) == 2:
        return own[0] == saved[0] or own[1] == saved[1]
    return own == saved


def faults_on_rows(design: ObserverDesign, times: FloatArray, u: FloatArray, y: FloatArray) -> FloatArray:
    """Return fault estimates ``(rows, nf)`` on rows of a log, as `run_on_data` has them; NaN where there is none."""
    run = LogRun(design)
    first = len(run.observer.state_names)
    rows = run.estimates(times.tolist(), np.hstack([u, y]))
    return np.array([row.values[first : first + len(run.observer.fault_names)] for row in rows])


#: A table that a run on measured data has written, as CSV or as Parquet.
ESTIMATES = FileKind("a table of estimates of obsynth", rb"\Atime,status,|\APAR1(?s:.*)status(?s:.*)hat\[")
#: Columns of a table that hold text.
TEXT_COLUMNS = ("status", "alarm")


def time_columns(header: Sequence[str]) -> tuple[int, ...]:
    """Return which columns hold times."""
    return tuple(i for i, name in enumerate(header) if name == TIME_HEADER or name.startswith(f"{TIME_HEADER} of "))


def dated(rows: Sequence[Sequence[Any]], places: Sequence[int], shown: Callable[[float], Any]) -> list[list[Any]]:
    """Return rows in which the times are dates."""
    found = [list(row) for row in rows]
    for row in found:
        for place in places:
            row[place] = shown(row[place])
    return found


#: Takes rows of cells: texts, and numbers of which NaN is an empty cell.
Sink: TypeAlias = Callable[[Sequence[Sequence[Any]]], None]


def text_sink(stream: TextIO, header: Sequence[str], stamps: Stamps) -> Sink:
    """Return what writes CSV to a text stream, flushed after each call; floats so that they are read back bit for bit,
    and dates as such."""
    write_rows, times = table_writer(stream, header), time_columns(header)
    # Who reads a stream may wait for the header before a row is sent.
    stream.flush()

    def write(rows: Sequence[Sequence[Any]]) -> None:
        write_rows(dated(rows, times, stamps.date) if stamps.is_dated else rows)
        stream.flush()

    return write


class FrameSink:
    """A sink whose rows come to a data frame, in which dates stay dates.

    Numbers stand where the frame will have them, room for ``rows`` at first: parts that are joined in the end would be
    there twice."""

    def __init__(self, header: Sequence[str], stamps: Stamps, rows: int) -> None:
        self._header, self._stamps, self._count = list(header), stamps, 0
        self._times = frozenset(time_columns(header))
        self._numbers = [np.empty(rows) for _ in header]
        self._others: list[list[Any]] = [[] for _ in header]

    def __call__(self, rows: Sequence[Sequence[Any]]) -> None:
        """Keep rows."""
        self.keep(zip(*rows, strict=True), len(rows))

    def keep(self, columns: Iterable[Any], count: int) -> None:
        """Keep so many rows, which are given as columns."""
        end = self._count + count
        for place, cells in enumerate(columns):
            if self._header[place] in TEXT_COLUMNS:
                self._others[place].extend(cells)
            elif self._stamps.is_dated and place in self._times:
                self._others[place].extend(map(self._stamps.moment, cells))
            else:
                numbers = self._numbers[place]
                if end > len(numbers):
                    self._numbers[place] = numbers = np.concatenate([numbers, np.empty(end)])
                numbers[self._count : end] = cells
        self._count = end

    def frame(self) -> pd.DataFrame:
        """Return the data frame."""
        import pandas as pd

        if not self._count:
            return pd.DataFrame([], columns=self._header)
        columns = zip(self._header, self._others, self._numbers, strict=True)
        found = [pd.Series(others or kept[: self._count], name=name, copy=False) for name, others, kept in columns]
        frame = pd.DataFrame(dict(enumerate(found)), copy=False)
        frame.columns = pd.Index(self._header)
        return frame


@contextmanager
def parquet_sink(path: str, header: Sequence[str]) -> Iterator[Sink]:
    """Give what writes a Parquet file, one row group for each call."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema([(name, pa.string() if name in TEXT_COLUMNS else pa.float64()) for name in header])
    with pq.ParquetWriter(path, schema) as writer:

        def write(rows: Sequence[Sequence[Any]]) -> None:
            if rows:
                columns = zip(zip(*rows, strict=True), schema, strict=True)
                arrays = [pa.array(list(cells), field.type) for cells, field in columns]
                writer.write_table(pa.Table.from_arrays(arrays, schema=schema))

        yield write


@contextmanager
def sink_for(out: str | Path | TextIO, header: Sequence[str], stamps: Stamps) -> Iterator[Sink]:
    """Give a sink for a stream, or for a file that replaces ``out`` when all went well, and not at all else.
    In a Parquet file times are seconds, since 1970 where the log has dates."""
    if not isinstance(out, str | Path):
        yield text_sink(out, header, stamps)
        return
    path = Path(out)
    check_suffix(path)
    with replacement_of(path) as (handle, temporary):
        if path.suffix.lower() == ".parquet":
            os.close(handle)
            with parquet_sink(temporary, header) as sink:
                yield sink
        else:
            with os.fdopen(handle, "w", encoding="utf-8", newline="") as stream:
                yield text_sink(stream, header, stamps)


#: Rows of a stream after which its state is saved.
STATE_ROWS = 100


@dataclass(frozen=True, eq=False)
class DataRun:
    """What a run on measured data was.

    Parameters
    ----------
    rows : int
        Rows of data.
    statuses : mapping of str to int
        How many rows were ``ok``, ``warm-up``, ``partial``, ``gap``, ``recovering``, ``repeated stamp`` and
        ``out of order``.
    alarms : mapping of str to float
        Time in seconds at which each column, or the monitor, first passed its threshold.
    isolated : str
        The fault that the monitor named first; empty without one, and where the evidence does not distinguish faults.
    recovered : mapping of str to str
        States of the plant as written that were recovered from the estimates, and what each of these estimates is:
        ``exact``, ``needs the fault estimate`` (it is used) or ``biased by the disturbance``.
    outliers : mapping of str to int
        How many samples of each output were left out, or pulled to their limit; recursive and nonlinear designs.
    warnings : tuple of str
        What a user should know about the data.
    digest : str
        sha256 of the gain set.
    table : pandas.DataFrame or None
        The estimates, when they were not written anywhere.
    measured : pandas.DataFrame or None
        Time and the signals that were read, in their units, beside that table.
    stamps : Stamps
        Whether the log has seconds, or dates and times: ``stamps.shown(time)`` is a time as the log writes it.
    thresholds : mapping of str to float
        Those that were given.
    alarm_rows : mapping of str to int
        Numbers of the rows of these alarms, from 1.
    events : tuple of AlarmEvent
        All alarms: from when to when, which fault, how large.  Rows above a threshold that are less than 20 rows apart,
        those that are missing among them, are one.
    silent : mapping of str to int
        How many rows were without a decision, by their status; ``undecided`` where the monitor decides nothing.
    statement : str
        What the threshold of its monitor promises, and what that rests on; empty without one.
    stuck : mapping of str to tuple of (int, int)
        First and last rows, from 1, in which an output repeats one value for longer than it otherwise does.
    """

    rows: int
    statuses: Mapping[str, int]
    alarms: Mapping[str, float]
    isolated: str
    recovered: Mapping[str, str]
    outliers: Mapping[str, int]
    warnings: tuple[str, ...]
    digest: str
    table: pd.DataFrame | None = field(default=None, repr=False)
    measured: pd.DataFrame | None = field(default=None, repr=False)
    stamps: Stamps = field(default_factory=Stamps, repr=False)
    thresholds: Mapping[str, float] = field(default_factory=dict, repr=False)
    alarm_rows: Mapping[str, int] = field(default_factory=dict)
    events: tuple[AlarmEvent, ...] = ()
    silent: Mapping[str, int] = field(default_factory=dict)
    statement: str = ""
    stuck: Mapping[str, tuple[tuple[int, int], ...]] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return the summary as plain data, without the table."""
        return {
            "rows": self.rows,
            "statuses": dict(self.statuses),
            "alarms": dict(self.alarms),
            "alarm_rows": dict(self.alarm_rows),
            "alarm_stamps": {name: self.stamps.shown(time) for name, time in self.alarms.items()},
            "events": [event.as_dict() for event in self.events],
            "silent": dict(self.silent),
            "isolated": self.isolated,
            "recovered": dict(self.recovered),
            "outliers": dict(self.outliers),
            "stuck": {name: [list(run) for run in runs] for name, runs in self.stuck.items()},
            "warnings": list(self.warnings),
            "gains_sha256": self.digest,
        }


@arguments_checked
def run_on_data(
    design: ObserverDesign,
    data: Data,
    out: str | Path | TextIO | None = None,
    *,
    columns: Mapping[str, str] | None = None,
    time_column: str | None = None,
    scales: Mapping[str, float] | None = None,
    thresholds: Mapping[str, float] | None = None,
    monitor: Monitor | None = None,
    gap: float | None = None,
    warm_up: float | None = None,
    outliers: str | None = None,
    smooth: bool = False,
    lag: int | None = None,
    recovered: str | Sequence[str] | None = None,
    state: str | Path | None = None,
    state_every: int = STATE_ROWS,
    chunk_rows: int = CHUNK_ROWS,
    progress: Callable[[int], None] | None = None,
) -> DataRun:
    """Run a design on measured data, in constant memory.

    Each row of data gives one row of estimates.  The operating point is subtracted from the data and added back to
    the estimates.  An estimate with a delay has a column ``time of ...`` with the time that it is for.  If the design
    is for a plant whose algebraic states were eliminated, these are recovered and have columns as well.

    Parameters
    ----------
    design : ObserverDesign
        Of any method.
    data : path, text stream or pandas.DataFrame
        With a column ``time`` and a column for each known input and output.  Files are text (``.csv``, ``.tsv``),
        Parquet, TDMS or MDF (``.mf4``, ``.mdf``, ``.dat``) by their suffix; a stream is text and is answered row by
        row.  Columns of text are separated by commas, semicolons, tabs or bars, and numbers may have a decimal comma
        where commas separate nothing.  The time is in seconds, or dates and times of ISO 8601 with or without a zone
        (taken as UTC without one), which are written back as such; the index of a frame is the time where it is a
        DatetimeIndex.
    out : path or text stream, optional
        CSV or Parquet file, written whole or not at all; or a stream for CSV.  By default a data frame is returned.
    columns : mapping, optional
        Column of a signal (or of ``time``) where their names differ.
    time_column : str, optional
        Column of the time, the same as ``columns={"time": ...}``.
    scales : mapping, optional, signal's unit per column's unit
        Factor of a signal's column; by default the plant's.
    thresholds : mapping, optional
        Level of the absolute value by column of the output, such as ``fhat[actuator]`` or ``r[speed]`` (of faults
        with an operating point, of the deviation): the column ``alarm`` names those above their level.  Alarms are
        suspended in rows that are not ``ok`` or ``partial``; while the stated deviation of a fault estimate is above
        that before samples were missing, its level is as many times higher.
    monitor : Monitor, optional
        From `obsynth.online_monitor`: columns ``statistic`` and ``threshold``, and its alarms in ``alarm``, with the
        fault that it points to.
    gap : float, optional, seconds
        Continuous-time designs: longer intervals are gaps; by default those ten times the longest one before.
    warm_up : float, optional, seconds
        After the start, and after gaps at most; by default until the slowest mode has shrunk to 2 %, and none for
        recursive and nonlinear designs, whose deviations hold from the start.
    outliers : {"gate", "huber", "none"}, optional
        Recursive and nonlinear designs: what is done with a sample that its prediction excludes; by default what the
        design says, and a gate of six deviations where it says nothing.
    smooth : bool, optional
        Recursive and nonlinear designs: estimates from the whole log, as `obsynth.smooth` makes them, instead of those
        of the filter.  Residuals, outliers, monitors and statuses stay those of the filter.  All rows are written at
        the end, and the log is held in memory.
    lag : int, optional
        The same with the ``lag`` samples after each row; each row is written, with its own time, when they are there.
    recovered : {"all", "none"} or list of str, optional
        Which states of the plant as written, before its algebraic states were eliminated, stand beside the estimates;
        by default all of up to 300, and none of more.
    state : path, optional
        A saved state to go on from, if the file exists; the state at the end is written to it.
    state_every : int, optional
        Rows of a stream after which the state is written anew, whole or not at all: so many are lost at most when the
        process is killed.
    chunk_rows : int, optional
        Rows that are read and written at a time; the results do not depend on it.
    progress : callable, optional
        Called with the number of rows done, after each chunk.

    Returns
    -------
    DataRun
        A summary, with the estimates if ``out`` is not given.

    Raises
    ------
    SpecError
        Columns are missing, a cell is no number, a time is missing, repeated, decreasing or
        does not fit the design's dt (the row is named), or a file cannot be read or written.

    Notes
    -----
    Continuous-time observers are advanced from row to row by a first-order hold over the interval as it is: exact for
    signals that are linear between rows.  In a row with a missing sample, and in a gap, the outputs of the plant model
    (faults held at their last estimate, unknown inputs zero, started from the last state estimate) stand in for the
    measured ones, so that the observer's state follows the model's; fault estimates are held, residuals are empty and
    the status is ``gap``.  The observer starts again after a gap of more than 10,000 samples, where the model has lost
    the plant (it misses the outputs by more than their size before and after the gap, as an unstable one will in the
    end, and by more than becomes usual within a warm-up), and after every gap of a plant of index 2 or more, whose
    model cannot be propagated.  Intervals are rounded to the resolution of the time stamps.

    Recursive and nonlinear designs take missing outputs themselves, with what they cost in the columns ``sd ...``
    (standard deviations): a row without some outputs is ``partial``, one without all of them, or without an input, is a
    ``gap``.  The first row is k = 0, of which recursive designs do not use the outputs.  Missing inputs are held,
    within the largest changes that they have made before, by which deviations grow; the rows after that are
    ``recovering`` until the warm-up is over.  ``r`` is the innovation at the parameters estimated one sample before
    (whitened, for recursive designs).
    """
    whole_number(chunk_rows, "chunk_rows")
    whole_number(state_every, "state_every")
    _require_files(state=state, out=out, data=data)
    if time_column is not None:
        columns = {**(columns or {}), TIME_HEADER: time_column}
    stamps = Stamps()
    run = LogRun(
        design,
        columns,
        scales,
        gap=gap,
        warm_up=warm_up,
        outliers=outliers,
        thresholds=thresholds or {},
        monitor=monitor,
        recovered=recovered,
        stamps=stamps,
    )
    _smoothed(run, data, smooth=smooth, lag=lag, state=state)
    digest = gain_set_digest(design)
    resumed = state is not None and Path(state).exists()
    if resumed:
        resume_state(Path(str(state)), run, digest)
    room = len(data) if isinstance(data, Sized) and not isinstance(data, str) else CHUNK_ROWS
    kept = FrameSink((TIME_HEADER, *run.signals.names), stamps, room) if out is None else None
    # What has left a stream cannot be taken back: there the state is saved however the run ends.
    save = None
    if not (state is None or out is None or isinstance(out, str | Path)):
        save = partial(save_state, Path(state), run, digest)
    rows = chunks(data, run.signals, stamps, chunk_rows)
    if not hasattr(data, "readline"):
        # What cannot be read leaves no header behind; of a stream the header comes before the first row.
        rows = chain(list(islice(rows, 1)), rows)
    gathered = FrameSink(run.header, stamps, room)
    for file in (out, state):
        if isinstance(file, str | Path):
            remove_left_parts(Path(file))
    with nullcontext(gathered) if out is None else sink_for(out, run.header, stamps) as sink:
        _run_rows(run, rows, sink, kept, save, progress or bool, state_every)
        if state is None and not hasattr(data, "readline"):
            _require_a_window(design, run.rows)
    if state is not None:
        save_state(Path(state), run, digest)
    table = gathered.frame() if out is None else None
    shown = {} if run.recovered is None else dict(run.recovered.flags)
    found = zip(run.observer.output_names, run.repeated.stuck(), strict=True)
    stuck = {name: tuple((first + 1, last + 1) for first, last in runs) for name, runs in found if runs}
    start = () if resumed else run.first.alarm_of_the_start(design, run.events.events())
    return DataRun(
        run.rows,
        dict(run.statuses),
        dict(run.alarms),
        run.isolated,
        shown,
        dict(getattr(run.observer, "outliers", {})),
        (*run.observer.notes, *stamps.warnings(), *run.first.warnings(), *start, *stuck_texts(stuck)),
        digest,
        table,
        None if kept is None else kept.frame(),
        stamps,
        dict(thresholds or {}),
        dict(run.alarm_rows),
        run.events.events(),
        dict(run.events.silent),
        "" if monitor is None else monitor.statement,
        stuck,
    )


def _require_files(*, state: Any, out: Any, data: object) -> None:
    """Refuse files of `run_on_data` that are one, or cannot be written."""
    if out is not None and not hasattr(out, "write"):
        require_kind(out, (str, Path), "out", "the name of a file, or a text stream")
    require_distinct(
        {
            "state": state,
            "data": data if isinstance(data, str | Path) else None,
            "out": out if isinstance(out, str | Path) else None,
        }
    )
    if state is not None:
        check_output(state)


def _require_a_window(design: ObserverDesign, rows: int) -> None:
    """Raise `SpecError` where a log is shorter than the window of a guaranteed test, which then says nothing of it."""
    if not is_guaranteed(design):
        return
    needed = max(map(rows_before, GuaranteedTest.of(design).tests)) + 1
    if rows < needed:
        raise SpecError(
            f"The log has {rows} rows, but a window of {design.name!r} has {needed} samples: none of them has a "
            "verdict. Design the test with fewer samples.",
            path="samples",
        )


def _smoothed(run: LogRun, data: Data, *, smooth: bool, lag: int | None, state: str | Path | None) -> None:
    """Let rows wait for those after them, if they shall."""
    if not smooth and lag is None:
        return
    if smooth and lag is not None:
        raise SpecError("smooth takes the whole record, and lag some samples of it: give one of them.", path="lag")
    if smooth and hasattr(data, "readline"):
        raise SpecError("A stream has no end to smooth from: give a lag, or the log as a file.", path="smooth")
    if smooth and state is not None:
        raise SpecError(
            "smooth needs the whole record, but a saved state continues a part of it: give a lag, or "
            "leave the state out.",
            path="smooth",
        )
    run.later = LaterRows(run.observer, lag)


def _run_rows(
    run: LogRun,
    rows: Iterator[FloatArray],
    sink: Sink,
    kept: FrameSink | None,
    save: Callable[[], None] | None,
    progress: Callable[[int], object],
    state_every: int = STATE_ROWS,
) -> None:
    """Run over all rows: in chunks, or one by one where the state is to be saved after a stream."""
    held, is_whole = HeldSignals(), True
    if save is None:
        for chunk in rows:
            if kept is not None:
                kept.keep([chunk[:, 0].tolist(), *run.signals.measured(chunk).T], len(chunk))
            sink(run.take(chunk))
            progress(run.rows)
        sink(run.finish())
        return
    with ending_signals(), held.installed():
        try:
            for chunk in rows:
                for row in chunk:
                    with held:
                        is_whole = False
                        found = run.take(row[None])
                        is_whole = True
                        sink(found)
                        if run.rows % state_every == 0:
                            save()
                progress(run.rows)
        except ObsynthError:
            # A refused row has changed nothing.
            is_whole = True
            raise
        finally:
            if is_whole and run.rows:
                save()
                sink(run.finish())


class LaterRows:
    """Rows of a log that wait ``lag`` samples for those after them; ``None``: until the end."""

    def __init__(self, observer: LogObserver, lag: int | None) -> None:
        if not isinstance(observer, SteppingLogObserver):
            raise SpecError(
                "Smoothing is for recursive and nonlinear designs, whose covariances relate later samples to earlier "
                "ones: design a descriptor-kalman, adaptive-observer or dae-adaptive-observer.",
                path="smooth",
            )
        self.logged, self.lag = observer, checked_lag(lag)
        self.chain = observer.chain = Chain(links_of(observer.observer))
        #: With the sample of the chain that each is.
        self.waiting = list[tuple[Row, int]]()

    def take(self, row: Row) -> Iterator[tuple[Row, Any, Smoothed]]:
        """Take a row after its step; yield those that are smoothed now, with what the observer said of them."""
        if self.logged.chain is not None and self.logged.chain is not self.chain:
            # The observer has started again: what comes says nothing of what was.
            yield from self.flush()
            self.chain = self.logged.chain
        chain = self.chain
        self.waiting.append((row, chain.last))
        if self.lag is None:
            return
        while (k := self.waiting[0][1]) + self.lag <= chain.last:
            yield self._shown(*self.waiting.pop(0), chain.smoothed(k, k + self.lag)[0])
        # A late value changes what is known since its own time.
        chain.drop_before(min(k, chain.last - self.logged.observer.timing.longest))

    def flush(self) -> Iterator[tuple[Row, Any, Smoothed]]:
        """Yield the rows that wait, smoothed by as many samples as there are."""
        waiting, self.waiting = self.waiting, []
        if not waiting:
            return
        first = waiting[0][1]
        found = self.chain.smoothed(first, waiting[-1][1])
        for row, k in waiting:
            yield self._shown(row, k, found[k - first])

    def _shown(self, row: Row, k: int, found: Smoothed) -> tuple[Row, Any, Smoothed]:
        nx = len(self.logged.state_names)
        if row.status in STALE:
            return row, self.chain.row(k), found
        theta, spread = parameters_of(found, nx)
        own = (
            found.x[:nx],
            theta,
            deviations_in(found.factor, found.diffuse)[:nx],
            np.sqrt(np.einsum("ij,ij->i", spread, spread)),
        )
        estimated = np.concatenate(own)
        values = np.concatenate((estimated, row.values[len(estimated) :]))
        return row._replace(values=values), self.chain.row(k), found


@arguments_checked
def smooth(
    design: ObserverDesign,
    data: Any,
    u: ArrayLike | None = None,
    *,
    lag: int | None = None,
    columns: Mapping[str, str] | None = None,
    time_column: str | None = None,
    scales: Mapping[str, float] | None = None,
    outliers: str | None = None,
) -> Estimates:
    r"""Estimate each sample of a record from those after it as well.

    A filter knows the past; a log is mostly read afterwards.  With ``x_k = m_k + F_k c_k``, where ``F_k F_k'`` is the
    filter's covariance and ``c_k ~ N(0, I)``, the orthogonal factorisations of a step give ``c_k`` from ``c_{k+1}``:

    .. math::
        c_k = j_k + J_k c_{k+1} + N_k b, \quad b \sim N(0, I)

    so that what is known in the end is carried back by products alone.  Smoothed deviations are never above those of
    the filter.

    Parameters
    ----------
    design : ObserverDesign
        Of the methods ``descriptor-kalman``, ``adaptive-observer`` or ``dae-adaptive-observer``.
    data : array_like, tuple of two arrays, path, text stream or pandas.DataFrame
        Outputs ``(samples, ny)``, NaN where a sample is missing, or outputs and inputs; or a log as `run_on_data`
        takes it, in the signals' units.
    u : array_like, optional
        Known inputs ``(samples, nu)`` beside an array of outputs.
    lag : int, optional
        Samples that are waited for: the estimate at k is the one from samples up to ``k + lag`` (as many as there are,
        at the end).  By default the whole record.
    columns, time_column, scales : optional
        Of a log, as `run_on_data` takes them.
    outliers : {"gate", "huber", "none"}, optional
        What is done with a sample that its prediction excludes; by default what the design says, and for logs a gate
        where it says nothing.  The smoother takes what the filter took.

    Returns
    -------
    Estimates
        One row per sample (of a log: per row of it, with the operating point added back).  States, parameters and their
        deviations are smoothed; innovations and what belongs to them are the filter's.

    Raises
    ------
    SpecError
        The design is of another method, shapes do not fit, ``lag`` is no positive number, or the whole record of a
        stream is asked for; a log has irregular time stamps (the row is named).
    PreconditionError
        Form ``literal``, whose residuals are correlated in time; rank H_k is lost at some k.

    Notes
    -----
    Rauch, Tung and Striebel need the inverse of the predicted covariance; here nothing is inverted but triangles, so
    that E, Q, R and P_0 may be singular.  States that missing samples leave undetermined keep infinite deviations only
    if nothing later determines them.

    Parameters: as states where they walk.  Forms with a forgetting factor lambda weigh samples before and after k by
    ``lambda ** |j - k|``, with the covariance that this estimate has while the parameters are constant; for
    ``lambda = 1`` it is the least-squares estimate from the whole record.  Behind a reset nothing is carried.

    Nonlinear designs are linearised along the filter's estimates (the extended smoother), which is exact for linear
    plants; forms ``random-walk`` and ``augmented-kalman`` take states and parameters together.  Bounds of parameters
    cut the estimates, bounds of states project them, and both leave covariances as they are.

    References
    ----------
    .. [RauchTungStriebel1965] Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3 (8), 1445-1450.
    .. [Paige1977] Paige, Saunders, Least squares estimation of discrete linear dynamic systems using orthogonal
       transformations, SIAM Journal on Numerical Analysis 14 (2), 180-193: the square-root form; ours keeps the way
       back of each step instead of one large factorisation, and lets E be singular.
    """
    waited = checked_lag(lag)
    if isinstance(design.observer, LinearObserver):
        # The same refusal as on logs.
        LaterRows(LogRun(design).observer, waited)
    if isinstance(data, str) or any(hasattr(data, name) for name in ("__fspath__", "readline", "columns")):
        if u is not None:
            raise SpecError("u is for arrays: a log has the inputs in its columns.", path="u")
        if waited is None and hasattr(data, "readline"):
            raise SpecError("A stream has no end: give a lag, or the whole log as a file.", path="lag")
        if time_column is not None:
            columns = {**(columns or {}), TIME_HEADER: time_column}
        return _smoothed_log(LogRun(design, columns, scales, outliers=outliers), data, waited)
    if columns or scales or time_column:
        raise SpecError(
            "columns, time_column and scales are for logs: arrays have their signals in order.", path="columns"
        )
    observer: Any = design.observer
    if outliers is not None:
        observer = changed(observer, outliers=outliers)
    if isinstance(data, tuple) and len(data) == 2 and u is None and np.ndim(data[0]) == 2:
        data, u = data
    return smoothed_record(observer, data, u, waited)


def _smoothed_log(run: LogRun, data: Any, lag: int | None) -> Estimates:
    later = LaterRows(run.observer, lag)
    found: list[tuple[Row, Any, Smoothed]] = []
    for time, deviations in samples(data, run.signals):
        found.extend(later.take(run.estimates([time], deviations[None])[0]))
    found.extend(later.flush())
    known = smoothed_estimates(later.logged.observer, [row for _, row, _ in found], [sample for _, _, sample in found])
    point = run.signals.estimates_point(run.observer)
    nx, nq = len(run.observer.state_names), len(run.observer.fault_names)
    return replace(
        known, states=read_only(known.states + point[:nx]), faults=read_only(known.faults + point[nx : nx + nq])
    )
