"""One fault on a decoupled plant: whether it shows, where it does not, how fast it does, and by which equations.

In floating point; exactly for small plants whose numbers are as somebody wrote them.

With N a minimal polynomial basis of the left null space of the unknowns' pencil, the zeros of the fault are those of
the greatest common divisor of ``g = N [bf; df]``; decoupled: where ``[F; G]`` lies in the range of ``[A - sE; C]``.

Least order of a residual that shows a fault, the least degree in y and u of an equation without states: of ``z+ = A z +
F f + K w``, ``0 = C z + G f + L w`` with w = [u; y], the equations of degree m in w are spanned by ``s^k e``, k <= m,
with e those of degree 0: the rows, and derivatives of equations that hold no w, which cost nothing. That is the least
degree of a minimal polynomial basis (Forney 1975) among its rows that show the fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from itertools import dropwhile
from typing import ClassVar, NamedTuple

import numpy as np
from flint import fmpq, fmpq_mat, fmpq_poly, fmpz_poly
from numpy.typing import NDArray

from obsynth.analysis.diagnosis.decoupled import DecoupledPlant, decoupled, finite_values, left_part, unknowns_pencil
from obsynth.analysis.zeros import are_outside
from obsynth.numerics.arrays import ComplexArray, FloatArray, largest_singular_value
from obsynth.numerics.pencils import FiniteZeros, full_svd
from obsynth.numerics.ranks import CLEAR_GAP, MARKOV_TOLERANCE, RANK_TOLERANCE, TRACE_TOLERANCE, rank_from
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_arithmetic import (
    ExactPencil,
    Root,
    blocks,
    holds_computed,
    identity,
    left_null_basis,
    locate_roots,
    null_basis,
    picked_columns,
    picked_rows,
    pivot_columns,
    primitive,
    row_basis,
    written_fraction,
    written_matrix,
    zeros_matrix,
)

#: Plants with more unknowns are decided in floating point.
MOST_EXACT_UNKNOWNS = 70
#: Plants with more unknowns are not reduced exactly, as the numbers grow: their fault polynomials come from pencils.
MOST_REDUCED = 24


def dc_point(dt: float) -> complex:
    """Return the point at which signals are constant."""
    return 1.0 + 0.0j if dt > 0.0 else 0.0j


def others(plant: DescriptorSystem, fault: int) -> tuple[int, ...]:
    """Return the columns of all faults but one."""
    return tuple(j for j in range(plant.nf) if j != fault)


@dataclass(frozen=True, eq=False)
class Removal:
    """What is left of a plant without its unknown inputs and a set of faults: the same for every other fault."""

    source: DescriptorSystem
    removed: tuple[int, ...]
    #: Of this plant, by the faults among the unknowns.
    pencils: dict[tuple[int, ...], ExactPencil] = field(default_factory=dict, repr=False)

    @cached_property
    def plant(self) -> DecoupledPlant:
        """The decoupled plant with all other faults."""
        return decoupled(self.source, self.removed, self.kept)

    @cached_property
    def kept(self) -> list[int]:
        """The other faults."""
        gone = set(self.removed)
        return [j for j in range(self.source.nf) if j not in gone]

    @cached_property
    def traces(self) -> tuple[FloatArray, FloatArray]:
        """Sizes ``(len(kept),)`` of the faults' columns before the reduction, and of what is left, relative to them."""
        sizes = np.maximum(self.plant.fault_sizes, np.finfo(np.float64).tiny)
        return sizes, np.linalg.norm(np.vstack([self.plant.F, self.plant.G]) / sizes, axis=0)

    @cached_property
    def residual_orders(self) -> dict[int, int]:
        """Least order of a scalar residual that shows a fault, of those that leave a trace."""
        plant, (sizes, traces) = self.plant, self.traces
        places = [place for place in range(len(self.kept)) if traces[place] > TRACE_TOLERANCE]
        if plant.order == 0 or not places:
            return {self.kept[place]: 0 for place in places}
        inverse = np.linalg.inv(plant.E * plant.time)
        units = (sizes * traces)[places]
        known = plant.signals
        found = residual_orders(
            inverse @ plant.A,
            plant.C,
            inverse @ plant.F[:, places] / units,
            plant.G[:, places] / units,
            inverse @ known[: plant.order],
            known[plant.order :],
        )
        return {self.kept[place]: order for place, order in zip(places, found, strict=True) if order is not None}

    def pencil(self, *more: int) -> ExactPencil:
        """Return the pencil of the unknowns, with more faults among them."""
        gone = tuple(sorted((*self.removed, *more)))
        if gone not in self.pencils:
            self.pencils[gone] = ExactPencil.written(*unknowns_pencil(self.source, gone))
        return self.pencils[gone]

    @cached_property
    def reduction(self) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat]:
        """Of the plant reduced over the rational numbers: dynamics, outputs, the columns of faults, u and y in both."""
        plant = self.source
        e, a = (written_matrix(part) for part in unknowns_pencil(plant, self.removed))
        known = np.block([[plant.B, np.zeros((plant.nx, plant.ny))], [plant.D, -np.eye(plant.ny)]])
        right = written_matrix(np.hstack([np.vstack([plant.Bf, plant.Df]), known]))
        return _reduced(e, a, right)[:4]


