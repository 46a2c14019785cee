"""Thresholds, guaranteed intervals and window proofs over tolerances, on plants drawn at random.

A case is a plant with 2 to 6 dynamic states and 1 to 4 constants, alone, in products, quotients, roots, powers, sines
and exponentials, in any of its nine matrices; half of the boxes have nominal values that are not their middle, a
quarter of the plants constants that vary.  Plants are discrete, discrete with algebraic rows, sampled, eliminated and
sampled, or continuous with an observer on samples; a third have states that were mixed.  The truth is made anew with
numpy from the expressions.  At up to six vertices and one point inside, disturbance and noise are at their bounds with
the signs that drive one output at one sample, found from the response of this very plant to each impulse; continuous
plants get a disturbance that switches five times in a sample.  A threshold that is passed without a fault, a guaranteed
interval that a fault (held for five samples) leaves, and a window without a fault that is proved faulty are wrong.
Refusals name their reason: `no bound`.
"""

from __future__ import annotations

import itertools
import math
import warnings
from typing import Any

import numpy as np
import pandas as pd
from benchmarks.campaigns.adaptive_thresholds import record_columns
from benchmarks.campaigns.frame import Outcome
from scipy.linalg import expm

import obsynth
from obsynth.errors import ObsynthError, PreconditionError, SpecError
from obsynth.monitoring.alarms.proof_file import proved_alarm
from obsynth.monitoring.thresholds.adaptive_monitor import adaptive_plan

CASES = 400
LIMIT = 300.0
STEPS = 50
#: Seconds between samples of what is continuous, and switches of its disturbance in a sample.
STEP, SWITCHES = 0.1, 5
KINDS = ("discrete", "descriptor", "sampled", "eliminated", "continuous")
FORMS = ("{a}", "{a} * {b}", "{a} / {b}", "sqrt({a}) * {b}", "1 / {a}", "{a} ** 2", "exp(0.3 * {a})", "{a} + {b}",
         "sin({a})")  # fmt: skip
FUNCTIONS = {"sqrt": math.sqrt, "exp": math.exp, "sin": math.sin, "__builtins__": {}}
#: Shares of cases with varying constants, mixed states, entries that are expressions, and proofs of windows.
VARYING, MIXED, PROVED = 0.25, 0.3, 0.15


