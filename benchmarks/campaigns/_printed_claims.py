"""What printed claims are compared with: sums, responses, linear programmes and filters from numbers, by numpy.

Of a design only the stored numbers are used: the matrices of its recursion.
"""

from __future__ import annotations

import io
import json
import re
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from benchmarks.campaigns._written_plants import (
    NOISE_BOUND,
    PARTS_OF_DELAYS,
    WrittenPlant,
    effects,
    held,
    kernels,
    outputs,
    sampled,
    worst_sum,
)
from scipy.linalg import null_space, solve_discrete_lyapunov
from scipy.optimize import linprog

import obsynth as ob
from obsynth.cli.main import main

#: Samples of a filter that is compared with a least, and of a test; parts of a sample in its programme.
TAPS, LONGEST, PARTS_OF_PROGRAMME = 12, 32, 8
#: Frequencies at which gains are computed, and of the search for a filter with its steps.
FREQUENCIES, GRID, STEPS = 4_096, 256, 80
#: Shares of terms at which something is zero, and at which a rank is decided.
ZERO, RANK = 1e-8, 1e-9
#: By which a filter may miss the response to the faults, far below what a least is compared to.
MISSED_RESPONSE = 1e-6


class _Stream(io.StringIO):
    def reconfigure(self, **_: object) -> None:
        pass


def run(*words: object) -> tuple[int, str]:
    """Return exit code and output of a command."""
    printed = _Stream()
    with redirect_stdout(printed), redirect_stderr(_Stream()):
        code = main([str(word) for word in words])
    return code, printed.getvalue()


def write_log(path: Path, plant: WrittenPlant, u: np.ndarray, y: np.ndarray) -> None:
    """Write a log of samples."""
    data = pd.DataFrame(np.column_stack([plant.dt * np.arange(len(u)), u, y]))
    data.columns = ["time", *plant.names["u"], *plant.names["y"]]
    data.to_csv(path, index=False, float_format="%.17g")


