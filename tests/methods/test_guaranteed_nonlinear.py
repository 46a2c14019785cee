"""Guaranteed tests of nonlinear plants: what the linear model leaves out in a region is bounded and proved again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML
from scipy.integrate import solve_ivp

import obsynth
from obsynth.cli.main import main
from obsynth.plants.transformations.remainders import bounded_model

AREA, C, H, V = 2.0, 0.5, 0.5, 0.002
EQUATIONS = {"balance": "area * der(level) = inflow + rain - outflow - leak", "valve": "outflow = c * sqrt(level)"}
FIELDS: dict[str, Any] = {
    "states": {"level": 4.0, "outflow": 1.0}, "inputs": {"inflow": 1.0, "rain": 0.0}, "parameters": {"leak": 0.0},
    "constants": {"area": AREA, "c": C},
    "units": {"level": "m", "outflow": "m3/s", "inflow": "m3/s", "rain": "m3/s", "leak": "m3/s", "gauge": "m"},
}  # fmt: skip
TANK = obsynth.DAEModel(EQUATIONS, {"gauge": "level"}, **FIELDS)
REGION = {"level": [3.8, 4.2], "outflow": [0.95, 1.05], "inflow": [0.9, 1.1], "rain": [-0.01, 0.01],
          "leak": [0.0, 0.05]}  # fmt: skip
ASKED: dict[str, Any] = {
    "fault": "leak", "course": "constant", "samples": 8, "sample_time": H, "region": REGION,
    "disturbance_bounds": {"rain": 0.005}, "noise_bound": {"gauge": V},
}  # fmt: skip


@cache
def test_of_tank() -> obsynth.GuaranteedTest:
    return obsynth.guaranteed_test(TANK, **ASKED)


test_of_tank.__test__ = False  # type: ignore[attr-defined]


def run(leak: float, seed: int, steps: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return levels, readings and inflows of the true tank; rain and inflow are held between samples."""
    rng = np.random.default_rng(seed)
    level, levels, inflows = 4.0 + 0.1 * np.sign(rng.standard_normal()), [], 1.0 + 0.02 * rng.standard_normal(steps)
    for k in range(steps):
        levels.append(level)
        rain = 0.005 * np.sign(rng.standard_normal())
        into = float(inflows[k]) + rain - (leak if k >= 10 else 0.0)
        done = solve_ivp(lambda _, x, into=into: [(into - C * np.sqrt(x[0])) / AREA], (0.0, H), [level],
                         rtol=1e-12, atol=1e-12)  # fmt: skip
        level = float(done.y[0, -1])
    found = np.array(levels)
    return found, found + V * np.sign(rng.standard_normal(steps)), inflows


def test_the_remainder_is_that_of_the_root_and_a_little_more() -> None:
    # c sqrt(x) leaves its tangent by at most c x^-1.5 / 8 w^2, which enters a sample by h / area, and fades a little.
    for width in (0.4, 0.1, 0.01):
        region = {**REGION, "level": [4.0 - width, 4.0 + width]}
        _, found = bounded_model(TANK, region, H, faults=["leak"], disturbances=["rain"])
        most = max(abs(C * np.sqrt(x) - (1.0 + (x - 4.0) * C / 4.0)) for x in (4.0 - width, 4.0 + width))
        assert 0.95 * most * H / AREA <= found["remainder of level"] <= 1.25 * most * H / AREA
        assert found["remainder in gauge"] < 1e-12


@pytest.mark.long
def test_what_an_output_shows_of_an_algebraic_state_has_its_remainder() -> None:
    fields = {**FIELDS, "units": {**FIELDS["units"], "meter": "m3/s"}}
    metered = obsynth.DAEModel(EQUATIONS, {"gauge": "level", "meter": "outflow"}, **fields)
    _, found = bounded_model(metered, REGION, H, faults=["leak"], disturbances=["rain"])
    most = max(abs(C * np.sqrt(x) - (1.0 + (x - 4.0) * C / 4.0)) for x in REGION["level"])
    assert most <= found["remainder in meter"] <= 1.25 * most
    test = obsynth.guaranteed_test(metered, **{**ASKED, "noise_bound": {"gauge": V, "meter": V}})
    assert 0.0 < test.threshold <= test_of_tank().threshold * (1.0 + 1e-9)


def test_between_samples_the_remainder_may_do_anything() -> None:
    # An oscillator whose remainder r enters the velocity: in a quarter of a turn it moves by r (1 - cos), less if held.
    model = obsynth.DAEModel(
        {"x": "der(x) = v", "v": "der(v) = -x + p + 0.1 * x ** 3"}, {"y": "x"}, states={"x": 0.0, "v": 0.0},
        parameters={"p": 0.0},
    )  # fmt: skip
    step, region = 4.0, {"x": [-0.1, 0.1], "v": [-0.1, 0.1], "p": [0.0, 0.0]}
    _, found = bounded_model(model, region, step, faults=["p"], disturbances=[])
    # |sin| over 4 s is 2 + 1 - |cos 4|, |cos| is 1 + 2 - |sin 4|... from 3 pi / 2 on it is not reached.
    r = 0.1 * 0.1**3
    whole = {"x": 2.0 + (1.0 + np.cos(4.0)), "v": 1.0 + 1.0 + abs(np.sin(4.0))}
    for name, size in whole.items():
        assert size * r <= found[f"remainder of {name}"] <= 6.0 * size * r
    # What a held remainder would do is less: it would not be safe.
    assert abs(np.sin(4.0)) * r < 0.5 * found["remainder of v"]


