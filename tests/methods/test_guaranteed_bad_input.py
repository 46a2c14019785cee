"""What a guaranteed test cannot be asked: the same words in Python, in a spec and on the command line."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

import obsynth
from obsynth.cli.main import main

GOOD = {"samples": 5, "course": "constant", "fault": "leak", "disturbance_bounds": {"inflow": 0.25}, "noise_bound": 3}
#: change of the options (None: left out), the exit code, and what is said.
BAD: dict[str, tuple[dict[str, Any], int, str]] = {
    "no bound of noise": ({"noise_bound": None}, 2, "noise_bound: a standard deviation is no bound"),
    "no bound of disturbances": ({"disturbance_bounds": None}, 2, "largest absolute value of inflow is missing"),
    "a negative bound": (
        {"noise_bound": {"level": -1.0}},
        2,
        r"noise_bound of level is -1.0: give a finite number, 0 or more",
    ),
    "an infinite bound": (
        {"disturbance_bounds": {"inflow": float("inf")}},
        2,
        r"disturbance_bounds of inflow is inf: give a finite number, 0 or more",
    ),
    "a text": ({"noise_bound": "three"}, 2, "noise_bound is 'three': give a number, 0 or more, or one for each name"),
    "a bound of nothing": ({"disturbance_bounds": {"inflow": 0.25, "rain": 1.0}}, 2, "unknown: rain"),
    "an unknown fault in free": ({"free": ["lek"]}, 2, "free names lek"),
    "its own fault in free": ({"free": ["leak"]}, 2, "free names leak"),
    "an unknown fault": ({"fault": "lek"}, 2, "There is no fault 'lek'"),
    "a step that does not fit": ({"course": "step", "before": 5}, 2, "step does not fit in 5 samples"),
    "a lag that does not fit": ({"course": "any", "lag": 5}, 2, "any does not fit in 5 samples"),
    "a lag of a constant": ({"lag": 1}, 2, "lag is for the courses any, ramp and rate"),
    "no rate": ({"course": "rate"}, 2, "course rate needs fault_rate"),
    "samples of none": ({"samples": 0}, 2, "samples is 0: give a whole number of samples, 1 to 1000000, or 'auto'"),
    "samples of a life": ({"samples": 10**9}, 2, "samples is 1000000000: give a whole number of samples, 1 to 1000000"),
    "a bank of one": ({"isolate": True}, 2, "leave fault and free out"),
    "exact in ellipsoids": ({"exact": True, "norm": "ellipsoid"}, 2, "exact is for norm box"),
    "another way with gaps": ({"missing": "guess"}, 2, "missing"),
    "too few samples": ({"samples": 1}, 3, "least number of samples for which there is a test is 2"),
}
PLANT = {
    "dt": 1.0, "state_names": ["x"], "input_names": ["pump"], "output_names": ["level"],
    "disturbance_names": ["inflow"], "fault_names": ["leak"], "A": [[1.0]], "B": [[1.0]], "C": [[1.0]], "Bd": [[1.0]],
    "Bf": [[1.0]], "sensor_noise": {"level": 0.1},
}  # fmt: skip


def written(folder: Path, options: dict[str, Any]) -> Path:
    """Write a spec with these options."""
    document = {
        "schema_version": 1, "name": "leak", "plant": PLANT,
        "method": {"id": "guaranteed-test", "options": {k: v for k, v in options.items() if v is not None}},
    }  # fmt: skip
    with (folder / "spec.yaml").open("w") as stream:
        YAML(typ="safe").dump(document, stream)
    return folder / "spec.yaml"


@cache
def plant() -> obsynth.DescriptorSystem:
    return obsynth.DescriptorSystem(None, PLANT["A"], **{name: value for name, value in PLANT.items() if name != "A"})


@pytest.mark.parametrize("name", BAD)
def test_python_spec_and_command_line_say_what_is_wrong_and_write_nothing(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, code, words = BAD[name]
    options = {**GOOD, **change}
    with pytest.raises(obsynth.ObsynthError, match=words) as caught:
        obsynth.guaranteed_test(plant(), **options)
    assert caught.value.exit_code == code
    spec = written(tmp_path, options)
    assert main(["design", "--system", str(spec), "--output", str(tmp_path / "leak.gains.json")]) == code
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(words, said), said
    assert [file.name for file in tmp_path.iterdir()] == ["spec.yaml"]


def test_options_of_a_spec_reach_the_design(tmp_path: Path) -> None:
    options = {**GOOD, "exact": True, "missing": "solve"}
    spec = obsynth.load_spec(written(tmp_path, options))
    design = obsynth.design(spec.plant, spec.method, **spec.options)
    assert (design.options["exact"], design.options["missing"]) == (True, "solve")
    bank = {name: value for name, value in options.items() if name != "fault"} | {"isolate": True}
    target = tmp_path / "bank.json"
    assert main(["design", "--system", str(written(tmp_path, bank)), "--output", str(target), "--quiet"]) == 0
    assert obsynth.load(target).options["isolate"] is True
    assert main(["verify", str(target)]) == 0


def test_deviations_of_noise_that_nobody_states_are_refused() -> None:
    quiet = plant().replace(Bw=None, Dw=None, noise_names=None)
    with pytest.raises(obsynth.SpecError, match="states no noise of which this is a number of deviations"):
        obsynth.guaranteed_test(quiet, **GOOD)
    bounded = obsynth.guaranteed_test(quiet, **{**GOOD, "noise_bound": {"level": 0.3}})
    assert bounded.threshold == pytest.approx(obsynth.guaranteed_test(plant(), **GOOD).threshold, rel=1e-9)
    assert "disturbances and noise within their stated bounds" in " ".join(str(bounded).split())
    assert "no sensor noise given" in str(obsynth.guaranteed_test(quiet, **{**GOOD, "noise_bound": None}))


def test_a_log_shorter_than_the_window_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    test = obsynth.guaranteed_test(plant(), **GOOD)
    log = pd.DataFrame({"time": np.arange(4.0), "pump": np.zeros(4), "level": np.zeros(4)})
    with pytest.raises(obsynth.SpecError, match="The log has 4 rows, but a window of 'design' has 5 samples"):
        obsynth.run_on_data(test, log, tmp_path / "out.csv", monitor=obsynth.online_monitor(test))
    assert not list(tmp_path.iterdir())
    # A stream, and a run that goes on from another, may have few rows.
    assert obsynth.run_on_data(test, log, tmp_path / "out.csv", state=tmp_path / "state").rows == 4
    with pytest.raises(obsynth.SpecError, match="The record has 4 samples, but a window of the test has 5"):
        obsynth.monitor(test, obsynth.Scenario(horizon=3.5))
