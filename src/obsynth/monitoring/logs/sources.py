"""Where rows come from: text, Parquet, TDMS and MDF files in chunks, data frames, and text streams row by row."""

from __future__ import annotations

import gc
import io
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import input_file, reason
from obsynth.monitoring.logs.signals import (
    TIME_HEADER,
    LogSignals,
    column_of,
    date_place,
    is_bad,
    status_places,
    with_date,
)
from obsynth.monitoring.logs.stamps import Stamps
from obsynth.monitoring.logs.text_logs import WINDOWS_TEXT, no_text, number_in_cell, stream_rows, text_chunks
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    from typing_extensions import TypeIs


#: Files that are read as text, and those that need a package: its name and the extra that installs it.
TEXT_SUFFIXES = (".csv", ".tsv")

NEEDED_PACKAGES = {
    ".parquet": ("pyarrow", "parquet"),
    ".tdms": ("nptdms", "tdms"),
    ".mf4": ("asammdf", "mdf"),
    ".mdf": ("asammdf", "mdf"),
    ".dat": ("asammdf", "mdf"),
}

#: Rows that are held in memory at a time.
CHUNK_ROWS = 10_000

#: Files that estimates are written to.
TABLE_SUFFIXES = (".csv", ".parquet")

Data: TypeAlias = "str | Path | TextIO | pd.DataFrame"

#: One log, or several.
Logs: TypeAlias = "str | Path | TextIO | pd.DataFrame | Sequence[str | Path | pd.DataFrame]"


#: How pandas calls the column of an index without a name.
_UNNAMED_INDEX = "__index_level_"


#: Waveforms whose samples are further apart than this share of their interval are no rows of one table.
LARGEST_SHIFT = 0.5


#: How files of these kinds begin.
_BEGINNINGS = {".parquet": b"PAR1", ".tdms": b"TDSm", ".mf4": b"MDF ", ".mdf": b"MDF ", ".dat": b"MDF "}


def chunks(
    data: Data, signals: LogSignals, stamps: Stamps, rows: int, *, after: float | None = None
) -> Iterator[FloatArray]:
    """Yield ``(rows, 1 + nu + ny)``: time and signals, in order; NaN where a sample is missing.  Inputs are those that
    act in a row as the design takes it.  The first rows are left out up to the time ``after``."""
    found = _without_days(_chunks(data, signals, stamps, rows), stamps)
    if after is not None:
        found = _later(found, after)
    if not signals.delay or not signals.inputs:
        yield from found
    elif signals.delay > 0:
        yield from _delayed(found, signals, stamps)
    else:
        yield from _advanced(found, signals)
    # Whether columns hold numbers is known at the end, wherever the words in them stand.
    stamps.require_numbers()


def _without_days(found: Iterator[FloatArray], stamps: Stamps) -> Iterator[FloatArray]:
    """Yield rows, of which the first ones must not be stamped in days."""
    for count, chunk in enumerate(found):
        if not count:
            stamps.require_no_days(chunk[:, 0])
        yield chunk


def _later(found: Iterator[FloatArray], after: float) -> Iterator[FloatArray]:
    """Yield rows from the first one on whose time is later."""
    is_begun = False
    for chunk in found:
        first = 0 if is_begun else int(np.argmax(chunk[:, 0] > after))
        is_begun = is_begun or bool(chunk[first, 0] > after)
        if is_begun:
            yield chunk[first:]


def _delayed(found: Iterator[FloatArray], signals: LogSignals, stamps: Stamps) -> Iterator[FloatArray]:
    """Yield rows with the inputs of so many rows before; the first ones hold their own."""
    inputs = slice(1, 1 + signals.inputs)
    for chunk in found:
        if stamps.earlier is None:
            stamps.earlier = np.repeat(chunk[:1, inputs], signals.delay, axis=0)
        whole = np.vstack([stamps.earlier, chunk[:, inputs]])
        stamps.earlier = whole[len(chunk) :]
        chunk[:, inputs] = whole[: len(chunk)]
        yield chunk


