"""The same questions decided exactly, for plants whose numbers are as somebody wrote them.

The reduction of `obsynth.analysis.diagnosis.reduction` over the rational numbers: no tolerance, so no gap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property

import numpy as np
from flint import fmpq, fmpq_mat, fmpq_poly, fmpz_poly

from obsynth.analysis.diagnosis.decoupled import unknowns_pencil
from obsynth.analysis.diagnosis.fault_columns import Question, Removal
from obsynth.analysis.diagnosis.residual_orders import exact_residual_order
from obsynth.numerics.arrays import ComplexArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_arithmetic import (
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
from obsynth.proofs.exact_pencils import ExactPencil

#: Plants with more unknowns are decided in floating point.
MOST_EXACT_UNKNOWNS = 70
#: Plants with more unknowns are not reduced exactly, as the numbers grow: their fault polynomials come from pencils.
MOST_REDUCED = 24


def decided_exactly(plant: DescriptorSystem) -> bool:
    """Whether a plant is small enough, and made of numbers as they were written."""
    matrices = (plant.E, plant.A, plant.C, plant.Bd, plant.Dd, plant.Bf, plant.Df)
    return plant.nx + plant.nd + plant.nf <= MOST_EXACT_UNKNOWNS and not any(map(holds_computed, matrices))


def question(plant: DescriptorSystem, removed: Sequence[int], number: int, exactly: bool | None = None) -> Question:
    """Return a question about a fault; exact (unless it is said) where the plant is decided exactly."""
    return Questions(plant, decided_exactly(plant) if exactly is None else exactly).of(removed, number)


@dataclass(frozen=True, eq=False)
class ExactRemoval(Removal):
    """What is left of a plant without its unknown inputs and a set of faults, over the rational numbers as well."""

    pencils: dict[tuple[int, ...], ExactPencil] = field(default_factory=dict, repr=False)

    def pencil(self, *more: int) -> ExactPencil:
        """Return the pencil of the unknowns, with more faults among them."""
        gone = tuple(sorted((*self.removed, *more)))
        if gone not in self.pencils:
            self.pencils[gone] = ExactPencil.written(*unknowns_pencil(self.source, gone))
        return self.pencils[gone]

    @cached_property
    def reduction(self) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat]:
        """The reduced plant: dynamics, outputs, and the columns of every fault, then of u and y, beside both."""
        plant = self.source
        e, a = (written_matrix(part) for part in unknowns_pencil(plant, self.removed))
        known = np.block([[plant.B, np.zeros((plant.nx, plant.ny))], [plant.D, -np.eye(plant.ny)]])
        right = written_matrix(np.hstack([np.vstack([plant.Bf, plant.Df]), known]))
        return _reduced(e, a, right)[:4]


@dataclass(frozen=True, eq=False)
class Questions:
    """Questions about the faults of one plant: what several of them rest on is computed once."""

    source: DescriptorSystem
    exactly: bool
    _removals: dict[tuple[int, ...], ExactRemoval] = field(default_factory=dict, repr=False)
    _pencils: dict[tuple[int, ...], ExactPencil] = field(default_factory=dict, repr=False)
    _asked: dict[tuple[tuple[int, ...], int], Question] = field(default_factory=dict, repr=False)

    def of(self, removed: Sequence[int], number: int) -> Question:
        """Return the question about a fault, with others removed."""
        gone = tuple(sorted(removed))
        if (gone, number) not in self._asked:
            if gone not in self._removals:
                self._removals[gone] = ExactRemoval(self.source, gone, pencils=self._pencils)
            small = self.source.nx + self.source.ny <= MOST_REDUCED
            kind = Question if not self.exactly else ReducedQuestion if small else ExactQuestion
            self._asked[gone, number] = kind(self.source, gone, number, self._removals[gone])
        return self._asked[gone, number]


class ExactQuestion(Question):
    """A fault by its polynomial alone: the zeros that it adds to those of the pencil of the unknowns."""

    exactly = True

    @cached_property
    def _exact_removal(self) -> ExactRemoval:
        shared = self.shared
        return shared if isinstance(shared, ExactRemoval) else ExactRemoval(self.source, self.removed)

    @cached_property
    def polynomial(self) -> fmpz_poly:
        """The fault polynomial, with coprime integer coefficients; zero where the fault has no effect on the
        outputs."""
        without, whole = self._exact_removal.pencil(), self._exact_removal.pencil(self.number)
        if whole.normal_rank == without.normal_rank:
            return fmpz_poly([])
        return primitive(fmpq_poly(whole.zero_polynomial) / fmpq_poly(without.zero_polynomial))

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


class ReducedQuestion(ExactQuestion):
    """A fault on the plant without its unknown inputs, which is reduced exactly."""

    @cached_property
    def _parts(self) -> tuple[fmpq_mat, ...]:
        """A, C, F, G, K, L of ``z+ = A z + F f + K [u; y]``, ``0 = C z + G f + L [u; y]`` with (A, C) observable, over
        the rationals."""
        a, c, right, outputs = self._exact_removal.reduction
        nf = self.source.nf
        rest = range(nf, right.ncols())
        parts = (picked_columns(part, of) for of in ([self.number], rest) for part in (right, outputs))
        return a, c, *parts

    @cached_property
    def order(self) -> int:
        """Order of the decoupled plant."""
        return int(self._parts[0].nrows())

    @cached_property
    def polynomial(self) -> fmpz_poly:
        """The fault polynomial, with coprime integer coefficients."""
        A, C, F, G, *_ = self._parts
        if _is_zero(F) and _is_zero(G):
            return fmpz_poly([])
        n, p = self.order, C.nrows()
        e = blocks([[identity(n), zeros_matrix(n, 1)], [zeros_matrix(p, n), zeros_matrix(p, 1)]])
        return primitive(_reduced(e, blocks([[A, F], [C, G]]), zeros_matrix(n + p, 0))[4])

    @cached_property
    def derivatives(self) -> int | None:
        """Derivatives of y and u (samples of delay) that an estimate needs."""
        if not self.visible:
            return None
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
        return exact_residual_order(*self._parts) if self.visible else None


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
