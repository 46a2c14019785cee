"""Signals of a log: their columns, and their values as deviations from the operating point."""

from __future__ import annotations

import re
import shlex
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.logs.log_observer import LogObserver
from obsynth.monitoring.logs.stamps import WITH_UNIT, Stamps
from obsynth.numerics.arguments import is_finite_number, require_kind
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.measurement_units import MICRO_SIGNS, conversion
from obsynth.numerics.suggestions import are_numbers, quoted_names, suggestion, there_are
from obsynth.plants.input_derivatives import derivative_name, derivative_of

#: A time of day without a date, whose date is in another column; hours, minutes and seconds since the start of a log.
_TIME_OF_DAY = re.compile(
    r"\d{1,2}:\d{2}(?::\d{2}\S*)?(?:\s*[AaPp]\.?[Mm]\.?)?(?:\s*(?:UTC|GMT|Z|[+-]\d\S*))?", re.IGNORECASE
)

#: The column of time stamps, in seconds.
TIME_HEADER = "time"

#: Names of a column of dates beside times of day, and names or endings of names of a column with the status of values.
_DATE_NAMES = ("date", "datum", "day", "tag", "fecha")

_STATUS_NAMES = ("status", "quality")

#: Beginnings of a status of bad values.
_BAD_STATUS = ("bad", "invalid", "not good")

#: Usual beginnings of the names of columns of time stamps, in the order in which they are suggested.
_TIME_NAMES = ("timestamp", "datetime", "zeit", "uhrzeit", "time", "date")


class HeaderUnit(NamedTuple):
    """The unit of a column in the header of a log, and the conversion to the plant's unit."""

    unit: str
    factor: float
    shift: float


