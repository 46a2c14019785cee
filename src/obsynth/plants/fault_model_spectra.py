"""Eigenvalues of fault models, each once, although rounding scatters multiple ones."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.log_balance import LogBalance

#: Distance, relative to the norm of a given matrix, below which computed eigenvalues count as one multiple eigenvalue:
#: a triple one scatters by the cube root of the unit roundoff.
MULTIPLE_EIGENVALUE = 1e-4
#: The same for built-in models, whose matrices are triangular or diagonalisable: only rounding separates copies.
SAME_EIGENVALUE = 1e-9


def stated_eigenvalues(phi: FloatArray) -> ComplexArray:
    """Return the distinct eigenvalues of a stacked transition ``(nw, nw)``, block by block where it falls apart."""
    linked = (phi != 0.0) | (phi.T != 0.0) | np.eye(len(phi), dtype=bool)
    for _ in range(len(phi)):
        linked = (linked.astype(float) @ linked.astype(float)) > 0.0
    values: list[complex] = []
    for members in sorted({tuple(np.flatnonzero(row).tolist()) for row in linked}):
        block = phi[np.ix_(members, members)]
        triangular = not np.any(np.tril(block, -1))
        found = np.unique(np.diag(block)) if triangular else distinct_eigenvalues(block, MULTIPLE_EIGENVALUE)
        values += [complex(value) for value in found if complex(value) not in values]
    return np.array(values, dtype=np.complex128)


def distinct_eigenvalues(matrix: FloatArray, tolerance: float) -> ComplexArray:
    """Return each eigenvalue once; those within ``tolerance`` times the balanced norm count as one, at their mean."""
    balanced = balanced_transition(matrix)[0]
    reach = tolerance * float(np.linalg.norm(balanced, 2))
    found: list[complex] = []
    waiting = [complex(value) for value in np.linalg.eigvals(balanced)]
    while waiting:
        near = [value for value in waiting if abs(value - waiting[0]) <= reach]
        waiting = [value for value in waiting if abs(value - waiting[0]) > reach]
        mean = sum(near) / len(near)
        # A cluster that scatters around the real axis is a real eigenvalue.
        found.append(complex(mean.real, 0.0) if abs(mean.imag) <= reach else mean)
    return np.array(found, dtype=np.complex128)


def balanced_transition(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a transition ``(n, n)`` with its states scaled by powers of two, and their factors ``(n,)``.

    The states of a fault model, such as f, f', f'', have sizes of their own.
    """
    n = len(matrix)
    problem = LogBalance(n + 1)
    # The unit of time is free: only the states are scaled.
    problem.add(matrix, range(n), range(n), signs=(-1, 1), common=n)
    states = np.exp2(np.round(problem.solve()[:n]))
    return np.asarray(matrix * states / states[:, None]), states
