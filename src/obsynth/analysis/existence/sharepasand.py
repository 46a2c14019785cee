"""Existence conditions of an unknown-input PI observer.

In place of Share Pasand, Aliyari, Taghirad, Lemma 4, Theorems 1 and 2, Lemma 6 (the last three are false as printed):
(D1) ``rank [E 0 Bd; C Dd 0; 0 0 Dd] = nx + rank Dd + rank [Bd; Dd]``,
(D2) ``rank [sE - A, -Bd; C, Dd] = nx + rank [Bd; Dd]`` for every s on or outside the boundary of stability,
(D3) at each unstable eigenvalue of Phi, tested exactly there, with V a basis of ``ker (lambda I - Phi)``:
``rank [lambda E - A, -Bf Cw V, -Bd; C, Df Cw V, Dd] = nx + dim V + rank [Bd; Dd]``.
(D2), (D3) are necessary for any observer of state and fault; (D1) for any that does not differentiate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from obsynth.analysis.existence.augmented_pencils import (
    AugmentedPlant,
    exact_drops,
    in_disturbances,
    independent_disturbances,
    instability,
    number,
    numbers,
)
from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.distance import zeros_at_rounding_level
from obsynth.analysis.existence.plant_numbers import SystemFacts
from obsynth.analysis.existence.sharepasand_decoupling import SOURCE, decoupling_condition, decoupling_data
from obsynth.analysis.existence.sharepasand_fault_model import (
    lost_in_rounding,
    model_conditions,
    order_conditions,
    rank_at,
)
from obsynth.analysis.existence.statements import (
    SCATTER,
    Evaluator,
    FullRank,
    NoZeroOutside,
    believed,
    reconsidered,
    zero_verdict,
)
from obsynth.errors import counted
from obsynth.numerics.arrays import ComplexArray, FloatArray, remembered
from obsynth.numerics.invariant_zeros import Zero, is_outside, system_pencil, system_zeros, zero_at
from obsynth.numerics.pencils import finite_zeros
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.signal_names import MOST_NAMES, leading_names
from obsynth.plants.transformations.recovery import Transformation
from obsynth.plants.transformations.repeated_disturbances import without_repeated_disturbances

_D2 = "rank [sE - A, -Bd; C, Dd] = nx + rank [Bd; Dd] on and outside the boundary of stability"

_D2_SOURCE = "Share Pasand, Lemma 4 (9.2)"


@dataclass(frozen=True, eq=False)
class Existence:
    """What was decided about a plant."""

    conditions: tuple[Condition, ...]  # after a failed (D2) there is no (D3); fixed modes come last
    plant: DescriptorSystem  # to design for: without unknown inputs that repeat others, or without algebraic states
    transformation: Transformation | None  # the elimination
    fixed_modes: ComplexArray  # poles of every such observer


@remembered
def _condition_cache(_plant: DescriptorSystem) -> dict[tuple[bool, *tuple[bytes, ...]], tuple[Condition, ...]]:
    """Return the cache of the conditions of a plant with a fault model: synthesis and verification ask for them."""
    return {}


def existence_conditions(plant: DescriptorSystem, model: Exosystem) -> tuple[Condition, ...]:
    """Return the existence conditions of the unknown-input PI observer."""
    return _condition_cache(plant).get(_cache_key(model, exactly=True)) or existence(plant, model).conditions


def existence(plant: DescriptorSystem, model: Exosystem, *, exactly: bool = True) -> Existence:
    """Return the existence conditions of the unknown-input PI observer, and the plant to design for."""
    dense = plant.dense()
    fewer = without_repeated_disturbances(dense)
    outcome = _examined(dense if fewer is None else fewer, model, exactly)
    if fewer is not None and outcome.transformation is not None:
        # A plant without its algebraic states is one with all unknown inputs.
        outcome = _examined(dense, model, exactly)
    _condition_cache(plant)[_cache_key(model, exactly=exactly)] = outcome.conditions
    # What decouples the others decouples an unknown input that repeats them: rounding would make it one of its own.
    return replace(outcome, plant=without_repeated_disturbances(outcome.plant) or outcome.plant)


def _examined(plant: DescriptorSystem, model: Exosystem, exactly: bool) -> Existence:
    return reconsidered(Evaluator(plant, exactly), lambda judge: _decided(judge, model), lambda each: each.conditions)


def _cache_key(model: Exosystem, *, exactly: bool) -> tuple[bool, *tuple[bytes, ...]]:
    """Return what the conditions depend on besides the plant: the numbers of the fault model, to the last digit."""
    parts = (model.Phi, model.Cw, model.eigenvalues)
    # A negative zero is a zero.
    return exactly, *((np.asarray(part) + 0.0).tobytes() for part in parts)


def _decided(judge: Evaluator, model: Exosystem) -> Existence:
    plant, rank = judge.plant, judge.rank_itself(FullRank([["Bd"], ["Dd"]]))
    holds = rank <= plant.ny
    enough = Condition(
        "nd <= ny",
        "no more independent unknown inputs than outputs",
        holds,
        float(rank),
        float(plant.ny),
        SOURCE,
        f"{counted(rank, 'unknown input')}, {counted(plant.ny, 'output')}"
        + ("" if holds else ". Measure more, or leave an unknown input out."),
        signals=() if holds else plant.disturbance_names,
    )
    if not enough.holds:
        return Existence((enough,), judge.plant, None, np.zeros(0, dtype=np.complex128))
    transformation, before, after = decoupling_data(judge)

    def decide(judge: Evaluator) -> Existence:
        # (D1) and the others fail independently: a user wants to know both.
        conditions = [enough, decoupling_condition(judge, before, after)]
        working, fixed, with_model = judge.plant, np.zeros(0, dtype=np.complex128), replace(judge, model=model)
        conditions.append(_zero_condition(judge, with_model.natural, with_model.units))
        if conditions[-1].holds:
            conditions += model_conditions(with_model, model)
        if all(condition.holds for condition in conditions):
            conditions += order_conditions(with_model, model)
            if conditions[-1].holds:
                fixed, condition = _fixed_modes(with_model, model)
                conditions.append(condition)
        return Existence(tuple(conditions), working, transformation, fixed)

    if transformation is None:
        return decide(judge)
    return reconsidered(Evaluator(transformation.plant, judge.exactly), decide, lambda each: each.conditions)


def _zero_condition(judge: Evaluator, plant: DescriptorSystem, units: PlantUnits) -> Condition:
    """Decide (D2) on the numbers of the plant as given, or in floating point."""
    disturbances = judge.independent_disturbances
    inputs, direct = plant.Bd[:, disturbances], plant.Dd[:, disturbances]

    def holding(facts: SystemFacts) -> Condition:
        return _zeros(True, facts.normal_rank, facts.columns, f"{counted(len(facts.zeros), 'stable zero')}")

    def lost(facts: SystemFacts) -> Condition:
        if not facts.full:
            rank, full = facts.normal_rank, facts.columns
            detail = f"normal rank {rank} of {full}: whole trajectories of the plant are output-nulling."
            return _zeros(False, rank, full, detail)
        point = units.rate * max(facts.outside, key=lambda value: instability(value, plant.dt))
        return _zero_failure(plant, units, zero_at(plant.E, plant.A, point, inputs, plant.C, direct), inputs, direct)

    return judge.no_zero_outside(NoZeroOutside("Bd", disturbances), holding=holding, lost=lost, what="observer")


def _zeros(holds: bool, value: float, bound: float, detail: str) -> Condition:
    return Condition("(D2) zeros", _D2, holds, float(value), float(bound), _D2_SOURCE, detail)


def _zero_failure(
    plant: DescriptorSystem, units: PlantUnits, zero: Zero, inputs: FloatArray, direct: FloatArray
) -> Condition:
    value = units.eigenvalue(zero.value)
    states = leading_names(np.abs(zero.state_direction), plant.state_names, most=MOST_NAMES)
    shares = in_disturbances(plant, inputs, direct, zero.input_direction)
    disturbances = () if zero.is_unobservable_mode else leading_names(shares, plant.disturbance_names, most=MOST_NAMES)
    where = f"{'s' if plant.dt == 0.0 else 'z'} = {number(value)}"
    masked = f" under the unknown input {', '.join(map(repr, disturbances))}" if disturbances else ""
    detail = (
        f"at {where} the states {', '.join(map(repr, states))} move{masked} along an undetectable mode: it has no "
        "effect on the outputs, and does not decay. Measure something that they move."
    )
    condition = _zeros(False, instability(value, plant.dt), 0.0, detail)
    return replace(condition, mode=value, signals=(*states, *disturbances))


def _visible_as_given(judge: Evaluator, model: Exosystem, drop: complex) -> bool:
    """Whether the units of the plant as given show a mode that is not stable, where its own hide it.

    Along a plant of parts that hardly touch its own units drift apart, and rounding hides what they make small."""
    plant, units = judge.plant, judge.units
    if not is_outside(drop, 1.0 if units.discrete else 0.0):
        return False
    augmented = AugmentedPlant.of(plant, model)
    return rank_at(augmented, independent_disturbances(plant), units.eigenvalue(drop)).full


def _fixed_modes(judge: Evaluator, model: Exosystem) -> tuple[ComplexArray, Condition]:
    """Return the drops of the augmented pencil, exact where the numbers of the plant as given are known."""
    plant, units = judge.natural, judge.units
    augmented, exact = AugmentedPlant.of(plant, units.scaled_model(model)), exact_drops(judge, model)
    if exact is not None:
        inputs, direct = plant.Bd[:, exact[1]], plant.Dd[:, exact[1]]
    else:
        inputs, direct = independent_disturbances(plant)
    pencil = system_pencil(augmented.E, augmented.A, augmented.below(inputs), augmented.C, direct)
    facts = None if exact is None else believed(exact[0].timed(units.rate), *pencil, nx=augmented.order)
    if facts is not None and facts.full and not facts.outside:
        # A mode that only rounding of the data moves is fixed as well.
        nearly = zeros_at_rounding_level(*pencil, finite_zeros(*pencil).values, facts.zeros, nx=augmented.order)
        zeros = np.array([*map(units.eigenvalue, (*facts.zeros, *nearly))], dtype=np.complex128)
        verdict = zero_verdict(facts, *pencil, nx=augmented.order, discrete=plant.dt > 0.0)
        if verdict.answer == "unclear" and verdict.point is not None:
            point = units.eigenvalue(verdict.point)
            return zeros, lost_in_rounding(judge, model, point)
    else:
        drops = system_zeros(*pencil, nx=augmented.order).values
        if exact is None:
            drops = np.array([value for value in drops if not _visible_as_given(judge, model, complex(value))])
        zeros = units.eigenvalues(drops)
        # Rounding scatters a multiple mode around its mean.  (D2) and (D3) exclude an unstable one: it is none at all.
        bound = 1.0 if plant.dt > 0.0 else 0.0
        means = [np.mean(drops[np.abs(drops - value) <= SCATTER * max(1.0, abs(value))]) for value in drops]
        unstable = [mean for mean in means if instability(complex(mean), plant.dt) >= bound]
        if unstable:
            point = units.eigenvalue(complex(unstable[0]))
            return zeros, lost_in_rounding(judge, model, point)
    text = ", ".join(numbers(zeros))
    return zeros, Condition(
        "fixed modes",
        "every pole that no gain moves is stable",
        True,
        float(len(zeros)),
        float(augmented.order),
        "drops of the augmented pencil",
        f"{len(zeros)} of {augmented.order} poles are fixed" + (f": {text}" if text else ""),
    )
