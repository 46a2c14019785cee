"""Comparing spectra, with multiple eigenvalues; decay rates in either time; H2 norms and responses in either time."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import ComplexArray, FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.numerics.norms import balanced_realisation, output_covariance
from obsynth.numerics.scaling import balanced_matrix

#: Wanted poles closer than this, relative to their size, are compared as a group: rounding scatters a multiple
#: eigenvalue by a root of the unit roundoff, but hardly moves the mean of the group.
SAME_POLE = 1e-3

#: Modulus below which a discrete eigenvalue counts as zero: its mode decays in a few samples, and has no useful rate.
DEAD_BEAT = 1e-6

#: Significant digits with which gains are commonly printed in full, and those with which a double is kept as it is.
PRINTED_DIGITS, DOUBLE_DIGITS = 9, 17

#: Powers of ten that are doubles, and whole numbers up to which every one is.
EXACT_POWERS = np.array([float(10**power) for power in range(23)])

LARGEST_WHOLE = 2**53

#: Computed eigenvalues are those of a matrix that is another by this, times its order and the unit roundoff, at most.
ROUNDING_OF_EIGENVALUES = 10.0


#: Modes slower than this share of the fastest, or of a rate that the plant has anyway, are integrators and rounding.
STANDING = 1e-6

#: Real or imaginary part of a pole, as a share of its modulus, below which it is rounding of trigonometry and of QZ.
ROUNDING_OF_A_POLE = 1e-12


def pole_text(value: complex, digits: int = 4, *, pair: bool = False) -> str:
    """Return a pole, a zero or an eigenvalue as text, a conjugate ``pair`` as one; a part that is rounding of the other
    is left out."""
    rounding = ROUNDING_OF_A_POLE * abs(value)
    value = complex(*(0.0 if abs(part) < rounding else part for part in (value.real, value.imag)))
    if value.imag == 0.0:
        return f"{value.real:.{digits}g}"
    return f"{value.real:.{digits}g} +- {abs(value.imag):.{digits}g}j" if pair else f"{value:.{digits}g}"


def eigenvalues(matrix: FloatArray) -> ComplexArray:
    """Return the eigenvalues of ``matrix (n, n)``; none of an empty one."""
    values = np.linalg.eigvals(matrix) if matrix.size else np.zeros(0)
    return np.asarray(values, dtype=np.complex128)


def rounding_of_eigenvalues(matrix: FloatArray) -> float:
    """Return what a rounding of a matrix ``(n, n)`` moves an eigenvalue by, relative to that, of the worst of them."""
    if not matrix.size:
        return 0.0
    values, vectors = np.linalg.eig(matrix)
    with np.errstate(all="ignore"):
        try:
            lefts = np.linalg.inv(vectors)
        except np.linalg.LinAlgError:
            return np.inf
        moved = np.linalg.norm(lefts, axis=1) * np.linalg.norm(vectors, axis=0) * np.linalg.norm(matrix)
        worst = float(np.max(np.where(moved > 0.0, moved / np.abs(values), 0.0))) * float(np.finfo(np.float64).eps)
    return worst if np.isfinite(worst) else np.inf


def spectrum_error(matrix: FloatArray, wanted: Sequence[complex] | ComplexArray, dt: float) -> float:
    """Return how far the eigenvalues of ``matrix (n, n)`` are from n wanted ones, relative to their size.

    In discrete time that of the unit circle. Assigned with the least total distance; means of groups are compared.
    """
    goal = np.asarray(wanted, dtype=np.complex128)
    if matrix.shape[0] != goal.size or not np.all(np.isfinite(matrix)):
        return float("inf")
    return mean_miss(eigenvalues(matrix), goal, dt)


def mean_miss(computed: Sequence[complex] | ComplexArray, wanted: Sequence[complex] | ComplexArray, dt: float) -> float:
    """Return `spectrum_error` of a matrix that has these eigenvalues; of more than are wanted, those nearest in sum."""
    values, goal = (np.asarray(poles, dtype=np.complex128) for poles in (computed, wanted))
    if values.size < goal.size:
        return float("inf")
    return max((abs(complex(np.mean(group.misses))) for group in pole_groups(values, goal, dt)), default=0.0)


def multiple_miss(
    computed: Sequence[complex] | ComplexArray, wanted: Sequence[complex] | ComplexArray, dt: float
) -> float:
    """Return the larger of `mean_miss` and, of each group of m poles that are the same, what moves one that far.

    What moves the mean of m equal poles by a share moves each of them by its m-th root at most: a pole that misses by
    ``d < 1`` needs ``d**m``.  A number that is compared with a tolerance bounds each pole by ``tolerance**(1/m)`` then.
    """
    values, goal = (np.asarray(poles, dtype=np.complex128) for poles in (computed, wanted))
    if values.size < goal.size:
        return float("inf")
    misses = [float(group.needed.max()) for group in pole_groups(values, goal, dt)]
    return max([mean_miss(values, goal, dt), *misses])


def farthest_pole(
    computed: Sequence[complex] | ComplexArray, wanted: Sequence[complex] | ComplexArray, dt: float
) -> float:
    """Return how far the worst eigenvalue is from its wanted one, relative as `spectrum_error`; nothing is a mean."""
    values, goal = (np.asarray(poles, dtype=np.complex128) for poles in (computed, wanted))
    if values.size != goal.size or not np.all(np.isfinite(values)):
        return float("inf")
    return max((float(np.max(np.abs(group.misses))) for group in pole_groups(values, goal, dt)), default=0.0)


class PoleGroup(NamedTuple):
    """Wanted poles that are the same: which of the computed ones are assigned to them, and by how much these miss."""

    computed: NDArray[np.intp]
    misses: ComplexArray  # relative to the wanted pole's size, in discrete time to the unit circle

    @property
    def needed(self) -> FloatArray:
        """The share of a perturbation that moves one of m equal poles as far as each misses."""
        sizes = np.abs(self.misses)
        # Beyond its own size no pole is moved by rounding, and a power might overflow.
        return np.where(sizes < 1.0, np.minimum(sizes, 1.0) ** len(sizes), sizes)


def pole_groups(computed: ComplexArray, goal: ComplexArray, dt: float) -> list[PoleGroup]:
    """Return, for each group of wanted poles that are the same, which poles are theirs: the least distances in sum.

    There are as many computed poles at least."""
    from scipy.optimize import linear_sum_assignment

    if goal.size == 0:
        return []
    rows, columns = linear_sum_assignment(np.abs(computed[:, None] - goal[None, :]))
    places = np.empty(goal.size, dtype=np.intp)
    places[columns] = rows
    largest = float(np.max(np.abs(goal))) or 1.0
    groups, waiting = [], np.arange(goal.size)
    while waiting.size:
        first = complex(goal[waiting[0]])
        reach = SAME_POLE * (1.0 if dt > 0.0 else abs(first))
        same = np.abs(goal[waiting] - first) <= reach
        # Itself, where it is no number.
        same[0] = True
        group, waiting = waiting[same], waiting[~same]
        # A pole at zero is compared with the others.
        size = 1.0 if dt > 0.0 else max(abs(first), SAME_POLE * largest)
        groups.append(PoleGroup(places[group], np.asarray((computed[places[group]] - goal[group]) / size)))
    return groups


def abscissa(matrix: FloatArray, dt: float) -> float:
    """Return the largest real part (``dt == 0``) or modulus of an eigenvalue; the empty matrix is stable."""
    return abscissa_of(eigenvalues(matrix), dt) if np.all(np.isfinite(matrix)) else np.inf


def abscissa_of(values: ComplexArray, dt: float) -> float:
    """Return the largest real part (``dt == 0``) or modulus of some eigenvalues."""
    if not values.size:
        return 0.0 if dt > 0.0 else -np.inf
    return float(np.max(np.abs(values))) if dt > 0.0 else float(np.max(values.real))


def as_printed(matrix: FloatArray, digits: int) -> FloatArray:
    """Return each entry as it is when printed with so many significant digits."""
    form, rounded, nonzero = f"%.{digits - 1}e", np.zeros(matrix.shape), matrix != 0.0
    values = matrix[nonzero]
    printed, sure = _printed(values, digits)
    printed[~sure] = [float(form % value) for value in values[~sure].tolist()]
    rounded[nonzero] = printed
    return rounded


def _printed(values: FloatArray, digits: int) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return numbers ``(n,)``, none of them zero, as printed, and for which of these that is certain.

    A whole number of so many digits times or over an exact power of ten is rounded once, as a decimal that is read.
    """
    with np.errstate(all="ignore"):
        sizes = np.where(np.isfinite(values), np.abs(values), 1.0)
        powers = np.floor(np.log10(sizes)) - (digits - 1)
        tens = EXACT_POWERS[np.minimum(np.abs(powers), len(EXACT_POWERS) - 1).astype(np.intp)]
        scaled = np.where(powers < 0.0, sizes * tens, sizes / tens)
        whole = np.rint(scaled)
        printed = np.copysign(np.where(powers < 0.0, whole / tens, whole * tens), values)
        # The quotient is off by half a unit in its last place: near a tie the digits themselves decide.
        clear = np.isfinite(values) & (
            np.abs(np.abs(scaled - np.floor(scaled)) - 0.5) > np.finfo(np.float64).eps * scaled
        )
        exact = np.abs(powers) < len(EXACT_POWERS)
        within = (whole > 10 ** (digits - 1)) & (whole <= min(10**digits, LARGEST_WHOLE))
        return printed, clear & exact & within


