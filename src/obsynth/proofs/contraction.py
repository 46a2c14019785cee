r"""A norm in which a stable matrix contracts, proved, and what follows for sums over all time.

.. math::
    \rho^2 P - A^T P A > 0 \qquad (\text{continuous: } -(A + \alpha I)^T P - P (A + \alpha I) > 0)

with P = Q'Q gives :math:`\|Q A^j b\| \le \rho^j \|Q b\|`, so that
:math:`\sum_j \|c A^j b\| \le \|c Q^{-1}\| \|Q b\| / (1 - \rho)` (:math:`/ \alpha` for the integral), norms rounded up.
Nonnegative matrices: proved bounds of the spectral radius, of ``(I - M)^-1``, and of sums of powers.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import flint
import numpy as np
from numpy.typing import NDArray

from obsynth.numerics import lapack
from obsynth.numerics.arrays import ComplexArray, FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import continuous_lyapunov, discrete_lyapunov
from obsynth.numerics.scaling import balanced_matrix
from obsynth.numerics.spectra import abscissa
from obsynth.numerics.thin_doubling import symmetric_product
from obsynth.proofs.balls import UNIT_ROUNDOFF, Ball, gamma, rounded_up
from obsynth.proofs.covariances import enclosed_sum
from obsynth.proofs.definiteness import prove_positive_definite
from obsynth.proofs.extended_balls import Enclosed, arb_matrix, block

#: Where between the spectral radius (0) and one (1) the rate is tried, in turn.
TRIED_RATES = (0.5, 0.2, 0.8, 0.95)

#: Digits of what is left to one: a multiple pole scatters by far more than rounding, and each machine would try, and
#: claim bounds of, a rate of its own.
ROOM_DIGITS = 8

#: Roundings of an entry, of every order n, that a Lyapunov equation by Schur vectors and its square root may take.
OPERATIONS = 1e3

#: Up to so many states Lyapunov equations are solved by sums first; doublings of these, and when they have settled.
LYAPUNOV_SUMS_UP_TO, MOST_SUM_DOUBLINGS, SUMS_SETTLED = 100, 80, 1e-17

#: From so many states on Lyapunov equations in discrete time are solved by products alone, and their root by Cholesky.
STATES_FOR_DOUBLED_SUMS = 200

#: Beside sums up to so large rounding hides no identity matrix: 1e-16 of them is 1e-7 of it.
LARGEST_SUM = 1e9

#: Where both lose it the sum is formed in so many digits, in bits, up to so many states.
PRECISE_BITS, PRECISE_SUMS_UP_TO = 1024, 20

#: The same where the rate itself is what is asked for.
TIGHT_RATES = (0.01, 0.1)


#: Solved for a rate this far from the spectral radius to the rate asked for, a Lyapunov matrix P satisfies the
#: inequality by a share of P itself, in every direction; solved for the rate, by an identity matrix, which is lost
#: beside a large P.
SHARE_OF_THE_RATE = 0.9

#: What is added to a matrix, as a share of its largest entry, so that it has a positive eigenvector.
_SHIFTS = (1e-4, 1e-7, 1e-10, 1e-13)

#: The inverse is given up where its residual is larger.
_LARGEST_INVERSE_RESIDUAL = 0.5

#: Bounds in the norm of a factor have ``1 / (1 - defect)`` of its inverse: above this they say little.
_LARGEST_DEFECT = 0.5


#: Most steps that are summed up one by one, and the share of the sum that the rest may then have.
MOST_SUMMED_STEPS, REMAINDER_OF_SUM = 65_536, 1e-3

#: Steps that are taken together; what is left is looked at when their number has grown by one in so many.
STEPS_AT_ONCE, LOOKS = 64, 8

#: A piece of an interval is at most this share of one over the norm of A; most pieces.
NORM_PIECE, MOST_PIECES = 0.05, 1_024


@dataclass(frozen=True, eq=False)
class Contraction:
    """A proved ``|Q A b| <= rate |Q b|`` (continuous: ``|Q e^{At} b| <= e^{-rate t} |Q b|``), Q triangular."""

    Q: FloatArray
    inverse: FloatArray  # near that of Q
    defect: float  # bounds |Q inverse - I|
    rate: float
    discrete: bool
    speed: float = 1.0  # norm of A in these states

    @property
    def factor(self) -> float:
        """Upper bound on the sum (integral) of all powers of the rate."""
        return float(rounded_up(np.asarray(1.0 / ((1.0 - self.rate) if self.discrete else self.rate)), 4))

    @property
    def roundings(self) -> float:
        """How much, relatively, another machine's Q may be off this one: rounding times the condition of P = Q'Q."""
        lengths = np.linalg.norm(self.Q, axis=0)
        condition = float(np.linalg.cond(self.Q / np.where(lengths > 0.0, lengths, 1.0))) if self.Q.size else 1.0
        slowness = self.factor if self.discrete else self.factor * self.speed
        return float(OPERATIONS * max(len(self.Q), 1) * UNIT_ROUNDOFF * condition**2 * max(slowness, 1.0))

    def sizes(self, columns: FloatArray, radius: FloatArray | None = None) -> FloatArray:
        """Return upper bounds on ``|Q b|`` of columns ``(n, m)``, known to within ``radius``, as ``(m,)``."""
        ball = Ball.exact(columns) if radius is None else Ball(np.asarray(columns, dtype=np.float64), radius)
        return column_norms(Ball.exact(self.Q) @ ball)

    def row_norm(self, rows: FloatArray, radius: FloatArray | None = None, summed: bool = False) -> float:
        """Return an upper bound on the norm of ``c Q^-1``, c known to ``radius``; ``summed``: a sum over many c."""
        if not rows.size:
            return 0.0
        ball = Ball.exact(rows) if radius is None else Ball(np.asarray(rows, dtype=np.float64), radius)
        product = ball @ Ball.exact(self.inverse)
        size = product.magnitude
        if summed:
            return float(rounded_up(np.asarray(np.sum(size) / (1.0 - self.defect)), size.size + 4))
        # |X|^2 <= |X|_1 |X|_inf, or Frobenius: both bound the spectral norm.
        frobenius = float(np.sqrt(rounded_up(np.asarray(np.sum(size**2)), size.size + 2)))
        mixed = float(np.sqrt(np.max(np.sum(size, axis=0)) * np.max(np.sum(size, axis=1))))
        return float(rounded_up(np.asarray(min(frobenius, mixed) / (1.0 - self.defect)), 2 * sum(size.shape) + 8))

    def gain(self, rows: FloatArray, columns: FloatArray, radius: FloatArray | None = None) -> FloatArray:
        """Return ``(p, m)``: upper bounds on ``sum_j |c A^j b|`` of each row and column, from ``j = 0``."""
        sizes = self.sizes(columns, radius)
        product = Ball.exact(rows) @ Ball.exact(self.inverse)
        row_norms = rounded_up(column_norms(product.T) / (1.0 - self.defect), 4)
        return rounded_up(row_norms[:, None] * sizes[None, :] * self.factor, 4)


def column_norms(ball: Ball) -> FloatArray:
    """Return upper bounds on the norms of the columns of every member, ``(m,)``."""
    size = ball.magnitude
    largest = np.max(size, axis=0, initial=0.0)
    safe = np.where((largest > 0.0) & np.isfinite(largest), largest, 1.0)
    sums = rounded_up(np.sum((size / safe) ** 2, axis=0), len(size) + 6)
    return np.asarray(rounded_up(safe * np.sqrt(sums), 4))


def prove_contraction(
    matrix: FloatArray | Ball, *, discrete: bool, rate: float | None = None, poles: ComplexArray | None = None
) -> Contraction | None:
    """Return a proved contraction of ``matrix (n, n)`` (with ``rate``, at that), or ``None`` where none is found.

    ``poles``: its eigenvalues, where they are known; they only say which rates are tried."""
    ball = Ball.of(matrix)
    if rate is not None and ball.midpoint.size:
        # Only the rate matters, not how tight the norm is: any factor that proves it will do, the quickest first.
        return _tried(ball, rate, discrete=discrete, sums_first=False) if ball.is_finite else None
    return next(proved_contractions(ball, discrete=discrete, poles=poles), None)


def proved_contractions(
    matrix: FloatArray | Ball, *, discrete: bool, poles: ComplexArray | None = None
) -> Iterator[Contraction]:
    """Yield a contraction of ``matrix (n, n)`` for each of some rates at which one is proved; see above."""
    ball = Ball.of(matrix)
    a = ball.midpoint
    if not a.size:
        yield Contraction(a, a, 0.0, 0.0 if discrete else 1.0, discrete)
    if not a.size or not ball.is_finite:
        return
    values = np.linalg.eigvals(a) if poles is None else poles
    bound = float(np.max(np.abs(values))) if discrete else float(-np.max(values.real))
    if not (bound < 1.0 if discrete else bound > 0.0):
        return
    mantissa, exponent = math.frexp(1.0 - bound if discrete else bound)
    room = math.ldexp(round(math.ldexp(mantissa, ROOM_DIGITS)), exponent - ROOM_DIGITS)
    for share in TRIED_RATES:
        tried = 1.0 - (1.0 - share) * room if discrete else (1.0 - share) * room
        # Sums of squares lose no digits to the slowest mode; with many states they take too long.
        contraction = _tried(ball, tried, discrete=discrete, sums_first=len(a) <= LYAPUNOV_SUMS_UP_TO)
        if contraction is not None:
            yield contraction


def proved_rate(matrix: FloatArray | Ball, known: Contraction | None = None) -> float | None:
    """Return a proved modulus below one, little above the spectral radius; at worst that of a ``known`` contraction."""
    ball = Ball.of(matrix)
    if not ball.midpoint.size:
        return 0.0
    if not np.all(np.isfinite(ball.midpoint)):
        return None
    radius = float(np.max(np.abs(np.linalg.eigvals(ball.midpoint))))
    for share in TIGHT_RATES if radius < 1.0 else ():
        contraction = prove_contraction(ball, discrete=True, rate=radius + share * (1.0 - radius))
        if contraction is not None:
            return contraction.rate
    contraction = prove_contraction(ball, discrete=True) if known is None else known
    return None if contraction is None else contraction.rate


def _tried(ball: Ball, rate: float, *, discrete: bool, sums_first: bool) -> Contraction | None:
    """Return a contraction at a rate; of many states those of filters that do not touch each other, beside each
    other."""
    parts = _separate_parts(ball) if ball.shape[0] > LYAPUNOV_SUMS_UP_TO else []
    if len(parts) < 2:
        return _tried_whole(ball, rate, discrete=discrete, sums_first=sums_first)
    factor, inverse, defects, speed = np.zeros(ball.shape), np.zeros(ball.shape), np.zeros(len(parts)), 0.0
    for i, part in enumerate(parts):
        place = np.ix_(part, part)
        own = Ball(ball.midpoint[place], ball.radius[place])
        contraction = _tried_whole(own, rate, discrete=discrete, sums_first=sums_first)
        if contraction is None:
            return None
        factor[place], inverse[place], defects[i] = contraction.Q, contraction.inverse, contraction.defect
        speed = max(speed, contraction.speed)
    # The norm of blocks beside each other is that of the largest one.
    return Contraction(factor, inverse, float(np.max(defects)), rate, discrete, speed)


def _separate_parts(ball: Ball) -> list[NDArray[np.int64]]:
    """Return the states, in order, of each part of a matrix that is exactly zero between them."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    coupled = (ball.midpoint != 0.0) | (ball.radius > 0.0)
    count, part_of = connected_components(csr_array(coupled), directed=False)
    return [np.flatnonzero(part_of == i) for i in range(count)]