def test_a_parameter_that_is_given_counts_with_its_value() -> None:
    # The valve's coefficient as a parameter: at 0.5 by what is given, not 0.3 as its nominal value says.
    fields = {**FIELDS, "constants": {"area": AREA}, "parameters": {"leak": 0.0, "c": 0.3}}
    fields["units"] = {**FIELDS["units"], "c": "m2.5/s"}
    model = obsynth.DAEModel(EQUATIONS, {"gauge": "level"}, **fields)
    _, found = bounded_model(model, REGION, H, faults=["leak"], disturbances=["rain"], given={"c": 0.5, "level": 4.0})
    _, plain = bounded_model(TANK, REGION, H, faults=["leak"], disturbances=["rain"])
    assert found["remainder of level"] == pytest.approx(plain["remainder of level"], rel=1e-6)


@pytest.mark.long
def test_no_healthy_tank_alarms_and_twice_the_threshold_does() -> None:
    test = test_of_tank()
    assert test.report.passed
    assert "least" not in test.certificate.claims
    assert 0.0 < test.threshold < 0.03
    point = test.linear[0].operating_point
    healthy = []
    for seed in range(30):
        for leak in (0.0, 2.0 * test.threshold):
            levels, readings, inflows = run(leak, seed)
            assert np.all(np.abs(levels - 4.0) <= 0.2)
            known = (inflows - point["inflow"])[:, None]
            said = test.observer.run((readings - point["gauge"])[:, None], known)
            low, high = test.interval(said)
            alarms = test.alarms(said)
            assert not alarms[:11].any()
            assert alarms.any() == (leak > 0.0)
            # The window of eight samples is filled by the leak from row 17 on.
            assert np.all((low[17:] <= leak) & (leak <= high[17:]))
            healthy.append(np.nanmax(np.abs(test.residual(said)[:10])))
    assert max(healthy) > 0.3 * test.threshold


@pytest.mark.long
def test_it_says_what_it_rests_on_and_is_saved(tmp_path: Path) -> None:
    test = test_of_tank()
    words = "level stays within 3.8 to 4.2 m"
    assert words in next(row.claim for row in test.report.checks if row.name == "threshold")
    assert words in obsynth.online_monitor(test).statement
    assert any("linear model is at most" in note for note in test.notes)
    kept = obsynth.load(test.save(tmp_path / "tank.json"))
    assert obsynth.verify(kept).passed
    _, readings, inflows = run(0.04, 1)
    log = pd.DataFrame({"time": H * np.arange(40), "inflow": inflows, "gauge": readings})
    proof = obsynth.prove_alarm(test, log, row=25)
    assert proof.proved
    assert words in proof.statement
    low, high = replace(test, options={**test.options, "exact": True}).exact_interval(
        readings[:, None] - 4.0, inflows[:, None] - 1.0
    )
    assert np.all((low[17:] <= 0.04) & (high[17:] >= 0.04))


def changed(what: str) -> obsynth.ObserverDesign:
    test = test_of_tank()
    plant, options = test.linear[0], dict(test.options)
    bounds = dict(options["disturbance_bounds"])
    if what == "bound":
        bounds["remainder of level"] *= 0.99
        return test.replace(options={**options, "disturbance_bounds": bounds})
    if what == "region":
        return test.replace(options={**options, "region": {**REGION, "level": [3.7, 4.2]}})
    if what == "model":
        model = {**options["model"], "constants": {"area": AREA, "c": 0.51}}
        return test.replace(options={**options, "model": model})
    if what == "sample time":
        return test.replace(options={**options, "sample_time": 0.25})
    if what == "directions":
        return test.replace(plant=plant.replace(Bd=0.5 * plant.Bd))
    return test.replace(plant=plant.replace(**{what: getattr(plant, what) * (1.0 + 1e-3)}))


@pytest.mark.one_in(6)
@pytest.mark.parametrize("what", ["bound", "region", "model", "sample time", "directions", "A", "B", "Bf", "C"])
def test_what_is_changed_fails_the_row_on_the_remainder(what: str) -> None:
    assert "remainder" in {row.name for row in obsynth.verify(changed(what)).failures}


def nonlinear_rate() -> obsynth.DAEModel:
    return obsynth.DAEModel({**EQUATIONS, "balance": "level * der(level) = inflow + rain - outflow - leak"},
                            {"gauge": "level"}, **FIELDS)  # fmt: skip


