"""Plants whose outputs need derivatives of known inputs: these are inputs of their own, formed from the log."""

from __future__ import annotations

import io
import math
import zipfile

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import obsynth
from obsynth.cli.main import main
from obsynth.plants.input_derivatives import difference_quotients
from obsynth.plants.transformations.index_reduction import with_input_derivatives

STEP, SIZE, BEGIN = 0.05, 0.5, 30.0


@pytest.fixture(scope="module")
def plant():
    """A position is prescribed, ``q = u``; a force sensor measures ``x + 2 u'``, with ``x' = -x + u + leak``."""
    return obsynth.DescriptorSystem(
        np.diag([1.0, 1.0, 0.0, 0.0]),
        [[-1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]],
        B=[[0.0], [0.0], [-1.0], [0.0]], C=[[1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 2.0]],
        Bf=[[1.0], [0.0], [0.0], [0.0]], dt=0.0, state_names=["x", "q", "speed", "force"], input_names=["u"],
        output_names=["y1", "y2"], fault_names=["leak"], sensor_noise={"y1": 0.01, "y2": 0.01}, units={"u": "m"},
    )  # fmt: skip


@pytest.fixture(scope="module")
def design(plant):
    return obsynth.ui_pi_observer(plant)


@pytest.fixture(scope="module")
def log():
    times = np.arange(0.0, 60.0, STEP)

    def rate(t, x):
        return -x + np.sin(0.5 * t) + (SIZE if t > BEGIN else 0.0)

    x = solve_ivp(rate, (0.0, times[-1]), [0.0], t_eval=times, rtol=1e-9, atol=1e-9, max_step=STEP).y[0]
    slope = 0.5 * np.cos(0.5 * times)
    return pd.DataFrame({"time": times, "u": np.sin(0.5 * times), "y1": x, "y2": x + 2.0 * slope, "slope": slope})


def estimates(run):
    return run.table["fhat[leak]"].to_numpy()


def test_the_output_is_used_and_the_derivative_is_an_input_that_is_named(plant, design):
    assert design.report.passed
    assert design.plant.input_names == ("u", "derivative of u")
    assert design.plant.output_names == ("y1", "y2")
    assert design.plant.units["derivative of u"] == "m/s"
    assert any("'y2' needs the derivative of 'u'" in note and "by differences" in note for note in design.notes)
    assert "derivative of u" in str(obsynth.check(plant)["ui-pi-observer"])


def test_samples_of_such_a_plant_have_the_derivative_as_an_input_too(plant, log):
    sampled = obsynth.discretise(plant, STEP).plant
    assert sampled.input_names == ("u", "derivative of u")
    # y1 = x, y2 = x + 2 u', x' = -x + u: the derivative acts at the samples alone.
    np.testing.assert_allclose(sampled.A, [[math.exp(-STEP)]])
    np.testing.assert_allclose(sampled.B, [[1.0 - math.exp(-STEP), 0.0]])
    np.testing.assert_allclose(sampled.D, [[0.0, 0.0], [0.0, 2.0]], atol=1e-15)
    found = obsynth.ui_pi_observer(obsynth.discretise(plant, STEP))
    assert found.report.passed
    run = obsynth.run_on_data(found, log)
    assert "derivative of u is formed from u by differences from row to row." in run.warnings
    exact = obsynth.run_on_data(found, log, columns={"derivative of u": "slope"})
    # An input that moves is held for half a step too long on average: half of 0.05 times its slope, 0.5 at most.
    assert abs(estimates(exact)[-1] - SIZE) < 2.0 * 0.5 * STEP * 0.5


def test_a_log_gives_the_derivative_and_what_differences_lose_is_bounded(design, log):
    run = obsynth.run_on_data(design, log)
    assert "derivative of u is formed from u by differences from row to row." in run.warnings
    # A backward difference is off by half a step times the second derivative, 1/4 at most.
    lost = 2.0 * 0.5 * STEP * 0.25
    assert abs(estimates(run)[-1] - SIZE) < 2.0 * lost
    exact = obsynth.run_on_data(design, log, columns={"derivative of u": "slope"})
    assert abs(estimates(exact)[-1] - SIZE) < 1e-6
    assert not any("by differences" in text for text in exact.warnings)
    named = obsynth.run_on_data(design, log.rename(columns={"slope": "derivative of u"}))
    assert np.array_equal(estimates(named), estimates(exact), equal_nan=True)


