"""When an unknown-input PI observer exists, on the plant's own data.

In place of Share Pasand, Aliyari, Taghirad, Lemma 4, Theorems 1 and 2, Lemma 6 (the last three are false as printed):
(D1) ``rank [E 0 Bd; C Dd 0; 0 0 Dd] = nx + rank Dd + rank [Bd; Dd]``,
(D2) ``rank [sE - A, -Bd; C, Dd] = nx + rank [Bd; Dd]`` for every s on or outside the boundary of stability,
(D3) at each unstable eigenvalue of Phi, tested exactly there, with V a basis of ``ker (lambda I - Phi)``:
``rank [lambda E - A, -Bf Cw V, -Bd; C, Df Cw V, Dd] = nx + dim V + rank [Bd; Dd]``.
(D2), (D3) are necessary for any observer of state and fault; (D1) for any that does not differentiate.

(D1), whether the unknown inputs can be decoupled without differentiating; and the elimination that may help.

Source: Share Pasand, Aliyari, Taghirad, Lemma 4 (9.1), in the form of `obsynth.methods.ui_pi_observer.conditions`.

Whether a fault model can be distinguished from states and unknown inputs: (D3), and the order of the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.existence.augmented_pencils import (
    AugmentedPlant,
    equilibrated,
    exact_drops,
    exact_loss,
    in_disturbances,
    independent_disturbances,
    instability,
    kernel,
    number,
    numbers,
)
from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.distance import least_share, zeros_at_rounding_level
from obsynth.analysis.existence.named_pencils import NamedPencil, named_augmented
from obsynth.analysis.existence.plant_numbers import SystemFacts
from obsynth.analysis.existence.statements import (
    SCATTER,
    Evaluator,
    FullRank,
    NoZeroOutside,
    believed,
    reconsidered,
    settled_rank,
    zero_verdict,
)
from obsynth.analysis.existence.witnesses import Unclear
from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import ComplexArray, FloatArray, remembered
from obsynth.numerics.invariant_zeros import Zero, is_outside, system_pencil, system_zeros, zero_at
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import RANK_TOLERANCE, RankDecision, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.signal_names import MOST_NAMES, leading_names
from obsynth.plants.transformations.elimination import (
    dynamic_coordinates,
    eliminate_algebraic_states,
    eliminated_exactly,
)
from obsynth.plants.transformations.recovery import StateRecovery, Transformation

#: A direct effect on an output, relative to the effect on the states (both in scaled units), that elimination may
#: leave by rounding.
ELIMINATION_ROUNDING = 1e-13

#: Why algebraic states cannot be eliminated, by the condition that fails.
_NOT_ELIMINATED = {
    "regularity": "the plant is not regular",
    "index": "the plant has index 2 or more",
    "dynamic states": "no other states are left",
}

SOURCE = "Share Pasand, Lemma 4 (9.1), in a form without E#"

#: The matrix of (D1).
D1_BLOCKS = (("E", None, "Bd"), ("C", "Dd", None), (None, None, "Dd"))


_D2 = "rank [sE - A, -Bd; C, Dd] = nx + rank [Bd; Dd] on and outside the boundary of stability"

_D2_SOURCE = "Share Pasand, Lemma 4 (9.2)"


def model_conditions(judge: Evaluator, model: Exosystem) -> list[Condition]:
    """Test (D3) at each unstable eigenvalue of the fault model, upper half plane only."""
    plant, units, scaled_model = judge.natural, judge.units, judge.units.scaled_model(model)
    sizes = None if judge.terms is None else units.scaled_plant(judge.terms)
    eigenvalues = map(complex, scaled_model.eigenvalues)
    unstable = [value for value in eigenvalues if value.imag >= 0.0 and is_outside(value, plant.dt)]
    found = []
    for value in sorted(unstable, key=lambda value: (value.real, value.imag)):
        lost = exact_loss(judge, model, units.eigenvalue(value))
        decision = _model_rank(plant, scaled_model, value, lost, sizes)
        if lost is None and not decision.full:
            # Of a plant of many parts its own units drift apart; rounding is as small in those that were given.
            as_given = _model_rank(judge.plant, model, units.eigenvalue(value), None)
            decision = max(decision, as_given, key=lambda found: found.rank)
        condition = _model_condition(scaled_model, decision, plant, value, units)
        if decision.means == "unclear":
            point = units.eigenvalue(value)
            other = f"hides a fault that follows its model at {number(point)}, and no observer estimates it"
            named = _named(judge, model, of_the_model=False)
            condition = condition.in_doubt(judge.doubt(named, other, point=point), judge.plant)
        found.append(condition)
        if not found[-1].holds:
            break
    return found


def _model_matrix(plant: DescriptorSystem, courses: NDArray[Any], value: complex) -> NDArray[Any]:
    """Return the matrix of (D3) at an eigenvalue; ``courses``: of the faults along its eigenvectors ``(nf, any)``."""
    inputs, direct = independent_disturbances(plant)
    return np.block(
        [
            [value * plant.E - plant.A, -plant.Bf @ courses, -inputs],
            [plant.C.astype(complex), plant.Df @ courses, direct],
        ]
    )


def _courses(model: Exosystem, value: complex) -> NDArray[Any]:
    return np.asarray(model.Cw @ kernel(model.Phi - value * np.eye(model.order)))


def _model_rank(
    plant: DescriptorSystem, model: Exosystem, value: complex, lost: int | None, sizes: DescriptorSystem | None = None
) -> RankDecision:
    """Decide (D3); ``sizes`` of the terms that the entries of the plant are sums of."""
    courses, share = _courses(model, value), np.inf
    matrix = _model_matrix(plant, courses, value)
    if sizes is not None:
        # Disturbances that are combinations of others are judged as those: their own terms are not known.
        inputs, direct = independent_disturbances(plant)
        own = inputs.shape == plant.Bd.shape
        whole = np.block(
            [
                [abs(value) * sizes.E + sizes.A, sizes.Bf @ np.abs(courses), sizes.Bd if own else np.abs(inputs)],
                [sizes.C, sizes.Df @ np.abs(courses), sizes.Dd if own else np.abs(direct)],
            ]
        )
        share = least_share(matrix, whole)
    width = matrix.shape[1]
    found = decide_rank(equilibrated(matrix)[0], expected=width, equilibrated=False)
    return settled_rank(found, None if lost is None else width - lost, share)


def _model_condition(
    model: Exosystem, decision: RankDecision, plant: DescriptorSystem, value: complex, units: PlantUnits
) -> Condition:
    own = units.eigenvalue(value)
    where = f"{'s' if plant.dt == 0.0 else 'z'} = {number(own)}"
    signals: tuple[str, ...] = ()
    detail = decision.describe()
    if not decision.full:
        courses = _courses(model, value)
        width = courses.shape[1]
        scaled, columns = equilibrated(_model_matrix(plant, courses, value))
        direction = columns * np.linalg.svd(scaled)[2][-1].conj()
        faults = leading_names(np.abs(courses @ direction[plant.nx : plant.nx + width]), plant.fault_names)
        shares = in_disturbances(plant, *independent_disturbances(plant), direction[plant.nx + width :])
        # Where states alone already hide the fault, no disturbance does.
        without = scaled[:, : plant.nx + width]
        hides = decide_rank(without, expected=plant.nx + width, equilibrated=False)
        disturbances = leading_names(shares, plant.disturbance_names, most=MOST_NAMES) if hides.full else ()
        signals = (*faults, *disturbances)
        masked = f" is masked by the unknown input {', '.join(map(repr, disturbances))}" if disturbances else ""
        alone = len(faults) == 1
        who = f"the fault {faults[0]!r}" if alone else f"a combination of the faults {', '.join(map(repr, faults))}"
        detail += (
            f": at {where} {who}{masked or ' is output-nulling'}: it has no effect on the outputs, so no observer can "
            f"estimate {'it' if alone else 'them'}. Measure another signal, or leave one of them out."
        )
    return Condition(
        f"(D3) fault model at {number(own)}",
        f"rank [lambda E - A, -Bf Cw V, -Bd; C, Df Cw V, Dd] full at {where}, an eigenvalue of Phi",
        decision.full,
        float(decision.rank),
        float(decision.expected),
        "in place of Share Pasand, Theorems 1 and 2, which are false",
        detail,
        mode=None if decision.full else own,
        signals=signals,
    )


def _named(judge: Evaluator, model: Exosystem, *, of_the_model: bool) -> NamedPencil:
    """Return plant and fault model as a pencil of which each entry is known by its name."""
    return named_augmented(judge.plant, model, judge.units, kept=judge.kept_disturbances, of_the_model=of_the_model)


def order_conditions(judge: Evaluator, model: Exosystem) -> list[Condition]:
    """Test that the fault model is not lost in rounding: at a zero z0 order n shows with about abs(z0)^(n + 1) only."""
    plant, units = judge.natural, judge.units
    inputs, direct = np.hstack([plant.Bf, plant.Bd]), np.hstack([plant.Df, plant.Dd])
    wide_e, wide_a = system_pencil(plant.E, plant.A, inputs, plant.C, direct)
    zeros = finite_zeros(wide_e, wide_a)
    if zeros.normal_rank < wide_e.shape[1]:
        return []
    points = [complex(value) for value in zeros.values if value.imag >= 0.0 and is_outside(value, plant.dt)]
    augmented = AugmentedPlant.of(plant, units.scaled_model(model))
    worst: tuple[RankDecision, complex] | None = None
    for point in points:
        decision = _rank_at(augmented, independent_disturbances(plant), point)
        if worst is None or (decision.rank, decision.smallest_kept) < (worst[0].rank, worst[0].smallest_kept):
            worst = (decision, point)
    if worst is None:
        return []
    decision, point = worst[0], units.eigenvalue(worst[1])
    lost = (
        f": at the zero {number(point)} of (f, d) -> y the fault model (order {model.order}) cannot be distinguished "
        "from zero in double precision. Lower its order."
    )
    found = Condition(
        "order of the fault model",
        "the augmented plant is observable in double precision at the points where it is least so",
        decision.full,
        float(decision.rank),
        float(decision.expected),
        "ours: exact observability is not enough in double precision",
        f"{decision.describe()} at {number(point)}" + ("" if decision.full else lost),
        mode=None if decision.full else point,
        signals=() if decision.full else plant.fault_names,
    )
    return [found if decision.full else found.in_doubt(_order_doubt(judge, model, point), judge.plant)]


def _rank_at(augmented: AugmentedPlant, disturbances: tuple[FloatArray, FloatArray], point: complex) -> RankDecision:
    """Decide whether plant and fault model have a mode at a point that these disturbances can hide."""
    entering, direct = disturbances
    below = augmented.below(entering)
    matrix = np.block([[point * augmented.E - augmented.A, -below], [augmented.C.astype(complex), direct]])
    return decide_rank(equilibrated(matrix)[0], expected=matrix.shape[1], equilibrated=False)


def _order_doubt(judge: Evaluator, model: Exosystem, point: complex) -> Unclear:
    return judge.doubt(
        _named(judge, model, of_the_model=True),
        f"hides a motion of plant and fault model at {number(point)}, and no observer estimates it",
        point=point,
        tolerance=RANK_TOLERANCE,
        decider="A fault model of lower order, or an output nearer to the fault, would decide it.",
        moving=True,
    )


def lost_in_rounding(judge: Evaluator, model: Exosystem, mode: complex) -> Condition:
    """Return the failing condition for a mode that seems fixed and unstable, against all other conditions."""
    order = judge.plant.nx + model.order
    found = Condition(
        "fault model in double precision",
        "no mode of plant and fault model seems unobservable by rounding alone",
        False,
        order - 1.0,
        float(order),
        "ours: exact observability is not enough in double precision",
        f"plant and fault model (order {model.order}) seem to have an unobservable unstable mode at {number(mode)}, "
        "which the "
        "conditions above exclude: in double precision the order of the model is too high. Lower it.",
        mode=mode,
        signals=judge.plant.fault_names,
    )
    return found.in_doubt(_order_doubt(judge, model, mode), judge.plant)


def decoupling_rank(judge: Evaluator) -> RankDecision:
    """Decide (D1): ``rank [E 0 Bd; C Dd 0; 0 0 Dd]``, with what it must be."""
    expected = judge.plant.nx + judge.rank_itself(FullRank([["Dd"]])) + judge.rank_itself(FullRank([["Bd"], ["Dd"]]))
    return judge.rank(FullRank(D1_BLOCKS, rank=expected))


def decoupling_data(judge: Evaluator) -> tuple[Transformation | None, str, str]:
    """Return the elimination of the algebraic states that (D1) needs, where it does; what is said before and after."""
    written = decoupling_rank(judge)
    if written.full:
        return None, "", ""
    try:
        transformation = _without_rounding(_eliminated(judge.plant))
    except PreconditionError as error:
        why = _NOT_ELIMINATED.get(error.condition or "", "they cannot be solved for")
        return None, "", f", and the algebraic states cannot be eliminated ({why})"
    if not transformation.description:
        return None, "", ""
    return transformation, f"rank {written.rank} of {written.expected} as written; ", " without the algebraic states"


def _eliminated(plant: DescriptorSystem) -> Transformation:
    """Eliminate algebraic states in the plant's own units (orthogonal combinations depend on them), then undo these."""
    units = PlantUnits.of(plant)
    basis = dynamic_coordinates(units.scaled_plant(plant))
    found = eliminated_exactly(plant, None if basis is None else units.states[:, None] * basis)
    if found is not None:
        return found
    found = eliminate_algebraic_states(plant)
    if found.plant.exact is not None:
        return found
    exact = units.rounded()
    found = eliminate_algebraic_states(exact.scaled_plant(plant))
    if set(found.plant.state_names) <= set(plant.state_names):
        return _in_given_units(found, plant, exact)
    return _in_given_units(eliminate_algebraic_states(units.scaled_plant(plant)), plant, units)


