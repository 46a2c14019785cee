"""What the README claims."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from obsynth.cli.main import main
from obsynth.methods.registry import REGISTRY

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_there_are_exactly_two_commands_to_start_with():
    lines = re.search(r"<!-- commands -->\n```sh\n(.*?)```\n<!-- end -->", README, re.DOTALL).group(1).splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("pip install . && design --system designs/wang2015/spec.yaml")
    assert "python -m pytest" in lines[1]


def test_every_linked_file_exists():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_the_first_screen_shows_what_is_printed(monkeypatch):
    """The first command and the first code, run in a clone: `docs/make_readme.py` writes what they print."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import make_readme

    for mark, told in make_readme.outputs(README).items():
        assert make_readme.block(README, mark) == told


def test_the_first_screen_tells_researchers_what_they_look_for():
    for word in ("LMI", "cvxpy", "inequality", "notebook", "obsynth.conditions", "pole placement", "E = I"):
        assert word in README


@pytest.mark.parametrize("command", re.findall(r"`obsynth (simulate --system [^`]*)`", README))
def test_every_simulation_of_the_readme_runs(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    verb, flag, spec, *rest = command.split()
    assert main([verb, flag, str(ROOT / spec), *rest, "--quiet"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]


def test_the_plant_of_ones_own_is_designed_and_saved(tmp_path):
    code = re.search(r"<!-- own -->\n```python\n(.*?)```", README, re.DOTALL).group(1)
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split()[2:] == ["verified", "True"]
    assert list(tmp_path.glob("*.gains.json"))


@pytest.mark.parametrize("spec", re.findall(r"design --system (designs/\S+)", README))
def test_every_design_command_writes_a_gain_set_that_verifies(spec, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["design", "--system", str(ROOT / spec), "--quiet"]) == 0
    (gains,) = tmp_path.glob("*.gains.json")
    assert main(["verify", str(gains)]) == 0
    assert main(["check", "--system", str(ROOT / spec)]) == 0
    assert "hold" in capsys.readouterr().out


def test_first_command_writes_the_file_it_names(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main(["design", "--system", str(ROOT / "designs/wang2015/spec.yaml"), "--quiet"])
    assert [path.name for path in tmp_path.iterdir()] == ["wang2015.gains.json"]
    assert "`wang2015.gains.json`" in README


def test_the_tour_runs_on_a_log(tmp_path, monkeypatch, capsys):
    """The three commands as printed, after the first one of the page, on a log with a gap."""
    monkeypatch.chdir(tmp_path)
    assert main(["design", "--system", str(ROOT / "designs/wang2015/spec.yaml"), "--quiet"]) == 0
    rows = [f"{k},0.1,0,{0.2 * k},{-0.1 * k},{0.05 * k}" for k in range(30) if not 12 <= k < 15]
    Path("log.csv").write_text("\n".join(["time,u1,u2,x2,x3,x4", *rows]) + "\n", encoding="utf-8")
    commands = re.search(r"<!-- tour -->\n```sh\n(.*?)```\n<!-- end -->", README, re.DOTALL).group(1).splitlines()
    assert len(commands) == 3
    for command in commands:
        program, *arguments = command.split()
        assert program == "obsynth"
        assert main(arguments) == 0
    header, *estimates = Path("estimates.csv").read_text(encoding="utf-8").splitlines()
    assert len(estimates) == len(rows)
    assert header.split(",")[:4] == ["time", "status", "time of fhat[actuator 1]", "time of fhat[actuator 2]"]
    assert {line.split(",")[1] for line in estimates} == {"warm-up", "ok", "recovering"}
    assert "Verified: all" in Path("report.html").read_text(encoding="utf-8")
    digest = json.loads(Path("wang2015.gains.json").read_text(encoding="utf-8"))["sha256"]
    assert digest in Path("observer.h").read_text(encoding="utf-8")
    assert digest in Path("report.html").read_text(encoding="utf-8")


def test_every_method_is_in_the_table():
    assert set(re.findall(r"^\| `([a-z-]+)` \| ", README, re.MULTILINE)) == set(REGISTRY)
