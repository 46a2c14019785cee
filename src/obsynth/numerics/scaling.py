"""Balancing by powers of two, exact in floating point; units by least squares on the logarithms of the entries.

The unknowns only shift with the units of the data: up to the rounding of exponents, the result does not depend on them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics import lapack
from obsynth.numerics.arrays import FloatArray, read_only

#: Sweeps of the balancing; each one must improve on the last, so few are ever used.
MOST_SWEEPS = 10

#: Makes the factors unique where one group of signals does not touch another; too small to move them.
SMALL_RIDGE = 1e-9


#: Makes the factors unique where nothing determines them; too small to move them elsewhere.
RIDGE = 1e-11

#: Rounding of the largest weight may be this share of the ridge: corrections of the solution then gain two digits each.
ROUNDED_RIDGE = 1.0 / 64.0

#: Weight of a wish in units of the ridge: it decides only what the entries leave open.
WISH_WEIGHT = 1e3

#: An entry this many bits below one has half a say: what is far below is coupling that hardly counts, or rounding.
HALF_SAY = 10.0

#: Corrections by exact residuals, each of which takes four or five digits of rounding away.
RESIDUAL_CORRECTIONS = 3

#: Whole exponents need no further correction once the last is below this share of the distance to where they change.
SETTLED_SHARE = 1e-2

#: Passes in which small entries lose their say.
PASSES = 3

#: Bits after the point of what parts of sums are split into: of a million parts below 2^10 the sum of the first has 46
#: bits, and those of the others have 50.
PART_BITS = (16, 46, 76)

#: From so many on a positive definite matrix is factored as one, in a third of the time.
MANY_UNKNOWNS = 500


@dataclass(frozen=True, eq=False)
class Scaling:
    """Powers of two for a plant: ``diag(equations) E diag(states)``, ``diag(outputs) C diag(states)`` and so on.

    ``equations (nx,)``, ``states (nx,)``, ``outputs (ny,)``; the plant's state is ``x = diag(states) z``.
    """

    equations: FloatArray
    states: FloatArray
    outputs: FloatArray

    def scale_dynamics(self, matrix: FloatArray) -> FloatArray:
        """Return ``E`` or ``A`` ``(nx, nx)`` of the scaled plant."""
        return self.equations[:, None] * matrix * self.states

    def scale_input(self, matrix: FloatArray) -> FloatArray:
        """Return an input-like matrix ``(nx, *)`` of the scaled plant."""
        return self.equations[:, None] * matrix

    def scale_output(self, matrix: FloatArray) -> FloatArray:
        """Return an output-like matrix ``(ny, nx)`` of the scaled plant."""
        return self.outputs[:, None] * matrix * self.states

    def scale_feedthrough(self, matrix: FloatArray) -> FloatArray:
        """Return a feedthrough matrix ``(ny, *)`` of the scaled plant."""
        return self.outputs[:, None] * matrix


@dataclass(frozen=True, eq=False)
class EquilibratedPencil:
    """The pencil ``diag(rows) (A - z E) diag(columns)``, its largest entries near one: ``E, A (m, n)``."""

    E: FloatArray
    A: FloatArray
    rows: FloatArray
    columns: FloatArray


def balancing_factors(matrix: FloatArray) -> FloatArray:
    """Return powers of two ``(n,)`` that balance a matrix ``(n, n)``: ``matrix * s / s[:, None]`` is balanced."""
    # Not by scipy's matrix_balance, which casts the factors to integers and warns where they are too large for that.
    if not matrix.size:
        return np.ones(len(matrix))
    return np.asarray(lapack.dgebal(np.asarray_chkfinite(matrix), scale=1, permute=0)[3], dtype=np.float64)


def balanced_matrix(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a matrix balanced, and the factors ``s`` that did it, as `balancing_factors` has them."""
    factors = balancing_factors(matrix)
    return matrix * factors / factors[:, None], factors


def power_of_two_below(sizes: FloatArray) -> FloatArray:
    """Return the largest power of two not above each entry of ``sizes``; 1 where that is zero."""
    # frexp is exact where log2 is not, and floor leaves everything between 1 and 2 alone.
    _, exponents = np.frexp(sizes)
    return np.where(sizes > 0.0, np.ldexp(1.0, exponents - 1), 1.0)