def digits_needed(matrix: FloatArray, dt: float) -> int:
    """Return the least number of significant digits with which, and with more than which, a matrix is stable."""
    bound, doubtful = 1.0 if dt > 0.0 else 0.0, range(_digits_beyond_doubt(matrix, dt) - 1, 0, -1)
    unstable = (digits for digits in doubtful if not abscissa(as_printed(matrix, digits), dt) < bound)
    return next(unstable, 0) + 1


def _digits_beyond_doubt(matrix: FloatArray, dt: float) -> int:
    """Return a number of digits with which, and with more than which, a matrix is stable by the theorem of Bauer and
    Fike: rounding moves no eigenvalue by more than its norm times the condition of the eigenvectors."""
    if not matrix.size or not np.all(np.isfinite(matrix)):
        return DOUBLE_DIGITS
    balanced, _ = balanced_matrix(matrix)
    values, vectors = np.linalg.eig(balanced)
    with np.errstate(all="ignore"):
        try:
            condition = float(np.linalg.norm(vectors) * np.linalg.norm(np.linalg.inv(vectors)))
        except np.linalg.LinAlgError:
            return DOUBLE_DIGITS
        size = condition * float(np.linalg.norm(balanced))
    margin = float(1.0 - np.max(np.abs(values)) if dt > 0.0 else -np.max(values.real))
    margin -= size * ROUNDING_OF_EIGENVALUES * len(matrix) * np.finfo(np.float64).eps
    # Rounding to d digits changes an entry by half a unit of the d-th.
    digits = (digits for digits in range(1, DOUBLE_DIGITS) if size * 0.5 * 10.0 ** (1 - digits) < margin)
    return next(digits, DOUBLE_DIGITS)


