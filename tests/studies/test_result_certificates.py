"""Robustness, tolerance studies and comparisons as certificates: done again, and a broken link fails by its name."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.results.certificate_files import differences
from obsynth.results.gain_set_writing import digest_of
from obsynth.studies.robustness_result import robustness_statement


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A certificate of each kind, and the gain set and the log that they rest on."""
    folder = tmp_path_factory.mktemp("certificates")
    plant = obsynth.uncertain_system(
        {
            "E": None, "A": [["0.8 * p", 0.1, 0.2], [0.0, 0.5, 0.1], [0.1, 0.0, "0.6 * p"]], "B": [[1.0], [0.5], [0.0]],
            "C": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "Bf": [[1.0], [0.0], [0.0]],
            "Bd": [[0.0], [1.0], [0.0]], "dt": 0.1,
        },
        {"p": {"nominal": 1.0, "tolerance": "2 %"}},
    )  # fmt: skip
    names = (*plant.disturbance_names, *plant.fault_names)
    scenario = obsynth.Scenario(
        horizon=30.0 * plant.dt,
        faults={plant.fault_names[0]: obsynth.Step(size=1.0, start=10.0 * plant.dt)},
        disturbances={names[0]: obsynth.Step(size=0.1)},
    )
    design = obsynth.fault_estimation_filter(plant)
    found = {"design": design.save(folder / "gains.json")}
    found["robustness"] = obsynth.robustness(design).save(folder / "robustness.json")
    study = obsynth.tolerance_study(
        design, scenario, tolerances=[0.0, 0.02], runs=3, disturbance_bounds={names[0]: 0.1}
    )
    found["tolerance study"] = study.save(folder / "study.json")
    u = np.sin(np.arange(40.0))[:, None]
    y = np.column_stack([np.cos(np.arange(40.0)), np.linspace(0.0, 1.0, 40)])
    log = folder / "log.csv"
    table = pd.DataFrame(np.hstack([u, y]), columns=[*plant.input_names, *plant.output_names])
    table.assign(time=plant.dt * np.arange(len(u))).to_csv(log, index=False)
    methods = ["fault-estimation-filter", "functional-filter"]
    kept = obsynth.compare(plant, scenario=scenario, methods=methods, runs=3, tolerance=0.01)
    found["comparison"] = kept.save(folder / "comparison.json")
    truth = table.assign(time=plant.dt * np.arange(len(u)), **{plant.fault_names[0]: 0.0})
    truth.to_csv(log, index=False)
    logged = obsynth.compare(plant, scenario=scenario, methods=methods[:1], runs=3, data=log)
    found["comparison on a log"] = logged.save(folder / "logged.json")
    return found | {"log": log}


KINDS = ("robustness", "tolerance study", "comparison", "comparison on a log")


def changed(file: Path, target: Path, change: Any) -> Path:
    """Write a certificate with something changed, and all digests made anew."""
    document = json.loads(file.read_text())
    body = document["certificate"]
    change(body)
    for inside in body["gain_sets"].values():
        inside["sha256"] = digest_of(inside["design"])
    document["sha256"] = digest_of(body)
    target.write_text(json.dumps(document))
    return target


def failing(file: Path, **more: Any) -> set[str]:
    return {row.name for row in obsynth.verify_certificate(file, **more).failures}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", KINDS)
def test_a_certificate_holds_and_says_what_it_rests_on(files: dict[str, Path], kind: str) -> None:
    report = obsynth.verify_certificate(files[kind])
    assert report.passed
    body = json.loads(files[kind].read_text())["certificate"]
    assert report["statement"].claim == body["statement"]
    for inside in body["gain_sets"].values():
        assert inside["sha256"][:12] in body["statement"]


