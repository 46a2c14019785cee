"""Unclear answers tell the tolerance, a plant within it with the other answer, and what would decide it.

The witness is confirmed by deciding existence on its exact numbers: the answer there is *no*, and nothing is unclear.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import block_diag

from obsynth import DescriptorSystem, PreconditionError, discretise, eliminate_algebraic_states
from obsynth.analysis.conditions import Condition
from obsynth.analysis.existence.witnesses import EntryChange, Unclear, Witness, rational_matrices
from obsynth.methods.fault_estimation_filter.conditions import fault_filter_conditions
from obsynth.methods.pd_observer.conditions import pd_observer_conditions
from obsynth.methods.recursive.conditions import recursive_conditions
from obsynth.methods.ui_pi_observer.conditions import existence
from obsynth.methods.ui_pi_observer.fault_model_condition import exact_drops
from obsynth.plants.exosystems import exosystem

#: A last digit or two of numbers near one.
LITTLE = 2.0**-51
#: The direction (1, 1) moves at 1 (1/s, or per sample: stays) and is all but hidden.
NEARLY_HIDDEN = {"A": [[-1.0, 2.0], [0.0, 1.0]], "C": [[1.0, -1.0 + LITTLE]]}
#: A constant fault is answered by x = (1, 1), which the outputs all but hide.
NEARLY_MASKED = {"A": [[-1.0, -1.0], [0.5, -2.0]], "Bf": [[2.0], [1.5]], "C": [[1.0, -1.0 + LITTLE], [2.0, -2.0]]}
#: Modes at 0.5 +- 1.5j, or 1.5 and 0.5, and 0.2, 0.1, in other integer coordinates: the first two are all but hidden.
MIXED = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 1, 1, 0], [1, 0, 0, 1]])
BACK = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, -1, 1, 0], [-1, 0, 0, 1]])
PAIR, TWO = ([[0.5, -1.5], [1.5, 0.5]], [[1.5, 0.5], [0, 0.5]])
HIDING = np.array([[0.0, -1 + LITTLE, 1, 0], [-1 + LITTLE, 0, 0, 1]])
#: A fault that oscillates with 2 rad/s is answered by x = (1, j, 1).
NEARLY_SINE = [[-1.0, 2, 0], [-1, 0, -0.5], [0, 2, -3]]


def ui_pi(plant: DescriptorSystem, fault_model: object = "step") -> tuple[Condition, ...]:
    return existence(plant, exosystem(fault_model, plant.fault_names, plant.dt)).conditions


def kalman(plant: DescriptorSystem) -> tuple[Condition, ...]:
    return tuple(recursive_conditions(plant, parameters=False))


def adaptive(plant: DescriptorSystem) -> tuple[Condition, ...]:
    return tuple(recursive_conditions(plant, parameters=True))


CASES = {
    "pd: a mode": (pd_observer_conditions, DescriptorSystem(None, **NEARLY_HIDDEN, Bf=[[1], [0]]), "detectability"),
    "pd: a constant fault": (pd_observer_conditions, DescriptorSystem(None, **NEARLY_MASKED), "rank [A F; C Df]"),
    "pd: like faults": (
        pd_observer_conditions,
        DescriptorSystem(None, [[-1, 0], [0.5, -2]], C=np.eye(2), Bf=[[1, 1], [1, 1 + LITTLE]]),
        "rank F",
    ),
    "filter: a mode": (
        fault_filter_conditions,
        DescriptorSystem(None, MIXED @ block_diag(TWO, 0.2, 0.1) @ BACK, C=HIDING, Bf=[[0], [0], [1], [0]], dt=0.1),
        "fault zeros",
    ),
    "filter: a pair of modes": (
        fault_filter_conditions,
        DescriptorSystem(None, MIXED @ block_diag(PAIR, 0.2, 0.1) @ BACK, C=HIDING, Bf=[[0], [0], [1], [0]], dt=0.1),
        "fault zeros",
    ),
    "filter: like faults": (
        fault_filter_conditions,
        DescriptorSystem(None, [[0.5, 0], [0.5, 0.2]], C=np.eye(2), Bf=[[1, 1], [1, 1 + LITTLE]], dt=0.1),
        "rank F",
    ),
    "filter: like outputs": (
        fault_filter_conditions,
        DescriptorSystem(None, [[0.5, 0], [0.5, 0.2]], C=[[1, 1], [1, 1 + LITTLE]], Bf=[[1], [1]], dt=0.1),
        "rank C",
    ),
    "filter: a state": (
        fault_filter_conditions,
        DescriptorSystem([[1, 1], [1, 1 + LITTLE]], [[0.5, 0], [0.5, 0.2]], C=[[1, 1]], Bf=[[1], [1]], dt=0.1),
        "rank [E; C]",
    ),
    "filter: faults that look alike at first": (
        fault_filter_conditions,
        DescriptorSystem(
            None,
            [[0.5, 0, 0.25], [0.5, 0.2, 0], [0, 0.5, 0.1]],
            C=[[1, 1, 0], [1, 1 + LITTLE, 1]],
            Bf=[[1, 0], [0, 1], [0, 0]],
            dt=0.1,
        ),
        "rank Upsilon",
    ),
    "kalman: a mode": (kalman, DescriptorSystem(None, **NEARLY_HIDDEN, dt=0.1), "detectability"),
    "kalman: a state": (
        kalman,
        DescriptorSystem([[1, 1], [1, 1 + LITTLE]], [[0.5, 0], [0.5, 0.2]], C=[[1, 1]], dt=0.1),
        "rank [E; C]",
    ),
    "adaptive: parameters": (
        adaptive,
        DescriptorSystem(None, [[0.5, 0], [0.5, 0.2]], C=np.eye(2), Bf=[[1, 1], [1, 1 + LITTLE]], dt=0.1),
        "identifiable parameters",
    ),
    "ui-pi: decoupling": (
        ui_pi,
        DescriptorSystem(None, [[-1, 1], [0.5, -2]], C=[[1, 1]], Bf=[[1], [0]], Bd=[[1], [-1 + LITTLE]]),
        "(D1) decoupling",
    ),
    "ui-pi: a sine": (
        lambda plant: ui_pi(plant, {"f1": {"sinusoid": 2.0}}),
        DescriptorSystem(None, NEARLY_SINE, C=[[1, 0, -1.0 + LITTLE], [2, 0, -2]], Bf=[[1], [-0.5], [3]]),
        "(D3) fault model at 0 +- 2j",
    ),
    "ui-pi: a mode": (ui_pi, DescriptorSystem(None, **NEARLY_HIDDEN, Bf=[[1], [0]]), "(D2) zeros"),
    "ui-pi: a constant fault": (ui_pi, DescriptorSystem(None, **NEARLY_MASKED), "(D3) fault model at 0"),
}


@pytest.mark.parametrize("case", CASES)
def test_the_witness_has_the_other_answer(case: str) -> None:
    conditions, plant, name = CASES[case]
    failed = [condition for condition in conditions(plant) if not condition.holds]
    condition = next(found for found in failed if found.name == name)
    doubt = condition.unclear
    assert doubt is not None
    assert doubt.witness is not None
    assert 0.0 < doubt.witness.size <= doubt.tolerance <= 1e-13
    assert (
        f"Tolerance: {doubt.tolerance:.1g} of the largest scaled entry. Witness: the plant with entry ("
        in condition.detail
    )
    assert "would decide it." in condition.detail
    with pytest.raises(PreconditionError, match=r"^Unclear: .*Witness: "):
        condition.require()
    changed = [found for found in conditions(doubt.witness.plant(plant)) if not found.holds]
    assert name in [found.name for found in changed]
    assert all(found.unclear is None for found in changed if found.name == name)


def test_a_long_fault_model_has_a_witness_of_its_own() -> None:
    plant = DescriptorSystem(
        [[1, 0, 0], [0, 0, 1], [0, 0, 0]], [[-5, 0, 0], [0, -2, 0], [0, -3, -1]], C=[[1, 0, 0], [0, 1, 0]],
        Bf=[[1], [1], [1]], Bd=[[1], [0], [-1]],
    )  # fmt: skip
    model = exosystem({"polynomial": 14}, plant.fault_names, 0.0)
    failed = existence(plant, model).conditions[-1]
    assert failed.unclear is not None
    witness = failed.unclear.witness
    assert witness is not None
    assert "of Phi of the fault model" in failed.detail
    drops = exact_drops(witness.plant(plant), witness.model(model))
    assert drops is not None
    assert not drops.facts.full or drops.facts.outside


def test_a_plant_that_was_sampled_or_reduced_is_named_so() -> None:
    chain = DescriptorSystem(
        np.diag([1.0, 1, 0]), [[0, 0, 0], [1, 0, 0], [0, 1, -1]], C=[[0, 0, 1], [0, 0, 2]], Bf=[[1], [1 + LITTLE], [-1]]
    )
    reduced = eliminate_algebraic_states(chain).plant
    for plant, kind in ((reduced, "without its algebraic states"), (discretise(reduced, 0.5).plant, "sampled plant")):
        text = Unclear(1e-14, Witness((EntryChange("A", 0, 0, Fraction(0), Fraction(1)),), 1e-15), "", "").described(
            plant
        )
        assert kind in text


def test_a_witness_is_named_entry_by_entry() -> None:
    conditions, plant, name = CASES["filter: like outputs"]
    condition = next(found for found in conditions(plant) if found.name == name)
    doubt = condition.unclear
    assert doubt is not None
    assert doubt.witness is not None
    (change,) = doubt.witness.changes
    before = rational_matrices(plant)[change.matrix][change.row, change.column]
    assert change.before == before
    # As it was written: 1.0000000000000004.
    assert abs(change.after - before) == Fraction("4e-16")
    assert f"entry ({change.row + 1}, {change.column + 1}) of C (output 'y" in condition.detail
