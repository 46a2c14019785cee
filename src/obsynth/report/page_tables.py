"""Tables of a page: facts, checks in the order of the argument, matrices; every text is escaped."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from itertools import groupby
from typing import Any

import numpy as np
from rich.table import Table

from obsynth.files.tables import aligned
from obsynth.numerics.arrays import FloatArray
from obsynth.results.checks import Check, Status
from obsynth.results.layout import shown_numbers, verdict, worth
from obsynth.results.number_texts import number

#: Prefix of a check's name -> heading of its group; the others are about the shipped observer.
_CHECK_GROUPS = {"plant": "The plant", "exists": "Does such an observer exist?"}

_SHIPPED = "The shipped observer"

#: Characters of an option; a solver's log may be long.
LONGEST_VALUE = 400

#: What each word behind a verdict means.
CHECK_STATUSES: dict[Status, str] = {
    "proved": "with a bound on every rounding error, on the numbers that are stored",
    "recomputed": "in double precision, by a route that shares no intermediate result with the design",
    "estimated": "statistics, with the interval in which chance alone puts the number",
    "assumed": "stated in the gain set, and not checked",
}


def fact_rows(rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield a table of labels with one or more values each."""
    yield '<div class="scroll"><table class="facts"><tbody>'
    for label, *values in rows:
        cells = "".join(f"<td>{escape(value)}</td>" for value in values)
        yield f'<tr><th scope="row">{escape(label)}</th>{cells}</tr>'
    yield "</tbody></table></div>"


def copied_table(table: Table) -> Iterator[str]:
    """Yield a terminal's table as one of the page."""
    rows = zip(*(map(str, column.cells) for column in table.columns), strict=True)
    yield from table_lines([str(column.header) for column in table.columns], rows)


def table_lines(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield a table with headings; all columns but the first hold numbers."""
    kinds, rows = ["", *["number"] * (len(headings) - 1)], [tuple(row) for row in rows]
    rows = list(zip(*map(aligned, zip(*rows, strict=True)), strict=True)) if rows else rows
    yield '<div class="scroll"><table class="copied"><thead><tr>'
    yield "".join(f'<th class="{kind}">{escape(text)}</th>' for kind, text in zip(kinds, headings, strict=True))
    yield "</tr></thead><tbody>"
    for row in rows:
        cells = (f'<td class="{kind}">{escape(text)}</td>' for kind, text in zip(kinds, row, strict=True))
        yield f"<tr>{''.join(cells)}</tr>"
    yield "</tbody></table></div>"


def check_rows(checks: Sequence[Check]) -> Iterator[str]:
    """Yield the table of the checks, those that fail in a group of their own at the top, and what the kinds mean."""
    yield '<div class="scroll"><table class="checks"><thead><tr>'
    yield "".join(
        f'<th class="{"number" if heading in ("value", "bound", "margin") else ""}">{heading}</th>'
        for heading in ("verdict", "check", "value", "bound", "margin", "source")
    )
    yield "</tr></thead>"
    for title, members in groupby(sorted(checks, key=_place), key=_group):
        yield f'<tbody><tr><th colspan="6" scope="rowgroup">{escape(title)}</th></tr>'
        yield from map(_row, members)
        yield "</tbody>"
    yield "</table></div>"
    yield "<h3>What the words mean</h3>"
    yield from fact_rows(
        (status, meaning)
        for status, meaning in CHECK_STATUSES.items()
        if any(check.status == status for check in checks)
    )


def _group(check: Check) -> str:
    return "What fails" if not check.passed else _CHECK_GROUPS.get(check.name.partition(":")[0], _SHIPPED)


def _place(check: Check) -> int:
    return ("What fails", *_CHECK_GROUPS.values(), _SHIPPED).index(_group(check))


def _row(check: Check) -> str:
    word = verdict(check).plain
    detail = f"<div>{escape(check.detail)}</div>" if check.detail else ""
    marked = f'<span class="kind">{escape(worth(check))}</span>'
    numbers = "".join(
        f'<td class="number{" none" if text in ("", "-") else ""}" data-label="{label}">{text}</td>'
        for label, text in zip(("value", "bound", "margin"), shown_numbers(check), strict=True)
    )
    return (
        f'<tr><td class="word {word.lower()}" data-label="verdict">{word}{marked}</td>'
        f'<td><strong>{escape(check.name)}</strong><div class="claim">{escape(check.claim)}</div>{detail}</td>'
        f'{numbers}<td class="source">{escape(check.source)}</td></tr>'
    )


def matrix_rows(matrix: FloatArray) -> Iterator[str]:
    """Yield a matrix ``(rows, cols)``; zeros are faint."""
    if not matrix.size:
        yield '<p class="soft">empty</p>'
        return
    yield '<div class="scroll tall"><table class="matrix"><tbody>'
    for row in matrix.tolist():
        cells = (
            f'<td class="number{"" if value else " zero"}">{number(value, digits=6) if value else "0"}</td>'
            for value in row
        )
        yield f"<tr>{''.join(cells)}</tr>"
    yield "</tbody></table></div>"


def value_text(value: Any) -> str:
    """Return an option or a solver's setting as one line: matrices by rows, diagonal ones as such; long ones cut."""
    text = _text(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]} ... (the gain set has all of it)"


def _text(value: Any) -> str:
    if value is None or isinstance(value, (bool, np.bool_)):
        return {None: "none", True: "yes", False: "no"}[None if value is None else bool(value)]
    if isinstance(value, (int, float)):
        return number(float(value), digits=7)
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_text(item)}" for key, item in value.items()) or "none"
    if isinstance(value, np.ndarray) and value.ndim == 2:
        if len(value) > 1 and value.shape[0] == value.shape[1] and not np.any(value[~np.eye(len(value), dtype=bool)]):
            return f"diag({', '.join(map(_text, np.diag(value).tolist()))})"
        return f"[{'; '.join(', '.join(map(_text, row)) for row in value.tolist())}]"
    if isinstance(value, (list, tuple)) and value and all(isinstance(item, Mapping) for item in value):
        return "; ".join(map(_text, value))
    if isinstance(value, (list, tuple, np.ndarray)):
        return f"[{', '.join(_text(item) for item in value)}]" if len(value) else "none"
    return str(value)


def listed(texts: Sequence[str]) -> Iterator[str]:
    """Yield a list of sentences."""
    yield "<ul>"
    yield from (f"<li>{escape(text)}</li>" for text in texts)
    yield "</ul>"
