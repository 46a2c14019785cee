"""Whatever a public function returns prints as something that is read: no dump of arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import obsynth

PLANT = obsynth.DescriptorSystem(
    A=[[0.9, 0.05], [0.0, 0.8]], B=[[1.0], [0.0]], C=np.eye(2), Bf=[[1.0], [0.0]], Bd=[[0.0], [1.0]], dt=1.0
)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    folder: Path = tmp_path_factory.mktemp("runs")
    design = obsynth.functional_filter(PLANT)
    design.save(folder / "a.gains.json")
    scenario = obsynth.Scenario(horizon=60, faults={"f1": obsynth.Step(size=1.0, start=30)})
    run = obsynth.simulate(design, scenario)
    run.write_csv(folder / "log.csv")
    return {
        "a sweep": obsynth.sweep(PLANT, {"decay": [0.2, 0.5, -1.0]}, method="ui-pi-observer"),
        "a fleet": obsynth.run_fleet(folder / "a.gains.json", folder / "log.csv", folder / "out"),
        "a trajectory": obsynth.simulate(PLANT, scenario),
        "a monitor": obsynth.online_monitor(design, disturbance_bounds={"d1": 0.1}, noise_bound=3.0, initial_error=0.0),
        "a decoupled plant": obsynth.decouple(PLANT),
        "an observer": design.observer,
    }


@pytest.mark.parametrize(
    ("which", "words"),
    [
        ("a sweep", "2 designed, 1 malformed"),
        ("a fleet", "1 run"),
        ("a trajectory", "<Trajectory of 61 samples over 60 s: 2 states, 2 outputs, 1 input, 1 fault>"),
        ("a monitor", "<Monitor pointwise: "),
        ("a decoupled plant", "<DecoupledPlant without d1: 1 state and 1 output for f1>"),
        ("an observer", "from 1 input and 2 outputs to 0 states, 1 fault and 1 residual>"),
    ],
)
def test_a_result_prints_as_a_sentence_or_a_table(results: dict[str, object], which: str, words: str) -> None:
    text = str(results[which])
    assert words in text
    assert "array(" not in text
    assert repr(results[which]) == text
