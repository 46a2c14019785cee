"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from obsynth.errors import SpecError


@contextmanager
def replacement_of(target: Path) -> Iterator[tuple[int, str]]:
    """Give an open file, and its path, that takes the place of ``target`` when all went well, else is removed."""
    if target.is_dir():
        raise SpecError(f"{target} is a folder: give the name of a file.", path=str(target))
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
        yield handle, temporary
        # mkstemp makes private files; a result should have the permissions of any new file.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, target)
    except OSError as error:
        raise SpecError(f"{target} cannot be written: {error.strerror}.", path=str(target)) from error
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)


def write_atomically(path: str | Path, content: str | bytes) -> Path:
    """Write ``content`` (text as UTF-8) to ``path`` so that the file is there whole or not at all."""
    if not isinstance(path, (str, os.PathLike)):
        raise SpecError(f"path is {path!r}: give the name of a file.", path="path")
    target = Path(path)
    with replacement_of(target) as (handle, _), os.fdopen(handle, "wb") as stream:
        stream.write(content.encode() if isinstance(content, str) else content)
    return target
