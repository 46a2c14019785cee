"""H-infinity filtering: the least gain from w to ``e0 - Z r`` over all causal Z, with a filter that attains it.

At level g the filtering Riccati equation with ``[C; L]``, ``[D; D1]`` and weight ``diag(0, -g^2)`` has a stabilising
solution of the right signs if and only if a causal filter with a gain below g exists (Hassibi, Sayed, Kailath,
*Indefinite-Quadratic Estimation and Control*, 1999, chapter 4).  With P and the full gain K of that solution,
``Phi = (A - K [C; L])'`` describes how the worst noise decays backwards in time.  From its eigenvalues
`obsynth.verification.invisible_faults` proves a lower bound for every causal filter, linear or not.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from obsynth.errors import PreconditionError, SolverError
from obsynth.numerics.arrays import SMALLEST, ComplexArray, FloatArray
from obsynth.numerics.decoupling_windows import EstimationProblem, Model
from obsynth.numerics.doubling import doubled_riccati_solution
from obsynth.numerics.gain_levels import EQUATION_TOLERANCE
from obsynth.numerics.gramians import gramian
from obsynth.numerics.least_level import place_of_zero_margin
from obsynth.numerics.matrix_equations import discrete_riccati
from obsynth.numerics.modal_response import resolved
from obsynth.numerics.norms import hinf_norm
from obsynth.numerics.ranks import BOUNDARY_RANK_TOLERANCE, WINDOW_RANK_TOLERANCE
from obsynth.numerics.standard_form import reachable_basis

#: A mode z is observable if the least singular value of [A - z I; C] exceeds this share of the norm of [A; C].
SHOWN_SHARE = 1e-6

#: Larger modes are results of rounding in a problem that has lost its digits.
FARTHEST_MODE = 1e12

#: Message for plants without a filter.
UNSTABLE_ZERO = (
    "The transfer from the faults to the outputs has a zero that is not strictly stable: no stable filter has this "
    "fault map."
)
#: Relative width of the bracket of levels at which the search ends, and most levels that it tries.
LEVEL_SHARE = 1e-8
MOST_LEVELS = 60
#: The next level lies above the better estimate of the least one by this share of the difference of two estimates.
#: Each failure enlarges the share by CAUTION; after MOST_FAILURES the bracket is halved.
ESTIMATE_SHARE, CAUTION, MOST_FAILURES = 0.2, 10.0, 3
#: Noise that is added to the outputs, relative to the size of the matrices, if some output has no noise; tried in turn.
ADDED_NOISES = (0.0, 1e-6, 1e-5, 1e-4, 1e-3)
#: A Kalman filter with a larger spectral radius counts as unstable.
STABLE_RADIUS = 1.0 - 1e-6
#: An innovation covariance is singular if the ratio of its least to its largest eigenvalue is at most this.
SINGULAR_INNOVATION = 1e-11
#: Weight of the sizes of estimated signals relative to measured ones in the size of a problem.
WANTED_SHARE = 1e-3
#: Entries below this share of the largest one count as zero.  SciPy balances the pencil of the Riccati equation, and an
#: entry of 1e-53 would give states so different units that no digit of the solution is left.
NO_ENTRY = float(np.finfo(float).eps) ** 2
#: Directions of smaller covariance, as a share of the largest, count as so large when errors are scaled: coordinates
#: further apart lose digits.
LEAST_ERROR_SHARE = 1e-8
#: A Riccati solution may have negative eigenvalues up to this share of its size, by rounding.
NEGATIVE_SHARE = 1e-7
#: Multiples of the least level for which the worst noise is returned: nearer ones give closer bounds, unless rounding
#: spoils them.
WORST_LEVELS = (1.0 + 1e-6, 1.0 + 1e-5, 1.0001, 1.001, 1.01)
#: A lower bound is reduced by this share for the rounding of its sums.
BOUND_ROUNDING = 1e-9
#: A gain below this share of the problem's size is zero up to rounding.
ZERO_SHARE = 1e-9
#: Most samples, and most inputs in total, of finite records that are searched for signals which r does not show.
LONGEST_FROM_REST, MOST_INPUTS_FROM_REST = 60, 360
#: A null space counts if all other singular values exceed this share.
CLEAR_KERNEL = 1e-5
#: The outputs do not show w if its effect on them is below this share of the problem's size.
BLIND_SHARE = 1e-10
#: Two generic angles at which that effect is evaluated: a response that vanishes at both vanishes everywhere.
BLIND_ANGLES = np.array([0.7, 2.1])
#: Directions that w drives by less than this share count as unreachable.
REACHED_BY_NOISE = 1e-9
#: A filter attains a level if its norm exceeds the level by at most this share.
NORM_ABOVE_LEVEL = 1e-6
#: Least angle of the frequency grid, and offsets of additional angles near modes.
LEAST_ANGLE, NEAR_MODES = 1e-6, np.array([0.0, 1e-4, -1e-4, 1e-2, -1e-2])
#: With so many states Riccati equations are solved by doubling first: in a tenth of the time, and where eigenvalues of
#: SciPy's pencil lay at zero, its solution of 96 states missed the equation by 73 % of its terms.
STATES_OF_DOUBLING = 20
#: With more states a level at which doubling does not converge counts as too low: the pencil takes seconds.
MOST_BY_PENCILS = 120
#: Number of angles of the grid on the half circle.
GRID = 1500


@dataclass(frozen=True, eq=False)
class LeastEstimation:
    """The filter ``i = r - C chi``, ``chi+ = A chi + K i``, ``ehat = L chi + Z0 i``, and its recomputed norm.

    ``limit`` is the least gain with unlimited delay, at the angle ``limit_angle``.  ``added_noise`` is positive where
    an output has no noise.  ``decays`` are the eigenvalues of the worst noise, for each level.
    """

    K: FloatArray
    Z0: FloatArray
    gain: float
    limit: float
    limit_angle: float
    added_noise: float
    decays: tuple[NDArray[np.complex128], ...]


class Searched(NamedTuple):
    """Gains of a filter and its norm; whether some solutions of Riccati equations gave filters above their level."""

    K: FloatArray
    Z0: FloatArray
    level: float
    is_above_levels: bool = False


class Whitened(NamedTuple):
    """A problem in terms of the innovation, without errors that w cannot reach, and its relation to the given one."""

    problem: EstimationProblem
    plain: EstimationProblem  # without added noise
    factor: FloatArray | None  # of the innovation
    K: FloatArray
    basis: FloatArray
    noise: float

    def restored(self, original: EstimationProblem, K: FloatArray, Z0: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gains for r of the given problem from gains for the innovation."""
        if self.factor is None:
            return np.zeros((len(original.A), len(original.C))), np.zeros((len(original.L), len(original.C)))
        return self.K + self.basis @ K @ self.factor, Z0 @ self.factor