@dataclass(frozen=True, eq=False)
class Question:
    """A fault of a plant, with the faults ``removed`` and every unknown input out of sight, in floating point."""

    removal: Removal
    number: int
    #: Whether it is decided over the rational numbers.
    exactly: ClassVar[bool] = False

    @property
    def source(self) -> DescriptorSystem:
        """The plant."""
        return self.removal.source

    @property
    def removed(self) -> tuple[int, ...]:
        """The faults that are out of sight."""
        return self.removal.removed

    @cached_property
    def plant(self) -> DecoupledPlant:
        """The decoupled plant, in floating point."""
        whole, place = self.removal.plant, [self.removal.kept.index(self.number)]
        return replace(
            whole,
            F=whole.F[:, place],
            G=whole.G[:, place],
            fault_sizes=whole.fault_sizes[place],
            faults=(whole.faults[place[0]],),
        )

    @cached_property
    def _scaled(self) -> tuple[FloatArray, FloatArray]:
        size = max(float(self.plant.fault_sizes[0]), np.finfo(np.float64).tiny)
        return self.plant.F / size, self.plant.G / size

    @cached_property
    def trace(self) -> float:
        """Size of what is left of the column, relative to before the reduction."""
        return float(np.linalg.norm(np.vstack(self._scaled)))

    @property
    def leaves_trace(self) -> bool:
        """Whether the fault shows in floating point."""
        return self.trace > TRACE_TOLERANCE

    @property
    def visible(self) -> bool:
        """Whether the outputs show the fault at all, free of what was removed."""
        return self.leaves_trace

    def shows_at(self, point: complex) -> bool:
        """Whether a fault ``exp(point t)`` (or ``point^k``) leaves a trace that the rest cannot imitate."""
        if not self.leaves_trace:
            return False
        plant, column = self.plant, np.vstack(self._scaled)[:, 0] / self.trace
        basis = np.linalg.qr(np.vstack([plant.A - point * plant.E, plant.C]))[0]
        rest = column - basis @ (basis.conj().T @ column)
        return float(np.linalg.norm(rest - basis @ (basis.conj().T @ rest))) > TRACE_TOLERANCE

    @property
    def shows_at_rest(self) -> bool:
        """Whether a constant fault leaves a constant trace."""
        return self.visible and self.shows_at(dc_point(self.source.dt))

    @property
    def estimable(self) -> bool:
        """Whether the fault's value can be told whatever its course is."""
        return self.visible and not self.blocking.size

    @cached_property
    def _pencil(self) -> tuple[FloatArray, FloatArray]:
        f, g = self._scaled
        plant, trace = self.plant, max(self.trace, np.finfo(np.float64).tiny)
        a = np.block([[plant.A, f / trace], [plant.C, g / trace]])
        e = np.zeros_like(a)
        e[: plant.order, : plant.order] = plant.E * plant.time
        return e, a

    @cached_property
    def zeros(self) -> ComplexArray:
        """Roots of the fault polynomial, 1/s (or dimensionless), with multiplicity."""
        if not self.leaves_trace:
            return np.zeros(0, dtype=np.complex128)
        return np.asarray(finite_values(left_part(*self._pencil)) * self.plant.time)

    @cached_property
    def blocking(self) -> ComplexArray:
        """Those on or outside the boundary of stability: a fault that follows one of them stays hidden."""
        if not self.zeros.size:
            return self.zeros
        e, a = self._pencil
        # In discrete time the boundary is a number, not a direction: the unit of s must not move it.
        unit = self.plant.time if self.source.dt > 0.0 else 1.0
        found = FiniteZeros(self.zeros / (self.plant.time / unit), a.shape[1], ())
        return np.asarray(self.zeros[np.array(are_outside(e / unit, a, found, self.source.dt), dtype=bool)])

    @cached_property
    def order(self) -> int:
        """Order of the decoupled plant."""
        return self.plant.order

    @cached_property
    def derivatives(self) -> int | None:
        """Derivatives of y and u (samples of delay) that an estimate needs; ``None`` where the fault has no effect on
        them."""
        f, g = self._scaled
        return _order_at_infinity(self.plant, f / self.trace, g / self.trace) if self.leaves_trace else None

    @cached_property
    def residual_order(self) -> int | None:
        """Least order of a scalar residual that shows the fault; ``None`` where nothing does."""
        return self.removal.residual_orders.get(self.number)

    @property
    def gap(self) -> float:
        """How clear the least clear decision was: kept over dropped; infinite for exact ones."""
        ranks = float("inf") if self.plant.thinnest is None else self.plant.thinnest.gap
        if self.trace == 0.0:
            return ranks
        return min(ranks, self.trace / TRACE_TOLERANCE if self.leaves_trace else TRACE_TOLERANCE / self.trace)

    @property
    def clear(self) -> bool:
        """Whether the gap is wide enough to trust the answer without a second look."""
        return self.gap >= CLEAR_GAP


