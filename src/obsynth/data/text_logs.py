"""Logs as text: columns separated by commas, semicolons, tabs or bars, numbers with a point or a comma."""

from __future__ import annotations

import codecs
import csv
import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from obsynth.data.signals import MISSING_TEXTS, Signals, Stamps
from obsynth.errors import SpecError
from obsynth.files.tables import unquoted
from obsynth.numerics.arguments import number_in_text
from obsynth.numerics.arrays import FloatArray

#: What may separate columns, the first one that fits.
SEPARATORS = (",", ";", "\t", "|")
#: How programs of Microsoft say what separates the columns, in a line before the header.
_SEPARATOR_LINE = re.compile(r"\s*sep=(.)\s*", re.IGNORECASE)
#: What a remark of the logger begins with, before the header.
REMARK = "#"
#: Lines that may end with CR alone.
_OLD_LINES = re.compile(r"[^\r]*\r\n?|[^\r]+")


@dataclass(frozen=True)
class Dialect:
    """How a log is written: what separates its columns, and whether numbers may have a decimal comma."""

    separator: str

    @property
    def comma(self) -> bool:
        """Whether a comma in a number stands for its point."""
        return self.separator != ","

    def number(self, text: str | None, row: int, column: str, stamps: Stamps | None = None) -> float:
        """Return the number in a cell, NaN where it is missing; a cell that is none is named with its row.
        In a column that has shown numbers, a word is what loggers write for a bad sample: ``stamps`` counts these."""
        cell = "" if text is None else text.strip()
        if cell.lower() in MISSING_TEXTS:
            return float("nan")
        try:
            return number_in_text(cell.replace(",", ".") if self.comma and "." not in cell else cell)
        except ValueError:
            if stamps is not None and ("#" in cell or not any(letter.isdigit() for letter in cell)):
                stamps.words.setdefault(column, []).append((row, cell))
                return float("nan")
            advice = ""
            if "," in cell:
                advice = (
                    " Separate the columns by semicolons where numbers have a decimal comma."
                    if not self.comma
                    else " Leave out what groups thousands."
                )
            raise SpecError(
                f"Row {row}, column {column!r}: {text!r} is no number.{advice}", path=f"row {row}"
            ) from None


def encoding_of(path: Path) -> str:
    """Return the encoding of a text: UTF-8 but where its first bytes say UTF-16, as Windows writes it."""
    with path.open("rb") as stream:
        return "utf-16" if stream.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig"


def no_text(path: Path, error: UnicodeDecodeError) -> SpecError:
    """Return what is told of a file whose bytes are no text."""
    name = "UTF-16" if error.encoding.startswith("utf-16") else "UTF-8"
    return SpecError(f"{path} is no {name} text (byte {error.start}).", path=str(path))


def text_chunks(path: Path, signals: Signals, stamps: Stamps, rows: int) -> Iterator[FloatArray]:
    """Yield ``(rows, 1 + nu + ny)`` of a file."""
    with path.open(encoding=encoding_of(path), newline="") as stream:
        if not stream.readline():
            raise SpecError(f"{path} cannot be read: it is empty.", path=str(path))
        stream.seek(0)
        try:
            yield from _together(stream_rows(stream, signals, stamps), rows)
        except SpecError as error:
            if (error.path or "").startswith("cells"):
                raise SpecError(f"{path} cannot be read: {error}", path=str(path)) from error
            raise


def stream_rows(stream: TextIO, signals: Signals, stamps: Stamps) -> Iterator[FloatArray]:
    """Yield one row at a time, ``(1, 1 + nu + ny)``, as soon as its line is there."""
    header, dialect, table = _opened(stream, signals.columns)
    places = signals.positions(header)
    row, shown = 0, set[int]()  # columns that have shown a number
    for cells in table:
        if not any(cell.strip() for cell in cells):
            continue
        row += 1
        if len(cells) > len(header):
            raise SpecError(
                f"Row {row} has {len(cells)} cells, but the header has {len(header)}.", path=f"cells of row {row}"
            )
        cells += [""] * (len(header) - len(cells))
        time = stamps.read(cells[places[0]], row, header[places[0]], comma=dialect.comma)
        values = [
            dialect.number(cells[place], row, header[place], stamps if place in shown else None) for place in places[1:]
        ]
        shown.update(place for place, value in zip(places[1:], values, strict=True) if math.isfinite(value))
        yield np.array([[time, *values]])
    if row == 0:
        raise SpecError("The data have no rows.", path="data")


def header_of(path: Path, wanted: Sequence[str]) -> list[str]:
    """Return the names of the columns of a file, of which some are wanted."""
    try:
        with path.open(encoding=encoding_of(path), newline="") as stream:
            return list(_opened(stream, wanted)[0])
    except UnicodeDecodeError as error:
        raise no_text(path, error) from error
    except OSError as error:
        raise SpecError(f"{path} cannot be read: {error.strerror or error}.", path=str(path)) from error


def _opened(stream: TextIO, wanted: Sequence[str]) -> tuple[tuple[str, ...], Dialect, Iterator[list[str]]]:
    """Return the names of the columns, how the log is written, and the cells of the lines below the header.  What a
    logger remarks before the header, in lines that begin with ``#`` and name no column that is read, is passed over."""
    lines = _text_lines(stream)
    head = next(lines, "")
    while head.startswith(REMARK) and not any(set(wanted) & set(_names(head, separator)) for separator in SEPARATORS):
        head = next(lines, "")
    told = _SEPARATOR_LINE.fullmatch(head)
    head = next(lines, "") if told else head
    dialect = Dialect(told.group(1)) if told else _dialect_of(head, wanted)
    # A name in quotes may go on in the next line.
    table = _cells(itertools.chain([head], lines), dialect)
    return tuple(unquoted(name.strip()) for name in next(table, [])), dialect, table


def _together(rows: Iterator[FloatArray], count: int) -> Iterator[FloatArray]:
    while block := list(itertools.islice(rows, count)):
        yield np.concatenate(block)


def _dialect_of(head: str, wanted: Sequence[str]) -> Dialect:
    """Return how a log is written: by the separator that finds the columns that are read, or that finds most."""
    found = {separator: _names(head, separator) for separator in SEPARATORS}
    whole = next((s for s, names in found.items() if set(wanted) <= set(names)), None)
    return Dialect(whole or max(SEPARATORS, key=lambda s: len(found[s])))


def _names(head: str, separator: str) -> Sequence[str]:
    try:
        return [unquoted(name.strip()) for name in next(csv.reader([head], delimiter=separator), [])]
    except csv.Error:
        return []


def _cells(lines: Iterator[str], dialect: Dialect) -> Iterator[list[str]]:
    """Yield the cells of each line; what is no text, or no table, is a `SpecError`."""
    table = csv.reader(lines, delimiter=dialect.separator)
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
            raise SpecError(f"{name} is no text of its encoding after line {count}.", path="data") from error
        if not block:
            return
        for line in _OLD_LINES.findall(block):
            # A byte order mark is no part of the first name.
            yield line.removeprefix("\ufeff") if is_first else line
            is_first = False
