"""A run on data in a few lines of text: rows, outliers, alarms, and what the threshold means."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from obsynth.files.tables import text_table
from obsynth.monitoring.alarms.events import alarm_notes, alarm_rows, silence, time_in_alarm
from obsynth.monitoring.statement_lines import statement_lines
from obsynth.plants.signal_names import listed

if TYPE_CHECKING:
    from obsynth.monitoring.logs.run import DataRun
    from obsynth.monitoring.thresholds.monitor import Monitor


def summary_of_run(run: DataRun, watched: Monitor | None, units: Mapping[str, str] | None = None) -> str:
    """Return what a run was, in a few lines; ``units``: of the plant's signals, by name."""
    counts = ", ".join(f"{count} {status}" for status, count in run.statuses.items())
    lines = [f"{run.rows} rows: {counts}."]
    if run.recovered:
        states = [f"{name} ({kind.replace('needs', 'with')})" for name, kind in run.recovered.items()]
        lines.append(f"Also estimated, of the plant as written: {listed(states)}.")
    if run.outliers:
        listed_outliers = ", ".join(f"{count} of {name}" for name, count in run.outliers.items())
        count = sum(run.outliers.values())
        lines.append(f"{count} outlier{'s' if count != 1 else ''}: {listed_outliers}.")
    for name, time in run.alarms.items():
        first = next((event for event in run.events if event.by == name), None)
        clear = watched is not None and name == watched.kind and first is not None and first.clear
        fault = f" Probable fault: {first.fault}." if clear and first is not None else ""
        by = f"threshold of {name}" if name in run.thresholds else f"monitor: {name}"
        lines.append(f"First alarm {run.stamps.shown(time)} ({by}).{fault}")
    rows, more = alarm_rows(run.events, run.stamps.shown, units)
    table = [*(text_table(rows) if rows else []), *([f"and {more} more"] if more else [])]
    lines += [*(f"  {line}" for line in table), *alarm_notes(run.events), *time_in_alarm(run.events, run.rows)]
    if watched is not None or run.thresholds or run.statement:
        lines += silence(run, watched.kind if watched else "any threshold")
    if watched is not None:
        lines += statement_lines(f"The {watched.kind} threshold: ", watched.statement)
    elif run.statement:
        lines += statement_lines("The threshold: ", run.statement)
    return "\n".join(lines)


def text_of_run(run: DataRun) -> str:
    """Return what ``print(run)`` shows: the same with warnings, and where the estimates are."""
    table = [] if run.table is None else [f"Estimates of {len(run.table)} rows are in its table."]
    return "\n".join([summary_of_run(run, None), *(f"Warning: {text}" for text in run.warnings), *table])
