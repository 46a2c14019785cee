"""False alarms and least faults against the tolerance, of a fixed bound and of an adaptive one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.errors import SpecError
from obsynth.specs.loader import load_spec

DRIVE = Path(__file__).parents[2] / "designs" / "drive" / "spec.yaml"


@pytest.fixture(scope="module")
def drive():
    spec = load_spec(DRIVE)
    return obsynth.design(spec.plant, spec.method, **dict(spec.options)), spec.scenario


@pytest.mark.long
def test_the_fixed_bound_alarms_and_the_adaptive_one_grows(drive) -> None:
    found = obsynth.tolerance_study(*drive, tolerances=[0, "5 %", "10 %"], runs=8, noise_bound=4.0)
    assert found.tolerances.tolist() == [0.0, 0.05, 0.1]
    assert (found.false_alarms[:, 1] == 0.0).all()
    assert found.false_alarms[0, 0] == 0.0
    assert found.false_alarms[2, 0] > 0.2
    adaptive = found.least_faults[:, 1]
    assert (np.diff(adaptive) > 0.05).all()
    # Without tolerances both are one bound, but for what is told by rows of their own.
    assert adaptive[0] <= 1.06 * found.least_faults[0, 0]
    table = str(found).splitlines()
    assert max(map(len, table[:-1])) < 80
    assert table[-1].startswith("Take the adaptive threshold: the fixed bound has false alarms from ")
    axes = obsynth.plotting.plot_tolerances(found)
    assert [line.get_label() for line in axes[1].get_lines()] == ["fixed bound", "adaptive threshold"]
    assert axes[1].get_lines()[1].get_ydata() == pytest.approx(adaptive)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"tolerances": []}, "give a list"), ({"tolerances": [-0.1]}, "tolerance is -0.1"), ({"fault": "x"}, "'x'"),
     ({"runs": 0}, "runs is 0")],
)  # fmt: skip
def test_refused_studies(drive, options: dict, words: str) -> None:
    with pytest.raises(SpecError, match=words):
        obsynth.tolerance_study(*drive, **options)
    bare = drive[0].replace(plant=drive[0].plant.replace(uncertainty=None))
    with pytest.raises(SpecError, match="No constant of the plant has a tolerance: state some in the plant, such"):
        obsynth.tolerance_study(bare, drive[1])
    varying = obsynth.design(drive[0].plant, "descriptor-kalman")
    with pytest.raises(SpecError, match="is by descriptor-kalman: leave tolerances out, or take a linear method"):
        obsynth.tolerance_study(varying, drive[1])


@pytest.mark.long
def test_the_command_writes_the_picture(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    picture = tmp_path / "t.svg"
    asked = ["evaluate", "--system", str(DRIVE), "--tolerances", "0,5%", "--runs", "3", "--noise-bound", "4",
             "--out", str(picture), "--json", "--quiet"]  # fmt: skip
    assert main(asked) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["tolerances"] == [0.0, 0.05]
    assert picture.read_text(encoding="utf-8").count("adaptive threshold") > 0
    assert main([*asked[:3], "--out", str(picture)]) == 2
    assert main([*asked, "--plants", "3"]) == 2
    assert "--tolerances" in capsys.readouterr().out
