"""Optimal filters of random plants: processor time on one thread of design with all its proofs, and the gap proved.

``python benchmarks/optimal_filter.py [sizes ...]`` prints the table of ``benchmarks/README.md``.  ``--small`` runs one
small instance of each row, so that nothing here can rot.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import obsynth

SEEDS = 5
#: Noise of the plant: one disturbance of the states, or one for each state; always one for each output.
FAMILIES = ("one", "every state")
PROBLEMS: dict[str, tuple[float, dict[str, Any]]] = {
    "delay 1": (1.0, {"delay": 1}),
    "matching": (1.0, {"reference": {"bandwidth": 0.7}, "exact": False}),
    "continuous": (0.0, {"reference": {"bandwidth": 2.0}}),
}


def random_plant(family: str, n: int, seed: int, dt: float) -> obsynth.DescriptorSystem:
    """Return a stable plant of three outputs and two faults."""
    rng = np.random.default_rng([98, n, seed])
    a = rng.normal(size=(n, n))
    radius = float(np.max(np.abs(np.linalg.eigvals(a))))
    a = 0.95 / radius * a if dt else a - (radius + 0.1) * np.eye(n)
    b, c, faults = rng.normal(size=(n, 1)), rng.normal(size=(3, n)), rng.normal(size=(n, 2))
    driven = rng.normal(size=(n, 1)) if family == FAMILIES[0] else 0.05 * rng.normal(size=(n, n))
    return obsynth.DescriptorSystem(
        A=a,
        B=b,
        C=c,
        Bf=faults,
        Bw=np.hstack([driven, np.zeros((n, 3))]),
        Dw=np.hstack([np.zeros((3, driven.shape[1])), 0.05 * np.eye(3)]),
        dt=dt,
    )


def row(family: str, n: int, seeds: int) -> str:
    """Return the row of a family and a size."""
    cells = [family, str(n)]
    for dt, options in PROBLEMS.values():
        seconds, gaps = [], []
        for seed in range(seeds):
            plant = random_plant(family, n, seed, dt)
            start = time.process_time()
            design = obsynth.optimal_filter(plant, **options)
            seconds.append(time.process_time() - start)
            gaps.append((design.gain - design.least) / design.gain)
        cells.append(f"{np.median(seconds):.2f}, {max(seconds):.2f} ({max(gaps):.0e})")
    return f"| {' | '.join(cells)} |"


def main(arguments: list[str]) -> None:
    """Print the table."""
    small = "--small" in arguments
    sizes = [3] if small else [int(text) for text in arguments] or [4, 8, 16, 30]
    # The first design loads what all of them need.
    obsynth.optimal_filter(random_plant(FAMILIES[0], 2, 0, 1.0), delay=2)
    print(f"| noise of the states | nx | {' | '.join(PROBLEMS)} |\n|{' --- |' * (2 + len(PROBLEMS))}")
    for family in FAMILIES:
        for n in sizes:
            print(row(family, n, 1 if small else SEEDS), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
