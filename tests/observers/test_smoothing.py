"""Smoothers against the whole record as one least-squares problem, against textbook recursions, and on logs."""

from __future__ import annotations

import io
from functools import cache

import numpy as np
import pandas as pd
import pytest
from test_dae_observer import linear_observer, matrices

from obsynth import (
    DAEModel,
    DescriptorSystem,
    ObserverDesign,
    PreconditionError,
    SpecError,
    TimeVaryingDescriptorSystem,
    adaptive_observer,
    dae_adaptive_observer,
    descriptor_kalman,
    run_on_data,
    simulate_dae,
    smooth,
)
from obsynth.cli.main import main
from obsynth.observers.recursive.options import observer_from_options
from obsynth.observers.smoothing import smoothed_record

pytestmark = pytest.mark.usefixtures("taken_as_verified")

E = np.diag([1.0, 1.0, 0.0])
A = np.array([[0.9, 0.2, 0.1], [0.0, 0.7, 0.3], [1.0, 1.0, -2.0]])
B = np.array([[1.0], [0.0], [1.0]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
PHI, PSI = np.array([[0.0], [1.0], [0.0]]), np.array([[0.3], [0.0]])
Q, R = np.diag([0.1, 0.2, 0.05]), np.diag([0.3, 0.1])
START, P0 = np.array([1.0, 0.0, 0.5]), np.diag([1.0, 2.0, 0.5])
SAMPLES = 30
FILTER = {"Q": Q, "R": R, "initial_state": START, "initial_covariance": P0}


def plant(**changes) -> TimeVaryingDescriptorSystem:
    """An algebraic state, and one parameter in an equation and in an output."""
    return TimeVaryingDescriptorSystem(
        E, A, B, C, **{"Phi": PHI, "Psi": PSI, "dt": 1.0, "horizon": 2 * SAMPLES, **changes}
    )


def record(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Outputs with missing samples, of one sensor and of both, and inputs."""
    rng = np.random.default_rng(seed)
    y, u = rng.standard_normal((SAMPLES, 2)), rng.standard_normal((SAMPLES, 1))
    y[5], y[9, 0], y[12, 1], y[20:24] = np.nan, np.nan, np.nan, np.nan
    return y, u


@cache
def filtering() -> ObserverDesign:
    return descriptor_kalman(plant(Phi=None, Psi=None), **FILTER)


class Batch:
    """A weighted least-squares problem, row by row."""

    def __init__(self, unknowns: int) -> None:
        self.unknowns, self.rows, self.right = unknowns, [], []

    def add(self, parts: dict[int, np.ndarray], right: np.ndarray, covariance: np.ndarray) -> None:
        row = np.zeros((len(right), self.unknowns))
        for column, part in parts.items():
            row[:, column : column + part.shape[1]] = part
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        self.rows.append(white @ row)
        self.right.append(white @ right)

    def solved(self) -> tuple[np.ndarray, np.ndarray]:
        stacked = np.vstack(self.rows)
        covariance = np.linalg.inv(stacked.T @ stacked)
        return covariance @ stacked.T @ np.concatenate(self.right), np.sqrt(np.diag(covariance))


def whole_record(y, u, *, theta=None, walk=None):
    """States, and parameters with prior (mean, variance): one of them, or one for each step that walks."""
    samples, parameters = len(y), 0 if theta is None else 1 if walk is None else len(y) - 1
    batch = Batch(3 * samples + parameters)

    def place(k):
        return 3 * samples + (k if walk is not None else 0)

    batch.add({0: np.eye(3)}, START, P0)
    if theta is not None:
        batch.add({place(0): np.eye(1)}, np.array([theta[0]]), np.array([[theta[1]]]))
    for k in range(samples - 1):
        if walk is not None and k:
            batch.add({place(k): np.eye(1), place(k - 1): -np.eye(1)}, np.zeros(1), np.array([[walk]]))
        more = {} if theta is None else {place(k): -PHI}
        batch.add({3 * k + 3: E, 3 * k: -A, **more}, B @ u[k], Q)
        seen = ~np.isnan(y[k + 1])
        if seen.any():
            more = {} if theta is None else {place(k): PSI[seen]}
            batch.add({3 * k + 3: C[seen], **more}, y[k + 1][seen], R[np.ix_(seen, seen)])
    estimate, deviations = batch.solved()
    states = slice(0, 3 * samples)
    return (estimate[states].reshape(-1, 3), deviations[states].reshape(-1, 3), estimate[3 * samples :],
            deviations[3 * samples :])  # fmt: skip


def test_a_filter_is_smoothed_to_the_least_squares_of_the_whole_record() -> None:
    y, u = record()
    design = filtering()
    found, (states, deviations, _, _) = smooth(design, y, u), whole_record(y, u)
    np.testing.assert_allclose(found.states, states, atol=1e-11)
    np.testing.assert_allclose(found.state_deviations, deviations, rtol=1e-11)
    filtered = design.observer.run(y, u)
    assert (found.state_deviations <= filtered.state_deviations * (1.0 + 1e-12)).all()
    # Missing samples leave the algebraic state undetermined for the filter, and not for the smoother.
    assert np.isinf(filtered.state_deviations).any()
    assert np.isfinite(found.state_deviations).all()


def test_a_state_that_nothing_later_determines_stays_undetermined() -> None:
    y, u = record()
    y[-1, 1] = np.nan
    found = smooth(filtering(), y, u)
    assert np.isinf(found.state_deviations[-1, 2])
    assert np.isfinite(found.state_deviations[:-1]).all()


def test_constant_parameters_are_the_least_squares_of_the_whole_record() -> None:
    y, u = record()
    design = adaptive_observer(
        plant(), forgetting=1.0, initial_parameters=[0.2], initial_parameter_covariance=[[2.0]], **FILTER
    )
    found = smooth(design, (y, u))
    states, deviations, theta, spread = whole_record(y, u, theta=(0.2, 2.0))
    np.testing.assert_allclose(found.states, states, atol=1e-11)
    np.testing.assert_allclose(found.state_deviations, deviations, rtol=1e-11)
    np.testing.assert_allclose(found.parameters, np.tile(theta, (SAMPLES, 1)), atol=1e-11)
    np.testing.assert_allclose(found.parameter_deviations, np.tile(spread, (SAMPLES, 1)), rtol=1e-11)


def test_walking_parameters_are_the_least_squares_of_the_whole_record() -> None:
    y, u = record()
    design = adaptive_observer(
        plant(), form="random-walk", random_walk=[[0.07]], initial_parameters=[0.2],
        initial_parameter_covariance=[[2.0]], **FILTER,
    )  # fmt: skip
    found = smooth(design, y, u)
    states, deviations, theta, spread = whole_record(y, u, theta=(0.2, 2.07), walk=0.07)
    np.testing.assert_allclose(found.states, states, atol=1e-11)
    np.testing.assert_allclose(found.state_deviations, deviations, rtol=1e-11)
    # A row holds the parameters of the step that led there.
    np.testing.assert_allclose(found.parameters[1:, 0], theta, atol=1e-11)
    np.testing.assert_allclose(found.parameter_deviations[1:, 0], spread, rtol=1e-11)


def test_forgetting_looks_both_ways() -> None:
    """In the end it is the observer's estimate, and everywhere that of weights ``lambda ** |j - k|``."""
    y, u = record()
    share = 0.9
    design = adaptive_observer(plant(), forgetting=share, guard="none", initial_parameter_covariance=[[2.0]], **FILTER)
    found, filtered = smooth(design, y, u), design.observer.run(y, u)
    np.testing.assert_allclose(found.parameters[-1], filtered.parameters[-1], atol=1e-13)
    np.testing.assert_allclose(found.state_deviations[-1], filtered.state_deviations[-1], atol=1e-13)
    v, G = np.nan_to_num(filtered.innovations), np.nan_to_num(filtered.regressors[:, :, 0])
    for k in (0, 8, 22):
        weights = share ** np.abs(np.arange(SAMPLES) - k)
        weight, prior = weights @ np.sum(G * G, axis=1), share ** float(k) / 2.0
        estimate = weights @ np.sum(G * v, axis=1) / (weight + prior)
        variance = (weights**2 @ np.sum(G * G, axis=1) + 2.0 * prior**2) / (weight + prior) ** 2
        np.testing.assert_allclose(found.parameters[k, 0], estimate, rtol=1e-10)
        np.testing.assert_allclose(found.parameter_covariances[k, 0, 0], variance, rtol=1e-10)


def test_without_algebraic_states_it_is_rauch_tung_striebel() -> None:
    """The textbook recursion, with the inverse of the predicted covariance."""
    rng = np.random.default_rng(3)
    F, H = np.array([[0.95, 0.3], [-0.2, 0.9]]), np.array([[1.0, 0.0]])
    noise, sensor = np.diag([0.02, 0.1]), np.array([[0.4]])
    y = rng.standard_normal((40, 1))
    x, P, filtered, predicted = np.array([1.0, -1.0]), np.eye(2), [], []
    for k in range(40):
        if k:
            x, P = F @ x, F @ P @ F.T + noise
            predicted.append((x, P))
            gain = P @ H.T / (H @ P @ H.T + sensor)
            x, P = x + gain @ (y[k] - H @ x), P - gain @ H @ P
        filtered.append((x, P))
    means, spreads = [x], [P]
    for k in range(38, -1, -1):
        (before, own), (ahead, forecast) = filtered[k], predicted[k]
        back = own @ F.T @ np.linalg.inv(forecast)
        means.insert(0, before + back @ (means[0] - ahead))
        spreads.insert(0, own + back @ (spreads[0] - forecast) @ back.T)
    design = descriptor_kalman(
        DescriptorSystem(A=F, B=np.zeros((2, 0)), C=H, dt=1.0), Q=noise, R=sensor, initial_state=[1.0, -1.0]
    )
    found = smooth(design, y)
    np.testing.assert_allclose(found.states, means, atol=1e-11)
    np.testing.assert_allclose(found.state_deviations**2, [np.diag(P) for P in spreads], rtol=1e-9)


def test_exact_equations_and_a_start_of_which_nothing_is_known() -> None:
    """Singular covariances and a prior of 1e12: nothing is inverted."""
    y, u = record()
    changes = {"Q": np.diag([0.1, 0.0, 0.0]), "initial_covariance": 1e12 * np.eye(3)}
    found = smooth(descriptor_kalman(plant(Phi=None, Psi=None), **{**FILTER, **changes}), y, u)
    x = found.states
    np.testing.assert_allclose(x[:-1, 0] + x[:-1, 1] - 2.0 * x[:-1, 2] + u[:-1, 0], 0.0, atol=1e-8)
    np.testing.assert_allclose(x[1:, 1], 0.7 * x[:-1, 1] + 0.3 * x[:-1, 2], atol=1e-8)
    assert found.state_deviations[1:].max() < 10.0


def test_early_constraints_say_the_same_of_the_past() -> None:
    """The algebraic equation of the last sample is what a sample without outputs would bring."""
    y, u = record()
    early = smooth(descriptor_kalman(plant(Phi=None, Psi=None), early_constraints=True, **FILTER), y, u)
    longer = np.vstack((y, [[np.nan, np.nan]])), np.vstack((u, [[0.0]]))
    late = smooth(filtering(), longer)
    np.testing.assert_allclose(early.states, late.states[:-1], atol=1e-10)
    np.testing.assert_allclose(early.state_deviations, late.state_deviations[:-1], rtol=1e-9)


@pytest.mark.parametrize("form", ["innovation", "random-walk"])
def test_a_lag_is_the_whole_record_of_what_is_there(form) -> None:
    y, u = record()
    walk = {"random_walk": [[0.01]]} if form == "random-walk" else {}
    design = adaptive_observer(plant(), form=form, **walk, **FILTER)
    found = smooth(design, y, u, lag=4)
    for k in (0, 3, 11, 19, SAMPLES - 5, SAMPLES - 1):
        part = smooth(design, y[: k + 5], u[: k + 5])
        np.testing.assert_allclose(found.states[k], part.states[k], atol=1e-12)
        np.testing.assert_allclose(found.parameters[k], part.parameters[k], atol=1e-12)
        np.testing.assert_allclose(found.parameter_deviations[k], part.parameter_deviations[k], rtol=1e-10)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("form", "linear"),
    [("forgetting", "innovation"), ("augmented-kalman", "random-walk"), ("random-walk", "random-walk")],
)
def test_a_linear_plant_as_equations_has_the_linear_smoother(form, linear) -> None:
    m, dt = matrices(), 0.25
    rng = np.random.default_rng(4)
    y, u = rng.standard_normal((25, 2)), rng.standard_normal((25, 2))
    u[:, 1] = 0.0
    # The linear model begins with y(1), and takes the input of the sample before.
    y[0], y[7, 1], y[15:18] = np.nan, np.nan, np.nan
    walk = 0.03 * np.eye(2)
    own = {"forgetting": 1.0} if form == "forgetting" else {"random_walk": walk}
    observer = linear_observer(form=form, **own)
    found = smoothed_record(observer, y, u, None)
    system = TimeVaryingDescriptorSystem(
        m["E"] / dt - m["A"], m["E"] / dt, m["B"], m["C"], Phi=m["G"], Psi=m["D"], dt=dt
    )
    more = {"forgetting": 1.0} if linear == "innovation" else {"form": linear, "random_walk": walk}
    design = adaptive_observer(
        system, Q=0.01 * np.eye(4), R=0.04 * np.eye(2), initial_state=observer.initial_state + found.projection, **more
    )
    shifted = np.vstack((u[1:, :1], [[0.0]]))
    expected = smooth(design, y, shifted)
    np.testing.assert_allclose(found.states, expected.states, atol=1e-9)
    np.testing.assert_allclose(found.state_deviations, expected.state_deviations, rtol=1e-8)
    np.testing.assert_allclose(found.parameters, expected.parameters, atol=1e-9)
    np.testing.assert_allclose(found.parameter_deviations, expected.parameter_deviations, rtol=1e-8)


def test_the_end_of_a_nonlinear_record_is_the_observers_estimate() -> None:
    rng = np.random.default_rng(5)
    y, u = rng.standard_normal((20, 2)), 0.3 * rng.standard_normal((20, 2))
    for changes in ({"forgetting": 0.9}, {"forgetting": 0.9, "weight": "paper"}, {"form": "augmented-kalman"}):
        observer = linear_observer(**changes)
        found, filtered = smoothed_record(observer, y, u, None), observer.run(y, u)
        np.testing.assert_allclose(found.states[-1], filtered.states[-1], atol=1e-12)
        np.testing.assert_allclose(found.state_deviations[-1], filtered.state_deviations[-1], rtol=1e-9)
        np.testing.assert_allclose(found.parameters[-1], filtered.parameters[-1], atol=1e-12)


@pytest.mark.long
def test_deviations_are_those_of_the_errors() -> None:
    """Monte Carlo: squared errors in units of their variances, and smaller than those of the filter."""
    rng = np.random.default_rng(6)
    design = filtering()
    head = np.vstack((E[:2], A[2:]))
    ratios, gains = [], []
    for _ in range(60):
        x, y, states = START + np.sqrt(np.diag(P0)) * rng.standard_normal(3), [np.full(2, np.nan)], []
        noise = rng.standard_normal((SAMPLES, 3)) * np.sqrt(np.diag(Q))
        # The algebraic equation of a sample holds for its own state.
        x[2] = (x[0] + x[1] + noise[0, 2]) / 2.0
        states.append(x)
        for k in range(1, SAMPLES):
            right = np.array([*(A[:2] @ x + noise[k - 1, :2]), -noise[k, 2]])
            x = np.linalg.solve(head, right)
            states.append(x)
            y.append(C @ x + np.sqrt(np.diag(R)) * rng.standard_normal(2))
        truth, u = np.array(states), np.zeros((SAMPLES, 1))
        outputs = np.array(y)
        found, filtered = smooth(design, outputs, u), design.observer.run(outputs, u)
        errors = found.states - truth
        ratios.append((errors / found.state_deviations)[1:-1] ** 2)
        gains.append(np.mean(errors[1:-1] ** 2) / np.mean((filtered.states - truth)[1:-1] ** 2))
    mean = np.mean(ratios, axis=0)
    # 60 degrees of freedom: 95 % of the means lie between .67 and 1.39.
    assert np.mean((mean > 0.67) & (mean < 1.39)) > 0.9
    assert abs(np.mean(mean) - 1.0) < 0.06
    assert np.mean(gains) < 0.9


def test_an_outlier_that_was_left_out_is_left_out_here() -> None:
    y, u = record()
    wrong, missing = y.copy(), y.copy()
    wrong[15, 0], missing[15, 0] = 1e6, np.nan
    model = plant(Phi=None, Psi=None)
    gated = smooth(descriptor_kalman(model, outliers="gate", **FILTER), wrong, u)
    np.testing.assert_allclose(gated.states, smooth(filtering(), missing, u).states, atol=1e-12)


def log(y: np.ndarray, u: np.ndarray) -> pd.DataFrame:
    frame = pd.DataFrame({"time": np.arange(len(y), dtype=float), "u1": u[:, 0], "y1": y[:, 0] + 100.0, "y2": y[:, 1]})
    return frame.drop(index=[14, 15])


@cache
def shifted_design() -> ObserverDesign:
    return adaptive_observer(plant(operating_point={"x1": 100.0, "y1": 100.0}), outliers="none", **FILTER)


def uncertain_inputs(u: np.ndarray) -> np.ndarray:
    """Return Q(k) with what the inputs of rows 14 and 15 may be off by when these are missing."""
    before = u[:14, 0]
    change, width = np.abs(np.diff(before)).max(), np.ptp(before)
    off = np.cumsum([min(change, width), min(2 * change, width)])
    variances = np.diff(off**2, prepend=0.0)
    moved = abs(u[16, 0] - u[13, 0])
    if moved > min(3 * change, width):
        variances[1] += (2 * moved) ** 2 - off[1] ** 2
    found = np.tile(Q, (2 * SAMPLES, 1, 1))
    found[14:16] += variances[:, None, None] * (B @ B.T)
    return found


@pytest.mark.long
def test_logs_with_gaps_are_smoothed_like_arrays(tmp_path) -> None:
    y, u = record()
    design, frame = shifted_design(), log(y, u)
    told = adaptive_observer(shifted_design().plant, outliers="none", **{**FILTER, "Q": uncertain_inputs(u)})
    y[14:16], u[14:16] = np.nan, u[13]
    kept = np.setdiff1d(np.arange(SAMPLES), [14, 15])
    whole, late = smooth(told, y, u), smooth(told, y, u, lag=3)
    on_log = smooth(design, frame, outliers="none")
    np.testing.assert_allclose(on_log.states - [100.0, 0.0, 0.0], whole.states[kept], atol=1e-11)
    table = run_on_data(design, frame, smooth=True, outliers="none").table
    np.testing.assert_allclose(table["fhat[theta1]"], whole.parameters[kept, 0], atol=1e-11)
    np.testing.assert_allclose(table["sd xhat[x2]"], whole.state_deviations[kept, 1], rtol=1e-10)
    run = run_on_data(design, frame, lag=3, outliers="none")
    np.testing.assert_allclose(run.table["xhat[x2]"], late.states[kept, 1], atol=1e-11)
    assert run.table["time"].tolist() == frame["time"].tolist()
    assert run.rows == len(frame)
    filtered = run_on_data(design, frame, outliers="none").table
    pd.testing.assert_series_equal(run.table["r[innovation 1]"], filtered["r[innovation 1]"])
    # A stream is answered while it runs.
    out = io.StringIO()
    run_on_data(design, io.StringIO(frame.to_csv(index=False)), out, lag=3, outliers="none")
    streamed = pd.read_csv(io.StringIO(out.getvalue()))
    np.testing.assert_allclose(streamed["xhat[x2]"], run.table["xhat[x2]"], rtol=1e-14)
    # From the command line.
    frame.to_csv(tmp_path / "log.csv", index=False)
    design.save(tmp_path / "gains.json")
    asked = ["run", "--gains", str(tmp_path / "gains.json"), "--data", str(tmp_path / "log.csv"), "--quiet",
             "--outliers", "none", "--out", str(tmp_path / "out.csv")]  # fmt: skip
    assert main([*asked, "--smooth"]) == 0
    np.testing.assert_allclose(pd.read_csv(tmp_path / "out.csv")["xhat[x2]"], table["xhat[x2]"], rtol=1e-14)
    assert main([*asked, "--lag", "3", "--force"]) == 0
    np.testing.assert_allclose(pd.read_csv(tmp_path / "out.csv")["xhat[x2]"], run.table["xhat[x2]"], rtol=1e-14)


def test_a_run_with_a_lag_goes_on_from_a_saved_state(tmp_path) -> None:
    """What was written at the end of the first part had less behind it; the second part loses nothing."""
    y, u = record()
    design, frame = shifted_design(), log(y, u)
    one = run_on_data(design, frame, lag=3, outliers="none").table
    state = tmp_path / "state.json"
    first = run_on_data(design, frame[:12], lag=3, outliers="none", state=state).table
    second = run_on_data(design, frame[12:], lag=3, outliers="none", state=state).table
    columns = ["xhat[x2]", "fhat[theta1]", "sd xhat[x3]"]
    np.testing.assert_allclose(first[columns][:9], one[columns][:9], rtol=1e-10)
    np.testing.assert_allclose(second[columns], one[columns][12:], rtol=1e-9)


def test_what_cannot_be_smoothed_is_refused_with_the_reason() -> None:
    y, u = record()
    design = shifted_design()
    for lag in (0, -1, 2.5, True):
        with pytest.raises(SpecError, match="lag is"):
            smooth(design, y, u, lag=lag)
    with pytest.raises(SpecError, match="no end"):
        smooth(design, io.StringIO("time,u1,y1,y2\n"))
    with pytest.raises(SpecError, match="no end"):
        run_on_data(design, io.StringIO("time,u1,y1,y2\n"), smooth=True)
    with pytest.raises(SpecError, match="give one of them"):
        run_on_data(design, log(y, u), smooth=True, lag=2)
    with pytest.raises(SpecError, match="leave the state out"):
        run_on_data(design, log(y, u), smooth=True, state="state.json")
    frame = log(y, u)
    frame.loc[5, "time"] = 5.5  # half a sample off: it may be that of either
    with pytest.raises(SpecError, match="Row 6"):
        smooth(design, frame)
    literal = adaptive_observer(plant(), form="literal", **FILTER)
    with pytest.raises(PreconditionError, match="correlated in time"):
        smooth(literal, y, u)


def test_a_nonlinear_record_is_nearer_to_the_truth() -> None:
    """A leaking tank whose leak walks: the smoothed level and leak miss by less than the filtered ones."""
    tank = DAEModel(
        {"tank": "area * der(level) = inflow - leak * sqrt(level)"}, {"gauge": "level"}, states={"level": 1.0},
        inputs={"inflow": 0.5}, parameters={"leak": 0.5}, constants={"area": 2.0},
        units={"level": "m", "inflow": "m3/s", "leak": "m2.5/s", "gauge": "m"},
    )  # fmt: skip
    rng, errors = np.random.default_rng(8), []
    made = dae_adaptive_observer(tank, dt=0.5, Q=1e-5, R=2e-3, form="augmented-kalman", random_walk=1e-4)
    for seed in range(6):
        leak = 0.5 + np.concatenate(([0.0], np.cumsum(0.01 * rng.standard_normal(79))))[:, None]
        u = np.full((80, 1), 0.5)
        truth = simulate_dae(tank, u, dt=0.5, parameters=leak, Q=1e-5 * np.eye(1), R=2e-3 * np.eye(1), seed=seed,
                             integration=made.observer.integration)  # fmt: skip
        found, filtered = smooth(made, truth.outputs, u), made.observer.run(truth.outputs, u)
        errors.append([np.mean((each.states - truth.states) ** 2) for each in (found, filtered)]
                      + [np.mean((each.parameters - leak) ** 2) for each in (found, filtered)])  # fmt: skip
        assert (found.parameter_deviations <= filtered.parameter_deviations * 1.01).all()
    states, before, parameters, filtered_parameters = np.mean(errors, axis=0)
    assert states < 0.8 * before
    assert parameters < 0.8 * filtered_parameters


@pytest.mark.parametrize("seed", [5, 28, 167])
def test_random_plants_of_any_rank_and_units_with_missing_samples(seed) -> None:
    """What is undetermined, and everything else, is what the singular values of the whole problem say."""
    rng = np.random.default_rng(seed)
    nx = rng.integers(2, 5)
    rank, ny = rng.integers(1, nx + 1), rng.integers(1, 4)
    first = rng.standard_normal((nx, nx))
    E = first @ np.diag([1.0] * rank + [0.0] * (nx - rank)) @ rng.standard_normal((nx, nx))
    A, C = 0.7 * rng.standard_normal((nx, nx)), rng.standard_normal((ny, nx))
    assert np.linalg.matrix_rank(np.vstack([E, C]), 1e-2) == nx
    units = 10.0 ** rng.integers(-3, 4, nx)
    E, A, C = E / units, A / units, C / units
    q, r, spread = rng.random(nx) + 0.1, rng.random(ny) + 0.1, units**2 * (rng.random(nx) + 0.1)
    y = rng.standard_normal((10, ny))
    y[rng.random((10, ny)) < 0.35] = np.nan
    observer = observer_from_options(
        TimeVaryingDescriptorSystem(E, A, None, C, dt=1.0),
        {"Q": np.diag(q), "R": np.diag(r), "initial_state": None, "initial_covariance": np.diag(spread),
         "early_constraints": False},
    )  # fmt: skip
    found = smoothed_record(observer, y, np.zeros((10, 0)), None)
    batch = Batch(10 * nx)
    batch.add({0: np.eye(nx)}, np.zeros(nx), np.diag(spread))
    for k in range(9):
        batch.add({nx * (k + 1): E, nx * k: -A}, np.zeros(nx), np.diag(q))
        seen = ~np.isnan(y[k + 1])
        if seen.any():
            batch.add({nx * (k + 1): C[seen]}, y[k + 1][seen], np.diag(r[seen]))
    left, values, right = np.linalg.svd(np.vstack(batch.rows) * np.tile(units, 10))
    count = int(np.sum(values > 1e-9 * values[0]))
    whole = right[:count].T / values[:count]
    undetermined = (np.abs(right[count:]) > 1e-7).any(axis=0).reshape(10, nx)
    states = (whole @ (left[:, :count].T @ np.concatenate(batch.right))).reshape(10, nx) * units
    deviations = np.sqrt(np.sum(whole**2, axis=1)).reshape(10, nx) * units
    np.testing.assert_array_equal(np.isinf(found.state_deviations), undetermined)
    gaps = np.abs(found.states - states) / deviations
    assert gaps[~undetermined].max() < 1e-8
    np.testing.assert_allclose(found.state_deviations[~undetermined], deviations[~undetermined], rtol=1e-8)
