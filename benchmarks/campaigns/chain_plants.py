"""Constants that vary against every way of a plant: no threshold is passed, and no healthy window is proved faulty.

A case is a plant of two or three states with one or two constants anywhere in E, A, B, C and Bf, constant or varying,
that goes one way: as written, eliminated (before the design, or by the method itself), sampled, eliminated and
sampled, linearised and sampled, with a fault that became a state, in other states (balanced), or decoupled. Six
healthy records of the plant as written are made with numpy alone, at corners, inside, and along paths: corners or
values drawn at each sample, slow walks, one switch. Disturbance and start keep their bounds. A threshold that is
passed, a guaranteed interval without zero and a window that is proved faulty are wrong. What lost its tolerances must
refuse.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pandas as pd
from benchmarks.campaigns.frame import Outcome

import obsynth
from obsynth.plants.constants import constants_box

CASES = 2000
LIMIT = 120.0
WAYS = ("as written", "eliminated", "eliminated by the method", "sampled", "eliminated and sampled",
        "linearised and sampled", "a fault as state", "balanced", "decoupled")  # fmt: skip
METHODS = ("fault-estimation-filter", "ui-pi-observer", "functional-filter")
PATHS = ("corner", "inside", "corners", "values", "walk", "switch")
STEPS, STEP, DISTURBANCE, START = 40, 0.1, 0.1, 0.2


class Truth:
    """A plant as rows of numbers and texts, and its matrices at values of the constants, by numpy alone."""

    def __init__(self, rng: np.random.Generator, way: str) -> None:
        self.way, self.smooth = way, way in ("sampled", "eliminated and sampled", "linearised and sampled")
        self.algebraic = int("eliminated" in way or way == "linearised and sampled")
        self.n = int(rng.integers(1, 3)) + self.algebraic + int(way in ("balanced", "a fault as state", "decoupled"))
        self.nf = 2 if way == "a fault as state" else 1
        n, dynamic = self.n, self.n - self.algebraic
        self.names = ["p", "q"][: int(rng.integers(1, 3))]
        self.half = float(rng.uniform(0.01, 0.08))
        a = rng.uniform(-0.2, 0.2, (n, n)) + np.diag(rng.uniform(0.3, 0.9, n))
        if self.smooth:
            a = rng.uniform(-0.5, 0.5, (n, n)) - np.diag(rng.uniform(1.0, 3.0, n))
        if self.algebraic:
            a[-1] = rng.uniform(0.2, 1.0, n)
            a[-1, -1] = -1.0
        e = np.eye(n)
        e[dynamic:] = 0.0
        b, bf, bd = rng.uniform(0.5, 1.5, (n, 1)), np.eye(n)[:, : self.nf], rng.uniform(0.0, 0.3, (n, 1))
        if bf.shape[1] < self.nf:
            bf = np.hstack([bf, np.ones((n, self.nf - bf.shape[1]))])
        bf[dynamic:] = 0.0
        unknown = way == "decoupled" or (rng.random() < 0.6 and way != "a fault as state")
        bd = bd if unknown else np.zeros((n, 0))
        c = (np.eye(n) + rng.choice([0.0, 0.3]) * rng.uniform(-1.0, 1.0, (n, n)))[:dynamic]
        self.numbers = {"E": e, "A": a, "B": b, "C": c, "Bf": bf, "Bd": bd}
        self.entries: dict[str, list[tuple[int, int, str]]] = {}
        places = [("A", int(rng.integers(n)), int(rng.integers(n))), ("B", int(rng.integers(n)), 0)]
        if rng.random() < 0.5:
            i = int(rng.integers(dynamic))
            places += [("E", i, i)]
        if rng.random() < 0.3:
            places += [("C", 0, 0)]
        if self.algebraic:
            places += [("A", n - 1, int(rng.integers(n - 1)))]
        if rng.random() < 0.2 and self.nf == 1:
            places += [("Bf", 0, 0)]
        for place, (name, i, j) in enumerate(dict.fromkeys(places)):
            own = self.names[-place if place < len(self.names) else int(rng.integers(len(self.names)))]
            self.entries.setdefault(name, []).append((i, j, own))

    def at(self, values: dict[str, float]) -> dict[str, np.ndarray]:
        """Return all matrices."""
        found = {name: matrix.copy() for name, matrix in self.numbers.items()}
        for name, entries in self.entries.items():
            for i, j, constant in entries:
                found[name][i, j] = self.numbers[name][i, j] * values[constant]
        return found

    def plant(self, variation: str) -> Any:
        """Return the plant with tolerances, as it is written."""
        rows: dict[str, Any] = {name: matrix.tolist() for name, matrix in self.numbers.items()}
        for name, entries in self.entries.items():
            for i, j, constant in entries:
                rows[name][i][j] = f"{float(self.numbers[name][i, j])!r} * {constant}"
        if not self.numbers["Bd"].size:
            del rows["Bd"]
        constants = {name: {"nominal": 1.0, "tolerance": self.half} for name in self.names}
        return obsynth.uncertain_system({**rows, "dt": 0.0 if self.smooth else 1.0}, constants, variation=variation)

    def record(self, path: list[dict[str, float]], rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return known inputs and outputs of a healthy run along a path of the constants."""
        from scipy.linalg import expm

        dynamic, nd = self.n - self.algebraic, self.numbers["Bd"].shape[1]
        u, d = rng.uniform(-1.0, 1.0, (STEPS, 1)), DISTURBANCE * rng.choice([-1.0, 1.0], (STEPS, nd))
        x, y = rng.uniform(-START, START, dynamic), np.empty((STEPS, dynamic))
        for k in range(STEPS):
            now = self.at(path[k])
            whole = x
            if self.algebraic:
                rest = now["A"][dynamic:, :dynamic] @ x + now["B"][dynamic:] @ u[k] + now["Bd"][dynamic:] @ d[k]
                whole = np.concatenate([x, -np.linalg.solve(now["A"][dynamic:, dynamic:], rest)])
            y[k] = now["C"] @ whole
            rate = (now["A"] @ whole + now["B"] @ u[k] + now["Bd"] @ d[k])[:dynamic]
            if not self.smooth:
                if k + 1 < STEPS:
                    x = np.linalg.solve(self.at(path[k + 1])["E"][:dynamic, :dynamic], rate)
                continue
            # Inputs are held; algebraic states follow at once.
            a = now["A"][:dynamic, :dynamic]
            if self.algebraic:
                a = a - now["A"][:dynamic, dynamic:] @ np.linalg.solve(
                    now["A"][dynamic:, dynamic:], now["A"][dynamic:, :dynamic]
                )
            inverse = np.linalg.inv(now["E"][:dynamic, :dynamic])
            slope, matrix = inverse @ rate, inverse @ a
            block = np.zeros((dynamic + 1, dynamic + 1))
            block[:dynamic, :dynamic], block[:dynamic, dynamic] = matrix, slope
            x = x + expm(block * STEP)[:dynamic, dynamic]
        return u, y


