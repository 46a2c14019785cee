"""The fault-estimation filter against what a user would write: processor time on one thread, verification included.

``python benchmarks/fault_estimation_filter.py [sizes ...]`` prints the table of ``benchmarks/README.md``.  ``--small``
runs one small instance of each row, so that nothing here can rot.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cvxpy
import numpy as np

import obsynth
from obsynth.analysis.fault_filter import prepare
from obsynth.numerics.norms import hinf_norm
from obsynth.spec import load_spec
from obsynth.synthesis.methods.fault_estimation_filter import gain_problem

ROOT = Path(__file__).parents[1]
BISECTION_TOLERANCE = 1e-4


def random_plant(nx: int, seed: int) -> obsynth.DescriptorSystem:
    """Return a plant with one fault of index one, nx / 4 outputs and nx / 2 disturbances, E of rank nx - 2."""
    rng = np.random.default_rng([nx, seed])
    ny, nd = max(3, nx // 4), nx // 2
    a = rng.normal(size=(nx, nx))
    a *= 1.1 / np.max(np.abs(np.linalg.eigvals(a)))
    c = rng.normal(size=(ny, nx)) / np.sqrt(nx)
    n = rng.normal(size=(nx, 2)) @ np.linalg.pinv(c[:2] @ rng.normal(size=(nx, 2)))
    e = np.eye(nx) - n @ np.linalg.solve(c[:2] @ n, c[:2])
    return obsynth.DescriptorSystem(
        e, a, None, c, Bf=rng.normal(size=(nx, 1)), Bd=0.3 * rng.normal(size=(nx, nd)), dt=0.1
    )


def direct_inequality(problem: object, level: float | None = None) -> float:
    """Solve the paper's inequality as written, for the least gamma or at a level; return the true norm reached."""
    a, b, c, d, z, zd = (getattr(problem, name) for name in ("A", "B", "C", "D", "Z", "Zd"))
    n, m, nd, q = len(a), len(c), b.shape[1], len(z)
    p, y = cvxpy.Variable((n, n), symmetric=True), cvxpy.Variable((n, m))
    squared = cvxpy.Variable(nonneg=True) if level is None else level**2
    whole = cvxpy.bmat([
        [p, np.zeros((n, nd)), (p @ a - y @ c).T, z.T],
        [np.zeros((nd, n)), squared * np.eye(nd), (p @ b - y @ d).T, zd.T],
        [p @ a - y @ c, p @ b - y @ d, p, np.zeros((n, q))],
        [z, zd, np.zeros((q, n)), np.eye(q)],
    ])  # fmt: skip
    constraints = [0.5 * (whole + whole.T) >> 1e-8 * np.eye(whole.shape[0]), p >> 1e-8 * np.eye(n)]
    try:
        cvxpy.Problem(cvxpy.Minimize(0 if level is not None else squared), constraints).solve(solver="CLARABEL")
        r = np.linalg.solve(p.value, y.value)
    except BaseException as error:
        if isinstance(error, (KeyboardInterrupt, SystemExit)):
            raise
        return np.inf
    return hinf_norm(a - r @ c, b - r @ d, z, zd).upper


def rebuilt_bisection(problem: object, start: float) -> float:
    """Bisect on gamma and build the inequality anew at each step, as published scripts do."""
    low, high = 0.0, start
    while high - low > BISECTION_TOLERANCE * high:
        middle = 0.5 * (low + high)
        reached = direct_inequality(problem, middle)
        low, high = (low, middle) if reached <= middle else (middle, high)
    return high


def timed(action) -> tuple[float, object]:
    """Return processor seconds and the result; an error of ours is a result."""
    began = time.process_time()
    try:
        found = action()
    except obsynth.ObsynthError as error:
        found = error
    return time.process_time() - began, found


def gain_of(found: object) -> float:
    """Return the least gain found; NaN for an error."""
    return found.certificate.claims["gamma_min"] if isinstance(found, obsynth.ObserverDesign) else np.nan


def row(nx: int, seed: int, *, naive: bool, bisect: bool) -> str:
    """Return one line of the table: time and least gamma of each way."""
    plant = random_plant(nx, seed)
    problem, _ = gain_problem(prepare(plant, None), free_weight=False)
    cells = [f"{nx}"]
    for engine in ("riccati", "lmi") if nx <= 32 else ("riccati",):
        seconds, found = timed(lambda engine=engine: obsynth.fault_estimation_filter(plant, engine=engine))
        cells.append(f"{seconds:.2f} s, {gain_of(found):.6g}")
        start = gain_of(found)
    cells += ["-"] * (3 - len(cells))
    seconds, reached = timed(lambda: direct_inequality(problem)) if naive else (np.nan, np.nan)
    cells.append(f"{seconds:.2f} s, {reached:.6g}" if naive else "-")
    seconds, reached = timed(lambda: rebuilt_bisection(problem, 2.0 * start)) if bisect else (np.nan, np.nan)
    cells.append(f"{seconds:.1f} s, {reached:.6g}" if bisect else "-")
    return "| " + " | ".join(cells) + " |"


def main(arguments: list[str]) -> None:
    """Print the table."""
    small = "--small" in arguments
    sizes = [int(item) for item in arguments if item.isdigit()] or ([6] if small else [8, 16, 32, 48, 100])
    print("| nx | riccati | lmi | direct inequality (cvxpy) | rebuilt bisection |")
    print("| --- | --- | --- | --- | --- |")
    for nx in sizes:
        print(row(nx, 0, naive=nx <= 32, bisect=nx <= 16), flush=True)
    if not small:
        spec = load_spec(ROOT / "designs/kundur/spec_fault_filter.yaml")
        seconds, found = timed(lambda: obsynth.design(spec.plant, spec.method, **dict(spec.options)))
        print(f"\nKundur, {spec.plant.nx} states: {seconds:.2f} s, gamma_min {gain_of(found):.3g}")


if __name__ == "__main__":
    main(sys.argv[1:])
