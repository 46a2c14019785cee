"""Entry points of the commands ``design`` and ``obsynth``: command line, verb, exit code.

Nothing heavy is imported here, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import gc
import os
import shlex
import sys
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from textwrap import fill
from typing import Any, NoReturn

from obsynth.cli.examples import EXAMPLES
from obsynth.cli.parser import SHELLS, Parser, PrintCompletion, meant
from obsynth.cli.verbs import VERBS as DESIGN_VERBS
from obsynth.errors import ObsynthError, SolverError, SpecError
from obsynth.files.inputs import protected_inputs
from obsynth.report.terminal.arguments import (
    Argument,
    Folded,
    Group,
    Settings,
    add_arguments,
    add_settings,
    read_settings,
    settings_of,
)
from obsynth.report.terminal.output import print_error, print_json
from obsynth.report.terminal.stages import watched_stages
from obsynth.report.terminal.verbs import Verb
from obsynth.version import __version__

#: What the program prints when it is called without arguments.
FIRST_STEPS = f"""\
usage: obsynth COMMAND [options]

obsynth {__version__} designs observers and fault-estimation filters for descriptor and
ordinary systems by linear matrix inequalities and convex optimisation, and
verifies every result without the solver.

Three commands to begin with, in the folder of obsynth:

  obsynth check --system designs/wang2015/spec.yaml
      which methods have a solution for this plant, and if one has none, why
  obsynth design --system designs/wang2015/spec.yaml
      a filter with proved bounds, written to wang2015.gains.json
  obsynth simulate --system designs/wang2015/spec.yaml --out run.csv
      the faults and their estimates on the scenario of the spec

For your own plant, change a copy of spec.yaml: docs/start.md explains it line
by line. "obsynth --help" lists all commands, "obsynth COMMAND --help" explains
one.
"""

EXIT_CODES = """\
exit codes:
  0  success
  2  wrong arguments, or a malformed spec, plant or file
  3  an existence condition fails: no design of this kind exists for this plant
  4  the matrix inequalities have no solution, and that is proved
  5  a solver gave up: inconclusive
  6  a check of the shipped gains failed
