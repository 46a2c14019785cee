"""What a user gets wrong is told with what may be meant, and where."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

import obsynth
from obsynth.cli.examples import EXAMPLES
from obsynth.cli.main import VERBS, main, obsynth_parser
from obsynth.methods.registry import REGISTRY
from obsynth.numerics.suggestions import suggestion

ROOT = Path(__file__).parents[2]
THERMAL = ROOT / "docs/examples/thermal/spec.yaml"
WANG = ROOT / "designs/wang2015/spec.yaml"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["desing"], "there is no command 'desing'. Did you mean design?"),
        (["clibrate", "--system", "x"], "Did you mean calibrate or validate?"),
        (["xyzzy"], "there is no command 'xyzzy'. obsynth --help lists them all."),
        (["design", "--sytem", "spec.yaml"], "There is no option --sytem. Did you mean --system?"),
        (["check", "--system", "spec.yaml", "--verbos1"], "Did you mean --verbose?"),
    ],
)
def test_words_that_are_misspelt(words: list[str], told: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(words)
    assert left.value.code == 2
    assert told in capsys.readouterr().err


def test_a_mistake_of_yaml_is_shown_with_its_line_and_a_caret(tmp_path, capsys) -> None:
    text = THERMAL.read_text(encoding="utf-8")
    (tmp_path / "spec.yaml").write_text(text.replace("  state_names", "   state_names"), encoding="utf-8")
    assert main(["check", "--system", str(tmp_path / "spec.yaml")]) == 2
    *_, shown, caret = capsys.readouterr().err.rstrip().splitlines()
    number = next(i for i, line in enumerate(text.splitlines(), 1) if "state_names" in line)
    assert shown == f"  {number} |    state_names: [heater, air, wall, surface]"
    assert shown[caret.index("^") :].startswith("state_names")


def test_a_spec_given_for_a_gain_set_says_what_to_run(capsys) -> None:
    assert main(["run", "--gains", str(THERMAL), "--data", "log.csv"]) == 2
    assert f"is a spec, not a file that obsynth wrote. Run `obsynth design --system {THERMAL}` first." in (
        capsys.readouterr().err
    )


def test_own_constraints_are_judged_before_a_solver_is_asked() -> None:
    plant = obsynth.load_spec(WANG).plant
    with pytest.raises(obsynth.SpecError, match=r"Your constraint 1 is not convex: P @ Y <= 2\.0"):
        obsynth.fault_estimation_filter(plant, constraints=lambda v: [v["P"] @ v["Y"] <= 2.0])
    with pytest.raises(obsynth.SpecError, match=r"no variable 'L': there are P, Y, gamma_squared, and the data T, N,"):
        obsynth.fault_estimation_filter(plant, constraints=lambda v: [v["L"] <= 2.0])


def test_own_constraints_get_the_data_of_the_paper() -> None:
    import cvxpy as cp

    plant = obsynth.load_spec(WANG).plant
    design = obsynth.fault_estimation_filter(plant, constraints=lambda v: [cp.norm(v["Y"] @ v["C1"]) <= 30.0])
    assert design.report.passed


def test_a_method_of_a_plug_in_that_is_missing(tmp_path, capsys) -> None:
    (tmp_path / "spec.yaml").write_text(THERMAL.read_text(encoding="utf-8").replace("ui-pi-observer", "hinf-pi"))
    assert main(["design", "--system", str(tmp_path / "spec.yaml"), "--quiet"]) == 2
    assert "install the package that provides hinf-pi" in capsys.readouterr().err


def test_every_command_has_an_example_that_its_parser_takes() -> None:
    import shlex

    assert set(EXAMPLES) == set(VERBS)
    for name, example in EXAMPLES.items():
        program, verb, *words = shlex.split(example)
        assert (program, verb) == ("obsynth", name)
        parser = obsynth_parser([name])
        options, rest = parser.parse_known_args([verb, *words])
        assert options.verb == name
        # What is left are settings, which are read apart.
        assert all(word.startswith("--") or "=" in word or rest[i - 1].startswith("--") for i, word in enumerate(rest))


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_help_begins_with_the_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([name, "--help"])
    text = capsys.readouterr().out
    assert text.index("example:") < text.index("options:")
    printed = text[text.index("example:") + len("example:") :].lstrip().partition("\n\n")[0]
    # A shell reads the lines as the one command.
    assert shlex.split(printed.replace("\\\n", " ")) == shlex.split(EXAMPLES[name])


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_a_shell_completes_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["--print-completion", shell])
    assert left.value.code == 0
    script = capsys.readouterr().out
    assert "prove-alarm" in script
    assert shell == "tcsh" or "--false-alarms" in script


def test_a_file_without_its_option_is_asked_about(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["design", "spec.yaml"])
    assert "required: --system. Did you mean --system spec.yaml?" in capsys.readouterr().err


def test_a_missing_file_is_asked_about_by_its_neighbours(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "spec.yaml").write_text("schema_version: 1\n")
    assert main(["design", "--system", str(tmp_path / "spec.yml")]) == 2
    assert f"does not exist. Did you mean {tmp_path / 'spec.yaml'}?" in capsys.readouterr().err
    assert main(["design", "--system", str(tmp_path / "other.mat")]) == 2
    assert "Did you mean" not in capsys.readouterr().err
    assert main(["design", "--system", str(tmp_path / "none" / "spec.yaml")]) == 2
    assert "Did you mean" not in capsys.readouterr().err


def test_a_threshold_for_a_signal_and_a_misspelt_monitor_are_asked_about() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.9]], C=[[1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1}, fault_names=["leak"]
    )
    design = obsynth.functional_filter(plant)
    log = {"time": list(range(20)), "y1": [0.0] * 20}
    with pytest.raises(obsynth.SpecError, match=r"Did you mean 'fhat\[leak\]'\?"):
        obsynth.run_on_data(design, log, thresholds={"leak": 1.0})
    with pytest.raises(obsynth.SpecError, match=r"Did you mean 'chi-square'\?"):
        obsynth.online_monitor(design, "chisquare")


def test_a_missing_colon_is_asked_about(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = THERMAL.read_text(encoding="utf-8")
    path = tmp_path / "spec.yaml"
    path.write_text(text.replace("  dt: 0 ", "  dt 0 ", 1), encoding="utf-8")
    assert main(["check", "--system", str(path)]) == 2
    number = next(i for i, line in enumerate(text.splitlines(), 1) if line.startswith("  dt: 0"))
    assert capsys.readouterr().err.rstrip().endswith(f"Is a colon missing in line {number}: 'dt 0'?")


def test_a_transposed_matrix_is_asked_about_before_the_names_that_it_takes_away(tmp_path: Path) -> None:
    text = THERMAL.read_text(encoding="utf-8")
    outputs = "{outputs: [heater, air, wall]}"
    assert outputs in text
    path = tmp_path / "spec.yaml"
    path.write_text(text.replace(outputs, "[[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]]"), encoding="utf-8")
    with pytest.raises(obsynth.SpecError) as raised:
        obsynth.load_spec(path)
    assert "C is 4 by 3, but 3 by 4 is needed. Is it transposed?" in raised.value.problems[0]


def test_what_is_given_instead_of_a_plant_or_a_method_is_named() -> None:
    spec = obsynth.load_spec(WANG)
    with pytest.raises(obsynth.SpecError, match=r"obsynth\.load_spec\('spec\.yaml'\)\.plant"):
        obsynth.check("spec.yaml")  # type: ignore[arg-type]
    with pytest.raises(obsynth.SpecError, match=r"The plant of a spec is spec\.plant"):
        obsynth.fault_estimation_filter(spec)  # type: ignore[arg-type]
    with pytest.raises(obsynth.SpecError, match="Did you mean 'ui-pi-observer'"):
        obsynth.design(spec.plant, obsynth.ui_pi_observer)  # type: ignore[arg-type]
    with pytest.raises(obsynth.SpecError, match="Did you mean 'ui-pi-observer'"):
        obsynth.design(spec.plant, "ui-pi")
    with pytest.raises(obsynth.SpecError, match="install the package that provides hinf"):
        obsynth.design(spec.plant, "hinf")


def test_a_misspelt_function_is_asked_about() -> None:
    with pytest.raises(AttributeError, match="Did you mean 'fault_estimation_filter'"):
        _ = obsynth.fault_estimation_filer
    with pytest.raises(AttributeError, match="Did you mean 'plot_faults'"):
        _ = obsynth.plotting.plot_fault
    with pytest.raises(AttributeError, match=r"no attribute 'zzz'$"):
        _ = obsynth.zzz


def test_two_options_that_are_misspelt_are_two_sentences(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["export", "--gians", "g.json", "--ot", "x.c"])
    told = capsys.readouterr().err
    assert "There is no option --gians. Did you mean --gains? There is no option --ot. Did you mean --to or " in told


@pytest.mark.parametrize(
    ("method", "told"),
    [
        (
            "{id: ui-pi-observer, gamma: 2}",
            "method.gamma: unknown key. Write options below method.options, as options: {",
        ),
        ("{id: ui-pi-observer, options: {gamma: 2}}", "unknown key. It is an option of fault-estimation-filter"),
        ("{id: ui-pi-observer, options: {xyzzy: 2}}", "method.options.xyzzy: unknown key. The options are "),
        ("{id: ui-pi-observer, options: {pole: [0.5]}}", "method.options.pole: unknown key. Did you mean 'poles'?"),
        ("{options: {gama: 2}}", "method.options.gama: no method has this option. Did you mean 'gamma'?"),
        ("ui-pi-observer", "not the text 'ui-pi-observer'. Write method: {id: ui-pi-observer}."),
        ("{id: ui-pi-obsever}", "Did you mean 'ui-pi-observer'?"),
    ],
)
def test_an_option_in_the_wrong_place_is_told_its_own(method: str, told: str, tmp_path, capsys) -> None:
    head, _, _ = THERMAL.read_text(encoding="utf-8").partition("\nmethod:")
    (tmp_path / "spec.yaml").write_text(f"{head}\nmethod: {method}\n", encoding="utf-8")
    assert main(["design", "--system", str(tmp_path / "spec.yaml"), "--quiet"]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wrong", "near"),
    [
        ("state_name", " Did you mean 'state_names'?"),
        ("WALL", " Did you mean 'wall'?"),
        ("xhat[y]", " Did you mean 'xhat[x]' or 'fhat[y]'?"),
        ("zzz", ""),
    ],
)
def test_names_much_farther_than_the_closest_are_not_suggested(wrong: str, near: str) -> None:
    assert (
        suggestion(wrong, ["state_names", "fault_names", "noise_names", "wall", "walls", "xhat[x]", "fhat[y]"]) == near
    )


def test_what_there_is_stands_in_the_message_where_nothing_is_close() -> None:
    given = {"A": [[0.5]], "C": [[1.0]], "dt": 1.0}
    with pytest.raises(obsynth.SpecError, match=r"no signal named 'z'\. There are: y1\."):
        obsynth.DescriptorSystem(**given, sensor_noise={"z": 0.1})
    with pytest.raises(obsynth.SpecError, match=r"Bf=\[\[1\]\] for a column or Bf=\[\[1\]\] for a row\."):
        obsynth.DescriptorSystem(**given, Bf=[1])
    with pytest.raises(obsynth.SpecError, match=r"fault_names has 2 names, but the plant has 1 fault \(column of Bf"):
        obsynth.DescriptorSystem(**given, Bf=[[1]], fault_names=["a", "b"])


def test_a_plant_without_faults_is_not_said_to_have_some() -> None:
    plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], dt=1.0)
    with pytest.raises(obsynth.PreconditionError) as refused:
        obsynth.fault_estimation_filter(plant)
    assert "Name the fault to estimate in Bf or Df." in str(refused.value)
    assert "aults can be estimated" not in str(refused.value)
    assert "Neither" not in str(refused.value)


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--time-column", "timestamp"], "Did you mean 'Timestamp'? Map it: --map time=Timestamp, or columns="),
        (["--time-column", "Timestamp", "--map", "air=luft"], "Map it: --map air=YOUR_COLUMN, or columns="),
        (["--time-column", "Timestamp", "--map", "air=AIR"], "Did you mean 'air'? Map it: --map air=air, or columns="),
    ],
)
def test_a_column_that_is_missing_is_mapped_by_its_signal(words: list[str], told: str, tmp_path, capsys) -> None:
    log = "Timestamp,power,heater,air,wall\n0,100,175,147,120\n10,100,175,147,120\n"
    (tmp_path / "log.csv").write_text(log, encoding="utf-8")
    gains = str(tmp_path / "oven.gains.json")
    assert main(["design", "--system", str(THERMAL), "--output", gains, "--quiet"]) == 0
    assert main(["run", "--gains", gains, "--data", str(tmp_path / "log.csv"), *words, "--quiet"]) == 2
    assert told in capsys.readouterr().err


def test_too_many_arguments_by_position_are_told_by_their_names() -> None:
    with pytest.raises(TypeError, match=r"^Step takes its arguments by name: start, end, size\.$"):
        obsynth.Step(1.0, 10.0)  # type: ignore[misc]
    with pytest.raises(
        TypeError, match=r"^DescriptorSystem takes E, A, B, C by position and the others by name: D, Bf"
    ):
        obsynth.DescriptorSystem([[1.0]], [[0.5]], [[1.0]], [[1.0]], [[0.0]])  # type: ignore[misc]


@pytest.mark.parametrize(
    ("option", "meant"), [("P0", "initial_covariance"), ("x0", "initial_state"), ("RN", "R"), ("process_noise", "Q")]
)
def test_an_option_by_the_name_of_another_library_is_asked_about(option: str, meant: str) -> None:
    plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], dt=1.0)
    with pytest.raises(obsynth.SpecError, match=rf"has no option '{option}'\. Did you mean '{meant}'\?"):
        obsynth.descriptor_kalman(plant, **{option: 1.0})


@pytest.mark.parametrize(
    ("wrong", "meant"), [("Ts", "'dt'"), ("fault_name", "'fault_names'"), ("F", "'Bf'"), ("zzz", "")]
)
def test_an_argument_by_another_name_is_asked_about(wrong: str, meant: str) -> None:
    with pytest.raises(TypeError) as raised:
        obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], **{wrong: None})  # type: ignore[arg-type]
    advice = f" Did you mean {meant}?" if meant else " There are: A, B, Bd, Bf"
    assert str(raised.value).startswith(f"DescriptorSystem has no argument {wrong!r}.{advice}")


def test_one_name_and_one_number_are_told_how_they_are_written() -> None:
    given = {"A": [[0.5]], "C": [[1.0]], "Bf": [[1.0]], "dt": 1.0}
    with pytest.raises(obsynth.SpecError, match=r"list of non-empty texts\. Give \['leak'\]\."):
        obsynth.DescriptorSystem(**given, fault_names="leak")
    assert obsynth.DescriptorSystem(**given, fault_names=["leak"]).fault_names == ("leak",)
    with pytest.raises(obsynth.SpecError, match=r"needs a profile, such as obsynth\.Step\(size=2\), or a list"):
        obsynth.Scenario(horizon=3, faults={"f1": 2.0})  # type: ignore[dict-item]
    assert obsynth.Scenario(horizon=3, faults={"f1": obsynth.Step(size=2)}).faults


#: Their keyword arguments are options, which `SpecError` names.
METHOD_FUNCTIONS = [
    getattr(obsynth, method.replace("-", "_")) for method in REGISTRY if hasattr(obsynth, method.replace("-", "_"))
]

#: Functions whose further arguments are options of methods, matrices or signals: these have messages of their own.
TAKES_ANY = inspect.Parameter.VAR_KEYWORD


@pytest.mark.parametrize("module", ["", ".conditions", ".plotting"])
def test_every_public_name_suggests_the_nearest_keyword(module: str) -> None:
    public, checked = import_module(f"obsynth{module}"), 0
    for name in public.__all__:
        made = getattr(public, name)
        if not callable(made) or (isinstance(made, type) and issubclass(made, Exception)):
            continue
        stated = inspect.signature(made).parameters.values()
        keywords = [each.name for each in stated if each.kind in (each.KEYWORD_ONLY, each.POSITIONAL_OR_KEYWORD)]
        if not keywords or made in METHOD_FUNCTIONS or any(each.kind is TAKES_ANY for each in stated):
            continue
        longest = max(keywords, key=len)
        with pytest.raises(TypeError, match=rf"has no argument '{longest}x'\. Did you mean '{longest}'"):
            made(**{f"{longest}x": None})
        checked += 1
    assert checked > 10


@pytest.mark.parametrize("designed", METHOD_FUNCTIONS, ids=lambda function: function.__name__)
def test_every_method_suggests_the_nearest_option(designed: Callable[..., object]) -> None:
    plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    option = max(set(inspect.signature(designed).parameters) - {"plant", "name"}, key=len)
    with pytest.raises(obsynth.SpecError, match=rf"has no option '{option}x'.*Did you mean '{option}'"):
        designed(plant, **{f"{option}x": None})


def test_an_option_that_no_method_has_is_named() -> None:
    plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    with pytest.raises(obsynth.SpecError, match=r"No method has the option 'gama'\. Did you mean 'gamma'"):
        obsynth.design(plant, gama=2.0)


def test_a_scenario_names_its_argument_by_what_others_call_it() -> None:
    with pytest.raises(TypeError, match=r"no argument 'duration'\. Did you mean 'horizon'\?"):
        obsynth.Scenario(duration=30.0)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"no argument 'x0'\. Did you mean 'initial_state'\?"):
        obsynth.Scenario(horizon=30.0, x0={})  # type: ignore[call-arg]


@pytest.mark.parametrize("value", ["many", "2.5"])
def test_a_word_in_place_of_a_number_is_refused_in_words(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["evaluate", "gains.json", "--runs", value])
    assert f"argument --runs: '{value}' is no whole number." in capsys.readouterr().err


def test_a_file_that_is_no_gain_set_says_how_one_is_written(tmp_path: Path) -> None:
    (tmp_path / "gains.json").write_text("[]", encoding="utf-8")
    with pytest.raises(obsynth.SpecError, match=r"is no gain set.*obsynth design --system SPEC --output FILE"):
        obsynth.load(tmp_path / "gains.json")


def test_variances_in_a_list_are_answered_with_a_diagonal() -> None:
    plant = obsynth.DescriptorSystem(A=[[0.5, 0], [0, 0.4]], C=[[1, 0], [0, 1]], dt=1.0)
    with pytest.raises(obsynth.SpecError, match=r"or Q=numpy\.diag\(\[1, 2\]\) for a diagonal"):
        obsynth.descriptor_kalman(plant, Q=[1, 2])


@pytest.mark.parametrize(
    ("command", "name", "message"),
    [
        ("check", "m.csv", "is a log (a table), not a spec (YAML or JSON). Logs are given with --data"),
        ("check", "m.xlsx", "is a log (a table), not a document of text. Logs are given with --data"),
        ("check", "m.mat", "is a file of MATLAB, not a document of text. A model in it is read in Python"),
        ("check", "A.mtx", "is a matrix, not a spec (YAML or JSON)."),
        ("verify", "m.csv", "is a log (a table), not a file that obsynth wrote (JSON)."),
        ("verify", "observer.c", "is C code, not a file that obsynth wrote (JSON)."),
        ("verify", "proof.json", "is a proof, not a gain set. Check it by `obsynth verify"),
    ],
)
def test_a_file_of_another_kind_is_named(
    command: str, name: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A log given for a spec was told that its top level must be a mapping."""
    contents = {
        ".csv": b"time,u\n0.0,1.0\n",
        ".xlsx": b"PK\x03\x04\xff",
        ".mat": b"MATLAB 5.0 \xff",
        ".mtx": b"%%MatrixMarket matrix coordinate real general\n1 1 1\n1 1 1\n",
        ".c": b"enum { TESTS = 1 };\n",
        ".json": b'{"format":"obsynth-proof","version":1}',
    }
    file = tmp_path / name
    file.write_bytes(contents[file.suffix])
    assert main([command, "--system" if command == "check" else "--gains", str(file)]) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_a_level_with_its_unit_is_answered_by_the_number_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gains = tmp_path / "wang.gains.json"
    assert main(["design", "--system", str(WANG), "--output", str(gains), "--quiet"]) == 0
    words = ["export", "--gains", str(gains), "--to", str(tmp_path / "o.c"), "--threshold"]
    assert main([*words, "fhat[actuator 1]=1 V"]) == 2
    assert "which is not written. Give fhat[actuator 1]=1." in " ".join(capsys.readouterr().err.split())
    assert main([*words, "fhat[actuator 1]=1"]) == 0


@pytest.mark.parametrize("command", ["compare", "sensors"])
def test_a_plant_that_changes_with_k_is_told_in_words(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A class of Python was named to somebody who had written a spec."""
    assert main([command, "--system", str(ROOT / "designs/smib/spec_inertia.yaml"), "--quiet"]) == 2
    told = capsys.readouterr().err
    assert "A linear plant with constant matrices is needed, and this one changes with k." in told
    assert "DescriptorSystem" not in told