def _path(kind: str, names: list[str], half: float, rng: np.random.Generator) -> list[dict[str, float]]:
    """Return values of the constants at each sample."""
    m = len(names)
    if kind in ("corner", "inside"):
        one = rng.choice([-1.0, 1.0], m) if kind == "corner" else rng.uniform(-1.0, 1.0, m)
        q = np.tile(one, (STEPS, 1))
    elif kind in ("corners", "values"):
        q = rng.choice([-1.0, 1.0], (STEPS, m)) if kind == "corners" else rng.uniform(-1.0, 1.0, (STEPS, m))
    elif kind == "walk":
        q = np.clip(np.cumsum(rng.uniform(-0.3, 0.3, (STEPS, m)), axis=0), -1.0, 1.0)
    else:
        q = np.ones((STEPS, m))
        q[: int(rng.integers(5, STEPS - 5))] = -1.0
    return [dict(zip(names, 1.0 + half * row, strict=True)) for row in q]


def _along(way: str, truth: Truth, variation: str) -> Any:
    """Return the plant after it went its way."""
    plant = truth.plant(variation)
    if way == "eliminated":
        return obsynth.eliminate_algebraic_states(plant).plant
    if way in ("sampled", "eliminated and sampled"):
        return obsynth.discretise(plant, STEP).plant
    if way == "a fault as state":
        from obsynth.plants.transformations.fault_states import augment_faults

        return augment_faults(plant, plant.fault_names[1:]).plant
    if way == "balanced":
        scale = np.diag(2.0 ** np.arange(truth.n))
        back = np.linalg.inv(scale)
        return plant.replace(
            **{name: back @ getattr(plant, name) @ scale for name in ("E", "A")}, C=plant.C @ scale,
            **{name: back @ getattr(plant, name) for name in ("B", "Bf", "Bd")},
        )  # fmt: skip
    if way == "linearised and sampled":
        return obsynth.discretise(_linearised(truth, variation), STEP).plant
    return plant


