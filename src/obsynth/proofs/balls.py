r"""Matrices with guaranteed error bounds: sums and products of balls contain those of every member, in any BLAS order.

A `Ball` is every real matrix within ``radius`` of ``midpoint``, entry by entry; an overflow leaves entries that are not
finite, about which nothing is claimed.  Higham, *Accuracy and Stability*, 2nd ed., section 3.1, with
:math:`u = 2^{-53}`, :math:`\gamma_k = k u / (1 - k u)`: a dot product of length k in any order, with or without fused
multiply-add, misses at most :math:`\gamma_k |x|^T |y|`, plus :math:`k\,2^{-1074}` where products underflow.

Matrices of real balls in any precision (python-flint's Arb), and the signs of a quadratic form decided with them.

Formed again with more digits and factored as :math:`L D L^T` until the pivots are decided: if every one is a ball to
the right of zero, each symmetric member is positive definite (Sylvester's law of inertia holds for every member).

Proofs that a symmetric matrix, known up to rounding, is positive definite: a Cholesky factorisation that completes.

S. M. Rump, *Verification of positive definiteness*, BIT 46, 2006 (formally proved by P. Roux in Coq).  With
:math:`\gamma_k = k u / (1 - k u)`, and R the computed factor of :math:`\tilde A` of order n:

1. :math:`r_{ij}` is the rounded quotient (or root) of :math:`\tilde a_{ij} - \sum_{k<i} r_{ki} r_{kj}`: at most i + 1
   roundings a term, in any order.  So :math:`|\tilde a_{ij} - \sum_{k \le i} r_{ki} r_{kj}| \le \gamma_{n+1}
   \sum_{k \le i} |r_{ki}| |r_{kj}| \le \gamma_{n+1} \|r_i\| \|r_j\|` (Cauchy, Schwarz).
2. On the diagonal: :math:`\|r_j\|^2 \le \tilde a_{jj} / (1 - \gamma_{n+1})`.
3. Hence :math:`R^T R = \tilde A + \Delta`, :math:`|\Delta| \le \frac{\gamma_{n+1}}{1 - \gamma_{n+1}} d d^T`,
   :math:`d_j = \sqrt{\tilde a_{jj}}`, of norm :math:`d^T d`:
   :math:`\lambda_{\min}(\tilde A) \ge -\frac{\gamma_{n+1}}{1 - \gamma_{n+1}} \mathrm{tr}\,\tilde A - \eta`, where
   underflow adds at most :math:`4 (n + 1 + \max_i \tilde a_{ii}) 2^{-1074}` an entry, n times that to the norm.

We take 2 (n + 4) for n + 1 (kernels may multiply by a rounded reciprocal) and twice the underflow; arithmetic rounds to
nearest with gradual underflow, and products are sums of products (no Strassen).  With
:math:`\tilde A = \mathrm{fl}(A - c I)`, completion proves

.. math::
    \lambda_{\min}(A) \ge c - \frac{\gamma_k}{1-\gamma_k} \mathrm{tr}\,\tilde A - u \max_i |\tilde a_{ii}| - \eta .

The error of forming A enters as the largest row sum of its radii, a bound on the norm of any symmetric perturbation
within them.  Then follow a congruence that brings the matrix near the identity, and more digits (`extended_balls`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, Self, TypeVar

import flint
import numpy as np
from numpy.typing import NDArray

from obsynth.numerics import lapack
from obsynth.numerics.arguments import FloatArray

#: Unit roundoff of IEEE double precision.
UNIT_ROUNDOFF = 2.0**-53
#: Twice the smallest positive number: more than one underflow can lose.
UNDERFLOW = 2.0**-1073
#: Powers of two up to this exponent have doubles as products.
LARGEST_EXPONENT = 500
#: Rows of a large matrix that are looked at at once: as many as a processor keeps near.
PANEL_ROWS = 128


def gamma(terms: int) -> float:
    """Return an upper bound on ``k u / (1 - k u)`` for ``k = terms`` (far below ``1 / u``)."""
    return terms * UNIT_ROUNDOFF * (1.0 + 2.0 * (terms + 2) * UNIT_ROUNDOFF)


def rounded_up(value: FloatArray, operations: int) -> FloatArray:
    """Return an upper bound on a non-negative exact value that was computed with ``operations`` roundings."""
    return value * (1.0 + 2.0 * (operations + 2) * UNIT_ROUNDOFF) + (operations + 1) * UNDERFLOW


@dataclass(frozen=True, eq=False)
class Ball:
    """All real matrices within ``radius`` (not negative) of ``midpoint``, entry by entry, ``(rows, cols)`` each."""

    midpoint: FloatArray
    radius: FloatArray

    @classmethod
    def exact(cls, matrix: FloatArray) -> Self:
        """Return the ball that holds ``matrix`` alone: floating-point numbers are exact data."""
        return cls(np.asarray(matrix, dtype=np.float64), np.zeros(np.shape(matrix)))

    @classmethod
    def of(cls, matrix: Ball | FloatArray) -> Self:
        """Return a ball as it is, or the one that holds a matrix alone."""
        return cls(matrix.midpoint, matrix.radius) if isinstance(matrix, Ball) else cls.exact(matrix)

    @classmethod
    def blocks(cls, rows: Sequence[Sequence[Self]]) -> Self:
        """Return the ball of the block matrix with the given rows of blocks."""
        heights, widths = [row[0].shape[0] for row in rows], [ball.shape[1] for ball in rows[0]]
        midpoint, radius = (np.zeros((sum(heights), sum(widths))) for _ in range(2))
        bottom = 0
        for row, height in zip(rows, heights, strict=True):
            right = 0
            for ball, width in zip(row, widths, strict=True):
                place = slice(bottom, bottom + height), slice(right, right + width)
                midpoint[place], radius[place] = ball.midpoint, ball.radius
                right += width
            bottom += height
        return cls(midpoint, radius)

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return tuple(self.midpoint.shape)

    @property
    def T(self) -> Self:
        """The transpose."""
        return type(self)(self.midpoint.T, self.radius.T)

    def __add__(self, other: Self) -> Self:
        """Return the ball of all sums of members."""
        with np.errstate(over="ignore", invalid="ignore"):
            total = self.midpoint + other.midpoint
            radius = rounded_up(self.radius + other.radius + UNIT_ROUNDOFF * np.abs(total), 3)
        return type(self)(total, radius)

    def __neg__(self) -> Self:
        """Return the ball of the negative members; exact."""
        return type(self)(-self.midpoint, self.radius)

    def __sub__(self, other: Self) -> Self:
        """Return the ball of all differences of members."""
        return self + (-other)

    def __matmul__(self, other: Self) -> Self:
        """Return the ball of all products of members."""
        length = self.shape[1]
        size, other_size = np.abs(self.midpoint), np.abs(other.midpoint)
        with np.errstate(over="ignore", invalid="ignore"):
            # gamma multiplies the product, not a factor: what a factor loses by underflow, the other may magnify.
            spread = gamma(length + 1) * (size @ other_size)
            if not other.is_exact:
                spread = spread + size @ other.radius
            if not self.is_exact:
                spread = spread + self.radius @ (other_size + other.radius)
            radius = rounded_up(spread, 2 * length + 6) + 3 * length * UNDERFLOW
            return type(self)(self.midpoint @ other.midpoint, radius)

    def scaled(self, factor: float) -> Self:
        """Return the ball of ``factor`` times every member."""
        with np.errstate(over="ignore", invalid="ignore"):
            product = factor * self.midpoint
            radius = abs(factor) * self.radius + UNIT_ROUNDOFF * np.abs(product) + UNDERFLOW
            return type(self)(product, rounded_up(radius, 4))

    @property
    def magnitude(self) -> FloatArray:
        """Upper bounds on the absolute values of the entries of every member."""
        return rounded_up(np.abs(self.midpoint) + self.radius, 2)

    @property
    def frobenius_norm(self) -> float:
        """Upper bound on the Frobenius norm of every member, and so on its 2-norm."""
        size = self.magnitude
        return float(rounded_up(np.asarray(np.sqrt(np.sum(size**2))), size.size + 6))

    def widened(self, share: float) -> Ball:
        """Return the ball of every member times a number that is off one by at most ``share``."""
        radius = self.radius + share * (np.abs(self.midpoint) + self.radius)
        return Ball(self.midpoint, rounded_up(radius, 4))

    def added(self, radius: float) -> Ball:
        """Return the ball of all sums with a matrix of entries of at most so much."""
        return Ball(self.midpoint, rounded_up(self.radius + radius, 2))

    @property
    def is_finite(self) -> bool:
        """Whether anything is claimed: no entry overflowed."""
        return bool(np.isfinite(self.midpoint).all() and np.isfinite(self.radius).all())

    @property
    def is_exact(self) -> bool:
        """Whether there is one member alone."""
        return not self.radius.any()

    def congruent(self, exponents: NDArray[np.int64]) -> Ball:
        """Return ``diag(2^k) X diag(2^k)``, k the ``exponents``: exact but for underflow."""
        middle, radius = np.empty(self.shape), np.empty(self.shape)
        # Where every factor is a double, one product is as exact as `ldexp`, at a fraction of its time.
        units = np.ldexp(1.0, exponents) if np.max(np.abs(exponents), initial=0) <= LARGEST_EXPONENT else None
        with np.errstate(over="ignore"):
            for start in range(0, len(exponents), PANEL_ROWS):
                rows = slice(start, start + PANEL_ROWS)
                if units is not None:
                    factors = units[rows, None] * units
                    np.multiply(self.midpoint[rows], factors, out=middle[rows])
                    np.multiply(self.radius[rows], factors, out=radius[rows])
                else:
                    total = exponents[rows, None] + exponents
                    np.ldexp(self.midpoint[rows], total, out=middle[rows])
                    np.ldexp(self.radius[rows], total, out=radius[rows])
            radius += UNDERFLOW
        return Ball(middle, radius)


#: The arithmetics in which a matrix can be formed so that sums and products hold those of all members.
Enclosed = TypeVar("Enclosed", Ball, "ExtendedBall")


class Formula(Protocol):
    """How a matrix is formed, in an arithmetic of whoever calls it: ``formula(Ball)`` for double precision."""

    def __call__(self, kind: type[Enclosed], /) -> Enclosed:
        """Return the matrix with what forming it may have cost."""


def block(rows: Sequence[Sequence[Enclosed]]) -> Enclosed:
    """Return the set of block matrices with the given rows of blocks."""
    return type(rows[0][0]).blocks(rows)


#: Digits to try, in bits.
PRECISION_BITS = (128, 512, 2048)
#: The largest order that is tried: 128 takes 0.1 s where 128 bits decide, 0.5 s where nothing does.
LARGEST_ORDER = 128


#: Digits (bits) in which all eigenvalues of a matrix are enclosed, and the largest order of which they are: .8 s at 57.
EIGENVALUE_BITS = (212, 848)
MOST_ENCLOSED = 80


def prove_by_ball_arithmetic(formula: Formula) -> tuple[float | None, str]:
    """Try to prove that every symmetric member of a matrix is positive definite, with as many digits as it takes.

    Returns a proved lower bound and the digits that decided; ``None`` and the reason without a proof."""
    reason = ""
    for bits in PRECISION_BITS:
        # A local precision: the one in python-flint's context is for the whole process.
        with flint.ctx.workprec(bits):
            matrix = formula(ExtendedBall)
            pivot = undecided_pivot(matrix.entries())
            if pivot is None:
                return _lower_bound(matrix), f"{bits} bits"
        place, is_certain, is_hopeless = pivot
        if is_certain:
            return None, f"pivot {place} is not positive: not positive definite"
        reason = f"{bits} bits of ball arithmetic leave the sign of pivot {place} open: singular, or next to it"
        if is_hopeless:
            break
    return None, reason


def enclosed_eigenvalues(matrix: FloatArray) -> tuple[Any, ...] | None:
    """Return balls (``flint.acb``), each with one eigenvalue of ``matrix`` as stored; ``None`` without a proof."""
    order = len(matrix)
    if not 0 < order <= MOST_ENCLOSED or not np.all(np.isfinite(matrix)):
        return None
    for bits in EIGENVALUE_BITS:
        with flint.ctx.workprec(bits):
            try:
                return tuple(flint.acb_mat(order, order, np.ravel(matrix).tolist()).eig(multiple=True))
            except ValueError:  # the enclosures found at this precision do not hold
                continue
    return None


def middle_of(ball: Any) -> complex:
    """Return the middle of a complex ball, to double precision."""
    return complex(float(ball.real.mid()), float(ball.imag.mid()))


def undecided_pivot(rows: list[list[Any]]) -> tuple[int, bool, bool] | None:
    """Return the place of the first pivot of ``L D L'`` not certainly positive, if any, whether it certainly is not,
    and whether digits do not help, as it is not finite; only the upper triangle is read."""
    size = len(rows)
    for k, pivot_row in enumerate(rows):
        pivot = pivot_row[k]
        if not pivot > 0:
            return k + 1, bool(pivot <= 0), not pivot.is_finite()
        for i in range(k + 1, size):
            factor, row = pivot_row[i] / pivot, rows[i]
            for j in range(i, size):
                row[j] -= factor * pivot_row[j]
    return None


def _lower_bound(matrix: ExtendedBall) -> float:
    """Return ``1 / trace(X^-1)``, rounded down: no more than the smallest eigenvalue of a definite member X."""
    try:
        trace = matrix.content.inv().trace().upper()
    except ZeroDivisionError:
        return float(np.nextafter(0.0, 1.0))
    bound = float((1 / trace).lower()) if trace > 0 and trace.is_finite() else 0.0
    return max(float(np.nextafter(bound, 0.0)), float(np.nextafter(0.0, 1.0)))


def arb_matrix(matrix: FloatArray) -> Any:
    """Return a matrix as python-flint's, exactly."""
    rows, columns = np.shape(matrix)
    return flint.arb_mat(rows, columns, np.ravel(matrix).tolist())


