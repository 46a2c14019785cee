"""Simulation of discrete plants: against recursions by hand, another program, and the plant's own equations."""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import pytest
from scipy.linalg import expm

from obsynth.errors import PreconditionError, SpecError
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.sampling import discretise
from obsynth.simulation.linear import simulate_plant, simulate_time_varying
from obsynth.simulation.trajectory import Trajectory
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"
STEPS = 40


def signals(plant: DescriptorSystem, rng: np.random.Generator, steps: int = STEPS) -> dict[str, np.ndarray]:
    sizes = {"u": plant.nu, "f": plant.nf, "d": plant.nd, "w": plant.nw}
    return {name: rng.standard_normal((steps, size)) for name, size in sizes.items()}


def random_plant(rng: np.random.Generator, *, algebraic: int, dense: bool = True, **changes) -> DescriptorSystem:
    """Return a stable index-1 plant (index 0 for ``algebraic=0``) with every signal everywhere."""
    dynamic = 3
    nx = dynamic + algebraic
    E, A = np.zeros((nx, nx)), rng.standard_normal((nx, nx))
    E[:dynamic, :dynamic] = np.eye(dynamic) if not dense else rng.standard_normal((3, 3)) + 3.0 * np.eye(3)
    A[:dynamic, :dynamic] *= 0.3
    A[:dynamic, dynamic:] *= 0.1
    A[dynamic:, dynamic:] += 3.0 * np.eye(algebraic)
    if dense:
        left, right = (rng.standard_normal((nx, nx)) + 2.0 * np.eye(nx) for _ in range(2))
        E, A = left @ E @ right, left @ A @ right
    widths = {"B": 2, "Bf": 2, "Bd": 1, "Bw": 3}
    inputs = {name: rng.standard_normal((nx, width)) for name, width in widths.items()}
    outputs = {name.replace("B", "D"): rng.standard_normal((2, width)) for name, width in widths.items()}
    plant = DescriptorSystem(E, A, C=rng.standard_normal((2, nx)), dt=0.1, **inputs, **outputs)
    return plant.replace(**changes)


def equation_residual(plant: DescriptorSystem, run: Trajectory) -> float:
    """Return the largest miss of the plant's equations at any sample, relative to the states' size."""
    driven = (
        run.states @ plant.A.T + run.inputs @ plant.B.T + run.faults @ plant.Bf.T
        + run.disturbances @ plant.Bd.T + run.noise @ plant.Bw.T
    )  # fmt: skip
    misses = run.states[1:] @ plant.E.T - driven[:-1]
    # At the last sample only the algebraic equations can be checked: rows of the left null space of E.
    left, values, _ = np.linalg.svd(plant.E)
    null = left[:, values < 1e-12 * values[0]]
    size = max(1.0, float(np.max(np.abs(run.states))), float(np.max(np.abs(driven))))
    return max(float(np.max(np.abs(misses))), float(np.max(np.abs(driven @ null), initial=0.0))) / size


def test_the_residual_of_the_tests_sees_a_wrong_state() -> None:
    plant = random_plant(np.random.default_rng(0), algebraic=2)
    run = simulate_plant(plant, steps=STEPS, **signals(plant, np.random.default_rng(1)))
    states = run.states.copy()
    states[7, 2] += 1e-6
    spoilt = Trajectory(
        states, run.outputs, run.inputs, run.faults, run.disturbances, run.noise, run.time, run.inconsistency
    )
    assert equation_residual(plant, run) < 1e-12
    assert equation_residual(plant, spoilt) > 1e-9


