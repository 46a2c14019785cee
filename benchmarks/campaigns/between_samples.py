"""Sampled plants against their continuous simulation, with disturbances that jump inside samples at the worst times.

Random plants in continuous time, slow, fast, stiff and oscillating, with one to three disturbances, with and without
feedthrough, sampled at a tenth to three of their time constants.  The course of each disturbance has the sign that
hurts most in each of many parts of a sample, for the largest time that is looked at; the simulation is that of the
plant as written, exact for such courses, and no code of obsynth.  No threshold may be passed by more than rounding, no
fault-free record may be proved faulty, and no guaranteed test has a threshold more than 1.05 times its worst course.
A case is one plant: a guaranteed test (a step, a constant fault, or a test over tolerances), the fault-estimation
filter with its monitor, from a known start and over tolerances, and proofs of alarms of both.  Of held disturbances the
test has a threshold of at most ``least`` of those that move.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from benchmarks.campaigns.frame import Outcome
from scipy.linalg import expm

import obsynth as ob

CASES = 500
LIMIT = 240.0  # s
#: Parts of a sample in which a course has one sign; samples of a record.
PARTS, RECORD = 64, 24
#: What rounding may add, as a share; how far a threshold of a guaranteed test may be above its worst course.
ROUNDING, TIGHT = 1e-9, 1.05
KINDS = ("slow", "oscillating", "stiff", "integrating")


class Plant(NamedTuple):
    """A plant as written, sampled, and the numbers that it is made of."""

    kind: str
    written: ob.DescriptorSystem
    sampled: ob.DescriptorSystem
    dt: float
    noise: float


def plant_of(seed: int) -> Plant:
    """Return the plant of a case."""
    rng = np.random.default_rng([seed, 46])
    kind, n, nd = KINDS[seed % len(KINDS)], int(rng.integers(2, 5)), int(rng.integers(1, 4))
    a = rng.standard_normal((n, n))
    if kind == "oscillating":
        a = 4.0 * (a - a.T) - 0.2 * np.eye(n)
    elif kind == "stiff":
        a *= np.logspace(0.0, rng.uniform(1.0, 3.0), n)[:, None]
    a -= (np.max(np.linalg.eigvals(a).real) + 0.2) * np.eye(n)
    if kind == "integrating":
        a = np.block([[a[:-1, :-1], np.zeros((n - 1, 1))], [rng.standard_normal((1, n - 1)), np.zeros((1, 1))]])
        a[:-1, :-1] -= max(0.0, float(np.max(np.linalg.eigvals(a[:-1, :-1]).real)) + 0.2) * np.eye(n - 1)
    noise = float(10.0 ** rng.uniform(-4.0, -1.0))
    direct = rng.choice([0.0, 0.3]) * rng.standard_normal((n, nd))
    written = ob.DescriptorSystem(
        A=a, B=rng.standard_normal((n, 1)), C=np.eye(n), Bf=np.eye(n)[:, :1], Bd=rng.standard_normal((n, nd)),
        Dd=direct, Bw=np.zeros((n, n)), Dw=noise * np.eye(n),
    )  # fmt: skip
    speed = float(np.median(np.abs(np.linalg.eigvals(a)[np.abs(np.linalg.eigvals(a)) > 1e-9])))
    dt = float(10.0 ** rng.uniform(-1.0, 0.5)) / speed
    return Plant(kind, written, ob.discretise(written, dt).plant, dt, noise)


def kernels(plant: Plant, samples: int) -> np.ndarray:
    """Return outputs ``(samples, PARTS + 1, nd, ny)`` at samples 0, 1, ... for a disturbance of one in one part of the
    first sample alone; the last part is its value at sample 0, which outputs show at once."""
    written = plant.written
    n, nd = written.nx, written.nd
    whole = expm(np.block([[written.A, written.Bd], [np.zeros((nd, n + nd))]]) * plant.dt / PARTS)
    step, moved = whole[:n, :n], expm(written.A * plant.dt)
    pushes = [whole[:n, n:]]
    while len(pushes) < PARTS:
        pushes.append(step @ pushes[-1])
    states, found = np.array(pushes[::-1]), np.zeros((samples, PARTS + 1, nd, written.ny))
    found[0, PARTS] = written.Dd.T
    for k in range(1, samples):
        found[k, :PARTS] = np.einsum("yx,pxd->pdy", written.C, states)
        states = np.einsum("xz,pzd->pxd", moved, states)
    return found


def record(plant: Plant, kernel: np.ndarray, signs: np.ndarray, noise: np.ndarray) -> pd.DataFrame:
    """Return a log without faults, from rest, for signs ``(samples, PARTS + 1, nd)`` of disturbances within one."""
    steps = len(noise)
    y = noise.copy()
    for k in range(steps):
        for first in range(k + 1):
            y[k] += np.einsum("pd,pdy->y", signs[first], kernel[k - first])
    data = pd.DataFrame(y, columns=list(plant.written.output_names))
    data.insert(0, "u1", np.zeros(steps))
    data.insert(0, "time", plant.dt * np.arange(steps))
    return data


def case(seed: int) -> Outcome:
    """Look at one plant."""
    plant, rng = plant_of(seed), np.random.default_rng([seed, 47])
    look = (_of_a_test, _of_a_filter, _over_tolerances)[(seed // len(KINDS)) % 3]
    try:
        return look(plant, rng)
    except (ob.PreconditionError, ob.InfeasibleError, ob.SolverError, ob.VerificationError):
        # Nothing is shipped, and nothing claimed: modes that decay by 1e-10 in a sample leave rounding alone.
        return Outcome(plant.kind, "no design")


def _of_a_test(plant: Plant, rng: np.random.Generator) -> Outcome:
    """A guaranteed test: worst windows, records that no proof may call faulty, and held disturbances."""
    step = rng.random() < 0.5
    asked: dict[str, Any] = {"disturbance_bounds": 1.0, "noise_bound": 3.0}
    asked |= {"course": "step", "before": 3, "after": 3} if step else {"course": "constant", "samples": 6}
    if rng.random() < 0.3:
        asked["exact"] = True
    test = ob.guaranteed_test(plant.sampled, **asked)
    held = ob.guaranteed_test(plant.sampled, **asked, disturbance="jump")
    samples, ny = test.samples, plant.written.ny
    kernel = kernels(plant, samples)
    ones = np.eye(samples * ny).reshape(-1, samples, ny)
    idle = np.zeros((samples, 1))
    weights = np.array([float(test.residual(test.observer.run(y, idle))[-1]) for y in ones]).reshape(samples, ny)
    # What each part of each sample does to the last row: of its own course the worst is that of its signs.
    effects = np.array([
        np.einsum("ky,kpdy->pd", weights[first:], kernel[: samples - first]) for first in range(samples)
    ])  # fmt: skip
    most = 3.0 * plant.noise
    worst = float(np.abs(effects).sum() + most * np.abs(weights).sum())
    if worst > test.threshold * (1.0 + ROUNDING):
        return Outcome(plant.kind, "test", f"worst course {worst:.9g}, threshold {test.threshold:.9g}")
    if not held.threshold * (1.0 - ROUNDING) <= test.least <= test.threshold:
        return Outcome(plant.kind, "test", f"least {test.least:.9g}, held {held.threshold:.9g}")
    data = record(plant, kernel, np.sign(effects), most * np.sign(weights))
    if ob.prove_alarm(test, data, samples).proved:
        return Outcome(plant.kind, "test", "a fault-free record is proved faulty")
    found = ob.run_on_data(test, data, monitor=ob.online_monitor(test))
    if found.alarms.get("pointwise"):
        return Outcome(plant.kind, "test", "a fault-free record alarms")
    if test.threshold > TIGHT * worst:
        return Outcome(plant.kind, "test", f"threshold {test.threshold:.6g} for a worst course of {worst:.6g}")
    return Outcome(plant.kind, "test", value=test.threshold / worst)


def _of_a_filter(plant: Plant, rng: np.random.Generator) -> Outcome:
    """The monitor of a filter at its worst sample, and proofs of alarms from a known start."""
    design = ob.fault_estimation_filter(plant.sampled)
    bounds = dict.fromkeys(plant.written.disturbance_names, 1.0)
    kernel, observer = kernels(plant, RECORD), design.linear[1]
    at = int(rng.integers(RECORD // 2, RECORD))
    signs, noise = _worst_record(plant, kernel, observer, at, rng)
    data = record(plant, kernel, signs, noise)
    start = dict.fromkeys(plant.sampled.state_names, 0.0)
    shares = []
    for given in ({"initial_error": 0.0}, {"initial_set": start}):
        watched = ob.online_monitor(design, disturbance_bounds=bounds, noise_bound=3.0, **given)
        if "move within their bounds between samples" not in watched.statement:
            return Outcome(plant.kind, "filter", f"says nothing of moving disturbances: {watched.statement}")
        share = _share(design, data, watched)
        if not share <= 1.0 + ROUNDING:
            return Outcome(plant.kind, "filter", f"{share:.9g} of the threshold, {given}")
        shares.append(share)
    proof = ob.prove_alarm(
        design, data, at + 1, window=6, disturbance_bounds=bounds, noise_bound=3.0, initial_set=start
    )
    if proof.proved:
        return Outcome(plant.kind, "filter", "a fault-free record is proved faulty")
    return Outcome(plant.kind, "filter", value=1.0 / max(shares))


def _over_tolerances(plant: Plant, rng: np.random.Generator) -> Outcome:
    """A filter for a plant with constants within 3 %: the true plant is at a corner."""
    written, n = plant.written, plant.written.nx
    entry = [[f"a{i}{j}" if i == j else float(written.A[i, j]) for j in range(n)] for i in range(n)]
    constants = {
        f"a{i}{i}": {"nominal": float(written.A[i, i]), "tolerance": "3 %"} for i in range(n) if written.A[i, i] != 0.0
    }
    for i in range(n):
        entry[i][i] = entry[i][i] if f"a{i}{i}" in constants else 0.0
    matrices = {name: getattr(written, name).tolist() for name in ("B", "C", "Bf", "Bd", "Dd", "Bw", "Dw")}
    uncertain = ob.uncertain_system({"A": entry, **matrices}, constants)
    design = ob.fault_estimation_filter(ob.discretise(uncertain, plant.dt).plant)
    corner = written.A.copy()
    for i in range(n):
        corner[i, i] *= 1.0 + 0.03 * float(rng.choice([-1.0, 1.0]))
    real = plant._replace(written=written.replace(A=corner))
    kernel = kernels(real, RECORD)
    signs, noise = _worst_record(real, kernel, design.linear[1], RECORD - 1, rng)
    data = record(real, kernel, signs, noise)
    bounds, start = dict.fromkeys(written.disturbance_names, 1.0), dict.fromkeys(design.linear[0].state_names, 0.0)
    watched = ob.online_monitor(
        design, disturbance_bounds=bounds, noise_bound=3.0, initial_set=start, constants=design.linear[0].uncertainty
    )
    share = _share(design, data, watched)
    if not share <= 1.0 + ROUNDING:
        return Outcome(plant.kind, "tolerances", f"{share:.9g} of the threshold")
    proof = ob.prove_alarm(
        design, data, RECORD, window=5, disturbance_bounds=bounds, noise_bound=3.0, initial_set=start
    )
    if proof.proved:
        return Outcome(plant.kind, "tolerances", "a fault-free record is proved faulty")
    return Outcome(plant.kind, "tolerances")


def _share(design: ob.ObserverDesign, data: pd.DataFrame, watched: Any) -> float:
    """Return the largest share of the threshold that a run reaches at any row; NaN where one has none."""
    table = ob.run_on_data(design, data, monitor=watched, warm_up=0.0).table
    return float(np.max((table["statistic"] / table["threshold"]).to_numpy(dtype=float)))


def _worst_record(
    plant: Plant, kernel: np.ndarray, observer: Any, at: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return signs of disturbances, and noise, that add up in one direction of what is watched at one sample."""
    ny, rows = plant.written.ny, slice(None)
    rows = observer.residual_rows if rng.random() < 0.5 and observer.residual_names else observer.fault_rows
    watched = observer.Cz[rows], observer.Dy[rows]
    direction = rng.standard_normal(len(watched[0]))
    # Weights of the outputs of each sample in the row at the last one.
    weights, state = np.zeros((RECORD, ny)), direction @ watched[0]
    weights[at] = direction @ watched[1]
    for k in range(at - 1, -1, -1):
        weights[k], state = state @ observer.By, state @ observer.Az
    signs = np.zeros((RECORD, PARTS + 1, plant.written.nd))
    for first in range(at + 1):
        signs[first] = np.sign(np.einsum("ky,kpdy->pd", weights[first : at + 1], kernel[: at + 1 - first]))
    return signs, 3.0 * plant.noise * np.sign(weights)
