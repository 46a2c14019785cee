"""Exact decoupling of faults that turn with the scheduling: wild courses, proofs, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from obsynth import PolytopicSystem, PreconditionError, SpecError
from obsynth.analysis.existence.turning_filter import TurningFilter, turning_conditions
from obsynth.conditions import turning_errors, turning_faults
from obsynth.methods.engines.vertex_certificates import best_decay
from obsynth.proofs.vertex_inequalities import Witness, prove_decay


def turning_plant(**changes: Any) -> PolytopicSystem:
    """Return reference case 14: three outputs, one fault that turns from the first state to the second."""
    rng = np.random.default_rng(3)
    A = [np.diag([0.9, 0.7, 1.05, 0.5]) + 0.1 * rng.standard_normal((4, 4)) for _ in range(2)]
    entries = [[f"{a} + {b - a} * v" for a, b in zip(*rows, strict=True)] for rows in zip(*A, strict=True)]
    plant = {"A": entries, "C": np.eye(3, 4), "Bf": [["1 - v"], ["v"], [0.3], [0.2]], "dt": 1.0}
    return PolytopicSystem(plant={**plant, **changes}, scheduling={"v": [0.0, 1.0]})


def test_a_fault_that_turns_has_no_effect_on_the_corrected_error() -> None:
    plant = turning_plant()
    found = turning_faults(plant)
    found.solve()
    assert found.variables["room"].value > 1e-8
    gains = found.gains()
    T, N, C = gains["T"], gains["N"], np.eye(3, 4)
    assert np.abs(T + N @ C - np.eye(4)).max() < 1e-12
    assert turning_errors(plant, gains).leak < 1e-12
    # The filter itself, on a wild course with faults of size 10, from another state than the plant's.
    rng = np.random.default_rng(1)
    x, corrected, misses = np.zeros(4), np.ones(4), []
    for _ in range(40):
        v, f = rng.random(), 10.0 * rng.standard_normal(1)
        now, K = plant.at([v]), (1 - v) * gains["K[1]"] + v * gains["K[2]"]
        z, x = T @ (now.A @ corrected), now.A @ x + now.Bf @ f
        estimate = z + N @ (C @ x)
        corrected = estimate + K @ (C @ x - C @ estimate)
        misses.append(float(np.abs(x - corrected).max()))
    assert misses[-1] < 1e-3 * misses[0]


def test_errors_decay_as_is_proved_and_no_fault_leaks() -> None:
    plant = turning_plant()
    found = turning_faults(plant)
    found.solve()
    made = turning_errors(plant, found.gains())
    decay, witness, none = best_decay(made.errors, gains=[np.zeros((4, 0))])
    assert decay < 1.0
    assert prove_decay(made.errors.closed(none), witness, decay, discrete=True).proved
    gains, rng = found.gains(), np.random.default_rng(0)
    C, T, P = np.eye(3, 4), gains["T"], witness.P[0]
    error, sizes, leak = np.array([1.0, -1, 1, 1]), [], 0.0
    for _ in range(60):
        v = rng.random()
        now, K = plant.at([v]), (1 - v) * gains["K[1]"] + v * gains["K[2]"]
        fault = (np.eye(4) - K @ C) @ T @ now.Bf * 10.0
        leak = max(leak, float(np.abs(fault).max()))
        error = (np.eye(4) - K @ C) @ T @ now.A @ error + fault[:, 0] * rng.standard_normal()
        sizes.append(float(error @ P @ error) ** 0.5)
    assert leak < 1e-11
    start = float(np.array([1.0, -1, 1, 1]) @ P @ np.array([1.0, -1, 1, 1])) ** 0.5
    assert all(size <= start * decay ** (k + 1) * (1 + 1e-9) + 1e-9 for k, size in enumerate(sizes))
    # Other gains leak, and a P for other errors proves nothing.
    other = {**gains, "K[2]": gains["K[1]"]}
    assert turning_errors(plant, other).leak > 1e-3
    assert not prove_decay(made.errors.closed(none), Witness([np.eye(4)]), decay, discrete=True).proved


@pytest.mark.parametrize(
    ("changes", "kind", "told"),
    [
        ({"dt": 0.0}, PreconditionError, "discrete time"),
        ({"C": [["1 + v", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, PreconditionError, "same C"),
        ({"Bf": [[0], [0], [0], ["1 + v"]]}, PreconditionError, "loses rank"),
        ({"Df": [[1], [0], [0]]}, PreconditionError, "without"),
    ],
)
def test_what_it_is_not_for_is_refused(changes: dict[str, Any], kind: type[Exception], told: str) -> None:
    with pytest.raises(kind, match=told):
        turning_faults(turning_plant(**changes))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"dt": 0.0}, "discrete time"),
        ({"C": [["1 + v", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "same C"),
        ({"Df": [[1], [0], [0]]}, "without"),
        ({"Bd": [[1], [0], [0], [0]], "Dd": [[1], [0], [0]]}, "without"),
    ],
)
def test_the_errors_are_of_plants_that_it_is_for(changes: dict[str, Any], told: str) -> None:
    gains = {"T": np.eye(4), "K[1]": np.zeros((4, 3)), "K[2]": np.zeros((4, 3))}
    with pytest.raises(PreconditionError, match=told):
        turning_errors(turning_plant(**changes), gains)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"K[2]": np.zeros((3, 4))}, r"K\[2\] is 3 by 4"),
        ({"T": np.full((4, 4), np.nan)}, "must be finite"),
        ({"T": 0.5 * np.eye(4)}, "no N has T E"),
    ],
)
def test_gains_of_another_plant_have_no_errors(changed: dict[str, Any], told: str) -> None:
    gains = {"T": np.eye(4), "K[1]": np.zeros((4, 3)), "K[2]": np.zeros((4, 3))}
    with pytest.raises(SpecError, match=told):
        turning_errors(turning_plant(), {**gains, **changed})
    del gains["T"]
    with pytest.raises(SpecError, match="T is missing"):
        turning_errors(turning_plant(), gains)


def test_more_than_two_vertices_are_refused_by_name() -> None:
    given = turning_plant().as_dict()["plant"]
    given["Bf"] = [["1 - v"], ["v * w"], [0.3], [0.2]]
    plant = PolytopicSystem(plant=given, scheduling={"v": [0.0, 1.0], "w": [0.5, 1.0]})
    with pytest.raises(SpecError, match="two vertices"):
        turning_faults(plant)
    with pytest.raises(SpecError, match="decay"):
        turning_faults(turning_plant(), decay=1.5)


@pytest.mark.parametrize("rounding", [0.0, 1e-14, 1e-13, 1e-12])
def test_what_is_rounding_to_the_rank_is_no_direction_of_the_correction(rounding: float) -> None:
    """Faults that are parallel but for rounding: equations that agree to it ask nothing of the correction."""
    rng = np.random.default_rng(1)
    first = np.array([1.0, 0.4, 0.3, 0.2])
    # The fourth state is not measured: there the rounding is a hundred times as large as in what the outputs show.
    second = 0.7 * first + rounding * rng.normal(size=4) * np.array([0.01, 0.01, 0.01, 1.0])
    for unit in (1.0, 1e-6):
        a, b = (unit * each for each in (first, second))
        plant = turning_plant(Bf=[[f"{x} + {y - x} * v"] for x, y in zip(a.tolist(), b.tolist(), strict=True)])
        made: list[TurningFilter] = []
        assert all(condition.holds for condition in turning_conditions(plant, made))
        assert max(np.abs(K).max() for K in made[0].K0) < 1.0
        # One fault, of one direction at both vertices: of six outputs two are used, and four are free.
        assert made[0].U[0].shape == (3, 4)
