"""Sensors of several rates, late values and bounds on states, against the plain observer and a general optimiser."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_dae_observer import linear_observer
from test_smoothing import FILTER, SAMPLES, plant, record

from obsynth import (
    DescriptorSystem,
    Scenario,
    SpecError,
    Step,
    adaptive_observer,
    descriptor_kalman,
    design,
    export,
    load,
    load_spec,
    run_batch,
    run_on_data,
    simulate,
    smooth,
    verify,
)
from obsynth.observers.outliers import projected

SENSORS = {"y1": {"every": 3, "delay": 2}, "y2": {"delay": 4}}


def arrived(y: np.ndarray, k: int) -> np.ndarray:
    """What is known in row k: y1 of each third row after two rows, y2 after four."""
    found = np.full_like(y[: k + 1], np.nan)
    for j in range(k + 1):
        if j % 3 == 0 and j + 2 <= k:
            found[j, 0] = y[j, 0]
        if j + 4 <= k:
            found[j, 1] = y[j, 1]
    return found


def as_rows(y: np.ndarray) -> np.ndarray:
    """The log of these sensors; in the rows without a sample y1 holds its last value."""
    found = np.full_like(y, np.nan)
    for k in range(len(y)):
        if k >= 2:
            found[k, 0] = y[(k - 2) // 3 * 3, 0]
        if k >= 4:
            found[k, 1] = y[k - 4, 1]
    return found


def kalman(**changes):
    return descriptor_kalman(plant(Phi=None, Psi=None), **{**FILTER, **changes})


@pytest.mark.one_in(3)
@pytest.mark.usefixtures("taken_as_verified")
@pytest.mark.parametrize("kind", ["descriptor-kalman", "innovation", "random-walk"])
def test_late_values_are_put_where_they_belong(kind) -> None:
    y, u = record()

    def made(**changes):
        if kind == "descriptor-kalman":
            return kalman(**changes)
        walk = {"random_walk": [[0.01]]} if kind == "random-walk" else {}
        return adaptive_observer(plant(), form=kind, **walk, **changes, **FILTER)

    late, plain = made(sensors=SENSORS), made()
    found = late.observer.run(as_rows(y), u)
    for k in (0, 1, 4, 7, 13, 22, SAMPLES - 1):
        expected = plain.observer.run(arrived(y, k), u[: k + 1])
        np.testing.assert_allclose(found.states[k], expected.states[-1], atol=1e-12)
        np.testing.assert_allclose(found.state_deviations[k], expected.state_deviations[-1], rtol=1e-12)
        np.testing.assert_allclose(found.parameters[k], expected.parameters[-1], atol=1e-12)
    whole = smooth(late, as_rows(y), u)
    np.testing.assert_allclose(whole.states, smooth(plain, arrived(y, SAMPLES - 1), u).states, atol=1e-12)
    some = smooth(late, as_rows(y), u, lag=3)
    np.testing.assert_allclose(some.states[11], smooth(plain, arrived(y, 14), u[:15]).states[11], atol=1e-12)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("form", ["forgetting", "augmented-kalman"])
def test_late_values_of_a_nonlinear_plant(form) -> None:
    rng = np.random.default_rng(2)
    y, u = rng.standard_normal((18, 2)), 0.2 * rng.standard_normal((18, 2))
    late = linear_observer(form=form, sensors={"y0": {"every": 3, "delay": 2}, "y1": {"delay": 4}})
    plain = linear_observer(form=form)
    found = late.run(as_rows(y), u)
    for k in (0, 3, 9, 17):
        expected = plain.run(arrived(y, k), u[: k + 1])
        np.testing.assert_allclose(found.states[k], expected.states[-1], atol=1e-12)
        np.testing.assert_allclose(found.parameters[k], expected.parameters[-1], atol=1e-12)
    running = late.start()
    rows = [running.step(y_k, u_k).states[0] for y_k, u_k in zip(as_rows(y), u, strict=True)]
    np.testing.assert_array_equal(rows, found.states)


@pytest.mark.long
@pytest.mark.usefixtures("taken_as_verified")
def test_a_log_with_slow_and_late_sensors(tmp_path) -> None:
    """A row without a value that is not due is no partial one; a run goes on from its state; the gain set keeps it."""
    y, u = record()
    y = np.nan_to_num(y)
    made = kalman(sensors=SENSORS)
    made.save(tmp_path / "gains.json")
    kept = load(tmp_path / "gains.json")
    assert kept.observer.sensors == {"y1": {"every": 3, "delay": 2}, "y2": {"every": 1, "delay": 4}}
    assert verify(kept).passed
    rows = as_rows(y)
    log = pd.DataFrame({"time": np.arange(SAMPLES, dtype=float), "u1": u[:, 0], "y1": rows[:, 0], "y2": rows[:, 1]})
    whole = run_on_data(kept, log, outliers="none")
    assert whole.statuses == {"ok": SAMPLES}
    expected = made.observer.run(rows, u)
    np.testing.assert_allclose(whole.table["xhat[x2]"], expected.states[:, 1], atol=1e-12)
    parts = [run_on_data(kept, part, outliers="none", state=tmp_path / "state.json").table
             for part in (log[:13], log[13:])]  # fmt: skip
    np.testing.assert_allclose(pd.concat(parts)["xhat[x2]"], expected.states[:, 1], atol=1e-12)
    later = run_on_data(kept, log, outliers="none", lag=3).table
    np.testing.assert_allclose(later["xhat[x2]"], smooth(made, rows, u, lag=3).states[:, 1], atol=1e-12)
    # A due value that is missing is missing.
    log.loc[8, "y1"] = np.nan
    assert run_on_data(kept, log, outliers="none").statuses == {"ok": SAMPLES - 1, "partial": 1}
    both = run_batch(made.observer, np.stack([rows, rows[::-1]]), u)
    np.testing.assert_array_equal(both.states[0], expected.states)


@pytest.mark.usefixtures("taken_as_verified")
def test_a_simulation_measures_when_the_sensors_do() -> None:
    made = kalman(sensors=SENSORS)
    scenario = Scenario(horizon=20.0, inputs={"u1": Step(size=1.0, start=5.0)}, noise=1.0, seed=3)
    slow = simulate(made, scenario)
    fast = simulate(kalman(), scenario)
    expected = np.full_like(fast.outputs, np.nan)
    expected[2::3, 0] = fast.outputs[0:-2:3, 0]
    expected[4:, 1] = fast.outputs[:-4, 1]
    np.testing.assert_array_equal(slow.outputs, expected)
    np.testing.assert_array_equal(slow.estimates.states, made.observer.run(expected, slow.inputs).states)


SPEC = """
schema_version: 1
name: tank
plant:
  E: [[1, 0], [0, 0]]
  A: [[0.9, 0.1], [1, -2]]
  B: [[1], [0]]
  C: [[1, 0], [0, 1]]
  dt: 1.0
  state_names: [level, flow]
  input_names: [pump]
  output_names: [slow, fast]
