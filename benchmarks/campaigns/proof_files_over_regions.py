"""Proof files of random designs over a region, checked without obsynth: all are accepted, and changed ones refused.

A case is a random plant of two to four states with one or two scheduling parameters (two to four vertices), and a
scheduled fault-estimation filter, unknown-input PI observer (sampled or continuous) or Kalman filter for it.  Its proof
file is checked by `checker/check_proof.py`; then every change below is made to it, one at a time: a gain .9999 of what
a course between vertices reaches, a decay faster than the slowest pole of a vertex, a root mean square below that at
rest at a vertex, a matrix of plant or observer at a vertex, a vertex more.  Wrong is a file of a verified design that
is refused or lacks its decay, and a changed file that is accepted.  The mean is that of the number of claims.
"""

from __future__ import annotations

import copy
import json
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.linalg
from benchmarks.campaigns._changed_proofs import as_array, as_data, checker
from benchmarks.campaigns.frame import Outcome
from benchmarks.campaigns.proof_files import accepted

import obsynth
from obsynth.exporting.proof_file import proof_bytes, proof_of
from obsynth.verification.over_region import worst_switching

CASES = 90
LIMIT = 120.0  # s
METHODS = ("fault-estimation-filter", "ui-pi-observer", "descriptor-kalman")
#: How much of a number that is reached is claimed, where the claim is made false.
BELOW = 0.9999
#: What is added to a matrix at a vertex, as a share of the largest entry of A there: its own may be rounding.
CHANGE = 0.01
#: Samples of a course between vertices, and random courses from which it is improved.
HORIZON, STARTS = 20, 2
#: A case of a method of both times is continuous with this probability.
CONTINUOUS = 0.5

Change = Callable[[dict[str, Any]], None]


def random_plant(rng: np.random.Generator, method: str) -> obsynth.PolytopicSystem:
    """Return a plant for which the method may have an observer."""
    nx, parameters = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    continuous = method == "ui-pi-observer" and rng.random() < CONTINUOUS
    middle = rng.standard_normal((nx, nx))
    middle *= float(rng.uniform(0.3, 0.9)) / np.abs(np.linalg.eigvals(middle)).max()
    if continuous:
        middle = middle - np.eye(nx)
    moved = [0.2 * rng.standard_normal((nx, nx)) * (rng.random((nx, nx)) < 0.4) for _ in range(parameters)]
    for part in moved:
        # No parameter is without any entry.
        part[tuple(rng.integers(0, nx, 2))] = 0.2
    a: list[list[str]] = [
        [
            f"{float(middle[i, j])!r}" + "".join(f" + {float(part[i, j])!r} * p{k}" for k, part in enumerate(moved))
            for j in range(nx)
        ]
        for i in range(nx)
    ]
    ny = min(nx, 2 + int(rng.integers(0, 2)))
    plant: dict[str, Any] = {"A": a, "C": rng.standard_normal((ny, nx)).tolist(), "dt": 0.0 if continuous else 0.1}
    if method == "descriptor-kalman":
        plant["Bw"] = np.hstack([0.1 * np.eye(nx), np.zeros((nx, ny))]).tolist()
        plant["Dw"] = np.hstack([np.zeros((ny, nx)), 0.2 * np.eye(ny)]).tolist()
    else:
        plant["Bf"] = rng.standard_normal((nx, 1)).tolist()
    if method == "fault-estimation-filter":
        plant["Bd"] = rng.standard_normal((nx, 1)).tolist()
    return obsynth.PolytopicSystem(plant=plant, scheduling={f"p{k}": [-1.0, 1.0] for k in range(parameters)})


