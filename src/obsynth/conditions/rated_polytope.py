r"""Observers of polytopic plants whose parameter has a bounded rate: inequalities in a parameter-dependent P(t).

Time is continuous and there are two vertices: t in [0, 1] is the weight of the second vertex, and changes by at most
nu per second.  P(t), and Y(t) of the gain ``L(t) = P(t)^-1 Y(t)``, are polynomials in t in Bernstein form.  If for all
t and both signs

.. math::
    \begin{bmatrix} \mathrm{He}(P A - Y C) \pm \nu P' & P B - Y D & C_z^T \\ * & -\gamma^2 I & D_z^T \\ * & * & -I
    \end{bmatrix} < 0, \qquad P > 0 \tag{V6}

then the L2 gain of the error system from w to z is at most gamma.  For a decay ``exp(-a time)`` the term ``2 a P`` is
added to the first block, and the rows of w and z are left out.  The polynomial in t is negative definite on [0, 1] if
all its Bernstein coefficients on equal pieces of [0, 1] are (`obsynth.numerics.bernstein`).  For given gains, with L
linear in t, ``P (A - L C)`` takes the place of ``P A - Y C``.

Reference: Wu, Yang, Packard, Becker, Int. J. Robust Nonlinear Control 6 (1996).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.conditions.lmi import MARGIN
from obsynth.conditions.polytope import MOST_ROOM, TRACE
from obsynth.conditions.problem import Conditions, Values
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, chosen, real_number, shown
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.bernstein import coefficients_on_pieces, product_coefficients
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_polytope import ErrorPolytope


@arguments_checked
def rated_inequalities(
    errors: ErrorPolytope,
    rate: float,
    *,
    goal: str = "gain",
    level: float | None = None,
    decay: float = 0.0,
    degree: int = 1,
    pieces: int = 4,
    gains: Sequence[FloatArray] | None = None,
    gain_limit: float | None = None,
    margin: float = MARGIN,
) -> Conditions:
    """Return the inequalities in P and Y for an error system whose parameter has a bounded rate.

    Parameters
    ----------
    errors : ErrorPolytope
        Two vertices, in continuous time, without algebraic errors; C and D are constant unless gains are given.
    rate : float
        Largest rate of the weight of the second vertex, in 1/s: the weight moves between 0 and 1.
    goal : {"gain", "decay"}, optional
        Minimise the L2 gain from w to z, or maximise the slack of the inequality of ``decay``.
    level : float, optional
        A fixed L2 gain: the slack at this level is maximised instead, so that a proof has room for rounding.
    decay : float, optional
        Errors decay at least like ``exp(-decay time)``, in 1/s; both goals include it.
    degree : int, optional
        Degree of P and Y in t, 0 to 5.
    pieces : int, optional
        Number of equal pieces of [0, 1], a power of two: more pieces are less conservative and cost more.
    gains : sequence of array_like, optional
        Gains to be analysed: one constant gain, or one for each end with linear interpolation between.
    gain_limit : float, optional
        Largest Frobenius norm of each coefficient of Y.
    margin : float, optional
        Least slack of every inequality, where the slack is not maximised.

    Returns
    -------
    Conditions
        Variables ``P[1]``, ..., ``Y[1]``, ... (Bernstein coefficients), and ``gamma_squared`` or ``room`` (the slack);
        gains ``P[1]``, ..., and ``L[1]``, ``L[2]`` at the two ends.

    Raises
    ------
    SpecError
        An option is out of range, or the error system is of another kind.

    Examples
    --------
    The commutator of a time-varying gain with the lag ``1 / (s + 1)`` has an L2 gain of 1 for arbitrarily fast gains,
    and of about the rate for slow ones.

    >>> import numpy as np
    >>> errors = ErrorPolytope(
    ...     [-np.eye(2)] * 2, np.zeros((0, 2)), B=[[[1.0], [-1]], [[1.0], [1]]], Cz=[[[-1.0, -1]], [[1.0, -1]]], dt=0.0
    ... )
    >>> conditions = rated_inequalities(errors, 0.1, degree=1, pieces=4)
    >>> _ = conditions.solve()
    >>> 0.2 < float(conditions.variables["gamma_squared"].value) ** 0.5 < 0.8
    True
    """
    chosen(goal, "goal", ("gain", "decay"))
    _require_fitting(errors, rate, level, decay, gains)
    n, m = errors.order, errors.outputs
    P = [cp.Variable((n, n), symmetric=True, name=f"P[{k + 1}]") for k in range(degree + 1)]
    fixed_gains = None if gains is None else [np.asarray(L, np.float64) for L in gains]
    Y = [cp.Variable((n, m), name=f"Y[{k + 1}]") for k in range(degree + 1)] if fixed_gains is None else []
    room = cp.Variable(name="room") if goal == "decay" or level is not None else None
    slack: Any = margin if room is None else room
    squared = cp.Variable(nonneg=True, name="gamma_squared") if room is None else None
    constraints: dict[str, Any] = {}
    for place, weights in coefficients_on_pieces(degree, pieces):
        constraints[f"P, {place}"] = lmi.at_least(_sum(P, weights), slack)
    gamma_squared = squared if level is None else level**2
    matrices = _coefficients_v6(errors, (P, Y), gamma_squared, fixed_gains, rate, decay, goal, pieces)
    constraints |= {name: lmi.at_least(lmi.symmetric_blocks(lower), slack) for name, lower in matrices}
    variables = {each.name(): each for each in (*P, *Y)}
    if room is not None:
        variables["room"] = room
        constraints["room"] = room <= MOST_ROOM
    else:
        variables["gamma_squared"] = squared
    if goal == "decay":
        constraints["trace"] = sum(cp.trace(each) for each in P) <= TRACE * n
    if gain_limit is not None:
        constraints |= {f"limit, {each.name()}": cp.norm(each, "fro") <= gain_limit for each in Y}

    def own_gains(_: Values) -> dict[str, FloatArray]:
        values = {each.name(): 0.5 * (each.value + each.value.T) for each in P}
        ends = fixed_gains or [np.linalg.solve(values[P[k].name()], Y[k].value) for k in (0, degree)]
        return values | {f"L[{i + 1}]": np.asarray(L) for i, L in enumerate(ends)}

    def unsupported(_: dict[str, FloatArray], name: str) -> ObserverDesign:
        raise SpecError(f"The error system of {name!r} has no plant: design by a method.", path="errors")

    return Conditions(
        "inequalities of a slow parameter (V6)",
        lmi.semidefinite_problem(
            cp.Maximize(room) if room is not None else cp.Minimize(squared), list(constraints.values())
        ),
        variables,
        {},
        {f"A[{i + 1}]": matrix for i, matrix in enumerate(errors.A)},
        constraints,
        tuple,
        own_gains,
        unsupported,
    )


def _coefficients_v6(
    errors: ErrorPolytope,
    unknowns: tuple[Sequence[Any], Sequence[Any]],
    gamma_squared: Any,
    gains: Sequence[FloatArray] | None,
    rate: float,
    decay: float,
    goal: str,
    pieces: int,
) -> Iterator[tuple[str, list[list[Any]]]]:
    """Yield the name and the lower blocks of each Bernstein coefficient of the negated matrix of (V6)."""
    P, Y = unknowns
    closed = None if gains is None else [errors.at(vertex, gains) for vertex in np.eye(2)]
    A, B = (errors.A, errors.B) if closed is None else ([c[0] for c in closed], [c[1] for c in closed])
    p, q = errors.inputs, len(errors.Cz[0])
    for at in product_coefficients(len(P) - 1, pieces):
        low, high = _sum(P, at.low), _sum(P, at.high)
        PA, PB = low @ A[0] + high @ A[1], low @ B[0] + high @ B[1]
        if Y:
            Y_at = _sum(Y, at.low + at.high)
            PA, PB = PA - Y_at @ errors.C[0], PB - Y_at @ errors.D[0]
        Z, Dz = (at.ends[0] * matrix[0] + at.ends[1] * matrix[1] for matrix in (errors.Cz, errors.Dz))
        for sign in (-1.0, 1.0) if rate else (1.0,):
            first = -2.0 * PA - sign * rate * _sum(P, at.slope) - 2.0 * decay * (low + high)
            lower = [[first]]
            if goal == "gain":
                lower = [[first], [-PB.T, at.scale * gamma_squared * np.eye(p)], [-Z, -Dz, at.scale * np.eye(q)]]
            yield f"(V6) {'+' if sign > 0.0 else '-'}, {at.place}", lower


def _require_fitting(errors: ErrorPolytope, rate: float, level: Any, decay: Any, gains: Any) -> None:
    if errors.count != 2:
        raise SpecError(
            f"A rate is for two vertices (one parameter that enters linearly), there are {errors.count}: leave it out.",
            path="rate",
        )
    if errors.dt > 0.0 or errors.ball or (errors.differential or errors.order) != errors.order:
        raise SpecError(
            "These inequalities are for continuous time, without algebraic errors: take vertex_inequalities, with "
            "steps in discrete time.",
            path="errors",
        )
    if not (np.isfinite(rate) and rate >= 0.0):
        raise SpecError(
            f"rate is {shown(rate)}: give a finite number, 0 or more, or vertex_inequalities for any course.",
            path="rate",
        )
    if level is not None:
        real_number(level, "level", "a positive number", above=0.0)
    if not decay >= 0.0:
        raise SpecError(f"decay is {shown(decay)}: give a rate, 0 or more.", path="decay")
    if gains is None and not errors.constant_output:
        raise SpecError("A gain that changes needs the same C and D at both vertices: give gains.", path="gains")
    if gains is not None:
        errors.closed(gains)


def _sum(parts: Sequence[Any], weights: FloatArray) -> Any:
    return sum(float(weight) * part for part, weight in zip(parts, weights, strict=True) if weight) + 0.0 * parts[0]
