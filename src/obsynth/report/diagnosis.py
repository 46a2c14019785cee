"""The diagnosis of a plant as tables."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from obsynth.analysis.diagnosis.verdicts import Diagnosis
from obsynth.report.layout import headed_table, print_section

#: Of a bank of residuals so many rows are shown.
MOST_ROWS = 12


def diagnosis_report(diagnosis: Diagnosis, *, console: Console, everything: bool = True) -> None:
    """Print what can be diagnosed: verdicts and sentences; isolability and banks with ``everything``."""
    if not diagnosis.faults:
        return
    print_section(console, diagnosis.heading, _table(diagnosis.verdict_rows()))
    if everything and len(diagnosis.faults) > 1:
        rows = diagnosis.bank_rows()
        print_section(console, "Which fault can be told from which", _table(diagnosis.isolability_rows()))
        more = len(rows) - 1 - MOST_ROWS
        title = "Structured residuals" + (f" ({more} more are not shown)" if more > 0 else "")
        if len(rows) > 1:
            print_section(console, title, _table(rows[: MOST_ROWS + 1]))
    for sentence in diagnosis.sentences:
        console.print(Text(sentence))
    for warning in diagnosis.warnings:
        console.print(Text(f"Warning: {warning}", style="yellow"))
    if diagnosis.sentences or diagnosis.warnings:
        console.print()


def _table(rows: Sequence[Sequence[str]]) -> Table:
    table = headed_table(*rows[0])
    for column in table.columns:
        column.overflow = "fold"
    for row in rows[1:]:
        table.add_row(*(Text(text) for text in row))
    return table