"""

#: Most options that are suggested for a single letter.
MOST_MEANT = 3

#: Longest line of an example command, so that its margin and the closing backslash fit into 78 columns of help.
WIDEST_COMMAND = 70

#: Verbs whose help lists the methods that are installed.
_VERBS_WITH_METHODS = ("design", "check", "compare")

#: Exit code of a program whose reader has closed the pipe, by the convention of shells.
BROKEN_PIPE = 141

#: New objects, a few MB, after which Python looks for cyclic garbage.  With Python's default, a short command spent a
#: tenth of its time in scans of the modules that it had imported.
GARBAGE_THRESHOLD = 100_000


def _all_verbs() -> dict[str, Verb]:
    """Return the verbs of this package and of the installed packages above it, in the order of the help."""
    verbs, added = dict(DESIGN_VERBS), dict[str, tuple[Argument | Group | Settings, ...]]()
    if find_spec("obsynth.monitoring") is not None:
        from obsynth.monitoring.verbs.table import ADDED
        from obsynth.monitoring.verbs.table import VERBS as OF_LOGS

        verbs |= OF_LOGS
        added = ADDED
    if find_spec("obsynth.studies") is not None:
        from obsynth.studies.verbs.table import VERBS as OF_STUDIES

        verbs |= OF_STUDIES
    for name, more in added.items():
        verbs[name] = verbs[name]._replace(arguments=(*verbs[name].arguments, *more))
    return {name: verbs[name] for name in EXAMPLES if name in verbs}


#: The verbs by name.
VERBS = _all_verbs()


def obsynth_parser(words: Collection[str] | None = None) -> argparse.ArgumentParser:
    """Return the parser of ``obsynth`` with all its verbs; only those among ``words`` have arguments."""
    parser = _parser("obsynth", "Design, verify and run observers and fault-estimation filters for descriptor systems.")
    parser.first_steps = FIRST_STEPS
    parser.add_argument(
        "--print-completion",
        action=PrintCompletion,
        choices=SHELLS,
        help="print a script that completes commands and options in this shell, and exit",
    )
    verbs: Any = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, verb in VERBS.items():
        own = verbs.add_parser(
            name,
            help=verb.help_text,
            add_help=words is None or name in words,
            description=fill(verb.help_text, width=78, break_on_hyphens=False),
            epilog=verb.epilog,
            formatter_class=Folded if verb.epilog else argparse.HelpFormatter,
        )
        if words is None or name in words:
            _with_verb(name, own)
    return parser


def _parser(name: str, description: str) -> Parser:
    parser = Parser(
        prog=name,
        description=fill(description, width=78),
        epilog=EXIT_CODES,
        formatter_class=Folded,
    )
    parser.add_argument("--version", action="version", version=f"obsynth {__version__}")
    return parser


def _with_verb(name: str, parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser.set_defaults(verb=name)
    if name in EXAMPLES:
        parser.description = f"{parser.description}\n\nexample:\n  {_in_lines(EXAMPLES[name])}"
        parser.formatter_class = Folded
    add_arguments(parser, VERBS[name].arguments)
    if settings := settings_of(VERBS[name].arguments):
        add_settings(parser, settings)
    if name in _VERBS_WITH_METHODS:
        # The methods are looked up only when the help is printed: other packages may have registered some.
        parser.format_help = lambda: _help_with_methods(parser)  # type: ignore[method-assign]
    return parser


def _in_lines(command: str) -> str:
    """Return a shell command broken into lines before its options."""
    first, *others = command.split(" --")
    lines = [first]
    for part in others:
        if len(lines[-1]) + len(part) <= WIDEST_COMMAND:
            lines[-1] += f" --{part}"
        else:
            lines.append(f"    --{part}")
    return " \\\n  ".join(lines)


def _help_with_methods(parser: argparse.ArgumentParser) -> str:
    """Return the help of a parser with the ids of the methods."""
    from obsynth.methods.installed import REGISTRY

    ids = ", ".join([*REGISTRY, "auto"])
    methods = fill(ids, width=78, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)
    return f"{argparse.ArgumentParser.format_help(parser)}\nmethods, each by method.id in the spec:\n{methods}\n"


@contextmanager
def usable_streams() -> Iterator[None]:
    """Make standard streams safe to print to, and print each warning on one line.

    A closed stream is replaced by the null device; characters outside a stream's encoding are escaped.
    """
    with warnings.catch_warnings(), ExitStack() as stack:
        # The line of a library that warns is no use to the user.
        warnings.showwarning = lambda message, *_, **__: print(f"Warning: {message}", file=sys.stderr)
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            if stream is None:
                # Otherwise the next file that is opened gets the stream's number, and with it the printed text.
                setattr(sys, name, stack.enter_context(open(os.devnull, "w", encoding="utf-8", newline="")))
                stack.callback(setattr, sys, name, None)
            elif hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="backslashreplace")
        yield


def unwritable_output(error: OSError) -> int:
    """Report that standard output cannot be written, and return the exit code; nothing more is written to it."""
    with suppress(OSError, ValueError, AttributeError):
        # The interpreter's own flush at exit must not complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError):
        return BROKEN_PIPE
    place = error.filename or "Standard output"
    with suppress(OSError):
        print(f"Error: {place} cannot be written: {error.strerror or error}.", file=sys.stderr)
    return SpecError.exit_code


def reported_error(error: Exception) -> ObsynthError | None:
    """Return an error of Python or of a library as one for the user; `None` if it is a defect of obsynth."""
    if isinstance(error, MemoryError):
        return SolverError("The computation does not fit into the memory: the result is inconclusive.")
    if isinstance(error, RecursionError):
        return SpecError("An expression or a document is nested too deeply.")
    if isinstance(error, ImportError):
        name = error.name or ""
        if name.startswith(("obsynth.monitoring", "obsynth.studies")):
            return SpecError(f"This needs {name}, which is not part of this installation.")
        is_ours = name.startswith("obsynth")
        text = f"This needs the library {error.name or error}, which cannot be loaded: install it with pip."
        return None if is_ours else SpecError(text)
    from obsynth.numerics.libraries import failure_of

    return failure_of(error)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``obsynth``."""
    words = sys.argv[1:] if arguments is None else arguments
    # A completion script needs the arguments of all commands, a run only those of one.
    return _run(obsynth_parser(None if "--print-completion" in words else words), words)


