"""`check` says no where `design` refuses for want of what the user states: noise, a sample time, options of auto."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import obsynth as ob
from obsynth.cli.main import main
from obsynth.methods.registry import method_class

LINEAR = ob.DescriptorSystem(
    np.diag([1.0, 1.0, 0.0]),
    [[0.9, 0.1, 0.0], [-0.2, 0.7, 0.1], [1.0, 0.5, -1.0]],
    C=[[1, 0, 0], [0, 0, 1]],
    Bf=[[0], [1], [0]],
    dt=0.1,
)
TANK = ob.DAEModel(
    {"balance": "2 * der(level) = inflow - outflow", "valve": "outflow = c * sqrt(level)"},
    {"flow": "outflow"},
    states={"level": 1.0, "outflow": 0.5},
    inputs={"inflow": 0.5},
    parameters={"c": 0.5},
)
#: The second output is twice an algebraic state that is known without noise, but for the parameters.
FIXED = ob.DescriptorSystem(
    np.diag([1.0, 0.0]),
    [[-0.5, 0.0], [1.0, 0.0]],
    C=[[0.0, 0.0], [0.0, 2.0]],
    Bf=[[2.0, 0.0], [0.0, 0.0]],
    Df=[[0.0, -2.0], [-1.0, 2.0]],
    Bw=np.zeros((2, 2)),
    Dw=0.1 * np.eye(2),
    dt=1.0,
)
GROWING = LINEAR.replace(A=[[2.0, 0.1, 0.0], [-0.2, 1.5, 0.1], [1.0, 0.5, -1.0]])
BIASED = ob.DAEModel(
    {"balance": "der(level) = -level"}, {"y": "level + bias"}, states={"level": 1.0}, parameters={"bias": 0.0}
)
NOISE = {"dt": 1.0, "Q": 1e-4, "R": 1e-4}


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("plant", "method", "options", "words"),
    [
        (TANK, "dae-adaptive-observer", {"dt": 1.0, "R": 1e-4}, "Q is missing"),
        (TANK, "dae-adaptive-observer", {"dt": 1.0, "Q": {"balance": 1e-4}}, "R is missing"),
        (BIASED, "dae-adaptive-observer", NOISE, "initial_parameter_covariance is missing"),
        (LINEAR.replace(Bw=np.ones((3, 2)), Dw=np.eye(2)), "descriptor-kalman", {"Q": np.eye(3)}, "Bw Dw' is not zero"),
        (LINEAR.replace(Bw=np.ones((3, 2)), Dw=np.eye(2)), "adaptive-observer", {"R": np.eye(2)}, "Bw Dw' is not zero"),
        (LINEAR.replace(Bd=np.eye(3), Dd=np.zeros((2, 3))), "descriptor-kalman", {}, "outputs do not determine"),
        (FIXED, "adaptive-observer", {}, "determine the parameters exactly"),
        (FIXED, "adaptive-observer", {"Q": 0.1, "R": 0.0}, "determine the parameters exactly"),
        (GROWING, "descriptor-kalman", {"Q": 0.0, "R": 0.1, "initial_covariance": 0.0}, "Errors do not decay"),
        (LINEAR.replace(Bw=np.eye(3), Dw=np.zeros((2, 3))), "functional-filter", {}, "free of noise"),
        (LINEAR.replace(dt=0.0, A=-LINEAR.A), "functional-filter", {"delay": 2}, "count samples"),
        (LINEAR.replace(dt=0.0, A=-LINEAR.A), "optimal-filter", {"delay": 2}, "discrete time"),
    ],
)
def test_check_tells_what_is_not_stated(plant: Any, method: str, options: dict[str, Any], words: str) -> None:
    report = ob.check(plant, {method: options})[method]
    assert [words in row.detail for row in report.failures] == [True]
    with pytest.raises(ob.ObsynthError, match=words):
        ob.design(plant, method, **options)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("plant", "method", "options"),
    [
        (TANK, "dae-adaptive-observer", NOISE),
        (LINEAR.replace(Bw=np.ones((3, 2)), Dw=np.eye(2)), "descriptor-kalman", {}),
        (LINEAR.replace(Bw=np.ones((3, 2)), Dw=np.eye(2)), "descriptor-kalman", {"Q": np.eye(3), "R": np.eye(2)}),
        (FIXED, "adaptive-observer", {"Q": 0.1, "R": 0.1}),
        (GROWING, "descriptor-kalman", {"Q": 0.0, "R": 0.1}),
        (LINEAR, "descriptor-kalman", {"Q": np.diag([0.1, 0.0, 0.0]), "R": 0.1}),
        (LINEAR.replace(Bw=np.eye(3), Dw=np.zeros((2, 3))), "functional-filter", {"noise": {"y1": 0.1, "y2": 0.1}}),
    ],
)
def test_what_is_stated_is_enough(plant: Any, method: str, options: dict[str, Any]) -> None:
    assert ob.check(plant, {method: options})[method].passed
    assert ob.design(plant, method, **options).report.passed


@pytest.mark.long
def test_large_plants_have_the_answer_of_a_design() -> None:
    # Of more than 60 states no gains were formed: the filter was said to exist.
    states = 61
    method = method_class("descriptor-kalman").of({"Q": 0.0, "R": 0.1, "initial_covariance": 0.0})
    growing, decaying = (
        ob.DescriptorSystem(A=np.diag([factor, *np.full(states - 1, 0.5)]), C=np.eye(states)[:2], dt=1.0)
        for factor in (1.5, 0.5)
    )
    assert all(condition.holds for condition in method.existence(growing))
    with pytest.raises(ob.PreconditionError, match="Errors do not decay"):
        method.require_stated(growing)
    method.require_stated(decaying)
    # A mode that grows is corrected as soon as it is not known exactly, whatever Q is.
    unknown = method_class("descriptor-kalman").of({"Q": 0.0, "R": 0.1})
    unknown.require_stated(growing)
    assert ob.design(growing, "descriptor-kalman", Q=0.0, R=0.1).certificate.claims["contraction"] < 0.9


def test_a_question_without_options_is_one_about_the_plant() -> None:
    assert ob.check(TANK)["dae-adaptive-observer"].passed


def test_options_of_auto_are_those_of_every_method_that_has_them() -> None:
    # The fault enters with a zero at 1: as a step it does not show, as a sine it does.
    plant = ob.DescriptorSystem(None, [[0.5, 0.0], [1.0, 0.2]], C=[[-1.0, 0.8]], Bf=[[1.0], [0.0]], dt=1.0)
    step = ob.check(plant, {"auto": {}})
    sine = ob.check(plant, {"auto": {"fault_model": {"sinusoid": 0.5}}})
    named = ob.check(plant, {"functional-filter": {"fault_model": {"sinusoid": 0.5}}})
    assert sine["functional-filter"].passed == named["functional-filter"].passed
    assert sine["functional-filter"].passed != step["functional-filter"].passed


def test_no_finite_mean_square_is_a_no_of_check_too() -> None:
    plant = ob.DescriptorSystem(A=[[-1.0]], C=[[1.0]], Bf=[[1.0]], Bw=[[0.0]], Dw=[[0.1]])
    first = {"norm": "h2", "reference": {"bandwidth": 2.0, "order": 1}}
    assert [row.name for row in ob.check(plant, {"optimal-filter": first})["optimal-filter"].failures] == [
        "exists: finite mean square"
    ]
    with pytest.raises(ob.PreconditionError, match="mean square is infinite"):
        ob.optimal_filter(plant, **first)
    # The reference by default has the order that a finite mean square needs.
    assert ob.check(plant, {"optimal-filter": {"norm": "h2"}})["optimal-filter"].passed
    assert ob.optimal_filter(plant, norm="h2").report.passed


def test_a_filter_that_keeps_too_few_digits_is_not_said_to_not_exist() -> None:
    """With noise added to every output the equations of this plant have no solution, without it they have one."""
    plant = ob.DescriptorSystem(
        A=[[-1.0, 0.0, -1.0, 1.0], [1.0, 0.0, 1.0, 0.5], [-1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]],
        C=[[-2.0, 0.0, 0.0, 0.0], [1.0, 0.0, -2.0, 0.0]],
        Bf=[[0.0], [0.0], [0.0], [1.0]],
        Bd=[[2.0, 0.0], [0.0, 1.0], [-2.0, 0.0], [0.0, 0.0]],
        Dd=[[0.0, 0.0], [1.0, -2.0]],
        Bw=np.zeros((4, 2)),
        Dw=0.1 * np.eye(2),
        dt=1.0,
    )
    # Kernels of some processors solve them, with too few digits: the others say that nothing is known.
    assert all(row.unclear for row in ob.check(plant)["optimal-filter"].failures)
    with pytest.raises((ob.SolverError, ob.PreconditionError), match=r"[Ii]nconclusive"):
        ob.optimal_filter(plant)


def test_command_for_a_nonlinear_plant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    plant = {
        "schema_version": 1,
        "kind": "dae",
        "equations": {"balance": "2 * der(level) = inflow - outflow", "valve": "outflow = c * sqrt(level)"},
        "outputs": {"flow": "outflow"},
        "states": {"level": 1.0, "outflow": 0.5},
        "inputs": {"inflow": 0.5},
        "parameters": {"c": 0.5},
    }
    (tmp_path / "tank.yaml").write_text(yaml.safe_dump(plant))
    named = {"method": {"id": "dae-adaptive-observer", "options": {"dt": 1.0}}}
    for method, words in ((named, "Q is missing"), ({}, "dt is missing")):
        path = tmp_path / "spec.yaml"
        path.write_text(yaml.safe_dump({"schema_version": 1, "name": "tank", "plant": {"file": "tank.yaml"}, **method}))
        assert main(["check", "--system", str(path)]) == ob.PreconditionError.exit_code
        assert words in " ".join(capsys.readouterr().out.split())
