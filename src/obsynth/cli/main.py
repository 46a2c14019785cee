"""The commands ``design`` and ``obsynth``: arguments in, exit code out; streams may be closed or full.

Nothing heavy is imported here, so that ``--help`` answers at once.

The verbs of the command line: what each is for, its arguments, and the function that runs it.
"""

from __future__ import annotations

import argparse
import gc
import os
import shlex
import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple, NoReturn

from obsynth.cli.arguments import (
    CLUSTER,
    DATA_OPTIONS,
    FORCE,
    GAINS,
    INPUT_DELAY,
    JOBS,
    JSON,
    LOG_OPTIONS,
    MAP,
    MONITOR,
    MONITOR_SETTINGS,
    QUIET,
    SCALE,
    SPEC_GAINS,
    SYSTEM,
    TIME_COLUMN,
    UNVERIFIED,
    Argument,
    Folded,
    Group,
    Settings,
    add_arguments,
    add_settings,
    digits,
    flag,
    option,
    read_settings,
    settings_of,
    verbose,
)
from obsynth.cli.examples import EXAMPLES
from obsynth.cli.output import print_error, print_json
from obsynth.cli.parser import SHELLS, Parser, PrintCompletion, meant
from obsynth.errors import ObsynthError, SolverError, SpecError
from obsynth.files.inputs import protected_inputs
from obsynth.version import __version__

EXIT_CODES = """\
exit codes:
  0  success
  2  wrong arguments, or a malformed spec, plant or file
  3  an existence condition fails: no design of this kind exists for this plant
  4  the matrix inequalities have no solution, and that is proved
  5  a solver gave up: inconclusive
  6  a check of the shipped gains failed
"""

# Lines that end in a backslash go on: help is folded to the terminal.
_SWEEP_DETAILS = """\
A value list is a YAML list: --set gamma='[0.1, 0.2]' --set plant.transform.sample_time='[0.01, 0.02]' --set \
plant.C.outputs='[[omega 1], [omega 1, omega 2]]'. A name that begins with no section of a spec is an option of \
its method. The folder keeps every gain set and result: the same command continues a sweep that was interrupted."""

_RUN_DETAILS = """\
The data have a column 'time', in seconds or as dates and times (ISO 8601), and one for each known input and \
output, by name. Columns of text are separated by commas, semicolons, tabs or bars; numbers may have a decimal \
comma where commas separate nothing.
Each row of estimates has a status:
  ok          nothing is missing
  warm-up     the initial-condition response has not settled yet
  gap         a sample is missing: fault estimates are held, the plant model stands in, no alarms
  partial     recursive and nonlinear designs: some outputs are missing, the others are used
  recovering  after a gap: an alarm needs a value that passes its threshold by more than the gap can have caused
  repeated stamp, out of order: the time stamp is not later than the last one: the row is left out (more than 10\
 in a row are an error)
Designs with a sampling time allow a time stamp to be off by 0.45 of it, and by 0.25 on average. A longer \
interval means missing rows: an interval of three sampling times, for example, means that two rows are missing.
An estimate with a delay has a column 'time of ...' with the time that it is the estimate for.

--monitor KIND adds columns 'statistic', 'threshold' and 'alarm', with the fault that the alarm points to. The \
thresholds hold however long the data are. KIND is one of
  pointwise   linear designs: the residual's peak bound, for disturbances and noise within bounds; where the \
plant's constants have tolerances, it adapts to the signals and holds for every plant within them, with columns \
for each threshold, the guaranteed interval of each fault, and the share of each constant
  window      the same for the l2 norm of the residual over a window
  paper       linear, discrete: eq. (66) of Wang et al. 2015, which guarantees nothing
  chi-square  linear: a window of the residual against its covariance; recursive: the parameters against theirs
  cusum       small changes of the residual, or of a parameter
  nis         recursive and nonlinear designs: innovations too large for the model
  learned     every design: thresholds from rows without faults (--normal), whatever noise the model assumes
The scenario of --system, or the options, state which disturbances and noise to expect.

If --gains is a folder, every gain set in it is run on --data, which is a log or a folder of logs, on --jobs \
processes or on a cluster; a log with the name of a gain set is for that gain set alone. --out is then a folder \
for the estimates, table.csv and fleet.png; the same command continues a run that was interrupted."""

_LOG = "text (.csv, .tsv), Parquet, TDMS or MDF file; - for text on standard input"

_EXPECTED_SCENARIO = option(
    "--system", "FILE", "spec (YAML) whose scenario states the disturbances and noise to expect", type=Path
)


