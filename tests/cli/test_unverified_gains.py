"""What fails its verification is refused by every verb that hands it on, or marked wherever it is written."""

from __future__ import annotations

import json
import re
import zipfile
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import loadmat

import obsynth
from obsynth.cli.main import main

DESIGNS = Path(__file__).parents[2] / "designs"
VERBS = {
    "export --to out.c": "out.h", "export --to out.mat": "out.mat", "export --to out.npz": "out.npz",
    "export --to out.fmu": "out.fmu", "run --data log.csv --out out.csv": "out.csv",
    "plot --data log.csv --out out.png --quiet": "out.png",
    "prove-alarm --data log.csv --row 20 --state-bound x1=1 --disturbance w=1 --out out.json": None,
}  # fmt: skip


@cache
def failing() -> obsynth.ObserverDesign:
    """Gains times 1.3: a spectral radius of 1.116."""
    plant = obsynth.load_spec(DESIGNS / "wang2015" / "spec.yaml").plant
    gains = obsynth.fault_estimation_filter(plant, weight="paper").gains
    return obsynth.design_from_gains(
        plant, "fault-estimation-filter", T=gains["T"], N=gains["N"], L=1.3 * gains["L"], W=gains["W"], gamma=1.5,
        name="wrong",
    )  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    design = failing()
    design.save(tmp_path / "wrong.gains.json")
    names = (*design.plant.input_names, *design.plant.output_names)
    pd.DataFrame({"time": np.arange(30), **dict.fromkeys(names, np.zeros(30))}).to_csv("log.csv", index=False)
    return tmp_path


def written(file: Path) -> str:
    if file.suffix == ".fmu":
        with zipfile.ZipFile(file) as archive:
            return archive.read("modelDescription.xml").decode()
    if file.suffix == ".mat":
        return str(loadmat(file)["unverified"])
    if file.suffix == ".npz":
        return str(np.load(file)["unverified"])
    return file.read_text()


