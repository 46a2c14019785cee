"""Tables as comma-separated text that is harmless in spreadsheets, as aligned text, and as pages of HTML."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Sequence
from html import escape
from importlib.resources import files
from typing import Any, TextIO

#: A text that begins so is taken for a formula by spreadsheets; the last four are the full-width forms.
_FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")

#: Marks a cell as text in spreadsheets.
_MARK = "'"

#: A number at the begin of a cell of a table, and what follows it, such as a unit.
_NUMBER_CELL = re.compile(r"(-?(?:\d{1,3}(?:,\d{3})+|\d+))((?:\.\d+)?(?:e[-+]?\d+)?)(?=$| )(.*)")


def standing_page(title: str, body: Iterable[str], *, generator: str = "obsynth") -> str:
    """Return a page that stands alone, in the style of the reports; title and lines of the body are HTML."""
    style = files("obsynth.files").joinpath("page.css").read_text(encoding="utf-8")
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8">',
        f'<meta name="generator" content="{generator}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{title}</title>",
        f"<style>{style}</style>",
        "</head>",
        "<body>",
        f"<h1>{title}</h1>",
        *body,
        "</body>",
        "</html>",
    ]
    return "\n".join(parts) + "\n"


def table_writer(stream: TextIO, header: Iterable[str]) -> Callable[[Iterable[Sequence[Any]]], None]:
    """Write the header of a table, and return what writes its rows of numbers and texts: floats so that they are read
    back bit for bit, NaN as an empty cell, texts harmless."""
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([harmless(name) for name in header])
    return lambda rows: writer.writerows([[_cell(value) for value in row] for row in rows])


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


def aligned(cells: Sequence[str]) -> list[str]:
    """Return the cells of a column with decimal points below each other; what is no number stays as it is."""
    parts = [_NUMBER_CELL.fullmatch(cell) for cell in cells]
    before = max((len(part.group(1)) for part in parts if part), default=0)
    after = max((len(part.group(2)) for part in parts if part), default=0)
    if sum(part is not None for part in parts) < 2:
        return list(cells)
    return [
        cell if part is None else f"{part.group(1):>{before}}{part.group(2):<{after}}{part.group(3)}"
        for cell, part in zip(cells, parts, strict=True)
    ]


def text_table(rows: Sequence[Sequence[str]], *, left_aligned: int | None = None) -> list[str]:
    """Return the lines of a table: columns begin at the left, all or the first ``left_aligned``, others end right."""
    head, *body = rows
    rows = [head, *zip(*(aligned(column) for column in zip(*body, strict=True)), strict=True)] if body else rows
    widths = [max(len(row[j]) for row in rows) for j in range(len(rows[0]))]
    count = len(widths) if left_aligned is None else left_aligned
    placed = (
        [cell.ljust(w) if j < count else cell.rjust(w) for j, (cell, w) in enumerate(zip(row, widths, strict=True))]
        for row in rows
    )
    return ["  ".join(cells).rstrip() for cells in placed]


def html_table(rows: Sequence[Sequence[str]]) -> str:
    """Return a table of HTML with a header."""
    head = "".join(f"<th>{escape(text)}</th>" for text in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>" for row in rows[1:])
    return f"<table><tr>{head}</tr>{body}</table>"