def changes(file: dict[str, Any], observer: Any) -> Iterator[tuple[str, Change]]:
    """Yield changes by which a claim becomes false, or its proof another one's."""
    errors = list(_errors(file, observer))
    sampled = bool(as_array(file["plant"]["sample_time"]).item())
    for place, claim in enumerate(file["claims"]):
        if claim["claim"] == "decay over the region":
            poles = [np.linalg.eigvals(part[0]) for part in errors]
            slowest = max(np.abs(each).max() for each in poles) if sampled else max(each.real.max() for each in poles)
            yield "a faster decay", _number(place, "rate", BELOW * slowest if sampled else -slowest / BELOW)
        if claim["claim"] == "gain over the region" and sampled:
            reached = worst_switching(errors, horizon=HORIZON, starts=STARTS)
            yield "a smaller gain", _number(place, "gamma", BELOW * reached)
        if claim["claim"] == "mean square over the region":
            yield "a smaller mean square", _number(place, "level", BELOW * max(map(_at_rest, errors)))
    for kind, name in (("plant", "A"), ("observer", "Az"), ("observer", "By")):
        yield f"{name} of a vertex", _matrix(kind, name)
    yield "a vertex more", _vertex_more


def _errors(file: dict[str, Any], observer: Any) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield M, B, c and d of ``e+ = M e + B s``, ``r = c e + d s`` at each vertex, s what a claim is about."""
    T, nx = as_array(file["follows"]["T"]), len(as_array(file["plant"]["E"]))
    kalman = not observer.fault_names
    rows = observer.state_rows if kalman else observer.fault_rows
    cz, dy = as_array(file["observer"]["Cz"])[rows], as_array(file["observer"]["Dy"])[rows]
    for vertex in file["vertices"]:
        az, by = (as_array(vertex["observer"][name]) for name in ("Az", "By"))
        if T.shape[1] > nx:
            b, d = T[:, nx:], np.zeros((len(cz), T.shape[1] - nx))
        else:
            letter = "w" if kalman else "d"
            into, seen = as_array(vertex["plant"][f"B{letter}"]), as_array(file["plant"][f"D{letter}"])
            b, d = T @ into - by @ seen, dy @ seen
        yield az, b, -cz, d


def _at_rest(part: tuple[np.ndarray, ...]) -> float:
    az, b, c, d = part
    covariance = scipy.linalg.solve_discrete_lyapunov(az, b @ b.T)
    return float(np.sqrt(np.trace(c @ covariance @ c.T + d @ d.T)))


def _number(place: int, name: str, value: float) -> Change:
    return lambda file: file["claims"][place].update({name: as_data([[value]])})


def _matrix(kind: str, name: str) -> Change:
    def change(file: dict[str, Any]) -> None:
        vertex = file["vertices"][-1]
        added = CHANGE * np.abs(as_array(vertex["plant"]["A"])).max()
        vertex[kind][name] = as_data(as_array(vertex[kind][name]) + added)

    return change


def _vertex_more(file: dict[str, Any]) -> None:
    file["vertices"].append(copy.deepcopy(file["vertices"][0]))


def case(seed: int) -> Outcome:
    """Design, export, check; change and check again."""
    method, rng = METHODS[seed % len(METHODS)], np.random.default_rng([50, seed])
    plant = random_plant(rng, method)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            design = obsynth.design(plant, method)
        except (obsynth.PreconditionError, obsynth.SolverError, obsynth.InfeasibleError) as error:
            return Outcome(method, f"no design ({type(error).__name__})")
    file, module = json.loads(proof_bytes(proof_of(design))), checker()
    verdicts, left = module.check(file)
    refused = [f"{name}: {text}" for name, proved, text in verdicts if not proved]
    if refused:
        return Outcome(method, "refused", "; ".join(refused))
    if "decay over the region" not in {name for name, _, _ in verdicts}:
        return Outcome(method, "incomplete", "; ".join(left))
    for name, change in changes(file, design.observer):
        changed = copy.deepcopy(file)
        change(changed)
        if changed == file:
            return Outcome(method, "nothing changed", name)
        if accepted(module, changed):
            return Outcome(method, "a changed file is accepted", name)
    return Outcome(method, "accepted, changed ones refused", value=float(len(verdicts)))
