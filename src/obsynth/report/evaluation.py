"""An evaluation for people: rates, delays and errors, each with its confidence interval."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from rich.console import Console
from rich.text import Text

from obsynth.experiments.intervals import Interval
from obsynth.experiments.monitors.monitor import Monitor
from obsynth.experiments.monte_carlo import Evaluation
from obsynth.observers.decisions import ParameterMonitor
from obsynth.report.layout import headed_table, number, print_section

#: Rows of a table; of a large plant the worst estimates are shown.
SHOWN = 12
_DECISIONS = {
    "false_alarm_rate": ("false alarms", "share of runs"),
    "missed_detection_rate": ("missed detections", "share of runs"),
    "detection_delay": ("detection delay", "s"),
    "isolation_error_rate": ("wrong fault named", "share of detections"),
}


def evaluation_report(
    name: str,
    found: Evaluation,
    *,
    monitor: Monitor | ParameterMonitor | None,
    console: Console,
    units: Mapping[str, str],
) -> None:
    """Print rates, delays and errors over many runs."""
    share = f"{100.0 * found.confidence:g} % interval"
    console.print(Text(f"{name}: {found.runs} runs", style="bold"))
    console.print()
    if monitor is not None:
        table = headed_table("decisions", "value", share, "of", "unit")
        for key, (title, unit) in _DECISIONS.items():
            item: Interval = getattr(found, key)
            if item.count:
                table.add_row(Text(title), number(item.value), _interval(item), str(item.count), Text(unit))
        kind, statement = described(monitor)
        print_section(console, f"Monitor {kind}", table)
        end = final_threshold(monitor)
        size = "" if end is None else f" ({number(end)} at the end of a run)"
        console.print(Text(f"Its threshold{size}: {statement}."))
        console.print()
    for title, errors in (("Fault estimates", found.fault_rmse), ("State estimates", found.state_rmse)):
        if not errors:
            continue
        table = headed_table("signal", "RMSE after warm-up", share, "unit")
        rows = sorted(errors.items(), key=lambda row: -row[1].value) if len(errors) > SHOWN else list(errors.items())
        if len(rows) > SHOWN:
            title = f"{title}: the worst {SHOWN} of {len(rows)}"
        for signal, item in rows[:SHOWN]:
            table.add_row(Text(signal), number(item.value), _interval(item), Text(units.get(signal, "")))
        print_section(console, f"{title} (mean over runs)", table)


def described(monitor: Monitor | ParameterMonitor) -> tuple[str, str]:
    """Return which monitor it is, and what its threshold means."""
    if isinstance(monitor, Monitor):
        return monitor.kind, monitor.statement
    return monitor.statistic, (
        "of a decision on parameters, passed in a run without a change with about the stated probability "
        f"({monitor.false_alarms:g})"
    )


def final_threshold(monitor: Monitor | ParameterMonitor) -> float | None:
    """Return the threshold at the end of a run; ``None`` where it is not the same in each run, or decides nothing."""
    if not isinstance(monitor, Monitor) or not monitor.threshold.size or not np.isfinite(monitor.threshold[-1]):
        return None
    return float(monitor.threshold[-1])


def _interval(item: Interval) -> str:
    return "-" if math.isnan(item.low) else f"{number(item.low)} to {number(item.high)}"
