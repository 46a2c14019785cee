"""Logs as people have them: starts that nobody stated, wrong samples, other units, steps that are too long."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy.linalg

from obsynth import (
    DAEModel,
    PreconditionError,
    SpecError,
    TimeVaryingDescriptorSystem,
    calibrate,
    dae_adaptive_observer,
    simulate_dae,
    validate,
)
from obsynth.monitoring.calibration.integration_error import integration_error

TRUE = {"C": 1e-3, "Rs": 100.0}
WIDE = {"C": (1e-4, 1e-2), "Rs": (10.0, 1000.0)}


def circuit() -> DAEModel:
    return DAEModel(
        {"node": "C * der(v) = i", "ohm": "src - v - Rs * i = 0"}, {"vm": "v", "im": "i"}, states={"v": 0.5, "i": 0.01},
        inputs={"src": 1.0}, constants=TRUE,
    )  # fmt: skip


def circuit_log(samples: int = 160, **changes) -> dict[str, np.ndarray]:
    """A source that switches; the capacitor begins at 1 V, where the model's nominal state is 0.5 V."""
    u = 1.0 + 0.5 * np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], samples // 20), 20)[:, None]
    y = np.array(simulate_dae(circuit(), u, dt=0.01, R=np.diag([1e-4, 1e-8]), seed=1, initial_state=[1.0, 0.0]).outputs)
    log = {"time": 0.01 * np.arange(samples), "src": u[:, 0], "vm": y[:, 0], "im": y[:, 1]}
    return {**log, **{name: change(log[name].copy()) for name, change in changes.items()}}


@cache
def plain():
    return calibrate(circuit(), circuit_log(), WIDE, starts=1)


def said(found, text: str) -> bool:
    return any(text in sentence for sentence in found.verdict)


@pytest.mark.long
def test_a_log_that_begins_elsewhere_is_no_fault() -> None:
    found = plain()
    assert found.box.holds(TRUE)
    assert found.nis.holds
    assert found.fault_free
    assert said(found, "does not begin at the nominal state (v 0.9")


@pytest.mark.long
def test_a_start_that_only_the_first_innovations_show() -> None:
    model = DAEModel(
        {"kin": "der(x) = v", "dyn": "M * der(v) = F - k * x - c * v"}, {"pos": "x"}, states={"x": 0.1, "v": 0.5},
        inputs={"F": 0.0}, constants={"M": 2.0, "k": 50.0, "c": 1.5},
    )  # fmt: skip
    F = 5.0 * np.repeat(np.random.default_rng(3).choice([-1.0, 1.0], 34), 12)[:400, None]
    y = np.array(simulate_dae(model, F, dt=0.2, R=1e-4 * np.eye(1), seed=2, initial_state=[0.0, 0.0]).outputs)[:, 0]
    log = {"time": 0.2 * np.arange(400), "F": F[:, 0], "pos": y}
    found = calibrate(model, log, {"M": (0.5, 5.0), "k": (10.0, 200.0), "c": (0.1, 10.0)}, starts=1, input_delay=0)
    assert found.box.holds({"M": 2.0, "k": 50.0, "c": 1.5})
    assert found.fault_free
    assert found.nis.holds
    assert said(found, "does not begin at the nominal state")


@pytest.mark.long
def test_single_samples_that_are_no_measurements_are_told_and_left_out() -> None:
    def wrong(column):
        column[77] += 1e6
        column[[140, 141]] = -4e4
        return column

    found = calibrate(circuit(), circuit_log(vm=wrong), WIDE, starts=1, input_delay=0)
    assert found.box.holds(TRUE)
    assert found.nis.holds
    assert said(found, "3 values of vm far from all others, counted as not measured (row 77: 1e+06, row 140")
    assert np.isnan(found.innovations[77, 0])
    assert found.R["vm"] == pytest.approx(plain().R["vm"], rel=0.1)


@pytest.mark.long
def test_a_sample_that_stands_out_is_named() -> None:
    def wrong(column):
        column[77] += 0.3
        return column

    found = calibrate(circuit(), circuit_log(vm=wrong), WIDE, starts=1, input_delay=0)
    assert said(found, "Samples of vm stand out by more than 6 deviations (row 77)")
    # The gate stands between the samples that are none and this one: in the middle, where it is the only one.
    assert list(found.outlier_sizes) == ["vm"]
    usual = 6.0 * float(np.median(found.deviations, axis=0)[found.output_names.index("vm")])
    assert found.outlier_sizes["vm"] == pytest.approx((usual * 0.3) ** 0.5, rel=0.05)