def test_sentences_tell_box_runs_and_log(files: dict[str, Path]) -> None:
    told = {kind: json.loads(files[kind].read_text())["certificate"]["statement"] for kind in KINDS}
    assert "constants (" in told["robustness"]
    assert "the same at all times" in told["robustness"]
    assert "within 2 % tolerances (d1 within 0.1)" in told["tolerance study"]
    assert "3 runs of" in told["comparison"]
    assert "parameters off by up to 1%" in told["comparison"]
    assert "log.csv (sha256" in told["comparison on a log"]
    assert all(len(text.split()) < 75 for text in told.values())


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_gain_set_fails_by_name(files: dict[str, Path], tmp_path: Path, kind: str) -> None:
    def change(body: dict[str, Any]) -> None:
        for inside in body["gain_sets"].values():
            values = inside["design"]["observer"]["By"]["data"]
            inside["design"]["observer"]["By"]["data"] = [1.01 * value for value in values]

    assert any(name.startswith("gain set") for name in failing(changed(files[kind], tmp_path / "c.json", change)))


def smaller(where: Any) -> bool:
    """Change the first number, true word or verdict that is found; return whether there was one."""
    for key, value in where.items() if isinstance(where, dict) else enumerate(where):
        if isinstance(value, (dict, list)):
            if smaller(value):
                return True
        elif isinstance(value, bool):
            where[key] = not value
            return True
        elif isinstance(value, (int, float)) and value:
            where[key] = value * 0.99
            return True
    return False


@pytest.mark.parametrize(
    ("kind", "entry"),
    [
        *(("robustness", name) for name in ("loop_radius", "largest_factor", "error_per_unit", "regular", "stable")),
        *(("tolerance study", name) for name in ("least_faults", "false_alarms", "runs", "fault")),
        *(("comparison", name) for name in ("order", "relative_error", "fast_enough", "faults")),
        ("comparison on a log", "faults"),
    ],
)
def test_a_changed_figure_fails_by_name(files: dict[str, Path], tmp_path: Path, kind: str, entry: str) -> None:
    def change(body: dict[str, Any]) -> None:
        result = body["result"]
        if kind.startswith("comparison"):
            result = next(iter(result["methods"].values()))
        value = result[entry]
        if isinstance(value, (dict, list)):
            if not smaller(value):
                value[0][0] = 0.5
        else:
            result[entry] = (
                f"not {value}" if isinstance(value, str) else (not value if isinstance(value, bool) else 0.9 * value)
            )

    assert "figures" in failing(changed(files[kind], tmp_path / "c.json", change))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", KINDS)
def test_another_sentence_fails_by_name(files: dict[str, Path], tmp_path: Path, kind: str) -> None:
    def change(body: dict[str, Any]) -> None:
        body["statement"] = body["statement"].replace("within", "near")

    assert failing(changed(files[kind], tmp_path / "c.json", change)) == {"statement"}


def test_the_box_inside_is_compared(files: dict[str, Path], tmp_path: Path) -> None:
    """A narrower box is another one: the figures and the sentence tell."""

    def change(body: dict[str, Any]) -> None:
        box = body["gain_sets"]["design"]["design"]["plant"]["uncertainty"]["box"]
        for item in box["constants"].values():
            item["range"] = [0.5 * (end + item["nominal"]) for end in item["range"]]

    assert {"figures", "statement"} <= failing(changed(files["robustness"], tmp_path / "c.json", change))


@pytest.mark.long
def test_what_was_asked_is_done_again(files: dict[str, Path], tmp_path: Path) -> None:
    for kind, key, value in (
        ("comparison", "runs", 4),
        ("tolerance study", "runs", 4),
        ("comparison", "tolerance", 0.0),
    ):

        def change(body: dict[str, Any], key: str = key, value: Any = value) -> None:
            body["asked"][key] = value

        assert "figures" in failing(changed(files[kind], tmp_path / "c.json", change))


def test_the_plant_of_a_comparison_is_that_of_its_gain_sets(files: dict[str, Path], tmp_path: Path) -> None:
    def change(body: dict[str, Any]) -> None:
        data = body["asked"]["plant"]["A"]["data"]
        body["asked"]["plant"]["A"]["data"] = [1.001 * value for value in data]

    assert {"plant", "figures"} <= failing(changed(files["comparison"], tmp_path / "c.json", change))