def decay_rates(values: ComplexArray | Sequence[complex], dt: float) -> FloatArray:
    """Return the rate in 1/s at which each mode decays; negative for one that grows."""
    poles = np.asarray(values, dtype=np.complex128)
    if dt == 0.0:
        return np.asarray(-poles.real, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(-np.log(np.abs(poles)) / dt, dtype=np.float64)


def speeds(values: ComplexArray | Sequence[complex], dt: float) -> FloatArray:
    """Return the speed ``abs(s)`` of each mode in 1/s; infinite for a mode that dies in one sample."""
    poles = np.asarray(values, dtype=np.complex128)
    if dt == 0.0:
        return np.asarray(np.abs(poles), dtype=np.float64)
    alive = np.abs(poles) > DEAD_BEAT
    sizes = np.full(poles.shape, np.inf)
    sizes[alive] = np.abs(np.log(poles[alive])) / dt
    return sizes


def moving_speeds(values: ComplexArray | Sequence[complex], dt: float, rate: float) -> FloatArray:
    """Return the finite speeds of the modes that move, in 1/s.

    Beside nothing faster than ``rate`` (1/s), what rounding leaves of an integrator would be a mode of 1e16 samples.
    """
    finite = speeds(values, dt)
    finite = finite[np.isfinite(finite)]
    return np.asarray(finite[finite > STANDING * np.max(finite, initial=rate)])


def noise_covariance(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, dt: float, *, is_stable: bool = False
) -> FloatArray:
    """Return the stationary covariance of the output under unit white noise; infinite near instability.

    In continuous time of unit intensity, and ``d`` does not count: white noise in an output has no variance.
    ``is_stable``: that ``a`` is stable is known, and its eigenvalues are not computed again.
    """
    if dt > 0.0:
        return output_covariance(a, b, c, d, is_stable=is_stable)

    if not a.size:
        return np.zeros((c.shape[0], c.shape[0]))
    if not is_stable and not abscissa(a, dt) < 0.0:
        return np.full((c.shape[0], c.shape[0]), np.inf)
    # In states and a time of their own: units must not cost digits.
    a, b, c = balanced_realisation(a, b, c)
    size = largest_singular_value(a)
    with warnings.catch_warnings(action="error", category=RuntimeWarning):
        # Poles within rounding of the axis: what comes out is no covariance.
        try:
            states = continuous_lyapunov(a / size, -b @ b.T)
        except RuntimeWarning:
            return np.full((c.shape[0], c.shape[0]), np.inf)
    return np.asarray(c @ states @ c.T) / size


def boundary_points(frequencies: FloatArray, dt: float) -> ComplexArray:
    """Return ``j w`` or ``exp(j w dt)`` for frequencies in rad/s."""
    return np.asarray(np.exp(1j * frequencies * dt) if dt > 0.0 else 1j * frequencies, dtype=np.complex128)
