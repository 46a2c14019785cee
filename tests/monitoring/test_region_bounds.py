"""Guaranteed thresholds of scheduled designs: against worst courses of parameters and inputs, by a simulation of its
own; on logs; what has none."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, SpecError
from obsynth.numerics.arrays import FloatArray

D1, NOISE = 0.1, 3.0


def _random_plant(seed: int, count: int) -> PolytopicSystem:
    """Return a stable plant of three states with a fault of constant direction, an unknown input and sensor noise."""
    rng = np.random.default_rng([seed, count])
    middle = rng.standard_normal((3, 3))
    middle *= 0.8 / np.abs(np.linalg.eigvals(middle)).max()
    names = ("v", "w")[:count]
    turns = {name: 0.12 * rng.standard_normal((3, 3)) for name in names}
    A = [
        [" + ".join([repr(middle[i, j]), *(f"{turns[name][i, j]!r} * {name}" for name in names)]) for j in range(3)]
        for i in range(3)
    ]
    plant = {
        "A": [[text.replace("np.float64(", "").replace(")", "") for text in row] for row in A],
        "C": [[1, 0, 0], [0, 1, 0]], "Bf": [[1], [0.3], [0.1]], "Bd": rng.uniform(0.2, 1.0, (3, 1)).tolist(), "dt": 1.0,
        "Bw": np.zeros((3, 2)).tolist(), "Dw": [[0.01, 0], [0, 0.02]],
    }  # fmt: skip
    return PolytopicSystem(plant=plant, scheduling={name: [-1, 1] for name in names})


def _turning_plant(seed: int) -> PolytopicSystem:
    """Return a plant whose fault turns with the parameter, with three noisy outputs."""
    rng = np.random.default_rng([seed, 77])
    middle, turn = rng.standard_normal((3, 3)), 0.1 * rng.standard_normal((3, 3))
    middle *= 0.75 / np.abs(np.linalg.eigvals(middle)).max()
    fault = rng.standard_normal(3), 0.5 * rng.standard_normal(3)
    plant = {
        "A": [[f"{middle[i, j]:.6f} + {turn[i, j]:.6f} * v" for j in range(3)] for i in range(3)],
        "Bf": [[f"{fault[0][i]:.6f} + {fault[1][i]:.6f} * v"] for i in range(3)], "C": np.eye(3).tolist(),
        "Bd": rng.uniform(0.2, 1.0, (3, 1)).tolist(), "dt": 1.0, "Bw": np.zeros((3, 3)).tolist(),
        "Dw": np.diag([0.01, 0.02, 0.015]).tolist(),
    }  # fmt: skip
    return PolytopicSystem(plant=plant, scheduling={"v": [-1, 1]})


def _simulated(
    design: ObserverDesign,
    course: FloatArray,
    d: FloatArray,
    noise: FloatArray,
    fault: FloatArray | None = None,
    start: FloatArray | None = None,
) -> FloatArray:
    """Return residuals ``(steps, nr)`` of the observer that runs beside the plant at parameters ``(steps, p)``."""
    plant, observer = design.scheduled
    x, state, rows = np.zeros(plant.nx) if start is None else start, observer.init(), []
    for k, parameters in enumerate(course):
        own = plant.at(parameters.tolist())
        y = own.C @ x + own.Dw @ noise[k]
        state, row = observer.advance(state, y, parameters)
        rows.append(row[observer.residual_rows])
        x = own.A @ x + own.Bd @ d[k] + (0.0 if fault is None else own.Bf @ fault[k])
    return np.array(rows)


def _worst(design: ObserverDesign, seed: int, steps: int = 14, passes: int = 2) -> float:
    """Return the largest residual that is reached by a search over courses of vertices, each with its worst inputs.

    The response to every input of every sample is measured by simulation: nothing of the bound is used.
    """
    plant, _ = design.scheduled
    rng, p = np.random.default_rng(seed), len(plant.scheduling.names)

    def reached(course: FloatArray) -> float:
        # The residual is linear in the inputs along a course: one simulation for each input and sample.
        responses = []
        for k in range(steps):
            for which in range(plant.nd + 2):
                d, noise = np.zeros((steps, plant.nd)), np.zeros((steps, 2))
                (d if which < plant.nd else noise)[k, which if which < plant.nd else which - plant.nd] = (
                    D1 if which < plant.nd else NOISE
                )
                responses.append(_simulated(design, course, d, noise)[-1])
        return float(np.max(np.abs(np.array(responses)).sum(axis=0)))

    best = 0.0
    for _ in range(passes):
        course = rng.choice([-1.0, 1.0], (steps, p))
        value = reached(course)
        for k in reversed(range(steps - 6, steps)):
            for j in range(p):
                trial = course.copy()
                trial[k, j] *= -1.0
                if (other := reached(trial)) > value:
                    course, value = trial, other
        best = max(best, value)
    return best


def _monitor(design: ObserverDesign, **more: Any) -> obsynth.Monitor:
    return obsynth.online_monitor(design, disturbance_bounds={"d1": D1}, noise_bound=NOISE, **more)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "count"), [(0, 1), (1, 1), (2, 2), (3, 1)])
def test_no_course_passes_the_threshold_and_some_come_near(seed: int, count: int) -> None:
    design = obsynth.fault_estimation_filter(_random_plant(seed, count))
    rule: Any = _monitor(design, initial_error=0.0).rule
    worst = _worst(design, seed)
    assert 0.75 * rule.limit < worst <= rule.limit
    assert (np.diff(rule.table) >= -1e-12).all()
    # What is allowed before the first samples act is the direct effect of noise alone.
    plant, _ = design.scheduled
    none = np.zeros((1, plant.nd))
    direct = [
        sum(np.abs(_simulated(design, corner[None], none, NOISE * unit[None])[0]) for unit in np.eye(2))
        for corner in np.array(list(product([-1.0, 1.0], repeat=count)))
    ]
    assert rule.table[0] == pytest.approx(np.max(direct), rel=1e-6)


@pytest.fixture(scope="module")
def design() -> ObserverDesign:
    return obsynth.fault_estimation_filter(_random_plant(0, 1))


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_a_filter_of_faults_that_turn_has_a_threshold_that_some_course_reaches(seed: int) -> None:
    """The sum of the norms of the responses to each input of each sample is what the threshold bounds."""
    design, steps, rng = obsynth.fault_estimation_filter(_turning_plant(seed)), 10, np.random.default_rng(seed)
    assert design.scheduled[1].correction is not None
    rule: Any = _monitor(design, initial_error=0.0).rule

    def reached(course: FloatArray) -> float:
        total = 0.0
        for k in range(steps):
            for which in range(4):
                inputs = np.zeros((steps, 4))
                inputs[k, which] = NOISE if which else D1
                total += float(np.linalg.norm(_simulated(design, course, inputs[:, :1], inputs[:, 1:])[-1]))
        return total

    course = rng.choice([-1.0, 1.0], (steps, 1))
    best = reached(course)
    for k in reversed(range(steps - 4, steps)):
        trial = np.where(np.arange(steps)[:, None] == k, -course, course)
        if (other := reached(trial)) > best:
            course, best = trial, other
    assert 0.9 * rule.limit < best <= rule.limit


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 4])
def test_random_inputs_and_starts_pass_no_row_of_a_filter_of_faults_that_turn(seed: int) -> None:
    design, rng = obsynth.fault_estimation_filter(_turning_plant(seed)), np.random.default_rng(seed)
    for size in (0.0, 0.7):
        rule: Any = _monitor(design, initial_error=size).rule
        for _ in range(8):
            course = rng.choice([-1.0, 0.3, 1.0], (25, 1))
            d, noise = D1 * rng.choice([-1.0, 1.0], (25, 1)), NOISE * rng.choice([-1.0, 1.0], (25, 3))
            # With E = I and three outputs the error at the start is T x.
            start = rng.standard_normal(3)
            start *= size / np.linalg.norm(design.certificate.matrices["tracking"] @ start)
            norms = np.linalg.norm(_simulated(design, course, d, noise, start=start), axis=1)
            bounds = np.append(rule.table, np.full(max(25 - len(rule.table), 0), rule.limit))[:25]
            assert (norms <= bounds).all()
        if size:
            assert norms[0] > 0.5 * bounds[0]
    fault = np.where(np.arange(60) < 40, 0.0, 4.0 * rule.limit / np.linalg.norm(design.scheduled[0].at([0.0]).Bf))
    none = np.zeros((60, 3))
    loud = np.linalg.norm(_simulated(design, np.zeros((60, 1)), none[:, :1], none, fault[:, None]), axis=1)
    assert (loud[42:] > rule.limit).any()


@pytest.mark.long
def test_random_inputs_raise_no_alarm_and_a_fault_does(design: ObserverDesign) -> None:
    rng, rule = np.random.default_rng(5), _monitor(design, initial_error=0.0)
    limit = rule.rule.limit  # type: ignore[attr-defined]
    course = rng.choice([-1.0, 1.0], (300, 1))
    d, noise = D1 * rng.choice([-1.0, 1.0], (300, 1)), NOISE * rng.choice([-1.0, 1.0], (300, 2))
    quiet = np.linalg.norm(_simulated(design, course, d, noise), axis=1)
    assert 0.3 * limit < quiet.max() <= limit
    fault = np.where(np.arange(300) < 200, 0.0, 3.0 * limit)[:, None]
    loud = np.linalg.norm(_simulated(design, course, d, noise, fault), axis=1)
    assert (loud[202:] > limit).all()


@pytest.mark.long
def test_the_statement_says_for_which_courses_and_a_log_has_the_alarm(design: ObserverDesign, tmp_path: Any) -> None:
    monitor = _monitor(design)
    assert "for every course of v in the region" in monitor.statement
    assert "after rows outside the region" in monitor.statement
    rng, plant = np.random.default_rng(0), design.plant
    assert isinstance(plant, PolytopicSystem)
    v = rng.uniform(-1, 1, 120)
    x, rows = np.zeros(3), []
    for k in range(120):
        own = plant.at([v[k]])
        rows.append(own.C @ x)
        x = own.A @ x + own.Bf[:, 0] * (2.0 if k >= 80 else 0.0)
    y = np.array(rows)
    log = pd.DataFrame({"time": np.arange(120.0), "v": v, "y1": y[:, 0], "y2": y[:, 1]})
    obsynth.run_on_data(design, log, out=tmp_path / "out.csv", monitor=monitor)
    written = pd.read_csv(tmp_path / "out.csv")
    alarm = written["alarm"].notna().to_numpy()
    assert not alarm[:80].any()
    assert alarm[82:].all()


def test_a_start_and_one_vertex_are_as_for_a_constant_plant() -> None:
    constant: dict[str, Any] = {
        "A": [[0.7, 0.1], [0, 0.5]],
        "C": [[1, 0], [0, 1]],
        "Bf": [[1], [0]],
        "Bd": [[0.2, 1], [1, 0.3]],
    }
    constant["dt"] = 1.0
    one = obsynth.fault_estimation_filter(PolytopicSystem([obsynth.DescriptorSystem(**constant)]))
    bounds = {"d1": D1, "d2": D1}  # of which no observer decouples both
    monitor: Any = obsynth.online_monitor(one, disturbance_bounds=bounds, initial_error=0.0)
    vertex = one.scheduled[0].vertices[0]
    plain = obsynth.fault_estimation_filter(vertex, gamma_margin=0.01)
    same = plain.replace(observer=one.scheduled[1].at_vertex(0), certificate=one.certificate)
    other: Any = obsynth.online_monitor(same, disturbance_bounds=bounds, initial_error=0.0, unverified=True)
    assert monitor.rule.limit == pytest.approx(other.rule.limit, rel=1e-3)


def test_what_has_no_guaranteed_threshold_is_refused_by_name(design: ObserverDesign) -> None:
    with pytest.raises(SpecError, match="d1"):
        obsynth.online_monitor(design, noise_bound=3.0)
    with pytest.raises(SpecError, match="noise_bound"):
        obsynth.online_monitor(design, disturbance_bounds={"d1": D1})
    with pytest.raises(SpecError, match="over a region"):
        obsynth.online_monitor(design, "window", disturbance_bounds={"d1": D1}, noise_bound=3.0)
    changed = design.replace(
        certificate=obsynth.Certificate(
            design.certificate.matrices, {**design.certificate.claims, "region_decay": 1e-3}
        )
    )
    with pytest.raises(SpecError, match="not proved"):
        _monitor(changed, unverified=True)
