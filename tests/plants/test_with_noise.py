"""Coloured noise, offsets and walking loads as states of a plant: numbers, names, ways back, refusals, calibration."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth import (
    DAEModel,
    DescriptorSystem,
    PreconditionError,
    SpecError,
    calibrate,
    descriptor_kalman,
    discretise,
    uncertain_system,
    with_noise,
)

NOISE = {"y1": {"deviation": 0.1, "correlation": "5 s"}, "y2": 0.05}


def plant(**changes) -> DescriptorSystem:
    arguments = {
        "A": [[-1.0, 0.2], [0.0, -0.5]], "B": [[0.0], [1.0]], "C": [[1.0, 0.0], [0.0, 1.0]], "Bd": [[1.0], [0.0]],
        "Df": [[1.0], [0.0]], "Bf": [[0.0], [0.0]], "Bw": 0.01 * np.eye(2), "output_names": ["y1", "y2"],
        "disturbance_names": ["load"], "fault_names": ["bias"], "units": {"y1": "K"},
    }  # fmt: skip
    return DescriptorSystem(None, **{**arguments, **changes})


def test_states_have_the_stated_numbers_names_and_units():
    made, options = with_noise(plant(), sensor_noise=NOISE, offset={"y2": 0.3}, walks={"load": 0.2})
    new = made.plant
    assert new.state_names == ("x1", "x2", "noise_y1", "offset_y2", "load")
    assert new.nd == 0
    assert new.A[2, 2] == -0.2
    assert new.A[0, 4] == 1.0
    assert new.C[:, 2:4].tolist() == [[1.0, 0.0], [0.0, 1.0]]
    covariance = new.Bw @ new.Bw.T
    # White noise through the first-order lag has the stated variance: 2 var / tau drives it.
    assert covariance[2, 2] == pytest.approx(2.0 * 0.01 / 5.0)
    assert covariance[4, 4] == pytest.approx(0.04)
    assert new.units["noise_y1"] == "K"
    assert options["initial_covariance"][3, 3] == pytest.approx(0.09)
    assert made.recovery.names == ("x1", "x2")
    np.testing.assert_array_equal(made.recovery.from_state, np.eye(2, 5))


def test_a_sampled_plant_keeps_the_variance_of_its_coloured_noise():
    made, _ = with_noise(plant(), sensor_noise=NOISE)
    sampled = discretise(made, 0.5)
    A, W = sampled.plant.A, sampled.plant.Bw @ sampled.plant.Bw.T
    assert A[2, 2] == pytest.approx(np.exp(-0.1))
    assert W[2, 2] / (1.0 - A[2, 2] ** 2) == pytest.approx(0.01)
    direct, _ = with_noise(plant(dt=0.5), sensor_noise=NOISE)
    assert direct.plant.A[2, 2] == pytest.approx(np.exp(-0.1))
    assert (direct.plant.Bw @ direct.plant.Bw.T)[2, 2] == pytest.approx(0.01 * (1.0 - np.exp(-0.2)))
    assert sampled.recovery.names == ("x1", "x2")


def test_an_offset_that_cannot_be_told_from_a_load_is_named():
    made, _ = with_noise(plant(C=[[1.0, 0.0], [0.0, 1.0]]), offset=["y1"], walks={"load": 0.1})
    with pytest.raises(PreconditionError) as caught:
        descriptor_kalman(discretise(made, 0.5).plant)
    assert "offset_y1" in str(caught.value)
    assert "load" in str(caught.value)


def test_a_nonlinear_plant_gets_equations_and_options():
    model = DAEModel(
        {"balance": "2 * der(level) = inflow - drawn - 0.5 * sqrt(level)"}, {"seen": "level"}, states={"level": 1.0},
        inputs={"inflow": 0.5, "drawn": 0.1}, units={"level": "m", "seen": "m", "inflow": "m3/s", "drawn": "m3/s"},
    )  # fmt: skip
    made, options = with_noise(
        model, sensor_noise={"seen": {"deviation": 0.1, "correlation": 5.0}}, offset=["seen"], walks={"drawn": 0.3},
        dt=0.5,
    )  # fmt: skip
    assert made.state_names == ("level", "noise_seen", "offset_seen", "drawn")
    assert made.input_names == ("inflow",)
    assert made.outputs["seen"] == "((level) + noise_seen) + offset_seen"
    assert made.units["noise_seen"] == "m"
    # A step of backward Euler keeps 1 / (1 + dt / tau); what it adds makes the stated variance.
    kept = 1.0 / 1.1
    assert (0.5 * kept) ** 2 * options["Q"]["noise_seen"] / (1.0 - kept**2) == pytest.approx(0.01)
    assert options["Q"]["drawn"] * 0.5 == pytest.approx(0.09)
    assert options["R"] == {"seen": pytest.approx(1e-6)}


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"sensor_noise": {"y9": 0.1}}, "y9"),
        ({"sensor_noise": {"y1": {"deviation": "unknown", "correlation": 5.0}}}, "calibrate --write-spec"),
        ({"sensor_noise": {"y1": {"deviation": 0.1, "correlation": "5 weeks"}}}, "correlation"),
        ({"sensor_noise": {"y1": {"correlation": 5.0}}}, "needs a deviation"),
        ({"offset": {"y1": -1.0}}, "offset.y1"),
        ({"walks": {"nothing": 1.0}}, "nothing"),
    ],
)
def test_what_is_malformed_is_refused_with_its_place(arguments, told):
    with pytest.raises(SpecError, match=told):
        with_noise(plant(), **arguments)


def test_constants_keep_their_places():
    uncertain = uncertain_system(
        {"A": [["a"]], "B": [[1]], "C": [[1]], "Bd": [["g"]], "output_names": ["y"], "disturbance_names": ["d"]},
        {"a": {"nominal": -1.0, "tolerance": "10 %"}, "g": {"nominal": 2.0, "tolerance": "10 %"}},
    )
    made, _ = with_noise(uncertain, walks={"d": 0.1})
    assert dict(made.plant.uncertainty.entries)["A"] == ((0, 0, "a"), (0, 1, "g"))
    assert made.plant.A.tolist() == [[-1.0, 2.0], [0.0, 0.0]]


def fast_and_slow() -> DescriptorSystem:
    return uncertain_system(
        {"A": [["a", 0], [0, 1]], "B": [["b"], [0]], "C": [[1, 0], [0, 1]], "dt": 1.0, "input_names": ["u"],
         "output_names": ["y1", "y2"]},
        {"a": {"nominal": 0.8, "tolerance": "50 %"}, "b": {"nominal": 0.1, "tolerance": "90 %"}},
    )  # fmt: skip


@pytest.mark.long
def test_a_random_walk_that_a_sensor_sees_is_calibrated_and_no_sign_is_blamed():
    rng, n = np.random.default_rng(0), 200
    u, x, y = np.repeat(rng.uniform(-1.0, 1.0, n // 10), 10), np.zeros(2), np.zeros((n, 2))
    for k in range(n):
        if k:
            x = np.array([0.9 * x[0] + 0.2 * u[k - 1], x[1] + 0.05 * rng.standard_normal()])
        y[k] = x + 0.02 * rng.standard_normal(2)
    log = {"time": np.arange(float(n)), "u": u, "y1": y[:, 0], "y2": y[:, 1]}
    found = calibrate(fast_and_slow(), log, {"a": (0.5, 0.99), "b": (0.01, 1.0)}, input_delay=0, starts=1)
    assert found.box.holds({"a": 0.9, "b": 0.2})
    assert found.Q["x2"] == pytest.approx(0.0025, rel=0.5)
    assert not any("sign" in sentence for sentence in found.verdict)


@pytest.mark.long
def test_a_plant_that_an_unknown_input_drives_is_calibrated_with_a_walk():
    rng, n = np.random.default_rng(1), 200
    u, x, d, y = np.repeat(rng.uniform(-1.0, 1.0, n // 10), 10), 0.0, 0.0, np.zeros(n)
    for k in range(n):
        if k:
            x, d = 0.9 * x + 0.2 * u[k - 1] + 0.3 * d, d + 0.1 * rng.standard_normal()
        y[k] = x + 0.02 * rng.standard_normal()
    driven = uncertain_system(
        {"A": [["a"]], "B": [["b"]], "C": [[1]], "Bd": [[0.3]], "dt": 1.0, "input_names": ["u"],
         "output_names": ["y"], "disturbance_names": ["load"]},
        {"a": {"nominal": 0.8, "tolerance": "50 %"}, "b": {"nominal": 0.1, "tolerance": "90 %"}},
    )  # fmt: skip
    log = {"time": np.arange(float(n)), "u": u, "y": y}
    found = calibrate(driven, log, {"a": (0.5, 0.99), "b": (0.01, 1.0)}, input_delay=0, starts=1)
    assert found.box.holds({"a": 0.9, "b": 0.2})
    assert found.walks["load"] == pytest.approx(0.1, rel=0.5)
    assert any("taken as a random walk" in sentence for sentence in found.verdict)


def coloured(seed: int, offset: float) -> dict[str, np.ndarray]:
    rng, n = np.random.default_rng(seed), 240
    u, x, e, y = np.repeat(rng.uniform(-1.0, 1.0, n // 12), 12), 0.0, rng.standard_normal(), np.zeros(n)
    for k in range(n):
        if k:
            x, e = 0.95 * x + 0.1 * u[k - 1], 0.9 * e + np.sqrt(0.19) * rng.standard_normal()
        y[k] = x + 0.1 * e + offset
    return {"time": np.arange(float(n)), "u": u, "y": y}


def test_coloured_noise_and_an_offset_that_are_stated_are_found_with_their_numbers():
    lag = uncertain_system(
        {"A": [["a"]], "B": [["b"]], "C": [[1]], "dt": 1.0, "input_names": ["u"], "output_names": ["y"]},
        {"a": {"nominal": 0.9, "tolerance": "20 %"}, "b": {"nominal": 0.1, "tolerance": "90 %"}},
    )
    found = calibrate(
        lag, coloured(0, 0.5), {"a": (0.5, 0.999), "b": (0.01, 1.0)}, noisy=[], input_delay=0, starts=1,
        sensor_noise={"y": {"correlation": "unknown"}}, offset={"y": "unknown"},
    )  # fmt: skip
    assert found.box.holds({"a": 0.95, "b": 0.1})
    assert found.box.stands
    assert set(found.names) == {"a", "b"}
    noise = found.sensor_noise["y"]
    assert noise["deviation"] == pytest.approx(0.1, rel=0.4)
    assert noise["correlation"] == pytest.approx(9.5, rel=0.7)
    assert tuple(found.offset) == ("y",)


def test_the_noise_that_a_spec_states_reaches_its_design(tmp_path):
    from obsynth import design, load_spec

    path = tmp_path / "lag.yaml"
    path.write_text(
        """
