r"""Observers of polytopic plants by matrix inequalities at the vertices: gain, mean square, decay.

The error system is ``e+ = (A - L C) e + (B - L D) w``, ``z = Cz e + Dz w`` with matrices in the convex hull of vertices
(`obsynth.verification.error_polytope`), and ``Y_i = P L_i``.  One common P covers arbitrary changes of the weights:

.. math::
    \begin{bmatrix} P & 0 & (P A_i - Y_i C)^T & C_{z,i}^T \\ * & \gamma^2 I & (P B_i - Y_i D)^T & D_{z,i}^T \\
    * & * & P & 0 \\ * & * & * & I \end{bmatrix} > 0 \tag{V1}

    \begin{bmatrix} P - C_z^T C_z & (P A_i - Y_i C)^T \\ * & P \end{bmatrix} > 0, \quad
    \mathrm{tr}\, B_{cl}^T P B_{cl} + |D_z|^2 < J \tag{V2}

With P at each vertex and a slack G (V3), each inequality belongs to a pair (i, j) of vertices, now and at the next
sample.  ``P_i`` is in the first place, ``G_i + G_i' - P_j`` in the third, ``G_i'`` replaces P in products, and
``L_i = G_i^-T F_i``.  If the weight changes by at most ``steps`` in a sample, the pairs are the corners of a hexagon,
with one common G.  In continuous time

.. math::
    \begin{bmatrix} \mathrm{He}(P A_i - Y_i C) + C_z^T C_z & P B_i - Y_i D + C_z^T D_z \\ * & D_z^T D_z - \gamma^2 I
    \end{bmatrix} < 0 \tag{V4}

where P is ``[[P1, 0], [P2, P3]]`` if the last errors are algebraic.  For an uncertainty R of A, ``|R| <= rho``, the
S-procedure subtracts ``rho^2 t I`` from the first place and adds a row and a column with P (in discrete time G) and
``t I``.

References: Boyd, El Ghaoui, Feron, Balakrishnan 1994; Daafouz, Bernussou, Syst. Control Lett. 43 (2001); de Oliveira,
Bernussou, Geromel, Syst. Control Lett. 37 (1999).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.conditions.lmi import MARGIN
from obsynth.conditions.problem import Conditions, Values
from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, chosen, real_number, shown
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.vertex_inequalities import Pair, Witness, pairs_of
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_polytope import ErrorPolytope

#: Homogeneous problems (decay alone) are normalised: the trace of P is at most the order times this.
TRACE = 1.0
#: Upper bound of a maximised slack, without which the scale of P would grow without limit.
MOST_ROOM = 1.0
#: Upper bound of the slack of a decay in multiples of an earlier P.  In scaled units no plant decays so much faster.
MOST_DECAY_ROOM = 1e3


@arguments_checked
def vertex_inequalities(
    errors: ErrorPolytope,
    *,
    goal: str = "gain",
    level: float | None = None,
    decay: float | None = None,
    lyapunov: str = "common",
    steps: float | None = None,
    gain: str = "scheduled",
    gains: Sequence[FloatArray] | None = None,
    gain_limit: float | None = None,
    free_output: bool = False,
    decay_metric: Sequence[FloatArray] | None = None,
    margin: float = MARGIN,
) -> Conditions:
    """Return the inequalities at the vertices of an error system, in P and Y.

    Parameters
    ----------
    errors : ErrorPolytope
        The vertices.
    goal : {"gain", "power", "decay"}, optional
        Minimise the l2 gain from w to z or the mean square of z for unit white w, or maximise the slack of ``decay``.
    level : float, optional
        A fixed gain (or root mean square): the slack at this level is maximised instead, so that a proof has room for
        rounding.
    decay : float, optional
        Errors decay at least like ``decay ** k`` (discrete time) or ``exp(-decay t)`` (continuous time, 1/s).
    lyapunov : {"common", "vertex"}, optional
        One P for all vertices, or one at each vertex (discrete time).
    steps : float, optional
        Largest change of the weight of the second of two vertices within a sample; arbitrary by default.
    gain : {"scheduled", "constant"}, optional
        One L at each vertex, or one L for all.
    gains : sequence of array_like, optional
        Gains to be analysed.
    gain_limit : float, optional
        Largest Frobenius norm of each Y.
    free_output : bool, optional
        Add ``V (C e + D w)`` with a variable V to z: an estimate may use the innovation directly.  In discrete time,
        for the gain, with C and D constant.
    decay_metric : sequence of array_like, optional
        P of an earlier solution, one common matrix or one at each vertex.  The slack is then that of the decay alone,
        in multiples of this P, as in Dinkelbach's iteration.  Needs ``decay``, and ``level`` or goal "decay".
    margin : float, optional
        Least slack of every inequality, where the slack is not maximised.

    Returns
    -------
    Conditions
        Variables ``P`` (or ``P[1]``, ...), ``G``, ``Y[1]``, ..., ``V``, and ``gamma_squared``, ``mean_square`` or, for
        a fixed level, ``room`` (the slack); gains ``L[1]``, ..., and ``P[1]``, ``G[1]``, ... for `witness_of`.

    Raises
    ------
    SpecError
        An option is out of range, or the gain is scheduled although the outputs change over the region.

    Examples
    --------
    >>> scalar = ErrorPolytope([[[a]] for a in (0.5, 0.9, 1.2)], [[1.0]], B=[[1.0, 0.0]], D=[[0.0, 1.0]], dt=1.0)
    >>> conditions = vertex_inequalities(scalar)
    >>> _ = conditions.solve()
    >>> round(float(conditions.variables["gamma_squared"].value) ** 0.5, 5)
    1.56205
    """
    chosen(goal, "goal", ("gain", "power", "decay"))
    chosen(lyapunov, "lyapunov", ("common", "vertex"))
    chosen(gain, "gain", ("scheduled", "constant"))
    _require_fitting(errors, goal, level, decay, lyapunov, steps, gain, gains)
    if free_output and (goal != "gain" or errors.dt <= 0.0 or not errors.constant_output):
        raise SpecError(
            "A free part of z is for the gain in discrete time, with C and D constant: leave free_output out.",
            path="free_output",
        )
    forms = _Forms.of(errors, lyapunov=lyapunov, steps=steps, gain=gain, gains=gains, free_output=free_output)
    room = cp.Variable(name="room") if level is not None or goal == "decay" else None
    slack = margin if room is None or decay_metric is not None else room
    decay_slack = None if decay_metric is None else _DecaySlack.of(room, decay_metric, decay, errors)
    variables = forms.variables()
    value: Any = None
    if goal != "decay":
        name = "gamma_squared" if goal == "gain" else "mean_square"
        value = level**2 if level is not None else cp.Variable(nonneg=True, name=name)
        if level is None:
            variables[name] = value
    requested = _Requested(goal, value, decay, slack, decay_slack)
    constraints: dict[str, Any] = {}
    for place, now, then in forms.places():
        constraints |= forms.at(place, now, then, requested)
    constraints |= {f"P{name}": lmi.at_least(P, slack) for name, P in forms.positive()}
    if room is not None:
        variables["room"] = room
        constraints["room"] = room <= (MOST_ROOM if decay_slack is None else MOST_DECAY_ROOM)
    if goal == "decay":
        constraints["trace"] = sum(cp.trace(P) for _, P in forms.positive()) <= TRACE * errors.order
    if gain_limit is not None and gains is None:
        constraints |= {f"limit{name}": cp.norm(Y, "fro") <= gain_limit for name, Y in forms.unknown_gains()}
    objective = cp.Maximize(room) if room is not None else cp.Minimize(value)

    def unsupported(_: dict[str, FloatArray], name: str) -> ObserverDesign:
        raise SpecError(f"The error system of {name!r} has no plant: design by a method.", path="errors")

    return Conditions(
        "vertex inequalities (V1) to (V4)",
        lmi.semidefinite_problem(objective, list(constraints.values())),
        variables,
        {},
        {f"A[{i + 1}]": A for i, A in enumerate(errors.A)},
        constraints,
        tuple,
        forms.gains,
        unsupported,
    )


def witness_of(
    errors: ErrorPolytope, conditions: Conditions, *, steps: float | None = None
) -> tuple[Witness, list[FloatArray]]:
    """Return the Lyapunov matrices and the gains for the present values of the variables."""
    values = conditions.gains()
    by_vertex = "P[2]" in values
    P = [values[f"P[{i + 1}]"] for i in range(errors.count)] if by_vertex else [values["P"]]
    names = [f"G[{i + 1}]" for i in range(errors.count)] if "G[2]" in values else ["G"] if "G" in values else []
    gains = [values[f"L[{i + 1}]"] for i in range(errors.count)] if "L[2]" in values else [values["L[1]"]]
    slacks = [values[name] for name in names] or None
    pairs = pairs_of(errors.count, steps) if steps is not None else None
    multiplier = float(values["t"].item()) if "t" in values else 0.0
    return Witness(P, slacks, pairs, multiplier, errors.differential), gains


def _require_fitting(
    errors: ErrorPolytope, goal: str, level: Any, decay: Any, lyapunov: str, steps: Any, gain: str, gains: Any
) -> None:
    if level is not None:
        real_number(level, "level", "a positive number", above=0.0)
    if goal == "decay" and decay is None:
        raise SpecError("goal 'decay' needs the rate: give decay.", path="decay")
    if decay is not None and not decay >= 0.0:
        raise SpecError(
            f"decay is {shown(decay)}: give a factor a sample in discrete time, or a rate, 0 or more.",
            path="decay",
        )
    if (lyapunov == "vertex" or steps is not None) and errors.dt <= 0.0:
        raise SpecError(
            "P at each vertex and steps are for discrete time: take lyapunov='common' here, or rated_inequalities.",
            path="lyapunov",
        )
    if steps is not None and not steps > 0.0:
        raise SpecError(f"steps is {shown(steps)}: give a positive number.", path="steps")
    if errors.ball and goal == "power":
        raise SpecError("A remainder beside A has no bound on the mean square: take goal='gain'.", path="goal")
    if gains is None and gain == "scheduled" and not errors.constant_output:
        raise SpecError(
            "A gain that changes with the scheduling needs the same C and D at all vertices: the product L(mu) C(mu) "
            "has no vertices. Take gain='constant'.",
            path="gain",
        )
    if gains is not None:
        errors.closed(gains)


@dataclass(frozen=True, eq=False)
class _Requested:
    """What every inequality requests: the goal, the squared gain or mean square, the decay, and the slack of each."""

    goal: str
    value: Any
    decay: float | None
    slack: Any
    decay_slack: _DecaySlack | None


@dataclass(frozen=True, eq=False)
class _Matrices:
    """The matrices of one inequality, linear in the variables.

    ``P`` at this sample, ``following`` is the third place of (V1), and ``GA``, ``GB``, ``Z``, ``Dz`` are those of the
    error system, the first two multiplied by G'.  ``decay_slack`` is zero or a multiple of an earlier P.
    """

    P: Any
    following: Any
    G: Any
    GA: Any
    GB: Any
    Z: Any
    Dz: Any
    decay_slack: Any


@dataclass(frozen=True, eq=False)
class _Forms:
    """The variables of the inequalities, and the inequalities as linear forms in them."""

    errors: ErrorPolytope
    P: list[Any]  # at each vertex; the same object where one is common
    G: list[Any]
    Y: list[Any]
    slack: bool  # whether G is a variable of its own
    pairs: list[Pair] | None
    fixed_gains: Sequence[FloatArray] | None
    t: Any  # multiplier of the S-procedure, or None
    V: Any  # gain from the innovation to z, or None

    @classmethod
    def of(
        cls, errors: ErrorPolytope, *, lyapunov: str, steps: float | None, gain: str, gains: Any, free_output: bool
    ) -> _Forms:
        """Return new variables."""
        n, m, count, k = errors.order, errors.outputs, errors.count, errors.differential
        by_vertex, moving = lyapunov == "vertex", lyapunov == "vertex" or steps is not None
        t = cp.Variable(nonneg=True, name="t") if errors.ball else None
        below = 0 if k is None else n - k
        if below:
            P, G = descriptor_variables(n, n - below)
            Ps, Gs = [P] * count, [G] * count
        else:
            Ps = [cp.Variable((n, n), symmetric=True, name=f"P[{i + 1}]") for i in range(count)] if by_vertex else []
            Ps = Ps or [cp.Variable((n, n), symmetric=True, name="P")] * count
            common = steps is not None or gain == "constant"
            slack = [cp.Variable((n, n), name="G")] * count if common else []
            slack = slack or [cp.Variable((n, n), name=f"G[{i + 1}]") for i in range(count)]
            Gs = slack if moving else Ps
        if gains is not None:
            Y = [G.T @ np.asarray(L) for G, L in zip(Gs, list(gains) * (count if len(gains) == 1 else 1), strict=True)]
        else:

            def unknown(name: str) -> Any:
                above = cp.Variable((n - below, m), name=name)
                return cp.vstack([above, np.zeros((below, m))]) if below else above

            Y = [unknown("Y")] * count if gain == "constant" else [unknown(f"Y[{i + 1}]") for i in range(count)]
        pairs = pairs_of(count, steps) if moving else None
        V = cp.Variable((len(errors.Cz[0]), m), name="V") if free_output else None
        return cls(errors, Ps, Gs, Y, moving or bool(below), pairs, gains, t, V)

    def variables(self) -> dict[str, Any]:
        """Return the variables by name."""
        variables: dict[str, Any] = {}
        for matrix in (*self.P, *(self.G if self.slack else ()), *(self.Y if self.fixed_gains is None else ())):
            variables |= {part.name(): part for part in matrix.variables()}
        return variables | {name: part for name, part in (("t", self.t), ("V", self.V)) if part is not None}

    def unknown_gains(self) -> list[tuple[str, Any]]:
        """Return the variables Y with the suffixes of their names."""
        distinct = list(dict.fromkeys(self.Y))
        return [(f"[{i + 1}]", Y) for i, Y in enumerate(distinct)]

    def positive(self) -> list[tuple[str, Any]]:
        """Return the matrices that have to be positive definite, with the suffixes of their names."""
        k = self.errors.differential
        distinct = list(dict.fromkeys(self.P))
        if k is not None and k < self.errors.order:
            return [("", distinct[0][:k, :k])]
        return [(f"[{i + 1}]" if len(distinct) > 1 else "", P) for i, P in enumerate(distinct)]

    def places(self) -> list[tuple[str, FloatArray, FloatArray]]:
        """Return for each inequality its suffix, the weights now, and the weights at the next sample."""
        if self.pairs is None:
            return [(f"[{i + 1}]", unit, unit) for i, unit in enumerate(np.eye(self.errors.count))]
        return [(f"[{i + 1}]", now, then) for i, (now, then) in enumerate(self.pairs)]

    def at(self, place: str, now: FloatArray, then: FloatArray, requested: _Requested) -> dict[str, Any]:
        """Return the inequalities at weights, by name."""
        errors = self.errors
        G = _mean(self.G, now)
        GA = _mean_of(lambda i: self.G[i].T @ errors.A[i] - self.Y[i] @ errors.C[i], now)
        GB = _mean_of(lambda i: self.G[i].T @ errors.B[i] - self.Y[i] @ errors.D[i], now)
        Z, Dz = _mean(list(errors.Cz), now), _mean(list(errors.Dz), now)
        if self.V is not None:
            Z, Dz = Z + self.V @ errors.C[0], Dz + self.V @ errors.D[0]
        decay_slack = 0.0 if requested.decay_slack is None else requested.decay_slack.at(now)
        P_now = _mean(self.P, now)
        if errors.dt > 0.0:
            following = G + G.T - _mean(self.P, then) if self.slack else _mean(self.P, then)
            return self._discrete(place, _Matrices(P_now, following, G, GA, GB, Z, Dz, decay_slack), requested)
        return self._continuous(place, _Matrices(P_now, P_now, G, GA, GB, Z, Dz, decay_slack), requested)

    def _discrete(self, place: str, m: _Matrices, requested: _Requested) -> dict[str, Any]:
        """Return (V1) or (V2), and the inequality of the decay, by name."""
        n, p, q = m.P.shape[0], m.Dz.shape[1], m.Dz.shape[0]
        value, decay, slack = requested.value, requested.decay, requested.slack
        remainder = self.errors.ball**2 * self.t * np.eye(n) if self.t is not None else 0.0
        constraints = {}
        if requested.goal == "gain":
            lower = [
                [m.P - remainder],
                [np.zeros((p, n)), value * np.eye(p)],
                [m.GA, m.GB, m.following],
                [m.Z, m.Dz, np.zeros((q, n)), np.eye(q)],
            ]
            constraints[f"(V1){place}"] = lmi.at_least(lmi.symmetric_blocks(self._with_ball(lower, m.G, 2)), slack)
        if requested.goal == "power":
            W = cp.Variable((p, p), symmetric=True)
            lower = [[m.P - m.Z.T @ m.Z], [m.GA, m.following]]
            constraints[f"(V2){place}"] = lmi.at_least(lmi.symmetric_blocks(lower), slack)
            constraints[f"(V2) trace{place}"] = cp.trace(W) + float(np.sum(m.Dz**2)) + slack <= value
            constraints[f"(V2) noise{place}"] = lmi.at_least(lmi.symmetric_blocks([[W], [m.GB, m.following]]), 0.0)
        if decay is not None:
            lower = [[decay**2 * m.P - remainder - m.decay_slack], [m.GA, m.following]]
            constraints[f"decay{place}"] = lmi.at_least(lmi.symmetric_blocks(self._with_ball(lower, m.G, 1)), slack)
        return constraints

    def _with_ball(self, lower: list[list[Any]], G: Any, next_error: int) -> list[list[Any]]:
        """Return lower blocks with the row of the S-procedure, where there is an uncertainty of A."""
        if self.t is None:
            return lower
        n = self.errors.order
        across = [G if i == next_error else np.zeros((n, row[-1].shape[0])) for i, row in enumerate(lower)]
        return [*lower, [*across, self.t * np.eye(n)]]

    def _continuous(self, place: str, m: _Matrices, requested: _Requested) -> dict[str, Any]:
        """Return (V4) or its form for the mean square, and the inequality of the decay, by name."""
        n, p = m.P.shape[0], m.Dz.shape[1]
        value, decay, slack = requested.value, requested.decay, requested.slack
        remainder = self.errors.ball**2 * self.t * np.eye(n) if self.t is not None else 0.0
        constraints = {}
        if requested.goal == "gain":
            lower = [
                [-2.0 * m.GA - m.Z.T @ m.Z - remainder],
                [-(m.GB + m.Z.T @ m.Dz).T, value * np.eye(p) - m.Dz.T @ m.Dz],
            ]
            constraints[f"(V4){place}"] = lmi.at_least(lmi.symmetric_blocks(self._with_ball(lower, -m.P, 0)), slack)
        if requested.goal == "power":
            W = cp.Variable((p, p), symmetric=True)
            constraints[f"(V4) power{place}"] = lmi.at_least(-2.0 * m.GA - m.Z.T @ m.Z, slack)
            constraints[f"(V4) trace{place}"] = cp.trace(W) + float(np.sum(m.Dz**2)) + slack <= value
            k = self.errors.differential or m.P.shape[0]
            constraints[f"(V4) noise{place}"] = lmi.at_least(lmi.symmetric_blocks([[W], [m.GB[:k], m.P[:k, :k]]]), 0.0)
        if decay is not None:
            lower = [[-2.0 * m.GA - 2.0 * decay * m.P - remainder - 2.0 * m.decay_slack]]
            constraints[f"decay{place}"] = lmi.at_least(lmi.symmetric_blocks(self._with_ball(lower, -m.P, 0)), slack)
        return constraints

    def gains(self, values: Values) -> dict[str, FloatArray]:
        """Return gains and Lyapunov matrices from the values of the variables."""
        matrices: dict[str, FloatArray] = {}
        distinct = list(dict.fromkeys(self.P))
        for i, P in enumerate(distinct):
            matrix = np.asarray(P.value)
            matrices[f"P[{i + 1}]" if len(distinct) > 1 else "P"] = 0.5 * (matrix + matrix.T)
        slack = list(dict.fromkeys(self.G)) if self.slack else []
        for i, G in enumerate(slack):
            matrices[f"G[{i + 1}]" if len(slack) > 1 else "G"] = np.asarray(G.value)
        if self.fixed_gains is not None:
            return (
                matrices
                | {f"L[{i + 1}]": np.asarray(L) for i, L in enumerate(self.fixed_gains)}
                | self._multiplier(values)
            )
        known: dict[Any, FloatArray] = {}
        for G, Y in zip(self.G, self.Y, strict=True):
            if (G, Y) not in known:
                matrix = np.asarray(G.value)
                known[G, Y] = np.linalg.solve(
                    matrix.T if self.slack else 0.5 * (matrix + matrix.T), np.asarray(Y.value)
                )
                matrices[f"L[{len(known)}]"] = known[G, Y]
        return matrices | self._multiplier(values)

    def _multiplier(self, values: Values) -> dict[str, FloatArray]:
        return {"t": np.atleast_2d(values["t"])} if self.t is not None else {}


@dataclass(frozen=True, eq=False)
class _DecaySlack:
    """The slack of a decay, in multiples of an earlier P."""

    room: Any
    metric: list[FloatArray]  # at each vertex

    @classmethod
    def of(cls, room: Any, metric: Sequence[FloatArray], decay: float | None, errors: ErrorPolytope) -> _DecaySlack:
        if room is None or decay is None:
            raise SpecError("A metric of the decay needs decay, and level or goal 'decay'.", path="decay_metric")
        each = [np.asarray(matrix, np.float64) for matrix in metric]
        return cls(room, each * (errors.count if len(each) == 1 else 1))

    def at(self, weights: FloatArray) -> Any:
        return self.room * _mean(self.metric, weights)


def descriptor_variables(n: int, k: int) -> tuple[Any, Any]:
    """Return ``diag(P1, 0)`` and ``[[P1, 0], [P2, P3]]``, P1 ``(k, k)`` symmetric."""
    P1 = cp.Variable((k, k), symmetric=True, name="P1")
    if k == n:  # blocks without rows have no value
        return P1, P1
    P2, P3 = cp.Variable((n - k, k), name="P2"), cp.Variable((n - k, n - k), name="P3")
    above = [P1, np.zeros((k, n - k))]
    return cp.bmat([above, [np.zeros((n - k, k)), np.zeros((n - k, n - k))]]), cp.bmat([above, [P2, P3]])


def _mean(parts: Sequence[Any], weights: FloatArray) -> Any:
    return _mean_of(parts.__getitem__, weights)


def _mean_of(part: Callable[[int], Any], weights: FloatArray) -> Any:
    """Return the mean of what ``part`` makes of the vertices with a weight: of the others nothing is built."""
    used = np.flatnonzero(weights)
    if len(used) == 1 and weights[used[0]] == 1.0:
        return part(int(used[0]))
    return sum(float(weights[i]) * part(int(i)) for i in used)