def _tried_whole(ball: Ball, rate: float, *, discrete: bool, sums_first: bool) -> Contraction | None:
    sums_first_factors = (_summed_factor, _lyapunov_factor, _precise_factor, _faster_lyapunov_factor)
    equations_first = (_lyapunov_factor, _faster_lyapunov_factor, _summed_factor, _precise_factor)
    for factor_of in sums_first_factors if sums_first else equations_first:
        factor = factor_of(ball.midpoint, rate, discrete=discrete)
        contraction = None if factor is None else _proved(ball, factor, rate, discrete=discrete)
        if contraction is not None:
            return contraction
    return None


def _proved(ball: Ball, factor: FloatArray, rate: float, *, discrete: bool) -> Contraction | None:
    """Return the contraction in the norm of a triangular factor, where it is one."""
    if not np.all(np.isfinite(factor)) or np.any(np.diag(factor) == 0.0):
        return None
    inverse = np.triu(np.linalg.inv(factor))
    if not np.all(np.isfinite(inverse)) or np.any(np.diag(inverse) == 0.0):
        return None
    n = len(factor)

    def formula(kind: type[Enclosed]) -> Enclosed:
        q, s = kind.exact(factor), kind.exact(inverse)
        unit, moved = q @ s, q @ (kind.of(ball) @ s)
        if discrete:
            return block([[(unit.T @ unit).scaled(rate), moved.T], [moved, kind.exact(np.eye(n)).scaled(rate)]])
        half = unit.T @ (moved + unit.scaled(rate))
        return -(half + half.T)

    if not prove_positive_definite(formula).proved:
        return None
    product = Ball.exact(factor) @ Ball.exact(inverse) - Ball.exact(np.eye(n))
    defect = product.frobenius_norm
    speed = largest_singular_value(factor @ ball.midpoint @ inverse)
    return Contraction(factor, inverse, defect, rate, discrete, speed) if defect < _LARGEST_DEFECT else None


