"""Gains with proved Lyapunov matrices for one parameter with a bounded rate, in continuous time.

``L(t) = P(t)^-1 Y(t)`` of `obsynth.conditions.rated_inequalities` is no mean of two gains.  What is shipped is: the
gains at its ends, and what lies between; that is analysed again, with a P(t) of its own, and proved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.conditions.rated_polytope import rated_inequalities
from obsynth.errors import SolverError
from obsynth.methods.engines.vertex_certificates import ROOMS, ErrorUnits, has_numbers
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.rated_inequalities import prove_rated_gain
from obsynth.verification.error_polytope import ErrorPolytope

#: Gains are sought at this multiple of the least level: those of the bare optimum are large.
ABOVE_LEAST = 1.1

#: Degree of P and pieces of [0, 1]: 3 and 8 prove a few per cent less, in twenty times the time.
DEGREE, PIECES = 2, 2


@dataclass(frozen=True, eq=False)
class RatedCertificate:
    """A gain over the region that is proved for slow courses.

    Parameters
    ----------
    P : list of FloatArray
        Bernstein coefficients of the Lyapunov matrix.
    level : float
        The L2 gain that is proved.
    runs : tuple of mapping
        Records of the solver.
    """

    P: list[FloatArray]
    level: float
    runs: tuple[Mapping[str, Any], ...]


def rated_certificate(
    errors: ErrorPolytope,
    rate: float,
    gains: Sequence[FloatArray],
    *,
    scale: float,
    solver: str = "CLARABEL",
    settings: Mapping[str, Any] | None = None,
) -> RatedCertificate | None:
    """Return a proof of the gain of given observers for slow courses; ``None`` without one.

    Parameters
    ----------
    errors : ErrorPolytope
        Two vertices.
    rate : float
        Largest change of the weight of the second one in a second.
    gains : sequence of FloatArray
        One, or one at each vertex.
    scale : float
        A gain of about the size, in whose units it is solved.
    solver, settings : optional
        As for `certified`.
    """
    units, runs = ErrorUnits.of(errors), list[dict[str, Any]]()
    unit = float(np.exp2(np.round(np.log2(scale)))) if scale > 0.0 else 1.0
    moved, own = units.moved(unit), units.gains_in(gains)
    problem = rated_inequalities(moved, rate, degree=DEGREE, pieces=PIECES, gains=own)
    if not has_numbers(problem, solver, settings, runs):
        return None
    least = float(np.sqrt(max(float(problem.variables["gamma_squared"].value), 0.0)))
    for room in ROOMS:
        target = (1.0 + room) * least
        if not target > 0.0:
            return None
        problem = rated_inequalities(moved, rate, degree=DEGREE, pieces=PIECES, gains=own, level=target)
        if not has_numbers(problem, solver, settings, runs):
            continue
        known = problem.gains()
        s = units.states / unit
        P = [known[f"P[{k + 1}]"] / s / s[:, None] for k in range(DEGREE + 1)]
        P = [0.5 * (matrix + matrix.T) for matrix in P]
        if prove_rated_gain(errors.closed(gains), P, rate, target * unit).proved:
            return RatedCertificate(P, target * unit, tuple(runs))
    return None


def rated_gains(
    errors: ErrorPolytope,
    rate: float,
    *,
    decay: float = 0.0,
    solver: str = "CLARABEL",
    settings: Mapping[str, Any] | None = None,
) -> list[FloatArray]:
    """Return gains at both vertices that are good for slow courses; nothing is proved of them.

    Parameters
    ----------
    errors : ErrorPolytope
        Two vertices, with inputs and noise.
    rate : float
        As for `rated_certificate`.
    decay : float, optional
        Errors are to decay like ``exp(-decay time)``.
    solver, settings : optional
        As for `certified`.

    Raises
    ------
    SolverError
        The solver has no numbers.
    """
    units, runs = ErrorUnits.of(errors), list[dict[str, Any]]()
    problem = rated_inequalities(units.moved(1.0), rate, degree=1, pieces=PIECES, decay=decay)
    if not has_numbers(problem, solver, settings, runs):
        raise SolverError("No Lyapunov matrix that moves with the parameter was found.", record=runs[-1])
    least = float(np.sqrt(max(float(problem.variables["gamma_squared"].value), 0.0)))
    problem = rated_inequalities(
        units.moved(1.0), rate, degree=1, pieces=PIECES, decay=decay, level=ABOVE_LEAST * least
    )
    if not has_numbers(problem, solver, settings, runs):
        raise SolverError("No Lyapunov matrix that moves with the parameter was found.", record=runs[-1])
    known = problem.gains()
    return [units.gain_out(known[f"L[{i + 1}]"]) for i in range(2)]
