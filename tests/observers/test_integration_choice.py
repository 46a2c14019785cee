"""A plant that turns within a step is integrated by Radau where that is left to the plant, or a note says so."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth import DAEModel, dae_adaptive_observer, simulate_dae
from obsynth.observers.nonlinear.building import largest_turn


def oscillator(frequency: float = 1.0) -> DAEModel:
    return DAEModel(
        {"place": "der(x) = v", "force": f"der(v) = -{frequency**2} * x - c * v + u"}, {"seen": "x"},
        states={"x": 1.0, "v": 1.0}, inputs={"u": 0.0}, parameters={"c": 0.2},
        units=dict.fromkeys(("x", "v", "u", "c", "seen"), "1"),
    )  # fmt: skip


def designed(model: DAEModel, integration: str, dt: float = 0.1):
    return dae_adaptive_observer(model, dt=dt, Q={"force": 1e-8}, R={"seen": 1e-6}, forgetting=0.99,
                                 integration=integration, initial_parameter_covariance=[[0.01]])  # fmt: skip


def test_the_turn_of_a_step_is_that_of_the_fastest_mode():
    assert abs(largest_turn(oscillator(2.0), 0.1) - 0.1 * np.sqrt(4.0 - 0.01)) < 1e-12


@pytest.mark.long
def test_auto_takes_radau_where_it_matters_and_backward_euler_elsewhere():
    assert designed(oscillator(), "auto").observer.integration == "radau"
    assert designed(oscillator(), "auto", dt=0.01).observer.integration == "backward-euler"


@pytest.mark.long
def test_backward_euler_is_noted_and_finds_a_wrong_damping_where_radau_finds_the_right_one():
    model = oscillator()
    u = np.sign(np.sin(np.arange(400) * 0.1))[:, None]
    true = simulate_dae(model, u, dt=0.1, R=[[1e-6]], seed=3)
    found = {}
    for integration in ("backward-euler", "auto"):
        design = designed(model, integration)
        assert any("turns by" in note for note in design.notes) == (integration == "backward-euler")
        found[integration] = design.observer.run(true.outputs, u, progress=False).parameters[-1, 0]
    assert abs(found["auto"] - 0.2) < 0.004
    assert abs(found["backward-euler"] - 0.2) > 0.02


def test_a_simulation_begins_on_its_constraint():
    model = DAEModel(
        {"balance": "der(x) = u - flow", "valve": "flow = c * sqrt(x)"}, {"seen": "flow"},
        states={"x": 4.0, "flow": 2.0}, inputs={"u": 1.0}, parameters={"c": 1.0},
        units=dict.fromkeys(("x", "flow", "u", "c", "seen"), "1"),
    )  # fmt: skip
    true = simulate_dae(model, np.ones((5, 1)), dt=0.1, initial_state=[9.0, 2.0])
    assert abs(true.states[0, 1] - 3.0) < 1e-6
    assert abs(true.states[0, 0] - 9.0) < 1e-5
    same = simulate_dae(model, np.ones((5, 1)), dt=0.1, initial_state=[9.0, 3.0])
    assert np.array_equal(same.states[0], [9.0, 3.0])
