"""Whether a log agrees with a design: wrong variances are named with their factor, and so is what else is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_calibrate import BOUNDS, LOG
from test_linearise import tanks

import obsynth
from obsynth import SpecError, dae_adaptive_observer, linearise, load_spec, validate, validity

CALIBRATED = {"a1": 0.0163, "a2": 0.0199, "b1": 0.0350, "b2": 0.0354}
HELD = {"u1": "u1_held", "u3": "u3_held"}
Q = {"tank1": 2.0e-5, "tank2": 1.2e-5, "tank3": 9.0e-7}
R = {"v1": 1.7e-5, "v2": 4.8e-6, "v3": 2.7e-5}


def designed(Q=Q, R=R, **constants):
    model = tanks()
    model = model.replace(constants={**model.constants, **CALIBRATED, **constants})
    return dae_adaptive_observer(
        model, dt=1.0, forgetting=0.95, Q=Q, R=R, initial_covariance=1e-4 * np.eye(3),
        initial_parameter_covariance=[[1e-4]],
    )  # fmt: skip


@pytest.fixture(scope="module")
def right():
    return designed()


@pytest.mark.long
def test_a_calibrated_design_agrees_with_its_log(right):
    found = validate(right, LOG, rows="0:56", columns=HELD)
    assert found.passed
    assert 0.8 < found.nis.value < 1.2
    assert not found.ratios
    assert "agrees" in str(found)
    figure = found.plot()
    assert len(figure.axes) == 7
    assert not any(panel.yaxis.label.get_parse_math() for panel in figure.axes)
    import matplotlib.pyplot as plt

    plt.close(figure)


@pytest.mark.long
def test_process_noise_a_hundred_times_too_large_is_named():
    found = validate(designed(Q={name: 100.0 * value for name, value in Q.items()}), LOG, rows="0:56", columns=HELD)
    assert not found.passed
    assert found.nis.value < 0.2
    assert set(found.ratios) == set(Q)
    assert all(1 / 200 < ratio < 1 / 50 for ratio in found.ratios.values())
    assert any("too large" in sentence for sentence in found.verdict)


@pytest.mark.long
def test_a_sensor_whose_noise_is_eight_times_too_small_is_named():
    found = validate(designed(R={**R, "v3": 2.7e-5 / 8}), LOG, rows="0:56", columns=HELD)
    assert not found.passed
    assert set(found.ratios) == {"v3"}
    assert 5.0 < found.ratios["v3"] < 12.0
    assert any("R of v3" in sentence and "too small" in sentence for sentence in found.verdict)


@pytest.mark.long
def test_a_leak_in_the_rows_is_found(right):
    found = validate(right, LOG, columns=HELD)
    assert not found.passed
    assert any("leak" in sentence for sentence in found.verdict)


@pytest.mark.long
def test_a_recursive_design_is_validated_too():
    linear = linearise(tanks(), at="point", given={"h1": 0.55, "h2": 0.47, "h3": 0.56}, drift=True)
    plant = obsynth.discretise(linear, 1.0).plant
    varying = obsynth.TimeVaryingDescriptorSystem.from_descriptor(plant)
    rng = np.random.default_rng(1)
    x, rows = np.zeros(3), []
    for _ in range(150):
        rows.append([0.47, 0.47, 1.0, *(x + 0.01 * rng.standard_normal(3))])
        x = plant.A @ x + plant.B @ (np.array(rows[-1][:3]) - [0.4737, 0.4737, 0.0]) + 0.003 * rng.standard_normal(3)
    columns = dict(zip((*plant.input_names, *plant.output_names), np.array(rows).T, strict=True))
    point = [plant.operating_point[name] for name in plant.output_names]
    log = {"time": np.arange(150.0), **columns}
    for name, value in zip(plant.output_names, point, strict=True):
        log[name] = log[name] + value
    for factor, holds in ((1.0, True), (25.0, False)):
        design = obsynth.adaptive_observer(
            varying, Q=9e-6 * np.eye(3), R=1e-4 / factor * np.eye(3), forgetting=0.98, initial_state=np.zeros(3),
            initial_covariance=1e-6 * np.eye(3), initial_parameters=[0.0], initial_parameter_covariance=[[1e-4]],
        )  # fmt: skip
        found = validate(design, log)
        assert found.nis.holds == holds
        assert set(found.sensors) == set(plant.output_names)


@pytest.mark.long
@pytest.mark.usefixtures("taken_as_verified")
def test_a_sensor_that_the_model_never_predicts_is_told_and_drawn() -> None:
    """An algebraic state that nothing tells before it is measured: the report of a shipped design ended in an error."""
    spec = load_spec(Path(__file__).parents[2] / "designs/moussaali2013_ltv/spec.yaml")
    design = obsynth.design(spec.plant, spec.method, **dict(spec.options))
    run = obsynth.simulate(design, spec.scenario.replace(horizon=60))
    columns = {"time": run.time, "u1": run.inputs[:, 0], "u2": run.inputs[:, 1], "y1": run.outputs[:, 0]}
    found = validate(design, pd.DataFrame(columns))
    assert not found.sensors["y1"].nis.samples
    assert "y1  not predicted in any row" in str(found)
    assert "nan" not in str(found)
    figure = found.plot()
    assert [text.get_text() for text in figure.axes[1].texts] == ["not predicted in any row"]
    import matplotlib.pyplot as plt

    plt.close(figure)


def test_bad_requests_are_refused(right):
    with pytest.raises(SpecError, match="at least"):
        validate(right, LOG, rows="0:10")
    with pytest.raises(SpecError, match="no column"):
        validate(right, pd.DataFrame({"time": [0.0, 1.0]}))


def test_validity_along_the_log_is_that_of_the_reference():
    """Reference, section 1: .75 deviations of 3 mV over rows 30 to 55, 14 over all rows before the leak."""
    deviations = dict.fromkeys(("v1", "v2", "v3"), 0.003)
    model = tanks()
    log = pd.read_csv(LOG)
    given = dict(zip(("h1", "h2", "h3"), log.loc[40, ["v1", "v2", "v3"]].to_numpy(dtype=float), strict=True))
    linear = linearise(model, at="point", given=given, drift=True)
    found = {}
    for first in (0, 30):
        start = log.loc[first, ["v1", "v2", "v3"]].to_numpy(dtype=float)
        found[first] = validity(model, linear, LOG, rows=f"{first}:56", initial_state=start, deviations=deviations)
    assert found[30].largest < 1.5
    assert found[0].largest > 5.0
    assert "deviations" in str(found[0])
    figure = found[0].plot()
    assert len(figure.axes) == 6
    assert not any(panel.yaxis.label.get_parse_math() for panel in figure.axes)
    import matplotlib.pyplot as plt

    plt.close(figure)
    with pytest.raises(SpecError, match="another plant"):
        validity(model, obsynth.discretise(linear, 1.0).plant, LOG)


def test_the_bounds_of_the_calibration_hold_what_the_design_uses():
    assert all(BOUNDS[name][0] < value < BOUNDS[name][1] for name, value in CALIBRATED.items())


def emptying_tank(samples: int, *, correlation: float = 0.0, c: float = 0.1, seed: int = 3) -> dict[str, np.ndarray]:
    """A log of a tank, backward Euler as the design takes it; sensor noise of deviation 0.01, first-order coloured."""
    rng = np.random.default_rng(seed)
    inflow = np.repeat(0.1 + 0.05 * rng.random(samples // 20 + 1), 20)[:samples]
    level, gauge, noise = 1.0, np.zeros(samples), 0.0
    for k in range(samples):
        if k:
            # level + c sqrt(level) = last + inflow: a quadratic in the root.
            held = level + inflow[k]
            level = ((-c + np.sqrt(c * c + 4.0 * held)) / 2.0) ** 2
        noise = correlation * noise + np.sqrt(1.0 - correlation**2) * 0.01 * rng.normal()
        gauge[k] = level + noise
    return {"time": np.arange(float(samples)), "inflow": inflow, "gauge": gauge}


@pytest.fixture(scope="module")
def tank_design():
    model = obsynth.DAEModel(
        {"balance": "der(level) = inflow - c * sqrt(level) * (1 - clog)"},
        {"gauge": "level"},
        states={"level": 1.0},
        inputs={"inflow": 0.1},
        parameters={"clog": 0.0},
        constants={"c": 0.1},
    )
    return dae_adaptive_observer(
        model, dt=1.0, Q={"balance": 1e-8}, R={"gauge": 1e-4}, initial_covariance=[[1e-4]],
        initial_parameter_covariance=[[1e-6]],
    )  # fmt: skip


def test_white_noise_of_the_stated_size_agrees(tank_design):
    assert validate(tank_design, emptying_tank(400)).passed


def test_missing_rows_are_predicted_as_a_run_does(tank_design):
    """The inflow changes while five rows are missing: nobody knows when, and both say what it may be off by."""
    log = pd.DataFrame(emptying_tank(100)).drop(index=range(58, 63))
    found = validate(tank_design, log)
    shown = obsynth.run_on_data(tank_design, log, outliers="none").table["r[gauge]"].to_numpy()
    whole = found.innovations[:, 0]
    assert np.isnan(whole[58:63]).all()
    np.testing.assert_allclose(np.delete(whole, range(58, 63))[1:], shown[1:], rtol=0.0, atol=1e-12)
    assert any(
        "5 rows are missing: their outputs count as not measured and the inputs" in line for line in found.verdict
    )


def test_coloured_noise_is_called_so_and_no_variance_is_blamed(tank_design):
    found = validate(tank_design, emptying_tank(400, correlation=0.9))
    assert not found.passed
    assert found.ratios == {}
    text = " ".join(found.verdict)
    assert "coloured noise or a model error" in text
    assert "noise of gauge that is correlated over about" in text
    assert "times too" not in text


def test_steps_are_judged_by_all_of_a_sensors_noise(tank_design):
    """What is white beside coloured noise is next to nothing: steps were told to err by 38 deviations of a sensor."""
    noise = {"gauge": {"deviation": 0.01, "correlation": 9.5}}
    model, found = obsynth.with_noise(tank_design.plant, sensor_noise=noise, dt=1.0)
    design = dae_adaptive_observer(
        model, dt=1.0, Q={"balance": 1e-8, **found["Q"]}, R={"gauge": 1e-12}, initial_covariance={"level": 1e-4},
        initial_parameter_covariance=[[1e-6]],
    )  # fmt: skip
    found = validate(design, emptying_tank(400, correlation=0.9))
    assert found.sensors["gauge"].whiteness.probability > 0.01
    assert not any("backward Euler" in sentence for sentence in found.verdict)


@pytest.mark.long
def test_a_wrong_constant_is_named_with_the_value_that_explains_the_log(tank_design):
    found = validate(tank_design, emptying_tank(400, c=0.13))
    assert not found.passed
    explained = next(sentence for sentence in found.verdict if "explains it best" in sentence or "constant" in sentence)
    assert "c" in explained


def walking_tank(walk: float, *, jump: float = 0.0, samples: int = 400, seed: int = 5) -> dict[str, np.ndarray]:
    """A log of the tank above whose valve clogs: by a random walk of this deviation in a sample, and at once."""
    rng = np.random.default_rng(seed)
    inflow = np.repeat(0.1 + 0.05 * rng.random(samples // 20 + 1), 20)[:samples]
    level, clog, gauge = 1.0, 0.0, np.zeros(samples)
    for k in range(samples):
        if k:
            clog += walk * rng.normal() + (jump if k == samples // 2 else 0.0)
            c, held = 0.1 * (1.0 - clog), level + inflow[k]
            level = ((-c + np.sqrt(c * c + 4.0 * held)) / 2.0) ** 2
        gauge[k] = level + 0.01 * rng.normal()
    return {"time": np.arange(float(samples)), "inflow": inflow, "gauge": gauge}


def walking_design(tank_design, walk: float, form: str = "augmented-kalman", R: float = 1e-4):
    return dae_adaptive_observer(
        tank_design.plant, dt=1.0, Q={"balance": 1e-8}, R={"gauge": R}, initial_covariance=[[1e-4]], form=form,
        initial_parameter_covariance=[[1e-6]], random_walk=[[walk**2]],
    )  # fmt: skip


@pytest.mark.one_in(4)
@pytest.mark.parametrize("form", ["augmented-kalman", "random-walk"])
@pytest.mark.parametrize("walk", [0.003, 0.3])
def test_a_walk_that_is_stated_large_is_no_disagreement(tank_design, form, walk):
    """A walk is what a fault may do: innovations of rows without one are smaller than with it, and not white."""
    found = validate(walking_design(tank_design, walk, form), walking_tank(0.0))
    assert found.passed, str(found)
    assert any("no random walk of clog" in sentence for sentence in found.verdict)
    # What is wrong beside the walk is still told, by its factor.
    wrong = validate(walking_design(tank_design, walk, form, R=1e-4 / 8.0), walking_tank(0.0))
    assert not wrong.passed
    assert 5.0 < wrong.ratios["gauge"] < 12.0


@pytest.mark.long
def test_a_parameter_that_walks_as_stated_agrees(tank_design):
    log = walking_tank(0.02)
    found = validate(walking_design(tank_design, 0.02), log)
    assert found.passed, str(found)
    assert found.ratios == {}
    assert not any("walk of clog" in sentence for sentence in found.verdict)
    # Sixteen times the variance that it has, and the sensor's variance an eighth of what it is.
    wide = validate(walking_design(tank_design, 0.08), log)
    assert wide.passed, str(wide)
    assert any("of the variance by which clog may walk" in sentence for sentence in wide.verdict)
    wrong = validate(walking_design(tank_design, 0.02, R=1e-4 / 8.0), log)
    assert not wrong.passed
    assert 5.0 < wrong.ratios["gauge"] < 12.0


@pytest.mark.long
def test_a_fault_that_is_further_off_than_it_may_walk_is_told(tank_design):
    found = validate(walking_design(tank_design, 1e-3), walking_tank(0.0, jump=0.5))
    assert not found.passed
    assert any("clog ends" in sentence and "not free of faults" in sentence for sentence in found.verdict)
    # Where it may walk so far nobody can say more than that it did.
    near = validate(walking_design(tank_design, 0.1), walking_tank(0.0, jump=0.5))
    assert any("no further than it may walk" in sentence for sentence in near.verdict)


@pytest.mark.long
def test_the_walk_of_a_recursive_design_is_judged_like_that_too():
    rng, x, rows = np.random.default_rng(4), 0.0, []
    for _ in range(300):
        rows.append([1.0, x + 0.01 * rng.standard_normal()])
        x = 0.9 * x + 0.1 + 0.001 * rng.standard_normal()
    u, y = np.array(rows).T
    plant = obsynth.TimeVaryingDescriptorSystem(
        [[1.0]], [[0.9]], [[0.1]], [[1.0]], Phi=[[1.0]], dt=1.0, input_names=["u"], output_names=["y"],
        parameter_names=["f"],
    )  # fmt: skip
    for walk in (1e-10, 1e-2):
        design = obsynth.adaptive_observer(
            plant, Q=[[1e-6]], R=[[1e-4]], form="random-walk", random_walk=[[walk]], initial_state=[0.0],
            initial_covariance=[[1e-4]], initial_parameters=[0.0], initial_parameter_covariance=[[1e-4]],
        )  # fmt: skip
        assert validate(design, {"time": np.arange(300.0), "u": u, "y": y}).passed


def test_outliers_that_a_gate_leaves_out_blame_no_variance(tank_design):
    log = emptying_tank(400)
    log["gauge"][[60, 150, 333]] += [1.0, -1.0, 1.0]
    gated = dae_adaptive_observer(
        tank_design.plant, dt=1.0, Q={"balance": 1e-8}, R={"gauge": 1e-4}, initial_covariance=[[1e-4]], outliers="gate",
        initial_parameter_covariance=[[1e-6]],
    )  # fmt: skip
    found = validate(gated, log)
    assert found.passed, str(found)
    assert found.ratios == {}


@pytest.mark.long
def test_no_run_is_made_twice(tank_design, monkeypatch):
    from obsynth.monitoring.calibration import validating, walk_shares

    runs, run = [], validating.recorded_innovations

    def counted(design, log):
        runs.append((design.observer.random_walk.tobytes(), tuple(design.plant.constants.values())))
        return run(design, log)

    monkeypatch.setattr(validating, "recorded_innovations", counted)
    validate(walking_design(tank_design, 0.02), walking_tank(0.0))
    assert len(runs) == len(set(runs)) == len(walk_shares.VARIANCE_SHARES)


@pytest.mark.long
@pytest.mark.parametrize("wrong", ["Q", "R"])
def test_a_wrong_variance_is_told_by_its_letter_where_an_equation_and_a_sensor_share_a_name(wrong):
    model = obsynth.DAEModel(
        {"x": "der(x) = (1 - loss) * u - x"}, {"x": "x"}, states={"x": 0.0}, inputs={"u": 0.0}, parameters={"loss": 0.0}
    )
    true = {"Q": 1.0, "R": 1e-2}
    stated = {**true, wrong: true[wrong] / 20}
    design = dae_adaptive_observer(
        model, dt=0.1, Q={"x": stated["Q"]}, R={"x": stated["R"]}, random_walk=[[0.0]],
        initial_parameter_covariance=[[1e-4]],
    )  # fmt: skip
    rng, x, rows = np.random.default_rng(3), 0.0, []
    for k in range(1_500):
        u = np.sign(np.sin(0.05 * k))
        x = (x + 0.1 * (u + np.sqrt(true["Q"]) * rng.standard_normal())) / 1.1 if k else x
        rows.append([0.1 * k, u, x + np.sqrt(true["R"]) * rng.standard_normal()])
    found = validate(design, pd.DataFrame(rows, columns=["time", "u", "x"]))
    assert set(found.ratios) == {f"{wrong} of x"}
    assert any(line.startswith(f"{wrong} of x is ") and "too small" in line for line in found.verdict)
