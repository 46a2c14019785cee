"""Files: what is read is a regular file, protected from being overwritten by the same command; and the one writer.

Files that are written appear whole or not at all, never over what was read, and over others only if told.

Signals that end a process, made into exceptions, so that what is half done is removed or saved first.
"""

from __future__ import annotations

import io
import json
import math
import os
import re
import shutil
import signal
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TextIO

from obsynth.errors import SpecError, a_kind

#: Documents larger than this are refused: matrices of that size belong in matrix files.
MOST_DOCUMENT_CHARACTERS = 32_000_000
#: Half of a pair of characters, which no file can hold; as JSON writes it, and as text.
_HALF_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")
#: What a path can be that is neither a file nor a folder.
_SPECIAL = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
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
        found = os.stat(file)
        if stat.S_ISREG(found.st_mode):
            inputs[found.st_dev, found.st_ino] = name


def protected_as(path: Path) -> Path | None:
    """Return the name under which the running command has read a file, links followed; `None` if it has not."""
    inputs = _read.get()
    if not inputs:
        return None
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return None
    return inputs.get((found.st_dev, found.st_ino))


def special_kind(path: Path) -> str | None:
    """Return what an existing path is that is neither file nor folder, such as ``a named pipe``; `None` otherwise."""
    return _SPECIAL.get(stat.S_IFMT(os.stat(path).st_mode))


def input_file(path: Path, *, where: str | None = None, is_protected: bool = True) -> Path:
    """Return ``path`` if it is a regular file, and protect it; anything else is a `SpecError` at ``where``."""
    place = where or str(path)
    try:
        if path.is_dir():
            raise SpecError(f"{path} is a folder: give the name of a file.", path=place)
        if not path.exists():
            raise SpecError(f"{path} does not exist.", path=place)
        kind = special_kind(path)
    except (OSError, ValueError) as error:
        raise SpecError(f"{path!s} cannot be read: {reason(error)}.", path=place) from error
    if kind is not None:
        raise SpecError(f"{path} is {kind}: give the name of a file.", path=place)
    if is_protected:
        protect(path)
    return path


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
        raise SpecError(f"{path} is no UTF-8 text (byte {error.start}).", path=place) from error
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
        what = (
            ": files that obsynth wrote are expected here" if path.suffix.lower() in (".yaml", ".yml", ".csv") else ""
        )
        raise SpecError(f"{path} is no JSON document ({error}){what}.", path=place) from error
    return document


def json_data(text: str) -> Any:
    """Return what a JSON text says; `ValueError` for NaN, numbers beyond the range of floats and repeated keys."""
    return json.loads(text, parse_constant=_refused_constant, parse_int=_ranged_int, object_pairs_hook=_distinct_keys)


def _refused_constant(name: str) -> float:
    raise ValueError(f"{name} is not allowed in JSON")


def _ranged_int(text: str) -> int:
    if math.isinf(float(text)):
        raise ValueError(f"a whole number of {len(text)} digits is too large")
    return int(text)


def _distinct_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        keys = [key for key, _ in pairs]
        repeated = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {repeated!r} is there twice")
    return found


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


#: The system's ways to end a process; there is no hang-up on Windows.
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextmanager
def ending_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise `SystemExit` (128 + number), unless the program has said what they do."""
    with _handlers({number: _end for number in ENDING if signal.getsignal(number) == signal.SIG_DFL}):
        yield


class HeldSignals:
    """A context in which a row of a stream is finished before a signal ends the run; a second signal acts at once."""

    def __init__(self) -> None:
        self._is_held = False
        self._waiting: Callable[[], Any] | None = None

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Take over what SIGINT, SIGTERM and SIGHUP do."""
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, *ENDING)}

        def held(number: int, then: Callable[[int, FrameType | None], Any]) -> Any:
            def handler(_: int, frame: FrameType | None) -> Any:
                if self._is_held and self._waiting is None:
                    self._waiting = lambda: then(number, frame)
                    return None
                return then(number, frame)

            return handler

        with _handlers({number: held(number, then) for number, then in before.items() if callable(then)}):
            yield

    def __enter__(self) -> None:
        self._is_held = True

    def __exit__(self, kind: object, *_: object) -> None:
        self._is_held = False
        waiting, self._waiting = self._waiting, None
        # An error ends the run already.
        if waiting is not None and kind is None:
            waiting()


def _end(number: int, _: FrameType | None) -> NoReturn:
    raise SystemExit(128 + number)


