"""Vertices that repeat one or lie among the others change no design; claims of gains of about zero, and decays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth import DescriptorSystem, PolytopicSystem
from obsynth.conditions import ErrorPolytope
from obsynth.methods.engines.vertex_certificates import best_decay, certified
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.convex_hulls import spanning_points

Given = list[dict[str, Any]]


def test_spanning_points_and_the_others_as_their_means() -> None:
    rng = np.random.default_rng(0)
    corners = np.array([[0.0, 0, 1], [4, 0, 1], [0, 3, 1], [5, 4, 1]])
    shares = rng.dirichlet(np.ones(4), 5)
    points = [*corners[:2], *(shares @ corners)[:3], *corners[2:], corners[1], *(shares @ corners)[3:]]
    spanning = spanning_points(points)
    assert spanning is not None
    used, weights = spanning
    assert used == [0, 1, 5, 6]
    assert (weights >= 0.0).all()
    assert weights.sum(axis=1) == pytest.approx(np.ones(len(points)), abs=1e-12)
    assert weights @ np.array(points)[used] == pytest.approx(np.array(points), abs=1e-11)
    assert spanning_points(list(corners)) is None
    assert spanning_points([corners[0]] * 3) is not None
    assert spanning_points(list(rng.standard_normal((40, 2)))) is None  # too many to examine
    # Of points on a line, only the ends; those near the line are no means.
    assert spanning_points([np.array([v, 0.0]) for v in (0.0, 1.0, 0.5, 0.25)])[0] == [0, 1]  # type: ignore[index]
    assert spanning_points([np.array([0.0, 0]), np.array([1.0, 0]), np.array([0.5, 1e-9])]) is None


def _vertices(seed: int, dt: float | None) -> Given:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((3, 3))
    A = A * 0.7 / np.abs(np.linalg.eigvals(A)).max() if dt else A - np.eye(3) * (1.0 + np.linalg.eigvals(A).real.max())
    same: dict[str, Any] = {"Bf": rng.standard_normal((3, 1)), "C": np.eye(3)[:2], **({"dt": dt} if dt else {})}
    return [{"A": A + 0.2 * rng.standard_normal((3, 3)), **same} for _ in range(3)]


def _with_redundant(given: Given) -> Given:
    mean = {**given[0], "A": 0.25 * given[0]["A"] + 0.75 * given[2]["A"]}
    return [given[0], mean, *given[1:], given[1]]


def _polytope(given: Given) -> PolytopicSystem:
    return PolytopicSystem([DescriptorSystem(**each) for each in given])


@pytest.mark.long
@pytest.mark.parametrize("dt", [None, 1.0])
@pytest.mark.parametrize("method", ["ui_pi_observer", "fault_estimation_filter", "descriptor_kalman"])
def test_redundant_vertices_change_no_design(method: str, dt: float | None) -> None:
    if dt is None and method != "ui_pi_observer":
        pytest.skip("of discrete time")
    options: dict[str, Any] = {"Q": 0.1, "R": 0.1} if method == "descriptor_kalman" else {}
    given = _vertices(1, dt)
    if method == "fault_estimation_filter":
        given = [{**each, "Bd": np.array([[1.0], [0.4], [0.3]])} for each in given]
    plain = getattr(obsynth, method)(_polytope(given), **options)
    other = getattr(obsynth, method)(_polytope(_with_redundant(given)), **options)
    assert other.report.passed
    assert dict(other.certificate.claims) == pytest.approx(dict(plain.certificate.claims), rel=1e-9)
    one, more = plain.scheduled[1], other.scheduled[1]
    for place, (first, second, share) in enumerate([(0, 0, 0), (0, 2, 0.75), (1, 1, 0), (2, 2, 0), (1, 1, 0)]):
        wanted = (1.0 - share) * one.By[first] + share * one.By[second]
        assert more.By[place] == pytest.approx(wanted, rel=1e-6, abs=1e-9)


def test_gains_at_a_redundant_vertex_are_the_mean_of_the_others() -> None:
    def errors(*values: float) -> ErrorPolytope:
        return ErrorPolytope([[[a]] for a in values], [[1.0]], B=[[1.0, 0.0]], D=[[0.0, 1.0]], dt=1.0)

    plain, more = certified(errors(0.5, 1.2)), certified(errors(0.5, 1.2, 0.85, 0.5))
    assert more.level == plain.level
    assert more.decay == plain.decay
    gains: list[FloatArray] = [plain.gains[0], plain.gains[1], 0.5 * (plain.gains[0] + plain.gains[1]), plain.gains[0]]
    assert np.ravel(more.gains) == pytest.approx(np.ravel(gains), rel=1e-12)
    assert more.proof.proved


@pytest.mark.long
def test_a_gain_of_zero_and_a_first_decay_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = {"A": [["0.7 + 0.1 * v", 0.1], [0, 0.5]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0]], "Bd": [[0], [1]]}
    region: dict[str, Any] = {"scheduling": {"v": [-1, 1]}}
    notes = " ".join(obsynth.fault_estimation_filter(PolytopicSystem(plant={**plant, "dt": 1.0}, **region)).notes)
    assert "the gain is zero but for rounding" in notes
    assert "a faster one" not in notes
    monkeypatch.setattr("obsynth.methods.engines.vertex_certificates.MOST_FAST", 1)
    coupled = {**plant, "C": [[1, 0]], "Bf": [[1], [0.2]], "Bd": [[0.1], [0.3]], "dt": 1.0}
    notes = " ".join(obsynth.fault_estimation_filter(PolytopicSystem(plant=coupled, **region)).notes)
    assert "zero but for rounding" not in notes
    assert "a faster one at the same gain is not sought" in notes


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_the_decay_in_continuous_time_is_near_the_fastest_of_the_gains_in_any_unit_of_time(seed: int) -> None:
    given = _vertices(seed, None)
    design = obsynth.ui_pi_observer(_polytope(given))
    decay, observer = design.certificate.claims["region_decay"], design.scheduled[1]
    slowest = min(-np.linalg.eigvals(A).real.max() for A in observer.Az)
    n = observer.order
    closed = ErrorPolytope(list(observer.Az), np.zeros((0, n)), dt=0.0)
    fastest, _, _ = best_decay(closed, gains=[np.zeros((n, 0))], limit=slowest)
    assert 0.95 * fastest <= decay <= slowest
    milliseconds = obsynth.ui_pi_observer(_polytope([{**e, "A": 1e3 * e["A"], "Bf": 1e3 * e["Bf"]} for e in given]))
    assert milliseconds.certificate.claims["region_decay"] == pytest.approx(1e3 * decay, rel=0.02)
