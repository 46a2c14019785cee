"""Thresholds over the tolerances of wang2015 (2 % of each entry of A) and drive (5 % of each constant).

A case of `constant` is 20 runs of one design without a fault: plants of the box, half of them drawn, half at vertices
by the sign of each constant's effect; disturbances and noise half random, half at their bounds with the sign that
drives one output at one sample.  The plants are exact (made anew with numpy from the constants, not from the family),
and a run counts as wrong if any threshold is passed at any sample.  `varying` draws the constants anew at each sample;
`faults` has a step of three median thresholds, whose guaranteed intervals must hold at each sample.  `windows` are
windows without a fault, none of which may be proved faulty; the last cases are windows with a fault of 0.05 on
wang2015, each of which must be proved, and its certificate hold.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.campaigns.frame import Outcome
from scipy.linalg import expm

import obsynth
from obsynth.experiments.alarm_proofs.certificate import verify_alarm
from obsynth.experiments.alarm_proofs.proof import proved_alarm
from obsynth.experiments.monitors.adaptive_monitor import adaptive_plan
from obsynth.experiments.monitors.adaptive_rule import record_columns
from obsynth.spec import load_spec

#: For each design 100 cases of 20 runs, 10 of varying constants, 8 of faults and 50 of 10 windows; then 12 proofs.
CASES = 2 * 168 + 12
LIMIT = 300.0
RUNS, STEPS = 20, 200
DESIGNS = Path(__file__).parents[2] / "designs"
NAMES = ("wang2015", "drive")
#: Bounds of the disturbance, of the noise in deviations, and of the states at the start.
BOUNDS = {"wang2015": (0.1, 0.0, [0.2, 0.2, 0.2, 50.0]), "drive": (0.2, 3.0**0.5, [0.2, 0.2, 0.2])}  # fmt: skip


@cache
def made(name: str, variation: str) -> tuple[Any, Any]:
    """Return a design and its plan."""
    spec = load_spec(DESIGNS / name / "spec.yaml")
    plant = obsynth.uncertain_system(spec.plant, variation=variation)
    design = obsynth.design(plant, spec.method, **dict(spec.options))
    dbar, noise, start = BOUNDS[name]
    states = dict(zip(plant.state_names, start, strict=True))
    return design, adaptive_plan(design, np.array([dbar]), noise, initial_error=None, initial_set=states)[0]


def exact(plant: Any, q: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return ``A, B, Bf, Bd, C, D, Df, Dd`` of the plant at q, reduced and sampled by numpy."""
    uncertain = plant.uncertainty
    numbers = uncertain.written or {
        name: getattr(plant, name) for name in ("E", "A", "B", "C", "D", "Bf", "Df", "Bd", "Dd")
    }
    m = uncertain.filled(numbers, uncertain.box.values(q))
    moving = np.abs(numbers["E"]).any(axis=0)
    rows = np.abs(numbers["E"]).any(axis=1)
    inputs = np.hstack([m["B"], m["Bf"], m["Bd"]])
    direct = np.hstack([m["D"], m["Df"], m["Dd"]])
    x = -np.linalg.solve(m["A"][~rows][:, ~moving], np.hstack([m["A"][~rows][:, moving], inputs[~rows]]))
    n = int(moving.sum())
    top = np.hstack([m["A"][rows][:, moving], inputs[rows]]) + m["A"][rows][:, ~moving] @ x
    top = np.linalg.solve(m["E"][rows][:, moving], top)
    out = np.hstack([m["C"][:, moving], direct]) + m["C"][:, ~moving] @ x
    step = next((size for kind, size in uncertain.steps if kind == "sample"), None)
    if step is not None:
        block = np.zeros((top.shape[1], top.shape[1]))
        block[:n] = top
        top = expm(block * step)[:n]
    ends = np.cumsum([n, plant.nu, plant.nf])
    return (*np.split(top, ends, axis=1), *np.split(out, ends, axis=1))


