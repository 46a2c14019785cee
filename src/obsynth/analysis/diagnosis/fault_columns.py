"""One fault of a decoupled plant: whether it is visible, its blocking zeros, and the order of its estimate.

With N a minimal polynomial basis of the left null space of the unknowns' pencil, the zeros of the fault are those of
the greatest common divisor of ``g = N [bf; df]``; decoupled: where ``[F; G]`` lies in the range of ``[A - sE; C]``.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from flint import fmpq_mat, fmpq_poly

from obsynth.analysis.diagnosis.decoupled import DecoupledPlant, decoupled, unknowns_pencil
from obsynth.analysis.diagnosis.residual_orders import residual_orders
from obsynth.analysis.diagnosis.without_unknown_inputs import finite_values, left_part
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.invariant_zeros import are_outside
from obsynth.numerics.pencils import FiniteZeros
from obsynth.numerics.ranks import CLEAR_GAP, MARKOV_TOLERANCE, RANK_TOLERANCE, TRACE_TOLERANCE, rank_from
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_doubles import written_matrix
from obsynth.proofs.exact_pencils import ExactPencil
from obsynth.proofs.rational_matrices import (
    blocks,
    left_null_basis,
    null_basis,
    picked_columns,
    picked_rows,
    pivot_columns,
    row_basis,
    zeros_matrix,
)


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
        return decoupled(self.source, self.removed, self.estimated)

    @cached_property
    def estimated(self) -> list[int]:
        """The other faults."""
        gone = set(self.removed)
        return [j for j in range(self.source.nf) if j not in gone]

    @cached_property
    def traces(self) -> tuple[FloatArray, FloatArray]:
        """Sizes of the columns of the ``estimated`` faults before the reduction, and what is left, relative to them."""
        sizes = np.maximum(self.plant.fault_sizes, np.finfo(np.float64).tiny)
        return sizes, np.linalg.norm(np.vstack([self.plant.F, self.plant.G]) / sizes, axis=0)

    @cached_property
    def residual_orders(self) -> dict[int, int]:
        """Least order of a scalar residual that shows a fault, of those that leave a trace."""
        plant, (sizes, traces) = self.plant, self.traces
        places = [place for place in range(len(self.estimated)) if traces[place] > TRACE_TOLERANCE]
        if plant.order == 0 or not places:
            return {self.estimated[place]: 0 for place in places}
        inverse = np.linalg.inv(plant.E * plant.time)
        units = (sizes * traces)[places]
        known = plant.signals
        orders = residual_orders(
            inverse @ plant.A,
            plant.C,
            inverse @ plant.F[:, places] / units,
            plant.G[:, places] / units,
            inverse @ known[: plant.order],
            known[plant.order :],
        )
        return {self.estimated[place]: order for place, order in zip(places, orders, strict=True) if order is not None}

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
        return reduced_values(e, a, right)[:4]


@dataclass(frozen=True, eq=False)
class DecoupledFault:
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
        reduced, place = self.removal.plant, [self.removal.estimated.index(self.number)]
        return replace(
            reduced,
            F=reduced.F[:, place],
            G=reduced.G[:, place],
            fault_sizes=reduced.fault_sizes[place],
            faults=(reduced.faults[place[0]],),
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
        remainder = column - basis @ (basis.conj().T @ column)
        return float(np.linalg.norm(remainder - basis @ (basis.conj().T @ remainder))) > TRACE_TOLERANCE

    @property
    def shows_at_rest(self) -> bool:
        """Whether a constant fault leaves a constant trace."""
        return self.visible and self.shows_at(dc_point(self.source.dt))

    @property
    def estimable(self) -> bool:
        """Whether the fault's value can be estimated whatever its time profile is."""
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
        zeros = FiniteZeros(self.zeros / (self.plant.time / unit), a.shape[1], ())
        return np.asarray(self.zeros[np.array(are_outside(e / unit, a, zeros, self.source.dt), dtype=bool)])

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
        left_vectors, values, _ = np.linalg.svd(rows[:, n:])
        rank = rank_from(values, expected=len(rows), scale=float(full)).rank
        new = left_vectors[:, rank:].T @ rows[:, :n]
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


def reduced_values(
    e: fmpq_mat, a: fmpq_mat, right: fmpq_mat
) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat, fmpq_poly]:
    """Return A, C, the columns ``right`` beside both, and the polynomial of the finite zeros that were taken out."""
    while True:
        kernel = null_basis(e)
        if kernel.ncols() == 0:
            break
        dynamic = pivot_columns(e)
        left_null = left_null_basis(a * kernel)
        e, a, right = left_null * picked_columns(e, dynamic), left_null * picked_columns(a, dynamic), left_null * right
    rows = pivot_columns(e.transpose())
    free = left_null_basis(e)
    top, c, outputs = picked_rows(e, rows), free * a, free * right
    if not rows:
        return zeros_matrix(0, 0), zeros_matrix(c.nrows(), 0), zeros_matrix(0, right.ncols()), outputs, fmpq_poly([1])
    solved = top.solve(blocks([[picked_rows(a, rows), picked_rows(right, rows)]]))
    n = len(rows)
    a, right = picked_columns(solved, range(n)), picked_columns(solved, range(n, solved.ncols()))
    observable = row_basis(c)
    while True:
        more = row_basis(blocks([[observable], [observable * a]]))
        if more.nrows() == observable.nrows():
            break
        observable = more
    if observable.nrows() == n:
        return a, c, right, outputs, fmpq_poly([1])
    pivots = pivot_columns(observable)
    kept_a = picked_columns(observable * a, pivots)
    zeros = a.charpoly() / kept_a.charpoly() if pivots else a.charpoly()
    return kept_a, picked_columns(c, pivots), observable * right, outputs, fmpq_poly(zeros)
