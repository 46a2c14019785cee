"""One table of methods and properties: a method gets these tests by being in the registry."""

from __future__ import annotations

import copy
import io
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pandas as pd
import pytest
from test_dae_c_export import as_run, run_c
from test_export import start_of, through_c

import obsynth
from obsynth.errors import SpecError
from obsynth.exporting.c_window import is_window
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.numerics.arguments import field_types
from obsynth.observers.estimates import Estimates
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.steady_observer import steady_observer

SAMPLES = 24
#: The methods of obsynth, and one that a test registers: it has a folder and one line of the registry, no more.
OWN, ADDED = tuple(REGISTRY), "luenberger-observer"
EACH = pytest.mark.parametrize("method", [*OWN, ADDED])

A = np.array([[0.9, 0.1, 0.0], [-0.2, 0.7, 0.1], [0.0, 0.3, 0.6]])
DISCRETE = obsynth.DescriptorSystem(
    None, A, [[0.0], [1.0], [0.0]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], Bf=[[0.0], [1.0], [0.0]], dt=0.1
)
CONTINUOUS = obsynth.DescriptorSystem(
    None, A - 2.0 * np.eye(3), DISCRETE.B, DISCRETE.C, Bf=DISCRETE.Bf, dt=0.0
)  # fmt: skip
TANK = obsynth.DAEModel(
    {"tank": "area * der(level) = inflow - leak * sqrt(level)"},
    {"gauge": "level"},
    states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.5}, constants={"area": 2.0},
    units={"level": "m", "inflow": "m3/s", "leak": "m2.5/s", "gauge": "m"},
)  # fmt: skip
KNOWN_TANK = obsynth.DAEModel(
    {"tank": "area * der(level) = inflow - leak * sqrt(level)"},
    {"gauge": "level"},
    states={"level": 1.0}, inputs={"inflow": 0.5}, constants={"area": 2.0, "leak": 0.5},
    units={"level": "m", "inflow": "m3/s", "gauge": "m"},
)  # fmt: skip
MEASURED = obsynth.DescriptorSystem(None, [[1.1, 0.1], [0.0, 0.9]], [[0.0], [1.0]], np.eye(2), dt=0.1)
NOISY = CONTINUOUS.replace(Bd=[[0.3], [0.0], [0.1]], Dd=[[0.2], [0.0]], Bw=np.zeros((3, 2)), Dw=0.3 * np.eye(2))
#: Plants in the order in which a method takes the first that it has an observer for.
PLANTS: tuple[Any, ...] = (DISCRETE, CONTINUOUS, TANK, KNOWN_TANK, MEASURED, NOISY)
#: What a method cannot do without.
OPTIONS: dict[str, dict[str, Any]] = {
    "descriptor-kalman": {"Q": 0.01, "R": 0.01},
    "adaptive-observer": {"Q": 0.01, "R": 0.01},
    "dae-adaptive-observer": {"dt": 0.1, "Q": 1e-4, "R": 1e-4},
    "extended-kalman": {"dt": 0.1, "Q": 1e-4, "R": 1e-4},
    "region-observer": {
        "region": {"level": [0.2, 2.0], "leak": [0.3, 0.7]},
        "sample_time": 0.1,
        "noise": {"gauge": 1e-3, "leak": 1e-3},
    },
    "guaranteed-test": {"noise_bound": {"y1": 0.1, "y2": 0.1}, "course": "constant", "samples": 6},
}
#: A number of the shipped observer that nothing but the design says.
CORRUPTED = {
    LinearObserver: "Az", RecursiveObserver: "initial_covariance", DAEObserver: "initial_covariance",
    RegionObserver: "gain",
}  # fmt: skip


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(REGISTRY, ADDED, "luenberger_method:LuenbergerObserver")


@cache
def designed(method: str) -> tuple[Any, obsynth.ObserverDesign]:
    """Return the first plant for which the method's own conditions hold, and its design."""
    for plant in PLANTS:
        try:
            return plant, obsynth.design(plant, method, **OPTIONS.get(method, {}))
        except obsynth.PreconditionError:
            continue
    raise AssertionError(f"{method} has no observer for any plant of the table: add one to PLANTS")


def plant_of(method: str) -> Any:
    return designed(method)[0]


def design_of(method: str) -> obsynth.ObserverDesign:
    return designed(method)[1]


