"""Arguments of monitors, and of runs on data."""

from __future__ import annotations

import argparse
from typing import Any

from obsynth.monitoring.thresholds.options import DISTURBANCES, FALSE_ALARMS, LINEAR_OPTIONS, PARAMETER_OPTIONS, WINDOW
from obsynth.report.terminal.arguments import OPTION_NAMES, Group, Settings, flag, numbers_of, option, ranges_of
from obsynth.report.terminal.common_options import (
    INPUT_DELAY,
    MAP,
    SCALE_OPTION,
    TIME_COLUMN,
    TIME_UNIT,
    TIME_ZONE,
    count,
    positive,
    probability,
)

#: What a monitor is made of.
_WHAT_A_MONITOR_DOES = "compare the residual (or the parameters) with a threshold; obsynth run --help lists the kinds"

#: Options that are no settings of monitors on the command line.
_ELSEWHERE = {"scenario", "sample_time", "constants", "gamma"}

#: Names of all settings of monitors.
MONITOR_NAMES = sorted(
    OPTION_NAMES.get(name, name)
    for name in {name for table in (LINEAR_OPTIONS, PARAMETER_OPTIONS) for names in table.values() for name in names}
    - _ELSEWHERE
)

MONITOR = Group("monitor", (option("--monitor", "KIND", _WHAT_A_MONITOR_DOES),))

#: What disturbances do between samples.
DISTURBANCE_COURSE = option(
    "--disturbance-course",
    "KIND",
    "between the samples of a sampled plant, disturbances do anything (any, default) or nothing (held)",
    choices=DISTURBANCES,
)

#: What its threshold is made of, where the scenario does not say it.
MONITOR_SETTINGS = Settings(
    (
        option("--disturbance", "NAME=BOUND", "largest absolute value of a disturbance; may be repeated"),
        DISTURBANCE_COURSE,
        option("--noise-bound", "N", "bound on the noise, in standard deviations", type=float),
        option(
            "--initial",
            "STATE=BOUND",
            "pointwise, discrete designs: bound of a state of the plant at the start (or LOW:HIGH); may be repeated",
        ),
        option("--initial-error", "E", "bound on the norm of the error at the start", type=float),
        option(
            "--false-alarms",
            "P",
            f"statistical kinds: probability of a false alarm in the whole run (default: {FALSE_ALARMS:g})",
            type=probability,
        ),
        option("--window", "N", f"length of the window in samples (default: {WINDOW})", type=count),
        option(
            "--change",
            "X",
            "cusum: change to detect, in standard deviations of the residual, or in parameter units (default: 1)",
            type=positive,
        ),
    )
)

#: How a log is read, and what is watched in it.
DATA_OPTIONS = (
    MAP,
    MONITOR,
    MONITOR_SETTINGS,
    Settings(
        (
            TIME_COLUMN,
            TIME_UNIT,
            TIME_ZONE,
            INPUT_DELAY,
            option(
                "--normal",
                "FILE",
                "monitor 'learned': what obsynth thresholds wrote (.json), or a log without faults",
            ),
            flag("--no-sensor-faults", "monitor 'learned': an alarm is one of the design's faults, and no sensor's"),
            SCALE_OPTION,
            option(
                "--threshold",
                "COLUMN=LEVEL",
                "alarm when the absolute value of a column of the output passes a level; may be repeated",
            ),
            option(
                "--nominal",
                "NAME=VALUE",
                "monitor of a recursive design: nominal value of a parameter; may be repeated",
            ),
            option("--sample-time", "SECONDS", "monitor of a continuous design: time between the rows", type=float),
            option("--gap", "SECONDS", "continuous designs: a longer interval between two rows is a gap", type=float),
            option("--warm-up", "SECONDS", "length of the warm-up at the start and after gaps", type=float),
        )
    ),
)


def stated_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return what a command line states of a monitor, by the names of the arguments of `obsynth.online_monitor`."""
    return {
        "disturbance_bounds": numbers_of(options.disturbance),
        "noise_bound": options.noise_bound,
        "initial_error": options.initial_error,
        "window": options.window,
        "false_alarms": options.false_alarms,
        "change": options.change,
        "initial_set": ranges_of(options.initial) or None,
        "nominal": numbers_of(getattr(options, "nominal", [])),
        "disturbance": "held" if options.disturbance_course == "held" else None,
        "normal": getattr(options, "normal", None),
        "sensor_faults": False if getattr(options, "no_sensor_faults", False) else None,
    }
