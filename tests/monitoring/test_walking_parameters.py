"""Parameters that walk or jump: honest covariances (a seeded share of the campaign), joint covariances, and resets."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.campaigns._walking_parameters import cases, linear_errors, nonlinear_errors

from obsynth import SpecError, adaptive_observer, dae_adaptive_observer, simulate_dae

pytestmark = pytest.mark.usefixtures("taken_as_verified")
TANK = cases()["leak and bias of a tank"]
OPTIONS = {"dt": TANK.dt, "Q": TANK.Q, "R": TANK.R, "initial_parameter_covariance": TANK.start,
           "initial_covariance": 1e-4, "integration": "backward-euler"}  # fmt: skip


@pytest.mark.parametrize("form", ["random-walk", "augmented-kalman"])
def test_covariances_of_walking_parameters_are_honest(form):
    errors = nonlinear_errors(TANK, form, 12)[1:]
    # A mean over 119 correlated samples of 12 runs and two parameters.
    assert 0.7 < errors.mean() < 1.4


@pytest.mark.long
def test_covariances_of_a_linear_walk_are_honest():
    assert 0.7 < linear_errors(12).mean() < 1.4


def test_a_stated_walk_chooses_the_form():
    assert dae_adaptive_observer(TANK.model, **OPTIONS, random_walk=TANK.walk).observer.form == "random-walk"
    assert dae_adaptive_observer(TANK.model, **OPTIONS).observer.form == "forgetting"


def record(jump: float = 0.0, samples: int = 160):
    u = np.sign(np.sin(0.15 * np.arange(samples)))[:, None]
    path = np.zeros((samples, 2))
    path[80:, 0] = jump
    true = simulate_dae(TANK.model, u, dt=TANK.dt, parameters=path, Q=np.diag([1e-4, 0.0]), R=1e-3 * np.eye(2),
                        integration="backward-euler", seed=5)  # fmt: skip
    return true, u, path


@pytest.mark.one_in(3)
@pytest.mark.parametrize("form", ["forgetting", "random-walk", "augmented-kalman"])
def test_a_reset_follows_a_jump_and_nothing_else(form):
    slow = {**OPTIONS, "form": form, "forgetting": 0.998}
    if form != "forgetting":
        slow |= {"random_walk": 1e-9}
    found = {}
    for reset in (0.0, 1e-6):
        observer = dae_adaptive_observer(TANK.model, **slow, reset=reset).observer
        for jump in (0.0, 1.0):
            true, u, path = record(jump)
            state = observer.init()
            for y, sent in zip(true.outputs, u, strict=True):
                state, row = observer.advance(state, y, sent)
            found[reset, jump] = abs(row.theta[0] - path[-1, 0]), state.resets
    assert found[0.0, 1.0][0] > 0.3
    assert found[1e-6, 1.0][0] < 0.15
    assert found[1e-6, 1.0][1] >= 1
    assert found[1e-6, 0.0][1] == found[0.0, 1.0][1] == 0


def test_records_batches_and_samples_reset_alike_and_the_c_refuses():
    from obsynth import run_batch

    observer = dae_adaptive_observer(TANK.model, **OPTIONS, forgetting=0.998, reset=1e-6).observer
    true, u, _ = record(1.0)
    whole = observer.run(true.outputs, u, progress=False)
    batch = run_batch(observer, true.outputs[None], u, progress=False)
    assert np.array_equal(whole.parameters, batch.parameters[0])
    with pytest.raises(SpecError, match="reset"):
        run_batch(observer, true.outputs[None], u, compiled=True, progress=False)
    with pytest.raises(SpecError, match="reset"):
        observer.run(true.outputs, u, compiled=True)
    gated = dae_adaptive_observer(TANK.model, **OPTIONS, outliers="gate").observer
    with pytest.raises(SpecError, match="outliers"):
        run_batch(gated, true.outputs[None], u, compiled=True, progress=False)


def test_a_batch_treats_outliers_as_a_record_does():
    from obsynth import run_batch

    observer = dae_adaptive_observer(TANK.model, **OPTIONS, outliers="gate").observer
    true, u, _ = record()
    y = np.array(true.outputs)
    y[40, 0] = 1e6
    whole = observer.run(y, u, progress=False)
    batch = run_batch(observer, y[None], u, progress=False)
    assert np.array_equal(whole.states, batch.states[0])
    assert np.abs(batch.parameters[0, -1]).max() < 0.3


def test_joint_covariances_hold_the_parts_and_the_correlation():
    true, u, _ = record()
    joint = {}
    for form in ("random-walk", "augmented-kalman"):
        observer = dae_adaptive_observer(TANK.model, **OPTIONS, form=form, random_walk=TANK.walk).observer
        found = observer.run(true.outputs, u, progress=False)
        joint[form] = found.joint_covariances
        assert joint[form].shape == (160, 4, 4)
        assert np.allclose(np.sqrt(joint[form][:, [0, 1], [0, 1]]), found.state_deviations)
        assert np.array_equal(joint[form][:, 2:, 2:], found.parameter_covariances)
    # Two ways to write one filter, on a plant that is linear.
    assert np.allclose(joint["random-walk"][5:], joint["augmented-kalman"][5:], rtol=1e-6, atol=1e-12)
    assert np.abs(joint["random-walk"][-1, :2, 2:]).max() > 1e-5


def test_joint_covariances_of_a_recursive_observer():
    from obsynth import TimeVaryingDescriptorSystem

    plant = TimeVaryingDescriptorSystem(None, [[0.9]], None, [[1.0]], Phi=[[1.0]], dt=1.0)
    rng, joint = np.random.default_rng(0), []
    for options in ({"form": "random-walk", "random_walk": 1e-12}, {"forgetting": 1.0, "guard": "none"}):
        design = adaptive_observer(plant, Q=0.01, R=0.04, initial_covariance=1.0,
                                   initial_parameter_covariance=[[0.5]], **options)  # fmt: skip
        joint.append(design.observer.run(rng.standard_normal((30, 1)), compiled=False).joint_covariances)
    assert np.allclose(joint[0], joint[1], rtol=1e-5)
    assert np.all(np.linalg.eigvalsh(joint[0]) > 0.0)
