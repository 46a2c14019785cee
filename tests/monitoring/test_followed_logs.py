"""Logs that grow: rows as they are written, rotations, and a process that is killed."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.monitoring.logs.followed import FollowedLog

HEADER = "time,y1,y2\n"
ROWS = np.random.default_rng(0).standard_normal((400, 2))
pytestmark = pytest.mark.usefixtures("taken_as_verified")


def design() -> obsynth.ObserverDesign:
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    )
    return obsynth.fault_estimation_filter(plant)


def lines(first: int, last: int) -> str:
    return "".join(f"{k},{y1!r},{y2!r}\n" for k, (y1, y2) in enumerate(ROWS.tolist()[first:last], first))


def append(path: Path, text: str) -> None:
    with path.open("a") as stream:
        stream.write(text)


class Story:
    """What happens to a file, one step at each time that a stream waits for it; then the stream ends."""

    def __init__(self, *steps: object) -> None:
        self.steps = list(steps)

    def __call__(self, seconds: float) -> bool:
        assert seconds > 0.0
        if not self.steps:
            return True
        self.steps.pop(0)()  # type: ignore[operator]
        return False


def test_lines_come_when_they_are_whole(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(HEADER + "0,1,2\n1,")
    seen: list[str] = []
    story = Story(lambda: append(path, "3"), lambda: append(path, ",4\n2,5,6\n"), lambda: append(path, "3,7,8"))
    seen.extend(FollowedLog(path, wait=story))
    assert seen == [HEADER, "0,1,2\n", "1,3,4\n", "2,5,6\n"]


@pytest.mark.parametrize("way", ["renamed", "copied and cut"])
def test_rotations_lose_and_repeat_nothing(tmp_path: Path, way: str) -> None:
    path, whole = tmp_path / "log.csv", list(range(60))
    path.write_text("# logger 7\n" + HEADER + lines(0, 20))

    def rotated() -> None:
        append(path, lines(20, 25))
        if way == "renamed":
            path.rename(tmp_path / "log.1.csv")

    def begun() -> None:
        if way == "renamed":
            path.write_text("# logger 7\n" + HEADER + lines(25, 40))
        else:
            with path.open("r+") as stream:
                stream.truncate(0)

    after = Story(rotated, begun, lambda: append(path, lines(25 if way != "renamed" else 40, 60)))
    rows = [line for line in FollowedLog(path, wait=after) if line[0].isdigit()]
    assert rows == lines(0, 60).splitlines(keepends=True)
    assert len(rows) == len(whole)


def test_a_run_on_a_log_that_grows_says_what_a_run_on_the_whole_log_says(tmp_path: Path) -> None:
    path, out = tmp_path / "log.csv", io.StringIO()
    path.write_text(HEADER + lines(0, 150))

    def rotated() -> None:
        path.rename(tmp_path / "log.1.csv")
        path.write_text(HEADER + lines(150, 300))

    story = Story(rotated, lambda: append(path, lines(300, 400)))
    run = obsynth.run_on_data(design(), FollowedLog(path, wait=story), out)
    (tmp_path / "whole.csv").write_text(HEADER + lines(0, 400))
    expected = obsynth.run_on_data(design(), tmp_path / "whole.csv").table
    found = pd.read_csv(io.StringIO(out.getvalue()), keep_default_na=True)
    assert run.rows == 400
    np.testing.assert_array_equal(found["fhat[f1]"], expected["fhat[f1]"])
    assert found["status"].tolist() == expected["status"].tolist()


@pytest.mark.long
def test_a_process_that_is_killed_goes_on_where_its_state_is(tmp_path: Path) -> None:
    """Every row is there at least once, rows after the last saved state twice, and all are those of one run."""
    path, gains, state = tmp_path / "log.csv", design().save(tmp_path / "g.json"), tmp_path / "state.json"
    path.write_text(HEADER + lines(0, 150))
    command = [
        sys.executable, "-m", "obsynth", "run", "--gains", str(gains), "--follow", str(path), "--unverified",
        "--state", str(state), "--set", "state-every=20", "--quiet",
    ]  # fmt: skip
    source = str(Path(obsynth.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": source, "PYTHONUNBUFFERED": "1"}

    def run_until(count: int, number: int) -> list[str]:
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
            assert process.stdout is not None
            found = [process.stdout.readline() for _ in range(count + 1)]
            process.send_signal(number)
            rest, _ = process.communicate(timeout=60)
            assert process.returncode == (-number if number == signal.SIGKILL else 128 + number)
            return [*found, *(line for line in rest.splitlines(keepends=True) if line.endswith("\n"))]

    first = run_until(150, signal.SIGKILL)
    append(path, lines(150, 250))
    second = run_until(110, signal.SIGTERM)
    assert len(second) <= 1 + 20 + 100
    append(path, lines(250, 300))
    third = run_until(50, signal.SIGTERM)
    assert len(third) == 1 + 50
    (tmp_path / "whole.csv").write_text(HEADER + lines(0, 300))
    whole = io.StringIO()
    obsynth.run_on_data(design(), tmp_path / "whole.csv", whole)
    expected = whole.getvalue().splitlines(keepends=True)
    assert first[0] == second[0] == third[0] == expected[0]
    assert list(dict.fromkeys([*first, *second[1:], *third[1:]])) == expected


@pytest.mark.one_in(5)
@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--out", "estimates.csv"], "leave --out out"),
        (["--smooth"], "it needs the whole log"),
        (["--follow", "log.parquet"], "a text log is needed"),
        (["--follow", "none.csv"], "Start when the log is there"),
        (["--data", "log.csv"], "not allowed with"),
    ],
)
def test_what_has_no_end_is_refused_where_an_end_is_needed(
    more: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    design().save("g.json")
    Path("log.csv").write_text(HEADER + lines(0, 10))
    follow = [] if "--follow" in more else ["--follow", "log.csv"]
    try:
        code = main(["run", "--gains", "g.json", "--unverified", *follow, *more])
    except SystemExit as end:
        code = int(end.code or 0)
    assert code == 2
    assert said in capsys.readouterr().err.replace("\n", " ")


def test_a_health_line_is_said_of_a_log_that_grows(capsys: pytest.CaptureFixture[str]) -> None:
    from obsynth.monitoring.verbs.run_progress import health

    said = health()
    said(1)
    said(2)
    assert capsys.readouterr().err == "1 rows in 0 s.\n"