def _summed_factor(a: FloatArray, rate: float, *, discrete: bool) -> FloatArray | None:
    """Return an upper triangular Q with ``Q'Q`` near the sum of ``(A / rate)^k' W (A / rate)^k``, in doubled steps; in
    continuous time of the Cayley transform's.

    W is I, or where I is lost beside such a sum, that sum with W = I: beside it this one is at most as large as the
    slowest mode is slow, however far the states are from each other.
    """
    identity = np.eye(len(a))
    with np.errstate(all="ignore"):
        balanced, scale = balanced_matrix(a)
        if discrete:
            power, start, size = balanced / rate if rate > 0.0 else np.full_like(balanced, np.nan), identity, 1.0
        else:
            shifted = balanced + rate * identity
            size = largest_singular_value(shifted) or 1.0
            try:
                inverse = np.linalg.inv(size * identity - shifted)
            except np.linalg.LinAlgError:
                return None
            power, start = inverse @ (size * identity + shifted), np.sqrt(2.0 * size) * inverse
        root = _summed(power, start)
        if root is not None and size * float(np.max(np.sum(root**2, axis=0))) > LARGEST_SUM:
            root = _summed(power, root / np.max(np.abs(root)) @ start)
        return None if root is None else np.asarray(np.triu(np.linalg.qr(root / scale[None, :], mode="r")))


