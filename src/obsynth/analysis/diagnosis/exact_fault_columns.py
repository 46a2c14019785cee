"""Detectability of faults in rational arithmetic, for plants with stated numbers.

The decisions of `obsynth.analysis.diagnosis.fault_columns` over the rational numbers: no tolerance, so no gap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property

import numpy as np
from flint import fmpq, fmpq_mat, fmpq_poly, fmpz_poly

from obsynth.analysis.diagnosis.fault_columns import DecoupledFault, Removal, reduced_values
from obsynth.analysis.diagnosis.residual_orders import exact_residual_order
from obsynth.numerics.arrays import ComplexArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_doubles import holds_computed, written_fraction
from obsynth.proofs.exact_pencils import ExactPencil
from obsynth.proofs.polynomial_roots import Root, locate_roots, primitive
from obsynth.proofs.rational_matrices import (
    blocks,
    identity,
    left_null_basis,
    picked_columns,
    row_basis,
    zeros_matrix,
)

#: Plants with more unknowns are not reduced exactly, as the numbers grow: their fault polynomials come from pencils.
MOST_REDUCED = 24

#: Plants with more unknowns are decided in floating point.
MOST_EXACT_UNKNOWNS = 70


@dataclass(frozen=True, eq=False)
class ExactDecoupledFault(DecoupledFault):
    """A fault, with others out of sight, over the rational numbers: no tolerance, so no gap.

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
        known_columns = range(nf, right.ncols())
        groups = ([self.number], known_columns)
        parts = (picked_columns(part, columns) for columns in groups for part in (right, outputs))
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
            without, with_fault = self.removal.pencil(), self.removal.pencil(self.number)
            if with_fault.normal_rank == without.normal_rank:
                return fmpz_poly([])
            return primitive(fmpq_poly(with_fault.zero_polynomial) / fmpq_poly(without.zero_polynomial))
        A, C, F, G, *_ = self._parts
        if _is_zero(F) and _is_zero(G):
            return fmpz_poly([])
        n, p = self.order, C.nrows()
        e = blocks([[identity(n), zeros_matrix(n, 1)], [zeros_matrix(p, n), zeros_matrix(p, 1)]])
        return primitive(reduced_values(e, blocks([[A, F], [C, G]]), zeros_matrix(n + p, 0))[4])

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
    """Whether a plant is small enough to be decided over the rational numbers, and its numbers are as written."""
    matrices = (plant.E, plant.A, plant.C, plant.Bd, plant.Dd, plant.Bf, plant.Df)
    return plant.nx + plant.nd + plant.nf <= MOST_EXACT_UNKNOWNS and not any(map(holds_computed, matrices))


def decoupled_fault(
    plant: DescriptorSystem, removed: Sequence[int], number: int, exactly: bool | None = None
) -> DecoupledFault:
    """Return a fault with others removed; ``exactly``: over the rational numbers, by default where that is possible."""
    return DecoupledFaults(plant, decided_exactly(plant) if exactly is None else exactly).of(removed, number)


@dataclass(frozen=True, eq=False)
class DecoupledFaults:
    """The faults of one plant; reductions that several of them share are computed once."""

    source: DescriptorSystem
    exactly: bool
    _removals: dict[tuple[int, ...], Removal] = field(default_factory=dict, repr=False)
    _pencils: dict[tuple[int, ...], ExactPencil] = field(default_factory=dict, repr=False)
    _faults: dict[tuple[tuple[int, ...], int], DecoupledFault] = field(default_factory=dict, repr=False)

    def of(self, removed: Sequence[int], number: int) -> DecoupledFault:
        """Return a fault, with others removed."""
        removed_faults = tuple(sorted(removed))
        if (removed_faults, number) not in self._faults:
            if removed_faults not in self._removals:
                self._removals[removed_faults] = Removal(self.source, removed_faults, self._pencils)
            removal, small = self._removals[removed_faults], self.source.nx + self.source.ny <= MOST_REDUCED
            exact = ExactDecoupledFault(removal, number, small) if self.exactly else None
            self._faults[removed_faults, number] = exact or DecoupledFault(removal, number)
        return self._faults[removed_faults, number]


def _is_zero(matrix: fmpq_mat) -> bool:
    return all(value == 0 for value in matrix.entries())


def _values(roots: Sequence[Root]) -> ComplexArray:
    listed = [root.value for root in roots for _ in range(root.multiplicity)]
    return np.array(listed, dtype=np.complex128)
