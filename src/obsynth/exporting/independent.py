"""Certificates checked by another program: one file of Python without any import but the standard library.

It runs as a process of its own, with ``python -I``: no module of obsynth, and none of the user's, is imported there by
accident.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.exporting.proof_file import proof_bytes, proof_of
from obsynth.exporting.proof_of_tests import fractions_data, window_as_data, window_of_test
from obsynth.methods.guaranteed_test.bank import is_bank, tests_of
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.proofs.witnesses import Dyadic, number_data
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import restored
from obsynth.results.gain_sets import loaded

#: Name of the program, in the package where it is installed and at the root of the project's sources.
CHECKER = "check_proof.py"
#: Its exit codes: all claims proved, one not proved.
PROVED, NOT_PROVED = 0, 1
#: A proof file says what it is within so many bytes.
HEAD_BYTES = 400


@dataclass(frozen=True)
class IndependentReport:
    """What the program printed, and whether it proved every claim."""

    passed: bool
    text: str


def checker_path() -> Path:
    """Return the file of the program; raise `SpecError` where an installation lacks it."""
    module = Path(__file__).resolve()
    for place in (module.with_name(CHECKER), module.parents[3] / "checker" / CHECKER):
        if place.is_file():
            return place
    raise SpecError(f"{CHECKER} is not part of this installation: install obsynth again.", path=CHECKER)


def copy_checker(directory: Path) -> Path:
    """Copy the program into a directory, and return its path there."""
    return Path(shutil.copyfile(checker_path(), directory / CHECKER))


def check_independently(proof: Path) -> IndependentReport:
    """Run the program on a proof file.

    Parameters
    ----------
    proof : Path
        A proof file, from `write_proof` or anybody else.

    Raises
    ------
    SpecError
        It is no proof file.
    """
    command = [sys.executable, "-I", str(checker_path()), str(proof)]
    run = subprocess.run(command, capture_output=True, text=True, encoding="utf-8", check=False)
    if run.returncode not in (PROVED, NOT_PROVED) or not run.stdout:
        raise SpecError(f"{proof} could not be checked: {run.stderr.strip()}", path=str(proof))
    return IndependentReport(run.returncode == PROVED, run.stdout.rstrip())


def check_design_independently(design: ObserverDesign) -> IndependentReport:
    """Write the proof file of a design to a temporary place, and run the program on it."""
    return _checked(proof_of(design))


def is_proof_file(head: bytes) -> bool:
    """Whether a file that begins like this is a proof file."""
    return re.search(rb'"format"\s*:\s*"obsynth-proof"', head) is not None


def check_alarm_independently(document: Mapping[str, Any]) -> IndependentReport:
    """Run the program on what the certificate of an alarm proves, and the gain set inside."""
    body = document.get("certificate")
    return _checked(alarm_proof_of(body if isinstance(body, Mapping) else {}))


def _checked(data: Mapping[str, Any]) -> IndependentReport:
    with tempfile.TemporaryDirectory(prefix="obsynth-proof-") as directory:
        place = Path(directory) / "proof.json"
        place.write_bytes(proof_bytes(data))
        return check_independently(place)


def alarm_proof_of(certificate: Mapping[str, Any]) -> dict[str, Any]:
    """Return the proof file of an alarm of a guaranteed test: that of its gain set, and the claim on the alarm.

    Parameters
    ----------
    certificate : mapping
        What the file of an alarm certificate holds.

    Raises
    ------
    SpecError
        The alarm is of another method: its proof is a linear programme over the state, left to `obsynth verify`.
    """
    if not {"multipliers", "test", "gain_set"} <= certificate.keys():
        raise SpecError(
            "The alarm is proved by a linear programme over the states of its window, not by a guaranteed test: only "
            "alarms of guaranteed tests have proof files. `obsynth verify` without --independent checks this one.",
            path="certificate",
        )
    design = loaded(json.dumps(certificate["gain_set"]).encode(), "the gain set of the alarm")
    tests = tests_of(design, GuaranteedTestMethod.of) if is_bank(design) else (design,)
    place = [test.linear[0].fault_names[window_of_test(test).test_problem.fault] for test in tests].index(
        certificate["test"]
    )
    window = window_of_test(tests[place]).outer
    y, u = (np.asarray(restored(certificate[name]), dtype=np.float64) for name in ("y", "u"))
    claim = {
        "claim": "alarm",
        "window": window_as_data(window),
        "multipliers": fractions_data([Fraction(text) for text in certificate["multipliers"]]),
        "y": Dyadic.of(y.reshape(len(y), -1)).data(),
        "u": Dyadic.of(u.reshape(len(y), -1) if u.size else np.zeros((len(y), 0))).data(),
        "margin": number_data(float(certificate["margin"])),
    }
    proof = proof_of(design)
    about = f"alarm at row {certificate['row']}, {proof['about']}"
    return {**proof, "about": about, "claims": [*proof["claims"], claim]}
