r"""Witnesses of matrix inequalities with integer entries, which exact arithmetic checks directly.

Numbers are dyadic, ``integer 2^e``.  That a symmetric S is positive definite is shown by F and positive d: with
``R = S - F'F``, each row of R dominates its others in units d, so that ``x'Sx = |Fx|^2 + x'Rx > 0``.  F is the Cholesky
factor of S less a small part of its diagonal.  Solutions of Lyapunov equations are sums by doubling, in as many digits
as the inequality needs: any approximate solution that satisfies it is a proof.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import flint
import numpy as np
from flint import arb, arb_mat, fmpz, fmpz_mat

from obsynth.numerics.arrays import FloatArray
from obsynth.proofs.exact_doubles import rounded_outward

#: Bits that are tried: few where the inequality has room, many for poles near to each other or to the boundary.
PRECISIONS = (160, 320, 640, 1280)
#: Shares of the diagonal that are left to R, as powers of two.
LEFT_TO_REST = (-8, -20, -40, -70, -110, -160, -240, -400, -700)
#: Bits of a witness that are spent beyond its margin.
SPARE_BITS = 24
#: Numbers above two to this are those of a sum that grows.
LARGEST_POWER = 20_000
#: The speed of Cayley's transform is not below this.
SLOWEST = 2.0**-500
#: Doublings of a sum over time: after so many nothing that decays at a rate of double precision is left.
MOST_DOUBLINGS = 80


@dataclass(frozen=True, eq=False)
class Dyadic:
    """A matrix of numbers ``integer 2^exponent``; sums and products are exact."""

    integers: Any  # fmpz_mat
    exponent: int

    @classmethod
    def of(cls, matrix: Any) -> Dyadic:
        """Return an array of doubles ``(m, n)``, exactly."""
        array = np.atleast_2d(np.asarray(matrix, dtype=np.float64))
        ratios = [value.as_integer_ratio() for value in array.ravel().tolist()]
        shift = max((bottom.bit_length() - 1 for _, bottom in ratios), default=0)
        entries = [top << (shift - bottom.bit_length() + 1) for top, bottom in ratios]
        return cls(fmpz_mat(array.shape[0], array.shape[1], entries), -shift)

    @classmethod
    def identity(cls, size: int) -> Dyadic:
        """Return the identity."""
        return cls(fmpz_mat(size, size, [int(i == j) for i in range(size) for j in range(size)]), 0)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return int(self.integers.nrows()), int(self.integers.ncols())

    @property
    def T(self) -> Dyadic:
        """The transpose."""
        return Dyadic(self.integers.transpose(), self.exponent)

    def __matmul__(self, other: Dyadic) -> Dyadic:
        return Dyadic(self.integers * other.integers, self.exponent + other.exponent)

    def __add__(self, other: Dyadic) -> Dyadic:
        exponent = min(self.exponent, other.exponent)
        return Dyadic(self._at(exponent) + other._at(exponent), exponent)

    def __sub__(self, other: Dyadic) -> Dyadic:
        return self + (-other)

    def __neg__(self) -> Dyadic:
        return Dyadic(-self.integers, self.exponent)

    def _at(self, exponent: int) -> Any:
        return self.integers * (fmpz(1) << (self.exponent - exponent))

    def scaled(self, number: float) -> Dyadic:
        """Return the product with a double, exactly."""
        top, bottom = float(number).as_integer_ratio()
        return Dyadic(self.integers * fmpz(top), self.exponent - bottom.bit_length() + 1)

    def rows(self) -> list[list[int]]:
        """Return the integers row by row."""
        return [[int(value) for value in row] for row in self.integers.tolist()]

    def rows_at(self, places: Iterable[int]) -> Dyadic:
        """Return some rows."""
        integers = self.integers.tolist()
        chosen = [integers[i] for i in places]
        return Dyadic(fmpz_mat(len(chosen), self.shape[1], [value for row in chosen for value in row]), self.exponent)

    def columns_from(self, first: int) -> Dyadic:
        """Return the columns from one on."""
        return self.T.rows_at(range(first, self.shape[1])).T

    def fraction(self, i: int, j: int) -> Fraction:
        """Return one entry."""
        return Fraction(int(self.integers[i, j])) * Fraction(2) ** self.exponent

    def absolute(self) -> Dyadic:
        """Return the absolute values."""
        return Dyadic(fmpz_mat(*self.shape, [abs(value) for value in self.integers.entries()]), self.exponent)

    def balls(self) -> Any:
        """Return the same as a matrix of balls, exact ones."""
        entries = [arb(value) * arb(2) ** self.exponent for value in self.integers.entries()]
        return arb_mat(*self.shape, entries)

    def data(self) -> dict[str, Any]:
        """Return the matrix as data of a proof file."""
        return {
            "size": list(self.shape),
            "exponent": self.exponent,
            "entries": [written(int(value)) for value in self.integers.entries()],
        }


def number_data(value: float) -> dict[str, Any]:
    """Return a double as data of a proof file."""
    return Dyadic.of(np.array([[value]])).data()


def written(value: int) -> int | str:
    """Return an integer as JSON has it, in hexadecimal digits where other readers would round it."""
    return value if abs(value) < 2**53 else f"{value:x}"


def blocks(parts: Sequence[Sequence[Dyadic]]) -> Dyadic:
    """Return a matrix of blocks."""
    exponent = min(part.exponent for row in parts for part in row)
    rows: list[list[Any]] = []
    for row in parts:
        aligned = [part._at(exponent).tolist() for part in row]
        rows += [[value for part in aligned for value in part[i]] for i in range(row[0].shape[0])]
    columns = sum(part.shape[1] for part in parts[0])
    return Dyadic(fmpz_mat(len(rows), columns, [value for row in rows for value in row]), exponent)


def definite_witness(matrix: Dyadic) -> dict[str, Any] | None:
    """Return the factor and the weights that show a symmetric matrix to be positive definite; ``None``: none found."""
    size, rows = matrix.shape[0], matrix.rows()
    if any(rows[i][i] <= 0 for i in range(size)):
        return None
    # Powers of two that bring the diagonal to between one and four.
    shifts = [-((rows[i][i].bit_length() - 1 + matrix.exponent) // 2) for i in range(size)]
    for bits, share in zip(_bits_of(LEFT_TO_REST), LEFT_TO_REST, strict=True):
        unit = [[_shifted(v, matrix.exponent + a + b + bits) for v, b in zip(row, shifts, strict=True)]
                for row, a in zip(rows, shifts, strict=True)]  # fmt: skip
        for i in range(size):
            unit[i][i] -= _shifted(unit[i][i], share)
        lower = _cholesky(unit, bits)
        if lower is None:
            continue
        least = min(shifts, default=0)
        entries = [lower[j][i] << (max(shifts, default=0) - shifts[j]) for i in range(size) for j in range(size)]
        factor = Dyadic(fmpz_mat(size, size, entries), -bits - max(shifts, default=0))
        weights = [1 << (shift - least) for shift in shifts]
        if _dominates((matrix - factor.T @ factor).rows(), weights):
            return {"factor": factor.data(), "weights": [written(weight) for weight in weights]}
    return None


def _bits_of(shares: Sequence[int]) -> list[int]:
    return [2 * SPARE_BITS - share for share in shares]


def _shifted(value: int, by: int) -> int:
    return value << by if by >= 0 else value >> -by


def _cholesky(matrix: list[list[int]], bits: int) -> list[list[int]] | None:
    """Return the lower factor of a matrix of multiples of ``2^-bits``, rounded to these; ``None`` if not definite."""
    size = len(matrix)
    lower = [[0] * size for _ in range(size)]
    for j in range(size):
        own = lower[j]
        square = (matrix[j][j] << bits) - sum(value * value for value in own[:j])
        if square <= 0:
            return None
        own[j] = pivot = math.isqrt(square)
        if not pivot:
            return None
        for i in range(j + 1, size):
            row = lower[i]
            row[j] = ((matrix[i][j] << bits) - sum(map(int.__mul__, row[:j], own[:j]))) // pivot
    return lower


def _dominates(rows: list[list[int]], weights: list[int]) -> bool:
    for i, row in enumerate(rows):
        total = sum(abs(value) * weight for value, weight in zip(row, weights, strict=True))
        if not 2 * row[i] * weights[i] > total:
            return False
    return True


def lyapunov_solution(a: Dyadic, q: Dyadic, rate: float, *, discrete: bool, bits: int) -> Dyadic | None:
    """Return about P with ``a'Pa + rate^2 q = rate^2 P`` or ``a'P + Pa + 2 rate P = -q``; ``None``: it does not exist.

    Any rounding of it will do: what it is for is checked afterwards.
    """
    size = a.shape[0]
    with flint.ctx.workprec(bits):
        own, total = a.balls(), q.balls()
        identity = Dyadic.identity(size).balls()
        try:
            if discrete:
                moved = own * (arb(1) / arb(rate))
            else:
                # Cayley's transform with a speed between the slowest and the fastest mode.
                own = own + identity * arb(rate)
                speed = arb(max(_size(own), SLOWEST))
                back = (identity * speed - own).inv().mid()
                moved, total = (identity * speed + own) * back, back.transpose() * total * back * (2 * speed)
        except ZeroDivisionError:
            return None
        return _sum_over_time(moved.mid(), total.mid(), bits)


def _size(matrix: Any) -> float:
    """Return about the geometric mean of the absolute values of eigenvalues; of a singular matrix its largest entry."""
    size = max(int(matrix.nrows()), 1)
    determinant = float(abs(matrix.det()).mid()) if size < 400 else 0.0
    largest = max((abs(float(value.mid())) for value in matrix.entries()), default=1.0)
    return determinant ** (1.0 / size) if 0.0 < determinant < math.inf else largest


def _sum_over_time(moved: Any, total: Any, bits: int) -> Dyadic | None:
    for _ in range(MOST_DOUBLINGS):
        added = (moved.transpose() * total * moved).mid()
        total, moved = (total + added).mid(), (moved * moved).mid()
        largest, most = (max((abs(value) for value in part.entries()), default=arb(0)) for part in (moved, total))
        if not largest < arb(2) ** LARGEST_POWER or not most < arb(2) ** LARGEST_POWER:
            return None
        if largest < arb(2) ** (-bits):
            return rounded(total, bits, symmetric=True)
    return None


def rounded(matrix: Any, bits: int, *, symmetric: bool = False) -> Dyadic:
    """Return the middles of balls, to so many bits of the root of the product of their diagonal entries."""
    size, columns = int(matrix.nrows()), int(matrix.ncols())
    entries = [_mantissa(value) for value in matrix.entries()]
    rows = [entries[i * columns : (i + 1) * columns] for i in range(size)]
    place = min((_highest_bit(rows[i][i]) for i in range(min(size, columns)) if rows[i][i][0]), default=0)
    exponent = place - bits
    integers = [[_shifted(man, exp - exponent) for man, exp in row] for row in rows]
    if symmetric:
        integers = [[integers[min(i, j)][max(i, j)] for j in range(columns)] for i in range(size)]
    return Dyadic(fmpz_mat(size, columns, [value for row in integers for value in row]), exponent)


def _mantissa(ball: Any) -> tuple[int, int]:
    if ball == 0:
        return 0, 0
    mantissa, exponent = ball.mid().man_exp()
    return int(mantissa), int(exponent)


def _highest_bit(value: tuple[int, int]) -> int:
    return abs(value[0]).bit_length() + value[1]


def lyapunov_witness(a: Dyadic, units: FloatArray, rate: float, *, discrete: bool) -> dict[str, Any] | None:
    """Return P and what shows ``P > 0`` and that it decreases at a rate; ``units (n,)`` of the states."""
    if not a.shape[0]:
        return None
    q = Dyadic.of(np.diag(units**-2.0))
    for bits in PRECISIONS:
        p = lyapunov_solution(a, q, rate, discrete=discrete, bits=bits)
        if p is None:
            continue
        half = a.T @ p + p.scaled(rate)
        decrease = p.scaled(rate).scaled(rate) - a.T @ p @ a if discrete else -(half + half.T)
        decreases = definite_witness(decrease)
        if decreases is not None and (positive := definite_witness(p)) is not None:
            return {"P": p, "P_positive": positive, "decreases": decreases}
    return None


def inverse(p: Dyadic) -> Dyadic | None:
    """Return about the inverse of a symmetric matrix, in many more digits than double precision has."""
    bits = PRECISIONS[-1]
    with flint.ctx.workprec(bits):
        try:
            return rounded(p.balls().inv().mid(), bits // 4, symmetric=True)
        except ZeroDivisionError:
            return None


def inverse_above(p: Dyadic) -> tuple[Dyadic, dict[str, Any]] | None:
    """Return G a little above the inverse of P, with what shows ``[P, I; I, G] > 0``."""
    size = p.shape[0]
    for bits in PRECISIONS:
        with flint.ctx.workprec(bits):
            try:
                g = rounded((p.balls().inv() * (1 + arb(2) ** -16)).mid(), bits, symmetric=True)
            except ZeroDivisionError:
                continue
        identity = Dyadic.identity(size)
        witness = definite_witness(blocks([[p, identity], [identity, g]]))
        if witness is not None:
            return g, witness
    return None


def root_above(value: Fraction) -> float:
    """Return a double that is at least the square root of a fraction, by less than 2^-20 of it."""
    if not value:
        return 0.0
    shift = 2 * max(0, 128 - (value.numerator.bit_length() - value.denominator.bit_length()) // 2)
    root = math.isqrt((value.numerator << shift) // value.denominator) + 1
    return rounded_outward(Fraction(root, 1 << (shift // 2)))
