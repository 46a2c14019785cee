"""Every argument of every public function, given as what it cannot be: always a SpecError that names it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache

import control
import numpy as np
import pandas as pd
import pytest
from scipy import signal

import obsynth
from obsynth import SpecError, conditions, plotting

#: Annotations that say nothing about the kind, or whose kinds the function itself tells apart.
OPEN = ("Any", "Data", "LogData", "Logs", "Picked")
#: Functions made from the classes of methods, whose fields are checked, and those of one argument that may be anything.
NOT_CHECKED = {
    "adaptive_observer", "dae_adaptive_observer", "descriptor_kalman", "detection_filter", "extended_kalman",
    "fault_estimation_filter", "fault_model", "functional_filter", "guaranteed_test", "pd_observer", "region_observer",
    "ui_pi_observer",
}  # fmt: skip


def functions() -> dict[str, Callable[..., object]]:
    found = {}
    for module in (obsynth, plotting, conditions):
        for name in module.__all__:
            if inspect.isfunction(getattr(module, name)) and name not in NOT_CHECKED:
                found[f"{module.__name__}.{name}"] = getattr(module, name)
    return found


@pytest.mark.parametrize("name", functions())
def test_all_arguments_of_a_wrong_kind_are_told_at_once(name):
    function = functions()[name]
    parameters = [p for p in inspect.signature(function).parameters.values() if p.kind is not p.VAR_KEYWORD]
    with pytest.raises(SpecError) as told:
        function(**{parameter.name: object() for parameter in parameters})
    lines = str(told.value).splitlines()
    for parameter in parameters:
        if parameter.annotation not in OPEN:
            assert sum(f"{parameter.name} is a" in line or f"{parameter.name} is <" in line for line in lines) == 1


def plant(**more) -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(None, 0.5 * np.eye(2), C=np.eye(2), dt=1.0, **more)


class NoArray:
    """As arrays of other libraries that live elsewhere."""

    def __array__(self, *args, **kwargs):
        raise RuntimeError("it is on another device")


@cache
def design() -> obsynth.ObserverDesign:
    return obsynth.ui_pi_observer(plant(Bf=[[1.0], [0.0]]))


LINEAR = obsynth.LinearObserver(
    [[0.5]], np.zeros((1, 0)), [[1.0]], [[1.0]], np.zeros((1, 0)), [[0.0]], 1.0, (), ("y",), ("x",), (), (), (0,), ()
)
MODEL = {"equations": {"x": "der(x) + x"}, "outputs": {"y": "x"}, "states": {"x": 1.0}}
GAINS = {"T": np.eye(2), "N": np.zeros((2, 2)), "L": np.zeros((2, 2)), "W": np.zeros((1, 2))}
FAULTY = {"Bf": [[1.0], [0.0]], "Bd": [[0.0], [1.0]]}
CALLS: dict[str, tuple[Callable[[], object], str]] = {
    "a range": (lambda: obsynth.simulate_dae(obsynth.DAEModel(**MODEL), [], dt=0.1, seed=-1), "seed is -1"),
    "a list of lists": (lambda: obsynth.decouple(plant(**FAULTY), without=[["f1"]]), "give a list of names"),
    "an array that is none": (lambda: plant(Bf=NoArray()), "Bf is a NoArray that is no array: it is on another"),
    "uncertainty": (lambda: plant(uncertainty=3), "uncertainty is an int"),
    "parts of uncertainty": (lambda: plant(uncertainty={}), "uncertainty has no 'box'"),
    "exact": (lambda: plant(exact=np.eye(2)), "exact is a ndarray"),
    "an array without axes": (lambda: obsynth.decouple(plant(**FAULTY), without=np.array(1.0)), "without is a ndarray"),
    "an array for a log": (
        lambda: obsynth.run_on_data(obsynth.functional_filter(plant(**FAULTY)), np.zeros((5, 2))),
        "data is an array, whose columns have no names",
    ),
    "an empty array for a scenario": (
        lambda: obsynth.guaranteed_test(plant(**FAULTY), scenario=np.array([])),
        "scenario is for plants whose constants",
    ),
    "a first state that is a text": (
        lambda: obsynth.descriptor_kalman(plant(**FAULTY), initial_state=""), "initial_state is '': give real numbers",
    ),
    "a first variance below 0": (
        lambda: obsynth.descriptor_kalman(plant(**FAULTY), initial_covariance=-1.0),
        "initial_covariance is no covariance",
    ),
    "rows of different lengths": (
        lambda: obsynth.descriptor_kalman(plant(**FAULTY), Q=[[1, 2], [3]]), "Q has rows of different lengths",
    ),
    "a function of nothing": (
        lambda: obsynth.fault_estimation_filter(plant(**FAULTY), constraints=lambda: []),
        "constraints is a function that does not take one argument",
    ),
    "an array for a plant": (lambda: obsynth.PolytopicSystem(plant=np.array([])), "plant is a ndarray"),
    "parts of exact": (lambda: plant(exact={}), "exact has no 'matrices'"),
    "definitions": (lambda: obsynth.DAEModel(**MODEL, definitions=np.eye(2)), "definitions"),
    "state": (lambda: LINEAR.step(None, [1.0]), "state is missing"),
    "observer's dt": (lambda: LINEAR.from_dict({**LINEAR.as_dict(), "dt": None}), "dt of the observer is missing"),
    "observer's data": (lambda: LINEAR.from_dict(3), "data is an int"),
    "fault model": (lambda: obsynth.FaultModel("a", [[1.0]], "mine"), "Phi holds text"),
    "gamma of gains": (
        lambda: obsynth.design_from_gains(plant(**FAULTY), "fault-estimation-filter", **GAINS, gamma=float("nan")),
        "gamma is nan: give a number above 0",
    ),
    "tiny gamma": (
        lambda: obsynth.design_from_gains(plant(**FAULTY), "fault-estimation-filter", **GAINS, gamma=1e-310),
        "1 / gamma",
    ),
    "huge covariance": (
        lambda: obsynth.steady_state_filter(plant(), Q=np.full((2, 2), 1e308), R=np.eye(2)),
        "Q has 1e",
    ),
    "huge level": (lambda: conditions.wang2015(plant(**FAULTY), gamma=1e308), "gamma is 1e"),
    "column that is a list": (
        lambda: obsynth.run_on_data(design(), pd.DataFrame({"time": [0.0, 1.0]}), columns={"y1": []}),
        "The column of 'y1' is",
    ),
    "parameter without a name": (
        lambda: obsynth.sweep({"a": plant()}, {1: [1.0]}, method="fault-estimation-filter"),
        "The parameter 1 is",
    ),
    "step of no plant": (lambda: obsynth.Scenario(horizon=1.0).step_of(None), "plant is missing"),
    "huge bound of a start": (
        lambda: obsynth.monitor(design(), obsynth.Scenario(horizon=5.0), initial_error=1e308),
        "initial_error is 1e",
    ),
    "steps of noise": (
        lambda: obsynth.with_noise(obsynth.DAEModel(**MODEL), process_noise={"x": 0.1}, dt=1e-310),
        "1 / dt",
    ),
    "folder with a zero": (
        lambda: obsynth.sweep({"a": plant()}, {"gamma": [1.0]}, method="fault-estimation-filter", folder="a\0b"),
        "cannot be used as a folder",
    ),
    "no file can have that name": (lambda: obsynth.verify_certificate("a\0b"), ""),
}  # fmt: skip


@pytest.mark.parametrize("what", CALLS)
def test_values_that_ended_in_errors_of_others_are_refused_by_name(what):
    call, words = CALLS[what]
    with pytest.raises(SpecError) as told:
        call()
    assert words in str(told.value)


def test_names_of_outputs_may_be_an_array_beside_noise_by_name():
    named = plant(output_names=np.array(["a", "b"]), sensor_noise={"a": 0.1, "b": 0.2})
    assert (named.output_names, named.noise_names) == (("a", "b"), ("noise a", "noise b"))


def test_small_numbers_of_numpy_do_not_overflow():
    """Whole numbers of eight bits end at 127, also in products."""
    continuous = obsynth.DescriptorSystem(A=-np.eye(2), C=np.eye(2), **FAULTY)
    by_numpy, plain = (
        obsynth.compare(continuous, sample_time=time, methods=["functional-filter"], runs=2)
        for time in (np.int8(1), 1.0)
    )
    np.testing.assert_array_equal(by_numpy.truth, plain.truth)


def test_arguments_of_the_right_kind_are_not_judged_by_their_class():
    diagnosed = obsynth.diagnose(plant(**FAULTY), frequencies=np.array([0.1]), suggest=np.True_)
    assert diagnosed.faults


A_PLANT = {"A": [[0.9, 0.1], [0.0, 0.8]], "C": [[1.0, 0.0]], "Bf": [[1.0], [0.0]], "dt": 1.0}
OTHER_PLANTS = {
    "python-control": (lambda: control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), "by obsynth.from_control(model)"),
    "scipy": (lambda: signal.StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), "by obsynth.from_scipy(model)"),
    "a mapping": (lambda: A_PLANT, "obsynth.DescriptorSystem(**plant)"),
}


@pytest.mark.parametrize("kind", OTHER_PLANTS)
@pytest.mark.parametrize(
    "take", [obsynth.fault_estimation_filter, obsynth.check, obsynth.design, obsynth.diagnose, conditions.wang2015]
)
def test_what_makes_a_plant_of_another_one_is_told(kind, take):
    made, told = OTHER_PLANTS[kind]
    with pytest.raises(SpecError, match=r"plant is a .*: give an obsynth\.DescriptorSystem") as refused:
        take(made())
    assert told in str(refused.value)


def test_what_is_told_makes_a_plant():
    assert obsynth.DescriptorSystem(**A_PLANT).nf == 1
    assert obsynth.from_control(OTHER_PLANTS["python-control"][0]()).nx == 1
    assert obsynth.from_scipy(OTHER_PLANTS["scipy"][0]()).nx == 1
