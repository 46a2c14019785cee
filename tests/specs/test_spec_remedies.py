"""What a new user writes into a spec by mistake: one message with the line, what is wrong, and what to write instead;
and what is written instead is taken."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import obsynth
from obsynth.cli.main import main

ROWS = "[[0.9, 0.1], [0, 0.8]]"
SPEC = f"""schema_version: 1
name: first
plant:
  dt: 0.1
  A: {ROWS}
  C: [[1, 0]]
  Bf: [[1], [0]]
"""


class Mistake(NamedTuple):
    """What of the spec is replaced by what; words of the message; what repairs it, and the line of the message."""

    old: str
    new: str
    words: str
    repaired: str
    line: int


#: A plant of one state.
ONE = "dt: 0.1\n  A: [[0.9]]\n  C: [[1]]\n  Bf: [[1]]\n"
TWO = SPEC.partition("plant:\n  ")[2]

MISTAKES = {
    "name of a file": Mistake(ROWS, "A.csv", "Write A: {file: A.csv}", "{file: A.csv}", 5),
    "sampling time by another name": Mistake(
        "dt: 0.1", "Ts: 0.1", "plant.Ts: unknown key. Did you mean 'dt'", "dt: 0.1", 4
    ),
    "fraction for a time": Mistake("dt: 0.1", "dt: 1/10", "Write 0.1.", "dt: 0.1", 4),
    "frequency": Mistake("dt: 0.1", "dt: 10 Hz", "Write 0.1 for a period of 10 Hz", "dt: 0.1", 4),
    "fraction": Mistake(
        "[[0.9,", "[[9/10,", "row 1, column 1 must be a number, not the text '9/10'. Write 0.9.", "[[0.9,", 5
    ),
    "number in quotes": Mistake("[[0.9,", "[['0.9',", "Write 0.9.", "[[0.9,", 5),
    "exponent of Fortran": Mistake("[[0.9,", "[[9.0D-1,", "Write 0.9.", "[[0.9,", 5),
    "formula": Mistake("[[0.9,", "[[sqrt(0.81),", "Write 0.9.", "[[0.9,", 5),
    "no disturbance": Mistake("  Bf:", "  Bd: []\n  Bf:", "Leave Bd out", "  Bf:", 7),
    "empty rows": Mistake("  Bf:", "  Bd: [[], []]\n  Bf:", "Leave Bd out", "  Bf:", 7),
    "scalar": Mistake(TWO, ONE.replace("[[0.9]]", "0.9"), "Write A: [[0.9]]", ONE, 5),
    "flat list": Mistake("[[1], [0]]", "[1, 0]", "[[1], [0]] for one column", "[[1], [0]]", 7),
    "row for a column": Mistake("[[1], [0]]", "[[1, 0]]", "Bf is 1 by 2, but 2 by 1 is needed", "[[1], [0]]", 7),
    "column for a row": Mistake("C: [[1, 0]]", "C: [[1], [0]]", "C is 2 by 1, but 1 by 2 is needed", "C: [[1, 0]]", 6),
    "MATLAB": Mistake(ROWS, "[0.9 0.1; 0 0.8]", "Write A: [[0.9, 0.1], [0.0, 0.8]]", ROWS, 5),
    "identity": Mistake("  C:", "  E: I\n  C:", "Leave E out", "  C:", 6),
    "name of a state": Mistake("[[1], [0]]", "x1", "Write Bf: {states: [x1]}", "{states: [x1]}", 7),
    "one name": Mistake(
        "  C:", "  fault_names: leak\n  C:", "Write fault_names: [leak]", "  fault_names: [leak]\n  C:", 6
    ),
    "tab": Mistake("  A:", "\tA:", "is indented by a tab", "  A:", 5),
    "empty key": Mistake("name: first", 'name: first\n"": 1', "a key is empty: write its name", "name: first", 3),
    "empty key of a section": Mistake("  C:", '  "": 1\n  C:', "plant: a key is empty", "  C:", 6),
    "repeated key": Mistake("dt: 0.1", "dt: 0.1\n  dt: 1", 'the key "dt" is repeated', "dt: 0.1", 5),
    "open bracket": Mistake(ROWS, "[[0.9, 0.1], [0, 0.8]", "begins in line 5 lacks a comma, or ] at its end", ROWS, 6),
    "one blank too many": Mistake("  Bf:", "   Bf:", "indent this line by 2 blanks, as line 4", "  Bf:", 7),
    "no blank after a colon": Mistake("dt: 0.1", "dt:0.1", "Is a blank missing in line 4? Write dt: 0.1", "dt: 0.1", 5),
    "alias": Mistake("dt: 0.1", "dt: *step", "write the value, or the anchor", "dt: &step 0.1", 4),
    "second document": Mistake(
        "  Bf: [[1], [0]]\n", "  Bf: [[1], [0]]\n---\nname: b\n", "put it into a file of its own", TWO[-17:], 8
    ),
    "entry that is not known": Mistake("[[0.9,", "[[.nan,", "not nan. Write 0 for no coupling", "[[0,", 5),
    "decimal comma": Mistake(
        "[[0.9, 0.1]", "[[0,9, 0,1]", "if commas are decimal ones, write points", "[[0.9, 0.1]", 5
    ),
    "brackets": Mistake("C: [[1, 0]]", "C: [[[1, 0]]]", "Remove a pair of brackets", "C: [[1, 0]]", 6),
    "number in quotes for a version": Mistake(
        "schema_version: 1", "schema_version: '1'", "Write 1.", "schema_version: 1", 1
    ),
    "number for a name": Mistake("name: first", "name: 12", "Write '12', in quotes", "name: '12'", 2),
    "one level too deep": Mistake(
        TWO, "  " + TWO.replace("  ", "    ").replace("dt:", "system:\n      dt:", 1), "one level higher", TWO, 4
    ),
    "key without a value": Mistake(
        "name: first", "name: first\nmethod:\n  options:", "Leave options out", "name: first", 4
    ),
    "dashes": Mistake(
        "name: first",
        "name: first\nmethod:\n  options:\n  - gamma: 2",
        "Write what is below options without dashes",
        "name: first\nmethod:\n  id: fault-estimation-filter\n  options:\n    gamma: 2",
        4,
    ),
    "kind of a profile": Mistake(
        "name: first",
        "name: first\nscenario: {horizon: 9, faults: {f1: {kind: stp, size: 1}}}",
        "Did you mean 'step'?",
        "name: first\nscenario: {horizon: 9, faults: {f1: {kind: step, size: 1}}}",
        3,
    ),
    "slope of a ramp": Mistake(
        "name: first",
        "name: first\nscenario: {horizon: 9, faults: {f1: {kind: ramp, slope: 1}}}",
        "slope: unknown key. The keys here are kind, start, end, rate.",
        "name: first\nscenario: {horizon: 9, faults: {f1: {kind: ramp, rate: 1}}}",
        3,
    ),
    "profile by another word": Mistake(
        "name: first",
        "name: first\nscenario: {horizon: 9, faults: {f1: {type: step, size: 1, begin: 2}}}",
        "type: unknown key. Did you mean 'kind'?",
        "name: first\nscenario: {horizon: 9, faults: {f1: {kind: step, size: 1, start: 2}}}",
        3,
    ),
}


def loaded(folder: Path, text: str, name: str = "spec.yaml") -> obsynth.DescriptorSystem:
    """Return the plant of a spec with this text."""
    (folder / name).write_text(text, encoding="utf-8")
    plant = obsynth.load_spec(folder / name).plant
    assert isinstance(plant, obsynth.DescriptorSystem)
    return plant


@pytest.mark.parametrize("name", MISTAKES)
def test_what_a_message_says_to_write_is_taken(name: str, tmp_path: Path) -> None:
    mistake = MISTAKES[name]
    (tmp_path / "A.csv").write_text("0.9,0.1\n0,0.8\n", encoding="utf-8")
    assert SPEC.count(mistake.old) == 1
    with pytest.raises(obsynth.SpecError) as refused:
        loaded(tmp_path, SPEC.replace(mistake.old, mistake.new))
    assert mistake.words in str(refused.value)
    assert f"line {mistake.line}" in str(refused.value)
    plant = loaded(tmp_path, SPEC.replace(mistake.old, mistake.repaired))
    assert plant.nf == 1


#: Texts of one matrix, as programs of several countries write it.
TABLES = ["0.9,0.1\n0,0.8", "0.9;0.1\n0;0.8\n", "0,9;0,1\n0;0,8\n", "0.9\t0.1\r\n0\t0.8\r\n", "# A\n0.9 0.1\n0 0.8\n"]


@pytest.mark.parametrize("table", TABLES, ids=repr)
def test_a_table_of_numbers_is_read_whatever_separates_them(table: str, tmp_path: Path) -> None:
    (tmp_path / "A.csv").write_bytes(table.encode())
    plant = loaded(tmp_path, SPEC.replace(ROWS, "{file: A.csv}"))
    assert np.array_equal(plant.A, [[0.9, 0.1], [0.0, 0.8]])


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("x1,x2\n0.9,0.1\n0,0.8\n", "line 1 holds names ('x1'), and only numbers are read: remove this line"),
        ("0.9,0.1,\n0,0.8,\n", "line 1, column 3 is empty: remove the separator at the end of the line"),
        ("0.9,0.1\n\n0,abc\n", "line 3, column 2 holds 'abc', which is no number"),
        ("0.9,0.1\n0\n", "line 2 has 1 number, but the first row has 2"),
        ("0,9;1.5\n0;0,8\n", "line 1, column 1 holds '0,9'"),
        ("", "it is empty"),
    ],
)
def test_the_line_of_a_damaged_table_is_named(table: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "A.csv").write_text(table, encoding="utf-8")
    with pytest.raises(obsynth.SpecError) as refused:
        loaded(tmp_path, SPEC.replace(ROWS, "{file: A.csv}"))
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("name", "advice"), [("A.npy", "numpy.savez"), ("A.txt", "name it .csv"), ("A.xlsx", "save the sheet as .csv")]
)
def test_a_file_of_another_kind_is_told_how_it_becomes_one(name: str, advice: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("0.9,0.1\n0,0.8\n", encoding="utf-8")
    with pytest.raises(obsynth.SpecError, match=advice):
        loaded(tmp_path, SPEC.replace(ROWS, f"{{file: {name}}}"))


def test_json_is_a_spec_and_toml_is_named(tmp_path: Path) -> None:
    text = '{"schema_version": 1, "name": "a", "plant": {"dt": 1, "A": [[0.9]], "C": [[1]], "Bf": [[1]]}}'
    assert loaded(tmp_path, text, "spec.json").nx == 1
    with pytest.raises(obsynth.SpecError, match=r"spec\.toml is TOML, and a spec is YAML or JSON"):
        loaded(tmp_path, 'name = "a"\n[plant]\ndt = 1\n', "spec.toml")


def test_lines_are_those_of_the_file_that_holds_the_plant(tmp_path: Path) -> None:
    (tmp_path / "plant.yaml").write_text("schema_version: 1\ndt: 1\nA: [[one]]\nC: [[1]]\n", encoding="utf-8")
    with pytest.raises(obsynth.SpecError) as refused:
        loaded(tmp_path, "schema_version: 1\nname: a\nplant: {file: plant.yaml}\n")
    assert str(refused.value).startswith(str(tmp_path / "plant.yaml"))
    assert refused.value.problems == ("A: row 1, column 1 must be a number, not the text 'one'. [line 3]",)


def test_a_document_that_is_no_longer_that_of_the_file_names_no_lines(tmp_path: Path) -> None:
    from obsynth.specs.documents import read_yaml
    from obsynth.specs.loader import changed_document, spec_of

    (tmp_path / "spec.yaml").write_text(SPEC, encoding="utf-8")
    document = changed_document(read_yaml(tmp_path / "spec.yaml"), {"plant.dt": -1.0})
    with pytest.raises(obsynth.SpecError) as refused:
        spec_of(document, tmp_path / "spec.yaml")
    assert refused.value.problems == ("plant.dt: must be at least 0, not the number -1.0.",)


def test_a_key_of_a_plant_at_the_top_is_told_where_it_belongs(tmp_path: Path) -> None:
    with pytest.raises(obsynth.SpecError) as refused:
        loaded(tmp_path, "schema_version: 1\nname: a\nA: [[1]]\nplant: {dt: 1, C: [[1]]}\n")
    assert "A: unknown key. It belongs below plant. [line 3]" in refused.value.problems


def test_a_folder_is_asked_about_by_the_specs_in_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("spec.yaml", "plant.yaml"):
        (tmp_path / name).write_text(SPEC, encoding="utf-8")
    assert main(["design", "--system", str(tmp_path)]) == 2
    assert f"is a folder: give the name of a file. Did you mean {tmp_path / 'spec.yaml'}?" in capsys.readouterr().err


def test_two_transposed_matrices_are_the_only_ones_refused() -> None:
    given = {"A": [[0.9, 0.1], [0, 0.8]], "dt": 1.0, "output_names": ["y"], "fault_names": ["leak"]}
    with pytest.raises(obsynth.SpecError) as refused:
        obsynth.DescriptorSystem(C=[[1], [0]], Bf=[[1, 0]], D=[[0]], B=[[1], [0]], **given)
    assert len(refused.value.problems) == 2
    assert all(problem.endswith("is needed. Is it transposed?") for problem in refused.value.problems)