@dataclass(frozen=True, eq=False)
class ExtendedBall:
    """All real matrices within radii of midpoints that have the digits of python-flint's current precision."""

    content: Any

    @classmethod
    def exact(cls, matrix: FloatArray) -> Self:
        """Return the ball that holds ``matrix`` alone, whatever the precision."""
        return cls(arb_matrix(matrix))

    @classmethod
    def of(cls, ball: Ball) -> Self:
        """Return the ball with the midpoint and radius of ``ball``."""
        rows, columns = ball.shape
        pairs = zip(np.ravel(ball.midpoint).tolist(), np.ravel(ball.radius).tolist(), strict=True)
        content = [flint.arb(middle, radius) if radius else flint.arb(middle) for middle, radius in pairs]
        return cls(flint.arb_mat(rows, columns, content))

    @classmethod
    def blocks(cls, rows: Sequence[Sequence[Self]]) -> Self:
        """Return the ball of the block matrix with the given rows of blocks."""
        joined: list[Any] = []
        height = 0
        for row in rows:
            parts = [part.entries() for part in row]
            height += row[0].shape[0]
            for i in range(row[0].shape[0]):
                joined += [value for part in parts for value in part[i]]
        return cls(flint.arb_mat(height, sum(part.shape[1] for part in rows[0]), joined))

    def entries(self) -> list[list[Any]]:
        """Return the entries as lists of ``flint.arb``."""
        return [list(row) for row in self.content.tolist()]

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return int(self.content.nrows()), int(self.content.ncols())

    @property
    def T(self) -> Self:
        """The transpose."""
        return type(self)(self.content.transpose())

    def __add__(self, other: Self) -> Self:
        """Return the ball of all sums of members."""
        return type(self)(self.content + other.content)

    def __neg__(self) -> Self:
        """Return the ball of the negative members; exact."""
        return type(self)(-self.content)

    def __sub__(self, other: Self) -> Self:
        """Return the ball of all differences of members."""
        return type(self)(self.content - other.content)

    def __matmul__(self, other: Self) -> Self:
        """Return the ball of all products of members."""
        return type(self)(self.content * other.content)

    def scaled(self, factor: float) -> Self:
        """Return the ball of ``factor`` times every member."""
        return type(self)(self.content * flint.arb(factor))