def least_estimation(
    problem: EstimationProblem, *, norm: str = "hinf", noises: Sequence[float] = ADDED_NOISES
) -> LeastEstimation:
    """Return the filter of least gain (``"hinf"``) or of least mean square (``"h2"``, the root of the trace).

    The first of ``noises`` with which a filter exists is added to the outputs.  `PreconditionError` is raised where no
    filter is stable.
    """
    white = whitened(problem, noises)
    core = white.problem
    P0 = gramian(core.A, core.B @ core.B.T) if len(core.C) else 0.0 * core.A
    K, Z0 = _central(core, P0)
    limit, angle = 0.0, 0.0
    decays: tuple[NDArray[np.complex128], ...] = ()
    if norm == "hinf":
        limit, angle = _non_causal_limit(white.plain if white.noise else core)
        least = _invisible_at(white.plain, angle) if white.noise else limit
        least = max(least, _invisible_from_rest(white.plain))
        level = _norm(_error_system(core, K, Z0))
        found = _search(core, (K, Z0), least, level)
        if found.is_above_levels:
            white, found = _searched_in_units_of_errors(white, P0, found, least)
        (K, Z0, level, _), core = found, white.problem
        decays = tuple(_decays(core, share * level) for share in WORST_LEVELS)
    closed = _error_system(white.plain, K, Z0)
    gain = _norm(closed) if norm == "hinf" else _deviation(closed)
    return LeastEstimation(*white.restored(problem, K, Z0), gain, limit, angle, white.noise, decays)


