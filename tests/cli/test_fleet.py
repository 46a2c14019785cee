"""A folder of gain sets on a folder of logs: the same numbers wherever they run, resumed, one table and one picture."""

from __future__ import annotations

import json
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.cli.main import main


@pytest.fixture
def places(tmp_path: Path) -> tuple[Path, Path]:
    gains, logs = tmp_path / "gains", tmp_path / "logs"
    gains.mkdir()
    logs.mkdir()
    plant = obsynth.DescriptorSystem(None, [[0.5]], C=[[1.0]], Bf=[[1.0]], Dw=[[0.1]], dt=1.0)
    other = plant.replace(C=[[2.0]], output_names=["y2"])
    obsynth.fault_estimation_filter(plant).save(gains / "one.gains.json")
    obsynth.functional_filter(plant).save(gains / "two.gains.json")
    obsynth.fault_estimation_filter(other).save(gains / "three.gains.json")
    rng = np.random.default_rng(3)
    for name, columns in (("shared", ("y1", "y2")), ("three", ("y2",))):
        rows = rng.normal(size=(40, len(columns)))
        body = "\n".join(",".join(f"{value:.6f}" for value in (k, *row)) for k, row in enumerate(rows))
        (logs / f"{name}.csv").write_text(f"time,{','.join(columns)}\n{body}\n")
    return gains, logs


def told(fleet: obsynth.types.Fleet) -> list[tuple[object, ...]]:
    return [
        (run.name, run.status, run.rows, dict(run.alarms), dict(run.largest), run.file and run.file.read_bytes())
        for run in fleet.runs
    ]


def test_pairs_and_numbers(places: tuple[Path, Path], tmp_path: Path) -> None:
    found = obsynth.run_fleet(*places, tmp_path / "out", thresholds={"fhat[f1]": 0.5})
    names = [run.name for run in found.runs]
    assert names == ["one on shared", "three on shared", "three on three", "two on shared"]
    assert found.counts == {"run": 4}
    alone = obsynth.run_on_data(
        obsynth.load(places[0] / "one.gains.json"), places[1] / "shared.csv", thresholds={"fhat[f1]": 0.5}
    )
    assert found.runs[0].alarms == dict(alone.alarms)
    table = found.table()
    assert list(table["run"]) == names
    assert "alarm fhat[f1], s" in table
    panels = found.plot().axes
    assert len(panels) == 4
    # Dollars in names are dollars.
    assert not any(text.get_parse_math() for panel in panels for text in panel.get_legend().get_texts())


@pytest.mark.long
def test_processes_give_the_same_and_what_is_there_is_kept(places: tuple[Path, Path], tmp_path: Path) -> None:
    here = obsynth.run_fleet(*places, tmp_path / "here")
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        there = obsynth.run_fleet(*places, tmp_path / "there", executor=executor)
    assert told(here) == told(there)
    calls: list[tuple[int, int]] = []
    (tmp_path / "here" / here.runs[1].file.name).write_text("damaged")
    again = obsynth.run_fleet(*places, tmp_path / "here", progress=lambda *numbers: calls.append(numbers))
    assert calls == [(4, 4)]
    assert told(again) == told(there)


def test_logs_of_the_same_numbers_are_runs_of_their_own(places: tuple[Path, Path], tmp_path: Path) -> None:
    (places[1] / "again.csv").write_bytes((places[1] / "shared.csv").read_bytes())
    found = obsynth.run_fleet(places[0] / "one.gains.json", places[1], tmp_path / "out")
    assert [run.name for run in found.runs] == ["one on again", "one on shared", "one on three"]
    assert found.runs[0].file != found.runs[1].file
    assert found.runs[0].largest == found.runs[1].largest


def test_a_log_that_does_not_fit_is_a_row(places: tuple[Path, Path], tmp_path: Path) -> None:
    (places[1] / "shared.csv").write_text("time,y1\n0,1\n1,2\n")
    found = obsynth.run_fleet(*places, tmp_path / "out")
    assert found.counts == {"malformed": 1, "run": 3}
    assert "y2" in next(run.message for run in found.runs if run.status == "malformed")


@pytest.mark.long
def test_the_verb(places: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    arguments = ["run", "--gains", str(places[0]), "--data", str(places[1]), "--out", str(out), "--quiet"]
    assert main([*arguments, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["counts"] == {"run": 4}
    assert (out / "table.csv").read_text().startswith("run,status,rows,ok,")
    assert (out / "fleet.png").stat().st_size > 1000
    assert main([*arguments, "--smooth"]) == 2
    assert main([*arguments[:5], "--quiet"]) == 2


@pytest.mark.parametrize(
    ("changes", "text"),
    [({"data": "nowhere.csv"}, "no such file"), ({"speed": 3}, "use some of"), ({"gains": "empty"}, "no file")],
)
def test_bad_arguments(places: tuple[Path, Path], tmp_path: Path, changes: dict[str, object], text: str) -> None:
    (tmp_path / "empty").mkdir()
    given = {"gains": places[0], "data": places[1], "folder": tmp_path / "out"} | changes
    given = {name: tmp_path / value if isinstance(value, str) else value for name, value in given.items()}
    with pytest.raises(obsynth.SpecError, match=text):
        obsynth.run_fleet(**given)