@dataclass(frozen=True, eq=False)
class ExactQuestion(Question):
    """The same over the rational numbers: no tolerance, so no gap.

    ``reduced``: on the plant without its unknown inputs; otherwise by the fault polynomial alone, and orders are those
    of floating point.
    """

    reduced: bool = True
    exactly = True

    @cached_property
    def _parts(self) -> tuple[fmpq_mat, ...]:
        """A, C, F, G, K, L of ``z+ = A z + F f + K [u; y]``, ``0 = C z + G f + L [u; y]`` with (A, C) observable, over
        the rationals."""
        a, c, right, outputs = self.removal.reduction
        nf = self.source.nf
        rest = range(nf, right.ncols())
        parts = (picked_columns(part, of) for of in ([self.number], rest) for part in (right, outputs))
        return a, c, *parts

    @cached_property
    def order(self) -> int:
        """Order of the decoupled plant."""
        return int(self._parts[0].nrows()) if self.reduced else super().order

    @cached_property
    def polynomial(self) -> fmpz_poly:
        """The fault polynomial, with coprime integer coefficients; zero where the fault has no effect on the
        outputs."""
        if not self.reduced:
            # The zeros that the fault adds to those of the pencil of the unknowns.
            without, whole = self.removal.pencil(), self.removal.pencil(self.number)
            if whole.normal_rank == without.normal_rank:
                return fmpz_poly([])
            return primitive(fmpq_poly(whole.zero_polynomial) / fmpq_poly(without.zero_polynomial))
        A, C, F, G, *_ = self._parts
        if _is_zero(F) and _is_zero(G):
            return fmpz_poly([])
        n, p = self.order, C.nrows()
        e = blocks([[identity(n), zeros_matrix(n, 1)], [zeros_matrix(p, n), zeros_matrix(p, 1)]])
        return primitive(_reduced(e, blocks([[A, F], [C, G]]), zeros_matrix(n + p, 0))[4])

    @property
    def visible(self) -> bool:
        """Whether the outputs show the fault at all."""
        return not self.polynomial.is_zero()

    @cached_property
    def _roots(self) -> tuple[Root, ...]:
        return locate_roots(self.polynomial, discrete=self.source.dt > 0.0)

    @cached_property
    def zeros(self) -> ComplexArray:
        """The zeros with multiplicity, 1/s (or dimensionless)."""
        return _values(self._roots)

    @cached_property
    def blocking(self) -> ComplexArray:
        """Those on or outside the boundary of stability."""
        return _values([root for root in self._roots if root.side != "stable"])

    def shows_at(self, point: complex) -> bool:
        """Whether the fault polynomial has no root at a point, whose parts are taken as they are written."""
        real, imaginary = written_fraction(complex(point).real), written_fraction(complex(point).imag)
        factor = [real * real + imaginary * imaginary, -2 * real, Fraction(1)] if imaginary else [-real, Fraction(1)]
        at = fmpq_poly([fmpq(value.numerator, value.denominator) for value in factor])
        return self.visible and not (fmpq_poly(self.polynomial) % at).is_zero()

    @property
    def gap(self) -> float:
        """Infinite: nothing was rounded."""
        return float("inf")

    @cached_property
    def derivatives(self) -> int | None:
        """Derivatives of y and u (samples of delay) that an estimate needs."""
        if not self.reduced or not self.visible:
            return None if self.reduced else super().derivatives
        (A, C, F, G, K, L), n = self._parts, self.order
        rows = blocks([[C, G, L]])
        for _ in range(n):
            new = left_null_basis(picked_columns(rows, range(n, rows.ncols()))) * picked_columns(rows, range(n))
            if new.rank() == 0:
                break
            more = blocks([[rows], [blocks([[new * A, new * F, new * K]])]])
            if more.rank() == rows.rank():
                break
            # Every pass adds rows that repeat others: only what they span counts.
            rows = more if more.nrows() <= more.ncols() else row_basis(more)
        c, direct, vector, order = picked_columns(rows, range(n)), picked_columns(rows, [n]), F, 0
        while _is_zero(direct) and order <= n:
            direct, vector = c * vector, A * vector
            order += 1
        return order

    @cached_property
    def residual_order(self) -> int | None:
        """Least order of a scalar residual that shows the fault."""
        if not self.reduced:
            return super().residual_order
        return exact_residual_order(*self._parts) if self.visible else None


