"""Proofs of alarms: true ones are found and rechecked, healthy windows are never proved faulty, changed files fail."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pandas as pd
import pytest
from test_adaptive_thresholds import exact_records, start_set
from uncertain_plants import drive, wang

import obsynth
from obsynth.monitoring.alarms.proof_file import proved_alarm
from obsynth.results.gain_set_writing import digest_of
from obsynth.verification.assumptions import file_digest
from obsynth.verification.over_tolerances.plants_of_the_box import drawn_points


@pytest.fixture(scope="module")
def design() -> Any:
    return obsynth.fault_estimation_filter(wang())


def record(design: Any, seed: int, *, fault: float) -> tuple[np.ndarray, np.ndarray]:
    points = drawn_points(len(design.plant.uncertainty.box.names), 1, seed)
    _, u, y, _ = exact_records(design, points, 50, seed, fault=fault)
    return u[0], y[0]


def options(design: Any) -> dict[str, Any]:
    return {"disturbance_bounds": {"w": 0.1}, "initial_set": start_set(design)}


@pytest.fixture(scope="module")
def found(design: Any) -> Any:
    """Return the proof of a fault from a record's first rows."""
    u, y = record(design, 1, fault=0.2)
    return proved_alarm(design, u[:34], y[:34], **options(design))


def test_faults_are_proved_and_certificates_hold(design, found, tmp_path) -> None:
    u, y = record(design, 2, fault=0.2)
    for one in (found, proved_alarm(design, u[:34], y[:34], **options(design))):
        assert one.proved
        assert one.margin > 0.0
        assert "a fault since" in one.statement or "without a fault since" in one.statement
    file = found.save(tmp_path / "alarm.json")
    report = obsynth.verify_alarm(file)
    assert report.passed
    assert next(check for check in report.checks if check.name == "proof").kind == "proved"


@pytest.mark.parametrize("make", [wang, drive])
def test_healthy_windows_are_never_proved_faulty(make) -> None:
    design = obsynth.fault_estimation_filter(make())
    name, noise_bound = design.plant.disturbance_names[0], 1.0 if design.plant.nw else None
    for seed in range(4):
        u, y = record(design, seed, fault=0.0)
        found = proved_alarm(
            design, u[:40], y[:40], window=12, disturbance_bounds={name: 0.1}, noise_bound=noise_bound,
            initial_set=start_set(design),
        )  # fmt: skip
        assert not found.proved
        assert found.statement.startswith("Cannot be proved")
        # Of the first of Wang's windows the simplex method goes in circles.
        assert "no multipliers" not in found.statement


@pytest.mark.one_in(6)
@pytest.mark.parametrize("change", ["y", "margin", "below", "bounds", "statement", "window", "tolerance"])
def test_changed_certificates_fail(found, tmp_path, change: str) -> None:
    content = json.loads(found.save(tmp_path / "alarm.json").read_text())
    body = content["certificate"]
    if change == "y":
        body["y"]["data"] = [0.0] * len(body["y"]["data"])
    elif change == "below":
        body["below"]["data"] = [-value for value in body["below"]["data"]]
    elif change == "bounds":
        body["bounds"]["data"] = [10.0]
    elif change == "window":
        body["window"] = 5
    elif change == "margin":
        body["margin"] *= 1.002
    elif change == "statement":
        body["statement"] = body["statement"].replace("a fault", "two faults")
    else:
        constants = body["gain_set"]["design"]["plant"]["uncertainty"]["box"]["constants"]
        for item in constants.values():
            middle, half = item["nominal"], 10.0 * abs(item["range"][1] - item["nominal"])
            item["range"] = [middle - half, middle + half]
        body["gain_set"]["sha256"] = digest_of(body["gain_set"]["design"])
    content["sha256"] = digest_of(body)
    file = tmp_path / "changed.json"
    file.write_text(json.dumps(content))
    assert not obsynth.verify_alarm(file).passed


def test_a_certificate_with_another_digest_fails(found, tmp_path) -> None:
    file = found.save(tmp_path / "alarm.json")
    file.write_text(file.read_text().replace('"row": 34', '"row": 33'))
    assert not obsynth.verify_alarm(file).passed


def resigned(content: dict[str, Any], file: Any) -> Any:
    """Write a certificate with a digest that fits its changed content."""
    inner = content["certificate"]["gain_set"]
    inner["sha256"] = digest_of(inner["design"])
    content["sha256"] = digest_of(content["certificate"])
    file.write_text(json.dumps(content))
    return file


def test_the_gain_set_inside_is_verified_too(design, found, tmp_path) -> None:
    """Claims, plant and tolerances of the gain set in a certificate fail it by name, digests made to fit."""
    u, y = record(design, 1, fault=0.2)
    text = found.save(tmp_path / "alarm.json").read_text()
    for path in (("observer", "By"), ("plant", "Bf"), ("certificate", "claims")):
        content = json.loads(text)
        part = content["certificate"]["gain_set"]["design"]
        for key in path:
            part = part[key]
        if "data" in part:
            part["data"] = [1.01 * value for value in part["data"]]
        else:
            part["gamma"] *= 0.9
        report = obsynth.verify_alarm(resigned(content, tmp_path / "bad.json"))
        assert "gain set" in {check.name for check in report.failures}
    refused = design.replace(observer=dataclasses.replace(design.observer, By=1.01 * design.observer.By))
    with pytest.raises(obsynth.VerificationError, match="fails its own verification"):
        proved_alarm(refused, u[:34], y[:34], **options(design))
    again = proved_alarm(refused, u[:34], y[:34], **options(design), unverified=True)
    assert not again.proved
    assert "unverified" in again.statement