@pytest.mark.long
def test_a_sensor_of_another_sign_and_one_with_a_bias_are_named(share) -> None:
    # Offsets and delays are looked for with --whole, which takes twice as long.
    for samples, options in share(((200, {"offset": {}, "input_delay": 0}), (240, {})), 2):
        log = circuit_log(samples, vm=lambda column: -column)
        turned = calibrate(circuit(), log, WIDE, starts=1, **options)
        assert said(turned, "The best simulation explains almost nothing of vm")
    bias, short = (circuit_log(samples, vm=lambda column: column + 0.3) for samples in (300, 100))
    biased = calibrate(circuit(), bias, WIDE, starts=1, offset={}, input_delay=0)
    assert said(biased, "The innovations of vm have the mean +1.00 deviations: a bias")
    taken = calibrate(circuit(), short, WIDE, starts=1, input_delay=0)
    assert said(taken, "The sensor vm has an offset")
    assert tuple(taken.offset) == ("vm",)
    assert taken.box.holds(TRUE)
    assert not said(biased, "of im have the mean")


@pytest.mark.long
def test_short_errors_of_steps_that_add_up_take_radau() -> None:
    """A sixth of a deviation in a step moves a constant by five of its own: the true volume is outside of that box."""
    model = DAEModel(
        {"mass": "V * der(c) = q * (cin - c) - V * k0 * exp(-E / T) * c",
         "heat": "rho * cp * V * der(T) = rho * cp * q * (Tin - T) + H * V * k0 * exp(-E / T) * c"}, {"Ts": "T"},
        states={"c": 800.0, "T": 330.0}, inputs={"q": 1e-3, "Tin": 320.0},
        constants={"V": 0.1, "k0": 7e7, "E": 8000.0, "rho": 1000.0, "cp": 4186.0, "H": 5e4, "cin": 1000.0},
    )  # fmt: skip
    flow, warm = (np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], 13), hold)[:250]
                  for seed, hold in ((1, 25), (2, 20)))  # fmt: skip
    u = np.column_stack([1e-3 * (1.0 + 0.3 * flow), 320.0 + 4.0 * warm])
    y = np.array(simulate_dae(model, u, dt=5.0, R=0.01 * np.eye(1), seed=5).outputs)[:, 0]
    log = {"time": 5.0 * np.arange(250), "q": u[:, 0], "Tin": u[:, 1], "Ts": y}
    unknown = {"V": (0.05, 0.3), "H": (1e4, 2e5)}
    found = calibrate(model, log, unknown, starts=1, input_delay=0)
    assert found.integration == "radau"
    assert said(found, "of its own: Radau is used")
    assert found.box.holds({"V": 0.1, "H": 5e4})
    euler = calibrate(model, log, unknown, starts=1, integration="backward-euler", input_delay=0)
    assert not euler.box.holds({"V": 0.1, "H": 5e4})


def test_rows_that_are_asked_for_are_named() -> None:
    with pytest.raises(SpecError, match=r"rows 400:500 holds nothing: the log has 160 rows"):
        calibrate(circuit(), circuit_log(), WIDE, rows="400:500")


def test_steps_are_compared_where_held_inputs_change() -> None:
    """Changes before rows 20, 40, ... of 400: of 100 rows that are evenly spread none is there."""
    model = DAEModel({"lag": "der(x) = u - x"}, {"y": "x"}, states={"x": 0.0}, inputs={"u": 0.0})
    u = np.repeat(np.random.default_rng(4).uniform(-1.0, 1.0, 20), 20)[:, None]
    x = np.zeros_like(u)
    for k in range(1, len(x)):
        x[k] = u[k] + np.exp(-1.0) * (x[k - 1] - u[k])
    found = integration_error(model, x, u, np.zeros(0), np.ones(1), 1.0)
    away = np.abs(u[1:] - x[:-1])[:, 0]
    # A step of backward Euler goes half the way, the plant 1 - 1 / e of it; Radau's own error is 1e-4 of it.
    np.testing.assert_allclose(found.largest, (0.5 - np.exp(-1.0)) * away.max(), rtol=2e-3)
    assert found.row == 1 + away.argmax()


