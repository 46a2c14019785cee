"""Thresholds, tests and proofs of sampled plants against their continuous simulation: disturbances move in a sample."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm

import obsynth
from obsynth.cli.main import main
from obsynth.proofs.absolute_integrals import interval_columns
from obsynth.proofs.affine import AffineMatrix

PARTS, SAMPLES, BEFORE = 240, 6, 3
ASKED = {"samples": SAMPLES, "disturbance_bounds": 1.0, "noise_bound": 3.0, "course": "step", "before": BEFORE}

#: Highest share by which a threshold passes the worst course of its own weights, and the least of all weights.
TIGHT, NEAR_LEAST = 1.02, 1.08


def plant_of(seed: int) -> tuple[obsynth.DescriptorSystem, float]:
    """A stable plant in continuous time, with one fault and one disturbance, and a sample time near its own; of some
    one mode is a hundred times as fast."""
    rng = np.random.default_rng([46, seed])
    n = int(rng.integers(2, 5))
    a = rng.normal(size=(n, n))
    if seed % 4 == 3:
        a[-1] -= 100.0 * np.eye(n)[-1]
    a -= (np.max(np.linalg.eigvals(a).real) + 0.3) * np.eye(n)
    noise = 10.0 ** rng.uniform(-5, -2)
    plant = obsynth.DescriptorSystem(
        A=a, C=np.eye(n), Bf=np.eye(n)[:, :1], Bd=rng.normal(size=(n, 1)), Bw=np.zeros((n, n)), Dw=noise * np.eye(n)
    )
    return plant, float(10.0 ** rng.uniform(-1.0, 0.5) / np.abs(np.linalg.eigvals(a)).min())


def responses(plant: obsynth.DescriptorSystem, dt: float, samples: int, parts: int = PARTS) -> np.ndarray:
    """Outputs ``(samples parts, samples, ny)`` for a disturbance of one in one part of one sample alone, by the matrix
    exponential of the plant in continuous time."""
    n = plant.nx
    both = expm(np.block([[plant.A, plant.Bd], [np.zeros((1, n + 1))]]) * dt / parts)
    step, push, whole = both[:n, :n], both[:n, n], expm(plant.A * dt)
    found = np.zeros((samples * parts, samples, plant.ny))
    for part in range(parts):
        x = np.linalg.matrix_power(step, parts - 1 - part) @ push
        for k in range(1, samples):
            for first in range(samples - k):
                found[first * parts + part, first + k] = plant.C @ x
            x = whole @ x
    return found


def residual(test: obsynth.GuaranteedTest, y: np.ndarray) -> float:
    return float(test.residual(test.observer.run(y, np.zeros((len(y), 0))))[-1])


def worst_of(test: obsynth.GuaranteedTest, plant: obsynth.DescriptorSystem, dt: float) -> float:
    """The largest residual that a course of the disturbance within its bound, and noise, reach for these weights."""
    y = np.eye(SAMPLES * plant.ny).reshape(-1, SAMPLES, plant.ny)
    weights = np.array([residual(test, one) for one in y])
    noise = 3.0 * float(plant.Dw[0, 0]) * np.abs(weights).sum()
    return noise + float(np.abs(responses(plant, dt, SAMPLES).reshape(SAMPLES * PARTS, -1) @ weights).sum())


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(8))
def test_a_threshold_is_that_of_the_worst_course_between_samples(seed: int, tmp_path: Path) -> None:
    plant, dt = plant_of(seed)
    sampled = obsynth.discretise(plant, dt)
    test = obsynth.guaranteed_test(sampled, **ASKED)
    held = obsynth.guaranteed_test(sampled, disturbance="jump", **ASKED)
    worst = worst_of(test, plant, dt)
    assert worst <= test.threshold * (1.0 + 1e-9)
    # Parts of a sample miss a little of the worst course; the bound adds less than a per cent or two.
    assert test.threshold <= TIGHT * worst
    assert held.threshold * (1.0 - 1e-9) <= test.least <= test.threshold <= NEAR_LEAST * test.least
    assert obsynth.verify(obsynth.load(test.save(tmp_path / "test.json"))).passed


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(3))
def test_held_disturbances_are_those_of_the_sampled_model(seed: int) -> None:
    """Without the plant behind it a sampled plant has no other course: the option gives its numbers to the digit."""
    plant, dt = plant_of(seed)
    sampled = obsynth.discretise(plant, dt).plant
    names = ("E", "A", "B", "C", "Bf", "Bd", "Bw", "Dw")
    alone = obsynth.DescriptorSystem(**{name: getattr(sampled, name) for name in names}, dt=dt)
    held = obsynth.guaranteed_test(sampled, disturbance="jump", **ASKED)
    assert held.threshold == obsynth.guaranteed_test(alone, **ASKED).threshold
    design, other = (obsynth.fault_estimation_filter(one) for one in (sampled, alone))
    options = {"disturbance_bounds": {"d1": 1.0}, "noise_bound": 3.0}
    limits = [
        obsynth.online_monitor(design, disturbance="held", **options).rule.limit,
        obsynth.online_monitor(other, **options).rule.limit,
    ]
    assert limits[0] == limits[1] < obsynth.online_monitor(design, **options).rule.limit


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(4))
def test_no_healthy_course_is_proved_faulty(seed: int) -> None:
    plant, dt = plant_of(seed)
    quiet = plant.replace(Bw=np.zeros((plant.nx, 0)), Dw=np.zeros((plant.ny, 0)), noise_names=None)
    design = obsynth.fault_estimation_filter(obsynth.discretise(quiet, dt))
    samples, parts = 12, 8
    outputs = responses(quiet, dt, samples, parts)
    rng = np.random.default_rng(seed)
    courses = [np.tile(np.repeat([1.0, -1.0], parts // 2), samples), rng.choice([-1.0, 1.0], samples * parts)]
    given = {"disturbance_bounds": {"d1": 1.0}, "initial_set": dict.fromkeys(plant.state_names, 0.0), "window": 6}
    for course in courses:
        y = np.tensordot(course, outputs, 1)
        data = pd.DataFrame(y, columns=list(plant.output_names))
        data.insert(0, "time", np.arange(samples) * dt)
        proof = obsynth.prove_alarm(design, data, samples, **given)
        assert not proof.proved
        assert "between samples too" in proof.statement
        held = obsynth.prove_alarm(design, data, samples, disturbance="held", **given)
        assert "held between samples" in held.statement


def test_statements_say_what_is_assumed_of_disturbances() -> None:
    plant, dt = plant_of(0)
    sampled = obsynth.discretise(plant, dt)
    design = obsynth.fault_estimation_filter(sampled)
    options = {"disturbance_bounds": {"d1": 1.0}, "noise_bound": 3.0}
    anything = obsynth.online_monitor(design, **options)
    held = obsynth.online_monitor(design, disturbance="held", **options)
    assert "move within their bounds between samples" in anything.statement
    assert "disturbances are held between samples" in held.statement
    start = dict.fromkeys(plant.state_names, 0.0)
    assert "move within their bounds" in obsynth.online_monitor(design, initial_set=start, **options).statement
    test = obsynth.guaranteed_test(sampled, **ASKED)
    assert "any time course, between samples too" in obsynth.online_monitor(test).statement
    assert "any time course, between samples too" in test.report["threshold"].claim
    jump = obsynth.guaranteed_test(sampled, disturbance="jump", **ASKED)
    assert "held between samples" in obsynth.online_monitor(jump).statement
    assert "held between samples" in jump.report["threshold"].claim


def test_a_test_of_a_plant_with_delays_says_that_disturbances_are_held() -> None:
    """Of its samples nothing is known in between: a disturbance that moves there would pass the threshold."""
    plant, dt = plant_of(1)
    late = obsynth.discretise(plant.replace(delays={"y1": 1.5 * dt}), dt)
    for kind in ("any", "jump"):
        design = obsynth.guaranteed_test(late, **ASKED, disturbance=kind)
        assert "disturbances that are held between samples" in obsynth.online_monitor(design).statement
        assert "disturbances that are held between samples" in design.report["threshold"].claim


@pytest.mark.parametrize("stiffness", [1.0, 1e2, 1e4])
def test_sums_of_columns_bound_integrals_and_are_near_them(stiffness: float) -> None:
    rng = np.random.default_rng([46, int(stiffness)])
    for n in (1, 2, 4):
        a = rng.normal(size=(n, n)) * np.logspace(0.0, np.log10(stiffness), n)[:, None]
        a -= (np.max(np.linalg.eigvals(a).real) + 0.1) * np.eye(n)
        b = rng.normal(size=(n, 1))
        values, vectors = np.linalg.eig(a)
        length = 2.0 / float(np.abs(values).min())
        edges = np.unique(np.concatenate([np.linspace(0.0, length, 20_001), length * np.logspace(-8.0, 0.0, 20_001)]))
        entering = np.linalg.solve(vectors, b.astype(complex)).ravel()
        middles = 0.5 * (edges[1:] + edges[:-1])
        kernel = ((np.exp(np.outer(middles, values)) * entering) @ vectors.T).real
        found = interval_columns(AffineMatrix.exact(a, 0), AffineMatrix.exact(b, 0), length)
        for row in rng.normal(size=(20, n)):
            integral = np.abs(kernel @ row) @ np.diff(edges)
            bound = sum(np.abs(row @ block.center) + np.abs(row) @ block.radius for block in found.blocks)
            bound = bound + np.abs(row @ found.directions) @ found.rest
            assert integral <= bound[0] * (1.0 + 1e-5)
            assert bound[0] <= 1.02 * integral


def worst_record(test: obsynth.GuaranteedTest, plant: obsynth.DescriptorSystem, dt: float) -> np.ndarray:
    """Outputs ``(SAMPLES, ny)`` without a fault, from rest, whose last residual is the largest there is."""
    y = np.eye(SAMPLES * plant.ny).reshape(-1, SAMPLES, plant.ny)
    weights = np.array([residual(test, one) for one in y]).reshape(SAMPLES, -1)
    effects = responses(plant, dt, SAMPLES)
    course = np.sign(effects.reshape(len(effects), -1) @ weights.ravel())
    return np.tensordot(course, effects, 1) + 3.0 * float(plant.Dw[0, 0]) * np.sign(weights)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", [1, 5, 6])
def test_the_worst_record_is_no_alarm_no_proof_and_no_interval_without_zero(seed: int) -> None:
    plant, dt = plant_of(seed)
    options = {name: value for name, value in ASKED.items() if name != "before"} | {"course": "constant"}
    sampled = obsynth.discretise(plant, dt)
    for more in ({}, {"exact": True}):
        test = obsynth.guaranteed_test(sampled, **options, **more)
        y = worst_record(test, plant, dt)
        data = pd.DataFrame(y, columns=list(plant.output_names))
        data.insert(0, "time", np.arange(SAMPLES) * dt)
        run = obsynth.run_on_data(test, data, monitor=obsynth.online_monitor(test))
        last = run.table.iloc[-1]
        assert last["statistic"] <= last["threshold"]
        assert last["statistic"] >= 0.98 * last["threshold"]
        assert not obsynth.prove_alarm(test, data, SAMPLES).proved
        if more:
            assert last["lowest f1"] <= 0.0 <= last["highest f1"]
    held = obsynth.guaranteed_test(sampled, disturbance="jump", **options)
    proof = obsynth.prove_alarm(held, data, SAMPLES)
    assert "held between samples" in proof.statement or not proof.proved


@pytest.mark.long
@pytest.mark.parametrize("seed", [4, 6])
def test_disturbances_of_a_bounded_rate_move_within_a_sample_too(seed: int) -> None:
    plant, dt = plant_of(seed)
    rate = 0.2
    test = obsynth.guaranteed_test(obsynth.discretise(plant, dt), disturbance="rate", disturbance_rate=rate, **ASKED)
    y = np.eye(SAMPLES * plant.ny).reshape(-1, SAMPLES, plant.ny)
    weights = np.array([residual(test, one) for one in y])
    noise = 3.0 * float(plant.Dw[0, 0]) * np.abs(weights).sum()
    # About any level, half of the rate to either side, as fast as it likes: no two values differ by more.
    moved = 0.5 * rate * np.abs(responses(plant, dt, SAMPLES).reshape(SAMPLES * PARTS, -1) @ weights).sum()
    assert moved + noise <= test.threshold * (1.0 + 1e-9)
    free = obsynth.guaranteed_test(obsynth.discretise(plant, dt), **ASKED)
    assert test.least <= test.threshold <= free.threshold * 1.1
    assert "by their stated rates" in test.report["threshold"].claim


@pytest.mark.parametrize("seed", [2, 5])
def test_thresholds_of_a_known_start_count_courses_between_samples(seed: int) -> None:
    plant, dt = plant_of(seed)
    quiet = plant.replace(Bw=np.zeros((plant.nx, 0)), Dw=np.zeros((plant.ny, 0)), noise_names=None)
    design = obsynth.fault_estimation_filter(obsynth.discretise(quiet, dt))
    samples, observer = 10, design.linear[1]
    effects = responses(quiet, dt, samples, 24)
    ones = np.array([observer.run(y, np.zeros((samples, 0))).residuals[-1, 0] for y in effects])
    y = np.tensordot(np.sign(ones), effects, 1)
    data = pd.DataFrame(y, columns=list(plant.output_names))
    data.insert(0, "time", np.arange(samples) * dt)
    given = {"disturbance_bounds": {"d1": 1.0}, "initial_set": dict.fromkeys(plant.state_names, 0.0)}
    last = f"threshold r[{observer.residual_names[0]}]"
    found = [
        obsynth.run_on_data(design, data, monitor=obsynth.online_monitor(design, disturbance=course, **given)).table
        for course in ("any", "held")
    ]
    moving, held = (float(table[last].iloc[-1]) for table in found)
    worst = float(np.abs(ones).sum())
    assert held < worst <= moving * (1.0 + 1e-9)
    assert moving <= TIGHT * worst


def test_a_certificate_without_a_word_about_disturbances_is_refused_by_name(tmp_path: Path) -> None:
    plant, dt = plant_of(1)
    design = obsynth.fault_estimation_filter(obsynth.discretise(plant, dt))
    y = np.zeros((8, plant.ny))
    y[-1, 0] = 1e3
    data = pd.DataFrame(y, columns=list(plant.output_names))
    data.insert(0, "time", np.arange(8) * dt)
    given = {"disturbance_bounds": {"d1": 1.0}, "noise_bound": 3.0}
    proof = obsynth.prove_alarm(design, data, 8, initial_set=dict.fromkeys(plant.state_names, 0.0), **given)
    assert proof.proved
    assert obsynth.verify_certificate(proof.save(tmp_path / "alarm.json")).passed
    old = {name: value for name, value in proof.certificate.items() if name != "disturbance"}
    report = obsynth.verify_certificate(replace(proof, certificate=old).save(tmp_path / "old.json"))
    assert [check.name for check in report.failures] == ["assumptions"]
    assert "disturbances do between samples" in report["assumptions"].claim
    none = replace(proof, proved=False, certificate={}, statement="Cannot be proved.")
    report = obsynth.verify_certificate(none.save(tmp_path / "none.json"))
    assert [check.name for check in report.failures] == ["proof"]


def test_unknown_inputs_of_a_nonlinear_plant_move_between_samples() -> None:
    equations = {"place": "der(place) = speed - lost", "force": "der(speed) = push + wind - 9*place - 0.05*place**3"}
    model = obsynth.DAEModel(
        equations, {"gauge": "place", "meter": "speed"}, states={"place": 0.0, "speed": 0.0},
        inputs={"push": 0.0, "wind": 0.0}, parameters={"lost": 0.0},
    )  # fmt: skip
    dt, samples, v = 0.7, 6, 1e-4
    region = {"place": [-0.05, 0.05], "speed": [-0.15, 0.15], "push": [0.0, 0.0], "wind": [-0.01, 0.01],
              "lost": [0.0, 0.01]}  # fmt: skip
    asked = {
        "course": "constant", "samples": samples, "sample_time": dt, "region": region,
        "disturbance_bounds": {"wind": 0.01}, "noise_bound": {"gauge": v, "meter": v},
    }  # fmt: skip
    test = obsynth.guaranteed_test(model, "lost", **asked)
    held = obsynth.guaranteed_test(model, "lost", disturbance="jump", **asked)
    linear = obsynth.DescriptorSystem(
        A=[[0.0, 1.0], [-9.0, 0.0]], C=np.eye(2), Bf=[[0.0], [1.0]], Bd=[[0.0], [1.0]]
    )  # fmt: skip
    y = np.eye(samples * 2).reshape(-1, samples, 2)
    inputs = np.zeros((samples, 1))
    run = [test.observer.run(one, inputs) for one in y]
    weights = np.array([float(np.hstack([one.faults, one.residuals])[-1, 0]) for one in run])
    worst = 0.01 * np.abs(responses(linear, dt, samples).reshape(samples * PARTS, -1) @ weights).sum()
    worst += v * np.abs(weights).sum()
    assert held.threshold < worst <= test.threshold * (1.0 + 1e-9)
    assert test.report.passed


@pytest.mark.long
def test_the_independent_program_forms_the_same_columns(tmp_path: Path) -> None:
    plant, dt = plant_of(1)
    test = obsynth.guaranteed_test(obsynth.discretise(plant, dt), **ASKED)
    path = test.save(tmp_path / "test.json")
    assert main(["export", "--gains", str(path), "--to", str(tmp_path / "proof.json")]) == 0
    document = json.loads((tmp_path / "proof.json").read_text("utf-8"))
    claims = {claim["claim"]: claim for claim in document["claims"]}
    assert {"threshold", "least"} <= set(claims)
    assert main(["verify", "--independent", str(tmp_path / "proof.json")]) == 0
    # Without the columns nothing but the values at the samples would act.
    for bound in claims["threshold"]["window"]["between_samples"]["bounds"]:
        bound["entries"][0] = 2 * int(bound["entries"][0])
    (tmp_path / "changed.json").write_text(json.dumps(document), "utf-8")
    assert main(["verify", "--independent", str(tmp_path / "changed.json")]) == 6
