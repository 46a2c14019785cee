"""Models of DAEs: what is refused and why, the index, and what can be identified."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from dae_plants import ROD, diode, exchanger, pendulum

from obsynth import (
    DAEModel,
    SpecError,
    dae_adaptive_observer,
    eliminate_algebraic_states,
    identifiability,
    linearise,
    simulate_dae,
)
from obsynth.analysis.dae_structure import index_report
from obsynth.methods.designing import check
from obsynth.plants.dae_functions import DAEFunctions
from obsynth.plants.implicit_step import ImplicitStep

UNITS = dict.fromkeys(["a", "b", "go", "c", "seen"], "1")


def small(**changes) -> DAEModel:
    fields = {
        "equations": {"moves": "der(a) = -c * a + b", "holds": "b = go + 0.1 * a"}, "outputs": {"seen": "b"},
        "states": {"a": 1.0, "b": 1.0}, "inputs": {"go": 1.0}, "parameters": {"c": 0.5}, "units": UNITS,
    }  # fmt: skip
    return DAEModel(**{**fields, **changes})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"equations": {"moves": "der(a) = -c * a + bb", "holds": "b = go"}}, ["equations.moves", "'bb'"]),
        ({"equations": {"moves": "der(a) = -c * a + b"}}, ["1 equation for 2 states", "1 too few"]),
        ({"equations": {"moves": "der(a) = -c * a + b", "holds": "go = 1"}}, ["'holds'", "neither a state"]),
        ({"equations": {"moves": "der(a) = -c * a", "holds": "a = go"}}, ["state 'b' enters no equation"]),
        ({"equations": {"moves": "der(a) = -a + b", "holds": "b = go"}}, ["parameter 'c' enters no equation"]),
        ({"equations": {"moves": "der(a) = -c * a + b", "holds": "b = a"}}, ["input 'go' enters no equation"]),
        ({"equations": {"moves": "der(a) = -c * a + der(go)", "holds": "b = a"}}, ["der(...)", "'go'"]),
        ({"equations": {"moves": "der(der(a)) = -c * a", "holds": "b = a"}}, ["no function 'der'"]),
        ({"equations": {"moves": "der(a) = __import__", "holds": "b = c"}}, ["'__import__'"]),
        ({"equations": {"moves": "der(a) = a.real", "holds": "b = c"}}, ["'a.real' is not allowed"]),
        ({"equations": {"moves": "der(a) = a ^ 2", "holds": "b = c"}}, ["'a^2' is not allowed", "written **"]),
        ({"states": {"a": 1.0, "b": float("nan")}}, ["states.b", "finite"]),
        ({"inputs": {"go": 1.0, "a": 2.0}}, ["'a'", "more than one"]),
        ({"parameters": {"sin": 1.0}}, ["'sin'"]),
        ({"outputs": {}}, ["outputs is empty"]),
        ({"equations": {"moves": "der(a) = -c * a if a > 0 else b", "holds": "b = go"}},
         ["equations.moves", "where(a > b, c, d)"]),
        ({"equations": {"moves": "der(a) = -c * a", "holds": "b <= go"}}, ["equations.holds", "where(a > b, c, d)"]),
        ({"states": {"a": 1.0, "where": 1.0}}, ["'where'"]),
        ({"outputs": {"seen": "2.0"}}, ["'seen'", "neither a state nor a parameter"]),
        ({"equations": {"moves": "der(c) = -c * a + b", "holds": "b = go + 0.1 * a"}}, ["der(...)", "'moves'", "zero"]),
        ({"equations": {"moves": "der(a) = -c * a + k", "holds": "b = go"}}, ["'der(a) = -c * a + k' uses 'k'"]),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(changes, words) -> None:
    with pytest.raises(SpecError) as caught:
        small(**changes)
    assert [word for word in words if word not in str(caught.value)] == []


@pytest.mark.parametrize("name", ["der(a)", "der( a )"])
def test_an_equation_named_by_its_derivative_gives_that(name) -> None:
    """Without '=' the text was an algebraic equation, which a design verified and no log could follow."""
    whole = small()
    for text in ("-c * a + b", "der(a) = -c * a + b", "-c * a + b - der(a)"):
        found = small(equations={name: text, "holds": "b = go + 0.1 * a"})
        rates, x = np.array([0.3, 0.0]), np.array([2.0, 1.5])
        local = [
            DAEFunctions(model, "backward-euler").residual_function(x, x - rates, [1.0], [0.5], 1.0)[0]
            for model in (found, whole)
        ]
        assert abs(float(local[0][0])) == pytest.approx(abs(float(local[1][0])))
        assert found.equation_names == (name, "holds")
    # Under any other name a text without '=' is zero, as ever; a comparison is no '='.
    assert small(equations={"moves": "der(a) + c * a - b", "holds": "b - go - a"}).equations["holds"] == "b - go - a"
    chosen = small(equations={name: "where(a >= b, -c * a, b)", "holds": "b = go + 0.1 * a"})
    assert chosen.equations[name] == "der(a) = where(a >= b, -c * a, b)"


def test_a_variance_under_another_name_than_that_of_an_equation_is_refused_with_the_names() -> None:
    with pytest.raises(SpecError, match="Q has no signal named 'x1'; there are: moves, holds"):
        dae_adaptive_observer(small(), dt=1.0, Q={"x1": 1.0}, R=1.0)


def test_an_if_on_a_state_is_refused_and_where_is_not() -> None:
    fields = {"states": {"a": 1.0}, "units": {"a": "1", "seen": "1"}, "output_names": ["seen"]}

    def with_if(rates, x, u, theta):
        return [rates[0] - (1.0 if x[0] > 0 else 2.0)]

    def with_where(rates, x, u, theta):
        return [rates[0] - np.where(x[0] > 0, np.sqrt(np.maximum(x[0], 0.0)), 2.0)]

    with pytest.raises(SpecError, match=r"numpy\.where"):
        DAEModel(with_if, lambda x, theta: [x[0]], **fields)
    model = DAEModel(with_where, lambda x, theta: [x[0]], **fields)
    found = ImplicitStep(DAEFunctions(model), 0.5).solve(np.array([4.0]), np.zeros(0), np.zeros(0)).x[0]
    assert found == pytest.approx(((0.5 + np.sqrt(0.25 + 16.0)) / 2) ** 2, rel=1e-14)


@pytest.mark.parametrize(
    ("equation", "words"),
    [
        (lambda r, x, u, t: [r[0] - (1.0 if x[0] > 0 else 2.0)], ["numpy.where"]),
        (lambda r, x, u, t: [r[0] - max(x[0], 0.0)], ["numpy.maximum"]),
        (lambda r, x, u, t: [r[0] - np.where(0.0 < x[0] < 1.0, 1.0, 2.0)], ["numpy.logical_and"]),
        (lambda r, x, u, t: [r[0] - math.sqrt(x[0])], ["not a number", "in place of those of math"]),
        (lambda r, x, u, t: [r[0] - float(x[0])], ["not a number"]),
        (lambda r, x, u, t: [r[0] - int(x[0])], ["int(x)"]),
        (lambda r, x, u, t: [r[0] - sum(1.0 for _ in range(x[0]))], ["TypeError", "range(x)"]),
        (lambda r, x, u, t: [r[0] - x[1]], ["IndexError", "rates, x, u, theta"]),
        (lambda r, x, u: [r[0] - x[0]], ["TypeError", "rates, x, u, theta"]),
        (lambda r, x, u, t: ["x"], ["cannot be called on symbols"]),
        (lambda r, x, u, t: [r[0], x[0]], ["2 equations for 1 state ", "1 too many"]),
        (lambda r, x, u, t: None, ["must return a list"]),
    ],
)  # fmt: skip
def test_functions_that_cannot_be_used_say_what_to_use(equation, words) -> None:
    fields = {"states": {"a": 1.0}, "units": {"a": "1", "y": "1"}, "output_names": ["y"]}
    with pytest.raises(SpecError) as caught:
        DAEModel(equation, lambda x, theta: [x[0]], **fields)
    assert [word for word in words if word not in str(caught.value)] == []


def test_where_in_a_text_is_where_in_a_function() -> None:
    """A pump that stops above a level, and drains by a root that does not exist below zero."""
    fields = {"states": {"a": 1.0}, "inputs": {"go": 1.0}, "parameters": {"c": 0.5}}
    units = dict.fromkeys(["a", "go", "c", "seen"], "1")
    text = DAEModel({"level": "der(a) = where(a <= 2, go, 0) - c * where(a > 0, sqrt(a), 0)"}, {"seen": "a"},
                    units=units, **fields)  # fmt: skip

    def level(rates, x, u, theta):
        drained = np.where(x[0] > 0.0, np.sqrt(x[0]), 0.0)
        return [rates[0] - np.where(x[0] <= 2.0, u[0], 0.0) + theta[0] * drained]

    function = DAEModel(level, lambda x, theta: [x[0]], units=units, output_names=["seen"], **fields)
    u, c = np.array([1.0]), np.array([0.5])
    for start in (-1.0, 1.0, 3.0):
        steps = [ImplicitStep(DAEFunctions(model), 1e-3) for model in (text, function)]
        ends = [step.solve(np.array([start]), u, c).x[0] for step in steps]
        slope = (1.0 if start <= 2.0 else 0.0) - 0.5 * np.sqrt(max(start, 0.0))
        assert ends[0] == pytest.approx(start + 1e-3 * slope, abs=1e-6)
        assert ends[0] == ends[1]
        F, *_ = steps[0].sensitivities(steps[0].solve(np.array([start]), u, c), np.array([start]), u, c)
        assert np.isfinite(F).all()
    assert DAEModel(**text.as_dict()).as_dict() == text.as_dict()


def test_functions_cannot_be_saved_and_texts_can() -> None:
    with pytest.raises(SpecError, match="Python functions"):
        DAEModel(lambda r, x, u, t: [r[0] + x[0]], lambda x, t: [x[0]], states={"a": 1.0},
                 units={"a": "1", "y": "1"}, output_names=["y"]).as_dict()  # fmt: skip
    model = exchanger()
    assert DAEModel(**model.as_dict()).as_dict() == model.as_dict()


@pytest.mark.parametrize("index", [1, 2, 3])
def test_the_index_of_a_pendulum(index) -> None:
    found = index_report(pendulum(ROD[index]), 0.01)
    assert found.index == index
    assert ("rod" in found.equations) == (index > 1)
    assert ("tension" in found.states) == (index > 1)


def test_a_redundant_equation_is_index_zero_and_named() -> None:
    found = index_report(small(equations={"first": "a + c * b = go", "again": "2 * a + 2 * c * b = go"}), 1.0)
    assert found.index == 0
    assert set(found.equations) == {"first", "again"}


def test_examples_have_index_one() -> None:
    assert index_report(exchanger(), 1.0).index == 1
    assert index_report(diode(), 1e-4).index == 1


def test_steady_state_of_the_heat_exchanger() -> None:
    """The audit's digits: 412.78 K and 375.38 K; 87 Pa between the cells."""
    model = exchanger()
    step = ImplicitStep(DAEFunctions(model), 100.0)
    x = model.nominal_state
    for _ in range(50):
        x = step.solve(x, model.nominal_input, model.nominal_parameters).x
    assert x[2:] == pytest.approx([412.78, 375.38], abs=0.006)
    assert x[1] - x[0] == pytest.approx(87.0, abs=1.0)


