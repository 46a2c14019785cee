"""What goes to the terminal: reports on stdout, progress and errors on stderr, JSON for programs."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from obsynth.errors import ObsynthError, VerificationError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console


_TITLES = {
    "SpecError": "Malformed input",
    "PreconditionError": "Precondition fails",
    "InfeasibleError": "Infeasible",
    "SolverError": "The solver gave up",
    "VerificationError": "Verification failed",
}


def print_json(data: Any, *, is_plain: bool = False) -> None:
    """Print ``data`` as one JSON document on stdout; arrays and special floats as in gain sets."""
    from obsynth.results.gain_sets import plain

    print(json.dumps(data if is_plain else plain(data), indent=1, allow_nan=False))


def print_error(error: ObsynthError) -> None:
    """Print an error for people on stderr."""
    print(f"{_TITLES.get(type(error).__name__, 'Error')}: {error}", file=sys.stderr)
    if isinstance(error, VerificationError):
        from rich.console import Console

        from obsynth.results.checks_table import checks_table

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


@contextmanager
def progress(*, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show the stages of a long run on stderr."""
    if quiet:
        yield lambda text: None
        return
    if not sys.stderr.isatty():
        begin = time.monotonic()
        yield lambda text: print(f"[{time.monotonic() - begin:5.1f} s] {text}", file=sys.stderr, flush=True)
        return
    from rich.console import Console
    from rich.text import Text

    with Console(stderr=True).status(Text("reading")) as status:
        yield lambda text: status.update(Text(text))
