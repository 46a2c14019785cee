"""Options in range that would do nothing are refused, by name, before anything is done."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main

DRIVE, TANKS = (str(Path(__file__).parents[2] / "designs" / name / "spec.yaml") for name in ("drive", "threetank"))


@cache
def gain_set() -> bytes:
    import tempfile

    plant = obsynth.DescriptorSystem(
        None, np.array([[0.8, 0.1], [0.0, 0.5]]), C=np.eye(2), Bf=np.array([[1.0], [0.0]]), Dw=0.01 * np.eye(2), dt=0.1
    )
    with tempfile.TemporaryDirectory() as folder:
        return obsynth.fault_estimation_filter(plant).save(Path(folder) / "g.json").read_bytes()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "g.json").write_bytes(gain_set())
    table = pd.DataFrame(np.zeros((60, 2)), columns=["y1", "y2"]).assign(time=0.1 * np.arange(60))
    table.to_csv("l.csv", index=False)
    return tmp_path


RUN = "run --gains g.json --data l.csv --out e.csv"
EVALUATE = f"evaluate --system {DRIVE} --quiet"


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("line", "named"),
    [
        *((f"{RUN} {option}", option.split()[0]) for option in (
            "--change 2", "--window 20", "--false-alarms 0.01", "--noise-bound 3", "--initial-error 1",
            "--normal l.csv",
            "--disturbance d=1", "--initial x1=1", "--nominal p=1", "--sample-time 1", "--state-every 50", "--jobs 2",
        )),
        *((f"{RUN} --monitor pointwise --noise-bound 3 {option}", option.split()[0]) for option in (
            "--change 2", "--window 20", "--false-alarms 0.01", "--normal l.csv", "--nominal p=1",
        )),
        *((f"{RUN} --monitor chi-square {option}", option.split()[0]) for option in (
            "--change 2", "--noise-bound 3", "--initial-error 1", "--initial x1=1", "--normal l.csv",
            "--disturbance d=1",
        )),
        (f"{RUN} --monitor window --noise-bound 3 --false-alarms 0.1", "--false-alarms"),
        (f"{RUN} --monitor paper --window 3", "--window"),
        ("run --gains g.json --data l.csv --force", "--force"),
        ("export --gains g.json --to o.npz --fmi 3.0", "fmi"),
        ("export --gains g.json --to o.npz --threshold fhat[f1]=1", "thresholds"),
        ("report --gains g.json --out r.html --monitor pointwise", "--monitor"),
        ("report --gains g.json --out r.html --rows 0:5", "--rows"),
        ("report --gains g.json --out r.html --warm-up 5", "--warm-up"),
        (f"{EVALUATE} --change 2", "--change"),
        (f"{EVALUATE} --noise-bound 2", "--noise-bound"),
        (f"{EVALUATE} --unverified", "--unverified"),
        (f"{EVALUATE} --force", "--force"),
        (f"{EVALUATE} --tolerances 1% --window 20", "--window"),
        (f"{EVALUATE} --tolerances 1% --jobs 1", "--jobs"),
        (f"{EVALUATE} --tolerances 1% --confidence 0.9", "--confidence"),
        (f"simulate --system {DRIVE} --unverified", "--unverified"),
        (f"simulate --system {DRIVE} --force", "--force"),
        (f"compare --system {DRIVE} --map y=z", "--map"),
        (f"compare --system {DRIVE} --scale y=2", "--scale"),
        (f"linearise --system {TANKS} --rows 0:3", "--rows"),
        (f"sweep --system {DRIVE} --out o --jobs 1 --cluster tcp://127.0.0.1:1", "--jobs"),
        ("prove-alarm --gains g.json --data l.csv --row 9 --initial x1=1 --initial x2=1 --state-bound x1=1 "
         "--noise-bound 3", "state_bounds"),
        ("verify g.json --data l.csv", "--data"),
    ],
)  # fmt: skip
def test_what_does_nothing_is_refused_by_name(
    folder: Path, line: str, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(folder.iterdir())
    assert main([*line.split(), "--json"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert told["path"] == named
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(
    "line",
    [
        f"{RUN} --monitor pointwise --noise-bound 3 --initial-error 1",
        f"{RUN} --monitor window --noise-bound 3 --window 5",
        f"{RUN} --monitor chi-square --window 5 --false-alarms 0.1 --force",
        f"{RUN} --monitor cusum --change 2 --set window=5",
    ],
)
def test_what_acts_is_taken(folder: Path, line: str) -> None:
    assert main([*line.split(), "--quiet"]) == 0
    assert (folder / "e.csv").exists()


def test_what_python_would_ignore_is_refused(folder: Path) -> None:
    design = obsynth.load("g.json")
    plant = design.plant
    with pytest.raises(
        obsynth.SpecError, match="learned monitors and levels of outputs, not this monitor: write it as C"
    ):
        obsynth.export(design, "o.fmu", monitor=obsynth.online_monitor(design, noise_bound=3.0))
    scenario = obsynth.Scenario(horizon=3.0)
    for wrong in (
        {"options": {"no-method": {}}}, {"options": {"functional-filter": {}}, "methods": ["fault-estimation-filter"]},
        {"sample_time": 0.5}, {"columns": {"y1": "a"}}, {"scales": {"y1": 2.0}},
        {"disturbance": 2.0, "scenario": scenario},
    ):  # fmt: skip
        with pytest.raises(obsynth.SpecError) as refused:
            obsynth.compare(plant, **wrong)
        assert refused.value.path == next(iter(wrong))
