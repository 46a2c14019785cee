"""The command line: what it prints where, what it writes, and how it ends."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import obsynth
from obsynth.cli.main import design_command, main, obsynth_parser
from obsynth.results.gain_set_writing import digest_of
from obsynth.results.gain_sets import load

ROOT = Path(__file__).parents[2]
WANG = ROOT / "designs" / "wang2015" / "spec.yaml"
WANG_OTHER_FAULTS = ROOT / "designs" / "wang2015_printed_psi" / "spec.yaml"
SMIB = ROOT / "designs" / "smib" / "spec.yaml"

FILES = ("--gains", "a.json", "--data", "b.csv")
IMPOSSIBLE = """\
schema_version: 1
name: impossible
plant: {dt: 1, A: [[0, 1], [-0.1, 0.3]], C: [[1, 1]], Bf: [[0], [1]]}
method: {id: fault-estimation-filter}
"""
# Index 1: x2 = -x1 + f.  Bracketed and non-ASCII names must reach the terminal as they are.
CONTINUOUS = """\
schema_version: 1
name: small
plant:
  dt: 0
  E: [[1, 0], [0, 0]]
  A: [[-1, 1], [-1, -1]]
  C: {outputs: [x1]}
  Bf: [[0], [1]]
  fault_names: ["[bold]tor\u03c4ue[/bold]"]
  transform: {eliminate_algebraic_states: true, sample_time: 0.5}
method: {id: fault-estimation-filter}
"""


@pytest.fixture(autouse=True)
def _work_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")


@pytest.fixture(scope="module")
def wang_gains(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("gains") / "wang2015.gains.json"
    assert main(["design", "--system", str(WANG), "--output", str(path), "--quiet"]) == 0
    return path


def run(*arguments: str, **settings: Any) -> subprocess.CompletedProcess[str]:
    """Run the command line as a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), **settings.pop("env", {})}
    command = [sys.executable, "-m", "obsynth", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, **settings)


def damaged(path: Path, target: Path) -> Path:
    """Write a gain set with one wrong gain and a digest that fits."""
    document = json.loads(path.read_text(encoding="utf-8"))
    document["design"]["observer"]["By"]["data"][0] += 1e-3
    document["sha256"] = digest_of(document["design"])
    target.write_text(json.dumps(document), encoding="utf-8")
    return target


