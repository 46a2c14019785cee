"""Guaranteed tests with bounds ``[low, high]``: their middle is a known constant, whatever runs the test."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML
from test_guaranteed_c import through_c

import obsynth
from obsynth.cli.main import main
from obsynth.methods.guaranteed_test.exact import Programmes

V, W = 0.5, 0.25
ONE = [[1.0]]
INTEGRATOR = obsynth.DescriptorSystem(None, ONE, C=ONE, Bd=ONE, Bf=ONE, dt=1.0)
#: Bounds of the disturbance and of noise, with the same half widths as +-W and +-V.
SHIFTED: dict[str, tuple[Any, Any]] = {
    "both": ([0.5, 1.0], [-0.2, 0.8]),
    "disturbance": ([-0.75, -0.25], V),
    "noise": (W, [0.0, 1.0]),
}


def integrator(d: Any, v: Any, **more: Any) -> obsynth.GuaranteedTest:
    options = {"course": "constant", "samples": 5, **more}
    return obsynth.guaranteed_test(INTEGRATOR, disturbance_bounds={"d1": d}, noise_bound={"y1": v}, **options)


TANK = obsynth.DescriptorSystem(
    None, [[0.95, 0.04], [0.04, 0.95]], B=[[0.1], [0.0]], C=np.eye(2), D=[[0.3], [0.0]], Bd=[[0.02], [0.0]],
    Dd=[[0.0], [0.05]], Bf=[[-0.1, 0.0], [0.0, -0.1]], dt=1.0, state_names=["h1", "h2"], input_names=["pump"],
    output_names=["level 1", "level 2"], fault_names=["leak 1", "leak 2"], disturbance_names=["inflow"],
)  # fmt: skip
#: Inflow between 0.1 and 1.1, the first level read 0 to 0.02 too high.
INTERVALS: dict[str, Any] = {"disturbance_bounds": {"inflow": [0.1, 1.1]},
                             "noise_bound": {"level 1": [0.0, 0.02], "level 2": 0.01}}  # fmt: skip
ABOUT_ZERO: dict[str, Any] = {"disturbance_bounds": {"inflow": 0.5}, "noise_bound": {"level 1": 0.01, "level 2": 0.01}}
MIDDLE_D, MIDDLE_V = 0.6, np.array([0.01, 0.0])
ASKED: dict[str, dict[str, Any]] = {
    "test": {"fault": "leak 2", "course": "constant", "samples": 6},
    "step": {"fault": "leak 1", "course": "step", "before": 4, "after": 4, "free": "none"},
    "held": {"fault": "leak 2", "course": "any", "samples": 6, "disturbance": "held"},
    "bank": {"isolate": True, "course": "constant", "samples": 6},
}


@cache
def tank(name: str = "test", *, shifted: bool = True, **more: Any) -> obsynth.GuaranteedTest:
    return obsynth.guaranteed_test(TANK, **{**ASKED[name], **(INTERVALS if shifted else ABOUT_ZERO), **more})


def record(leak: float = 0.0, *, shifted: bool = True, rows: int = 25) -> pd.DataFrame:
    """Return a log whose disturbance and noise move about the middles, or about zero by the same amounts."""
    rng = np.random.default_rng(2)
    x, found = np.array([1.0, 0.5]), []
    for k in range(rows):
        u, d = 1.0 + 0.5 * np.sin(k), rng.uniform(-0.5, 0.5) + MIDDLE_D * shifted
        v = rng.uniform(-0.01, 0.01, 2) + MIDDLE_V * shifted
        found.append([float(k), u, *(TANK.C @ x + TANK.D[:, 0] * u + TANK.Dd[:, 0] * d + v)])
        fault = np.array([0.0, leak if k >= 10 else 0.0])
        x = TANK.A @ x + TANK.B[:, 0] * u + TANK.Bd[:, 0] * d + TANK.Bf @ fault
    return pd.DataFrame(found, columns=["time", "pump", "level 1", "level 2"])


def signals(log: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    return log[["level 1", "level 2"]].to_numpy(), log[["pump"]].to_numpy()


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", SHIFTED)
def test_the_threshold_is_that_of_the_half_widths_and_is_reached(name: str) -> None:
    d, v = SHIFTED[name]
    test = integrator(d, v)
    assert test.threshold == pytest.approx(W + 2 * V / 4, rel=1e-9)
    assert test.threshold / (1.0 + 1e-9) <= test.least <= test.threshold
    ends = [np.array(given) if isinstance(given, list) else np.array([-given, given]) for given in (d, v)]
    rng, largest = np.random.default_rng(3), 0.0
    for _ in range(400):
        x, y = 5.0 * rng.standard_normal(), np.zeros((5, 1))
        for k in range(5):
            y[k], x = x + ends[1][rng.integers(2)], x + ends[0][rng.integers(2)]
        largest = max(largest, abs(test.residual(test.observer.run(y))[-1]))
    assert 0.9 * test.threshold < largest <= test.threshold


def test_a_known_disturbance_costs_nothing() -> None:
    # Both ends alike: the disturbance is no unknown any more.
    assert integrator([0.3, 0.3], V).threshold == pytest.approx(2 * V / 4, rel=1e-9)
    with_noise_known = integrator([0.3, 0.3], [0.1, 0.1])
    assert with_noise_known.threshold < 1e-12
    y = 0.1 + 0.3 * np.arange(5.0)[:, None]
    assert abs(with_noise_known.residual(with_noise_known.observer.run(y))[-1]) <= with_noise_known.threshold + 1e-14


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", ASKED)
def test_shifted_records_are_judged_like_those_about_zero(name: str, tmp_path: Path) -> None:
    shifted, plain = tank(name), tank(name, shifted=False)
    assert shifted.report.passed
    for one, other in zip(shifted.tests, plain.tests, strict=True):
        assert one.threshold == pytest.approx(other.threshold, rel=1e-9)
        assert one.least == pytest.approx(other.least, rel=1e-9)
    tables = []
    for test, moved in ((shifted, True), (plain, False)):
        log = record(3.0 * plain.tests[-1].threshold, shifted=moved)
        log.loc[4, "level 1"] = np.nan
        tables.append(obsynth.run_on_data(test, log, monitor=obsynth.online_monitor(test)).table)
    size = float(np.nanmax(tables[1]["statistic"]))
    decided = tables[1]["statistic"].notna()
    assert decided.sum() > 8
    assert np.array_equal(tables[0]["statistic"].notna(), decided)
    assert tables[0]["statistic"][decided].to_numpy() == pytest.approx(
        tables[1]["statistic"][decided].to_numpy(), abs=1e-11 * size
    )
    assert tables[0]["alarm"].tolist() == tables[1]["alarm"].tolist()
    kept = obsynth.load(shifted.save(tmp_path / "test.json"))
    assert np.array_equal(kept.observer.constant, shifted.observer.constant)
    assert obsynth.verify(kept).passed
    both = np.hstack([*signals(record())[::-1]])
    state = shifted.observer.init()
    rows = []
    for row in both:
        state, said = shifted.observer.step(state, row[1:], row[:1])
        rows.append(np.hstack([said.faults, said.residuals])[0])
    whole = shifted.observer.run(both[:, 1:], both[:, :1])
    assert np.array(rows) == pytest.approx(np.hstack([whole.faults, whole.residuals]), rel=1e-12)


@pytest.mark.parametrize("name", ["test", "bank"])
def test_c_adds_the_constant_too(name: str, tmp_path: Path) -> None:
    y, u = signals(record())
    found = through_c(tank(name), tmp_path, np.hstack([u, y]))
    count = len(tank(name).tests)
    rows = tank(name).observer.run(y, u)
    assert found[6:, :count] == pytest.approx(np.hstack([rows.faults, rows.residuals])[6:], rel=1e-12, abs=1e-14)
    assert np.abs(tank(name).observer.constant).min() > 1e-3


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".fmu"])
def test_other_files_have_no_place_for_it(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(obsynth.SpecError, match="do not lie about zero"):
        obsynth.export(tank(), tmp_path / f"test{suffix}")
    assert not list(tmp_path.iterdir())
    for call in (tank().to_scipy, tank().to_control):
        with pytest.raises(obsynth.SpecError, match="adds a constant"):
            call()


def test_the_least_interval_and_the_test_of_what_is_left_know_the_middles() -> None:
    own, plain = Programmes.of(tank()), Programmes.of(tank(shifted=False))
    (y, u), (centred, _) = signals(record(0.4, rows=6)), signals(record(0.4, shifted=False, rows=6))
    assert own.interval(y, u) == pytest.approx(plain.interval(centred, u), abs=1e-9)
    holed, hollow = y.copy(), centred.copy()
    holed[2, 0] = hollow[2, 0] = np.nan
    assert own.least_test(holed, u) == pytest.approx(plain.least_test(hollow, u), abs=1e-9)
    low, high = tank(exact=True).exact_interval(*signals(record(0.4)))
    assert np.all(low[16:] <= 0.4)
    assert np.all(high[16:] >= 0.4)


def test_an_alarm_is_proved_about_the_middle(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    record(3.0 * tank().threshold).to_csv(log, index=False)
    proof = obsynth.prove_alarm(tank(), log, row=20)
    assert "inflow within 0.1 to 1.1" in proof.statement
    assert "noise of level 1 within 0 to 0.02" in proof.statement
    about_zero = obsynth.prove_alarm(tank(shifted=False), record(3.0 * tank().threshold, shifted=False), row=20)
    assert proof.margin == pytest.approx(about_zero.margin, rel=1e-6)
    target = proof.save(tmp_path / "alarm.json")
    assert main(["verify", str(target), "--data", str(log)]) == 0
    assert not obsynth.prove_alarm(tank(), record(), row=20).proved


def test_a_changed_constant_fails() -> None:
    for constant in (np.zeros(1), 1.0001 * tank().observer.constant):
        broken = type(tank().observer).from_dict({**tank().observer.as_dict(), "constant": constant})
        failures = {row.name for row in obsynth.verify(tank().replace(observer=broken)).failures}
        assert "weights" in failures
    bare = tank(shifted=False)
    added = type(bare.observer).from_dict({**bare.observer.as_dict(), "constant": [1e-3]})
    assert "weights" in {row.name for row in obsynth.verify(bare.replace(observer=added)).failures}
    other = tank().replace(options={**tank().options, "disturbance_bounds": {"inflow": [0.2, 1.2]}})
    assert "weights" in {row.name for row in obsynth.verify(other).failures}
    wider = tank().replace(options={**tank().options, "disturbance_bounds": {"inflow": [0.0, 1.2]}})
    assert "threshold" in {row.name for row in obsynth.verify(wider).failures}


def test_a_plant_that_changes_with_k_has_a_constant_at_each_row() -> None:
    gains = np.array([1.0, 2.0, 0.5, 3.0, 4.0, 1.0])
    plant = obsynth.TimeVaryingDescriptorSystem(
        E=None, A=ONE, C=ONE, Phi=gains[:, None, None], dt=1.0, parameter_names=["leak"]
    )
    asked = {"course": "constant", "samples": 2}
    test = obsynth.guaranteed_test(
        plant, disturbance_bounds={"mu1": [0.5, 1.0]}, noise_bound={"y1": [0.0, 1.0]}, **asked
    )
    assert test.limits(7)[2:] == pytest.approx((W + 2 * V) / gains[1:], rel=1e-9)
    # A level that rises by the middle of the bounds says nothing.
    residual = test.residual(test.observer.run(0.5 + 0.75 * np.arange(7.0)[:, None]))
    assert np.abs(residual[2:]).max() < 1e-12
    constants = 1.001 * test.observer.constants
    broken = type(test.observer).from_dict({**test.observer.as_dict(), "constants": constants})
    assert "weights" in {row.name for row in obsynth.verify(test.replace(observer=broken)).failures}


BAD = {
    "the higher end first": {"disturbance_bounds": {"d1": [1.0, 0.5]}},
    "one end": {"disturbance_bounds": {"d1": [1.0]}},
    "three": {"noise_bound": {"y1": [0.0, 0.5, 1.0]}},
    "no number": {"noise_bound": {"y1": [0.0, float("nan")]}},
    "infinite": {"disturbance_bounds": {"d1": [0.0, float("inf")]}},
    "a text": {"disturbance_bounds": {"d1": [0.0, "1"]}},
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_interval_is_refused(name: str) -> None:
    options = {"disturbance_bounds": {"d1": W}, "noise_bound": {"y1": V}, **BAD[name]}
    with pytest.raises(obsynth.SpecError, match=r"low first|two finite"):
        obsynth.guaranteed_test(INTEGRATOR, course="constant", samples=3, **options)


def test_a_spec_takes_intervals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant = {"dt": 1.0, "A": ONE, "C": ONE, "Bd": ONE, "Bf": ONE}
    document = {
        "schema_version": 1, "name": "tank", "plant": plant,
        "method": {"id": "guaranteed-test", "options": {
            "course": "constant", "samples": 5, "disturbance_bounds": {"d1": [0.5, 1.0]},
            "noise_bound": {"y1": [-0.2, 0.8]}}},
    }  # fmt: skip
    spec, gains = tmp_path / "tank.yaml", tmp_path / "tank.gains.json"

    def written() -> list[str]:
        with spec.open("w") as stream:
            YAML(typ="safe").dump(document, stream)
        return ["design", "--system", str(spec), "--output", str(gains)]

    assert main(written()) == 0
    found = obsynth.load(gains)
    assert found.observer.constant == pytest.approx(integrator(*SHIFTED["both"]).observer.constant)
    assert main(["verify", str(gains)]) == 0
    gains.unlink()
    document["method"]["options"]["disturbance_bounds"] = {"d1": [1.0, 0.5]}
    assert main(written()) == 2
    assert "low first" in capsys.readouterr().err
    assert not gains.exists()
