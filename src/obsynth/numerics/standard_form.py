"""A descriptor system as a discrete-time state space, for H-infinity problems of either time and any index.

Continuous time: the Cayley transform ``s = alpha (z - 1) / (z + 1)`` keeps H-infinity norms, stability and causality,
and ``alpha E - A`` is invertible whatever the index.  Discrete time: the infinite modes are split off by QZ; an index
above one makes outputs depend on later inputs, so that all inputs are taken some samples later (a chain), which
changes no norm.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray

#: Infinite eigenvalues of index 3 come out of QZ near ``eps^(-1/3)``: beyond this an eigenvalue is infinite.
INFINITE_EIGENVALUE = 1e4
#: A direction counts as reached above this share of the matrices.
REACHED_SHARE = 1e-10
#: Powers of the nilpotent part that are smaller than this are none.
NILPOTENT_LEFT = 1e-10
#: Off the geometric mean of the poles, so that no pole lies on the point.
CAYLEY_DETUNING = 1.0371
#: Moduli of poles between which the Cayley point is chosen, rad/s.
SLOWEST_POLE, FASTEST_POLE = 1e-6, 1e6


class StandardForm(NamedTuple):
    """``x+ = A x + B v``, ``y = C x + D v``, minimal; inputs ``shift`` samples later; ``alpha``: the Cayley point."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    shift: int
    alpha: float


def reachable_basis(a: FloatArray, b: FloatArray, *, share: float = REACHED_SHARE, scale: float = 0.0) -> FloatArray:
    """Return an orthonormal basis ``(n, r)`` of what inputs ``b`` reach, by a staircase of singular values.

    A direction counts where it is larger than ``share`` of ``scale``; by default of the matrices themselves.
    """
    n, basis, x = len(a), np.zeros((len(a), 0)), np.asarray(b)
    size = max(float(np.linalg.norm(a)), SMALLEST)
    while basis.shape[1] < n and x.size:
        for _ in range(2):
            x = x - basis @ (basis.T @ x)
        level = scale or (float(np.linalg.norm(b)) if not basis.shape[1] else size)
        left_vectors, values, _ = np.linalg.svd(x, full_matrices=False)
        left_vectors = left_vectors[:, values > share * max(level, SMALLEST)]
        if not left_vectors.shape[1]:
            break
        basis = np.hstack([basis, left_vectors])
        x = a @ left_vectors
    return basis


def cayley_point(*poles: Any) -> float:
    """Return the geometric mean of the moduli of poles, rad/s: where the Cayley transform loses the fewest digits."""
    sizes = np.abs(np.concatenate([np.ravel(part) for part in poles]))
    sizes = sizes[np.isfinite(sizes)]
    sizes = sizes[(sizes > SLOWEST_POLE) & (sizes < FASTEST_POLE)]
    return CAYLEY_DETUNING * (float(np.exp(np.mean(np.log(sizes)))) if sizes.size else 1.0)


def finite_poles(e: FloatArray, a: FloatArray, count: int) -> ComplexArray:
    """Return the ``count`` smallest eigenvalues of a pencil: the finite ones, where the staircase counted so many.

    QZ returns infinite ones of index 3 near 1e5, and of higher index nearer: no bound on their moduli parts them.
    """
    poles = scipy.linalg.eigvals(a, e)
    order = np.argsort(np.where(np.isfinite(poles), np.abs(poles), np.inf), kind="stable")
    return np.asarray(poles[np.sort(order[:count])], dtype=np.complex128)


def standard_form(
    e: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, dt: float, *, alpha: float | None = None
) -> StandardForm:
    """Return a regular descriptor system in standard form.

    Parameters
    ----------
    e, a, b, c, d : FloatArray
        ``E x+ = A x + B v``, ``y = C x + D v`` (x' for ``dt = 0``), the pencil regular, any index.
    dt : float
        Seconds between samples, 0 for continuous time.
    alpha : float, optional
        Point of the Cayley transform, rad/s; by default `cayley_point` of the poles.
    """
    if dt == 0.0:
        point = cayley_point(scipy.linalg.eigvals(a, e)) if alpha is None else alpha
        system, shift = _cayley_of_descriptor(e, a, b, c, d, point), 0
    else:
        point, (system, shift) = 1.0, _without_infinite_modes(e, a, b, c, d)
    A, B, C, D = system
    reached = reachable_basis(A, B)
    A, B, C = reached.T @ A @ reached, reached.T @ B, C @ reached
    observable = reachable_basis(A.T, C.T)
    # Bases at right angles leave rounding of other inputs in the columns of those that do nothing.
    acting = np.any(b != 0.0, axis=0) | np.any(d != 0.0, axis=0)
    return StandardForm(observable.T @ A @ observable, observable.T @ B * acting, C @ observable, D, shift, point)