@pytest.mark.long
def test_a_log_with_a_wrong_sample_is_compared_without_it_and_steps_that_are_too_long_are_told() -> None:
    design = dae_adaptive_observer(
        circuit().replace(constants={"C": 1e-3}, parameters={"Rs": 100.0}), dt=0.01, Q={"node": 1e-12, "ohm": 1e-12},
        R={"vm": 1e-4, "im": 1e-8}, initial_state={"v": 1.0}, initial_covariance={"v": 0.01, "i": 1e-4},
        initial_parameter_covariance={"Rs": 1.0}, integration="backward-euler",
    )  # fmt: skip

    def wrong(column):
        column[77] += 1e6
        return column

    found = validate(design, circuit_log(300, vm=wrong))
    assert said(found, "1 value of vm far from all others")
    assert said(found, "A step of backward Euler has an error of up to 0.4")
    exact = validate(replace(design, observer=replace(design.observer, integration="radau")), circuit_log(300))
    assert exact.nis.holds
    assert not said(exact, "backward Euler")


@pytest.mark.long
def test_another_unit_of_one_sensor_of_a_linear_plant_is_refused() -> None:
    plant = TimeVaryingDescriptorSystem(
        E=[[1, 0], [0, 0]], A=[["p", "0.1"], ["c", -1]], B=[["b"], [0]], C=[[1, 0], [0, 1]], Phi=[[0], [0]], dt=1.0,
        constants={"p": 0.9, "c": 0.5, "b": 1.0},
    )  # fmt: skip
    rng = np.random.default_rng(0)
    u, x, rows = np.repeat(rng.choice([-1.0, 1.0], 15), 10), 0.0, []
    for k in range(150):
        x = 0.95 * x + u[k - 1] + 0.05 * rng.standard_normal() if k else x
        rows.append([x, 0.5 * x] + 0.02 * rng.standard_normal(2))
    y = np.array(rows)
    log = {"time": np.arange(150.0), "u1": u, "y1": y[:, 0], "y2": y[:, 1]}
    unknown = {"p": (0.1, 1.2), "c": (0.0, 2.0), "b": (0.1, 3.0)}
    assert calibrate(plant, log, unknown, starts=1, input_delay=0).box.holds({"p": 0.9, "c": 0.5, "b": 1.0})
    with pytest.raises(PreconditionError, match=r"y1: .* times that of the model") as caught:
        calibrate(plant, {**log, "y1": 1000.0 * y[:, 0]}, unknown, starts=1)
    assert caught.value.code == "explains-nothing"


@pytest.mark.parametrize("unknown", [["C"], {"C": ["a", "b"]}, {"C": [1e-4, float("nan")]}, {"C": 1e-3}, {"C": [1, 0]}])
def test_bounds_that_are_none_are_refused(unknown) -> None:
    with pytest.raises(SpecError, match="unknown"):
        calibrate(circuit(), circuit_log(), unknown)


