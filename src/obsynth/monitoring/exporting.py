"""Monitors in exported files: learned thresholds as C beside their observer, and bounds over tolerances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from obsynth.errors import SpecError
from obsynth.exporting.alarms import STATISTIC, ExportedMonitor, MonitorVariable, isolated_fault
from obsynth.exporting.c_source import filled_table, filled_template, integer_table, table_lines
from obsynth.monitoring.region_monitors import region_monitor_in_c
from obsynth.monitoring.thresholds.adaptive_rule import AdaptiveRule
from obsynth.monitoring.thresholds.learned import FAULTS_SLOWER, FOLLOWED_ROWS, OWN_ROWS, LearnedThresholds
from obsynth.monitoring.thresholds.learned_levels import HOLD
from obsynth.monitoring.thresholds.learned_rule import (
    FOLLOWED_MOST,
    MOST_OF_START,
    NEARLY_MOST,
    OWN_MOST,
    ROOM_OF_START,
    LearnedRule,
    follow_shares,
    shares_of_partial_scores,
)
from obsynth.monitoring.thresholds.learned_statistics import AGES, FORGETTING
from obsynth.monitoring.thresholds.monitor import Monitor
from obsynth.monitoring.thresholds.parameter_scores import DISTINGUISHED, LEAST_ADDED, MODEL_SHARE, parameter_walk
from obsynth.monitoring.thresholds.swings import LEAST_SWINGS, ROW_MEMORY, SWING, SWING_MEMORY, SWING_ROOM
from obsynth.monitoring.thresholds.watched_columns import as_learned, watched_names
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import gain_set_digest
from obsynth.verification.over_tolerances.adaptive_bound import AdaptiveBound


@dataclass(frozen=True, eq=False)
class LearnedMonitorInC:
    """Learned thresholds as C: an `obsynth.exporting.alarms.ExportedMonitor`.

    ``columns``: all outputs of a run that may be watched, fault estimates first; ``walk (nf, nf)``: the covariance by
    which faults walk between samples; ``outputs``: how many the plant has.
    """

    learned: LearnedThresholds
    columns: tuple[str, ...]
    fault_names: tuple[str, ...]
    walk: FloatArray | None
    outputs: int

    follows_rows: ClassVar[bool] = False

    @property
    def statement(self) -> str:
        """What its thresholds mean."""
        return self.learned.statement

    @property
    def variables(self) -> tuple[MonitorVariable, ...]:
        """The statistic, the fault that an alarm points to, and whether an alarm lasts."""
        held = f"1 while an alarm lasts, {HOLD} rows more than the statistic is above its level"
        return (
            MonitorVariable(STATISTIC, f"largest statistic in units of its level: {self.statement}", "statistic"),
            isolated_fault(self.fault_names),
            MonitorVariable("event", held, "event"),
        )

    def watched_observer(self, observer: Any) -> Any:
        """Return an observer as the one from which the thresholds were learned judged outliers."""
        return as_learned(observer, self.learned)

    def struct_lines(self, prefix: str) -> list[str]:
        """Return the declaration of the monitor's structure."""
        model = self.learned.statistics.model
        m, width = model.channels, max(len(self.learned.statistics.estimates), 1)
        inputs = 0 if self.learned.ranges is None else self.learned.ranges.inputs
        swinging = len(FORGETTING) * m + len(self.learned.statistics.responses()[0])
        return [
            "typedef struct {",
            "    /* Read these after a step: the largest statistic in units of its level (NaN where nothing is",
            "     * decided), whether it passes 1, which fault it points to (-1: none, or not distinguished yet), and "
            "an",
            "     * alarm that lasts. */",
            "    REAL statistic;",
            "    int alarm, fault, event;",
            "    /* Everything else is the monitor's own. */",
            f"    REAL past[{max(model.order * m, 1)}];",
            f"    REAL white[{max(AGES) * m}];",
            f"    REAL means[{len(FORGETTING) * m}];",
            f"    REAL slow[{m}];",
            f"    REAL before[{(1 + width) * width}];",
            f"    REAL scores[{max(AGES) * 2 * width}];",
            f"    REAL centres[{width}];",
            f"    REAL own[{m + width}];",
            f"    REAL swing_high[{swinging}];",
            f"    REAL swing_low[{swinging}];",
            f"    REAL swing_count[{swinging}];",
            f"    int swing_side[{swinging}];",
            "    REAL swing_row;",
            f"    REAL repeated[{max(self.outputs, 1)}];",
            f"    long equal[{max(self.outputs, 1)}];",
            f"    REAL raised[{max(AGES) * max(inputs, 1)}];",
            f"    REAL raised_now[{max(inputs, 1)}];",
            "    REAL roots, room;",
            "    int at, quiet, to_wait, alarmed, begun, ended, stood;",
            "    long taken;",
            "    int decided;",
            f"}} {prefix}_monitor;",
            "",
        ]

    def longest(self) -> list[int]:
        """Return from which equal sample on each output counts as not measured, 0 for never."""
        repeats = self.learned.repeats
        if repeats is None or not self.outputs:
            return [0] * max(self.outputs, 1)
        return [int(count) if np.isfinite(count) else 0 for count in repeats.tolist()]

    def source(self, prefix: str) -> str:
        """Return the tables and functions of the monitor."""
        learned = self.learned
        faults = {f"fhat[{name}]": i for i, name in enumerate(self.fault_names)}
        faults |= {f"fault {name}": i for i, name in enumerate(self.fault_names)}
        listed = ", ".join(f"{name} = {value}" for name, value in self._sizes().items())
        lines = [
            f"enum {{ {listed} }};",
            *(f"#define {name} ((REAL){value!r})" for name, value in self._follow_numbers().items()),
            f"#define MONITOR_LEAST ((REAL){LEAST_ADDED!r})",
            f"#define MONITOR_APART ((REAL){DISTINGUISHED!r})",
            f"#define MONITOR_SHARE ((REAL){MODEL_SHARE!r})",
            *(line for name, table in self._tables().items() for line in table_lines(name, filled_table(table))),
            *integer_table("monitor_longest", self.longest()),
            *integer_table("monitor_ages", AGES),
            *integer_table("monitor_places", [self.columns.index(name) for name in learned.columns]),
            *integer_table("monitor_seldom", [int(name in learned.seldom) for name in self.columns]),
            *integer_table("monitor_told", [faults.get(name, -1) for name in learned.statistics.signature_names]),
        ]
        return "\n".join(lines) + filled_template("learned.c", prefix, {}, "obsynth.monitoring")

    def _sizes(self) -> dict[str, int]:
        """Return the sizes of the tables, by their names in C."""
        learned, model = self.learned, self.learned.statistics.model
        faults_watched = len(learned.statistics.estimates)
        return {
            "CHANNELS": model.channels,
            "ORDER": model.order,
            "OLDEST": max(AGES),
            "AGES": len(AGES),
            "MEANS": len(FORGETTING),
            "SHAPES": len(learned.statistics.responses()[0]),
            "MONITOR_FAULTS": len(learned.scales),
            "MONITOR_ESTIMATES": faults_watched,
            "MONITOR_WIDTH": max(faults_watched, 1),
            "MONITOR_SETTLING": learned.settling,
            "MONITOR_OUTPUTS": self.outputs,
            "MONITOR_INPUTS": 0 if learned.ranges is None else len(learned.ranges.middle_and_half()[0]),
            "MONITOR_STATISTICS": len(learned.levels),
            "MONITOR_HOLD": HOLD,
            "MONITOR_RESTS": int(model.rests_on_the_past),
            "MONITOR_OFFSET": int(learned.memory > 0.0 or learned.takes_first_rows),
            "MONITOR_OWN": OWN_ROWS[0] if learned.takes_first_rows else 0,
            "MONITOR_OWN_LATER": OWN_ROWS[1],
            "MONITOR_WATCHED": sum(name.startswith(("fhat[", "r[")) for name in self.columns),
        }

    def _follow_numbers(self) -> dict[str, float]:
        """Return how an offset of residuals is followed, and how levels follow swings, by the names in C."""
        usual, in_alarm = follow_shares(self.learned.memory)
        later, later_in_alarm = follow_shares(self.learned.memory or FOLLOWED_ROWS)
        return {
            "MONITOR_FOLLOW": usual, "MONITOR_FOLLOW_IN_ALARM": in_alarm, "MONITOR_FOLLOWED_MOST": FOLLOWED_MOST,
            "MONITOR_FOLLOW_LATER": later, "MONITOR_FOLLOW_LATER_IN_ALARM": later_in_alarm,
            "MONITOR_FAULTS_SLOWER": FAULTS_SLOWER, "MONITOR_OWN_MOST": OWN_MOST,
            "MONITOR_NEARLY_MOST": NEARLY_MOST,
            "MONITOR_ROOM": ROOM_OF_START, "MONITOR_MOST_OF_START": MOST_OF_START,
            "MONITOR_SWING": SWING, "MONITOR_LEAST_SWINGS": LEAST_SWINGS, "MONITOR_SWING_ROOM": SWING_ROOM,
            "MONITOR_SWING_KEPT": 1.0 - 1.0 / SWING_MEMORY, "MONITOR_ROW_KEPT": 1.0 - 1.0 / ROW_MEMORY,
        }  # fmt: skip

    def _tables(self) -> dict[str, Any]:
        """Return the numbers of the thresholds, by their names in C."""
        learned, model = self.learned, self.learned.statistics.model
        bands = learned.statistics.fault_bands
        shares = np.array(FORGETTING)
        nothing = np.zeros(0)
        middle, half = (nothing, nothing) if learned.ranges is None else learned.ranges.middle_and_half()
        rates = None if learned.ranges is None else learned.ranges.rates
        return {
            "monitor_mean": model.mean[None],
            "monitor_offset": model.offset[None],
            "monitor_A": model.A.reshape(-1, model.channels),
            "monitor_whitener": model.whitener,
            "monitor_precision": model.whitener.T @ model.whitener,
            "monitor_shares": shares[None],
            "monitor_sizes": ((2.0 - shares) / shares)[None],
            "monitor_levels": learned.levels[None],
            **self._step_responses(),
            "monitor_effects": learned.statistics.offset_effects() / np.sqrt(learned.statistics.levels_by_age),
            "monitor_bands": (np.zeros(len(learned.statistics.estimates)) if bands is None else bands)[None],
            "monitor_partly_measured": shares_of_partial_scores(learned)[None],
            "monitor_centres": learned.centres[None],
            "monitor_scales": learned.scales[None],
            "monitor_walk": np.zeros((0, 0)) if self.walk is None else self.walk,
            "monitor_middle": middle[None],
            "monitor_half": np.where(np.isfinite(half), half, 0.0)[None],
            "monitor_rates": np.ones((len(middle), len(learned.levels))) if rates is None else rates,
            "monitor_innovation": np.array([[learned.innovation]]),
        }

    def _step_responses(self) -> dict[str, FloatArray]:
        """Return what steps do to whitened residuals: a straight line, what the first rows differ from it by, and the
        inverse lengths of all rows up to each age."""
        statistics, order = self.learned.statistics, self.learned.statistics.model.order
        shapes, slopes = statistics.responses()
        straight = shapes[:, -1:] + (np.arange(order + 1) - order)[:, None] * slopes[:, None, :]
        rows = np.concatenate([shapes, shapes[:, -1:] + np.arange(1, max(AGES))[:, None] * slopes[:, None, :]], axis=1)
        powers = np.cumsum(np.sum(rows**2, axis=2), axis=1)[:, np.array(AGES) - 1]
        return {
            "monitor_flat": straight[:, 0],
            "monitor_slopes": slopes,
            "monitor_early": (shapes - straight).reshape(-1, statistics.model.channels),
            "monitor_roots": np.sqrt(1.0 / (np.maximum(powers, SMALLEST) * statistics.levels_by_age)),
        }