@pytest.mark.long
def test_streams_resumed_runs_and_other_names_and_units_are_the_same(design, log, tmp_path):
    whole = estimates(obsynth.run_on_data(design, log))
    path = tmp_path / "log.csv"
    log.to_csv(path, index=False, float_format="%.17g")
    out = io.StringIO()
    obsynth.run_on_data(design, io.StringIO(path.read_text()), out=out)
    out.seek(0)
    assert np.array_equal(pd.read_csv(out)["fhat[leak]"], whole, equal_nan=True)
    parts = []
    for name, rows in (("a", log.iloc[:700]), ("b", log.iloc[700:])):
        rows.to_csv(path, index=False, float_format="%.17g")
        obsynth.run_on_data(design, path, state=tmp_path / "state.json", out=tmp_path / f"{name}.csv")
        parts.append(pd.read_csv(tmp_path / f"{name}.csv")["fhat[leak]"])
    assert np.array_equal(np.concatenate(parts), whole, equal_nan=True)
    renamed = obsynth.run_on_data(design, log.rename(columns={"u": "drive"}), columns={"u": "drive"})
    assert np.array_equal(estimates(renamed), whole, equal_nan=True)
    scaled = obsynth.run_on_data(design, log.assign(u=1000.0 * log["u"]), scales={"u": 1e-3})
    assert np.allclose(estimates(scaled), whole, rtol=1e-9, atol=1e-12, equal_nan=True)


def test_a_blank_input_is_a_blank_derivative_in_its_row_and_the_next(design, log):
    log = log.copy()
    log.loc[100, "u"] = np.nan
    run = obsynth.run_on_data(design, log)
    assert run.statuses["gap"] == 2
    assert abs(estimates(run)[-1] - SIZE) < 0.02


def test_a_scenario_moves_the_derivative_with_its_input(design):
    scenario = obsynth.Scenario(
        horizon=20.0, sample_time=STEP, inputs={"u": obsynth.Sine(amplitude=1.0, frequency=0.1)}, noise=0.0
    )
    run = obsynth.simulate(design, scenario)
    assert np.allclose(run.inputs[1:, 1], np.diff(run.inputs[:, 0]) / STEP)
    given = {**scenario.inputs, "derivative of u": obsynth.Step(size=3.0)}
    assert np.all(obsynth.simulate(design, scenario.replace(inputs=given)).inputs[:, 1] == 3.0)


@pytest.mark.long
def test_c_and_fmu_take_it_as_an_input_by_its_name(design, tmp_path):
    obsynth.export(design, tmp_path / "filter.c", sample_time=STEP)
    assert "derivative of u" in (tmp_path / "filter.h").read_text()
    obsynth.export(design, tmp_path / "filter.fmu", sample_time=STEP)
    with zipfile.ZipFile(tmp_path / "filter.fmu") as archive:
        assert b'name="derivative of u"' in archive.read("modelDescription.xml")


@pytest.mark.parametrize("index", [2, 3, 4])
@pytest.mark.parametrize("scrambled", [False, True])
def test_the_proper_form_with_derivatives_has_the_transfer_functions_of_the_plant(index, scrambled):
    rng = np.random.default_rng(index)
    slow = np.array([[-1.0, 0.5, 0.0], [0.0, -2.0, 1.0], [0.25, 0.0, -1.5]])
    zero = np.zeros((3, index))
    e = np.block([[np.eye(3), zero], [zero.T, np.diag(np.ones(index - 1), 1)]])
    a = np.block([[slow, zero], [zero.T, np.eye(index)]])
    b = np.vstack([[[1.0], [0.0], [2.0]], np.zeros((index - 1, 1)), [[1.0]]])
    c = rng.integers(1, 4, (3, 3 + index)).astype(float)
    if scrambled:
        left, right = (np.linalg.qr(rng.normal(size=(3 + index, 3 + index)))[0] for _ in range(2))
        e, a, b, c = left @ e @ right, left @ a @ right, left @ b, c @ right
    source = obsynth.DescriptorSystem(e, a, B=b, C=c, dt=0.0)
    found = with_input_derivatives(source)
    assert found is not None
    step, names = found
    words = ("derivative of u1", "second derivative of u1", "third derivative of u1")
    assert names == words[: index - 1]
    for s in (0.7, 2.0j):
        powers = np.array([[s**k] for k in range(index)])
        wanted = np.linalg.solve(s * e - a, b)
        reduced = step.plant
        z = np.linalg.solve(s * reduced.E - reduced.A, reduced.B @ powers)
        assert np.allclose(reduced.C @ z + reduced.D @ powers, c @ wanted, rtol=1e-7, atol=1e-7)
        assert np.allclose(step.recovery.from_state @ z + step.recovery.from_input @ powers, wanted, atol=1e-7)


