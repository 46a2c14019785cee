"""The how-to from equations and two logs to an alarm: its commands are run as they stand, and what it claims is so."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from obsynth.cli.main import main
from obsynth.specs.documents import read_yaml

pytestmark = pytest.mark.long

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def oven(tmp_path_factory):
    """The folder after all commands, in order, with what each printed and returned."""
    folder = tmp_path_factory.mktemp("oven")
    for path in (DOCS / "examples" / "oven").iterdir():
        shutil.copy(path, folder)
    subprocess.run([sys.executable, "make_logs.py"], cwd=folder, check=True)
    page = (DOCS / "howto" / "alarm.md").read_text(encoding="utf-8")
    commands = re.findall(r"^obsynth (.*)$", page, re.MULTILINE)
    assert len(commands) == 8
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        codes = [main([*shlex.split(command), "--quiet"]) for command in commands]
    return folder, dict(zip(commands, codes, strict=True))


def alarms(path: Path) -> np.ndarray:
    """Times of the rows with an alarm, with its text."""
    import pandas as pd

    table = pd.read_csv(path)
    return table.loc[table["alarm"].notna(), ["time", "alarm"]].to_numpy()


def test_every_command_succeeds_and_the_design_agrees_with_its_log(oven):
    assert set(oven[1].values()) == {0}


def test_the_calibrated_spec_carries_on_everything(oven):
    found = read_yaml(oven[0] / "calibrated.yaml")
    plant, options = found["plant"], found["method"]["options"]
    assert plant["constants"]["C1"] == pytest.approx(2.1, abs=0.02)
    assert plant["constants"]["k"] == pytest.approx(0.052, abs=0.0005)
    noise = plant["sensor_noise"]["T case"]
    assert noise["deviation"] == pytest.approx(0.2 / np.sqrt(1.0 - 0.81), rel=0.3)
    assert noise["correlation"] == pytest.approx(-10.0 / np.log(0.9), rel=0.5)
    assert plant["walks"]["room"] == pytest.approx(0.1 / np.sqrt(10.0), rel=0.5)
    assert options["integration"] == "radau"
    assert set(options["Q"]) == {"core", "noise_T_case", "room"}
    assert options["R"]["T core"] == pytest.approx(0.0025, rel=0.3)
    assert found["calibrate"]["input_delay"] == 0
    assert len(found["calibrate"]["digest"]) == 64


def test_the_normal_log_is_quiet_and_the_fault_is_named_one_sample_late(oven):
    assert len(alarms(oven[0] / "normal_estimates.csv")) == 0
    found = alarms(oven[0] / "estimates.csv")
    assert found[0].tolist() == [2410.0, "nis: lost"]


def test_the_box_and_the_threshold_over_it(oven):
    found = read_yaml(oven[0] / "tolerances.yaml")
    assert found["plant"]["box"] == {"file": "box.json"}
    import pandas as pd

    table = pd.read_csv(oven[0] / "tolerant_estimates.csv")
    assert table["alarm"].isna().all()
    row = table[table["time"] == 2400.0].iloc[0]
    assert row["statistic"] == pytest.approx(0.3, abs=0.05)
    assert row["threshold"] == pytest.approx(0.9, abs=0.1)


def test_offsets_that_the_room_explains_too_are_named(oven):
    from obsynth import check, load_spec

    text = (oven[0] / "tolerances.yaml").read_text(encoding="utf-8")
    path = oven[0] / "offset.yaml"
    path.write_text(
        text.replace("  walks:", "  offset: {T case: unknown, T core: unknown}\n  walks:"), encoding="utf-8"
    )
    report = check(load_spec(path).plant)["descriptor-kalman"]
    assert not report.passed
    (told,) = [row.detail for row in report.failures]
    assert "offset_T_case" in told
    assert "offset_T_core" in told
    assert "room" in told