#: The first shift that is tried, relative to the error bound: as little as leaves a bound above zero.
LEAST_SHIFT = 1.0 + 2.0**-5
#: Shares of the estimated eigenvalue that are tried as lower bounds, in turn.
EIGENVALUE_SHARES = (0.5, 2.0**-4)
#: Steps of inverse iteration behind that estimate.
INVERSE_ITERATIONS = 4

Means = Literal["Cholesky", "preconditioned Cholesky", "ball arithmetic", "none"]


@dataclass(frozen=True)
class DefinitenessProof:
    """The outcome of an attempt to prove that every symmetric member of a ball is positive definite."""

    proved: bool
    lower_bound: float  # proved, after a congruence; unproved: the computed one less the error bounds, or zero
    error_bound: float  # of rounding in double precision, and forming
    means: Means = "none"
    reason: str = ""  # precision of ball arithmetic, or why there is no proof

    @property
    def in_double_precision(self) -> bool:
        """Whether it is proved without more digits: a certificate to prefer, since everybody can check it."""
        return self.proved and self.means != "ball arithmetic"

    @property
    def text(self) -> str:
        """How it was proved, or why not, for reports."""
        if self.means == "ball arithmetic":
            return f"ball arithmetic with {self.reason} (python-flint), on a unit diagonal"
        if not self.proved:
            return f"not proved: {self.reason}" if self.reason else "not proved"
        change = " after preconditioning" if self.means == "preconditioned Cholesky" else ""
        return f"Cholesky{change} with rounding bound {self.error_bound:.1e}, on a unit diagonal"