def _advanced(found: Iterator[FloatArray], signals: LogSignals) -> Iterator[FloatArray]:
    """Yield rows with the inputs of so many rows after, for which they wait; the last ones hold the last."""
    inputs, wait = slice(1, 1 + signals.inputs), -signals.delay
    kept: FloatArray | None = None
    for chunk in found:
        whole = chunk if kept is None else np.vstack([kept, chunk])
        ready = max(len(whole) - wait, 0)
        kept = whole[ready:].copy()
        if ready:
            done = whole[:ready].copy()
            done[:, inputs] = whole[wait : wait + ready, inputs]
            yield done
    if kept is not None and len(kept):
        # Of a short log fewer rows than these are left.
        after = np.minimum(np.arange(len(kept)) + wait, len(kept) - 1)
        kept[:, inputs] = kept[after][:, inputs]
        yield kept


def _chunks(data: Data, signals: LogSignals, stamps: Stamps, rows: int) -> Iterator[FloatArray]:
    if isinstance(data, str | Path):
        path = Path(data)
        check_suffix(path, (*TEXT_SUFFIXES, *NEEDED_PACKAGES))
        with require_readable_log(path):
            if path.suffix.lower() in TEXT_SUFFIXES:
                yield from text_chunks(path, signals, stamps, rows)
            else:
                with read_by_package(path):
                    read_rows, _ = READERS[path.suffix.lower()]
                    yield from _converted(read_rows(path, signals, stamps, rows), signals, stamps)
    elif is_stream(data):
        if data is sys.stdin and isinstance(data, io.TextIOWrapper):
            data.reconfigure(errors=WINDOWS_TEXT)
        yield from stream_rows(data, signals, stamps)
    else:
        import pandas as pd

        require_kind(data, pd.DataFrame, "data", "the name of a file, a text stream or a pandas.DataFrame")
        frame = _with_time(data, signals)
        numbers = all(pd.api.types.is_numeric_dtype(kind) for kind in frame.dtypes)
        # Of numbers a part says no less than the whole: no copy of all of them is made.
        parts = range(0, max(len(frame), 1), rows) if numbers else range(1)
        size = rows if numbers else max(len(frame), 1)
        for whole in _converted((frame.iloc[start : start + size] for start in parts), signals, stamps):
            for start in range(0, len(whole), rows):
                yield whole[start : start + rows]


def samples(data: Data, signals: LogSignals) -> Iterator[tuple[float, FloatArray]]:
    """Yield time and deviations ``(nu + ny,)`` of each row."""
    for chunk in chunks(data, signals, Stamps(), CHUNK_ROWS):
        yield from zip(chunk[:, 0].tolist(), signals.deviations(chunk), strict=True)


def is_stream(data: TextIO | pd.DataFrame) -> TypeIs[TextIO]:
    """Whether ``data`` is read line by line."""
    return hasattr(data, "readline")


def check_suffix(path: Path, suffixes: tuple[str, ...] = TABLE_SUFFIXES) -> None:
    """Raise `SpecError` unless a file is of a known kind by its name, and its package is installed."""
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        raise SpecError(f"{path} has an unknown suffix: use one of {', '.join(suffixes)}.", path=str(path))
    if suffix in NEEDED_PACKAGES:
        package, extra = NEEDED_PACKAGES[suffix]
        try:
            import_module(package)
        except ImportError:
            raise SpecError(
                f"{suffix} files need {package}: pip install 'obsynth[{extra}]', or use CSV.", path=str(path)
            ) from None


@contextmanager
def require_readable_log(path: Path) -> Iterator[None]:
    """Turn what can be wrong with a file into errors that name it."""
    try:
        if path.exists():
            input_file(path)
        yield
    except SpecError:
        raise
    except UnicodeDecodeError as error:
        raise no_text(path, error) from error
    except OSError as error:
        raise SpecError(f"{path} cannot be read: {reason(error)}.", path=str(path)) from error


