r"""Sampling of a continuous polytope of error systems with constant parameters in each sample, with a remainder.

:math:`e^{T A(\mu)}` is no mean of the :math:`e^{T A_i}`, but nearly so.  Along a line in the hull its second derivative
is at most :math:`T^2 |H|^2 e^{a T}`, a the largest logarithmic norm (0 or more), and what a function with such a
derivative misses of the mean of its ends is, by Jensen's inequality,

.. math::
    |e^{T A(\mu)} - \textstyle\sum \mu_i e^{T A_i}| \le T^2 D^2 (1 - 1/N) e^{a T} / 4

with D the diameter of the hull in Frobenius' norm.  An observer that uses :math:`e^{T A(\mu_k)}` itself has errors with
this remainder beside A.  A parameter that moves within the sample has the transition of the plant differ by at most
:math:`\nu T^2 e^{a T} / 2`, :math:`|dA/dt| \le \nu`; this multiplies the state and not the error.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.affine import AffineMatrix, affine_exponential
from obsynth.proofs.balls import UNIT_ROUNDOFF
from obsynth.verification.error_polytope import ErrorPolytope

#: By how much bounds are larger than computed, for all rounding of a few norms and eigenvalues.
_ROOM = 1.0 + 1e-9


@arguments_checked
def sampled_polytope(errors: ErrorPolytope, dt: float) -> ErrorPolytope:
    """Return a continuous error system without inputs at samples, for parameters that rest between them.

    Parameters
    ----------
    errors : ErrorPolytope
        In continuous time, all errors differential, nothing that drives them, and one C.
    dt : float
        Seconds between samples.

    Returns
    -------
    ErrorPolytope
        ``exp(dt A_i)`` at each vertex, and the remainder ``ball`` beside it, rounding among it.

    Raises
    ------
    SpecError
        The system is sampled, has algebraic errors or inputs, dt is not positive, or errors grow so much within a
        sample that nothing finite bounds the remainder.

    Examples
    --------
    >>> spring = ErrorPolytope([[[0, 1], [-1, -1]], [[0, 1], [-3, -1]]], [[1.0, 0.0]], dt=0.0)
    >>> found = sampled_polytope(spring, 0.1)
    >>> found.dt, 0.005 < found.ball < 0.006
    (0.1, True)
    """
    real_number(dt, "dt", "a positive number of seconds", above=0.0)
    if errors.dt > 0.0:
        raise SpecError("The error system is sampled already.", path="errors")
    if errors.differential is not None and errors.differential < errors.order:
        raise SpecError("Algebraic errors have no samples of their own: eliminate them first.", path="errors")
    if errors.B[0].size or not errors.constant_output:
        raise SpecError(
            "Inputs of the errors, and outputs that change, are not sampled here: give A at the vertices, and one C.",
            path="errors",
        )
    # What overflows has no finite bound, and is refused.
    with np.errstate(over="ignore", invalid="ignore"):
        missed = _missed_of_means(errors, dt)
        _require_finite_square(missed, dt)
        made = [affine_exponential(_times(dt, matrix)) for matrix in errors.A]
        rounding = max(float(np.linalg.norm(matrix.radius)) for matrix in made)
        ball = missed + rounding * _ROOM
        largest = max(float(np.linalg.norm(matrix.center)) for matrix in made)
    _require_finite_square(ball + largest, dt)
    return ErrorPolytope([matrix.center for matrix in made], errors.C[0], Cz=list(errors.Cz), dt=dt, ball=ball)


def _missed_of_means(errors: ErrorPolytope, dt: float) -> float:
    """Return what the exponential misses of the mean of those at the vertices, at most."""
    diameter = dt * max(float(np.linalg.norm(one - other)) for one in errors.A for other in errors.A)
    share = (1.0 - 1.0 / errors.count) / 4.0
    return diameter * diameter * share * _growth(errors, dt) * _ROOM if diameter else 0.0


@arguments_checked
def drift_within_samples(errors: ErrorPolytope, dt: float, rate: float) -> float:
    """Return a bound on the change of a sample's transition matrix when the parameter moves within the sample.

    Parameters
    ----------
    errors : ErrorPolytope
        Of the error system in continuous time.
    dt : float
        Seconds between samples.
    rate : float
        Largest norm of ``dA/dt``, 1/s2.

    Returns
    -------
    float
        Bound on ``|Phi - exp(dt A(mu_k))|``, Phi the transition of the state over the sample.

    Raises
    ------
    SpecError
        ``dt`` or ``rate`` is not a positive number, or the bound is not finite.

    Examples
    --------
    >>> spring = ErrorPolytope([[[0, 1], [-1, -1]], [[0, 1], [-3, -1]]], [[1.0, 0.0]], dt=0.0)
    >>> round(drift_within_samples(spring, 0.1, 4.0), 4)
    0.0213
    """
    real_number(dt, "dt", "a positive number of seconds", above=0.0)
    real_number(rate, "rate", "a positive number", above=0.0)
    with np.errstate(over="ignore"):
        bound = rate * dt * dt * _growth(errors, dt) / 2.0 * _ROOM
    _require_finite_square(bound, dt)
    return bound


def _times(dt: float, matrix: FloatArray) -> AffineMatrix:
    """Return a matrix times a number, with what rounding of the products leaves."""
    product = AffineMatrix.exact(dt * matrix, 0)
    return replace(product, radius=np.nextafter(UNIT_ROUNDOFF * np.abs(product.center), np.inf))


def _growth(errors: ErrorPolytope, dt: float) -> float:
    """Return ``exp(a dt)`` for the largest logarithmic norm a at the vertices, 0 or more: it is convex, so that no
    point of the hull has a larger one."""

    def logarithmic_norm(matrix: FloatArray) -> float:
        largest = float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[-1])
        return largest + (_ROOM - 1.0) * float(np.linalg.norm(matrix))

    exponent = max(0.0, *map(logarithmic_norm, errors.A)) * dt
    return math.exp(exponent) if exponent < math.log(np.finfo(np.float64).max) else math.inf


def _require_finite_square(bound: float, dt: float) -> None:
    """Refuse a bound that no inequality can hold: its square is in each."""
    if not math.isfinite(bound * bound):
        raise SpecError(
            f"Nothing finite bounds what samples of {dt:.6g} s miss, so much can errors grow or parameters move within "
            "one: take a smaller dt, or states in units of like size.",
            path="dt",
        )