def achieved(white: Whitened, K: FloatArray, Z0: FloatArray, norm: str) -> float:
    """Return the norm (``"hinf"`` or ``"h2"``) from w to the error with gains for the innovation."""
    closed = _error_system(white.plain, K, Z0)
    return _norm(closed) if norm == "hinf" else _deviation(closed)


def require_stable_filter(problem: EstimationProblem) -> None:
    """Raise `PreconditionError` where no filter is stable, without computing the least gain."""
    whitened(problem)


def _riccati(
    a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray, s: FloatArray, *, most_by_pencils: float = math.inf
) -> FloatArray:
    """Return the stabilising solution; raise `LinAlgError` where none is found, with more states by doubling alone."""
    a, b, q, r, s = (_with_zeros(part) for part in (a, b, q, r, s))
    if len(a) >= STATES_OF_DOUBLING:
        doubled = _doubled(a, b, q, r, s)
        if doubled is not None:
            return doubled
        if len(a) > most_by_pencils:
            raise np.linalg.LinAlgError("doubling does not converge")
    with warnings.catch_warnings(action="ignore"):
        solution = discrete_riccati(a, b, q, r, s=s) if len(a) else np.zeros((0, 0))
    return np.asarray(0.5 * (solution + solution.T))


def _doubled(a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray, s: FloatArray) -> FloatArray | None:
    """Return the solution by doubling, where it is one but for rounding and stabilises."""
    with np.errstate(all="ignore"):
        try:
            solution = doubled_riccati_solution(a.T, b.T, q, r, s)
            if solution is None:
                return None
            through, moved = a.T @ solution @ b + s, a.T @ solution @ a
            gain = np.linalg.solve(r + b.T @ solution @ b, through.T)
            radius = np.max(np.abs(np.linalg.eigvals(a - b @ gain)))
        except np.linalg.LinAlgError:
            return None
    taken = through @ gain
    size = sum(float(np.linalg.norm(part)) for part in (moved, q, taken, solution))
    is_solved = float(np.linalg.norm(moved + q - taken - solution)) <= EQUATION_TOLERANCE * size
    return solution if is_solved and radius < 1.0 else None


def _with_zeros(matrix: FloatArray) -> FloatArray:
    return np.where(np.abs(matrix) > NO_ENTRY * np.max(np.abs(matrix), initial=0.0), matrix, 0.0)


