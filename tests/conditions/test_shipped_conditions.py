"""`design.conditions()`: the paper's problem with the matrices of the certificate put in, whichever engine ran."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth import conditions

DESIGNS = Path(__file__).parents[2] / "designs"


@cache
def spec_of(path: str):
    return obsynth.load_spec(DESIGNS / path)


def plant_of(path: str):
    return spec_of(path).plant


def direct_plant():
    """Faults and disturbances that outputs show directly."""
    return obsynth.DescriptorSystem(
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]], [[0.9, 0.1, 0.0], [-0.2, 0.7, 0.1], [1.0, 0.5, -1.0]],
        C=[[1, 0, 0], [0, 0, 1], [0, 1, 0]], Bf=[[0.0], [1.0], [0.0]], Df=["y1"], Bd=[[0.1], [0.3], [0.0]],
        Dd=[[0.2], [0.0], [0.1]], dt=0.1, fault_names=["actuator", "sensor"],
    )  # fmt: skip


def quiet_plant():
    """No unknown input, so no gamma."""
    return direct_plant().replace(Bd=None, Dd=None, disturbance_names=None)


def kalman_plant(**more):
    return obsynth.DescriptorSystem(
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]], [[0.9, 0.1, 0], [-0.2, 0.7, 0.1], [1, 0.5, -1]], C=[[1, 0, 0], [0, 0, 1]],
        dt=0.1, **more,
    )  # fmt: skip


FEW = np.array([[2.0, 0.3], [0.0, 0.5]])
MADE = {
    "wang, riccati": lambda: obsynth.fault_estimation_filter(plant_of("wang2015/spec.yaml")),
    "wang, inequality": lambda: obsynth.fault_estimation_filter(plant_of("wang2015/spec.yaml"), engine="lmi"),
    "wang, free weight": lambda: obsynth.fault_estimation_filter(
        plant_of("wang2015/spec.yaml"), weight="free"
    ),
    "wang, mean": lambda: obsynth.fault_estimation_filter(plant_of("wang2015/spec.yaml"), mean=3),
    "wang, noise": lambda: obsynth.fault_estimation_filter(plant_of("drive/spec.yaml")),
    "wang, network": lambda: obsynth.fault_estimation_filter(plant_of("smib/spec.yaml")),
    "wang, direct": lambda: obsynth.fault_estimation_filter(direct_plant()),
    "wang, quiet": lambda: obsynth.fault_estimation_filter(quiet_plant()),
    "pd, inequality": lambda: obsynth.pd_observer(plant_of("filasova/spec.yaml"), delta=0.1, engine="lmi"),
    "pd, riccati": lambda: obsynth.pd_observer(plant_of("filasova/spec.yaml"), engine="riccati"),
    "pd, theorem 2": lambda: obsynth.pd_observer(plant_of("filasova/spec.yaml"), theorem=2, delta=0.1),
    "pd, decay": lambda: obsynth.pd_observer(plant_of("filasova/spec.yaml"), delta=0.1, decay=2.0),
    "pd, G": lambda: obsynth.pd_observer(plant_of("filasova/spec.yaml"), delta=0.1, adaptation_gain=FEW),
    "pd, algebraic states": lambda: obsynth.pd_observer(plant_of("sharepasand/spec.yaml").replace(
        Bd=None, disturbance_names=None)),
    "ui-pi, poles": lambda: obsynth.design(
        plant_of("sharepasand/spec.yaml"), "ui-pi-observer", **spec_of("sharepasand/spec.yaml").options
    ),
    "ui-pi, compromise": lambda: obsynth.ui_pi_observer(plant_of("sharepasand/spec.yaml"), fault_model="ramp"),
    "ui-pi, joint": lambda: obsynth.ui_pi_observer(plant_of("sharepasand/spec.yaml"), joint=True),
    "ui-pi, sampled": lambda: obsynth.ui_pi_observer(kalman_plant(Bf=[[0.0], [1.0], [0.0]])),
    "kalman": lambda: obsynth.descriptor_kalman(kalman_plant()),
    "kalman, noise": lambda: obsynth.descriptor_kalman(kalman_plant(Bw=np.eye(3), sensor_noise={"y1": 0.1, "y2": 0.2})),
    "kalman, unknown input": lambda: obsynth.descriptor_kalman(kalman_plant(Bd=[[1.0], [0.0], [0.0]])),
}  # fmt: skip


@cache
def made(name: str):
    return MADE[name]()


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", MADE)
def test_what_is_shipped_satisfies_the_printed_inequality(name):
    design = made(name)
    found = design.conditions()
    assert isinstance(found, conditions.Conditions)
    assert found.constraints
    for label, constraint in found.constraints.items():
        largest = max(np.abs(argument.value).max(initial=0.0) for argument in constraint.args)
        assert constraint.violation() <= 1e-12 * max(largest, 1.0), label
    assert found.existence.passed


#: Letters of which the paper's problem holds the same as the design.
LETTERS = {"wang": "TNLW", "pd": "JL", "ui-pi": ("U_a", "D_a", "K_a", "Ahat", "Bhat", "Jhat"), "kalman": "LK"}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", MADE)
def test_its_gains_are_those_that_are_shipped(name):
    design = made(name)
    gains = design.conditions().gains()
    for letter in LETTERS[name.split(",")[0]]:
        size = np.abs(design.gains[letter]).max(initial=0.0)
        np.testing.assert_allclose(gains[letter], design.gains[letter], rtol=0, atol=1e-7 * max(size, 1.0))


@pytest.mark.parametrize("name", ["wang, riccati", "pd, riccati", "ui-pi, poles"])
def test_a_gain_that_is_no_solution_violates_it(name):
    found = made(name).conditions()
    Y = found.variables["Y"]
    Y.value = -20.0 * Y.value
    assert max(constraint.violation() for constraint in found.constraints.values()) > 1e-2


def test_the_engine_is_told():
    assert made("wang, riccati").solver["engine"] == "riccati"
    assert made("pd, riccati").solver["engine"] == "riccati"
    assert made("pd, inequality").solver["engine"] == "lmi"


def test_a_design_from_a_file_has_them_too(tmp_path):
    path = made("wang, riccati").save(tmp_path / "wang.gains.json")
    found = obsynth.load(path).conditions()
    assert all(constraint.violation() <= 1e-10 for constraint in found.constraints.values())


def test_other_methods_say_that_they_have_none():
    design = obsynth.functional_filter(plant_of("filasova/spec.yaml"))
    with pytest.raises(obsynth.SpecError, match=r"'functional-filter' is not made of matrix inequalities; those that"):
        design.conditions()


@pytest.mark.parametrize("name", ["wang, riccati", "pd, decay", "ui-pi, poles", "kalman"])
def test_state_spaces_of_scipy_and_control_are_the_observer(name):
    design = made(name)
    ours, theirs = design.to_scipy(), design.to_control()
    for letter in "ABCD":
        np.testing.assert_array_equal(getattr(ours, letter), getattr(theirs, letter))
    assert (ours.dt or 0.0) == theirs.dt == design.observer.dt


def test_a_mat_file_has_the_gains_under_the_letters_of_the_paper(tmp_path):
    from scipy.io import loadmat

    design = made("wang, riccati")
    obsynth.export(design, tmp_path / "filter.mat")
    found = loadmat(tmp_path / "filter.mat", simplify_cells=True)
    for letter in "TNLW":
        np.testing.assert_array_equal(found["gains"][letter], design.gains[letter])
    np.testing.assert_array_equal(found["certificate"]["P_factor"], design.certificate.matrices["P_factor"])
