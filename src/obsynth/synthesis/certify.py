"""Finding a certificate for gains in hand: a Lyapunov matrix with which the shipped inequality can be proved."""

from __future__ import annotations

import numpy as np

from obsynth.models.descriptor import DescriptorSystem
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear import LinearObserver
from obsynth.synthesis.riccati import bounded_real_matrix, normalising_change
from obsynth.verification.bounded_real import prove_bounded_real
from obsynth.verification.error_system import ErrorSystem

#: Levels, relative to the claimed one, at which coordinates are improved on the way to it.
APPROACH = (1.5, 1.05, 1.001)
#: Slack of the Riccati equation relative to the output weight, largest first: the first that proves is taken.
SLACKS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)


def bounded_real_certificate(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, gain: float, *, core: int, lag: int
) -> FloatArray:
    """Return Q ``(core, core)``, upper triangular with P = Q'Q, for the shipped observer at level ``gain``.

    The Riccati solution with the largest slack that gives a proof; the last try when none does, for the report.

    Parameters
    ----------
    plant, observer, tracking, lag
        As for `obsynth.verification.bounded_real.prove_bounded_real`.
    gain : float
        Level to certify.
    core : int
        Leading observer states that carry the fault estimate.
    """
    errors = ErrorSystem.of(plant, observer, tracking, lag)
    a, b = observer.Az[:core, :core], errors.disturbance[:core] / gain
    c, d = -errors.fault_output[0][:, :core], errors.fault_output[2] / gain
    change = np.eye(core)
    for level in APPROACH:
        inverse = np.asarray(np.linalg.inv(change))
        better = _well_scaled(inverse @ a @ change, inverse @ b, c @ change, d, level)
        change = change @ better
    inverse = np.asarray(np.linalg.inv(change))
    a, b, c = inverse @ a @ change, inverse @ b, c @ change
    best = _triangular(inverse)
    for slack in SLACKS:
        p = bounded_real_matrix(a, b, c, d, 1.0, slack=slack * max(1.0, float(np.linalg.norm(c, 2)) ** 2))
        if p is None:
            continue
        best = _triangular(np.asarray(np.linalg.cholesky(p)).T @ inverse)
        if prove_bounded_real(plant, observer, tracking, best, gain, lag=lag).proved:
            break
    return best


def _triangular(factor: FloatArray) -> FloatArray:
    """Return the upper triangular factor of the same Gram matrix."""
    return np.asarray(np.triu(np.linalg.qr(factor, mode="r")))


def _well_scaled(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float) -> FloatArray:
    """Return a state change in which the Riccati solution at ``level`` is the identity."""
    tail = 1e-6 * max(float(np.linalg.norm(c, 2)) ** 2, np.finfo(np.float64).tiny)
    p = bounded_real_matrix(a, b, c, d, level, slack=tail)
    if p is None:
        p = bounded_real_matrix(a, b[:, :0], c, d[:, :0], 1.0, slack=tail)
    return np.eye(a.shape[0]) if p is None else normalising_change(p)