def record_of(design: obsynth.ObserverDesign) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs and inputs that a plant may give: around its nominal values where it has some."""
    rng = np.random.default_rng(7)
    if isinstance(design.observer, (DAEObserver, RegionObserver)):
        return 1.0 + 0.01 * rng.standard_normal((SAMPLES, 1)), np.full((SAMPLES, 1), 0.5)
    return rng.standard_normal((SAMPLES, design.plant.ny)), rng.standard_normal((SAMPLES, design.plant.nu))


def log_of(design: obsynth.ObserverDesign) -> pd.DataFrame:
    y, u = record_of(design)
    dt = design.observer.dt or 0.1
    names = ["time", *design.plant.input_names, *design.plant.output_names]
    return pd.DataFrame(np.hstack([dt * np.arange(SAMPLES)[:, None], u, y]), columns=names)


def stepping(design: obsynth.ObserverDesign) -> Any:
    """Return the observer, sampled where its time is continuous."""
    observer = design.observer
    return obsynth.sample_observer(observer, 0.1) if observer.dt == 0.0 else observer


@pytest.mark.one_in(4)
@EACH
def test_a_design_is_verified_and_survives_its_file(method: str, tmp_path: Path) -> None:
    design = design_of(method)
    assert design.report.passed
    again = obsynth.load(design.save(tmp_path / "gains.json"))
    assert obsynth.verify(again).passed
    # It goes to other processes as it goes to files.
    sent = pickle.loads(pickle.dumps(design)).save(tmp_path / "sent.json")
    assert sent.read_bytes() == (tmp_path / "gains.json").read_bytes()
    here, there = (obsynth.run_on_data(one, log_of(one)).table for one in (design, again))
    pd.testing.assert_frame_equal(here, there, check_exact=True)


WRONG_MODELS = ("zero", "a hundredth too large", "one entry", "other equations", "another shape", "none")


@pytest.mark.one_in(4)
@pytest.mark.parametrize("wrong", WRONG_MODELS)
@EACH
def test_a_wrong_error_model_fails(method: str, wrong: str, monkeypatch: pytest.MonkeyPatch) -> None:
    design, known = design_of(method), method_class(method)
    if not isinstance(design.observer, LinearObserver):
        assert known.error_model(design) is None
        return
    right = known.error_model(design)
    assert right is not None
    i, j = np.unravel_index(np.argmax(np.abs(right.T)), right.T.shape)
    other = right.T.copy()
    other[i, j] *= 1.0 + 1e-4
    added = np.zeros_like(right.goal)
    added[0, 0] = 1.0
    models = {
        "zero": replace(right, T=0.0 * right.T),
        "a hundredth too large": replace(right, T=1.01 * right.T),
        "one entry": replace(right, T=other),
        "other equations": replace(right, T0=added),
        "another shape": replace(right, T=right.T[:, 1:]),
        "none": None,
    }
    monkeypatch.setattr(known, "error_model", classmethod(lambda _, __: models[wrong]))
    assert "error model" in {row.name for row in obsynth.verify(design).failures}


@EACH
def test_a_run_is_its_steps(method: str) -> None:
    design = design_of(method)
    observer, (y, u) = stepping(design), record_of(design)
    whole, state, kept = observer.run(y, u), observer.init(), observer.init()
    for k in range(SAMPLES):
        state, row = observer.step(state, y[k], u[k])
        for name in ("states", "faults", "state_deviations", "fault_covariances"):
            np.testing.assert_allclose(getattr(row, name)[0], getattr(whole, name)[k], rtol=1e-9, atol=1e-12)
    # The first state was not touched: a state is a value.
    np.testing.assert_equal(kept, observer.init())
    assert isinstance(whole, Estimates)


@EACH
def test_a_run_that_was_interrupted_goes_on_as_if_it_was_not(method: str, tmp_path: Path) -> None:
    design = design_of(method)
    log, out = log_of(design), io.StringIO()
    obsynth.run_on_data(design, io.StringIO(log.to_csv(index=False)), out)
    parts = []
    for rows in (slice(0, 11), slice(11, None)):
        part = io.StringIO()
        text = io.StringIO(log.iloc[rows].to_csv(index=False))
        obsynth.run_on_data(design, text, part, state=tmp_path / "state.json")
        parts.append(part.getvalue().splitlines())
    assert [*parts[0], *parts[1][1:]] == out.getvalue().splitlines()


@pytest.mark.one_in(4)
@EACH
def test_what_is_given_is_not_changed(method: str) -> None:
    plant, options = plant_of(method), OPTIONS.get(method, {})
    asked = copy.deepcopy(options)
    before = {key: repr(value) for key, value in plant.as_dict().items()}
    design = obsynth.design(plant, method, **asked)
    assert {key: repr(value) for key, value in plant.as_dict().items()} == before
    assert asked == options
    y, u = record_of(design)
    log, again = log_of(design), log_of(design)
    outputs, inputs = y.copy(), u.copy()
    stepping(design).run(outputs, inputs)
    obsynth.run_on_data(design, log)
    np.testing.assert_array_equal(outputs, y)
    np.testing.assert_array_equal(inputs, u)
    pd.testing.assert_frame_equal(log, again, check_exact=True)


#: The tank with its level in mm, its flow in l/s and its equation in l/s.
SMALL_UNITS = obsynth.DAEModel(
    {"tank": "1000 * area * der(level / 1000) = inflow - 1000 * leak * sqrt(level / 1000)"},
    {"gauge": "level"},
    states={"level": 1000.0}, inputs={"inflow": 500.0}, parameters={"leak": 0.5}, constants={"area": 2.0},
    units={"level": "mm", "inflow": "l/s", "leak": "m2.5/s", "gauge": "mm"},
)  # fmt: skip


KNOWN_IN_SMALL_UNITS = SMALL_UNITS.replace(parameters={}, constants={"area": 2.0, "leak": 0.5}, units={})


def in_other_units(method: str) -> tuple[Any, dict[str, Any]]:
    """Return the method's plant with outputs, equations and states in other units; noise and starts follow them."""
    plant, options = plant_of(method), dict(OPTIONS.get(method, {}))
    if method == "region-observer":
        small = {"region": {"level": [200, 2000], "leak": [0.3, 0.7]}, "noise": {"gauge": 1.0, "leak": 1e-3}}
        return SMALL_UNITS, {**options, **small}
    if isinstance(plant, obsynth.DAEModel):
        changed = SMALL_UNITS if plant.nq else KNOWN_IN_SMALL_UNITS
        return changed, {**options, "Q": 1e6 * options["Q"], "R": 1e6 * options["R"]}
    rng = np.random.default_rng(3)
    rows, states = (np.diag(10.0 ** rng.uniform(-4, 4, plant.nx)) for _ in range(2))
    outputs = np.diag(10.0 ** rng.uniform(-4, 4, plant.ny))
    changed = plant.replace(
        E=rows @ plant.E @ states, A=rows @ plant.A @ states, B=rows @ plant.B, Bf=rows @ plant.Bf,
        C=outputs @ plant.C @ states,
    )  # fmt: skip
    if "Q" in options:
        options |= {"Q": 0.01 * rows @ rows.T, "R": 0.01 * outputs @ outputs.T}
        options["initial_covariance"] = np.linalg.inv(states) @ np.linalg.inv(states).T
    return changed, options


