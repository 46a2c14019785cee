"""One fault on a decoupled plant: whether it shows, where it does not, and how fast it does.

With N a minimal polynomial basis of the left null space of the unknowns' pencil, ``g = N [bf; df]``; the zeros of the
fault are the roots of the greatest common divisor of the entries of g.  On the decoupled plant g vanishes at a point
exactly where ``[F; G]`` lies in the range of ``[A - sE; C]``, which has full column rank everywhere.

One fault, decided exactly where that can be, else in floating point with the gaps behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from obsynth.analysis.diagnosis.decoupled import DecoupledPlant, decoupled
from obsynth.analysis.diagnosis.reduction import finite_values, left_part
from obsynth.analysis.zeros import are_outside
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.numerics.pencils import FiniteZeros
from obsynth.numerics.ranks import CLEAR_GAP, MARKOV_TOLERANCE, RANK_TOLERANCE, TRACE_TOLERANCE, rank_from
from obsynth.plants.descriptor import DescriptorSystem

#: Parity spaces of a higher order than this are not formed: their powers hold no digits.
MOST_PARITY_ORDER = 24


@dataclass(frozen=True, eq=False)
class FaultColumn:
    """The column of one fault on a decoupled plant."""

    plant: DecoupledPlant
    number: int

    @cached_property
    def _scaled(self) -> tuple[FloatArray, FloatArray]:
        size = max(float(self.plant.fault_sizes[self.number]), np.finfo(np.float64).tiny)
        columns = [self.number]
        return self.plant.F[:, columns] / size, self.plant.G[:, columns] / size

    @cached_property
    def trace(self) -> float:
        """Size of what is left of the column, relative to before the reduction."""
        return float(np.linalg.norm(np.vstack(self._scaled)))

    @property
    def visible(self) -> bool:
        """Whether the outputs show the fault at all, free of what was removed."""
        return self.trace > TRACE_TOLERANCE

    def strength(self, point: complex) -> float:
        """Return the part of the column, relative to its size, that shows at a point of the s (or z) plane."""
        if not self.visible:
            return 0.0
        f, g = self._scaled
        plant = self.plant
        top = np.vstack([plant.A - point * plant.E, plant.C])
        column = np.vstack([f, g])[:, 0] / self.trace
        if plant.order == 0:
            return float(np.linalg.norm(column))
        basis = np.linalg.qr(top)[0]
        rest = column - basis @ (basis.conj().T @ column)
        return float(np.linalg.norm(rest - basis @ (basis.conj().T @ rest)))

    def shows_at(self, point: complex) -> bool:
        """Whether a fault ``exp(point t)`` (or ``point^k``) leaves a trace that the rest cannot imitate."""
        return self.strength(point) > TRACE_TOLERANCE

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
        if not self.visible:
            return np.zeros(0, dtype=np.complex128)
        return np.asarray(finite_values(left_part(*self._pencil)) * self.plant.time)

    @cached_property
    def blocking(self) -> ComplexArray:
        """Those on or outside the boundary of stability: a fault that follows one of them stays hidden."""
        if not self.zeros.size:
            return self.zeros
        e, a = self._pencil
        found = FiniteZeros(self.zeros / self.plant.time, a.shape[1], ())
        if self.plant.source.dt > 0.0:
            # In discrete time the boundary is a number, not a direction: the unit of s must not move it.
            e = e / self.plant.time
            found = FiniteZeros(self.zeros, a.shape[1], ())
        outside = are_outside(e, a, found, self.plant.source.dt)
        return np.asarray(self.zeros[np.array(outside, dtype=bool)])

    @cached_property
    def derivatives(self) -> int | None:
        """Derivatives of y and u (samples of delay) that an estimate needs; ``None`` where nothing shows."""
        if not self.visible:
            return None
        f, g = self._scaled
        return _order_at_infinity(self.plant, f / self.trace, g / self.trace)

    @cached_property
    def residual_order(self) -> int | None:
        """Least order of a scalar residual that shows the fault; ``None`` where nothing does, or beyond 24."""
        if not self.visible:
            return None
        for order in range(min(self.plant.order, MOST_PARITY_ORDER) + 1):
            if self.seen_by_parity(order):
                return order
        return None

    def seen_by_parity(self, order: int) -> bool:
        """Whether a parity vector of an order shows the fault."""
        plant = self.plant
        f, g = self._scaled
        if plant.order == 0:
            return self.visible
        inverse = np.linalg.inv(plant.E * plant.time)
        a, f = inverse @ plant.A, inverse @ f
        powers, markov = [plant.C], [g]
        for _ in range(order):
            markov.append(powers[-1] @ f)
            powers.append(powers[-1] @ a)
        observed = np.vstack(powers)
        # Powers grow or fade: rows of one length keep a long chain of one output apart from rounding.
        lengths = np.linalg.norm(observed, axis=1, keepdims=True)
        lengths = np.where(lengths > 0.0, lengths, 1.0)
        observed = observed / lengths
        left, values, _ = np.linalg.svd(observed)
        rank = rank_from(values, expected=observed.shape[1]).rank
        parity = left[:, rank:].T
        if not len(parity):
            return False
        p = len(plant.C)
        toeplitz = np.zeros((len(observed), order + 1))
        for row in range(order + 1):
            for column in range(row + 1):
                toeplitz[row * p : (row + 1) * p, column] = markov[row - column][:, 0]
        toeplitz = toeplitz / lengths
        return bool(np.linalg.norm(parity @ toeplitz) > TRACE_TOLERANCE * max(1.0, float(np.linalg.norm(toeplitz))))


def _order_at_infinity(plant: DecoupledPlant, f: FloatArray, g: FloatArray) -> int:
    """Return the derivatives needed; rows without y, u are exact, and differentiating those costs nothing."""
    n = plant.order
    if n == 0:
        return 0
    inverse = np.linalg.inv(plant.E * plant.time)
    a, f, known = inverse @ plant.A, inverse @ f, inverse @ np.hstack([-plant.By, plant.Bu])
    rows = np.hstack([plant.C, g, np.hstack([plant.H, plant.Du])])
    for _ in range(n):
        full = np.linalg.norm(rows, 2)
        left, values, _ = np.linalg.svd(rows[:, n:])
        rank = rank_from(values, expected=len(rows), scale=float(full)).rank
        new = left[:, rank:].T @ rows[:, :n]
        if not new.size or np.linalg.norm(new) <= MARKOV_TOLERANCE * full:
            break
        more = np.vstack([rows, np.hstack([new @ a, new @ f, new @ known])])
        if _rank(more) == _rank(rows):
            break
        rows = more
    c, direct, vector, order = rows[:, :n], rows[:, n : n + 1], f, 0
    size = max(float(np.linalg.norm(direct)), float(np.linalg.norm(c, 2) * np.linalg.norm(vector)))
    while np.linalg.norm(direct) <= MARKOV_TOLERANCE * size and order <= n:
        direct = c @ vector
        size = float(np.linalg.norm(c, 2) * np.linalg.norm(vector))
        vector = a @ vector
        order += 1
    return order


def _rank(matrix: FloatArray) -> int:
    values = np.linalg.svd(matrix, compute_uv=False)
    return rank_from(np.asarray(values), expected=min(matrix.shape), tolerance=RANK_TOLERANCE).rank


@dataclass(frozen=True, eq=False)
class Question:
    """A fault of a plant, asked about with the faults ``removed`` and every unknown input out of sight."""

    source: DescriptorSystem
    removed: tuple[int, ...]
    number: int
    exactly: bool

    @cached_property
    def plant(self) -> DecoupledPlant:
        """The decoupled plant, in floating point."""
        return decoupled(self.source, self.removed, [self.number])

    @cached_property
    def rounded(self) -> FaultColumn:
        """The fault in floating point."""
        return FaultColumn(self.plant, 0)

    @cached_property
    def _exact(self) -> object:
        from obsynth.analysis.diagnosis import exact

        if self.source.nx + self.source.ny > exact.MOST_REDUCED:
            return exact.PencilColumn(self.source, self.removed, self.number)
        return exact.exact_decoupled(self.source, self.removed, [self.number]).column(0)

    @property
    def _decider(self) -> FaultColumn:
        return self._exact if self.exactly else self.rounded  # type: ignore[return-value]

    @cached_property
    def visible(self) -> bool:
        """Whether the outputs show the fault at all."""
        return self._decider.visible

    def shows_at(self, point: complex) -> bool:
        """Whether a fault ``exp(point t)`` (or ``point^k``) leaves a trace that the rest cannot imitate."""
        return self._decider.shows_at(point)

    @cached_property
    def zeros(self) -> ComplexArray:
        """Roots of the fault polynomial, 1/s (or dimensionless)."""
        return self._decider.zeros

    @cached_property
    def blocking(self) -> ComplexArray:
        """Those on or outside the boundary of stability."""
        return self._decider.blocking

    @cached_property
    def derivatives(self) -> int | None:
        """Derivatives (samples of delay) that an estimate needs."""
        return self._decider.derivatives if self._is_reduced else self.rounded.derivatives

    @cached_property
    def residual_order(self) -> int | None:
        """Least order of a scalar residual that shows the fault."""
        return self._decider.residual_order if self._is_reduced else self.rounded.residual_order

    @cached_property
    def order(self) -> int:
        """Order of the decoupled plant."""
        return int(self._decider.plant.order) if self._is_reduced else self.plant.order

    @property
    def _is_reduced(self) -> bool:
        return not self.exactly or hasattr(self._exact, "plant")

    @property
    def gap(self) -> float:
        """How clear the least clear decision was: kept over dropped; infinite for exact ones."""
        if self.exactly:
            return float("inf")
        thinnest = self.plant.thinnest
        ranks = thinnest.gap if thinnest is not None else float("inf")
        trace = self.rounded.trace
        if trace == 0.0:
            return ranks
        return min(ranks, trace / TRACE_TOLERANCE if self.rounded.visible else TRACE_TOLERANCE / trace)

    @property
    def clear(self) -> bool:
        """Whether the gap is wide enough to trust the answer without a second look."""
        return self.gap >= CLEAR_GAP


def question(plant: DescriptorSystem, removed: Sequence[int], number: int) -> Question:
    """Return a question about a fault; exact where the plant is small and made of numbers as they were written."""
    return Question(plant, tuple(removed), number, decided_exactly(plant))


def decided_exactly(plant: DescriptorSystem) -> bool:
    """Whether questions about a plant are decided over the rational numbers."""
    from obsynth.analysis.diagnosis.exact import can_be_exact

    return can_be_exact(plant)
