"""Calibration file -> box -> plant with tolerances -> gain set -> alarm: each link is named by digest and compared."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.plants.constants import constants_box
from obsynth.results.calibration_files import box_row, calibration_text, read_calibration, verify_calibration
from obsynth.results.gain_set_writing import digest_of

DESIGNS = Path(__file__).parents[2] / "designs"
SPEC, LOG = DESIGNS / "threetank" / "spec.yaml", DESIGNS / "threetank" / "log.csv"


def stated() -> dict[str, object]:
    """A calibration of the stiffness of the drive, as the verb writes it."""
    constants = {"k": {"nominal": 20.0, "range": [19.0, 21.0], "open": [], "unit": "N m/rad"}}
    return {"level": 0.95, "stands": True, "log": {"digest": "cd" * 32}, "constants": constants}


def drive_spec(folder: Path) -> Path:
    """The drive of the examples, whose stiffness has the range of a calibration file."""
    plant = (DESIGNS / "drive" / "plant.yaml").read_text()
    line = "k: {nominal: 20.0, tolerance: 5 %, unit: N m/rad}"
    assert line in plant
    plant = plant.replace(line, "k: {nominal: 20.0}")
    plant = plant.replace("variation: constant", "variation: constant\nbox: {file: box.json}")
    (folder / "plant.yaml").write_text(plant)
    (folder / "box.json").write_text(calibration_text(stated()))
    spec = "schema_version: 1\nname: drive\nplant: {file: plant.yaml}\nmethod: {id: fault-estimation-filter}\n"
    (folder / "spec.yaml").write_text(spec)
    return folder / "spec.yaml"


@cache
def gain_set() -> str:
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        spec = drive_spec(Path(name))
        assert main(["design", "--system", str(spec), "--output", f"{name}/g.json", "--quiet", "--json"]) == 0
        return (Path(name) / "g.json").read_text()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "box.json").write_text(calibration_text(stated()))
    (tmp_path / "gains.json").write_text(gain_set())
    return tmp_path


@pytest.mark.long
def test_a_gain_set_names_its_calibration(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", "gains.json", "-v"]) == 0
    assert "assumed" in capsys.readouterr().out
    assert main(["verify", "gains.json", "--calibration", "box.json"]) == 0
    wider = stated()
    wider["constants"]["k"]["range"] = [18.0, 22.0]
    (folder / "box.json").write_text(calibration_text(wider))
    capsys.readouterr()
    assert main(["verify", "gains.json", "--calibration", "box.json", "--json"]) == 6
    told = json.loads(capsys.readouterr().out)
    failing = [row["detail"] for row in told["report"]["checks"] if not row["passed"]]
    assert failing == ["wrong: digest of the calibration, k"]


@pytest.mark.one_in(5)
@pytest.mark.parametrize("change", ["range", "level", "digest", "nominal", "unit"])
def test_an_edited_calibration_is_refused(folder: Path, change: str) -> None:
    content = json.loads((folder / "box.json").read_text())
    item = content["constants"]["k"]
    if change == "range":
        item["range"] = [19.99, 20.01]
    elif change == "level":
        content["level"] = 0.9999
    elif change == "digest":
        content["log"]["digest"] = "ab" * 32
    else:
        item[change] = 20.1 if change == "nominal" else "N"
    (folder / "box.json").write_text(json.dumps(content))
    with pytest.raises(obsynth.SpecError, match="changed after it was written"):
        read_calibration(folder / "box.json")
    assert main(["verify", "box.json"]) == 6


@pytest.mark.parametrize(
    ("where", "value", "told"),
    [
        (("constants",), [1], "is damaged: constants"),
        (("constants", "k"), 3, "is damaged: k"),
        (("constants", "k", "unit"), None, "is damaged: k"),
        (("constants", "k", "open"), 0, "is damaged: k"),
        (("constants", "k", "range"), [21.0, 19.0], "is damaged: k"),
        (("log",), "log.csv", "is damaged: log"),
        (("stands",), None, "is damaged: stands"),
        (("schema_version",), 2, "schema version 2, and this obsynth reads 1"),
        (("stands",), False, "is not valid: .* 95 % is not its level"),
        (("constants", "k", "unit"), "N/m", "'k' is in N m/rad here, and in N/m in box.json"),
    ],
)
def test_what_is_no_box_of_the_plant_is_refused(folder: Path, where: tuple[str, ...], value: object, told: str) -> None:
    """The digest is right: the file is of another version or plant, or its box does not hold what it says."""
    spec, found = drive_spec(folder), stated()
    holder = found
    for name in where[:-1]:
        holder = holder[name]
    holder[where[-1]] = value
    (folder / "box.json").write_text(calibration_text(found))
    plant = folder / "plant.yaml"
    plant.write_text(plant.read_text().replace("k: {nominal: 20.0}", "k: {nominal: 20.0, unit: N m/rad}"))
    with pytest.raises(obsynth.SpecError, match=told):
        obsynth.load_spec(spec)


def test_a_unit_of_the_plant_stays_where_the_calibration_has_none(folder: Path) -> None:
    spec, found = drive_spec(folder), stated()
    found["constants"]["k"]["unit"] = "1"
    (folder / "box.json").write_text(calibration_text(found))
    plant = folder / "plant.yaml"
    plant.write_text(plant.read_text().replace("k: {nominal: 20.0}", "k: {nominal: 20.0, unit: N m/rad}"))
    assert obsynth.load_spec(spec).plant.uncertainty.box.constants["k"].unit == "N m/rad"


def test_a_calibration_without_a_digest_is_asked_for_again(folder: Path) -> None:
    content = json.loads((folder / "box.json").read_text())
    del content["sha256"]
    (folder / "box.json").write_text(json.dumps(content))
    with pytest.raises(obsynth.SpecError, match="calibrate again"):
        read_calibration(folder / "box.json")


@pytest.mark.long
def test_a_calibration_is_done_again_from_plant_and_log(folder: Path) -> None:
    words = ["--system", str(SPEC), "--data", str(LOG)]
    asked = ["--rows", "0:56", "--unknown", "a1=0.005:0.08", "--quiet"]
    assert main(["calibrate", *words, *asked, "--out", "tank.json"]) == 0
    assert main(["verify", "tank.json"]) == 0
    assert main(["verify", "tank.json", *words]) == 0
    assert main(["verify", "tank.json", "--data", str(LOG)]) == 2
    content = json.loads((folder / "tank.json").read_text())
    item = content["constants"]["a1"]
    middle = item["nominal"]
    item["range"] = [middle + 0.01 * (end - middle) for end in item["range"]]
    del content["sha256"]
    (folder / "tank.json").write_text(json.dumps({"kind": content["kind"], "sha256": digest_of(content), **content}))
    # With a digest made anew it is the log that tells.
    assert verify_calibration("tank.json").passed
    assert main(["verify", "tank.json", *words]) == 6


def test_each_entry_of_a_calibration_is_compared_with_the_same_done_again(folder: Path) -> None:
    """A row fails by its name where log, unit, open sides, nominal value, range or level are others."""
    again = stated()
    assert verify_calibration("box.json", again).passed
    changes = {
        "unit": ("ranges", lambda data: data["constants"]["k"].update(unit="N")),
        "open": ("ranges", lambda data: data["constants"]["k"].update(open=["low"])),
        "nominal": ("ranges", lambda data: data["constants"]["k"].update(nominal=20.05)),
        "low": ("ranges", lambda data: data["constants"]["k"].update(range=[19.05, 21.0])),
        "high": ("ranges", lambda data: data["constants"]["k"].update(range=[19.0, 21.05])),
        "level": ("ranges", lambda data: data.update(level=0.9)),
        "name": ("ranges", lambda data: data["constants"].update(c=data["constants"]["k"])),
        "log": ("log", lambda data: data["log"].update(digest="ab" * 32)),
    }
    for name, (row, change) in changes.items():
        other = stated()
        change(other)
        assert {check.name for check in verify_calibration("box.json", other).failures} == {row}, name
    near = stated()
    near["constants"]["k"]["range"] = [19.001, 21.001]
    assert verify_calibration("box.json", near).passed


@pytest.mark.parametrize("change", ["digest", "level", "log", "low", "high", "nominal"])
def test_each_entry_of_a_box_is_compared_with_its_calibration(folder: Path, change: str) -> None:
    text = calibration_text(stated())
    digest = json.loads(text)["sha256"]
    ends = {"low": 19.0, "high": 21.0, "nominal": 20.0}
    if change in ends:
        ends[change] += 0.25
    constant = {"nominal": ends["nominal"], "range": [ends["low"], ends["high"]]}
    asked = {
        "calibration": "ab" * 32 if change == "digest" else digest,
        "digest": "ab" * 32 if change == "log" else "cd" * 32,
        "level": 0.9 if change == "level" else 0.95,
    }
    good = {"calibration": digest, "digest": "cd" * 32, "level": 0.95}
    true = constants_box({"k": {"nominal": 20.0, "range": [19.0, 21.0]}}, source="calibrated", **good)
    assert box_row(true, folder / "box.json").passed
    assert not box_row(constants_box({"k": constant}, source="calibrated", **asked), folder / "box.json").passed


def test_options_that_do_nothing_are_refused(folder: Path) -> None:
    assert main(["verify", "gains.json", "--data", "box.json"]) == 2
    assert main(["verify", "box.json", "--calibration", "box.json"]) == 2
    assert main(["verify", "box.json", "--printed-digits", "3"]) == 2
