r"""Proved contraction of a stable matrix in a weighted norm, and the bounds on sums over all time that follow from it.

.. math::
    \rho^2 P - A^T P A > 0 \qquad (\text{continuous: } -(A + \alpha I)^T P - P (A + \alpha I) > 0)

with P = Q'Q gives :math:`\|Q A^j b\| \le \rho^j \|Q b\|`, so that
:math:`\sum_j \|c A^j b\| \le \|c Q^{-1}\| \|Q b\| / (1 - \rho)` (:math:`/ \alpha` for the integral), norms rounded up.
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
from obsynth.proofs.balls import UNIT_ROUNDOFF, Ball, rounded_up
from obsynth.proofs.covariances import enclosed_sum
from obsynth.proofs.definiteness import prove_positive_definite
from obsynth.proofs.extended_balls import Enclosed, arb_matrix, block

#: Rates to try in turn, from the spectral radius (0) to one (1).
TRIED_RATES = (0.5, 0.2, 0.8, 0.95)

#: The same where the rate itself is wanted.
TIGHT_RATES = (0.01, 0.1)

#: Bits to which the distance from the spectral radius to one is rounded.  A multiple pole scatters by far more than
#: rounding; without this each machine would try another rate and claim other bounds.
ROOM_DIGITS = 8

#: Rounding errors of an entry, per order n, of a Lyapunov equation solved by Schur vectors and of its square root.
OPERATIONS = 1e3

#: Up to this many states Lyapunov equations are solved by sums first; most doublings, and the share of the sum below
#: which the last doubling ends them.
LYAPUNOV_SUMS_UP_TO, MOST_SUM_DOUBLINGS, SUMS_SETTLED = 100, 80, 1e-17

#: From this many states on, Lyapunov equations in discrete time are solved by products alone, with a Cholesky root.
STATES_FOR_DOUBLED_SUMS = 200

#: Largest sum beside which rounding leaves an identity matrix intact: 1e-16 of it is 1e-7 of the identity.
LARGEST_SUM = 1e9

#: Precision, in bits, of the sum where double precision loses it, and most states for that.
PRECISE_BITS, PRECISE_SUMS_UP_TO = 1024, 20

#: Position, between the spectral radius (0) and the required rate (1), of the rate for which a Lyapunov equation is
#: solved.  Its P then satisfies the inequality for the required rate with a margin that is a share of P in every
#: direction.  Solved for the required rate itself, the margin is an identity matrix, which is lost beside a large P.
SHARE_OF_THE_RATE = 0.9

#: Bounds in the norm of a factor grow by ``1 / (1 - defect)`` of its inverse: above this defect they are of little use.
_LARGEST_DEFECT = 0.5


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
        """Largest relative distance of another machine's Q from this one: rounding times the condition of P = Q'Q."""
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
    """Return a proved contraction of ``matrix (n, n)``, at ``rate`` if one is given; ``None`` where none is found.

    ``poles``: its eigenvalues, where they are known; they only choose the rates to try."""
    ball = Ball.of(matrix)
    if rate is not None and ball.midpoint.size:
        # Only the rate matters, not how tight the norm is: take the first factor that proves it, quick ones first.
        return _tried(ball, rate, discrete=discrete, sums_first=False) if ball.is_finite else None
    return next(proved_contractions(ball, discrete=discrete, poles=poles), None)


def proved_contractions(
    matrix: FloatArray | Ball, *, discrete: bool, poles: ComplexArray | None = None
) -> Iterator[Contraction]:
    """Yield a contraction of ``matrix (n, n)`` for each of `TRIED_RATES` at which one is proved."""
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
    """Return a contraction at a rate; a large block-diagonal matrix is proved block by block."""
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
    # The norm of a block-diagonal matrix is that of its largest block.
    return Contraction(factor, inverse, float(np.max(defects)), rate, discrete, speed)


def _separate_parts(ball: Ball) -> list[NDArray[np.int64]]:
    """Return the states of each diagonal block, in order, of a matrix that is exactly zero outside of these blocks."""
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
    """Return the contraction in the norm of a triangular factor; ``None`` where it is not proved."""
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
    """Return an upper triangular Q with ``Q'Q`` near the sum of ``(A / rate)^k' W (A / rate)^k``, by doubling.

    In continuous time the Cayley transform of A takes the place of A / rate.  W is I.  Where rounding hides I beside
    that sum, the sum itself becomes W and the second sum is returned: its size relative to W is limited by the
    slowest mode, whatever the units of the states.
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
    """Return the second sum of `_summed_factor` in many digits.

    Double precision may lose it where eigenvectors nearly coincide, on one processor and not on another.
    """
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
    """Return a triangular factor of the sum of ``(F A^k)'(F A^k)`` over all k; ``None`` where it does not converge."""
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
    """Return the factor for a rate between this one and that of the slowest mode; see `SHARE_OF_THE_RATE`."""
    bound = abscissa(a, 1.0 if discrete else 0.0)
    bound = bound if discrete else -bound
    faster = bound + SHARE_OF_THE_RATE * (rate - bound)
    return _lyapunov_factor(a, faster, discrete=discrete)


def _root_of_sum(power: FloatArray) -> FloatArray | None:
    """Return an upper triangular Q with ``Q'Q`` near ``sum A^k' A^k``, by doubling; ``None`` where there is none.

    With many states this takes a third of the time of Schur vectors.
    """
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
