"""Optimal linear estimation in discrete time: the least H-infinity or H2 norm of an error over all causal filters.

.. math:: x^+ = A x + B w, \\quad r = C x + D w, \\quad e_0 = L x + H w, \\qquad \\min_Z |e_0 - Z r|

H-infinity: the filtering Riccati equation at a level (Hassibi, Sayed, Kailath, SIAM 1999, chapter 4), bisected.  The
lower bound is a family of pasts ``x_{-k} = X Phi^k eta``, ``w_{-k-1} = W Phi^k eta`` with r = 0: every causal filter,
linear or not, estimates 0 there, and its gain is at least that of the error over the noise.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import LinAlgWarning, eigh, svd

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.matrix_equations import discrete_riccati
from obsynth.numerics.norms import frequency_response, hinf_norm, output_covariance, spectral_radius

#: Relative width at which the bisection of the level ends.
LEVEL_TOLERANCE = 1e-8

#: Halvings of the level: more than double precision has digits.
MOST_HALVINGS = 60

#: Kalman filters with poles nearer to the circle than this belong to singular problems: their gains lose all digits.
LEAST_STABILITY = 1e-6

#: Extra noise on every measurement of a singular problem, relative to the problem's own size; the first that works.
EXTRA_NOISE = (0.0, 1e-6, 1e-5, 1e-4, 1e-3)

#: Levels above the least, relative, from whose Riccati solutions a lower bound is read: near the least they blow up.
ABOVE_LEAST = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 3e-2, 1e-1)

#: Residual of the equations of a past, relative to its noise, above which it is none.
PAST_TOLERANCE = 1e-10

#: Directions of a Gramian smaller than this, relative to the largest, are rounding.
GRAMIAN_TOLERANCE = 1e-9

#: Directions that the noise reaches less than this, relative to the size of the matrices, it does not reach.
REACH_TOLERANCE = 1e-9

#: Responses below this, relative to the problem's size, are rounding.
RESPONSE_TOLERANCE = 1e-10

#: Errors below this, relative to those without measurements, are zero: all that rounding leaves of exact decoupling.
ZERO_GAIN = 1e-9

#: Pasts of singular problems of more states are not corrected: that takes a least-squares problem of n^2 unknowns.
MOST_CORRECTED = 20

#: Samples of a past that are summed; one that has not died by then shows no bound.
MOST_SAMPLES = 2000

#: Angles at which the gain of filters that need not be causal is computed, before its largest is refined.
ANGLES = 600

#: The least frequency of a grid, as a share of half a turn of a sample.
LEAST_ANGLE = 1e-6

#: Levels start at this share of the size of the data.
FIRST_LEVEL = 1e-3

#: Innovations whose smallest share of the variance is below this have no inverse.
SINGULAR_INNOVATION = 1e-11

#: Eigenvalues of a covariance below zero by more than this share are not rounding.
NEGATIVE_SHARE = 1e-7

#: How far above a bound the level that is tried lies.
ABOVE_BOUND = 1e-6

#: Responses whose energy grows by less than this share are over.
FADED = 1e-22

#: A bound from a response is lowered by this, for its rounding.
ROUNDED_DOWN = 1e-9

#: Equations whose share is below this are not independent.
DEPENDENT = 1e-12


class NoStableFilterError(Exception):
    """No stable filter exists, or none whose error noise does not move without bound; the text says which."""


@dataclass(frozen=True, eq=False)
class EstimationProblem:
    """What is measured, ``r = C x + D w``, and what is to be estimated, ``L x + H w``, of ``x+ = A x + B w``."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    L: FloatArray
    H: FloatArray

    def reduced(self, basis: FloatArray) -> EstimationProblem:
        """Return the problem on the subspace of an orthonormal basis ``(n, m)``."""
        back = basis.T
        return replace(self, A=back @ self.A @ basis, B=back @ self.B, C=self.C @ basis, L=self.L @ basis)

    def error(self, gain: FloatArray, output: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the system from w to the error of ``x+ = A x + K (r - C x)``, ``L x + Z0 (r - C x)``."""
        return (
            self.A - gain @ self.C,
            self.B - gain @ self.D,
            self.L - output @ self.C,
            self.H - output @ self.D,
        )


@dataclass(frozen=True, eq=False)
class OptimalEstimator:
    """Gains ``K (n, p)`` and ``Z0 (e, p)`` of a filter, its recomputed gain, and what no filter undercuts.

    ``least``: lower bound for all causal filters, linear or not (H2: for linear ones).  ``non_causal``: least gain of
    filters that know the future; NaN for H2.  ``extra_noise``: deviation that was added to each measurement.
    """

    K: FloatArray
    Z0: FloatArray
    gain: float
    least: float
    non_causal: float
    extra_noise: float


def optimal_estimator(problem: EstimationProblem, norm: Literal["hinf", "h2"] = "hinf") -> OptimalEstimator:
    """Return the filter of least norm, with a lower bound for every other; raise `NoStableFilterError` for none."""
    white = _whitened(problem)
    gramian = _gramian(white.problem.A, white.problem.B)
    gain, output = _central_gains(white.problem, gramian)
    plain = white.without_extra_noise
    if norm == "h2":
        found = _h2_norm(*plain.error(gain, output))
        return OptimalEstimator(*white.restored(gain, output), found, found, np.nan, white.extra_noise)
    limit = _non_causal_gain(white.problem)
    highest = hinf_norm(*white.problem.error(gain, output)).upper
    size = max(hinf_norm(plain.A, plain.B, plain.L, plain.H).upper, highest)
    least = 0.0 if white.extra_noise else limit
    level = highest
    if highest > max(limit * (1.0 + LEVEL_TOLERANCE), ZERO_GAIN * size):
        level, solution = _least_level(white.problem, limit, highest, ZERO_GAIN * size)
        if solution is not None:
            gain, output = _central_gains(white.problem, solution)
        least = max(least, _bound_by_pasts(white, level))
    found = hinf_norm(*plain.error(gain, output)).upper
    return OptimalEstimator(*white.restored(gain, output), found, min(least, found), limit, white.extra_noise)


@dataclass(frozen=True, eq=False)
class _Whitened:
    """A problem whose measurements are innovations, and how its gains become those of the problem as given."""

    given: EstimationProblem
    problem: EstimationProblem
    basis: FloatArray
    kalman: FloatArray
    scale: FloatArray  # innovations = scale @ (r - C x)
    extra_noise: float

    @property
    def without_extra_noise(self) -> EstimationProblem:
        own = self.given.B.shape[1]
        part = self.problem
        return replace(part, B=part.B[:, :own], D=part.D[:, :own], H=part.H[:, :own])

    def restored(self, gain: FloatArray, output: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.kalman + self.basis @ gain @ self.scale, output @ self.scale


def _whitened(given: EstimationProblem) -> _Whitened:
    n, measured = len(given.A), len(given.C)
    size = max(
        float(np.linalg.norm(given.C) * np.linalg.norm(given.B) + np.linalg.norm(given.D)),
        FIRST_LEVEL * float(np.linalg.norm(given.L) * np.linalg.norm(given.B) + np.linalg.norm(given.H)),
        float(np.finfo(float).tiny),
    )
    stable = spectral_radius(given.A) < 1.0
    angles = np.array([0.7, 2.1])
    shown = frequency_response(given.A, given.B, given.C, given.D, angles) if stable and measured else np.zeros(0)
    if not measured or (stable and np.max(np.abs(shown), initial=0.0) < RESPONSE_TOLERANCE * size):
        if not stable:
            raise NoStableFilterError("what the outputs leave unknown of the faults has an unstable mode")
        none = replace(given, C=given.C[:0], D=given.D[:0])
        return _Whitened(given, none, np.eye(n), np.zeros((n, measured)), np.zeros((0, measured)), 0.0)
    for share in EXTRA_NOISE:
        noisy = given
        if share:
            noisy = replace(
                given,
                B=np.hstack([given.B, np.zeros((n, measured))]),
                D=np.hstack([given.D, share * size * np.eye(measured)]),
                H=np.hstack([given.H, np.zeros((len(given.H), measured))]),
            )
        found = _kalman(noisy)
        if found is None:
            continue
        kalman, innovation = found
        values, vectors = np.linalg.eigh(innovation)
        if values[0] <= SINGULAR_INNOVATION * values[-1]:
            continue
        scale = (vectors / np.sqrt(values)).T
        a, b = noisy.A - kalman @ noisy.C, noisy.B - kalman @ noisy.D
        white = replace(noisy, A=a, B=b, C=scale @ noisy.C, D=scale @ noisy.D)
        basis = reachable_basis(a, b, REACH_TOLERANCE)
        return _Whitened(given, white.reduced(basis), basis, kalman, scale, share * size)
    raise NoStableFilterError("the faults have an unstable zero towards the outputs, or one on the stability boundary")


def _kalman(problem: EstimationProblem) -> tuple[FloatArray, FloatArray] | None:
    """Return the Kalman gain and the covariance of the innovations; ``None`` where no stabilising one is found."""
    a, b, c, d = problem.A, problem.B, problem.C, problem.D
    covariance = _riccati(a, b, c, d, d @ d.T)
    if covariance is None:
        return None
    innovation = c @ covariance @ c.T + d @ d.T
    try:
        gain = np.linalg.solve(innovation, c @ covariance @ a.T + d @ b.T).T
    except np.linalg.LinAlgError:
        return None
    settled = np.all(np.isfinite(gain)) and spectral_radius(a - gain @ c) < 1.0 - LEAST_STABILITY
    return (np.asarray(gain), np.asarray((innovation + innovation.T) / 2.0)) if settled else None


def _riccati(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, r: FloatArray) -> FloatArray | None:
    if not len(a):
        return np.zeros((0, 0))
    try:
        with np.errstate(invalid="ignore", over="ignore"), warnings.catch_warnings():
            # What is ill-conditioned is judged by the solution, not by the estimate of a condition.
            warnings.simplefilter("ignore", LinAlgWarning)
            solution = discrete_riccati(a.T, c.T, b @ b.T, r, s=b @ d.T)
    except (np.linalg.LinAlgError, ValueError):
        return None
    return np.asarray((solution + solution.T) / 2.0)


def reachable_basis(a: FloatArray, b: FloatArray, tolerance: float) -> FloatArray:
    """Return an orthonormal basis of the reachable subspace of (A, B) by the staircase algorithm."""
    n = len(a)
    basis, new = np.zeros((n, 0)), b
    size = float(np.linalg.norm(b))
    while basis.shape[1] < n and new.size:
        for _ in range(2):
            new = new - basis @ (basis.T @ new)
        left, values, _ = svd(new, full_matrices=False)
        left = left[:, values > tolerance * max(size, np.finfo(float).tiny)]
        if not left.shape[1]:
            break
        basis, new, size = np.hstack([basis, left]), a @ left, float(np.linalg.norm(a))
    return basis


def _gramian(a: FloatArray, b: FloatArray) -> FloatArray:
    return output_covariance(a, b, np.eye(len(a)), np.zeros(b.shape))


def _h2_norm(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> float:
    return float(np.sqrt(max(np.trace(output_covariance(a, b, c, d)), 0.0)))


def _central_gains(problem: EstimationProblem, solution: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return K and Z0 of a Riccati solution."""
    if not len(problem.C):
        return np.zeros((len(problem.A), 0)), np.zeros((len(problem.L), 0))
    seen = problem.C @ solution
    innovation = seen @ problem.C.T + problem.D @ problem.D.T
    gain = np.linalg.solve(innovation, seen @ problem.A.T + problem.D @ problem.B.T).T
    output = np.linalg.solve(innovation, seen @ problem.L.T + problem.D @ problem.H.T).T
    return np.asarray(gain), np.asarray(output)


def _solution_at(problem: EstimationProblem, level: float) -> FloatArray | None:
    """Return the stabilising solution of the H-infinity filtering equation; ``None``: the level is not attainable."""
    q = len(problem.C)
    both, direct = np.vstack([problem.C, problem.L]), np.vstack([problem.D, problem.H])
    weight = direct @ direct.T
    weight[q:, q:] -= level**2 * np.eye(len(problem.L))
    solution = _riccati(problem.A, problem.B, both, direct, weight)
    if solution is None or not np.all(np.isfinite(solution)):
        return None
    inertia = both @ solution @ both.T + weight
    if len(solution) and np.linalg.eigvalsh(solution)[0] < -NEGATIVE_SHARE * (1.0 + np.max(np.abs(solution))):
        return None
    if q and np.linalg.eigvalsh(inertia[:q, :q])[0] <= 0.0:
        return None
    rest = inertia[q:, q:]
    if q:
        rest = rest - inertia[q:, :q] @ np.linalg.solve(inertia[:q, :q], inertia[:q, q:])
    if np.linalg.eigvalsh((rest + rest.T) / 2.0)[-1] >= 0.0:
        return None
    gain, _ = _central_gains(problem, solution)
    return solution if spectral_radius(problem.A - gain @ problem.C) < 1.0 else None


def _least_level(
    problem: EstimationProblem, lowest: float, highest: float, nothing: float
) -> tuple[float, FloatArray | None]:
    """Return the least level whose filter has it as its norm, and the solution; ``None``: no better than given."""
    best: FloatArray | None = None
    for halving in range(MOST_HALVINGS):
        level = (lowest + highest) / 2.0
        if not halving:
            level = min(level, max(lowest, nothing) * (1.0 + 3.0 * LEVEL_TOLERANCE))
        solution = _solution_at(problem, level)
        if solution is not None and hinf_norm(*problem.error(*_central_gains(problem, solution))).value <= level * (
            1.0 + ABOVE_BOUND
        ):
            highest, best = level, solution
        else:
            lowest = level
        if highest - lowest <= LEVEL_TOLERANCE * highest or highest <= nothing:
            break
    return highest, best


def _bound_by_pasts(white: _Whitened, least: float) -> float:
    """Return the best lower bound that Riccati solutions a little above the least level show."""
    best, problem = 0.0, white.problem
    if white.extra_noise and len(problem.A) > MOST_CORRECTED:
        return best
    plain = white.without_extra_noise if white.extra_noise else None
    for share in ABOVE_LEAST:
        level = least * (1.0 + share)
        solution = _solution_at(problem, level)
        if solution is not None:
            best = max(best, _bound_by_past(problem, solution, level, plain))
    return best


def _bound_by_past(
    problem: EstimationProblem, solution: FloatArray, level: float, plain: EstimationProblem | None
) -> float:
    """Return the gain of one invisible past: error over noise, both summed sample by sample; 0 where it is none.

    ``plain``: the problem without extra noise, to which the past is corrected.
    """
    q = len(problem.C)
    both, direct = np.vstack([problem.C, problem.L]), np.vstack([problem.D, problem.H])
    inertia = both @ solution @ both.T + direct @ direct.T
    inertia[q:, q:] -= level**2 * np.eye(len(problem.L))
    try:
        gain = np.linalg.solve(inertia, both @ solution @ problem.A.T + direct @ problem.B.T).T
    except np.linalg.LinAlgError:
        return 0.0
    step, noise = (problem.A - gain @ both).T, (problem.B - gain @ direct).T
    if not len(step) or spectral_radius(step) >= 1.0:
        return 0.0
    if plain is not None:
        problem = plain
        solution, noise = _corrected(plain, solution, noise[: plain.B.shape[1]], step)
    error = problem.L @ solution @ step + problem.H @ noise
    missed = np.vstack(
        [problem.A @ solution @ step + problem.B @ noise - solution, problem.C @ solution @ step + problem.D @ noise]
    )
    start = _worst_start(step, error, noise)
    if start is None:
        return 0.0
    sums = np.zeros(3)
    for _ in range(MOST_SAMPLES):
        more = np.array([np.sum((rows @ start) ** 2) for rows in (error, noise, missed)])
        sums += more
        start = step @ start
        if more[0] + more[1] <= FADED * sums[1]:
            break
    else:
        # What is left out of the noise would make the quotient too large.
        return 0.0
    if not sums[1] > 0.0 or np.sqrt(sums[2] / sums[1]) > PAST_TOLERANCE:
        return 0.0
    return float(np.sqrt(sums[0] / sums[1]) * (1.0 - ROUNDED_DOWN))


def _corrected(
    problem: EstimationProblem, states: FloatArray, noise: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return X and W nearest to those given with ``A X Phi + B W = X`` and ``C X Phi + D W = 0``."""
    n, k = problem.B.shape
    one = np.eye(n)
    equations = np.block(
        [
            [np.kron(problem.A, step.T) - np.eye(n * n), np.kron(problem.B, one)],
            [np.kron(problem.C, step.T), np.kron(problem.D, one)],
        ]
    )
    found = np.concatenate([states.ravel(), noise.ravel()])
    found = found - np.linalg.lstsq(equations, equations @ found, rcond=DEPENDENT)[0]
    return found[: n * n].reshape(n, n), found[n * n :].reshape(k, n)


def _worst_start(step: FloatArray, error: FloatArray, noise: FloatArray) -> FloatArray | None:
    """Return eta of the largest quotient of the sums of ``|error Phi^k eta|^2`` and ``|noise Phi^k eta|^2``."""
    above, below = _gramian(step.T, error.T), _gramian(step.T, noise.T)
    # States that the noise does not move are not scaled up by what is only rounding.
    floor = GRAMIAN_TOLERANCE**2 * float(np.max(np.diag(below), initial=0.0))
    if not np.isfinite(floor) or floor <= np.finfo(float).tiny:
        return None
    sizes = np.sqrt(np.maximum(np.diag(below), floor))
    above, below = above / np.outer(sizes, sizes), below / np.outer(sizes, sizes)
    if not (np.all(np.isfinite(above)) and np.all(np.isfinite(below))):
        return None
    values, vectors = eigh((below + below.T) / 2.0)
    least = GRAMIAN_TOLERANCE * values[-1]
    kept = values > least
    unit = vectors[:, kept] / np.sqrt(values[kept])
    _, turned = eigh(unit.T @ (above + above.T) @ unit / 2.0)
    return np.asarray(unit @ turned[:, -1] / sizes)


def _non_causal_gain(problem: EstimationProblem) -> float:
    """Return the largest gain over frequency of ``e0 (I - r^+ r)``: no stable filter is below it, causal or not."""
    joint = np.vstack([problem.L, problem.C]), np.vstack([problem.H, problem.D])
    rows = len(problem.L)

    def gains(angles: FloatArray) -> FloatArray:
        found = frequency_response(problem.A, problem.B, *joint, angles)
        error, seen = found[:, :rows], found[:, rows:]
        if seen.shape[1]:
            back = np.conj(np.swapaxes(seen, 1, 2))
            error = error - error @ back @ np.linalg.solve(seen @ back, seen)
        return np.asarray(np.linalg.norm(error, 2, axis=(1, 2))) if error.shape[2] else np.zeros(len(angles))

    ends = np.geomspace(LEAST_ANGLE, 1.0, ANGLES // 3)
    modes = np.abs(np.angle(np.linalg.eigvals(problem.A))) if len(problem.A) else np.zeros(0)
    angles = np.unique(np.concatenate([np.linspace(0.0, np.pi, ANGLES), ends, np.pi - ends, modes]))
    found = gains(angles)
    best = float(np.max(found))
    for i in np.argsort(found)[-3:]:
        low, high = angles[max(i - 1, 0)], angles[min(i + 1, len(angles) - 1)]
        for _ in range(8):
            trial = np.linspace(low, high, 9)
            near = gains(trial)
            top = int(np.argmax(near))
            best = max(best, float(near[top]))
            low, high = trial[max(top - 1, 0)], trial[min(top + 1, 8)]
    return best