def _precise_factor(a: FloatArray, rate: float, *, discrete: bool) -> FloatArray | None:
    """Return the second sum of `_summed_factor` in many digits, where double precision has lost it to eigenvectors that
    nearly coincide: whether it does is a matter of one processor's rounding."""
    n = len(a)
    if n > PRECISE_SUMS_UP_TO or not np.all(np.isfinite(a)) or not rate > 0.0:
        return None
    balanced, scale = balanced_matrix(a)
    with flint.ctx.workprec(PRECISE_BITS):
        identity, turned = arb_matrix(np.eye(n)), arb_matrix(balanced.T)
        moving = turned * (1 / flint.arb(rate)) if discrete else turned + identity * flint.arb(rate)
        total = identity
        for _ in range(2):
            enclosed = enclosed_sum(moving, total, largest_singular_value(balanced) + rate, discrete=discrete)
            if enclosed is None:
                return None
            total = enclosed.mid()
        rows = total.tolist()
        for k in range(n):
            if not rows[k][k] > 0:
                return None
            root = rows[k][k].sqrt()
            rows[k] = [value / root for value in rows[k]]
            for i in range(k + 1, n):
                rows[i] = [value - rows[k][i] * other for value, other in zip(rows[i], rows[k], strict=True)]
        factor = np.array([[float(value.mid()) for value in row] for row in rows])
    return np.asarray(np.triu(factor / scale[None, :]))


