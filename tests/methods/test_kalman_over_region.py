"""Kalman filters over a region: the steady filter at one vertex, covariances along courses, corrupted designs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.corruptions import with_claims, with_matrices
from tests.support.polytopic_plants import record, wang

import obsynth
from obsynth import ObserverDesign, PolytopicSystem, PreconditionError, SpecError
from obsynth.numerics.arrays import FloatArray

NOISE: dict[str, Any] = {"Q": np.diag([0.1, 0.1, 0.1, 1e-3]).tolist(), "R": 0.01}


def oscillator(**changes: Any) -> PolytopicSystem:
    """Return a plant of which one output is measured."""
    plant = {
        "A": [["0.8 + 0.3 * v", 0.3], [-0.2, "0.9 - 0.2 * v"]], "B": [[0], [1]], "C": [[1, 0]], "D": [[0.5]], "dt": 1.0,
    }  # fmt: skip
    return PolytopicSystem(plant={**plant, **changes}, scheduling={"v": [-1, 1]})


@pytest.fixture(scope="module")
def design() -> ObserverDesign:
    return obsynth.descriptor_kalman(oscillator(), Q=0.1, R=0.1)


@pytest.fixture(scope="module")
def singular() -> ObserverDesign:
    return obsynth.descriptor_kalman(wang(), **NOISE)


def covariances(
    design: ObserverDesign, course: FloatArray, Q: FloatArray, R: FloatArray, units: FloatArray | float = 1.0
) -> FloatArray:
    """Return the mean square of the state errors at every sample along a course, from the matrices of the run alone."""
    plant, observer = design.scheduled
    n, T = plant.nx, design.certificate.matrices["tracking"]
    Dy, X, found = observer.Dy[:n], np.zeros((n, n)), []
    for values in course:
        weights = plant.weights(values)
        Az, By = np.tensordot(weights, observer.Az, 1), np.tensordot(weights, observer.By, 1)
        found.append(np.sum(np.diag(X + Dy @ R @ Dy.T) / np.square(units)))
        X = Az @ X @ Az.T + T @ Q @ T.T + By @ R @ By.T
    return np.array(found)


def test_one_vertex_is_the_steady_filter() -> None:
    point = oscillator().at({"v": 0.3})
    one = obsynth.descriptor_kalman(PolytopicSystem([point]), Q=0.1, R=0.2)
    steady = obsynth.steady_state_filter(point, Q=0.1, R=0.2)
    assert one.certificate.claims["region_deviation"] == pytest.approx(np.trace(steady.P) ** 0.5, rel=3e-3)
    assert one.certificate.claims["region_deviation"] > np.trace(steady.P) ** 0.5


@pytest.mark.long
def test_a_scalar_filter_is_that_of_the_worst_pole() -> None:
    plant = PolytopicSystem(plant={"A": [["a"]], "C": [[1.0]], "dt": 1.0}, scheduling={"a": [0.5, 1.2]})
    made = obsynth.descriptor_kalman(plant, Q=1.0, R=1.0)
    predicted = max(np.roots([1.0, -(1.2**2 + 1.0 - 1.0), -1.0]))
    assert made.certificate.claims["region_deviation"] ** 2 == pytest.approx(predicted / (predicted + 1), rel=5e-3)


@pytest.mark.long
@pytest.mark.parametrize("name", ["design", "singular"])
def test_no_course_exceeds_the_mean_square(name: str, request: pytest.FixtureRequest) -> None:
    made: ObserverDesign = request.getfixturevalue(name)
    plant, level = made.scheduled[0], made.certificate.claims["region_deviation"] ** 2
    Q = 0.1 * np.eye(2) if name == "design" else np.array(NOISE["Q"])
    R = (0.1 if name == "design" else 0.01) * np.eye(plant.ny)
    ends, rng, worst = np.array([plant.scheduling.low, plant.scheduling.high]), np.random.default_rng(0), 0.0
    p = len(plant.scheduling.names)
    for trial in range(40):
        picks = rng.integers(0, 2, (300, p)) if trial % 2 else np.repeat(rng.integers(0, 2, (30, p)), 10, axis=0)
        picks = np.full((300, p), trial // 2 % 2) if trial < 4 else picks
        found = covariances(made, ends[picks, np.arange(p)], Q, R)
        worst = max(worst, float(found[-200:].mean()))
    assert 0.8 * level < worst <= level


@pytest.mark.long
def test_estimates_follow_without_noise(singular: ObserverDesign) -> None:
    plant, observer = singular.scheduled
    rng = np.random.default_rng(2)
    course, u = rng.uniform(-1, 1, (1500, 2)), rng.standard_normal((1500, 1))
    y = record(plant, course, u, np.zeros((1500, 2)), 5.0 * rng.standard_normal((1500, 1)))
    found = observer.run(y, np.column_stack([u, course]))
    assert np.abs(found.states[-1][1:] - y[-1]).max() < 1e-6  # three of four states are measured
    assert np.abs(found.residuals[-1]).max() < 1e-6
    first = -(found.states[-1] @ np.array([0.0, 0, 1, 1]))  # the algebraic equation, without faults
    assert found.states[-1][0] == pytest.approx(first, abs=1e-6)


def _observer(design: ObserverDesign, **changed: Any) -> ObserverDesign:
    data = {**design.scheduled[1].as_dict(), **changed}
    return design.replace(observer=type(design.scheduled[1]).from_dict(data))


_DEVIATION, _DECAY = "mean square over the region", "decay over the region"
_CORRUPTIONS: dict[str, tuple[Callable[[ObserverDesign], ObserverDesign], str]] = {
    "smaller number": (
        lambda d: with_claims(d, region_deviation=0.99 * d.certificate.claims["region_deviation"]), _DEVIATION,
    ),
    "faster decay": (lambda d: with_claims(d, region_decay=0.5 * d.certificate.claims["region_decay"]), _DECAY),
    "no number": (lambda d: with_claims(d, region_deviation=float("nan")), _DEVIATION),
    "another P": (lambda d: with_matrices(d, P_gain=0.5 * d.certificate.matrices["P_gain"]), _DEVIATION),
    "P is not symmetric": (
        lambda d: with_matrices(d, P_gain=d.certificate.matrices["P_gain"] + np.array([[0, 1e-9], [0, 0]])),
        _DEVIATION,
    ),
    "P of the decay is none": (
        lambda d: with_matrices(d, P_region=0.0 * d.certificate.matrices["P_region"]), "decay over the region",
    ),
    "more noise": (lambda d: d.replace(options={**d.options, "R": [[0.2]]}), _DEVIATION),
    "noise that is none": (lambda d: d.replace(options={**d.options, "R": [[-0.2]]}), "fits the plant"),
    "another tracking": (
        lambda d: with_matrices(d, tracking=1.001 * d.certificate.matrices["tracking"]), "unbiased: dynamics",
    ),
    "no tracking": (lambda d: with_matrices(d, tracking=np.zeros((1, 2))), "fits the plant"),
    "another gain": (lambda d: _observer(d, By=1.001 * d.scheduled[1].By), "unbiased: dynamics"),
    "another input": (lambda d: _observer(d, Bu=1.001 * d.scheduled[1].Bu), "unbiased: inputs"),
    "another estimate": (lambda d: _observer(d, Dy=1.001 * d.scheduled[1].Dy), "unbiased: state"),
    "claims too early": (lambda d: _observer(d, forgetting=1), "rows without a claim"),
    "wider region": (
        lambda d: d.replace(plant=PolytopicSystem(plant=d.plant.as_dict()["plant"], scheduling={"v": [-1.1, 1]})),
        "scheduling",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", _CORRUPTIONS)
def test_corrupted_designs_are_refused(name: str, design: ObserverDesign) -> None:
    corrupt, row = _CORRUPTIONS[name]
    report = obsynth.verify(corrupt(design))
    assert not report.passed
    assert not report[row].passed


def test_an_unknown_input_that_is_not_left_out_is_refused() -> None:
    plant = oscillator(C=[[1, 0], [0, 1]], D=[[0.5], [0]], Bd=[["0.5 + 0.2 * v"], [0]])
    made = obsynth.descriptor_kalman(plant, Q=0.1, R=0.1)
    rng = np.random.default_rng(0)
    x, errors = np.ones(2), []
    observer, state = made.scheduled[1], made.scheduled[1].init()
    for _ in range(60):
        v, u, d = rng.uniform(-1, 1), rng.standard_normal(1), 100.0 * rng.standard_normal(1)
        now = plant.at([v])
        state, found = observer.step(state, now.C @ x + now.D @ u, np.r_[u, v])
        errors.append(np.abs(found.states[0] - x).max())
        x = now.A @ x + now.B @ u + now.Bd @ d
    assert errors[-1] < 1e-9
    other = plant.as_dict()["plant"] | {"Bd": [[0.5], ["0.2 * v"]]}
    report = obsynth.verify(made.replace(plant=PolytopicSystem(plant=other, scheduling={"v": [-1, 1]})))
    assert not report.passed


@pytest.mark.long
def test_units_do_not_matter() -> None:
    plain, factor = obsynth.descriptor_kalman(oscillator(), Q=0.1, R=0.1), 1024.0
    moved = oscillator(
        A=[["0.8 + 0.3 * v", 0.3 / factor], [-0.2 * factor, "0.9 - 0.2 * v"]], B=[[0], [factor]], C=[[1, 0]]
    )
    other = obsynth.descriptor_kalman(moved, Q=[[0.1, 0], [0, 0.1 * factor**2]], R=0.1)
    course, R = np.random.default_rng(0).uniform(-1, 1, (200, 1)), np.array([[0.1]])
    one = covariances(plain, course, 0.1 * np.eye(2), R)
    units = np.array([1.0, factor])
    same = covariances(other, course, 0.1 * np.diag(units**2), R, units)
    assert same[50:] == pytest.approx(one[50:], rel=0.02)


def test_a_gain_set_is_the_design_again(design: ObserverDesign, tmp_path: Path) -> None:
    again = obsynth.load(design.save(tmp_path / "kalman.gains.json"))
    assert obsynth.verify(again).passed
    assert np.array_equal(again.scheduled[1].Az, design.scheduled[1].Az)


def test_noise_of_the_plant_counts_at_every_vertex() -> None:
    plant = oscillator(Bw=[["1 + 0.5 * v", 0], [0, 0]], Dw=[[0, 0.3]])
    made = obsynth.descriptor_kalman(plant)
    quiet = obsynth.descriptor_kalman(oscillator(Bw=[[0.5, 0], [0, 0]], Dw=[[0, 0.3]]))
    assert made.certificate.claims["region_deviation"] > quiet.certificate.claims["region_deviation"]
    with pytest.raises(SpecError, match="at once"):
        obsynth.descriptor_kalman(oscillator(Bw=[["1 + 0.5 * v"], [0]], Dw=[[0.3]]))


@pytest.mark.long
def test_a_rate_buys_a_smaller_mean_square() -> None:
    def made(rate: float | None) -> float:
        given = oscillator().as_dict()["plant"]
        entry = {"range": [-1, 1], **({"rate": rate} if rate else {})}
        plant = PolytopicSystem(plant=given, scheduling={"v": entry})
        return float(obsynth.descriptor_kalman(plant, Q=0.1, R=0.1).certificate.claims["region_deviation"])

    assert made(0.02) <= made(None) * (1 + 2e-3)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"initial_state": [0, 0]}, "no initial_state"),
        ({"outliers": "gate"}, "no outliers"),
        ({"Q": [[1, 0], [0, -1]]}, "Q"),
        ({"Q": np.zeros((3, 2, 2))}, "Q"),
        ({"R": [[1, 2]]}, "R"),
    ],
)
def test_what_a_filter_over_a_region_does_not_have_is_refused(options: dict[str, Any], told: str) -> None:
    with pytest.raises(SpecError, match=told):
        obsynth.descriptor_kalman(oscillator(), **options)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"dt": 0.0}, "continuous plant"),
        ({"C": [["1 + 0.1 * v", 0]]}, "constant outputs"),
        ({"A": [[1.1, 0], [0, "0.5 * v"]], "C": [[0, 1]]}, "vertex 1"),
        ({"Bd": [[0], [1]], "Dd": [[1]]}, "unknown inputs in outputs"),
        ({"Bd": [[0], ["1 + v"]]}, "rank over the region"),
    ],
)
def test_what_does_not_exist_is_refused_by_name(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(PreconditionError, match=told):
        obsynth.descriptor_kalman(oscillator(**changes), Q=0.1, R=0.1)


def test_auto_takes_it_for_states_alone() -> None:
    faulty = oscillator(C=[[1, 0], [0, 1]], D=[[0], [0]], Bf=[[1], [0]])
    assert obsynth.design(faulty).method != "descriptor-kalman"