method:
  id: descriptor-kalman
  options:
    sensors: {slow: {every: 10, delay: 3}}
    state_bounds: {level: [0, 5]}
"""


def test_a_spec_says_both(tmp_path) -> None:
    file = tmp_path / "spec.yaml"
    file.write_text(SPEC, encoding="utf-8")
    spec = load_spec(file)
    made = design(spec.plant, spec.method, **spec.options)
    assert made.observer.sensors == {"slow": {"every": 10, "delay": 3}}
    np.testing.assert_array_equal(made.observer.state_bounds, [[0.0, 5.0], [-np.inf, np.inf]])
    file.write_text(SPEC.replace("every: 10", "every: 0"), encoding="utf-8")
    with pytest.raises(SpecError, match="every"):
        load_spec(file)
    file.write_text(SPEC.replace("descriptor-kalman", "pd-observer"), encoding="utf-8")
    with pytest.raises(SpecError, match="sensors"):
        load_spec(file)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_the_projection_is_the_nearest_point(seed, singular) -> None:
    from scipy.optimize import minimize

    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((3, 2 if singular else 3))
    x, low = rng.standard_normal(3), -0.5 + 0.2 * rng.standard_normal(3)
    bounds = np.column_stack([low, low + 1.0])
    if singular:
        # Two directions and two bounded states: there is always a point.
        bounds[2] = -np.inf, np.inf
    found = projected(x, factor, bounds)
    assert (found >= bounds[:, 0] - 1e-9).all()
    assert (found <= bounds[:, 1] + 1e-9).all()
    sides = []
    for i, pair in enumerate(bounds):
        for sign, end in zip((1.0, -1.0), pair, strict=True):
            if np.isfinite(end):
                gap = lambda e, sign=sign, end=end, i=i: sign * ((x + factor @ e)[i] - end)  # noqa: E731
                sides.append({"type": "ineq", "fun": gap})
    best = minimize(lambda e: e @ e, np.linalg.lstsq(factor, found - x)[0], constraints=sides, tol=1e-12)
    own = np.linalg.lstsq(factor, found - x)[0]
    np.testing.assert_allclose(x + factor @ own, found, atol=1e-7)
    assert own @ own <= best.fun * (1.0 + 1e-5) + 1e-9


@pytest.mark.usefixtures("taken_as_verified")
def test_bounds_hold_and_bring_no_estimate_further_from_the_truth() -> None:
    """The recursion goes on without them, so that innovations and covariances are those of the plain filter."""
    y, u = record()
    bounded = kalman(state_bounds={"x1": [-0.2, 0.2], "x3": [0.0, np.inf]})
    found, plain = bounded.observer.run(y, u), kalman().observer.run(y, u)
    assert found.states[:, 0].min() >= -0.2
    assert found.states[:, 0].max() <= 0.2
    assert found.states[:, 2].min() >= 0.0
    np.testing.assert_array_equal(found.innovations, plain.innovations)
    np.testing.assert_array_equal(found.state_deviations, plain.state_deviations)
    smoothed = smooth(bounded, y, u)
    assert smoothed.states[:, 2].min() >= 0.0
    row = next(check for check in verify(bounded).checks if check.name == "state bounds")
    assert row.status == "assumed"
    assert "x1, x3" in row.detail
    # Any point inside, in units of the covariance.
    rng, state, free = np.random.default_rng(0), bounded.observer.init(), kalman().observer.init()
    for k in range(10):
        state, shown = bounded.observer.advance(state, np.nan_to_num(y[k]), u[k])
        free, row = kalman_row(free, np.nan_to_num(y[k]), u[k])
        if k and np.linalg.matrix_rank(row.factor) == 3:
            inside = np.array([rng.uniform(-0.2, 0.2), rng.normal(), abs(rng.normal())])
            before, after = (np.linalg.solve(row.factor, x - inside) for x in (row.x, shown.x))
            assert after @ after <= before @ before + 1e-9


_PLAIN = kalman()


def kalman_row(state, y, u):
    return _PLAIN.observer.advance(state, y, u)


def test_bounds_of_a_nonlinear_plant_are_where_the_next_step_begins() -> None:
    rng = np.random.default_rng(4)
    y, u = rng.standard_normal((15, 2)), 0.2 * rng.standard_normal((15, 2))
    for form in ("forgetting", "augmented-kalman"):
        bounded = linear_observer(form=form, state_bounds={"x1": [-0.1, 0.1]})
        found, plain = bounded.run(y, u), linear_observer(form=form).run(y, u)
        assert np.abs(found.states[:, 1]).max() <= 0.1
        assert np.abs(plain.states[:, 1]).max() > 0.1
        assert np.isfinite(found.state_deviations).all()


@pytest.mark.usefixtures("taken_as_verified")
def test_what_is_refused_by_name(tmp_path) -> None:
    y, u = record()
    bounded, late = kalman(state_bounds={"x1": [-1.0, 1.0]}), kalman(sensors={"y1": {"every": 2}})
    for made, option in ((bounded, "state_bounds"), (late, "sensors")):
        for name in ("observer.c", "observer.npz", "observer.fmu"):
            with pytest.raises(SpecError, match=option):
                export(made, tmp_path / name)
        with pytest.raises(SpecError, match="state_bounds"):
            made.observer.run(y, u, compiled=True)
    assert not list(tmp_path.iterdir())
    with pytest.raises(SpecError, match="state_bounds"):
        linear_observer(state_bounds={"x1": [-1.0, 1.0]}).run(y[:5], np.zeros((5, 2)), compiled=True)
    wrong = [
        {"sensors": {"y1": {"every": 0}}}, {"sensors": {"y1": {"delay": -1}}}, {"sensors": {"y1": {"rate": 2}}},
        {"sensors": {"y7": {"every": 2}}}, {"sensors": [2, 3]}, {"state_bounds": {"x1": [1.0, 0.0]}},
        {"state_bounds": {"x9": [0.0, 1.0]}}, {"state_bounds": [[0.0, 1.0]]}, {"state_bounds": {"x1": 3.0}},
        {"state_bounds": {"x1": [float("nan"), 1.0]}},
    ]  # fmt: skip
    for options in wrong:
        with pytest.raises(SpecError):
            kalman(**options)
    stable = DescriptorSystem(A=[[0.5]], B=[[1.0]], C=[[1.0]], dt=1.0)
    for method in ("pd-observer", "ui-pi-observer", "fault-estimation-filter"):
        with pytest.raises(SpecError, match="sensors"):
            design(stable, method, sensors={"y1": {"every": 2}})