class TestDesign:
    @pytest.mark.long
    def test_report_and_file(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        assert main(["design", "--system", str(WANG), "-v"]) == 0
        printed = capsys.readouterr()
        assert [path.name for path in tmp_path.iterdir()] == ["wang2015.gains.json"]
        for text in ("wang2015", "gamma_min", "1.464718", "actuator 1", "H-infinity norm", "Verified: all"):
            assert text in printed.out
        assert printed.out.rstrip().endswith("Gain set: wang2015.gains.json")
        assert load("wang2015.gains.json").report.passed

    def test_design_is_obsynth_design(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert design_command(["--system", str(WANG), "--output", "a.json", "--quiet", "--json"]) == 0
        first = json.loads(capsys.readouterr().out)
        assert main(["design", "--system", str(WANG), "--output", "b.json", "--quiet", "--json"]) == 0
        second = json.loads(capsys.readouterr().out)
        assert (first["file"], second["file"]) == ("a.json", "b.json")
        gains = [document["gain_set"]["design"]["gains"] for document in (first, second)]
        assert gains[0] == gains[1]

    def test_json_is_the_gain_set_of_the_file(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["design", "--system", str(WANG), "--json"]) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed["gain_set"] == json.loads(Path("wang2015.gains.json").read_text(encoding="utf-8"))
        assert printed["passed"] is True

    def test_stages_go_to_stderr_unless_quiet(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["design", "--system", str(WANG), "--json"]) == 0
        stages = capsys.readouterr().err.splitlines()
        assert len(stages) >= 4
        assert "reading" in stages[0]
        assert "verifying" in stages[-1]
        assert main(["design", "--system", str(WANG), "--json", "--quiet"]) == 0
        assert capsys.readouterr().err == ""

    def test_an_older_file_is_replaced(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        (tmp_path / "wang2015.gains.json").write_text("old", encoding="utf-8")
        assert main(["design", "--system", str(WANG), "--quiet"]) == 0
        assert load("wang2015.gains.json").name == "wang2015"
        assert len(list(tmp_path.iterdir())) == 1

    def test_an_older_file_survives_a_failure(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        (tmp_path / "spec.yaml").write_text(IMPOSSIBLE, encoding="utf-8")
        (tmp_path / "impossible.gains.json").write_text("old", encoding="utf-8")
        assert main(["design", "--system", "spec.yaml", "--quiet"]) == 3
        assert (tmp_path / "impossible.gains.json").read_text(encoding="utf-8") == "old"

    def test_options_of_the_spec_are_used(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        text = WANG.read_text(encoding="utf-8").replace("plant.yaml", str(WANG.parent / "plant.yaml"))
        text = text.replace("{weight: paper}", "{weight: paper, gamma: 2.5}")
        (tmp_path / "spec.yaml").write_text(text, encoding="utf-8")
        assert main(["design", "--system", "spec.yaml", "--quiet", "--json"]) == 0
        found = json.loads(capsys.readouterr().out)["gain_set"]["design"]
        assert found["options"]["gamma"] == 2.5
        assert found["certificate"]["claims"]["gamma"] == 2.5

    def test_a_transformed_plant_keeps_the_way_back(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        (tmp_path / "spec.yaml").write_text(CONTINUOUS, encoding="utf-8")
        assert main(["design", "--system", "spec.yaml", "--quiet", "--verbose"]) == 0
        printed = capsys.readouterr().out
        assert "[bold]tor\u03c4ue[/bold]" in printed
        assert "States of the plant as written" in printed
        assert "needs the fault estimate" in printed
        recovery = load("small.gains.json").recovery
        assert recovery is not None
        assert recovery.flags() == ("exact", "needs the fault estimate")

    @pytest.mark.long
    def test_smib(self, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("COLUMNS", "80")
        assert main(["design", "--system", str(SMIB), "--quiet"]) == 0
        printed = capsys.readouterr().out
        estimate = next(line for line in printed.splitlines() if line.startswith("tm GENCLS 1 "))
        delay_in_samples, delay_in_seconds, deviation = estimate.removeprefix("tm GENCLS 1").split()[:3]
        assert (delay_in_samples, delay_in_seconds) == ("1", "0.02")
        assert float(deviation) < 0.05
        for text in (
            "tm GENCLS 1",
            "active power Bus 3",
            "0.02",
            "Verified: all",
            "the model is exact",
            "the slowest mode falls to 2 % in",
        ):
            assert text in printed
        assert len(printed.splitlines()) <= 16
        assert max(map(len, printed.splitlines())) <= 80
        assert "LMI" not in printed


class TestWidths:
    @pytest.mark.one_in(3)
    @pytest.mark.parametrize("width", [72, 80, 120, 200])
    @pytest.mark.parametrize(
        "arguments", [["verify", "-v"], ["check", "-v", "--system", str(SMIB)]], ids=["verify", "check"]
    )
    def test_everything_fits_and_no_verdict_is_cut(
        self,
        width: int,
        arguments: list[str],
        wang_gains: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.setenv("COLUMNS", str(width))
        # A path stays in one piece, so it is given by its name alone.
        monkeypatch.chdir(wang_gains.parent)
        given = [*arguments, wang_gains.name] if arguments[0] == "verify" else arguments
        assert main(given) == 0
        lines = capsys.readouterr().out.splitlines()
        assert max(len(line) for line in lines) <= width
        assert "\u2026" not in "".join(lines)
        heading = next(line.split() for line in lines if line.startswith("check "))
        assert heading == ["check", *(["claim"] if width >= 110 else []), "value", "bound", "margin", "verdict", "kind"]
        assert sum(" holds " in line for line in lines) >= 10

    @pytest.mark.one_in(4)
    @pytest.mark.parametrize("width", [70, 78, 80, 90])
    def test_no_column_of_a_narrow_table_is_cut(
        self, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setenv("COLUMNS", str(width))
        thermal = ROOT / "docs" / "examples" / "thermal" / "spec.yaml"
        (report,) = obsynth.diagnose(obsynth.load_spec(thermal).plant).verdict_rows()[1:]
        assert main(["check", "--system", str(thermal)]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert next(line for line in lines if line.startswith("fault ")).split()[-2:] == ["residual", "filter"]
        assert next(line for line in lines if line.startswith("heater ")).split()[-3:] == list(report[-3:])

    def test_a_failure_is_a_word(self, wang_gains: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["verify", str(damaged(wang_gains, tmp_path / "bad.json"))]) == 6
        printed = capsys.readouterr().out
        assert " FAILS " in printed
        assert "FAILS: " in printed
        assert "Verified" not in printed


class TestCheck:
    @pytest.mark.long
    def test_possible(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        assert main(["check", "--system", str(SMIB), "-v"]) == 0
        printed = capsys.readouterr().out
        for text in (
            "as written",
            "rank 4 of 34",
            "30, of size 1",
            "eliminated 30 algebraic states",
            "a design exists",
        ):
            assert text in printed
        assert list(tmp_path.iterdir()) == []

    def test_impossible(self, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        (tmp_path / "spec.yaml").write_text(IMPOSSIBLE, encoding="utf-8")
        assert main(["check", "--system", "spec.yaml"]) == 3
        printed = capsys.readouterr().out
        assert "IMPOSSIBLE" in printed
        assert "FAILS" in printed
        assert "-1" in printed

    @pytest.mark.parametrize(("spec", "code"), [(WANG_OTHER_FAULTS, 0), (None, 3)])
    def test_json(self, spec: Path | None, code: int, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
        (tmp_path / "spec.yaml").write_text(IMPOSSIBLE, encoding="utf-8")
        assert main(["check", "--system", str(spec or "spec.yaml"), "--json"]) == code
        found = json.loads(capsys.readouterr().out)
        assert found["passed"] is (code == 0)
        assert found["methods"][found["method"]]["passed"] is (code == 0)
        structure = found["structure"]["as_the_method_sees_it"]
        assert structure["regular"] is True
        assert structure["index"] == (1 if spec else 0)
        assert len(structure["finite_eigenvalues"]) == (3 if spec else 2)


class TestVerify:
    def test_holds(self, wang_gains: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["verify", str(wang_gains)]) == 0
        printed = capsys.readouterr().out
        assert "Verified: all" in printed.splitlines()[0]
        assert len(printed.splitlines()) <= 20
        assert main(["verify", str(wang_gains), "-v"]) == 0
        assert "H-infinity norm" in capsys.readouterr().out

    def test_json(self, wang_gains: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["verify", str(wang_gains), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert (found["passed"], found["name"], found["method"]) == (True, "wang2015", "fault-estimation-filter")
        assert all(check["passed"] for check in found["report"]["checks"])

    def test_printed_digits_are_passed_on(
        self, wang_gains: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        # An error of 1e-3 is within what printing with two decimals may do, and beyond twelve.
        path = str(damaged(wang_gains, tmp_path / "rounded.json"))
        margins = []
        for digits in ("2", "12"):
            main(["verify", path, "--printed-digits", digits, "--json"])
            checks = {row["name"]: row for row in json.loads(capsys.readouterr().out)["report"]["checks"]}
            margins.append(checks["unbiased: dynamics"]["passed"])
        assert margins == [True, False]


class TestEndings:
    @pytest.mark.parametrize(
        "arguments",
        [
            [],
            ["design"],
            ["nonsense"],
            ["check"],
            ["verify"],
            ["verify", "gains.json", "--printed-digits", "0"],
            ["verify", "gains.json", "--printed-digits", "many"],
            ["design", "--system"],
            ["design", "--system", "spec.yaml", "--unknown"],
        ],
    )
    def test_wrong_arguments_end_with_2(self, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit) as end:
            main(arguments)
        assert end.value.code == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert "usage:" in printed.err

    def test_the_first_steps_name_commands_that_parse_and_files_that_exist(
        self, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with pytest.raises(SystemExit):
            main([])
        lines = [shlex.split(line) for line in capsys.readouterr().err.splitlines() if line.startswith("  obsynth ")]
        assert [words[1] for words in lines] == ["check", "design", "simulate"]
        for words in lines:
            options = obsynth_parser().parse_args(words[1:])
            assert (ROOT / options.system).is_file()

    @pytest.mark.parametrize(
        ("command", "arguments", "told"),
        [
            (main, ["thresholds", *FILES, "--false-alarm-rate", "1"], "Did you mean --false-alarms"),
            (main, ["run", *FILES, "--qqqq=7"], "there is no option --qqqq. See obsynth run"),
            (main, ["run", *FILES, "-q"], "there is no option -q. Did you mean --quiet? See obsynth run"),
            (main, ["plot", *FILES, "more"], "it does not take 'more': see obsynth plot --help."),
            (design_command, ["--system", "spec.yaml", "--outptu=x"], "Did you mean --output"),
        ],
    )  # fmt: skip
    def test_an_unknown_option_is_told_with_the_usage_of_its_verb(
        self, command: Any, arguments: list[str], told: str, capsys: pytest.CaptureFixture[str]
    ) -> None:
        with pytest.raises(SystemExit) as end:
            command(arguments)
        assert end.value.code == 2
        printed = capsys.readouterr().err
        assert told in " ".join(printed.split())
        assert printed.startswith("usage: design" if command is design_command else f"usage: obsynth {arguments[0]}")

    def test_verify_takes_a_gain_set_by_name_or_by_gains(self, capsys: pytest.CaptureFixture[str]) -> None:
        gains = "nothing.gains.json"
        assert main(["verify", "--gains", gains]) == main(["verify", gains]) == 2
        first, second = capsys.readouterr().err.splitlines()
        assert first == second
        assert gains in first
        assert main(["verify", f"--gains={gains}"]) == 2

    @pytest.mark.parametrize("command", [main, design_command])
    def test_version(self, command: Any, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit) as end:
            command(["--version"])
        assert end.value.code == 0
        assert capsys.readouterr().out == f"obsynth {obsynth.__version__}\n"

    def test_interrupted(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        def interrupted(spec: Any, **_: Any) -> Any:
            raise KeyboardInterrupt

        monkeypatch.setattr("obsynth.cli.commands.design_of_spec", interrupted)
        assert main(["design", "--system", str(WANG), "--quiet"]) == 130
        assert capsys.readouterr().err == "Interrupted.\n"
        assert list(Path.cwd().iterdir()) == []

    def test_errors_are_text_on_stderr_and_nothing_on_stdout(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["design", "--system", "nowhere.yaml", "--quiet"]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err == "Error: nowhere.yaml does not exist.\n"


class TestRealProcesses:
    @pytest.mark.long
    def test_design(self, tmp_path: Path) -> None:
        done = run("design", "--system", str(WANG), "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["passed"] is True
        assert "searching" in done.stderr
        assert [path.name for path in tmp_path.iterdir()] == ["wang2015.gains.json"]

    @pytest.mark.long
    def test_error(self, tmp_path: Path) -> None:
        (tmp_path / "spec.yaml").write_text(IMPOSSIBLE, encoding="utf-8")
        done = run("design", "--system", "spec.yaml")
        assert done.returncode == 3
        assert done.stdout == ""
        assert "zero z = -1" in done.stderr
        assert "Traceback" not in done.stderr

    @pytest.mark.long
    def test_an_ascii_terminal(self, tmp_path: Path) -> None:
        (tmp_path / "spec.yaml").write_text(CONTINUOUS, encoding="utf-8")
        done = run("design", "--system", "spec.yaml", env={"PYTHONIOENCODING": "ascii"})
        assert done.returncode == 0, done.stderr
        assert "tor\\u03c4ue" in done.stdout

    @pytest.mark.long
    def test_a_reader_that_leaves(self, wang_gains: Path) -> None:
        command = [sys.executable, "-m", "obsynth", "verify", str(wang_gains)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            process.stdout.close()
            said = process.stderr.read()
        assert process.returncode == 141
        assert said == b""

    @pytest.mark.long
    def test_progress_on_a_terminal_disappears(self, tmp_path: Path) -> None:
        here, there = os.openpty()
        environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "TERM": "xterm"}
        command = [sys.executable, "-m", "obsynth", "design", "--system", str(WANG), "--json"]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=there, check=False, env=environment)
        os.close(there)
        # A terminal gives at most 4095 characters at once, which is less than a slow machine shows.
        parts = []
        with suppress(OSError):
            while part := os.read(here, 65536):
                parts.append(part)
        shown = b"".join(parts).decode()
        os.close(here)
        assert done.returncode == 0
        assert json.loads(done.stdout)["passed"] is True
        # The line is erased at the end, and the cursor is shown again.
        assert "reading" in shown or "searching" in shown
        assert shown.endswith(("\x1b[2K", "\x1b[?25h\r\x1b[1A\x1b[2K", "\x1b[?25h"))
