"""Observers of nonlinear plants over a region: what is proved against trajectories; corrupted designs; files, logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from tests.support.corruptions import with_claims, with_matrices, with_observer

import obsynth
from obsynth import DAEModel, ObserverDesign, PreconditionError, SolverError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.nonlinear.region_observer import RegionObserver

#: The region of the two tanks, and their noise.
REGION = {"h2": [0.1, 0.6], "h1 - h2": [0.02, 0.55]}
NOISE = {"l1": 1e-3, "l2": 1e-3, "leak": 1e-4}
STEP = 2.0


def tanks(**changes: Any) -> DAEModel:
    """Return two tanks with a leak, whose outflow is an algebraic state."""
    given: dict[str, Any] = {
        "equations": {
            "first": "2.0 * der(h1) = q - between - leak",
            "second": "2.0 * der(h2) = between - out",
            "valve": "out = 0.1 * sqrt(h2)",
        },
        "outputs": {"l1": "h1", "l2": "h2"},
        "definitions": {"between": "0.1 * (h1 - h2) / sqrt(abs(h1 - h2) + eps)"},
        "states": {"h1": 0.5, "h2": 0.3, "out": 0.05}, "inputs": {"q": 0.05}, "parameters": {"leak": 0.0},
        "constants": {"eps": 0.01},
    }  # fmt: skip
    return DAEModel(**{**given, **changes})


@pytest.fixture(scope="module")
def design() -> ObserverDesign:
    return obsynth.region_observer(tanks(), region=REGION, sample_time=STEP, noise=NOISE)


def _simulated(samples: int, *, leak: float = 0.0, walk: float = 0.0, seed: int = 0) -> tuple[FloatArray, ...]:
    """Return outputs, inputs, and states with the leak, of the plant in steps of implicit Euler."""
    rng = np.random.default_rng(seed)
    u = (0.055 + 0.008 * np.sin(np.arange(samples) / 40.0))[:, None]
    path = (leak + np.cumsum(walk * np.sqrt(STEP) * rng.standard_normal(samples)))[:, None]
    start = [0.6, 0.35, 0.06]
    found = obsynth.simulate_dae(
        tanks(), u, dt=STEP, parameters=path, initial_state=start, integration="backward-euler"
    )
    return found.outputs, u, np.hstack([found.states, path])


def _lyapunov(design: ObserverDesign, errors: FloatArray) -> FloatArray:
    """Return the squared norms of errors ``(samples, h1 h2 out leak)`` in the certificate's matrix."""
    P = design.certificate.matrices["P_region"][0]
    ordered = errors[:, [0, 1, 3, 2]]
    return np.einsum("ki,ij,kj->k", ordered, P, ordered)


@pytest.mark.long
def test_what_is_proved_is_said_in_words(design: ObserverDesign) -> None:
    assert design.report.passed
    claim = design.report["mean square over the region"].claim
    assert "h2 in [0.1, 0.6], h1 - h2 in [0.02, 0.55], for every trajectory there" in claim
    assert "exactly one solution for out" in design.report["index 1 over the region"].claim
    assert "errors decay by" in str(design)
    # Simulated apart, a van der Pol oscillator had twice the claimed deviation in steps that were too long for it.
    assert "what a step of implicit Euler misses of it is not counted" in claim
    assert "rows that are close beside its motion" in " ".join(str(design).split())


@pytest.mark.long
def test_errors_shrink_in_every_step_as_is_proved(design: ObserverDesign) -> None:
    rate = design.certificate.claims["region_decay"]
    model, observer = design.over_region
    rng, factor = np.random.default_rng(1), 1.0 + 2.0 * rate * STEP
    worst = 0.0
    for seed in range(4):
        y, u, x = _simulated(60, leak=0.002, seed=seed)
        # The estimate may start anywhere, also far outside.
        start = np.array([0.5, 0.3, 0.0, 0.05]) + rng.standard_normal(4) * [1.0, 1.0, 0.05, 1.0]
        found = replace(observer, initial_state=start).run(y, u)
        errors = np.hstack([found.states, found.faults]) - x
        V = _lyapunov(design, errors)
        shrinks = V[1:] / V[:-1]
        worst = max(worst, float(shrinks.max()))
        assert V[1] > 0.0
    assert worst <= (1.0 + 1e-6) / factor
    assert model.nx == 3


