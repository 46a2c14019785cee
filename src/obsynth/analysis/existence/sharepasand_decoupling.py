"""Existence condition (D1): unknown inputs can be decoupled without derivatives, or after an elimination.

Source: Share Pasand, Aliyari, Taghirad, Lemma 4 (9.1), in the form of `obsynth.analysis.existence.sharepasand`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.statements import Evaluator, FullRank
from obsynth.errors import PreconditionError
from obsynth.numerics.ranks import RANK_TOLERANCE, RankDecision, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.plants.descriptor import DescriptorSystem
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

#: The matrix of (D1).
D1_BLOCKS = (("E", None, "Bd"), ("C", "Dd", None), (None, None, "Dd"))

#: The source of (D1).
SOURCE = "Share Pasand, Lemma 4 (9.1), in a form without E#"


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
    elimination = eliminated_exactly(plant, None if basis is None else units.states[:, None] * basis)
    if elimination is not None:
        return elimination
    elimination = eliminate_algebraic_states(plant)
    if elimination.plant.exact is not None:
        return elimination
    exact = units.rounded()
    elimination = eliminate_algebraic_states(exact.scaled_plant(plant))
    if set(elimination.plant.state_names) <= set(plant.state_names):
        return _in_given_units(elimination, plant, exact)
    return _in_given_units(eliminate_algebraic_states(units.scaled_plant(plant)), plant, units)


def _in_given_units(elimination: Transformation, plant: DescriptorSystem, units: PlantUnits) -> Transformation:
    unit_of = dict(zip(plant.state_names, units.states, strict=True))
    states = np.array([unit_of.get(name, 1.0) for name in elimination.plant.state_names])
    back = replace(
        units,
        time=1.0 / units.time,
        equations=states,
        states=1.0 / states,
        outputs=1.0 / units.outputs,
        faults=1.0 / units.faults,
        disturbances=1.0 / units.disturbances,
    )
    old = elimination.recovery
    # A source state that cannot be recovered is not among these.
    own = np.array([unit_of.get(name, 1.0) for name in old.names])[:, None]
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
        elimination,
        source=plant,
        plant=back.scaled_plant(elimination.plant).replace(E=None, dt=plant.dt),
        recovery=recovery,
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
    for direct, state_effect in (("Dd", scaled.Bd), ("Df", scaled.Bf)):
        sizes = np.max(np.abs(state_effect), axis=0, initial=0.0)
        negligible = np.abs(getattr(scaled, direct)) <= ELIMINATION_ROUNDING * sizes
        changes[direct] = np.where(negligible, 0.0, getattr(plant, direct))
    return replace(transformation, plant=plant.replace(**changes))


def decoupling_condition(judge: Evaluator, before: str, after: str) -> Condition:
    """Return the condition (D1), with the unknown inputs that fail it."""
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
    condition = Condition(
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
        return condition
    # Without direct parts, as almost always, the condition is that [E Bd; C 0] has full rank.
    disturbances = judge.independent_disturbances
    free = [j for j in disturbances if not plant.Dd[:, j].any()]
    direct = [j for j in disturbances if j not in free]
    layout: list[list[str | None]] = (
        [["E", "Bd"], ["C", None]] if not direct else [["E", "Bd", None], ["C", None, "Dd"]]
    )
    return condition.in_doubt(judge.rank_doubt(FullRank(layout, {"Bd": free, "Dd": direct}), decision), plant)


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
