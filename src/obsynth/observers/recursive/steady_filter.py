"""The steady state of the descriptor Kalman filter of a time-invariant plant, from its algebraic Riccati equation."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.analysis.existence.condition import Condition, require_all
from obsynth.analysis.existence.kalman import with_stated_noise
from obsynth.analysis.existence.recursive import described_mode, recursive_conditions
from obsynth.analysis.time_varying import as_time_varying
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.numerics.arguments import arguments_checked, require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix, read_only, require_no_overflow
from obsynth.numerics.invariant_zeros import are_outside
from obsynth.numerics.matrix_equations import discrete_lyapunov, discrete_riccati
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import (
    BOUNDARY_TOLERANCE,
    CANCELLATION_TOLERANCE,
    NEGLIGIBLE_SHARE,
    covariance_factor,
    decide_rank,
    product_but_rounding,
)
from obsynth.numerics.square_root_estimation import least_squares_step, rank_revealing_step
from obsynth.observers.recursive.gain_schedule import MOST_SETTLING_STEPS
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.step_model import StepMatrices, rounding_of, stacked_noise
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.recovery import Transformation

#: The solution must satisfy its equation to this share of its size: half the digits.
RICCATI_TOLERANCE = 1e-8

#: A deviation below so many roundings of the noise that a gain passes on is zero: what is exact came out below three.
ROUNDED_TERMS = 64.0

#: Newton steps after the recursion: each doubles the digits.
MOST_RICCATI_STEPS = 50


@dataclass(frozen=True, eq=False)
class SteadyState:
    """What the filter converges to.

    Parameters
    ----------
    P : FloatArray
        ``(nx, nx)``: covariance of the estimate.
    P_predicted : FloatArray
        ``(ne, ne)``: ``A P A' + Q``, the unknown of (16).
    L, K : FloatArray
        ``(nx, ne)`` and ``(nx, ny)``: the gains (11).
    rate : float
        Factor per step by which the distance of P to its limit shrinks: the squared spectral radius of L A.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], dt=1.0)
    >>> steady = obsynth.steady_state_filter(plant, Q=1.0, R=1.0)
    >>> steady.K.round(4).tolist(), round(steady.rate, 4)
    ([[0.5311]], 0.055)
    """

    P: FloatArray
    P_predicted: FloatArray
    L: FloatArray
    K: FloatArray
    rate: float


@arguments_checked
def steady_state_filter(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | Transformation,
    *,
    Q: ArrayLike | None = None,
    R: ArrayLike | None = None,
) -> SteadyState:
    r"""Return the steady state of the descriptor Kalman filter.

    Solves (16) for the inverse of P, where Q and R are definite:

    .. math::
        X = E^T Q^{-1} E + C^T R^{-1} C - E^T Q^{-1} A (A^T Q^{-1} A + X)^{-1} A^T Q^{-1} E, \qquad P = X^{-1}

    Parameters
    ----------
    plant : DescriptorSystem, TimeVaryingDescriptorSystem or Transformation
        Time-invariant, discrete; ``E (ne, nx)``, ``C (ny, nx)``.
    Q, R : array_like, optional
        ``(ne, ne)`` and ``(ny, ny)``, may be singular; a number stands for that multiple of the identity.  By default
        ``Bw Bw'`` and ``Dw Dw'`` where the plant states its noise, else identities, as of `obsynth.descriptor_kalman`.

    Returns
    -------
    SteadyState
        Covariances, gains, and the rate of convergence per step (dimensionless).

    Raises
    ------
    SpecError
        The plant changes with k, or Q or R is no covariance.
    PreconditionError
        ``rank [E; C] < nx``, an undetectable mode, or a mode on the unit circle that no noise reaches: the covariance
        then tends to zero like ``1 / k``, and no stabilising solution exists.
    SolverError
        No solution was found that passes its own residual; the recursion may still converge.

    Notes
    -----
    (16) needs Q and R definite.  Where they are singular (equations or outputs that hold exactly) or ill-conditioned,
    the fixed point of the filter's own step is found by Newton's method (Kleinman), from gains that the recursion has
    made stable.  States that sensors and equations without noise tell exactly have a covariance of zero.

    References
    ----------
    .. [MoussaAli2013] Fault diagnosis for linear time-varying descriptor systems, IFAC ALCOSP 2013, eq. (16).

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], dt=1.0)
    >>> steady = obsynth.steady_state_filter(plant, Q=1.0, R=1.0)
    >>> sorted(name for name in dir(steady) if not name.startswith("_"))
    ['K', 'L', 'P', 'P_predicted', 'rate']
    """
    varying = as_time_varying(plant)
    if not varying.is_time_invariant:
        raise SpecError("The plant changes with k: it has no steady state.", path="plant")
    require_all(recursive_conditions(varying, parameters=False))
    own = plant.plant if isinstance(plant, Transformation) else plant
    stated = with_stated_noise(own, {"Q": Q, "R": R})
    covariances = {name: 1.0 if given is None else given for name, given in stated.items()}
    q, r = (
        float(as_matrix(given, name)[0, 0]) * np.eye(size) if np.ndim(given) == 0 else as_matrix(given, name)
        for (name, given), size in zip(covariances.items(), (varying.ne, varying.ny), strict=True)
    )
    for name, matrix, size in (("Q", q, varying.ne), ("R", r, varying.ny)):
        require_shape(matrix.shape, (size, size), name)
        require_no_overflow(matrix, name, name)
    roots = covariance_factor(q, "Q"), covariance_factor(r, "R")
    reached_condition(varying, *roots).require()
    E, A, C = varying.E.at(1), varying.A.at(0), varying.C.at(1)
    noise = stacked_noise(*roots)
    P = _from_riccati(E, A, C, q, r) if decide_rank(q).full and decide_rank(r).full else None
    step = _Step(E, A, C, noise)
    if P is None or not step.stays_at(P):
        P = _from_recursion(step)
    if not step.stays_at(P):
        known = step.without_rounding(P)
        P = known if step.stays_at(known, rounded=True) and step.is_stable(step.settled_gain(known)) else P
    gain = step.settled_gain(P)
    if not step.stays_at(P, rounded=True):
        raise SolverError("The solution of the Riccati equation (16) fails its own residual. Run the filter instead.")
    L, K = gain[:, : varying.ne], gain[:, varying.ne :]
    return SteadyState(
        read_only(P), read_only(A @ P @ A.T + q), read_only(L), read_only(K), spectral_radius(L @ A) ** 2
    )


def settled_contraction(observer: RecursiveObserver) -> float | None:
    """Return the spectral radius of L A in the steady state that the gains of a filter tend to.

    They tend to it from every start that is uncertain in all states, and from any other where noise reaches every mode
    that does not decay.  ``None`` where plant or noise change with k, where there is a horizon, or no such state.
    """
    plant = observer.plant
    alike = plant.is_time_invariant and observer.Q.is_constant and observer.R.is_constant
    if not alike or plant.horizon or observer.early_constraints:
        return None
    if not forgets_its_start(observer):
        return None
    q, r = observer.Q.at(0), observer.R.at(0)
    try:
        # The solution is judged by its own residual, whatever LAPACK thinks of the digits on the way.
        with warnings.catch_warnings(action="ignore"):
            steady = steady_state_filter(plant, Q=q, R=r)
    except (PreconditionError, SolverError, SpecError):
        return None
    return float(np.sqrt(steady.rate))


def is_uncertain_at_first(observer: RecursiveObserver) -> bool:
    """Whether the stated covariance of the first state leaves no direction of it known exactly."""
    start = np.asarray(observer.initial_covariance)
    deviations = np.sqrt(np.maximum(np.diag(start), np.finfo(np.float64).tiny))
    return decide_rank(start / np.outer(deviations, deviations)).full


def forgets_its_start(observer: RecursiveObserver) -> bool:
    """Whether gains tend to those of the steady state from the stated covariance of the first state: it is uncertain in
    all states, or noise, which is constant, reaches every mode that does not decay."""
    if is_uncertain_at_first(observer):
        return True
    q, r = covariance_factor(observer.Q.at(0), "Q"), covariance_factor(observer.R.at(0), "R")
    return not _unreached(observer.plant, q, r)


def _unreached(plant: TimeVaryingDescriptorSystem, Q_root: FloatArray, R_root: FloatArray) -> list[complex]:
    """Return the modes that do not decay and that no noise reaches."""
    E, A, C = plant.E.at(1), plant.A.at(0), plant.C.at(1)
    if decide_rank(R_root, expected=len(R_root)).full:
        # Noise of its own in every output: equations alone lose rank, or nothing does.
        C, R_root = C[:0], R_root[:0]
    noise = stacked_noise(Q_root[:, Q_root.any(axis=0)], R_root[:, R_root.any(axis=0)])
    wide_e = np.hstack([np.vstack([E, C]), np.zeros_like(noise)])
    wide_a = np.hstack([np.vstack([A, np.zeros_like(C)]), noise])
    zeros = finite_zeros(wide_e, wide_a, to_the_end=False)
    outside = are_outside(wide_e, wide_a, zeros, plant.dt)
    return [complex(z) for z, out in zip(zeros.values, outside, strict=True) if out]


def reached_condition(plant: TimeVaryingDescriptorSystem, Q_root: FloatArray, R_root: FloatArray) -> Condition:
    """Return the condition that noise reaches every mode on the unit circle, so that the gains never fall asleep."""
    on_circle = [z for z in _unreached(plant, Q_root, R_root) if abs(z) <= 1.0 + BOUNDARY_TOLERANCE]
    listed = ", ".join(described_mode(z) for z in on_circle if z.imag >= 0.0)
    detail = (
        "no mode lies on the unit circle unreached"
        if not on_circle
        else (
            f"at z = {listed} the noise does not act: what is known there grows without end, so that the gains tend "
            "to zero like 1 / k and later changes are not followed. Give the equations that move this "
            "mode a variance in Q."
        )
    )
    return Condition(
        "noise on the unit circle",
        "[A - zE, Q^(1/2), 0; -zC, 0, R^(1/2)] has its full rank for all |z| = 1",
        not on_circle,
        float(len(on_circle)),
        0.0,
        "Nikoukhah, Willsky, Levy 1992",
        detail,
        on_circle[0] if on_circle else None,
    )


def _from_riccati(E: FloatArray, A: FloatArray, C: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray | None:
    """Solve (16) for the inverse of P; return ``None`` where the solver finds nothing."""

    n = E.shape[1]
    weighted = np.linalg.solve(q, np.hstack([E, A]))
    information = E.T @ weighted[:, :n] + C.T @ np.linalg.solve(r, C)
    cross, square = E.T @ weighted[:, n:], A.T @ weighted[:, n:]
    try:
        # What a badly conditioned equation gives is judged by its residual.
        with warnings.catch_warnings(action="ignore"):
            inverse = discrete_riccati(
                np.zeros((n, n)),
                np.eye(n),
                0.5 * (information + information.T),
                0.5 * (square + square.T),
                e=np.eye(n),
                s=cross,
            )
        P = np.linalg.inv(inverse)
    except (np.linalg.LinAlgError, ValueError):  # SciPy raises ValueError where it cannot reorder the Schur form
        return None
    return np.asarray(0.5 * (P + P.T), dtype=np.float64) if np.all(np.isfinite(P)) else None


def _from_recursion(step: _Step) -> FloatArray:
    """Find the fixed point of the step by Newton's method."""

    P, A = np.eye(step.A.shape[1]), step.A
    gain, following = step.taken(P)
    for _ in range(MOST_SETTLING_STEPS):
        if step.is_stable(gain):
            break
        P = following
        gain, following = step.taken(P)
    else:
        raise SolverError(
            f"The gains of the filter are not stable after {MOST_SETTLING_STEPS} steps: its convergence is too "
            "slow for a steady state. Run the filter instead."
        )
    for _ in range(MOST_RICCATI_STEPS):
        driven = product_but_rounding(gain, step.noise)
        last, P = P, discrete_lyapunov(gain[:, : len(A)] @ A, driven @ driven.T)
        P = np.asarray(0.5 * (P + P.T))
        gain = step.settled_gain(P)
        if np.linalg.norm(P - last) <= CANCELLATION_TOLERANCE * np.linalg.norm(P):
            break
    return P