def test_errors_on_a_log_are_assumed_or_compared(files: dict[str, Path], tmp_path: Path) -> None:
    file, log = files["comparison on a log"], files["log"]
    assert obsynth.verify_certificate(file)["log"].status == "assumed"
    assert obsynth.verify_certificate(file, data=log).passed
    other = tmp_path / "log.csv"
    other.write_text(log.read_text().replace("0", "1", 1))
    assert failing(file, data=other) >= {"log"}

    def change(body: dict[str, Any]) -> None:
        for fault in next(iter(body["result"]["methods"].values()))["faults"]:
            fault["rms"] *= 0.5
        entry = next(iter(body["result"]["methods"].values()))
        entry["relative_error"] *= 0.5

    assert "figures" in failing(changed(file, tmp_path / "c.json", change), data=log)


def test_a_digest_alone_fails(files: dict[str, Path], tmp_path: Path) -> None:
    document = json.loads(files["robustness"].read_text())
    document["certificate"]["asked"]["note"] = 1
    (tmp_path / "c.json").write_text(json.dumps(document))
    assert "digest" in failing(tmp_path / "c.json")
    document["kind"] = "obsynth fleet"
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(obsynth.SpecError, match="no certificate of a result"):
        obsynth.verify_certificate(tmp_path / "c.json")