def decided_exactly(plant: DescriptorSystem) -> bool:
    """Whether a plant is small enough, and made of numbers as they were written."""
    matrices = (plant.E, plant.A, plant.C, plant.Bd, plant.Dd, plant.Bf, plant.Df)
    return plant.nx + plant.nd + plant.nf <= MOST_EXACT_UNKNOWNS and not any(map(holds_computed, matrices))


def question(plant: DescriptorSystem, removed: Sequence[int], number: int, exactly: bool | None = None) -> Question:
    """Return a question about a fault; exact (unless it is said) where the plant is decided exactly."""
    return Questions(plant, decided_exactly(plant) if exactly is None else exactly).of(removed, number)


@dataclass(frozen=True, eq=False)
class Questions:
    """Questions about the faults of one plant: what several of them rest on is computed once."""

    source: DescriptorSystem
    exactly: bool
    _removals: dict[tuple[int, ...], Removal] = field(default_factory=dict, repr=False)
    _pencils: dict[tuple[int, ...], ExactPencil] = field(default_factory=dict, repr=False)
    _asked: dict[tuple[tuple[int, ...], int], Question] = field(default_factory=dict, repr=False)

    def of(self, removed: Sequence[int], number: int) -> Question:
        """Return the question about a fault, with others removed."""
        gone = tuple(sorted(removed))
        if (gone, number) not in self._asked:
            if gone not in self._removals:
                self._removals[gone] = Removal(self.source, gone, self._pencils)
            removal, small = self._removals[gone], self.source.nx + self.source.ny <= MOST_REDUCED
            exact = ExactQuestion(removal, number, small) if self.exactly else None
            self._asked[gone, number] = exact or Question(removal, number)
        return self._asked[gone, number]