@contextmanager
def read_by_package(path: Path) -> Iterator[None]:
    """Turn whatever the package of a file raises about it, as it may be damaged in any place, into an error that names
    both.  What the package would log is in that error."""
    wanted = _BEGINNINGS[path.suffix.lower()]
    with path.open("rb") as stream:
        if stream.read(len(wanted)) != wanted:
            # Its package would read nothing.
            raise SpecError(f"{path} cannot be read: it is no {path.suffix} file.", path=str(path))
    package = NEEDED_PACKAGES[path.suffix.lower()][0]
    import_module(package)
    loggers = [
        logging.getLogger(name) for name in (package, *logging.root.manager.loggerDict) if name.startswith(package)
    ]
    were_disabled = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    except SpecError:
        raise
    except Exception as error:  # readers of damaged bytes raise what comes: struct.error, TypeError, a bare Exception
        raise _unreadable(path, package, error) from error
    finally:
        for logger, was_disabled in zip(loggers, were_disabled, strict=True):
            logger.disabled = was_disabled


def _unreadable(path: Path, package: str, error: Exception) -> SpecError:
    told = " ".join(reason(error).split()) or type(error).__name__
    return SpecError(
        f"{path} cannot be read: {package} says {told!r}. If the file is damaged, or its end is missing, copy it or "
        "export it again.",
        path=str(path),
    )


def _parquet(path: Path, signals: LogSignals, stamps: Stamps, rows: int) -> Iterator[pd.DataFrame]:
    import pyarrow.parquet

    time = signals.columns[0]
    with pyarrow.parquet.ParquetFile(path) as file:
        header, own, counted = _parquet_header(file.schema_arrow, time)
        places = signals.positions(tuple(header))
        more = [date_place(header, places), *status_places(header, places)]
        wanted = [
            own if header[place] == time else header[place]
            # In their order: a status stands right of its value.
            for place in sorted({place for place in (*places, *more) if place is not None})
            if header[place] != time or not counted
        ]
        done = 0
        for batch in file.iter_batches(batch_size=rows, columns=wanted):
            # What pandas notes about an index would take it out of the columns.
            frame = batch.to_pandas(ignore_metadata=True).rename(columns={own: time})
            if counted is not None:
                frame[time] = counted[0] + counted[1] * np.arange(done, done + len(frame))
            done += len(frame)
            yield frame


def _parquet_names(path: Path, wanted: Sequence[str]) -> list[str]:
    import pyarrow.parquet

    return _parquet_header(pyarrow.parquet.read_schema(path), wanted[0])[0]


def _parquet_header(schema: Any, time: str) -> tuple[list[str], str, tuple[float, float] | None]:
    """Return the names of all columns, how the file itself calls the time, and first number and step of the time where
    it is an index that counts, which pandas writes to no column.  Dates and time differences may have no name."""
    import pyarrow as pa

    names = list(schema.names)
    indices = [] if time in names else (schema.pandas_metadata or {}).get("index_columns", [])
    for index in indices:
        if isinstance(index, dict) and index.get("kind") == "range" and index.get("name") == time:
            return [*names, time], time, (float(index["start"]), float(index["step"]))
        if time == TIME_HEADER and isinstance(index, str) and index.startswith(_UNNAMED_INDEX):
            kind = schema.field(index).type
            if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
                return [time if name == index else name for name in names], index, None
    return names, time, None


def _only(path: Path, name: str, channels: Sequence[tuple[str, str, Any]]) -> Any:
    """Return the channel that is called so, or as its group and it, such as ``rig/level``; `None` where there is none.
    ``channels`` are groups, names and channels."""
    found = [(group, channel) for group, own, channel in channels if name in (own, f"{group}/{own}")]
    found = found or [(group, channel) for group, own, channel in channels if column_of([own], name)]
    if len(found) > 1:
        groups = ", ".join(repr(group) for group, _ in found)
        raise SpecError(
            f"{path} has more than one channel {name!r}, in the groups {groups}: name the group too, such as "
            f"'{found[0][0]}/{name}' (--map, or columns={{...}}).",
            path=str(path),
        )
    return found[0][1] if found else None


