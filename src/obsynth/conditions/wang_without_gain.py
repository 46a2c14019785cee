r"""Inequality (45) of Wang et al. 2015 after elimination of Y: the same P and gamma from two smaller inequalities.

(45) is affine in Y with nothing beside it, so that a Y exists if and only if (projection lemma) M < 0 and, with N a
basis of the null space of ``[C1 D1]``,

.. math::
    N^T \left( \begin{bmatrix} A_1 & TD \end{bmatrix}^T P \begin{bmatrix} A_1 & TD \end{bmatrix} + M \right) N < 0,
    \qquad M = \begin{bmatrix} -P & 0 \\ 0 & -\gamma^2 I \end{bmatrix} + Z^T Z.

``P^-1 Y = [A1 TD] (-M)^-1 [C1 D1]^T ([C1 D1] (-M)^-1 [C1 D1]^T)^-1`` then leaves the least matrix of all Y.  A weight
that is a variable stays in Z, before the Schur complement.  Solved in coordinates of a Riccati filter.

Source: P. Gahinet, P. Apkarian, A linear matrix inequality approach to H-infinity control, Int. J. Robust Nonlinear
Control 4 (1994).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.conditions.lmi import MARGIN
from obsynth.conditions.semidefinite_problem import SmallerProblem
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.central_filter import search_least_gain
from obsynth.numerics.injection_problem import GainProblem, normalise, null_basis
from obsynth.numerics.ranks import RANK_TOLERANCE

#: Eigenvalues of -M below this share of the largest are no better known by the solution of a solver.
SOLVED_SHARE = 1e-10


@dataclass(frozen=True, eq=False)
class WrittenIn:
    """The coordinates in which (45) stands: ``e = X xi``, ``R = R0 + X P^-1 Y rest`` (63), and where R acts."""

    X: FloatArray
    R0: FloatArray
    rest: FloatArray
    V: FloatArray  # measurements that no fault reaches: V' y


def wang_without_gain(
    convex: GainProblem, variables: dict[str, Any], level: Any | None, written_in: WrittenIn
) -> SmallerProblem:
    """Return (45) without Y in balanced coordinates.

    Parameters
    ----------
    convex : GainProblem
        The filter's error with R as the injection, in the plant's coordinates.
    variables : dict
        Those of (45), which get the values of its solution: ``P``, ``Y``, ``gamma_squared`` unless it is given, ``Vw``
        of a free weight.
    level : cvxpy.Parameter or None
        Gamma squared where it is given.
    written_in : WrittenIn
        The coordinates of P and Y.
    """
    start = search_least_gain(convex)
    normalised = normalise(convex, start=start.injection, gain=start.gain or None)
    X, unit = normalised.states, normalised.gain or 1.0
    n, nd, q = convex.A.shape[0], convex.B.shape[1], convex.Z.shape[0]
    G = np.hstack([np.linalg.solve(X, convex.A @ X), np.linalg.solve(X, convex.B) / unit])
    H = np.hstack([convex.C @ X, convex.D / unit])
    fixed = np.hstack([convex.Z @ X, convex.Zd / unit])
    N = null_basis(H)
    P = lmi.symmetric_variable(n)
    squared = cp.Variable(nonneg=True) if level is None else level / unit**2
    Vw = variables.get("Vw")
    own_weight = None if Vw is None else cp.Variable(Vw.shape)
    outputs = fixed if own_weight is None else fixed + own_weight @ H
    # Inputs that no estimate shows at once stand alone in M, where they say that the level is positive.
    counted = n + nd if convex.Zd.any() or convex.D.any() else n
    bases = {True: N, False: np.eye(n + nd)[:, :counted]}
    inequalities = []
    for moves, basis in bases.items():
        states, inputs, moved = basis[:n], basis[n:], G @ basis
        matrix = -(states.T @ P @ states) - squared * (inputs.T @ inputs)
        if moves:
            matrix = matrix + moved.T @ P @ moved
        # N takes the free part of the weight away, as it takes away what the outputs show.
        if own_weight is None or moves:
            inequalities.append(lmi.at_most(matrix + (fixed @ basis).T @ (fixed @ basis), -MARGIN))
        else:
            inequalities.append(lmi.at_most(lmi.symmetric_blocks([[matrix], [outputs @ basis, -np.eye(q)]]), -MARGIN))

    def set_values() -> None:
        value, gamma_squared = P.value, float(squared.value)
        weight = fixed if own_weight is None else fixed + own_weight.value @ H
        least = block_diag(value, gamma_squared * np.eye(nd)) - weight.T @ weight
        values, vectors = np.linalg.eigh((least + least.T) / 2.0)
        root = vectors / np.sqrt(np.maximum(values, SOLVED_SHARE * values[-1]))
        scaled_G, scaled_H = (root.T @ part.T for part in (G, H))
        R = X @ np.linalg.lstsq(scaled_H, scaled_G, rcond=None)[0].T
        change = np.linalg.solve(X, written_in.X)
        P_value = change.T @ value @ change
        # Of the plant's own measurements the rows are dependent, and what rounding leaves of that must not be inverted.
        back = np.linalg.pinv(written_in.rest, rcond=RANK_TOLERANCE)
        gain = np.linalg.solve(written_in.X, R @ written_in.V.T - written_in.R0) @ back
        variables["P"].save_value((P_value + P_value.T) / 2.0)
        variables["Y"].save_value(P_value @ gain)
        if level is None:
            variables["gamma_squared"].save_value(np.asarray(gamma_squared * unit**2))
        if own_weight is not None:
            variables["Vw"].save_value(own_weight.value)

    return SmallerProblem(cp.Problem(cp.Minimize(squared if level is None else 0), inequalities), set_values)