def _order_at_infinity(plant: DecoupledPlant, f: FloatArray, g: FloatArray) -> int:
    """Return the derivatives needed; rows without y, u are exact, and differentiating those costs nothing."""
    n = plant.order
    if n == 0:
        return 0
    inverse = np.linalg.inv(plant.E * plant.time)
    a, f, known = inverse @ plant.A, inverse @ f, inverse @ plant.signals[:n]
    rows = np.hstack([plant.C, g, plant.signals[n:]])
    independent = _rank(rows)
    for _ in range(n):
        full = np.linalg.norm(rows, 2)
        left, values, _ = np.linalg.svd(rows[:, n:])
        rank = rank_from(values, expected=len(rows), scale=float(full)).rank
        new = left[:, rank:].T @ rows[:, :n]
        if not new.size or np.linalg.norm(new) <= MARKOV_TOLERANCE * full:
            break
        rows = _compressed(np.vstack([rows, np.hstack([new @ a, new @ f, new @ known])]))
        before, independent = independent, _rank(rows)
        if independent == before:
            break
    c, direct, vector, order = rows[:, :n], rows[:, n : n + 1], f, 0
    size = max(float(np.linalg.norm(direct)), float(np.linalg.norm(c, 2) * np.linalg.norm(vector)))
    while np.linalg.norm(direct) <= MARKOV_TOLERANCE * size and order <= n:
        direct = c @ vector
        size = float(np.linalg.norm(c, 2) * np.linalg.norm(vector))
        vector = a @ vector
        order += 1
    return order


def _compressed(rows: FloatArray) -> FloatArray:
    """Return no more rows than columns, with the same singular values: a triangle of them where they are many."""
    return np.asarray(np.linalg.qr(rows, mode="r")) if rows.shape[0] > rows.shape[1] else rows


def _rank(matrix: FloatArray) -> int:
    values = np.linalg.svd(matrix, compute_uv=False)
    return rank_from(np.asarray(values), expected=min(matrix.shape), tolerance=RANK_TOLERANCE).rank


def _reduced(e: fmpq_mat, a: fmpq_mat, right: fmpq_mat) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat, fmpq_poly]:
    """Return A, C, the columns ``right`` beside both, and the polynomial of the finite zeros that were taken out."""
    while True:
        kernel = null_basis(e)
        if kernel.ncols() == 0:
            break
        kept = pivot_columns(e)
        rest = left_null_basis(a * kernel)
        e, a, right = rest * picked_columns(e, kept), rest * picked_columns(a, kept), rest * right
    rows = pivot_columns(e.transpose())
    free = left_null_basis(e)
    top, c, outputs = picked_rows(e, rows), free * a, free * right
    if not rows:
        return zeros_matrix(0, 0), zeros_matrix(c.nrows(), 0), zeros_matrix(0, right.ncols()), outputs, fmpq_poly([1])
    whole = top.solve(blocks([[picked_rows(a, rows), picked_rows(right, rows)]]))
    n = len(rows)
    a, right = picked_columns(whole, range(n)), picked_columns(whole, range(n, whole.ncols()))
    seen = row_basis(c)
    while True:
        more = row_basis(blocks([[seen], [seen * a]]))
        if more.nrows() == seen.nrows():
            break
        seen = more
    if seen.nrows() == n:
        return a, c, right, outputs, fmpq_poly([1])
    pivots = pivot_columns(seen)
    kept_a = picked_columns(seen * a, pivots)
    zeros = a.charpoly() / kept_a.charpoly() if pivots else a.charpoly()
    return kept_a, picked_columns(c, pivots), seen * right, outputs, fmpq_poly(zeros)