def simulated(name: str, q: np.ndarray, signals: dict[str, np.ndarray], x0: np.ndarray) -> np.ndarray:
    """Return outputs of one run; ``q (p,)`` or one for each sample ``(steps, p)``."""
    plant = made(name, "constant")[0].plant
    fixed = exact(plant, q) if q.ndim == 1 else None
    x, y = x0.copy(), np.empty((STEPS, plant.ny))
    for k in range(STEPS):
        a, b, bf, bd, c, d, df, dd = fixed if fixed is not None else exact(plant, q[k])
        u, f, w, v = (signals[key][k] for key in ("u", "f", "d", "v"))
        y[k] = c @ x + d @ u + df @ f + dd @ w + v
        x = a @ x + b @ u + bf @ f + bd @ w
    return y


def inputs_of(name: str, rng: np.random.Generator) -> np.ndarray:
    """Return known inputs of a run."""
    k = np.arange(STEPS)[:, None]
    if name == "wang2015":
        return 2.0 * np.sin(np.hstack([k, k])) if rng.random() < 0.5 else rng.uniform(-2.0, 2.0, (STEPS, 2))
    if name == "drive":
        return np.sign(np.sin(2.0 * np.pi * k / 100.0)) + rng.uniform(-0.5, 0.5, (STEPS, 1)) * (rng.random() < 0.5)
    return np.zeros((STEPS, 0))


