"""Input files: only regular files are read, and the same command cannot overwrite them."""

from __future__ import annotations

import json
import math
import os
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TextIO

from obsynth.errors import SpecError, a_kind

#: Documents larger than this are refused: matrices of that size belong in matrix files.
MOST_DOCUMENT_CHARACTERS = 32_000_000

#: How alike the name of a file must be to one that may be meant, as `difflib` measures it.
CLOSE_NAME = 0.75

#: A folder with more specs is not asked about: the question would be longer than the answer.
MOST_FILES_NAMED = 3

#: What the readers of numpy and scipy raise for a damaged file.
READING_ERRORS = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    EOFError,
    OverflowError,
    RuntimeError,
    MemoryError,
    AttributeError,
    NotImplementedError,
    UserWarning,
    struct.error,
    zlib.error,
    zipfile.BadZipFile,
)

#: Half of a pair of characters, which no file can hold; as JSON writes it, and as text.
_HALF_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")

#: What a number beyond the range of floats has: an exponent of three digits, or as many digits before its point.
_PERHAPS_INFINITE = re.compile(r"\d[eE]\+?\d{3}|\d{300}")

#: Of a number in a message so many digits are shown.
MOST_SHOWN_DIGITS = 20

#: What a path can be that is neither a file nor a folder.
_SPECIAL = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}

#: What files of other kinds are, by their endings.
_KINDS_BY_SUFFIX = {
    **dict.fromkeys((".csv", ".tsv", ".xlsx", ".xlsm", ".parquet", ".tdms", ".mf4", ".mdf", ".dat"), "a log (a table)"),
    ".mat": "a file of MATLAB",
    ".npz": "a file of numpy",
    ".mtx": "a matrix",
    ".fmu": "an FMU",
    **dict.fromkeys((".c", ".h"), "C code"),
    **dict.fromkeys((".html", ".htm"), "a page for people to read"),
}

#: Where a file of another kind belongs, by its ending.
_PLACES_BY_SUFFIX = {
    **dict.fromkeys(
        (".csv", ".tsv", ".xlsx", ".xlsm", ".parquet", ".tdms", ".mf4", ".mdf", ".dat"),
        "Logs are given with --data, as to `obsynth run`.",
    ),
    ".mat": "A model in it is read in Python, by obsynth.from_matlab.",
    ".fmu": "A model in it is read in Python, by obsynth.from_fmu.",
}

#: Device and number of each file that the running command has read; `None` outside commands.
_read: ContextVar[dict[tuple[int, int], Path] | None] = ContextVar("files read", default=None)


@contextmanager
def protected_inputs() -> Iterator[None]:
    """Protect every file that is read from here on: the writer refuses to replace it, under whatever name."""
    token = _read.set({})
    try:
        yield
    finally:
        _read.reset(token)


def protect(path: Path) -> None:
    """Count a file among the inputs of the running command."""
    _protect(path, path)


def protect_stream(stream: TextIO) -> None:
    """Count the file that a stream reads among the inputs of the running command, if it is one."""
    with suppress(OSError, ValueError, AttributeError):
        _protect(stream.fileno(), Path("standard input"))


def _protect(file: Path | int, name: Path) -> None:
    inputs = _read.get()
    if inputs is None:
        return
    with suppress(OSError, ValueError):
        status = os.stat(file)
        if stat.S_ISREG(status.st_mode):
            inputs[status.st_dev, status.st_ino] = name


def protected_as(path: Path) -> Path | None:
    """Return the name under which the running command has read a file, links followed; `None` if it has not."""
    inputs = _read.get()
    if not inputs:
        return None
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return inputs.get((status.st_dev, status.st_ino))


def special_kind(path: Path) -> str | None:
    """Return what an existing path is that is neither file nor folder, such as ``a named pipe``; `None` otherwise."""
    return _SPECIAL.get(stat.S_IFMT(os.stat(path).st_mode))


def _similar_files(path: Path) -> str:
    """Return a question with the files of the folder whose names are close to a wrong one; empty where none is."""
    import difflib

    try:
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry in entries if entry.is_file()]
    except OSError:
        return ""
    close = difflib.get_close_matches(path.name, names, n=2, cutoff=CLOSE_NAME)
    return f" Did you mean {' or '.join(str(path.parent / name) for name in close)}?" if close else ""


def _files_inside(folder: Path, suffixes: tuple[str, ...]) -> str:
    """Return a question with the files in a folder that end so, ``spec.yaml`` if it is one; empty where many do."""
    try:
        files = sorted(entry for entry in folder.iterdir() if entry.name.endswith(suffixes) and entry.is_file())
    except OSError:
        return ""
    files = [entry for entry in files if entry.name in ("spec.yaml", "spec.yml")] or files
    return f" Did you mean {' or '.join(map(str, files))}?" if 0 < len(files) <= MOST_FILES_NAMED else ""