class _Step:
    """The step of a filter that stays the same; what rounding makes of its estimates goes on from step to step."""

    def __init__(self, E: FloatArray, A: FloatArray, C: FloatArray, noise: FloatArray) -> None:
        H = np.vstack([E, C])
        of_equations, of_outputs = np.zeros((len(A), 0)), np.zeros((len(C), 0))
        self.matrices = StepMatrices(H, A, of_equations, of_equations, of_outputs, np.zeros((0, 0)), of_outputs, noise)
        self.A, self.noise, self.rounding = A, noise, np.zeros((A.shape[1], 0))

    def taken(self, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``[L K]`` and the covariance after one step from P."""
        H, root = self.matrices.H, _root(P)
        outputs = len(H) - len(self.A)
        S = np.hstack([np.vstack([self.A @ root, np.zeros((outputs, root.shape[1]))]), self.noise])
        data, unknown = np.eye(len(H)), np.zeros((len(H), 0))
        rounding = rounding_of(self.matrices, self.rounding)
        solved = None if rounding.is_followed else least_squares_step(H, S, data)
        solved = solved or rank_revealing_step(H, S, data, unknown, mapped=len(H), rounding=rounding)
        self.rounding = solved.rounding if len(solved.rounding) else self.rounding
        return solved.estimate, np.asarray(solved.factor @ solved.factor.T)

    def is_stable(self, gain: FloatArray) -> bool:
        """Return whether errors decay with a gain ``[L K]``."""
        return spectral_radius(gain[:, : len(self.A)] @ self.A) < 1.0

    def stays_at(self, P: FloatArray, *, rounded: bool = False) -> bool:
        """Return whether a step from P comes back to it, up to digits of P, or of noise that cancels (``rounded``)."""
        gain, following = self.taken(P)
        allowed = RICCATI_TOLERANCE * np.linalg.norm(P)
        if rounded:
            allowed += np.sum(self._rounding_deviations(gain) ** 2)
        return bool(np.linalg.norm(following - P) <= allowed)

    def without_rounding(self, P: FloatArray) -> FloatArray:
        """Return P with zeros for states that are known exactly, of which rounding makes the noise that cancels."""
        gain, _ = self.taken(P)
        known = np.sqrt(np.maximum(np.diag(P), 0.0)) <= self._rounding_deviations(gain)
        return np.where(known[:, None] | known, 0.0, P)

    def _rounding_deviations(self, gain: FloatArray) -> FloatArray:
        """Return the deviation ``(nx,)`` that rounding gives each state: of noise that a gain passes on, or that would
        pass by least squares, of which a gain is what is best."""
        sizes = np.linalg.norm((np.abs(gain) + np.abs(np.linalg.pinv(self.matrices.H))) @ np.abs(self.noise), axis=1)
        return np.asarray(ROUNDED_TERMS * float(np.finfo(np.float64).eps) * sizes)

    def settled_gain(self, P: FloatArray) -> FloatArray:
        """Return ``[L K]`` at P: of one step, or where outputs without noise leave it to rounding, after many."""
        gain, _ = self.taken(P)
        for _ in range(MOST_SETTLING_STEPS if self.rounding.shape[1] else 0):
            last, (gain, _) = gain, self.taken(P)
            if np.max(np.abs(gain - last)) <= CANCELLATION_TOLERANCE * np.max(np.abs(gain)):
                break
        return gain


def _root(P: FloatArray) -> FloatArray:
    """Return a square root of a covariance that rounding may have left indefinite, or definite where it is not."""
    deviations = np.sqrt(np.maximum(np.diag(P), 0.0))
    scale = np.where(deviations > 0.0, deviations, 1.0)
    values, vectors = np.linalg.eigh(P / np.outer(scale, scale))
    significant = values > NEGLIGIBLE_SHARE * values[-1]
    return np.asarray(scale[:, None] * vectors[:, significant] * np.sqrt(values[significant]))
