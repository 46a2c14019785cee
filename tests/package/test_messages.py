"""What is said besides the numbers: one message for one mistake, and no silence where less is done than was asked."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.errors import SpecError
from obsynth.plants.signal_names import index_of
from obsynth.report.page_tables import value_text

PLANT = {
    "E": [[1.0, 0.0], [0.0, 1.0]],
    "A": [[0.9, 0.1], [0.0, 0.5]],
    "C": [[1.0, 0.0], [0.0, 1.0]],
    "Bf": [[1.0], [0.0]],
    "Bd": [[0.0], [1.0]],
    "dt": 0.1,
}


@pytest.mark.parametrize("letter", ["B", "C", "Bf", "Bd", "Bw"])
def test_a_matrix_that_cannot_be_read_is_the_only_thing_said_of_its_signals(letter):
    # D, Df, Dd, Dw and the names of the signals depend on a number that is not known then.
    others = {"C": {"D": [[1.0], [1.0]], "output_names": ["y", "z"]}, "B": {"input_names": ["u"]}}
    with pytest.raises(SpecError) as found:
        obsynth.DescriptorSystem(**{**PLANT, **others.get(letter, {}), letter: ["x7"]})
    assert str(found.value) == f"{letter} has no signal named 'x7'. There are: x1, x2."


def test_mistakes_that_have_nothing_to_do_with_one_another_are_told_together():
    with pytest.raises(SpecError) as found:
        obsynth.DescriptorSystem(**{**PLANT, "C": ["x7"], "Bd": [[1.0]], "fault_names": ["a", "b"]})
    assert len(found.value.problems) == 3


def test_a_gain_far_above_what_is_useful_is_not_shipped_and_the_report_says_so():
    design = obsynth.fault_estimation_filter(obsynth.DescriptorSystem(**{**PLANT, "Bd": [[1.0], [1.0]]}), gamma=1e6)
    gamma = design.certificate.claims["gamma"]
    assert gamma < 1e6
    assert any(note.startswith("gamma = 1e+06 was asked for, and") for note in design.notes)
    usual = obsynth.fault_estimation_filter(design.plant, gamma=gamma / 2)
    assert usual.certificate.claims["gamma"] == gamma / 2
    assert not any("was asked for" in note for note in usual.notes)


def test_a_run_that_is_mostly_warm_up_says_why_nothing_was_raised(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    design = obsynth.fault_estimation_filter(obsynth.DescriptorSystem(**PLANT), weight="paper")
    design.save(tmp_path / "gains.json")
    for rows, told in ((3, True), (400, False)):
        log = "time,y1,y2\n" + "".join(f"{0.1 * row:.1f},0,0\n" for row in range(rows))
        (tmp_path / "log.csv").write_text(log, encoding="utf-8")
        files = ["--gains", str(tmp_path / "gains.json"), "--data", str(tmp_path / "log.csv")]
        watch = ["--monitor", "pointwise", "--disturbance", "d1=1", "--out", str(tmp_path / "out.csv")]
        assert main(["run", *files, *watch]) == 0
        printed = capsys.readouterr().out
        # Of rows without a decision only the reason is printed.
        assert ("No alarm by pointwise" in printed) != told
        assert (f"No decision in the first {rows} of {rows} rows" in printed) == told


def test_the_order_of_messages_does_not_change_from_run_to_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    content = """
schema_version: 1
name: case
plant: {dt: 1, A: [[0.5]], C: [[1]], Bf: [[1]]}
method: {id: fault-estimation-filter}
scenario: {horizon: 9, faults: {f1: {kind: sine, size: 1, rate: 2, period: 3, amplitude: 1, frequency: 0.1}}}
"""
    (tmp_path / "spec.yaml").write_text(content, encoding="utf-8")
    assert main(["check", "--system", str(tmp_path / "spec.yaml")]) == 2
    assert re.findall(r"a sine has no (\w+):", capsys.readouterr().err) == ["period", "rate", "size"]


def test_what_a_solver_did_is_separated_run_by_run():
    assert value_text([{"what": "a", "gain": 1}, {"what": "b"}]) == "what: a, gain: 1; what: b"


def test_every_wrong_name_and_shape_of_a_plant_is_told_at_once():
    """Each with what was meant: a name that is close, or that a column was written as a row."""
    with pytest.raises(obsynth.SpecError) as found:
        obsynth.DescriptorSystem(
            A=[[-1, 0], [0, -2]], C=["x1"], Bf=[[1, 0]], state_names=["x1", "x2"], sensor_noise={"w": 1.0, "v": 1.0},
            operating_point={"x11": 1.0}, units={"zz": "m", "x22": "m"},
        )  # fmt: skip
    told = found.value.problems
    assert "sensor_noise has no signal named 'w'." in told
    assert "sensor_noise has no signal named 'v'." in told
    assert any(text.endswith("Is it transposed?") for text in told if text.startswith("Bf "))
    assert any("'x11'" in text and "Did you mean 'x1'" in text for text in told)
    assert any("'x22'" in text and "Did you mean 'x2'" in text for text in told)
    assert len(told) == 6


def test_a_name_that_is_like_no_other_is_told_what_there_is() -> None:
    with pytest.raises(SpecError, match=r"Q has no signal named 'Tc'\. There are: coil, zone\."):
        index_of("Tc", ["coil", "zone"], what="Q")
    with pytest.raises(SpecError, match=r"Q has no signal named 'cool'\. Did you mean 'coil'\?"):
        index_of("cool", ["coil", "zone"], what="Q")


@pytest.mark.parametrize(
    ("equation", "said"),
    [
        ("area * d(level) = inflow", "A derivative in an equation is written der(x)."),
        ("area * level' = inflow", "A derivative in an equation is written der(x)."),
        ("area * der(level) == inflow", "An equation has a single =."),
        ("area * dlevel/dt = inflow", "A derivative in an equation is written der(x)."),
        ("der(level) = sin(t)", "What depends on time by itself is an input: a column of the log."),
    ],
)
def test_how_an_equation_is_written_is_told_where_it_is_not(equation: str, said: str) -> None:
    with pytest.raises(SpecError) as found:
        obsynth.DAEModel({"balance": equation}, {"gauge": "level"}, states={"level": 1.0}, inputs={"inflow": 0.1})
    assert said in str(found.value)


def test_a_constant_with_its_unit_in_a_text_is_told_as_no_number() -> None:
    with pytest.raises(SpecError, match="'L' is the text '100e-6 H', which is no number"):
        obsynth.uncertain_system({"E": [["L"]], "A": [[-1.0]], "C": [[1.0]]}, {"L": "100e-6 H"})


def test_a_setting_that_cannot_be_read_names_its_command_alone(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["run", "--gains", "g.json", "--data", "log.csv", "--threshold", "fhat[leak]"])
    printed = capsys.readouterr().err
    usage, said = printed.splitlines()
    assert usage == "usage: obsynth run --set NAME=VALUE (see obsynth run --help)"
    assert said == "obsynth run: error: argument --threshold: 'fhat[leak]' is not of the form NAME=VALUE"


def test_a_gain_set_in_place_of_a_spec_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    obsynth.fault_estimation_filter(obsynth.DescriptorSystem(**PLANT)).save(tmp_path / "gains.json")
    assert main(["design", "--system", str(tmp_path / "gains.json")]) == 2
    assert "This is a gain set: give the spec that it was made from." in " ".join(capsys.readouterr().err.split())
