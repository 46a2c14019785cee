"""The options that several verbs have, each spelled once, and the types of their values."""

from __future__ import annotations

import math
from pathlib import Path

from obsynth.report.terminal.arguments import Settings, flag, number_type, option


def delay(text: str) -> int | str:
    """Return a delay in rows, or ``auto``."""
    return text if text == "auto" else int(text)


digits = number_type("digits", int, lambda value: 1 <= value <= 15, "is not between 1 and 15")

probability = number_type("probability", float, lambda value: 0.0 < value < 1.0, "is no probability between 0 and 1")

positive = number_type("positive", float, lambda value: 0.0 < value < math.inf, "is no positive number")

count = number_type("count", int, lambda value: value >= 1, "is less than 1")

INPUT_DELAY = option(
    "--input-delay",
    "ROWS",
    "rows of the log by which inputs act later than in the design (default: from inputs.hold in the spec; "
    "calibrate also takes 'auto')",
    type=delay,
)

SYSTEM = option("--system", "FILE", "the spec (YAML)", type=Path, required=True)

GAINS = option("--gains", "FILE", "a gain set (JSON) that design wrote", type=Path, required=True)

SPEC_GAINS = option("--gains", "FILE", "a gain set for the spec's plant: nothing is designed", type=Path)

UNVERIFIED = Settings(
    (flag("--unverified", "use a gain set that fails its verification; every file that is written says so"),)
)

JSON = flag("--json", "print results and errors as JSON on stdout, for programs")

FORCE = flag("--force", "replace an existing file of any kind (inputs are never replaced)")

QUIET = flag("--quiet", "print no progress")

JOBS = option("--jobs", "N", "processes (default: 1)", type=count)

SWEEP_JOBS = option("--jobs", "N", "processes (default: 1; one a processor for more than ten designs)", type=count)

CLUSTER = option("--cluster", "ADDRESS", "address of the scheduler of a Dask cluster, in place of --jobs")

MAP = option("--map", "SIGNAL=COLUMN", "column of a signal (or of the time) where the names differ; may be repeated")

SCALE_OPTION = option(
    "--scale", "SIGNAL=FACTOR", "factor from the unit of the column to that of the signal; may be repeated"
)

SCALE = Settings((SCALE_OPTION,))

TIME_COLUMN = option(
    "--time-column",
    "COLUMN",
    "column with the time, in seconds or as dates (ISO 8601, or 05.03.2026 08:30) (default: time)",
)

TIME_ZONE = option(
    "--time-zone",
    "ZONE",
    "zone of dates that name none, such as Europe/Berlin or +01:00; the hour that comes twice in autumn is told apart "
    "by the order of the rows (default: UTC)",
)

TIME_UNIT = option(
    "--time-unit",
    "UNIT",
    "unit of stamps that are numbers: s, ms, us, ns, min, h, or d for days of spreadsheets and MATLAB "
    "(default: as the log says)",
)

#: How a log without faults is read.
LOG_OPTIONS = (
    MAP,
    SCALE,
    Settings(
        (
            option(
                "--rows",
                "A:B",
                "rows of the log without faults: the first one, counted from 0, and one past the last (default: all)",
            ),
            TIME_COLUMN,
        )
    ),
)