def _tdms(path: Path, signals: LogSignals, stamps: Stamps, rows: int) -> Iterator[pd.DataFrame]:
    """Yield the channels of a TDMS file; where no channel is the time, that of the waveforms is."""
    from nptdms import TdmsFile

    with path.open("rb") as stream, TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            stamps.notes.append(f"{path} ends within its last segment: what follows was lost, or not written yet.")
        channels = _tdms_channels(file)
        found = {name: _only(path, name, channels) for name in signals.columns}
        wanted = {name: channel for name, channel in found.items() if channel is not None}
        frame: dict[str, Any] = {name: channel[:] for name, channel in wanted.items()}
        time = signals.columns[0]
        lengths = {name: len(values) for name, values in frame.items()}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{name!r} {count}" for name, count in lengths.items())
            raise SpecError(f"{path}: the channels have different numbers of samples: {told}.", path=str(path))
        if time not in frame and wanted:
            waves = {name: channel for name, channel in wanted.items() if "wf_increment" in channel.properties}
            if waves:
                frame = {time: _wave_times(path, waves), **frame}
        others = {name: np.zeros(0) for _, name, _ in channels if name not in frame}
        yield from _frames(frame, others, signals, rows)


def _tdms_channels(file: Any) -> list[tuple[str, str, Any]]:
    return [(group.name, channel.name, channel) for group in file.groups() for channel in group.channels()]


def _tdms_names(path: Path, wanted: Sequence[str]) -> list[str]:
    from nptdms import TdmsFile

    with path.open("rb") as stream, TdmsFile.read_metadata(stream) as file:
        channels = _tdms_channels(file)
        have_times = any("wf_increment" in channel.properties for _, name, channel in channels if name in wanted)
        return _called(channels, wanted, have_times=have_times)


def _called(channels: Sequence[tuple[str, str, Any]], wanted: Sequence[str], *, have_times: bool) -> list[str]:
    """Return the names of channels, with the group too where they are wanted so; the time, which is wanted first, as
    well where the file has times without a channel of that name."""
    names = list(dict.fromkeys(name for _, name, _ in channels))
    full = {f"{group}/{name}" for group, name, _ in channels}
    names += [name for name in dict.fromkeys(wanted) if name in full and name not in names]
    return [*names, wanted[0]] if have_times and wanted[0] not in names else names


def _wave_times(path: Path, waves: dict[str, Any]) -> FloatArray:
    """Return the times of waveforms ``(rows,)``, which must be the same for all of them."""
    first = next(iter(waves))
    times = np.asarray(waves[first].time_track())
    start = waves[first].properties.get("wf_start_time")
    for name, wave in waves.items():
        own = np.asarray(wave.time_track())
        begin = wave.properties.get("wf_start_time")
        if begin is not None and start is not None:
            own = own + (begin - start) / np.timedelta64(1, "s")
        step = abs(float(waves[first].properties["wf_increment"]))
        if not np.all(np.abs(own - times) <= LARGEST_SHIFT * step):
            raise SpecError(
                f"{path}: the waveforms {first!r} and {name!r} have other times: resample them to the same times.",
                path=str(path),
            )
    return times


def _mdf(path: Path, signals: LogSignals, stamps: Stamps, rows: int) -> Iterator[pd.DataFrame]:
    """Yield the channels of an MDF file on the raster of the first signal, with the stamps of the time channel."""
    with _mdf_file(path) as file:
        known = _mdf_channels(file)
        masters = set(file.masters_db.items())
        time = signals.columns[0]
        found = {name: _only(path, name, known) for name in signals.columns[1:]}
        wanted = {name: place for name, place in found.items() if place is not None}
        frame: dict[str, Any] = {}
        if wanted:
            raster = np.asarray(file.get_master(next(iter(wanted.values()))[0]), dtype=np.float64)
            of_time = _only(path, time, [entry for entry in known if entry[2] not in masters])
            names = {name for _, name, place in known if place in masters}
            if of_time is not None:
                frame[time] = _on_raster(file, time, of_time, raster)
            elif time == TIME_HEADER or time in names:
                frame[time] = raster
            frame.update({name: _on_raster(file, name, place, raster) for name, place in wanted.items()})
        yield from _frames(frame, dict.fromkeys(name for _, name, _ in known), signals, rows)


