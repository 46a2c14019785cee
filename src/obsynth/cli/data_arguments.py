"""The arguments of ``run``, ``export`` and ``report``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from obsynth.cli.arguments import add_force, add_gains, add_json, add_quiet
from obsynth.cli.sweep import add_executors

#: Probability of a false alarm in the whole run, where none is given.
FALSE_ALARMS = 0.01
_RUN = "Run a design on measured data: a log, or a stream on standard input, a row in, a row out."
_EXPORT = (
    "Write a gain set for Simulink (.mat), numpy (.npz), C99 (.c and .h), or as a functional mock-up unit for "
    "co-simulation (.fmu); of a recursive design for a time-invariant plant, its steady state."
)
_PLOT = "Run a design on measured data and draw it: outputs, estimates, residuals, thresholds and alarms."
_REPORT = "Verify a gain set again and write one self-contained HTML page about it."
_RUN_DETAILS = """\
The data have a column 'time', in seconds or as dates and times (ISO 8601), and one for each known input and output,
by name. Columns of text are separated by commas, semicolons, tabs or bars; numbers may have a decimal comma where
commas separate nothing.
Each row of estimates has a status:
  ok          all is well
  warm-up     the start is not forgotten yet
  gap         a sample is missing: fault estimates are held, the plant model stands in, no alarms
  partial     recursive and nonlinear designs: some outputs are missing, the others are used
  recovering  after a gap, like warm-up
An estimate that lags has a column 'time of ...', the time of which it is the estimate.

--monitor KIND adds columns 'statistic', 'threshold' and 'alarm', with the fault that stands out. The thresholds hold
however long the data are. KIND is one of
  pointwise   linear designs: the residual's peak bound, for disturbances and noise within bounds; where the plant's
              constants have tolerances, it adapts to the signals and holds for every plant within them, with columns
              for each threshold, the guaranteed interval of each fault, and the share of each constant
  window      the same for its l2 norm over a window
  paper       linear, discrete: eq. (66) of Wang et al. 2015; no bound
  chi-square  linear: a window of the residual against its covariance; recursive: the parameters against theirs
  cusum       small changes of the residual, or of a parameter
  nis         recursive and nonlinear designs: innovations that the model does not explain
Where --gains is a folder, every gain set in it is run on --data, a log or a folder of logs, on --jobs processes or a
cluster; a log with the name of a gain set is for that one alone.  --out is a folder then, with the estimates, table.csv
and fleet.png; the same command goes on where another was stopped.

