"""Whether constant parameters leave traces that can be told apart; plants with constant matrices, decided as written:

up to 64 states in rational arithmetic (24 of a sampled plant, in enclosures); parameters stand where faults do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from obsynth.analysis.conditions import Condition
from obsynth.analysis.existence.distance import ROUNDING_LEVEL
from obsynth.analysis.existence.named_pencils import NamedPencil, named_pencil, unclear
from obsynth.analysis.existence.numbers import numbers_of
from obsynth.analysis.existence.rational import PlantNumbers, WrittenNumbers
from obsynth.analysis.existence.verdicts import DECIDER, ZeroVerdict, settled_rank, zero_doubt, zero_verdict
from obsynth.analysis.existence.witnesses import Unclear
from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.time_varying import (
    STEPS_WITHOUT_HORIZON,
    IntArray,
    StepBlocks,
    early_rows,
    step_blocks,
)
from obsynth.analysis.zeros import leading_names
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.least_squares_step import OUTGROWN, least_squares_step, rank_revealing_step
from obsynth.numerics.ranks import NAMED_SHARE, RankDecision, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
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
        from fractions import Fraction

        from flint import arb

        pencil: Any = self.numbers.pencil(self.numbers.matrix("Bf"), self.numbers.matrix("Df"))  # type: ignore[attr-defined]
        one = Fraction(1) if isinstance(self.numbers, WrittenNumbers) else arb(1)
        return settled_rank(decision, int(pencil.rank_at(one)))

    def step_doubt(self, decision: RankDecision, late: IntArray) -> Unclear:
        """Return why the first rank is unclear."""
        layout = [["E"], ["C"], ["A"]] if late.size else [["E"], ["C"]]
        named = named_pencil(self.plant, self.units, layout)
        if late.size:
            kept = [*range(self.plant.nx + self.plant.ny), *(self.plant.nx + self.plant.ny + late)]
            terms = None if named.terms is None else named.terms[kept]
            named = NamedPencil(
                named.A[kept], named.E[kept], named.owners[kept], named.rows[kept], named.columns, terms
            )
        return unclear(
            self.plant, named, tolerance=ROUNDING_LEVEL, other=f"has rank {decision.expected - 1}", decider=DECIDER
        )

    def traces_doubt(self, decision: RankDecision) -> Unclear:
        """Return why the second rank is unclear."""
        named = named_pencil(self.plant, self.units, [["A", "Bf"], ["C", "Df"]])
        found = unclear(
            self.plant, named, tolerance=ROUNDING_LEVEL, point=1 + 0j, other=f"has rank {decision.expected - 1}",
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


_NAME = "identifiable parameters"
_TRACES_SOURCE = "our finding: (26) needs it, Moussa Ali, Zhang 2013"


class _Kernel(NamedTuple):
    """Constant parameters, in their own units, that leave no trace, and the states that hide them."""

    parameters: FloatArray  # (nq,)
    shares: FloatArray  # (nq,), free of units
    states: tuple[str, ...]  # names


def identifiability_condition(
    plant: TimeVaryingDescriptorSystem, *, early: bool = False, constant: ConstantPlant | None = None
) -> Condition:
    """Return the condition that outputs tell the parameters from each other and from the state."""
    still = all(matrix.is_constant for matrix in (plant.E, plant.A, plant.C, plant.Phi, plant.Psi))
    decision, kernel = _steady(plant) if still else _along(plant, early=early)
    if still and constant is not None:
        decision = constant.settled_traces(decision)
    wanted = "rank [A - E, Phi; C, Psi]" if still else "rank of the traces of all parameters"
    claim = f"{wanted} = {decision.expected}"
    value, bound = float(decision.rank), float(decision.expected)
    if decision.full:
        how = "" if still else ", in floating point along the horizon"
        return Condition(_NAME, claim, True, value, bound, _TRACES_SOURCE, f"{decision.describe()}{how}")
    names = leading_names(kernel.shares, plant.parameter_names)
    detail = f"{decision.describe()}: {_explained(kernel, names, plant)}"
    found = Condition(_NAME, claim, False, value, bound, _TRACES_SOURCE, detail, signals=names)
    if constant is None or decision.means != "unclear":
        return found
    return found.in_doubt(constant.traces_doubt(decision), constant.plant)


def _explained(kernel: _Kernel, names: tuple[str, ...], plant: TimeVaryingDescriptorSystem) -> str:
    hidden = ", ".join(map(repr, kernel.states))
    with_states = f" together with constant shifts of {hidden}" if hidden else ""
    if len(names) == 1:
        text = f"the parameter {names[0]!r} leaves no trace in the outputs"
        text += f": it cannot be told from constant shifts of {hidden}" if hidden else ""
    else:
        values = [kernel.parameters[plant.parameter_names.index(name)] for name in names]
        size = values[int(np.argmax(np.abs(values)))]
        ratio = " : ".join(f"{value / size:.4g}" for value in values)
        text = (
            f"the parameters {', '.join(map(repr, names))} cannot be told from each other: in the ratio {ratio}"
            f"{with_states} they leave no trace in the outputs"
        )
    return f"{text}. Estimate fewer parameters, or measure something that they act on."


def _steady(plant: TimeVaryingDescriptorSystem) -> tuple[RankDecision, _Kernel]:
    """Decide about a time-invariant plant by its state and parameters at rest."""
    whole = np.block([[plant.A.at(0) - plant.E.at(1), plant.Phi.at(0)], [plant.C.at(1), plant.Psi.at(0)]])
    pencil = equilibrate_pencil(np.zeros_like(whole), whole)
    decision = decide_rank(pencil.A, expected=plant.nx + plant.nq, equilibrated=False)
    shares = np.linalg.svd(pencil.A)[2][decision.rank :]
    states, parameters = np.linalg.norm(shares[:, : plant.nx], axis=0), shares[:, plant.nx :]
    largest = max(float(np.max(states, initial=0.0)), float(np.max(np.abs(parameters), initial=0.0)))
    involved = leading_names(states, plant.state_names) if states.max(initial=0.0) > NAMED_SHARE * largest else ()
    return decision, _kernel_of(parameters, pencil.columns[plant.nx :], involved)


def _along(plant: TimeVaryingDescriptorSystem, *, early: bool) -> tuple[RankDecision, _Kernel]:
    """Decide along the horizon, by the whitened traces of the parameters for noise of unit size everywhere."""
    late = early_rows(plant, early=early)
    steps = plant.horizon or STEPS_WITHOUT_HORIZON
    steps = max(steps - 1, 1) if late.size else steps
    largest = _largest(plant, steps, late)
    ne = len(largest.E)
    pencil = equilibrate_pencil(np.vstack([largest.E, np.zeros_like(largest.C)]), np.vstack([largest.A, largest.C]))
    rows, columns = pencil.rows[:, None], pencil.columns
    direct = np.linalg.norm(rows * np.vstack([largest.Phi, largest.Psi]), axis=0)
    direct[direct == 0.0] = 1.0
    nx, nq = plant.nx, plant.nq
    factor, regressor, gathered, sizes = np.eye(nx), np.zeros((nx, nq)), np.zeros((0, nq)), np.zeros(nq)
    for k in range(steps):
        blocks = step_blocks(plant, k, late)
        H, A = rows * np.vstack([blocks.E, blocks.C]) * columns, rows[:ne] * blocks.A * columns
        Phi, Psi = rows[:ne] * blocks.Phi, rows[ne:] * blocks.Psi
        noise = np.hstack([np.zeros((len(H), nx)), np.eye(len(H))])
        noise[:ne, :nx] = A @ factor
        right = np.vstack([A @ regressor + Phi, -Psi])
        found = least_squares_step(H, noise, right) or rank_revealing_step(H, noise, right, np.zeros((len(H), 0)))
        regressor, factor = found.estimate, found.factor
        if not max(np.max(np.abs(regressor)), np.max(np.abs(factor))) < OUTGROWN:
            # What nothing shows grows without bound: what has been seen until here decides.
            break
        here = np.linalg.norm(right, axis=0)
        # A regressor that grows in a state which nothing shows must not drown what was seen before.
        weight = 1.0 / max(1.0, float(np.max(here / direct)))
        gathered = np.asarray(np.linalg.qr(np.vstack([gathered, weight * found.innovation]), mode="r"))
        sizes = np.hypot(sizes, weight * here)
    sizes[sizes == 0.0] = 1.0
    # Relative to the terms that a trace is made of: rounding of a trace that vanishes is no trace.
    relative = np.vstack([gathered, np.zeros((nq, nq))]) / sizes
    decision = decide_rank(relative, expected=nq, scale=1.0, equilibrated=False)
    parameters = np.linalg.svd(relative)[2][decision.rank :]
    return decision, _kernel_of(parameters, 1.0 / sizes, ())


def _kernel_of(parameters: FloatArray, columns: FloatArray, states: tuple[str, ...]) -> _Kernel:
    """Return a kernel whose rows are given in scaled coordinates; the row with most parameters stands for its ratio."""
    if not len(parameters):
        return _Kernel(np.zeros(len(columns)), np.zeros(len(columns)), states)
    strongest = parameters[int(np.argmax(np.linalg.norm(parameters, axis=1)))]
    return _Kernel(strongest * columns, np.linalg.norm(parameters, axis=0), states)


def _largest(plant: TimeVaryingDescriptorSystem, steps: int, late: IntArray) -> StepBlocks:
    """Return the largest absolute value of each entry along the horizon: it tells what rows and states are like."""
    found = [np.abs(matrix) for matrix in step_blocks(plant, 0, late)]
    for k in range(1, steps):
        for matrix, here in zip(found, step_blocks(plant, k, late), strict=True):
            np.maximum(matrix, np.abs(here), out=matrix)
    return StepBlocks(*found)
