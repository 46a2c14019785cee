"""Recursive designs of plants that were sampled or reduced: plant as written, way back and names are verified."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.results.gain_set_writing import design_as_dict


def written(**changes: Any) -> obsynth.DescriptorSystem:
    """Three dynamic states and an algebraic one; an unknown input that outputs show at once becomes a state."""
    fields: dict[str, Any] = {
        "E": np.diag([1.0, 1.0, 1.0, 0.0]),
        "A": [[-1.0, 0.3, 0.0, 0.5], [0.2, -0.8, 0.4, 0.0], [0.0, 0.1, -0.5, 0.3], [0.6, -0.4, 0.2, 1.0]],
        "B": [[1.0], [0.0], [0.5], [0.3]],
        "C": [[1.0, 0.0, 0.2, 0.0], [0.0, 1.0, 0.0, 0.7], [0.0, 0.0, 1.0, 0.1]],
        "Bf": [[0.0], [1.0], [0.0], [0.2]],
        "Bd": [[0.0], [0.3], [1.0], [0.4]],
        "state_names": ["level", "speed", "heat", "flow"],
        "sensor_noise": {"y1": 0.02, "y2": 0.01, "y3": 0.05},
    }
    return obsynth.DescriptorSystem(**{**fields, **changes})


@cache
def document(method: str) -> str:
    design = getattr(obsynth, method)(obsynth.discretise(written(), 0.25))
    assert design.report.passed
    return json.dumps(design_as_dict(design))


def still_passes(folder: Path, method: str, change: Any) -> bool:
    body = json.loads(document(method))
    change(body["design"])
    text = json.dumps(body["design"], sort_keys=True, separators=(",", ":"))
    body["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    (folder / "changed.json").write_text(json.dumps(body), "utf-8")
    try:
        return obsynth.verify(obsynth.load(folder / "changed.json")).passed
    except obsynth.SpecError:
        return False


def entry(part: str, name: str, place: int, factor: float) -> Any:
    def change(design: dict[str, Any]) -> None:
        held = design[part][name] if part == "recovery" else design[part]["matrices"][name]
        numbers = held["data" if part == "recovery" else "values"]
        assert numbers[place] != 0.0
        numbers[place] *= factor

    return change


def renamed(part: str, name: str) -> Any:
    def change(design: dict[str, Any]) -> None:
        names = design[part][name] if part == "recovery" else design[part]["signals"][name]
        names[0] += " changed"

    return change


def other_time(design: dict[str, Any]) -> None:
    design["source"]["sample_time"] *= 1.001


CHANGES = {
    "state kept": entry("recovery", "from_state", 0, 2.0),
    "way back of an algebraic state": entry("recovery", "from_state", -2, 1.001),
    "effect of an input on it": entry("recovery", "from_input", 3, 1.001),
    "effect of the fault": entry("recovery", "from_fault", 3, 2.0),
    "effect of the unknown input": entry("recovery", "from_disturbance", 3, 2.0),
    "noise": entry("recovery", "noise_kept", 0, 2.0),
    "name of a recovered state": renamed("recovery", "names"),
    "A as written": entry("source", "A", 0, 1.001),
    "C as written": entry("source", "C", 0, 2.0),
    "fault as written": entry("source", "Bf", 0, 1.001),
    "unknown input as written": entry("source", "Bd", 0, 2.0),
    "name of an output as written": renamed("source", "output_names"),
    "name of the fault as written": renamed("source", "fault_names"),
    "sample time": other_time,
}


@pytest.mark.parametrize(
    ("method", "change"),
    [*(("descriptor_kalman", change) for change in CHANGES), ("adaptive_observer", "A as written"),
     ("adaptive_observer", "state kept")],
)  # fmt: skip
def test_a_changed_way_from_the_plant_as_written_is_refused(tmp_path: Path, method: str, change: str) -> None:
    """All of these passed: estimates of the states as written come from the recovery, and nothing compared it."""
    assert not still_passes(tmp_path, method, CHANGES[change])


def test_without_the_plant_as_written_the_way_back_is_assumed_and_kept_states_are_themselves(tmp_path: Path) -> None:
    def without_source(design: dict[str, Any]) -> None:
        design["source"] = None

    assert still_passes(tmp_path, "descriptor_kalman", without_source)

    def and_other_way_back(design: dict[str, Any]) -> None:
        without_source(design)
        CHANGES["state kept"](design)

    assert not still_passes(tmp_path, "descriptor_kalman", and_other_way_back)


@pytest.mark.parametrize(
    "plant",
    [
        written(),
        written(Bd=None, disturbance_names=None),
        written(Dd=[[0.3], [0.0], [1.0]]),
        # Noise of equations and outputs at once becomes states, unless covariances are stated.
        written(dt=0.25, Bd=None, sensor_noise=None, Bw=0.1 * np.eye(4, 3), Dw=0.2 * np.eye(3)),
        written(units={"level": "m", "y1": "m"}, operating_point={"level": 2.0, "u1": 1.0}, scales={"y1": 0.01}),
    ],
)
@pytest.mark.parametrize("options", [{}, {"Q": 0.1, "R": 0.2}])
def test_what_is_designed_passes(plant: obsynth.DescriptorSystem, options: dict[str, float]) -> None:
    proper = obsynth.eliminate_algebraic_states(plant) if plant.dt else obsynth.discretise(plant, 0.25)
    design = obsynth.descriptor_kalman(proper, **options)
    names = {check.name for check in design.report.checks}
    assert design.report.passed
    assert {"plant as written", "recovery as written", "recovery of kept states", "stored twice"} <= names