def design_command(arguments: Sequence[str] | None = None) -> int:
    """Run ``design``, which is ``obsynth design``."""
    return _run(_with_verb("design", _parser("design", VERBS["design"].help_text)), arguments)


def _run(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> int:
    with usable_streams(), protected_inputs(), _rare_garbage_collection():
        try:
            try:
                return _outcome(_options(parser, arguments))
            finally:
                sys.stdout.flush()
        except KeyboardInterrupt:
            print("Interrupted.", file=sys.stderr)
            return 130
        except OSError as error:
            # Reading and writing of files raises SpecError, so this error comes from standard output.
            return unwritable_output(error)


@contextmanager
def _rare_garbage_collection() -> Iterator[None]:
    """Make Python look for cyclic garbage less often than by default."""
    before = gc.get_threshold()
    gc.set_threshold(GARBAGE_THRESHOLD, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _options(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the parsed arguments of a command line, its settings (``--set NAME=VALUE``) among them."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    options, unknown = parser.parse_known_args(words)
    options.command = shlex.join([parser.prog, *words])
    unknown = read_settings(f"{parser.prog} {options.verb}", VERBS[options.verb].arguments, options, unknown)
    if unknown:
        _refuse_words(parser.prog, options.verb, unknown)
    return options


def _refuse_words(prog: str, verb: str, unknown: Sequence[str]) -> NoReturn:
    """End the program with the usage of the verb and, for a misspelt option, the one that may be meant."""
    own = _with_verb(verb, Parser(prog=prog if prog == verb else f"{prog} {verb}"))
    known = [
        *own._option_string_actions,
        *(name for setting in settings_of(VERBS[verb].arguments) for name in setting.names),
    ]
    wrong = [word.partition("=")[0] for word in unknown if word.startswith("-") and word != "-"]
    if not wrong:
        own.error(f"it does not take {' '.join(map(repr, unknown))}: see {own.prog} --help.")
    own.error(f"there is no option {wrong[0]}.{_meant_option(wrong[0], known)} See {own.prog} --help.")


def _meant_option(word: str, known: Sequence[str]) -> str:
    """Return a question with the options that begin with a single letter, or that are close to a misspelt one."""
    if len(word) > len("-q"):
        return meant(word, known)
    beginning = [name for name in known if name.startswith(f"-{word}")]
    return f" Did you mean {' or '.join(beginning)}?" if 0 < len(beginning) <= MOST_MEANT else ""


def _outcome(options: argparse.Namespace) -> int:
    """Run the verb and return its exit code; print an error and return the error's exit code."""
    try:
        named = ("output", "out", "write_spec", "to", "state", "prove")
        is_written = options.verb == "design" or any(getattr(options, name, None) not in (None, "-") for name in named)
        if getattr(options, "force", False) and not is_written:
            raise SpecError("--force replaces a file, and none is written here: give --out.", path="--force")
        # A run on a log that grows says itself that it is alive.
        is_followed = getattr(options, "follow", None) is not None
        with watched_stages(options.verb, quiet=getattr(options, "quiet", False) or is_followed):
            return VERBS[options.verb].run(options)
    except ObsynthError as error:
        failure = error
    except (ImportError, MemoryError, RecursionError, ArithmeticError, ValueError) as error:
        # numpy's LinAlgError is a ValueError.
        reported = reported_error(error)
        if reported is None:
            raise
        failure = reported
    if options.json:
        print_json(failure.as_dict())
    print_error(failure)
    return failure.exit_code