def test_recursion_by_hand() -> None:
    """The paper's example: x4 = -(x1 + x3 + b4 u + f4 n) at the same sample."""
    plant = load_spec(DESIGNS / "wang2015" / "spec.yaml").plant
    rng = np.random.default_rng(2)
    u, f, d = rng.standard_normal((STEPS, 2)), rng.standard_normal((STEPS, 2)), rng.standard_normal((STEPS, 1))
    x = np.array([0.5, 1.0, 0.0, np.nan])
    expected = []
    for k in range(STEPS):
        x[3] = -(x[0] + x[2] + plant.B[3] @ u[k] + plant.Bf[3] @ f[k])
        expected.append(x)
        x = np.append((plant.A @ x + plant.B @ u[k] + plant.Bf @ f[k] + plant.Bd @ d[k])[:3], np.nan)
    start = expected[0]
    run = simulate_plant(plant, steps=STEPS, u=u, f=f, d=d, initial_state=start)
    np.testing.assert_allclose(run.states, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.outputs, np.array(expected)[:, 1:], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(run.time, np.arange(STEPS) * 1.0)
    assert run.inconsistency < 1e-14


def test_the_initial_state_of_the_paper_is_consistent() -> None:
    plant = load_spec(DESIGNS / "wang2015" / "spec.yaml").plant
    assert simulate_plant(plant, steps=1, initial_state=[0.5, 1.0, 0.0, -0.5]).inconsistency == 0.0


def test_another_program_agrees_when_E_is_the_identity() -> None:
    rng = np.random.default_rng(3)
    plant = random_plant(rng, algebraic=0, dense=False)
    assert np.array_equal(plant.E, np.eye(3))
    given = signals(plant, rng)
    start = rng.standard_normal(3)
    run = simulate_plant(plant, steps=STEPS, initial_state=start, **given)
    system = control.ss(
        plant.A, np.hstack([plant.B, plant.Bf, plant.Bd, plant.Bw]),
        plant.C, np.hstack([plant.D, plant.Df, plant.Dd, plant.Dw]), plant.dt,
    )  # fmt: skip
    other = control.forced_response(system, run.time, np.hstack(list(given.values())).T, start, return_states=True)
    np.testing.assert_allclose(run.states, other.states.T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.outputs, other.outputs.T, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.time, other.time)
    assert run.inconsistency == 0.0


@pytest.mark.parametrize("algebraic", [0, 1, 2, 4])
@pytest.mark.parametrize("seed", range(5))
def test_every_equation_holds_at_every_sample(algebraic: int, seed: int) -> None:
    rng = np.random.default_rng([algebraic, seed])
    plant = random_plant(rng, algebraic=algebraic)
    given = signals(plant, rng)
    run = simulate_plant(plant, steps=STEPS, initial_state=rng.standard_normal(plant.nx), **given)
    assert equation_residual(plant, run) < 1e-11
    expected = run.states @ plant.C.T + sum(
        given[name] @ matrix.T for name, matrix in zip("ufdw", (plant.D, plant.Df, plant.Dd, plant.Dw), strict=True)
    )
    np.testing.assert_allclose(run.outputs, expected, rtol=0, atol=1e-12)


def test_equations_in_very_different_units() -> None:
    rng = np.random.default_rng(4)
    plant = random_plant(rng, algebraic=2)
    rows, columns = 10.0 ** rng.uniform(-6, 6, 5), 10.0 ** rng.uniform(-3, 3, 5)
    scaled = plant.replace(
        E=rows[:, None] * plant.E * columns, A=rows[:, None] * plant.A * columns, C=plant.C * columns,
        **{name: rows[:, None] * getattr(plant, name) for name in ("B", "Bf", "Bd", "Bw")},
    )  # fmt: skip
    given, start = signals(plant, rng), rng.standard_normal(5)
    run = simulate_plant(plant, steps=STEPS, initial_state=start, **given)
    other = simulate_plant(scaled, steps=STEPS, initial_state=start / columns, **given)
    np.testing.assert_allclose(other.states * columns, run.states, rtol=0, atol=1e-8)


def test_an_inconsistent_start_is_projected_along_the_null_space_of_E() -> None:
    rng = np.random.default_rng(5)
    plant = random_plant(rng, algebraic=2)
    given = signals(plant, rng)
    consistent = simulate_plant(plant, steps=STEPS, initial_state=rng.standard_normal(5), **given)
    start = consistent.states[0]
    again = simulate_plant(plant, steps=STEPS, initial_state=start, **given)
    assert again.inconsistency < 1e-12
    null = np.linalg.svd(plant.E)[2][-2:].T
    push = null @ np.array([0.3, -0.4])
    pushed = simulate_plant(plant, steps=STEPS, initial_state=start + push, **given)
    np.testing.assert_allclose(pushed.states, again.states, rtol=0, atol=1e-11)
    assert pushed.inconsistency == pytest.approx(0.5, abs=1e-11)


def test_without_a_start_the_dynamic_part_is_zero_and_nothing_is_inconsistent() -> None:
    plant = load_spec(DESIGNS / "wang2015" / "spec.yaml").plant
    run = simulate_plant(plant, steps=3, u=[[1.0, 2.0]] * 3)
    np.testing.assert_array_equal(run.states[0], [0.0, 0.0, 0.0, 1.0])
    assert run.inconsistency == 0.0


def test_nothing_in_nothing_out() -> None:
    plant = random_plant(np.random.default_rng(6), algebraic=2)
    run = simulate_plant(plant, steps=5)
    assert not run.states.any()
    assert not run.outputs.any()
    shapes = [getattr(run, name).shape for name in ("states", "outputs", "inputs", "faults", "disturbances", "noise")]
    assert shapes == [(5, 5), (5, 2), (5, 2), (5, 2), (5, 1), (5, 3)]


def test_arrays_are_read_only_and_the_inputs_are_left_alone() -> None:
    plant = random_plant(np.random.default_rng(7), algebraic=1)
    given = signals(plant, np.random.default_rng(8))
    copies = {name: value.copy() for name, value in given.items()}
    run = simulate_plant(plant, steps=STEPS, **given)
    for name, value in copies.items():
        np.testing.assert_array_equal(given[name], value)
    for name in ("states", "outputs", "inputs", "faults", "disturbances", "noise", "time"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(run, name)[0] = 1.0


def test_the_network_sampled_against_its_continuous_equations() -> None:
    """Held signals: dynamic states by the matrix exponential, algebraic ones by their own equations."""
    written = load_spec(DESIGNS / "smib" / "spec.yaml")
    transformation = written.transformation
    assert transformation is not None
    continuous, sampled = transformation.source, written.plant
    rng = np.random.default_rng(9)
    f = np.repeat(rng.standard_normal((8, 1)), 5, axis=0)
    d = np.repeat(rng.standard_normal((4, 1)), 10, axis=0)
    run = simulate_plant(sampled, steps=STEPS, f=f, d=d)
    recovery = transformation.recovery
    states = (
        run.states @ recovery.from_state.T + run.faults @ recovery.from_fault.T
        + run.disturbances @ recovery.from_disturbance.T
    )  # fmt: skip
    algebraic = ~continuous.E.any(axis=1)
    misses = (states @ continuous.A.T + f @ continuous.Bf.T + d @ continuous.Bd.T)[:, algebraic]
    assert np.max(np.abs(misses)) < 1e-11 * np.max(np.abs(states))
    np.testing.assert_allclose(run.outputs, states @ continuous.C.T, rtol=0, atol=1e-11)
    # One matrix exponential over five samples, with the signals as constant states.
    reduced = eliminate_algebraic_states(continuous).plant
    block = np.zeros((6, 6))
    block[:4] = np.hstack([reduced.A, reduced.Bf, reduced.Bd])
    leap = expm(5 * sampled.dt * block)
    for k in range(0, STEPS - 5, 5):
        expected = leap @ np.concatenate([run.states[k], f[k], d[k]])
        np.testing.assert_allclose(run.states[k + 5], expected[:4], rtol=0, atol=1e-10)


def test_a_continuous_plant_is_refused_with_the_remedy() -> None:
    plant = random_plant(np.random.default_rng(10), algebraic=1, dt=0.0, Bw=None, Dw=None, noise_names=None)
    with pytest.raises(SpecError, match="sample it first") as caught:
        simulate_plant(plant, steps=5)
    assert caught.value.path == "dt"
    sampled = discretise(plant, 0.01).plant
    assert simulate_plant(sampled, steps=5).states.shape == (5, 3)


def test_index_two_and_singular_pencils_are_refused() -> None:
    nilpotent = np.array([[0.0, 1.0], [0.0, 0.0]])
    with pytest.raises(PreconditionError) as caught:
        simulate_plant(DescriptorSystem(nilpotent, np.eye(2), dt=1.0), steps=5)
    assert caught.value.condition == "index"
    with pytest.raises(PreconditionError) as caught:
        simulate_plant(DescriptorSystem(np.diag([1.0, 0.0]), np.diag([1.0, 0.0]), dt=1.0), steps=5)
    assert caught.value.condition == "regularity"


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ({"steps": 0}, "steps"),
        ({"steps": 2.0}, "steps"),
        ({"steps": True}, "steps"),
        ({"steps": 5, "u": np.zeros((4, 2))}, "u"),
        ({"steps": 5, "u": np.zeros((5, 3))}, "u"),
        ({"steps": 5, "u": np.zeros(5)}, "u"),
        ({"steps": 5, "f": np.full((5, 2), np.nan)}, "f"),
        ({"steps": 5, "d": [["a"]] * 5}, "d"),
        ({"steps": 5, "w": np.zeros((5, 1))}, "w"),
        ({"steps": 5, "initial_state": [0.0, 0.0, 0.0]}, "initial_state"),
        ({"steps": 5, "initial_state": [0.0, 0.0, 0.0, np.inf]}, "initial_state"),
    ],
)
def test_malformed_arguments_are_named(arguments: dict[str, object], path: str) -> None:
    plant = random_plant(np.random.default_rng(11), algebraic=1)
    with pytest.raises(SpecError) as caught:
        simulate_plant(plant, **arguments)
    assert caught.value.path == path