def unproved(reason: str) -> DefinitenessProof:
    """Return that nothing is proved, for a reason found before any factorisation."""
    return DefinitenessProof(False, -float("inf"), 0.0, reason=reason)


def prove_positive_definite(matrix: Formula | Ball | FloatArray) -> DefinitenessProof:
    """Try to prove that every symmetric member of ``matrix (n, n)`` is positive definite."""
    formula = _as_formula(matrix)
    ball = formula(Ball)
    if ball.shape[0] == 0:
        return DefinitenessProof(True, float("inf"), 0.0, "Cholesky")
    if not ball.is_finite:
        return unproved("an entry is not finite")
    diagonal = np.diag(ball.midpoint).copy()  # no view, which would keep all of it
    if np.any(diagonal <= 0.0):
        place = int(np.argmin(diagonal))
        return unproved(f"diagonal entry {place + 1} is {diagonal[place]:.3g}: not positive definite")
    exponents = -np.round(np.log2(diagonal) / 2.0).astype(np.int64)
    # Large matrices are let go as soon as nothing follows from them any more.
    ball = ball.congruent(exponents)
    scaled = _symmetric(ball)
    del ball
    if not scaled.is_finite:
        return unproved("an entry beside the diagonal is larger than the diagonal allows: not positive definite")
    first = _by_cholesky(scaled)
    if first.proved:
        return first
    return _by_preconditioning(scaled) or _in_more_digits(formula, exponents, first)


