"""An unclear answer states its tolerance, a witness (a plant within it with the opposite answer), and what decides it.

The witness is confirmed by a decision on its exact numbers: the answer for it is *no*, without any doubt.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag

from obsynth import (
    DescriptorSystem,
    PreconditionError,
    check,
    discretise,
    eliminate_algebraic_states,
    functional_filter,
)
from obsynth.analysis.existence import named_pencils
from obsynth.analysis.existence.augmented_pencils import exact_drops
from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.filasova import pd_observer_conditions
from obsynth.analysis.existence.functional_filter import conditions as functional_conditions
from obsynth.analysis.existence.recursive import recursive_conditions
from obsynth.analysis.existence.sharepasand import existence
from obsynth.analysis.existence.statements import Evaluator, _first_of_the_largest
from obsynth.analysis.existence.wang2015 import fault_filter_conditions
from obsynth.analysis.existence.witnesses import EntryChange, Unclear, Witness, rational_matrices
from obsynth.plants.faults import exosystem

#: The last one or two digits of numbers near one.
LITTLE = 2.0**-51
#: The direction (1, 1) has an eigenvalue of 1 and is hidden from the output but for rounding.
NEARLY_HIDDEN: dict[str, Any] = {"A": [[-1.0, 2.0], [0.0, 1.0]], "C": [[1.0, -1.0 + LITTLE]]}
#: A constant fault leads to x = (1, 1), which is hidden from the outputs but for rounding.
NEARLY_MASKED: dict[str, Any] = {
    "A": [[-1.0, -1.0], [0.5, -2.0]],
    "Bf": [[2.0], [1.5]],
    "C": [[1.0, -1.0 + LITTLE], [2.0, -2.0]],
}
#: Modes at 0.5 +- 1.5j, or 1.5 and 0.5, and 0.2, 0.1, in other integer coordinates: the first two are all but hidden.
MIXED = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 1, 1, 0], [1, 0, 0, 1]])
BACK = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, -1, 1, 0], [-1, 0, 0, 1]])
PAIR, TWO = ([[0.5, -1.5], [1.5, 0.5]], [[1.5, 0.5], [0, 0.5]])
HIDING = np.array([[0.0, -1 + LITTLE, 1, 0], [-1 + LITTLE, 0, 0, 1]])
#: A fault that oscillates with 2 rad/s is answered by x = (1, j, 1).
NEARLY_SINE = [[-1.0, 2, 0], [-1, 0, -0.5], [0, 2, -3]]


def made(E: Any, A: Any, **fields: Any) -> DescriptorSystem:
    """Return a plant: integers and floats may be mixed."""
    return DescriptorSystem(E, A, **fields)


def ui_pi(plant: DescriptorSystem, fault_model: object = "step") -> tuple[Condition, ...]:
    return existence(plant, exosystem(fault_model, plant.fault_names, plant.dt)).conditions


def kalman(plant: DescriptorSystem) -> tuple[Condition, ...]:
    return tuple(recursive_conditions(plant, parameters=False))


def adaptive(plant: DescriptorSystem) -> tuple[Condition, ...]:
    return tuple(recursive_conditions(plant, parameters=True))


def functional(plant: DescriptorSystem) -> tuple[Condition, ...]:
    return functional_conditions(plant, exactly=True)


def test_what_floating_point_does_not_see_is_no_refusal_of_what_shows_on_paper() -> None:
    """Numbers with so many digits count as computed: a fault that shows only in exact arithmetic is unclear."""
    plant = made(None, **NEARLY_MASKED)
    with pytest.raises(PreconditionError, match=r"^Unclear: .*Witness: the plant with entry"):
        functional_filter(plant)


CASES: dict[str, tuple[Callable[[DescriptorSystem], tuple[Condition, ...]], DescriptorSystem, str]] = {
    "pd: a mode": (pd_observer_conditions, made(None, **NEARLY_HIDDEN, Bf=[[1], [0]]), "detectability"),
    "pd: a constant fault": (pd_observer_conditions, made(None, **NEARLY_MASKED), "rank [A F; C Df]"),
    "pd: like faults": (
        pd_observer_conditions,
        made(None, [[-1, 0], [0.5, -2]], C=np.eye(2), Bf=[[1, 1], [1, 1 + LITTLE]]),
        "rank F",
    ),
    "filter: a mode": (
        fault_filter_conditions,
        made(None, MIXED @ block_diag(TWO, 0.2, 0.1) @ BACK, C=HIDING, Bf=[[0], [0], [1], [0]], dt=0.1),
        "fault zeros",
    ),
    "filter: a pair of modes": (
        fault_filter_conditions,
        made(None, MIXED @ block_diag(PAIR, 0.2, 0.1) @ BACK, C=HIDING, Bf=[[0], [0], [1], [0]], dt=0.1),
        "fault zeros",
    ),
    "filter: like faults": (
        fault_filter_conditions,
        made(None, [[0.5, 0], [0.5, 0.2]], C=np.eye(2), Bf=[[1, 1], [1, 1 + LITTLE]], dt=0.1),
        "rank F",
    ),
    "filter: like outputs": (
        fault_filter_conditions,
        # With one of the two the fault has a zero at 2.
        made(None, [[0.5, 0], [0.5, 2]], C=[[1, 1], [1, 1 + LITTLE]], Bf=[[1], [0.5]], dt=0.1),
        "rank [C Dd]",
    ),
    "filter: a state": (
        fault_filter_conditions,
        made([[1, 1], [1, 1 + LITTLE]], [[0.5, 0], [0.5, 0.2]], C=[[1, 1]], Bf=[[1], [1]], dt=0.1),
        "rank [E; C]",
    ),
    "filter: faults that look alike at first": (
        fault_filter_conditions,
        made(
            None,
            [[0.5, 0, 0.25], [0.5, 0.2, 0], [0, 0.5, 0.1]],
            C=[[1, 1, 0], [1, 1 + LITTLE, 1]],
            Bf=[[1, 0], [0, 1], [0, 0]],
            dt=0.1,
        ),
        "rank Upsilon",
    ),
    "functional: a constant fault": (functional, made(None, **NEARLY_MASKED), "f1 follows its model"),
    "functional: like faults": (
        functional,
        made(None, [[-1, 0], [0.5, -2]], C=np.eye(2), Bf=[[1, 1], [1, 1 + LITTLE]]),
        "f1 follows its model",
    ),
    "kalman: a mode": (kalman, made(None, **NEARLY_HIDDEN, dt=0.1), "detectability"),
    "kalman: a state": (
        kalman,
        made([[1, 1], [1, 1 + LITTLE]], [[0.5, 0], [0.5, 0.2]], C=[[1, 1]], dt=0.1),
        "rank [E; C]",
    ),
    "kalman: an algebraic state": (
        kalman,
        made([[1, 1], [0, 0]], [[0.5, 0], [0.25, 1]], C=[[1, 1 + LITTLE]], dt=0.1),
        "rank [E; C]",
    ),
    "adaptive: parameters": (
        adaptive,
        made(None, [[0.5, 0], [0.5, 0.2]], C=np.eye(2), Bf=[[1, 1], [1, 1 + LITTLE]], dt=0.1),
        "identifiable parameters",
    ),
    "ui-pi: decoupling": (
        ui_pi,
        made(None, [[-1, 1], [0.5, -2]], C=[[1, 1]], Bf=[[1], [0]], Bd=[[1], [-1 + LITTLE]]),
        "(D1) decoupling",
    ),
    "ui-pi: a sine": (
        lambda plant: ui_pi(plant, {"f1": {"sinusoid": 2.0}}),
        made(None, NEARLY_SINE, C=[[1, 0, -1.0 + LITTLE], [2, 0, -2]], Bf=[[1], [-0.5], [3]]),
        "(D3) fault model at 0 +- 2j",
    ),
    "ui-pi: a mode": (ui_pi, made(None, **NEARLY_HIDDEN, Bf=[[1], [0]]), "(D2) zeros"),
    "ui-pi: a constant fault": (ui_pi, made(None, **NEARLY_MASKED), "(D3) fault model at 0"),
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
    # Faults that are alike do not show at all, at no pole of their models; outputs that are alike are one, which has
    # the zero.
    others = {"rank [C Dd]": "fault zeros"}.get(name, f"{name.split()[0]} detectable")
    assert {name, others} & {found.name for found in changed}
    assert all(found.unclear is None for found in changed)


@pytest.mark.parametrize("units", [1.0, 2.0**20])
def test_a_no_that_holds_only_exactly_names_the_gain_it_would_take(units: float) -> None:
    """With a last digit off, the outputs show x = (1, 1) by 2e-16 or less: a gain of 1e16 or more undoes that."""
    hidden = made(None, NEARLY_HIDDEN["A"], C=[[units, -units]], Bf=[[1], [0]])
    lost = pd_observer_conditions(hidden)[-1]
    assert (lost.holds, lost.unclear) == (False, None)
    told = re.search(r"every observer needs a gain of about (\S+) from 'y1' to 'x2'", lost.detail)
    assert told is not None
    assert float(told[1]) * units == pytest.approx(1e16, rel=0.2)
    with pytest.raises(PreconditionError, match=r"^No observer of this kind exists: .*detectability"):
        lost.require()


def test_of_two_states_that_move_as_much_the_first_is_named() -> None:
    """Which of two equal shares is larger would hang on the processor."""
    assert _first_of_the_largest(np.array([0.5, np.nextafter(0.7, 0.0), 0.7])) == 1
    assert _first_of_the_largest(np.array([0.5, 0.69, 0.7])) == 2


def test_what_no_output_holds_anything_of_no_digits_would_show() -> None:
    plant = made(None, [[0.5, 0], [0, 1.5]], C=[[1, 0]], dt=0.1)
    assert "No output depends on it" in kalman(plant)[-1].detail


def test_a_long_fault_model_has_a_witness_of_its_own() -> None:
    plant = made(
        [[1, 0, 0], [0, 0, 1], [0, 0, 0]], [[-5, 0, 0], [0, -2, 0], [0, -3, -1]], C=[[1, 0, 0], [0, 1, 0]],
        Bf=[[1], [1], [1]], Bd=[[1], [0], [-1]],
    )  # fmt: skip
    model = exosystem({"polynomial": 14}, plant.fault_names, 0.0)
    failed = existence(plant, model).conditions[-1]
    assert failed.unclear is not None
    witness = failed.unclear.witness
    assert witness is not None
    assert "of Phi of the fault model" in failed.detail
    drops = exact_drops(Evaluator(witness.plant(plant)), witness.model(model))
    assert drops is not None
    assert not drops[0].full or drops[0].outside


def test_a_plant_that_was_sampled_or_reduced_is_named_so() -> None:
    chain = made(
        np.diag([1.0, 1, 0]), [[0, 0, 0], [1, 0, 0], [0, 1, -1]], C=[[0, 0, 1], [0, 0, 2]], Bf=[[1], [1 + LITTLE], [-1]]
    )
    reduced = eliminate_algebraic_states(chain).plant
    for plant, kind in ((reduced, "without its algebraic states"), (discretise(reduced, 0.5).plant, "sampled plant")):
        text = Unclear(1e-14, Witness((EntryChange("A", 0, 0, Fraction(0), Fraction(1)),), 1e-15), "", "").described(
            plant
        )
        assert kind in text


def test_the_rows_of_a_check_say_that_they_are_unclear() -> None:
    row = check(CASES["pd: a mode"][1])["pd-observer"].failures[0]
    assert row.name == "exists: detectability"
    assert row.detail.startswith("Unclear: ")
    assert "Witness: the plant with entry (" in row.detail


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


@pytest.mark.parametrize("inside", [complex(0.6, 0.8) * (1.0 - 1e-9), complex(0.3, 0.4), complex(-0.2, 0.1)])
def test_a_point_inside_the_circle_is_stretched_onto_it_at_once(inside):
    # By one exact stretch: not by steps of the last digit, which never end for a point that is not near.
    for digits in (3, 8, 11):
        real, imaginary = named_pencils._placed(inside, digits, 0.1)
        assert 1 <= real * real + imaginary * imaginary <= 1 + Fraction(10, 10**digits)
        # The direction is that of the point, whose parts are rounded to so many digits.
        assert abs(float(imaginary) * inside.real - float(real) * inside.imag) <= 10.0 ** (1 - digits)