What disturbances and noise are to be expected comes from the scenario of --system, or from the options.
"""


def add_data_verbs(verbs: Any) -> None:
    """Add the parsers."""
    _add_run(verbs)
    _add_what_follows(verbs)


def _add_run(verbs: Any) -> None:
    run = verbs.add_parser(
        "run", help=_RUN, description=_RUN, epilog=_RUN_DETAILS, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_gains(run)
    _add_data(run, required=True, what="text (.csv, .tsv), Parquet, TDMS or MDF file; - for text on standard input")
    run.add_argument(
        "--out",
        default="-",
        metavar="FILE",
        help="CSV or Parquet file for the estimates (default: - for stdout); a folder for many gain sets",
    )
    _add_data_options(run)
    _add_scenario(run)
    add_executors(run)
    run.add_argument(
        "--outliers", choices=("gate", "huber", "none"),
        help="recursive and nonlinear designs: leave out samples that their prediction excludes (default), pull them "
        "to its limit, or take them as they are",
    )  # fmt: skip
    later = run.add_mutually_exclusive_group()
    later.add_argument(
        "--smooth", action="store_true",
        help="recursive and nonlinear designs: estimates from the whole log, not only from what came before",
    )  # fmt: skip
    later.add_argument(
        "--lag", type=int, metavar="N",
        help="the same from the N samples after each row: rows are written N samples late, with their own time",
    )  # fmt: skip
    run.add_argument(
        "--recovered", action="append", metavar="NAME",
        help="a state of the plant as written to recover (or all, or none; default: all of up to 300)",
    )  # fmt: skip
    run.add_argument(
        "--state", type=Path, metavar="FILE", help="go on from this saved state if it exists, and save the new one"
    )
    run.add_argument(
        "--prove", type=Path, metavar="FILE",
        help="with --monitor pointwise: prove the first alarm, and write the certificate that 'verify' rechecks",
    )  # fmt: skip
    add_json(run)
    add_force(run)
    add_quiet(run, "no progress and no summary")
    run.set_defaults(verb="run")


def _add_what_follows(verbs: Any) -> None:
    """Add the verbs that take a gain set further: export, plot and report."""
    export = verbs.add_parser("export", help=_EXPORT, description=_EXPORT)
    add_gains(export)
    export.add_argument(
        "--to", type=Path, required=True, metavar="FILE", help=".mat, .npz, .c (with a header), or .fmu"
    )
    export.add_argument(
        "--sample-time", type=float, metavar="SECONDS", help="sample a continuous-time observer (needed for C and FMU)"
    )
    export.add_argument("--fmi", choices=("2.0", "3.0"), default="2.0", help="version of FMI for .fmu (default: 2.0)")
    export.add_argument(
        "--threshold", type=pair, action="append", default=[], metavar="OUTPUT=LEVEL",
        help="for .fmu: alarm when the absolute value of an output, such as fhat[pump], passes a level",
    )  # fmt: skip
    export.add_argument("--warm-up", type=float, metavar="SECONDS", help="for .fmu: no alarms in these seconds")
    add_force(export)
    add_json(export)
    export.set_defaults(verb="export")

    plot = verbs.add_parser("plot", help=_PLOT, description=_PLOT)
    add_gains(plot)
    _add_data(plot, required=True, what="text (.csv, .tsv), Parquet, TDMS or MDF file; - for text on standard input")
    plot.add_argument("--out", type=Path, metavar="FILE", help="picture (.png, .svg or .pdf); without it, a window")
    plot.add_argument(
        "--show", metavar="PARTS", default="outputs,faults,residuals,statistic,shares",
        help="what is drawn, of outputs,faults,residuals,statistic,shares (default: all there is)",
    )  # fmt: skip
    _add_data_options(plot)
    _add_scenario(plot)
    add_force(plot)
    add_json(plot)
    add_quiet(plot)
    plot.set_defaults(verb="plot")

    report = verbs.add_parser("report", help=_REPORT, description=_REPORT)
    add_gains(report)
    report.add_argument("--out", type=Path, required=True, metavar="FILE", help="the page (HTML)")
    report.add_argument("--system", type=Path, metavar="SPEC", help="show the design on the scenario of this spec")
    _add_data(report, required=False, what="show the design on this log as well: text, Parquet, TDMS or MDF file")
    report.add_argument("--rows", metavar="A:B", help="rows without faults, which are to agree (default: all)")
    _add_data_options(report)
    add_force(report)
    add_json(report)
    report.set_defaults(verb="report")


def _add_data(parser: argparse.ArgumentParser, *, required: bool, what: str) -> None:
    parser.add_argument("--data", required=required, metavar="FILE", help=what)


def _add_scenario(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--system",
        type=Path,
        metavar="FILE",
        help="spec (YAML) whose scenario tells what is to be expected",
    )


def _add_data_options(parser: argparse.ArgumentParser) -> None:
    """Add what says how a log is read, and what is watched in it."""
    add_map(parser)
    parser.add_argument(
        "--time-column", metavar="COLUMN", help="column of the time, in seconds or as dates (ISO 8601); default: time"
    )
    parser.add_argument(
        "--scale", type=pair, action="append", default=[], metavar="SIGNAL=FACTOR",
        help="the column's value times the factor is in the signal's unit; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--threshold", type=pair, action="append", default=[], metavar="COLUMN=LEVEL",
        help="alarm when the absolute value of a column of the output passes a level; may be repeated",
    )  # fmt: skip
    add_monitor_arguments(parser)
    parser.add_argument(
        "--nominal", type=pair, action="append", default=[], metavar="NAME=VALUE",
        help="monitor of a recursive design: nominal value of a parameter; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--sample-time", type=float, metavar="SECONDS", help="monitor of a continuous design: between the rows"
    )
    parser.add_argument("--gap", type=float, metavar="SECONDS", help="continuous designs: longer intervals are gaps")
    parser.add_argument("--warm-up", type=float, metavar="SECONDS", help="how long to mark the start, and after gaps")


def add_monitor_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what a monitor is made of."""
    group = parser.add_argument_group("monitor")
    group.add_argument("--monitor", metavar="KIND", help="watch the residual (or the parameters) by a threshold")
    group.add_argument(
        "--disturbance", type=pair, action="append", default=[], metavar="NAME=BOUND",
        help="largest absolute value of a disturbance; may be repeated",
    )  # fmt: skip
    group.add_argument("--noise-bound", type=float, metavar="N", help="standard deviations that no noise exceeds")
    group.add_argument(
        "--initial", type=pair, action="append", default=[], metavar="STATE=BOUND",
        help="pointwise, discrete designs: bound of a state of the plant at the start (or LOW:HIGH); may be repeated",
    )  # fmt: skip
    group.add_argument("--initial-error", type=float, metavar="E", help="bound on the norm of the error at the start")
    group.add_argument(
        "--false-alarms", type=float, default=FALSE_ALARMS, metavar="P",
        help="statistical kinds: probability of a false alarm in the whole run (default: %(default)s)",
    )  # fmt: skip
    group.add_argument("--window", type=int, default=20, metavar="N", help="samples looked back (default: 20)")
    group.add_argument(
        "--change", type=float, default=1.0, metavar="X",
        help="cusum: change to be found, in deviations of the residual, or in parameter units (default: 1)",
    )  # fmt: skip


def add_map(parser: argparse.ArgumentParser) -> None:
    """Add ``--map``."""
    parser.add_argument(
        "--map", type=pair, action="append", default=[], metavar="SIGNAL=COLUMN",
        help="column of a signal (or of time) where the names differ; may be repeated",
    )  # fmt: skip


def pair(text: str) -> tuple[str, str]:
    """Return the two sides of NAME=VALUE."""
    # A column of the output, such as fhat[a=b], may hold an equals sign; a number or a plain column does not.
    name, mark, value = text.rpartition("=")
    if not mark or not name or not value:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=VALUE")
    return name, value
