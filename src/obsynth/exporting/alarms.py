"""Alarms of an exported observer: thresholds of its outputs, and the C code of a registered monitor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

from obsynth.errors import SpecError
from obsynth.exporting.realisation import Realisation
from obsynth.numerics.arguments import real_number, require_mapping
from obsynth.numerics.suggestions import there_are
from obsynth.observers.linear.modes import checked_warm_up, transient
from obsynth.observers.scheduled.observer import ScheduledObserver

#: What the statistic of a monitor is called, in units of its level.
STATISTIC = "statistic"

#: Seconds, about thirty years.
_NEVER = 1e9


@runtime_checkable
class Monitor(Protocol):
    """What an export takes as a monitor: that of `obsynth.online_monitor`, which upper rooms write as C."""

    @property
    def statement(self) -> str:
        """What its threshold means."""

    @property
    def rule(self) -> Any:
        """Statistic and threshold."""


class MonitorVariable(NamedTuple):
    """A number that an exported monitor shows after each step, and how C reads it from the monitor's structure."""

    name: str
    description: str
    expression: str


def isolated_fault(fault_names: Sequence[str]) -> MonitorVariable:
    """Return the fault that an alarm points to, by its number."""
    listed = ", ".join(f"{i + 1}: {name}" for i, name in enumerate(fault_names))
    return MonitorVariable(
        "isolated", f"number of the fault of the plant that an alarm points to, 0 for none ({listed})", "fault + 1.0"
    )


class ExportedMonitor(Protocol):
    """A monitor whose C stands beside that of its observer: ``monitor_reset`` and ``monitor_take``.

    One that ``follows_rows`` has ``monitor_follow`` besides, which takes states, inputs and parameters before it."""

    @property
    def follows_rows(self) -> bool:
        """Whether its threshold hangs on the signals of the rows."""

    @property
    def statement(self) -> str:
        """What its threshold means."""

    @property
    def variables(self) -> tuple[MonitorVariable, ...]:
        """What it shows after each step."""

    def watched_observer(self, observer: Any) -> Any:
        """Return an observer as the monitor expects it."""

    def struct_lines(self, prefix: str) -> list[str]:
        """Return the declaration of its structure, ``<prefix>_monitor``."""

    def source(self, prefix: str) -> str:
        """Return its tables and functions."""


@dataclass(frozen=True, eq=False)
class Alarms:
    """What raises an alarm: ``levels`` by watched output, 0 for none; ``warm_up`` in seconds; a monitor."""

    levels: Mapping[str, float]
    fault_names: tuple[str, ...]
    warm_up: float
    monitor: ExportedMonitor | None = None

    @classmethod
    def of(
        cls,
        watched: Sequence[str],
        fault_names: Sequence[str],
        thresholds: Mapping[str, float] | None,
        warm_up: float,
        monitor: ExportedMonitor | None,
    ) -> Alarms:
        """Return alarms of outputs that may be watched; raise `SpecError` for another name."""
        require_mapping(thresholds, "thresholds")
        for name, level in (thresholds or {}).items():
            if name not in watched:
                raise SpecError(
                    f"There is no output {name!r} to monitor; {there_are(name, watched)}", path="thresholds"
                )
            real_number(level, f"The threshold of {name!r}", "a positive number", above=0.0, path="thresholds")
        levels = {name: float((thresholds or {}).get(name, 0.0)) for name in watched}
        if monitor is not None:
            levels[STATISTIC] = 1.0
        return cls(levels, tuple(fault_names), warm_up, monitor)

    def struct_lines(self, prefix: str) -> list[str]:
        """Return the declaration of the monitor in C, if there is one."""
        return [] if self.monitor is None else self.monitor.struct_lines(prefix)

    def source(self, prefix: str) -> str:
        """Return the tables and functions of the monitor in C, if there is one."""
        return "" if self.monitor is None else self.monitor.source(prefix)


def scheduled_alarms(
    observer: ScheduledObserver,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    monitor: ExportedMonitor | None,
) -> Alarms:
    """Return the alarms of a scheduled observer."""
    columns = (*observer.row_names[observer.fault_rows], *observer.row_names[observer.residual_rows])
    # Rows to forget in discrete time, seconds in continuous time.
    seconds = checked_warm_up(warm_up, observer.forgetting * (observer.dt or 1.0))
    return Alarms.of(columns, observer.fault_names, thresholds, seconds, monitor)


def linear_alarms(
    realisation: Realisation,
    thresholds: Mapping[str, float] | None,
    warm_up: float | None,
    monitor: ExportedMonitor | None,
) -> Alarms:
    """Return the alarms of a linear observer."""
    observer = realisation.observer
    columns = (*observer.row_names[observer.fault_rows], *observer.row_names[observer.residual_rows])
    # That of the design itself, as runs have it: sampling changes no mode.
    seconds = checked_warm_up(warm_up, transient(realisation.running))
    # A file may hold finite numbers alone: an observer that never settles raises no alarm.
    seconds = seconds if math.isfinite(seconds) else _NEVER
    return Alarms.of(columns, observer.fault_names, thresholds, seconds, monitor)
