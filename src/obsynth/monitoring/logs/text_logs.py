"""Logs as text: columns separated by commas, semicolons, tabs or bars, numbers with a point or a comma."""

from __future__ import annotations

import codecs
import csv
import itertools
import re
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from io import BufferedIOBase
from pathlib import Path
from typing import TextIO

import numpy as np

from obsynth.errors import SpecError, counted
from obsynth.files.tables import unquoted
from obsynth.monitoring.logs.signals import LogSignals, column_of, date_place, is_bad, status_places, with_date
from obsynth.monitoring.logs.stamps import MISSING_TEXTS, Stamps
from obsynth.numerics.arguments import number_in_text
from obsynth.numerics.arrays import FloatArray

#: What may separate columns, the first one that fits.
SEPARATORS = (",", ";", "\t", "|")

#: How programs of Microsoft say what separates the columns, in a line before the header.
_SEPARATOR_LINE = re.compile(r"\s*sep=(.)\s*", re.IGNORECASE)

#: What a remark of the logger begins with, before the header.
REMARK = "#"

#: Lines without any column that is read, among which a header is looked for.
MOST_REMARKS = 50

#: Lines that may end with CR alone.
_OLD_LINES = re.compile(r"[^\r]*\r\n?|[^\r]+")

#: What nearly all cells hold.
_PLAIN_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?([eE][+-]?\d+)?", re.ASCII)

#: What groups thousands: a blank of some kind or an apostrophe, or a point or comma that is not the decimal mark, or
#: stands twice; and a number whose only mark may do so.
_GROUPED = re.compile(
    r"([+-]?\d{1,3}(?:([ '\u00a0\u2009\u202f\u2019])\d{3}(?:\2\d{3})*"
    r"|(?:\.\d{3})+(?=,)|(?:,\d{3})+(?=\.)|(?:\.\d{3}){2,}|(?:,\d{3}){2,}))(?:([.,])(\d*))?"
)

_ONE_GROUP = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")

#: The name by which texts are opened that may hold such bytes.
WINDOWS_TEXT = "obsynth.windows"

#: What helps where a file is in another encoding than it seems to be.
SAVE_AS_TEXT = "If another program reads it, save it there as UTF-8."

#: What is said of a file that is no text in any encoding.
BINARY = (
    "{name} holds binary data, and no table of text. Export it as CSV from the program that wrote it, or let its name "
    "end as is usual for its kind (.parquet, .mat, .npz, .mf4, .tdms)."
)

#: Characters below the space that a text may have.
CONTROLS_IN_TEXTS = frozenset("\t\n\v\f\r\x1a")
#: Characters by which the letters of a text are judged, at least: a file that ends within a character has one.
FEWEST_JUDGED = 16


def number_in_cell(
    text: str | None, row: int, column: str, stamps: Stamps | None = None, *, comma: bool = False
) -> float:
    """Return the number in a cell, NaN where it is missing; a cell that is none is named with its row.
    A word is what loggers write for a bad sample: ``stamps`` counts these, and which columns show numbers; ``comma``:
    whether a comma in a number stands for its point."""
    if text is not None and not comma and _PLAIN_NUMBER.fullmatch(text):
        # As nearly all cells are.
        if stamps is not None:
            stamps.numeric.add(column)
        return float(text)
    cell = "" if text is None else text.strip()
    if cell.lower() in MISSING_TEXTS:
        return float("nan")
    try:
        number = number_in_text(cell.replace(",", ".") if comma and "." not in cell else cell)
        if comma and stamps is not None and ("," in cell or "." in cell):
            mark = "." if "." in cell else ","
            if stamps.decimals.get(column) != mark:
                stamps.take_mark(column, row, cell, mark, may_group=bool(_ONE_GROUP.fullmatch(cell)))
    except ValueError:
        grouped = _GROUPED.fullmatch(cell)
        if grouped is not None and stamps is not None:
            integer_part, mark, decimals = grouped[1], grouped[3] or "", grouped[4] or ""
            if mark:
                stamps.take_mark(column, row, cell, mark, may_group=False)
            stamps.numeric.add(column)
            return float(re.sub(r"[^\d+-]", "", integer_part) + "." + decimals)
        if stamps is not None and ("#" in cell or not any(letter.isdigit() for letter in cell)):
            stamps.take_word(column, row, cell)
            return float("nan")
        advice = ""
        if "," in cell:
            advice = (
                " Separate the columns by semicolons where numbers have a decimal comma."
                if not comma
                else " Leave out what groups thousands."
            )
        raise SpecError(f"Row {row}, column {column!r}: {text!r} is no number.{advice}", path=f"row {row}") from None
    if stamps is not None:
        stamps.numeric.add(column)
    return number


