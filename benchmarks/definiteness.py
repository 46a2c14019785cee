"""What a proof costs: processor time on one thread, forming the inequality with its error bounds included.

``python benchmarks/definiteness.py`` prints the table of ``benchmarks/README.md``; ``--small`` runs one small row.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import obsynth
from obsynth.methods.pd_observer.certificate_proofs import prove_gains
from obsynth.observers.linear.observer import LinearObserver
from obsynth.proofs.definiteness import LARGEST_ORDER, DefinitenessProof, prove_positive_definite
from obsynth.verification.inequalities import prove_bounded_real, prove_stable

SECONDS_PER_CELL = 1.0
Action = Callable[[], DefinitenessProof]


def conditioned(n: int, condition: float) -> Action:
    """A random symmetric matrix with this condition number."""
    basis = np.linalg.qr(np.random.default_rng(n).normal(size=(n, n)))[0]
    found = (basis * condition ** -np.linspace(0.0, 1.0, n)) @ basis.T
    symmetric = np.tril(found) + np.tril(found, -1).T
    return lambda: prove_positive_definite(symmetric)


def next_to_singular(n: int) -> Action:
    """Whole numbers, exactly singular, but for one diagonal entry that is one unit in the last place up."""
    factor = np.random.default_rng(n).integers(-9, 10, (n, n - 1)).astype(float)
    found = factor @ factor.T
    found[0, 0] = np.nextafter(found[0, 0], np.inf)
    return lambda: prove_positive_definite(found)


def contracting(n: int) -> np.ndarray:
    """Return a random matrix with norm 0.9."""
    a = np.random.default_rng(n).normal(size=(n, n))
    return 0.9 * a / np.linalg.norm(a, 2)


def lyapunov(n: int) -> Action:
    """Stability of a matrix of order n."""
    a = contracting(n)
    return lambda: prove_stable(a, np.eye(n), 1.0)


def bounded_real(n: int) -> Action:
    """The inequality of the fault-estimation filter: n states, n / 2 disturbances, one fault."""
    rng = np.random.default_rng([n, 1])
    a, column = contracting(n), np.zeros((n, 1))
    plant = obsynth.DescriptorSystem(
        None, a, C=rng.normal(size=(1, n)), Bd=0.1 * rng.normal(size=(n, n // 2)) / np.sqrt(n), Bf=column + 1.0, dt=1.0
    )
    observer = LinearObserver(
        Az=a, Bu=np.zeros((n, 0)), By=column, Cz=np.vstack([np.eye(n), 0.1 * rng.normal(size=(1, n)) / np.sqrt(n)]),
        Dy=np.zeros((n + 1, 1)), Du=np.zeros((n + 1, 0)), dt=1.0, input_names=(), output_names=plant.output_names,
        state_names=plant.state_names, fault_names=plant.fault_names, residual_names=(), state_delays=(0,) * n,
        fault_delays=(0,),
    )  # fmt: skip
    return lambda: prove_bounded_real(plant, observer, np.eye(n), np.eye(n), 10.0)


def pd_observer(n: int) -> Action:
    """The inequality of the PD observer for n unknown states."""
    a, none = contracting(n) - np.eye(n), np.zeros((n, 1))
    return lambda: prove_gains(a, none.T, none, none, np.eye(n), np.eye(n), delta=0.1, decay=0.0)


ROWS: dict[str, Callable[[int], Action]] = {
    "matrix of order n, condition 1e3": lambda n: conditioned(n, 1e3),
    "matrix of order n, condition 1e12": lambda n: conditioned(n, 1e12),
    "matrix of order n, one unit in the last place from singular": next_to_singular,
    "stability of n states": lyapunov,
    "PD observer, n states (order 2 n)": pd_observer,
    "fault-estimation filter, n states (order 2.5 n + 1)": bounded_real,
}


def cell(action: Action, seconds: float) -> str:
    """Return the mean processor time, and by what it was proved."""
    found, count, began = action(), 0, time.process_time()
    if not found.proved:
        return "not proved"
    while not count or time.process_time() - began < seconds:
        action()
        count += 1
    spent = time.process_time() - began
    return f"{1e3 * spent / count:.3g} ms{'' if found.means == 'Cholesky' else f', {found.means}'}"


def main(arguments: list[str]) -> None:
    """Print the table."""
    small = "--small" in arguments
    sizes = [4] if small else [16, LARGEST_ORDER, 200]
    print("| | " + " | ".join(f"n = {n}" for n in sizes) + " |")
    print("| --- |" + " --- |" * len(sizes))
    for name, make in ROWS.items():
        cells = [cell(make(n), 0.0 if small else SECONDS_PER_CELL) for n in sizes]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
