"""The verbs about many designs, runs or plants."""

from __future__ import annotations

import argparse
from pathlib import Path

from obsynth.monitoring.verbs.arguments import MONITOR, MONITOR_SETTINGS
from obsynth.report.terminal.arguments import Settings, option
from obsynth.report.terminal.common_options import (
    CLUSTER,
    FORCE,
    INPUT_DELAY,
    JOBS,
    JSON,
    MAP,
    QUIET,
    SCALE,
    SPEC_GAINS,
    SWEEP_JOBS,
    SYSTEM,
    TIME_COLUMN,
    UNVERIFIED,
)
from obsynth.report.terminal.verbs import Verb

# Lines that end in a backslash go on: help is folded to the terminal.
_SWEEP_DETAILS = """\
A value list is a YAML list: --set gamma='[0.1, 0.2]' --set plant.transform.sample_time='[0.01, 0.02]' --set \
plant.C.outputs='[[omega 1], [omega 1, omega 2]]'. A name that begins with no section of a spec is an option of \
its method. The folder keeps every gain set and result: the same command continues a sweep that was interrupted."""


def _run_sensors(options: argparse.Namespace) -> int:
    from obsynth.studies.verbs.sensors import run_sensors

    return run_sensors(options)


def _run_compare(options: argparse.Namespace) -> int:
    from obsynth.studies.verbs.scenarios import run_compare

    return run_compare(options)


def _run_evaluate(options: argparse.Namespace) -> int:
    from obsynth.studies.verbs.scenarios import run_evaluate

    return run_evaluate(options)


def _run_sweep(options: argparse.Namespace) -> int:
    from obsynth.studies.verbs.sweeps import run_sweep

    return run_sweep(options)


#: Verbs by name.
VERBS = {
    "sensors": Verb(
        _run_sensors,
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
    "compare": Verb(
        _run_compare,
        "Design by every method that exists for a spec's plant, and compare them on its scenario.",
        (
            SYSTEM,
            option("--data", "FILE", "a log, as for run, that ranks methods by the delay of alarms", type=Path),
            MAP,
            SCALE,
            option("--out", "FILE", "write a page (HTML), or a certificate for obsynth verify (.json)", type=Path),
            Settings(
                (
                    option("--runs", "N", "drawn runs of the scenario (default: 20)", type=int, default=20),
                    option(
                        "--tolerance",
                        "T",
                        "relative error of the drawn parameters (default: 0)",
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
        _run_evaluate,
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
        _run_sweep,
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
            SWEEP_JOBS,
            CLUSTER,
            JSON,
            FORCE,
            QUIET,
        ),
        _SWEEP_DETAILS,
    ),
}
