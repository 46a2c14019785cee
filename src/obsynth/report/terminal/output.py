"""Terminal output: reports on stdout, progress and errors on stderr, JSON for programs."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.errors import ObsynthError, VerificationError
from obsynth.files.outputs import FileKind, check_output, check_replaceable

if TYPE_CHECKING:
    from rich.console import Console

    from obsynth.results.design import ObserverDesign
    from obsynth.results.verification_report import VerificationReport


_TITLES = {
    "PreconditionError": "Existence condition fails",
    "InfeasibleError": "Infeasible",
    "SolverError": "Inconclusive",
    "VerificationError": "Verification failed",
}


def output_file(path: str | Path, kind: FileKind | None, options: argparse.Namespace, *, option: str = "--out") -> Path:
    """Return where to write a file of some kind, or raise `SpecError` before any work is done.
    A file that the command has read, under whatever name, is never written (checked again when the file is put in its
    place).  An existing file of another kind (of any, if that is `None`) needs ``--force``."""
    target = check_output(path, option=option)
    if kind is not None:
        kind.check_name(target)
    if not options.force:
        check_replaceable(target, kind)
    return target


def emit(options: argparse.Namespace, payload: Mapping[str, Any], text: Callable[[], Any] | str = "") -> None:
    """Print the result of a verb, as JSON or as text, with what was written: the paths under ``file`` or ``files``."""
    files = [item for item in payload.get("files", [payload.get("file")]) if isinstance(item, Path)]
    if options.json:
        texts = {name: str(item) for name, item in payload.items() if isinstance(item, Path)}
        several = {"files": [str(item) for item in files]} if "files" in payload else {}
        print_json({"command": options.verb, **payload, **texts, **several})
        return
    if not isinstance(text, str):
        text()
    elif text:
        print(text)
    if files:
        print(f"Written: {', '.join(map(str, files))}")


def print_json(data: Any, *, is_plain: bool = False) -> None:
    """Print ``data`` as one JSON document on stdout; arrays and special floats as in gain sets."""
    from obsynth.results.gain_set_writing import plain

    print(json.dumps(data if is_plain else plain(data), indent=1, allow_nan=False))


def verified_again(path: Path) -> tuple[ObserverDesign, VerificationReport]:
    """Return a saved design, and what its verification says now."""
    from obsynth.methods.verifying import verify
    from obsynth.results.gain_sets import load

    design = load(path)
    return design, verify(design)


def gains_to_hand_on(path: Path, *, unverified: bool) -> tuple[ObserverDesign, str]:
    """Return a saved design verified again, and the mark of one that fails; `VerificationError` unless that is wanted.
    A file's digest is no signature, and its report may be edited like all else: only a new one counts."""
    from obsynth.results.design import require_verified, unverified_mark

    design, report = verified_again(path)
    mark = unverified_mark(report)
    if not mark:
        return design, ""
    design = design.replace(report=report)
    require_verified(design, unverified=unverified)
    print(f"Warning: {path}: {mark}", file=sys.stderr)
    return design, mark


def print_error(error: ObsynthError) -> None:
    """Print an error for people on stderr."""
    print(f"{_TITLES.get(type(error).__name__, 'Error')}: {error}", file=sys.stderr)
    if isinstance(error, VerificationError):
        from rich.console import Console

        from obsynth.results.layout import checks_table

        console = Console(stderr=True, markup=False, highlight=False, emoji=False)
        console.print(checks_table(error.report.failures, width=console.width))


def stdout_console() -> Console:
    """Return a console for reports: no markup, no guesses about what to highlight."""
    from rich.console import Console

    class ReportConsole(Console):
        """A console that lets the command line decide what a broken pipe means."""

        def on_broken_pipe(self) -> None:
            """Raise `BrokenPipeError`, where rich would end the process."""
            raise BrokenPipeError

    return ReportConsole(markup=False, highlight=False, emoji=False)