#: Verbs whose help lists the methods that are installed.
_TELL_METHODS = ("design", "check", "compare")


#: Exit code of a program whose reader has left, as shells give it.
BROKEN_PIPE = 141


#: New objects after which Python looks for cycles of garbage, of a few MB: with its own number, a tenth of a short
#: command was looking through what imports have made.
NEW_OBJECTS = 100_000


class Verb(NamedTuple):
    """A verb: ``run`` is a module of `obsynth.cli` and a function, loaded when the verb is asked for."""

    run: str
    told: str
    arguments: tuple[Argument | Group | Settings, ...]
    epilog: str | None = None


VERBS = {
    "design": Verb(
        "obsynth.cli.commands:run_design",
        "Design an observer from a spec, verify it, print a report and write the gain set.",
        (
            SYSTEM,
            option(
                "--output",
                "FILE",
                "where to write the gain set (default: <name of the spec>.gains.json in the current folder)",
                type=Path,
            ),
            verbose("every claim and every check"),
            JSON,
            FORCE,
            QUIET,
        ),
    ),
    "check": Verb(
        "obsynth.cli.commands:run_check",
        "Analyse the plant of a spec, and check for every method whether a design can exist.",
        (
            SYSTEM,
            flag("--whole-bank", "list every structured residual where there are 7 to 12 faults, too"),
            verbose("the structure of the plant and every condition"),
            JSON,
        ),
    ),
    "sensors": Verb(
        "obsynth.cli.commands:run_sensors",
        "Find the cheapest sensors to add, so that faults can be detected, isolated or estimated.",
        (
            SYSTEM,
            option(
                "--goal",
                "GOAL",
                "detect, isolate, estimate-step, estimate (default), or threshold: the least threshold of --fault is "
                "at most --below",
                default="estimate",
            ),
            option("--fault", "NAME", "the fault (default: all; for threshold: that of the spec's method)"),
            Settings(
                (
                    option(
                        "--below",
                        "SIZE",
                        "for threshold: half of the size of a fault that must be detected for certain",
                        type=float,
                    ),
                    option("--noise", "DEVIATION", "noise of each candidate; threshold needs it", type=float),
                    option("--largest", "N", "largest number of sensors to add", type=int),
                    option("--sample-time", "SECONDS", "for threshold: sample time for a continuous plant", type=float),
                )
            ),
            JSON,
            QUIET,
        ),
    ),
    "verify": Verb(
        "obsynth.cli.commands:run_verify",
        "Verify a saved gain set, or a certificate of any kind with all files that it refers to, again.",
        (
            Group(
                "",
                (
                    option(
                        "file",
                        "FILE",
                        "a gain set, what calibrate wrote, or the certificate of an alarm, a robustness analysis, a "
                        "tolerance study or a comparison",
                        type=Path,
                        nargs="?",
                    ),
                    option("--gains", "FILE", "the same file, named as in the other commands", type=Path),
                ),
                required=True,
            ),
            option("--data", "FILE", "the log that an alarm, a comparison or a calibration names", type=Path),
            Settings(
                (
                    option(
                        "--calibration",
                        "FILE",
                        "the calibration that the box of a gain set, an alarm or a robustness analysis names",
                        type=Path,
                    ),
                    option(
                        "--system",
                        "FILE",
                        "with --data: the spec of a calibration, which is then repeated",
                        type=Path,
                    ),
                    option(
                        "--printed-digits",
                        "N",
                        "treat the gains as rounded to N decimals, as in a printed table",
                        type=digits,
                    ),
                    flag(
                        "--independent",
                        "check a gain set, the alarm of a guaranteed test, or a proof file (export --to proof.json) by "
                        "check_proof.py alone, in a process without obsynth",
                    ),
                )
            ),
            verbose("every claim and every check"),
            JSON,
        ),
    ),
    "simulate": Verb(
        "obsynth.studies.verbs.scenarios:run_simulate",
        "Design an observer from a spec, and simulate it on the spec's scenario.",
        (
            SYSTEM,
            SPEC_GAINS,
            UNVERIFIED,
            option("--out", "FILE", "write every signal to this file (CSV)", type=Path),
            JSON,
            FORCE,
            QUIET,
        ),
    ),
    "compare": Verb(
        "obsynth.studies.verbs.scenarios:run_compare",
        "Design by every method that exists for a spec's plant, and compare them on its scenario.",
        (
            SYSTEM,
            option("--data", "FILE", "a log, as for run, to replay through every method", type=Path),
            MAP,
            SCALE,
            option("--out", "FILE", "write a page (HTML), or a certificate for obsynth verify (.json)", type=Path),
            Settings(
                (
                    option("--runs", "N", "drawn runs of the scenario (default: 20)", type=int, default=20),
                    option(
                        "--tolerance",
                        "T",
                        "relative error of the parameters that are drawn (default: 0.05)",
                        type=float,
                        default=0.0,
                    ),
                    option(
                        "--within", "SECONDS", "the estimate of a step must reach 90 %% within this time", type=float
                    ),
                    option("--sample-time", "SECONDS", "sample time for a continuous plant", type=float),
                    TIME_COLUMN,
                    INPUT_DELAY,
                )
            ),
            FORCE,
            JSON,
            QUIET,
        ),
    ),
    "evaluate": Verb(
        "obsynth.studies.verbs.scenarios:run_evaluate",
        "Design an observer from a spec, run the spec's scenario many times, and count alarms, delays and errors.",
        (
            SYSTEM,
            SPEC_GAINS,
            UNVERIFIED,
            option("--runs", "N", "number of runs, each with its own seed (default: 100)", type=int, default=100),
            Settings(
                (
                    option(
                        "--tolerances",
                        "LIST",
                        "instead, compare a fixed bound with the adaptive threshold for these tolerances, such as "
                        "0,1%%,2%%,5%%",
                    ),
                    option(
                        "--confidence",
                        "P",
                        "confidence level of the intervals (default: 0.95)",
                        type=float,
                    ),
                    option("--plants", "N", "draw N plants from the tolerances, half of them vertices", type=int),
                    JOBS,
                )
            ),
            option(
                "--out",
                "FILE",
                "with --tolerances: write the picture (.png, .svg or .pdf), or a certificate for verify (.json)",
                type=Path,
            ),
            MONITOR,
            MONITOR_SETTINGS,
            JSON,
            FORCE,
            QUIET,
        ),
    ),
    "sweep": Verb(
        "obsynth.studies.verbs.sweeps:run_sweep",
        "Design and verify for every combination of specs and values; a design that fails is a row of the table.",
        (
            option("--system", "FILE", "a spec (YAML), or several", type=Path, required=True, nargs="+"),
            option(
                "--set",
                "PATH=LIST",
                "an entry of the specs and the list of its values; may be repeated",
                action="append",
                default=[],
            ),
            option("--out", "FOLDER", "folder for gain sets, results and table.csv", type=Path, required=True),
            option("--claim", "NAME", "the claim that the picture shows (default: the most frequent one)"),
            JOBS,
            CLUSTER,
            JSON,
            FORCE,
            QUIET,
        ),
        _SWEEP_DETAILS,
    ),
    "run": Verb(
        "obsynth.monitoring.verbs.logs:run_run",
        "Run a design on measured data: a log, or a stream on standard input, with a row of estimates for each row.",
        (
            GAINS,
            UNVERIFIED,
            option("--data", "FILE", _LOG, required=True),
            option(
                "--out",
                "FILE",
                "CSV or Parquet file for the estimates (default: - for stdout); a folder for many gain sets",
                default="-",
            ),
            *DATA_OPTIONS,
            _EXPECTED_SCENARIO,
            Settings(
                (
                    option(
                        "--prove",
                        "FILE",
                        "with --monitor pointwise: prove the first alarm, and write the certificate that 'verify' "
                        "rechecks",
                        type=Path,
                    ),
                    JOBS,
                    CLUSTER,
                    option(
                        "--outliers",
                        None,
                        "recursive and nonlinear designs: leave out outliers (default), limit them, or use them",
                        choices=("gate", "huber", "none"),
                    ),
                    option(
                        "--recovered",
                        "NAME",
                        "recover this state of the plant as written ('all' or 'none' of them; default: all, if there "
                        "are at most 300); may be repeated",
                        action="append",
                    ),
                    option(
                        "--lag",
                        "N",
                        "smooth each estimate with the N samples after it; rows are then delayed by N samples",
                        type=int,
                    ),
                    option(
                        "--state-every",
                        "N",
                        "of a stream: save --state again after every N rows (default: 100)",
                        type=int,
                    ),
                )
            ),
            flag("--smooth", "recursive and nonlinear designs: smooth the estimates over the whole log"),
            option("--state", "FILE", "continue from this saved state if it exists, and save the new one", type=Path),
            JSON,
            FORCE,
            flag("--quiet", "print no progress and no summary"),
        ),
        _RUN_DETAILS,
    ),
    "thresholds": Verb(
        "obsynth.monitoring.verbs.thresholds:run_thresholds",
        "Find thresholds of a design from a log without faults, for a rate of false alarms.",
        (
            GAINS,
            UNVERIFIED,
            option("--data", "FILE", _LOG, required=True),
            option("--false-alarms", "RATE", "such as '1 per week' or '2 per 1000 rows' (default: '1 per 1000 rows')"),
            option(
                "--out",
                "FILE",
                "write the thresholds to this file (JSON), for run --monitor learned --normal FILE",
                type=Path,
            ),
            *LOG_OPTIONS,
            Settings(
                (
                    INPUT_DELAY,
                    option("--gap", "SECONDS", "continuous designs: longer intervals are gaps", type=float),
                    option(
                        "--warm-up",
                        "SECONDS",
                        "seconds that are left out as warm-up, at the start and after gaps",
                        type=float,
                    ),
                )
            ),
            JSON,
            FORCE,
            QUIET,
        ),
    ),
    "export": Verb(
        "obsynth.monitoring.verbs.logs:run_export",
        "Write a gain set for Simulink (.mat), numpy (.npz), C99 (.c and .h), as a functional mock-up unit for "
        "co-simulation (.fmu), or the proof of its claims in whole numbers (.json). A recursive design "
        "for a time-invariant plant is written as its steady state.",
        (
            GAINS,
            UNVERIFIED,
            option(
                "--to", "FILE", ".mat, .npz, .c (with a header), .fmu, or .json (a proof)", type=Path, required=True
            ),
            Settings(
                (
                    option(
                        "--sample-time",
                        "SECONDS",
                        "sample a continuous-time observer (needed for C and FMU)",
                        type=float,
                    ),
                    option("--fmi", None, "version of FMI for .fmu (default: 2.0)", choices=("2.0", "3.0")),
                    option(
                        "--precision",
                        None,
                        "type of the numbers in .c (default: double); the header states the error of floats",
                        choices=("double", "float"),
                    ),
                    option(
                        "--outliers",
                        None,
                        "nonlinear designs, .c and .fmu: leave out outliers (default), limit them, or use them",
                        choices=("gate", "huber", "none"),
                    ),
                    option(
                        "--normal",
                        "FILE",
                        "for .c and .fmu: the monitor that obsynth thresholds wrote (.json)",
                        type=Path,
                    ),
                    option(
                        "--threshold",
                        "OUTPUT=LEVEL",
                        "for .c and .fmu: alarm when the absolute value of an output, such as "
                        "fhat[pump], passes a level; may be repeated",
                    ),
                    option("--warm-up", "SECONDS", "for .c and .fmu: no alarms in these seconds", type=float),
                    flag("--checker", "for .json: copy check_proof.py, which checks it without obsynth, beside it"),
                )
            ),
            FORCE,
            JSON,
        ),
    ),
    "plot": Verb(
        "obsynth.monitoring.verbs.logs:run_plot",
        "Run a design on measured data and draw it: outputs, estimates, residuals, thresholds and alarms.",
        (
            GAINS,
            UNVERIFIED,
            option("--data", "FILE", _LOG, required=True),
            option("--out", "FILE", "picture (.png, .svg or .pdf); without it, a window opens", type=Path),
            *DATA_OPTIONS,
            Settings(
                (
                    option(
                        "--show",
                        "PARTS",
                        "what to draw, from outputs,faults,residuals,statistic,shares (default: all of them)",
                        default="outputs,faults,residuals,statistic,shares",
                    ),
                )
            ),
            _EXPECTED_SCENARIO,
            FORCE,
            JSON,
            QUIET,
        ),
    ),
    "report": Verb(
        "obsynth.monitoring.verbs.logs:run_report",
        "Verify a gain set again and write one self-contained HTML page about it.",
        (
            GAINS,
            UNVERIFIED,
            option(
                "--out",
                "FILE",
                "the page (HTML), or a certificate (.json) of what holds for every plant within its tolerances, which "
                "obsynth verify checks again",
                type=Path,
                required=True,
            ),
            option("--system", "SPEC", "show the design on the scenario of this spec", type=Path),
            option("--data", "FILE", "show the design on this log as well: text, Parquet, TDMS or MDF file"),
            *DATA_OPTIONS,
            Settings(
                (option("--rows", "A:B", "rows without faults, which are compared with the design (default: all)"),)
            ),
            FORCE,
            JSON,
        ),
    ),
    "linearise": Verb(
        "obsynth.monitoring.verbs.calibration:run_linearise",
        "Linearise the nonlinear plant of a spec: exact matrices at an equilibrium (by default that of the spec's "
        "transform), or the reason why there is none.",
        (
            SYSTEM,
            Settings(
                (
                    option("--at", None, "where to linearise (default: equilibrium)", choices=("equilibrium", "point")),
                    option(
                        "--given", "NAME=VALUE", "value of a state, input, parameter or output there; may be repeated"
                    ),
                    option(
                        "--free",
                        "NAME[=LOW:HIGH]",
                        "an input or parameter that is solved for, within bounds; may be repeated",
                        action="append",
                        default=[],
                    ),
                    option(
                        "--fault",
                        "NAME",
                        "a parameter that is a fault (default: all); may be repeated",
                        action="append",
                    ),
                    option(
                        "--disturbance",
                        "NAME",
                        "an input that is not known; may be repeated",
                        action="append",
                        default=[],
                    ),
                    flag("--drift", "allow a point that is no equilibrium: its motion becomes an input 'drift'"),
                )
            ),
            option("--data", "FILE", "the log, as for run", type=Path),
            *LOG_OPTIONS,
            option(
                "--out",
                "FILE",
                "write the linear plant to this file (YAML), at nominal values: for designs that know "
                "tolerances, give the equations and transform.linearise in the spec",
                type=Path,
            ),
            JSON,
            FORCE,
            QUIET,
        ),
    ),
    "calibrate": Verb(
        "obsynth.monitoring.verbs.calibration:run_calibrate",
        "Fit constants and noise of a plant to a log without faults, with confidence intervals.",
        (
            SYSTEM,
            option("--data", "FILE", "the log, as for run", type=Path),
            *LOG_OPTIONS,
            Settings(
                (
                    option(
                        "--unknown",
                        "NAME=LOW:HIGH",
                        "a constant to fit, with its bounds, in addition to those of the spec; may be repeated",
                    ),
                    option(
                        "--write-spec",
                        "FILE",
                        "write the spec with the constants, boxes and noise that were found",
                        type=Path,
                    ),
                    INPUT_DELAY,
                    option("--level", "P", "probability that the box holds (default: 0.95)", type=float),
                )
            ),
            option("--out", "FILE", "write the result to this file (JSON)", type=Path),
            JSON,
            FORCE,
            QUIET,
        ),
    ),
    "validate": Verb(
        "obsynth.monitoring.verbs.calibration:run_validate",
        "Test whether a log without faults agrees with a design.",
        (
            GAINS,
            UNVERIFIED,
            option("--data", "FILE", "the log, as for run", type=Path, required=True),
            *LOG_OPTIONS,
            Settings((INPUT_DELAY,)),
            JSON,
            QUIET,
        ),
    ),
    "prove-alarm": Verb(
        "obsynth.monitoring.verbs.logs:run_prove_alarm",
        "Prove that no plant within its tolerances explains the data up to a row without a fault.",
        (
            GAINS,
            UNVERIFIED,
            option("--data", "FILE", "the log, as for run", type=Path, required=True),
            option("--row", "K", "last row of the window, counted from 1", type=int, required=True),
            option("--out", "FILE", "write the certificate (JSON) if there is a proof", type=Path),
            MAP,
            SCALE,
            Settings(
                (
                    TIME_COLUMN,
                    INPUT_DELAY,
                    option("--window", "N", "length of the window in samples (default: 20)", type=int, default=20),
                    option("--disturbance", "NAME=BOUND", "largest absolute value of a disturbance; may be repeated"),
                    option(
                        "--initial", "STATE=BOUND", "bound of a state at the first row (or LOW:HIGH); may be repeated"
                    ),
                    option(
                        "--state-bound",
                        "STATE=BOUND",
                        "without initial: bound of a state in the window; may be repeated",
                    ),
                    option("--noise-bound", "N", "bound on the noise, in standard deviations", type=float),
                )
            ),
            JSON,
            FORCE,
        ),
    ),
}


