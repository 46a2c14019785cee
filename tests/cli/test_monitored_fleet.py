"""A folder of gain sets is run with a monitor of each: with thresholds of its own, or learned from one normal log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.errors import SpecError

ROWS = 400


def log(seed: int, *, leak: float = 0.0) -> pd.DataFrame:
    """Return rows of two states, of which the first has a leak from the middle on."""
    rng, x, rows = np.random.default_rng(seed), np.zeros(2), []
    for k in range(ROWS):
        rows.append([k, *(x + 0.1 * rng.standard_normal(2))])
        x = np.array([0.9 * x[0] + 0.1 * x[1] + leak * (k >= ROWS // 2), 0.8 * x[1]]) + 0.01 * rng.standard_normal(2)
    return pd.DataFrame(rows, columns=["time", "y1", "y2"])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two gain sets, thresholds of each, and logs."""
    folder = tmp_path_factory.mktemp("fleet")
    for part in ("gains", "normal", "logs"):
        (folder / part).mkdir()
    for name, decay in (("fast", 0.5), ("slow", 0.9)):
        plant = obsynth.DescriptorSystem(
            A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1], [0]], dt=1.0, fault_names=["leak"],
            sensor_noise={"y1": 0.1, "y2": 0.1},
        )  # fmt: skip
        design = obsynth.ui_pi_observer(plant, decay=decay)
        design.save(folder / "gains" / f"{name}.gains.json")
        learned = obsynth.learn_thresholds(design, [log(1), log(2)], false_alarms="1 per 5000 rows")
        learned.save(folder / "normal" / f"{name}.json")
    log(1).to_csv(folder / "normal.csv", index=False)
    log(3).to_csv(folder / "logs" / "healthy.csv", index=False)
    log(4, leak=0.3).to_csv(folder / "logs" / "leak.csv", index=False)
    return folder


def fleet(place: Path, out: Path, **options) -> dict[str, obsynth.FleetRun]:
    """Return the runs of a fleet by name."""
    found = obsynth.run_fleet(place / "gains", place / "logs", out, **options)
    assert [run.message for run in found.runs if run.status != "run"] == []
    return {run.name: run for run in found.runs}


@pytest.mark.long
def test_each_design_has_its_own_thresholds(place: Path, tmp_path: Path):
    found = fleet(place, tmp_path / "o", monitor="learned", normal=place / "normal")
    assert len(found) == 4
    for name in ("fast", "slow"):
        design = obsynth.load(place / "gains" / f"{name}.gains.json")
        monitor = obsynth.online_monitor(design, "learned", normal=place / "normal" / f"{name}.json")
        alone = obsynth.run_on_data(design, place / "logs" / "leak.csv", monitor=monitor)
        assert (found[f"{name} on leak"].alarms, found[f"{name} on leak"].fault) == (alone.alarms, alone.isolated)
        assert alone.alarms


@pytest.mark.long
def test_a_normal_log_is_learned_from_by_each(place: Path, tmp_path: Path):
    found = fleet(place, tmp_path / "o", monitor="learned", normal=place / "normal.csv", sensor_faults=False)
    assert {run.fault for name, run in found.items() if name.endswith("leak")} == {"leak"}


@pytest.mark.long
def test_thresholds_that_are_missing_are_told(place: Path, tmp_path: Path):
    (tmp_path / "none").mkdir()
    found = obsynth.run_fleet(
        place / "gains", place / "logs", tmp_path / "o", monitor="learned", normal=tmp_path / "none"
    )
    assert {run.status for run in found.runs} == {"malformed"}
    assert "fast.json" in found.runs[0].message
    with pytest.raises(SpecError, match="normal is for the monitor learned"):
        obsynth.run_fleet(place / "gains", place / "logs", tmp_path / "o2", normal=place / "normal")


@pytest.mark.long
def test_the_command_takes_a_monitor_for_a_folder(place: Path, tmp_path: Path, capsys):
    given = ["run", "--gains", str(place / "gains"), "--data", str(place / "logs"), "--out", str(tmp_path / "o")]
    assert main([*given, "--monitor", "learned", "--normal", str(place / "normal")]) == 0
    table = pd.read_csv(tmp_path / "o" / "table.csv")
    alarmed = table[table["run"].str.endswith("leak")]
    assert alarmed["alarm learned, s"].notna().all()
    assert alarmed["fault"].notna().all()
    assert main([*given, "--normal", str(place / "normal")]) == 2
    assert "--normal is for a monitor" in capsys.readouterr().err
