"""The descriptor Kalman filter of plants with unknown inputs: against a filter that is told them, and least squares."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.analysis.existence.kalman import without_unknown_inputs


def plant(rng, *, direct, nx=4, ny=3, nd=2, **changes):
    """Return a sampled plant; of its unknown inputs ``direct`` show in the outputs at once."""
    a = rng.normal(size=(nx, nx)) / nx
    dd = np.zeros((ny, nd))
    dd[:, :direct] = rng.normal(size=(ny, direct))
    given = {
        "C": rng.normal(size=(ny, nx)), "Bd": rng.normal(size=(nx, nd)), "Dd": dd, "B": rng.normal(size=(nx, 1)),
        "Bw": np.hstack([0.1 * np.eye(nx), np.zeros((nx, ny))]), "dt": 1.0,
        "Dw": np.hstack([np.zeros((ny, nx)), 0.2 * np.eye(ny)]),
    }  # fmt: skip
    return obsynth.DescriptorSystem(None, a, **(given | changes))


def simulated(plant, rng, d, steps=12):
    """Return x, u, y with the given unknown inputs; noise if ``rng``."""
    x, u = np.zeros((steps, plant.nx)), rng.normal(size=(steps, plant.nu))
    w = rng.normal(size=(steps, plant.nw))
    y = np.zeros((steps, plant.ny))
    for k in range(steps):
        y[k] = plant.C @ x[k] + plant.Dd @ d[k] + plant.Dw @ w[k]
        if k + 1 < steps:
            x[k + 1] = plant.A @ x[k] + plant.B @ u[k] + plant.Bd @ d[k] + plant.Bw @ w[k]
    return x, u, y


def least_squares(plant, u, y):
    """Return the last state that fits equations and outputs best, all unknown inputs free; x(0) has unit covariance."""
    steps, nx, nd = len(y), plant.nx, plant.nd
    width = steps * (nx + nd)
    rows, right = [], []
    first = np.zeros((nx, width))
    first[:, :nx] = np.eye(nx)
    rows.append(first)
    right.append(np.zeros(nx))
    for k in range(steps):
        x, d = slice(k * (nx + nd), k * (nx + nd) + nx), slice(k * (nx + nd) + nx, (k + 1) * (nx + nd))
        if k:
            shown = np.zeros((plant.ny, width))
            shown[:, x], shown[:, d] = plant.C / 0.2, plant.Dd / 0.2
            rows.append(shown)
            right.append(y[k] / 0.2)
        if k + 1 < steps:
            moved = np.zeros((nx, width))
            moved[:, x], moved[:, d] = -plant.A / 0.1, -plant.Bd / 0.1
            moved[:, (k + 1) * (nx + nd) : (k + 1) * (nx + nd) + nx] = np.eye(nx) / 0.1
            rows.append(moved)
            right.append(plant.B @ u[k] / 0.1)
    found = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
    return found[-(nx + nd) : -nd]


@pytest.mark.one_in(6)
@pytest.mark.parametrize("direct", [0, 1, 2])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_as_least_squares_over_the_whole_record(direct, seed):
    rng = np.random.default_rng(seed)
    given = plant(rng, direct=direct)
    design = obsynth.descriptor_kalman(given)
    assert design.report.passed
    x, u, y = simulated(given, rng, 100.0 * rng.normal(size=(12, 2)))
    estimates = design.observer.run(y, u).states
    expected = least_squares(given, u, y)
    np.testing.assert_allclose(estimates[-1][: given.nx], expected, rtol=1e-6, atol=1e-6)
    assert np.max(np.abs(estimates[-1][: given.nx] - x[-1])) < 5.0


def test_unknown_inputs_that_show_are_estimated_by_name():
    rng = np.random.default_rng(3)
    given = plant(rng, direct=2, disturbance_names=["load", "wind"])
    design = obsynth.descriptor_kalman(given)
    assert design.plant.state_names[-2:] == ("load", "wind")
    assert "'load', 'wind' are estimated" in design.notes[0]
    d = 50.0 * rng.normal(size=(12, 2))
    _, u, y = simulated(given, rng, d)
    assert np.max(np.abs(design.observer.run(y, u).states[-1][-2:] - d[-1])) < 10.0


def test_the_condition_names_what_is_missing():
    rng = np.random.default_rng(4)
    given = plant(rng, direct=0, ny=1)
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.descriptor_kalman(given)
    assert caught.value.condition == "rank [N E; C]"  # E is the identity: [E; C] has full rank
    assert "(N combines the equations to those without unknown inputs)" in str(caught.value)


def test_a_given_covariance_is_that_of_all_equations():
    rng = np.random.default_rng(5)
    given = plant(rng, direct=0)
    stated, told = (obsynth.descriptor_kalman(given, **options) for options in ({}, {"Q": 0.01 * np.eye(4)}))
    np.testing.assert_allclose(stated.gains["L"], told.gains["L"], rtol=1e-12)
    with pytest.raises(obsynth.SpecError, match="4 by 4"):
        obsynth.descriptor_kalman(given, Q=np.eye(3))


@pytest.mark.parametrize("direct", [0, 1, 2])
@pytest.mark.parametrize(("equations", "outputs"), [(2.0**20, 2.0**-18), (2.0**-20, 2.0**18)])
def test_units_do_not_decide_which_unknown_inputs_are_estimated(direct, equations, outputs):
    # With states in thousandths and outputs in thousands, what shows at once was taken for rounding, and removed.
    rng = np.random.default_rng(3)
    given = plant(rng, direct=direct)
    other = given.replace(
        B=equations * given.B, Bd=equations * given.Bd, Bw=equations * given.Bw,
        C=outputs / equations * given.C, Dd=outputs * given.Dd, Dw=outputs * given.Dw,
    )  # fmt: skip
    first, second = without_unknown_inputs(given), without_unknown_inputs(other)
    assert first.names == second.names
    assert len(first.equations) == len(second.equations)
    assert first.note == second.note


@pytest.mark.one_in(6)
@pytest.mark.parametrize("seed", range(8))
def test_a_known_input_may_be_late_where_an_unknown_one_enters_with_it(seed: int) -> None:
    """What turned equations leave of a delay's register was rounding, and the units of the states followed from it."""
    rng = np.random.default_rng([46, 4, seed])
    n = int(rng.integers(2, 5))
    a = rng.standard_normal((n, n))
    a -= (0.3 + np.max(np.linalg.eigvals(a).real)) * np.eye(n)
    b = rng.standard_normal((n, 1))
    late = {"u1": float(rng.choice([0.05, 0.1, 0.2]))} | ({"y1": 0.05} if seed % 2 else {})
    plant = obsynth.DescriptorSystem(
        A=a, B=b, C=np.eye(n), Bd=b, Bw=np.diag(rng.uniform(0.1, 0.3, n)), delays=late,
        sensor_noise={f"y{i + 1}": 0.1 for i in range(n)},
    )  # fmt: skip
    sampled = obsynth.discretise(plant, 0.05).plant
    design = obsynth.descriptor_kalman(sampled)
    assert design.report.passed
    # Its estimates are late by nothing but noise: of an exact record, with any unknown input, they are the states.
    x, u, d = np.zeros(sampled.nx), rng.standard_normal((60, 1)), 10.0 * rng.standard_normal((60, 1))
    states, outputs = [], []
    for k in range(60):
        states.append(x)
        outputs.append(sampled.C @ x)
        x = sampled.A @ x + sampled.B @ u[k] + sampled.Bd @ d[k]
    found = design.observer.run(np.array(outputs), u)
    assert np.max(np.abs(found.states[20:, -1] - np.array(states)[20:, -1])) < 1e-6