def random_outputs(plant: WrittenPlant, u: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return outputs without a fault for white noise and disturbances that are drawn anew for each sample."""
    d = rng.uniform(-1.0, 1.0, (len(u), len(plant.bounds))) * plant.bounds
    return outputs(plant, u, np.zeros(len(u)), d) + rng.standard_normal((len(u), len(plant.C))) * plant.noise


def separate(alarms: np.ndarray, apart: int) -> int:
    """Return how many times alarms begin, those less than ``apart`` rows after another not counted."""
    rows = np.flatnonzero(alarms)
    return int(rows.size > 0) + int(np.sum(np.diff(rows) >= apart))


def weights_of(design: ob.ObserverDesign, samples: int, row: int) -> np.ndarray:
    """Return the weights ``(samples, ny)`` of outputs in an estimate, or the residual of a test, at the last sample."""
    observer = design.linear[1]
    rows = observer.fault_rows if observer.fault_names else observer.residual_rows
    return _weights(observer, observer.Cz[rows][row], observer.Dy[rows][row], samples)


def weights(design: ob.ObserverDesign, samples: int, rng: np.random.Generator) -> np.ndarray:
    """Return the weights of outputs in one direction of residuals or fault estimates, of length one."""
    observer = design.linear[1]
    rows = observer.residual_rows if observer.residual_names else observer.fault_rows
    if observer.fault_names and rng.random() < 0.5:
        rows = observer.fault_rows
    return _in_direction(observer, rows, samples, rng)


def _in_direction(observer: Any, rows: slice, samples: int, rng: np.random.Generator) -> np.ndarray:
    direction = rng.standard_normal(len(observer.Cz[rows]))
    direction /= np.linalg.norm(direction)
    return _weights(observer, direction @ observer.Cz[rows], direction @ observer.Dy[rows], samples)


def _weights(observer: Any, of_state: np.ndarray, direct: np.ndarray, samples: int) -> np.ndarray:
    found, ahead = np.zeros((samples, observer.Dy.shape[1])), of_state
    found[-1] = direct
    for k in range(samples - 2, -1, -1):
        found[k], ahead = ahead @ observer.By, ahead @ observer.Az
    return found


def largest_statistic(
    design: ob.ObserverDesign, plant: WrittenPlant, samples: int, rng: np.random.Generator, *, is_held: bool
) -> float:
    """Return the largest norm of the residual that disturbances, moving or held, reach without a fault, of some
    directions."""
    observer, kernel, found = design.linear[1], kernels(plant, samples), 0.0
    rows = observer.residual_rows if observer.residual_names else observer.fault_rows
    for _ in range(1 if len(observer.Cz[rows]) == 1 else 4):
        each = _in_direction(observer, rows, samples, rng)
        effect = effects(kernel, each)
        found = max(found, worst_sum(held(effect) if is_held else effect, each, plant.noise))
    return found


# --- responses ----------------------------------------------------------------------------------------------------


def _responses(plant: WrittenPlant, design: ob.ObserverDesign, *, noise: bool) -> np.ndarray:
    """Return the response of the fault estimates to held disturbances and ``noise``, ``(frequencies, nf, inputs)``."""
    observer, model = design.linear[1], sampled(plant)
    n, push, direct = len(model.A), model.Bd, model.Dd
    if noise:
        push, direct = np.hstack([push, np.zeros((n, len(plant.C)))]), np.hstack([direct, np.diag(plant.noise)])
    cz, dy = observer.Cz[observer.fault_rows], observer.Dy[observer.fault_rows]
    a = np.block([[model.A, np.zeros((n, observer.order))], [observer.By @ model.C, observer.Az]])
    b, c = np.vstack([push, observer.By @ direct]), np.hstack([dy @ model.C, cz])
    points = np.concatenate([[0.0], np.geomspace(1e-5, np.pi, FREQUENCIES), np.linspace(0.0, np.pi, FREQUENCIES)])
    lhs = np.exp(1j * points)[:, None, None] * np.eye(len(a)) - a
    return np.asarray(c @ np.linalg.solve(lhs, np.broadcast_to(b, (len(points), *b.shape))) + dy @ direct)


def gain(plant: WrittenPlant, design: ob.ObserverDesign, *, each: bool = False, noise: bool = False) -> float:
    """Return the largest gain from all disturbances (and ``noise``), or from one of them, to the fault estimates."""
    responses = _responses(plant, design, noise=noise)
    if each:
        return float(np.max(np.linalg.norm(responses, axis=1)))
    return float(np.max(np.linalg.svd(responses, compute_uv=False)))


def deviation(plant: WrittenPlant, design: ob.ObserverDesign) -> float:
    """Return the standard deviation of the fault estimate for white sensor noise."""
    observer = design.linear[1]
    driven, direct = observer.By * plant.noise, observer.Dy[observer.fault_rows] * plant.noise
    states = solve_discrete_lyapunov(observer.Az, driven @ driven.T) if observer.order else np.zeros((0, 0))
    rows = observer.Cz[observer.fault_rows]
    return float(np.sqrt((rows @ states @ rows.T + direct @ direct.T)[0, 0]))


def detectable(plant: WrittenPlant) -> tuple[bool, bool]:
    """Return whether the fault is no combination of disturbances at the outputs: in general, and for constant ones."""
    model = sampled(plant)
    push, direct = np.hstack([model.Bf, model.Bd]), np.hstack([model.Df, model.Dd])

    def more(z: complex) -> bool:
        seen = model.C @ np.linalg.solve(z * np.eye(len(push)) - model.A, push.astype(complex)) + direct
        sizes = np.linalg.norm(seen, axis=0)
        seen = seen / np.where(sizes > 0.0, sizes, 1.0)
        ranks = [int(np.sum(np.linalg.svd(part, compute_uv=False) > RANK)) for part in (seen, seen[:, 1:])]
        return ranks[0] > ranks[1]

    return more(1.3 * np.exp(0.7j)), more(1.0)


def missed_by_steps(plant: WrittenPlant, text: str) -> float:
    """Return what is left of steps and states that cancel, as a share of the sizes of the terms."""
    values = {name: float(value) for value, name in re.findall(r"a step of (\S+) in (\w+)", text)}
    values |= {name: float(value) for name, value in re.findall(r"(x\d) = ([-0-9.e]+[0-9])", text)}
    names, read = plant.names, plant.outputs
    x, f, d = (np.array([values.get(name, 0.0) for name in names[kind]]) for kind in "xfd")
    terms = np.block([
        [plant.A * x, plant.Bf * f, plant.Bd * d],
        [read["C"] * x, read["Df"] * f, read["Dd"] * d],
    ])  # fmt: skip
    return float(np.linalg.norm(terms.sum(axis=1)) / np.linalg.norm(np.abs(terms).sum(axis=1)))


# --- what does better than a least --------------------------------------------------------------------------------


def _of_window(plant: WrittenPlant, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return what a window of outputs ``(samples ny)`` shows of its first state and of a fault in each sample."""
    model, ny = sampled(plant), len(plant.C)
    states, faults = [model.C], np.zeros((samples, ny, samples))
    faults[np.arange(samples), :, np.arange(samples)] = model.Df[:, 0]
    for k in range(1, samples):
        for later in range(k, samples):
            faults[later, :, later - k] = (states[k - 1] @ model.Bf)[:, 0]
        states.append(states[-1] @ model.A)
    return np.vstack(states), faults.reshape(samples * ny, samples)


def _by_programme(plant: WrittenPlant, wanted: np.ndarray, values: np.ndarray, *, is_held: bool) -> float:
    """Return the largest value without a fault of the linear test of a window with ``wanted.T w = values`` and the
    least, measured with 24 parts a sample; infinite where there is none."""
    ny = len(plant.C)
    samples = len(wanted) // ny
    kernel = kernels(plant, samples, PARTS_OF_PROGRAMME)
    units = np.eye(samples * ny).reshape(-1, samples, ny)
    each = [effects(kernel, unit) for unit in units]
    rows = np.array([(effect.sum(axis=1) if is_held else effect).ravel() for effect in each]).T
    rows = np.vstack([rows, NOISE_BOUND * np.diag(np.tile(plant.noise, samples))])
    rows = rows[np.any(rows != 0.0, axis=1)]
    count, identity = len(rows), np.eye(len(rows))
    solved = linprog(
        np.concatenate([np.zeros(samples * ny), np.ones(count)]),
        A_ub=np.block([[rows, -identity], [-rows, -identity]]),
        b_ub=np.zeros(2 * count),
        A_eq=np.hstack([wanted.T, np.zeros((wanted.shape[1], count))]),
        b_eq=values,
        bounds=[(None, None)] * (samples * ny) + [(0.0, None)] * count,
        method="highs",
    )
    if solved.status != 0:
        return np.inf
    found = solved.x[: samples * ny]
    if np.max(np.abs(wanted.T @ found - values)) > ZERO * max(1.0, float(np.max(np.abs(wanted).T @ np.abs(found)))):
        return np.inf
    test = found.reshape(samples, ny)
    effect = effects(kernels(plant, samples), test)
    return worst_sum(held(effect) if is_held else effect, test, plant.noise)


def step_test(plant: WrittenPlant, *, before: int, after: int, is_held: bool) -> float:
    """Return the threshold of a test of a step within a window."""
    states, faults = _of_window(plant, before + after)
    wanted = np.column_stack([states, faults[:, before:].sum(axis=1)])
    return _by_programme(plant, wanted, np.eye(wanted.shape[1])[-1], is_held=is_held)


def better_test(plant: WrittenPlant, design: ob.ObserverDesign, least: float, *, is_held: bool) -> str:
    """Return by how much a test with the delay of a design is better than a least; of a fault of any time course where
    the estimate is one sample of it, else of a constant one.  Inputs of the window alone are known: tests have nothing
    of its first outputs, which earlier ones move where inputs act late."""
    samples = LONGEST + -plant.delays[0] // PARTS_OF_DELAYS
    states, faults = _of_window(plant, samples)
    own = weights_of(design, samples, row=0).ravel() @ faults
    at = samples - 1 - design.linear[1].fault_delays[0]
    if abs(own[at] - 1.0) < ZERO and np.sum(np.abs(np.delete(own, at))) < ZERO:
        wanted, values = np.hstack([states, faults]), np.concatenate([np.zeros(states.shape[1]), np.eye(samples)[at]])
        kept = np.any(wanted != 0.0, axis=0)
        wanted, values = wanted[:, kept], values[kept]
    else:
        wanted = np.column_stack([states, faults.sum(axis=1)])
        values = np.eye(wanted.shape[1])[-1]
    found = _by_programme(plant, wanted, values, is_held=is_held)
    return f"a test has {found:.6g}" if found < least * (1.0 - 1e-3) else ""


def filter_of_samples(plant: WrittenPlant, delay: int, *, noise: bool = False) -> float | None:
    """Return the gain from held disturbances, and ``noise``, of a filter of `TAPS` samples that shows the fault after a
    delay, made small by weighted least squares; ``None`` where there is none."""
    states, faults = _of_window(plant, TAPS)
    if delay >= TAPS:
        return None
    wanted = np.hstack([states, faults])
    values = np.concatenate([np.zeros(states.shape[1]), np.eye(TAPS)[TAPS - 1 - delay]])
    first, *_ = np.linalg.lstsq(wanted.T, values, rcond=1e-12)
    size = float(np.max(np.abs(wanted).T @ np.abs(first)))
    if np.max(np.abs(wanted.T @ first - values)) > ZERO * max(1.0, size):
        return None
    free = null_space(wanted.T, rcond=1e-11)
    model, ny, nd = sampled(plant), len(plant.C), len(plant.bounds)
    seen = np.zeros((TAPS, ny, TAPS, nd + ny * noise))
    moved = model.Bd
    for later in range(TAPS):
        seen[later, :, later, :nd] = model.Dd
        if noise:
            seen[later, :, later, nd:] = np.diag(plant.noise)
    for age in range(1, TAPS):
        for at in range(TAPS - age):
            seen[at + age, :, at, :nd] = model.C @ moved
        moved = model.A @ moved
    flat = seen.reshape(TAPS * ny, -1)

    def response(w: np.ndarray, points: np.ndarray) -> np.ndarray:
        turned = np.exp(-1j * np.outer(points, np.arange(TAPS - 1, -1, -1)))
        return np.asarray(
            np.einsum("pt,...td->...pd", turned, (w.T @ flat).reshape(*w.T.shape[:-1], TAPS, seen.shape[-1]))
        )

    points = np.linspace(0.0, np.pi, GRID)
    given, moves, share = response(first, points), response(free, points), np.full(GRID, 1.0 / GRID)
    if np.max(np.abs(moves), initial=0.0) <= ZERO * np.max(np.abs(given), initial=0.0):
        free = free[:, :0]  # nothing but rounding: every filter of so many samples has this gain
    best, chosen = np.inf, first
    for _ in range(STEPS if free.shape[1] else 1):
        w = first
        if free.shape[1]:
            root = np.sqrt(share)[:, None]
            lhs = (moves * root).reshape(free.shape[1], -1).T
            rhs = -(given * root).ravel()
            v, *_ = np.linalg.lstsq(
                np.vstack([lhs.real, lhs.imag]), np.concatenate([rhs.real, rhs.imag]), rcond=1e-12
            )  # fmt: skip
            w = first + free @ v
        sizes = np.linalg.norm(response(w, points), axis=1)
        if sizes.max() < best:
            best, chosen = float(sizes.max()), w
        share = share * sizes
        if not share.sum() > 0.0:
            break
        share /= share.sum()
    if np.max(np.abs(wanted.T @ chosen - values)) > MISSED_RESPONSE:
        return None
    return float(np.max(np.linalg.norm(response(chosen, np.linspace(0.0, np.pi, FREQUENCIES)), axis=1)))


# --- other designs of a spec --------------------------------------------------------------------------------------


def compared(folder: Path) -> dict[str, dict[str, float]]:
    """Return the numbers of the fault f1 by method, from the same comparison."""
    code, text = run("compare", "--system", folder / "spec.yaml", "--runs", "2", "--quiet", "--json")
    if code:
        return {}
    rows = {}
    for entry in json.loads(text)["methods"]:
        if entry["faults"]:
            faults = entry["faults"]
            rows[entry["method"]] = faults["f1"] if isinstance(faults, dict) else faults[0]
    return rows


def designed(folder: Path, method: str) -> ob.ObserverDesign | None:
    """Return the design that another method makes of the spec."""
    spec = json.loads((folder / "spec.yaml").read_text("utf-8"))
    spec["method"] = {"id": method}
    other, gains = folder / f"{method}.yaml", folder / f"{method}.json"
    if not gains.exists():
        other.write_text(json.dumps(spec), encoding="utf-8")
        code, _ = run("design", "--system", other, "--output", gains, "--quiet")
        if code:
            return None
    return ob.load(gains)
