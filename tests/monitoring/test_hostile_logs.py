"""Every command that reads a log, on logs that nobody cleaned: it reads them, or names column, row and remedy.

Each case is one change of a clean text; what a command leaves behind on an error is nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.monitoring.calibration.logs import read_log
from obsynth.monitoring.logs.log_run import faults_on_rows
from obsynth.studies.compared_records import ComparedLog

ROWS, AT = 130, 60
PLANT = """
schema_version: 1
dt: 1.0
constants: {a: {nominal: 0.9, tolerance: 20 %}}
A: [[a, 0.05], [0.0, 0.8]]
B: [[1.0], [0.5]]
C: [[1, 0], [0, 1]]
Bf: [[1.0], [0.0]]
state_names: [warm, cool]
input_names: [heat]
output_names: [T1, T2]
fault_names: [loss]
units: {T1: K, T2: K, heat: W}
sensor_noise: {T1: 0.05, T2: 0.05}
"""
SPEC = """
schema_version: 1
name: rods
plant: {file: plant.yaml}
method: {id: METHOD}
scenario: {horizon: 20, inputs: {heat: {kind: step, size: 1}}, faults: {loss: {kind: step, size: 1, start: 10}}}
"""
HEADER = ("time", "heat", "T1", "T2")
VERBS = ("run", "thresholds", "validate", "calibrate", "compare")
Rows = list[list[str]]


def clean() -> Rows:
    rng, x, rows = np.random.default_rng(1), np.zeros(2), [list(HEADER)]
    u = np.repeat(rng.uniform(-1.0, 1.0, ROWS // 8 + 1), 8)
    for k in range(ROWS):
        rows.append([f"{k}", *(f"{value:.4f}" for value in (u[k], *(x + 0.05 * rng.standard_normal(2))))])
        x = np.array([[0.9, 0.05], [0.0, 0.8]]) @ x + [u[k], 0.5 * u[k]] + 0.01 * rng.standard_normal(2)
    return rows


def with_cell(text: str, column: str = "T1", rows: slice = slice(AT, AT + 1)) -> Rows:
    """Return rows with a text in cells of a column; row 0 is the header."""
    changed = clean()
    for row in changed[1:][rows]:
        row[HEADER.index(column)] = text
    return changed


def without(column: str) -> Rows:
    return [[cell for name, cell in zip(HEADER, row, strict=True) if name != column] for row in clean()]


def times(of: Callable[[int], object]) -> Rows:
    return [list(HEADER), *([str(of(k)), *row[1:]] for k, row in enumerate(clean()[1:]))]


def named(*header: str) -> Rows:
    return [list(header), *clean()[1:]]


ALL = slice(None)
NO_NUMBER = r"Row 61, column 'T1': '{}' is no number"
#: By what is wrong with a log: its rows, and what each command says of it; of each that is not named, it says nothing
#: and succeeds.  "*" is every command.
REFUSED: dict[str, tuple[Rows, dict[str, str]]] = {
    "two points": (with_cell("1.2.3"), {"*": NO_NUMBER.format("1.2.3")}),
    "unit in a cell": (with_cell("12 V"), {"*": NO_NUMBER.format("12 V")}),
    "empty output": (with_cell("", rows=ALL), {
        "*": "'T1' is never measured. Name the column that holds it (--map T1=COLUMN, or columns={'T1': 'COLUMN'})",
        "thresholds": f"Only 0 rows of the log can be used*Of its {ROWS} rows these are missing: T1 in {ROWS}.",
        "validate": "The output 'T1' is nowhere finite*--map T1=", "calibrate": "The output 'T1' is nowhere finite"}),
    "infinite output": (with_cell("inf", rows=ALL), {
        "*": "'T1' is never measured", "thresholds": f"T1 in {ROWS}.",
        "validate": "The output 'T1' is nowhere finite", "calibrate": "The output 'T1' is nowhere finite"}),
    "empty input": (with_cell("", "heat", ALL), {
        "*": "'heat' is never measured", "thresholds": f"heat in {ROWS}.",
        "validate": "The input 'heat' is nowhere finite*--map heat=", "calibrate": "input 'heat' is nowhere finite"}),
    "half an output": (with_cell("-inf", rows=slice(AT, None)), {"thresholds": "these are missing: T1 in 70."}),
    "no time": (with_cell("", "time"), {
        "*": "Row 61 has no time", "validate": "Row 60, counted from 0", "calibrate": "Row 60, counted from 0"}),
    "infinite time": (with_cell("inf", "time"), {
        "*": "Row 61 has no time", "validate": "Row 60, counted from 0", "calibrate": "Row 60, counted from 0"}),
    "a word as time": (with_cell("abc", "time"), {"*": "Row 61, column 'time': 'abc' is no time stamp"}),
    "one time": (times(lambda _: 5), {
        "*": "Row 12 repeats the time 5 s of the row before, as all rows from row 2 on. Name the column of the time",
        "validate": "Stamps must rise, but that of row 1 is 5 s. Sort", "calibrate": "Stamps must rise"}),
    "two logs in one": (times(lambda k: k % 100), {
        "*": "Row 111: the time falls from 99 to 10 s, as it has since row 101. Sort the log by its time; if logs were "
             "joined, give each by itself", "validate": "Stamps must rise", "calibrate": "Stamps must rise"}),
    "milliseconds": (times(lambda k: 1000 * k), {"*": "in ms, call their column 'time [ms]'"}),
    "minutes": (times(lambda k: f"{k / 60:.6f}"), {"*": "in min, call their column 'time [min]'"}),
    "a clock that jumps": (times(lambda k: k + 10**9 * (k >= 100)), {
        "validate": "before row 100, counted from 0, which comes 1e+09 s after*(rows 0:100)",
        "calibrate": "(rows 0:100)"}),
    "no output": (without("T2"), {"*": "no column 'T2'*Map it: --map T2="}),
    "no input": (without("heat"), {"*": "no column 'heat'*Map it: --map heat="}),
    "no row": (clean()[:1], {"*": "The data have no rows."}),
    "one row": (clean()[:2], {
        "thresholds": "The log has 1 rows: give 100 and more", "validate": "at least 20 are needed",
        "calibrate": "The log has 1 row: a calibration needs more", "compare": "1 row: a comparison needs 2"}),
    "a column twice": ([[*row, row[2]] for row in clean()], {"*": "more than one column 'T1'"}),
    "a time twice": ([[*row, row[0]] for row in clean()], {"*": "more than one column 'time'"}),
    "volts": (named("time", "heat (W)", "T1 (V)", "T2 (K)"), {"*": "T1 is in V in the data, and in K in the plant"}),
    "commas for all": ([[cell.replace(".", ",") for cell in row] for row in clean()], {
        "*": "Row 1 has 7 cells, but the header has 4. If numbers have a decimal comma, separate the columns by semi"}),
    "a cell too many": ([*clean()[:AT], [*clean()[AT], "9"], *clean()[AT + 1:]], {"*": "Row 60 has 5 cells"}),
}  # fmt: skip
INFINITE = "1 infinite cell of 'T1' counted as missing, first in row 61."
WORD = "1 cell of 'T1' without a number: counted as missing, first 'I/O timeout' in row 61."
#: Commands whose notes on a log are looked at here.
NOTING = ("run", "thresholds", "calibrate", "compare")
STALE = {"run": "1 repeated stamp", "calibrate": "1 row left out: the stamps do not rise"}
#: By what is wrong with a log that is taken as it is: its rows, the separator and encoding, and what is said of it.
TAKEN: dict[str, tuple[Rows, str, str, dict[str, str]]] = {
    "infinite cell": (with_cell("inf"), ",", "utf-8", dict.fromkeys(NOTING, INFINITE)),
    "too large": (with_cell("1e400"), ",", "utf-8", dict.fromkeys(NOTING, INFINITE)),
    "a word": (with_cell("I/O timeout"), ",", "utf-8", dict.fromkeys(NOTING, WORD)),
    "nan": (with_cell("nan"), ",", "utf-8", {"run": "1 gap"}),
    "semicolons": (clean(), ";", "utf-8", {}),
    "decimal commas": ([[cell.replace(".", ",") for cell in row] for row in clean()], ";", "utf-8", {}),
    "byte order mark": (clean(), ",", "utf-8-sig", {}),
    "tabs and UTF-16": (clean(), "\t", "utf-16", {}),
    "a row twice": ([*clean()[:AT], clean()[AT - 1], *clean()[AT:]], ",", "utf-8", STALE),
    "a time twice": ([*clean()[:AT], [*clean()[AT - 1][:2], "9", "9"], *clean()[AT:]], ",", "utf-8", STALE),
    "fahrenheit": (
        [["time", "heat (W)", "T1 (degF)", "T2 (K)"],
         *([*row[:2], f"{1.8 * (float(row[2]) - 273.15) + 32.0:.6f}", row[3]] for row in clean()[1:])],
        ",", "utf-8", dict.fromkeys(NOTING, "T1 is converted from degF to K."),
    ),
    "a constant": (with_cell("3.0", rows=ALL), ",", "utf-8",
                   dict.fromkeys(("run", "thresholds", "compare"), f"T1 is 3 in all {ROWS} rows: its sensor may be")),
    "no time": (without("time"), ",", "utf-8", {"compare": "no column 'time': its rows are taken as 1 s apart"}),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The plant, its specs and gain sets."""
    made = tmp_path_factory.mktemp("hostile")
    (made / "plant.yaml").write_text(PLANT)
    for name, method in (("linear", "ui-pi-observer"), ("kalman", "descriptor-kalman")):
        (made / f"{name}.yaml").write_text(SPEC.replace("METHOD", method))
        gains = ("--out", str(made / f"{name}.json"), "--quiet")
        assert main(["design", "--system", str(made / f"{name}.yaml"), *gains]) == 0
    return made


