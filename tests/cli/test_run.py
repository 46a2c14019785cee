"""``obsynth run``: logs and streams in, estimates out; bad data end in the right code, and leave no file behind."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from obsynth.cli.main import main
from obsynth.files.outputs import replacement_of

ROOT = Path(__file__).parents[2]
HEADER = "time,u1,u2,x2,x3,x4"
ROWS = [f"{k},0.1,0,{0.2 * k},{-0.1 * k},{0.05 * k}" for k in range(8)]


@pytest.fixture(scope="module")
def gains(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("gains") / "wang2015.gains.json"
    assert main(["design", "--system", str(ROOT / "designs/wang2015/spec.yaml"), "--output", str(path), "--quiet"]) == 0
    return path


@pytest.fixture(autouse=True)
def _work_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def log(*rows: str, header: str = HEADER) -> None:
    Path("log.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def run(gains: Path, *more: str, data: str = "log.csv", out: str = "estimates.csv") -> int:
    return main(["run", "--gains", str(gains), "--data", data, "--out", out, *more])


def test_a_log_becomes_estimates(gains, capsys):
    log(*ROWS)
    assert run(gains) == 0
    printed = capsys.readouterr()
    assert printed.out == "8 rows: 5 warm-up, 3 ok.\n"
    assert printed.err == ""
    table = pd.read_csv("estimates.csv")
    assert list(table["time"]) == list(range(8))
    assert np.isfinite(table["fhat[actuator 1]"]).all()
    assert sorted(path.name for path in Path().iterdir()) == ["estimates.csv", "log.csv"]


def test_json_says_what_was_done_and_of_which_gain_set(gains, capsys):
    log(*ROWS)
    assert run(gains, "--json", "--threshold", "r[actuator 1]=1e-9") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["rows"] == 8
    assert printed["statuses"] == {"warm-up": 5, "ok": 3}
    assert printed["alarms"] == {"r[actuator 1]": 5.0}
    assert printed["gains_sha256"] == json.loads(gains.read_text())["sha256"]


@pytest.mark.long
def test_a_stream_gives_what_a_file_gives_a_row_in_a_row_out(gains):
    log(*ROWS)
    assert run(gains, "--quiet") == 0
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    environment.pop("PYTHONUNBUFFERED", None)  # it would flush what we must flush
    command = [sys.executable, "-W", "error", "-m", "obsynth", "run", "--gains", str(gains), "--data", "-"]
    with subprocess.Popen(
        [*command, "--quiet"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(HEADER + "\n")
        process.stdin.flush()
        answers = [process.stdout.readline()]
        for row in ROWS:
            process.stdin.write(row + "\n")
            process.stdin.flush()
            # Would wait for ever if the answer came only with the next row.
            answers.append(process.stdout.readline())
        process.stdin.close()
        assert process.stdout.read() == ""
    assert process.returncode == 0
    assert "".join(answers) == Path("estimates.csv").read_text()


def test_a_run_goes_on_from_a_saved_state(gains):
    log(*ROWS)
    assert run(gains, "--quiet") == 0
    whole = Path("estimates.csv").read_text().splitlines()
    found = []
    for rows in (ROWS[:3], ROWS[3:]):
        log(*rows)
        assert run(gains, "--quiet", "--state", "state.json") == 0
        found += Path("estimates.csv").read_text().splitlines()[1:]
    assert found == whole[1:]


@pytest.mark.long
def test_a_restart_removes_what_a_killed_run_has_left_and_nothing_that_is_being_written(gains):
    log(*ROWS)
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    command = [sys.executable, "-m", "obsynth", "run", "--gains", str(gains), "--data", "-", "--out", "estimates.csv"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, env=environment) as process:
        until = time.monotonic() + 60.0
        while not list(Path().glob(".obsynth-*.part")) and time.monotonic() < until:
            time.sleep(0.01)
        process.kill()
    left = list(Path().glob(".obsynth-*.part"))
    assert len(left) == 1
    same, another = replacement_of(Path("estimates.csv")), replacement_of(Path("other.csv"))
    with same as (handle, living), another as (other, theirs):
        # As for Parquet: the file is opened by its name.
        os.close(handle)
        os.close(other)
        assert run(gains, "--quiet", "--state", "state.json") == 0
        names = {"estimates.csv", "log.csv", "state.json", Path(living).name, Path(theirs).name}
        assert {path.name for path in Path().iterdir()} == names


def test_names_units_and_time_may_differ(gains):
    log(*ROWS)
    assert run(gains, "--quiet") == 0
    wanted = pd.read_csv("estimates.csv")
    log(*(f"{k},0.1,0,{200.0 * k},{-0.1 * k},{0.05 * k}" for k in range(8)), header="t,u1,u2,speed,x3,x4")
    assert run(gains, "--quiet", "--map", "x2=speed", "--map", "time=t", "--scale", "x2=0.001") == 0
    pd.testing.assert_frame_equal(pd.read_csv("estimates.csv"), wanted, atol=1e-12, rtol=1e-12)


@pytest.mark.parametrize("blank", ["", "NaN", "nan", "NA", "null", "inf"])
def test_what_is_missing_is_a_gap(gains, capsys, blank):
    rows = list(ROWS)
    rows[6] = f"6,0.1,0,{blank},1,1"
    log(*rows)
    assert run(gains) == 0
    assert capsys.readouterr().out == "8 rows: 5 warm-up, 1 ok, 1 gap, 1 recovering.\n"


@pytest.mark.parametrize("word", ["BAD", "No Data", "#DIV/0!", "-"])
def test_a_word_among_numbers_is_a_missing_sample(gains, capsys, word):
    rows = list(ROWS)
    rows[6] = f"6,0.1,0,{word},1,1"
    log(*rows)
    assert run(gains) == 0
    told = capsys.readouterr()
    assert told.out == "8 rows: 5 warm-up, 1 ok, 1 gap, 1 recovering.\n"
    assert f"1 cell of 'x2' without a number: counted as missing, first {word!r} in row 7" in told.err


BAD_LOGS = {
    "a missing column": (["time,u1,u2,x2,x3", "0,0,0,0,0"], "no column 'x4'"),
    "a missing time": (["u1,u2,x2,x3,x4", "0,0,0,0,0"], "no column 'time'"),
    "a repeated column": (["time,u1,u2,x2,x3,x4,x4", "0,0,0,0,0,0,0"], "more than one column 'x4'"),
    "words alone": ([HEADER, "0,0,0,high,0,0"], "The column 'x2' holds no number: row 1 has 'high'"),
    "a number with its unit": ([HEADER, ROWS[0], "1,0,0,5 m,0,0"], "Row 2, column 'x2': '5 m' is no number"),
    "a decimal comma": ([HEADER, ROWS[0], '1,0,0,"1,5",0,0'], "Row 2, column 'x2': '1,5' is no number"),
    "too many cells": ([HEADER, ROWS[0], ROWS[1] + ",7"], "log.csv cannot be read"),
    "too many cells in each row": ([HEADER, *(row + ",7" for row in ROWS)], "log.csv cannot be read"),
    "a time that stays": ([HEADER, ROWS[0], *[ROWS[1]] * 12], "Row 13 repeats the time 1 s"),
    "times that fall": ([HEADER, ROWS[0], ROWS[1], *[ROWS[0]] * 11], "Row 13: the time falls"),
    "no time in a row": ([HEADER, ROWS[0], ",0,0,0,0,0"], "Row 2 has no time"),
    "irregular times": ([HEADER, ROWS[0], ROWS[1], "2.48,0,0,0,0,0"], "Row 3 comes 1.48 s after"),
    "another dt": ([HEADER, "0,0,0,0,0,0", "0.5,0,0,0,0,0"], "Row 2 comes 0.5 s after"),
    "twice the dt": (
        [HEADER, "0,0,0,0,0,0", "2,0,0,0,0,0", "4,0,0,0,0,0"],
        "the log is sampled every 2 s, but the design needs 1 s",
    ),
    "no rows": ([HEADER], "no rows"),
    "nothing": ([], "cannot be read"),
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", BAD_LOGS)
@pytest.mark.parametrize("way", ["file", "stream"])
def test_a_bad_log_is_refused_and_leaves_nothing(gains, capsys, monkeypatch, name, way):
    lines, message = BAD_LOGS[name]
    if way == "file":
        Path("log.csv").write_text("\n".join(lines), encoding="utf-8")
        assert run(gains, "--state", "state.json") == 2
    else:
        import io

        monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(lines)))
        assert run(gains, "--state", "state.json", data="-") == 2
        message = message.replace("log.csv cannot be read", "cells, but the header has 6")
        message = "The data are empty" if message == "cannot be read" else message.replace("cannot be read", "no rows")
    assert message in capsys.readouterr().err
    assert {path.name for path in Path().iterdir()} <= {"log.csv"}


def test_an_older_result_survives_a_failure(gains):
    log(ROWS[0], ROWS[0])
    Path("estimates.csv").write_text("old")
    assert run(gains) == 2
    assert Path("estimates.csv").read_text() == "old"


def test_files_that_are_not_there_or_not_right(gains, capsys):
    def refused(fragment: str, *more: str, **places: str) -> None:
        assert run(gains, *more, **places) == 2
        assert fragment in capsys.readouterr().err
        assert main(["run", "--gains", str(gains), "--data", "nowhere.csv"]) == 2
        printed = capsys.readouterr()
        assert (printed.out, "nowhere.csv does not exist" in printed.err) == ("", True)
        assert {path.name for path in Path().iterdir()} <= {"log.csv", "folder", "folder.csv", "bad.parquet", "log.txt"}

    refused("log.csv does not exist.")
    log(*ROWS)
    Path("folder.csv").mkdir()
    refused("folder.csv is a folder", data="folder.csv")
    refused("folder.csv is a folder", out="folder.csv")
    refused("nowhere/out.csv cannot be written", out="nowhere/out.csv")
    refused("log.csv: give another one", out="log.csv")
    Path("log.txt").write_text("time")
    refused("log.txt has an unknown suffix", data="log.txt")
    refused("out.xlsx has an unknown suffix", out="out.xlsx")
    Path("bad.parquet").write_text("no parquet")
    refused("bad.parquet cannot be read", data="bad.parquet")
    refused("'high' is no number", "--scale", "x2=high")
    refused("no input or output of this observer", "--map", "x9=a")
    refused("There is no column 'f'", "--threshold", "f=1")
    refused("gap is for continuous-time designs", "--gap", "2")
    refused("cannot both go to stdout", "--json", out="-")
    Path("log.csv").write_bytes(b"time,u1,u2,x2,x3,x4\n0,0,0,0,0,\x81\n")
    refused("log.csv is no UTF-8 text")


@pytest.mark.long
@pytest.mark.usefixtures("taken_as_verified")
def test_recursive_and_nonlinear_designs_run_as_well(capsys, monkeypatch):
    """From files in chunks and from a stream, with bad rows named, going on from a saved state."""
    import io

    for design, columns in (("moussaali2013_ltv", "u1,u2,y1"), ("pendulum", "across,down")):
        spec = ROOT / "designs" / design / "spec.yaml"
        assert main(["design", "--system", str(spec), "--output", "recursive.json", "--quiet"]) == 0
        step, width = (1.0, 3) if design == "moussaali2013_ltv" else (0.01, 2)
        start = [0.6, -0.8] if width == 2 else [1.0, 1.0, 0.5]
        rows = [",".join(map(repr, [step * k, *start])) for k in range(12)]
        rows[5] = f"{step * 5}" + (",1.0,1.0," if width == 3 else ",,-0.8")
        log(*rows, header=f"time,{columns}")
        capsys.readouterr()
        assert run(Path("recursive.json")) == 0
        assert capsys.readouterr().out.startswith("12 rows: ")
        whole = Path("estimates.csv").read_text().splitlines()
        assert "sd xhat[" in whole[0]
        answers = []
        for part in (rows[:4], rows[4:]):
            text = "\n".join([f"time,{columns}", *part])
            monkeypatch.setattr("sys.stdin", io.StringIO(text))
            assert run(Path("recursive.json"), "--quiet", "--state", "state.json", data="-", out="-") == 0
            answers += capsys.readouterr().out.splitlines()[1:]
        assert answers == whole[1:]
        Path("state.json").unlink()
        log(*rows[:3], rows[2], *rows[3:], header=f"time,{columns}")
        assert run(Path("recursive.json"), out="repeated.csv") == 0
        assert "1 repeated stamp" in capsys.readouterr().out
        answers = Path("repeated.csv").read_text().splitlines()
        assert [*answers[:4], *answers[5:]] == whole
        assert run(Path("recursive.json"), "--gap", "3", out="other.csv") == 2
        assert "gap is for continuous-time designs" in capsys.readouterr().err
        assert not Path("other.csv").exists()


def test_a_stream_that_breaks_off_saves_the_state_of_the_rows_that_were_answered(gains, monkeypatch, capsys):
    """What has left on a stream cannot be taken back: the run goes on after the last good row."""
    import io

    log(*ROWS)
    assert run(gains, "--quiet") == 0
    whole = Path("estimates.csv").read_text().splitlines()
    answers = []
    for rows, code in ((["high,0,0,0,0,0"], 2), ([*ROWS[:4], "high,0,0,0,0,0"], 2), (ROWS[4:], 0)):
        monkeypatch.setattr("sys.stdin", io.StringIO("\n".join([HEADER, *rows])))
        assert run(gains, "--quiet", "--state", "state.json", data="-", out="-") == code
        answers += capsys.readouterr().out.splitlines()[1:]
        assert Path("state.json").exists() == (len(answers) > 0)
    assert answers == whole[1:]