class Truth:
    """A plant as rows of numbers and texts, and its exact matrices at a point of the box."""

    def __init__(self, seed: int) -> None:
        rng = self.rng = np.random.default_rng([seed, 17])
        self.kind = str(rng.choice(KINDS))
        self.smooth = self.kind in ("sampled", "eliminated", "continuous")
        self.varying = bool(rng.random() < VARYING) and self.kind != "continuous"
        self.n, self.nu, self.nd = int(rng.integers(2, 7)), int(rng.integers(0, 3)), int(rng.integers(0, 2))
        self.ny = int(rng.integers(max(2, self.n - 1), self.n + 2))
        self.algebraic = int(rng.integers(1, 3)) if self.kind in ("descriptor", "eliminated") else 0
        names = [f"p{i}" for i in range(int(rng.integers(1, 5)))]
        self.nominal = {name: float(rng.uniform(0.5, 2.0)) for name in names}
        matrices = self._numbers()
        used = [name for name in matrices if rng.random() < 0.6] or ["A"]
        share = rng.uniform(0.05, 0.5)
        self.rows = {
            name: [[self._text(float(value)) if name in used and value and rng.random() < share else float(value)
                    for value in row] for row in matrix] for name, matrix in matrices.items()
        }  # fmt: skip
        if not any(isinstance(cell, str) for rows in self.rows.values() for row in rows for cell in row):
            self.rows["A"][0][0] = self._text(float(matrices["A"][0, 0]))
        text = str(self.rows)
        self.constants = {name: self._range(name) for name in names if name in text}
        self.dbar, self.vbar = float(rng.choice([0.1, 1.0])), float(rng.choice([0.0, 0.01, 0.1]))
        self._made: dict[tuple[float, ...], tuple[np.ndarray, ...]] = {}

    def _numbers(self) -> dict[str, np.ndarray]:
        """Return E, A, ..., Dd at the nominal values."""
        rng, n, size = self.rng, self.n, self.n + self.algebraic
        a = rng.normal(size=(n, n))
        if self.smooth:
            a -= (np.linalg.eigvals(a).real.max() + rng.uniform(-0.2, 1.0)) * np.eye(n)
        else:
            a *= rng.uniform(0.3, 1.0) / np.abs(np.linalg.eigvals(a)).max()
        e = np.exp(0.5 * rng.normal(size=n))
        found = {"E": np.zeros((size, size)), "A": np.zeros((size, size)), "B": rng.normal(size=(size, self.nu)),
                 "C": rng.normal(size=(self.ny, size)), "D": rng.normal(size=(self.ny, self.nu)),
                 "Bf": rng.normal(size=(size, 1)), "Df": np.zeros((self.ny, 1)), "Bd": rng.normal(size=(size, self.nd)),
                 "Dd": rng.normal(size=(self.ny, self.nd)) * (rng.random() < 0.4)}  # fmt: skip
        found["E"][:n, :n] = np.diag(e)
        found["D"] *= rng.random() < 0.5 and self.kind != "continuous"
        whole = found["A"]
        whole[:n, n:] = 0.3 * rng.normal(size=(n, self.algebraic))
        whole[n:, :n] = 0.5 * rng.normal(size=(self.algebraic, n))
        whole[n:, n:] = np.eye(self.algebraic) + 0.2 * rng.normal(size=(self.algebraic, self.algebraic))
        whole[:n, :n] = e[:, None] * a + whole[:n, n:] @ np.linalg.solve(whole[n:, n:], whole[n:, :n])
        for name, chance in (("Bf", 0.7), ("Bd", 0.5)):
            found[name][n:] *= rng.random() > chance
        if rng.random() < MIXED:
            mixing = np.eye(size) + np.triu(rng.integers(-1, 2, (size, size)), 1)
            found |= {name: found[name] @ mixing for name in ("E", "A", "C")}
        return found

    def _text(self, value: float) -> str:
        a, b = self.rng.choice(list(self.nominal), 2)
        form = str(self.rng.choice(FORMS)).format(a=a, b=b)
        return f"{value / eval(form, FUNCTIONS, self.nominal)!r} * ({form})"

    def _range(self, name: str) -> dict[str, Any]:
        rng, middle = self.rng, self.nominal[name]
        share = float(rng.choice([0.005, 0.02, 0.05, 0.1]))
        if rng.random() < 0.5:
            return {"nominal": middle, "tolerance": share}
        below, above = share * rng.uniform(0.0, 1.0), share * rng.uniform(0.01, 1.0)
        return {"nominal": middle, "range": [middle * (1.0 - below), middle * (1.0 + above)]}

    def plant(self) -> obsynth.DescriptorSystem:
        """Return the plant that is designed for."""
        given = {name: rows for name, rows in self.rows.items() if name in ("E", "A", "C") or (rows and rows[0])}
        found = obsynth.uncertain_system({**given, "dt": 0.0 if self.smooth else 1.0}, self.constants,
                                         variation="varying" if self.varying else "constant")  # fmt: skip
        if self.kind == "eliminated":
            found = obsynth.eliminate_algebraic_states(found).plant
        if self.kind in ("sampled", "eliminated"):
            found = obsynth.discretise(found, STEP).plant
        if not self.vbar:
            return found
        return found.replace(Bw=np.zeros((found.nx, self.ny)), Dw=self.vbar * np.eye(self.ny), noise_names=None)

    def exact(self, q: np.ndarray, box: Any, parts: int) -> tuple[np.ndarray, ...]:
        """Return ``X^-1, A_dyn, W, C, R, E_dyn`` (discrete), or with F, G of a part of a sample in place of A and W."""
        key = (*q.tolist(), float(parts))
        if key in self._made:
            return self._made[key]
        values = {name: item.nominal for name, item in box.constants.items()}
        for item, place in zip(box.uncertain, q.tolist(), strict=True):
            values[item.name] = (item.low + item.high) / 2.0 + place * (item.high - item.low) / 2.0

        def number(cell: float | str) -> float:
            return float(eval(cell, FUNCTIONS, values)) if isinstance(cell, str) else cell

        m = {name: np.array([[number(cell) for cell in row] for row in rows]).reshape(len(rows), len(rows[0]))
             for name, rows in self.rows.items()}  # fmt: skip
        n, w, r = self.n, np.hstack([m["B"], m["Bd"], m["Bf"]]), np.hstack([m["D"], m["Dd"], m["Df"]])
        inverse = np.linalg.inv(np.vstack([m["E"][:n], m["A"][n:]]))
        if not self.smooth:
            found = (inverse, m["A"][:n], w, m["C"], r, m["E"][:n])
        else:
            moving, rest = m["A"][:n] @ inverse[:, :n], w[:n] - m["A"][:n] @ inverse[:, n:] @ w[n:]
            block = np.zeros((n + w.shape[1], n + w.shape[1]))
            block[:n] = np.hstack([moving, rest])
            whole = expm(STEP / parts * block)
            found = (inverse, whole[:n, :n], whole[:n, n:], m["C"] @ inverse[:, :n],
                     r - m["C"] @ inverse[:, n:] @ w[n:], m["E"][:n])  # fmt: skip
        self._made[key] = found
        return found

    def outputs(self, q: np.ndarray, box: Any, x: np.ndarray, w: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return y ``(runs, steps, ny)``: ``q (steps, p)``, ``x (runs, size)``, ``w (runs, steps, parts, .)``."""
        runs, steps, parts, _ = w.shape
        y, n = np.empty((runs, steps, self.ny)), self.n
        after = x
        for k in range(steps):
            inverse, a, b, c, r, e = self.exact(q[k], box, parts)
            # A sampled plant's state does not jump when a constant changes; of others E(q) x goes on.
            begin = after @ e.T if self.smooth or not k else after
            if self.smooth:
                y[:, k] = begin @ c.T + w[:, k, 0] @ r.T + v[:, k]
                for part in range(parts):
                    begin = begin @ a.T + w[:, k, part] @ b.T
                after = begin @ inverse[:, :n].T
            else:
                state = np.hstack([begin, -w[:, k, 0] @ b[n:].T]) @ inverse.T
                y[:, k] = state @ c.T + w[:, k, 0] @ r.T + v[:, k]
                after = state @ a.T + w[:, k, 0] @ b[:n].T
        return y


def designed(truth: Truth, plant: obsynth.DescriptorSystem) -> Any:
    """Return a design of some method, or nothing where none of them exists."""
    methods = [obsynth.fault_estimation_filter, obsynth.pd_observer, obsynth.ui_pi_observer]
    for i in truth.rng.permutation(len(methods)):
        if truth.kind == "continuous" and i == 0:
            continue
        try:
            return methods[i](plant)
        except ObsynthError:
            continue
    return None


def rows_of(design: Any, y: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the rows of the observer for one run."""
    found = design.observer.run(y, u if u.shape[1] else None)
    return np.hstack([found.states, found.faults, found.residuals])


def case(seed: int) -> Outcome:
    """Run one case."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        truth = Truth(seed)
        group = f"{truth.kind}{', varying' if truth.varying else ''}"
        try:
            plant = truth.plant()
        except PreconditionError:
            return Outcome(group, "no plant")
        design = designed(truth, plant)
        if design is None or design.plant.uncertainty is None or design.plant.uncertainty.lost:
            # A method that eliminates algebraic states itself says that it left the tolerances behind.
            told = design is not None and any("tolerances" in note for note in design.notes)
            wrong = "" if design is None or told else "the tolerances are lost without a word"
            return Outcome(group, "no design" if design is None else "no bound", wrong)
        return (_continuous if truth.kind == "continuous" else _sampled)(truth, design, group)


def _points(truth: Truth, count: int) -> list[np.ndarray]:
    corners = [np.array(corner) for corner in itertools.product((-1.0, 1.0), repeat=count)]
    return [*(corners[i] for i in truth.rng.permutation(len(corners))[:6]), truth.rng.uniform(-1.0, 1.0, count)]


def _sampled(truth: Truth, design: Any, group: str) -> Outcome:
    rng, plant, box = truth.rng, design.plant, design.plant.uncertainty.box
    start = dict.fromkeys(plant.state_names, float(rng.choice([0.0, 0.1, 1.0])))
    bounds = np.full(plant.nd, truth.dbar)
    try:
        plan = adaptive_plan(design, bounds, 1.0, initial_error=None, initial_set=start)[0]
    except PreconditionError:
        return Outcome(group, "no bound")
    size, no, count = len(truth.rows["A"]), plan.bound.counts[4], len(box.names)
    u = rng.uniform(-1.0, 1.0, (STEPS, truth.nu)) * float(rng.choice([1.0, 10.0]))
    # A plant that was eliminated, by us or by its method, has other states than were written: they begin at zero.
    written = truth.kind != "eliminated" and len(start) == size
    x = np.array(list(start.values())) * rng.choice([-1.0, 1.0], size) if written else np.zeros(size)
    largest, wrong = 0.0, ""
    for point in _points(truth, count):
        q = rng.choice([-1.0, 1.0], (STEPS, count)) if truth.varying else np.tile(point, (STEPS, 1))
        w, v, target = _aimed(truth, design, q, x, u, no)
        y = truth.outputs(q, box, x[None], w[None, :, None], v[None])
        rows = rows_of(design, y[0], u)[None]
        thresholds, _ = record_columns(plan, rows, u[None], y)
        values = np.abs(rows[0, :, rows.shape[2] - no :])
        largest = max(largest, float(np.max(values / np.maximum(thresholds[0], np.finfo(float).tiny), initial=0.0)))
        if (values > thresholds[0]).any():
            wrong = f"a threshold is passed without a fault: {largest:.3f}"
        if rng.random() < PROVED and target > 3:
            found = proved_alarm(
                design, u[: target + 1], y[0, : target + 1], window=int(rng.integers(2, 8)),
                disturbance_bounds=dict.fromkeys(plant.disturbance_names, truth.dbar),
                noise_bound=1.0 if plant.nw else None, initial_set=start,
            )  # fmt: skip
            wrong = "a window without a fault is proved faulty" if found.proved else wrong
        if plan.intervals and plan.fault_names:
            f = np.repeat(rng.normal(size=STEPS // 5) * 10.0 ** rng.uniform(-1.0, 2.0), 5)
            y = truth.outputs(q, box, x[None], np.column_stack([w[:, :-1], f])[None, :, None], v[None])
            late = design.observer.fault_delays[0]
            low, high = record_columns(plan, rows_of(design, y[0], u)[None], u[None], y)[1][0, late:, 0].T
            acted = f[: STEPS - late]
            if (acted < low).any() or (acted > high).any():
                wrong = "a fault leaves its guaranteed interval"
    return Outcome(group, _shown(largest), wrong)


def _aimed(
    truth: Truth, design: Any, q: np.ndarray, x: np.ndarray, u: np.ndarray, no: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return signals ``w (steps, nu + nd + 1)``, noise ``v``, and the sample at which they drive one output."""
    rng, box, nu, nd, ny = truth.rng, design.plant.uncertainty.box, truth.nu, truth.nd, truth.ny
    target, row = int(rng.integers(5, STEPS)), int(rng.integers(no))
    moved = [(k, nu + j) for k in range(target + 1) for j in range(nd)]
    heard = [(k, j) for k in range(target + 1) for j in range(ny)] if truth.vbar else []
    w, v = (
        np.zeros((len(moved) + len(heard) + 1, STEPS, nu + nd + 1)),
        np.zeros((len(moved) + len(heard) + 1, STEPS, ny)),
    )
    for i, (k, j) in enumerate(moved):
        w[i, k, j] = 1.0
    for i, (k, j) in enumerate(heard):
        v[len(moved) + i, k, j] = 1.0
    w[-1, :, :nu] = u
    begin = np.zeros((len(w), len(x)))
    begin[-1] = x
    y = truth.outputs(q, box, begin, w[:, :, None], v)
    inputs = np.zeros((len(w), STEPS, nu))
    inputs[-1] = u
    place = len(design.observer.Cz) - no + row
    effects = np.array([rows_of(design, y[i], inputs[i])[target, place] for i in range(len(w))])
    sign = 1.0 if effects[-1] >= 0.0 else -1.0
    found = np.zeros((STEPS, nu + nd + 1))
    found[:, :nu] = u
    found[:, nu : nu + nd] = truth.dbar * rng.choice([-1.0, 1.0], (STEPS, nd))
    noise = truth.vbar * rng.choice([-1.0, 1.0], (STEPS, ny))
    for i, (k, j) in enumerate(moved):
        found[k, j] = truth.dbar * (sign if effects[i] >= 0.0 else -sign)
    for i, (k, j) in enumerate(heard):
        noise[k, j] = truth.vbar * (sign if effects[len(moved) + i] >= 0.0 else -sign)
    return found, noise, target


def _continuous(truth: Truth, design: Any, group: str) -> Outcome:
    rng, plant, box = truth.rng, design.plant, design.plant.uncertainty.box
    start = dict.fromkeys(plant.state_names, float(rng.choice([0.01, 0.1, 1.0])))
    try:
        monitor = obsynth.online_monitor(
            design, constants=plant, disturbance_bounds=dict.fromkeys(plant.disturbance_names, truth.dbar),
            noise_bound=1.0 if plant.nw else None, sample_time=STEP, initial_set=start,
        )  # fmt: skip
    except (PreconditionError, SpecError):
        # The nominal rule beside it refuses unstable plants whose outputs bend between samples.
        return Outcome(group, "no bound")
    u = rng.uniform(-1.0, 1.0, (STEPS, truth.nu)) * float(rng.choice([1.0, 10.0]))
    largest, wrong = 0.0, ""
    for q in _points(truth, len(box.names)):
        x = rng.choice([-1.0, 1.0], plant.nx) * np.array(list(start.values()))
        w = np.zeros((1, STEPS, SWITCHES, truth.nu + truth.nd + 1))
        w[0, :, :, : truth.nu] = u[:, None]
        w[0, :, :, truth.nu : -1] = truth.dbar * rng.choice([-1.0, 1.0], (STEPS, SWITCHES, truth.nd))
        v = truth.vbar * rng.choice([-1.0, 1.0], (1, STEPS, truth.ny))
        y = truth.outputs(np.tile(q, (STEPS, 1)), box, x[None], w, v)[0]
        log = pd.DataFrame(np.column_stack([STEP * np.arange(STEPS), u, y]),
                           columns=["time", *plant.input_names, *plant.output_names])  # fmt: skip
        table = obsynth.run_on_data(design, log, monitor=monitor, warm_up=0.0).table
        names = [name.removeprefix("threshold ") for name in table.columns if name.startswith("threshold ")]
        for name in names:
            largest = max(largest, float((table[name].abs() / table[f"threshold {name}"]).max()))
    if largest > 1.0:
        wrong = f"a threshold is passed without a fault: {largest:.3f}"
    return Outcome(group, _shown(largest), wrong)


def _shown(largest: float) -> str:
    steps = (0.5, 0.8, 0.9, 1.0)
    low = next((a for a, b in zip((0.0, *steps), steps, strict=False) if largest <= b), 1.0)
    high = next((b for b in steps if largest <= b), math.inf)
    return f"largest share of the threshold {low:g} to {high:g}"