@pytest.mark.long
def test_estimates_deviate_by_less_than_is_proved(design: ObserverDesign) -> None:
    level = design.certificate.claims["region_deviation"]
    squares = []
    for seed in range(3):
        y, u, x = _simulated(900, walk=NOISE["leak"], seed=seed)
        assert (x[:, 1] > 0.1).all()
        noisy = y + 1e-3 * np.random.default_rng(seed + 50).standard_normal(y.shape)
        found = design.over_region[1].run(noisy, u)
        squares.append(np.mean((found.faults[100:, 0] - x[100:, 3]) ** 2))
    reached = np.sqrt(np.mean(squares))
    assert 0.4 * level < reached <= level
    assert design.report["worst corner at rest"].value > 0.85 * level


@pytest.mark.long
def test_the_gain_is_not_exceeded() -> None:
    made = obsynth.region_observer(tanks(), region=REGION, sample_time=STEP, noise=NOISE, goal="gain")
    level, observer = made.certificate.claims["region_gain"], made.over_region[1]
    y, u, x = _simulated(400)
    rng = np.random.default_rng(0)
    observer = replace(observer, initial_state=x[0][[0, 1, 3, 2]])
    for slow in (1, 20, 100):
        # Noise of unit size per root of a second: a sample of w stands for sqrt(STEP) times its deviation.
        w = np.repeat(rng.standard_normal((400 // slow + 1, 2)), slow, axis=0)[:400]
        found = observer.run(y + 1e-3 * np.sqrt(STEP) * w, u)
        clean = observer.run(y, u)
        assert np.linalg.norm(found.faults - clean.faults) <= level * np.linalg.norm(w) * 1.05


@pytest.mark.long
def test_decay_alone_and_given_gains(design: ObserverDesign) -> None:
    fast = obsynth.region_observer(tanks(), region=REGION, sample_time=STEP, goal="decay")
    assert set(fast.certificate.claims) == {"region_decay"}
    assert fast.certificate.claims["region_decay"] > 3.0 * design.certificate.claims["region_decay"]
    again = obsynth.region_observer(tanks(), region=REGION, sample_time=STEP, noise=NOISE, gains=design.gains["L"])
    claims = again.certificate.claims
    assert claims["region_deviation"] <= design.certificate.claims["region_deviation"] * 1.0001
    assert np.array_equal(again.gains["L"], design.gains["L"])
    asked = obsynth.region_observer(
        tanks(), region=REGION, sample_time=STEP, noise=NOISE, decay=2.0 * design.certificate.claims["region_decay"]
    )
    assert asked.certificate.claims["region_decay"] >= 2.0 * design.certificate.claims["region_decay"]
    assert asked.certificate.claims["region_deviation"] > design.certificate.claims["region_deviation"]
    with pytest.raises(SolverError):
        obsynth.region_observer(
            tanks(), region=REGION, sample_time=STEP, noise=NOISE, gains=-np.asarray(design.gains["L"])
        )


def test_a_plant_without_nonlinearities_is_the_kalman_filter() -> None:
    from scipy.linalg import solve_continuous_are

    linear = DAEModel(
        {"x": "der(x) = v", "v": "der(v) = -2.0 * x - 0.3 * v + f"}, {"y": "x"}, states={"x": 0.0, "v": 0.0},
        inputs={}, parameters={"f": 0.0},
    )  # fmt: skip
    made = obsynth.region_observer(linear, region={"x": [-1, 1]}, sample_time=0.01, noise={"y": 0.1, "f": 0.5})
    A, C = np.array([[0, 1, 0], [-2, -0.3, 1], [0, 0, 0.0]]), np.array([[1.0, 0, 0]])
    X = solve_continuous_are(A.T, C.T, np.diag([0, 0, 0.25]), [[0.1**2 * 0.01]])
    assert made.certificate.claims["region_deviation"] == pytest.approx(np.sqrt(X[2, 2]), rel=0.03)
    assert made.certificate.claims["region_deviation"] >= np.sqrt(X[2, 2])


@pytest.mark.long
def test_a_flexible_joint_has_no_limit_of_its_slope_and_units_do_not_matter() -> None:
    # Raghavan, Hedrick: a Lipschitz condition passes or fails by the units of the fourth state.
    made = []
    for unit in (1.0, 10.0):
        joint = DAEModel(
            {
                "a": "der(x1) = x2", "b": "der(x2) = -48.6 * x1 - 1.25 * x2 + 48.6 * x3", "c": f"der(x3) = {unit} * x4",
                "d": f"der(x4) = (19.5 * x1 - 19.5 * x3 - 3.33 * sin(x3) + f) / {unit}",
            },
            {"p": "x1", "s": "x2"}, states={"x1": 0.0, "x2": 0.0, "x3": 0.0, "x4": 0.0}, inputs={},
            parameters={"f": 0.0},
        )  # fmt: skip
        made.append(
            obsynth.region_observer(
                joint, region={"x3": [-3.2, 3.2]}, sample_time=0.001, noise={"p": 0.01, "s": 0.1, "f": 1.0},
                wanted={"f": 1.0},
            )
        )  # fmt: skip
        assert made[-1].report.passed
    levels = [each.certificate.claims["region_deviation"] for each in made]
    assert levels[0] == pytest.approx(levels[1], rel=0.02)


def _scaled(design: ObserverDesign, name: str, factor: float) -> float:
    return factor * design.certificate.claims[name]


_CORRUPTIONS: dict[str, tuple[Callable[[ObserverDesign], ObserverDesign], str]] = {
    "wider region": (
        lambda d: with_observer(d, region={"h2": [0.05, 0.6], "h1 - h2": [0.02, 0.55]}), "slopes over the region",
    ),
    "narrower slopes": (lambda d: with_observer(d, slopes=0.999 * d.over_region[1].slopes), "slopes over the region"),
    "wider slopes": (
        lambda d: with_observer(d, slopes=d.over_region[1].slopes + np.array([[-0.5, 0.5]])), "decay over the region",
    ),
    "changed gain": (lambda d: with_observer(d, gain=2.0 * d.over_region[1].gain), "mean square over the region"),
    "no gain": (lambda d: with_observer(d, gain=0.0 * d.over_region[1].gain), "decay over the region"),
    "smaller deviation": (
        lambda d: with_claims(d, region_deviation=_scaled(d, "region_deviation", 0.9)), "mean square over the region",
    ),
    "no number": (lambda d: with_claims(d, region_deviation=float("nan")), "mean square over the region"),
    "faster decay": (lambda d: with_claims(d, region_decay=_scaled(d, "region_decay", 1.2)), "decay over the region"),
    "asymmetric P": (
        lambda d: with_matrices(d, P_region=d.certificate.matrices["P_region"] + 1e-9 * np.eye(4, k=1)),
        "decay over the region",
    ),
    "G of another structure": (
        lambda d: with_matrices(d, G_gain=d.certificate.matrices["G_gain"] + np.eye(4, k=3)),
        "mean square over the region",
    ),
    "algebraic part of G": (
        lambda d: with_matrices(d, G_region=d.certificate.matrices["G_region"] * np.diag([1, 1, 1, -1.0])
                            + d.certificate.matrices["G_region"] * (1 - np.eye(4))),
        "index 1 over the region",
    ),
    "P of other order": (lambda d: with_matrices(d, P_region=np.eye(3)[None]), "decay over the region"),
    "less noise": (
        lambda d: d.replace(options={**d.options, "noise": {**NOISE, "leak": 2e-4}}), "mean square over the region",
    ),
    "noise of nobody": (lambda d: d.replace(options={**d.options, "noise": {"l1": 1.0}}), "options"),
    "other wanted": (
        lambda d: d.replace(options={**d.options, "wanted": {"leak": 0.5}}), "mean square over the region",
    ),
    "too few rows out": (lambda d: with_observer(d, forgetting=3), "rows without a claim"),
    "another plant": (lambda d: d.replace(plant=tanks(constants={"eps": 0.02})), "fits the plant"),
    "longer samples": (lambda d: with_observer(d, dt=20.0), "mean square over the region"),
}  # fmt: skip


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", _CORRUPTIONS)
def test_corrupted_designs_are_refused(name: str, design: ObserverDesign) -> None:
    corrupt, row = _CORRUPTIONS[name]
    report = obsynth.verify(corrupt(design))
    assert not report.passed
    assert not report[row].passed


def test_a_gain_set_is_the_design_again(design: ObserverDesign, tmp_path: Path) -> None:
    again = obsynth.load(design.save(tmp_path / "tanks.gains.json"))
    assert obsynth.verify(again).passed
    y, u, _ = _simulated(20)
    assert np.array_equal(again.over_region[1].run(y, u).faults, design.over_region[1].run(y, u).faults)
    assert isinstance(again.observer, RegionObserver)


def _log(samples: int = 400) -> pd.DataFrame:
    y, u, x = _simulated(samples, leak=0.003)
    columns = {"time": STEP * np.arange(samples), "q": u[:, 0], "l1": y[:, 0], "l2": y[:, 1], "truth": x[:, 3]}
    return pd.DataFrame(columns)


def test_rows_outside_the_region_are_out(design: ObserverDesign, tmp_path: Path) -> None:
    log, left = _log(), design.over_region[1].forgetting
    log.loc[250, "l2"] = 0.7
    log.loc[300, "l1"] = np.nan
    obsynth.run_on_data(design, log.drop(columns="truth"), out=tmp_path / "out.csv")
    found = pd.read_csv(tmp_path / "out.csv")
    assert (found.status[250 : 250 + left] == "out").all()
    assert found.status[249] == "ok"
    assert found.status[300] == "gap"
    assert np.isnan(found["fhat[leak]"][300])
    good = found.status == "ok"
    assert good.sum() > 50
    assert np.abs(found["fhat[leak]"] - log.truth)[good].max() < 1e-4


def test_a_stopped_run_goes_on(design: ObserverDesign, tmp_path: Path) -> None:
    log = _log(80).drop(columns="truth")
    obsynth.run_on_data(design, log, out=tmp_path / "whole.csv")
    obsynth.run_on_data(design, log[:33], out=tmp_path / "first.csv", state=tmp_path / "state.json")
    obsynth.run_on_data(design, log[33:], out=tmp_path / "second.csv", state=tmp_path / "state.json")
    parts = pd.concat([pd.read_csv(tmp_path / name) for name in ("first.csv", "second.csv")], ignore_index=True)
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "whole.csv"), parts, check_exact=True)


def test_steps_are_those_of_a_run(design: ObserverDesign) -> None:
    observer, (y, u, _) = design.over_region[1], _simulated(15)
    found, state = observer.run(y, u), observer.init()
    for k in range(len(y)):
        state, estimates = observer.step(state, y[k], u[k])
        assert np.array_equal(estimates.faults[0], found.faults[k])
    with pytest.raises(SpecError):
        observer.step(state, [np.nan, 0.3], [0.05])


@pytest.mark.parametrize(
    ("changes", "region", "error", "told"),
    [
        ({}, {"h2": [0.1, 0.6]}, PreconditionError, "no range of 'h1'"),
        ({}, {"h2": [0.0, 0.6], "h1 - h2": [0, 1]}, PreconditionError, "slope of 'sqrt"),
        ({}, {"h2": [0.6, 0.1], "h1 - h2": [0, 1]}, SpecError, "lower one first"),
        ({}, {"h2": [0.1, np.inf], "h1 - h2": [0, 1]}, SpecError, "both finite"),
        ({}, {"h3": [0.1, 0.6]}, SpecError, "'h3'"),
        ({}, {"h1 * h2": [0.1, 0.6]}, SpecError, "no linear combination"),
        ({"definitions": {"between": "where(h1 > h2, h1 - h2, 0)"}}, REGION, PreconditionError, "chooses between"),
        (
            {"equations": {"first": "h1 * der(h1) = q - leak", "second": "der(h2) = h1 - out", "valve": "out = h2"}},
            {"h1": [0.1, 1]}, PreconditionError, "E would change",
        ),
        (
            {"equations": {"first": "der(h1 ** 2) = q - leak", "second": "der(h2) = h1 - out", "valve": "out = h2"}},
            {"h1": [0.1, 1]}, PreconditionError, "E would change",
        ),
        (
            {"equations": {"first": "der(h1 - h2) = q - leak", "second": "2 * der(h1) - 2 * der(h2) = h1 - out",
                           "valve": "out = h2 * h1"}},
            {"h1": [0.1, 1], "h2": [0.1, 1]}, PreconditionError, "are dependent",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_proved_is_refused_by_name(
    changes: dict[str, Any], region: dict[str, Any], error: type[Exception], told: str
) -> None:
    definitions = {} if "equations" in changes else tanks().definitions
    model = tanks(**{"definitions": dict(definitions), **changes})
    with pytest.raises(error, match=told):
        obsynth.region_observer(model, region=region, sample_time=STEP, noise=NOISE)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"region": REGION, "sample_time": STEP}, "noise is missing"),
        ({"region": REGION, "noise": NOISE}, "sample_time is missing"),
        ({"sample_time": STEP, "noise": NOISE}, "region is missing"),
        ({"region": REGION, "sample_time": STEP, "noise": {"l1": 1e-3, "l2": 1e-3}}, "says nothing of 'leak'"),
        ({"region": REGION, "sample_time": STEP, "noise": {**NOISE, "l3": 1.0}}, "noise names 'l3'"),
        ({"region": REGION, "sample_time": STEP, "noise": {**NOISE, "l1": -1.0}}, "positive number"),
        ({"region": REGION, "sample_time": STEP, "noise": NOISE, "wanted": {"out": 1.0}}, "wanted names 'out'"),
        ({"region": REGION, "sample_time": STEP, "noise": NOISE, "faults": ["eps"]}, "no signal named 'eps'"),
        ({"region": REGION, "sample_time": STEP, "noise": NOISE, "gains": [[1.0]]}, r"give \(3, 2\)"),
    ],
)
def test_options_that_do_not_fit_are_refused(options: dict[str, Any], told: str) -> None:
    with pytest.raises(SpecError, match=told):
        obsynth.region_observer(tanks(), **options)