def _in_given_units(found: Transformation, plant: DescriptorSystem, units: PlantUnits) -> Transformation:
    kept = dict(zip(plant.state_names, units.states, strict=True))
    states = np.array([kept.get(name, 1.0) for name in found.plant.state_names])
    back = replace(
        units,
        time=1.0 / units.time,
        equations=states,
        states=1.0 / states,
        outputs=1.0 / units.outputs,
        faults=1.0 / units.faults,
        disturbances=1.0 / units.disturbances,
    )
    old = found.recovery
    # A source state that cannot be recovered is not among these.
    own = np.array([kept.get(name, 1.0) for name in old.names])[:, None]
    recovery = StateRecovery(
        old.names,
        own * old.from_state / states,
        own * old.from_input,
        own * old.from_fault / units.faults,
        own * old.from_disturbance / units.disturbances,
        own * old.from_noise * (1.0 if units.discrete else np.sqrt(units.time)),
        old.noise_kept,
    )
    return replace(
        found, source=plant, plant=back.scaled_plant(found.plant).replace(E=None, dt=plant.dt), recovery=recovery
    )


def _without_rounding(transformation: Transformation) -> Transformation:
    """Set to zero what elimination left of a direct effect that is none: a rank decision would take it for one."""
    plant = transformation.plant
    if plant.exact is not None:
        return transformation  # rounded once: what is zero is zero
    # What may be rounding must have no say in the units in which it is judged.
    units = PlantUnits.of(plant.replace(Dd=np.zeros_like(plant.Dd), Df=np.zeros_like(plant.Df)))
    scaled = units.scaled_plant(plant)
    changes = {}
    for direct, entering in (("Dd", scaled.Bd), ("Df", scaled.Bf)):
        sizes = np.max(np.abs(entering), axis=0, initial=0.0)
        negligible = np.abs(getattr(scaled, direct)) <= ELIMINATION_ROUNDING * sizes
        changes[direct] = np.where(negligible, 0.0, getattr(plant, direct))
    return replace(transformation, plant=plant.replace(**changes))


