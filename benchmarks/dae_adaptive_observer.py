"""Steps per second of the observer of a nonlinear DAE on the heat exchanger, with every engine, and the EKF beside it.

Usage: ``python benchmarks/dae_adaptive_observer.py [--small]``.  One thread, processor time (of the C compiler, which
is a process of its own, wall time), best of several; the engines are compared first, so that nothing is timed that
computes something else.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import platform
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

import obsynth
from obsynth.methods.registry import method_class
from obsynth.observers.nonlinear.building import dae_observer_from_options
from obsynth.specs.loader import load_spec

SPEC = Path(__file__).parents[1] / "designs" / "moussaali2013_dae" / "spec.yaml"
SAMPLES, TRIALS, FEWER_TRIALS, REPEATS = 1001, 1000, 20, 5
FORMS = {"adaptive observer": {}, "augmented EKF": {"form": "augmented-kalman"}}


def record(observer: obsynth.DAEObserver, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs and inputs with both faults, 1 % of noise on the inlet flow, and the truth by Radau IIA."""
    model, rng = observer.model, np.random.default_rng(1)
    u = np.tile(model.nominal_input, (samples, 1))
    u[:, 0] *= 1.0 + 0.01 * rng.standard_normal(samples)
    k = np.arange(samples) * 1000 / samples
    faults = np.column_stack([np.interp(k, [200, 400], [1.0, 0.85]), np.where(k >= 600, 3000.0, 0.0)])
    return obsynth.simulate_dae(model, u, dt=1.0, parameters=faults, Q=observer.Q, R=observer.R, seed=1).outputs, u


def stepped(observer: obsynth.DAEObserver, y: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Run by the public `step`, one sample in and one row of estimates out."""
    running = observer.start()
    return np.array([running.step(y[k], u[k]).parameters[0] for k in range(len(y))])


def seconds(run: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return processor time, best of several."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        run()
        times.append(time.process_time() - begin)
    return min(times)


def measured(observer: obsynth.DAEObserver, samples: int, trials: int) -> dict[str, float]:
    """Return steps per second by engine, and seconds that setting up takes."""
    y, u = record(observer, samples)
    begin = time.process_time()
    fresh = replace(observer, model=observer.model.replace())
    fresh.run(y[:2], u[:2])
    found = {"set-up of the graph, s": time.process_time() - begin}
    begin = time.perf_counter()
    observer.library.started()
    found["set-up of the C, s"] = time.perf_counter() - begin
    many, few = (np.broadcast_to(y, (count, *y.shape)) for count in (trials, min(trials, FEWER_TRIALS)))
    ways: dict[str, tuple[Callable[[], np.ndarray], int, int]] = {
        "`step`, sample by sample": (lambda: stepped(observer, y, u), samples, REPEATS),
        "`run`": (lambda: observer.run(y, u).parameters, samples, REPEATS),
        "`run`, as C": (lambda: observer.run(y, u, compiled=True).parameters, samples, REPEATS),
        "`run_batch`, in CasADi": (
            lambda: obsynth.run_batch(observer, few, u, compiled=False).parameters[-1], few.shape[0] * samples, 2,
        ),
        f"`run_batch`, {trials} trials, as C": (
            lambda: obsynth.run_batch(observer, many, u, compiled=True).parameters[-1], trials * samples, 2,
        ),
    }  # fmt: skip
    exact = observer.run(y, u, compiled=False).parameters
    for name, (run, steps, repeats) in ways.items():
        np.testing.assert_allclose(run() / [0.1, 1e3], exact / [0.1, 1e3], rtol=0, atol=1e-10, err_msg=name)
        found[f"{name}, steps/s"] = steps / seconds(run, repeats)
    return found


def main() -> None:
    """Print the table."""
    small = "--small" in sys.argv[1:]
    samples, trials = (60, 3) if small else (SAMPLES, TRIALS)
    spec = load_spec(SPEC)
    asked = method_class("dae-adaptive-observer").of(spec.options)
    observer = dae_observer_from_options(spec.plant, asked.as_given())
    print(f"Python {platform.python_version()}, numpy {np.__version__}, CasADi {ca.__version__}, {platform.machine()}")
    print(f"| {samples - 1:,} steps | {' | '.join(FORMS)} |")
    print("| --- |" + " --- |" * len(FORMS))
    columns = [measured(replace(observer, **changes), samples, trials) for changes in FORMS.values()]
    for name in columns[0]:
        cells = [f"{column[name]:.2f}" if name.endswith(" s") else f"{column[name]:,.0f}" for column in columns]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