def test_python_functions_are_refused() -> None:
    model = DAEModel(
        lambda rates, x, u, theta: [rates[0] + x[0] ** 3 - u[0]], lambda x, theta: [x[0]],
        states={"x": 1.0}, inputs={"u": 1.0}, parameters={}, output_names=["y"],
    )  # fmt: skip
    with pytest.raises(SpecError, match="Write them as texts"):
        obsynth.region_observer(model, region={"x": [0, 1]}, sample_time=0.1, noise={"y": 0.1})


def test_what_such_designs_do_not_have_is_refused_by_name(design: ObserverDesign, tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="not written as files yet"):
        obsynth.export(design, tmp_path / "tanks.c")
    with pytest.raises(SpecError, match="no scheduling parameters"):
        obsynth.simulate(design, obsynth.Scenario(horizon=10.0, scheduling={"h1": obsynth.Step(size=0.1)}))


def test_a_growing_mode_that_no_output_shows_is_named() -> None:
    model = DAEModel(
        {"seen": "der(x) = -x + u + fault", "hidden": "der(z) = z + 0.1 * sin(z)"}, {"y": "x"},
        states={"x": 1.0, "z": 0.0}, inputs={"u": 0.0}, parameters={"fault": 0.0},
    )  # fmt: skip
    with pytest.raises(PreconditionError, match="of z is shown by no output and does not decay"):
        obsynth.region_observer(model, region={"z": [-0.5, 1.0]}, sample_time=0.1, noise={"y": 0.1, "fault": 0.1})