@pytest.mark.one_in(4)
@EACH
def test_units_do_not_change_the_verdict(method: str, tmp_path: Path) -> None:
    changed, options = in_other_units(method)
    design = obsynth.design(changed, method, **options)
    assert design.report.passed
    assert obsynth.verify(obsynth.load(design.save(tmp_path / "gains.json"))).passed


@pytest.mark.one_in(4)
@EACH
def test_a_corrupted_design_fails(method: str) -> None:
    design = design_of(method)
    observer = design.observer
    field = next(name for kind, name in CORRUPTED.items() if isinstance(observer, kind))
    changed = replace(observer, **{field: 1.5 * getattr(observer, field)})
    assert not obsynth.verify(design.replace(observer=changed)).passed


@pytest.mark.one_in(4)
@EACH
def test_a_claim_that_the_method_does_not_know_fails(method: str) -> None:
    design = design_of(method)
    claims = {**design.certificate.claims, "perfection": 1.0}
    assert "perfection" not in method_class(method).claims
    assert not obsynth.verify(design.replace(certificate=replace(design.certificate, claims=claims))).passed


#: What a changed file may hold in place of an option.
ODD_OPTIONS = (None, -1, 2.5, True, "x", "x1", [1.0], {}, {"x1": [0.0, 1.0]}, {"units": {}}, float("nan"))


@pytest.mark.one_in(4)
@EACH
def test_an_option_of_another_kind_in_a_file_is_a_row_that_fails_or_an_error_of_ours(
    method: str, share: Callable[..., Any]
) -> None:
    design = design_of(method)
    changes = [(name, value) for name in design.options for value in ODD_OPTIONS]
    judged = 0
    for name, value in share(changes, 15):
        changed = design.replace(options={**design.options, name: value})
        try:
            judged += bool(obsynth.verify(changed).checks)
        except obsynth.ObsynthError:
            judged += 1
    assert judged == len(share(changes, 15))


