"""Guaranteed thresholds over a region as C: a table of bounds by the row, or in continuous time bounds that follow the
rows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from obsynth.errors import SpecError
from obsynth.exporting.alarms import STATISTIC, ExportedMonitor, MonitorVariable, isolated_fault
from obsynth.exporting.c_source import filled_table, filled_template, integer_table, table_lines
from obsynth.monitoring.thresholds.euler_bounds import MOST_GROWTH, third_order
from obsynth.monitoring.thresholds.euler_rule import EulerRule
from obsynth.monitoring.thresholds.monitor import Monitor
from obsynth.monitoring.thresholds.rules import NormRule
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.scheduled.observer import FORGOTTEN_SHARE, ScheduledObserver
from obsynth.verification.over_tolerances.responses import OUTWARD

#: The start of a monitor's structure in C.
_SHOWN_LINES = (
    "typedef struct {",
    "    /* Read these after a step: the norm of the residual in units of its threshold, both of them,",
    "     * NaN where nothing is decided; whether the threshold is passed, and by which fault (-1: none). */",
    "    REAL statistic, norm, threshold;",
    "    int alarm, fault;",
    "    /* Everything else is the monitor's own. */",
)


@dataclass(frozen=True, eq=False)
class _NormAgainstLimitInC(ABC):
    """The norm of the residual against a limit as C: an `obsynth.exporting.alarms.ExportedMonitor`, but for the limit.

    ``residuals``: how many there are; ``fault_scales (nf,)``: what fault estimates are compared in.
    """

    statement: str
    residuals: int
    fault_names: tuple[str, ...]
    fault_scales: FloatArray

    #: The file of C in which the limit is formed.
    template: ClassVar[str]

    @property
    def variables(self) -> tuple[MonitorVariable, ...]:
        """The norm of the residual in units of its threshold, and the fault that an alarm points to."""
        shown = MonitorVariable(STATISTIC, f"norm of the residual by its threshold: {self.statement}", "statistic")
        return (shown, isolated_fault(self.fault_names))

    def watched_observer(self, observer: Any) -> Any:
        """Return the observer as it is."""
        return observer

    def struct_lines(self, prefix: str) -> list[str]:
        """Return the declaration of the monitor's structure."""
        return [*_SHOWN_LINES, *self._own_fields(), f"}} {prefix}_monitor;", ""]

    def source(self, prefix: str) -> str:
        """Return the tables and functions of the monitor."""
        sizes = {**self._sizes(), "MONITOR_RESIDUALS": self.residuals, "MONITOR_FAULTS": len(self.fault_names)}
        tables = {**self._tables(), "monitor_scales": self.fault_scales[None]}
        lines = [
            f"enum {{ {', '.join(f'{name} = {value}' for name, value in sizes.items())} }};",
            *(f"#define {name} ((REAL){float(value)!r})" for name, value in self._numbers().items()),
            *(line for name, table in tables.items() for line in table_lines(name, filled_table(table))),
            *self._more_lines(),
        ]
        templates = ("norm_against_limit.c", self.template)
        return "\n".join(lines) + "".join(filled_template(name, prefix, {}, "obsynth.monitoring") for name in templates)

    @abstractmethod
    def _own_fields(self) -> list[str]:
        """Return the fields of the structure that the limit is formed from."""

    @abstractmethod
    def _sizes(self) -> dict[str, int]:
        """Return sizes by their names in C."""

    @abstractmethod
    def _numbers(self) -> dict[str, float]:
        """Return numbers by their names in C."""

    @abstractmethod
    def _tables(self) -> dict[str, FloatArray]:
        """Return tables by their names in C."""

    def _more_lines(self) -> list[str]:
        """Return other lines of C."""
        return []


@dataclass(frozen=True, eq=False)
class RegionMonitorInC(_NormAgainstLimitInC):
    """A bound on the residual for every course of the parameters.

    ``table``: bounds by the row since the start; ``limit``: for ever after.
    """

    table: FloatArray
    limit: float

    follows_rows: ClassVar[bool] = False
    template: ClassVar[str] = "region_threshold.c"

    def _own_fields(self) -> list[str]:
        return ["    int is_decided;", "    long row;"]

    def _sizes(self) -> dict[str, int]:
        return {"TABLE_LENGTH": len(self.table)}

    def _numbers(self) -> dict[str, float]:
        return {"MONITOR_LIMIT": self.limit}

    def _tables(self) -> dict[str, FloatArray]:
        return {"monitor_table": self.table[None]}