@pytest.mark.long
def test_a_step_is_found_where_newton_alone_goes_round_in_circles() -> None:
    model = DAEModel(
        {
            "e1": "0.5 * der(x1) + 0.3 * der(x2) = -0.88 * x1 - 0.357 * x2 - 0.209 * x3 + 0.65 * bend + 0.2 * w1"
                  " - 0.16 * w2",
            "e2": "0.5 * der(x2) = -0.369 * x1 - 1.338 * x2 - 0.039 * x3 + 0.79 * bend - 0.04 * w1 + 0.19 * w2",
            "e3": "0.5 * der(x3) = 0.523 * x1 - 1.293 * x2 - 0.641 * x3 + 0.55 * bend + 0.09 * w1 - 0.19 * w2",
            "a1": "w1 = -0.39 * bend - 0.07 * x3 - 0.75 * x1",
            "a2": "w2 = -0.53 * (0.8 * x3 - 0.57 * x2) ** 2 - 0.95 * x1 + 0.61 * x2 + 0.3 * sin(w2) + 0.2 * w1",
        },
        {"y1": "x1", "y2": "-0.57 * x3 - 0.37 * x2", "y3": "-0.32 * x2 - 0.13 * x3"},
        definitions={"bend": "log(0.11 * x3 - 0.03 * x2 + 9) * sin(-0.29 * x1 + 0.58)"},
        states=dict.fromkeys(["x1", "x2", "x3", "w1", "w2"], 0.0), inputs={}, parameters={},
    )  # fmt: skip
    made = obsynth.region_observer(
        model, region={"x1": [-1.46, 0.84], "x2": [-0.62, 1.66], "x3": [-1.47, 1.22], "w2": [-4, 4]}, sample_time=5.0,
        noise={"y1": 0.02, "y2": 0.02, "y3": 0.02, "der(x1)": 0.1, "der(x2)": 0.1, "der(x3)": 0.1}, goal="gain",
    )  # fmt: skip
    observer = made.over_region[1]
    rng = np.random.default_rng(11)
    y = 0.1 * rng.standard_normal((4, 3))
    ends = [
        replace(observer, initial_state=far * rng.standard_normal(5)).run(np.tile(y[:1], (40, 1))).states[-1]
        for far in (0.0, 1.0, 30.0, 1000.0)
    ]
    # One solution: from everywhere to the same rest, where equations and gain are in balance.
    for end in ends[1:]:
        assert end == pytest.approx(ends[0], abs=1e-9)