def _decoupling_condition(judge: Evaluator, before: str, after: str) -> Condition:
    plant, decision, signals = judge.plant, decoupling_rank(judge), tuple[str, ...]()
    detail = f"{before}{decision.describe()}{after}"
    if not decision.full:
        signals = _undecoupled(judge)
        detail += ": " + (
            f"the unknown input {', '.join(map(repr, signals))} moves states that reach no output without a "
            "derivative, so only a derivative of the outputs could decouple it. Measure such a state, or leave the "
            "input out."
            if set(signals) & set(plant.disturbance_names)
            else f"the states {', '.join(map(repr, signals))} are neither dynamic nor measured."
        )
    found = Condition(
        "(D1) decoupling",
        "rank [E 0 Bd; C Dd 0; 0 0 Dd] = nx + rank Dd + rank [Bd; Dd]",
        decision.full,
        float(decision.rank),
        float(decision.expected),
        SOURCE,
        detail,
        signals=signals,
    )
    if decision.means != "unclear":
        return found
    # Without direct parts, as almost always, the condition is that [E Bd; C 0] has full rank.
    kept = judge.kept_disturbances
    free = [j for j in kept if not plant.Dd[:, j].any()]
    seen = [j for j in kept if j not in free]
    layout: list[list[str | None]] = [["E", "Bd"], ["C", None]] if not seen else [["E", "Bd", None], ["C", None, "Dd"]]
    return found.in_doubt(judge.rank_doubt(FullRank(layout, {"Bd": free, "Dd": seen}), decision), plant)


