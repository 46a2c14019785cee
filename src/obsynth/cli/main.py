"""The commands ``design`` and ``obsynth``: arguments in, exit code out.

Nothing heavy is imported here, so that ``--help`` answers at once.

The process around a verb: standard streams that may be closed or full, and what numbers can do to a computation.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path

from obsynth.cli.arguments import add_force, add_json, add_quiet, add_system, add_verbose, spec_verb
from obsynth.cli.calibration import add_calibration_verbs
from obsynth.cli.data_arguments import add_data_verbs
from obsynth.cli.output import print_error, print_json
from obsynth.cli.prove_alarm import add_prove_alarm_verb
from obsynth.cli.scenarios import add_compare_verb, add_evaluate_verb, add_simulate_verb
from obsynth.cli.sweep import add_sweep_verb
from obsynth.errors import ObsynthError, SolverError, SpecError
from obsynth.files.inputs import protected_inputs
from obsynth.version import __version__

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
                setattr(sys, name, stack.enter_context(open(os.devnull, "w", encoding="utf-8")))
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
        return SolverError("The computation does not fit into the memory: nothing is known.")
    if isinstance(error, RecursionError):
        return SpecError("An expression or a document is nested too deeply.")
    if isinstance(error, ImportError):
        is_ours = (error.name or "").startswith("obsynth")
        text = f"This needs the library {error.name or error}, which cannot be loaded: install it with pip."
        return None if is_ours else SpecError(text)
    from obsynth.numerics.failures import failure_of

    return failure_of(error)


_EXIT_CODES = """\
exit codes:
  0  success
  2  wrong arguments, or a malformed spec, plant or file
  3  an existence condition fails: no design of this kind exists for this plant
  4  the matrix inequalities have no solution, and that is proved
  5  a solver gave up: nothing is known
  6  a check of the shipped gains failed
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``obsynth``."""
    return _run(_parser(), arguments)


def design_command(arguments: Sequence[str] | None = None) -> int:
    """Run ``design``, which is ``obsynth design``."""
    parser = argparse.ArgumentParser(
        prog="design", description=_DESIGN, epilog=_EXIT_CODES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    _add_version(parser)
    _add_design_arguments(parser)
    return _run(parser, arguments)


_DESIGN = "Design an observer from a spec, prove it, print a report and write the gain set."
_CHECK = "Analyse the plant of a spec, and check for every method whether a design can exist."
_VERIFY = "Verify a saved gain set again, from the plant and the shipped realisation alone."


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="obsynth", epilog=_EXIT_CODES, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Observers and fault-estimation filters for descriptor systems: designed, proved again, and run.",
    )  # fmt: skip
    _add_version(parser)
    verbs = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_design_arguments(verbs.add_parser("design", help=_DESIGN, description=_DESIGN))

    check = spec_verb(verbs, "check", _CHECK)
    add_verbose(check, "the structure of the plant and every condition")
    add_json(check)

    verify = verbs.add_parser("verify", help=_VERIFY, description=_VERIFY)
    verify.add_argument(
        "gains", type=Path, metavar="FILE", help="a gain set that design wrote, or an alarm's certificate"
    )
    verify.add_argument(
        "--printed-digits", type=_digits, metavar="N",
        help="judge the gains as numbers that were printed with N decimals",
    )  # fmt: skip
    add_verbose(verify, "every claim and every check")
    add_json(verify)
    verify.set_defaults(verb="verify")

    add_simulate_verb(verbs)
    add_compare_verb(verbs)
    add_evaluate_verb(verbs)
    add_sweep_verb(verbs)
    add_data_verbs(verbs)
    add_calibration_verbs(verbs)
    add_prove_alarm_verb(verbs)
    return parser


def _add_design_arguments(parser: argparse.ArgumentParser) -> None:
    add_system(parser)
    parser.add_argument(
        "--output", type=Path, metavar="FILE",
        help="where to write the gain set (default: <name of the spec>.gains.json in the current folder)",
    )  # fmt: skip
    add_verbose(parser, "every claim and every check")
    add_json(parser)
    add_force(parser)
    add_quiet(parser)
    parser.set_defaults(verb="design")


def _add_version(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--version", action="version", version=f"obsynth {__version__}")


def _digits(text: str) -> int:
    digits = int(text)
    if not 1 <= digits <= 15:
        raise argparse.ArgumentTypeError(f"{digits} is not between 1 and 15")
    return digits


#: Verb -> module of `obsynth.cli` and function; only the one that is asked for is loaded.
_VERBS = {
    "design": "commands:run_design", "check": "commands:run_check", "verify": "commands:run_verify",
    "simulate": "scenarios:run_simulate", "compare": "scenarios:run_compare", "evaluate": "scenarios:run_evaluate",
    "sweep": "sweep:run_sweep", "run": "data_commands:run_run", "export": "data_commands:run_export",
    "plot": "data_commands:run_plot", "report": "data_commands:run_report", "linearise": "calibration:run_linearise",
    "calibrate": "calibration:run_calibrate", "validate": "calibration:run_validate",
    "prove-alarm": "prove_alarm:run_prove_alarm",
}  # fmt: skip


def _verb(name: str) -> Callable[[argparse.Namespace], int]:
    module, _, function = _VERBS[name].partition(":")
    found: Callable[[argparse.Namespace], int] = getattr(import_module(f"obsynth.cli.{module}"), function)
    return found


def _run(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> int:
    with usable_streams(), protected_inputs():
        try:
            try:
                return _outcome(parser.parse_args(arguments))
            finally:
                sys.stdout.flush()
        except KeyboardInterrupt:
            print("Interrupted.", file=sys.stderr)
            return 130
        except OSError as error:
            # Files are read and written elsewhere, with errors of their own: this is standard output.
            return unwritable_output(error)


def _outcome(options: argparse.Namespace) -> int:
    """Run the verb; return its exit code, or that of its error after telling it."""
    try:
        return _verb(options.verb)(options)
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