@pytest.mark.one_in(4)
@pytest.mark.parametrize("line", VERBS)
def test_failing_gains_are_refused_or_marked(folder: Path, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    verb, *rest = line.split()
    words = [verb, "--gains", "wrong.gains.json", *rest]
    assert main(words) == 6
    captured = capsys.readouterr()
    assert "spectral radius" in captured.err
    assert not list(folder.glob("out*"))
    assert main([*words, "--unverified"]) == 0
    told = capsys.readouterr()
    assert "nverified" in (told.out + told.err).lower()
    target = VERBS[line]
    if target is None:
        assert "Cannot be proved" in told.out
        assert not list(folder.glob("out*"))
    elif Path(target).suffix not in (".csv", ".png"):
        assert "UNVERIFIED: 4 of" in written(folder / target)


def test_a_report_edited_to_pass_changes_nothing(folder: Path) -> None:
    """The stored report is no signature: every row of it may be edited, and the digest made to fit."""
    from obsynth.results.gain_set_writing import digest_of

    content = json.loads((folder / "wrong.gains.json").read_text())
    report = content["design"]["report"]
    report["passed"] = True
    for row in report["checks"]:
        row["passed"] = True
    content["sha256"] = digest_of(content["design"])
    (folder / "wrong.gains.json").write_text(json.dumps(content))
    assert obsynth.load("wrong.gains.json").report.passed
    assert main(["export", "--gains", "wrong.gains.json", "--to", "out.c"]) == 6


def test_functions_refuse_what_fails_and_many_runs_say_so(folder: Path) -> None:
    design = failing()
    with pytest.raises(obsynth.VerificationError, match="not used"):
        obsynth.export(design, folder / "out.c")
    with pytest.raises(obsynth.VerificationError, match="not used"):
        obsynth.online_monitor(design, disturbance_bounds={"w": 1.0})
    assert obsynth.export(design, folder / "out.c", unverified=True)
    (folder / "many").mkdir()
    design.save(folder / "many" / "wrong.gains.json")
    assert main(["run", "--gains", "many", "--data", "log.csv", "--out", "runs", "--quiet"]) == 0
    table = pd.read_csv(folder / "runs" / "table.csv")
    assert table["status"].tolist() == ["unverified"]
    assert main(["run", "--gains", "many", "--data", "log.csv", "--out", "all", "--quiet", "--unverified"]) == 0
    assert pd.read_csv(folder / "all" / "table.csv")["status"].tolist() == ["run"]


@pytest.mark.long
def test_proved_never_stands_beside_fails(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", "wrong.gains.json"]) == 6
    told = capsys.readouterr().out
    assert "gamma = 1.5" in told
    assert "NOT proved" in told
    assert "claim   " not in told
    assert main(["report", "--gains", "wrong.gains.json", "--out", "page.html"]) == 6
    page = re.sub(r"<[^>]+>", " ", (folder / "page.html").read_text())
    assert "proved bound" not in page
    assert "shipped: proved" not in page
    assert "initial-condition response does not decay" in page
    assert "time constant -" not in page
    assert not re.search(r"FAILS\s+(\(?proved)", page)


def test_a_file_that_has_changed_is_verified_afresh(folder: Path) -> None:
    """Under the same name, after it was found to hold: with other gains, and with a single number changed."""
    from obsynth.results.gain_set_writing import digest_of

    words = ["export", "--gains", "wrong.gains.json", "--to", "out.npz", "--force"]
    obsynth.fault_estimation_filter(failing().plant).save("wrong.gains.json")
    good = Path("wrong.gains.json").read_bytes()
    assert [main(words), main(words)] == [0, 0]
    failing().save("wrong.gains.json")
    assert main(words) == 6
    content = json.loads(good)
    stored = content["design"]["observer"]["Az"]["data"]
    stored[0] *= 1.0 + 1e-6
    content["sha256"] = digest_of(content["design"])
    Path("wrong.gains.json").write_text(json.dumps(content))
    assert main(words) == 6
    Path("wrong.gains.json").write_bytes(good)
    assert main(words) == 0


@pytest.mark.long
def test_a_page_of_gains_that_fail_says_on_the_terminal_why_the_exit_code_is_6(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", "--gains", "wrong.gains.json", "--out", "page.html"]) == 6
    told = capsys.readouterr()
    assert told.out == "Written: page.html\n"
    assert re.search(r"^Warning: wrong.gains.json: UNVERIFIED: \d+ of \d+ checks FAIL: ", told.err, re.MULTILINE)


@pytest.mark.long
def test_notes_of_a_file_are_said_to_be_unverified(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A note is a sentence: "a fault of 1e-9 is certain to raise an alarm" was printed below "Verified"."""
    plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], Bf=[[1.0]], dt=0.1)
    design = obsynth.ui_pi_observer(plant).replace(notes=("A fault of 1e-9 is certain to raise an alarm.",))
    file, page = design.save(tmp_path / "a.gains.json"), tmp_path / "page.html"
    for more in ([], ["-v"]):
        assert main(["verify", str(file), *more]) == 0
        said, _, notes = capsys.readouterr().out.partition("which verify does not check")
        assert "is certain to raise" not in said
        assert "is certain to raise" in notes
    assert main(["report", "--gains", str(file), "--out", str(page)]) == 0
    assert page.read_text().count("is certain to raise") == page.read_text().count("which verify does not check") == 1


def test_checks_are_counted_alike_in_every_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The header of the C code counted rows that only inform: 44 checks, where `verify` has 30."""
    plant = obsynth.load_spec(DESIGNS / "wang2015" / "spec.yaml").plant
    design = obsynth.fault_estimation_filter(plant, weight="paper")
    design.save(folder / "right.gains.json")
    assert main(["verify", "--gains", "right.gains.json"]) == 0
    told = re.search(r"Verified: all (\d+) checks hold", capsys.readouterr().out)
    assert told is not None
    assert int(told.group(1)) < len(design.report.checks)
    assert main(["export", "--gains", "right.gains.json", "--to", "right.c"]) == 0
    assert f"Verified: all {told.group(1)} checks of obsynth hold." in (folder / "right.h").read_text()
