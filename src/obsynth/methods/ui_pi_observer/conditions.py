"""When an unknown-input PI observer exists, on the plant's own data.

In place of Share Pasand, Aliyari, Taghirad, Lemma 4, Theorems 1 and 2, Lemma 6 (the last three are false as printed):
(D1) ``rank [E 0 Bd; C Dd 0; 0 0 Dd] = nx + rank Dd + rank [Bd; Dd]``,
(D2) ``rank [sE - A, -Bd; C, Dd] = nx + rank [Bd; Dd]`` for every s on or outside the boundary of stability,
(D3) at each unstable eigenvalue of Phi, tested exactly there, with V a basis of ``ker (lambda I - Phi)``:
``rank [lambda E - A, -Bf Cw V, -Bd; C, Df Cw V, Dd] = nx + dim V + rank [Bd; Dd]``.
(D2), (D3) are necessary for any observer of state and fault; (D1) for any that does not differentiate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from obsynth.analysis.conditions import Condition, is_doubted, is_refused
from obsynth.analysis.existence.distance import zeros_at_rounding_level
from obsynth.analysis.existence.numbers import decides_exactly, numbers_of, reconsidered
from obsynth.analysis.existence.rational import SystemFacts
from obsynth.analysis.existence.verdicts import (
    believed,
    in_own_time,
    needed_gain,
    verdict_condition,
    zero_doubt,
    zero_verdict,
)
from obsynth.analysis.existence.witnesses import Unclear
from obsynth.analysis.plant_units import PlantUnits, sized_plant
from obsynth.analysis.transformations.recovery import Transformation
from obsynth.analysis.zeros import Zero, leading_names, system_pencil, system_zeros, zero_at, zeros_of_system
from obsynth.methods.ui_pi_observer.augmented_plant import AugmentedPlant
from obsynth.methods.ui_pi_observer.decoupling_condition import (
    SOURCE,
    decoupling_data,
    decoupling_rank,
    disturbance_rank,
)
from obsynth.methods.ui_pi_observer.fault_model_condition import (
    lost_in_rounding,
    model_conditions,
    order_conditions,
)
from obsynth.methods.ui_pi_observer.pencils import (
    MOST_NAMES,
    exact_drops,
    in_disturbances,
    independent_disturbances,
    instability,
    kept_disturbances,
    number,
    numbers,
)
from obsynth.numerics.arrays import ComplexArray, FloatArray, remembered
from obsynth.numerics.pencils import finite_zeros
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.fault_models import Exosystem

#: Drops of the augmented pencil this close to each other, relative to their size or one, may be one multiple mode.
SCATTER = 1e-2

__all__ = ["Existence", "decoupling_rank", "existence"]


@dataclass(frozen=True, eq=False)
class Existence:
    """What was decided about a plant."""

    conditions: tuple[Condition, ...]  # after a failed (D2) there is no (D3); fixed modes come last
    plant: DescriptorSystem  # as given, or without its algebraic states
    transformation: Transformation | None  # the elimination
    fixed_modes: ComplexArray  # poles of every such observer


@remembered
def _known(_plant: DescriptorSystem) -> dict[tuple[bool, *tuple[bytes, ...]], tuple[Condition, ...]]:
    """Return the cache of the conditions of a plant with a fault model: synthesis and verification ask for them."""
    return {}


def existence_conditions(plant: DescriptorSystem, model: Exosystem) -> tuple[Condition, ...]:
    """Return the existence conditions of the unknown-input PI observer."""
    return _known(plant).get(_key(model)) or existence(plant, model).conditions


def existence(plant: DescriptorSystem, model: Exosystem) -> Existence:
    """Return the existence conditions of the unknown-input PI observer, and the plant to design for."""
    dense = plant.dense()
    found = reconsidered(
        lambda: _decided(dense, model), lambda found: is_refused(found.conditions),
        lambda found: is_doubted(found.conditions),
    )  # fmt: skip
    _known(plant)[_key(model)] = found.conditions
    return found


def _key(model: Exosystem) -> tuple[bool, *tuple[bytes, ...]]:
    """Return what the conditions depend on besides the plant: the numbers of the fault model, to the last digit."""
    parts = (model.Phi, model.Cw, model.eigenvalues)
    # A negative zero is a zero.
    return decides_exactly(), *((np.asarray(part) + 0.0).tobytes() for part in parts)


def _decided(plant: DescriptorSystem, model: Exosystem) -> Existence:
    nothing = np.zeros(0, dtype=np.complex128)
    enough = _enough_outputs(plant)
    if not enough.holds:
        return Existence((enough,), plant, None, nothing)
    working, transformation, solvable = decoupling_data(plant)
    # Powers of two: what is exact in the data, such as a zero at the origin, stays exact.
    units = PlantUnits.of(working, model).rounded()
    scaled, courses = units.scaled_plant(working), units.scaled_model(model)
    # (D1) and the others fail independently: a user wants to know both.
    found = [enough, solvable, _zero_condition(working, scaled, units)]
    if found[-1].holds:
        found += model_conditions(working, model, scaled, courses, units)
    if not all(condition.holds for condition in found):
        return Existence(tuple(found), working, transformation, nothing)
    found += order_conditions(working, model, scaled, courses, units)
    if not found[-1].holds:
        return Existence(tuple(found), working, transformation, nothing)
    fixed, condition = _fixed_modes(working, model, scaled, courses, units)
    return Existence((*found, condition), working, transformation, fixed)


def _enough_outputs(plant: DescriptorSystem) -> Condition:
    rank = disturbance_rank(plant)
    holds = rank <= plant.ny
    return Condition(
        "nd <= ny",
        "no more independent unknown inputs than outputs",
        holds,
        float(rank),
        float(plant.ny),
        SOURCE,
        f"{rank} unknown input(s), {plant.ny} output(s)"
        + ("" if holds else ". Measure more, or leave an unknown input out."),
        signals=() if holds else plant.disturbance_names,
    )


_D2 = "rank [sE - A, -Bd; C, Dd] = nx + rank [Bd; Dd] on and outside the boundary of stability"
_D2_SOURCE = "Share Pasand, Lemma 4 (9.2)"


def _zero_condition(given: DescriptorSystem, plant: DescriptorSystem, units: PlantUnits) -> Condition:
    """Decide (D2) on the numbers of the plant as given, or in floating point on the scaled one."""
    numbers = numbers_of(given)
    if numbers is None:
        return _zero_condition_in_floating_point(plant, units)
    kept = kept_disturbances(given, numbers)
    facts = numbers.system(numbers.picked(numbers.matrix("Bd"), kept), numbers.picked(numbers.matrix("Dd"), kept))
    inputs, direct = plant.Bd[:, kept], plant.Dd[:, kept]
    if not facts.full:
        return _hidden_trajectories(facts.normal_rank, facts.columns)
    wide_e, wide_a = system_pencil(plant.E, plant.A, inputs, plant.C, direct)
    terms, sizes = sized_plant(given), None
    if terms is not None:
        terms = units.scaled_plant(terms)
        sizes = np.block([[terms.A, terms.Bd[:, kept]], [terms.C, terms.Dd[:, kept]]])
    verdict = zero_verdict(_timed(facts, units.rate), wide_e, wide_a, nx=plant.nx, discrete=plant.dt > 0.0, sizes=sizes)
    holding = _zeros(True, facts.normal_rank, facts.columns, f"{len(verdict.facts.zeros)} stable zero(s)")
    own = in_own_time(verdict, units.rate)

    def lost(zeros: Sequence[complex]) -> Condition:
        zero = zero_at(plant.E, plant.A, zeros[0], inputs, plant.C, direct)
        return _zero_failure(plant, units, zero, inputs, direct)

    def seen() -> list[complex]:
        _, _, outside = zeros_of_system(plant.E, plant.A, inputs, plant.C, direct, dt=plant.dt)
        return [_worst(outside, plant.dt).value] if outside else []

    def doubt() -> Unclear:
        kept_columns = {"Bd": kept, "Dd": kept}
        return zero_doubt(given, units, own, [["A", "Bd"], ["C", "Dd"]], kept=kept_columns, what="observer")

    return verdict_condition(
        own, holding, given, what="An observer", lost=lost, seen=seen, doubt=doubt,
        gain=lambda mode: needed_gain(given, units, mode, inputs="Bd" if given.nd else ""),
    )  # fmt: skip


def _zeros(holds: bool, value: float, bound: float, detail: str) -> Condition:
    return Condition("(D2) zeros", _D2, holds, float(value), float(bound), _D2_SOURCE, detail)


def _worst(outside: Sequence[Zero], dt: float) -> Zero:
    return max(outside, key=lambda zero: instability(zero.value, dt))


def _timed(facts: SystemFacts, rate: float) -> SystemFacts:
    """Return facts in the time of the scaled plant."""
    zeros, outside = (tuple(value * rate for value in values) for values in (facts.zeros, facts.outside))
    return replace(facts, zeros=zeros, outside=outside)


def _hidden_trajectories(rank: int, full: int) -> Condition:
    detail = f"normal rank {rank} of {full}: whole trajectories of the plant are output-nulling."
    return _zeros(False, rank, full, detail)


def _zero_condition_in_floating_point(plant: DescriptorSystem, units: PlantUnits) -> Condition:
    inputs, direct = independent_disturbances(plant)
    found, zeros, outside = zeros_of_system(plant.E, plant.A, inputs, plant.C, direct, dt=plant.dt)
    full = plant.nx + inputs.shape[1]
    if found.normal_rank < full:
        return _hidden_trajectories(found.normal_rank, full)
    if outside:
        return _zero_failure(plant, units, _worst(outside, plant.dt), inputs, direct)
    return _zeros(True, found.normal_rank, full, f"{len(zeros)} stable zero(s)")


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
        f"at {where} the states {', '.join(map(repr, states))} move{masked} along an undetectable mode: no output "
        "shows it, and it does not decay. Measure something that they move."
    )
    found = _zeros(False, instability(value, plant.dt), 0.0, detail)
    return replace(found, mode=value, signals=(*states, *disturbances))


def _fixed_modes(
    given: DescriptorSystem, courses: Exosystem, plant: DescriptorSystem, model: Exosystem, units: PlantUnits
) -> tuple[ComplexArray, Condition]:
    """Return the drops of the augmented pencil, exact where the numbers of the plant as given are known."""
    augmented = AugmentedPlant.of(plant, model)
    exact = exact_drops(given, courses)
    if exact is not None:
        inputs, direct = plant.Bd[:, exact.kept], plant.Dd[:, exact.kept]
    else:
        inputs, direct = independent_disturbances(plant)
    below = np.vstack([inputs, np.zeros((model.order, inputs.shape[1]))])
    pencil = system_pencil(augmented.E, augmented.A, below, augmented.C, direct)
    facts = None if exact is None else believed(_timed(exact.facts, units.rate), *pencil, nx=augmented.order)
    if facts is not None and facts.full and not facts.outside:
        # A mode that only rounding of the data moves is fixed as well.
        nearly = zeros_at_rounding_level(*pencil, finite_zeros(*pencil).values, facts.zeros, nx=augmented.order)
        zeros = np.array([*map(units.eigenvalue, (*facts.zeros, *nearly))], dtype=np.complex128)
        verdict = zero_verdict(facts, *pencil, nx=augmented.order, discrete=plant.dt > 0.0)
        if verdict.answer == "unclear" and verdict.distance is not None:
            point = units.eigenvalue(verdict.distance.point)
            return zeros, lost_in_rounding(given, courses, units, point, augmented.order)
    else:
        drops = system_zeros(*pencil, nx=augmented.order).values
        zeros = units.eigenvalues(drops)
        # Rounding scatters a multiple mode around its mean.  (D2) and (D3) exclude an unstable one: it is none at all.
        bound = 1.0 if plant.dt > 0.0 else 0.0
        means = [np.mean(drops[np.abs(drops - value) <= SCATTER * max(1.0, abs(value))]) for value in drops]
        unstable = [mean for mean in means if instability(complex(mean), plant.dt) >= bound]
        if unstable:
            point = units.eigenvalue(complex(unstable[0]))
            return zeros, lost_in_rounding(given, courses, units, point, augmented.order)
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
