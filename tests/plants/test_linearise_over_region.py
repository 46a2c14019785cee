"""Models over a region from nonlinear equations: exact at every point, and refused where they would not be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth import PreconditionError, SpecError

pytest.importorskip("casadi")


def _trailer(**changes: Any) -> obsynth.DAEModel:
    """Lateral motion at a speed v, which stands in five entries, with an algebraic slip and a constant load."""
    arguments: dict[str, Any] = {
        "equations": {
            "side": "m * der(y) = -2.0 * y / v - v * w + slip + gust",
            "yaw": "der(w) = 0.5 * y / v - w / v + 2.0 * steer + offset",
            "tyre": "slip = 3.0 * steer - y / v + 0.1 * v",
        },
        "outputs": {"rate": "w", "drift": "y", "pull": "slip + bias"},
        "states": {"y": 0.0, "w": 0.0, "slip": 0.1},
        "inputs": {"steer": 0.0, "v": 1.0, "gust": 0.0},
        "parameters": {"offset": 0.0, "bias": 0.0},
        "constants": {"m": 2.0},
        "units": {"v": "m/s"},
    }
    arguments |= changes
    equations, outputs = arguments.pop("equations"), arguments.pop("outputs")
    return obsynth.DAEModel(equations, outputs, **arguments)


_REGION = {"v": {"range": [0.5, 2.0], "rate": 0.2, "column": "speed"}}


@pytest.fixture(scope="module")
def plant() -> obsynth.PolytopicSystem:
    return obsynth.linearise(_trailer(), given={"v": 1.0}, disturbances=["gust"], region=_REGION, scheduling=["v"])


@pytest.mark.one_in(5)
@pytest.mark.parametrize("v", [0.5, 0.9, 1.0, 1.7, 2.0])
def test_every_point_is_the_linear_model_there(plant: obsynth.PolytopicSystem, v: float) -> None:
    other = obsynth.linearise(
        _trailer(inputs={"steer": 0.0, "v": v, "gust": 0.0}), at="point", drift=True, disturbances=["gust"]
    )
    there, kept = plant.at({"v": v}), [i for i, name in enumerate(other.input_names) if name == "steer"]
    for name in ("E", "A", "Bf", "Bd", "C", "Df"):
        assert np.allclose(getattr(there, name), getattr(other, name), rtol=0, atol=1e-12), name
    assert np.allclose(there.B[:, :1], other.B[:, kept], rtol=0, atol=1e-12)
    assert "v" not in plant.input_names
    assert plant.scheduling.names == ("v",)
    assert plant.scheduling.columns["v"] == "speed"
    assert plant.scheduling.units["v"] == "m/s"
    assert plant.scheduling.rates == (0.2,)


@pytest.mark.parametrize("v", [0.5, 1.3, 2.0])
def test_what_the_scheduling_moves_is_an_input_that_is_one(plant: obsynth.PolytopicSystem, v: float) -> None:
    """The motion of the nonlinear plant at any state is that of the model, with shift = 1."""
    rng = np.random.default_rng(4)
    point = np.array([plant.operating_point[name] for name in plant.state_names])
    assert plant.input_names == ("steer", "shift")
    there = plant.at({"v": v})
    for _ in range(5):
        y, w, slip, steer, gust = rng.normal(size=5)
        rows = np.array(
            [
                -2.0 * y / v - v * w + slip + gust,
                0.5 * y / v - w / v + 2.0 * steer,
                3.0 * steer - y / v + 0.1 * v - slip,
            ]
        )
        u = np.array([steer - plant.operating_point["steer"], 1.0])
        model = there.A @ (np.array([y, w, slip]) - point) + there.B @ u + there.Bd[:, 0] * gust
        # The sign of an algebraic equation is that of its residual.
        assert np.allclose(np.abs(model), np.abs(rows), rtol=0, atol=1e-12)
        assert np.allclose(model[:2], rows[:2], rtol=0, atol=1e-12)


def test_a_constant_that_is_measured_is_scheduled_too() -> None:
    model = obsynth.DAEModel(
        {"rise": "der(h) = q / area - h + leak / area"}, {"seen": "h"},
        states={"h": 0.0}, inputs={"q": 0.0}, parameters={"leak": 0.0}, constants={"area": 2.0},
    )  # fmt: skip
    found = obsynth.linearise(model, region={"area": [1.0, 4.0]}, sensor_noise={"seen": 0.1})
    assert found.at({"area": 4.0}).B.tolist() == [[0.25]]
    assert found.at({"area": 1.0}).Bf.tolist() == [[1.0]]
    assert found.fault_names == ("leak",)
    assert found.input_names == ("q",)
    assert found.vertices[0].nw == 1


def test_a_design_for_the_region_estimates_a_fault_of_the_nonlinear_plant() -> None:
    """A heater whose flow is measured: the balance is bilinear in flow and temperature."""
    model = obsynth.DAEModel(
        {
            "tank": "2.0 * der(T) = flow * (inlet - T) + 3.0 * power + loss",
            "wall": "der(W) = T - W",
        },
        {"T1": "T", "W1": "W"},
        states={"T": 23.0, "W": 23.0}, inputs={"flow": 0.5, "inlet": 20.0, "power": 0.5}, parameters={"loss": 0.0},
    )  # fmt: skip
    with pytest.raises(PreconditionError, match=r"'tank' is not linear .* depend on 'T', 'flow'"):
        obsynth.linearise(model, region={"inlet": [10.0, 30.0]})
    plant = obsynth.linearise(model, region={"flow": [0.2, 1.0]})
    design = obsynth.ui_pi_observer(plant)
    assert design.report.passed
    dt, rows = 0.01, 4000
    time = dt * np.arange(rows)
    flow, loss = 0.6 + 0.39 * np.sign(np.sin(0.7 * time)), np.where(time > 15.0, -1.5, 0.0)
    inlet, power = 20.0 + 3.0 * np.sin(0.3 * time), 0.5 + 0.2 * np.cos(time)
    x = np.array([24.0, 18.0])
    log: dict[str, Any] = {name: [] for name in ("T1", "W1")}
    for k in range(rows):
        log["T1"].append(x[0])
        log["W1"].append(x[1])
        x = x + dt * np.array([0.5 * (flow[k] * (inlet[k] - x[0]) + 3.0 * power[k] + loss[k]), x[0] - x[1]])
    log |= {"time": time, "flow": flow, "inlet": inlet, "power": power}
    assert plant.input_names[-1] == plant.shift == "shift"  # one in every row, of which a log has no column
    run = obsynth.run_on_data(design, {name: np.asarray(values) for name, values in log.items()})
    found = run.table["fhat[loss]"].to_numpy()
    assert found[-1] == pytest.approx(-1.5, abs=0.05)
    assert abs(found[1400]) < 0.05


@pytest.mark.parametrize(
    ("options", "kind", "told"),
    [
        ({"region": {"y": [0.0, 1.0]}}, PreconditionError, "'y' is a state.*region_observer"),
        ({"region": {"z": [0.0, 1.0]}}, SpecError, "'z' is no input, parameter or constant"),
        ({"scheduling": ["v"]}, SpecError, "give region"),
        ({"region": {"v": [1, 2]}, "scheduling": ["m"]}, SpecError, "'m', of which region gives no range"),
        ({"region": {"v": [1, 2], "m": [1, 2]}, "scheduling": ["v"]}, SpecError, "region has 'm'"),
        ({"region": {"v": [2, 1]}}, SpecError, "the lower one first"),
        ({"region": {"v": [-1.0, 1.0]}}, PreconditionError, "1 / v|not bounded|divi"),
        ({"region": {"m": [1.0, 3.0], "v": [1, 2]}}, PreconditionError, "E has an expression"),
        ({"region": {"v": [1, 2]}, "faults": ["v"]}, SpecError, "'v' is scheduled, and a fault"),
        ({"region": {"v": [1, 2]}, "disturbances": ["v"]}, SpecError, "'v' is scheduled, and a disturbance"),
        ({"region": {"v": [1, 2]}, "drift": True}, SpecError, "has no drift"),
        ({"region": {"v": [1, 2]}, "constants": {"m": "10 %"}}, SpecError, "has no constants"),
        ({"region": {"v": [1, 2]}, "scheduling": "v"}, SpecError, "give a list of names"),
    ],
)
def test_what_is_no_model_over_a_region_is_refused(options: dict[str, Any], kind: type, told: str) -> None:
    with pytest.raises(kind, match=told):
        obsynth.linearise(_trailer(), given={"v": 1.0} if "drift" not in options else {}, **options)


def test_an_equation_that_is_nonlinear_in_its_states_is_refused() -> None:
    model = obsynth.DAEModel(
        {"rise": "der(h) = q - v * sqrt(h)"}, {"seen": "h"}, states={"h": 1.0}, inputs={"q": 1.0, "v": 1.0}
    )
    with pytest.raises(PreconditionError, match=r"'rise' is not linear .* depend on 'h'.*region_observer") as caught:
        obsynth.linearise(model, region={"v": [0.5, 2.0]})
    assert caught.value.signals == ("h",)
