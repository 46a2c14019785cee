"""One fault, decided exactly where that can be, else in floating point with the gaps behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from obsynth.analysis.diagnosis.decoupled import DecoupledPlant, decoupled
from obsynth.analysis.diagnosis.fault_columns import FaultColumn
from obsynth.numerics.arrays import ComplexArray
from obsynth.numerics.ranks import CLEAR_GAP, TRACE_TOLERANCE
from obsynth.plants.descriptor import DescriptorSystem


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
