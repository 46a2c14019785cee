"""Proofs of alarms: true ones are found and rechecked, healthy windows are never proved faulty, changed files fail."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from test_adaptive_thresholds import exact_records, start_set
from uncertain_plants import drive, wang

import obsynth
from obsynth.experiments.alarm_proof import proved_alarm
from obsynth.tolerances.exact_plant import drawn_points


@pytest.fixture(scope="module")
def design() -> Any:
    return obsynth.fault_estimation_filter(wang())


def record(design: Any, seed: int, *, fault: float) -> tuple[np.ndarray, np.ndarray]:
    points = drawn_points(len(design.plant.uncertainty.box.names), 1, seed)
    _, u, y, _ = exact_records(design, points, 50, seed, fault=fault)
    return u[0], y[0]


def options(design: Any) -> dict[str, Any]:
    return {"disturbance_bounds": {"w": 0.1}, "initial_set": start_set(design)}


def test_faults_are_proved_and_certificates_hold(design, tmp_path) -> None:
    for seed in (1, 2):
        u, y = record(design, seed, fault=0.2)
        found = proved_alarm(design, u[:34], y[:34], **options(design))
        assert found.proved
        assert found.margin > 0.0
        assert "a fault since" in found.statement or "without a fault since" in found.statement
    file = found.save(tmp_path / "alarm.json")
    report = obsynth.verify_alarm(file)
    assert report.passed
    assert next(check for check in report.checks if check.name == "proof").kind == "proved"


@pytest.mark.parametrize("make", [wang, drive])
def test_healthy_windows_are_never_proved_faulty(make) -> None:
    design = obsynth.fault_estimation_filter(make())
    name = design.plant.disturbance_names[0]
    for seed in range(4):
        u, y = record(design, seed, fault=0.0)
        found = proved_alarm(
            design, u[:40], y[:40], window=12, disturbance_bounds={name: 0.1}, noise_bound=1.0,
            initial_set=start_set(design),
        )  # fmt: skip
        assert not found.proved
        assert found.statement.startswith("Cannot be proved")


@pytest.mark.parametrize("change", ["y", "margin", "below", "bounds", "statement", "window", "tolerance"])
def test_changed_certificates_fail(design, tmp_path, change: str) -> None:
    from obsynth.results.gain_sets import digest_of

    u, y = record(design, 1, fault=0.2)
    found = proved_alarm(design, u[:34], y[:34], **options(design))
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
        body["margin"] *= 1.1
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


def test_a_certificate_with_another_digest_fails(design, tmp_path) -> None:
    u, y = record(design, 1, fault=0.2)
    file = proved_alarm(design, u[:34], y[:34], **options(design)).save(tmp_path / "alarm.json")
    file.write_text(file.read_text().replace('"row": 34', '"row": 33'))
    assert not obsynth.verify_alarm(file).passed
