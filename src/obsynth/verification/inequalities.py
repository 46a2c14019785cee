r"""The bounded real inequality and the stability of a shipped observer, proved with bounds on every rounding error.

With ``e+ = M e + B d``, fault error ``-C e + D d``, P = Q'Q, the gain is below g, and M is Schur stable, if

.. math::
    \begin{bmatrix} P & 0 & (QM)^T & C^T \\ & g^2 I & (QB)^T & -D^T \\ & & I & 0 \\ & & & I \end{bmatrix} > 0

((45) of Wang 2015 before its Schur complements, P divided out of the third block, with D).  Stable is A with
``-S^T (A^T Q^T Q + Q^T Q A) S > 0`` (``z' = A z``), or ``[[(QS)^T QS, (QAS)^T], [QAS, I]] > 0`` (``z+ = A z``), for any
congruence S (here close to the inverse of Q).  Q is stored: P, rounded, loses definiteness near condition 1e16.
"""

from __future__ import annotations

from hashlib import blake2b
from typing import Any, Protocol

import numpy as np

from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.spectra import decay_rates, eigenvalues
from obsynth.observers.linear.modes import poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import Ball
from obsynth.proofs.contraction import prove_contraction
from obsynth.proofs.definiteness import DefinitenessProof, prove_positive_definite, unproved
from obsynth.proofs.extended_balls import Enclosed, block, enclosed_eigenvalues
from obsynth.results.checks import Check, CheckKind
from obsynth.verification.error_system import contraction_of

#: A claimed rate is proved for all but this share of it.
RATE_TOLERANCE = 1e-4

#: Squares hide the sign of what is claimed.
NO_GAIN = "the gain is not above 0"


def prove_bounded_real(
    plant: DescriptorSystem,
    observer: LinearObserver,
    tracking: FloatArray,
    factor: FloatArray,
    gain: float,
) -> DefinitenessProof:
    """Try to prove the bounded real inequality for the shipped observer; ``factor (core, core)``.

    What was proved of the same numbers, to the last bit, is not proved again while the observer lives.
    """
    known = _proofs_of(observer)
    numbers = _digest(plant.Bd, plant.Dd, tracking, factor, np.array([gain]))
    if numbers in known:
        return known[numbers]
    proof = _try_bounded_real(plant, observer, tracking, factor, gain)
    if proof.proved:
        known[numbers] = proof
    return proof


@remembered
def _proofs_of(_observer: LinearObserver) -> dict[bytes, DefinitenessProof]:
    return {}


def _digest(*parts: FloatArray) -> bytes:
    """Return what tells numbers ``(m, n)`` from all others."""
    digest = blake2b()
    for part in parts:
        digest.update(repr((part.shape, part.dtype.str)).encode())
        digest.update(np.ascontiguousarray(part).data)
    return digest.digest()


def _try_bounded_real(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, factor: FloatArray, gain: float
) -> DefinitenessProof:
    core = factor.shape[0]
    outside = (observer.Az[:core, core:], observer.Cz[observer.fault_rows, core:])
    # What follows the core must be a chain of delays: strictly lower triangular, hence stable.
    chain = np.triu(observer.Az[core:, core:])
    if any(np.any(part != 0.0) for part in (*outside, chain)):
        return unproved("the states after the core are no chain of delays, or act on the core or the fault estimate")
    if not _is_triangular(factor) or not gain > 0.0:
        return unproved("the certificate is not triangular and nonsingular, or the gain is not positive")
    inverse = np.triu(np.linalg.inv(factor))
    if not _is_invertible(inverse):
        return unproved("the certificate cannot be inverted")

    def formula(kind: type[Enclosed]) -> Enclosed:
        exact = kind.exact
        core, nd = factor.shape[0], plant.nd
        q, s = exact(factor), exact(inverse)
        b = exact(tracking[:core, : plant.nx]) @ exact(plant.Bd) - exact(observer.By[:core]) @ exact(plant.Dd)
        qs, qms = q @ s, q @ (exact(observer.Az[:core, :core]) @ s)
        cs = exact(observer.Cz[observer.fault_rows, :core]) @ s
        d = exact(observer.Dy[observer.fault_rows]) @ exact(plant.Dd)
        level = exact(np.eye(nd)).scaled(gain).scaled(gain)
        qb, nf = q @ b, cs.shape[0]

        def zero(rows: int, columns: int) -> Enclosed:
            return exact(np.zeros((rows, columns)))

        return block(
            [
                [qs.T @ qs, zero(core, nd), qms.T, cs.T],
                [zero(nd, core), level, qb.T, -d.T],
                [qms, qb, exact(np.eye(core)), zero(core, nf)],
                [cs, -d, zero(nf, core), exact(np.eye(nf))],
            ]
        )

    return prove_positive_definite(formula)


