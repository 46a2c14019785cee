"""Fault models: what they say is what their exosystem does."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from obsynth import FaultModel, SpecError, fault_model
from obsynth.plants.faults import exosystem, stated_eigenvalues, summed


def course(data: object, start: list[float], times: np.ndarray) -> np.ndarray:
    model = fault_model(data)
    return np.array([(model.Cw @ scipy.linalg.expm(model.Phi * t) @ start)[0] for t in times])


TIMES = np.linspace(0.0, 2.0, 5)


@pytest.mark.parametrize(
    ("data", "start", "expected"),
    [
        ("step", [2.0], lambda t: 2.0 + 0.0 * t),
        ("ramp", [1.0, 3.0], lambda t: 1.0 + 3.0 * t),
        ("parabola", [0.0, 1.0, 2.0], lambda t: t + t**2),
        ({"polynomial": 3}, [0.0, 0.0, 0.0, 6.0], lambda t: t**3),
        ({"sinusoid": 1.5}, [0.0, 1.0], lambda t: np.sin(1.5 * t)),
        ({"exponential": -0.7}, [2.0], lambda t: 2.0 * np.exp(-0.7 * t)),
        ({"sum": ["step", {"sinusoid": 2.0}]}, [1.0, 1.0, 0.0], lambda t: 1.0 + np.cos(2.0 * t)),
    ],
)
def test_courses(data: object, start: list[float], expected) -> None:
    np.testing.assert_allclose(course(data, start, TIMES), expected(TIMES), atol=1e-12)


def test_in_discrete_time_samples_lie_on_the_same_course() -> None:
    dt = 0.25
    model = exosystem({"f": {"sum": ["ramp", {"sinusoid": 1.5}]}}, ["f"], dt)
    state, found = np.array([0.5, 1.0, 0.0, 1.0]), []
    for _ in range(9):
        found.append((model.Cw @ state)[0])
        state = model.Phi @ state
    times = dt * np.arange(9)
    np.testing.assert_allclose(found, 0.5 + times + np.sin(1.5 * times), atol=1e-12)


def test_given_matrices_are_in_the_plants_own_time() -> None:
    data = {"Phi": [[0.9]], "Cw": [[1.0]]}
    for dt in (0.0, 0.5):
        assert exosystem(data, ["f"], dt).Phi.tolist() == [[0.9]]


def test_each_fault_has_its_own_model_and_they_do_not_mix() -> None:
    found = exosystem({"b": "ramp", "a": {"sinusoid": 2.0}}, ["a", "b"], 0.0)
    assert found.Phi.shape == (4, 4)
    np.testing.assert_array_equal(found.Cw, [[1, 0, 0, 0], [0, 0, 1, 0]])
    np.testing.assert_array_equal(found.Phi[:2, 2:], 0.0)
    assert sorted(found.eigenvalues, key=lambda v: v.imag) == pytest.approx([-2j, 0j, 2j])
    assert found.descriptions == ("sinusoid of 2 rad/s", "ramp")
    assert found.names == ("a model 1", "a model 2", "b model 1", "b model 2")


def test_multiple_eigenvalues_count_once_and_stay_exact() -> None:
    for dt, value in ((0.0, 0.0), (0.1, 1.0)):
        assert exosystem({"polynomial": 6}, ["f"], dt).eigenvalues.tolist() == [value]
    turned = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    phi = turned @ (0.3 * np.eye(3) + np.eye(3, k=1)) @ turned.T
    (value,) = exosystem({"Phi": phi, "Cw": [[1.0, 0.2, 0.1]]}, ["f"], 0.0).eigenvalues
    assert value == pytest.approx(0.3, abs=1e-9)
    assert value.imag == 0.0


def test_slow_models_are_not_taken_for_constant() -> None:
    found = exosystem({"sum": ["step", {"sinusoid": 1e-6}]}, ["f"], 0.0).eigenvalues
    assert sorted(found.imag) == pytest.approx([-1e-6, 0.0, 1e-6])


def test_stated_eigenvalues_fall_apart_into_blocks() -> None:
    phi = scipy.linalg.block_diag(np.eye(2, k=1), [[0.0, 3.0], [-3.0, 0.0]], [[0.0]])
    assert sorted(stated_eigenvalues(phi), key=lambda v: v.imag) == pytest.approx([-3j, 0.0, 3j])


def test_a_model_can_be_given_as_itself() -> None:
    model = FaultModel(np.array([[-0.1]]), np.eye(1), "a leak")
    assert fault_model(model) is model
    assert exosystem(model, ["f"], 0.0).descriptions == ("a leak",)


@pytest.mark.parametrize(
    "data",
    [
        "stepp", 3, {}, {"polynomial": -1}, {"polynomial": 1.0}, {"polynomial": True}, {"sinusoid": -1.0},
        {"sinusoid": "fast"}, {"exponential": float("nan")}, {"Phi": [[0.0]]}, {"Phi": [[0.0, 1.0]], "Cw": [[1.0]]},
        {"sum": []}, {"sum": ["step", "step"]}, {"step": 1, "ramp": 2},
    ],
)  # fmt: skip
def test_what_is_no_model_is_refused(data: object) -> None:
    with pytest.raises(SpecError):
        exosystem(data, ["f"], 0.0)


def test_a_sum_cannot_mix_the_two_times() -> None:
    with pytest.raises(SpecError, match="not both"):
        summed([fault_model("step"), fault_model({"Phi": [[0.5]], "Cw": [[1.0]]})])