def test_the_sentence_tells_bounds_start_constants_and_log(tmp_path) -> None:
    """Each assumption is in the sentence, and another value of it is another sentence."""
    design = obsynth.fault_estimation_filter(drive())
    u, y = record(design, 5, fault=2.0)
    names = (*design.plant.input_names, *design.plant.output_names)
    log = tmp_path / "log.csv"
    pd.DataFrame(np.hstack([u, y]), columns=list(names)).assign(time=0.02 * np.arange(len(u))).to_csv(log, index=False)
    start = start_set(design)
    asked = {"disturbance_bounds": {"load": 0.1}, "noise_bound": 1.7, "initial_set": start}
    found = obsynth.prove_alarm(design, log, 45, **asked)
    assert found.proved
    text = found.statement
    for words in (
        "load within 0.1",
        "noise within 1.7 standard deviations",
        "start with",
        "J1, J2, k, c, b within 5 % of nominal",
        "the same at all times",
        "rows 26 to 45 of log.csv",
        "since row 1",
        file_digest(log)[:12],
    ):
        assert words in text
    small = obsynth.prove_alarm(design, log, 45, **{**asked, "disturbance_bounds": {"load": 0.001}})
    assert "load within 0.001" in small.statement
    assert small.statement.split("Assumptions")[1] != text.split("Assumptions")[1]
    file = found.save(tmp_path / "alarm.json")
    alone, whole = obsynth.verify_alarm(file), obsynth.verify_alarm(file, data=log)
    assert (alone["log"].status, whole["log"].status) == ("assumed", "recomputed")
    assert alone.passed
    assert whole.passed
    assert alone["statement"].claim == text
    changed = tmp_path / "other.csv"
    changed.write_text(log.read_text().replace("time", "time ", 1))
    assert {check.name for check in obsynth.verify_alarm(file, data=changed).failures} == {"log"}
    content = json.loads(file.read_text())
    content["certificate"]["y"]["data"][3] += 1e-9
    report = obsynth.verify_alarm(resigned(content, tmp_path / "bad.json"), data=log)
    assert "log" in {check.name for check in report.failures}
    content["schema_version"] = 2
    (tmp_path / "old.json").write_text(json.dumps(content))
    with pytest.raises(obsynth.SpecError, match="prove the alarm again"):
        obsynth.verify_alarm(tmp_path / "old.json")


def test_digest_row_and_margin_are_judged_by_themselves(found, tmp_path) -> None:
    """A smaller margin and another row are harmless or wrong in themselves; the digest tells the first."""
    text = found.save(tmp_path / "alarm.json").read_text()
    content = json.loads(text)
    content["certificate"]["margin"] *= 0.5
    (tmp_path / "bad.json").write_text(json.dumps(content))
    assert {check.name for check in obsynth.verify_alarm(tmp_path / "bad.json").failures} == {"digest"}
    assert obsynth.verify_alarm(resigned(content, tmp_path / "bad.json")).passed
    cases = (("row", 33, {"rows"}), ("margin", 0.0, {"margin"}), ("origin", "stated", {"statement"}))
    for key, value, failing in cases:
        content = json.loads(text)
        content["certificate"][key] = value
        report = obsynth.verify_alarm(resigned(content, tmp_path / "bad.json"))
        assert {check.name for check in report.failures} == failing
    content = json.loads(text)
    content["certificate"]["below"]["data"] = [0.0] * len(content["certificate"]["below"]["data"])
    assert "proof" in {check.name for check in obsynth.verify_alarm(resigned(content, tmp_path / "bad.json")).failures}


def test_a_record_with_a_gap_proves_nothing(design) -> None:
    """Between rows 19 and 21 anything may have happened: a start at row 1 says nothing of what comes after."""
    u, y = record(design, 1, fault=0.2)
    plant = design.plant
    names = [*plant.input_names, *plant.output_names]
    whole = pd.DataFrame(np.hstack([u, y]), columns=names).assign(time=plant.dt * np.arange(len(u)))
    assert obsynth.prove_alarm(design, whole, 34, **options(design)).proved
    with pytest.raises(obsynth.SpecError, match="Row 20 has a gap before it") as refused:
        obsynth.prove_alarm(design, whole.drop(index=19), 33, **options(design))
    assert refused.value.path == "data"
    blank = whole.copy()
    blank.loc[19, names[-1]] = np.nan
    with pytest.raises(obsynth.SpecError, match="Row 20 has a gap before it or misses a sample"):
        obsynth.prove_alarm(design, blank, 34, **options(design))
    for row, words in ((1, "at least 2"), (51, "have 50 rows")):
        with pytest.raises(obsynth.SpecError, match=words):
            obsynth.prove_alarm(design, whole, row, **options(design))


def test_deviations_of_noise_that_nobody_states_are_refused(design) -> None:
    u, y = record(design, 1, fault=0.2)
    with pytest.raises(obsynth.SpecError, match="no noise is stated"):
        proved_alarm(design, u[:34], y[:34], **options(design), noise_bound=3.0)
