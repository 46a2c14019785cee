"""The same questions decided exactly, for plants whose numbers are as somebody wrote them.

The reduction of `obsynth.analysis.diagnosis.reduction` over the rational numbers: no tolerance, so no gap.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
from flint import fmpq, fmpq_mat, fmpq_poly, fmpz_poly

from obsynth.analysis.diagnosis.decoupled import unknowns_pencil
from obsynth.numerics.arrays import ComplexArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_matrices import (
    blocks,
    computed_entries,
    identity,
    null_basis,
    pivot_columns,
    written_fraction,
    written_matrix,
    zeros_matrix,
)
from obsynth.proofs.exact_pencils import ExactPencil
from obsynth.proofs.root_location import Root, RootLocation, locate_roots, primitive

#: Plants with more unknowns are decided in floating point.
MOST_UNKNOWNS = 70
#: Plants with more unknowns are not reduced exactly, as the numbers grow: their fault polynomials come from pencils.
MOST_REDUCED = 24


def can_be_exact(plant: DescriptorSystem) -> bool:
    """Whether a plant is small enough, and made of numbers as they were written."""
    matrices = (plant.E, plant.A, plant.C, plant.Bd, plant.Dd, plant.Bf, plant.Df)
    return plant.nx + plant.nd + plant.nf <= MOST_UNKNOWNS and not any(map(computed_entries, matrices))


class ExactZeros(ABC):
    """What follows from a fault polynomial."""

    @property
    @abstractmethod
    def polynomial(self) -> fmpz_poly:
        """The fault polynomial, with coprime integer coefficients; zero where nothing shows the fault."""

    @property
    @abstractmethod
    def discrete(self) -> bool:
        """Whether time is discrete."""

    @property
    def visible(self) -> bool:
        """Whether the outputs show the fault at all."""
        return not self.polynomial.is_zero()

    @cached_property
    def location(self) -> RootLocation:
        """The zeros and where they are."""
        return locate_roots(self.polynomial, discrete=self.discrete)

    @property
    def zeros(self) -> ComplexArray:
        """The zeros with multiplicity, 1/s (or dimensionless)."""
        return _values(self.location.roots)

    @property
    def blocking(self) -> ComplexArray:
        """Those on or outside the boundary of stability."""
        return _values(self.location.outside)

    def shows_at(self, point: complex) -> bool:
        """Whether the fault polynomial has no root at a point, whose parts are taken as they are written."""
        real, imaginary = written_fraction(complex(point).real), written_fraction(complex(point).imag)
        if imaginary == 0:
            at = fmpq_poly([_rational(-real), 1])
        else:
            at = fmpq_poly([_rational(real * real + imaginary * imaginary), _rational(-2 * real), 1])
        return self.visible and not (fmpq_poly(self.polynomial) % at).is_zero()


@dataclass(frozen=True, eq=False)
class PencilColumn(ExactZeros):
    """One fault by its polynomial alone: the zeros that it adds to those of the pencil of the unknowns."""

    source: DescriptorSystem
    removed: tuple[int, ...]
    number: int

    @property
    def discrete(self) -> bool:
        """Whether time is discrete."""
        return self.source.dt > 0.0

    @cached_property
    def polynomial(self) -> fmpz_poly:
        """The fault polynomial."""
        without = ExactPencil.written(*unknowns_pencil(self.source, self.removed))
        whole = ExactPencil.written(*unknowns_pencil(self.source, (*self.removed, self.number)))
        if whole.normal_rank == without.normal_rank:
            return fmpz_poly([])
        return primitive(fmpq_poly(whole.zero_polynomial) / fmpq_poly(without.zero_polynomial))


@dataclass(frozen=True, eq=False)
class ExactDecoupled:
    """``z+ = A z + F f + K [u; y]``, ``0 = C z + G f + L [u; y]`` with (A, C) observable, over the rationals."""

    A: fmpq_mat
    C: fmpq_mat
    F: fmpq_mat
    G: fmpq_mat
    K: fmpq_mat
    L: fmpq_mat
    discrete: bool

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.A.nrows())

    def column(self, number: int) -> ExactColumn:
        """Return what is known of one fault."""
        return ExactColumn(self, _columns(self.F, [number]), _columns(self.G, [number]))


def exact_decoupled(plant: DescriptorSystem, removed: Sequence[int], kept: Sequence[int]) -> ExactDecoupled:
    """Remove the unknown inputs and the faults ``removed`` exactly; keep the columns ``kept``."""
    e, a = (written_matrix(part) for part in unknowns_pencil(plant, removed))
    known = np.block([[plant.B, np.zeros((plant.nx, plant.ny))], [plant.D, -np.eye(plant.ny)]])
    faults = np.vstack([plant.Bf, plant.Df])[:, list(kept)]
    a, c, right, outputs, _ = _reduced(e, a, written_matrix(np.hstack([faults, known])))
    f = list(range(len(kept)))
    rest = list(range(len(kept), right.ncols()))
    return ExactDecoupled(
        a, c, _columns(right, f), _columns(outputs, f), _columns(right, rest), _columns(outputs, rest), plant.dt > 0.0
    )


@dataclass(frozen=True, eq=False)
class ExactColumn(ExactZeros):
    """One fault on an exactly decoupled plant."""

    plant: ExactDecoupled
    F: fmpq_mat
    G: fmpq_mat

    @property
    def discrete(self) -> bool:
        """Whether time is discrete."""
        return self.plant.discrete

    @cached_property
    def polynomial(self) -> fmpz_poly:
        """The fault polynomial, with coprime integer coefficients."""
        if all(value == 0 for value in (*self.F.entries(), *self.G.entries())):
            return fmpz_poly([])
        plant = self.plant
        n, p = plant.order, plant.C.nrows()
        e = blocks([[identity(n), zeros_matrix(n, 1)], [zeros_matrix(p, n), zeros_matrix(p, 1)]])
        a = blocks([[plant.A, self.F], [plant.C, self.G]])
        return primitive(_reduced(e, a, zeros_matrix(n + p, 0))[4])

    @cached_property
    def derivatives(self) -> int | None:
        """Derivatives of y and u (samples of delay) that an estimate needs."""
        if not self.visible:
            return None
        plant, n = self.plant, self.plant.order
        rows = _beside(plant.C, self.G, plant.L)
        for _ in range(n):
            free = null_basis(_columns(rows, range(n, rows.ncols())).transpose()).transpose()
            new = free * _columns(rows, range(n))
            if new.rank() == 0:
                break
            more = _stacked(rows, _beside(new * plant.A, new * self.F, new * plant.K))
            if more.rank() == rows.rank():
                break
            rows = more
        c, direct, vector, order = _columns(rows, range(n)), _columns(rows, [n]), self.F, 0
        while all(value == 0 for value in direct.entries()) and order <= n:
            direct, vector = c * vector, plant.A * vector
            order += 1
        return order

    @cached_property
    def residual_order(self) -> int | None:
        """Least order of a scalar residual that shows the fault."""
        plant = self.plant
        powers, markov = [plant.C], [self.G]
        for order in range(plant.order + 1) if self.visible else ():
            observed = powers[0]
            for part in powers[1:]:
                observed = _stacked(observed, part)
            parity = null_basis(observed.transpose()).transpose()
            p, zero = plant.C.nrows(), zeros_matrix(plant.C.nrows(), 1)
            toeplitz = blocks([[markov[i - j] if j <= i else zero for j in range(order + 1)] for i in range(order + 1)])
            if p and any(value != 0 for value in (parity * toeplitz).entries()):
                return order
            markov.append(powers[-1] * self.F)
            powers.append(powers[-1] * plant.A)
        return None


def _reduced(e: fmpq_mat, a: fmpq_mat, right: fmpq_mat) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat, fmpq_poly]:
    """Return A, C, the columns ``right`` beside both, and the polynomial of the finite zeros that were taken out."""
    while True:
        kernel = null_basis(e)
        if kernel.ncols() == 0:
            break
        kept = pivot_columns(e)
        rest = null_basis((a * kernel).transpose()).transpose()
        e, a, right = rest * _columns(e, kept), rest * _columns(a, kept), rest * right
    rows = pivot_columns(e.transpose())
    free = null_basis(e.transpose()).transpose()
    top, c, outputs = _rows(e, rows), free * a, free * right
    if not rows:
        return zeros_matrix(0, 0), zeros_matrix(c.nrows(), 0), zeros_matrix(0, right.ncols()), outputs, fmpq_poly([1])
    whole = top.solve(_beside(_rows(a, rows), _rows(right, rows)))
    n = len(rows)
    a, right = _columns(whole, range(n)), _columns(whole, range(n, whole.ncols()))
    seen = _row_space(c)
    while True:
        more = _row_space(_stacked(seen, seen * a))
        if more.nrows() == seen.nrows():
            break
        seen = more
    if seen.nrows() == n:
        return a, c, right, outputs, fmpq_poly([1])
    pivots = pivot_columns(seen)
    kept_a = _columns(seen * a, pivots)
    zeros = a.charpoly() / kept_a.charpoly() if pivots else a.charpoly()
    return kept_a, _columns(c, pivots), seen * right, outputs, fmpq_poly(zeros)


def _row_space(matrix: fmpq_mat) -> fmpq_mat:
    reduced, rank = matrix.rref()
    return _rows(reduced, range(rank))


def _columns(matrix: fmpq_mat, columns: Sequence[int]) -> fmpq_mat:
    return fmpq_mat(matrix.nrows(), len(columns), [matrix[i, j] for i in range(matrix.nrows()) for j in columns])


def _rows(matrix: fmpq_mat, rows: Sequence[int]) -> fmpq_mat:
    return fmpq_mat(len(rows), matrix.ncols(), [matrix[i, j] for i in rows for j in range(matrix.ncols())])


def _beside(*parts: fmpq_mat) -> fmpq_mat:
    return blocks([list(parts)])


def _stacked(*parts: fmpq_mat) -> fmpq_mat:
    return blocks([[part] for part in parts])


def _values(roots: Sequence[Root]) -> ComplexArray:
    listed = [root.value for root in roots for _ in range(root.multiplicity)]
    return np.array(listed, dtype=np.complex128)


def _rational(value: Fraction) -> fmpq:
    return fmpq(value.numerator, value.denominator)