def _kalman(problem: EstimationProblem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return covariance, gain and innovation; raise `LinAlgError` where no filter is stable."""
    A, B, C, D = problem.A, problem.B, problem.C, problem.D
    P = _riccati(A.T, C.T, B @ B.T, D @ D.T, B @ D.T)
    R = C @ P @ C.T + D @ D.T
    K = np.asarray(np.linalg.solve(R, C @ P @ A.T + D @ B.T).T, dtype=np.float64)
    if np.max(np.abs(np.linalg.eigvals(A - K @ C)), initial=0.0) >= STABLE_RADIUS:
        raise np.linalg.LinAlgError("not stabilising")
    return P, K, R


def _size(problem: EstimationProblem) -> float:
    def size(part: FloatArray) -> float:
        return float(np.linalg.norm(part))

    measured_size = size(problem.C) * size(problem.B) + size(problem.D)
    estimated_size = size(problem.L) * size(problem.B) + size(problem.D1)
    # Without any noise, the size is that of the outputs for states of size one.
    return max(measured_size, WANTED_SHARE * estimated_size) or max(size(problem.C), SMALLEST)


def whitened(problem: EstimationProblem, noises: Sequence[float] = ADDED_NOISES) -> Whitened:
    """Return the problem in terms of the innovation, without errors that w cannot reach.

    Where an output has no noise, noise is added.  The filter is nevertheless one for the given plant, with the gain
    that it has there.
    """
    n, rows, size = len(problem.A), len(problem.C), _size(problem)
    stable = bool(np.max(np.abs(np.linalg.eigvals(problem.A)), initial=0.0) < STABLE_RADIUS)
    blind = (
        not problem.B.shape[1] or np.max(np.abs(_responses(problem, BLIND_ANGLES)[1]), initial=0.0) < BLIND_SHARE * size
    )
    if not rows or (blind and stable):
        if not stable:
            raise PreconditionError(UNSTABLE_ZERO, condition="zeros")
        bare = replace(problem, C=problem.C[:0], D=problem.D[:0])
        return Whitened(bare, bare, None, np.zeros((n, 0)), np.eye(n), 0.0)
    reason: object = ""
    for noise in noises:
        B, D = _noisy(problem, noise * size)
        try:
            _, K, R = _kalman(replace(problem, B=B, D=D))
        except (np.linalg.LinAlgError, ValueError) as error:
            reason = error
            continue
        values, vectors = np.linalg.eigh(R)
        if values[0] <= SINGULAR_INNOVATION * values[-1]:
            reason = "the innovation is singular"
            continue
        factor = (vectors / np.sqrt(values)).T
        D1 = np.hstack([problem.D1, np.zeros((len(problem.D1), B.shape[1] - problem.B.shape[1]))])
        A, B, C = problem.A - K @ problem.C, B - K @ D, factor @ problem.C
        basis = reachable_basis(A, B, share=REACHED_BY_NOISE)
        reduced = replace(
            problem, A=basis.T @ A @ basis, B=basis.T @ B, C=C @ basis, D=factor @ D, L=problem.L @ basis, D1=D1
        )
        count = problem.B.shape[1]
        plain = replace(reduced, B=reduced.B[:, :count], D=reduced.D[:, :count], D1=D1[:, :count])
        return Whitened(reduced, plain, factor, K, basis, noise)
    if _shows_lasting_modes(problem):
        raise PreconditionError(
            "Inconclusive: the outputs show every mode that lasts, or it is beyond double precision, but the Riccati "
            f"equation of a filter with this fault map has no solution there ({reason}).",
            condition="zeros",
            unclear=True,
        )
    raise PreconditionError(
        "The transfer from the faults to the outputs has a zero that is not strictly stable, or none of the "
        f"outputs shows a mode that lasts: no stable filter has this fault map ({reason}).",
        condition="zeros",
    )


def _shows_lasting_modes(problem: EstimationProblem) -> bool:
    """Whether each mode on or outside the unit circle is clearly observable, so that (A, C) is detectable.

    Modes beyond double precision do not count.
    """
    n, whole = len(problem.A), np.vstack([problem.A, problem.C])
    lasting = [value for value in np.linalg.eigvals(problem.A) if STABLE_RADIUS <= abs(value) < FARTHEST_MODE]
    size = max(float(np.linalg.norm(whole)), SMALLEST)
    unit = np.vstack([np.eye(n), np.zeros_like(problem.C)])
    return all(np.linalg.svd(whole - value * unit, compute_uv=False)[-1] > SHOWN_SHARE * size for value in lasting)


def _noisy(problem: EstimationProblem, noise: float) -> tuple[FloatArray, FloatArray]:
    """Return B and D with additional noise on each output, and for a problem without any noise also on each state.

    Noise on the states makes the filter forget errors of undamped modes.  If a problem has noise, but none on undamped
    modes, the caller has to add it to its plant.
    """
    B, D = problem.B, problem.D
    if not noise:
        return B, D
    n, rows = len(problem.A), len(problem.C)
    B, D = np.hstack([B, np.zeros((n, rows))]), np.hstack([D, noise * np.eye(rows)])
    if not problem.B.any() and not problem.D.any():
        output_size = max(float(np.linalg.norm(problem.C)), SMALLEST)
        B, D = np.hstack([B, noise / output_size * np.eye(n)]), np.hstack([D, np.zeros((rows, n))])
    return B, D


def _central(problem: EstimationProblem, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the gains K and Z0 of the filter that belongs to a Riccati solution."""
    A, B, C, D, L, D1 = problem.A, problem.B, problem.C, problem.D, problem.L, problem.D1
    if not len(C):
        return np.zeros((len(A), 0)), np.zeros((len(L), 0))
    R = C @ P @ C.T + D @ D.T
    cross = np.hstack([C @ P @ A.T + D @ B.T, C @ P @ L.T + D @ D1.T])
    gains = np.asarray(np.linalg.solve(R, cross).T, dtype=np.float64)
    return gains[: len(A)], gains[len(A) :]


def _error_system(
    problem: EstimationProblem, K: FloatArray, Z0: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    return (
        problem.A - K @ problem.C,
        problem.B - K @ problem.D,
        problem.L - Z0 @ problem.C,
        problem.D1 - Z0 @ problem.D,
    )


def _norm(system: tuple[FloatArray, FloatArray, FloatArray, FloatArray]) -> float:
    return 0.0 if not system[1].shape[1] or not len(system[2]) else hinf_norm(*system).upper


def _deviation(system: tuple[FloatArray, FloatArray, FloatArray, FloatArray]) -> float:
    a, b, c, d = system
    covariance = gramian(a, b @ b.T)
    return float(np.sqrt(max(np.trace(d @ d.T + c @ covariance @ c.T), 0.0)))


def _at_level(problem: EstimationProblem, level: float) -> tuple[FloatArray, float] | None:
    """Return the stabilising solution of the filtering equation at a level, and its margin; ``None`` without a filter.

    The margin is that of the block that has to be negative, as a share of the squared level.
    """
    rows = len(problem.C)
    CL, DD = np.vstack([problem.C, problem.L]), np.vstack([problem.D, problem.D1])
    weight = DD @ DD.T
    weight[rows:, rows:] -= level**2 * np.eye(len(problem.L))
    try:
        P = _riccati(
            problem.A.T, CL.T, problem.B @ problem.B.T, weight, problem.B @ DD.T, most_by_pencils=MOST_BY_PENCILS
        )
    except (np.linalg.LinAlgError, ValueError):
        return None
    R = CL @ P @ CL.T + weight
    if len(P) and np.linalg.eigvalsh(P)[0] < -NEGATIVE_SHARE * (np.max(np.abs(P)) + 1.0):
        return None
    innovation, mixed, error = R[:rows, :rows], R[:rows, rows:], R[rows:, rows:]
    if rows and np.linalg.eigvalsh(innovation)[0] <= 0.0:
        return None
    schur = error - (mixed.T @ np.linalg.solve(innovation, mixed) if rows else 0.0)
    largest = float(np.linalg.eigvalsh(0.5 * (schur + schur.T))[-1])
    if largest >= 0.0:
        return None
    closed = problem.A - _central(problem, P)[0] @ problem.C
    return (P, -largest / level**2) if np.max(np.abs(np.linalg.eigvals(closed)), initial=0.0) < 1.0 else None


def _searched_in_units_of_errors(
    white: Whitened, covariance: FloatArray, found: Searched, least: float
) -> tuple[Whitened, Searched]:
    """Search on in coordinates in which the least covariance of the errors is the identity.

    At the levels of filters Riccati equations have solutions near it, or above.  In other coordinates their rounding
    may make the gain of a filter of 100 states a thousandth larger than the least one.  Return the coordinates in
    which the better filter was found, and that filter.
    """
    values, vectors = np.linalg.eigh(covariance)
    if not len(values) or not values[-1] > 0.0:
        return white, found
    sizes = np.sqrt(np.maximum(values, LEAST_ERROR_SHARE * values[-1]))
    onto, back = (vectors / sizes).T, vectors * sizes

    def turned(problem: EstimationProblem) -> EstimationProblem:
        return replace(problem, A=onto @ problem.A @ back, B=onto @ problem.B, C=problem.C @ back, L=problem.L @ back)

    scaled = white._replace(problem=turned(white.problem), plain=turned(white.plain), basis=white.basis @ back)
    again = _search(scaled.problem, (onto @ found.K, found.Z0), least, found.level)
    return (scaled, again) if again.level < found.level else (white, found)


def _search(problem: EstimationProblem, first: tuple[FloatArray, FloatArray], least: float, high: float) -> Searched:
    """Search the level between a lower bound and the norm of the first filter; a level counts as the true norm says."""
    nothing = ZERO_SHARE * max(float(np.linalg.norm(problem.D1)), float(np.linalg.norm(problem.L @ problem.B)), high)
    if high <= max(least * (1.0 + LEVEL_SHARE), nothing):
        return Searched(*first, high)
    low, best, is_above = least * (1.0 - BOUND_ROUNDING), first, False
    level, reached, failed = least * (1.0 + 3.0 * LEVEL_SHARE), list[tuple[float, float]](), 0
    for _ in range(MOST_LEVELS):
        level = level if low < level < high else 0.5 * (low + high)
        solved = _at_level(problem, level)
        gains = None if solved is None else _central(problem, solved[0])
        if solved is None or gains is None or _norm(_error_system(problem, *gains)) > level * (1.0 + NORM_ABOVE_LEVEL):
            low, failed, is_above = level, failed + 1, is_above or gains is not None
        else:
            high, best, failed = level, gains, 0
            reached = [*reached[-2:], (float(level**2), float(solved[1] * level**2))]
        if high - low <= LEVEL_SHARE * high or high <= nothing:
            break
        level = _next_level(reached, low, high, failed)
    return Searched(*best, high, is_above)


def _next_level(reached: list[tuple[float, float]], low: float, high: float, failed: int) -> float:
    """Return a level just above where the margin vanishes, by the last levels with their squares and margins."""
    points = reached[::-1]
    if len(points) < 2 or failed > MOST_FAILURES or len({margin for _, margin in points}) < len(points):
        return 0.5 * (low + high)
    if not failed and points[1][0] - points[0][0] <= 4.0 * LEVEL_SHARE * points[0][0]:
        # A level next to the one before was reached: margins so near to each other tell nothing.
        return 0.5 * (low + high)
    zeros = [place_of_zero_margin(points[:count]) for count in range(2, len(points) + 1)]
    if failed and zeros[-1] <= low**2:
        return 0.5 * (low + high)
    nearest, zero = (max(zero, low**2) for zero in (zeros[0], zeros[-1]))
    distance = abs(zero - nearest) if len(zeros) > 1 else high**2 - zero
    step = CAUTION**failed * max(ESTIMATE_SHARE * distance, LEVEL_SHARE * zero)
    level = math.sqrt(zero + step)
    return min(level, high * (1.0 - 0.9 * LEVEL_SHARE))


def _responses(problem: EstimationProblem, angles: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return the responses of e0 and of r at angles on the circle."""
    points, rows = np.exp(1j * np.atleast_1d(angles)), len(problem.L)
    outputs, direct = np.vstack([problem.L, problem.C]), np.vstack([problem.D1, problem.D])
    # There are fewer outputs than inputs: the equations of the transposed system have fewer right sides.
    turned = np.concatenate([*resolved(None, problem.A.T, outputs.T, points)])
    responses = np.asarray(np.swapaxes(turned, 1, 2) @ problem.B + direct, dtype=np.complex128)
    return responses[:, :rows], responses[:, rows:]


def _hidden_gain(problem: EstimationProblem, angles: FloatArray) -> FloatArray:
    """Return the gain of what r does not show, at angles: no filter, causal or not, has less."""
    error, residual = _responses(problem, angles)
    if len(problem.C):
        turned = np.conj(np.swapaxes(residual, 1, 2))
        error = error - error @ turned @ np.linalg.solve(residual @ turned, residual)
    if not error.size:
        return np.zeros(len(error))
    # Of few rows: the eigenvalues of their products are quicker than singular values, and as exact for the largest.
    products = error @ np.conj(np.swapaxes(error, 1, 2))
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(products)[:, -1], 0.0)))


def _non_causal_limit(problem: EstimationProblem) -> tuple[float, float]:
    """Return the least gain with unlimited delay, by a grid that is refined, and its angle."""
    if not problem.B.shape[1] or not len(problem.L):
        return 0.0, 0.0
    near = np.abs(np.angle(np.linalg.eigvals(problem.A)))[:, None] + NEAR_MODES
    fine = np.geomspace(LEAST_ANGLE, 1.0, GRID // 3)
    angles = np.unique(
        np.clip(np.concatenate([np.linspace(0, np.pi, GRID), fine, np.pi - fine, near.ravel()]), 0, np.pi)
    )
    with np.errstate(all="ignore"):
        try:
            values = _hidden_gain(problem, angles)
        except np.linalg.LinAlgError:
            return 0.0, 0.0
        values = np.where(np.isfinite(values), values, 0.0)
        best = (float(values.max()), float(angles[values.argmax()]))
        for i in np.argsort(values)[-5:]:
            low, high = angles[max(i - 1, 0)], angles[min(i + 1, len(angles) - 1)]
            for _ in range(8):
                inner = np.linspace(low, high, 9)
                refined = np.nan_to_num(_hidden_gain(problem, inner))
                j = int(refined.argmax())
                best = max(best, (float(refined[j]), float(inner[j])))
                low, high = inner[max(j - 1, 0)], inner[min(j + 1, 8)]
    return best[0] * (1.0 - BOUND_ROUNDING), best[1]


def _invisible_at(problem: EstimationProblem, angle: float) -> float:
    """Return the gain of inputs that r does not show at one angle."""
    error, residual = (part[0] for part in _responses(problem, np.array([angle])))
    hidden = scipy.linalg.null_space(residual, rcond=WINDOW_RANK_TOLERANCE) if len(residual) else np.eye(error.shape[1])
    return float(np.linalg.norm(error @ hidden, 2)) * (1.0 - BOUND_ROUNDING) if hidden.shape[1] else 0.0


def _invisible_from_rest(problem: EstimationProblem) -> float:
    """Return the gain of inputs from rest that r does not show: a bound on every causal filter, linear or not.

    Only kernels with a clear gap count: unstable zeros of r leave singular values like ``|zero|^-N``, which are none.
    """
    rows, errors, width = len(problem.C), len(problem.L), problem.B.shape[1]
    if not width or not errors:
        return 0.0
    outputs, moved = np.vstack([problem.C, problem.L]), problem.B
    length = max(4, min(LONGEST_FROM_REST, MOST_INPUTS_FROM_REST // width))
    blocks = [np.vstack([problem.D, problem.D1])]
    for _ in range(length):
        blocks.append(outputs @ moved)
        moved = problem.A @ moved
    while length >= 0:
        toeplitz = np.zeros((length + 1, rows + errors, length + 1, width))
        for i in range(length + 1):
            for j in range(i + 1):
                toeplitz[i, :, j, :] = blocks[i - j]
        residual, error = (
            toeplitz[:, part].reshape(-1, (length + 1) * width) for part in (slice(rows), slice(rows, None))
        )
        _, values, right = np.linalg.svd(residual) if rows else (None, np.zeros(0), np.eye(residual.shape[1]))
        clear = values > BOUNDARY_RANK_TOLERANCE * max(float(np.max(values, initial=0.0)), SMALLEST)
        if not clear.any() or values[clear].min() >= CLEAR_KERNEL * values[0]:
            hidden = right[int(clear.sum()) :].T
            gain = float(np.linalg.norm(error @ hidden, 2)) if hidden.shape[1] else 0.0
            return gain * (1.0 - BOUND_ROUNDING)
        length = length // 2 if length else -1
    return 0.0


def _decays(problem: EstimationProblem, level: float) -> NDArray[np.complex128]:
    """Return the eigenvalues of Phi of the Riccati solution at a level; none where there is no solution."""
    rows, solved = len(problem.C), _at_level(problem, level)
    if solved is None or not len(solved[0]):
        return np.zeros(0, dtype=complex)
    P = solved[0]
    CL, DD = np.vstack([problem.C, problem.L]), np.vstack([problem.D, problem.D1])
    R = CL @ P @ CL.T + DD @ DD.T
    R[rows:, rows:] -= level**2 * np.eye(len(problem.L))
    try:
        K = np.linalg.solve(R, CL @ P @ problem.A.T + DD @ problem.B.T).T
    except np.linalg.LinAlgError:
        return np.zeros(0, dtype=complex)
    return np.asarray(np.linalg.eigvals(problem.A - K @ CL), dtype=complex)


def realised(problem: EstimationProblem, K: FloatArray, Z0: FloatArray, ny: int) -> Model:
    """Return the filter from y to the estimates, ``(A, B, C, D)``: the bank, its corrections, and the window of y."""
    length, n = problem.window, len(problem.A)
    Af, By = problem.A - K @ problem.C, problem.G + K @ problem.V
    Cf, Dy = -(problem.L - Z0 @ problem.C), problem.F - Z0 @ problem.V
    older = ny * length
    shift = np.eye(older, k=ny)
    enter = np.zeros((older, ny))
    if length:
        enter[-ny:] = np.eye(ny)
    A = np.block([[Af, By[:, :older]], [np.zeros((older, n)), shift]])
    B = np.vstack([By[:, older:], enter])
    C, D = np.hstack([Cf, Dy[:, :older]]), Dy[:, older:]
    if not np.all(np.isfinite(A)):
        raise SolverError("The filter of least gain has no finite realisation: the result is inconclusive.")
    return A, B, C, D