@pytest.mark.parametrize("multiple", [1 / 7, -3 / 7, 0.2, 0.3])
def test_noise_along_an_unknown_input_leaves_no_variance_of_rounding(multiple: float) -> None:
    # In the combination of equations without the unknown input it cancels, but for rounding.
    hidden = np.array([[0.0], [-1.0], [0.5], [0.25]])
    process = multiple * hidden + np.array([[0.3], [0.0], [0.0], [0.0]])
    A = [[0.5, 0.1, 0.0, 0.0], [0.0, 0.4, 0.2, 0.0], [0.1, 0.0, 0.3, 0.0], [0.0, 0.0, 0.1, 0.2]]
    plant = obsynth.DescriptorSystem(
        A=A, C=np.eye(4), Bd=hidden, Bw=np.hstack([process, np.zeros((4, 4))]),
        Dw=np.hstack([np.zeros((4, 1)), 0.1 * np.eye(4)]), dt=1.0,
    )  # fmt: skip
    Q = obsynth.descriptor_kalman(plant).observer.Q.at(0)
    assert np.linalg.matrix_rank(Q) == 1
    assert np.count_nonzero(np.diag(Q)) == 1


@pytest.mark.parametrize("q", [None, 0.5])
def test_where_no_equation_is_left_an_estimate_follows_from_the_outputs_of_its_sample(q: float | None) -> None:
    rng = np.random.default_rng(6)
    given = plant(rng, direct=0, nx=2, ny=3, nd=2)
    design = obsynth.descriptor_kalman(given, Q=q)
    assert design.report.passed
    assert "no equation is left" in design.notes[0]
    _, u, y = simulated(given, rng, 100.0 * rng.normal(size=(12, 2)))
    found = design.observer.run(y, u)
    np.testing.assert_allclose(found.states[-1], np.linalg.lstsq(given.C, y[-1], rcond=None)[0], rtol=1e-9)
    covariance = 0.04 * np.linalg.inv(given.C.T @ given.C)
    np.testing.assert_allclose(found.state_deviations[-1], np.sqrt(np.diag(covariance)), rtol=1e-9)


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("direct", "nd"), [(0, 1), (1, 1), (1, 2), (0, 2)])
def test_the_adaptive_observer_learns_beside_any_unknown_input(direct: int, nd: int) -> None:
    """Of records without noise the parameters are learned exactly, however large the unknown inputs are."""
    rng = np.random.default_rng([7, direct, nd])
    given = plant(rng, direct=direct, nd=nd, Bf=rng.normal(size=(4, 1)))
    design = obsynth.adaptive_observer(given, forgetting=1.0, initial_parameter_covariance=1e6)
    assert design.report.passed
    d, theta = 100.0 * rng.normal(size=(80, nd)), 3.0
    still = given.replace(
        Bw=np.zeros((4, 1)), Dw=np.zeros((3, 1)), noise_names=None, B=np.hstack([given.B, given.Bf]),
        D=np.zeros((3, 2)), input_names=["u1", "f1 as an input"], Bf=None, Df=None, fault_names=None,
    )  # fmt: skip
    x, y = np.zeros(4), []
    u = rng.normal(size=(80, 1))
    for k in range(80):
        y.append(still.C @ x + still.Dd @ d[k])
        x = still.A @ x + still.B @ [u[k, 0], theta] + still.Bd @ d[k]
    found = design.observer.run(np.array(y), u)
    assert found.parameters[-1, 0] == pytest.approx(theta, abs=1e-3)


def test_a_parameter_that_an_unknown_input_can_imitate_is_named() -> None:
    rng = np.random.default_rng(8)
    given = plant(rng, direct=0, nd=1)
    with pytest.raises(obsynth.PreconditionError, match="f1"):
        obsynth.adaptive_observer(given.replace(Bf=given.Bd, Df=np.zeros((3, 1)), fault_names=["f1"]))