@dataclass(frozen=True, eq=False)
class LogSignals:
    """The columns of measured signals, and the conversion of their values to deviations."""

    names: tuple[str, ...]  # signals: known inputs, then outputs
    columns: tuple[str, ...]  # the columns that are read: time, then one for each signal
    scale: FloatArray  # scale, offset: ``(nu + ny,)``: deviation = scale times the value in the column, minus offset
    offset: FloatArray
    point: Mapping[str, float]  # the operating point
    constant_signal: int | None = None  # number of the signal that is 1 in every row and has no column, if there is one
    inputs: int = 0  # columns of known inputs
    delay: int = 0  # rows by which inputs act later than in the design; negative: earlier
    units: Mapping[str, str] = field(default_factory=dict)  # of signals without a stated factor
    in_header: dict[str, HeaderUnit] = field(default_factory=dict)  # by signal; filled in when a header is read

    @classmethod
    def of(
        cls,
        observer: LogObserver,
        columns: Mapping[str, str] | None,
        scales: Mapping[str, float] | None,
        units: Mapping[str, str] = MappingProxyType({}),
    ) -> LogSignals:
        """Return the signals that a running design reads."""
        names = observer.input_names + observer.output_names
        renamed, factors = dict(columns or {}), dict(scales or {})
        unknown = [name for name in renamed if name not in (TIME_HEADER, *names)]
        unknown += [name for name in factors if name not in names]
        if unknown:
            raise SpecError(
                f"{unknown[0]!r} is no input or output of this observer; {there_are(unknown[0], names)}",
                path="columns",
            )
        for name, column in renamed.items():
            require_kind(column, str, f"The column of {name!r}", "the name of a column", path="columns")
        for name, factor in factors.items():
            if not is_finite_number(factor) or factor == 0.0:
                raise SpecError(f"The scale of {name!r} is {factor!r}: give a finite number, not zero.", path="scales")
        uncertain = getattr(getattr(observer, "plant", None), "uncertainty", None)
        shift = getattr(observer, "shift", None) if uncertain is None else uncertain.shift
        scaled = {*factors, *observer.scales}

        def base_of(name: str) -> str | None:
            # A derivative without a factor of its own has that of its input.
            base = derivative_of(name, observer.input_names) if name in observer.input_names else None
            return None if base is None else base[0]

        return cls(
            names,
            tuple(_column(name, names, renamed) for name in (TIME_HEADER, *names) if not shift or name != shift),
            read_only(np.array([_factor(name, names, factors, observer.scales) for name in names])),
            read_only(np.array([observer.point.get(name, 0.0) for name in names])),
            dict(observer.point),
            names.index(shift) if shift and shift in names else None,
            len(observer.input_names) - int(bool(shift) and shift in observer.input_names),
            observer.input_delay,
            {name: unit for name, unit in units.items() if name not in scaled and base_of(name) not in scaled},
        )

    @property
    def has_derivatives(self) -> bool:
        """Whether a signal is the derivative of a known input, which a run may compute from its samples."""
        return any(derivative_of(name, self.names) for name in self.names)

    def conversions(
        self, header: Sequence[str], places: Sequence[int], stamps: Stamps, below: Sequence[str] = ()
    ) -> tuple[FloatArray, FloatArray]:
        """Return factors and shifts ``(columns,)`` from the units in a header, or in the line ``below`` it, to those of
        the plant; conversions are noted in the notes of ``stamps``.

        Raises
        ------
        SpecError
            A unit cannot be converted.
        """
        names = [name for i, name in enumerate(self.names) if i != self.constant_signal]
        factors, shifts = np.ones(len(names)), np.zeros(len(names))
        for i, (name, place) in enumerate(zip(names, places[1:], strict=True)):
            base = derivative_of(name, names)
            if base is not None and place == places[1 + names.index(base[0])]:
                # The derivative is computed from the samples of its input, and has their unit.
                name = base[0]
            behind = WITH_UNIT.fullmatch(header[place])
            unit = below[i + 1].strip("[]() ") if i + 1 < len(below) else "" if behind is None else behind[2]
            if not unit or name not in self.units:
                continue
            try:
                way = conversion(unit, self.units[name])
            except SpecError as error:
                raise SpecError(
                    f"{name} is in {unit} in the data, and in {self.units[name]} in the plant: {error}; or state the "
                    f"factor (--scale {shlex.quote(name)}=FACTOR).",
                    path=f"columns.{name}",
                ) from error
            if way is not None:
                factors[i], shifts[i] = way
                self.in_header[names[i]] = HeaderUnit(unit, *way)
            if way is not None and way != (1.0, 0.0):
                stamps.notes.append(f"{name} is converted from {unit} to {self.units[name]}.")
        return factors, shifts

    def measured(self, rows: FloatArray) -> FloatArray:
        """Return signals in their units ``(rows, nu + ny)`` from rows of time and columns."""
        read = (
            rows[:, 1:] if self.constant_signal is None else np.insert(rows[:, 1:], self.constant_signal, 1.0, axis=1)
        )
        return np.asarray(self.scale * read)

    def deviations(self, rows: FloatArray) -> FloatArray:
        """Return deviations ``(rows, nu + ny)`` from rows of time and columns."""
        return self.measured(rows) - self.offset

    def positions(self, header: tuple[str, ...]) -> list[int]:
        """Return the position in a header of each column that is read."""
        matches = [column_of(header, name) for name in self.columns]
        for i, name in enumerate(self.columns):
            # A derivative without a column is computed from the column of its input.
            known = self.columns[1 : 1 + self.inputs]
            base = derivative_of(name, known) if matches[i] is None and name in known else None
            matches[i] = matches[i] if base is None else matches[self.columns.index(base[0])]
        missing = sorted({name for name, present in zip(self.columns, matches, strict=True) if present is None})
        if missing:
            raise missing_columns(header, missing, dict(self.columns_and_signals()))
        present = [name for name in matches if name is not None]
        repeated = sorted({name for name in present if header.count(name) > 1})
        if repeated:
            raise SpecError(
                f"The data have more than one column {', '.join(map(repr, repeated))}: give each a name of its own.",
                path="data",
            )
        return [header.index(name) for name in present]

    def columns_and_signals(self) -> list[tuple[str, str]]:
        """Return each column that is read, except the time, with its signal; several signals may share a column."""
        return list(
            zip(self.columns[1:], (n for i, n in enumerate(self.names) if i != self.constant_signal), strict=True)
        )

    def estimates_point(self, observer: LogObserver) -> FloatArray:
        """Return the operating point of the columns of estimates, which is added to deviations of states and faults."""
        biases = getattr(getattr(observer, "plant", None), "sensor_faults", ())
        values = [self.point.get(name, 0.0) for name in observer.state_names]
        values += [0.0 if name in biases else self.point.get(name, 0.0) for name in observer.fault_names]
        return np.array(values + [0.0] * (len(observer.columns) - len(values)))


def missing_columns(header: Sequence[str], missing: Sequence[str], signals: Mapping[str, str]) -> SpecError:
    """Return the error for missing columns of a log; ``signals`` are those of the columns, except the time."""
    column, signal = next(
        ((column, signals[column]) for column in missing if column in signals), (missing[0], TIME_HEADER)
    )
    return SpecError(
        f"The data have no {'column' if len(missing) == 1 else 'columns'} {quoted_names(missing)}; they have "
        f"{quoted_names(header)}. {_advice(header, missing, column, signal)}",
        path="data",
    )


