"""Methods side by side, as a table that fits the console."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.text import Text

from obsynth.comparison.result import Comparison
from obsynth.report.layout import headed_table, print_section

#: Columns left out where the console is narrower than so many characters.
NARROW = 130
_LESS = ("order", "50 % s", "peak", "bias", "alarm s", "smallest", "ms")


def comparison_report(found: Comparison, *, console: Console, file: Path | None = None) -> None:
    """Print what was compared, the table, the refusals and the recommendation."""
    header, *rows = found.rows()
    kept = [i for i, name in enumerate(header) if console.width >= NARROW or name not in _LESS]
    table = headed_table(*(header[i] for i in kept))
    for column in table.columns:
        column.overflow = "fold"
    for row in rows:
        table.add_row(*(Text(row[i]) for i in kept))
    console.print(Text(found.setting))
    if rows:
        print_section(console, "", table)
    for refusal in found.refusals:
        console.print(Text(refusal, style="yellow"))
    console.print(Text(found.advice, style="bold"))
    if file is not None:
        console.print(Text(f"Written: {file}"), soft_wrap=True)
