"""Recursive designs of plants that were sampled take rows at any time: each step is the continuous plant's own."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

import obsynth

A, B, NOISE = np.array([[-0.4, 1.0], [-1.0, -0.3]]), np.array([[0.0], [1.0]]), np.diag([0.05, 0.1])
C, DEVIATION, DT = np.array([[1.0, 0.0]]), 0.1, 0.1


def plant(**changes):
    return obsynth.DescriptorSystem(
        **{"A": A, "B": B, "C": C, "Bw": NOISE, "sensor_noise": {"y1": DEVIATION}, **changes}
    )


def design(method="descriptor-kalman", sampled=None, **options):
    return obsynth.design(obsynth.discretise(plant() if sampled is None else sampled, DT), method, **options)


def step_of(seconds):
    """Transition, held input and covariance of the noise over an interval, by block exponentials."""
    block = np.zeros((4, 4))
    block[:2, :2], block[:2, 2:], block[2:, 2:] = -A, NOISE @ NOISE.T, A.T
    whole = expm(block * seconds)
    transition = whole[2:, 2:].T
    held = np.zeros((3, 3))
    held[:2, :2], held[:2, 2:] = A, B
    return transition, expm(held * seconds)[:2, 2:], transition @ whole[:2, 2:]


def textbook(times, u, y):
    """The Kalman filter at these times, in covariances."""
    x, P, found = np.zeros(2), np.eye(2), [(np.zeros(2), np.ones(2))]
    for k in range(1, len(times)):
        F, G, Q = step_of(times[k] - times[k - 1])
        x, P = F @ x + G @ u[k - 1], F @ P @ F.T + Q
        if not np.isnan(y[k, 0]):
            S = C @ P @ C.T + DEVIATION**2
            K = P @ C.T / S
            x, P = x + K @ (y[k] - C @ x), P - K @ S @ K.T
        found.append((x, np.sqrt(np.diag(P))))
    return tuple(np.array(part) for part in zip(*found, strict=True))


def run(design, times, u, y, **options):
    table = pd.DataFrame({"time": times, "u1": u[:, 0], "y1": y[:, 0]})
    return obsynth.run_on_data(design, table, **{"outliers": "none", **options})


INTERVAL = st.floats(0.002, 0.8).map(lambda seconds: round(seconds, 3))


@pytest.mark.long
@given(st.lists(INTERVAL, min_size=12, max_size=60), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_estimates_are_those_of_the_textbook_at_any_times(intervals, seed):
    # The first one is none that rows could be missing in.
    times = np.round(np.cumsum([0.0, 0.033, *intervals]), 6)
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=(len(times), 1)), rng.normal(size=(len(times), 1))
    found = run(design(), times, u, y)
    states, deviations = textbook(times, u, y)
    table = found.table
    np.testing.assert_allclose(table[["xhat[x1]", "xhat[x2]"]], states, atol=1e-9 * max(1.0, np.abs(states).max()))
    np.testing.assert_allclose(table[["sd xhat[x1]", "sd xhat[x2]"]], deviations, rtol=1e-9)
    np.testing.assert_array_equal(table["time"], times)


def test_missing_samples_at_irregular_times():
    rng = np.random.default_rng(4)
    times = np.round(np.cumsum([0.0, *rng.uniform(0.01, 0.3, 80)]), 4)
    u, y = rng.normal(size=(81, 1)), rng.normal(size=(81, 1))
    y[20:30] = np.nan
    found = run(design(), times, u, y)
    states, deviations = textbook(times, u, y)
    np.testing.assert_allclose(found.table["xhat[x2]"], states[:, 1], atol=1e-9)
    np.testing.assert_allclose(found.table["sd xhat[x1]"], deviations[:, 0], rtol=1e-9)


def test_regular_stamps_are_taken_as_before():
    rng = np.random.default_rng(5)
    times, u, y = DT * np.arange(100), rng.normal(size=(100, 1)), rng.normal(size=(100, 1))
    made = design()
    alone = made.observer.run(y, u)
    np.testing.assert_array_equal(run(made, times, u, y).table["xhat[x1]"], alone.states[:, 0])
    # A row that is missing is a sample without signals, as long as the stamps are even.
    kept = np.delete(np.arange(100), 40)
    found = run(made, times[kept], u[kept], y[kept])
    assert found.table["sd xhat[x1]"].iloc[40] > 1.05 * found.table["sd xhat[x1]"].iloc[39]


@pytest.mark.long
def test_parameters_learn_over_the_interval():
    """Two rows at once are as good as one: what is forgotten in between follows the time."""
    faulty = plant(Bf=[[0.0], [1.0]], fault_names=["leak"])
    made = design("adaptive-observer", faulty, forgetting=0.98)
    rng = np.random.default_rng(6)
    times = np.round(np.cumsum([0.0, *rng.uniform(0.02, 0.25, 900)]), 5)
    x, u, y = np.zeros(2), np.ones((len(times), 1)), np.zeros((len(times), 1))
    for k in range(1, len(times)):
        F, G, Q = step_of(times[k] - times[k - 1])
        leak = -0.5 if times[k - 1] > 40.0 else 0.0
        x = F @ x + (G @ u[k - 1]) + G[:, 0] * leak + np.linalg.cholesky(Q + 1e-15 * np.eye(2)) @ rng.normal(size=2)
        y[k] = C @ x + DEVIATION * rng.normal()
    table = run(made, times, u, y).table
    assert table["fhat[leak]"][times > 80.0].mean() == pytest.approx(-0.5, abs=0.1)
    assert abs(table["fhat[leak]"][(times > 20.0) & (times < 40.0)].mean()) < 0.1


def test_a_covariance_that_was_given_grows_with_the_interval():
    made = design(Q=0.01)
    times = np.array([0.0, 0.05, 0.1, 0.5])
    zero = np.zeros((4, 1))
    found = run(made, times, zero, np.full((4, 1), np.nan)).table["sd xhat[x1]"].to_numpy()
    P = np.eye(2)
    for seconds, deviation in zip(np.diff(times), found[1:], strict=True):
        F = expm(A * seconds)
        P = F @ P @ F.T + 0.01 * seconds / DT * np.eye(2)
        assert deviation == pytest.approx(np.sqrt(P[0, 0]), rel=1e-9)


@pytest.mark.long
def test_a_run_goes_on_where_it_stopped(tmp_path):
    rng = np.random.default_rng(7)
    times = np.round(np.cumsum([0.0, *rng.uniform(0.01, 0.3, 60)]), 4)
    u, y = rng.normal(size=(61, 1)), rng.normal(size=(61, 1))
    whole = run(design(), times, u, y).table
    first = run(design(), times[:25], u[:25], y[:25], state=tmp_path / "state.json").table
    second = run(design(), times[25:], u[25:], y[25:], state=tmp_path / "state.json").table
    pd.testing.assert_frame_equal(pd.concat([first, second], ignore_index=True), whole)


def test_what_cannot_is_refused_by_name():
    rng = np.random.default_rng(8)
    times = np.round(np.cumsum([0.0, *rng.uniform(0.01, 0.3, 30)]), 4)
    u, y = rng.normal(size=(31, 1)), rng.normal(size=(31, 1))
    written = obsynth.DescriptorSystem(A=expm(A * DT), B=B, C=C, dt=DT, sensor_noise={"y1": DEVIATION}, Bw=NOISE)
    for made, why in (
        (obsynth.descriptor_kalman(written), "stated in samples"),
        (design(sampled=plant(delays={"u1": 0.1})), "the plant has delays"),
        (design(sensors={"y1": {"every": 2}}), "sensors that are sampled every so many rows"),
    ):
        with pytest.raises(obsynth.SpecError, match=f"continuous plant that was sampled .*{why}"):
            run(made, times, u, y)
    with pytest.raises(obsynth.SpecError, match="not smoothed over irregular time stamps"):
        run(design(), times, u, y, smooth=True)


@pytest.mark.long
def test_unknown_inputs_and_nonlinear_stamps_keep_their_ways():
    unknown = plant(Bd=[[0.0], [1.0]], C=np.eye(2), sensor_noise={"y1": 0.1, "y2": 0.1})
    made = obsynth.design(obsynth.discretise(unknown, DT), "descriptor-kalman")
    rng = np.random.default_rng(9)
    times = np.round(np.cumsum([0.0, *rng.uniform(0.02, 0.3, 200)]), 4)
    u, x, y, truth = np.ones((201, 1)), np.zeros(2), np.zeros((201, 2)), np.zeros((201, 2))
    for k in range(1, 201):
        F, G, _ = step_of(times[k] - times[k - 1])
        x = F @ x + G[:, 0] * (1.0 + 5.0 * np.sin(k))
        truth[k], y[k] = x, x + 0.1 * rng.normal(size=2)
    table = obsynth.run_on_data(made, pd.DataFrame({"time": times, "u1": u[:, 0], "y1": y[:, 0], "y2": y[:, 1]})).table
    errors = table[["xhat[x1]", "xhat[x2]"]].to_numpy() - truth
    assert np.abs(errors[20:]).max() < 0.5
