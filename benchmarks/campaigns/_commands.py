"""Runs of the command line in this process: what they print, what they leave behind, and whether a file was lost."""

from __future__ import annotations

import hashlib
import io
import os
import re
import stat
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

from obsynth.cli.main import main

#: Exit codes that are documented; 141 is a reader that has left.
KNOWN_CODES = frozenset({0, 2, 3, 4, 5, 6, 141})
#: Messages that say that a mistake of obsynth got through, and words of Python that users need not know.
_UNTOLD = re.compile(r"Traceback|object at 0x|NoneType|unsupported operand|has no attribute|not subscriptable|<class '")


@dataclass(frozen=True)
class Ran:
    """One run: exit code, what was wrong with it ("" if nothing)."""

    code: int
    wrong: str
    errors: str


class _Reconfigurable(io.StringIO):
    """A stream for texts, as a terminal would take them."""

    def reconfigure(self, **_: object) -> None:
        pass


def contents(folder: Path) -> dict[str, str]:
    """Return a digest of every regular file in a folder, and the kind of everything else."""
    found = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        if stat.S_ISREG(mode):
            found[str(path.relative_to(folder))] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[str(path.relative_to(folder))] = str(stat.S_IFMT(mode))
    return found


def run(
    folder: Path, words: Sequence[str], *, may_change: Sequence[str] = (), changes_anyway: Sequence[str] = (),
    feed: str | None = None,
) -> Ran:  # fmt: skip
    """Run ``obsynth`` in a folder; only the files in ``may_change`` may be new or other afterwards, if it succeeds."""
    before = contents(folder)
    printed, errors = _Reconfigurable(), _Reconfigurable()
    wrong = ""
    with chdir(folder), redirect_stdout(printed), redirect_stderr(errors), _standard_input(feed):
        try:
            # The command line tells warnings in a line: they are errors in the tests only.
            with warnings.catch_warnings():
                warnings.simplefilter("default")
                code = main(list(words))
        except SystemExit as error:
            code = error.code if isinstance(error.code, int) else 1
        except Exception as error:  # noqa: BLE001 - what leaves the command line is a traceback for the user
            code = 1
            places = [place for place in traceback.extract_tb(error.__traceback__) if "obsynth" in place.filename]
            place = places[-1]
            wrong = f"traceback: {type(error).__name__}: {str(error)[:80]} ({Path(place.filename).name}:{place.lineno})"
    told = errors.getvalue()
    if not wrong:
        wrong = _mistake(code, told, printed.getvalue())
    if not wrong:
        wrong = _losses(before, contents(folder), [*(may_change if code in (0, 6) else ()), *changes_anyway])
    return Ran(code, wrong, told)


def _mistake(code: int, told: str, printed: str) -> str:
    if code not in KNOWN_CODES:
        return f"exit code {code}: {told[:120]}"
    # That a condition or a check fails is told by the report.
    if code and not (told + (printed if code in (3, 6) else "")).strip():
        return f"exit code {code} without a word"
    hit = _UNTOLD.search(told)
    return f"words of Python: {' '.join(told.split())[:200]}" if hit else ""


def _losses(before: dict[str, str], after: dict[str, str], may_change: Sequence[str]) -> str:
    lost = [name for name in before if after.get(name) != before[name] and name not in may_change]
    left = [name for name in after if name not in before and name not in may_change]
    if lost:
        return f"file lost: {', '.join(lost)}"
    return f"left behind: {', '.join(left)}" if left else ""


@contextmanager
def _standard_input(feed: str | None) -> Iterator[None]:
    before = sys.stdin
    sys.stdin = io.StringIO(feed or "", newline="")
    try:
        yield
    finally:
        sys.stdin = before


def make_special(path: Path, kind: str) -> None:
    """Put something at a path that is no regular file, or one that cannot be read."""
    if path.is_dir() and not path.is_symlink():
        return
    path.unlink(missing_ok=True)
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "dangling":
        path.symlink_to("nowhere")
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "empty":
        path.touch()