def _is_zero(matrix: fmpq_mat) -> bool:
    return all(value == 0 for value in matrix.entries())


def _values(roots: Sequence[Root]) -> ComplexArray:
    listed = [root.value for root in roots for _ in range(root.multiplicity)]
    return np.array(listed, dtype=np.complex128)


def exact_residual_order(A: fmpq_mat, C: fmpq_mat, F: fmpq_mat, G: fmpq_mat, K: fmpq_mat, L: fmpq_mat) -> int | None:
    """Return the least order for one fault, over the rational numbers; ``None`` where no equation shows it."""
    n, known, free = A.nrows(), K.ncols(), -1
    # Rows [w | z | f, f', ...] in echelon form: those without w come last, then those without z.
    rows = blocks([[L, C, G]])
    while True:
        # Equations of the fault alone, which a plant that is not regular may have.
        if _from_column(rows, known + n).nrows():
            return 0
        rows = _kept(rows, known + n)
        without = _from_column(rows, known)
        if without.nrows() <= free:
            break
        free = without.nrows()
        z, f = _split(without, known, n)
        rows = blocks([[rows, zeros_matrix(rows.nrows(), 1)], [z * K, z * A, z * F, f]])
    equations = picked_columns(rows, range(known, rows.ncols()))
    base = equations
    for order in range(n + 1):
        if _from_column(equations, n).nrows():
            return order
        z, f = _split(_kept(equations, n), 0, n)
        if not z.nrows():
            break
        equations = blocks([[z * A, z * F, f]])
        padding = zeros_matrix(base.nrows(), equations.ncols() - base.ncols())
        equations = blocks([[base, padding], [equations]])
    return None


def _split(rows: fmpq_mat, known: int, n: int) -> tuple[fmpq_mat, fmpq_mat]:
    return picked_columns(rows, range(known, known + n)), picked_columns(rows, range(known + n, rows.ncols()))


def _echelon(rows: fmpq_mat) -> list[list[fmpq]]:
    reduced, rank = rows.rref()
    return reduced.tolist()[:rank]


def _kept(rows: fmpq_mat, columns: int) -> fmpq_mat:
    """Return independent combinations of rows whose first columns are independent; what has none of them goes."""
    listed = [row for row in _echelon(rows) if any(value != 0 for value in row[:columns])]
    return fmpq_mat(len(listed), rows.ncols(), [value for row in listed for value in row])


def _from_column(rows: fmpq_mat, columns: int) -> fmpq_mat:
    """Return independent combinations of rows that are zero in the first columns."""
    listed = list(dropwhile(lambda row: any(value != 0 for value in row[:columns]), _echelon(rows)))
    return fmpq_mat(len(listed), rows.ncols(), [value for row in listed for value in row])


class _Rows(NamedTuple):
    """Equations ``0 = z_rows z + sum_k f_rows[:, k] s^k f``, one column of `f` for each fault."""

    z: FloatArray  # ``(r, n)``
    f: FloatArray  # ``(r, degree + 1, count)``

    def joined(self, more: _Rows) -> _Rows:
        degree = max(self.f.shape[1], more.f.shape[1])
        f = [np.pad(part.f, ((0, 0), (0, degree - part.f.shape[1]), (0, 0))) for part in (self, more)]
        return _Rows(np.vstack([self.z, more.z]), np.concatenate(f))

    def differentiated(self, A: FloatArray, F: FloatArray) -> _Rows:
        return _Rows(self.z @ A, np.concatenate([(self.z @ F)[:, None], self.f], axis=1))

    def combined(self, factors: FloatArray) -> _Rows:
        return _Rows(factors @ self.z, np.tensordot(factors, self.f, axes=1))


