"""Steps per second of recursive filters on the same problem with E = I, in one run: ours and other packages.

Usage: ``python benchmarks/recursive_filters.py``; packages that are not installed are left out.  One thread, processor
time, best of several; all filters are compared first, so that nothing is timed that computes something else.  The time
that the compiled kernel takes to load (or, the first time, to compile) is printed and not part of its rate.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import importlib
import importlib.util
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import obsynth
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.recursive.options import observer_from_options

SIZES = ((2, 1, 1), (20, 5, 3))
STEPS, REPEATS, TRIALS, BATCH_STEPS = 2000, 7, 1000, 200


@dataclass(frozen=True)
class Problem:
    """A stable plant, its noise, and a record."""

    A: FloatArray
    C: FloatArray
    Phi: FloatArray
    Q: FloatArray
    R: FloatArray
    y: FloatArray
    u: FloatArray

    @classmethod
    def of(cls, nx: int, ny: int, nq: int) -> Problem:
        """Return a random problem of a size."""
        rng = np.random.default_rng(nx)
        A = rng.standard_normal((nx, nx))
        A *= 0.9 / np.max(np.abs(np.linalg.eigvals(A)))
        return cls(
            A, rng.standard_normal((ny, nx)), rng.standard_normal((nx, nq)), np.diag(rng.uniform(0.1, 1.0, nx)),
            np.diag(rng.uniform(0.1, 1.0, ny)), rng.standard_normal((STEPS, ny)), rng.standard_normal((STEPS, nx)),
        )  # fmt: skip

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.A)


def plant_of(problem: Problem, *, varying: bool = False) -> obsynth.TimeVaryingDescriptorSystem:
    """Return the problem as a plant; as a stack, if nothing shall be kept from step to step."""
    A = np.tile(problem.A, (STEPS, 1, 1)) if varying else problem.A
    return obsynth.TimeVaryingDescriptorSystem(
        None, A, np.eye(problem.nx), problem.C, Phi=problem.Phi, dt=1.0, horizon=STEPS
    )


def observer_of(problem: Problem, *, adaptive: bool, varying: bool = False) -> obsynth.RecursiveObserver:
    """Return our observer of the problem."""
    options = {
        "Q": problem.Q, "R": problem.R, "initial_state": None, "initial_covariance": None, "early_constraints": False,
    }  # fmt: skip
    if adaptive:
        options |= {
            "form": "innovation", "forgetting": 0.98, "guard": "regularise", "initial_parameters": None,
            "initial_parameter_covariance": None, "random_walk": None, "window": 50, "reset": 0.0,
        }  # fmt: skip
    return observer_from_options(plant_of(problem, varying=varying), options)


def ours(problem: Problem, *, adaptive: bool = False, varying: bool = False) -> FloatArray:
    """Run our observer sample by sample."""
    running = observer_of(problem, adaptive=adaptive, varying=varying).start()
    for k in range(STEPS):
        row = running.raw_step(problem.y[k], problem.u[k])
    return row.x


def ours_compiled(problem: Problem, *, varying: bool = False) -> FloatArray:
    """Run our observer over the record in the compiled kernel, estimates of every sample included."""
    observer = observer_of(problem, adaptive=False, varying=varying)
    return observer.run(problem.y, problem.u, compiled=True).states[-1]


def by_filterpy(problem: Problem) -> FloatArray:
    """Run filterpy, covariance form."""
    from filterpy.kalman import KalmanFilter

    theirs = KalmanFilter(dim_x=problem.nx, dim_z=len(problem.C), dim_u=problem.nx)
    theirs.x, theirs.F, theirs.H, theirs.B = np.zeros(problem.nx), problem.A, problem.C, np.eye(problem.nx)
    theirs.Q, theirs.R = problem.Q, problem.R
    for k in range(1, STEPS):
        theirs.predict(u=problem.u[k - 1])
        theirs.update(problem.y[k])
    return np.asarray(theirs.x)


def by_filterpy_square_root(problem: Problem) -> FloatArray:
    """Run filterpy, square-root form."""
    from filterpy.kalman import SquareRootKalmanFilter

    theirs = SquareRootKalmanFilter(dim_x=problem.nx, dim_z=len(problem.C), dim_u=problem.nx)
    theirs.x, theirs.F, theirs.H = np.zeros((problem.nx, 1)), problem.A, problem.C
    theirs.B, theirs.P = np.eye(problem.nx), np.eye(problem.nx)
    theirs.Q, theirs.R = problem.Q, problem.R
    for k in range(1, STEPS):
        theirs.predict(u=problem.u[k - 1][:, None])
        theirs.update(problem.y[k][:, None])
    return np.asarray(theirs.x)[:, 0]


def by_pykalman(problem: Problem) -> FloatArray:
    """Run pykalman."""
    from pykalman import KalmanFilter

    theirs = KalmanFilter(
        transition_matrices=problem.A, observation_matrices=problem.C, transition_covariance=problem.Q,
        observation_covariance=problem.R, transition_offsets=problem.u[:-1], initial_state_mean=np.zeros(problem.nx),
        initial_state_covariance=np.eye(problem.nx),
    )  # fmt: skip
    # Its first sample corrects the prior; ours does not have one, so it is masked.
    y = np.ma.masked_array(problem.y, mask=False)
    y[0] = np.ma.masked
    return np.asarray(theirs.filter(y)[0][-1])


def by_statsmodels(problem: Problem) -> FloatArray:
    """Run the compiled filter of statsmodels."""
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

    theirs = KalmanFilter(k_endog=len(problem.C), k_states=problem.nx)
    y = problem.y.copy()
    y[0] = np.nan
    theirs.bind(y)
    theirs["design"], theirs["transition"], theirs["selection"] = problem.C, problem.A, np.eye(problem.nx)
    theirs["state_cov"], theirs["obs_cov"] = problem.Q, problem.R
    theirs["state_intercept"] = np.asfortranarray(problem.u.T)
    theirs.initialize_known(np.zeros(problem.nx), np.eye(problem.nx))
    # Else it stops to update the covariance once it has converged, and does another job.
    theirs.tolerance = 0.0
    return np.asarray(theirs.filter().filtered_state[:, -1])


def batched(problem: Problem) -> FloatArray:
    """Run many trials that share the model, with parameters."""
    observer = observer_of(problem, adaptive=True)
    y = np.broadcast_to(problem.y[:BATCH_STEPS], (TRIALS, BATCH_STEPS, len(problem.C)))
    return obsynth.run_batch(observer, y, problem.u[:BATCH_STEPS]).states[0, -1]


def rate(run: Callable[[], object], steps: int) -> float:
    """Return steps per second of processor time, best of several."""
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return steps / min(times)


CONTESTANTS: dict[str, tuple[str | None, Callable[[Problem], FloatArray]]] = {
    "obsynth, filter": (None, ours),
    "obsynth, filter, A as a stack": (None, lambda problem: ours(problem, varying=True)),
    "obsynth, filter, compiled": ("numba", ours_compiled),
    "obsynth, filter, compiled, A as a stack": ("numba", lambda problem: ours_compiled(problem, varying=True)),
    "filterpy": ("filterpy", by_filterpy),
    "filterpy, square root": ("filterpy", by_filterpy_square_root),
    "pykalman": ("pykalman", by_pykalman),
    "statsmodels": ("statsmodels", by_statsmodels),
}


def main() -> None:
    """Print the table."""
    print(f"Python {platform.python_version()}, numpy {np.__version__}, {platform.machine()}")
    if importlib.util.find_spec("numba") is not None:
        begin = time.perf_counter()
        importlib.import_module("obsynth.numerics.compiled_steps")
        print(f"The kernel was there after {time.perf_counter() - begin:.1f} s.")
    print("| steps per second | " + " | ".join(f"nx, ny, nq = {size}" for size in SIZES) + " |")
    print("| --- |" + " --- |" * len(SIZES))
    problems = [Problem.of(*size) for size in SIZES]
    exact = [ours(problem) for problem in problems]
    for name, (package, run) in CONTESTANTS.items():
        if package is not None and importlib.util.find_spec(package) is None:
            continue
        for problem, x in zip(problems, exact, strict=True):
            np.testing.assert_allclose(run(problem), x, rtol=0, atol=1e-9, err_msg=name)
        rates = [rate(lambda run=run, problem=problem: run(problem), STEPS) for problem in problems]
        print(f"| {name} | " + " | ".join(f"{value:,.0f}" for value in rates) + " |", flush=True)
    adaptive = [rate(lambda problem=problem: ours(problem, adaptive=True), STEPS) for problem in problems]
    print("| obsynth, adaptive observer | " + " | ".join(f"{value:,.0f}" for value in adaptive) + " |")
    trials = [rate(lambda problem=problem: batched(problem), TRIALS * BATCH_STEPS) for problem in problems]
    print(f"| obsynth, adaptive, {TRIALS} trials at once | " + " | ".join(f"{value:,.0f}" for value in trials) + " |")


if __name__ == "__main__":
    main()
