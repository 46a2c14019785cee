"""``obsynth export`` and ``obsynth report``: what they print and write, and how bad input ends."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from obsynth.cli.main import main
from obsynth.results.gain_set_writing import digest_of

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("gains")
    for name in ("wang2015", "filasova", "moussaali2013_ltv"):
        spec = ROOT / "designs" / name / "spec.yaml"
        assert main(["design", "--system", str(spec), "--output", str(path / f"{name}.json"), "--quiet"]) == 0
    return path


@pytest.fixture(autouse=True)
def _work_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def export(gains: Path, target: str, *more: str) -> int:
    return main(["export", "--gains", str(gains), "--to", target, *more])


@pytest.mark.one_in(3)
@pytest.mark.parametrize("target", ["a.mat", "a.npz", "a.c"])
def test_export_writes_what_its_name_says(folder, capsys, target):
    assert export(folder / "wang2015.json", target) == 0
    files = ["a.c", "a.h"] if target == "a.c" else [target]
    assert capsys.readouterr().out == f"Written: {', '.join(files)}\n"
    assert sorted(path.name for path in Path().iterdir()) == files


def test_export_samples_and_speaks_json(folder, capsys):
    assert export(folder / "filasova.json", "a.npz", "--sample-time", "0.01", "--json") == 0
    assert json.loads(capsys.readouterr().out)["files"] == ["a.npz"]
    assert np.load("a.npz")["Ts"] == 0.01


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("gains", "arguments", "message"),
    [
        ("wang2015", ["a.xlsx"], "unknown suffix"),
        ("wang2015", ["nowhere/a.c"], "cannot be written"),
        ("wang2015", ["a.mat", "--sample-time", "1"], "sampled already"),
        ("filasova", ["a.c"], "continuous in time"),
        ("moussaali2013_ltv", ["a.mat"], "E, A, Phi may change with k"),
        ("missing", ["a.mat"], "does not exist"),
    ],
)
def test_export_refuses(folder, capsys, gains, arguments, message):
    assert export(folder / f"{gains}.json", *arguments) == 2
    assert message in capsys.readouterr().err
    assert list(Path().iterdir()) == []


@pytest.mark.long
def test_report_verifies_again_and_writes_the_page(folder, capsys):
    assert main(["report", "--gains", str(folder / "wang2015.json"), "--out", "report.html"]) == 0
    assert capsys.readouterr().out == "Written: report.html\n"
    page = Path("report.html").read_text(encoding="utf-8")
    assert '<p class="verdict holds">Verified: all' in page
    assert json.loads((folder / "wang2015.json").read_text())["sha256"] in page


@pytest.mark.long
def test_report_of_wrong_gains_says_so_and_ends_in_six(folder, capsys):
    """The saved report still says that all is well; what counts is the new one."""
    document = json.loads((folder / "wang2015.json").read_text())
    document["design"]["observer"]["By"]["data"][0] += 1e-3
    document["sha256"] = digest_of(document["design"])
    Path("wrong.json").write_text(json.dumps(document))
    assert main(["report", "--gains", "wrong.json", "--out", "report.html", "--json"]) == 6
    assert json.loads(capsys.readouterr().out)["passed"] is False
    assert '<p class="verdict fails">FAILS:' in Path("report.html").read_text(encoding="utf-8")


def test_report_refuses(folder, capsys):
    gains = str(folder / "wang2015.json")
    assert main(["report", "--gains", gains, "--out", gains]) == 2
    assert main(["report", "--gains", gains, "--out", "."]) == 2
    assert main(["report", "--gains", "missing.json", "--out", "report.html"]) == 2
    assert list(Path().iterdir()) == []
    assert json.loads(Path(gains).read_text())["kind"] == "obsynth gain set"


@pytest.mark.parametrize(
    ("arguments", "target", "wanted"),
    [
        (["simulate", "--system", "spec", "--out"], "signals.png", ".csv"),
        (["compare", "--system", "spec", "--out"], "table.csv", ".html"),
        (["design", "--system", "spec", "--output"], "gains.YAML", ".json"),
        (["report", "--gains", "gains", "--out"], "page.pdf", ".html"),
    ],
)
def test_no_file_gets_the_name_of_another_format(folder, capsys, arguments, target, wanted):
    """A table of signals was written to `signals.png` without a word."""
    known = {"spec": str(ROOT / "designs" / "wang2015" / "spec.yaml"), "gains": str(folder / "wang2015.json")}
    assert main([*(known.get(word, word) for word in arguments), target, "--force"]) == 2
    assert f"give it a name that ends in {wanted}." in capsys.readouterr().err
    assert list(Path().iterdir()) == []


@pytest.mark.long
def test_report_shows_the_design_on_the_scenario_of_a_spec(folder, capsys):
    spec = ROOT / "designs" / "wang2015" / "spec.yaml"
    gains = str(folder / "wang2015.json")
    assert main(["report", "--gains", gains, "--out", "page.html", "--system", str(spec)]) == 0
    page = Path("page.html").read_text(encoding="utf-8")
    assert "On the scenario: 300 s, seed 2015." in page
    assert f"--system {spec}" in page
    Path("none.yaml").write_text(re.sub(r"(?ms)^scenario:.*?(?=^\w|\Z)", "", spec.read_text()).replace(
        "plant.yaml", str(spec.with_name("plant.yaml"))))  # fmt: skip
    capsys.readouterr()
    assert main(["report", "--gains", gains, "--out", "bare.html", "--system", "none.yaml"]) == 0
    assert "Note: none.yaml has no scenario: the page shows no simulation of one." in capsys.readouterr().err
    assert "On the scenario" not in Path("bare.html").read_text(encoding="utf-8")
    # The scenario of another plant.
    other = ROOT / "designs" / "smib" / "spec.yaml"
    assert main(["report", "--gains", gains, "--out", "other.html", "--system", str(other)]) == 2
    assert "tm GENCLS 1" in capsys.readouterr().err
    assert not Path("other.html").exists()


@pytest.mark.long
def test_the_block_how_to_reproduce_this_runs(tmp_path, monkeypatch, capsys):
    """Every setting of the command is in it: run in the same folder, it writes the same page again."""
    import re
    import runpy
    import shlex
    from html import unescape

    docs = Path(__file__).parents[2] / "docs/examples/thermal"
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(docs / "make_log.py"), run_name="__main__")
    assert main(["design", "--system", str(docs / "spec.yaml"), "--quiet"]) == 0
    words = ["report", "--gains", "oven.gains.json", "--data", "oven.csv", "--time-column", "Timestamp"]
    assert main([*words, "--threshold", "fhat[heater fault]=1", "--out", "a page.html"]) == 0
    page = Path("a page.html").read_text(encoding="utf-8")
    commands = unescape(re.search(r"<pre>(obsynth verify.*?)</pre>", page, re.DOTALL).group(1)).splitlines()
    assert len(commands) == 2
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == "obsynth"
        assert main(arguments) == 0
    again = Path("a page.html").read_text(encoding="utf-8")
    # Only the time at which it was written may differ.
    without_time = [re.sub(r'<p class="soft">\d{4}-\d\d-\d\d [^;]*;', "", text) for text in (page, again)]
    assert without_time[0] == without_time[1]
    assert "ALARM from 2026-05-01T09:30:30+02:00 on. Probable fault: heater fault." in page
