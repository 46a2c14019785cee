r"""Observers of plants with slopes between bounds by one inequality with a multiplier, in continuous time.

``E e' = (A + W diag(d) V - L (C + Wy diag(d) V)) e + (B - L D) w``, ``z = Cz e``, every ``|d_k| <= 1`` as it likes, one
gain L, ``Y = G' L``:

.. math::
    \begin{bmatrix} \mathrm{He}(G^T A - Y C) + V^T Q V + C_z^T C_z & G^T W - Y W_y + V^T S & G^T B - Y D \\
    * & R & 0 \\ * & * & -\gamma^2 I \end{bmatrix} < 0

A diagonal multiplier is ``Q = T = -R >= 0``, ``S = 0`` (M1); a full one has ``Q + S d + d S' + d R d >= 0`` at the
corners of d and ``R_kk <= 0``, so that the corners suffice (M2).  By the S-procedure the inequality then holds for
every d: it is of order n + q, where those at the corners are ``2^q`` of order n.

References: Scherer, Weiland, *Linear Matrix Inequalities in Control*, chapter 6; Boyd et al. 1994, chapter 5.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.conditions.lmi import MARGIN
from obsynth.conditions.polytope import MOST_DECAY_ROOM, MOST_ROOM, TRACE, descriptor_variables
from obsynth.conditions.problem import Conditions, Values
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, chosen, require_shape, shown
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.suggestions import fields_suggested
from obsynth.proofs.extended_balls import Enclosed
from obsynth.proofs.slope_blocks import SlopeBlock
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_polytope import ErrorPolytope

#: Slopes of a full multiplier, whose conditions stand at 2 ** 6 corners; more take a diagonal one.
MOST_IN_FULL_MULTIPLIER = 6


@fields_suggested
@dataclass(frozen=True, eq=False)
class SlopedErrors:
    """An error system with slopes between -1 and 1.

    Parameters
    ----------
    nominal : ErrorPolytope
        One vertex, in continuous time.
    W, Wy, V : FloatArray
        ``(n, q)``, ``(m, q)`` and ``(q, n)``.
    """

    nominal: ErrorPolytope
    W: FloatArray
    Wy: FloatArray
    V: FloatArray

    @property
    def count(self) -> int:
        """Number of slopes."""
        return int(self.W.shape[1])

    def closed(self, gain: FloatArray) -> SlopeBlock:
        """Return how the closed error system is formed, of a gain ``(n, m)``."""

        def slopes(kind: type[Enclosed]) -> tuple[Enclosed, Enclosed]:
            exact = kind.exact
            return exact(self.W) - exact(gain) @ exact(self.Wy), exact(self.V)

        return SlopeBlock(self.nominal.closed([gain])[0], slopes, self.count)


@arguments_checked
def slope_inequality(
    errors: SlopedErrors,
    *,
    goal: str = "gain",
    multiplier: str = "full",
    level: float | None = None,
    decay: float | None = None,
    gain: FloatArray | None = None,
    gain_limit: float | None = None,
    decay_metric: FloatArray | None = None,
    margin: float = MARGIN,
) -> Conditions:
    """Return the inequality with a multiplier, in P and Y.

    Parameters
    ----------
    errors : SlopedErrors
        In continuous time.
    goal : {"gain", "power", "decay"}, optional
        The least L2 gain, the least mean square for unit white w, or the largest slack of ``decay``.
    multiplier : {"full", "diagonal"}, optional
        A full one for up to six slopes.
    level : float, optional
        A given gain (or root mean square): the largest slack at that level is sought instead.
    decay : float, optional
        Errors decay at least like ``exp(-decay t)``.
    gain : array_like, optional
        A given gain ``(n, m)``, which is analysed.
    gain_limit : float, optional
        The largest Frobenius norm of Y.
    decay_metric : array_like, optional
        P of an earlier solution, for goal "decay": the slack is then sought in multiples of it, by which the next decay
        follows (Dinkelbach's iteration).
    margin : float, optional
        What the inequalities keep to the boundary of the cone.

    Returns
    -------
    Conditions
        Variables ``P1``, ``P2``, ``P3``, ``Y`` and ``gamma_squared``, ``mean_square`` or ``room``; gains ``L[1]``, and
        of a diagonal multiplier ``T[gain]``, ``T[power]``, ``T[decay]``.

    Raises
    ------
    SpecError
        An option is out of range, or a full multiplier has too many slopes.

    Examples
    --------
    >>> import numpy as np
    >>> nominal = ErrorPolytope([[[0, 1], [-2.0, -1]]], np.zeros((0, 2)), dt=0.0)
    >>> spring = SlopedErrors(nominal, np.array([[0], [1.0]]), np.zeros((0, 1)), np.array([[1.0, 0]]))
    >>> conditions = slope_inequality(spring, goal="decay", decay=0.0)
    >>> _ = conditions.solve()
    >>> bool(conditions.variables["room"].value > 1e-3)
    True
    """
    _require_options(errors, goal, multiplier, decay, decay_metric)
    own = errors.nominal
    n, k, m, p = own.order, own.differential or own.order, own.outputs, own.inputs
    P, G = descriptor_variables(n, k)
    Y1 = cp.Variable((k, m), name="Y")
    given = None if gain is None else as_matrix(gain, "gain")
    if given is not None:
        require_shape(given.shape, (n, m), "gain")
    Y = cp.vstack([Y1, np.zeros((n - k, m))]) if k < n else Y1
    Y = Y if given is None else G.T @ given
    room = cp.Variable(name="room") if goal == "decay" or level is not None else None
    slack: Any = margin if room is None or decay_metric is not None else room
    name = "gamma_squared" if goal == "gain" else "mean_square"
    squared: Any = cp.Variable(nonneg=True, name=name) if level is None else level**2
    GB, Z = G.T @ own.B[0] - Y @ own.D[0], own.Cz[0]
    collected = _Inequalities(
        errors, multiplier, slack, squared, G.T @ own.A[0] - Y @ own.C[0], G.T @ errors.W - Y @ errors.Wy, GB, {}, {}
    )
    constraints = collected.constraints
    constraints["P"] = lmi.at_least(P[:k, :k], slack)
    if goal == "gain":
        collected.add("gain", Z.T @ Z, driven=True)
    if goal == "power":
        collected.add("power", Z.T @ Z, driven=False)
        noise = cp.Variable((p, p), symmetric=True)
        constraints["trace"] = cp.trace(noise) + slack <= squared
        constraints["noise"] = lmi.at_least(lmi.symmetric_blocks([[noise], [GB[:k], P[:k, :k]]]), 0.0)
    if decay is not None:
        beside = 0.0 if decay_metric is None or room is None else 2.0 * room * np.asarray(decay_metric)
        collected.add("decay", 2.0 * decay * P + beside, driven=False)
    most = MOST_ROOM if decay_metric is None else MOST_DECAY_ROOM
    constraints |= _limits(goal, P, (room, most), Y1, gain_limit if given is None else None)
    objective = cp.Minimize(squared) if room is None else cp.Maximize(room)
    variables = {part.name(): part for part in (*P.variables(), *G.variables(), *([Y1] if given is None else []))}
    variables |= {"room": room} if room is not None else {name: squared}

    def gains(_: Values) -> dict[str, FloatArray]:
        L = np.linalg.solve(np.asarray(G.value).T, np.asarray(Y.value)) if given is None else given
        return {"L[1]": L, "P": np.asarray(P.value), "G": np.asarray(G.value)} | collected.multiplier_values()

    return Conditions(
        f"one inequality with a {multiplier} multiplier",
        lmi.semidefinite_problem(objective, list(constraints.values())),
        variables,
        {},
        {"A": own.A[0], "W": errors.W, "V": errors.V, "Wy": errors.Wy},
        constraints,
        tuple,
        gains,
        _no_design,
    )


@dataclass(frozen=True, eq=False)
class _Inequalities:
    """The inequalities with multipliers, as they are collected: each with multipliers of its own."""

    errors: SlopedErrors
    kind: str
    slack: Any
    squared: Any
    GA: Any
    GW: Any
    GB: Any
    constraints: dict[str, Any]
    multipliers: dict[str, Any]

    def add(self, name: str, first: Any, *, driven: bool) -> None:
        """Add the inequality with ``first`` beside the states, and with the inputs where it is ``driven``."""
        errors, p = self.errors, self.errors.nominal.inputs
        Q, S, R, more = _multiplier(errors.count, self.kind, name)
        self.constraints.update(more)
        if self.kind == "diagonal":
            self.multipliers[f"T[{name}]"] = -R
        lower = [[-(2.0 * self.GA + first + errors.V.T @ Q @ errors.V)], [-(self.GW + errors.V.T @ S).T, -R]]
        if driven:
            lower.append([-self.GB.T, np.zeros((p, errors.count)), self.squared * np.eye(p)])
        self.constraints[name] = lmi.at_least(lmi.symmetric_blocks(lower), self.slack)

    def multiplier_values(self) -> dict[str, FloatArray]:
        """Return the diagonal multipliers of a solution."""
        return {name: np.diag(np.asarray(T.value)) for name, T in self.multipliers.items()}


def _no_design(_: dict[str, FloatArray], name: str) -> ObserverDesign:
    raise SpecError(f"The error system of {name!r} has no plant: design by obsynth.region_observer.", path="errors")


def _limits(goal: str, P: Any, slack: tuple[Any, float], Y: Any, gain_limit: float | None) -> dict[str, Any]:
    """Return what bounds the slack, the scale of a homogeneous inequality, and the gain."""
    limits: dict[str, Any] = {}
    room, most = slack
    if room is not None:
        limits["room"] = room <= most
    if goal == "decay":
        limits["trace"] = cp.trace(P) <= TRACE * P.shape[0]
    if gain_limit is not None:
        limits["limit"] = cp.norm(Y, "fro") <= gain_limit
    return limits


def _require_options(
    errors: SlopedErrors, goal: str, multiplier: str, decay: float | None, decay_metric: FloatArray | None
) -> None:
    chosen(goal, "goal", ("gain", "power", "decay"))
    chosen(multiplier, "multiplier", ("full", "diagonal"))
    if multiplier == "full" and errors.count > MOST_IN_FULL_MULTIPLIER:
        raise SpecError(
            f"A full multiplier for {errors.count} slopes stands at 2 ** {errors.count} corners: take "
            "multiplier='diagonal'.",
            path="multiplier",
        )
    if decay is not None and not decay >= 0.0:
        raise SpecError(f"decay is {shown(decay)}: give a rate, 0 or more.", path="decay")
    if goal == "decay" and decay is None:
        raise SpecError("goal 'decay' needs the rate: give decay.", path="decay")
    if decay_metric is not None and goal != "decay":
        raise SpecError("A metric of the decay is for goal 'decay': leave it out.", path="decay_metric")


def _multiplier(q: int, kind: str, name: str) -> tuple[Any, Any, Any, dict[str, Any]]:
    """Return Q, S and R with what they must satisfy."""
    if kind == "diagonal":
        T = cp.Variable(q, nonneg=True)
        return cp.diag(T), np.zeros((q, q)), -cp.diag(T), {}
    Q, R = cp.Variable((q, q), symmetric=True), cp.Variable((q, q), symmetric=True)
    S = cp.Variable((q, q))
    more: dict[str, Any] = {f"concave, {name}": cp.diag(R) <= 0}
    for place, corner in enumerate(itertools.product((-1.0, 1.0), repeat=q)):
        d = np.diag(corner)
        more[f"corner {place + 1}, {name}"] = lmi.at_least(Q + S @ d + d @ S.T + d @ R @ d, 0.0)
    return Q, S, R, more
