"""Existence of recursive observers of plants whose matrices are constant, on their numbers as written.

Up to 64 states in rational arithmetic (24 of a sampled plant, in enclosures); parameters stand where faults do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.analysis.existence.distance import DROWNED
from obsynth.analysis.existence.named_pencils import NamedPencil, named_pencil, unclear
from obsynth.analysis.existence.numbers import numbers_of
from obsynth.analysis.existence.rational import PlantNumbers, WrittenNumbers
from obsynth.analysis.existence.verdicts import DECIDER, ZeroVerdict, settled_rank, zero_doubt, zero_verdict
from obsynth.analysis.existence.witnesses import Unclear
from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.time_varying import IntArray
from obsynth.numerics.ranks import RankDecision
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem


@dataclass(frozen=True, eq=False)
class ConstantPlant:
    """A plant with constant matrices, its parameters as faults, and the numbers on which existence is decided."""

    plant: DescriptorSystem
    numbers: PlantNumbers

    @classmethod
    def of(
        cls, given: DescriptorSystem | TimeVaryingDescriptorSystem | object, varying: TimeVaryingDescriptorSystem
    ) -> ConstantPlant | None:
        """Return the plant; ``None`` where matrices change, are not square, or are too large to be decided exactly."""
        still = all(part.is_constant for part in (varying.E, varying.A, varying.C, varying.Phi, varying.Psi))
        if not still or varying.ne != varying.nx:
            return None
        if isinstance(given, DescriptorSystem):
            plant = given.dense()
        else:
            plant = DescriptorSystem(
                varying.E.at(1), varying.A.at(0), C=varying.C.at(1), Bf=varying.Phi.at(0), Df=varying.Psi.at(0),
                dt=varying.dt, state_names=varying.state_names, output_names=varying.output_names,
                fault_names=varying.parameter_names,
            )  # fmt: skip
        numbers = numbers_of(plant)
        return None if numbers is None else cls(plant, numbers)

    @cached_property
    def units(self) -> PlantUnits:
        """Units of the plant's own, as powers of two."""
        return PlantUnits.of(self.plant).rounded()

    @cached_property
    def detectability(self) -> ZeroVerdict:
        """Whether a mode that does not die out is hidden."""
        plant, numbers = self.plant, self.numbers
        facts = numbers.system(numbers.zeros(plant.nx, 0), numbers.zeros(plant.ny, 0))
        tall_e, tall_a = np.vstack([plant.E, np.zeros_like(plant.C)]), np.vstack([plant.A, plant.C])
        return zero_verdict(facts, *self.units.scaled_pencil(tall_e, tall_a), nx=plant.nx, discrete=True)

    def settled_step(self, decision: RankDecision, late: IntArray) -> RankDecision:
        """Decide the rank of E and C, and of the rows of A that are used one step early."""
        e, a, c = (self.numbers.matrix(name) for name in "EAC")
        parts = [[e], [c]]
        if late.size:
            parts.append([self._rows(a, late)])
        return settled_rank(decision, self.numbers.rank(self.numbers.blocks(parts)))

    def settled_traces(self, decision: RankDecision) -> RankDecision:
        """Decide the rank of ``[A - E, Phi; C, Psi]``."""
        pencil: Any = self.numbers.pencil(self.numbers.matrix("Bf"), self.numbers.matrix("Df"))  # type: ignore[attr-defined]
        if isinstance(self.numbers, WrittenNumbers):
            from fractions import Fraction

            return settled_rank(decision, int(pencil.rank_at(Fraction(1))))
        from flint import arb

        return settled_rank(decision, int(pencil.rank_at(arb(1))))

    def step_doubt(self, decision: RankDecision, late: IntArray) -> Unclear:
        """Return why the first rank is unclear."""
        layout = [["E"], ["C"], ["A"]] if late.size else [["E"], ["C"]]
        named = named_pencil(self.plant, self.units, layout)
        if late.size:
            kept = [*range(self.plant.nx + self.plant.ny), *(self.plant.nx + self.plant.ny + late)]
            named = _picked(named, kept)
        return unclear(self.plant, named, tolerance=DROWNED, other=f"has rank {decision.expected - 1}", decider=DECIDER)

    def traces_doubt(self, decision: RankDecision) -> Unclear:
        """Return why the second rank is unclear."""
        named = named_pencil(self.plant, self.units, [["A", "Bf"], ["C", "Df"]])
        found = unclear(
            self.plant, named, tolerance=DROWNED, point=1 + 0j, other=f"has rank {decision.expected - 1}",
            decider=DECIDER,
        )  # fmt: skip
        return replace(found, parameters=True)

    def mode_doubt(self) -> Unclear:
        """Return why it is unclear whether a mode is hidden."""
        return zero_doubt(self.plant, self.units, self.detectability, [["A"], ["C"]], what="filter")

    def _rows(self, matrix: Any, rows: IntArray) -> Any:
        if not isinstance(self.numbers, WrittenNumbers):
            return [matrix[i] for i in rows]
        from flint import fmpq_mat

        columns = int(matrix.ncols())
        return fmpq_mat(len(rows), columns, [matrix[int(i), j] for i in rows for j in range(columns)])


def _picked(named: NamedPencil, rows: list[int]) -> NamedPencil:
    return NamedPencil(
        named.A[rows], named.E[rows], named.owners[rows], named.rows[rows], named.columns,
        None if named.terms is None else named.terms[rows],
    )  # fmt: skip