@contextmanager
def _handlers(wanted: dict[Any, Any]) -> Iterator[None]:
    """Set handlers, and the ones from before afterwards; only the main thread may."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


#: Ending of a file that is not whole yet.
PART = ".part"
#: Bytes of the beginning and of the end of a file that are looked at to tell its kind.
LOOKED_AT = 1 << 16


#: Suffixes by which files of one format are named, the usual one first.
SUFFIXES = (
    (".csv", ".tsv", ".txt"),
    (".json",),
    (".yaml", ".yml"),
    (".html", ".htm"),
    *(
        (suffix,)
        for suffix in (".png", ".svg", ".pdf", ".jpg", ".parquet", ".xlsx", ".mat", ".npz", ".fmu", ".c", ".h")
    ),
)


@dataclass(frozen=True)
class FileKind:
    """A kind of file that obsynth writes: its name, a regular expression for its beginning or end, how it is named.

    ``ending``: end of the whole name by which an older one is known; ``suffix``: of its format, where it has one."""

    name: str
    mark: bytes
    ending: str | None = None
    suffix: str | None = None

    def check_name(self, target: Path) -> None:
        """Raise `SpecError` for a name that is that of another format."""
        named = next((group for group in SUFFIXES if target.suffix.lower() in group), None)
        if self.suffix is not None and named is not None and self.suffix not in named:
            raise SpecError(
                f"{target} would hold {self.name}, which is no {target.suffix} file: give it a name that ends in "
                f"{self.suffix}.",
                path=str(target),
            )

    def recognises(self, path: Path) -> bool:
        """Whether an existing file is of this kind, by its content or its name; empty files are of every kind."""
        if self.ending is not None and path.name.endswith(self.ending):
            return True
        with path.open("rb") as stream:
            content = stream.read(LOOKED_AT)
            size = os.fstat(stream.fileno()).st_size
            if size > LOOKED_AT:
                stream.seek(max(size - LOOKED_AT, LOOKED_AT))
                content += b"\0" + stream.read()
        return not content or re.search(self.mark, content) is not None


def check_output(path: str | Path, *, option: str = "") -> Path:
    """Return where to write; refuse a hopeless place, and any file that the running command has read."""
    target = path_of(path)
    where = str(target)
    wanted = f"give the name of a file{f' to {option}' if option else ''}"
    try:
        if target.is_dir():
            raise SpecError(f"{target} is a folder: {wanted}.", path=where)
        folder = _followed(target).parent
        if not folder.is_dir():
            raise SpecError(f"The folder {folder} does not exist: {target} cannot be written.", path=where)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise SpecError(
                f"{target} cannot be written: there is no permission to write to the folder {folder}.", path=where
            )
        # Asks the system about the name, which may be too long or hold a null character.
        special = special_kind(target) if _exists(target) else None
    except (OSError, ValueError) as error:
        raise SpecError(f"{target} cannot be written: {reason(error)}.", path=where) from error
    if special is not None:
        raise SpecError(f"{target} is {special}: {wanted}.", path=where)
    read = protected_as(target)
    if read is not None:
        also = "" if str(read) == where else f", as {read}"
        raise SpecError(
            f"{target} is read by this command{also}: it cannot be written as well, give another file.", path=where
        )
    return target


def check_replaceable(target: Path, kind: FileKind | None) -> None:
    """Raise `SpecError` for an existing file that is read-only or of another kind, both of which have to be forced."""
    advice = "give another name, or --force to replace it"
    try:
        if not _exists(target):
            return
        if not os.access(target, os.W_OK):
            raise SpecError(f"{target} is read-only: {advice}.", path=str(target))
        if kind is None or not kind.recognises(target):
            found = "exists" if kind is None else f"exists and is not {kind.name}"
            raise SpecError(f"{target} {found}: {advice}.", path=str(target))
    except OSError as error:
        raise SpecError(f"{target} cannot be read ({reason(error)}): {advice}.", path=str(target)) from error


def require_distinct(files: Mapping[str, str | Path | None]) -> None:
    """Raise `SpecError` if two of the files are the same, links followed; they are given by what they are for."""
    seen: dict[object, str] = {}
    for name, file in files.items():
        if file is None:
            continue
        path = Path(file)
        try:
            found = os.stat(path)
            keys: set[object] = {(found.st_dev, found.st_ino), os.path.realpath(path)}
        except (OSError, ValueError):
            keys = {os.path.realpath(path)} if "\0" not in str(path) else set()
        for key in keys:
            if seen.setdefault(key, name) != name:
                raise SpecError(f"{name} and {seen[key]} are the same file {path}: give another one.", path=str(path))


@contextmanager
def replacement_of(target: Path) -> Iterator[tuple[int, str]]:
    """Give an open file, and its path, that takes the place of ``target`` when all went well, else is removed."""
    with _temporary_beside(target) as (handle, temporary), _written(target):
        yield handle, temporary
        _settle(temporary, target)


@contextmanager
def made_folder(folder: Path) -> Iterator[Path]:
    """Give a folder, made where there is none; what was made and is still empty goes again if what follows fails."""
    missing: list[Path] = []
    try:
        missing = [place for place in (folder, *folder.parents) if not place.exists()]
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise SpecError(f"{folder} cannot be used as a folder: {reason(error)}.", path=str(folder)) from error
    try:
        yield folder
    except BaseException:
        for place in missing:
            with suppress(OSError):
                place.rmdir()
        raise


@contextmanager
def working_folder() -> Iterator[Path]:
    """Give a temporary folder for what is compiled or unpacked; what the system refuses there is a `SpecError`."""
    try:
        with tempfile.TemporaryDirectory(prefix="obsynth-", ignore_cleanup_errors=True) as folder:
            yield Path(folder)
    except OSError as error:
        raise SpecError(
            f"The folder for temporary files cannot be used: {reason(error)}. Name another one in TMPDIR.",
            path="TMPDIR",
        ) from error


def write_atomically(path: str | Path, content: str | bytes) -> Path:
    """Write ``content`` (text as UTF-8) to ``path`` so that the file is there whole or not at all."""
    target = check_output(path)
    with replacement_of(target) as (handle, _), os.fdopen(handle, "wb") as stream:
        stream.write(content.encode() if isinstance(content, str) else content)
    return target


def write_together(contents: Mapping[Path, str | bytes]) -> tuple[Path, ...]:
    """Write files that belong together: all of them appear, whole, or none does."""
    with ExitStack() as stack:
        temporaries = {}
        for target, content in contents.items():
            handle, temporaries[target] = stack.enter_context(_temporary_beside(target))
            with _written(target), os.fdopen(handle, "wb") as stream:
                stream.write(content.encode() if isinstance(content, str) else content)
        for target, temporary in temporaries.items():
            with _written(target):
                stack.enter_context(_undone_on_failure(target))
                _settle(temporary, target)
    return tuple(contents)


@contextmanager
def _temporary_beside(target: Path) -> Iterator[tuple[int, str]]:
    """Give an open temporary file in the folder of ``target``; what is left of it at the end is removed."""
    check_output(target)
    with ending_signals(), ExitStack() as stack:
        with _written(target):
            handle, temporary = _locked_part(_followed(target), stack)
        yield handle, temporary


def _locked_part(place: Path, stack: ExitStack) -> tuple[int, str]:
    """Return a new file for what becomes ``place``, locked until the end: the system unlocks it when we are killed."""
    while True:
        handle, temporary = tempfile.mkstemp(dir=place.parent, prefix=_part_prefix(place), suffix=PART)
        stack.callback(Path(temporary).unlink, missing_ok=True)
        locks = _locks()
        if locks is None:
            return handle, temporary
        # Who writes may close the file and open it again by its name.
        kept = os.dup(handle)
        stack.callback(os.close, kept)
        with suppress(OSError):  # not every file system has locks
            locks.flock(kept, locks.LOCK_EX)
        if os.path.exists(temporary):
            return handle, temporary
        os.close(handle)  # another process took it for a file that was left


def remove_left_parts(target: Path) -> None:
    """Remove what processes that were killed have left of ``target``; what a living one writes is locked and stays."""
    place, locks = _followed(target), _locks()
    if locks is None:
        return
    for part in place.parent.glob(f"{_part_prefix(place)}*{PART}"):
        with suppress(OSError), part.open("rb") as stream:
            locks.flock(stream, locks.LOCK_EX | locks.LOCK_NB)
            part.unlink()


def _part_prefix(place: Path) -> str:
    return f".obsynth-{sha256(os.fsencode(place.name)).hexdigest()[:12]}-"


def _locks() -> Any:
    """Return the module of file locks; ``None`` on Windows, where a file that is open cannot be removed anyway."""
    try:
        return import_module("fcntl")
    except ImportError:
        return None


def _settle(temporary: str, target: Path) -> None:
    """Put a temporary file in its place, with the permissions of the old file or else of any new one."""
    place = _followed(target)
    if place.exists():
        mode = place.stat().st_mode & 0o777
    else:
        mask = os.umask(0)
        os.umask(mask)
        mode = 0o666 & ~mask
    # What was read since the first check counts as well.
    check_output(target)
    os.chmod(temporary, mode)
    os.replace(temporary, place)


@contextmanager
def _undone_on_failure(target: Path) -> Iterator[None]:
    """Bring back what stood at ``target``, or nothing, if what follows fails."""
    place = _followed(target)
    with ExitStack() as stack:
        kept = None
        if place.exists():
            kept = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=place.parent, prefix=".obsynth-"))) / "old"
            shutil.copy2(place, kept)
        try:
            yield
        except BaseException:
            if kept is None:
                place.unlink(missing_ok=True)
            else:
                os.replace(kept, place)
            raise


def _exists(target: Path) -> bool:
    """Whether there is something at a path, links followed; an impossible name is the system's error."""
    try:
        os.stat(target)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _followed(target: Path) -> Path:
    """Return the place that a link points to: the link stays one."""
    return Path(os.path.realpath(target)) if target.is_symlink() else target


@contextmanager
def _written(target: Path) -> Iterator[None]:
    """Say of an error of the system which file could not be written."""
    try:
        yield
    except OSError as error:
        raise SpecError(f"{target} cannot be written: {reason(error)}.", path=str(target)) from error


def yaml_text(data: Mapping[str, Any]) -> str:
    """Return plain data as YAML in the order in which it is given, every number as exact as it is."""
    from ruamel.yaml import YAML

    text = io.StringIO()
    yaml: Any = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.width = 4096
    yaml.sort_base_mapping_type_on_output = False
    yaml.dump(data, text)
    return text.getvalue()
