"""Guaranteed thresholds of scheduled designs in continuous time: against courses that switch, simulated apart."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, SpecError
from obsynth.monitoring.thresholds.euler_bounds import EulerErrorBound, PlantMotion, RowChange
from obsynth.monitoring.thresholds.euler_rule import weights_between
from obsynth.monitoring.thresholds.monitor import LinearSample, Sample
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.scheduling import Scheduling

D1, NOISE = 0.1, 3.0
#: Parts of an interval of the simulation: disturbances, and the place of a jump, may change between them.
PARTS = 4


def _plant(**changes: Any) -> PolytopicSystem:
    """Return a plant of three states whose fault changes its effect, with noise of two sensors."""
    plant = {
        "A": [[-1, "x", 0.3], [0.2, -2, "0.5 * x"], [0.1, 0.4, -1.5]], "B": [[0], [1], [0.3]],
        "Bf": [[0], ["1 + 0.3 * x"], [0.2]], "Bd": [[1], [0], [0.2]], "C": [[1, 0, 0], [0, 1, 0]],
        "Bw": np.zeros((3, 2)).tolist(), "Dw": [[0.001, 0], [0, 0.002]],
    }  # fmt: skip
    return PolytopicSystem(plant={**plant, **changes}, scheduling={"x": [0.5, 2]})


def random_plant(seed: int) -> PolytopicSystem:
    """Return a stable plant of up to four states, the last of which may be algebraic, with up to two parameters."""
    rng = np.random.default_rng([seed, 50])
    n, count, algebraic = int(rng.integers(2, 5)), int(rng.integers(1, 3)), bool(rng.integers(0, 2))
    middle = rng.standard_normal((n, n))
    middle -= (np.max(np.linalg.eigvals(middle).real) + rng.uniform(0.3, 2.0)) * np.eye(n)
    turns = 0.25 * rng.standard_normal((count, n, n))
    E = np.eye(n)
    if algebraic:
        E[-1, -1], middle[-1, -1], turns[:, -1] = 0.0, -2.0, 0.0
    names = ("p", "q")[:count]
    texts = (["p", "p * q"] if rng.integers(0, 2) else ["p ** 2", "q"])[:count]
    factors = list(zip(turns, texts, strict=True))
    A = [
        [" + ".join([f"{middle[i, j]:.6f}", *(f"{t[i, j]:.6f} * {text}" for t, text in factors)]) for j in range(n)]
        for i in range(n)
    ]
    C = np.eye(n)[: max(n - 1, 2)]
    plant = {
        "E": E, "A": A, "B": rng.standard_normal((n, 1)).tolist(), "Bf": rng.standard_normal((n, 1)).tolist(),
        "Bd": rng.standard_normal((n, 1)).tolist(), "C": C, "Bw": np.zeros((n, len(C))).tolist(),
        "Dw": (0.002 * np.eye(len(C))).tolist(),
    }  # fmt: skip
    return PolytopicSystem(plant=plant, scheduling={name: [-1, 1.2] for name in names})


def _signals(rng: np.random.Generator, mode: str, steps: int, width: int) -> FloatArray:
    """Return signals ``(steps, width)`` in [0, 1]: jumps, held for a while or not, walks, or waves."""
    if mode == "waves":
        return np.asarray(0.5 + 0.5 * np.sin(0.07 * np.arange(steps)[:, None] + np.arange(width)))
    if mode == "walk":
        return np.clip(0.5 + np.cumsum(0.05 * rng.standard_normal((steps, width)), axis=0), 0.0, 1.0)
    held = int(rng.integers(5, 40)) if mode == "jumps" else 1
    return np.repeat(rng.choice([0.0, 1.0], (steps // held + 1, width)), held, axis=0)[:steps]


def simulated(
    design: ObserverDesign, seed: int, mode: str, h: float, steps: int, start: FloatArray | None = None
) -> list[LinearSample]:
    """Return what the observer gave along a course, beside a plant that is moved by matrix exponentials."""
    plant, observer = design.scheduled
    rng, scheduling = np.random.default_rng(seed), plant.scheduling
    stacks = {name: np.array([getattr(v, name) for v in plant.vertices]) for name in ("A", "B", "Bd")}
    first, r = plant.vertices[0], int(np.linalg.matrix_rank(plant.E))
    low, high = scheduling.low, scheduling.high
    course = low + (high - low) * _signals(rng, mode, steps, len(low))
    u = 2.0 * _signals(rng, mode, steps, plant.nu) - 1.0
    jumps = mode in ("jumps", "fast")

    def at(parameters: FloatArray) -> tuple[FloatArray, ...]:
        weights = scheduling.weights(parameters)
        return tuple(np.tensordot(weights, stack, 1) for stack in stacks.values())

    def whole(v: FloatArray, parameters: FloatArray, inputs: FloatArray, d: FloatArray) -> FloatArray:
        A, B, Bd = at(parameters)
        driven = B @ inputs + Bd @ d
        return np.r_[v, np.linalg.solve(A[r:, r:], -(A[r:, :r] @ v + driven[r:]))]

    v, state, rows = np.zeros(r) if start is None else start, observer.init(), []
    d, held, count = D1 * rng.choice([-1.0, 1.0], plant.nd), int(rng.integers(1, 200)), 0
    for k in range(steps):
        place = rng.uniform(0, 1)
        for part in range(PARTS if k else 0):
            count += 1
            d = D1 * rng.choice([-1.0, 1.0], plant.nd) if count % held == 0 else d
            share = (part + 0.5) / PARTS
            share = float(share > place) if jumps else share
            between = [one[k - 1] + share * (one[k] - one[k - 1]) for one in (course, u)]
            A, B, Bd = at(between[0])
            driven = B @ between[1] + Bd @ d
            inverse = np.linalg.solve(A[r:, r:], np.hstack([A[r:, :r], driven[r:, None]]))
            M = np.zeros((r + 1, r + 1))
            M[:r] = np.hstack([A[:r, :r], driven[:r, None]]) - A[:r, r:] @ inverse
            v = (expm(M * h / PARTS) @ np.r_[v, 1.0])[:r]
        x = whole(v, course[k], u[k], d)
        y = first.C @ x + first.D @ u[k] + first.Dd @ d + first.Dw @ (NOISE * rng.choice([-1.0, 1.0], plant.nw))
        signals = np.r_[u[k], course[k]]
        state, row = observer.advance(state, y, signals, h if k else 0.0)
        rows.append(LinearSample(row, signals, y, plant.nx))
    return rows


def watched(design: ObserverDesign, monitor: obsynth.Monitor, rows: list[LinearSample], h: float) -> FloatArray:
    """Return statistic and threshold ``(steps, 2)``."""
    observer, state, made = design.scheduled[1], monitor.rule.init(), []
    for k, row in enumerate(rows):
        sample = Sample(k * h, row.rows[observer.residual_rows], row.rows[observer.fault_rows], row)
        state, output = monitor.rule.step(state, sample)
        made.append((output.statistic, output.threshold))
    return np.array(made)


def _monitor(design: ObserverDesign, **more: Any) -> obsynth.Monitor:
    return obsynth.online_monitor(design, disturbance_bounds={"d1": D1}, noise_bound=NOISE, **more)


@pytest.fixture(scope="module")
def design() -> ObserverDesign:
    return obsynth.ui_pi_observer(_plant())


@pytest.mark.long
@pytest.mark.parametrize("mode", ["waves", "walk", "jumps", "fast"])
@pytest.mark.parametrize("h", [0.002, 0.03])
def test_no_course_passes_the_threshold_and_slow_ones_come_near(design: ObserverDesign, mode: str, h: float) -> None:
    monitor = _monitor(design, initial_error=0.0)
    for seed in range(3):
        values = watched(design, monitor, simulated(design, seed, mode, h, 400), h)
        assert (values[:, 0] <= values[:, 1]).all()
        assert np.isfinite(values[:, 1]).all()
        assert mode == "fast" or np.max(values[1:, 0] / values[1:, 1]) > 0.1


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_no_course_of_random_plants_passes(seed: int) -> None:
    design = obsynth.ui_pi_observer(random_plant(seed))
    monitor = _monitor(design, initial_error=0.0)
    for mode in ("waves", "jumps", "fast"):
        values = watched(design, monitor, simulated(design, seed, mode, 0.01, 250), 0.01)
        assert (values[:, 0] <= values[:, 1]).all()
    values = watched(design, monitor, simulated(design, seed, "walk", 0.01, 100), 0.01)
    assert np.isfinite(values[:, 1]).all()


@pytest.mark.long
def test_a_start_of_a_stated_size_passes_no_row_and_one_twice_as_large_does(design: ObserverDesign) -> None:
    tracking = design.certificate.matrices["tracking"][:, :3]
    start = np.array([0.0, 1.0, -0.5])
    size = float(np.linalg.norm(tracking @ start))
    rows = simulated(design, 3, "waves", 0.01, 60, start)
    stated = watched(design, _monitor(design, initial_error=size), rows, 0.01)
    assert (stated[:, 0] <= stated[:, 1]).all()
    smaller = watched(design, _monitor(design, initial_error=0.05 * size), rows, 0.01)
    assert (smaller[:, 0] > smaller[:, 1]).any()


@pytest.mark.long
def test_without_a_start_nothing_is_decided_until_an_error_has_decayed(design: ObserverDesign) -> None:
    values = watched(design, _monitor(design), simulated(design, 1, "waves", 0.02, 400), 0.02)
    first = int(np.argmax(np.isfinite(values[:, 1])))
    decay = design.certificate.claims["region_decay"]
    assert 0.8 * np.log(100) / decay < first * 0.02 < 3.0 * np.log(100) / decay
    assert (values[first:, 0] <= values[first:, 1]).all()


@pytest.mark.long
def test_a_log_has_the_alarm_of_a_fault_and_none_before(design: ObserverDesign) -> None:
    plant, h, steps, onset = design.scheduled[0], 0.02, 1000, 700
    t = np.arange(steps) * h
    x = 1.2 + 0.4 * np.sin(0.5 * t)
    v, outputs = np.zeros(3), []
    for k in range(steps):
        own = plant.at([x[k]])
        outputs.append(own.C @ v)
        M = np.zeros((4, 4))
        M[:3, :3], M[:3, 3] = own.A, own.Bf[:, 0] * (k >= onset) + 0.05 * own.Bd[:, 0]
        v = (expm(M * h) @ np.r_[v, 1.0])[:3]
    y = np.array(outputs)
    log = pd.DataFrame({"time": t, "u1": 0.0, "x": x, "y1": y[:, 0], "y2": y[:, 1]})
    monitor = _monitor(design)
    run = obsynth.run_on_data(design, log, monitor=monitor)
    assert list(run.alarms)
    assert onset < min(run.alarm_rows.values()) < onset + 100
    assert run.table is not None
    assert run.table["threshold"].notna().sum() > 300
    assert "stay between their values at both" in monitor.statement


@pytest.mark.parametrize("h", [0.01, 0.1])
def test_steps_of_a_given_observer_stay_below_their_bound_and_come_near(h: float) -> None:
    """An observer with a gain that is written down; plant, input and disturbance jump within an interval."""
    A, B, Bd = np.array([[[-1, 2.0], [0.5, -2]], [[-1, -1.0], [0.5, -3]]]), np.ones((2, 2, 1)), np.full((2, 2, 1), 0.1)
    closed = A - np.array([[3.0, 0], [0, 1.0]])
    decay = -max(float(np.linalg.eigvalsh(0.5 * (M + M.T))[-1]) for M in closed)
    motion = PlantMotion(A, B, Bd, np.eye(2), np.eye(2), np.zeros((2, 0)), np.ones(2))
    bound = EulerErrorBound(motion, np.eye(2), np.eye(2), decay, float(np.linalg.norm(Bd[0])))
    rng, shares = np.random.default_rng(0), []
    x, z, size, place, u = np.zeros(2), np.zeros(2), 0.0, 0, np.ones(1)
    for k in range(300):
        before, u_before = place, u
        place, u = (int(rng.integers(2)), rng.choice([-1.0, 1.0], 1)) if k % 40 == 0 else (place, u)
        for part in range(2):
            now, driven = (place, u) if part else (before, u_before)
            force = B[now] @ driven + Bd[now] @ rng.choice([-1.0, 1.0], 1)
            x = (expm(np.block([[A[now], force[:, None]], [np.zeros((1, 3))]]) * h / 2) @ np.r_[x, 1.0])[:2]
        L = A[place] - closed[place]
        z = np.linalg.solve(np.eye(2) - h * closed[place], z + h * (B[place] @ u + L @ x))
        changed = np.full(2, float(place != before))
        size, _ = bound.after(size, RowChange(h, z, u, np.abs(u - u_before), np.eye(2)[place], changed))
        assert np.linalg.norm(x - z) <= size
        shares.append(np.linalg.norm(x - z) / size)
    assert max(shares) > 0.2


def test_weights_between_rows_are_enclosed() -> None:
    scheduling = Scheduling(("p", "q"), np.array([-1.0, -1]), np.array([1.0, 1]), (None, None), ("p ** 2", "p * q"))
    before, now = np.array([-0.5, 0.2]), np.array([0.6, -0.9])
    weights, turned = weights_between(scheduling, before, now)
    for p in np.linspace(-0.5, 0.6, 12):
        for q in np.linspace(-0.9, 0.2, 12):
            assert (np.abs(scheduling.weights([p, q]) - weights) <= turned + 1e-12).all()
    assert not weights_between(scheduling, now, now)[1].any()


@pytest.mark.long
def test_what_has_no_such_threshold_is_refused_by_name(design: ObserverDesign) -> None:
    with pytest.raises(SpecError, match="d1"):
        obsynth.online_monitor(design, noise_bound=3.0)
    with pytest.raises(SpecError, match="noise_bound"):
        obsynth.online_monitor(design, disturbance_bounds={"d1": D1})


@pytest.mark.long
def test_process_noise_is_refused_by_name() -> None:
    with pytest.raises(SpecError, match="process noise"):
        _monitor(obsynth.ui_pi_observer(_plant(Bw=[[0.1, 0], [0, 0], [0, 0]])))
