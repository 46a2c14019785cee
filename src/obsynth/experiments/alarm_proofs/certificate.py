"""Certificates of alarms on disk, and their check without a solver."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError, SpecError
from obsynth.experiments.alarm_proofs.proof import KIND, SCHEMA_VERSION, Question, statement
from obsynth.files.inputs import read_json
from obsynth.results.checks import Check, VerificationReport
from obsynth.results.gain_sets import digest_of, loaded, restored

#: The stated margin may differ from the one found again by this share: matrices are made anew.
SAME_MARGIN = 1e-3


def is_certificate(content: Any) -> bool:
    """Whether a JSON document is a certificate of an alarm."""
    return isinstance(content, dict) and content.get("kind") == KIND


def verify_alarm(path: str | Path) -> VerificationReport:
    """Check the certificate of an alarm again, without a solver.

    Parameters
    ----------
    path : str or Path
        What `prove_alarm` (or ``obsynth prove-alarm``) wrote.

    Returns
    -------
    VerificationReport
        It fails where the file was changed, or the multipliers prove nothing.

    Raises
    ------
    SpecError
        The file is no certificate.
    """
    source = Path(path)
    content = read_json(source)
    if not is_certificate(content):
        raise SpecError(f"{source} is no certificate of an alarm.", path=str(source))
    body = content.get("certificate")
    if content.get("schema_version") != SCHEMA_VERSION or not isinstance(body, dict):
        raise SpecError(f"{source} has an unknown schema version.", path=str(source))
    intact = content.get("sha256") == digest_of(body)
    checks = [_row("digest", "the file is as it was written", float(intact), 1.0, intact)]
    try:
        checks += _checked(body)
    except (ObsynthError, KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        checks.append(_row("contents", f"the certificate can be read ({error})", 0.0, 1.0, False))
    return VerificationReport.of(checks)


def _checked(body: Mapping[str, Any]) -> list[Check]:
    data = restored({name: value for name, value in body.items() if name != "gain_set"})
    design = loaded(json.dumps(body["gain_set"]).encode(), "the certificate's gain set")
    plant, _ = design.linear
    u = np.asarray(data["u"], dtype=np.float64).reshape(-1, plant.nu)
    y = np.asarray(data["y"], dtype=np.float64).reshape(-1, plant.ny)
    bounds = np.asarray(data["bounds"], dtype=np.float64)
    question = Question.of(
        design, dict(zip(plant.disturbance_names, bounds.tolist(), strict=True)), data["noise_bound"],
        data["initial_set"], data["state_bounds"], data["window"],
    )  # fmt: skip
    programme, origin = question.programme(design, u, y)
    equal, below = np.asarray(data["equal"]), np.asarray(data["below"])
    fits = equal.shape == (len(programme.equal.right),) and below.shape == (len(programme.below.right),)
    margin = float(programme.proved_least(equal, below)) if fits else float("nan")
    said = statement(design, min(question.window, len(y)), origin)
    rows = len(y) == data["row"] and len(u) == len(y)
    stated = float(data["margin"])
    return [
        _row("rows", "the record ends at the stated row", float(rows), 1.0, rows),
        _row("statement", "the sentence is that of these bounds", float(said == data["statement"]), 1.0,
             said == data["statement"]),
        _row("proof", "least excess over all bounds, from the multipliers, in exact arithmetic", margin, 0.0,
             margin > 0.0, kind="proved"),
        _row("margin", "the stated margin is not above what is proved", stated, margin * (1.0 + SAME_MARGIN),
             bool(0.0 < stated <= margin * (1.0 + SAME_MARGIN))),
    ]  # fmt: skip


def _row(name: str, claim: str, value: float, bound: float, passed: bool, *, kind: Any = "computed") -> Check:
    source = "linear programme with safe dual bounds (Neumaier and Shcherbina 2004)"
    return Check(name, claim, value, bound, value - bound, bool(passed), source, kind)
