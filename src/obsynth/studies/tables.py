"""Tables of evaluations and comparisons: rates of alarms, errors of estimates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.text import Text

from obsynth.monitoring.thresholds.parameter_decisions import ParameterMonitor
from obsynth.report.scenarios import NOT_SETTLED, worst_rows
from obsynth.results.layout import headed_table, print_section, printed
from obsynth.results.number_texts import number

if TYPE_CHECKING:
    from obsynth.monitoring.thresholds.monitor import Monitor
    from obsynth.studies.comparison import Comparison
    from obsynth.studies.evaluate import Evaluation, Interval


_DECISIONS = {
    "false_alarm_rate": ("false alarms", "share of runs"),
    "missed_detection_rate": ("missed detections", "share of runs"),
    "detection_delay": ("detection delay", "s"),
    "isolation_error_rate": ("wrong fault named", "share of detections"),
}

#: Columns left out where the console is narrower than so many characters.
NARROW = 160

_LESS = (
    "order",
    "s to 50 %",
    "at horizon",
    "peak",
    "bias",
    "s to alarm",
    "smallest",
    "gain / least",
    "noise / least",
    "ms",
)

#: Columns of names, how wide they are there (eighty columns less six of numbers), and how wide headings of numbers.
_NAME_COLUMNS = ("method", "fault")

_NAME_WIDTH, _HEADING_WIDTH = 11, 8


def evaluation_text(evaluation: Evaluation) -> str:
    """Return what ``print(evaluation)`` shows."""
    return printed(lambda console: evaluation_report("Evaluation", evaluation, monitor=None, console=console, units={}))


def evaluation_report(
    name: str,
    evaluation: Evaluation,
    *,
    monitor: Monitor | ParameterMonitor | None,
    console: Console,
    units: Mapping[str, str],
    beside: Sequence[str] = (),
) -> None:
    """Print rates, delays and errors over many runs; ``beside``: sentences on thresholds."""
    share = f"{100.0 * evaluation.confidence:g} % interval"
    console.print(Text(f"{name}: {evaluation.runs} runs", style="bold"))
    console.print()
    decided = {key: item for key in _DECISIONS if (item := getattr(evaluation, key)).count}
    if monitor is not None or decided:
        table = headed_table("decisions", "value", share, "of", "unit")
        for key, item in decided.items():
            title, unit = _DECISIONS[key]
            table.add_row(Text(title), number(item.value), _interval(item), str(item.count), Text(unit))
        print_section(console, "Monitor" if monitor is None else f"Monitor {described(monitor)[0]}", table)
    if monitor is not None:
        end = final_threshold(monitor)
        _, statement = described(monitor)
        size = "" if end is None else f" ({number(end)} at the end of a run)"
        if not isinstance(monitor, ParameterMonitor) and monitor.rule.adapts:
            size = " (it adapts to the signals of each run)"
        console.print(Text(f"Its threshold{size}: {statement}."))
        console.print()
    for sentence in beside:
        console.print(Text(sentence))
    estimates = "Parameter" if evaluation.recursive else "Fault"
    for title, errors, warm_up in (
        (f"{estimates} estimates", evaluation.fault_rmse, evaluation.fault_warm_up),
        ("State estimates", evaluation.state_rmse, evaluation.state_warm_up),
    ):
        if errors:
            since = "from row 1 on" if evaluation.recursive else "after warm-up"
            table = headed_table("signal", "RMSE" if warm_up is None else f"RMSE {since}", share, "unit")
            title, rows = worst_rows(title, list(errors.items()), lambda row: row[1].value)
            for signal, item in rows:
                table.add_row(Text(signal), number(item.value), _interval(item), Text(units.get(signal, "")))
            of = "" if warm_up is not None else f"; {NOT_SETTLED}"
            print_section(console, f"{title} (mean over runs, against the signals of their time{of})", table)


def described(monitor: Monitor | ParameterMonitor) -> tuple[str, str]:
    """Return which monitor it is, and what its threshold means."""
    if not isinstance(monitor, ParameterMonitor):
        return monitor.kind, monitor.statement
    return monitor.statistic, (
        "of a decision on parameters, passed in a run without a change with about the stated probability "
        f"({monitor.false_alarms:g})"
    )


def final_threshold(monitor: Monitor | ParameterMonitor) -> float | None:
    """Return what an alarm passes at the end of a run, with what rounding may add; ``None`` where it is not the same in
    each run, or decides nothing."""
    if isinstance(monitor, ParameterMonitor) or monitor.rule.adapts:
        return None
    if not monitor.threshold.size or not np.isfinite(monitor.threshold[-1]):
        return None
    return float(monitor.threshold[-1] + monitor.floor)


def _interval(item: Interval) -> str:
    return "-" if math.isnan(item.low) else f"{number(item.low)} to {number(item.high)}"


def comparison_report(comparison: Comparison, *, console: Console, file: Path | None = None) -> None:
    """Print what was compared, the table, the refusals and the recommendation."""
    header, *rows = comparison.rows()
    wide = console.width >= NARROW
    columns = [i for i, name in enumerate(header) if wide or name not in _LESS]
    table = headed_table(
        *(header[i] if wide else fill(header[i], _HEADING_WIDTH, break_long_words=False) for i in columns)
    )
    # Only names break, and at their hyphens and blanks: a number that is cut is another number.
    for column, i in zip(table.columns, columns, strict=True):
        column.no_wrap = header[i] not in _NAME_COLUMNS
        if not column.no_wrap:
            words = [word for row in rows for word in row[i].replace("-", "- ").split()]
            column.min_width = min(max(map(len, [header[i], *words])), _NAME_WIDTH)
    for row in rows:
        texts = [row[i] if wide or header[i] not in _NAME_COLUMNS else fill(row[i], _NAME_WIDTH) for i in columns]
        table.add_row(*map(Text, texts))
    console.print(Text(comparison.setting))
    for note in comparison.notes:
        console.print(Text(note, style="yellow"))
    if rows:
        print_section(console, "", table)
        console.print(Text(comparison.meanings([header[i] for i in columns]), style="dim"))
    for text in comparison.beside_the_least:
        console.print(Text(text))
    for refusal in comparison.refusals:
        console.print(Text(refusal, style="yellow"))
    console.print(Text(comparison.advice, style="bold"))
    if file is not None:
        console.print(Text(f"Written: {file}"), soft_wrap=True)