def _cayley_of_descriptor(
    e: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, alpha: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    factor, root = scipy.linalg.lu_factor(alpha * e - a), np.sqrt(2.0 * alpha)
    moved_b = scipy.linalg.lu_solve(factor, b)
    moved = scipy.linalg.lu_solve(factor, alpha * e + a)
    return moved, root * moved_b, root * (c @ scipy.linalg.lu_solve(factor, e)), d + c @ moved_b


def cayley(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, alpha: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the Cayley transform of a continuous-time system, which has its norm; alpha is no pole of it."""
    identity = np.eye(len(a))
    inverse, root = np.linalg.inv(alpha * identity - a), np.sqrt(2.0 * alpha)
    return inverse @ (alpha * identity + a), root * inverse @ b, root * c @ inverse, d + c @ inverse @ b


def uncayley(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, alpha: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the continuous-time system whose Cayley transform is given; ``I + a`` must be invertible."""
    inverse, root = np.linalg.inv(np.eye(len(a)) + a), np.sqrt(2.0 * alpha)
    moved = -alpha * inverse @ (np.eye(len(a)) - a)
    return moved, root * inverse @ b, root * c @ inverse, d - c @ inverse @ b


def _without_infinite_modes(
    e: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray
) -> tuple[tuple[FloatArray, FloatArray, FloatArray, FloatArray], int]:
    """Split off the infinite modes; where they differentiate, all inputs are taken later, by a chain of samples."""
    n = len(a)

    def finite(alphas: Any, betas: Any) -> Any:
        return np.abs(betas) * INFINITE_EIGENVALUE > np.abs(alphas)

    aa, ee, alphas, betas, q, z = scipy.linalg.ordqz(a, e, sort=finite, output="real")
    k = int(np.sum(finite(alphas, betas)))
    bq, cz = q.T @ b, c @ z
    a1, e1, a2, e2 = aa[:k, :k], ee[:k, :k], aa[k:, k:], ee[k:, k:]
    if 0 < k < n:
        # A1 R - S A2 = -A12, E1 R - S E2 = -E12: what couples both parts is taken away.
        m = n - k
        system = np.block(
            [
                [np.kron(np.eye(m), a1), -np.kron(a2.T, np.eye(k))],
                [np.kron(np.eye(m), e1), -np.kron(e2.T, np.eye(k))],
            ]
        )
        right = -np.concatenate([aa[:k, k:].ravel("F"), ee[:k, k:].ravel("F")])
        solved = np.linalg.solve(system, right)
        r, s = solved[: k * m].reshape((k, m), order="F"), solved[k * m :].reshape((k, m), order="F")
        bq = np.vstack([bq[:k] - s @ bq[k:], bq[k:]])
        cz = np.hstack([cz[:, :k], cz[:, k:] + cz[:, :k] @ r])
    A, B = (
        (np.linalg.solve(e1, a1), np.linalg.solve(e1, bq[:k])) if k else (np.zeros((0, 0)), np.zeros((0, b.shape[1])))
    )
    C, D, later = cz[:, :k], d, _polynomial_part(a2, e2, bq[k:], cz[:, k:])
    shift = max(len(later) - 1, 0)
    if later:
        D = D + later[0]
    if shift:
        width = b.shape[1]
        count = width * shift
        chain, enter = np.eye(count, k=-width), np.eye(count, width)
        oldest = np.eye(width, count, k=count - width)
        C = np.hstack([C, np.hstack([*later[1:-1][::-1], D])])
        A = np.block([[A, B @ oldest], [np.zeros((count, k)), chain]])
        B, D = np.vstack([np.zeros((k, width)), enter]), later[-1]
    return (A, B, C, D), shift


def _polynomial_part(a2: FloatArray, e2: FloatArray, b2: FloatArray, c2: FloatArray) -> list[FloatArray]:
    """Return the matrices by which outputs depend on the inputs of this sample, the next, and so on."""
    coefficients: list[FloatArray] = []
    if not len(a2):
        return coefficients
    nilpotent, x = np.linalg.solve(a2, e2), -np.linalg.solve(a2, b2)
    while len(coefficients) < len(a2) and np.max(np.abs(x), initial=0.0) > NILPOTENT_LEFT:
        coefficients.append(c2 @ x)
        x = nilpotent @ x
    while coefficients and np.max(np.abs(coefficients[-1]), initial=0.0) < NILPOTENT_LEFT:
        coefficients.pop()
    return coefficients