@dataclass(frozen=True, eq=False)
class FollowingRegionMonitorInC(_NormAgainstLimitInC):
    """Bounds on the residual in continuous time that follow the rows.

    ``rule``: its bounds; ``seconds`` between rows; ``function_places``: which parameter each function of the scheduling
    is.
    """

    rule: EulerRule
    seconds: float
    function_places: tuple[int, ...]
    vertices: int
    parameters: int

    follows_rows: ClassVar[bool] = True
    template: ClassVar[str] = "region_threshold_that_follows.c"

    def _own_fields(self) -> list[str]:
        inputs, count = self.rule.bounds[0].errors.motion.B.shape[2], len(self.rule.bounds)
        return [
            f"    REAL size[{count}], share[{count}], limit;",
            f"    REAL u[{max(inputs, 1)}], parameters[{self.parameters}], weights[{self.vertices}];",
            "    int has_before;",
        ]

    def _sizes(self) -> dict[str, int]:
        return {"BOUNDS": len(self.rule.bounds), "MOTIONS": self.rule.bounds[0].errors.motion.A.shape[1]}

    def _numbers(self) -> dict[str, float]:
        first = self.rule.bounds[0].errors
        return {
            "SECOND_ORDER": 0.5 * self.seconds * self.seconds,
            "THIRD_ORDER": third_order(first.growth, self.seconds),
            "SLOPE_OF_NOISE": first.slope_of_noise,
            "AT_ONCE": self.rule.direct,
            "OUTWARD": OUTWARD,
            "FORGOTTEN_SHARE": FORGOTTEN_SHARE,
        }

    def _tables(self) -> dict[str, FloatArray]:
        """Return those of the plant's motion, and of each bound."""
        bounds = [bound.errors for bound in self.rule.bounds]
        first = bounds[0]
        motion = first.motion
        return {
            "motion_A": np.vstack(list(motion.A)),
            "motion_B": np.vstack(list(motion.B)),
            "turned_A": np.vstack(list(first.A_turns)),
            "turned_B": np.vstack(list(first.B_turns)),
            "motion_estimated": motion.estimated,
            "motion_units": motion.units[None],
            "slope_of_inputs": first.slope_of_inputs[None],
            "drive": np.vstack([bound.drive for bound in bounds]),
            "drive_of_inputs": np.vstack([bound.drive_of_inputs for bound in bounds]),
            "turned_error": np.vstack([bound.turned_error for bound in bounds]),
            "turned_noise": np.vstack([bound.turned_noise for bound in bounds]),
            "drifts": np.array([[bound.drift for bound in bounds]]),
            "slopes_of_error": np.array([[bound.slope_of_error for bound in bounds]]),
            "decays": np.array([[bound.decay for bound in bounds]]),
            "driven": np.array([[bound.driven for bound in bounds]]),
            "gains": np.array([[bound.gain for bound in self.rule.bounds]]),
            "bound_starts": np.array([[-1.0 if b.start is None else b.start for b in self.rule.bounds]]),
        }

    def _more_lines(self) -> list[str]:
        return integer_table("function_places", self.function_places) if self.function_places else []


def region_monitor_in_c(monitor: Monitor, observer: ScheduledObserver, seconds: float | None) -> ExportedMonitor:
    """Return a guaranteed threshold over a region as C; ``seconds`` between rows of a design in continuous time."""
    monitor.require_fit(len(observer.residual_names), observer.fault_names)
    if isinstance(monitor.rule, EulerRule) and seconds is not None:
        return _following_monitor(monitor, monitor.rule, observer, seconds)
    bound = monitor.rule.bound_by_row if isinstance(monitor.rule, NormRule) else None
    if monitor.kind != "pointwise" or bound is None:
        raise SpecError(
            "C of a design over a region holds guaranteed thresholds (kind 'pointwise' of obsynth.online_monitor) and "
            "levels of its outputs, not this monitor: run it on rows with obsynth.run_on_data.",
            path="monitor",
        )
    table, limit = bound
    return RegionMonitorInC(*_of_monitor(monitor), table, float(limit))


def _of_monitor(monitor: Monitor) -> tuple[str, int, tuple[str, ...], FloatArray]:
    return monitor.statement, monitor.residuals, monitor.fault_names, monitor.fault_scales


def _following_monitor(
    monitor: Monitor, rule: EulerRule, observer: ScheduledObserver, seconds: float
) -> FollowingRegionMonitorInC:
    scheduling = observer.scheduling
    enclosed = [text for text in scheduling.functions if text not in scheduling.names]
    if enclosed:
        raise SpecError(
            f"The guaranteed threshold follows the rows by enclosures of {enclosed[0]!r} between two of them, which "
            "are not written as C: run it with obsynth.run_on_data, or give levels of the outputs (thresholds={...}, "
            "--threshold) for C.",
            path="monitor",
        )
    if not rule.bounds[0].errors.growth * seconds < MOST_GROWTH:
        raise SpecError(
            f"With {seconds:g} s between samples nothing is known of the plant between them: no row would have a "
            "threshold. Give a shorter sample time.",
            path="sample_time",
        )
    return FollowingRegionMonitorInC(
        *_of_monitor(monitor),
        rule,
        seconds,
        tuple(scheduling.names.index(text) for text in scheduling.functions),
        observer.count,
        len(scheduling.names),
    )