@pytest.mark.long
def test_slow_plants_have_a_decay_too() -> None:
    # A store of 1e9 units: its rates are 1e-10 of those of a plant in seconds.
    store = DAEModel(
        {"balance": "1e9 * der(p) = q - 1e3 * sqrt(p) - leak"}, {"y": "p"}, states={"p": 1e6}, inputs={"q": 1e6},
        parameters={"leak": 0.0},
    )  # fmt: skip
    made = obsynth.region_observer(store, region={"p": [1e5, 1e7]}, sample_time=10.0, noise={"y": 1e2, "leak": 1e3})
    assert 1e-8 < made.certificate.claims["region_decay"] < 1e-4
    assert made.report.passed


@pytest.mark.long
def test_rates_alone_do_not_run_away_where_noise_is_stated() -> None:
    model = DAEModel(
        {"a": "der(x) = -x + 0.5 * sin(z)", "b": "der(z) = -z + 0.3 * tanh(x)"}, {"y1": "x", "y2": "z"},
        states={"x": 0.0, "z": 0.0}, inputs={}, parameters={},
    )  # fmt: skip
    region = {"x": [-1, 1], "z": [-1, 1]}
    for noise in (None, {"y1": 0.01, "y2": 0.01, "der(x)": 0.1, "der(z)": 0.1}):
        made = obsynth.region_observer(model, region=region, sample_time=0.05, goal="decay", noise=noise)
        assert np.abs(made.gains["L"]).max() < 1e4


