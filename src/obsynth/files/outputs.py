"""Output files: written completely or not at all, never over inputs, and over other files only on request."""

from __future__ import annotations

import io
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any

from obsynth.errors import SpecError
from obsynth.files.inputs import path_of, protected_as, reason, special_kind
from obsynth.files.signals import ending_signals

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
                f"{target}: obsynth writes {self.name} as {self.suffix}, not as {target.suffix}: give it a name that "
                f"ends in {self.suffix}.",
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
    advice = f"give the name of a file{f' to {option}' if option else ''}"
    try:
        if target.is_dir():
            raise SpecError(f"{target} is a folder: {advice}.", path=where)
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
        raise SpecError(f"{target} is {special}: {advice}.", path=where)
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
            problem = "exists" if kind is None else f"exists and is not {kind.name}"
            raise SpecError(f"{target} {problem}: {advice}.", path=str(target))
    except OSError as error:
        raise SpecError(f"{target} cannot be read ({reason(error)}): {advice}.", path=str(target)) from error


def require_distinct(files: Mapping[str, str | Path | None]) -> None:
    """Raise `SpecError` if two of the files are the same, links followed; they are given by what they are for."""
    owners: dict[object, str] = {}
    for name, file in files.items():
        if file is None:
            continue
        path = Path(file)
        try:
            status = os.stat(path)
            keys: set[object] = {(status.st_dev, status.st_ino), os.path.realpath(path)}
        except (OSError, ValueError):
            keys = {os.path.realpath(path)} if "\0" not in str(path) else set()
        for key in keys:
            if owners.setdefault(key, name) != name:
                raise SpecError(f"{name} and {owners[key]} are the same file {path}: give another one.", path=str(path))


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


def write_atomically(path: str | Path, content: str | bytes, *, kind: FileKind | None = None) -> Path:
    """Write ``content`` (text as UTF-8) to ``path`` so that the file is there whole or not at all; of a stated kind
    under no name of another format."""
    target = check_output(path)
    if kind is not None:
        kind.check_name(target)
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
        lock = os.dup(handle)
        stack.callback(os.close, lock)
        with suppress(OSError):  # not every file system has locks
            locks.flock(lock, locks.LOCK_EX)
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
        old = None
        if place.exists():
            old = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=place.parent, prefix=".obsynth-"))) / "old"
            shutil.copy2(place, old)
        try:
            yield
        except BaseException:
            if old is None:
                place.unlink(missing_ok=True)
            else:
                os.replace(old, place)
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