def _is_triangular(factor: FloatArray) -> bool:
    """Whether a factor is upper triangular and nonsingular."""
    return bool(np.all(np.tril(factor, -1) == 0.0) and np.all(np.diag(factor) != 0.0))


def _is_invertible(inverse: FloatArray) -> bool:
    return bool(np.all(np.isfinite(inverse)) and np.all(np.diag(inverse) != 0.0))


def prove_symmetric_positive(matrix: FloatArray) -> DefinitenessProof:
    """Try to prove that a matrix is symmetric, exactly, and positive definite."""
    if not np.array_equal(matrix, matrix.T):
        return unproved("the matrix is not symmetric")
    return prove_positive_definite(matrix)


def prove_gain(
    a: FloatArray | Ball,
    b: FloatArray | Ball,
    c: FloatArray | Ball,
    P: FloatArray,
    gain: float,
    *,
    direct: FloatArray | Ball | None = None,
) -> DefinitenessProof:
    """Try to prove that ``x' = a x + b v``, ``z = c x + direct v`` is stable, and of an H-infinity norm below ``gain``:
    ``P > 0``, ``[P a + a' P, P b, c'; b' P, -gain^2 I, direct'; c, direct, -I] < 0``."""
    positive = prove_symmetric_positive(P)
    if not positive.proved:
        return unproved(f"P itself: {positive.reason}")
    if not gain > 0.0:
        return unproved(NO_GAIN)
    states, inputs, outputs = Ball.of(a), Ball.of(b), Ball.of(c)
    through = Ball.of(np.zeros((outputs.shape[0], inputs.shape[1])) if direct is None else direct)

    def formula(kind: type[Enclosed]) -> Enclosed:
        p, shown, d = kind.exact(P), kind.of(outputs), kind.of(through)
        moved, entering = p @ kind.of(states), p @ kind.of(inputs)
        level = kind.exact(np.eye(inputs.shape[1])).scaled(gain).scaled(gain)
        identity = kind.exact(np.eye(outputs.shape[0]))
        return block([[-(moved + moved.T), -entering, shown.T], [-entering.T, level, d.T], [shown, d, identity]])

    return prove_positive_definite(formula)


class System(Protocol):
    """How a system ``(a, b, c, d)`` is formed, in an arithmetic of whoever calls it."""

    def __call__(self, kind: type[Enclosed], /) -> tuple[Enclosed, Enclosed, Enclosed, Enclosed]:
        """Return the matrices with what forming them may have cost."""


def prove_norm(system: System, P: FloatArray, gain: float, *, dt: float) -> DefinitenessProof:
    """Try to prove that a system is stable and of an H-infinity norm below ``gain``, in either time.

    Discrete time: ``P > 0`` and ``[P, 0, a'P, c'; 0, gain^2 I, b'P, d'; P a, P b, P, 0; c, d, 0, I] > 0``; continuous:
    ``P > 0`` and ``[-(P a + a'P), -P b, c'; -b'P, gain^2 I, d'; c, d, I] > 0``.
    """
    positive = prove_symmetric_positive(P)
    if not positive.proved:
        return unproved(f"P itself: {positive.reason}")
    if not gain > 0.0:
        return unproved(NO_GAIN)

    def formula(kind: type[Enclosed]) -> Enclosed:
        a, b, c, d = system(kind)
        p = kind.exact(P)
        moved, driven = p @ a, p @ b
        n, nw, nz = a.shape[0], b.shape[1], c.shape[0]
        level, one = kind.exact(np.eye(nw)).scaled(gain).scaled(gain), kind.exact(np.eye(nz))

        def zero(rows: int, columns: int) -> Enclosed:
            return kind.exact(np.zeros((rows, columns)))

        if dt == 0.0:
            return block([[-(moved + moved.T), -driven, c.T], [-driven.T, level, d.T], [c, d, one]])
        return block(
            [
                [p, zero(n, nw), moved.T, c.T],
                [zero(nw, n), level, driven.T, d.T],
                [moved, driven, p, zero(n, nz)],
                [c, d, zero(nz, n), one],
            ]
        )

    return prove_positive_definite(formula)