def command(folder: Path, verb: str, log: Path, out: Path) -> list[str]:
    gains = ["--gains", str(folder / ("kalman.json" if verb == "validate" else "linear.json"))]
    more = {
        "run": [*gains, "--out", str(out / "estimates.csv")],
        "thresholds": [*gains, "--out", str(out / "thresholds.json")],
        "validate": gains,
        "calibrate": [
            "--system",
            str(folder / "plant.yaml"),
            "--unknown",
            "a=0.5:0.99",
            "--out",
            str(out / "fit.json"),
        ],
    }
    return [verb, *more[verb], "--data", str(log)]


def written(rows: Rows, path: Path, separator: str = ",", encoding: str = "utf-8") -> Path:
    path.write_bytes(("\n".join(separator.join(row) for row in rows) + "\n").encode(encoding))
    return path


def replayed(folder: Path, log: Path) -> tuple[str, ...]:
    """Read a log and run a design on it as a comparison does, without its other designs, and return its notes."""
    design = obsynth.load(folder / "linear.json")
    record = ComparedLog(log).record(design.plant)
    faults_on_rows(design, record.times, record.u, record.y)
    return record.notes


def says(text: str, parts: str) -> bool:
    return all(part in " ".join(text.split()) for part in parts.split("*"))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", REFUSED)
