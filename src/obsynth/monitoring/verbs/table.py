"""The verbs that read logs, and what they add to verbs of designs."""

from __future__ import annotations

import argparse
from pathlib import Path

from obsynth.monitoring.verbs.arguments import DATA_OPTIONS, DISTURBANCE_COURSE
from obsynth.report.terminal.arguments import Argument, Group, Settings, flag, option
from obsynth.report.terminal.common_options import (
    CLUSTER,
    FORCE,
    GAINS,
    INPUT_DELAY,
    JOBS,
    JSON,
    LOG_OPTIONS,
    MAP,
    QUIET,
    SCALE,
    SYSTEM,
    TIME_COLUMN,
    TIME_UNIT,
    TIME_ZONE,
    UNVERIFIED,
)
from obsynth.report.terminal.verbs import Verb

# Lines that end in a backslash go on: help is folded to the terminal.
_RUN_DETAILS = """\
The data have a column 'time', in seconds or as dates and times (ISO 8601), and one for each known input and \
output, by name. Columns of text are separated by commas, semicolons, tabs or bars; numbers may have a decimal \
comma where commas separate nothing.
Each row of estimates has a status:
  ok          nothing is missing
  warm-up     the initial-condition response has not settled yet
  gap         a sample is missing: fault estimates are held, the plant model replaces the sensors, no alarms
  partial     recursive and nonlinear designs: some outputs are missing, the others are used
  out         designs over a region: a scheduling parameter, an input, a measurement or the estimate is outside the \
region, or was so until recently: nothing is claimed, no alarms
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
  chi-square  linear: a window of the residual against its covariance, or the fault estimates and their means over a\
 window; recursive: the parameters against theirs
  cusum       cumulative sums: small changes of the residual, or of a parameter
  nis         recursive and nonlinear designs: normalised innovations squared, too large for the model
  learned     every design, and the only one for those over a region: thresholds from rows without faults\
 (--normal), whatever noise the model assumes
The scenario of --system, or the options, state which disturbances and noise to expect.

If --gains is a folder, every gain set in it is run on --data, which is a log or a folder of logs, on --jobs \
processes or on a cluster; a log with the name of a gain set is for that gain set alone. --out is then a folder \
for the estimates, table.csv and fleet.png; the same command continues a run that was interrupted."""

_LOG = "text (.csv, .tsv), Parquet, TDMS or MDF file; - for text on standard input"

_EXPECTED_SCENARIO = option(
    "--system", "FILE", "spec (YAML) whose scenario states the disturbances and noise to expect", type=Path
)

#: Arguments that monitors add to verbs of designs, by verb.
ADDED: dict[str, tuple[Argument | Group | Settings, ...]] = {
    "export": (
        Settings(
            (
                option(
                    "--normal",
                    "FILE",
                    "for .c and .fmu: the monitor that obsynth thresholds wrote (.json)",
                    type=Path,
                ),
            ),
        ),
    ),
    "report": (
        option("--data", "FILE", "show the design on this log as well: text, Parquet, TDMS or MDF file"),
        *DATA_OPTIONS,
        Settings((option("--rows", "A:B", "rows without faults, which are compared with the design (default: all)"),)),
    ),
}


def _run_run(options: argparse.Namespace) -> int:
    from obsynth.monitoring.verbs.logs import run_run

    return run_run(options)


def _run_thresholds(options: argparse.Namespace) -> int:
    from obsynth.monitoring.verbs.thresholds import run_thresholds

    return run_thresholds(options)


def _run_plot(options: argparse.Namespace) -> int:
    from obsynth.monitoring.verbs.logs import run_plot

    return run_plot(options)


def _run_linearise(options: argparse.Namespace) -> int:
    from obsynth.monitoring.verbs.calibration import run_linearise

    return run_linearise(options)


def _run_calibrate(options: argparse.Namespace) -> int:
    from obsynth.monitoring.verbs.calibration import run_calibrate

    return run_calibrate(options)


def _run_validate(options: argparse.Namespace) -> int:
    from obsynth.monitoring.verbs.calibration import run_validate

    return run_validate(options)


def _run_prove_alarm(options: argparse.Namespace) -> int:
    from obsynth.monitoring.verbs.logs import run_prove_alarm

    return run_prove_alarm(options)


#: Verbs by name.
VERBS = {
    "run": Verb(
        _run_run,
        "Run a design on measured data: a log, or a stream on standard input, with a row of estimates for each row.",
        (
            GAINS,
            UNVERIFIED,
            Group(
                "",
                (
                    option("--data", "FILE", _LOG),
                    option(
                        "--follow",
                        "FILE",
                        "a text log that grows: wait for its rows, over rotations of the file; a saved --state goes on "
                        "after the rows that it has",
                    ),
                ),
                required=True,
            ),
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
                    flag("--units-as-is", "go on where a signal is likely in another unit than the plant's"),
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
        _run_thresholds,
        "Find thresholds of a design from a log without faults, for a rate of false alarms.",
        (
            GAINS,
            UNVERIFIED,
            option(
                "--data",
                "FILE",
                "one log without faults or several, or the folder that they are in; " + _LOG,
                required=True,
                nargs="+",
            ),
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
                    TIME_UNIT,
                    TIME_ZONE,
                    INPUT_DELAY,
                    option("--gap", "SECONDS", "continuous designs: longer intervals are gaps", type=float),
                    option(
                        "--warm-up",
                        "SECONDS",
                        "seconds that are left out as warm-up, at the start and after gaps",
                        type=float,
                    ),
                    option(
                        "--sensor-drift",
                        "N",
                        "standard deviations of its noise by which a sensor may drift without an alarm (0: none)",
                        type=float,
                    ),
                    flag("--units-as-is", "go on where a signal is likely in another unit than the plant's"),
                )
            ),
            JSON,
            FORCE,
            QUIET,
        ),
    ),
    "plot": Verb(
        _run_plot,
        "Run a design on measured data and draw the run: outputs, estimates, residuals, thresholds and alarms.",
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
    "linearise": Verb(
        _run_linearise,
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
        _run_calibrate,
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
                        "write the spec with the constants, boxes and noise that were fitted",
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
        _run_validate,
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
        _run_prove_alarm,
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
                    DISTURBANCE_COURSE,
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
