"""The steady state of recursive designs: what the recursion becomes, in every form, and in C."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from test_export import digest, through_c

import obsynth
from obsynth import PreconditionError, SolverError, SpecError, TimeVaryingDescriptorSystem
from obsynth.observers.recursive.steady_observer import steady_observer

pytestmark = pytest.mark.usefixtures("taken_as_verified")

PLANT = TimeVaryingDescriptorSystem(
    E=[[1, 0, 0], [0, 1, 0], [0, 0, 0]], A=[[0.9, 0.1, 0], [-0.2, 0.7, 0.1], [1, 0.5, -1]], B=[[0], [1], [0.3]],
    C=[[1, 0, 0], [0, 0, 1]], Phi=[[0], [1], [0]], dt=0.1, parameter_names=["leak"],
    operating_point={"y1": 3.0, "x1": 3.0, "leak": 0.5},
)  # fmt: skip
Q = np.diag([1e-3, 1e-3, 1e-4])
START = {"initial_state": [0.5, -0.2, 0.4]}
DESIGNS = {
    "filter": lambda: obsynth.descriptor_kalman(PLANT, Q=Q, R=1e-2, **START),
    "singular": lambda: obsynth.descriptor_kalman(PLANT, Q=np.diag([1e-3, 1e-3, 0]), R=1e-2),
    "early": lambda: obsynth.descriptor_kalman(PLANT, Q=Q, R=1e-2, early_constraints=True, **START),
    "innovation": lambda: obsynth.adaptive_observer(
        PLANT, Q=Q, R=1e-2, forgetting=0.95, initial_parameters=[0.3], **START
    ),
    "early innovation": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, forgetting=0.95, early_constraints=True),
    "unguarded": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, forgetting=0.95, guard="none"),
    "directional": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, forgetting=0.95, guard="directional"),
    "literal": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, forgetting=0.95, form="literal"),
    "walk": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, form="random-walk", random_walk=1e-4, **START),
}
SAMPLES = 900


@cache
def designed(name: str) -> obsynth.ObserverDesign:
    return DESIGNS[name]()


def record(samples: int = SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(samples, 2)), rng.normal(size=(samples, 1))


@pytest.mark.one_in(8)
@pytest.mark.parametrize("name", DESIGNS)
def test_the_recursion_becomes_its_steady_state(name):
    design = designed(name)
    y, u = record()
    found = steady_observer(design.observer)
    assert not found.start.flags.writeable
    wanted, steady = design.observer.run(y, u), found.observer.run(y, u, initial_state=found.start)
    late = slice(600, None)
    np.testing.assert_allclose(steady.states[late], wanted.states[late], rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(steady.faults[late], wanted.parameters[late], rtol=0.0, atol=1e-11)
    # Directions of the innovation are free up to their sign: their length is not.
    gaps = wanted.innovations
    if name not in ("filter", "singular", "early", "walk"):
        gaps = gaps[1:] - np.einsum("kmq,kq->km", wanted.regressors[1:], wanted.parameters[:-1])
    lengths = np.linalg.norm(gaps, axis=1)[-200:]
    np.testing.assert_allclose(np.linalg.norm(steady.residuals, axis=1)[-200:], lengths, rtol=1e-10)


def test_expressions_without_k_are_constants(tmp_path):
    given = {**PLANT.as_dict(), "constants": {"rate": 0.9}}
    named = TimeVaryingDescriptorSystem(
        **{
            **given,
            "A": [["rate", 0.1, 0], ["-0.2", 0.7, 0.1], [1, "rate / 1.8", -1]],
            "E": [["1", 0, 0], [0, 1, 0], [0, 0, 0]],
        }
    )
    moving = TimeVaryingDescriptorSystem(**{**given, "A": [["rate + 0 * k", 0.1, 0], [-0.2, 0.7, 0.1], [1, 0.5, -1]]})
    assert (named.is_time_invariant, moving.is_time_invariant) == (True, False)
    design = obsynth.descriptor_kalman(named, Q=Q, R=1e-2, **START)
    found, wanted = (steady_observer(each.observer).observer for each in (design, designed("filter")))
    for letter in ("Az", "By", "Bu", "Cz", "Dy"):
        np.testing.assert_array_equal(getattr(found, letter), getattr(wanted, letter))
    design.save(tmp_path / "named.gains.json")
    again = obsynth.load(tmp_path / "named.gains.json")
    assert again.plant.is_time_invariant
    assert obsynth.verify(again).passed
    with pytest.raises(SpecError, match="A may change with k"):
        steady_observer(obsynth.descriptor_kalman(moving, Q=Q, R=1e-2, **START).observer)


def test_its_gains_are_those_of_the_riccati_equation():
    design = designed("filter")
    state = obsynth.steady_state_filter(PLANT, Q=Q, R=1e-2 * np.eye(2))
    found = steady_observer(design.observer).observer
    np.testing.assert_allclose(found.Dy[:3], state.K, atol=1e-12)
    np.testing.assert_allclose(found.Cz[:3], state.L, atol=1e-12)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", ["filter", "early", "innovation", "walk"])
def test_c_equals_python_over_ten_thousand_steps(name, tmp_path):
    design = designed(name)
    source, header = obsynth.export(design, tmp_path / "steady.c")
    found = steady_observer(design.observer)
    y, u = record(10_000)
    shown = through_c(found.observer, source, np.hstack([u, y]))
    run = found.observer.run(y, u, initial_state=found.start)
    wanted = np.hstack([run.states, run.faults, run.residuals])
    assert np.all(np.abs(shown - wanted).max(axis=0) <= 1e-12 * np.abs(wanted).max(axis=0))
    for path in (source, header):
        assert digest(design, tmp_path) in path.read_text(encoding="ascii")
    text = header.read_text(encoding="ascii")
    assert "steady state of a recursive design" in text
    assert 'y[0]: "y1", operating point 3.0' in text


@pytest.mark.long
def test_arrays_and_state_space(tmp_path):
    design = designed("innovation")
    (path,) = obsynth.export(design, tmp_path / "steady.npz")
    data, found = np.load(path), steady_observer(design.observer)
    np.testing.assert_array_equal(data["A"], found.observer.Az)
    np.testing.assert_array_equal(data["x0"].ravel(), found.start)
    assert list(data["output_names"][:4]) == ["xhat[x1]", "xhat[x2]", "xhat[x3]", "fhat[leak]"]
    assert dict(zip(data["output_names"], data["output_point"], strict=True))["fhat[leak]"] == 0.5
    assert float(data["Ts"]) == 0.1
    system = design.to_control()
    np.testing.assert_array_equal(system.A, found.observer.Az)
    assert system.input_labels == ["u1", "y1", "y2"]


@pytest.mark.long
def test_what_has_no_steady_state_is_refused(tmp_path):
    moving = PLANT.replace(A=[[0.9, "0.1 * sin(k)", 0], [-0.2, 0.7, 0.1], [1, 0.5, -1]], horizon=50)
    with pytest.raises(SpecError, match=r"^A may change with k"):
        obsynth.export(obsynth.descriptor_kalman(moving, Q=Q, R=1e-2), tmp_path / "a.c")
    short = PLANT.replace(horizon=50)
    noise = obsynth.descriptor_kalman(short, Q=Q, R=[["0.01 + 0.001 * k", 0], [0, 0.01]])
    with pytest.raises(SpecError, match=r"^R may change with k"):
        obsynth.export(noise, tmp_path / "a.c")
    resetting = obsynth.adaptive_observer(short, Q=Q, R=1e-2, reset=1e-6)
    with pytest.raises(SpecError, match="resets its gains"):
        obsynth.export(resetting, tmp_path / "a.c")
    for option, value in (("outliers", "gate"), ("state_bounds", {"x1": [-1, 1]}), ("sensors", {"y1": {"delay": 2}})):
        with pytest.raises(SpecError, match=option):
            obsynth.export(obsynth.descriptor_kalman(short, Q=Q, R=1e-2, **{option: value}), tmp_path / "a.c")
    with pytest.raises(SpecError, match="sampled already"):
        obsynth.export(designed("filter"), tmp_path / "a.c", sample_time=0.1)
    # A constant that nothing disturbs is learnt for ever: the gain goes to zero like 1 / k, and is never constant.
    still = TimeVaryingDescriptorSystem(E=[[1]], A=[[1]], C=[[1]], dt=1.0)
    with pytest.raises((SolverError, PreconditionError), match=r"do not settle|not stable"):
        obsynth.export(obsynth.descriptor_kalman(still, Q=0.0, R=1.0), tmp_path / "a.c")
    assert list(tmp_path.iterdir()) == []


def test_a_nonlinear_design_is_refused(tmp_path):
    model = obsynth.DAEModel(
        equations={"balance": "area * der(level) = inflow - c * out", "valve": "out - sqrt(level) = 0"},
        outputs={"height": "level", "drain": "out"}, states={"level": 1.0, "out": 1.0}, inputs={"inflow": 1.0},
        parameters={"c": 1.0}, constants={"area": 2.0},
        units={"level": "m", "out": "m0.5", "inflow": "m3/s", "c": "1", "height": "m", "drain": "m0.5", "area": "m2"},
    )  # fmt: skip
    design = obsynth.dae_adaptive_observer(model, dt=0.1, Q={"balance": 1e-8}, R={"height": 1e-4, "drain": 1e-4})
    with pytest.raises(SpecError, match="nonlinear plant"):
        obsynth.export(design, tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: obsynth.load(None), "path is missing"),
        (lambda: obsynth.load(3), "path is an int"),
        (lambda: obsynth.sample_observer(None, 0.1), "observer is missing"),
        (lambda: obsynth.sample_observer(designed("filter"), 0.1), "observer is an ObserverDesign"),
        (lambda: obsynth.export(None, "a.c"), "design is missing"),
        (lambda: obsynth.export(designed("filter"), None), "path is missing"),
        (lambda: designed("filter").save(None), "path is missing"),
        (lambda: obsynth.run_on_data(None, "log.csv"), "design is missing"),
        (lambda: obsynth.run_on_data(designed("filter"), None), "data is missing"),
        (lambda: obsynth.run_on_data(designed("filter"), [[0.0]]), "data is a list"),
        (lambda: obsynth.run_on_data(designed("filter"), "log.csv", 3), "out is an int"),
        (lambda: obsynth.run_on_data(designed("filter"), "log.csv", monitor="nis"), "monitor is a str"),
        (lambda: obsynth.run_on_data(designed("filter"), "log.csv", thresholds={"xhat[x1]": "a"}), "threshold of"),
        (lambda: obsynth.run_on_data(designed("filter"), "log.csv", scales={"y1": "a"}), "scale of"),
        (lambda: obsynth.run_on_data(designed("filter"), "log.csv", columns=["y1"]), "columns is a list"),
        (lambda: obsynth.run_on_data(designed("filter"), "log.csv", warm_up="a"), "warm_up is 'a'"),
        (lambda: obsynth.run_on_data(designed("filter"), "log.csv", state=3), "state is an int"),
        (lambda: obsynth.simulate(None, None), "design is missing"),
        (lambda: obsynth.simulate(designed("filter"), None), "scenario is missing"),
        (lambda: obsynth.monitor(None, None), "design is missing"),
        (lambda: obsynth.monitor(designed("filter"), obsynth.Scenario(horizon=1)), "no linear time-invariant"),
        (lambda: obsynth.evaluate(None, None), "design is missing"),
        (lambda: obsynth.online_monitor(designed("filter"), "nis", scenario=3), "scenario is an int"),
        (lambda: obsynth.online_monitor(designed("filter"), "nis", false_alarms="a"), "false_alarms is 'a'"),
        (lambda: obsynth.online_monitor(designed("filter"), "nis", window=5), "window is for designs of another"),
        (lambda: obsynth.online_monitor(designed("filter"), "nis", noise_bound=3.0), "noise_bound is for designs"),
        (lambda: obsynth.online_monitor(designed("walk"), "nis", nominal={"leak": "a"}), "nominal value of 'leak'"),
    ],
)  # fmt: skip
def test_calls_that_make_no_sense_are_refused_in_words(call, message):
    with pytest.raises(SpecError, match=message):
        call()


@pytest.mark.parametrize("dt", ["a", None, True, float("nan"), 0.0])
def test_a_sampling_time_is_a_positive_number(dt):
    continuous = obsynth.LinearObserver(
        [[-1.0]],
        np.zeros((1, 0)),
        [[1.0]],
        [[1.0]],
        np.zeros((1, 0)),
        [[0.0]],
        0.0,
        (),
        ("y",),
        ("x",),
        (),
        (),
        (0,),
        (),
    )
    with pytest.raises(SpecError, match="dt is"):
        obsynth.sample_observer(continuous, dt)


@pytest.mark.long
def test_gains_whose_last_digits_go_to_and_fro_have_settled() -> None:
    # After a thousand steps some entries moved by 8e-15 for ever, in other units of the states by nothing.
    plant = obsynth.DescriptorSystem(
        np.diag([1.0, 1.0, 0.0]), np.diag([0.0, -0.5, -0.95]),
        C=[[-0.23, -0.16, -0.49], [-1.02, 1.09, -1.39], [-0.18, -0.26, 1.56]],
        Bf=[[0.5, 2.3], [0.8, -0.5], [0.5, 1.1]], Dw=np.diag([0.01, 0.6, 0.01]), dt=0.1,
    )  # fmt: skip
    assert steady_observer(obsynth.adaptive_observer(plant).observer).steps < 3000
