"""A run over a log: from rows of data to rows of output, with alarms, counts and a state that can be saved."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import ObsynthError, SpecError
from obsynth.monitoring.alarms.events import NO_DECISION, SHELVED, AlarmLog
from obsynth.monitoring.logs.clock import STALE, Clock, StampError
from obsynth.monitoring.logs.log_observer import DECIDING, RECOVERING, Row
from obsynth.monitoring.logs.observer_of_design import log_observer
from obsynth.monitoring.logs.operating_point import OperatingPointCheck
from obsynth.monitoring.logs.recovered_states import RecoveredStates
from obsynth.monitoring.logs.signals import TIME_HEADER, LogSignals
from obsynth.monitoring.logs.stamps import Stamps
from obsynth.monitoring.logs.stuck_sensors import STUCK_ALARM_ROWS, RepeatedValues, Unrepeated, rising
from obsynth.monitoring.logs.unit_check import UnitCheck
from obsynth.monitoring.thresholds.learned import logs_that_do
from obsynth.monitoring.thresholds.learned_ranges import RowsBeyond
from obsynth.monitoring.thresholds.learned_rule import LearnedRule
from obsynth.monitoring.thresholds.monitor import LinearSample, Monitor, Sample
from obsynth.monitoring.thresholds.watched_columns import as_learned
from obsynth.numerics.arguments import real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.suggestions import suggestion
from obsynth.results.design import ObserverDesign

#: Name of the alarm of a stuck sensor, before the name of its output.
STUCK_SENSOR = "stuck sensor"

#: Name in the column with the time of recovered states, if they lag.
LATE = "recovered states"

#: Largest number of rows that are processed together.
ROWS_AT_ONCE = 4096


def damaged_state(path: Path) -> SpecError:
    """Return the error for a saved state whose parts do not fit."""
    return SpecError(f"{path} is damaged: it is no state of this design and these options.", path=str(path))


class LogRun:
    """A design over a log, from its start: rows of data to estimates (`read`), and to rows of output (`take`).

    ``thresholds`` are levels by column; ``recovered`` selects states of the original plant that are returned as well;
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
        units_as_is: bool = True,
    ) -> None:
        #: For learned thresholds: removes the samples of sensors that may be stuck.
        self.unrepeated: Unrepeated | None = None
        #: For learned thresholds: records rows with inputs and outputs beyond their learned ranges.
        self.beyond: RowsBeyond | None = None
        if monitor is not None and isinstance(monitor.rule, LearnedRule):
            learned = monitor.rule.learned
            design = design.replace(observer=as_learned(design.observer, learned))
            self.unrepeated = None if learned.repeats is None else Unrepeated(learned.repeats)
            self.beyond = None if learned.ranges is None else RowsBeyond(learned.ranges)
        self.observer = observer = log_observer(design, gap=gap, warm_up=warm_up, outliers=outliers)
        self.clock = Clock(observer.dt, gap, irregular=observer.takes_any_interval, why=observer.own_intervals_only)
        self.signals = LogSignals.of(observer, columns, scales, getattr(design.plant, "units", {}))
        self.stamps, self.monitor = stamps, monitor
        #: Smoother in which rows wait for later ones, if there is one.
        self.later: Any = None
        self._watching: Any = None if monitor is None else monitor.init()
        self.recovered = RecoveredStates.of(design.recovery, observer, recovered)
        extra = () if self.recovered is None else self.recovered.columns
        names = (*observer.columns, *extra)
        self._levels = _levels(thresholds, names)
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
        self._shifts = self._shifts_of_intervals()
        self.first, self.rows = OperatingPointCheck(self.signals), 0
        self.units = None if units_as_is else UnitCheck(design, self.signals)
        #: File of the state that the run continues from, until the first rows have shown that its parts fit together.
        self.resumed_from: Path | None = None
        self.statuses, self.alarms, self.isolated = Counter[str](), dict[str, float](), ""
        self.alarm_rows = dict[str, int]()
        self.events = AlarmLog(self.header)
        self.repeated = RepeatedValues(len(observer.output_names))

    def _shifts_of_intervals(self) -> FloatArray:
        """Return the operating point of the monitor's columns, which is nonzero for intervals of faults."""
        point = dict(zip(self.observer.fault_names, self._point[self._faults].tolist(), strict=True))
        ends = {f"{end} {name}": value for name, value in point.items() for end in ("lowest", "highest")}
        return np.array([ends.get(name, 0.0) for name in (() if self.monitor is None else self.monitor.columns)])

    def take(self, chunk: FloatArray) -> list[list[Any]]:
        """Take rows ``[time, u, y]`` as read; return rows of output (``chunk (rows, 1 + nu + ny)``)."""
        if self.resumed_from is None:
            return self._taken(chunk)
        try:
            rows = self._taken(chunk)
        except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError) as error:
            raise damaged_state(self.resumed_from) from error
        self.resumed_from = None
        return rows

    def _taken(self, chunk: FloatArray) -> list[list[Any]]:
        if self.later is None:
            return self._rows_out(self.read(chunk))
        # A row that waits for later ones is smoothed with each of them before the next one is read.
        return self._rows_out(
            [ready for row in chunk for took in self.read(row[None]) for ready, *_ in self.later.take(took)]
        )

    def read(self, chunk: FloatArray) -> list[Row]:
        """Take rows ``[time, u, y]`` as read; return the estimates at them (``chunk (rows, 1 + nu + ny)``)."""
        deviations = self.signals.deviations(chunk)
        if self.units is not None:
            self.units.take(deviations)
        return self.estimates(chunk[:, 0].tolist(), deviations)

    def estimates(self, times: Sequence[float], values: FloatArray) -> list[Row]:
        """Return the estimates at rows with deviations ``values (rows, nu + ny)``; rows whose stamps do not increase
        are left out."""
        rows, at, read = list[Row](), list[float](), values
        values, memory = self._unrepeated_rows(times, values)
        complete = np.asarray(np.isfinite(values).all(axis=1))
        while (done := len(rows)) < len(times):
            status = self.clock.stale(times[done])
            if status:
                rows.append(Row(status, np.full(len(self.observer.columns), np.nan)))
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
                    rows += taken
                    at += own[: len(taken)]
                    self._remember(memory, len(rows))
                    continue
            rows.append(self._single(times[done], values[done], self.rows + done + 1))
            at.append(self.clock.at(times[done]))
            self._remember(memory, len(rows))
        if rows and self.rows == 0:
            self.first.status = rows[0].status
        self.rows += len(rows)
        self.first.take(times, values)
        counts = [None] * len(rows) if memory is None else list(memory[:, 1])
        return [
            row._replace(time=time, deviations=v, at=own, repeated=equal)
            for row, time, v, own, equal in zip(rows, times, read, at, counts, strict=True)
        ]

    def _unrepeated_rows(self, times: Sequence[float], values: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """Return rows ``(rows, nu + ny)`` without repeated values of sensors that may be stuck, and the memory of
        repeated values after each row."""
        if self.unrepeated is None or not len(values):
            return values, None
        nu = values.shape[1] - len(self.unrepeated.longest)
        earlier = -math.inf if self.clock.last is None else self.clock.stamp
        outputs, memory = self.unrepeated.of_rows(values[:, nu:], rising(times, earlier))
        return np.hstack([values[:, :nu], outputs]), memory

    def _remember(self, memory: FloatArray | None, done: int) -> None:
        """Set the memory of repeated values to that after ``done`` rows."""
        if self.unrepeated is not None and memory is not None:
            self.unrepeated.memory = memory[done - 1]

    def _single(self, time: float, values: FloatArray, number: int) -> Row:
        """Process one row; an error leaves the state unchanged, so that the run may continue after it."""
        parts = (self.observer, self.clock)
        before = [dict(vars(part)) for part in parts]
        try:
            seconds, missing = self.clock.advance(time, number)
            missed = tuple(self._missed(time, missing)) if missing and self.observer.follows(missing) else ()
            if self.clock.dt > 0.0 and not self.clock.is_own:
                missing -= len(missed)
                seconds = (missing + 1) * self.clock.dt
            own, longest = self.clock.at(time), self.clock.longest
            row = self.observer.take(own, values, seconds=seconds, missing=missing, longest=longest)
            return row._replace(missed=missed) if missed else row
        except ObsynthError as error:
            for part, fields_before in zip(parts, before, strict=True):
                vars(part).update(fields_before)
            place = f"row {number}"
            if self.stamps is not None and self.stamps.is_dated and isinstance(error, StampError):
                error.args = (error.dated(self.stamps.shown, is_autumn=self.stamps.may_be_autumn),)
            if isinstance(error, SpecError):
                if error.path == place:
                    raise
                error.path = place
            error.args = (f"Row {number}: {error}",)
            raise

    def _missed(self, time: float, missing: int) -> Iterator[Row]:
        """Process the missing rows of a sampled design before a row, as rows of the log without signals."""
        nothing = np.full(len(self.signals.names), np.nan)
        for before in range(missing, 0, -1):
            at = self.clock.at(time, before)
            row = self.observer.take(at, nothing, seconds=self.clock.dt, missing=0, longest=self.clock.longest)
            yield row._replace(time=time, deviations=nothing, at=at)

    def finish(self) -> list[list[Any]]:
        """Return the rows of output that still waited for later rows."""
        if self.units is not None:
            self.units.finish()
        return [] if self.later is None else self._rows_out([ready for ready, *_ in self.later.flush()])

    def _rows_out(self, taken: Sequence[Row]) -> list[list[Any]]:
        if not taken:
            return []
        estimates = [row.values for row in taken]
        if self.recovered is not None:
            estimates = [np.concatenate([row.values, self._recovered_in(row)]) for row in taken]
        self.statuses.update(row.status for row in taken)
        self.repeated.take(np.array([self._outputs_of(row) for row in taken]))
        absolute: list[list[float]] = (np.array(estimates) + self._point).tolist()
        rows: list[list[Any]] = [
            [row.time, row.status, *(row.time - lag for lag in self._lags), *cells]
            for row, cells in zip(taken, absolute, strict=True)
        ]
        if self._levels or self.monitor is not None:
            first = self.rows - len(rows) + 1
            beyond = self._inputs_beyond(taken, first)
            for number, (row, values, cells) in enumerate(zip(taken, estimates, rows, strict=True), first):
                cells.extend(self._decided(row, values, number, cells, beyond[number - first]))
        return rows

    def _inputs_beyond(self, taken: Sequence[Row], first: int) -> list[tuple[str, ...]]:
        """Return the inputs beyond their learned ranges in each row; the first row has the number ``first``."""
        if self.beyond is None:
            return [()] * len(taken)
        nothing = np.full(len(self.signals.names), np.nan)
        read = [nothing if row.deviations is None or row.status in STALE else row.deviations for row in taken]
        return self.beyond.take(np.array(read), first)

    def _outputs_of(self, row: Row) -> FloatArray:
        """Return the measured outputs ``(ny,)``, NaN in a row that is left out."""
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

    def _decided(
        self, row: Row, values: FloatArray, number: int, before: Sequence[Any], beyond: tuple[str, ...]
    ) -> list[Any]:
        """Return the cells of the monitor, if there is one, and of alarms, and record the alarms.

        ``before`` are the other cells of the row, and ``beyond`` the inputs for which levels are raised.
        """
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
            self._watching, output = self.monitor.step(self._watching, self._sample(self.monitor, row))
            more = output.more or (math.nan,) * len(self.monitor.columns)
            cells = [*(np.array(more) + self._shifts).tolist(), output.statistic, output.threshold]
            undecided = math.isnan(output.statistic) and (undecided or not self._levels)
            if output.alarm:
                evidence = output.statistic / output.threshold if output.threshold else math.inf
                kind, distinguished = self.monitor.kind, bool(output.fault) or not self.monitor.fault_names
                self.events.take(
                    kind, output.fault, evidence, time, number, [*before, *cells], distinguished=distinguished,
                    ranking=output.ranking, beyond=beyond,
                )  # fmt: skip
                self.alarms.setdefault(self.monitor.kind, time)
                self.isolated = self.isolated or output.fault
                self.alarm_rows.setdefault(self.monitor.kind, number)
                since = self.events.shelved_since(kind)
                # If several causes are equally likely none is named, but the others are excluded: list these.
                candidates = "" if output.ranking is None else output.ranking.candidates
                fault_text = output.fault or candidates if math.isnan(since) else SHELVED.format(self._time_text(since))
                names.append(f"{kind}: {fault_text}" if fault_text else kind)
        for name, evidence in self._stuck(row):
            self.events.take(name, "", evidence, time, number, [*before, *cells])
            self.alarms.setdefault(name, time)
            self.alarm_rows.setdefault(name, number)
            names.append(name)
        for name, evidence in passed:
            fault = name[5:-1] if name.startswith("fhat[") else ""
            self.events.take(name, fault, evidence, time, number, [*before, *cells])
        if undecided:
            self.events.silent[row.status if row.status not in DECIDING else NO_DECISION] += 1
        return [*cells, "; ".join(names)]

    def taken_for_usual(self) -> tuple[str, ...]:
        """Return a text if an alarm of learned thresholds was ended since it was present from the start on."""
        if self.monitor is None or not isinstance(self.monitor.rule, LearnedRule) or not self._watching.rule.ended:
            return ()
        logs = logs_that_do(self.monitor.rule.learned.logs, joined=", which")
        return (
            f"An alarm stood when {self._watching.rule.ended} rows had been decided, and was ended there: the "
            f"thresholds are of {logs} not distinguish an offset of this log from a fault that was there "
            "from its first row on, so that these rows are taken for what is usual in this log"
            f"{self._raised_by_start()}. If the alarm was a fault, it may still be there. Three normal logs "
            "that hold such offsets tell (learn the thresholds from them).",
        )

    def _raised_by_start(self) -> str:
        """Return a text on the factor of levels after an alarm from the start on was ended; empty if it is one."""
        room = self._watching.rule.room
        if room <= 1.0:
            return ""
        return (
            f", and levels are raised by what the alarm had reached (at the end of the run still {room:.2g} times the "
            f"learned ones: changes that are found are {math.sqrt(room):.2g} times as large)"
        )

    def swinging(self) -> tuple[str, ...]:
        """Return a text if levels of learned thresholds were raised since residuals swing to both sides."""
        if self.monitor is None or not isinstance(self.monitor.rule, LearnedRule):
            return ()
        swings = self._watching.rule.swings
        if swings.since is None:
            return ()
        return (
            f"Residuals swing to both sides, slowly and beyond what was learned, since "
            f"{self._time_text(swings.since)}: a fault stays on one side, so that noise has become slower than in the "
            "rows that the thresholds were learned from, or something swings that the model does not have. Levels of "
            f"slow changes are up to {swings.most:.2g} times as high since then, and smaller faults are missed. Where "
            "the plant is as it should be, learn the thresholds again with this log among the normal ones.",
        )

    def _time_text(self, time: float) -> str:
        return f"{time:.15g}" if self.stamps is None else self.stamps.shown(time)

    def _stuck(self, row: Row) -> list[tuple[str, float]]:
        """Return the alarms of sensors that have been stuck for long, with the ratios to their thresholds."""
        if self.unrepeated is None or row.repeated is None:
            return []
        shares = row.repeated / (self.unrepeated.longest + STUCK_ALARM_ROWS)
        by_output = zip(self.observer.output_names, shares.tolist(), strict=True)
        return [(f"{STUCK_SENSOR} {name}", share) for name, share in by_output if share > 1.0]

    def _sample(self, monitor: Monitor, row: Row) -> Sample:
        """Return the input of a monitor for a row."""
        deciding = row.status in DECIDING and (row.settled or not monitor.guarantees)
        if monitor.rule.bridges and row.bridged:
            deciding = row.status in (*DECIDING, RECOVERING)
        residuals, faults = row.values[self._residuals], row.values[self._faults]
        inputs = None if row.deviations is None else row.deviations[: len(self.observer.input_names)]
        return Sample(row.at, residuals, faults, self._evidence(row), deciding, row.skipped, row.bridged, inputs)

    def _share(self, row: Row, column: int) -> float:
        """Return the factor of a level: that of the deviation of a fault estimate by missing samples."""
        place = column - self._faults.start
        return 1.0 if row.unsure is None or not 0 <= place < len(row.unsure) else float(row.unsure[place])

    def _excess(self, row: Row, column: int) -> float:
        """Return by how much a column must exceed its level for an alarm: infinite where nothing is decided."""
        if row.status in DECIDING:
            return 0.0
        if row.status != RECOVERING or row.excess is None or column >= len(row.excess):
            return math.inf
        return float(row.excess[column])

    def _evidence(self, row: Row) -> Any:
        """Return the observer's row for a monitor; if samples are missing, the values that exist, for monitors that
        accept gaps."""
        if row.evidence is not None or self.monitor is None or not self.monitor.rule.takes_gaps:
            return row.evidence
        nu, deviations = len(self.observer.input_names), row.deviations
        if deviations is None:
            return None
        return LinearSample(row.values, deviations[:nu], deviations[nu:], len(self.observer.state_names))

    def as_dict(self) -> dict[str, Any]:
        """Return the state between rows as data."""
        # Only designs with derivatives of inputs have this part.
        latest = None if self.stamps is None else [[i, *row] for i, row in self.stamps.differenced.items()] or None
        return {
            **({"differenced": latest} if self.signals.has_derivatives else {}),
            "observer": self.observer.as_dict(),
            "clock": self.clock.as_dict(),
            "recovered": None if self.recovered is None else self.recovered.as_dict(),
            "inputs": None if self.stamps is None else self.stamps.earlier,
            "numeric": None if self.stamps is None else sorted(self.stamps.numeric),
            "monitor": None if self.monitor is None else self.monitor.as_data(self._watching),
            "repeated": None if self.unrepeated is None else self.unrepeated.memory,
            "beyond": None if self.beyond is None else self.beyond.memory,
        }

    def resume(self, data: dict[str, Any]) -> None:
        """Restore the state from the data that `as_dict` returned."""
        if (data["monitor"] is None) != (self.monitor is None):
            raise SpecError("The saved state is of a run with another monitor: use the same options.", path="state")
        if (data.get("repeated") is None) != (self.unrepeated is None):
            raise SpecError("The saved state is of a run with another monitor: use the same options.", path="state")
        if self.unrepeated is not None:
            self.unrepeated.memory = np.asarray(data["repeated"], dtype=np.float64)
        if self.beyond is not None and data.get("beyond") is not None:
            self.beyond.resume(np.asarray(data["beyond"]))
        self.observer.resume(data["observer"])
        self.clock.resume(data["clock"])
        if self.stamps is not None:
            self.stamps.latest = self.clock.stamp
        if self.stamps is not None:
            self.stamps.earlier, self.stamps.numeric = data["inputs"], set(data["numeric"])
            latest = data.get("differenced") or []
            self.stamps.differenced = {int(row[0]): np.asarray(row[1:], dtype=np.float64) for row in latest}
        if self.recovered is not None:
            self.recovered.resume(data["recovered"])
        if self.monitor is not None:
            self._watching = self.monitor.from_data(data["monitor"])
        # Units were checked in the first rows of the run.
        self.units = None


def _levels(thresholds: Mapping[str, float], names: Sequence[str]) -> tuple[tuple[str, int, float], ...]:
    """Return the name, the position and the level of each column with a threshold."""
    for name, level in thresholds.items():
        if name not in names:
            raise SpecError(
                f"There is no column {name!r} to monitor: there are {', '.join(names)}.{_meant(name, names)}",
                path="thresholds",
            )
        real_number(level, f"The threshold of {name!r}", "a positive number", above=0.0, path="thresholds")
    return tuple((name, names.index(name), level) for name, level in thresholds.items())


def _meant(name: str, names: Sequence[str]) -> str:
    """Return a question on the column that a signal without brackets may mean, or on one with a similar name."""
    of_signal = [column for column in names if column.endswith(f"[{name}]")]
    return f" Did you mean {' or '.join(map(repr, of_signal))}?" if of_signal else suggestion(name, names)


def faults_on_rows(
    design: ObserverDesign, times: FloatArray, u: FloatArray, y: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return fault estimates ``(rows, nf)`` on rows of a log as in `run_on_data`, NaN where there are none; and which
    rows may be decided ``(rows,)``."""
    run = LogRun(design)
    first = len(run.observer.state_names)
    rows = run.estimates(times.tolist(), np.hstack([u, y]))
    faults = np.array([row.values[first : first + len(run.observer.fault_names)] for row in rows])
    return faults, np.array([row.status in DECIDING for row in rows], dtype=bool)
