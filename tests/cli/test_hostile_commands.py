"""Nothing lost, nothing hangs, no traceback: outputs over inputs, full and closed streams, signals, bad numbers."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from obsynth.cli.main import main

ROOT = Path(__file__).parents[2]
PLANT = """\
schema_version: 1
dt: 1.0
A: {file: A.csv}
C: [[1, 0], [0, 1]]
B: [[0.5], [1.0]]
Bf: [[1.0], [0.0]]
state_names: {file: names.json}
output_names: ["=SUM(A1)", "y${2}$"]
fault_names: ["${fault}"]
"""
SPEC = """\
schema_version: 1
name: small
plant: {file: plant.yaml}
method: {id: fault-estimation-filter}
scenario: {horizon: 12, faults: {"${fault}": {kind: step, start: 3, size: 1.0}}}
"""


@pytest.fixture(scope="module")
def gain_set(tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("made")
    files(folder)
    target = folder / "g.json"
    assert main(["design", "--system", str(folder / "spec.yaml"), "--output", str(target), "--quiet"]) == 0
    return target.read_text("utf-8")


def files(folder: Path) -> None:
    for name, text in (("plant.yaml", PLANT), ("spec.yaml", SPEC), ("A.csv", "0.5,0.1\n0,0.25\n"),
                       ("names.json", '["x1", "-x2"]')):  # fmt: skip
        (folder / name).write_text(text, "utf-8")


@pytest.fixture(autouse=True)
def _all_files_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gain_set: str) -> None:
    monkeypatch.chdir(tmp_path)
    files(tmp_path)
    Path("g.json").write_text(gain_set, "utf-8")
    Path("log.csv").write_text(log(range(10)), "utf-8")


def log(times) -> str:
    return "\n".join(["time,u1,=SUM(A1),y${2}$", *(f"{time},0.1,0.2,{0.1 * k}" for k, time in enumerate(times))]) + "\n"


def contents() -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in Path().iterdir() if path.is_file()}


SIMULATE = ["simulate", "--system", "spec.yaml", "--gains", "g.json", "--quiet", "--out"]
REPORT = ["report", "--system", "spec.yaml", "--gains", "g.json", "--out"]
DESIGN = ["design", "--system", "spec.yaml", "--quiet", "--output"]
EXPORT = ["export", "--gains", "g.json", "--to"]
RUN = ["run", "--gains", "g.json", "--data", "log.csv", "--quiet", "--out"]


class TestInputsAreNeverOutputs:
    @pytest.mark.one_in(4)
    @pytest.mark.parametrize(
        ("words", "inputs"),
        [
            (SIMULATE, ("spec.yaml", "plant.yaml", "A.csv", "names.json", "g.json")),
            (REPORT, ("spec.yaml", "plant.yaml", "A.csv", "g.json")),
            (DESIGN, ("spec.yaml", "plant.yaml", "A.csv", "names.json")),
        ],
        ids=["simulate", "report", "design"],
    )
    @pytest.mark.parametrize("way", ["itself", "symlink", "hard link"])
    def test_not_even_by_force(self, words, inputs, way, capsys):
        for name in inputs:
            target = name
            if way != "itself":
                target = f"link to {name}"
                (os.symlink if way == "symlink" else os.link)(name, target)
            before = contents()
            assert main([*words, target, "--force"]) == 2
            told = capsys.readouterr().err
            assert told.startswith("Error: ")
            assert target in told
            assert contents() == before

    def test_a_run_and_an_export(self, capsys):
        os.symlink("log.csv", "soft.csv")
        os.link("log.csv", "hard.csv")
        os.symlink("g.json", "gains.c")
        Path("state.csv").write_text("", "utf-8")
        before = contents()
        for words in (
            [*RUN, "log.csv"], [*RUN, "soft.csv"], [*RUN, "hard.csv"], [*RUN, "new.csv", "--state", "new.csv"],
            [*RUN, "new.csv", "--state", "g.json"], [*RUN, "new.csv", "--state", "log.csv"], [*EXPORT, "gains.c"],
        ):  # fmt: skip
            assert main([*words, "--force"]) == 2, words
            assert capsys.readouterr().err.startswith("Error: ")
            assert contents() == before

    def test_the_log_on_standard_input(self, monkeypatch, capsys):
        with open("log.csv", encoding="utf-8") as stream:
            monkeypatch.setattr("sys.stdin", stream)
            assert main(["run", "--gains", "g.json", "--data", "-", "--quiet", "--force", "--out", "log.csv"]) == 2
        assert "as standard input" in capsys.readouterr().err
        assert Path("log.csv").read_text("utf-8") == log(range(10))


class TestOtherFiles:
    CASES = ((SIMULATE, "o.csv"), (REPORT, "o.html"), (DESIGN, "o.json"), (EXPORT, "o.c"), (EXPORT, "o.npz"),
             (EXPORT, "o.mat"), (RUN, "o.csv"))  # fmt: skip

    @pytest.mark.one_in(7)
    @pytest.mark.parametrize(("words", "name"), CASES)
    def test_the_own_kind_is_replaced_others_by_force_only(self, words, name, capsys):
        assert main([*words, name]) == 0
        first = Path(name).read_bytes()
        assert main([*words, name]) == 0
        Path(name).write_text("time,u1\n0,1\n", "utf-8")
        assert main([*words, name]) == 2
        assert f"{name} exists and is not" in capsys.readouterr().err
        assert Path(name).read_text("utf-8") == "time,u1\n0,1\n"
        assert main([*words, name, "--force"]) == 0
        # A report says when and by which words it was made, an archive when; of the others every byte is the same.
        assert len(Path(name).read_bytes().replace(b" --force", b"")) == len(first)

    def test_a_header_of_ones_own_beside_the_source(self, capsys):
        Path("o.h").write_text("#define MINE 1\n", "utf-8")
        assert main([*EXPORT, "o.c"]) == 2
        assert "o.h exists and is not C code that obsynth has exported" in capsys.readouterr().err
        assert not Path("o.c").exists()

    def test_the_folder_of_the_state_is_looked_for_before_work_begins(self, capsys, monkeypatch):
        monkeypatch.setattr("obsynth.monitoring.logs.log_run.LogRun.take", lambda *_: pytest.fail("work has begun"))
        assert main([*RUN, "o.csv", "--state", "missing/state.json"]) == 2
        assert "The folder missing does not exist" in capsys.readouterr().err
        assert not Path("o.csv").exists()


def command(*words: str, shell: str = "", **how) -> subprocess.CompletedProcess:
    line = [sys.executable, "-W", "error", "-m", "obsynth", *words]
    if shell:
        line = ["bash", "-c", f'"$@" {shell}', "bash", *line]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    return subprocess.run(line, capture_output=True, text=True, env=environment, timeout=600, check=False, **how)


class TestStandardStreams:
    @pytest.mark.long
    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device")
    def test_a_full_output(self):
        done = command("verify", "g.json", shell="> /dev/full")
        assert done.returncode == 2
        assert done.stderr == "Error: Standard output cannot be written: No space left on device.\n"

    @pytest.mark.long
    def test_a_closed_output(self):
        done = command("verify", "g.json", shell=">&-")
        assert (done.returncode, done.stderr) == (0, "")
        done = command("check", "--system", "nowhere.yaml", shell=">&- 2>&-")
        assert (done.returncode, done.stdout) == (2, "")

    @pytest.mark.long
    def test_a_reader_that_has_left(self):
        done = command("verify", "g.json", shell="| true; exit ${PIPESTATUS[0]}")
        assert done.returncode in (0, 141)
        assert done.stderr == ""


def heeds_signals() -> None:
    """Undo what a shell in the background, or nohup, has told this process to ignore."""
    for name in ("SIGTERM", "SIGHUP", "SIGINT"):
        signal.signal(getattr(signal, name), signal.SIG_DFL)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_a_stream_saves_its_state_when_it_is_ended(name, monkeypatch, capsys):
    assert main([*RUN, "whole.csv"]) == 0
    lines = log(range(10)).splitlines(keepends=True)
    words = ["run", "--gains", "g.json", "--data", "-", "--quiet", "--state", "state.json"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    environment.pop("PYTHONUNBUFFERED", None)
    line = [sys.executable, "-W", "error", "-m", "obsynth", *words]
    with subprocess.Popen(
        line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        # Whoever runs the tests may have it ignored.
        preexec_fn=lambda: signal.signal(getattr(signal, name), signal.SIG_DFL),
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdin.write("".join(lines[:6]))
        process.stdin.flush()
        answers = [process.stdout.readline() for _ in range(6)]
        process.send_signal(getattr(signal, name))
        assert process.wait(60) == 128 + getattr(signal, name)
        assert "Traceback" not in process.stderr.read()
    monkeypatch.setattr("sys.stdin", io.StringIO(lines[0] + "".join(lines[6:])))
    capsys.readouterr()
    assert main(words) == 0
    rest = capsys.readouterr().out.splitlines(keepends=True)[1:]
    assert "".join([*answers, *rest]) == Path("whole.csv").read_text("utf-8")


def with_digest(document, part):
    text = json.dumps(document[part], sort_keys=True, separators=(",", ":"))
    return json.dumps({**document, "sha256": hashlib.sha256(text.encode()).hexdigest()})


class TestNumbers:
    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("value", [10**400, None, float("nan"), "1", [], {}, True, {"shape": [1], "data": [None]}])
    @pytest.mark.parametrize("place", ["claims", "gains", "Az", "plant", "names"])
    def test_in_a_gain_set(self, value, place, capsys):
        document = json.loads(Path("g.json").read_text("utf-8"))
        design = document["design"]
        if place == "claims":
            design["certificate"]["claims"][next(iter(design["certificate"]["claims"]))] = value
        elif place == "gains":
            design["gains"][next(iter(design["gains"]))] = value
        elif place == "names":
            design["observer"]["state_names"] = value
        else:
            (design["observer"]["Az"] if place == "Az" else design["plant"]["A"])["data"][0] = value
        Path("g.json").write_text(with_digest(document, "design"), "utf-8")
        assert main(["verify", "g.json"]) in (2, 6)
        told = capsys.readouterr()
        assert told.err.startswith("Error: g.json") or "NOT verified" in told.out or "fail" in told.out
        assert main(["run", "--gains", "g.json", "--data", "log.csv", "--out", "o.csv", "--quiet"]) in (0, 2)

    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("value", [1e308, -1e308, 5e-324])
    @pytest.mark.parametrize("matrix", ["plant A", "plant C", "plant Bf", "observer Az", "observer By", "observer Dy"])
    def test_numbers_that_overflow_fail_their_checks_without_a_warning(self, matrix, value, capsys):
        document = json.loads(Path("g.json").read_text("utf-8"))
        part, name = matrix.split()
        document["design"][part][name]["data"][0] = value
        Path("g.json").write_text(with_digest(document, "design"), "utf-8")
        assert main(["verify", "g.json"]) in (2, 5, 6)
        told = capsys.readouterr()
        assert "Warning" not in told.err
        assert "FAIL" in told.out or "NOT verified" in told.out or told.err.startswith(("Error", "Inconclusive"))

    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("value", [10**400, float("nan"), "1", [], True, {"shape": [1], "data": [None]}])
    def test_in_a_saved_state(self, value, capsys):
        assert main([*RUN, "o.csv", "--state", "state.json"]) == 0
        good = Path("state.json").read_text("utf-8")
        Path("log.csv").write_text(log(range(10, 20)), "utf-8")
        for name in ("last", "z", "v", "inputs"):
            document = json.loads(good)
            document["run"]["state"]["observer"][name] = value
            Path("state.json").write_text(with_digest(document, "run"), "utf-8")
            before = contents()
            assert main([*RUN, "o.csv", "--state", "state.json"]) == 2, name
            assert capsys.readouterr().err.startswith("Error: state.json")
            assert contents() == before

    def test_a_stamp_that_falls_is_a_row_that_is_left_out_and_told(self):
        Path("log.csv").write_text(log([*range(8), "-1e308"]), "utf-8")
        assert main([*RUN, "o.csv"]) == 0
        assert Path("o.csv").read_text("utf-8").splitlines()[-1].startswith("-1e+308,out of order,")

    @pytest.mark.parametrize("last", ["1e308", "1e400", "1e16"])
    def test_in_a_cell_of_time(self, last, capsys):
        Path("log.csv").write_text(log([*range(8), last]), "utf-8")
        assert main([*RUN, "o.csv"]) == 2
        assert "Row 9" in capsys.readouterr().err
        assert not Path("o.csv").exists()

    @pytest.mark.parametrize("way", ["file", "stream"])
    def test_lines_that_end_with_carriage_returns(self, way, monkeypatch):
        assert main([*RUN, "whole.csv"]) == 0
        Path("log.csv").write_bytes(log(range(10)).replace("\n", "\r").encode())
        if way == "file":
            assert main([*RUN, "o.csv"]) == 0
        else:
            monkeypatch.setattr("sys.stdin", io.StringIO("\ufeff" + log(range(10)).replace("\n", "\r"), newline=""))
            assert main(["run", "--gains", "g.json", "--data", "-", "--out", "o.csv", "--quiet"]) == 0
        assert Path("o.csv").read_text("utf-8") == Path("whole.csv").read_text("utf-8")


class TestComputations:
    @pytest.mark.parametrize("words", [["check", "--system", "spec.yaml"], ["verify", "g.json"], [*DESIGN, "o.json"]])
    def test_lapack_gives_up(self, words, monkeypatch, capsys):
        def fail(*_, **__):
            raise np.linalg.LinAlgError("SVD did not converge")

        for name in ("svd", "eigvals", "eig", "qr", "solve", "lstsq", "norm"):
            monkeypatch.setattr(np.linalg, name, fail)
        for name in ("svd", "qr", "schur", "ordqz", "qz", "eigvals", "eig", "svdvals", "solve"):
            monkeypatch.setattr(f"scipy.linalg.{name}", fail)
        assert main(words) == 5
        told = capsys.readouterr().err
        assert "LAPACK gave up (SVD did not converge)" in told
        assert "Traceback" not in told
        assert not Path("o.json").exists()

    def test_an_entry_that_overflows(self, capsys):
        Path("plant.yaml").write_text(PLANT.replace("B: [[0.5], [1.0]]", "B: [[0.5], [1e308]]"), "utf-8")
        assert main(["check", "--system", "spec.yaml"]) in (0, 2, 3, 5)
        assert "Traceback" not in capsys.readouterr().err

    def test_a_library_that_is_missing(self, monkeypatch, capsys):
        monkeypatch.setitem(sys.modules, "pyarrow", None)
        assert main([*RUN, "o.parquet"]) == 2
        assert "pip install 'obsynth[parquet]'" in capsys.readouterr().err
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
        assert main([*REPORT, "o.html"]) == 2
        assert "the library matplotlib.figure, which cannot be loaded" in capsys.readouterr().err
        assert not Path("o.html").exists()


class TestNames:
    def test_no_header_cell_is_a_formula(self):
        for words, name in ((SIMULATE, "s.csv"), (RUN, "r.csv")):
            assert main([*words, name]) == 0
            with open(name, encoding="utf-8", newline="") as stream:
                header = next(csv.reader(stream))
            assert not [cell for cell in header if cell.lstrip().startswith(("=", "+", "-", "@", "\t", "\r"))]
        with open("s.csv", encoding="utf-8", newline="") as stream:
            assert "'=SUM(A1)" in next(csv.reader(stream))

    def test_a_table_that_was_simulated_can_be_run_on(self):
        assert main([*SIMULATE, "s.csv"]) == 0
        assert main(["run", "--gains", "g.json", "--data", "s.csv", "--out", "o.csv", "--quiet"]) == 0

    @pytest.mark.long
    def test_dollars_are_dollars_in_pictures(self):
        assert main([*REPORT, "o.html"]) == 0
        assert Path("o.html").read_text("utf-8").count("data:image/png") >= 1

    @pytest.mark.parametrize("name", ["two\\nlines", "\\0", "\\u0007", "\\ud800", "a\\u2028b"])
    def test_control_characters_are_refused(self, name, capsys):
        Path("plant.yaml").write_text(PLANT.replace("${fault}", name), "utf-8")
        assert main(["check", "--system", "spec.yaml"]) == 2
        assert capsys.readouterr().err.startswith("Error: ")


def test_a_long_sum_is_no_deep_one(capsys):
    plant = "plant: {kind: time-varying, dt: 1.0, horizon: 20, constants: {x: 0.5}, E: [[1]], A: [['%s']], C: [[1]]}\n"
    method = "method: {id: descriptor-kalman, options: {Q: [[1.0e-4]], R: [[1.0e-3]]}}\n"
    for sum_of, code in (
        ("*".join(["x"] * 950), 0),
        ("+".join(["x/1000"] * 250), 0),
        ("abs(" * 60 + "x" + ")" * 60, 2),
    ):
        Path("deep.yaml").write_text("schema_version: 1\nname: deep\n" + plant % sum_of + method, "utf-8")
        assert main(["check", "--system", "deep.yaml"]) == code
        told = capsys.readouterr().err
        assert ("it is nested more than" in told) == bool(code)


def test_ragged_rows_with_an_entry_that_is_none(capsys):
    plant = "plant: {kind: time-varying, dt: 1.0, horizon: 20, A: [[1, null], [1]], C: [[1, 0]]}\n"
    method = "method: {id: descriptor-kalman, options: {Q: 1.0e-4, R: 1.0e-3}}\n"
    Path("ragged.yaml").write_text("schema_version: 1\nname: ragged\n" + plant + method, "utf-8")
    assert main(["check", "--system", "ragged.yaml"]) == 2
    told = capsys.readouterr().err
    assert "row 1, column 2 must be a number or an expression in k, not nothing (null)" in told
    assert "row 2 has 1 entry, but row 1 has 2" in told


class TestFoldersOfResults:
    """``sweep`` and ``run`` on many designs: what is refused leaves no folder, and nothing that is read is written."""

    @pytest.mark.parametrize(
        "words",
        [
            ["--system", "missing.yaml"], ["--system", "spec.yaml", "--set", "gamma"],
            ["--system", "spec.yaml", "--set", "gamma=[]"],
            ["--system", "spec.yaml", "--set", "gamma=[2]", "--set", "gamma=[3]"],
        ],
        ids=["no spec", "no list", "no values", "twice"],
    )  # fmt: skip
    def test_a_refused_sweep_leaves_no_folder(self, words, capsys):
        before = contents()
        assert main(["sweep", *words, "--out", "new/folder", "--quiet"]) == 2
        assert capsys.readouterr().err.startswith("Error: ")
        assert not Path("new").exists()
        assert contents() == before

    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("jobs", ["0", "-1", "2.5", "many"])
    def test_no_process_is_a_word_that_the_command_line_refuses(self, jobs, capsys):
        before = contents()
        with pytest.raises(SystemExit) as ended:
            main(["sweep", "--system", "spec.yaml", "--jobs", jobs, "--out", "new/folder", "--quiet"])
        assert ended.value.code == 2
        assert "argument --jobs" in capsys.readouterr().err
        assert contents() == before

    def test_a_table_that_is_the_spec(self, capsys):
        Path("o").mkdir()
        os.symlink("../spec.yaml", "o/table.csv")
        before = contents()
        assert main(["sweep", "--system", "spec.yaml", "--out", "o", "--force", "--quiet"]) == 2
        assert "is read by this command" in capsys.readouterr().err
        assert contents() == before
        assert [path.name for path in Path("o").iterdir()] == ["table.csv"]

    def test_many_designs_on_nothing(self, capsys):
        Path("gs").mkdir()
        assert main(["run", "--gains", "gs", "--data", "log.csv", "--out", "o", "--quiet"]) == 2
        assert "there is no file" in capsys.readouterr().err
        assert not Path("o").exists()

    def test_a_log_that_would_be_the_table(self, capsys):
        Path("gs").mkdir()
        Path("o").mkdir()
        Path("gs/a.gains.json").write_bytes(Path("g.json").read_bytes())
        Path("o/table.csv").write_bytes(Path("log.csv").read_bytes())
        words = ["run", "--gains", "gs", "--data", "o/table.csv", "--out", "o", "--force", "--quiet"]
        assert main(words) == 2
        assert "is read by this command" in capsys.readouterr().err
        assert Path("o/table.csv").read_bytes() == Path("log.csv").read_bytes()


def test_a_named_pipe_is_no_log_of_a_calibration():
    from obsynth import SpecError
    from obsynth.monitoring.calibration.logs import read_log

    os.mkfifo("pipe.csv")
    with pytest.raises(SpecError, match="named pipe"):
        read_log("pipe.csv", ["u"], ["y"])


@pytest.mark.parametrize("runs", [10**30, 10**400])
def test_numbers_beyond_any_memory_are_refused(runs):
    from obsynth import SpecError, functional_filter
    from obsynth.numerics.arguments import Count, checked_value, is_finite_number
    from obsynth.specs.loader import load_spec

    assert is_finite_number(runs) == (runs < 10**300)
    with pytest.raises(SpecError, match="whole number"):
        checked_value(runs, "runs", Count)
    with pytest.raises(SpecError, match="delay"):
        functional_filter(load_spec("spec.yaml").plant, delay=runs)
