"""Recorded logs for calibration: columns by signal, a regular grid of stamps, and errors by code where one cannot be
used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import PreconditionError, SpecError, counted
from obsynth.monitoring.logs.clock import MOST_STALE, SORTED, unit_advice
from obsynth.monitoring.logs.log_tables import log_table, parsed_rows
from obsynth.monitoring.logs.signals import HeaderUnit, mapping_advice, time_advice
from obsynth.monitoring.logs.stuck_sensors import stuck_rows, stuck_texts, without_repeats
from obsynth.monitoring.logs.unpacked_logs import as_frame
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.suggestions import quoted_names, there_are

if TYPE_CHECKING:
    import pandas as pd


LogData: TypeAlias = "str | Path | pd.DataFrame | Mapping[str, Any] | RecordedLog"

#: Stamps further off the grid than this share of a step are refused, and further than the second are reported.
LARGEST_JITTER = 0.2

NOTED_JITTER = 0.02

#: The same of stamps and the grid itself, where two of them are off each other by more.
LARGEST_STAMP_OFFSET = 0.25

#: A log in which more rows than this are missing is not filled up: its grid would have little but missing rows, which a
#: fit takes one by one, and a clock that jumps by years would fill the memory.
MOST_MISSING_ROWS = 100_000

#: What counts as one quantum between values of a column: all differences are whole multiples within this.
QUANTUM_SLACK = 0.02

#: Share of distinct values above which a column shows no quantum that limits its noise: a ramp has none twice.
DISTINCT_SHARE = 0.7

#: Rows of wrong values that are named.
MOST_LISTED_ROWS = 5

#: Decimals to which values of a column are compared, and the share of the largest below which a step is
#: rounding.
VALUE_DIGITS, SAME_VALUE = 12, 1e-9

#: The variance of what rounding takes away, even over a step, is the step squared over this.
EVEN = 12.0


def bad_log(code: str, message: str, *, path: str = "log") -> SpecError:
    """Return the error of a log that is malformed: ``irregular``, ``nan``, ``time``, ``empty``, ``too-short``."""
    return SpecError(message, path=path, code=code)


def refused(code: str, message: str, *, signals: Sequence[str] = ()) -> PreconditionError:
    """Return the error of a log that cannot determine what is asked, or of a model that cannot follow it."""
    return PreconditionError(message, condition=code, signals=signals)


@dataclass(frozen=True, eq=False)
class RecordedLog:
    """Inputs and outputs on a regular grid."""

    time: FloatArray  # ``(n,)`` seconds
    u: FloatArray  # ``(n, nu)``
    y: FloatArray  # ``(n, ny)`` with NaN for what is missing
    dt: float  # seconds
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    rows: tuple[int, int]  # first row and one past the last, of the data that were given
    source: str = ""
    notes: tuple[str, ...] = ()  # what was noticed and repaired
    #: How far samples that stand out, and count as not measured, were from their prediction: ``(any,)`` of each output.
    outliers: tuple[FloatArray, ...] = ()
    input_delay: int = 0  # rows by which the inputs are later than the data have them
    held: NDArray[np.bool_] | None = None  # ``(n, nu)``: inputs that were missing, and stand as they last were
    header_units: Mapping[str, HeaderUnit] = field(default_factory=dict)  # those that signals were converted from

    @property
    def measured_inputs(self) -> FloatArray:
        """The inputs ``(n, nu)``, NaN where they were missing after the first row."""
        if self.held is None or not self.held[1:].any():
            return self.u
        return np.where(self.held & (np.arange(self.samples) > 0)[:, None], np.nan, self.u)

    @property
    def samples(self) -> int:
        """Number of rows."""
        return len(self.time)

    @property
    def digest(self) -> str:
        """SHA-256 of stamps, inputs and outputs: the same numbers have the same digest, however they were stored."""
        values = np.ascontiguousarray(np.column_stack([self.time, self.u, self.y]), dtype="<f8")
        names = "\n".join((*self.input_names, "", *self.output_names)).encode()
        return hashlib.sha256(names + b"\0" + np.where(np.isnan(values), np.nan, values).tobytes()).hexdigest()

    @property
    def described(self) -> dict[str, Any]:
        """What a report says of the log."""
        return {
            "source": self.source,
            "rows": list(self.rows),
            "digest": self.digest,
            "samples": self.samples,
            "dt": self.dt,
        }

    def shifted(self, rows: int) -> RecordedLog:
        """Return the log with its inputs later by whole rows: what row k says acts from row k on for ``rows = 1``."""
        if abs(rows) >= len(self.u):
            raise SpecError(
                f"input_delay is {rows} rows, but the log has {len(self.u)} here: give fewer.", path="input_delay"
            )
        places = np.clip(np.arange(len(self.u)) - rows, 0, len(self.u) - 1)
        held = None if self.held is None else self.held[places]
        return replace(self, u=read_only(self.u[places]), held=held, input_delay=self.input_delay + rows)

    def first(self, count: int) -> RecordedLog:
        """Return the first rows."""
        return self.between(0, count)

    def between(self, first: int, last: int) -> RecordedLog:
        """Return the rows from one to before another."""
        return replace(
            self,
            time=self.time[first:last],
            u=self.u[first:last],
            y=self.y[first:last],
            rows=(self.rows[0] + first, self.rows[0] + last),
            held=None if self.held is None else self.held[first:last],
        )

    def without(self, wrong: NDArray[np.bool_]) -> RecordedLog:
        """Return the log without single outputs ``(n, ny)`` that are no measurements, with a note for each sensor."""
        notes = list(self.notes)
        for i, name in enumerate(self.output_names):
            rows = np.flatnonzero(wrong[:, i])
            if len(rows):
                listed = listed_rows([f"row {self.rows[0] + row}: {self.y[row, i]:.4g}" for row in rows])
                notes.append(
                    f"{counted(len(rows), 'value')} of {name} far from all others, counted as not measured ({listed})."
                )
        return replace(self, y=read_only(np.where(wrong, np.nan, self.y)), notes=tuple(notes))

    def unstuck(self) -> RecordedLog:
        """Return the log without what sensors repeated while they were stuck, which no noise of theirs moved."""
        stuck = [stuck_rows(column) for column in self.y.T]
        if not any(stuck):
            return self
        y = without_repeats(self.y, stuck)
        return replace(self, y=read_only(y), notes=(*self.notes, "What a stuck sensor repeats counts as not measured."))


def listed_rows(rows: Sequence[Any] | NDArray[np.int64]) -> str:
    """Return the first few rows as a sentence names them."""
    return ", ".join(map(str, rows[:MOST_LISTED_ROWS])) + (", ..." if len(rows) > MOST_LISTED_ROWS else "")


def read_log(
    log: LogData,
    input_names: Sequence[str],
    output_names: Sequence[str],
    *,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    dt: float | None = None,
    units: Mapping[str, str] = MappingProxyType({}),
) -> RecordedLog:
    """Return the rows of a log as inputs and outputs on a grid. A log is a CSV or Parquet file, a data frame, or a
    mapping from names to columns; ``columns`` says which column a signal (or ``time``) is in where the names differ,
    ``scales`` what its values are multiplied by; where nothing does, values in another unit than the signal's of
    ``units`` are converted, or refused, by the header."""
    if isinstance(log, RecordedLog):
        if (log.input_names, log.output_names) != (tuple(input_names), tuple(output_names)):
            raise SpecError("The log is of another plant: its signals differ.", path="log")
        first, last = parsed_rows(rows, log.samples)
        return log.between(first, last)
    signals = ("time", *input_names, *output_names)
    for option, mapping in (("columns", columns or {}), ("scales", scales or {})):
        wrong = [name for name in mapping if name not in signals]
        if wrong:
            raise SpecError(
                f"{option} names {wrong[0]!r}, which is no signal; {there_are(wrong[0], signals)}",
                path=f"{option}.{wrong[0]}",
            )
    held = {name: (columns or {}).get(name, name) for name in signals}
    own = {held[name]: unit for name, unit in units.items() if name in held and name not in (scales or {})}
    in_header = dict[str, HeaderUnit]()
    table, names, source, notes = _table(log, list(held.values()), own, in_header)
    length = max((len(values) for values in table.values()), default=0)
    first, last = parsed_rows(rows, length)

    def column(name: str) -> FloatArray:
        wanted = held[name]
        if wanted not in table:
            raise SpecError(
                f"The log has no column {wanted!r}{'' if wanted == name else f' for {name!r}'}; "
                f"{there_are(wanted, names)} {mapping_advice(name)}",
                path=f"columns.{name}",
            )
        numbers = _numbers(table[wanted], wanted, length)[first:last]
        return np.asarray(numbers * float((scales or {}).get(name, 1.0)), dtype=np.float64)

    in_table = held["time"] in table
    if not in_table and dt is None:
        raise SpecError(
            f"The log has no column 'time'; it has {quoted_names(names)}. "
            f"{time_advice(names) or 'Name it by columns.'} In Python, dt stands for the stamps of an even log.",
            path="columns.time",
        )
    time = column("time") if in_table else np.asarray(np.arange(first, last) * float(dt or 0.0))
    u = np.column_stack([column(name) for name in input_names]) if input_names else np.zeros((last - first, 0))
    y = np.column_stack([column(name) for name in output_names])
    record = _on_grid(time, u, y, dt, tuple(input_names), tuple(output_names), (first, last), source)
    stuck = {
        name: [(first + begins, first + ends) for begins, ends in stuck_rows(values)]
        for name, values in zip(record.output_names, record.y.T, strict=True)
    }
    converted = {name: in_header[wanted] for name, wanted in held.items() if wanted in in_header}
    return replace(record, notes=(*notes, *record.notes, *stuck_texts(stuck)), header_units=converted)


def _table(
    log: Any, wanted: Sequence[str], units: Mapping[str, str], in_header: dict[str, HeaderUnit]
) -> tuple[dict[str, Any], list[str], str, tuple[str, ...]]:
    """Return columns that are wanted, the time first, names of all columns, where they come from, and what is to be
    said of their cells; ``in_header`` is filled with the units that a header states of columns."""
    log = log if isinstance(log, str | Path | Mapping) else as_frame(log)
    if isinstance(log, str | Path) or (hasattr(log, "columns") and hasattr(log, "index")):
        columns, names, notes = log_table(log, wanted[1:], wanted[0], units=units, in_header=in_header)
        return columns, names, Path(log).name if isinstance(log, str | Path) else "", notes
    if isinstance(log, Mapping):
        columns = {str(name): np.atleast_1d(np.asarray(log[name])) for name in log}
        wanted_columns = {name: columns[name] for name in wanted if name in columns}
        if (
            any(values.dtype.kind in "OU" for values in wanted_columns.values())
            and len(set(map(len, wanted_columns.values()))) == 1
        ):
            import pandas as pd

            # Cells with words are read as those of a frame.
            frame = pd.DataFrame(wanted_columns)
            read, _, notes = log_table(frame, wanted[1:], wanted[0], units=units, in_header=in_header)
            return {**columns, **read}, list(map(str, log)), "", notes
        return columns, list(map(str, log)), "", ()
    raise SpecError(
        "log must be the name of a file, a pandas.DataFrame, or a mapping from names to columns.", path="log"
    )


def _numbers(values: Any, name: str, length: int) -> FloatArray:
    if len(values) != length:
        raise SpecError(f"The column {name!r} has {len(values)} rows, another {length}.", path=f"log.{name}")
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise SpecError(f"The column {name!r} holds something that is no number.", path=f"log.{name}") from None


def _on_grid(
    time: FloatArray,
    u: FloatArray,
    y: FloatArray,
    dt: float | None,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    rows: tuple[int, int],
    source: str,
) -> RecordedLog:
    """Return the log on its grid; missing rows become rows without outputs whose inputs are those before.
    Rows whose stamps do not rise are left out, and inputs that are missing are held."""
    notes = []
    stale = np.isfinite(time) & (time <= np.maximum.accumulate(np.concatenate([[-np.inf], time[:-1]])))
    if stale.any() and not _longest(stale) > MOST_STALE:
        notes.append(f"{counted(int(stale.sum()), 'row')} left out: the stamps do not rise.")
        time, u, y = time[~stale], u[~stale], y[~stale]
    step, counts, jitter = _grid(time, dt, rows[0])
    _require_few_missing(time, counts, rows)
    if jitter.max(initial=0.0) > NOTED_JITTER:
        notes.append(f"The stamps jitter by {jitter.max():.1%} of a step.")
    missing = ~np.isfinite(u)
    for name, column in zip(inputs, u.T, strict=True):
        finite = np.isfinite(column)
        if not finite.any():
            raise bad_log("nan", _never_finite("input", name), path=f"log.{name}")
        if not finite.all():
            notes.append(f"{counted(int((~finite).sum()), 'value')} of {name} missing: the last one before is held.")
            places = np.maximum.accumulate(np.where(finite, np.arange(len(column)), np.argmax(finite)))
            u = u.copy()
            u[:, inputs.index(name)] = column[places]
    for name, column in zip(outputs, y.T, strict=True):
        if not np.isfinite(column).any():
            raise bad_log("nan", _never_finite("output", name), path=f"log.{name}")
        if np.isinf(column).any():
            notes.append(f"{counted(int(np.isinf(column).sum()), 'infinite value')} of {name} counted as not measured.")
    y = np.where(np.isfinite(y), y, np.nan)
    places = np.concatenate([[0], np.cumsum(counts)])
    if (counts > 1).any():
        held = " and the inputs before them are held" if inputs else ""
        notes.append(f"{int((counts - 1).sum())} rows are missing: their outputs count as not measured{held}.")
        grid = np.arange(places[-1] + 1)
        before = np.searchsorted(places, grid, side="right") - 1
        u, missing = u[before], missing[before] | ~np.isin(grid, places)[:, None]
        wide = np.full((len(grid), y.shape[1]), np.nan)
        wide[places] = y
        y, time = wide, time[0] + step * grid
    return RecordedLog(
        read_only(time), read_only(u), read_only(y), step, inputs, outputs, rows, source, tuple(notes), held=missing
    )


def _never_finite(kind: str, name: str) -> str:
    return f"The {kind} {name!r} is nowhere finite in these rows: give other rows. {mapping_advice(name)}"


def _require_few_missing(time: FloatArray, counts: NDArray[np.int64], rows: tuple[int, int]) -> None:
    """Refuse stamps ``(n,)`` with so many steps between them ``(n - 1,)`` that most of the grid would be missing."""
    missing = int((counts - 1).sum())
    if missing <= MOST_MISSING_ROWS:
        return
    gap = int(np.argmax(counts))
    after = rows[0] + gap + 1
    parts = [(rows[0], after), (after, rows[1])]
    first, last = max(parts, key=lambda part: part[1] - part[0])
    raise bad_log(
        "time",
        f"{missing:,} rows are missing, most of them before row {after}, counted from 0, which comes "
        f"{time[gap + 1] - time[gap]:.6g} s after the one before: more than {MOST_MISSING_ROWS:,} are not filled up. "
        f"Give a part of the log (rows {first}:{last}).",
        path="log.time",
    )


def _grid(time: FloatArray, dt: float | None, first: int) -> tuple[float, NDArray[np.int64], FloatArray]:
    """Return the step of the grid of stamps ``(n,)`` which begin in row ``first``, the steps between them, and how far
    each is off, in steps; refuse stamps that are on none."""
    if not np.isfinite(time).all():
        bad = int(np.argmin(np.isfinite(time)))
        raise bad_log("time", f"Row {first + bad}, counted from 0, has no time stamp.", path="log.time")
    if (np.diff(time) <= 0).any():
        bad = int(np.argmax(np.diff(time, prepend=-np.inf) <= 0))
        raise bad_log(
            "time", f"Stamps must rise, but that of row {first + bad} is {time[bad]:g} s. {SORTED}.", path="log.time"
        )
    gaps = np.diff(time)
    step = float(np.median(gaps)) if dt is None and gaps.size else float(dt or 1.0)
    counts = np.round(gaps / step).astype(np.int64)
    jitter = np.abs(gaps / step - counts)
    if dt is None and jitter.max(initial=0.0) > NOTED_JITTER and (counts >= 1).all():
        step = _mean_step(time, counts)
        jitter = np.abs(gaps / step - counts)
    irregular = jitter.max(initial=0.0) > LARGEST_JITTER
    if irregular and (counts >= 1).all():
        # Two stamps that are off the grid may be off each other by twice as much: against the grid itself.
        away = time - time[0] - step * np.concatenate([[0], np.cumsum(counts)])
        jitter = np.abs(away - np.median(away))[1:] / step
        irregular = jitter.max() > LARGEST_STAMP_OFFSET
    if irregular or (counts < 1).any():
        worst = int(np.argmax(jitter))
        raise bad_log(
            "irregular",
            f"The stamps are irregular: row {first + worst + 1} is {jitter[worst]:.0%} "
            f"of a step off the grid of {step:g} s. Resample the log.{unit_advice(float(np.median(gaps)) / step)}",
            path="log.time",
        )
    if counts.size > 1 and counts.min() > 1:
        raise bad_log(
            "irregular",
            f"No two rows are less than {counts.min() * step:.10g} s apart, but a step takes {step:.10g} s: the "
            f"sampling time does not fit.{unit_advice(float(counts.min()))}",
            path="log.time",
        )
    return step, counts, jitter


def _mean_step(time: FloatArray, counts: NDArray[np.int64]) -> float:
    """Return the step of a grid from stamps that jitter ``(n,)`` and the steps between them: their median is off by
    its share of the jitter, which adds up over a log; in as few digits as the stamps know of it."""
    places = np.concatenate([[0], np.cumsum(counts)]) - np.sum(counts) / 2.0
    away = places - places.mean()
    step = float(away @ time / (away @ away))
    deviation = time - time.mean() - step * away
    error = float(np.sqrt(deviation @ deviation / max(len(time) - 2, 1) / (away @ away)))
    return next(
        (short for short in (float(f"{step:.{digits}g}") for digits in range(1, 17)) if abs(short - step) <= error),
        step,
    )


def _longest(true: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of true values."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], true.astype(np.int64), [0]])))
    return int((ends[1::2] - ends[::2]).max(initial=0))


def roughness(y: FloatArray) -> FloatArray:
    """Return the deviation of white noise that differences of successive samples of sensors ``(n, ny)`` would show
    ``(ny,)``: those of neighbouring rows, or of a sensor that is slower than the rows, of its samples."""
    deviations = np.zeros(y.shape[1])
    for j, column in enumerate(y.T):
        changes = np.diff(column)
        changes = changes[np.isfinite(changes)]
        if changes.size < 2:
            changes = np.diff(column[np.isfinite(column)])
        if changes.size:
            deviations[j] = float(np.std(changes)) / np.sqrt(2.0)
    return deviations


def quantum(column: FloatArray) -> float:
    """Return the smallest step between values of a column of which all others are multiples; zero without one."""
    values = np.unique(np.round(column[np.isfinite(column)], VALUE_DIGITS))
    steps = np.diff(values)
    steps = steps[steps > SAME_VALUE * max(1.0, float(np.abs(values).max(initial=0.0)))]
    if not steps.size:
        return 0.0
    ratios = steps / steps.min()
    if np.abs(ratios - np.round(ratios)).max() > QUANTUM_SLACK or steps.size < 3:
        return 0.0
    return float(np.median(steps[np.round(ratios) == 1]))


def repeats(column: FloatArray) -> bool:
    """Whether values of a column come again often enough that its quantum limits what its noise can be."""
    values = column[np.isfinite(column)]
    return bool(len(np.unique(np.round(values, VALUE_DIGITS))) < DISTINCT_SHARE * len(values))