def _undecoupled(judge: Evaluator) -> tuple[str, ...]:
    """Return the unknown inputs that move what no output shows at once, or else the states in question."""
    plant, matrix = judge.plant, judge.arranged(FullRank(D1_BLOCKS), judge.natural)
    pencil = equilibrate_pencil(np.zeros_like(matrix), matrix)
    hidden = np.linalg.svd(pencil.A)[2][decide_rank(matrix).rank :].T
    # Of all null vectors the one that moves the states most: some are there only because disturbances repeat.
    rotation = np.linalg.svd(hidden[: plant.nx])[2]
    direction = hidden @ rotation[0]
    shares = np.abs(direction[plant.nx + plant.nd :])
    if np.max(shares, initial=0.0) > RANK_TOLERANCE:
        return leading_names(shares, plant.disturbance_names, most=MOST_NAMES)
    return leading_names(np.abs(direction[: plant.nx]), plant.state_names, most=MOST_NAMES)


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
    return _known(plant).get(_key(model, exactly=True)) or existence(plant, model).conditions


def existence(plant: DescriptorSystem, model: Exosystem, *, exactly: bool = True) -> Existence:
    """Return the existence conditions of the unknown-input PI observer, and the plant to design for."""
    judge = Evaluator(plant.dense(), exactly)
    found = reconsidered(judge, lambda judge: _decided(judge, model), lambda found: found.conditions)
    _known(plant)[_key(model, exactly=exactly)] = found.conditions
    return found


