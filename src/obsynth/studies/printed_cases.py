"""Tables of many designs or many runs as text that fits the width of a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from obsynth.methods.registry import REGISTRY, method_class
from obsynth.results.layout import headed_table
from obsynth.results.number_texts import bound_number, point_in_time

#: Number of blanks between columns.
_BLANKS_BETWEEN = 2


def printed_cases(outcome: Any, width: int, *, rest: str) -> Any:
    """Return the printed table of a sweep, without the columns message and file."""
    header, rows = outcome.rows()
    columns = [i for i, name in enumerate(header) if name not in ("message", "file")]
    sides = {name: meaning.side for method in REGISTRY for name, meaning in method_class(method).claims.items()}
    texts = (
        [bound_number(row[i], sides.get(header[i], "")) if isinstance(row[i], float) else str(row[i]) for i in columns]
        for row in rows
    )
    return _printed(outcome, [header[i] for i in columns], texts, width, rest)


def printed_runs(outcome: Any, width: int, *, rest: str) -> Any:
    """Return the printed table of runs, with the first alarm of each, or the reason why it has no result."""
    rows = []
    for run in outcome.runs:
        first = min(run.alarms, key=lambda name: run.alarms[name], default="")
        alarm = f"{first} at {point_in_time(run.alarms[first])}" if first else "-"
        rows.append((run.name, run.status, str(run.rows), str(run.statuses.get("ok", 0)), alarm, run.message))
    return _printed(outcome, ("run", "status", "rows", "ok", "first alarm", "why not"), rows, width, rest)


def _printed(outcome: Any, header: Sequence[str], rows: Iterable[Sequence[str]], width: int, rest: str) -> Any:
    """Return a printed table, below a line of counts, the columns that are equal in all rows, and the omitted ones."""
    from rich.console import Group
    from rich.text import Text

    listed = [tuple("" if cell == "nan" else cell for cell in row) for row in rows]
    columns = dict(zip(header, zip(*listed, strict=True), strict=True)) if listed else {}
    headings = {name: _heading(name, header) for name in header}
    filled = {name: column for name, column in columns.items() if any(column)}
    same = {name: column[0] for name, column in filled.items() if len(listed) > 1 and len(set(column)) == 1}
    printed, widths, missing, room = (
        dict[str, tuple[str, ...]](),
        dict[str, int](),
        list[str](),
        width + _BLANKS_BETWEEN,
    )
    for name, column in filled.items():
        if name not in same:
            # Texts fold at blanks, so a column needs the width of its longest word; a cut number would be wrong.
            words = [word for text in (headings[name], *column) for word in text.split()]
            wide = max(map(len, words)) + _BLANKS_BETWEEN
            if wide <= room:
                printed[name], widths[name], room = column, wide - _BLANKS_BETWEEN, room - wide
            else:
                missing.append(name)
    lines = [", ".join(f"{count} {status}" for status, count in outcome.counts.items())]
    if same:
        lines.append(f"In all of them: {', '.join(f'{name} {value}' for name, value in same.items())}.")
    if missing:
        lines.append(f"In {rest} alone: {', '.join(missing)}.")
    table = headed_table(*(headings[name] for name in printed))
    for place, (name, cells) in zip(table.columns, printed.items(), strict=True):
        # Remaining space goes to the first columns whose texts are longer.
        more = min(max(map(len, cells)) - widths[name], room)
        place.width, room = widths[name] + max(more, 0), room - max(more, 0)
    for row in zip(*printed.values(), strict=True):
        table.add_row(*(Text(cell or "-") for cell in row))
    return Group(*map(Text, lines), Text(), table)


def _heading(name: str, names: Sequence[str]) -> str:
    """Return the name of a column in words: its last part, or all of it where another column ends like it.

    It may fold at its blanks; table.csv keeps the name itself."""
    last = name.rpartition(".")[2]
    is_alone = sum(other.rpartition(".")[2] == last for other in names) == 1
    return (last if is_alone else name.replace(".", ". ")).replace("_", " ")
