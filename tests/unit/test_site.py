"""The site's own example: from a spec and a log with dates to an alarm, as the first page says."""

from __future__ import annotations

import re
import runpy
import shlex
from pathlib import Path

import pytest

import obsynth
from obsynth.cli.main import main

DOCS = Path(__file__).parents[2] / "docs"


def test_the_first_steps_lead_to_a_plotted_alarm(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "spec.yaml").write_text((DOCS / "examples/thermal/spec.yaml").read_text(encoding="utf-8"))
    runpy.run_path(str(DOCS / "examples/thermal/make_log.py"), run_name="__main__")
    commands = re.findall(r"^obsynth .*$", (DOCS / "start.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert [command.split()[1] for command in commands] == ["check", "design", "plot"]
    for command in commands:
        assert main(shlex.split(command)[1:]) == 0
    printed = capsys.readouterr().out
    assert "0.107 W" in printed
    # The heater loses 30 W at 09:30.
    assert re.search(r"Alarm: fhat\[heater fault\] first above its threshold at 2026-05-01T09:3", printed)
    assert (tmp_path / "oven.png").stat().st_size > 10_000
    (tmp_path / "oven.csv").rename(tmp_path / "log.csv")
    run = obsynth.run_on_data(obsynth.load("oven.gains.json"), "log.csv", time_column="Timestamp")
    assert run.table["fhat[heater fault]"].iloc[-1] == pytest.approx(30.0, abs=0.5)


@pytest.mark.parametrize("page", ["motor", "tank", "circuit", "time_varying"])
def test_the_code_of_the_how_tos_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "howto" / f"{page}.md").read_text(encoding="utf-8"), re.DOTALL)
    exec(code, {})


def test_every_page_is_in_a_list():
    listed = "".join(path.read_text(encoding="utf-8") for path in DOCS.rglob("index.md"))
    pages = [path for path in DOCS.rglob("*.md") if "_build" not in path.parts and "made" not in path.parts]
    assert [page.name for page in pages if page.stem != "index" and page.stem not in listed] == []