def _as_formula(matrix: Formula | Ball | FloatArray) -> Formula:
    if not isinstance(matrix, (Ball, np.ndarray)):
        return matrix
    ball = Ball.of(matrix)

    def given(kind: type[Enclosed]) -> Enclosed:
        return kind.of(ball)

    return given


def _symmetric(ball: Ball) -> Ball:
    """Return a ball with symmetric midpoint and all symmetric members of ``ball``: they lie in its transpose too."""
    middle, radius = np.empty(ball.shape), np.empty(ball.shape)
    starts = range(0, len(middle), PANEL_ROWS)
    with np.errstate(over="ignore", invalid="ignore"):
        for rows, columns in (
            (slice(i, i + PANEL_ROWS), slice(j, j + PANEL_ROWS)) for i in starts for j in starts[i // PANEL_ROWS :]
        ):
            one, other = ball.midpoint[rows, columns], ball.midpoint[columns, rows].T
            middle[rows, columns] = 0.5 * (one + other)
            middle[columns, rows] = middle[rows, columns].T
            # The difference of the midpoints more than covers the rounding of their average.
            size = np.maximum(ball.radius[rows, columns], ball.radius[columns, rows].T) + np.abs(one - other)
            radius[rows, columns] = rounded_up(size, 4)
            radius[columns, rows] = radius[rows, columns].T
    return Ball(middle, radius)


def _by_cholesky(ball: Ball, means: Means = "Cholesky") -> DefinitenessProof:
    size = ball.shape[0]
    forming = float(rounded_up(np.max(np.sum(ball.radius, axis=1)), size + 2))
    states = ball.midpoint.shape[0]
    growth = gamma(2 * (states + 4))
    trace = float(rounded_up(np.sum(np.abs(np.diag(ball.midpoint))), states))
    largest = float(np.max(np.abs(np.diag(ball.midpoint))))
    # The shift only lowers a diagonal that stays positive, so the unshifted trace bounds the shifted one.
    bound = growth * (1.0 + 2.0 * growth) * trace + 2.0 * UNIT_ROUNDOFF * largest
    underflow = 4.0 * states * (2.0 * states + largest) * UNDERFLOW
    error = forming + float(rounded_up(np.asarray(bound + underflow), 8))
    shift = LEAST_SHIFT * error
    factor = _shifted_factor(ball.midpoint, shift)
    if factor is None:
        estimate = float(np.linalg.eigvalsh(ball.midpoint)[0])
        reason = (
            f"the smallest eigenvalue, computed as {estimate:.3g} on a unit diagonal, is not above the rounding and "
            f"forming errors, {error:.3g}"
        )
        return DefinitenessProof(False, min(estimate - error, 0.0), error, reason=reason)
    # That is a proof.  How much there is besides is estimated, and proved by another factorisation.
    left = _smallest_eigenvalue(factor)
    for share in EIGENVALUE_SHARES:
        larger = shift + share * left
        if larger > shift and _shifted_factor(ball.midpoint, larger) is not None:
            return DefinitenessProof(True, larger - error, error, means)
    return DefinitenessProof(True, shift - error, error, means)


def _smallest_eigenvalue(factor: FloatArray) -> float:
    """Return an estimate of the smallest eigenvalue of ``factor factor'``, from above, by inverse iteration."""
    vector = np.ones(len(factor)) / np.sqrt(len(factor))
    # Signs that alternate where those of the factor do keep the start away from a right angle.
    vector = np.where(factor[-1] > 0.0, -vector, vector)
    size = 0.0
    for _ in range(INVERSE_ITERATIONS):
        vector = lapack.dpotrs(factor, vector, lower=1)[0]
        size = float(np.linalg.norm(vector))
        if not np.isfinite(size) or size == 0.0:
            return 0.0
        vector = vector / size
    return 1.0 / size


def _by_preconditioning(ball: Ball) -> DefinitenessProof | None:
    """Prove ``C' X C`` near I instead, formed with error bounds: for condition numbers up to 1e12; else ``None``.

    C is close to the inverse Cholesky factor, triangular with a nonzero diagonal, hence nonsingular exactly.
    """
    factor = _shifted_factor(ball.midpoint, 0.0)
    if factor is None:
        return None
    try:
        change = np.triu(np.linalg.inv(factor).T)
    except np.linalg.LinAlgError:
        # Pivoting can make pivots underflow although the diagonal of the factor does not.
        return None
    if not np.all(np.isfinite(change)) or np.any(np.diag(change) == 0.0):
        return None
    exact = Ball.exact(change)
    near_identity = _symmetric(exact.T @ ball @ exact)
    proof = _by_cholesky(near_identity, "preconditioned Cholesky") if near_identity.is_finite else None
    return proof if proof and proof.proved else None


def _in_more_digits(formula: Formula, exponents: NDArray[np.int64], first: DefinitenessProof) -> DefinitenessProof:
    """Prove by ball arithmetic what double precision left open; or return ``first`` with the reason."""
    if first.lower_bound < -2.0 * first.error_bound:
        return first  # negative beyond all errors
    if len(exponents) > LARGEST_ORDER:
        told = f"ball arithmetic is tried up to order {LARGEST_ORDER}, this is {len(exponents)}"
        return replace(first, reason=f"{first.reason}; {told}")
    units = np.diag(np.ldexp(1.0, exponents))

    def scaled(kind: type[Enclosed]) -> Enclosed:
        change = kind.exact(units)
        return change @ formula(kind) @ change

    bound, told = prove_by_ball_arithmetic(scaled)
    if bound is None:
        return replace(first, reason=f"{first.reason}; {told}")
    return DefinitenessProof(True, bound, first.error_bound, "ball arithmetic", told)


def _shifted_factor(matrix: FloatArray, shift: float) -> FloatArray | None:
    """Return the lower triangular factor of a symmetric matrix less ``shift`` times the identity, or ``None``."""
    # Transposed, it is the same matrix in the order that LAPACK reads, and its copy the only one.
    lowered = np.array(matrix, order="C", dtype=np.float64).T
    np.einsum("ii->i", lowered)[:] -= shift
    factor, failed = lapack.dpotrf(lowered, lower=1, clean=1, overwrite_a=1)
    return np.asarray(factor) if not failed and np.isfinite(factor).all() else None