def input_file(
    path: Path,
    *,
    where: str | None = None,
    is_protected: bool = True,
    suffixes: tuple[str, ...] = (".yaml", ".yml"),
) -> Path:
    """Return ``path`` if it is a regular file, and protect it; anything else is a `SpecError` at ``where``, of a folder
    with its files that end in ``suffixes``."""
    place = where or str(path)
    try:
        if path.is_dir():
            raise SpecError(f"{path} is a folder: give the name of a file.{_files_inside(path, suffixes)}", path=place)
        if not path.exists():
            raise SpecError(f"{path} does not exist.{_similar_files(path)}", path=place)
        kind = special_kind(path)
    except (OSError, ValueError) as error:
        raise SpecError(f"{path!s} cannot be read: {reason(error)}.", path=place) from error
    if kind is not None:
        raise SpecError(f"{path} is {kind}: give the name of a file.", path=place)
    if is_protected:
        protect(path)
    return path


def of_another_kind(path: Path, wanted: str) -> str | None:
    """Return a sentence on a file whose ending says that it is not what is wanted, such as "a spec"; ``None`` where it
    does not say so."""
    suffix = path.suffix.lower()
    if suffix not in _KINDS_BY_SUFFIX:
        return None
    place = _PLACES_BY_SUFFIX.get(suffix, "")
    return f"{path} is {_KINDS_BY_SUFFIX[suffix]}, not {wanted}.{place and ' '}{place}"


def suffix_error(path: Path, suffixes: Iterable[str]) -> SpecError:
    """Return the error for a file whose name ends in none of some suffixes."""
    has = "an unknown suffix" if path.suffix else "no suffix"
    return SpecError(f"{path} has {has}: use one of {', '.join(suffixes)}.", path=str(path))


def _lines_before(path: Path, most: int) -> int:
    """Return how many lines of a file, of at most so many bytes, end before its first byte that is no UTF-8."""
    with path.open("rb") as stream:
        data = stream.read(most)
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        return data[: error.start].count(b"\n")
    return data.count(b"\n")


def read_text(
    path: Path, *, where: str | None = None, is_protected: bool = True, most: int = MOST_DOCUMENT_CHARACTERS
) -> str:
    """Return the text of a UTF-8 file of at most ``most`` characters."""
    place = where or str(path)
    input_file(path, where=place, is_protected=is_protected)
    try:
        with path.open(encoding="utf-8-sig") as stream:
            text = stream.read(most + 1)
    except UnicodeDecodeError as error:
        line = _lines_before(path, 4 * most) + 1
        damaged = f"{path} is no UTF-8 text (line {line}): save it as UTF-8."
        raise SpecError(of_another_kind(path, "a document of text") or damaged, path=place) from error
    except (OSError, MemoryError) as error:
        raise SpecError(f"{path} cannot be read: {reason(error)}.", path=place) from error
    if len(text) > most:
        raise SpecError(
            f"{path} is too large for a document (more than {most:,} characters): large matrices belong in "
            ".mtx or .npz files.",
            path=place,
        )
    return text


def read_json(
    path: Path, *, where: str | None = None, is_protected: bool = True, most: int = MOST_DOCUMENT_CHARACTERS
) -> Any:
    """Return a JSON document: no NaN, no whole number beyond the range of floats, no key twice, no half characters."""
    place = where or str(path)
    text = read_text(path, where=place, is_protected=is_protected, most=most)
    try:
        document = json_data(text)
        if _HALF_CHARACTER.search(text):
            json.dumps(document, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        if path.suffix.lower() in (".yaml", ".yml"):
            problem = f"{path} is a spec, not a file that obsynth wrote. Run `obsynth design --system {path}` first."
        elif path.suffix.lower() in (".html", ".htm"):
            problem = (
                f"{path} is a page for people to read. What is verified is the gain set that `obsynth design` wrote "
                "beside it (.gains.json)."
            )
        else:
            other = of_another_kind(path, "a file that obsynth wrote (JSON)")
            problem = other or f"{path} is not a JSON document ({error})."
        raise SpecError(problem, path=place) from error
    return document


def json_data(text: str) -> Any:
    """Return what a JSON text says; `ValueError` for NaN, numbers beyond the range of floats and repeated keys."""
    return json.loads(
        text,
        parse_constant=_refused_constant,
        parse_int=_ranged_int,
        # A function for every number takes as long as all the rest of a large file.
        parse_float=_ranged_float if _PERHAPS_INFINITE.search(text) else None,
        object_pairs_hook=_distinct_keys,
    )


def _refused_constant(name: str) -> float:
    raise ValueError(f"{name} is not allowed in JSON")


def _ranged_int(text: str) -> int:
    if math.isinf(float(text)):
        raise ValueError(f"a whole number of {len(text)} digits is too large")
    return int(text)


def _ranged_float(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        shown = text if len(text) <= MOST_SHOWN_DIGITS else f"{text[:MOST_SHOWN_DIGITS]}..."
        raise ValueError(f"{shown} is beyond the range of floats")
    return value


def _distinct_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) != len(pairs):
        keys = [key for key, _ in pairs]
        repeated = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {repeated!r} is there twice")
    return mapping


def reason(error: BaseException) -> str:
    """Return what the system says about an error, without the name of the file."""
    if isinstance(error, MemoryError):
        return "it does not fit into memory"
    return str(getattr(error, "strerror", None) or error).rstrip(".")


def path_of(path: Any) -> Path:
    """Return the path that a caller names; raise `SpecError` for what names none."""
    if not isinstance(path, (str, os.PathLike)):
        raise SpecError(f"path is {a_kind(path)}: give the name of a file.", path="path")
    return Path(path)