def test_derivatives_of_faults_and_of_a_high_order_are_no_inputs():
    e = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    more = {"B": [[1.0], [0.0], [0.0]], "C": [[1.0, 1.0, 0.0]], "dt": 0.0}
    a = np.diag([-1.0, 1.0, 1.0])
    assert with_input_derivatives(obsynth.DescriptorSystem(e, a, Bf=[[0.0], [0.0], [1.0]], **more)) is None
    assert with_input_derivatives(obsynth.DescriptorSystem(e, a, **{**more, "dt": 1.0})) is None


def test_differences_go_on_from_chunk_to_chunk():
    times, values = np.array([0.0, 1.0, 3.0, 4.0]), np.array([2.0, 3.0, 7.0, 1.0])
    first, before = difference_quotients(times, values, 1, None)
    assert first.tolist() == [0.0, 1.0, 2.0, -6.0]
    second, _ = difference_quotients(times, values, 2, None)
    assert second == pytest.approx([0.0, 1.0, 2.0 / 3.0, -16.0 / 3.0], abs=1e-15)
    for order, whole in ((1, first), (2, second)):
        before, parts = None, []
        for place in range(4):
            part, before = difference_quotients(times[place : place + 1], values[place : place + 1], order, before)
            parts.extend(part)
        assert parts == whole.tolist()


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_polynomial_of_the_order_is_exact_at_any_times(order: int):
    times = np.array([0.0, 1.0, 3.0, 4.0, 6.0, 7.0, 9.0])
    quotients, _ = difference_quotients(times, times**order, order, None)
    assert quotients[order:] == pytest.approx(np.full(7 - order, float(math.factorial(order))))


def test_rows_that_the_clock_leaves_out_are_no_samples_of_the_input(design, log):
    late = log.drop(columns="slope")
    late.loc[200, ["time", "u"]] = [2.0, 50.0]
    without = estimates(obsynth.run_on_data(design, late.drop(index=200)))
    assert estimates(obsynth.run_on_data(design, late))[-500:] == pytest.approx(without[-500:], abs=1e-9)


CAM = """
schema_version: 1
name: cam
plant:
  dt: 0
  state_names: [x, q, speed, force]
  input_names: [u]
  output_names: [y1, y2]
  E: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
  A: [[-1, 1, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 1, -1]]
  B: [[0], [0], [-1], [0]]
  C: [[1, 0, 0, 0], [1, 0, 0, 2]]
  Bf: [[1], [0], [0], [0]]
  fault_names: [leak]
  sensor_noise: {y1: 0.01, y2: 0.01}
method: {id: ui-pi-observer}
scenario:
  horizon: 60 s
  sample_time: 50 ms
  inputs: {u: {kind: sine, amplitude: 1, frequency: 0.05}}
  faults: {leak: {kind: step, size: 0.5, start: 30 s}}
"""


@pytest.mark.long
def test_a_spec_is_designed_simulated_and_run_by_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.yaml").write_text(CAM, encoding="utf-8")
    assert main(["design", "--system", "spec.yaml"]) == 0
    assert main(["simulate", "--system", "spec.yaml", "--gains", "cam.gains.json", "--out", "run.csv"]) == 0
    pd.read_csv("run.csv")[["time", "u", "y1", "y2"]].to_csv("log.csv", index=False)
    assert main(["run", "--gains", "cam.gains.json", "--data", "log.csv", "--out", "est.csv"]) == 0
    assert "derivative of u is formed from u by differences" in capsys.readouterr().err
    assert abs(pd.read_csv("est.csv")["fhat[leak]"].iloc[-1] - SIZE) < 0.02
    # A plant with other signals is still another plant.
    (tmp_path / "other.yaml").write_text(CAM.replace("[u]", "[drive]").replace("{u:", "{drive:"), encoding="utf-8")
    assert main(["simulate", "--system", "other.yaml", "--gains", "cam.gains.json", "--out", "o.csv"]) == 2
    assert "is for a plant with other signals" in capsys.readouterr().err
