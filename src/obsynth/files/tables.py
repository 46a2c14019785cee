"""Tables as comma-separated text that is harmless in spreadsheets, as aligned text, and as HTML."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any, Protocol

#: A text that begins so is taken for a formula by spreadsheets; the last four are the full-width forms.
_FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")
#: Marks a cell as text in spreadsheets.
_MARK = "'"


class _Writable(Protocol):
    def write(self, text: str, /) -> Any: ...


class TableWriter:
    """Rows to a text stream; floats so that they are read back bit for bit, NaN as an empty cell, texts harmless."""

    def __init__(self, stream: _Writable, header: Iterable[str]) -> None:
        self._writer = csv.writer(stream, lineterminator="\n")
        self._writer.writerow([harmless(name) for name in header])

    def write(self, rows: Iterable[Sequence[Any]]) -> None:
        """Write rows of numbers and texts."""
        self._writer.writerows([[_cell(value) for value in row] for row in rows])


def harmless(text: str) -> str:
    """Return a text as a cell that no spreadsheet takes for a formula: with an apostrophe in front where needed."""
    return _MARK + text if text.lstrip().startswith(_FORMULA) or text.startswith(("\t", "\r", "\n")) else text


def unquoted(cell: str) -> str:
    """Return the text of a cell that `harmless` may have marked."""
    return cell[1:] if cell.startswith(_MARK) and harmless(cell[1:]) == cell else cell


def _cell(value: Any) -> Any:
    if isinstance(value, str):
        return harmless(value)
    return "" if value != value else value


def text_table(rows: Sequence[Sequence[str]], *, left: int | None = None) -> list[str]:
    """Return the lines of a table; its columns, or the first ``left`` of them, begin at the left, others end right."""
    widths = [max(len(row[j]) for row in rows) for j in range(len(rows[0]))]
    count = len(widths) if left is None else left
    aligned = (
        [cell.ljust(w) if j < count else cell.rjust(w) for j, (cell, w) in enumerate(zip(row, widths, strict=True))]
        for row in rows
    )
    return ["  ".join(cells).rstrip() for cells in aligned]


def html_table(rows: Sequence[Sequence[str]]) -> str:
    """Return a table of HTML with a header."""
    head = "".join(f"<th>{escape(text)}</th>" for text in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>" for row in rows[1:])
    return f"<table><tr>{head}</tr>{body}</table>"
