"""``obsynth linearise``, ``calibrate`` and ``validate``: specs and logs in, tables, files and exit codes out."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.specs.loader import load_spec

DESIGN = Path(__file__).parents[2] / "designs" / "threetank"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("threetank")
    for name in ("plant.yaml", "spec.yaml", "log.csv"):
        shutil.copy(DESIGN / name, place / name)
    return place


@pytest.fixture(scope="module")
def gains(folder):
    path = folder / "gains.json"
    assert main(["design", "--system", str(folder / "spec.yaml"), "--output", str(path), "--quiet"]) == 0
    return path


def test_linearise_names_the_combination_that_nothing_can_satisfy(folder, capsys):
    assert main(["linearise", "--system", str(folder / "plant.yaml")]) == 3
    assert "tank1 + tank2 + tank3" in capsys.readouterr().err


def test_linearise_writes_a_plant_that_a_linear_method_takes(folder, capsys):
    target = folder / "linear.yaml"
    arguments = ["--given", "leak=0.03", "--given", "h1=0.7", "--given", "h3=0.65", "--free", "u1=0:1", "--free", "u3"]
    assert main(["linearise", "--system", str(folder / "spec.yaml"), *arguments, "--out", str(target)]) == 0
    assert "Operating point" in capsys.readouterr().out
    (folder / "linear_spec.yaml").write_text(
        "schema_version: 1\nname: linear\nplant: {file: linear.yaml, transform: {sample_time: 1.0}}\n"
        "method: {id: pd-observer}\n",
        encoding="utf-8",
    )
    plant = load_spec(folder / "linear_spec.yaml").plant
    assert plant.is_discrete
    assert plant.operating_point["h1"] == 0.7


def test_a_spec_linearises_its_plant_for_a_linear_method(folder):
    (folder / "direct.yaml").write_text(
        "schema_version: 1\nname: direct\n"
        "plant:\n  file: plant.yaml\n  transform:\n    linearise: {given: {leak: 0.03, h1: 0.7, h3: 0.65}, "
        "free: [u1, u3]}\n"
        "    sample_time: 1.0\n"
        "method: {id: pd-observer}\n",
        encoding="utf-8",
    )
    spec = load_spec(folder / "direct.yaml")
    model = spec.model
    linear = obsynth.linearise(model, given={"leak": 0.03, "h1": 0.7, "h3": 0.65}, free=["u1", "u3"])
    assert np.array_equal(spec.plant.A, obsynth.discretise(linear, 1.0).plant.A)
    assert spec.plant.fault_names == ("leak",)


@pytest.mark.long
def test_calibrate_takes_everything_from_the_spec(folder, capsys):
    target = folder / "calibration.json"
    assert main(["calibrate", "--system", str(folder / "spec.yaml"), "--out", str(target), "--quiet"]) == 0
    # Quiet is without progress, not without the answer.
    said = capsys.readouterr()
    assert "95 % box" in said.out
    assert not said.err
    found = json.loads(target.read_text(encoding="utf-8"))
    assert found["constants"]["a1"]["nominal"] == pytest.approx(0.0163, abs=1e-4)
    assert found["log"]["rows"] == [0, 56]


@pytest.mark.long
def test_a_spec_as_the_file_of_a_calibration_names_the_option_for_it(folder, capsys):
    assert main(["calibrate", "--system", str(folder / "spec.yaml"), "--out", "calibrated.yaml", "--quiet"]) == 2
    assert "--write-spec calibrated.yaml" in " ".join(capsys.readouterr().err.split())


@pytest.mark.long
def test_a_calibration_can_be_made_again(folder, capsys):
    """Of one constant, which takes less time than four."""
    spec, kept = folder / "one.yaml", "  unknown: {a1: [0.005, 0.08]}"
    lines = (folder / "spec.yaml").read_text(encoding="utf-8").splitlines()
    assert sum(line.startswith("  unknown: ") for line in lines) == 1
    text = "\n".join(kept if line.startswith("  unknown: ") else line for line in lines) + "\n"
    spec.write_text(text, encoding="utf-8")
    assert main(["calibrate", "--system", str(spec), "--json", "--quiet"]) == 0
    found = json.loads(capsys.readouterr().out)
    spec.write_text(text + f"  digest: {found['log']['digest']}\n", encoding="utf-8")
    assert main(["calibrate", "--system", str(spec), "--json", "--quiet"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["constants"] == found["constants"]
    assert list(found["constants"]) == ["a1"]
    assert main(["calibrate", "--system", str(spec), "--rows", "0:50", "--quiet"]) == 2
    assert "digest" in capsys.readouterr().err


@pytest.mark.long
def test_validate_says_yes_and_no_by_its_exit_code(folder, gains, capsys):
    columns = ["--map", "u1=u1_held", "--map", "u3=u3_held", "--data", str(folder / "log.csv")]
    capsys.readouterr()
    assert main(["validate", "--gains", str(gains), *columns, "--rows", "0:56", "--quiet"]) == 0
    assert "agrees" in capsys.readouterr().out
    assert main(["validate", "--gains", str(gains), *columns, "--json"]) == 6
    printed = capsys.readouterr()
    assert not json.loads(printed.out)["passed"]
    assert "variances that the log makes likeliest" in printed.err  # seconds to minutes on a long log


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["calibrate", "--system", "spec.yaml", "--data", "missing.csv"], 2),
        (["calibrate", "--system", "spec.yaml", "--unknown", "a1=5"], 2),
        (["calibrate", "--system", "spec.yaml", "--rows", "0:3"], 2),
        (["linearise", "--system", "plant.yaml", "--given", "h9=1"], 2),
        (["linearise", "--system", "plant.yaml", "--given", "leak=.03", "--given", "h1=.4", "--given", "h2=.6",
          "--free", "u1=0:1", "--free", "u3"], 3),
    ],
)  # fmt: skip
def test_what_is_wrong_has_an_exit_code(folder, monkeypatch, arguments, code):
    monkeypatch.chdir(folder)
    assert main(arguments) == code


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda log: log.iloc[:10], "too-short"),
        (lambda log: log.assign(v2=1000.0 * log.v2), "explains-nothing"),
        (lambda log: log.assign(v1=log.v1 / 1000.0, v2=log.v2 / 1000.0, v3=log.v3 / 1000.0), "explains-nothing"),
        (lambda log: log.assign(time=log.time + 0.3 * np.sin(9.0 * np.arange(56))), "irregular"),
        (lambda log: log.assign(u1=np.nan), "nan"),
        (lambda log: log.assign(v1=0.5, v2=0.5, v3=0.5, u1=0.0, u3=0.0), "not-exciting"),
        (lambda log: log.assign(v1=np.sin(0.3 * np.arange(56)), v2=1.0 - log.v2, v3=np.cos(np.arange(56))),
         "explains-nothing"),
    ],
)  # fmt: skip
def test_logs_that_cannot_be_used_have_a_code_in_the_json(folder, tmp_path, capsys, change, code):
    import pandas as pd

    change(pd.read_csv(folder / "log.csv").iloc[:56]).to_csv(tmp_path / "log.csv", index=False)
    arguments = ["--data", str(tmp_path / "log.csv"), "--rows", ":", "--json", "--quiet"]
    assert main(["calibrate", "--system", str(folder / "spec.yaml"), *arguments]) in (2, 3)
    assert json.loads(capsys.readouterr().out)["code"] == code


@pytest.mark.long
def test_the_report_on_a_log_says_whether_it_agrees(folder, gains, capsys):
    page = folder / "report.html"
    columns = ["--map", "u1=u1_held", "--map", "u3=u3_held", "--data", str(folder / "log.csv")]
    shown = []
    for rows in (["--rows", "0:56"], []):
        arguments = ["report", "--gains", str(gains), *columns, *rows, "--out", str(page), "--force"]
        assert main(arguments) == 0
        text = page.read_text(encoding="utf-8")
        shown.append(text[text.index('id="comparison-with-your-data"') :].partition("</section>")[0])
    assert "Rows 0:56 of the log agree with the design." in shown[0]
    assert "NIS" in shown[0]
    assert shown[0].count("<img") == 1
    assert "The log, taken as free of faults, does not agree" in shown[1]
    assert "not free of faults" in shown[1]