@pytest.mark.one_in(2)
@EACH
def test_c_says_what_python_says(method: str, tmp_path: Path) -> None:
    """The exported source, compiled with warnings as errors; a recursive design as its steady state."""
    design = design_of(method)
    y, u = record_of(design)
    if isinstance(design.observer, DAEObserver):
        said, run = run_c(design, y, u, tmp_path), as_run(design).run(y, u)
        for name in ("states", "parameters", "state_deviations", "parameter_deviations"):
            np.testing.assert_allclose(said[name], getattr(run, name), rtol=1e-9, atol=1e-12)
        return
    if isinstance(design.observer, RegionObserver):
        with pytest.raises(SpecError, match="not written as files yet"):
            obsynth.export(design, tmp_path / "observer.c")
        return
    if is_window(design):
        # A dot product with a threshold of its own: test_guaranteed_c.
        return
    sampling = {"sample_time": 0.1} if design.observer.dt == 0.0 else {}
    source, _ = obsynth.export(design, tmp_path / "observer.c", **sampling)
    observer = stepping(design)
    start = start_of(design.observer, 0.1, np.concatenate([u[0], y[0]])) if sampling else None
    if isinstance(observer, RecursiveObserver):
        steady = steady_observer(observer)
        observer, start = steady.observer, steady.start
    run = observer.run(y, u, initial_state=start)
    wanted = np.hstack([run.states, run.faults, run.residuals])
    np.testing.assert_allclose(through_c(observer, source, np.hstack([u, y])), wanted, rtol=1e-9, atol=1e-10)


WITHOUT_SOLVERS = """
import sys
for name in ("cvxpy", "clarabel", "scs", "slycot"):
    sys.modules[name] = None
import obsynth
for gains, log in zip(sys.argv[1::2], sys.argv[2::2]):
    design = obsynth.load(gains)
    print(obsynth.verify(design).passed, obsynth.run_on_data(design, log).rows)
"""


@pytest.mark.long
def test_verify_and_run_need_no_solver(tmp_path: Path) -> None:
    """In a process in which no solver can be imported."""
    arguments: list[str] = []
    for method in OWN:
        design, log = design_of(method), tmp_path / f"{method}.csv"
        log_of(design).to_csv(log, index=False)
        arguments += [str(design.save(tmp_path / f"{method}.json")), str(log)]
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_SOLVERS, *arguments], capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(Path(obsynth.__file__).parents[1])},
    )  # fmt: skip
    assert done.stdout.splitlines() == [f"True {SAMPLES}"] * len(OWN), done.stderr


@EACH
def test_a_record_is_smoothed_or_the_reason_is_said(method: str) -> None:
    """A method gets this by stating deviations; its last sample has nothing after it."""
    design = design_of(method)
    y, u = record_of(design)
    if isinstance(design.observer, (LinearObserver, RegionObserver)):
        with pytest.raises(obsynth.SpecError, match="covariances"):
            obsynth.smooth(design, y, u)
        with pytest.raises(obsynth.SpecError, match="covariances"):
            obsynth.run_on_data(design, log_of(design), smooth=True)
        return
    found, filtered = obsynth.smooth(design, y, u), design.observer.run(y, u)
    np.testing.assert_allclose(found.states[-1], filtered.states[-1], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.state_deviations[-1], filtered.state_deviations[-1], rtol=1e-9)
    assert np.mean(found.state_deviations) < np.mean(filtered.state_deviations)
    table = obsynth.run_on_data(design, log_of(design), lag=SAMPLES, outliers="none").table
    np.testing.assert_allclose(
        table[[f"xhat[{name}]" for name in found.state_names]], found.states, rtol=1e-9, atol=1e-12
    )


@pytest.mark.one_in(4)
@EACH
def test_sensors_of_their_own_times_are_taken_or_refused_by_name(method: str, tmp_path: Path) -> None:
    plant, options = plant_of(method), OPTIONS.get(method, {})
    name = plant.output_names[0]
    sensors = {name: {"every": 3, "delay": 2}}
    if isinstance(design_of(method).observer, (LinearObserver, RegionObserver)):
        with pytest.raises(obsynth.SpecError, match="sensors"):
            obsynth.design(plant, method, sensors=sensors, **options)
        return
    design = obsynth.design(plant, method, sensors=sensors, **options)
    again = obsynth.load(design.save(tmp_path / "gains.json"))
    assert obsynth.verify(again).passed
    y, u = record_of(design)
    due = again.observer.timing.expected
    silent = np.array([[value if due(k)[i] else np.nan for i, value in enumerate(row)] for k, row in enumerate(y)])
    # What is not due is not used.
    np.testing.assert_array_equal(again.observer.run(y, u).states, again.observer.run(silent, u).states)


NO_NUMBERS = (True, np.True_, [True], {"leak": True}, object())


@pytest.mark.one_in(4)
@EACH
def test_no_option_takes_what_is_no_number_for_one(method: str) -> None:
    """True is not 1.0: every option that is no truth itself refuses it, in Python and in lists."""
    for name, kind in field_types(method_class(method)).items():
        # A solver's own settings may be truths: they are the solver's.
        if bool in (kind, *get_args(kind)) or name == "solver_options":
            continue
        for value in NO_NUMBERS:
            with pytest.raises(SpecError):
                obsynth.design(plant_of(method), method, **{**OPTIONS.get(method, {}), name: value})
