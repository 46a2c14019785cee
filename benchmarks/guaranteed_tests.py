"""Guaranteed tests: what the number of states and of samples costs, in processor seconds and memory, and each row.

``python benchmarks/guaranteed_tests.py`` prints the tables of the README; each case has a process of its own.
``python benchmarks/guaranteed_tests.py --case NX N`` is one of them; ``--small`` runs two small ones in one process.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from time import perf_counter, process_time
from typing import Any

import numpy as np

CASES = [(nx, samples) for nx in (4, 10, 20, 40, 60) for samples in (3, 10, 30, 100)]
SMALL = [(4, 3), (4, 10)]
#: A case that takes longer is told as such.
SECONDS = 600.0
#: Windows of more equations are not for each row of a log.
MOST_EQUATIONS = 2000
ROWS, EXACT_ROWS = 20_000, 10
HEADER = (
    "nx",
    "N",
    "equations",
    "design, s",
    "verify, s",
    "MB",
    "us a row",
    "exact, ms a row",
    "threshold / least - 1",
)


def plant(nx: int) -> Any:
    """Return a chain of masses of water: the level of each third tank and of the last is measured, the first leaks."""
    import obsynth

    A = 0.9 * np.eye(nx) + 0.05 * np.eye(nx, k=1) + 0.05 * np.eye(nx, k=-1)
    measured = np.unique([*range(0, nx, 3), nx - 1])
    first, last = np.eye(nx)[:, [0]], np.eye(nx)[:, [-1]]
    return obsynth.DescriptorSystem(
        None, A, B=first, C=np.eye(nx)[measured], Bd=last, Bf=-first, dt=1.0,
        sensor_noise={f"y{k + 1}": 0.01 for k in range(len(measured))},
    )  # fmt: skip


def case(nx: int, samples: int) -> list[str]:
    """Return the cells of a row."""
    import obsynth

    system = plant(nx)
    begin = process_time()
    test = obsynth.guaranteed_test(system, course="constant", samples=samples, disturbance_bounds=0.1, noise_bound=3)
    design = process_time() - begin
    begin = process_time()
    passed = obsynth.verify(test).passed
    verify = process_time() - begin
    rng = np.random.default_rng(1)
    y, u = 0.01 * rng.standard_normal((ROWS, system.ny)), np.zeros((ROWS, 1))
    runs = []
    for _ in range(5):
        begin = perf_counter()
        test.observer.run(y, u)
        runs.append((perf_counter() - begin) / ROWS)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    equations = test.certificate.matrices["multipliers"].size
    exact = f"{1e3 * _exact(test, y, u):.3g}" if equations <= MOST_EQUATIONS else "-"
    gap = "not proved" if np.isnan(test.least) else f"{test.threshold / test.least - 1.0:.0e}"
    return [
        str(nx), str(samples), str(equations), f"{design:.3g}",
        f"{verify:.3g}" if passed else "fails", f"{memory:.0f}", f"{1e6 * min(runs):.2g}", exact, gap,
    ]  # fmt: skip


def _exact(test: Any, y: np.ndarray, u: np.ndarray) -> float:
    """Return the processor seconds that the least interval of a row takes, after the first."""
    from obsynth.methods.guaranteed_test.exact import Programmes

    programmes, length = Programmes.of(test), test.linear[1].order + 1
    programmes.interval(y[:length], u[:length])
    begin = process_time()
    for k in range(EXACT_ROWS):
        programmes.interval(y[k : k + length], u[k : k + length])
    return (process_time() - begin) / EXACT_ROWS


def main(arguments: list[str]) -> None:
    """Print the table."""
    if arguments[:1] == ["--case"]:
        print(" | ".join(case(int(arguments[1]), int(arguments[2]))))
        return
    print(f"| {' | '.join(HEADER)} |\n|{' --- |' * len(HEADER)}")
    if "--small" in arguments:
        for nx, samples in SMALL:
            print(f"| {' | '.join(case(nx, samples))} |", flush=True)
        return
    for nx, samples in CASES:
        command = [sys.executable, __file__, "--case", str(nx), str(samples)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=SECONDS)
            said = done.stdout.strip() or (done.stderr.strip().splitlines() or ["?"])[-1][:100]
        except subprocess.TimeoutExpired:
            said = f"{nx} | {samples} | more than {SECONDS:.0f} s"
        print(f"| {said} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
