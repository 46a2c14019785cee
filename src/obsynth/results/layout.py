"""Shared pieces of the tables: numbers, verdicts, lists of names.

Text is always wrapped in `rich.text.Text`, so that brackets in a signal's name are never read as markup,
and a verdict is always a word, so that it is readable without colour.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from obsynth.numerics.arguments import is_number

#: Two values this near to each other, relative to their size or one, are shown as conjugates.
SAME_NUMBER = 1e-9
#: Values that are listed; the others are counted.
MOST_VALUES = 8


def number(value: float, *, digits: int = 4) -> str:
    """Return ``value`` with a few significant digits; a dash for "not a number", whatever a changed file may hold."""
    if not is_number(value) or math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return f"{value:.{digits}g}"


def complex_number(value: complex) -> str:
    """Return a real or complex value with four digits, such as ``0.9701 + 0.1277j``."""
    if value.imag == 0.0:
        return number(value.real)
    sign = "+" if value.imag > 0 else "-"
    return f"{number(value.real)} {sign} {number(abs(value.imag))}j"


def complex_numbers(values: Iterable[complex]) -> str:
    """Return several values as text, largest first; conjugate pairs once, as ``a +- bj``; long lists are cut."""
    waiting = sorted((complex(value) for value in values), key=lambda value: (-abs(value), -value.real, -value.imag))
    shown: list[str] = []
    while waiting:
        value = waiting.pop(0)
        partner = next((w for w in waiting if abs(w - value.conjugate()) <= SAME_NUMBER * max(1.0, abs(value))), None)
        if value.imag == 0.0 or partner is None:
            shown.append(complex_number(value))
        else:
            waiting.remove(partner)
            shown.append(f"{number(value.real)} +- {number(abs(value.imag))}j")
    return name_list(shown, limit=MOST_VALUES)


def name_list(names: Sequence[str], *, limit: int = 6) -> str:
    """Return names separated by commas; of a long list the first ones and how many more there are."""
    if not names:
        return "none"
    if len(names) <= limit + 1:
        return ", ".join(names)
    return f"{', '.join(names[:limit])} and {len(names) - limit} more"


def print_section(console: Console, title: str, content: RenderableType) -> None:
    """Print a title, the content below it, and an empty line."""
    console.print(Text(title, style="bold"))
    console.print(content)
    console.print()


def headed_table(*headings: str) -> Table:
    """Return an empty table with a line below its headings; all columns but the first align right."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    for position, heading in enumerate(headings):
        # A heading may be folded between its words, never within one.
        longest = max(map(len, heading.split()), default=0)
        table.add_column(heading, justify="right" if position else "left", min_width=longest)
    return table


def facts_table(rows: Iterable[Sequence[str]], *, headings: Sequence[str] = ()) -> Table:
    """Return a table of labels with one or more values each."""
    table = Table(
        box=None, show_header=bool(headings), pad_edge=False, padding=(0, 2, 0, 0), header_style="dim",
    )  # fmt: skip
    listed = [tuple(row) for row in rows]
    for column in range(max((len(row) for row in listed), default=0)):
        heading = headings[column] if column < len(headings) else ""
        table.add_column(heading, overflow="fold", no_wrap=column == 0, style="dim" if column == 0 else "")
    for row in listed:
        table.add_row(*(Text(cell) for cell in row))
    return table