def _column(name: str, names: Sequence[str], renamed: Mapping[str, str]) -> str:
    """Return the column of a signal; that of a derivative follows from the column of its input."""
    base = derivative_of(name, names)
    return renamed.get(name, name if base is None else derivative_name(renamed.get(base[0], base[0]), base[1]))


def _factor(name: str, names: Sequence[str], factors: Mapping[str, float], scales: Mapping[str, float]) -> float:
    """Return the factor of a column; a derivative without its own has that of its input."""
    base = derivative_of(name, names)
    default = 1.0 if base is None else factors.get(base[0], scales.get(base[0], 1.0))
    return factors.get(name, scales.get(name, default))


def is_bad(status: str) -> bool:
    """Whether a status means that the value is bad."""
    return status.strip().lower().startswith(_BAD_STATUS)


def column_of(header: Sequence[str], name: str) -> str | None:
    """Return the name of a column in a header, or `None` if there is none or several.

    The name may be encoded with other code points, or be followed by a unit in brackets.
    """
    if name in header:
        return name
    name = _one_spelling(name)
    same = [column for column in header if not column.isascii() and _one_spelling(column) == name]
    if len(same) == 1:
        return same[0]
    with_unit = [
        column
        for column in header
        if (unit := WITH_UNIT.fullmatch(_one_spelling(column) if not column.isascii() else column)) and unit[1] == name
    ]
    return with_unit[0] if len(with_unit) == 1 else None


def _one_spelling(name: str) -> str:
    """Return a name in a standard encoding: letters with accents as one code point, the sign for micro as mu."""
    return name if name.isascii() else unicodedata.normalize("NFC", name).replace(*MICRO_SIGNS)


def date_place(header: Sequence[str], places: Sequence[int]) -> int | None:
    """Return the position of a column of dates for times of day without dates; `None` if there is not exactly one."""
    dates = [i for i, name in enumerate(header) if name.strip().lower() in _DATE_NAMES and i not in places]
    return dates[0] if len(dates) == 1 else None


def with_date(date: str, text: str) -> str:
    """Return a time of day together with its date; other texts are returned unchanged."""
    # A data frame may print its dates with midnight as the time.
    return f"{date.strip().removesuffix(' 00:00:00')} {text.strip()}" if _TIME_OF_DAY.fullmatch(text.strip()) else text


def status_places(header: Sequence[str], places: Sequence[int]) -> list[int | None]:
    """Return the position of the status of each column that is read ``(1 + nu + ny,)``.

    The name of such a column is that of the values with a word such as ``status`` appended, or such a word alone in the
    next column.
    """
    by_column: list[int | None] = [None]
    lower = [name.strip().lower() for name in header]
    for place in places[1:]:
        unit = WITH_UNIT.fullmatch(lower[place])
        base = unit[1] if unit else lower[place]
        own = [
            i
            for i, name in enumerate(lower)
            if name.startswith(base) and name[len(base) :].strip(" ._-:()[]/") in _STATUS_NAMES
        ]
        beside = [place + 1] if place + 1 < len(lower) and lower[place + 1] in _STATUS_NAMES else []
        by_column.append(next((i for i in (*own, *beside) if i not in places), None))
    return by_column


def _advice(header: Sequence[str], missing: Sequence[str], column: str, signal: str) -> str:
    """Return advice on missing columns, such as ``column`` of a ``signal`` or of the time."""
    if len(header) == 1 and any(mark in header[0] for mark in ":#~^ "):
        return "Separate columns by commas, semicolons, tabs or bars."
    if are_numbers(header):
        return "These are numbers, not names: name the columns in the first line of a file, or in DataFrame.columns."
    if TIME_HEADER in missing and (advice := time_advice(header)):
        return advice
    meant = next((name for name in header if name.casefold() == column.casefold()), "YOUR_COLUMN")
    suggested = suggestion(column, header)
    return f"{suggested} {mapping_advice(signal, meant)}".lstrip()


def mapping_advice(signal: str, column: str = "YOUR_COLUMN") -> str:
    """Return a sentence on how to map a signal to a column, on the command line and in Python."""
    return f"Map it: --map {shlex.quote(signal)}={shlex.quote(column)}, or columns={{{signal!r}: {column!r}}}."


def time_advice(header: Sequence[str]) -> str:
    """Return a sentence on how to name the column that may be the time; empty if there is none."""
    time_like = next((name for kind in _TIME_NAMES for name in header if name.lower().startswith(kind)), None)
    time_like = time_like or next((name for name in header if name.lower() == "t"), None)
    if time_like is None:
        return ""
    return (
        f"If {time_like!r} is the time: --time-column {shlex.quote(time_like)}, or columns={{'time': {time_like!r}}}."
    )
