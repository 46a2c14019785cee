"""Tables of the page: facts, checks in the order of the argument, matrices; every text is escaped."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from itertools import groupby
from typing import Any

import numpy as np
from rich.table import Table

from obsynth.numerics.arrays import FloatArray
from obsynth.results.checks import Check, CheckKind, Status
from obsynth.results.layout import number, verdict

#: Prefix of a check's name -> heading of its group; the others are about the shipped observer.
_GROUPS = {"plant": "The plant", "exists": "Does such an observer exist?"}
_SHIPPED = "The shipped observer"
#: Characters of an option; a solver's log may be long.
LONGEST_VALUE = 400
#: What each kind of check is worth.
KINDS: dict[CheckKind, str] = {
    "proved": "an inequality that was proved, with bounds on every rounding error",
    "condition": "an existence condition of the method, on the plant alone",
    "equality": "an identity: what is left of it, against a bound scaled by the size of its terms; it is not called "
    "proved",
    "computed": "a number that was found again by a second route",
    "information": "a number worth knowing that no verdict depends on",
}
#: What each row is worth, whatever its kind.
STATUSES: dict[Status, str] = {
    "proved": "outward rounding, on the numbers that are stored",
    "computed twice": "double precision, by a route that shares no intermediate result with the design",
    "estimated": "statistics, with the interval in which chance alone puts the number",
    "assumed": "stated by whoever made the design, and not checked",
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
    kinds = ["", *["number"] * (len(headings) - 1)]
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
    yield "<h3>What each kind of check is worth</h3>"
    yield from fact_rows([
        *((kind, meaning) for kind, meaning in KINDS.items() if any(check.kind == kind for check in checks)),
        *((f"({status})", meaning) for status, meaning in STATUSES.items()
          if any(check.status == status for check in checks)),
    ])  # fmt: skip


def _group(check: Check) -> str:
    return "What fails" if not check.passed else _GROUPS.get(check.name.partition(":")[0], _SHIPPED)


def _place(check: Check) -> int:
    return ("What fails", *_GROUPS.values(), _SHIPPED).index(_group(check))


def _row(check: Check) -> str:
    word = verdict(check).plain
    detail = f"<div>{escape(check.detail)}</div>" if check.detail else ""
    parts = dict.fromkeys([*([] if word == "info" else [check.kind]), f"({check.status})"])
    kind = f'<span class="kind">{escape(" ".join(parts))}</span>'
    numbers = "".join(
        f'<td class="number{" none" if number(value) == "-" else ""}" data-label="{label}">{number(value)}</td>'
        for label, value in (("value", check.value), ("bound", check.bound), ("margin", check.margin))
    )
    return (
        f'<tr><td class="word {word.lower()}" data-label="verdict">{word}{kind}</td>'
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
