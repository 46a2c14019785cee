"""Plants from CasADi: the same as from texts, linear and nonlinear, and what is wrong with others."""

from __future__ import annotations

import casadi
import numpy as np
import pytest

import obsynth

STATES, INPUTS, PARAMETERS = {"level": 1.0, "outflow": 0.5}, {"inflow": 0.5}, {"c": 0.5}


def tank(symbol=casadi.SX):
    x, z, u, p = (symbol.sym(name) for name in "xzup")
    return {"x": x, "z": z, "u": u, "p": p, "ode": (u - z) / 2.0, "alg": z - p * casadi.sqrt(x), "y": z}


def by_text():
    return obsynth.DAEModel(
        {"balance": "2 * der(level) = inflow - outflow", "valve": "outflow = c * sqrt(level)"}, {"flow": "outflow"},
        states=STATES, inputs=INPUTS, parameters=PARAMETERS,
    )  # fmt: skip


@pytest.mark.one_in(4)
@pytest.mark.parametrize("symbol", [casadi.SX, casadi.MX])
@pytest.mark.parametrize("as_function", [False, True])
def test_it_is_the_plant_of_the_same_texts(symbol, as_function):
    system = tank(symbol)
    if as_function:
        names, results = ["x", "z", "u", "p"], ["ode", "alg", "y"]
        parts = ([system[name] for name in names], [system[name] for name in results])
        system = casadi.Function("tank", *parts, names, results)
    plant = obsynth.from_casadi(
        system, states=STATES, inputs=INPUTS, parameters=PARAMETERS, output_names=["flow"]
    )  # fmt: skip
    assert plant.state_names == ("level", "outflow")
    assert plant.output_names == ("flow",)
    ours, theirs = (obsynth.eliminate_algebraic_states(obsynth.linearise(each)).plant for each in (plant, by_text()))
    for name in ("A", "B", "C"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-12, atol=1e-14)
    u = np.full((20, 1), 0.55)
    first, second = (obsynth.simulate(each, dt=0.5, u=u) for each in (plant, by_text()))
    np.testing.assert_allclose(first.outputs, second.outputs, rtol=1e-9)


def test_a_plant_without_algebraic_states_inputs_or_parameters():
    x = casadi.SX.sym("x", 2)
    plant = obsynth.from_casadi({"x": x, "ode": casadi.vertcat(x[1], -x[0] - x[1]), "y": x[0]}, states={"q": 0, "v": 0})
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(obsynth.linearise(plant).A).imag), [-(0.75**0.5), 0.75**0.5])


BAD = {
    "no system": (lambda: obsynth.from_casadi(3, states=STATES), "system is 3: give a casadi.Function"),
    "key": (lambda: obsynth.from_casadi({**tank(), "w": 1}, states=STATES), "unknown key 'w'; there are: x, z, u, p"),
    "states": (lambda: obsynth.from_casadi(tank(), states={"x": 1.0}), r"states names 1 value, but"),
    "inputs": (lambda: obsynth.from_casadi(tank(), states=STATES), r"inputs names 0 values, but the system has 1"),
    "names": (
        lambda: obsynth.from_casadi(casadi.Function("f", [casadi.SX.sym("a")], [1]), states={"a": 1.0}), "'i0': name",
    ),
    "free": (
        lambda: obsynth.from_casadi({"x": casadi.SX.sym("x"), "ode": casadi.SX.sym("w"), "y": 1}, states={"a": 1.0}),
        "makes no function",
    ),
    "y of u": (
        lambda: obsynth.from_casadi(
            {**tank(), "y": tank()["u"]}, states=STATES, inputs=INPUTS, parameters=PARAMETERS
        ), "makes no function",
    ),
    "no y": (
        lambda: obsynth.from_casadi({k: v for k, v in SAME.items() if k != "y"}, states=STATES, inputs=INPUTS,
                                    parameters=PARAMETERS), r"0 outputs y",
    ),
    "direct": (
        lambda: obsynth.from_casadi({**SAME, "y": SAME["u"]}, states=STATES, inputs=INPUTS, parameters=PARAMETERS),
        "y depends on u",
    ),
    "no mapping": (lambda: obsynth.from_casadi(tank(), states=["a"]), "states is a list"),
}  # fmt: skip
SAME = tank()


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_told(name):
    call, told = BAD[name]
    with pytest.raises(obsynth.SpecError, match=told):
        call()