def prove_stable(a: FloatArray, factor: FloatArray, dt: float) -> DefinitenessProof:
    """Try to prove that every mode of ``a (n, n)`` decays; ``factor (n, n)``."""
    if factor.shape != a.shape or not np.all(np.isfinite(factor)) or not np.all(np.isfinite(a)):
        return unproved("the certificate does not fit, or a number is not finite")
    if a.shape[0] == 0:
        return DefinitenessProof(True, np.inf, 0.0, "Cholesky")
    if not _is_triangular(factor):
        return unproved("the certificate is not triangular and nonsingular")
    inverse = np.triu(np.linalg.inv(factor))
    if not _is_invertible(inverse):
        return unproved("the certificate cannot be inverted")

    def formula(kind: type[Enclosed]) -> Enclosed:
        q, s = kind.exact(factor), kind.exact(inverse)
        whole, moved = q @ s, q @ (kind.exact(a) @ s)
        if dt > 0.0:
            identity = kind.exact(np.eye(a.shape[0]))
            return block([[whole.T @ whole, moved.T], [moved, identity]])
        half = whole.T @ moved
        return -(half + half.T)

    return prove_positive_definite(formula)


def stability_factor(observer: LinearObserver) -> FloatArray:
    """Return Q, upper triangular, with which `prove_stable` succeeds: of a proved contraction, the identity without."""
    contraction = contraction_of(observer)
    return np.eye(observer.order) if contraction is None else contraction.Q


def stability_row(a: FloatArray, factor: FloatArray, dt: float, source: str) -> Check:
    """Return the row that every mode of ``a (n, n)`` decays, by a Lyapunov factor."""
    claim = "every error decays: the Lyapunov inequality is positive definite"
    return proof_row("stability", claim, prove_stable(a, factor, dt), source)


def proof_row(name: str, claim: str, proof: DefinitenessProof, source: str) -> Check:
    """Return the row of a proof that a matrix is positive definite."""
    bound = proof.lower_bound
    return Check(name, claim, bound, 0.0, bound, proof.proved, source, "proved", proof.text)


def decay_row(observer: LinearObserver, claimed: float) -> Check:
    """Return the row on a claimed decay (1/s): proved for all but `RATE_TOLERANCE` of it, whatever poles there are."""
    a, dt = observer.Az, observer.dt
    slowest = float(np.min(decay_rates(poles_of(observer), dt), initial=np.inf))
    wanted = claimed - RATE_TOLERANCE * abs(claimed)
    source, passed = "recomputed eigenvalues", bool(slowest >= wanted)
    status: CheckKind = "computed"
    if not len(a) or _contracts(a, dt, wanted):
        source, passed, status = "Lyapunov inequality, shifted by the rate", True, "proved"
        slowest = max(slowest, wanted)
    elif (enclosed := enclosed_eigenvalues(a)) is not None:
        slowest = enclosed_decay(enclosed, dt)
        source, passed, status = "enclosure of each eigenvalue of the stored numbers", bool(slowest >= wanted), "proved"
    slow = f"slowest time constant {1.0 / slowest:.3g} s; " if 0.0 < slowest < np.inf else ""
    return Check(
        "decay",
        "every mode decays at the claimed rate (1/s) or faster",
        slowest,
        wanted,
        slowest - wanted,
        passed,
        source,
        status,
        f"{slow}{status} for {wanted:.6g} 1/s",
    )


def slowest_decay(a: FloatArray, dt: float) -> float:
    """Return the rate of the slowest mode (1/s), such that `decay_row` can find it again; infinite without modes."""
    slowest = float(np.min(decay_rates(eigenvalues(a), dt), initial=np.inf))
    if not np.isfinite(slowest) or _contracts(a, dt, slowest - RATE_TOLERANCE * abs(slowest)):
        return slowest
    enclosed = enclosed_eigenvalues(a)
    return slowest if enclosed is None else enclosed_decay(enclosed, dt)


def enclosed_decay(enclosed: tuple[Any, ...], dt: float) -> float:
    """Return a lower bound on the rate of the slowest of some enclosed eigenvalues."""
    if dt == 0.0:
        return float(np.nextafter(min(float((-ball.real).lower()) for ball in enclosed), -np.inf))
    # The two roundings of the logarithm's argument are far below the tolerance of a rate.
    radius = max(float(abs(ball).upper()) for ball in enclosed)
    return float(-np.log(np.nextafter(radius, np.inf)) / dt) if radius > 0.0 else np.inf


def _contracts(a: FloatArray, dt: float, rate: float) -> bool:
    if not rate > 0.0 or not np.isfinite(rate):
        return False
    return prove_contraction(a, discrete=dt > 0.0, rate=float(np.exp(-rate * dt)) if dt > 0.0 else rate) is not None
