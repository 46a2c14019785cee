"""What a design over a region costs: processor time on one thread, by states and vertices.

``python benchmarks/over_region.py`` prints the table of ``benchmarks/README.md``; ``--small`` runs two small rows.
"""

from __future__ import annotations

import os
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from obsynth.conditions import ErrorPolytope, vertex_inequalities
from obsynth.methods.engines.vertex_certificates import certified
from obsynth.proofs.vertex_inequalities import prove_gain

STATES, VERTICES = (4, 8, 16), (2, 4, 8, 16, 32, 64)
SMALL_STATES, SMALL_VERTICES = (2,), (2, 4)
OUTPUTS, DISTURBANCES, GOALS = 2, 2, 2
#: By how much vertices differ, and how fast the middle decays.
SPREAD, SLOWEST = 0.1, 0.95


def random_errors(n: int, count: int) -> ErrorPolytope:
    """Return a sampled error system with two outputs, two disturbances, their noise, and two errors that count."""
    rng = np.random.default_rng([n, count])
    middle = rng.standard_normal((n, n))
    middle *= SLOWEST / np.abs(np.linalg.eigvals(middle)).max()
    A = [middle + SPREAD / np.sqrt(n) * rng.standard_normal((n, n)) for _ in range(count)]
    B = np.hstack([rng.standard_normal((n, DISTURBANCES)), np.zeros((n, OUTPUTS))])
    D = np.hstack([np.zeros((OUTPUTS, DISTURBANCES)), 0.5 * np.eye(OUTPUTS)])
    return ErrorPolytope(A, rng.standard_normal((OUTPUTS, n)), B=B, D=D, Cz=rng.standard_normal((GOALS, n)))


def row(n: int, count: int) -> tuple[float, float, float]:
    """Return seconds of the least gain, of a design whose claim is proved, and of the proof of one vertex."""
    errors = random_errors(n, count)
    start = time.process_time()
    vertex_inequalities(errors).solve()
    solved = time.process_time()
    made = certified(errors)
    designed = time.process_time()
    proof = prove_gain(errors.closed(made.gains), made.witness, made.level, discrete=True)
    if not proof.proved:
        raise SystemExit(f"{n} states, {count} vertices: the claim is not proved: {proof.reason}")
    return solved - start, designed - solved, (time.process_time() - designed) / count


def main() -> None:
    """Print the table."""
    small = "--small" in sys.argv[1:]
    row(2, 2)  # what is imported at the first problem is no part of a time
    print("| states | vertices | least gain | design with a proof | proof of a vertex |")
    print("| --- | --- | --- | --- | --- |")
    for n in SMALL_STATES if small else STATES:
        for count in SMALL_VERTICES if small else VERTICES:
            least, design, proof = row(n, count)
            print(f"| {n} | {count} | {least:.2f} s | {design:.2f} s | {1e3 * proof:.1f} ms |", flush=True)


if __name__ == "__main__":
    main()
