"""Proof files of random designs, checked without obsynth: all are accepted, and changed ones are refused.

A case is a random plant of two to eight states, sampled or continuous, with one or two faults, unknown inputs, noise
and for some algebraic states, and a design by one of the linear methods. Its proof file is checked by
`checker/check_proof.py`; then two changes are made to it, one at a time, each of which makes a claim false or its
proof wrong: a gain .9999 of the norm, a decay faster than the slowest pole, a threshold below the least, an entry of
plant or observer, an order of names. Wrong is a file of a verified design that is refused, or that proves nothing of
stability or thresholds, and a changed file that is accepted.
"""

from __future__ import annotations

import copy
import json
import warnings
from typing import Any

import numpy as np
from benchmarks.campaigns._changed_proofs import changes, checker
from benchmarks.campaigns.frame import Outcome

import obsynth
from obsynth.exporting.proof_file import proof_bytes, proof_of

CASES = 450
LIMIT = 300.0
METHODS = ("fault-estimation-filter", "pd-observer", "ui-pi-observer", "functional-filter", "detection-filter",
           "guaranteed-test")  # fmt: skip
#: Changes of each file.
CHANGES = 2
#: What a file must prove besides the identities.
NEEDED = {"guaranteed-test": {"threshold", "least"}}


def random_plant(rng: np.random.Generator, method: str) -> obsynth.DescriptorSystem:
    """Return a plant that the method may have an observer for."""
    nx = int(rng.integers(2, 9 if method != "optimal-filter" else 5))
    nf = int(rng.integers(1, 3)) if nx > 2 else 1
    nd = int(rng.integers(0, 2))
    ny = min(nx, nf + nd + int(rng.integers(0, 2)))
    continuous = method in ("pd-observer", "detection-filter") or (
        method in ("ui-pi-observer", "functional-filter", "optimal-filter") and rng.random() < 0.5
    )
    a = rng.standard_normal((nx, nx))
    a *= float(rng.uniform(0.3, 1.1)) / max(np.abs(np.linalg.eigvals(a)).max(), 1e-3)
    if continuous:
        a = a * float(rng.uniform(0.5, 5.0)) - np.eye(nx)
    e = np.eye(nx)
    if method in ("fault-estimation-filter", "guaranteed-test") and nx > 3 and rng.random() < 0.3:
        e[-1] = 0.0
        a[-1, -1] = -1.0
    bf = rng.standard_normal((nx, nf))
    bd = rng.uniform(0.1, 1.0) * rng.standard_normal((nx, nd))
    c = rng.standard_normal((ny, nx))
    noisy = method in ("detection-filter", "optimal-filter") or (
        rng.random() < 0.7 and method in ("functional-filter", "ui-pi-observer")
    )
    inner, outer = np.hstack([0.1 * np.eye(nx), np.zeros((nx, ny))]), np.hstack([np.zeros((ny, nx)), 0.3 * np.eye(ny)])
    return obsynth.DescriptorSystem(
        e, a, rng.standard_normal((nx, 1)), c, Bf=bf, Bd=bd, Bw=inner if noisy else None, Dw=outer if noisy else None,
        dt=0.0 if continuous else 0.1,
    )  # fmt: skip


def options_of(rng: np.random.Generator, method: str, plant: obsynth.DescriptorSystem) -> dict[str, Any]:
    """Return options for the method."""
    if method == "optimal-filter":
        return _of_optimal_filter(rng, plant)
    if method != "guaranteed-test":
        return {}
    return {
        "noise_bound": {name: float(rng.uniform(0.01, 0.2)) for name in plant.output_names},
        "disturbance_bounds": {name: float(rng.uniform(0.01, 0.5)) for name in plant.disturbance_names},
        "fault": plant.fault_names[0],
        "free": "none" if rng.random() < 0.5 else "others",
        "course": str(rng.choice(["constant", "any", "ramp", "step"])),
        "disturbance": str(rng.choice(["jump", "held"])),
        "norm": str(rng.choice(["box", "ellipsoid"])),
        "samples": 6 + plant.nx,
        "before": 4,
    }


def _of_optimal_filter(rng: np.random.Generator, plant: obsynth.DescriptorSystem) -> dict[str, Any]:
    def model() -> dict[str, Any]:
        pole = 0.4 if plant.dt else -1.0
        return {"A": [[pole]], "B": [[1.0]], "C": [[float(rng.uniform(0.1, 0.4))]], "D": [[1.0]]}

    options: dict[str, Any] = {}
    if rng.random() < 0.4:
        options["reference"] = {"bandwidth": float(rng.uniform(0.3, 3.0)), "order": int(rng.integers(1, 3))}
        options["exact"] = bool(rng.random() < 0.5)
    elif plant.dt:
        options["delay"] = int(rng.integers(1, 3))
    if rng.random() < 0.6:
        weights = {"errors": {"f1": model() if rng.random() < 0.5 else 2.0}}
        if rng.random() < 0.7:
            weights["inputs"] = {plant.noise_names[0]: model() if rng.random() < 0.5 else 0.5}
        options["weights"] = weights
    if plant.nd and rng.random() < 0.3:
        options["decoupled"] = plant.disturbance_names[0]
    return options


def case(seed: int) -> Outcome:
    """Design, export, check; change and check again."""
    return case_of(METHODS[seed % len(METHODS)], np.random.default_rng([46, seed]))


def case_of(method: str, rng: np.random.Generator) -> Outcome:
    """Draw a plant for a method; design, export, check; change and check again."""
    plant = random_plant(rng, method)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            design = obsynth.design(plant, method, **options_of(rng, method, plant))
        except (obsynth.PreconditionError, obsynth.SolverError, obsynth.InfeasibleError, obsynth.SpecError) as error:
            return Outcome(method, f"no design ({type(error).__name__})")
    if not design.report.passed:
        return Outcome(method, "not verified")
    proof, module = json.loads(proof_bytes(proof_of(design))), checker()
    verdicts, left = module.check(proof)
    refused = [f"{name}: {text}" for name, proved, text in verdicts if not proved]
    if refused:
        return Outcome(method, "refused", "; ".join(refused))
    missing = NEEDED.get(method, {"identities", "stable", "rounding"}) - {name for name, _, _ in verdicts}
    if missing and (plant.nx or design.linear[1].order):
        return Outcome(method, "incomplete", f"{', '.join(sorted(missing))} not proved: {'; '.join(left)}")
    found = list(changes(proof))
    for k in rng.choice(len(found), size=min(CHANGES, len(found)), replace=False):
        name, change = found[int(k)]
        changed = copy.deepcopy(proof)
        change(changed)
        if changed == proof:
            return Outcome(method, "nothing changed", name)
        if accepted(module, changed):
            return Outcome(method, "a changed file is accepted", name)
    return Outcome(method, f"accepted, {CHANGES} changed ones refused", value=float(len(verdicts)))


def accepted(module: Any, proof: dict[str, Any]) -> bool:
    """Whether the checker accepts a file."""
    try:
        verdicts, _ = module.check(proof)
    except (module.Refused, *module.UNREADABLE):
        return False
    return all(proved for _, proved, _ in verdicts)
