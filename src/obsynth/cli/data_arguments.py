"""The arguments of ``run``, ``export`` and ``report``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

_RUN = "Run a linear design on measured data: a log, or a stream on standard input, a row in, a row out."
_EXPORT = "Write a linear gain set for Simulink (.mat), numpy (.npz) or C99 (.c and .h)."
_REPORT = "Verify a gain set again and write one self-contained HTML page about it."
_RUN_DETAILS = """\
The data have a column 'time' in seconds and one for each known input and output, by name.
Each row of estimates has a status:
  ok          all is well
  warm-up     the start is not forgotten yet
  gap         a sample is missing: fault estimates are held, the plant model stands in, no alarms
  recovering  after a gap, like warm-up
An estimate that lags has a column 'time of ...', the time of which it is the estimate.
"""


def add_data_verbs(verbs: Any) -> None:
    """Add the parsers.

    Parameters
    ----------
    verbs : object
        The subparsers of ``obsynth``.
    """
    run = verbs.add_parser(
        "run", help=_RUN, description=_RUN, epilog=_RUN_DETAILS, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    _add_gains(run)
    run.add_argument("--data", required=True, metavar="FILE", help="CSV or Parquet file; - for CSV on standard input")
    run.add_argument(
        "--out", default="-", metavar="FILE", help="CSV or Parquet file for the estimates (default: - for stdout)"
    )
    run.add_argument(
        "--map", type=_pair, action="append", default=[], metavar="SIGNAL=COLUMN",
        help="column of a signal (or of time) where the names differ; may be repeated",
    )  # fmt: skip
    run.add_argument(
        "--scale", type=_pair, action="append", default=[], metavar="SIGNAL=FACTOR",
        help="the column's value times the factor is in the signal's unit; may be repeated",
    )  # fmt: skip
    run.add_argument(
        "--threshold", type=_pair, action="append", default=[], metavar="COLUMN=LEVEL",
        help="alarm when the absolute value of a column of the output passes a level; may be repeated",
    )  # fmt: skip
    run.add_argument("--gap", type=float, metavar="SECONDS", help="continuous designs: longer intervals are gaps")
    run.add_argument("--warm-up", type=float, metavar="SECONDS", help="how long to mark the start, and after gaps")
    run.add_argument(
        "--state", type=Path, metavar="FILE", help="go on from this saved state if it exists, and save the new one"
    )
    _add_json(run)
    run.add_argument("--quiet", action="store_true", help="print no progress and no summary")
    run.set_defaults(verb="run")

    export = verbs.add_parser("export", help=_EXPORT, description=_EXPORT)
    _add_gains(export)
    export.add_argument("--to", type=Path, required=True, metavar="FILE", help=".mat, .npz, or .c (with a header)")
    export.add_argument(
        "--sample-time", type=float, metavar="SECONDS", help="sample a continuous-time observer (needed for C)"
    )
    _add_json(export)
    export.set_defaults(verb="export")

    report = verbs.add_parser("report", help=_REPORT, description=_REPORT)
    _add_gains(report)
    report.add_argument("--out", type=Path, required=True, metavar="FILE", help="the page (HTML)")
    report.add_argument("--system", type=Path, metavar="SPEC", help="show the design on the scenario of this spec")
    _add_json(report)
    report.set_defaults(verb="report")


def _add_gains(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--gains", type=Path, required=True, metavar="FILE", help="a gain set (JSON) that design wrote")


def _add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON on stdout, for programs; errors too")


def _pair(text: str) -> tuple[str, str]:
    # A column of the output, such as fhat[a=b], may hold an equals sign; a number or a plain column does not.
    name, mark, value = text.rpartition("=")
    if not mark or not name or not value:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=VALUE")
    return name, value