def _summed(power: FloatArray, factor: FloatArray) -> FloatArray | None:
    """Return a triangular factor of the sum of ``(F A^k)'(F A^k)`` over all k; ``None`` where it does not settle."""
    for _ in range(MOST_SUM_DOUBLINGS):
        later = factor @ power
        if not np.all(np.isfinite(later)):
            return None
        factor = np.asarray(np.linalg.qr(np.vstack([factor, later]), mode="r"))
        if np.all(np.linalg.norm(later, axis=0) <= SUMS_SETTLED * np.linalg.norm(factor, axis=0)):
            return np.asarray(factor)
        power = power @ power
    return None


def _lyapunov_factor(a: FloatArray, rate: float, *, discrete: bool) -> FloatArray | None:
    """Return an upper triangular Q with ``P = Q'Q`` near a solution; ``None`` where there is none."""
    from scipy.linalg import qr

    identity = np.eye(len(a))
    with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
        # Scales of very different units are cast to positions of a permutation.
        balanced, scale = balanced_matrix(a)
        if discrete and rate > 0.0 and len(a) >= STATES_FOR_DOUBLED_SUMS:
            root = _root_of_sum(balanced / rate)
            if root is not None:
                return np.asarray(root / scale)
        try:
            if discrete:
                solution = discrete_lyapunov((balanced / rate).T, identity) if rate > 0.0 else None
            else:
                shifted = balanced + rate * identity
                size = largest_singular_value(shifted) or 1.0
                solution = continuous_lyapunov(shifted.T / size, -identity)
        except (np.linalg.LinAlgError, ValueError):
            return None
    if solution is None or not np.all(np.isfinite(solution)):
        return None
    values, vectors = np.linalg.eigh((solution + solution.T) / 2.0)
    if not np.all(values > 0.0):
        return None
    root = (np.sqrt(values)[:, None] * vectors.T) / scale[None, :]
    return np.asarray(np.triu(qr(root, mode="r")[0][: len(a)]))


def _faster_lyapunov_factor(a: FloatArray, rate: float, *, discrete: bool) -> FloatArray | None:
    """Return the factor for a rate between this one and the fastest that there is."""
    bound = abscissa(a, 1.0 if discrete else 0.0)
    bound = bound if discrete else -bound
    faster = bound + SHARE_OF_THE_RATE * (rate - bound)
    return _lyapunov_factor(a, faster, discrete=discrete)


def _root_of_sum(power: FloatArray) -> FloatArray | None:
    """Return an upper triangular Q with ``Q'Q`` near ``sum A^k' A^k``, in doubled steps; ``None`` where it has none.

    Of many states that is a third of the time of Schur vectors."""
    total = np.eye(len(power))
    for _ in range(MOST_SUM_DOUBLINGS):
        later = symmetric_product(power.T, total @ power)
        total = total + later
        if not np.all(np.isfinite(total)):
            return None
        if np.all(np.diag(later) <= SUMS_SETTLED * np.diag(total)):
            factor, failed = lapack.dpotrf(total, lower=0, clean=1)
            return None if failed else np.asarray(factor)
        power = power @ power
    return None


