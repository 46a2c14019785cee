r"""Quadratic stability and performance of a polytope of error systems, proved at its vertices in balls.

An error obeys :math:`e^+ = M(\mu) e + B(\mu) w`, :math:`z = C_z(\mu) e + D_z(\mu) w` (:math:`e^+` is :math:`\dot e` in
continuous time), where the four matrices are the same mean, with weights :math:`\mu` of the simplex that may change
with every sample, of those at the vertices.  At a fixed P each inequality below is affine in the four matrices, so that
it is proved at the vertices alone (Boyd, El Ghaoui, Feron, Balakrishnan, *Linear Matrix Inequalities*, chapters 5, 6).

Discrete time, with :math:`P_a` now and :math:`P_b` at the next sample, and a slack G (Daafouz, Bernussou 2001):

.. math::
    \begin{bmatrix} P_a - \rho^2 t I & 0 & M^T G & C_z^T \\ * & g I & B^T G & D_z^T \\ * & * & G + G^T - P_b & 0 \\
    * & * & * & I \end{bmatrix} > 0

and :math:`\sum |z|^2 \le g \sum |w|^2 + e_0^T P e_0`; with one P, G = P.  A remainder R beside M, :math:`|R| \le \rho`,
is one more row and column ``[0, 0, G, 0]`` with ``t I``.  Continuous time, for errors of which the last rows are
algebraic too (``E e' = M e + B w``, ``E = diag(I, 0)``, ``G = [[P1, 0], [P2, P3]]``, ``P = diag(P1, 0)``):

.. math::
    \begin{bmatrix} G^T M + M^T G + C_z^T C_z & G^T B + C_z^T D_z \\ * & D_z^T D_z - g I \end{bmatrix} < 0

A remainder takes ``rho^2 t I`` from the first place there, with ``t I`` and P in one more row and column.

Decay: ``r^2 P_a`` or ``2 a P`` in the first place, without w and z: ``|e(k)|_P <= r^k |e(0)|_P``, or ``exp(-a t)``.
Mean square: ``tr B'PB + |Dz|^2 < J`` beside ``M'PM - P + Cz'Cz < 0``: the mean of ``|z|^2`` for unit white w, whatever
the weights are that do not depend on w.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.balls import Ball
from obsynth.proofs.definiteness import DefinitenessProof, prove_positive_definite, unproved
from obsynth.proofs.extended_balls import Enclosed, block
from obsynth.proofs.slope_blocks import SlopeBlock, mean_square_form

#: Weights at the vertices now and at the next sample.
Pair = tuple[FloatArray, FloatArray]


class Vertex(Protocol):
    """How the error system at a vertex is formed: ``vertex(Ball)`` returns M, B, Cz and Dz in double precision."""

    def __call__(self, kind: type[Enclosed], /) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
        """Return M ``(n, n)``, B ``(n, p)``, Cz ``(q, n)`` and Dz ``(q, p)``."""


#: What is proved: vertices, or one block with the slopes of a plant.
Proved = Sequence[Vertex] | SlopeBlock


@dataclass(frozen=True, eq=False)
class Witness:
    """Lyapunov matrices from which the inequalities of a polytope are recomputed.

    Parameters
    ----------
    P : sequence of FloatArray
        ``(n, n)``, symmetric: one for all vertices, or one for each.
    G : sequence of FloatArray, optional
        The slack ``(n, n)``, one or one for each vertex; P itself by default.
    pairs : sequence of pairs of FloatArray, optional
        Weights now and at the next sample, of which the convex hull is every pair that can happen; by default every
        vertex by itself for one P, every pair of vertices for several.
    multiplier : float, optional
        That of the remainder beside M.
    differential : int, optional
        How many of the errors are differential, in continuous time; all by default.
    slopes : FloatArray, optional
        Multipliers ``(q,)`` of slopes, where one block is proved in place of their corners.
    """

    P: Sequence[FloatArray]
    G: Sequence[FloatArray] | None = None
    pairs: Sequence[Pair] | None = None
    multiplier: float = 0.0
    differential: int | None = None
    slopes: FloatArray | None = None

    @property
    def order(self) -> int:
        """Number of errors."""
        return len(self.P[0])

    def in_units(self, states: FloatArray) -> Witness:
        """Return the matrices for errors ``diag(states) e``, where these are for e: ``S^-1 P S^-1``."""
        P = [matrix / states / states[:, None] for matrix in self.P]
        return replace(self, P=P, G=None if self.G is None else [m / states / states[:, None] for m in self.G])

    def pairs_of(self, count: int) -> list[Pair]:
        """Return the pairs of weights at which the inequalities are proved."""
        if self.pairs is not None:
            return list(self.pairs)
        units = np.eye(count)
        if len(self.P) == 1:
            return [(unit, unit) for unit in units]
        return [(now, then) for now in units for then in units]

    def problem(self, count: int) -> str:
        """Return why these are no matrices for ``count`` vertices; empty where they are."""
        n = self.order
        for name, matrices in (("P", self.P), ("G", self.G or self.P)):
            if len(matrices) not in (1, count):
                return f"{name} is given at {len(matrices)} vertices of {count}"
            if any(np.shape(matrix) != (n, n) or not np.isfinite(matrix).all() for matrix in matrices):
                return f"{name} is no finite matrix of order {n}"
        if any((matrix != matrix.T).any() for matrix in self.P):
            return "P is not symmetric"
        if len(self.P) > 1 and self.G is None:
            return "a P for each vertex needs a slack G"
        if not (np.isfinite(self.multiplier) and self.multiplier >= 0.0):
            return "the multiplier of the remainder is negative"
        return self._pairs_problem(count)

    def _pairs_problem(self, count: int) -> str:
        for now, then in self.pairs_of(count):
            for weights in (now, then):
                if np.shape(weights) != (count,) or not (np.asarray(weights) >= 0.0).all():
                    return f"weights are not {count} numbers of the simplex"
                # Sums of weights are exact where they are halves, quarters and so on; a pair is data, not a result.
                if not abs(float(np.sum(weights)) - 1.0) <= count * np.finfo(np.float64).eps:
                    return "weights do not add up to one"
        mixed = any(np.count_nonzero(now) > 1 for now, _ in self.pairs_of(count))
        if mixed and (self.G is None or len(self.G) > 1):
            return "weights between vertices need one slack G for all"
        return ""


@dataclass(frozen=True)
class VertexProof:
    """Whether inequalities are proved at every vertex, and by how much, or where the first fails."""

    proved: bool
    margin: float  # least eigenvalue that is proved, on a unit diagonal
    count: int  # matrices that were factored
    reason: str = ""

    @classmethod
    def of(cls, proofs: Sequence[tuple[str, DefinitenessProof]]) -> VertexProof:
        """Return what proofs at named places amount to."""
        margin = min((proof.lower_bound for _, proof in proofs), default=-np.inf)
        for place, proof in proofs:
            if not proof.proved:
                return cls(False, margin, len(proofs), f"{place}: {proof.text}")
        return cls(bool(proofs), margin, len(proofs), "" if proofs else "there is no vertex")


def pairs_of(count: int, steps: float | None) -> list[Pair]:
    """Return the corners of the set of weights now and at the next sample.

    Parameters
    ----------
    count : int
        Number of vertices.
    steps : float or None
        Largest change of the weight of the second of two vertices; any for ``None``.
    """
    units = np.eye(count)
    if steps is None:
        return [(now, then) for now in units for then in units]
    if count != 2:
        raise SpecError(
            f"steps are for two vertices (one parameter that enters linearly), there are {count}: leave the rates out.",
            path="steps",
        )
    reach = min(float(steps), 1.0)

    def weights(share: float) -> FloatArray:
        return np.array([1.0 - share, share])

    corners = [(0.0, 0.0), (0.0, reach), (1.0 - reach, 1.0), (1.0, 1.0), (1.0, 1.0 - reach), (reach, 0.0)]
    return [(weights(now), weights(then)) for now, then in dict.fromkeys(corners)]


def prove_gain(vertices: Proved, witness: Witness, gain: float, *, discrete: bool, ball: float = 0.0) -> VertexProof:
    """Try to prove that the l2 (L2) gain from w to z is below ``gain`` for every trajectory of the weights."""
    return _proved(vertices, witness, discrete=discrete, ball=ball, gain=gain)


def prove_decay(vertices: Proved, witness: Witness, rate: float, *, discrete: bool, ball: float = 0.0) -> VertexProof:
    """Try to prove decay: ``rate ** k`` in discrete time, ``exp(-rate t)`` in continuous time."""
    return _proved(vertices, witness, discrete=discrete, ball=ball, decay=rate)


def prove_mean_square(vertices: Proved, witness: Witness, level: float, *, discrete: bool) -> VertexProof:
    """Try to prove that the mean of ``|z|^2`` is below ``level ** 2`` for unit white w, independent of the weights."""
    return _proved(vertices, witness, discrete=discrete, ball=0.0, power=level)


def prove_nonsingular(vertices: Sequence[FloatArray], right: FloatArray, room: float) -> VertexProof:
    """Try to prove that ``He(X right) > 2 room I`` for every X in the hull of ``vertices (n, n)``.

    Then every X is nonsingular, and ``|X^-1| <= |right| / room``.
    """
    made = []
    for place, matrix in enumerate(vertices):

        def formula(kind: type[Enclosed], matrix: FloatArray = matrix) -> Enclosed:
            product = kind.exact(matrix) @ kind.exact(right)
            return product + product.T - kind.exact(np.eye(len(right))).scaled(2.0 * room)

        made.append((f"vertex {place + 1}", prove_positive_definite(formula)))
    return VertexProof.of(made)


def _proved(
    vertices: Proved,
    witness: Witness,
    *,
    discrete: bool,
    ball: float,
    gain: float | None = None,
    decay: float | None = None,
    power: float | None = None,
) -> VertexProof:
    if isinstance(vertices, SlopeBlock):
        return _proved_block(vertices, witness, discrete=discrete, ball=ball, gain=gain, decay=decay, power=power)
    problem = witness.problem(len(vertices))
    if not problem and any(vertex(Ball)[0].shape != (witness.order, witness.order) for vertex in vertices):
        problem = "the certificate is of another order than the errors"
    if not problem and not all(value is None or value >= 0.0 for value in (gain, power)):
        problem = "the number that is claimed is negative"
    if not problem and not discrete:
        problem = _flow_problem(vertices, witness, ball, power)
    if problem:
        return VertexProof.of([("certificate", unproved(problem))])
    forms = _Forms(vertices, witness, ball)
    make = forms.discrete if discrete else forms.continuous
    made = []
    for place, formula in make(gain, decay, power):
        made.append((place, prove_positive_definite(formula)))
        if not made[-1][1].proved:
            break
    return VertexProof.of(made)


def _proved_block(
    made: SlopeBlock,
    witness: Witness,
    *,
    discrete: bool,
    ball: float,
    gain: float | None,
    decay: float | None,
    power: float | None,
) -> VertexProof:
    """Prove one block with the slopes, in continuous time."""
    problem = witness.problem(1) or made.problem(witness.slopes)
    if discrete or ball:
        problem = "a block with slopes is for continuous time, without a remainder"
    if not problem and made.nominal(Ball)[0].shape != (witness.order, witness.order):
        problem = "the certificate is of another order than the errors"
    if not problem and not all(value is None or value >= 0.0 for value in (gain, decay, power)):
        problem = "the number that is claimed is negative"
    problem = problem or _flow_problem([made.nominal], witness, ball, power)
    if problem or witness.slopes is None:
        return VertexProof.of([("certificate", unproved(problem))])
    P, k = witness.P[0], witness.differential or witness.order
    G = P if witness.G is None else witness.G[0]
    proofs = []
    for place, formula in made.formulas(P, G, k, witness.slopes, gain=gain, decay=decay, power=power):
        proofs.append((place, prove_positive_definite(formula)))
        if not proofs[-1][1].proved:
            break
    return VertexProof.of(proofs)


def _flow_problem(vertices: Sequence[Vertex], witness: Witness, ball: float, power: float | None) -> str:
    """Return why a certificate is none in continuous time; empty where it is one."""
    if len(witness.P) > 1 or (witness.G is not None and len(witness.G) > 1):
        return "in continuous time one P is proved"
    if ball and (witness.G is not None or power is not None):
        return "a remainder in continuous time is for one P, and bounds no mean square"
    P, k = witness.P[0], witness.order if witness.differential is None else witness.differential
    G = P if witness.G is None else witness.G[0]
    if not 0 < k <= len(P) or P[k:].any() or (G[:k] != P[:k]).any():
        return "G is not [[P1, 0], [P2, P3]] with P = diag(P1, 0)"
    driven = [vertex(Ball)[1] for vertex in vertices] if power is not None and k < len(P) else []
    if any(part.midpoint[k:].any() or part.radius[k:].any() for part in driven):
        return "white noise enters the algebraic equations: its mean square is not bounded this way"
    return ""


class _Formula(Protocol):
    def __call__(self, kind: type[Enclosed], /) -> Enclosed: ...


@dataclass(frozen=True, eq=False)
class _Forms:
    """The matrices that must be positive definite, each as a formula."""

    vertices: Sequence[Vertex]
    witness: Witness
    ball: float

    def discrete(self, gain: float | None, decay: float | None, power: float | None) -> Iterator[tuple[str, _Formula]]:
        """Yield place and formula of every matrix in discrete time."""
        trace = self._trace_form if self.witness.G is None else self._trace_form_with_slack
        for now, then in self.witness.pairs_of(len(self.vertices)):
            place = _place(now, then)
            if gain is not None:
                yield place, self._gain_form(now, then, gain)
            if decay is not None:
                yield place, self._stable_form(now, then, decay, with_outputs=False)
            if power is not None:
                yield place, self._stable_form(now, then, 1.0, with_outputs=True)
                yield f"{place}, mean square", trace(now, then, power)

    def continuous(
        self, gain: float | None, decay: float | None, power: float | None
    ) -> Iterator[tuple[str, _Formula]]:
        """Yield place and formula of every matrix in continuous time; P itself is the first."""
        count, k = len(self.vertices), self.witness.differential
        yield "P", lambda kind: kind.exact(self.witness.P[0][:k, :k])
        for unit in np.eye(count):
            place = _place(unit, unit)
            if gain is not None or power is not None:
                yield place, self._flow_form(unit, gain, 0.0, with_outputs=True)
            if decay is not None:
                yield place, self._flow_form(unit, None, decay, with_outputs=False)
            if power is not None:
                yield f"{place}, mean square", self._trace_form(unit, unit, power)

    def _at(self, kind: type[Enclosed], now: FloatArray) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed, Enclosed]:
        """Return ``G'M``, ``G'B``, Cz, Dz and G at weights."""
        used = np.flatnonzero(now)
        slack = self.witness.G or self.witness.P
        parts = []
        for i in used:
            m, b, cz, dz = self.vertices[int(i)](kind)
            g = kind.exact(slack[0 if len(slack) == 1 else int(i)])
            parts.append((g.T @ m, g.T @ b, cz, dz, g))
        return tuple(_mean([part[j] for part in parts], now[used]) for j in range(5))  # type: ignore[return-value]

    def _lyapunov(self, kind: type[Enclosed], weights: FloatArray) -> Enclosed:
        matrices = self.witness.P
        if len(matrices) == 1:
            return kind.exact(matrices[0])
        used = np.flatnonzero(weights)
        return _mean([kind.exact(matrices[int(i)]) for i in used], weights[used])

    def _lower(self, kind: type[Enclosed], slack: Enclosed, then: FloatArray) -> Enclosed:
        after = self._lyapunov(kind, then)
        return after if self.witness.G is None else slack + slack.T - after

    def _gain_form(self, now: FloatArray, then: FloatArray, gain: float) -> _Formula:
        def formula(kind: type[Enclosed]) -> Enclosed:
            gm, gb, cz, dz, slack = self._at(kind, now)
            n, (q, p) = self.witness.order, dz.shape
            first = self._lyapunov(kind, now) - self._remainder(kind)
            level = kind.exact(np.eye(p)).scaled(gain).scaled(gain)
            rows = [
                [first, _zero(kind, n, p), gm.T, cz.T],
                [_zero(kind, p, n), level, gb.T, dz.T],
                [gm, gb, self._lower(kind, slack, then), _zero(kind, n, q)],
                [cz, dz, _zero(kind, q, n), kind.exact(np.eye(q))],
            ]
            return self._with_remainder(kind, rows, slack, [n, p, n, q])

        return formula

    def _stable_form(self, now: FloatArray, then: FloatArray, rate: float, *, with_outputs: bool) -> _Formula:
        def formula(kind: type[Enclosed]) -> Enclosed:
            gm, _, cz, _, slack = self._at(kind, now)
            n = self.witness.order
            first = self._lyapunov(kind, now).scaled(rate).scaled(rate) - self._remainder(kind)
            first = first - cz.T @ cz if with_outputs else first
            rows = [[first, gm.T], [gm, self._lower(kind, slack, then)]]
            return self._with_remainder(kind, rows, slack, [n, n])

        return formula

    def _flow_form(self, now: FloatArray, gain: float | None, rate: float, *, with_outputs: bool) -> _Formula:
        def formula(kind: type[Enclosed]) -> Enclosed:
            gm, gb, cz, dz, _ = self._at(kind, now)
            first = -(gm + gm.T) - self._lyapunov(kind, now).scaled(2.0 * rate)
            first = first - cz.T @ cz if with_outputs else first
            P, n, p = self._lyapunov(kind, now), self.witness.order, dz.shape[1]
            if self.ball:
                first = first - self._remainder(kind)
            corner = kind.exact(np.eye(n)).scaled(self.witness.multiplier)
            if gain is None:
                return block([[first, -P], [-P, corner]]) if self.ball else first
            across = -(gb + cz.T @ dz)
            level = kind.exact(np.eye(p)).scaled(gain).scaled(gain) - dz.T @ dz
            if not self.ball:
                return block([[first, across], [across.T, level]])
            nothing = _zero(kind, p, n)
            return block([[first, across, -P], [across.T, level, nothing], [-P, nothing.T, corner]])

        return formula

    def _trace_form(self, now: FloatArray, then: FloatArray, level: float) -> _Formula:
        """Return ``level^2 - |Dz|^2 - tr B'PB``."""

        def formula(kind: type[Enclosed]) -> Enclosed:
            used = np.flatnonzero(now)
            parts = [self.vertices[int(i)](kind) for i in used]
            b, dz = _mean([part[1] for part in parts], now[used]), _mean([part[3] for part in parts], now[used])
            return mean_square_form(kind, self._lyapunov(kind, then), b, dz, level)

        return formula

    def _trace_form_with_slack(self, now: FloatArray, then: FloatArray, level: float) -> _Formula:
        """Return the matrix with the Schur complement ``level^2 - |Dz|^2 - tr B'G (G + G' - P)^-1 G'B``, discrete time.

        It is affine in both weights but for ``-|Dz|^2``, and no more than with ``tr B'PB``: corners suffice."""

        def formula(kind: type[Enclosed]) -> Enclosed:
            _, gb, _, dz, slack = self._at(kind, now)
            n, p = gb.shape
            lower, nothing = self._lower(kind, slack, then), _zero(kind, n, n)
            corner = kind.exact(np.ones((1, 1))).scaled(level).scaled(level)
            first: list[Enclosed] = []
            rows: list[list[Enclosed]] = [first]
            for k in range(p):
                unit = kind.exact(np.eye(p)[:, [k]])
                column, direct = gb @ unit, dz @ unit
                corner = corner - direct.T @ direct
                first.append(column.T)
                row: list[Enclosed] = [column]
                for j in range(p):
                    row.append(lower if j == k else nothing)
                rows.append(row)
            first.insert(0, corner)
            return block(rows)

        return formula

    def _remainder(self, kind: type[Enclosed]) -> Enclosed:
        part = kind.exact(np.eye(self.witness.order))
        return part.scaled(self.witness.multiplier).scaled(self.ball).scaled(self.ball)

    def _with_remainder(
        self, kind: type[Enclosed], rows: list[list[Enclosed]], slack: Enclosed, sizes: list[int]
    ) -> Enclosed:
        """Return the block matrix, with the row and column of a remainder beside M where there is one."""
        if not self.ball:
            return block(rows)
        n = self.witness.order
        # e at the next sample is the third of four blocks, or the second of two.
        place = len(sizes) // 2
        corner = kind.exact(np.eye(n)).scaled(self.witness.multiplier)
        last: list[Enclosed] = []
        for row, size in zip(rows, sizes, strict=True):
            part = slack if row is rows[place] else _zero(kind, n, size)
            row.append(part.T)
            last.append(part)
        last.append(corner)
        rows.append(last)
        return block(rows)


def _mean(parts: Sequence[Enclosed], weights: FloatArray) -> Enclosed:
    if len(parts) == 1:
        return parts[0]
    total = parts[0].scaled(float(weights[0]))
    for part, weight in zip(parts[1:], weights[1:], strict=True):
        total = total + part.scaled(float(weight))
    return total


def _zero(kind: type[Enclosed], rows: int, columns: int) -> Enclosed:
    return kind.exact(np.zeros((rows, columns)))


def _place(now: FloatArray, then: FloatArray) -> str:
    """Return a place in words, such as ``vertex 3`` or ``vertex 1, then 2``."""

    def named(weights: FloatArray) -> str:
        used = np.flatnonzero(weights)
        if len(used) == 1:
            return f"{used[0] + 1}"
        return " + ".join(f"{weights[i]:.4g} of {i + 1}" for i in used)

    first, second = named(now), named(then)
    return f"vertex {first}" if first == second else f"vertex {first}, then {second}"
