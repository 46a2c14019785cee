"""(D1), whether the unknown inputs can be decoupled without differentiating; and the elimination that may help.

Source: Share Pasand, Aliyari, Taghirad, Lemma 4 (9.1), in the form of `obsynth.methods.ui_pi_observer.conditions`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.analysis.conditions import Condition
from obsynth.analysis.existence.distance import least_share
from obsynth.analysis.existence.numbers import numbers_of
from obsynth.analysis.existence.verdicts import rank_doubt, settled_rank
from obsynth.analysis.plant_units import PlantUnits, sized_plant
from obsynth.analysis.transformations.elimination import (
    dynamic_coordinates,
    eliminate_algebraic_states,
    eliminated_exactly,
)
from obsynth.analysis.transformations.recovery import StateRecovery, Transformation
from obsynth.analysis.zeros import leading_names
from obsynth.errors import PreconditionError
from obsynth.methods.ui_pi_observer.pencils import MOST_NAMES, kept_disturbances
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, RankDecision, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.origin import origin_of

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


def decoupling_rank(plant: DescriptorSystem) -> RankDecision:
    """Decide (D1): ``rank [E 0 Bd; C Dd 0; 0 0 Dd]``, with what it must be."""
    scaled, numbers = _scaled(plant), numbers_of(plant)
    if numbers is None:
        return decide_rank(_decoupling_matrix(scaled), expected=plant.nx + _rank(scaled.Dd) + disturbance_rank(plant))
    bd, dd = numbers.matrix("Bd"), numbers.matrix("Dd")
    nothing, square = numbers.zeros(plant.nx, plant.nd), numbers.zeros(plant.ny, plant.nd)
    matrix = numbers.blocks([
        [numbers.matrix("E"), nothing, bd],
        [numbers.matrix("C"), dd, square],
        [numbers.zeros(plant.ny, plant.nx), square, dd],
    ])  # fmt: skip
    expected = plant.nx + numbers.rank(dd) + disturbance_rank(plant)
    decision, terms = decide_rank(_decoupling_matrix(scaled), expected=expected), sized_plant(plant)
    if terms is None:
        return settled_rank(decision, numbers.rank(matrix))
    sizes = PlantUnits.of(plant).rounded().scaled_plant(terms)
    share = least_share(_decoupling_matrix(scaled), _decoupling_matrix(sizes), rank=expected)
    return settled_rank(decision, numbers.rank(matrix), share)


def _scaled(plant: DescriptorSystem) -> DescriptorSystem:
    return PlantUnits.of(plant).rounded().scaled_plant(plant)


def _decoupling_matrix(plant: DescriptorSystem) -> FloatArray:
    nx, ny, nd = plant.nx, plant.ny, plant.nd
    matrix = np.zeros((nx + 2 * ny, nx + 2 * nd))
    matrix[:nx, :nx], matrix[:nx, nx + nd :] = plant.E, plant.Bd
    matrix[nx : nx + ny, :nx], matrix[nx : nx + ny, nx : nx + nd] = plant.C, plant.Dd
    matrix[nx + ny :, nx + nd :] = plant.Dd
    return matrix


def disturbance_rank(plant: DescriptorSystem) -> int:
    """Return ``rank [Bd; Dd]``: repeated disturbances count once."""
    numbers = numbers_of(plant)
    if numbers is not None:
        return numbers.rank(numbers.blocks([[numbers.matrix("Bd")], [numbers.matrix("Dd")]]))
    scaled = _scaled(plant)
    return _rank(np.vstack([scaled.Bd, scaled.Dd]))


def _rank(matrix: FloatArray) -> int:
    return decide_rank(matrix).rank


def decoupling_data(plant: DescriptorSystem) -> tuple[DescriptorSystem, Transformation | None, Condition]:
    """Return the plant on which (D1) holds, if the algebraic states can be eliminated where it does not."""
    written = decoupling_rank(plant)
    said = f"rank {written.rank} of {written.expected}"
    if written.full:
        return plant, None, _decoupling_condition(plant, written, written.describe())
    try:
        transformation = _without_rounding(_eliminated(plant))
    except PreconditionError as error:
        why = _NOT_ELIMINATED.get(error.condition or "", "they cannot be solved for")
        reason = f"{written.describe()}, and the algebraic states cannot be eliminated ({why})"
        return plant, None, _decoupling_condition(plant, written, reason)
    if not transformation.description:
        return plant, None, _decoupling_condition(plant, written, written.describe())
    reduced = transformation.plant
    again = decoupling_rank(reduced)
    detail = f"{said} as written; {again.describe()} without the algebraic states"
    return reduced, transformation, _decoupling_condition(reduced, again, detail)


def _eliminated(plant: DescriptorSystem) -> Transformation:
    """Eliminate algebraic states in the plant's own units (orthogonal combinations depend on them), then undo these."""
    units = PlantUnits.of(plant)
    basis = dynamic_coordinates(units.scaled_plant(plant))
    found = eliminated_exactly(plant, None if basis is None else units.states[:, None] * basis)
    if found is not None:
        return found
    found = eliminate_algebraic_states(plant)
    if origin_of(found.plant) is not None:
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
        units, time=1.0 / units.time, equations=states, states=1.0 / states, outputs=1.0 / units.outputs,
        faults=1.0 / units.faults, disturbances=1.0 / units.disturbances,
    )  # fmt: skip
    old = found.recovery
    # A source state that cannot be recovered is not among these.
    own = np.array([kept.get(name, 1.0) for name in old.names])[:, None]
    recovery = StateRecovery(
        old.names, own * old.from_state / states, own * old.from_input, own * old.from_fault / units.faults,
        own * old.from_disturbance / units.disturbances,
        own * old.from_noise * (1.0 if units.discrete else np.sqrt(units.time)), old.noise_kept,
    )  # fmt: skip
    return replace(
        found, source=plant, plant=back.scaled_plant(found.plant).replace(E=None, dt=plant.dt), recovery=recovery
    )