def spectral_radius_bound(matrix: FloatArray) -> float:
    """Return an upper bound of the spectral radius of ``|matrix|``: a quotient of Collatz and Wielandt, rounded up."""
    return positive_vector(matrix)[0]


def positive_vector(matrix: FloatArray) -> tuple[float, FloatArray]:
    """Return ``rho`` and ``w > 0`` with ``|matrix| w <= rho w`` proved; rho is near the spectral radius."""
    values = np.abs(np.asarray(matrix, dtype=np.float64))
    size = len(values)
    if not size:
        return 0.0, np.zeros(0)
    if not np.isfinite(values).all():
        return np.inf, np.ones(size)
    if not values.any():
        return 0.0, np.ones(size)
    best, at = _positive_vector(values)
    if best < 1.0:
        return best, at
    # What is added to a matrix hides its small entries, which in other units are as large as the others.
    scaled, units = balanced_matrix(values)
    vector = units * _positive_vector(np.abs(scaled))[1]
    quotient = _largest_quotient(values, vector)
    return (quotient, vector) if quotient < best else (best, at)


def _positive_vector(values: FloatArray) -> tuple[float, FloatArray]:
    """Return the same for a nonnegative matrix, by its eigenvectors in the units that it is in."""
    size, tiny, largest = len(values), np.finfo(np.float64).tiny, float(values.max())
    best, at = np.inf, np.ones(size)
    for shift in _SHIFTS:
        eigenvalues, vectors = np.linalg.eig(values + shift * largest)
        vector = np.abs(vectors[:, int(np.argmax(eigenvalues.real))].real) + tiny
        vector = vector / vector.max() + tiny
        quotient = _largest_quotient(values, vector)
        if quotient < best:
            best, at = quotient, vector
    return best, at


def _largest_quotient(values: FloatArray, vector: FloatArray) -> float:
    """Return an upper bound on the largest entry of ``values @ vector / vector``."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        quotients = rounded_up(values @ vector, len(values) + 3) / vector
    largest = float(np.max(quotients)) * (1.0 + 4.0 * UNIT_ROUNDOFF)
    return largest if np.isfinite(largest) and np.all(vector > 0.0) else np.inf


def inverse_bound(matrix: FloatArray) -> FloatArray | None:
    """Return an entrywise upper bound of ``(I - |matrix|)^-1``; `None` unless the spectral radius is proved below 1."""
    values = np.abs(np.asarray(matrix, dtype=np.float64))
    size = len(values)
    if not size:
        return np.zeros((0, 0))
    radius, weights = positive_vector(values)
    if not radius < 1.0:
        return None
    # In units in which row sums are below one, the residual of a computed inverse shrinks what it is multiplied by.
    scaled = values * weights / weights[:, None]
    near = np.abs(np.linalg.inv(np.eye(size) - scaled))
    residual = np.abs(np.eye(size) - (near - scaled @ near))
    residual = residual + gamma(2 * size + 8) * (near + scaled @ near)
    norm = float(rounded_up(residual.sum(axis=1), size + 4).max())
    if not norm < _LARGEST_INVERSE_RESIDUAL:
        return None
    # inverse = near (I - residual)^-1 = near (I + residual + ...); no entry of residual^k is larger than norm^k.
    more = norm / (1.0 - norm) * near.sum(axis=1, keepdims=True)
    bound = rounded_up(near + more, 2 * size + 8) * (1.0 + 8.0 * UNIT_ROUNDOFF)
    return np.asarray(bound * weights[:, None] / weights * (1.0 + 8.0 * UNIT_ROUNDOFF))