@pytest.mark.long
@pytest.mark.parametrize("late", [0, 1])
def test_the_record_of_another_simulator_has_its_own_start_and_no_delay_that_it_lacks(late: int) -> None:
    from scipy.integrate import solve_ivp

    true, n = {"A": 2.2, "c": 0.55}, 80
    rng = np.random.default_rng(0)
    q, h = 0.5 + 0.2 * np.repeat(rng.uniform(-1.0, 1.0, n // 8), 8), np.zeros(n)
    h[0] = 1.6
    for k in range(1, n):
        flow = q[k - late]
        h[k] = solve_ivp(
            lambda _, x, flow=flow: (flow - true["c"] * np.sqrt(x)) / true["A"], (0.0, 1.0), [h[k - 1]], rtol=1e-9,
            atol=1e-10,
        ).y[0, -1]  # fmt: skip
    tank = DAEModel(
        {"balance": "A * der(h) = q - c * sqrt(h)"}, {"seen": "h"}, states={"h": 1.0}, inputs={"q": 0.5},
        constants={"A": 2.0, "c": 0.5},
    )  # fmt: skip
    log = {"time": np.arange(float(n)), "q": q, "seen": h + 1e-4 * rng.standard_normal(n)}
    found = calibrate(tank, log, {"A": (1.0, 4.0), "c": (0.3, 0.8)}, starts=1)
    assert found.input_delay == late
    assert found.box.holds(true)


@pytest.mark.long
def test_coloured_noise_that_process_noise_stands_for_is_found() -> None:
    """Two vessels: process noise made the innovations of both gauges white, 43 nats below a state for the noise."""
    rng, dt, rows, kept = np.random.default_rng(0), 0.5, 300, 0.9
    inflow = np.repeat(rng.uniform(0.2, 1.0, rows // 25), 25)
    load = np.repeat(rng.uniform(0.5, 1.2, rows // 60), 60)
    x, e, found = np.array([2.0, 1.0]), 0.0, []
    for k in range(rows):
        for _ in range(10 if k else 0):
            flow = 0.6 * np.sqrt(x[0] - x[1])
            x = x + dt / 10 * np.array([inflow[k] - flow, (flow - 0.5 * load[k] * np.sqrt(x[1])) / 2])
        e = kept * e + np.sqrt(1 - kept**2) * rng.standard_normal()
        found.append([x[0] + 0.03 * e, x[1] + 0.01 * rng.standard_normal()])
    model = DAEModel(
        {"first": "der(h1) = inflow - c * sqrt(h1 - h2)",
         "second": "2 * der(h2) = c * sqrt(h1 - h2) - d * load * sqrt(h2)"},
        {"upper": "h1", "lower": "h2"}, states={"h1": 2.0, "h2": 1.0}, inputs={"inflow": 0.6, "load": 1.0},
        constants={"c": 0.55, "d": 0.55},
    )  # fmt: skip
    upper, lower = np.array(found).T
    log = {"time": dt * np.arange(rows), "inflow": inflow, "load": load, "upper": upper, "lower": lower}
    fit = calibrate(model, log, {"c": (0.4, 0.9), "d": (0.3, 0.7)}, starts=1, input_delay=0, offset={})
    assert list(fit.sensor_noise) == ["upper"]
    assert 2.0 < fit.sensor_noise["upper"]["correlation"] < 10.0  # AR(.9) of 0.5 s: 4.75 s
    assert fit.R["lower"] == pytest.approx(1e-4, rel=0.25)


@pytest.mark.long
def test_coloured_noise_with_outliers_is_found_beside_a_load_that_walks() -> None:
    """A motor whose load nobody measures: the search ended at a correlation as long as the log, 26 nats below the best,
    and a single wrong sample made the white noise of its sensor larger than the coloured one."""
    rng, dt, rows, kept = np.random.default_rng(1), 0.05, 500, 0.9
    R, L, K, J, b = 0.824, 0.02, 0.1236, 0.00388, 0.003
    voltage = np.repeat(rng.uniform(4.0, 12.0, rows // 20), 20)
    x, load, e, found = np.array([2.0, 40.0]), 0.05, 0.0, []
    A = np.array([[-R / L, -K / L, 1.0 / L, 0.0], [K / J, -b / J, 0.0, -1.0 / J], [0.0] * 4, [0.0] * 4])
    step = scipy.linalg.expm(dt * A)
    for k in range(rows):
        load += 0.002 * rng.standard_normal()
        x = (step @ [*x, voltage[k], load])[:2] if k else x
        e = kept * e + np.sqrt(1.0 - kept**2) * rng.standard_normal()
        found.append([dt * k, voltage[k], x[0] + 0.03 * rng.standard_normal(), x[1] + 0.5 * e])
    time, voltage, current, speed = np.array(found).T
    speed[[100, 340]] += [15.0, -15.0]
    model = DAEModel(
        {"coil": "L * der(i) = voltage - R * i - K * w", "rotor": "J * der(w) = K * i - b * w - load"},
        {"current": "i", "speed": "w"}, states={"i": 2.0, "w": 40.0}, inputs={"voltage": 8.0, "load": 0.05},
        constants={"R": 0.8, "L": L, "K": 0.12, "J": 0.004, "b": b},
    )  # fmt: skip
    log = {"time": time, "voltage": voltage, "current": current, "speed": speed}
    calibrated = calibrate(
        model, log, {"R": (0.4, 1.6), "K": (0.06, 0.24), "J": (0.002, 0.008)}, noisy=["coil"], starts=1, input_delay=0,
        sensor_noise={"speed": {"correlation": "unknown"}}, walks=["load"], offset={},
    )  # fmt: skip
    assert calibrated.nominal == pytest.approx({"R": R, "K": K, "J": J}, rel=0.03)
    assert said(calibrated, "Samples of speed stand out by more than 6 deviations (row 100, 340)")
    # AR(.9) of 50 ms: 0.475 s; a correlation is known to a factor of two or so.
    assert 0.2 < calibrated.sensor_noise["speed"]["correlation"] < 1.2
    assert calibrated.R["speed"] < 0.1**2