def equilibrate_pencil(E: FloatArray, A: FloatArray) -> EquilibratedPencil:
    """Scale the rows, then the columns, of ``A - z E (m, n)`` by powers of two to largest entries in [1, 2).

    One pass is enough: scaling a column up cannot lift an entry above those that already rule their rows.
    """
    rows, columns = equilibrating_factors(np.maximum(np.abs(E), np.abs(A)))
    return EquilibratedPencil(
        read_only(rows[:, None] * E * columns),
        read_only(rows[:, None] * A * columns),
        read_only(rows),
        read_only(columns),
    )


def equilibrating_factors(sizes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the factors ``(..., m)`` and ``(..., n)`` of `equilibrate_pencil` for absolute values ``(..., m, n)``."""
    rows = 1.0 / power_of_two_below(np.max(sizes, axis=-1, initial=0.0))
    columns = 1.0 / power_of_two_below(np.max(rows[..., :, None] * sizes, axis=-2, initial=0.0))
    return rows, columns


def balance_system(
    E: FloatArray, A: FloatArray, inputs: Sequence[FloatArray] = (), outputs: Sequence[FloatArray] = ()
) -> Scaling:
    """Find power-of-two factors that bring the largest entries of rows and columns of a plant near one.

    Equations go by the row of ``[E A]`` (else of the inputs), outputs by their rows, states by the column of ``[E; C]``
    (else of A). A fast state cannot have both E and A near one: a sweep is kept only when it improves the columns.
    """
    nx = E.shape[0]
    e, a = np.abs(E), np.abs(A)
    b = np.abs(np.hstack([np.zeros((nx, 0)), *inputs]))
    c = np.abs(np.vstack([np.zeros((0, nx)), *outputs]))
    states = np.ones(nx)
    best = _scale_rows(e, a, b, c, states)
    peaks = _state_peaks(e, a, c, best)
    for _ in range(MOST_SWEEPS):
        states = states / power_of_two_below(peaks)
        trial = _scale_rows(e, a, b, c, states)
        new_peaks = _state_peaks(e, a, c, trial)
        if not _imbalance(new_peaks) < _imbalance(peaks):
            break
        best, peaks = trial, new_peaks
    return best


def balance_by_least_squares(
    E: FloatArray, A: FloatArray, inputs: Sequence[FloatArray] = (), outputs: Sequence[FloatArray] = ()
) -> Scaling:
    """Find power-of-two factors that bring all entries of a plant, on the whole, near one.

    The squared logarithms of all nonzero entries are least; input columns are free. The result does not depend on
    units. Source: R. C. Ward, *Balancing the generalized eigenvalue problem*, SIAM J. Sci. Stat. Comput. 2, 1981.
    """
    ne, nx = E.shape
    b, c = np.hstack([np.zeros((ne, 0)), *inputs]), np.vstack([np.zeros((0, nx)), *outputs])
    ends = [0, ne, ne + nx, ne + nx + len(c), ne + nx + len(c) + b.shape[1]]
    equations, states, shown, entering = map(range, ends[:-1], ends[1:])
    problem = LogBalance(ends[-1])
    for matrix, rows, columns in ((E, equations, states), (A, equations, states), (c, shown, states)):
        problem.add(matrix, rows, columns)
    problem.add(b, equations, entering)
    exponents = problem.solve(passes=0, ridge=SMALL_RIDGE, whole=True).astype(np.int64)
    return Scaling(*(read_only(np.ldexp(1.0, exponents[part])) for part in (equations, states, shown)))


def _scale_rows(e: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray, states: FloatArray) -> Scaling:
    own = _row_peaks(np.hstack([e, a]) * np.concatenate([states, states]))
    equations = np.where(own > 0.0, own, _row_peaks(b))
    outputs = _row_peaks(c * states)
    return Scaling(
        read_only(1.0 / power_of_two_below(equations)),
        read_only(states),
        read_only(1.0 / power_of_two_below(outputs)),
    )


def _state_peaks(e: FloatArray, a: FloatArray, c: FloatArray, scaling: Scaling) -> FloatArray:
    own = _row_peaks(np.vstack([scaling.scale_dynamics(e), scaling.scale_output(c)]).T)
    return np.where(own > 0.0, own, _row_peaks(scaling.scale_dynamics(a).T))


def _imbalance(peaks: FloatArray) -> float:
    return float(np.sum(np.abs(np.log2(power_of_two_below(peaks)))))


def _row_peaks(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.max(matrix, axis=1, initial=0.0))


@dataclass(eq=False)
class LogBalance:
    """Minimise ``log2 abs(M[i, j]) + row[i] + column[j] + common`` over all nonzero entries of matrices."""

    count: int
    _terms: list[_Entries] = field(default_factory=list)
    _wishes: list[tuple[int, float]] = field(default_factory=list)

    def add(
        self,
        matrix: FloatArray,
        rows: range,
        columns: range,
        *,
        signs: tuple[int, int] = (1, 1),
        common: int | None = None,
        weight: float = 1.0,
    ) -> None:
        """Ask for entries of a matrix ``(m, n)`` near one."""
        row, column = np.nonzero(matrix)
        count = len(row)
        self._terms.append(
            _Entries(
                self.count,
                np.log2(np.abs(matrix[row, column])),
                np.full(count, weight),
                (rows.start + row, columns.start + column, np.full(count, self.count if common is None else common)),
                (np.full(count, signs[0]), np.full(count, signs[1]), np.ones(count)),
            )
        )

    def wish(self, unknown: int, exponent: float) -> None:
        """Ask for a value where the entries leave the unknown open."""
        self._wishes.append((unknown, exponent))

    def solve(self, *, passes: int = PASSES, ridge: float = RIDGE, whole: bool = False) -> FloatArray:
        """Return the exponents ``(count,)``, rounded to whole numbers where these are wanted."""
        entries = _Entries.joined(self._terms, self.count)
        weights = entries.weights
        # Of hundreds of states with a dense E the weights are so large that their rounding would be the ridge.
        largest = float(entries.diagonal(weights).max(initial=0.0))
        ridge = max(ridge, largest * float(np.finfo(np.float64).eps) / ROUNDED_RIDGE)
        solved, found = self._solved(entries, weights, ridge)
        for _ in range(passes):
            weights = entries.weights * entries.say(found)
            solved, found = self._solved(entries, weights, ridge)
        # What the entries leave open would be rounding over the ridge: of exact residuals nothing is left of it.
        for _ in range(RESIDUAL_CORRECTIONS):
            before, found = found, found + solved(self._missed(entries, weights, found, ridge))
            if np.array_equal(before, found):
                break
            to_a_half = np.abs(np.abs(found - np.round(found)) - 0.5)
            if whole and np.all(np.abs(found - before) <= SETTLED_SHARE * np.min(to_a_half, initial=1.0)):
                break
        return np.asarray(np.round(found) if whole else found, dtype=np.float64)

    def _missed(self, entries: _Entries, weights: FloatArray, found: FloatArray, ridge: float) -> FloatArray:
        """Return what is left of the normal equations."""
        parts = _whole_parts(weights * entries.logarithms(found))
        missed = -ridge * found - sum(map(entries.sums, parts[::-1]))
        for unknown, exponent in self._wishes:
            missed[unknown] += WISH_WEIGHT * ridge * (exponent - found[unknown])
        return missed

    def _solved(
        self, entries: _Entries, weights: FloatArray, ridge: float
    ) -> tuple[Callable[[FloatArray], FloatArray], FloatArray]:
        """Return what solves the normal equations for a right side, and the solution."""
        normal, right = entries.normal(weights), -entries.sums(weights * entries.sizes)
        diagonal = np.einsum("ii->i", normal)
        diagonal += ridge
        for unknown, exponent in self._wishes:
            diagonal[unknown] += WISH_WEIGHT * ridge
            right[unknown] += WISH_WEIGHT * ridge * exponent
        solved = _factored(normal)
        return solved, solved(right)


def _factored(matrix: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what solves equations with a matrix ``(n, n)``, definite beyond rounding; what is given is lost."""
    if not matrix.size:
        return lambda right: right
    matrix = np.asarray_chkfinite(matrix)
    if len(matrix) >= MANY_UNKNOWNS:
        # In the place of one half, from the other of which all is there again.
        diagonal = matrix.diagonal().copy()
        factor, failed = lapack.dpotrf(matrix.T, lower=1, clean=0, overwrite_a=1)
        if not failed:
            return lambda right: np.asarray(lapack.dpotrs(factor, right, lower=1)[0], dtype=np.float64)
        below = np.tril(matrix, -1)
        matrix = below + below.T
        np.fill_diagonal(matrix, diagonal)
    factors, pivots, failed = lapack.dgetrf(matrix)
    if failed:
        raise np.linalg.LinAlgError("Singular matrix")
    return lambda right: np.asarray(lapack.dgetrs(factors, pivots, right)[0], dtype=np.float64)


def _whole_parts(parts: FloatArray) -> list[FloatArray]:
    """Return multiples of smaller and smaller powers of two whose sum is given, but for the last bits of small ones.

    Sums of such multiples are exact: what enters two sums enters both with the same value."""
    found = []
    for bits in PART_BITS:
        found.append(np.ldexp(np.rint(np.ldexp(parts, bits)), -bits))
        parts = parts - found[-1]
    return found


@dataclass(frozen=True, eq=False)
class _Entries:
    """Logarithms and weights ``(k,)`` of entries, and the unknowns that scale them: places and signs, ``(k,)`` each.

    Of row, of column and, where any has one, common; one place more than there are unknowns stands for none.  Sums add
    up one entry after the other, so that they come out the same on every machine."""

    count: int
    sizes: FloatArray
    weights: FloatArray
    places: Sequence[NDArray[np.int64]]
    signs: Sequence[FloatArray]

    @classmethod
    def joined(cls, terms: Sequence[_Entries], count: int) -> _Entries:
        """Return the entries of all matrices, for so many unknowns."""
        kinds = range(3 if any((term.places[2] < count).any() for term in terms) else 2)
        return cls(
            count,
            np.concatenate([np.zeros(0), *(term.sizes for term in terms)]),
            np.concatenate([np.zeros(0), *(term.weights for term in terms)]),
            [np.concatenate([np.zeros(0, dtype=np.int64), *(term.places[k] for term in terms)]) for k in kinds],
            [np.concatenate([np.zeros(0), *(term.signs[k] for term in terms)]) for k in kinds],
        )

    def logarithms(self, exponents: FloatArray) -> FloatArray:
        """Return the logarithms of the scaled entries."""
        found, known = self.sizes.copy(), np.append(exponents, 0.0)
        for place, sign in zip(self.places, self.signs, strict=True):
            found += sign * known[place]
        return found

    def say(self, exponents: FloatArray) -> FloatArray:
        """Return the say of each entry: all of it above one, less the further it is below."""
        return np.asarray(1.0 / (1.0 + (np.minimum(self.logarithms(exponents), 0.0) / HALF_SAY) ** 2))

    def sums(self, parts: FloatArray) -> FloatArray:
        """Return for each unknown the sum ``(count,)``, with signs, of what is given for the entries that it scales."""
        found = np.zeros(self.count + 1)
        for place, sign in zip(self.places, self.signs, strict=True):
            found += np.bincount(place, sign * parts, len(found))
        return found[:-1]

    def diagonal(self, weights: FloatArray) -> FloatArray:
        """Return for each unknown the weight ``(count,)`` of all entries that it scales."""
        found = np.zeros(self.count + 1)
        for place in self.places:
            found += np.bincount(place, weights, len(found))
        return found[:-1]

    def normal(self, weights: FloatArray) -> FloatArray:
        """Return the matrix ``(count, count)`` of the normal equations."""
        count = self.count + 1
        found = np.diag(np.append(self.diagonal(weights), 0.0))
        scaled = list(zip(self.places, self.signs, strict=True))
        for number, (place, sign) in enumerate(scaled):
            for other, other_sign in scaled[:number]:
                both = np.bincount(place * count + other, sign * other_sign * weights, count * count)
                both = both.reshape(count, count)
                found += both
                found += both.T
        return found[:-1, :-1]
