"""The commands ``design`` and ``obsynth``: arguments in, exit code out; streams may be closed or full.

Nothing heavy is imported here, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module

from obsynth.cli.arguments import read_settings
from obsynth.cli.output import print_error, print_json
from obsynth.cli.verbs import VERBS, design_parser, obsynth_parser
from obsynth.errors import ObsynthError, SolverError, SpecError
from obsynth.files.inputs import protected_inputs

#: Exit code of a program whose reader has left, as shells give it.
BROKEN_PIPE = 141


@contextmanager
def usable_streams() -> Iterator[None]:
    """Let texts go to nowhere where a stream is closed, print characters that an encoding lacks, warn in one line."""
    with warnings.catch_warnings(), ExitStack() as stack:
        warnings.showwarning = _told_warning
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            if stream is None:
                # The first file that is opened would get its number, and what is meant for the terminal.
                setattr(sys, name, stack.enter_context(open(os.devnull, "w", encoding="utf-8", newline="")))
                stack.callback(setattr, sys, name, None)
            elif hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="backslashreplace")
        yield


def _told_warning(message: Warning | str, *_: object, **__: object) -> None:
    # Where in a library it arose is no use to the user.
    print(f"Warning: {message}", file=sys.stderr)


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


def told_error(error: Exception) -> ObsynthError | None:
    """Return what an error of Python or of a library is for the user; `None` if it is a mistake of obsynth."""
    if isinstance(error, MemoryError):
        return SolverError("The computation does not fit into the memory: the result is inconclusive.")
    if isinstance(error, RecursionError):
        return SpecError("An expression or a document is nested too deeply.")
    if isinstance(error, ImportError):
        is_ours = (error.name or "").startswith("obsynth")
        text = f"This needs the library {error.name or error}, which cannot be loaded: install it with pip."
        return None if is_ours else SpecError(text)
    from obsynth.numerics.libraries import failure_of

    return failure_of(error)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``obsynth``."""
    return _run(obsynth_parser(), arguments)


def design_command(arguments: Sequence[str] | None = None) -> int:
    """Run ``design``, which is ``obsynth design``."""
    return _run(design_parser(), arguments)


def _run(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> int:
    with usable_streams(), protected_inputs():
        try:
            try:
                return _outcome(_options(parser, arguments))
            finally:
                sys.stdout.flush()
        except KeyboardInterrupt:
            print("Interrupted.", file=sys.stderr)
            return 130
        except OSError as error:
            # Files are read and written elsewhere, with errors of their own: this is standard output.
            return unwritable_output(error)


def _options(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments of a command line, settings among them."""
    options, rest = parser.parse_known_args(arguments)
    rest = read_settings(parser.prog, VERBS[options.verb].arguments, options, rest)
    if rest:
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    return options


def _outcome(options: argparse.Namespace) -> int:
    """Run the verb; return its exit code, or that of its error after telling it."""
    try:
        module, _, function = VERBS[options.verb].run.partition(":")
        run: Callable[[argparse.Namespace], int] = getattr(import_module(f"obsynth.cli.{module}"), function)
        return run(options)
    except ObsynthError as error:
        told = error
    except (ImportError, MemoryError, RecursionError, ArithmeticError, ValueError) as error:
        # LAPACK's errors are among the last.
        found = told_error(error)
        if found is None:
            raise
        told = found
    if options.json:
        print_json(told.as_dict())
    print_error(told)
    return told.exit_code
