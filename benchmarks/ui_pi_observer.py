"""The unknown-input PI observer of heated rods of many states: processor time on one thread, verification included.

``python benchmarks/ui_pi_observer.py [sizes ...]`` prints the table of ``benchmarks/README.md``.  ``--small`` runs one
small instance of each row, so that nothing here can rot.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import control
import numpy as np

import obsynth
from obsynth.specs.loader import load_spec

ROOT = Path(__file__).parents[1]
SAMPLE_TIME = 0.2
#: Ways to ask for gains, the same for every rod.
WAYS: dict[str, dict[str, Any]] = {
    "default": {},
    "noise weights": {"noise": {"measurement": 0.01, "process": 0.1}},
}


def rod(nx: int) -> obsynth.DescriptorSystem:
    """Return a heated rod: a fault in the middle, an unknown source at the end, three thermometers."""
    a = -2.0 * np.eye(nx) + np.eye(nx, k=1) + np.eye(nx, k=-1)
    places = np.eye(nx)[[nx // 4, nx // 2, nx - 1]]
    return obsynth.DescriptorSystem(None, a, C=places, Bf=places[1:2].T, Bd=places[2:].T)


def timed(work: Any) -> tuple[float, Any]:
    """Return the processor time of ``work()`` and what it returned."""
    start = time.process_time()
    found = work()
    return time.process_time() - start, found


def designed(plant: obsynth.DescriptorSystem, **options: Any) -> str:
    """Return time and slowest pole of a verified design."""
    seconds, design = timed(lambda: obsynth.ui_pi_observer(plant, **options))
    return f"{seconds:.2f} s, {design.certificate.claims['decay']:.3g} 1/s"


def kalman_filter(plant: obsynth.DescriptorSystem) -> str:
    """Return the same of control.lqe for the plant with a step model, the source as noise; nothing is verified."""
    nx = plant.nx
    a = np.zeros((nx + 1, nx + 1))
    a[:nx, :nx], a[:nx, nx:] = plant.A, plant.Bf
    c = np.hstack([plant.C, np.zeros((plant.ny, 1))])
    seconds, found = timed(lambda: control.lqe(a, np.eye(nx + 1), c, np.eye(nx + 1), np.eye(plant.ny)))
    return f"{seconds:.2f} s, {-np.max(np.linalg.eigvals(a - found[0] @ c).real):.3g} 1/s"


def main(arguments: list[str]) -> None:
    """Print the table."""
    small = "--small" in arguments
    sizes = [16] if small else [int(word) for word in arguments] or [30, 80, 200]
    columns = [*WAYS, f"sampled every {SAMPLE_TIME} s", "control.lqe, not decoupled"]
    print("| nx | " + " | ".join(columns) + " |")
    print("| --- |" + " --- |" * len(columns))
    for nx in sizes:
        plant = rod(nx)
        cells = [designed(plant, **options) for options in WAYS.values()]
        cells += [designed(obsynth.discretise(plant, SAMPLE_TIME).plant), kalman_filter(plant)]
        print(f"| {nx} | " + " | ".join(cells) + " |", flush=True)
    if small:
        return
    network = load_spec(ROOT / "designs" / "kundur" / "spec.yaml").plant
    for text, options in (
        ("default", {}),
        (
            "region: decay 0.2 1/s, damping 0.2, radius 60 1/s",
            {"region": {"decay": 0.2, "damping": 0.2, "radius": 60.0}},
        ),
    ):
        print(f"Kundur's network, 196 variables, {text}: {designed(network, **options)}")


if __name__ == "__main__":
    main(sys.argv[1:])