def obsynth_parser(asked: Collection[str] | None = None) -> argparse.ArgumentParser:
    """Return the parser of ``obsynth`` with all its verbs; only those among the words ``asked`` have arguments."""
    parser = _parser("obsynth", "Design, verify and run observers and fault-estimation filters for descriptor systems.")
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
            help=verb.told,
            add_help=asked is None or name in asked,
            description=fill(verb.told, width=78),
            epilog=verb.epilog,
            formatter_class=Folded if verb.epilog else argparse.HelpFormatter,
        )
        if asked is None or name in asked:
            _fill(name, own)
    return parser


def _parser(name: str, told: str) -> argparse.ArgumentParser:
    parser = Parser(
        prog=name,
        description=fill(told, width=78),
        epilog=EXIT_CODES,
        formatter_class=Folded,
    )
    parser.add_argument("--version", action="version", version=f"obsynth {__version__}")
    return parser


def _fill(name: str, parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser.set_defaults(verb=name)
    if name in EXAMPLES:
        parser.description = f"{parser.description}\n\nexample:\n  {EXAMPLES[name]}"
        parser.formatter_class = Folded
    add_arguments(parser, VERBS[name].arguments)
    if settings := settings_of(VERBS[name].arguments):
        add_settings(parser, settings)
    if name in _TELL_METHODS:
        # Asked for only when the help is printed: other packages may have registered some.
        parser.format_help = lambda: _help_with_methods(parser)  # type: ignore[method-assign]
    return parser


def _help_with_methods(parser: argparse.ArgumentParser) -> str:
    """Return the help of a parser with the ids of the methods."""
    from obsynth.methods.installed import REGISTRY

    told = fill(", ".join([*REGISTRY, "auto"]), width=78, initial_indent="  ", subsequent_indent="  ")
    return f"{argparse.ArgumentParser.format_help(parser)}\nmethods:\n{told}\n"


@contextmanager
def usable_streams() -> Iterator[None]:
    """Let texts go to nowhere where a stream is closed, print characters that an encoding lacks, warn in one line."""
    with warnings.catch_warnings(), ExitStack() as stack:
        # Where in a library it arose is no use to the user.
        warnings.showwarning = lambda message, *_, **__: print(f"Warning: {message}", file=sys.stderr)
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            if stream is None:
                # The first file that is opened would get its number, and what is meant for the terminal.
                setattr(sys, name, stack.enter_context(open(os.devnull, "w", encoding="utf-8", newline="")))
                stack.callback(setattr, sys, name, None)
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
        print(f"Error: {place} cannot be written: {error.strerror or error}.", file=sys.stderr)
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
    words = sys.argv[1:] if arguments is None else arguments
    # A script of completion knows the arguments of all commands; otherwise only those of one are made.
    return _run(obsynth_parser(None if "--print-completion" in words else words), words)


def design_command(arguments: Sequence[str] | None = None) -> int:
    """Run ``design``, which is ``obsynth design``."""
    return _run(_fill("design", _parser("design", VERBS["design"].told)), arguments)


def _run(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> int:
    with usable_streams(), protected_inputs(), _collected_rarely():
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


@contextmanager
def _collected_rarely() -> Iterator[None]:
    """Look for cycles of garbage less often than Python does by itself."""
    before = gc.get_threshold()
    gc.set_threshold(NEW_OBJECTS, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _options(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the arguments of a command line, settings among them."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    options, rest = parser.parse_known_args(words)
    options.command = shlex.join([parser.prog, *words])
    rest = read_settings(f"{parser.prog} {options.verb}", VERBS[options.verb].arguments, options, rest)
    if rest:
        _refuse_words(parser.prog, options.verb, rest)
    return options


def _refuse_words(prog: str, verb: str, rest: Sequence[str]) -> NoReturn:
    """End the program as words that a verb does not take do: with its usage, and what may be meant."""
    own = _fill(verb, Parser(prog=prog if prog == verb else f"{prog} {verb}"))
    known = [*own._option_string_actions, *(name for one in settings_of(VERBS[verb].arguments) for name in one.names)]
    wrong = [word.partition("=")[0] for word in rest if word.startswith("-") and word != "-"]
    if not wrong:
        own.error(f"it does not take {' '.join(map(repr, rest))}: see {own.prog} --help.")
    own.error(f"there is no option {wrong[0]}.{meant(wrong[0], known)} See {own.prog} --help.")


def _outcome(options: argparse.Namespace) -> int:
    """Run the verb; return its exit code, or that of its error after telling it."""
    try:
        named = ("output", "out", "write_spec", "to", "state", "prove")
        is_written = options.verb == "design" or any(getattr(options, name, None) not in (None, "-") for name in named)
        if getattr(options, "force", False) and not is_written:
            raise SpecError("--force replaces a file, and none is written here: give --out.", path="--force")
        module, function = VERBS[options.verb].run.split(":")
        run: Callable[[argparse.Namespace], int] = getattr(import_module(module), function)
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
