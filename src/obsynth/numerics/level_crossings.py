"""Where the gain of a discrete-time system crosses a level: eigenvalues of a symplectic pencil on the unit circle."""

from __future__ import annotations

import numpy as np

from obsynth.numerics.arrays import ComplexArray, FloatArray

#: Eigenvalues of the symplectic pencil this close to the unit circle are looked at as crossings: a false one costs
#: one more look, a missed one would cost the bound.
CIRCLE_TOLERANCE = 1e-3
#: Reciprocal condition number down to which a matrix may be inverted on the way to those eigenvalues.
SAFE_CONDITION = 1e-7


def level_crossings(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float
) -> tuple[FloatArray, float]:
    """Return the angles in [0, pi] at which a singular value equals ``level``, and the distance of the closest miss.

    The transfer function has the singular value g at e^{jw} exactly when the pencil
    ``z [I 0; C'C + C'D R^-1 D'C, A' + C'D R^-1 B'] - [A + B R^-1 D'C, B R^-1 B'; 0 I]``, with
    ``R = g^2 I - D'D``, is singular at z = e^{jw}.

    Shapes: ``a (n, n)``, ``b (n, m)``, ``c (p, n)``, ``d (p, m)``.
    """
    root = np.sqrt(level)
    b, c, d = b / root, c / root, d / level
    n = a.shape[0]
    weight = np.eye(d.shape[1]) - d.T @ d
    solved = np.linalg.solve(weight, np.hstack([d.T @ c, b.T]))
    through, back = solved[:, :n], solved[:, n:]
    left, right = np.eye(2 * n), np.eye(2 * n)
    left[n:, :n], left[n:, n:] = c.T @ c + c.T @ d @ through, a.T + c.T @ d @ back
    right[:n, :n], right[:n, n:] = a + b @ through, b @ back
    alpha, beta = _pencil_eigenvalues(right, left)
    size = np.abs(alpha) + np.abs(beta)
    # |alpha| and |beta| are compared, not divided: infinite eigenvalues need no special case.
    miss = np.abs(np.abs(alpha) - np.abs(beta)) / np.where(size == 0.0, 1.0, 0.5 * size)
    miss[size == 0.0] = 0.0
    near = miss < CIRCLE_TOLERANCE
    return np.abs(np.angle(alpha[near] * np.conj(beta[near]))), float(np.min(miss))


def _pencil_eigenvalues(right: FloatArray, left: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return alpha and beta of the eigenvalues ``z = alpha / beta`` of ``right - z left``.

    With ``z = (1 + s) / (1 - s)`` these are ordinary ones, of ``(right + left)^-1 (right - left)``, where that can be
    inverted without harm, which it cannot if there is one close to -1; or the same with ``-left`` and -z, and +1.  The
    circle becomes the imaginary axis.
    """
    from scipy.linalg import eigvals
    from scipy.linalg.lapack import dgecon, dgetrf, dgetrs

    for sign in (1.0, -1.0):
        both = np.asarray_chkfinite(right + sign * left)
        factors, pivots, failed = dgetrf(both)
        if not failed and dgecon(factors, np.max(np.sum(np.abs(both), axis=0)))[0] > SAFE_CONDITION:
            s = np.linalg.eigvals(dgetrs(factors, pivots, right - sign * left)[0])
            return np.asarray(sign * (1.0 + s), dtype=np.complex128), np.asarray(1.0 - s, dtype=np.complex128)
    alpha, beta = eigvals(right, left, homogeneous_eigvals=True)
    return np.asarray(alpha), np.asarray(beta)
