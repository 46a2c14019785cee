"""The verb ``sweep``."""

from __future__ import annotations

import csv
import json
import os
from contextlib import contextmanager

import pytest

from obsynth.cli.main import main
from obsynth.studies.verbs import sweeps

PLANT = {
    "schema_version": 1, "name": "small",
    "plant": {"dt": 1, "A": [[0.5, 0.1], [0, 0.7]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0]], "Bd": [[0], [1]]},
    "method": {"id": "fault-estimation-filter"},
}  # fmt: skip


@pytest.fixture
def spec(tmp_path):
    file = tmp_path / "small.yaml"
    file.write_text(json.dumps(PLANT))
    return str(file)


@pytest.mark.long
def test_folder_table_and_picture(spec, tmp_path, capsys):
    out = tmp_path / "many"
    arguments = ["sweep", "--system", spec, "--set", "gamma_margin=[0.05, 0.1, -1]", "--out", str(out)]
    assert main([*arguments, "--quiet"]) == 0
    printed = capsys.readouterr().out
    assert "2 designed, 1 malformed" in printed
    # Why there is no design is printed, not only written to the table.
    assert ": malformed: " in printed
    rows = list(csv.DictReader((out / "table.csv").read_text().splitlines()))
    assert [row["status"] for row in rows] == ["designed", "designed", "malformed"]
    assert float(rows[0]["gamma_margin"]) == 0.05
    assert (out / "sweep.png").read_bytes().startswith(b"\x89PNG")
    assert main(["verify", str(out / rows[0]["file"])]) == 0
    capsys.readouterr()
    assert main([*arguments, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["counts"] == {"designed": 2, "malformed": 1}
    assert [case["gamma_min"] for case in told["cases"][:2]] == [float(row["gamma_min"]) for row in rows[:2]]


@pytest.mark.parametrize(
    ("count", "more", "jobs"), [(10, [], 1), (11, [], 3), (11, ["--jobs", "1"], 1), (2, ["--jobs", "2"], 2)]
)
def test_more_than_ten_designs_are_made_on_all_processors(spec, tmp_path, monkeypatch, count, more, jobs):
    asked = []

    @contextmanager
    def here(jobs, cluster):
        asked.append((jobs, cluster))
        yield None

    monkeypatch.setattr(sweeps, "chosen_executor", here)
    monkeypatch.setattr(sweeps, "usable_processors", lambda: 3)
    values = f"gamma_margin={[-1.0 - i for i in range(count)]}"
    assert main(["sweep", "--system", spec, "--set", values, "--out", str(tmp_path / "many"), "--quiet", *more]) == 2
    assert asked == [(jobs, None)]


def test_processors_that_may_be_used_are_counted():
    assert 1 <= sweeps.usable_processors() <= os.cpu_count()


@pytest.mark.long
def test_designs_on_all_processors_are_those_made_here(spec, tmp_path):
    values = f"gamma_margin={[0.05 + 0.01 * i for i in range(sweeps.FEW_DESIGNS + 1)]}"
    tables = []
    for name, more in (("all", []), ("one", ["--jobs", "1"])):
        out = tmp_path / name
        assert main(["sweep", "--system", spec, "--set", values, "--out", str(out), "--quiet", *more]) == 0
        rows = csv.DictReader((out / "table.csv").read_text().splitlines())
        tables.append([{key: value for key, value in row.items() if key != "seconds"} for row in rows])
    assert tables[0] == tables[1]
    assert {row["status"] for row in tables[0]} == {"designed"}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("ending", [".gains.json", ".result.json"])
@pytest.mark.parametrize("content", [None, "{", "{}"], ids=["missing", "cut", "empty"])
def test_a_sweep_goes_on_where_a_file_was_lost(spec, tmp_path, capsys, ending, content):
    """It refused to write the result anew, as it had read it."""
    out = tmp_path / "many"
    arguments = ["sweep", "--system", spec, "--set", "gamma_margin=[0.05]", "--out", str(out), "--quiet"]
    assert main(arguments) == 0
    (file,) = out.glob(f"*{ending}")
    before = json.loads(file.read_text())
    file.unlink()
    if content is not None:
        file.write_text(content)
    assert main(arguments) == 0, capsys.readouterr().err
    after = json.loads(file.read_text())
    assert after["kind"] == before["kind"]
    assert main(arguments) == 0
    assert json.loads(file.read_text()) == after


@pytest.mark.parametrize(
    ("extra", "path"),
    [
        (["--set", "gamma=0.5"], "--set"),
        (["--set", "gamma=[0.5"], "--set"),
    ],
)
def test_bad_arguments(spec, tmp_path, capsys, extra, path):
    assert main(["sweep", "--system", spec, "--out", str(tmp_path / "many"), "--json", *extra]) == 2
    assert json.loads(capsys.readouterr().out)["path"] == path


@pytest.mark.parametrize(("values", "code"), [("decy=[0.2, 0.3]", 2), ("residual_weight_limit=[-1, 10]", 0)])
def test_cases_that_are_all_malformed_are_an_error(spec, tmp_path, capsys, values, code):
    assert main(["sweep", "--system", spec, "--out", str(tmp_path / "many"), "--set", values]) == code
    assert f"{2 if code else 1} malformed" in capsys.readouterr().out


def test_the_folder_is_a_file(spec, tmp_path):
    assert main(["sweep", "--system", spec, "--out", spec]) == 2


def test_an_unknown_claim_is_refused_before_anything_is_designed(spec, tmp_path, capsys):
    out = tmp_path / "many"
    assert main(["sweep", "--system", spec, "--out", str(out), "--claim", "decay", "--json", "--quiet"]) == 2
    told = json.loads(capsys.readouterr().out)
    assert told["path"] == "--claim"
    assert "'decay'" in told["message"]
    assert "gamma" in told["message"]
    assert not out.exists()


def test_a_claim_of_any_method_is_taken_where_the_method_is_chosen_or_varied(spec, tmp_path, capsys):
    arguments = ["sweep", "--system", spec, "--claim", "decay", "--quiet"]
    varied = ["--set", "method.id=[fault-estimation-filter, ui-pi-observer]"]
    assert main([*arguments, *varied, "--out", str(tmp_path / "varied")]) == 0
    assert main([*arguments, "--set", "method.id=[pd-observer]", "--out", str(tmp_path / "other")]) == 0
    # No design makes the claim: the table is written all the same, and a sentence says why there is no picture.
    assert "no design claims 'decay'" in capsys.readouterr().err
    assert (tmp_path / "other" / "table.csv").is_file()
    assert not (tmp_path / "other" / "sweep.png").exists()


def test_the_table_on_a_narrow_terminal_cuts_nothing_and_says_what_it_leaves_out(spec, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "24")
    assert main(["sweep", "--system", spec, "--set", "gamma_margin=[0.05, 0.1]", "--out", str(tmp_path / "s")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines[:-1])) <= 24
    assert "…" not in "".join(lines)
    header = next(csv.reader((tmp_path / "s" / "table.csv").read_text().splitlines()))
    told = " ".join(" ".join(lines).split())
    assert "In all of them: status designed" in told
    missing = told.partition("In table.csv alone: ")[2].partition(".")[0].split(", ")
    assert missing
    assert set(missing) < set(header)


def test_headings_are_words_and_columns_of_the_file_are_names(spec, tmp_path, capsys, monkeypatch):
    """An identifier ('gamma_margin') stood in the heading of the printed table."""
    monkeypatch.setenv("COLUMNS", "100")
    out = tmp_path / "s"
    assert main(["sweep", "--system", spec, "--set", "gamma_margin=[0.05, 0.1]", "--out", str(out)]) == 0
    heading = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("case "))
    assert "margin" in heading
    assert "_" not in heading
    assert "gamma_margin" in next(csv.reader((out / "table.csv").read_text().splitlines()))
