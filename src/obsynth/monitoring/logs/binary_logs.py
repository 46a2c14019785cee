"""Logs in files that a package reads: Parquet, TDMS, MDF, NumPy and MATLAB, in chunks of data frames."""

from __future__ import annotations

import gc
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.files.inputs import reason
from obsynth.monitoring.logs.signals import TIME_HEADER, LogSignals, column_of, date_place, status_places
from obsynth.monitoring.logs.stamps import Stamps
from obsynth.monitoring.logs.unpacked_logs import channel_frame, mat_channels, npz_channels
from obsynth.numerics.arrays import FloatArray

if TYPE_CHECKING:
    import pandas as pd


#: Package of a file by its suffix, and the extra that installs it.
NEEDED_PACKAGES = {
    ".parquet": ("pyarrow", "parquet"),
    ".tdms": ("nptdms", "tdms"),
    ".mf4": ("asammdf", "mdf"),
    ".mdf": ("asammdf", "mdf"),
    ".dat": ("asammdf", "mdf"),
    ".xlsx": ("openpyxl", "excel"),
    ".xlsm": ("openpyxl", "excel"),
    ".npz": ("numpy", ""),
    ".mat": ("scipy", ""),
}

#: How pandas calls the column of an index without a name.
_UNNAMED_INDEX = "__index_level_"

#: Waveforms whose samples are further apart than this share of their interval are no rows of one table.
LARGEST_SHIFT = 0.5

#: How files of these kinds begin.
_BEGINNINGS = {".parquet": b"PAR1", ".tdms": b"TDSm", ".mf4": b"MDF ", ".mdf": b"MDF ", ".dat": b"MDF "}
_BEGINNINGS |= {".npz": b"PK\3\4", ".mat": b"MATLAB"}

#: Returns the channels of a file: group, name and samples of each.
_Channels: TypeAlias = "Callable[[Path], list[tuple[str, str, Any]]]"


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
    cause = " ".join(reason(error).split()) or type(error).__name__
    return SpecError(
        f"{path} cannot be read: {package} says {cause!r}. If the file is damaged, or its end is missing, copy it or "
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
    matches = [(group, channel) for group, own, channel in channels if name in (own, f"{group}/{own}")]
    matches = matches or [(group, channel) for group, own, channel in channels if column_of([own], name)]
    if len(matches) > 1:
        groups = ", ".join(repr(group) for group, _ in matches)
        raise SpecError(
            f"{path} has more than one channel {name!r}, in the groups {groups}: name the group too, such as "
            f"'{matches[0][0]}/{name}' (--map, or columns={{...}}).",
            path=str(path),
        )
    return matches[0][1] if matches else None


def _tdms(path: Path, signals: LogSignals, stamps: Stamps, rows: int) -> Iterator[pd.DataFrame]:
    """Yield the channels of a TDMS file; where no channel is the time, that of the waveforms is."""
    from nptdms import TdmsFile

    with path.open("rb") as stream, TdmsFile.open(stream) as file:
        if file.file_status.incomplete_final_segment:
            stamps.notes.append(f"{path} ends within its last segment: what follows was lost, or not written yet.")
        channels = _tdms_channels(file)
        by_name = {name: _only(path, name, channels) for name in signals.columns}
        wanted = {name: channel for name, channel in by_name.items() if channel is not None}
        frame: dict[str, Any] = {name: channel[:] for name, channel in wanted.items()}
        time = signals.columns[0]
        lengths = {name: len(values) for name, values in frame.items()}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{name!r} {count}" for name, count in lengths.items())
            raise SpecError(f"{path}: the channels have different numbers of samples: {listed}.", path=str(path))
        if time not in frame and wanted:
            waves = {name: channel for name, channel in wanted.items() if "wf_increment" in channel.properties}
            if waves:
                frame = {time: _wave_times(path, waves), **frame}
        unread = {name: np.zeros(0) for _, name, _ in channels if name not in frame}
        yield from _frames(frame, unread, signals, rows)


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
        channels = _mdf_channels(file)
        masters = set(file.masters_db.items())
        time = signals.columns[0]
        by_name = {name: _only(path, name, channels) for name in signals.columns[1:]}
        wanted = {name: place for name, place in by_name.items() if place is not None}
        frame: dict[str, Any] = {}
        if wanted:
            raster = np.asarray(file.get_master(next(iter(wanted.values()))[0]), dtype=np.float64)
            of_time = _only(path, time, [entry for entry in channels if entry[2] not in masters])
            names = {name for _, name, place in channels if place in masters}
            if of_time is not None:
                frame[time] = _on_raster(file, time, of_time, raster)
            elif time == TIME_HEADER or time in names:
                frame[time] = raster
            frame.update({name: _on_raster(file, name, place, raster) for name, place in wanted.items()})
        yield from _frames(frame, dict.fromkeys(name for _, name, _ in channels), signals, rows)


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


def _arrays(channels_of: _Channels, path: Path, signals: LogSignals, _: Stamps, rows: int) -> Iterator[pd.DataFrame]:
    """Yield the arrays of a file that are read."""
    channels = channels_of(path)
    by_name = {name: _only(path, name, channels) for name in signals.columns}
    frame = channel_frame({name: values for name, values in by_name.items() if values is not None}, path)
    unread = dict.fromkeys(name for _, name, _ in channels if name not in frame)
    yield from _frames({str(name): frame[name] for name in frame}, unread, signals, rows)


def _array_names(channels_of: _Channels, path: Path, wanted: Sequence[str]) -> list[str]:
    return _called(channels_of(path), wanted, have_times=False)


def _frames(columns: dict[str, Any], unread: dict[str, Any], signals: LogSignals, rows: int) -> Iterator[pd.DataFrame]:
    """Yield columns in chunks; names that are not there are told with all that are."""
    import pandas as pd

    if not set(signals.columns) <= set(columns):
        signals.positions(tuple(dict.fromkeys((*columns, *unread))))
    frame = pd.DataFrame(columns)
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
    ".npz": (partial(_arrays, npz_channels), partial(_array_names, npz_channels)),
    ".mat": (partial(_arrays, mat_channels), partial(_array_names, mat_channels)),
}
