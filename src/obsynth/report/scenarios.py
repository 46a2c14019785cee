"""Simulations, evaluations and comparisons for people: how far estimates were off, how often alarms were right."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.text import Text

from obsynth.observers.decisions import ParameterMonitor
from obsynth.results.layout import duration, headed_table, number, print_section

if TYPE_CHECKING:
    from obsynth.monitoring.thresholds.monitor import Monitor
    from obsynth.simulation.simulate import Simulation
    from obsynth.studies.comparison import Comparison
    from obsynth.studies.evaluate import Evaluation, Interval


#: Rows of a table; of a large plant the worst estimates are shown.
SHOWN_ROWS = 12

_DECISIONS = {
    "false_alarm_rate": ("false alarms", "share of runs"),
    "missed_detection_rate": ("missed detections", "share of runs"),
    "detection_delay": ("detection delay", "s"),
    "isolation_error_rate": ("wrong fault named", "share of detections"),
}


#: Columns left out where the console is narrower than so many characters.
NARROW = 130

_LESS = ("order", "s to 50 %", "at horizon", "peak", "bias", "s to alarm", "smallest", "ms")

#: Columns of names, how wide they are there (eighty columns less six of numbers), and how wide headings of numbers.
_NAME_COLUMNS = ("method", "fault")

_NAME_WIDTH, _HEADING_WIDTH = 11, 8


def evaluation_report(
    name: str,
    found: Evaluation,
    *,
    monitor: Monitor | ParameterMonitor | None,
    console: Console,
    units: Mapping[str, str],
    beside: Sequence[str] = (),
) -> None:
    """Print rates, delays and errors over many runs; ``beside``: sentences on thresholds."""
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
    for sentence in beside:
        console.print(Text(sentence))
    for title, errors in (("Fault estimates", found.fault_rmse), ("State estimates", found.state_rmse)):
        if errors:
            table = headed_table("signal", "RMSE after warm-up", share, "unit")
            title, rows = _worst(title, list(errors.items()), lambda row: row[1].value)
            for signal, item in rows:
                table.add_row(Text(signal), number(item.value), _interval(item), Text(units.get(signal, "")))
            print_section(console, f"{title} (mean over runs)", table)


def _worst(title: str, rows: list[Any], size: Callable[[Any], float]) -> tuple[str, list[Any]]:
    """Return title and rows of a table; of many the worst."""
    if len(rows) <= SHOWN_ROWS:
        return title, rows
    return f"{title}: the worst {SHOWN_ROWS} of {len(rows)}", sorted(rows, key=lambda row: -size(row))[:SHOWN_ROWS]


def described(monitor: Monitor | ParameterMonitor) -> tuple[str, str]:
    """Return which monitor it is, and what its threshold means."""
    if not isinstance(monitor, ParameterMonitor):
        return monitor.kind, monitor.statement
    return monitor.statistic, (
        "of a decision on parameters, passed in a run without a change with about the stated probability "
        f"({monitor.false_alarms:g})"
    )


def final_threshold(monitor: Monitor | ParameterMonitor) -> float | None:
    """Return the threshold at the end of a run; ``None`` where it is not the same in each run, or decides nothing."""
    if isinstance(monitor, ParameterMonitor) or not monitor.threshold.size or not np.isfinite(monitor.threshold[-1]):
        return None
    return float(monitor.threshold[-1])


def _interval(item: Interval) -> str:
    return "-" if math.isnan(item.low) else f"{number(item.low)} to {number(item.high)}"


def comparison_report(found: Comparison, *, console: Console, file: Path | None = None) -> None:
    """Print what was compared, the table, the refusals and the recommendation."""
    header, *rows = found.rows()
    wide = console.width >= NARROW
    kept = [i for i, name in enumerate(header) if wide or name not in _LESS]
    table = headed_table(
        *(header[i] if wide else fill(header[i], _HEADING_WIDTH, break_long_words=False) for i in kept)
    )
    # Only names break, and at their hyphens and blanks: a number that is cut is another number.
    for column, i in zip(table.columns, kept, strict=True):
        column.no_wrap = header[i] not in _NAME_COLUMNS
        if not column.no_wrap:
            words = [word for row in rows for word in row[i].replace("-", "- ").split()]
            column.min_width = min(max(map(len, [header[i], *words])), _NAME_WIDTH)
    for row in rows:
        texts = [row[i] if wide or header[i] not in _NAME_COLUMNS else fill(row[i], _NAME_WIDTH) for i in kept]
        table.add_row(*map(Text, texts))
    console.print(Text(found.setting))
    for note in found.notes:
        console.print(Text(note, style="yellow"))
    if rows:
        print_section(console, "", table)
        console.print(Text(found.meanings([header[i] for i in kept]), style="dim"))
    for refusal in found.refusals:
        console.print(Text(refusal, style="yellow"))
    console.print(Text(found.advice, style="bold"))
    if file is not None:
        console.print(Text(f"Written: {file}"), soft_wrap=True)


def simulation_report(
    name: str,
    found: Simulation,
    *,
    console: Console,
    units: Mapping[str, str],
    file: str | None = None,
) -> None:
    """Print errors of all estimates: after warm-up for linear designs, with the coverage of their bands for others."""
    summary = found.summary()
    console.print(Text(f"{name}: {summary['samples']} samples, {found.time[-1]:g} s", style="bold"))
    console.print()
    linear = not found.estimates.has_deviations
    for kind, title in (
        ("faults", "Fault estimates" if linear else "Parameter estimates"),
        ("states", "State estimates"),
    ):
        if not summary[kind]:
            continue
        lasts = _last_column(found, kind)
        table = headed_table("signal", "RMSE", "largest error", next(lasts), "unit")
        title, rows = _worst(title, list(zip(summary[kind].items(), lasts, strict=True)), lambda row: row[0][1]["rmse"])
        for (signal, row), last in rows:
            table.add_row(Text(signal), number(row["rmse"]), number(row["largest"]), last, Text(units.get(signal, "")))
        told = "errors of the whole record"
        if linear and (end := summary[f"{kind[:-1]}_warm_up"]) is None:
            told = "the initial-condition response has not settled: errors of the whole record"
        elif linear:
            told = f"errors from {duration(end)} on, when the start no longer shows"
        print_section(console, f"{title} ({told})", table)
    for note in summary["notes"]:
        console.print(Text(note))
    if file is not None:
        console.print(Text(f"Written: {file}"))


def _last_column(found: Simulation, kind: str) -> Iterator[str]:
    """Yield a heading, and a cell for each signal: delays of a linear observer, coverage of a recursive one."""
    if not found.estimates.has_deviations:
        yield "delay (samples)"
        yield from map(str, found.estimates.fault_delays if kind == "faults" else found.estimates.state_delays)
    else:
        yield "in its 95 % band"
        yield from (f"{100.0 * row['within_band']:.0f} %" for row in found.summary()[kind].values())