def residual_orders(
    A: FloatArray, C: FloatArray, F: FloatArray, G: FloatArray, K: FloatArray, L: FloatArray
) -> list[int | None]:
    """Return the least order for each fault, in floating point; ``None`` where no equation shows it.

    The columns of ``[F; G]`` and of ``[K; L]`` have entries near one, as A and C; rows of zeros are equations as well.
    """
    n, count = A.shape[0], F.shape[1]
    basis, (new, alone) = _Rows(np.zeros((0, n)), np.zeros((0, 1, count))), _of_degree_zero(A, C, F, G, K, L)
    found: list[int | None] = [0 if is_alone else None for is_alone in alone.tolist()]
    scale = largest_singular_value(C)
    for order in range(n + 1):
        new, hidden, terms = _beside(basis, new, scale)
        shown = _shown(hidden, terms)
        found = [order if seen and one is None else one for one, seen in zip(found, shown.tolist(), strict=True)]
        if not len(new.z) or all(one is not None for one in found):
            break
        basis, new, scale = basis.joined(new), new.differentiated(A, F), largest_singular_value(A)
    return found


def _shown(hidden: FloatArray, terms: FloatArray) -> NDArray[np.bool_]:
    """Return which faults stand in equations, of which these are the fault parts and the sizes of their terms."""
    return np.asarray(np.any(np.linalg.norm(hidden, axis=1) > TRACE_TOLERANCE * np.maximum(terms, 1.0), axis=0))


def _of_degree_zero(
    A: FloatArray, C: FloatArray, F: FloatArray, G: FloatArray, K: FloatArray, L: FloatArray
) -> tuple[_Rows, NDArray[np.bool_]]:
    """Return the equations in which no derivative of w stands, and which faults have equations without z and w, as a
    plant that is not regular may have them."""
    n, count = A.shape[0], F.shape[1]
    alone = np.zeros(count, dtype=bool)
    rows, w = _Rows(C, G[:, None]), L
    free = _Rows(np.zeros((0, n)), np.zeros((0, 1, count)))
    size = max(largest_singular_value(L), largest_singular_value(K))
    scale = largest_singular_value(C)
    for _ in range(n + 1):
        left, values, _ = full_svd(w)
        rank = int(np.count_nonzero(values > RANK_TOLERANCE * size))
        new, hidden, terms = _beside(free, rows.combined(left[:, rank:].T), scale)
        alone |= _shown(hidden, terms)
        rows, w = rows.combined(left[:, :rank].T), left[:, :rank].T @ w
        if not len(new.z):
            break
        # Their derivatives hold no derivative of w: they are of degree 0 as well.
        free, scale = free.joined(new), max(scale, largest_singular_value(A))
        rows, w = rows.joined(new.differentiated(A, F)), np.vstack([w, new.z @ K])
    return rows.joined(free), alone


def _beside(basis: _Rows, rows: _Rows, scale: float) -> tuple[_Rows, FloatArray, FloatArray]:
    """Return what rows add to an orthonormal basis, orthonormal; fault parts of what adds nothing, and their terms."""
    z, f = rows
    terms = np.linalg.norm(f, axis=(0, 1))
    for _ in range(2):
        share = z @ basis.z.T
        taken = _Rows(z, f).joined(basis.combined(-share))
        z, f = taken.z[: len(z)] + taken.z[len(z) :], taken.f[: len(z)] + taken.f[len(z) :]
        terms = terms + np.linalg.norm(np.tensordot(np.abs(share), np.abs(basis.f), axes=1), axis=(0, 1))
    left, values, right = np.linalg.svd(z, full_matrices=len(z) > z.shape[1])
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * scale))
    new = _Rows(right[:rank], np.tensordot(left[:, :rank].T / values[:rank, None], f, axes=1))
    return new, np.tensordot(left[:, rank:].T, f, axes=1), np.asarray(terms)
