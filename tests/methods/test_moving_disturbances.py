"""Thresholds, tests and proofs of sampled plants against their continuous simulation: disturbances move in a sample."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm

import obsynth
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
