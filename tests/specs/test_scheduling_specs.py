"""Specs of plants over a region: `scheduling`, and what is refused in it; the commands on such a spec."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from tests.support.polytopic_plants import record, wang

import obsynth
from obsynth import PolytopicSystem, SpecError
from obsynth.cli.main import main

_SPEC = """
schema_version: 1
name: region
plant:
  dt: 1.0
  E: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]]
  A:
    - ["0.9 * (1 + share * a)", 0.005, -0.095, 0]
    - [0.005, 0.995, "0.0997 + share * b", 0]
    - [0.095, -0.0997, 0.99, 0]
    - [1, 0, 1, 1]
  B: [[1], [0], [0], [0]]
  C: [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  Bf: [[0.1, 0], [1, 1], [-0.1, 1], [-1, 0]]
  Bd: [[1], [1], [1], [0]]
  constants: {share: 0.05}
  scheduling:
    a: {range: [-1, 1], unit: m}
    b: {range: [-1, 1], column: speed}
method:
  id: fault-estimation-filter
"""


def _written(folder: Path, *changes: tuple[str, str]) -> Path:
    text = _SPEC
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "spec.yaml").write_text(text)
    return folder / "spec.yaml"


def test_a_spec_is_the_plant_of_its_expressions(tmp_path: Path) -> None:
    plant = obsynth.load_spec(_written(tmp_path)).plant
    assert isinstance(plant, PolytopicSystem)
    for one, other in zip(plant.vertices, wang().vertices, strict=True):
        assert pytest.approx(other.A, abs=1e-16) == one.A
        assert np.array_equal(one.Bf, other.Bf)
    assert plant.scheduling.columns == {"b": "speed"}
    assert plant.scheduling.units == {"a": "m"}


@pytest.mark.long
def test_the_commands_go_from_a_spec_to_estimates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec, gains = str(_written(tmp_path)), str(tmp_path / "region.gains.json")
    assert main(["check", "--system", spec]) == 0
    assert "all conditions hold" in capsys.readouterr().out
    assert main(["design", "--system", spec, "--output", gains]) == 0
    assert "a in [-1, 1] m, b in [-1, 1]" in " ".join(capsys.readouterr().out.split())
    assert main(["verify", "--gains", gains]) == 0
    rng = np.random.default_rng(0)
    parameters, u, f = rng.uniform(-1, 1, (120, 2)), rng.standard_normal((120, 1)), np.zeros((120, 2))
    f[70:, 1] = 2.0
    y = record(wang(), parameters, u, f)
    parameters[100, 1] = 7.0
    columns = np.hstack([np.arange(120.0)[:, None], u, parameters, y])
    log, out = tmp_path / "log.csv", tmp_path / "out.csv"
    pd.DataFrame(columns, columns=["time", "u1", "a", "speed", "y1", "y2", "y3"]).to_csv(log, index=False)
    assert main(["run", "--gains", gains, "--data", str(log), "--out", str(out)]) == 0
    found = pd.read_csv(out)
    # The parameter is out of its range at row 100, and for as long as errors need to decay.
    assert (found.status[100:103] == "out").all()
    assert (found.status[103:] == "ok").all()
    assert found["fhat[f2]"][105:].to_numpy() == pytest.approx(np.full(15, 2.0), abs=1e-3)
    assert (found.status[60:100] == "ok").all()
    assert found["fhat[f2]"][71:100].to_numpy() == pytest.approx(np.full(29, 2.0), abs=1e-6)
    assert main(["export", "--gains", gains, "--to", str(tmp_path / "region.c")]) == 0


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("range: [-1, 1], unit: m", "range: [1, 1]", "A parameter that does not change is a constant"),
        ("range: [-1, 1], unit: m", "range: [-1, 1], rate: 0", "rate of 'a' is 0"),
        ("range: [-1, 1], unit: m", "range: [-1, 1, 2]", "scheduling.a.range"),
        ("range: [-1, 1], unit: m", "span: [-1, 1]", "scheduling.a"),
        ("range: [-1, 1], unit: m", "range: [-1, 1], measured: false", "is not measured"),
        ("constants: {share: 0.05}", "constants: {share: {nominal: 0.05, tolerance: 5 %}}", "constants.share"),
        ("constants: {share: 0.05}", "constants: {part: 0.05}", "'share' is no scheduling parameter"),
        ("  scheduling:\n", "  tolerance: {A: 1 %}\n  scheduling:\n", "tolerance is for plants without scheduling"),
        ("  scheduling:\n", "  transform: {sample_time: 0.5}\n  scheduling:\n", "transform is for plants without"),
        ("share * b", "share * where(b < 0, 1, 2)", "chooses between formulas"),
    ],
)
def test_what_is_no_region_is_refused_with_its_place(tmp_path: Path, old: str, new: str, told: str) -> None:
    with pytest.raises(SpecError) as refused:
        obsynth.load_spec(_written(tmp_path, (old, new)))
    assert told in f"{refused.value.path}: {refused.value} {refused.value.problems}"


@pytest.mark.long
def test_a_range_alone_and_a_scenario_in_a_spec(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = (
        "scenario:\n  horizon: 100\n  faults: {f2: {kind: step, size: 1, start: 60}}\n"
        "  scheduling: {a: {kind: sine, amplitude: 1, frequency: 0.3}}\nmethod:"
    )
    spec = _written(tmp_path, ("{range: [-1, 1], unit: m}", "[-1, 1]"), ("method:", scenario))
    out, gains = tmp_path / "signals.csv", tmp_path / "region.gains.json"
    assert main(["design", "--system", str(spec), "--output", str(gains), "--quiet"]) == 0
    assert main(["simulate", "--system", str(spec), "--gains", str(gains), "--out", str(out)]) == 0
    table = pd.read_csv(out)
    assert {"a", "speed"} <= set(table.columns)
    assert table["fhat[f2]"][61:].to_numpy() == pytest.approx(np.ones(40), abs=1e-6)
    # What was written is a log.
    assert main(["run", "--gains", str(gains), "--data", str(out), "--out", str(tmp_path / "run.csv")]) == 0
    assert (pd.read_csv(tmp_path / "run.csv").status[40:] == "ok").all()
    capsys.readouterr()
    bad = _written(tmp_path, ("method:", scenario.replace("scheduling: {a", "scheduling: {speed")))
    assert main(["simulate", "--system", str(bad)]) == 2
    assert "scenario.scheduling.speed" in capsys.readouterr().err


def test_commands_for_other_plants_say_why_they_refuse(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spec = str(_written(tmp_path))
    for command in (["compare"], ["sensors"]):
        assert main([*command, "--system", spec]) == 2
        assert "Give the plant at one of their points, plant.at({...})" in " ".join(capsys.readouterr().err.split())