def _mdf_channels(file: Any) -> list[tuple[str, str, tuple[int, int]]]:
    return [(str(group), name, (group, at)) for name, places in file.channels_db.items() for group, at in places]


def _mdf_names(path: Path, wanted: Sequence[str]) -> list[str]:
    with _mdf_file(path) as file:
        return _called(_mdf_channels(file), wanted, have_times=wanted[0] == TIME_HEADER)


@contextmanager
def _mdf_file(path: Path) -> Iterator[Any]:
    """Open an MDF file.  What asammdf leaves of one that it cannot open fails once more when it is thrown away: nobody
    is to read of it."""
    from asammdf import MDF

    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        file = MDF(path)
    except Exception as error:
        # Without its traceback nothing holds what is half open but itself.
        error.with_traceback(None)
        gc.collect()
        raise _unreadable(path, "asammdf", error) from error
    finally:
        sys.unraisablehook = hook
    with file:
        _require_channels_within_records(path, file)
        yield file


def _require_channels_within_records(path: Path, file: Any) -> None:
    """Raise `SpecError` for an MDF file with a channel outside of its records, as changed bytes make them: code of
    asammdf in C would read there, and end the process."""
    for group in file.groups:
        bits = 8 * (group.channel_group.samples_byte_nr + getattr(group.channel_group, "invalidation_bytes_nr", 0))
        for channel in group.channels:
            # Version 4, and those before.
            start = (
                8 * channel.byte_offset + channel.bit_offset
                if hasattr(channel, "byte_offset")
                else 8 * getattr(channel, "additional_byte_offset", 0) + channel.start_offset
            )
            if start + channel.bit_count > bits:
                raise SpecError(
                    f"{path} cannot be read: its channel {channel.name!r} lies outside of its records. The file is "
                    "damaged: copy it or export it again.",
                    path=str(path),
                )


def _on_raster(file: Any, name: str, place: tuple[int, int], raster: FloatArray) -> Any:
    """Return a channel on a raster ``(rows,)``: interpolated between its samples, missing where it has none or where
    the logger says that they are invalid."""
    group, index = place
    signal = file.get(group=group, index=index)
    if signal.samples.ndim != 1 or signal.samples.dtype.names:
        raise SpecError(f"The channel {name!r} holds arrays: give one that holds a number a sample.", path="columns")
    own = np.asarray(file.get_master(group), dtype=np.float64)
    valid = np.isin(own, signal.timestamps)
    if np.array_equal(own, raster) and valid.all():
        return _cells_of(signal.samples)
    if np.any(np.diff(own) < 0) or not len(signal.samples):
        raise SpecError(
            f"The channel {name!r} has {'times that fall' if len(signal.samples) else 'no valid sample'}.",
            path="columns",
        )
    # Half a step before the first sample and after the last one these still count.
    margin = LARGEST_SHIFT * float(np.median(np.diff(own))) if len(own) > 1 else 0.0
    within = np.interp(raster, own, valid.astype(np.float64)) == 1.0
    within &= (raster >= own[0] - margin) & (raster <= own[-1] + margin)
    cells = _cells_of(signal.interp(raster).samples)
    return np.where(within, cells, None if cells.dtype == object else np.nan)


def _cells_of(samples: Any) -> Any:
    """Return samples ``(rows,)`` as numbers, or as the texts of a channel of words."""
    if samples.dtype.kind == "S":
        return np.array([cell.decode("utf-8", "replace") for cell in samples], dtype=object)
    return np.asarray(samples, dtype=object if samples.dtype.kind == "U" else np.float64)


def _frames(found: dict[str, Any], others: dict[str, Any], signals: LogSignals, rows: int) -> Iterator[pd.DataFrame]:
    """Yield columns in chunks; names that are not there are told with all that are."""
    import pandas as pd

    if not set(signals.columns) <= set(found):
        signals.positions(tuple(dict.fromkeys((*found, *others))))
    frame = pd.DataFrame(found)
    for start in range(0, max(len(frame), 1), rows):
        yield frame.iloc[start : start + rows]


