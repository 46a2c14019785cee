"""A refusal says that nothing exists only where no method estimates the faults; else whose assumption it is."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import obsynth

#: A mode that nothing shows and that does not decay: no observer of the whole state, and yet the fault shows.
HIDDEN = obsynth.DescriptorSystem(A=[[-1.0, 0.0], [0.0, 1.0]], C=[[1.0, 0.0]], Bf=[[1.0], [0.0]])


@pytest.mark.parametrize("method", ["ui-pi-observer", "pd-observer"])
def test_a_method_that_assumes_more_is_named_with_one_that_does_not(method):
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.design(HIDDEN, method)
    text = str(caught.value)
    assert text.startswith(f"{method} assumes more than this plant has: the condition ")
    assert "No observer" not in text
    assert "The faults can be estimated: functional-filter exists." in text
    assert "Measure one of: x2." in text
    assert caught.value.exit_code == 3
    # What is printed was tried.
    assert obsynth.functional_filter(HIDDEN).report.passed
    measured = HIDDEN.replace(C=np.eye(2), output_names=["y1", "x2"], D=None, Df=None, Dd=None, Dw=None)
    assert obsynth.design(measured, method).report.passed


@pytest.mark.parametrize("method", ["ui-pi-observer", "pd-observer", "functional-filter"])
def test_nothing_exists_only_where_no_method_does(method):
    plant = obsynth.DescriptorSystem(A=[[-1.0, 0.0], [0.0, -2.0]], C=[[0.0, 1.0]], Bf=[[1.0], [0.0]])
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.design(plant, method)
    assert "assumes more" not in str(caught.value)
    assert not any(report.passed for name, report in obsynth.check(plant).items() if name == method)


def test_what_unknown_inputs_reach_is_not_called_estimated() -> None:
    """A fault that moves the plant as an unknown input does: the PD observer exists, and estimates both together."""
    plant = obsynth.DescriptorSystem(A=[[-1, 1], [0, -2]], C=np.eye(2), Bf=[[0], [1]], Bd=np.eye(2))
    with pytest.raises(obsynth.PreconditionError, match="pd-observer exists, but d1, d2 reach its estimates") as caught:
        obsynth.functional_filter(plant)
    assert "can be estimated" not in str(caught.value)
    design = obsynth.pd_observer(plant)
    assert design.report.passed
    static = -np.linalg.solve(plant.A, plant.Bd[:, 1])  # where the plant settles under the unknown input
    observer = design.linear[1]
    driven = np.linalg.solve(observer.Az, observer.By @ static)
    assert abs(observer.Cz[observer.fault_rows] @ -driven + observer.Dy[observer.fault_rows] @ static)[0] > 0.5


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"Bd": [[1.0], [0.0]], "Bw": None, "Dw": None}, "functional_filter with residuals='detect' exists"),
        ({"Bd": np.eye(2), "Bw": None, "Dw": None}, "State the noise of all sensors"),
        ({"A": np.diag([1.0, -1.0]), "C": [[0.0, 1.0], [0.0, 2.0]]}, "Measure one of: x1."),
        ({"A": np.diag([0.0, -1.0])}, "State noise of the states"),
    ],
)
def test_no_assumption_of_the_detection_filter_is_said_to_exclude_others(changes: dict, words: str) -> None:
    parts = {
        "A": [[-1, 1], [0, -2]],
        "C": np.eye(2),
        "Bf": [[0], [1]],
        "Bw": np.zeros((2, 2)),
        "Dw": np.eye(2),
    } | changes
    plant = obsynth.DescriptorSystem(**{name: part for name, part in parts.items() if part is not None})
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.detection_filter(plant)
    assert str(caught.value).startswith("This method does not take the plant as it is")
    assert words in str(caught.value)
    # What is printed was tried.
    residuals = {"residuals": "detect"}
    if "functional_filter" in words:
        assert obsynth.functional_filter(plant, **residuals).report.passed
        return
    if "Measure" in words:
        plant = obsynth.DescriptorSystem(
            A=plant.A, C=np.vstack([plant.C, [1.0, 0.0]]), Bf=plant.Bf, Bw=np.zeros((2, 3)), Dw=np.eye(3)
        )
    elif "states" in words:
        plant = plant.replace(
            Bw=np.hstack([plant.Bw, np.eye(2)]), Dw=np.hstack([plant.Dw, np.zeros((2, 2))]), noise_names=None
        )
    else:
        with pytest.raises(obsynth.PreconditionError):
            obsynth.functional_filter(plant, **residuals)
        plant = plant.replace(Bw=np.zeros((2, 2)), Dw=np.eye(2), noise_names=None)
    assert obsynth.detection_filter(plant).report.passed


def _spring() -> obsynth.PolytopicSystem:
    return obsynth.PolytopicSystem(
        plant={
            "A": [[1.0, 0.1], ["-0.1 * k", 0.9]], "C": [[1, 0], [0, 1]], "Bf": [[0], [1]], "dt": 1.0,
            "output_names": ["x", "v"], "fault_names": ["push"],
        },
        scheduling={"k": [1.0, 2.0]},
    )  # fmt: skip


@cache
def _named_are_designed() -> bool:
    """Whether the methods that are named design: one takes noise of sensors as the Kalman filter would."""
    noise = {"measurement": {"x": 0.1, "v": 0.2}}
    designs = obsynth.ui_pi_observer(_spring(), noise=noise), obsynth.fault_estimation_filter(_spring())
    return all(design.report.passed for design in designs)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("method", ["adaptive_observer", "pd_observer", "functional_filter", "optimal_filter"])
def test_a_method_that_does_not_take_a_region_says_nothing_of_other_observers(method: str) -> None:
    with pytest.raises(obsynth.PreconditionError, match=r"^This method does not take the plant") as e:
        getattr(obsynth, method)(_spring())
    assert "methods for such plants are: fault-estimation-filter, ui-pi-observer" in str(e.value)
    # What is named was tried.
    assert _named_are_designed()


def test_a_continuous_plant_is_no_plant_without_an_observer() -> None:
    plant = obsynth.DescriptorSystem(None, [[-1.0, 0.0], [1.0, -2.0]], None, [[0.0, 1.0]], Bf=[[1.0], [0.0]])
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.fault_estimation_filter(plant)
    text = str(caught.value)
    assert "No observer of this kind exists" not in text
    assert "'discrete time' fails" in text
    assert obsynth.fault_estimation_filter(obsynth.discretise(plant, 0.1)) is not None


def test_an_option_without_which_the_design_exists_is_the_remedy():
    plant = obsynth.DescriptorSystem(A=[[0.5, 1.0], [0.0, 0.9]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]], dt=1.0)
    with pytest.raises(obsynth.PreconditionError, match=r"It exists with delay 'auto' in place of 0\.$"):
        obsynth.optimal_filter(plant, delay=0)
    assert obsynth.optimal_filter(plant, delay="auto").report.passed
    disturbed = obsynth.DescriptorSystem(A=plant.A, C=plant.C, Bf=plant.Bf, Bd=[[1.0], [0.0]], dt=1.0)
    with pytest.raises(obsynth.PreconditionError, match=r"It exists without decoupled\.$"):
        obsynth.optimal_filter(disturbed, decoupled=["d1"])
    assert obsynth.optimal_filter(disturbed).report.passed
