"""Linear models of nonlinear plants: exact Jacobians, and the reason where there is no equilibrium."""

from __future__ import annotations

import json
import re
from functools import cache

import numpy as np
import pytest
from dae_plants import DESIGNS, ROD, diode, exchanger, pendulum
from ruamel.yaml import YAML

import obsynth
from obsynth import (
    DAEModel,
    PreconditionError,
    SpecError,
    functional_filter,
    linearise,
    load_spec,
    optimal_filter,
    ui_pi_observer,
)
from obsynth.cli.main import main

#: Published constants of the tanks, which their calibration replaces.
PUBLISHED = {"a1": 0.0227, "a2": 0.0241, "b1": 0.0334, "b2": 0.0360}


@cache
def _tanks() -> DAEModel:
    document = YAML(typ="safe").load((DESIGNS / "threetank" / "plant.yaml").read_text(encoding="utf-8"))
    fields = {key: value for key, value in document.items() if key not in ("schema_version", "kind")}
    fields["constants"] |= PUBLISHED
    return DAEModel(**fields)


def tanks(**changes) -> DAEModel:
    """The three tanks with published constants: one model for all, whose functions are compiled once; or another."""
    return _tanks().replace(**changes) if changes else _tanks()


def relative(found, wanted) -> float:
    found, wanted = np.asarray(found, dtype=float), np.asarray(wanted, dtype=float)
    sizes = np.abs(wanted).max(axis=1, keepdims=True)
    return float((np.abs(found - wanted) / np.where(sizes > 0.0, sizes, 1.0)).max())


def test_three_tanks_with_a_leak_have_the_jacobian_written_by_hand():
    model = tanks()
    linear = linearise(model, given={"leak": 0.03, "h1": 0.7, "h3": 0.65}, free=["u1", "u3"])
    x = {name: linear.operating_point[name] for name in ("h1", "h2", "h3")}
    c = model.constants

    def slope(a, d):
        root = np.sqrt(abs(d) + 0.001)
        return a * (1.0 / root - abs(d) / (2.0 * root**3))

    s1, s2 = slope(c["a1"], x["h1"] - x["h2"]), slope(c["a2"], x["h3"] - x["h2"])
    lost = 0.03 / (2.0 * np.sqrt(x["h2"] - c["offset"]))
    A = [[-s1, s1, 0.0], [s1, -s1 - s2 - lost, s2], [0.0, s2, -s2]]
    assert relative(linear.A, A) < 1e-12
    assert relative(linear.B, [[c["b1"], 0], [0, 0], [0, c["b2"]]]) < 1e-14
    assert relative(linear.Bf, [[0], [-np.sqrt(x["h2"] - c["offset"])], [0]]) < 1e-12
    assert np.array_equal(linear.E, np.eye(3))
    assert np.array_equal(linear.C, np.eye(3))
    assert linear.fault_names == ("leak",)
    assert linear.units["h1"] == "V"
    assert linear.operating_point["v1"] == pytest.approx(0.7, abs=1e-15)


def test_the_diode_circuit_has_the_jacobian_written_by_hand():
    linear = linearise(diode())
    v, c = linear.operating_point["v"], linear.operating_point["c"]
    current = (2.0 - v - c) / 10.0
    g = (current + 1e-12) / 0.02585
    assert relative(linear.E, [[0, 0], [0, 1e-3]]) < 1e-15
    assert relative(linear.A, [[1 / 10.0 + g, 1 / 10.0], [g, -1 / 1000.0]]) < 1e-9
    assert relative(linear.B, [[-1 / 10.0], [0.0]]) < 1e-15
    assert relative(linear.Bf, [[0.0], [c / 1000.0**2]]) < 1e-12


