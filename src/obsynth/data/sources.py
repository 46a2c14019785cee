"""Where rows come from: text, Parquet, TDMS and MDF files in chunks, data frames, and text streams row by row."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeAlias

import numpy as np

from obsynth.data.signals import TIME_HEADER, Signals, Stamps
from obsynth.data.text_logs import Dialect, no_text, stream_rows, text_chunks
from obsynth.errors import SpecError
from obsynth.files.inputs import input_file
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


def chunks(data: Data, signals: Signals, stamps: Stamps, rows: int) -> Iterator[FloatArray]:
    """Yield ``(rows, 1 + nu + ny)``: time and signals, in order; NaN where a sample is missing.  Inputs are those that
    act in a row as the design takes it."""
    found = _chunks(data, signals, stamps, rows)
    if not signals.delay or not signals.inputs:
        yield from found
    elif signals.delay > 0:
        yield from _delayed(found, signals, stamps)
    else:
        yield from _advanced(found, signals)


def _delayed(found: Iterator[FloatArray], signals: Signals, stamps: Stamps) -> Iterator[FloatArray]:
    """Yield rows with the inputs of so many rows before; the first ones hold their own."""
    inputs = slice(1, 1 + signals.inputs)
    for chunk in found:
        if stamps.earlier is None:
            stamps.earlier = np.repeat(chunk[:1, inputs], signals.delay, axis=0)
        whole = np.vstack([stamps.earlier, chunk[:, inputs]])
        stamps.earlier = whole[len(chunk) :]
        chunk[:, inputs] = whole[: len(chunk)]
        yield chunk


def _advanced(found: Iterator[FloatArray], signals: Signals) -> Iterator[FloatArray]:
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


def _chunks(data: Data, signals: Signals, stamps: Stamps, rows: int) -> Iterator[FloatArray]:
    if isinstance(data, str | Path):
        path = Path(data)
        check_suffix(path, (*TEXT_SUFFIXES, *NEEDED_PACKAGES))
        with _readable(path):
            if path.suffix.lower() in TEXT_SUFFIXES:
                yield from text_chunks(path, signals, stamps, rows)
            else:
                _require_beginning(path)
                yield from _converted(_READERS[path.suffix.lower()](path, signals, rows), signals, stamps)
    elif is_stream(data):
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


def samples(data: Data, signals: Signals) -> Iterator[tuple[float, FloatArray]]:
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
def _readable(path: Path) -> Iterator[None]:
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
        raise SpecError(f"{path} cannot be read: {error.strerror or error}.", path=str(path)) from error
    except (ValueError, KeyError, IndexError, AttributeError, Warning) as error:
        raise SpecError(f"{path} cannot be read: {' '.join(str(error).split())}", path=str(path)) from error


def _parquet(path: Path, signals: Signals, rows: int) -> Iterator[pd.DataFrame]:
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path) as file:
        signals.positions(tuple(file.schema_arrow.names))
        for batch in file.iter_batches(batch_size=rows, columns=list(dict.fromkeys(signals.columns))):
            yield batch.to_pandas()


def _tdms(path: Path, signals: Signals, rows: int) -> Iterator[pd.DataFrame]:
    """Yield the channels of a TDMS file; where no channel is the time, that of the waveforms is."""
    from nptdms import TdmsFile

    with TdmsFile.open(path) as file:
        channels = {channel.name: channel for group in file.groups() for channel in group.channels()}
        wanted = {name: channels[name] for name in signals.columns if name in channels}
        frame: dict[str, Any] = {name: channel[:] for name, channel in wanted.items()}
        time = signals.columns[0]
        if time not in frame and wanted:
            first = next(iter(wanted.values()))
            if "wf_increment" in first.properties:
                frame = {time: first.time_track(), **frame}
        lengths = {name: len(values) for name, values in frame.items()}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{name!r} {count}" for name, count in lengths.items())
            raise SpecError(f"{path}: the channels have different numbers of samples: {told}.", path=str(path))
        others = {name: np.zeros(0) for name in channels if name not in frame}
        yield from _frames(frame, others, signals, rows)


def _mdf(path: Path, signals: Signals, rows: int) -> Iterator[pd.DataFrame]:
    """Yield the channels of an MDF file on one raster: that of the time channel, else of the first signal."""
    from asammdf import MDF

    with MDF(path) as file:
        known = [name for name in file.channels_db if file.channels_db[name]]
        wanted = [name for name in signals.columns[1:] if name in known]
        frame: dict[str, Any] = {}
        if wanted:
            raster = file.get(wanted[0]).timestamps
            frame[signals.columns[0]] = raster
            for name in wanted:
                signal = file.get(name)
                if len(signal.timestamps) != len(raster) or not np.array_equal(signal.timestamps, raster):
                    signal = signal.interp(raster)
                frame[name] = np.asarray(signal.samples, dtype=np.float64)
        yield from _frames(frame, dict.fromkeys(known), signals, rows)


def _frames(found: dict[str, Any], others: dict[str, Any], signals: Signals, rows: int) -> Iterator[pd.DataFrame]:
    """Yield columns in chunks; names that are not there are told with all that are."""
    import pandas as pd

    if not set(signals.columns) <= set(found):
        signals.positions(tuple(dict.fromkeys((*found, *others))))
    frame = pd.DataFrame(found)
    for start in range(0, max(len(frame), 1), rows):
        yield frame.iloc[start : start + rows]


#: How files of these kinds begin.
_BEGINNINGS = {".tdms": b"TDSm", ".mf4": b"MDF ", ".mdf": b"MDF ", ".dat": b"MDF "}


def _require_beginning(path: Path) -> None:
    """Raise `SpecError` for a file that is something else than its name says: its package would read nothing."""
    wanted = _BEGINNINGS.get(path.suffix.lower())
    if wanted is None:
        return
    with path.open("rb") as stream:
        if stream.read(len(wanted)) != wanted:
            raise SpecError(f"{path} cannot be read: it is no {path.suffix} file.", path=str(path))


_READERS: dict[str, Callable[[Path, Signals, int], Iterator[Any]]] = {
    ".parquet": _parquet,
    ".tdms": _tdms,
    ".mf4": _mdf,
    ".mdf": _mdf,
    ".dat": _mdf,
}


def _with_time(frame: pd.DataFrame, signals: Signals) -> pd.DataFrame:
    """Return a frame whose index of dates, of time differences, or called as the time, is a column."""
    import pandas as pd

    time, names = signals.columns[0], [str(name) for name in frame.columns]
    dated = isinstance(frame.index, (pd.DatetimeIndex, pd.TimedeltaIndex))
    if time in names or not (dated or frame.index.name == time):
        return frame
    if time != TIME_HEADER and frame.index.name != time:
        return frame
    return frame.assign(**{time: frame.index}).reset_index(drop=True)


def _converted(frames: Iterator[pd.DataFrame], signals: Signals, stamps: Stamps) -> Iterator[FloatArray]:
    done = 0
    for frame in frames:
        places = signals.positions(tuple(str(name) for name in frame.columns))
        times = _times(frame.iloc[:, places[0]], done, stamps)
        yield np.column_stack([times, *(_numbers(frame.iloc[:, place], done, stamps) for place in places[1:])])
        done += len(frame)
    if done == 0:
        raise SpecError("The data have no rows.", path="data")


def _times(column: pd.Series, done: int, stamps: Stamps) -> FloatArray:
    """Return a column of time stamps as seconds."""
    import pandas as pd

    found = stamps.read_column(column)
    if found is not None:
        return found
    if pd.api.types.is_numeric_dtype(column):
        stamps.is_dated = False
        return stamps.seconds(_numbers(column, done))
    texts = ["" if pd.isna(cell) else str(cell) for cell in column]
    return np.array([stamps.read(text, done + i + 1, str(column.name)) for i, text in enumerate(texts)])


def _numbers(column: pd.Series, done: int, stamps: Stamps | None = None) -> FloatArray:
    """Return a column as numbers; a cell that is no number is named with its row."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column):
        return np.asarray(column.to_numpy(dtype=np.float64, na_value=np.nan))
    texts = [None if pd.isna(cell) else str(cell) for cell in column]
    plain, shown, found = Dialect(","), False, list[float]()
    for i, text in enumerate(texts):
        found.append(plain.number(text, done + i + 1, str(column.name), stamps if shown else None))
        shown = shown or math.isfinite(found[-1])
    return np.array(found)
