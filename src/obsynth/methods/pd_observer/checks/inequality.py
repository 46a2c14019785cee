r"""The matrix inequality of the PD observer, formed with guaranteed error bounds and proved.

Theorem 1 of Filasova, Krokavec, Serbak is, with ``D = I + L C`` and ``Ae = A - J C`` of the augmented plant,

.. math::
    \mathrm{He}\left(\begin{bmatrix} A_e^T \\ -D^T \end{bmatrix} P_3 \begin{bmatrix} I & \delta I \end{bmatrix}\right)
    + \begin{bmatrix} 0 & P_1 \\ P_1 & 0 \end{bmatrix} < 0, \qquad P_1 > 0 ,

their (40)-(43) with Y = P3' J and Z = P3' L put back.  If ``(Ae - s D) x = 0``, then [x; s x] makes of it
``2 Re(s) x' P1 x < 0``; and ``D x = 0`` contradicts the second diagonal block.  So D is nonsingular and every
eigenvalue of ``D^-1 Ae`` lies to the left.  A decay rate is the same inequality for ``Ae + alpha D``.

What is shipped is ``Az = Ae D^-1`` and ``S = D^-1``.  A congruence with diag(S, S) gives the inequality for
``Az + alpha I`` and ``I`` with ``X = P3 S`` and ``P = S' P1 S``: no inverse is formed, and its lower right block proves
that S is nonsingular, so that the congruence is one.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball, Enclosed, block
from obsynth.proofs.definiteness import DefinitenessProof, prove_positive_definite, unproved


def prove_shipped_stability(
    observer: LinearObserver, P1: FloatArray, P3: FloatArray, *, delta: float, decay: float
) -> DefinitenessProof:
    """Try to prove that the shipped observer's errors decay faster than ``exp(-decay t)``.

    Shapes: ``P1 (nz, nz)``, ``P3 (nz, nz)``.
    """
    size = observer.order

    def formula(kind: type[Enclosed]) -> Enclosed:
        moving = kind.exact(observer.Az) + kind.exact(decay * np.eye(size))
        estimate = kind.exact(observer.Cz[:size])
        x = kind.exact(P3) @ estimate
        p = estimate.T @ kind.exact(P1) @ estimate
        return _inequality(moving.T @ x, x, p, delta)

    return prove_positive_definite(formula)


def prove_gains(
    A: FloatArray, C: FloatArray, J: FloatArray, L: FloatArray, P1: FloatArray, P3: FloatArray, *, delta: float,
    decay: float,
) -> DefinitenessProof:  # fmt: skip
    """Try to prove the inequality for gains on an augmented plant ``A (n, n)``, ``C (ny, n)``."""

    def formula(kind: type[Enclosed]) -> Enclosed:
        c, p3 = kind.exact(C), kind.exact(P3)
        ae = kind.exact(A) - kind.exact(J) @ c
        d = kind.exact(np.eye(len(A))) + kind.exact(L) @ c
        moving = ae + d.scaled(decay)
        return _inequality(moving.T @ p3, d.T @ p3, kind.exact(P1), delta)

    return prove_positive_definite(formula)


def prove_symmetric_positive(matrix: FloatArray) -> DefinitenessProof:
    """Try to prove that a matrix is symmetric, exactly, and positive definite."""
    if not np.array_equal(matrix, matrix.T):
        return unproved("the matrix is not symmetric")
    return prove_positive_definite(matrix)


def error_inputs(
    plant: DescriptorSystem, J: FloatArray, L: FloatArray, kind: Literal["rate", "noise"]
) -> Ball:  # fmt: skip
    """Return where the rate of the faults, or ``[w; w']``, enters ``eps' = Az eps + B v``, with rounding bounds.

    Shapes: ``J (nx + nf, ny)``, ``L (nx + nf, ny)``.
    """
    if kind == "rate":
        return Ball.exact(np.vstack([np.zeros((plant.nx, plant.nf)), np.eye(plant.nf)]))
    process = Ball.exact(np.vstack([plant.Bw, np.zeros((plant.nf, plant.nw))]))
    sensor = Ball.exact(plant.Dw)
    return block([[process - Ball.exact(J) @ sensor, -(Ball.exact(L) @ sensor)]])


def prove_gain(a: FloatArray, b: Ball, c: FloatArray, P: FloatArray, gain: float) -> DefinitenessProof:
    """Try to prove that ``x' = a x + b v``, ``z = c x`` is stable with an l2 gain below ``gain``.

    The bounded real inequality ``a' P + P a + c' c + P b b' P / gain^2 < 0`` before its Schur complements; that P is
    positive definite is a proof of its own.

    Shapes: ``a (n, n)``, ``c (p, n)``, ``b (n, m)``, ``P (n, n)``.
    """
    positive = prove_symmetric_positive(P)
    if not positive.proved:
        return unproved(f"P itself: {positive.reason}")
    inputs, outputs = b.shape[1], c.shape[0]

    def formula(kind: type[Enclosed]) -> Enclosed:
        p, shown = kind.exact(P), kind.exact(c)
        through, entering = p @ kind.exact(a), p @ kind.of(b)
        level = kind.exact(np.eye(inputs)).scaled(gain).scaled(gain)
        none = kind.exact(np.zeros((inputs, outputs)))
        return block([
            [-(through + through.T), -entering, shown.T],
            [-entering.T, level, none],
            [shown, none.T, kind.exact(np.eye(outputs))],
        ])  # fmt: skip

    return prove_positive_definite(formula)


def _inequality(moving: Enclosed, still: Enclosed, p: Enclosed, delta: float) -> Enclosed:
    """Return minus the inequality for a pencil ``M - s T``, from ``moving = M' X`` and ``still = T' X``."""
    lower = p - still + moving.T.scaled(delta)
    return block([[-(moving + moving.T), -lower.T], [-lower, (still + still.T).scaled(delta)]])