def excited(model: DAEModel, samples: int = 1000, share: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(6)
    u = np.tile(model.nominal_input, (samples, 1))
    u[:, 0] *= 1.0 + share * rng.standard_normal(samples)
    if model.input_names[1] == "Tin":
        u[:, 1] += 100.0 * share * rng.standard_normal(samples)
        u[:, 2] *= 1.0 + 2.0 * share * rng.standard_normal(samples)
    return u


def test_both_faults_are_identifiable_from_pressure_and_temperature() -> None:
    """The audit: Cramer-Rao 2e-4 and 5.4 Pa, full rank, without excitation."""
    model = exchanger()
    found = identifiability(model, excited(model), dt=1.0, R=np.diag([1e4, 0.25]), parameter_scales=[0.1, 1e3])
    assert found.rank == 5
    assert found.unseen == ()
    assert found.deviations[4] == pytest.approx(2e-4, rel=0.1)
    assert found.deviations[5] == pytest.approx(5.4, rel=0.01)
    assert str(found).splitlines()[-1] == "psi: deviation 5.41 at least"


def test_pressure_alone_needs_excitation() -> None:
    """The audit: rank 4 of 5 without excitation; with white noise of 5 % all can be told, 1e2 Pa."""
    units = {name: unit for name, unit in exchanger().units.items() if name != "temperature"}
    model = exchanger(outputs={"pressure": "p2 + psi"}, units=units)
    known = {"dt": 1.0, "R": [[1e4]], "parameter_scales": [0.1, 1e3]}
    still = identifiability(model, excited(model), initial_state=steady(model), **known)
    assert still.rank == 4
    assert {"phi", "psi"} <= set(still.unidentifiable)
    assert "phi: not identifiable\npsi: not identifiable\nno effect on the outputs (in units of scales): " in str(still)
    moved = identifiability(model, excited(model, share=0.05), **known)
    assert moved.rank == 5
    assert 70.0 < moved.deviations[5] < 140.0


def steady(model: DAEModel) -> np.ndarray:
    step = ImplicitStep(DAEFunctions(model), 1000.0)
    x = np.array(model.nominal_state)
    for _ in range(100):
        x = step.solve(x, model.nominal_input, model.nominal_parameters).x
    return x


def printed(momentum: str) -> DAEModel:
    """The paper's three sums with its known inputs: T2 and the outlet flow measured, pressure the only output."""
    model = exchanger()
    definitions = {k: v for k, v in model.definitions.items() if k not in ("m2", "h1", "U1", "U2", "M1", "M2")}
    definitions |= {"h1": model.definitions["h1"], "M": "v1 * p1 / (R * T1) + v2 * p2 / (R * T2)",
                    "U": "v1 * p1 / (R * T1) * (h1 - R * T1) + v2 * p2 / (R * T2) * (h2 - R * T2)"}  # fmt: skip
    names = {"p1": "Pa", "p2": "Pa", "T1": "K", "Mass": "kg", "Energy": "J", "m1": "kg/s", "m2": "kg/s", "Tin": "K",
             "T2": "K", "Qn": "W", "phi": "1", "psi": "Pa", "pressure": "Pa"}  # fmt: skip
    return DAEModel(
        {"mass": "der(Mass) = m1 - m2", "energy": "der(Energy) = m1 * hin - m2 * h2 - phi * Qn", "masses": "Mass = M",
         "energies": "Energy = U", "momentum": momentum},
        {"pressure": "p2 + psi"},
        states={"p1": 200014.0, "p2": 200101.0, "T1": 412.78, "Mass": 3.545, "Energy": 1.0e6},
        inputs={"m1": 0.2, "m2": 0.2, "Tin": 450.0, "T2": 375.38, "Qn": 15150.0},
        parameters=dict(model.parameters), constants=dict(model.constants), definitions=definitions, units=names,
    )  # fmt: skip


FLUX = "m1 ** 2 * T1 / p1 - m2 ** 2 * T2 / p2"


def test_as_printed_the_efficiency_never_reaches_the_output() -> None:
    model = printed(f"{FLUX} = 0")
    found = identifiability(model, excited(model, 200, 0.01), dt=1.0, R=[[1e4]], parameter_scales=[0.1, 1e3])
    assert "phi" in found.unidentifiable
    assert any(set(direction) <= {"T1", "p1", "Energy", "phi"} and "phi" in direction for direction in found.unseen)


def test_corrected_with_the_papers_inputs_the_bias_is_stored_energy() -> None:
    model = printed(f"{FLUX} + A ** 2 / R * (p1 - p2) = 0")
    found = identifiability(model, excited(model, 200), dt=1.0, R=[[1e4]], parameter_scales=[0.1, 1e3])
    assert "psi" in found.unidentifiable
    assert any({"psi", "Energy"} <= set(direction) for direction in found.unseen)
    assert "phi" not in found.unidentifiable


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"dt": 0.0}, "dt is 0.0"), ({"R": [[0.0]]}, "R must be positive definite"),
        ({"R": np.eye(2)}, "R is 2 by 2"),
        ({"parameter_scales": [0.0]}, "must be positive"), ({"u": np.ones((1, 1))}, "at least 2"),
        ({"u": np.ones((9, 2))}, r"\(samples, 1\)"), ({"initial_state": [1.0, np.inf]}, r"initial_state\.b is inf"),
    ],
)  # fmt: skip
def test_bad_questions_of_identifiability_are_named(arguments, words) -> None:
    given = {"u": np.ones((9, 1)), "dt": 0.5, "R": [[1.0]], **arguments}
    with pytest.raises(SpecError, match=words):
        identifiability(small(), given.pop("u"), **given)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (exchanger(), ["determine every direction"]),
        (printed(f"{FLUX} = 0"), ["do not determine", "phi (", "psi ("]),
        (printed(f"{FLUX} + A ** 2 / R * (p1 - p2) = 0"), ["do not determine", "Energy (", "psi ("]),
    ],
)  # fmt: skip
def test_the_check_before_any_design_says_what_the_outputs_do_not_tell(model, words) -> None:
    report = check(model)["dae-adaptive-observer"]
    assert report.passed
    detail = report["exists: parameters"].detail
    assert [word for word in words if word not in detail] == []
    assert ("phi (" in detail) == ("phi (" in words)