def test_the_pendulum_at_rest_has_the_jacobian_written_by_hand():
    linear = linearise(pendulum(ROD[1]), given={"x": 0.0, "y": -1.0, "vx": 0.0, "vy": 0.0})
    g, d = 9.81, 0.3
    A = [[0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [-g, 0, -d, 0, 0], [0, -g, 0, -d, 1], [0, -g, 0, -d, 1]]
    assert linear.operating_point["tension"] == pytest.approx(g, rel=1e-12)
    assert np.abs(linear.A - A).max() < 1e-10
    assert np.array_equal(linear.E, np.diag([1.0, 1, 1, 1, 0]))


def test_the_exchanger_agrees_with_differences_of_its_equations():
    """Complex-free central differences of the model's own implicit equations, at a point found for a pressure."""
    model = exchanger()
    linear = linearise(model, given={"pressure": 2.001e5}, free=["Qn"])
    point = dict(linear.operating_point)
    assert point["pressure"] == pytest.approx(2.001e5, rel=1e-12)
    import casadi as ca

    from obsynth.plants.dae_equations import symbols_of

    s = symbols_of(model)
    x0 = np.array([point[name] for name in model.state_names])
    u0 = np.array([point[name] for name in model.input_names])
    F = ca.Function("F", [s.rates, s.x, s.u, s.theta], [s.equations])
    rest = np.zeros(s.rates.numel())
    theta = model.nominal_parameters
    for i, size in enumerate(model.state_scales):
        h = 1e-5 * size
        step = np.zeros(4)
        step[i] = h
        slope = (np.array(F(rest, x0 + step, u0, theta)) - np.array(F(rest, x0 - step, u0, theta)))[:, 0] / (2 * h)
        peaks = np.abs(linear.A * model.state_scales).max(axis=1)
        assert (np.abs(linear.A[:, i] + slope) * size / peaks).max() < 1e-8
    assert (
        np.abs(np.array(F(rest, x0, u0, theta))[:, 0] / np.abs(linear.A * model.state_scales).max(axis=1)).max() < 1e-12
    )


def test_without_an_equilibrium_the_combination_of_equations_is_named():
    with pytest.raises(PreconditionError, match=r"tank1 \+ tank2 \+ tank3") as caught:
        linearise(tanks())
    assert caught.value.condition == "no-equilibrium"
    assert set(caught.value.signals) == {"tank1", "tank2", "tank3"}


def test_an_equilibrium_that_is_not_unique_names_the_direction():
    with pytest.raises(PreconditionError, match="direction") as caught:
        linearise(pendulum(ROD[1]))
    assert caught.value.condition == "equilibrium-not-unique"
    assert set(caught.value.signals) == {"y", "tension"}


def test_a_freed_input_outside_its_bounds_is_said():
    with pytest.raises(PreconditionError, match=r"u1 = -0\.3.* outside \[0, 1\]") as caught:
        linearise(tanks(), given={"leak": 0.03, "h1": 0.4, "h2": 0.6}, free={"u1": (0, 1), "u3": (0, 1)})
    assert caught.value.condition == "outside-bounds"
    assert caught.value.signals == ("u1",)


def test_a_moving_point_needs_to_be_asked_for_and_then_follows_the_motion():
    model = tanks()
    with pytest.raises(PreconditionError, match="drift=True"):
        linearise(model, at="point")
    linear = linearise(model, at="point", given={"h1": 0.7, "h2": 0.6, "h3": 0.72}, drift=True)
    assert linear.input_names == ("u1", "u3", "drift")
    assert linear.operating_point["drift"] == 0.0
    c, r = model.constants, lambda d: d / np.sqrt(abs(d) + 0.001)
    motion = [
        c["b1"] * 0.4737 - c["a1"] * r(0.1),
        c["a1"] * r(0.1) + c["a2"] * r(0.12),
        c["b2"] * 0.4737 - c["a2"] * r(0.12),
    ]
    assert np.abs(linear.B[:, 2] - motion).max() < 1e-15


@pytest.mark.long
def test_the_algebraic_state_of_a_point_is_solved_for_and_what_is_given_stays():
    linear = linearise(pendulum(ROD[1]), at="point", given={"x": 0.6, "y": -0.8, "vx": 0.4, "vy": 0.3}, drift=True)
    point = linear.operating_point
    assert [point[name] for name in ("x", "y", "vx", "vy")] == [0.6, -0.8, 0.4, 0.3]
    assert point["tension"] == pytest.approx(0.25 + 9.81 * 0.8 - 0.3 * (0.6 * 0.4 - 0.8 * 0.3), rel=1e-12)
    with pytest.raises(PreconditionError, match="contradict"):
        linearise(exchanger(), at="point", given={"p1": 2e5, "p2": 3e5, "T1": 400.0, "T2": 380.0}, drift=True)


def test_faults_and_disturbances_are_chosen_by_name():
    linear = linearise(exchanger(), free=["Qn"], given={"p2": 2.0e5}, faults=["phi"], disturbances=["Tin"])
    assert linear.fault_names == ("phi",)
    assert linear.disturbance_names == ("Tin",)
    assert linear.input_names == ("m1", "Qn", "s")
    assert linear.nd == 1
    assert "psi" not in linear.operating_point


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"given": {"h9": 1.0}}, "h9"),
        ({"given": {"h1": np.nan}}, "finite"),
        ({"given": {"u1": 0.5}, "free": ["u1"]}, "both given and free"),
        ({"free": ["h1"]}, "free has no signal"),
        ({"free": "u1"}, "list of names"),
        ({"faults": ["u1"], "at": "point", "drift": True}, "faults has no signal"),
        ({"at": "rest"}, "equilibrium"),
    ],
)
def test_bad_arguments_are_refused(arguments, told):
    with pytest.raises(SpecError, match=told):
        linearise(tanks(), **arguments)