schema_version: 1
name: lag
plant:
  dt: 0.0
  A: [[-0.5]]
  B: [[1.0]]
  C: [[1.0]]
  Bd: [[1.0]]
  Bw: [[0.01]]
  output_names: [y]
  disturbance_names: [load]
  sensor_noise: {y: {deviation: 0.1, correlation: 200 ms}}
  walks: {load: 0.2}
  transform: {sample_time: 0.1}
method: {id: descriptor-kalman}
""",
        encoding="utf-8",
    )
    spec = load_spec(path)
    assert spec.plant.state_names == ("x1", "noise_y", "load")
    assert spec.transformation.source.state_names == ("x1",)
    assert spec.plant.A[1, 1] == pytest.approx(np.exp(-0.5))
    made = design(spec.transformation, spec.method, **spec.options)
    assert made.report.passed
    assert made.observer.state_names == spec.plant.state_names
    # The state is not believed to a coloured sensor's own deviation alone: the filter says what it knows of each.
    found = made.observer.run(np.zeros((400, 1)), np.zeros((400, 1)))
    assert found.state_deviations[-1, 0] < 0.1
    assert found.state_deviations[-1, 2] < 1.0


def test_unknown_numbers_of_a_spec_are_for_calibrate(tmp_path):
    from obsynth import load_spec

    path = tmp_path / "lag.yaml"
    path.write_text(
        "schema_version: 1\nname: lag\nplant:\n  dt: 1.0\n  A: [[0.5]]\n  C: [[1.0]]\n  output_names: [y]\n"
        "  offset: {y: unknown}\n  sensor_noise: {y: {deviation: unknown, correlation: unknown}}\n",
        encoding="utf-8",
    )
    with pytest.raises(SpecError, match="calibrate --write-spec") as caught:
        load_spec(path)
    assert caught.value.path == "plant.sensor_noise.y.deviation"
