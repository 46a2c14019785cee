"""Time tables: courses through given points, in Python and in specs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth

WRONG = {
    "times that stand": ({"times": [0.0, 0.0], "values": [1.0, 2.0]}, "times must increase: 0 s follows 0 s"),
    "too few values": ({"times": [0.0, 1.0], "values": [1.0]}, "times has 2 entries, values has 1"),
    "no points": ({"times": [], "values": []}, "times must be a list of finite numbers, one or more"),
    "a gap": ({"times": [0.0, 1.0], "values": [1.0, np.nan]}, "values must be a list of finite numbers"),
    "a curve": ({"times": [0.0], "values": [1.0], "interpolation": "cubic"}, "use one of linear, held"),
}


def test_a_recorded_input_is_what_the_plant_gets() -> None:
    """A log at another rate than the plant's: straight lines between its points, exact for a continuous integrator."""
    plant = obsynth.DescriptorSystem(A=[[0.0]], B=[[1.0]], C=[[1.0]])
    log = pd.DataFrame({"time": [0.0, 0.7, 1.9, 4.0], "speed": [0.0, 2.0, -1.0, 0.5]})
    speed = obsynth.TimeTable(times=log["time"], values=log["speed"])
    run = obsynth.simulate(plant, obsynth.Scenario(horizon=4.0, sample_time=0.1, inputs={"u1": speed}))
    area = np.sum(0.5 * np.diff(log["time"]) * (log["speed"].to_numpy()[1:] + log["speed"].to_numpy()[:-1]))
    assert run.outputs[-1, 0] == pytest.approx(area, abs=1e-12)
    held = obsynth.TimeTable(times=log["time"], values=log["speed"], interpolation="held")
    run = obsynth.simulate(plant, obsynth.Scenario(horizon=4.0, sample_time=0.1, inputs={"u1": held}))
    area = np.sum(np.diff(log["time"]) * log["speed"].to_numpy()[:-1])
    assert run.outputs[-1, 0] == pytest.approx(area, abs=1e-12)


def test_outside_of_its_times_the_first_and_the_last_value_stay() -> None:
    table = obsynth.TimeTable(times=[2.0, 3.0], values=[5.0, 7.0], start=1.0, end=6.0)
    np.testing.assert_array_equal(table.sampled(8, 1.0)[0], [0.0, 5.0, 5.0, 7.0, 7.0, 7.0, 0.0, 0.0])


@pytest.mark.parametrize("case", WRONG)
def test_what_is_no_table_is_refused(case: str) -> None:
    arguments, told = WRONG[case]
    with pytest.raises(obsynth.SpecError, match=told):
        obsynth.TimeTable(**arguments)


SPEC = """
schema_version: 1
name: tank
plant: {A: [[0.5]], B: [[1.0]], C: [[1.0]], Bf: [[1.0]], dt: 1.0}
scenario:
  horizon: 5
  inputs:
    u1: {kind: time-table, times: [0, 2, 4], values: [0, 1, 1], interpolation: held}
method: {id: functional-filter}
"""


def test_a_spec_states_one(tmp_path: Path) -> None:
    path = tmp_path / "spec.yaml"
    path.write_text(SPEC)
    spec = obsynth.load_spec(path)
    run = obsynth.simulate(spec.plant, spec.scenario)
    np.testing.assert_array_equal(run.inputs[:, 0], [0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    path.write_text(SPEC.replace("[0, 1, 1]", "[0, 1]"))
    with pytest.raises(obsynth.SpecError, match="times has 3 entries, values has 2"):
        obsynth.load_spec(path)
    path.write_text(SPEC.replace("[0, 1, 1]", "[0, x, 1]"))
    with pytest.raises(obsynth.SpecError, match="values"):
        obsynth.load_spec(path)
