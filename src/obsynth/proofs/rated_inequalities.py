r"""Performance of a polytope of two vertices whose weight moves slowly, in continuous time, proved in balls.

``e' = M(t) e + B(t) w``, ``z = Cz(t) e + Dz(t) w`` are linear in a weight t in [0, 1] with ``|t'| <= nu``.  With P(t)
in Bernstein form (`obsynth.numerics.bernstein`)

.. math::
    \begin{bmatrix} \mathrm{He}(P M) \pm \nu P' & P B & C_z^T \\ * & -\gamma^2 I & D_z^T \\ * & * & -I
    \end{bmatrix} < 0, \qquad P > 0

for all t give :math:`\int |z|^2 \le \gamma^2 \int |w|^2 + e_0^T P(t_0) e_0` along every such course, as the derivative
of ``e' P e`` has the term ``t' e' P' e``, which is linear in t'; ``He(P M) + 2 a P \pm nu P' < 0`` gives the decay a.
Each is a matrix polynomial of one degree more than P: its coefficients are proved definite on every piece.

Reference: Wu, Yang, Packard, Becker, Int. J. Robust Nonlinear Control 6 (1996).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Protocol

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.bernstein import MOST_DEGREE, ProductCoefficient, coefficients_on_pieces, product_coefficients
from obsynth.proofs.balls import Ball
from obsynth.proofs.definiteness import DefinitenessProof, prove_positive_definite, unproved
from obsynth.proofs.extended_balls import Enclosed, block
from obsynth.proofs.vertex_inequalities import Vertex, VertexProof

#: Pieces that are tried: more of them prove more.
PIECES = (1, 2, 4, 8, 16)


class Formula(Protocol):
    """How a matrix is formed in one arithmetic."""

    def __call__(self, kind: type[Enclosed], /) -> Enclosed:
        """Return the matrix."""


def prove_rated_gain(
    vertices: Sequence[Vertex], P: Sequence[FloatArray], rate: float, gain: float, *, pieces: Sequence[int] = PIECES
) -> VertexProof:
    """Try to prove that the L2 gain from w to z is below ``gain`` while the weight moves by at most ``rate`` in 1/s.

    Parameters
    ----------
    vertices : sequence of Vertex
        Two.
    P : sequence of FloatArray
        Bernstein coefficients ``(n, n)`` of the Lyapunov matrix.
    rate : float
        Largest change of the weight of the second vertex in a second.
    gain : float
        What is claimed.
    pieces : sequence of int, optional
        Numbers of pieces that are tried in turn.
    """
    return _proved(vertices, P, rate, pieces, gain=gain)


def prove_rated_decay(
    vertices: Sequence[Vertex], P: Sequence[FloatArray], rate: float, decay: float, *, pieces: Sequence[int] = PIECES
) -> VertexProof:
    """Try to prove that ``e' P(t) e`` decays like ``exp(-2 decay time)`` while the weight moves so slowly."""
    return _proved(vertices, P, rate, pieces, decay=decay)


def _proved(
    vertices: Sequence[Vertex],
    P: Sequence[FloatArray],
    rate: float,
    pieces: Sequence[int],
    *,
    gain: float | None = None,
    decay: float = 0.0,
) -> VertexProof:
    problem = _problem(vertices, P, rate, gain, decay)
    proof = VertexProof.of([("certificate", unproved(problem))])
    for count in () if problem else pieces:
        proof = _on_pieces(vertices, P, rate, count, gain, decay)
        if proof.proved:
            break
    return proof


def _problem(vertices: Sequence[Vertex], P: Sequence[FloatArray], rate: float, gain: float | None, decay: float) -> str:
    """Return why this is no certificate; empty where it is one."""
    if len(vertices) != 2:
        return f"a certificate with a rate is for two vertices, there are {len(vertices)}"
    if not 1 <= len(P) <= MOST_DEGREE + 1:
        return f"the Lyapunov matrix has {len(P)} coefficients"
    n = vertices[0](Ball)[0].shape[0]
    if any(np.shape(matrix) != (n, n) or not np.isfinite(matrix).all() for matrix in P):
        return "the certificate is of another order than the errors"
    if any((matrix != matrix.T).any() for matrix in P):
        return "P is not symmetric"
    numbers = [rate, decay, *([] if gain is None else [gain])]
    if not all(np.isfinite(value) and value >= 0.0 for value in numbers):
        return "a rate, a decay or the number that is claimed is negative"
    return ""


def _on_pieces(
    vertices: Sequence[Vertex], P: Sequence[FloatArray], rate: float, pieces: int, gain: float | None, decay: float
) -> VertexProof:
    made: list[tuple[str, DefinitenessProof]] = []
    for place, formula in _formulas(vertices, P, rate, pieces, gain, decay):
        made.append((place, prove_positive_definite(formula)))
        if not made[-1][1].proved:
            break
    return VertexProof.of(made)


def _formulas(
    vertices: Sequence[Vertex], P: Sequence[FloatArray], rate: float, pieces: int, gain: float | None, decay: float
) -> Iterator[tuple[str, Formula]]:
    """Yield place and formula of every coefficient: those of P, then those of the negative of the inequality."""
    for place, weights in coefficients_on_pieces(len(P) - 1, pieces):
        yield f"P, {place}", partial(_combined, matrices=P, weights=weights)
    for coefficient in product_coefficients(len(P) - 1, pieces):
        for sign in (-1.0, 1.0) if rate else (1.0,):
            yield coefficient.place, _form(vertices, P, coefficient, sign * rate, gain, decay)


def _form(
    vertices: Sequence[Vertex],
    P: Sequence[FloatArray],
    at: ProductCoefficient,
    rate: float,
    gain: float | None,
    decay: float,
) -> Formula:
    """Return the formula of a coefficient of the negative of the inequality, times a positive number."""

    def formula(kind: type[Enclosed]) -> Enclosed:
        (m0, b0, z0, d0), (m1, b1, z1, d1) = (vertex(kind) for vertex in vertices)
        low, high = _combined(kind, P, at.low), _combined(kind, P, at.high)
        pm = low @ m0 + high @ m1
        first = -(pm + pm.T) - _combined(kind, P, at.slope).scaled(rate) - (low + high).scaled(2.0 * decay)
        if gain is None:
            return first
        pb = low @ b0 + high @ b1
        cz = z0.scaled(float(at.ends[0])) + z1.scaled(float(at.ends[1]))
        dz = d0.scaled(float(at.ends[0])) + d1.scaled(float(at.ends[1]))
        q, p = dz.shape
        level = kind.exact(np.eye(p)).scaled(at.scale).scaled(gain).scaled(gain)
        return block([[first, -pb, -cz.T], [-pb.T, level, -dz.T], [-cz, -dz, kind.exact(np.eye(q)).scaled(at.scale)]])

    return formula


def _combined(kind: type[Enclosed], matrices: Sequence[FloatArray], weights: FloatArray) -> Enclosed:
    """Return the sum of matrices with weights."""
    total = kind.exact(matrices[0]).scaled(float(weights[0]))
    for matrix, weight in zip(matrices[1:], weights[1:], strict=True):
        if weight:
            total = total + kind.exact(matrix).scaled(float(weight))
    return total
