"""Picture files of the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from obsynth.files.inputs import suffix_error
from obsynth.files.outputs import FileKind, write_atomically

#: Formats of pictures, with the mark by which an older one may be replaced.
PICTURES = {".png": rb"\A\x89PNG", ".svg": rb"<svg", ".pdf": rb"\A%PDF"}


def picture_kind(target: Path) -> FileKind:
    """Return what kind of picture a file is to be, by its suffix."""
    suffix = target.suffix.lower()
    if suffix not in PICTURES:
        raise suffix_error(target, PICTURES)
    return FileKind(f"a picture ({suffix})", PICTURES[suffix])


def written_picture(target: Path, count: int, draw: Callable[[list[Any]], Any]) -> None:
    """Write a picture of so many panels, one above the other; ``draw`` fills them."""
    from obsynth.report.plots.panels import image_of

    write_atomically(target, image_of(count, draw, kind=target.suffix[1:].lower()))