@pytest.mark.long
def test_the_verb_reads_every_kind(files: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    for kind in KINDS[:3]:
        assert main(["verify", str(files[kind]), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert (told["kind"], told["passed"]) == (kind, True)
        assert told["statement"]
    assert main(["verify", str(files["robustness"]), "--data", str(files["log"])]) == 2
    assert main(["verify", str(files["comparison on a log"]), "--data", str(files["log"])]) == 0


def test_the_verb_report_writes_the_certificate_of_robustness(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.json"
    assert main(["report", "--gains", str(files["design"]), "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert json.loads(out.read_text()) == json.loads(files["robustness"].read_text())
    assert told["statement"] == json.loads(out.read_text())["certificate"]["statement"]
    assert main(["report", "--gains", str(files["design"]), "--out", str(out), "--system", "s.yaml"]) == 2
    assert main(["verify", str(out)]) == 0


def test_what_fails_or_says_nothing_is_not_certified(files: dict[str, Path], tmp_path: Path) -> None:
    design = obsynth.load(files["design"])
    bad = design.replace(
        observer=design.observer.__class__(**{**vars(design.observer), "By": 1.01 * design.observer.By})
    )
    exact = design.replace(plant=design.plant.replace(uncertainty=None))
    with pytest.raises(obsynth.ObsynthError):
        obsynth.robustness(bad).save(tmp_path / "bad.json")
    with pytest.raises(obsynth.SpecError, match="nothing to certify"):
        obsynth.robustness(exact).save(tmp_path / "bad.json")
    assert not (tmp_path / "bad.json").exists()


@pytest.mark.long
def test_verification_needs_no_solver(files: dict[str, Path]) -> None:
    names = [str(files[kind]) for kind in KINDS]
    code = (
        "import sys\n"
        "for name in ('cvxpy', 'clarabel', 'scs'): sys.modules[name] = None\n"
        "import obsynth\n"
        f"assert all(obsynth.verify_certificate(name).passed for name in {names!r})\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_sentence_of_robustness_tells_each_verdict(files: dict[str, Path]) -> None:
    design = obsynth.load(files["design"])
    claims = obsynth.robustness(design).claims()

    def told(**changes: Any) -> str:
        return robustness_statement({**claims, **changes}, design, "ab" * 32)

    assert "regular of index 1 (proved), stable (proved)" in told()
    assert "stable (not decided)" in told(stable="open")
    assert "stable (refuted at p = 1.25)" in told(stable="refuted", breaking={"p": 1.25})
    assert "but for 1 mode that no constant touches" in told(untouched=[[0.0, 0.0]])
    assert "within bounds for ever (loop radius 0.999)" in told(loop_radius=0.999)
    assert "may grow (loop radius 1)" in told(loop_radius=1.0)
    assert "no bound of the observer's error" in told(loop_radius=None, largest_factor=None)
    assert "2.5 times as large" in told(largest_factor=2.5)


def test_a_certificate_of_another_version_is_refused(files: dict[str, Path], tmp_path: Path) -> None:
    document = json.loads(files["robustness"].read_text())
    document["schema_version"] = 99
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(obsynth.SpecError, match="schema version 99"):
        obsynth.verify_certificate(tmp_path / "c.json")


def test_figures_agree_to_rounding_and_no_further() -> None:
    true = {"a": 1.0, "rows": [1e-12, 5.0], "word": "x", "flag": True, "none": None, "inf": np.inf}
    assert differences(true, true) == []
    assert differences({**true, "rows": [3e-12, 5.0 + 1e-9]}, true) == []
    for name, value in (("a", 1.00001), ("a", True), ("rows", [1e-12]), ("rows", [1e-6, 5.0]), ("word", "y"),
                        ("flag", False), ("none", 0.0), ("inf", 1e300), ("rows", [1e-12, 5.0, 1.0])):  # fmt: skip
        assert differences({**true, name: value}, true) != []
    assert differences({"a": 1.0}, true) == ["names"]


@pytest.mark.parametrize("name", ["deviation", "rms", "bound", "least", "smallest_found", "threshold", "bias", "size"])
def test_a_figure_in_small_units_is_compared_with_those_of_its_unit(name: str) -> None:
    """Of a fault in farads figures are 1e-12 beside a horizon of 61 s, and a bound may be an exact zero."""
    figures = {"fault": "leak", "half": 4.0, "horizon": 61.0, "peak": 1.0, "unknown_input_gain": 3e-28}
    figures |= {"unknown_input_share": 2e-16, "deviation": 1e-12, "rms": 2e-12, "bias": 1e-14, "size": 5e-12}
    figures |= {"threshold": 3e-12, "smallest_found": 4e-12, "bound": 6e-12, "least": 1e-28}
    assert differences({**figures, name: 2.0 * figures[name] + 1e-13}, figures) == [name]
    assert not differences({**figures, name: figures[name] * (1.0 + 1e-7)}, figures)
    # What is rounding beside its own kind is the same on another processor.
    rounded = {**figures, "unknown_input_gain": 9e-28, "unknown_input_share": 7e-16, "least": 4e-28}
    assert not differences({**rounded, "peak": 1.0 - 1e-15}, figures)
    assert differences({**figures, "unknown_input_gain": 1e-12}, figures) == ["unknown_input_gain"]
    assert differences({**figures, "unknown_input_share": 1e-6}, figures) == ["unknown_input_share"]


def test_figures_of_robustness_are_not_compared_with_others_beside_them() -> None:
    """A radius of 1e-7 beside a factor of a million, or farads beside ohms, could be replaced by another."""
    claims = {"loop_radius": 1e-7, "largest_factor": 1e6, "breaking": {"resistance": 1e4, "capacity": 2e-12}}
    assert differences({**claims, "loop_radius": 9e-4}, claims) == ["loop_radius"]
    for name, value in (("capacity", 1e-6), ("capacity", 2.1e-12), ("resistance", 1.01e4)):
        assert differences({**claims, "breaking": {**claims["breaking"], name: value}}, claims) == [f"breaking, {name}"]
    # What is rounding beside one is the same on another processor.
    assert not differences({**claims, "loop_radius": 1e-7 + 1e-12, "largest_factor": 1e6 + 1e-3}, claims)
    rounded = {"resistance": 1e4 + 1e-8, "capacity": 2e-12 + 1e-24}
    assert not differences({**claims, "breaking": rounded}, claims)


@pytest.mark.parametrize("kind", KINDS)
def test_hostile_content_fails_as_contents(files: dict[str, Path], tmp_path: Path, kind: str) -> None:
    for key, value in (("asked", {}), ("asked", None), ("result", {}), ("log", 3), ("statement", None)):

        def change(body: dict[str, Any], key: str = key, value: Any = value) -> None:
            body[key] = value

        assert failing(changed(files[kind], tmp_path / "c.json", change)) or (key == "asked" and kind == "robustness")
    document = json.loads(files[kind].read_text())
    for inside in ([], {}, {"design": 1}, None):
        document["certificate"]["gain_sets"] = inside
        (tmp_path / "c.json").write_text(json.dumps(document))
        assert failing(tmp_path / "c.json") & {"contents", "figures"}

    def endless(body: dict[str, Any]) -> None:
        body["asked"]["runs"] = 10**15

    assert "contents" in failing(changed(files[kind], tmp_path / "c.json", endless))