def test_a_log_that_cannot_be_used_is_refused_in_a_sentence_and_nothing_is_written(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    rows, sentences = REFUSED[case]
    log = written(rows, tmp_path / "log.csv")
    for verb in VERBS:
        parts = sentences.get(verb, sentences.get("*", ""))
        (out := tmp_path / verb).mkdir()
        if verb == "compare":
            if parts:
                with pytest.raises(obsynth.SpecError) as error:
                    replayed(folder, log)
                assert says(str(error.value), parts)
        elif parts or verb == "run":
            code = main(command(folder, verb, log, out))
            text = "".join(capsys.readouterr())
            assert (verb, code) == (verb, 2 if parts else 0), text
            assert says(text, parts), (verb, text)
            assert "Traceback" not in text
            assert "invalid value" not in text
            if parts:
                assert not list(out.iterdir()), verb


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", TAKEN)
def test_a_log_with_what_can_be_read_is_taken_and_what_is_missing_is_said(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    rows, separator, encoding, sentences = TAKEN[case]
    log = written(rows, tmp_path / "log.csv", separator, encoding)
    for verb in ("run", "thresholds") if "time" in rows[0][0] else ():
        assert main(command(folder, verb, log, tmp_path)) == 0
        text = "".join(capsys.readouterr())
        assert says(text, sentences.get(verb, "")), (verb, text)
        assert "invalid value" not in text
    plant = obsynth.load(folder / "linear.json").plant
    record = read_log(log, plant.input_names, plant.output_names, dt=1.0, units=plant.units)
    assert record.samples == ROWS
    assert says(" ".join(record.notes), sentences.get("calibrate", ""))
    assert says(" ".join(replayed(folder, log)), sentences.get("compare", ""))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", ["parquet", "xlsx", "a folder", "a text"])
def test_files_of_other_kinds_are_refused_in_the_same_sentences(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    log, wanted = tmp_path / f"log.{kind}", "'T1' is never measured. Name the column that holds it (--map T1=COLUMN, "
    table = pd.DataFrame([map(float, row) for row in clean()[1:]], columns=list(HEADER)).assign(T1=np.nan)
    if kind == "parquet":
        pytest.importorskip("pyarrow")
        table.to_parquet(log)
    elif kind == "xlsx":
        pytest.importorskip("openpyxl")
        table.to_excel(log, index=False)
    elif kind == "a folder":
        log.mkdir()
        wanted = "is a folder: give the name of a file"
    else:
        log, wanted = written(clean(), tmp_path / "log.txt"), "has an unknown suffix: use one of .csv"
    assert main(command(folder, "run", log, tmp_path)) == 2
    assert says(capsys.readouterr().err, wanted)
    assert not (tmp_path / "estimates.csv").exists()


def test_a_sensor_that_is_never_measured_is_named_where_others_suffice(folder: Path, tmp_path: Path) -> None:
    log = written(REFUSED["empty output"][0], tmp_path / "log.csv")
    run = obsynth.run_on_data(obsynth.load(folder / "kalman.json"), log)
    assert run.statuses["partial"] >= ROWS - 1
    assert any("'T1' is never measured" in text for text in run.warnings)


def test_two_signals_may_be_read_from_one_column(folder: Path) -> None:
    design = obsynth.load(folder / "linear.json")
    rows = with_cell("inf", "T2")[1:]
    log = pd.DataFrame([[float(cell) for cell in row] for row in rows], columns=list(HEADER))
    run = obsynth.run_on_data(design, log, columns={"T1": "T2"})
    assert run.rows == ROWS
    assert [text for text in run.warnings if "infinite" in text] == [INFINITE.replace("T1", "T2")]
    log["T2"] = 3.0
    texts = obsynth.run_on_data(design, log, columns={"T1": "T2"}).warnings
    assert [text.split(":")[0] for text in texts if "in all" in text] == [
        f"{name} is 3 in all {ROWS} rows" for name in ("T1", "T2")
    ]