def _key(model: Exosystem, *, exactly: bool) -> tuple[bool, *tuple[bytes, ...]]:
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
        f"{rank} unknown input(s), {plant.ny} output(s)"
        + ("" if holds else ". Measure more, or leave an unknown input out."),
        signals=() if holds else plant.disturbance_names,
    )
    if not enough.holds:
        return Existence((enough,), judge.plant, None, np.zeros(0, dtype=np.complex128))
    transformation, before, after = decoupling_data(judge)

    def decide(judge: Evaluator) -> Existence:
        # (D1) and the others fail independently: a user wants to know both.
        found = [enough, _decoupling_condition(judge, before, after)]
        working, fixed, whole = judge.plant, np.zeros(0, dtype=np.complex128), replace(judge, model=model)
        found.append(_zero_condition(judge, whole.natural, whole.units))
        if found[-1].holds:
            found += model_conditions(whole, model)
        if all(condition.holds for condition in found):
            found += order_conditions(whole, model)
            if found[-1].holds:
                fixed, condition = _fixed_modes(whole, model)
                found.append(condition)
        return Existence(tuple(found), working, transformation, fixed)

    if transformation is None:
        return decide(judge)
    return reconsidered(Evaluator(transformation.plant, judge.exactly), decide, lambda found: found.conditions)


def _zero_condition(judge: Evaluator, plant: DescriptorSystem, units: PlantUnits) -> Condition:
    """Decide (D2) on the numbers of the plant as given, or in floating point."""
    kept = judge.kept_disturbances
    inputs, direct = plant.Bd[:, kept], plant.Dd[:, kept]

    def holding(facts: SystemFacts) -> Condition:
        return _zeros(True, facts.normal_rank, facts.columns, f"{len(facts.zeros)} stable zero(s)")

    def lost(facts: SystemFacts) -> Condition:
        if not facts.full:
            rank, full = facts.normal_rank, facts.columns
            detail = f"normal rank {rank} of {full}: whole trajectories of the plant are output-nulling."
            return _zeros(False, rank, full, detail)
        point = units.rate * max(facts.outside, key=lambda value: instability(value, plant.dt))
        return _zero_failure(plant, units, zero_at(plant.E, plant.A, point, inputs, plant.C, direct), inputs, direct)

    return judge.no_zero_outside(NoZeroOutside("Bd", kept), holding=holding, lost=lost, what="observer")


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
    found = _zeros(False, instability(value, plant.dt), 0.0, detail)
    return replace(found, mode=value, signals=(*states, *disturbances))


def _shown_as_given(judge: Evaluator, model: Exosystem, drop: complex) -> bool:
    """Whether the units of the plant as given show a mode that is not stable, where its own hide it.

    Along a plant of parts that hardly touch its own units drift apart, and rounding hides what they make small."""
    plant, units = judge.plant, judge.units
    if not is_outside(drop, 1.0 if units.discrete else 0.0):
        return False
    augmented = AugmentedPlant.of(plant, model)
    return _rank_at(augmented, independent_disturbances(plant), units.eigenvalue(drop)).full


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
            drops = np.array([value for value in drops if not _shown_as_given(judge, model, complex(value))])
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