def test_a_model_without_units_and_one_that_is_not_defined_where_the_search_ends() -> None:
    model = DAEModel(
        {"tank": "area * der(h) = inflow - w", "valve": "w - sqrt(h) = 0"}, {"level": "h"}, states={"h": 1.0, "w": 1.0},
        inputs={"inflow": 1.0}, constants={"area": 5.0},
    )  # fmt: skip
    linear = linearise(model, given={"h": 4.0}, free=["inflow"])
    assert linear.operating_point["inflow"] == pytest.approx(2.0)
    np.testing.assert_allclose(linear.A, [[0.0, -1.0], [0.25, -1.0]], atol=1e-12)
    with pytest.raises(PreconditionError, match="the equation 'valve' has no value where the search ends"):
        linearise(model, given={"h": -4.0}, free=["inflow"])


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("asin(h)", "'tank' has no finite derivative at the nominal values (a root at zero, asin or acos at 1 or -1?)"),
        ("sqrt(h - 1)", "'tank' has no finite derivative at the nominal values (a root at zero, asin or"),
        ("log(h - 1)", "'tank' has no value at the nominal values (a root of a negative number, a logarithm of zero"),
    ],
)
def test_equations_without_value_or_derivative_at_the_start_are_named_with_what_may_be_the_reason(formula, words):
    model = DAEModel(
        {"tank": f"der(h) = q - {formula} - leak", "pipe": "der(w) = h - w"}, {"level": "w"},
        states={"h": 1.0, "w": 1.0}, inputs={"q": 1.5}, parameters={"leak": 0.0},
    )  # fmt: skip
    with pytest.raises(SpecError, match=re.escape(words)):
        linearise(model)
    # Not "singular for every dt" and "not independent": nothing is known of the index there.
    with pytest.raises(PreconditionError, match=re.escape(words)) as caught:
        obsynth.design(model, "dae-adaptive-observer", dt=0.1, Q=1e-4, R=1e-4, initial_parameter_covariance=[[1.0]])
    assert caught.value.condition == "index"
    assert "independent" not in str(caught.value)


TANK = """schema_version: 1
name: tank
plant:
  kind: dae
  states: {level: 1.0}
  inputs: {inflow: 0.1}
  parameters: {c: 0.1}
  units: {level: m, inflow: m3/s, c: m2.5/s, gauge: m}
  equations: {balance: der(level) = inflow - c * sqrt(level)}
  outputs: {gauge: level}
"""
AT_FOUR = "  transform: {linearise: {given: {level: 4.0}, free: [inflow]}}\n"


def test_a_spec_is_linearised_where_it_says_and_with_its_noise(tmp_path, capsys):
    path = tmp_path / "tank.yaml"
    path.write_text(TANK + "  sensor_noise: {gauge: 0.01}\n  process_noise: {balance: 0.002}\n" + AT_FOUR)
    plant = load_spec(path).plant
    np.testing.assert_array_equal(plant.Bw, [[0.002, 0.0]])
    np.testing.assert_array_equal(plant.Dw, [[0.0, 0.01]])
    assert main(["linearise", "--system", str(path), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["operating_point"]["level"] == 4.0
    assert np.ravel(shown["A"]["data"]).tolist() == [-0.025]


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ("  process_noise: {scales: 0.01}\n" + AT_FOUR, "scales"),
        ("  process_noise: {scales: 0.01}\n", "process_noise has no signal named 'scales'"),
        ("  sensor_noise: {gauge: -0.01}\n" + AT_FOUR, "sensor_noise"),
        ("  sensor_noise: {level gauge: 0.01}\n" + AT_FOUR, "level gauge"),
    ],
)
def test_noise_that_fits_nothing_is_refused(tmp_path, more, told):
    path = tmp_path / "tank.yaml"
    path.write_text(TANK + more)
    with pytest.raises(SpecError, match=told):
        load_spec(path)


def test_white_noise_of_a_plant_that_is_not_linearised_becomes_variances_of_its_method(tmp_path):
    path = tmp_path / "tank.yaml"
    stated = "  sensor_noise: {gauge: 0.01}\n  process_noise: {balance: 0.002}\n"
    path.write_text(TANK + stated + "method: {id: dae-adaptive-observer, options: {dt: 4.0}}\n")
    options = load_spec(path).options
    assert options["R"] == {"gauge": pytest.approx(1e-4)}
    assert options["Q"] == {"balance": pytest.approx(0.002**2 / 4.0)}


def test_a_parameter_without_effect_at_the_point_is_named_where_its_fault_is_refused() -> None:
    """The valve is shut: how much it lets through changes nothing there, and does so at another point."""
    tank = DAEModel(
        {"balance": "2.0 * der(level) = inflow - c * sqrt(level) - opening * k"}, {"seen": "level"},
        states={"level": 1.0}, inputs={"inflow": 0.5, "opening": 0.0}, parameters={"c": 0.5, "k": 1.0},
    )  # fmt: skip
    shut = linearise(tank, given={"level": 4.0}, free=["inflow"], faults=["k"])
    for design in (functional_filter, ui_pi_observer, optimal_filter):
        with pytest.raises(PreconditionError, match="The columns of k in Bf and Df are zero: at this operating point"):
            design(shut)
    open_by_half = linearise(tank, given={"level": 4.0, "opening": 0.5}, free=["inflow"], faults=["k"])
    assert functional_filter(open_by_half).report.passed
    with pytest.raises(PreconditionError, match=r"The columns of k in Bf and Df are zero\. "):
        functional_filter(shut.replace(operating_point=None))
