"""Thresholds over tolerances: time for each sample, of robustness, and of many runs beside the nominal monitor.

Usage: ``python benchmarks/tolerances.py``.  Processor time on one thread.  Plants are made for the sizes that were
asked for: states in a stable chain, every second one measured, constants in entries of A, a disturbance and a fault.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import obsynth
from obsynth.monitoring.thresholds.adaptive_monitor import adaptive_plan
from obsynth.specs.loader import load_spec
from obsynth.verification.over_tolerances.adaptive_recursion import AdaptiveState, adaptive_step, thresholds_of_records

REPEATS, SAMPLES = 5, 4000
DESIGNS = Path(__file__).parents[1] / "designs"


def chain(nx: int, constants: int, rate: float) -> obsynth.DescriptorSystem:
    """Return a stable discrete plant with ``constants`` of 2 % in entries of A; ``rate`` is on its diagonal."""
    rng = np.random.default_rng(nx)
    a = rate * np.eye(nx) + 0.03 * np.eye(nx, k=1) - 0.03 * np.eye(nx, k=-1)
    rows: list[list[Any]] = a.tolist()
    for i in range(constants):
        row, column = i % nx, (i + i // nx) % nx
        rows[row][column] = f"{rows[row][column] or 0.02!r} * p{i}"
    ny = nx // 2 + 1
    c = np.zeros((ny, nx))
    c[np.arange(ny), np.minimum(2 * np.arange(ny), nx - 1)] = 1.0
    eye = np.eye(nx)
    plant = obsynth.uncertain_system(
        {"A": rows, "B": rng.normal(size=(nx, 1)), "C": c, "Bf": eye[:, :1], "Bd": eye[:, [nx // 2]], "dt": 1.0},
        {f"p{i}": {"nominal": 1.0, "tolerance": "2 %"} for i in range(constants)},
    )  # fmt: skip
    return plant.replace(Bw=np.zeros((nx, ny)), Dw=1e-3 * np.eye(ny), noise_names=None)


def seconds(work: Callable[[], Any]) -> float:
    """Return the median processor time of some calls."""
    found = []
    for _ in range(REPEATS):
        begin = time.process_time()
        work()
        found.append(time.process_time() - begin)
    return float(np.median(found))


def sampled(name: str, design: Any, disturbance: float, start: float) -> tuple[str, ...]:
    """Return the row of a design: states, constants, ring, microseconds for a sample of a record, and one at a time."""
    plant, observer = design.linear
    states = dict.fromkeys(plant.state_names, start)
    plan = adaptive_plan(design, np.full(plant.nd, disturbance), 3.0, initial_error=None, initial_set=states)[0]
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(SAMPLES, plant.nu)), rng.normal(size=(SAMPLES, plant.ny))
    found = observer.run(y, u if plant.nu else None)
    rows = np.hstack([found.states, found.faults, found.residuals]) @ plan.bound.structure.reading.T
    record = seconds(lambda: thresholds_of_records(plan.bound, rows[None], u[None], y[None]))

    def stepped() -> None:
        state = AdaptiveState.of(plan.bound)
        for k in range(SAMPLES):
            state, _ = adaptive_step(plan.bound, state, rows[k], u[k], y[k])

    each = seconds(stepped)
    return (name, str(plant.nx), str(len(plan.names)), str(plan.bound.length), f"{1e6 * record / SAMPLES:.0f}",
            f"{1e6 * each / SAMPLES:.0f}")  # fmt: skip


def evaluated(name: str, noise: float | None) -> tuple[str, ...]:
    """Return the row of a committed design: seconds of 1,000 runs under the nominal and the adaptive monitor."""
    spec = load_spec(DESIGNS / name / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method, **dict(spec.options))
    found = []
    for constants in (None, design.plant):
        monitor = obsynth.monitor(design, spec.scenario, constants=constants, noise_bound=noise)
        found.append(seconds(partial(obsynth.evaluate, design, spec.scenario, runs=1000, monitor=monitor)))
    return name, f"{found[0]:.2f}", f"{found[1]:.2f}", f"{found[1] / found[0]:.2f}"


def table(heading: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Print a table."""
    for row in (heading, tuple("---" for _ in heading), *rows):
        print("| " + " | ".join(row) + " |", flush=True)
    print()


def main() -> None:
    """Measure and print."""
    wang = load_spec(DESIGNS / "wang2015" / "spec.yaml")
    table(("plant", "states", "constants", "ring", "us a sample, record", "us a sample, one by one"), [
        sampled("wang2015", obsynth.design(wang.plant, wang.method), 0.1, 0.2),
        sampled("chain of 20", obsynth.fault_estimation_filter(chain(20, 5, 0.97)), 0.1, 0.1),
        sampled("chain of 50", obsynth.fault_estimation_filter(chain(50, 20, 0.9)), 0.1, 0.1),
    ])  # fmt: skip
    design = obsynth.fault_estimation_filter(chain(50, 20, 0.9))
    begin = time.process_time()
    found = obsynth.robustness(design)
    spent = time.process_time() - begin
    print(f"Robustness, 50 states, 20 constants: {spent:.1f} s (regular: {found.regular}, stable: {found.stable}, loop")
    print(f"radius {found.loop_radius:.3g}, finite up to {found.largest_factor:.3g} times the tolerances)\n")
    table(("1,000 runs of", "s, nominal", "s, adaptive", "times"),
          [evaluated("wang2015", None), evaluated("drive", 3.0), evaluated("smib", 3.0)])  # fmt: skip


if __name__ == "__main__":
    main()
