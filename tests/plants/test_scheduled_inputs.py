"""Plants that are scheduled by one of their own signals: by a known input, by what is measured, by what is not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth import DescriptorSystem, PolytopicSystem, SpecError

PLANT: dict[str, Any] = {
    "A": [["0.5 + 0.1 * flow", 0.1], [0.1, 0.8]],
    "B": [[0.3, 0.2], ["1 + flow", 0.4]],
    "C": [[1, 0], [0, 1]],
    "Bf": [[0.1], [1]],
    "Bd": [[1], [0.5]],
    "dt": 1.0,
    "input_names": ["flow", "heat"],
    "state_names": ["level", "temperature"],
    "fault_names": ["leak"],
}


def test_a_known_input_that_schedules_is_read_once_and_acts_as_before() -> None:
    plant = PolytopicSystem(plant=PLANT, scheduling={"flow": [0, 2]})
    assert (plant.input_names, plant.shift) == (("heat", "shift"), "shift")
    at = plant.at({"flow": 1.5})
    assert at.A[0, 0] == pytest.approx(0.65)
    # flow = 1.5: [0.3, 1 + 1.5] times it.
    assert pytest.approx(np.array([[0.2, 0.45], [0.4, 3.75]])) == at.B
    again = PolytopicSystem.from_dict(plant.as_dict())
    assert again.shift == "shift"
    assert np.array_equal(again.at({"flow": 1.5}).B, at.B)


def test_beside_an_operating_point_the_input_acts_by_its_deviation() -> None:
    plant = PolytopicSystem(
        plant={**PLANT, "B": [[0.3, 0.2], [0, 0.4]], "operating_point": {"flow": 0.5, "heat": 2.0}},
        scheduling={"flow": [0, 2]},
    )
    assert plant.at({"flow": 1.5}).B[0, 1] == pytest.approx(0.3 * 1.0)
    assert dict(plant.operating_point) == {"heat": 2.0, "shift": 0.0}


def test_a_log_has_one_column_of_the_input_and_the_estimates_are_right() -> None:
    rng = np.random.default_rng(5)
    flow, heat, leak = rng.uniform(0, 2, 60), rng.normal(size=60), np.where(np.arange(60) > 20, 0.7, 0.0)
    state, rows = np.array([0.4, -0.2]), []
    for k in range(60):
        rows.append({"time": float(k), "flow": flow[k], "heat": heat[k], "y1": state[0], "y2": state[1]})
        state = np.array([
            (0.5 + 0.1 * flow[k]) * state[0] + 0.1 * state[1] + 0.3 * flow[k] + 0.2 * heat[k] + 0.1 * leak[k],
            0.1 * state[0] + 0.8 * state[1] + (1 + flow[k]) * flow[k] + 0.4 * heat[k] + leak[k],
        ])  # fmt: skip
    design = obsynth.fault_estimation_filter(PolytopicSystem(plant=PLANT, scheduling={"flow": [0, 2]}))
    table = obsynth.run_on_data(design, pd.DataFrame(rows)).table
    found = table["fhat[leak]"].to_numpy()
    assert found[15:20] == pytest.approx(0.0, abs=1e-9)
    assert found[25:] == pytest.approx(0.7, abs=1e-9)


@pytest.mark.parametrize("column", [None, "flow"])
def test_an_input_by_its_own_name_or_by_a_column(column: str | None) -> None:
    name = "flow" if column is None else "rate"
    text = {**PLANT, "A": [[f"0.5 + 0.1 * {name}", 0.1], [0.1, 0.8]], "B": [[0.3, 0.2], [0, 0.4]]}
    plant = PolytopicSystem(plant=text, scheduling={name: {"range": [0, 2], "column": column}})
    assert plant.scheduling.read_names == ("flow",)
    assert plant.input_names == ("heat", "shift")


@pytest.mark.parametrize(("name", "kind"), [("level", "a state"), ("leak", "a fault"), ("d1", "an unknown input")])
def test_what_is_not_measured_schedules_nothing(name: str, kind: str) -> None:
    plant = {**PLANT, "A": [[f"0.5 + 0.1 * {name}", 0.1], [0.1, 0.8]], "B": None}
    plant = {key: value for key, value in plant.items() if key != "input_names"}
    with pytest.raises(SpecError, match=f"'{name}' is {kind} of the plant: an estimated parameter"):
        PolytopicSystem(plant=plant, scheduling={name: [0, 2]})
    # The remedy: an output shows it.
    assert PolytopicSystem(plant=plant, scheduling={name: {"range": [0, 2], "column": "y1"}}).count == 2


def test_two_vertices_do_not_tell_what_an_input_does() -> None:
    vertices = [DescriptorSystem(A=[[a]], B=[[1.0]], C=[[1.0]], dt=1.0) for a in (0.2, 0.6)]
    with pytest.raises(SpecError, match="'u1' is a known input"):
        PolytopicSystem(vertices, scheduling={"u1": [0, 1]})


@pytest.mark.parametrize(("key", "value"), [("delays", {"flow": 2.0}), ("scales", {"flow": 0.5})])
def test_an_input_that_acts_otherwise_than_it_is_logged_is_refused(key: str, value: dict[str, float]) -> None:
    with pytest.raises(SpecError, match=f"'flow' schedules the plant and has {key}"):
        PolytopicSystem(plant={**PLANT, key: value}, scheduling={"flow": [0, 2]})