def _as_windows(error: UnicodeError) -> tuple[str, int]:
    """Return bytes that are no UTF-8 as Windows writes western letters, such as the degree in a unit."""
    if isinstance(error, UnicodeDecodeError) and error.encoding.lower().startswith("utf-8"):
        with suppress(UnicodeDecodeError):
            return error.object[error.start : error.end].decode("cp1252"), error.end
    raise error


codecs.register_error(WINDOWS_TEXT, _as_windows)


def encoding_of(stream: BufferedIOBase) -> str:
    """Return the encoding of a text: UTF-8 but where its first bytes say UTF-16 or UTF-32, with or without a mark."""
    first = stream.read(4)
    if first in (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE):
        return "utf-32"
    if first[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return "utf-16"
    # A header begins with characters of ASCII, whose upper byte is zero.
    return {b"\1\0": "utf-16-le", b"\0\1": "utf-16-be"}.get(bytes(map(bool, first[:2])), "utf-8-sig")


def no_text(path: Path, error: UnicodeDecodeError) -> SpecError:
    """Return what is told of a file whose bytes are no text."""
    if _is_binary(error):
        return SpecError(BINARY.format(name=path), path=str(path))
    name = next((name for name in ("UTF-16", "UTF-32") if error.encoding.upper().startswith(name)), "UTF-8")
    return SpecError(f"{path} is no {name} text (byte {error.start}). {SAVE_AS_TEXT}", path=str(path))


def _is_binary(error: UnicodeDecodeError) -> bool:
    """Whether bytes are no text with a flaw: they have characters that no text has, or hardly any of a table."""
    text = error.object.decode(error.encoding, "replace")
    return _has_controls(text) or (len(text) >= FEWEST_JUDGED and 2 * sum(map(str.isascii, text)) < len(text))


def _has_controls(text: str) -> bool:
    return any(character < " " and character not in CONTROLS_IN_TEXTS for character in text)


def text_chunks(
    path: Path, opened: AbstractContextManager[TextIO], signals: LogSignals, stamps: Stamps, rows: int
) -> Iterator[FloatArray]:
    """Yield ``(rows, 1 + nu + ny)`` of a file that is opened as text."""
    with opened as stream:
        if not stream.readline():
            raise SpecError(f"{path} cannot be read: it is empty.", path=str(path))
        stream.seek(0)
        try:
            yield from _together(stream_rows(stream, signals, stamps), rows)
        except SpecError as error:
            if (error.path or "").startswith("cells"):
                raise SpecError(f"{path} cannot be read: {error}", path=str(path)) from error
            raise


def stream_rows(stream: TextIO, signals: LogSignals, stamps: Stamps) -> Iterator[FloatArray]:
    """Yield one row at a time, ``(1, 1 + nu + ny)``, as soon as its line is there."""
    header, comma, table = opened_text(stream, signals.columns, stamps.notes)
    if not header:
        raise SpecError("The data are empty: their first line is the names of the columns.", path="data")
    places = signals.positions(header)
    stamps.take_header(header, signals.columns, places)
    date, states = date_place(header, places), status_places(header, places)
    factors, shifts = signals.conversions(header, places, stamps)
    row = 0
    for cells in table:
        if not any(cell.strip() for cell in cells):
            continue
        if row == 0 and stamps.take_units(below := [cells[place].strip() for place in places if place < len(cells)]):
            factors, shifts = signals.conversions(header, places, stamps, below)
            continue
        row += 1
        if any(cell.strip() for cell in cells[len(header) :]):
            advice = " If numbers have a decimal comma, separate the columns by semicolons." if not comma else ""
            raise SpecError(
                f"Row {row} has {len(cells)} cells, but the header has {len(header)}.{advice}",
                path=f"cells of row {row}",
            )
        cells = [*cells[: len(header)], *[""] * (len(header) - len(cells))]
        stamp = cells[places[0]] if date is None else with_date(cells[date], cells[places[0]])
        time = stamps.read(stamp, row, header[places[0]], comma=comma)
        values = [number_in_cell(cells[place], row, header[place], stamps, comma=comma) for place in places[1:]]
        for i, place in enumerate(states):
            if place is not None and is_bad(cells[place]):
                stamps.take_bad(header[places[i]], row, cells[place].strip(), header[place])
                values[i - 1] = float("nan")
        yield np.array([[time, *(factors * values + shifts)]])
    if row == 0:
        raise SpecError("The data have no rows.", path="data")


def opened_text(
    stream: TextIO, wanted: Sequence[str], notes: list[str] | None = None
) -> tuple[tuple[str, ...], bool, Iterator[list[str]]]:
    """Return the names of the columns, whether numbers may have a decimal comma, and the cells of the lines below the
    header.  What a logger remarks before the header, in blank lines, in lines that begin with ``#`` and name no column
    that is read, and in other lines before one that names the time and another such column, is passed over."""
    lines = _text_lines(stream)
    head = next(lines, "")
    while (head and not head.strip()) or (
        head.startswith(REMARK)
        and not any(column_of(_names(head, separator), name) for separator in SEPARATORS for name in wanted)
    ):
        head = next(lines, "")
    separator_line = _SEPARATOR_LINE.fullmatch(head)
    head = next(lines, "") if separator_line else head
    if not separator_line and not _named(head, wanted):
        head, lines = _after_remarks(head, lines, wanted, notes)
    # A logger that lost its power leaves a file of zeros.
    if "\0" in head:
        raise SpecError(BINARY.format(name=getattr(stream, "name", "The log")), path="data")
    separator = separator_line.group(1) if separator_line else _separator_of(head, wanted)
    # A name in quotes may go on in the next line.
    table = _cells(itertools.chain([head], lines), separator)
    return tuple(unquoted(name.strip()) for name in next(table, [])), separator != ",", table


def _named(head: str, wanted: Sequence[str]) -> int:
    """Return how many of the columns that are wanted a line names, whatever separates them."""
    named = (_names(head, separator) for separator in SEPARATORS)
    return max(sum(column_of(names, name) is not None for name in wanted) for names in named)


def _after_remarks(
    head: str, lines: Iterator[str], wanted: Sequence[str], notes: list[str] | None
) -> tuple[str, Iterator[str]]:
    """Return the first of the next lines that names the time and another column that is read, and the lines below it;
    where there is none, the lines as they are."""
    needed = min(len(wanted), 2)
    passed: list[str] = []
    for line in itertools.islice(lines, MOST_REMARKS):
        if _named(line, wanted[:1]) and _named(line, wanted) >= needed:
            if notes is not None:
                notes.append(
                    f"Passed over {counted(len(passed) + 1, 'line')} before the header, first {head.strip()!r}."
                )
            return line, lines
        passed.append(line)
    return head, itertools.chain(passed, lines)


def _together(rows: Iterator[FloatArray], count: int) -> Iterator[FloatArray]:
    while block := list(itertools.islice(rows, count)):
        yield np.concatenate(block)


def _separator_of(head: str, wanted: Sequence[str]) -> str:
    """Return what separates the columns of a log: what finds the columns that are read, or finds most."""
    names_by_separator = {separator: _names(head, separator) for separator in SEPARATORS}
    complete = next(
        (s for s, names in names_by_separator.items() if all(column_of(names, name) for name in wanted)), None
    )
    return complete or max(SEPARATORS, key=lambda s: len(names_by_separator[s]))


def _names(head: str, separator: str) -> Sequence[str]:
    try:
        return [unquoted(name.strip()) for name in next(csv.reader([head], delimiter=separator), [])]
    except csv.Error:
        return []


def _cells(lines: Iterator[str], separator: str) -> Iterator[list[str]]:
    """Yield the cells of each line; what is no text, or no table, is a `SpecError`."""
    table = csv.reader(lines, delimiter=separator)
    for row in itertools.count():
        try:
            cells = next(table, None)
        except csv.Error as error:
            raise SpecError(f"Row {row} of the data cannot be read: {error}.", path=f"row {row}") from error
        if cells is None:
            return
        yield cells


def _text_lines(stream: TextIO) -> Iterator[str]:
    """Yield lines as they come; lines that end with CR alone, as of old, come together where a stream keeps these."""
    is_first = True
    for count in itertools.count():
        try:
            block = stream.readline()
        except UnicodeDecodeError as error:
            name = getattr(stream, "name", "The data")
            if _is_binary(error):
                raise SpecError(BINARY.format(name=name), path="data") from error
            place = f"after line {count}" if count else "in its first line"
            raise SpecError(f"{name} is no text of its encoding {place}. {SAVE_AS_TEXT}", path="data") from error
        if not block:
            return
        for line in _OLD_LINES.findall(block):
            # A byte order mark is no part of the first name.
            yield line.removeprefix("\ufeff") if is_first else line
            is_first = False