REFUSED: dict[str, tuple[dict[str, Any], type[Exception], str]] = {
    "no region": ({"region": None}, obsynth.PreconditionError, "needs region.*linearise"),
    "no sample time": ({"sample_time": None}, obsynth.PreconditionError, "needs sample_time"),
    "a state left out": ({"region": {"level": [3.8, 4.2]}}, obsynth.SpecError, "lacks outflow"),
    "another name": ({"region": {**REGION, "temperature": [0.0, 1.0]}}, obsynth.SpecError, "temperature is none"),
    "away from the point": ({"region": {**REGION, "level": [5.0, 6.0]}}, obsynth.SpecError, "around 4"),
    "the higher end first": ({"region": {**REGION, "level": [4.2, 3.8]}}, obsynth.SpecError, "low first"),
    "beyond the root": ({"region": {**REGION, "level": [-1.0, 5.0]}}, obsynth.PreconditionError, "sqrt"),
    "rain beyond": ({"disturbance_bounds": {"rain": 0.02}}, obsynth.SpecError, "region of rain .* widen"),
    "no input": ({"disturbance_bounds": {"snow": 0.02}}, obsynth.SpecError, "of the inputs that are not known"),
    "no name": ({"disturbance_bounds": 0.02}, obsynth.SpecError, "by name"),
    "no noise": ({"noise_bound": None}, obsynth.SpecError, "noise_bound"),
    "unknown fault": ({"fault": "lek"}, obsynth.SpecError, "no fault 'lek'"),
    "unknown free": ({"free": ["clog"]}, obsynth.SpecError, "free names clog"),
    "isolate": ({"fault": None, "isolate": True}, obsynth.SpecError, "isolate is for linear plants"),
    "model": ({"model": {}}, obsynth.SpecError, "model"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_it_cannot_be_asked_is_refused(name: str) -> None:
    options, error, words = REFUSED[name]
    with pytest.raises(error, match=words):
        obsynth.guaranteed_test(TANK, **{**ASKED, **options})


def test_models_without_a_bound_are_refused() -> None:
    with pytest.raises(obsynth.PreconditionError, match="multiplied by a signal"):
        obsynth.guaranteed_test(nonlinear_rate(), **ASKED)
    coupled = {**EQUATIONS, "balance": "area * der(level) + 0.1 * der(outflow) = inflow + rain - outflow - leak"}
    with pytest.raises(obsynth.PreconditionError, match="several derivatives"):
        obsynth.guaranteed_test(obsynth.DAEModel(coupled, {"gauge": "level"}, **FIELDS), **ASKED)
    functions = obsynth.DAEModel(
        lambda rates, x, u, theta: [2.0 * rates[0] - u[0] + theta[0]], lambda x, theta: [x[0]], states={"level": 4.0},
        inputs={"inflow": 0.0}, parameters={"leak": 0.0}, output_names=["y1"],
        units={"level": "m", "inflow": "m3/s", "leak": "m3/s", "y1": "m"},
    )  # fmt: skip
    with pytest.raises(obsynth.SpecError, match="equations as texts"):
        obsynth.guaranteed_test(functions, **{**ASKED, "disturbance_bounds": None, "noise_bound": {"y1": V}})
    linear = obsynth.DescriptorSystem(None, [[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    with pytest.raises(obsynth.SpecError, match="region is for nonlinear plants"):
        obsynth.guaranteed_test(linear, noise_bound={"y1": 1.0}, region={"x1": [0.0, 1.0]})
    assert not obsynth.check(TANK)["guaranteed-test"].passed
    assert obsynth.check(TANK, {"guaranteed-test": ASKED})["guaranteed-test"].passed


@pytest.mark.long
def test_the_command_line_designs_verifies_and_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant = {"kind": "dae", "equations": EQUATIONS, "outputs": {"gauge": "level"}, **FIELDS}
    document = {"schema_version": 1, "name": "tank", "plant": plant,
                "method": {"id": "guaranteed-test", "options": ASKED}}  # fmt: skip
    spec, gains, out = tmp_path / "tank.yaml", tmp_path / "tank.gains.json", tmp_path / "out.csv"
    with spec.open("w") as stream:
        YAML(typ="safe").dump(document, stream)
    _, readings, inflows = run(0.04, 1)
    pd.DataFrame({"time": H * np.arange(40), "inflow": inflows, "gauge": readings}).to_csv(
        tmp_path / "log.csv", index=False
    )
    assert main(["design", "--system", str(spec), "--output", str(gains)]) == 0
    assert main(["verify", str(gains)]) == 0
    run_it = ["run", "--gains", str(gains), "--data", str(tmp_path / "log.csv"), "--monitor", "pointwise"]
    assert main([*run_it, "--out", str(out)]) in (0, 1)
    alarms = pd.read_csv(out)["alarm"].notna()
    assert alarms[18:].all()
    assert not alarms[:11].any()
    assert "level stays within" in " ".join(capsys.readouterr().out.split())