def aimed(name: str, signals: dict[str, np.ndarray], rng: np.random.Generator) -> tuple[int, int, float]:
    """Put disturbance and noise at their bounds, with the signs that drive one output at one sample."""
    design, plan = made(name, "constant")
    observer, plant = design.observer, design.plant
    dbar, noise, _ = BOUNDS[name]
    target = int(rng.integers(STEPS // 3, STEPS))
    row = int(rng.integers(plan.bound.counts[4]))
    sign = float(rng.choice([-1.0, 1.0]))
    rest = plan.bound.structure.disturbances.center
    inner, _, outputs = plan.bound.structure.rows
    left = plan.bound.structure.Co[row]
    for j in range(target + 1):
        g = rest[outputs][row] if j == 0 else left @ rest[inner]
        signals["d"][target - j] = dbar * np.sign(g[: plant.nd]) * sign
        signals["v"][target - j] = noise * plant.Dw @ (np.sign(g[plant.nd :]) * sign)
        left = left if j == 0 else left @ observer.Az
    return target, row, sign


def effects(name: str, rows: np.ndarray, u: np.ndarray, target: int, row: int) -> np.ndarray:
    """Return the signed effect of each constant on an output at a sample."""
    bound = made(name, "constant")[1].bound
    _, nz, channel_rows, _, _ = bound.counts
    v = np.hstack([rows @ bound.structure.reading.T, u])
    psi = np.zeros((bound.counts[0], nz))
    for k in range(target):
        psi = psi @ bound.structure.Az.T + bound.drive[:, :nz] @ v[k]
    return np.asarray((bound.drive[:, nz:] @ v[target] + psi @ bound.shown.T)[:, channel_rows + row])


def one_run(name: str, seed: int, *, varying: bool = False, fault: float = 0.0) -> tuple[np.ndarray, ...]:
    """Return rows of the observer, u, y and faults of one run."""
    rng = np.random.default_rng([seed, NAMES.index(name), int(varying)])
    design, plan = made(name, "varying" if varying else "constant")
    plant, observer = design.plant, design.observer
    dbar, noise, start = BOUNDS[name]
    p = len(plan.names)
    signals = {
        "u": inputs_of(name, rng), "f": np.zeros((STEPS, plant.nf)), "d": dbar * rng.uniform(-1, 1, (STEPS, plant.nd)),
        "v": noise * rng.uniform(-1, 1, (STEPS, plant.nw)) @ plant.Dw.T,
    }  # fmt: skip
    signals["f"][STEPS // 2 :] = fault
    moving = plant.E.any(axis=0)
    x0 = (rng.uniform(-1, 1, plant.nx) * np.array(start))[moving]
    q = rng.choice([-1.0, 1.0], (STEPS, p)) if varying else rng.uniform(-1, 1, p)

    def observed(point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y = simulated(name, point, signals, x0)
        found = observer.run(y, signals["u"] if plant.nu else None)
        return np.hstack([found.states, found.faults, found.residuals]), y

    adversarial = seed % 2 == 1 and not varying
    if adversarial:
        target, row, sign = aimed(name, signals, rng)
    rows, y = observed(q)
    for _ in range(2 if adversarial else 0):
        q = np.where(effects(name, rows, signals["u"], target, row) * sign >= 0.0, 1.0, -1.0)
        rows, y = observed(q)
    return rows, signals["u"], y, signals["f"]


def case(seed: int) -> Outcome:
    """Run one case."""
    if seed >= 2 * 168:
        return _proof(seed)
    name, number = NAMES[seed % 2], seed // 2
    if number < 110:
        varying = number >= 100
        return _quiet(name, seed, varying=varying)
    if number < 118:
        return _faulty(name, seed)
    return _windows(name, seed)


def _quiet(name: str, seed: int, *, varying: bool) -> Outcome:
    design, plan = made(name, "varying" if varying else "constant")
    records = [one_run(name, seed * RUNS + i, varying=varying) for i in range(RUNS if not varying else 4)]
    rows, u, y = (np.array([record[i] for record in records]) for i in range(3))
    total, intervals = record_columns(plan, rows, u, y)
    ratio = float(np.max(np.abs(rows[:, :, design.observer.fault_rows.start :]) / total))
    group = f"{name}, {'varying' if varying else 'constant'}"
    wrong = "" if ratio <= 1.0 else f"passed: {ratio:.4f} of the threshold"
    outside = np.any(intervals[..., 0] > 0.0) or np.any(intervals[..., 1] < 0.0)
    wrong = wrong or ("an interval without a fault excludes zero" if outside else "")
    return Outcome(group, f"largest share of the threshold {'0.9 to 1' if ratio > 0.9 else 'below 0.9'}", wrong)


def _faulty(name: str, seed: int) -> Outcome:
    design, plan = made(name, "constant")
    quiet = one_run(name, seed * RUNS)
    size = 3.0 * float(np.median(record_columns(plan, *(item[None] for item in quiet[:3]))[0][0, STEPS // 2 :]))
    delay, wrong, late = design.observer.fault_delays[0], "", 0
    for i in range(RUNS):
        rows, u, y, faults = one_run(name, seed * RUNS + i, fault=size)
        total, intervals = record_columns(plan, rows[None], u[None], y[None])
        true = faults[: STEPS - delay]
        low, high = intervals[0, delay:, :, 0], intervals[0, delay:, :, 1]
        if np.any(low > true) or np.any(high < true):
            wrong = "a guaranteed interval does not hold the fault"
        first = STEPS // 2 + delay
        values = np.abs(rows[:, design.observer.fault_rows.start :])
        late += not np.any(values[first : first + 2] > total[0, first : first + 2])
    return Outcome(f"{name}, faults", "found within one sample" if late == 0 else f"{late} of {RUNS} later", wrong)


def _windows(name: str, seed: int) -> Outcome:
    design, _ = made(name, "constant")
    dbar, noise, start = BOUNDS[name]
    states = dict(zip(design.plant.state_names, start, strict=True))
    for i in range(10):
        _, u, y, _ = one_run(name, seed * RUNS + i)
        end = 30 + 5 * i
        found = proved_alarm(
            design, u[:end], y[:end], window=12, disturbance_bounds={design.plant.disturbance_names[0]: dbar},
            noise_bound=noise, initial_set=states,
        )  # fmt: skip
        if found.proved:
            return Outcome(f"{name}, windows", "proved", "a window without a fault was proved faulty")
    return Outcome(f"{name}, windows", "10 windows not proved")


def _proof(seed: int) -> Outcome:
    import tempfile

    design, _ = made("wang2015", "constant")
    dbar, _, start = BOUNDS["wang2015"]
    _, u, y, _ = one_run("wang2015", seed, fault=0.05)
    end = STEPS // 2 + 15
    found = proved_alarm(
        design, u[:end], y[:end], window=20, disturbance_bounds={"w": dbar},
        initial_set=dict(zip(design.plant.state_names, start, strict=True)),
    )  # fmt: skip
    if not found.proved:
        return Outcome("wang2015, a fault of 0.05", "not proved", "a fault of 0.05 was not proved")
    with tempfile.TemporaryDirectory() as folder:
        held = verify_alarm(found.save(Path(folder) / "alarm.json")).passed
    return Outcome("wang2015, a fault of 0.05", "proved", "" if held else "its certificate does not hold")
