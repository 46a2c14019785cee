"""Plants of which elimination or natural units make much of what is rounding, and observers whose numbers cancel."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable

import numpy as np
import pytest

import obsynth
from obsynth.report.plants import is_unclear, method_lines


def test_a_fault_of_which_elimination_leaves_only_rounding_is_unclear() -> None:
    # The algebraic equation takes the fault up whole, but for the last digit of the number with fifteen of them.
    plant = obsynth.DescriptorSystem(
        [[1.0, 0.0, 2.0**-25], [-65536.0, 128.0, -(2.0**-9)], [0.0, 0.0, 0.0]],
        [[1.5, -(2.0**-9), 5.21540641784668e-08], [-8192.0, 32.0, -0.000732421875], [8.0, 0.0, 2.0**-23]],
        C=[[-4096.0, 16.0, -(2.0**-13)], [-4096.0, 32.0, -(2.0**-13)]],
        Bf=[[2.0**-21], [-0.03125], [-(2.0**-17)]],
        Bd=[[0.375], [0.0], [2.0]],
        dt=1.0,
    )
    with pytest.raises(obsynth.PreconditionError, match=r"Unclear.*\(D3\)") as caught:
        obsynth.ui_pi_observer(plant)
    assert caught.value.condition == "(D3) fault model at 1"
    assert caught.value.unclear
    # The row says so in a field; its words alone say nothing.
    (row,) = [row for row in obsynth.check(plant)["ui-pi-observer"].failures if row.unclear]
    assert row.name == "exists: (D3) fault model at 1"
    assert is_unclear([row])
    ((_, text, _),) = method_lines({"ui-pi-observer": obsynth.VerificationReport.of([row])})
    assert text.startswith("UNCLEAR for this plant: the condition '(D3) fault model at 1' is not decided. Needed: ")
    assert "Found: Unclear" not in text
    assert not is_unclear([dataclasses.replace(row, unclear=False)])
    report = obsynth.VerificationReport.of([row, dataclasses.replace(row, name="other", unclear=False)])
    assert obsynth.VerificationReport.from_dict(report.as_dict()) == report
    assert [("unclear" in data) for data in report.as_dict()["checks"]] == [True, False]


METHODS: dict[str, tuple[float, Callable[[obsynth.DescriptorSystem], obsynth.ObserverDesign]]] = {
    "pd": (0.0, obsynth.pd_observer),
    "filter": (1.0, lambda plant: obsynth.fault_estimation_filter(obsynth.eliminate_algebraic_states(plant))),
    "filter, sampled": (0.0, lambda plant: obsynth.fault_estimation_filter(obsynth.discretise(plant, 0.5))),
    "ui-pi": (1.0, obsynth.ui_pi_observer),
    "ui-pi, continuous": (0.0, obsynth.ui_pi_observer),
    "functional": (0.0, obsynth.functional_filter),
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("share", "entering"), [(1.0, -1 - 2.0**-51), (0.333333333333333, -3.0)])
@pytest.mark.parametrize("spread", [0, 13])
@pytest.mark.parametrize("method", METHODS)
def test_no_method_makes_anything_of_what_elimination_leaves_by_rounding(
    method: str, spread: int, share: float, entering: float
) -> None:
    """The algebraic equation takes the fault out of the dynamic one but for its last digit, written or computed."""
    rng = np.random.default_rng(spread)
    equations, states, outputs, faults = (2.0 ** rng.integers(-spread, spread + 1, size=size) for size in (3, 3, 2, 1))
    left = equations[:, None]
    dt, design = METHODS[method]
    a = np.array([[-0.5, 0.25, share], [0.5, -0.25, 0], [0.25, 0, -1]])
    plant = obsynth.DescriptorSystem(
        left * np.diag([1.0, 1, 0]) * states, left * a * states, C=outputs[:, None] * np.eye(3)[:2] * states,
        Bf=left * np.array([[1.0], [0], [entering]]) * faults, dt=dt,
    )  # fmt: skip
    with pytest.raises(obsynth.PreconditionError, match=r"^Unclear: .*Tolerance: .*Witness: the .*would decide it"):
        design(plant)


def test_an_observer_whose_numbers_cancel_says_what_that_does() -> None:
    shear = np.array([[1.0, 1e3, 1e3], [0, 1, 1e3], [0, 0, 1]])
    back = np.linalg.inv(shear)
    a = np.array([[0.8, 0.3, 0], [0, 0.8, 0.2], [0.1, 0, 0.7]])
    plant = obsynth.DescriptorSystem(
        np.eye(3), shear @ a @ back, C=np.eye(3)[[0, 2]] @ back, Bf=shear @ [[0.0], [1], [0]], dt=1.0
    )
    # By default it is refused: in double precision a constant fault is missed by more than the limit.
    with pytest.raises(obsynth.VerificationError, match="constant fault"):
        obsynth.ui_pi_observer(plant)
    design = obsynth.ui_pi_observer(plant, steady_error_limit=0.1)
    (note,) = [note for note in design.notes if "The entries of the observer cancel" in note]
    # Which last digits the gains have is the platform's affair; the size of what they do is not.
    (share,) = re.findall(r"by ([0-9.e-]+) of the fault, and by more", note)
    assert 1e-6 < float(share) < 1e-3


def test_a_filter_that_once_cancelled_does_so_no_more() -> None:
    """A plant without noise and almost without a least gain, an equation of which is small beside an output."""
    plant = obsynth.DescriptorSystem(
        [[64.0, -131072.0, 256.0], [0.0, 128.0, -0.25], [0.0, 0.0, 256.0]],
        [[32.0, -131072.0, 256.0], [0.03125, -128.0, 0.125], [16.0, -32768.0, 0.0]],
        C=[[-0.0078125, 0.0, 0.03125], [0.0009765625, 2.0, -0.01171875]],
        Bf=[[-524288.0], [-256.0], [-524288.0]],
        Bd=[[-4.0], [0.0078125], [0.0]],
        dt=1.0,
    )
    design = obsynth.fault_estimation_filter(obsynth.eliminate_algebraic_states(plant).plant)
    assert not [note for note in design.notes if "The entries of the observer cancel" in note]


def test_other_observers_do_not_say_so() -> None:
    rng = np.random.default_rng(3)
    plant = obsynth.DescriptorSystem(
        A=0.5 * np.eye(3) + 0.1 * rng.normal(size=(3, 3)), B=np.zeros((3, 0)), C=np.eye(3)[:2] + 0.1,
        Bf=[[1.0], [0.0], [0.0]], Bd=[[0.0], [0.0], [0.1]], dt=0.1,
    )  # fmt: skip
    assert not [note for note in obsynth.fault_estimation_filter(plant).notes if "cancel" in note]