def test_a_single_signal_may_be_a_plain_list() -> None:
    plant = random_plant(np.random.default_rng(12), algebraic=1)
    d = np.arange(5.0)
    np.testing.assert_array_equal(
        simulate_plant(plant, steps=5, d=d).states, simulate_plant(plant, steps=5, d=d[:, None]).states
    )


def test_states_that_outgrow_double_precision_are_no_result() -> None:
    with pytest.raises(SpecError, match="sample 1024") as caught:
        simulate_plant(DescriptorSystem(None, [[2.0]], dt=1.0), steps=1100, initial_state=[1.0])
    assert caught.value.path == "steps"


@pytest.mark.parametrize("name", ["u", "parameters"])
def test_a_signal_that_a_time_varying_plant_does_not_have_is_refused(name):
    plant = TimeVaryingDescriptorSystem(np.eye(1), 0.5 * np.eye(1), C=np.eye(1), dt=1.0)
    with pytest.raises(SpecError, match=rf"{name} has shape \(3, 2\), but \(3, 0\) is needed"):
        simulate_time_varying(plant, samples=3, **{name: np.ones((3, 2))})
    empty = simulate_time_varying(plant, samples=3, **{name: np.zeros((3, 0))}, initial_state=[1.0])
    np.testing.assert_array_equal(empty.states, [[1.0], [0.5], [0.25]])
