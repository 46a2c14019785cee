"""The process around a verb: standard streams that may be closed or full, and what numbers can do to a computation."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from obsynth.errors import ObsynthError, SolverError, SpecError

#: Exit code of a program whose reader has left, as shells give it.
BROKEN_PIPE = 141


@contextmanager
def usable_streams() -> Iterator[None]:
    """Let texts go to nowhere where a standard stream is closed, and print characters that an encoding lacks."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            # The first file that is opened would get its number, and what is meant for the terminal.
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    yield


def unwritable_output(error: OSError) -> int:
    """Say that standard output takes no more, and return the exit code; nothing more is written to it."""
    with suppress(OSError, ValueError, AttributeError):
        # The interpreter's own flush at exit must not complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError):
        return BROKEN_PIPE
    place = error.filename or "Standard output"
    with suppress(OSError):
        print(f"Malformed input: {place} cannot be written: {error.strerror or error}.", file=sys.stderr)
    return SpecError.exit_code


def computation_failures() -> tuple[type[Exception], ...]:
    """Return the errors by which libraries say that a computation has failed; loads numpy."""
    from numpy.linalg import LinAlgError

    return (LinAlgError, ArithmeticError, MemoryError, RecursionError)


def failed_computation(error: Exception) -> ObsynthError:
    """Return what a failed computation is for the user."""
    if isinstance(error, MemoryError):
        return SolverError("The computation does not fit into the memory: nothing is known.")
    if isinstance(error, RecursionError):
        return SpecError("An expression or a document is nested too deeply.")
    return SolverError(
        f"A computation failed ({str(error).rstrip('.')}): nothing is known. Numbers of very different sizes do this: "
        "use other units."
    )


def missing_library(error: ImportError) -> ObsynthError:
    """Return what a missing library is for the user."""
    return SpecError(f"This needs the library {error.name or error}, which is not installed: pip install it.")