def test_the_fastest_decay_says_what_noise_does_to_it() -> None:
    """A step of implicit Euler, by hand: the slope of x^3 over [-1, 1] is between 0 and 3."""
    model = DAEModel({"a": "der(x) = -x - x ** 3"}, {"y": "x"}, states={"x": 0.0}, inputs={}, parameters={})
    made = obsynth.region_observer(model, region={"x": [-1, 1]}, sample_time=0.5, goal="decay")
    gain = float(made.gains["L"].item())
    moved = 0.5 * gain / (1.0 + 0.5 * (1.0 + 1.5 + gain))
    assert f"a deviation of 1 in y moves the estimate of x by {moved:.3g} within a sample" in made.notes[-1]
    given = obsynth.region_observer(model, region={"x": [-1, 1]}, sample_time=0.5, goal="decay", gains=[[3.0]])
    assert not any("within a sample" in note for note in given.notes)


def test_what_depends_on_known_inputs_alone_needs_no_range() -> None:
    model = DAEModel(
        {"a": "der(x) = -x + 0.2 * x ** 3 + sign(u) * sqrt(abs(u))"}, {"y": "x"}, states={"x": 0.0}, inputs={"u": 0.0},
        parameters={},
    )  # fmt: skip
    made = obsynth.region_observer(model, region={"x": [-1, 1]}, sample_time=0.1, goal="decay")
    assert made.report.passed
    found = made.over_region[1].run(np.full((200, 1), 0.5), np.full((200, 1), 0.475**2))
    assert found.states[-1, 0] == pytest.approx(0.5, abs=1e-9)


