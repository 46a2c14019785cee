"""The verbs of designs: what each is for, its arguments, and the function that runs it."""

from __future__ import annotations

import argparse
from pathlib import Path

from obsynth.report.terminal.arguments import Group, Settings, flag, option, verbose
from obsynth.report.terminal.common_options import FORCE, GAINS, JSON, QUIET, SPEC_GAINS, SYSTEM, UNVERIFIED, digits
from obsynth.report.terminal.verbs import Verb


def _run_design(options: argparse.Namespace) -> int:
    from obsynth.cli.commands import run_design

    return run_design(options)


def _run_check(options: argparse.Namespace) -> int:
    from obsynth.cli.commands import run_check

    return run_check(options)


def _run_verify(options: argparse.Namespace) -> int:
    from obsynth.cli.commands import run_verify

    return run_verify(options)


def _run_simulate(options: argparse.Namespace) -> int:
    from obsynth.cli.commands import run_simulate

    return run_simulate(options)


def _run_export(options: argparse.Namespace) -> int:
    from obsynth.cli.gain_sets import run_export

    return run_export(options)


def _run_report(options: argparse.Namespace) -> int:
    from obsynth.cli.gain_sets import run_report

    return run_report(options)


#: Verbs by name.
VERBS = {
    "design": Verb(
        _run_design,
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
        _run_check,
        "Analyse the plant of a spec, and check for every method whether a design can exist.",
        (
            SYSTEM,
            flag("--whole-bank", "list every structured residual where there are 7 to 12 faults, too"),
            verbose("the structure of the plant and every condition"),
            JSON,
        ),
    ),
    "verify": Verb(
        _run_verify,
        "Verify again a saved gain set, or a certificate of any kind with all files that it refers to.",
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
        _run_simulate,
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
    "export": Verb(
        _run_export,
        "Write a gain set for Simulink (.mat), numpy (.npz), C99 (.c and .h) or co-simulation (.fmu), or the proof "
        "of its claims in integers (.json). A recursive design for a time-invariant plant is written as its steady "
        "state.",
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
    "report": Verb(
        _run_report,
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
            FORCE,
            JSON,
            QUIET,
        ),
    ),
}