#: What yields the rows of a file, and what names all of its columns, of which some are wanted, the time first.
READERS: dict[
    str,
    tuple[Callable[[Path, LogSignals, Stamps, int], Iterator[Any]], Callable[[Path, Sequence[str]], list[str]]],
] = {
    ".parquet": (_parquet, _parquet_names),
    ".tdms": (_tdms, _tdms_names),
    ".mf4": (_mdf, _mdf_names),
    ".mdf": (_mdf, _mdf_names),
    ".dat": (_mdf, _mdf_names),
}


def _with_time(frame: pd.DataFrame, signals: LogSignals) -> pd.DataFrame:
    """Return a frame whose index of dates, of time differences, or called as the time, is a column."""
    import pandas as pd

    time, names = signals.columns[0], [str(name) for name in frame.columns]
    frame = frame.set_axis(names, axis=1)
    dated = isinstance(frame.index, (pd.DatetimeIndex, pd.TimedeltaIndex))
    if time in names or not (frame.index.name == time or (dated and time == TIME_HEADER)):
        return frame
    return frame.assign(**{time: frame.index}).reset_index(drop=True)


def _converted(frames: Iterator[pd.DataFrame], signals: LogSignals, stamps: Stamps) -> Iterator[FloatArray]:
    done = 0
    for frame in frames:
        header = tuple(str(name) for name in frame.columns)
        places = signals.positions(header)
        if not done:
            stamps.take_header(header, signals.columns, places)
            factors, shifts = signals.conversions(header, places, stamps)
        date = date_place(header, places)
        times = _times(frame.iloc[:, places[0]], done, stamps, None if date is None else frame.iloc[:, date])
        values = []
        for place, state in zip(places[1:], status_places(header, places)[1:], strict=True):
            column = _numbers(frame.iloc[:, place], done, stamps)
            states = None if state is None else frame.iloc[:, state]
            values.append(column if states is None else _without_bad(column, header[place], states, done, stamps))
        yield np.column_stack(
            [times, *(factor * value + shift for factor, value, shift in zip(factors, values, shifts, strict=True))]
        )
        done += len(frame)
    if done == 0:
        raise SpecError("The data have no rows.", path="data")


def _without_bad(values: FloatArray, name: str, states: pd.Series, done: int, stamps: Stamps) -> FloatArray:
    """Return samples ``(n,)`` without those of which their status says that they are bad."""
    said = [str(cell).strip() for cell in states]
    bad = np.array([is_bad(text) for text in said], dtype=bool)
    if bad.any():
        first = int(np.argmax(bad))
        stamps.take_bad(name, done + first + 1, said[first], str(states.name), count=int(bad.sum()))
    return np.where(bad, np.nan, values)


def _times(column: pd.Series, done: int, stamps: Stamps, dates: pd.Series | None) -> FloatArray:
    """Return a column of time stamps as seconds; ``dates`` may stand beside times of day."""
    import pandas as pd

    found = stamps.read_column(column)
    if found is not None:
        return found
    if pd.api.types.is_numeric_dtype(column):
        stamps.take_number()
        return stamps.seconds(_numbers(column, done))
    texts = ["" if pd.isna(cell) else str(cell) for cell in column]
    if dates is not None:
        texts = [with_date(str(date), text) for date, text in zip(dates, texts, strict=True)]
    return np.array([stamps.read(text, done + i + 1, str(column.name)) for i, text in enumerate(texts)])


def _numbers(column: pd.Series, done: int, stamps: Stamps | None = None) -> FloatArray:
    """Return a column as numbers; a cell that is no number is named with its row."""
    import pandas as pd

    if pd.api.types.is_complex_dtype(column):
        raise SpecError(f"The column {str(column.name)!r} holds complex numbers: give real ones.", path="columns")
    if pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column):
        found = np.asarray(column.to_numpy(dtype=np.float64, na_value=np.nan))
        if stamps is not None and not np.isnan(found).all():
            stamps.numeric.add(str(column.name))
        return found
    texts = [None if pd.isna(cell) else str(cell) for cell in column]
    return np.array([number_in_cell(text, done + i + 1, str(column.name), stamps) for i, text in enumerate(texts)])