def _without_rounding(transformation: Transformation) -> Transformation:
    """Set to zero what elimination left of a direct effect that is none: a rank decision would take it for one."""
    plant = transformation.plant
    if origin_of(plant) is not None:
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


def _decoupling_condition(plant: DescriptorSystem, decision: RankDecision, detail: str) -> Condition:
    signals: tuple[str, ...] = ()
    if not decision.full:
        signals = _undecoupled(plant)
        detail += ": " + (
            f"the unknown input {', '.join(map(repr, signals))} moves states that no output shows at once, so nothing "
            "but a derivative of the outputs could remove it. Measure such a state, or leave the input out."
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
    kept = kept_disturbances(plant, numbers_of(plant))
    free = [j for j in kept if not plant.Dd[:, j].any()]
    seen = [j for j in kept if j not in free]
    layout: list[list[str | None]] = [["E", "Bd"], ["C", None]] if not seen else [["E", "Bd", None], ["C", None, "Dd"]]
    doubt = rank_doubt(plant, PlantUnits.of(plant).rounded(), decision, layout, kept={"Bd": free, "Dd": seen})
    return found.in_doubt(doubt, plant)


def _undecoupled(plant: DescriptorSystem) -> tuple[str, ...]:
    """Return the unknown inputs that move what no output shows at once, or else the states in question."""
    matrix = _decoupling_matrix(_scaled(plant))
    pencil = equilibrate_pencil(np.zeros_like(matrix), matrix)
    hidden = np.linalg.svd(pencil.A)[2][decide_rank(matrix).rank :].T
    # Of all null vectors the one that moves the states most: some are there only because disturbances repeat.
    rotation = np.linalg.svd(hidden[: plant.nx])[2]
    direction = hidden @ rotation[0]
    shares = np.abs(direction[plant.nx + plant.nd :])
    if np.max(shares, initial=0.0) > RANK_TOLERANCE:
        return leading_names(shares, plant.disturbance_names, most=MOST_NAMES)
    return leading_names(np.abs(direction[: plant.nx]), plant.state_names, most=MOST_NAMES)
