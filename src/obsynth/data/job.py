"""One run: rows of data to rows of output, and what is counted on the way.

Whether the data begin near the operating point.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.analysis.transformations.recovery import StateRecovery
from obsynth.data.log_estimator import DECIDING, Engine, Entry, Later, Row, delayed
from obsynth.data.recovered import LATE, RecoveredStates
from obsynth.data.signals import TIME, Signals
from obsynth.errors import SpecError
from obsynth.experiments.monitors.online import OnlineMonitor
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray

#: Seconds of data that are compared with the operating point.
FIRST = 1.0
#: A signal is far from its operating point when its mean differs by this share of it.
FAR = 0.2


class OperatingPointCheck:
    """Gathers the first second of data. Fields: signals: With the operating point."""

    def __init__(self, signals: Signals) -> None:
        self._signals = signals
        self._begin: float | None = None
        self._sum, self._count = np.zeros(len(signals.names)), np.zeros(len(signals.names))

    def take(self, time: float, deviations: FloatArray) -> None:
        """Take one row: seconds, and deviations ``(nu + ny,)`` of which some may be missing."""
        self._begin = time if self._begin is None else self._begin
        if time - self._begin <= FIRST:
            known = np.isfinite(deviations)
            self._sum[known] += deviations[known]
            self._count[known] += 1.0

    def warnings(self) -> tuple[str, ...]:
        """Return a text for each signal with a stated operating point, not zero, that begins far from it."""
        texts = []
        for i, name in enumerate(self._signals.names):
            point = self._signals.point.get(name, 0.0)
            if point == 0.0 or self._count[i] == 0.0:
                continue
            away = self._sum[i] / self._count[i]
            if abs(away) > FAR * abs(point):
                texts.append(
                    f"{name} begins at {point + away:.6g}, far from its operating point {point:.6g}: the linear model "
                    "may not hold there, or the data are deviations already, or in another unit."
                )
        return tuple(texts)


def damaged_state(path: Path) -> SpecError:
    """Return the error for a saved state whose parts do not fit."""
    return SpecError(f"{path} is damaged: it is no state of this design and these options.", path=str(path))


class Job:
    """Rows of data to rows of output. Fields: engine: What is run; signals: Which columns it reads; recovery: The way
    back to the states of the plant as written; thresholds: Level by column; monitor: What watches residuals or
    parameters; later: Where rows wait for those after them."""

    def __init__(
        self, engine: Engine, signals: Signals, recovery: StateRecovery | None, thresholds: Mapping[str, float],
        monitor: OnlineMonitor | None, recovered: str | Sequence[str] | None = None, later: Later | None = None,
    ) -> None:  # fmt: skip
        self.engine, self.signals, self.monitor, self.later = engine, signals, monitor, later
        self.recovered = RecoveredStates.of(recovery, engine, recovered)
        extra = () if self.recovered is None else self.recovered.columns
        names = (*engine.columns, *extra)
        for name, level in thresholds.items():
            if name not in names:
                raise SpecError(f"There is no column {name!r} to watch: there are {', '.join(names)}.",
                                path="thresholds")  # fmt: skip
            if not (is_finite_number(level) and level > 0.0):
                raise SpecError(f"The threshold of {name!r} is {level!r}: give a positive number.", path="thresholds")
        self._levels = tuple((name, names.index(name), level) for name, level in thresholds.items())
        lags = list(delayed(engine))
        if self.recovered is not None and self.recovered.delay:
            lags.append((LATE, self.recovered.delay))
        self._lags = [delay * engine.dt for _, delay in lags]
        self._point = signals.estimates_point(engine)
        if self.recovered is not None:
            self._point = np.concatenate([self._point, self.recovered.point])
        states, faults = len(engine.state_names), len(engine.fault_names)
        self._faults = slice(states, states + faults)
        residuals = [i for i, name in enumerate(engine.columns) if name.startswith("r[")]
        self._residuals = slice(residuals[0], residuals[-1] + 1) if residuals else slice(0, 0)
        if monitor is not None:
            monitor.require_fit(len(residuals), engine.fault_names)
        self.header = (
            TIME, "status", *(f"time of {name}" for name, _ in lags), *names,
            *((*monitor.columns, "statistic", "threshold") if monitor is not None else ()),
            *(("alarm",) if thresholds or monitor is not None else ()),
        )  # fmt: skip
        # Intervals of faults are in their own units, like the estimates.
        point = dict(zip(engine.fault_names, self._point[self._faults].tolist(), strict=True))
        ends = {f"{end} {name}": value for name, value in point.items() for end in ("lowest", "highest")}
        self._shifts = np.array([ends.get(name, 0.0) for name in (() if monitor is None else monitor.columns)])
        self.first, self.rows = OperatingPointCheck(signals), 0
        #: The file of the state that the first rows go on from: only they show whether its parts fit together.
        self.resumed_from: Path | None = None
        self.statuses, self.alarms, self.isolated = Counter[str](), dict[str, float](), ""
        self.alarm_rows = dict[str, int]()

    def take(self, chunk: FloatArray) -> list[list[Any]]:
        """Take rows ``[time, u, y]`` as read; return rows of output: ``chunk (rows, 1 + nu + ny)``."""
        if self.resumed_from is None:
            return self._taken(chunk)
        try:
            found = self._taken(chunk)
        except (AttributeError, LookupError, TypeError, ValueError, ArithmeticError) as error:
            raise damaged_state(self.resumed_from) from error
        self.resumed_from = None
        return found

    def _taken(self, chunk: FloatArray) -> list[list[Any]]:
        entries: list[Entry] = []
        scaled = self.signals.deviations(chunk)
        for time, deviations in zip(chunk[:, 0].tolist(), scaled, strict=True):
            entry = Entry(time, deviations, self.engine.step(time, deviations, self.rows + 1))
            self.rows += 1
            self.first.take(time, deviations)
            if self.later is None:
                entries.append(entry)
            else:
                entries.extend(ready for ready, *_ in self.later.take(entry))
        return self._shown(entries)

    def finish(self) -> list[list[Any]]:
        """Return the rows of output that waited for what does not come any more."""
        return [] if self.later is None else self._shown([ready for ready, *_ in self.later.flush()])

    def _shown(self, entries: Sequence[Entry]) -> list[list[Any]]:
        if not entries:
            return []
        times = [entry.time for entry in entries]
        nu = len(self.engine.input_names)
        found, estimates = [], []
        for _, deviations, row in entries:
            values = row.values
            if self.recovered is not None:
                values = np.concatenate([values, self.recovered.take(row, deviations[:nu])])
            found.append(row)
            estimates.append(values)
        self.statuses.update(row.status for row in found)
        shown: list[list[float]] = (np.array(estimates) + self._point).tolist()
        rows: list[list[Any]] = [
            [time, row.status, *(time - lag for lag in self._lags), *cells]
            for time, row, cells in zip(times, found, shown, strict=True)
        ]
        if self._levels or self.monitor is not None:
            first = self.rows - len(rows) + 1
            for number, (time, row, values, cells) in enumerate(zip(times, found, estimates, rows, strict=True), first):
                cells.extend(self._decided(time, row, values, number))
        return rows

    def _decided(self, time: float, row: Row, values: FloatArray, number: int) -> list[Any]:
        """Return statistic and threshold, if there is a monitor, and what alarms there are."""
        deciding = row.status in DECIDING
        names = [name for name, i, level in self._levels if deciding and np.abs(values[i]) > level]
        for name in names:
            self.alarms.setdefault(name, time)
            self.alarm_rows.setdefault(name, number)
        cells: list[Any] = []
        if self.monitor is not None:
            seen = self.monitor.see(
                time, deciding=deciding, skipped=row.skipped, residuals=row.values[self._residuals],
                faults=row.values[self._faults], evidence=row.evidence,
            )  # fmt: skip
            more = seen.more or (math.nan,) * len(self.monitor.columns)
            cells = [*(np.array(more) + self._shifts).tolist(), seen.statistic, seen.threshold]
            if seen.alarm:
                if self.monitor.kind not in self.alarms:
                    self.alarms[self.monitor.kind], self.isolated = time, seen.fault
                    self.alarm_rows[self.monitor.kind] = number
                names.append(f"{self.monitor.kind}: {seen.fault}" if seen.fault else self.monitor.kind)
        return [*cells, "; ".join(names)]

    def as_dict(self) -> dict[str, Any]:
        """Return the state that goes from row to row, as data."""
        return {
            "observer": self.engine.as_dict(),
            "recovered": None if self.recovered is None else self.recovered.as_dict(),
            "monitor": None if self.monitor is None else self.monitor.as_dict(),
        }

    def resume(self, data: dict[str, Any]) -> None:
        """Go on from what `as_dict` returned."""
        if (data["monitor"] is None) != (self.monitor is None):
            raise SpecError("The saved state is of a run with another monitor: use the same options.", path="state")
        self.engine.resume(data["observer"])
        if self.recovered is not None:
            self.recovered.resume(data["recovered"])
        if self.monitor is not None:
            self.monitor.resume(data["monitor"])