def _linearised(truth: Truth, variation: str) -> Any:
    """Return the linear model of the same plant written as equations."""
    n, dynamic = truth.n, truth.n - truth.algebraic
    entries = {(name, i, j): constant for name, found in truth.entries.items() for i, j, constant in found}

    def term(name: str, i: int, j: int, signal: str) -> str:
        value = float(truth.numbers[name][i, j])
        constant = entries.get((name, i, j))
        return f"({value!r}) * {signal}" + (f" * {constant}" if constant else "")

    def row(i: int, matrices: tuple[str, ...]) -> str:
        signals = {"A": "x", "C": "x", "B": "u", "Bf": "f", "Bd": "d"}
        return " + ".join(
            term(name, i, j, f"{signals[name]}{j + 1}")
            for name in matrices
            for j in range(truth.numbers[name].shape[1])
        )

    unknown = [f"d{j + 1}" for j in range(truth.numbers["Bd"].shape[1])]
    equations = {}
    for i in range(n):
        left = f"der(x{i + 1}) * {entries.get(('E', i, i), '1.0')}" if i < dynamic else "0"
        equations[f"row {i + 1}"] = f"{left} = {row(i, ('A', 'B', 'Bf', 'Bd'))}"
    model = obsynth.DAEModel(
        equations,
        {f"y{i + 1}": row(i, ("C",)) for i in range(dynamic)},
        states={f"x{i + 1}": 0.0 for i in range(n)},
        inputs=dict.fromkeys(["u1", *unknown], 0.0),
        parameters={"f1": 0.0},
        constants=dict.fromkeys(truth.names, 1.0),
    )
    box = constants_box({name: {"nominal": 1.0, "tolerance": truth.half} for name in truth.names}, variation=variation)
    return obsynth.linearise(model, faults=["f1"], disturbances=unknown, constants=box)


def case(seed: int) -> Outcome:
    """Run one case."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return _case(np.random.default_rng([seed + 3000, 37]))


def _case(rng: np.random.Generator) -> Outcome:
    way = WAYS[int(rng.integers(len(WAYS)))]
    variation = "varying" if rng.random() < 0.7 else "constant"
    truth = Truth(rng, way)
    # Two of the methods take the unknown input out; the last one estimates no state, and has no bound over a box.
    method = str(rng.choice(METHODS, p=(0.0, 0.95, 0.05) if way == "decoupled" else (0.5, 0.45, 0.05)))
    try:
        design = obsynth.design(_along(way, truth, variation), method)
    except obsynth.ObsynthError as error:
        return Outcome(way, f"no design ({type(error).__name__})")
    return _healthy(design, truth, variation, way, rng)


def _healthy(design: Any, truth: Truth, variation: str, way: str, rng: np.random.Generator) -> Outcome:
    made_plant, _ = design.linear
    bounds = dict.fromkeys(made_plant.disturbance_names, DISTURBANCE)
    moving = np.abs(made_plant.E).max(axis=0) > 0.0
    start = {name: START if moving[i] else 50.0 for i, name in enumerate(made_plant.state_names)}
    asked = {"disturbance_bounds": bounds, "initial_set": start, "noise_bound": 0.0 if made_plant.nw else None}
    carried = made_plant.uncertainty is not None and not made_plant.uncertainty.lost
    try:
        watched = obsynth.online_monitor(design, **asked)
    except obsynth.ObsynthError as error:
        wrong = "" if isinstance(error, (obsynth.PreconditionError, obsynth.SpecError)) else repr(error)
        return Outcome(way, "refused" if carried else "refused (tolerances lost)", wrong)
    if not carried:
        return Outcome(way, "wrong", "a plant that lost its tolerances has thresholds")
    for kind in PATHS if variation == "varying" else PATHS[:2]:
        u, y = truth.record(_path(kind, truth.names, truth.half, rng), rng)
        names = [*made_plant.input_names, *made_plant.output_names]
        data = pd.DataFrame(np.hstack([u, y]), columns=names).assign(time=made_plant.dt * np.arange(STEPS))
        table = obsynth.run_on_data(design, data, monitor=watched, warm_up=0.0).table
        if (table["statistic"] > table["threshold"]).any() or table["alarm"].fillna("").astype(str).str.len().any():
            return Outcome(way, "wrong", f"{kind}, {variation}: a threshold is passed")
        for fault in made_plant.fault_names:
            if f"lowest {fault}" in table and ((table[f"lowest {fault}"] > 0) | (table[f"highest {fault}"] < 0)).any():
                return Outcome(way, "wrong", f"{kind}, {variation}: an interval of {fault} excludes zero")
        found = obsynth.prove_alarm(design, data, int(rng.integers(12, STEPS)), window=6, **asked)
        if found.proved:
            return Outcome(way, "wrong", f"{kind}, {variation}: a healthy window is proved faulty")
    return Outcome(way, "healthy")