def test_a_model_in_which_nothing_moves_and_an_output_among_the_ranges_are_refused_by_name() -> None:
    static = DAEModel({"a": "x = 1 + 0.1 * sin(x)"}, {"y": "x"}, states={"x": 1.0}, inputs={}, parameters={})
    with pytest.raises(PreconditionError, match="no state moves and no parameter is a fault"):
        obsynth.region_observer(static, region={"x": [-2, 2]}, sample_time=0.1, goal="decay")
    with pytest.raises(SpecError, match="names 'l1'; there are: h1, h2, leak, out, q"):
        obsynth.region_observer(tanks(), region={"l1": [0.1, 1]}, sample_time=STEP, noise=NOISE)


def test_readings_of_any_size_end_no_run(design: ObserverDesign, tmp_path: Path) -> None:
    log, left = _log(), design.over_region[1].forgetting
    log.loc[150, "l1"], log.loc[151, "l1"], log.loc[250, "q"] = 1e9, -1e9, 1e12
    obsynth.run_on_data(design, log.drop(columns="truth"), out=tmp_path / "out.csv")
    found = pd.read_csv(tmp_path / "out.csv")
    assert (found.status[150 : 151 + left] == "out").all()
    good = found.status[300:] == "ok"
    assert good.sum() > 50
    assert np.abs(found["fhat[leak]"] - log.truth)[300:][good].max() < 1e-3


def test_an_input_that_is_none_of_the_equations_is_out() -> None:
    model = DAEModel(
        {"a": "der(x) = -x + 0.2 * x ** 3 + sqrt(u)"}, {"y": "x"}, states={"x": 0.0}, inputs={"u": 0.0}, parameters={},
    )  # fmt: skip
    observer = obsynth.region_observer(model, region={"x": [-1, 1]}, sample_time=0.1, goal="decay").over_region[1]
    u = np.full((60, 1), 0.04)
    u[20] = -1.0
    rows, claimed = observer.record(np.full((60, 1), 0.2), u)
    assert claimed[:20].all()
    assert not claimed[20]
    assert np.isfinite(rows[:20]).all()
    assert np.isfinite(rows[21:]).all()
    assert claimed[-1]