def test_an_output_may_read_an_input_directly_or_through_definitions() -> None:
    """A terminal voltage is lower by what the current drops at a resistor; it was refused."""
    written = DAEModel(
        {"charge": "capacity * der(s) = -current", "branch": "der(v) = current - v"},
        {"voltage": "3 + s - drop", "twice": "2 * current + current_now_"},
        states={"s": 0.5, "v": 0.0}, inputs={"current": 2.0, "other": 1.0}, parameters={"r": 0.1},
        constants={"capacity": 10.0, "current_now_": 1.0},
        definitions={"lost": "r * current + other", "drop": "v + lost"},
    )  # fmt: skip
    assert list(written.states.items()) == [("s", 0.5), ("v", 0.0), ("current_now", 2.0), ("other_now", 1.0)]
    assert written.equations["current_now"] == "current_now = current"
    assert DAEModel(**written.as_dict()).as_dict() == written.as_dict()
    linear = eliminate_algebraic_states(linearise(written, at="point", drift=True)).plant
    inputs = list(linear.input_names)
    direct = linear.D[:, [inputs.index("current"), inputs.index("other")]]
    np.testing.assert_allclose(direct, [[-0.1, -1.0], [2.0, 0.0]], atol=1e-12)


def test_a_state_that_equals_an_input_has_a_name_of_its_own() -> None:
    model = DAEModel(
        {"moves": "der(go_now) = go - go_now"}, {"seen": "go_now + go"}, states={"go_now": 0.0}, inputs={"go": 1.0}
    )
    assert list(model.states) == ["go_now", "go_now_"]
    assert model.outputs["seen"] == "go_now + go_now_"


def test_an_output_that_reads_an_input_is_observed() -> None:
    """The same as with the state and its equation written by hand."""
    fields: dict[str, Any] = {
        "states": {"x": 1.0}, "inputs": {"u": 1.0}, "parameters": {"r": 0.5},
    }  # fmt: skip
    equations = {"moves": "der(x) = -x + u"}
    short = DAEModel(equations, {"y": "x + r * u"}, **fields)
    long = DAEModel(
        {**equations, "u_now": "u_now = u"}, {"y": "x + r * u_now"}, **{**fields, "states": {"x": 1.0, "u_now": 1.0}}
    )
    assert short.as_dict() == long.as_dict()
    design = dae_adaptive_observer(short, dt=0.1, Q={"moves": 1e-4}, R=1e-4)
    u = 1.0 + np.sin(0.3 * np.arange(200))[:, None]
    record = simulate_dae(short, u, dt=0.1, parameters=[0.7], seed=1, R=[[1e-4]])
    estimates = design.observer.run(record.outputs, u)
    assert abs(float(estimates.parameters[-1, 0]) - 0.7) < 0.05