def monitor_in_c(monitor: Monitor, design: ObserverDesign, seconds: float | None = None) -> ExportedMonitor | None:
    """Return a monitor of this design as C, with so many ``seconds`` between rows where it needs them; ``None`` where
    it is of a kind that is written otherwise, or not."""
    if isinstance(design.observer, ScheduledObserver):
        return region_monitor_in_c(monitor, design.observer, seconds)
    if not isinstance(monitor.rule, LearnedRule):
        return None
    learned = monitor.rule.learned
    if learned.gains != gain_set_digest(design):
        raise SpecError("The thresholds were learned with another gain set: learn them again.", path="monitor")
    if isinstance(design.observer, RecursiveObserver):
        raise SpecError(
            "The steady state of a recursive design, which is what is exported, has other innovations than the "
            "recursion that the thresholds were learned from: use levels of its outputs (thresholds).",
            path="monitor",
        )
    return LearnedMonitorInC(
        learned,
        watched_names(design),
        tuple(design.observer.fault_names),
        parameter_walk(design.observer),
        len(design.plant.output_names),
    )


def bound_of_monitor(monitor: Monitor, observer: LinearObserver) -> tuple[AdaptiveBound, AdaptiveBound]:
    """Return the bounds of an adaptive monitor of an observer that is written: from the first start on, and after a
    later one."""
    monitor.require_fit(len(observer.residual_names), observer.fault_names)
    rule = monitor.rule
    if not isinstance(rule, AdaptiveRule):
        raise SpecError("The monitor has no thresholds over tolerances: make it with constants.", path="monitor")
    if rule.plan.bound.first is not None:
        raise SpecError(
            "Thresholds of continuous designs are not written as C: sample the plant first.", path="monitor"
        )
    return rule.plan.bound, rule.later.bound
