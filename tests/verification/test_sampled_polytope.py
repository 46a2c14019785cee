"""Samples of a continuous polytope: what they miss is below the bound, and a decay with the bound is a decay."""

from __future__ import annotations

import itertools
import math

import flint
import numpy as np
import pytest
import scipy.linalg

import obsynth
from obsynth import PreconditionError, SpecError
from obsynth.conditions import ErrorPolytope, drift_within_samples, sampled_polytope, vertex_inequalities
from obsynth.conditions.polytope import witness_of
from obsynth.proofs.vertex_inequalities import prove_decay

DT = 0.1


def _spring() -> ErrorPolytope:
    return ErrorPolytope([[[0, 1], [-1, -1]], [[0, 1], [-3, -1]]], [[1.0, 0.0]], dt=0.0)


def _at(errors: ErrorPolytope, weights: np.ndarray) -> np.ndarray:
    return np.tensordot(weights, np.array(errors.A), axes=1)


def _missed(errors: ErrorPolytope, sampled: ErrorPolytope, weights: np.ndarray) -> float:
    exact = scipy.linalg.expm(sampled.dt * _at(errors, weights))
    return float(np.linalg.norm(exact - _at(sampled, weights), 2))


def test_the_spring_misses_less_than_the_bound_and_its_decay_is_proved() -> None:
    errors, sampled = _spring(), sampled_polytope(_spring(), DT)
    missed = max(_missed(errors, sampled, np.array([1 - m, m])) for m in np.linspace(0, 1, 101))
    assert missed == pytest.approx(0.00016, abs=1e-5)
    assert sampled.ball == pytest.approx(0.0053, abs=5e-5)
    found = vertex_inequalities(sampled, goal="decay", decay=0.8, gain_limit=1e3)
    found.solve()
    witness, gains = witness_of(sampled, found)
    closed = sampled.closed(gains)
    assert prove_decay(closed, witness, 0.8, discrete=True, ball=sampled.ball).proved
    assert not prove_decay(closed, witness, 0.8, discrete=True, ball=20 * sampled.ball).proved
    # Errors of an observer that steps by the exact transition, for a wild course of the parameter.
    rng, error = np.random.default_rng(0), np.array([1.0, -1.0])
    start = error @ witness.P[0] @ error
    for k in range(1, 31):
        m = float(rng.integers(0, 2)) if k % 3 else rng.random()
        weights = np.array([1 - m, m])
        gain = sum(w * g for w, g in zip(weights, gains if len(gains) == 2 else gains * 2, strict=True))
        error = (scipy.linalg.expm(DT * _at(errors, weights)) - gain @ errors.C[0]) @ error
        assert error @ witness.P[0] @ error <= start * 0.8 ** (2 * k) * (1 + 1e-12)


def test_a_parameter_that_moves_within_samples_has_a_bound_of_its_own() -> None:
    errors, steps, speed = _spring(), 200, 2.0
    moved = np.eye(2)
    for k in range(steps):
        m = speed * DT * (k + 0.5) / steps
        moved = scipy.linalg.expm(DT / steps * _at(errors, np.array([1 - m, m]))) @ moved
    missed = float(np.linalg.norm(moved - scipy.linalg.expm(DT * errors.A[0]), 2))
    bound = drift_within_samples(errors, DT, rate=speed * 2.0)
    assert missed == pytest.approx(0.0193, abs=1e-4)
    assert missed < bound
    assert bound == pytest.approx(0.0213, abs=1e-4)


@pytest.mark.parametrize("seed", range(12))
def test_no_point_of_a_random_hull_misses_more_than_the_bound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, count, dt = int(rng.integers(1, 5)), int(rng.integers(2, 6)), float(rng.choice([0.01, 0.1, 0.5]))
    errors = ErrorPolytope(list(rng.normal(size=(count, n, n))), np.ones((1, n)), dt=0.0)
    sampled = sampled_polytope(errors, dt)
    points = [np.bincount(pair, minlength=count) / 2.0 for pair in itertools.combinations(range(count), 2)]
    points += list(rng.dirichlet(np.ones(count), size=50))
    worst = max(_missed(errors, sampled, weights) for weights in points)
    assert worst <= sampled.ball
    # A quarter of the second difference is what the middle of two vertices misses: the bound is of that size.
    assert worst > 1e-3 * sampled.ball
    for matrix, vertex in zip(sampled.A, errors.A, strict=True):
        assert np.allclose(matrix, scipy.linalg.expm(dt * vertex), rtol=1e-12, atol=1e-13)


def test_one_vertex_has_rounding_alone_beside_it() -> None:
    found = sampled_polytope(ErrorPolytope([[[0, 1], [-2, -3]]], [[1.0, 0.0]], dt=0.0), 0.2)
    assert 0.0 < found.ball < 1e-12
    assert found.A[0][0, 0] == pytest.approx(2 * math.exp(-0.2) - math.exp(-0.4), rel=1e-12)


@pytest.mark.parametrize(
    ("errors", "dt", "told"),
    [
        (ErrorPolytope([[[0.5]]], [[1.0]], dt=1.0), 0.1, "sampled already"),
        (ErrorPolytope(np.array([[[-1.0, 1], [0, -1]]]), [[1.0, 0]], dt=0.0, differential=1), 0.1, "Algebraic errors"),
        (ErrorPolytope([[[-1.0]]], [[1.0]], B=[[1.0]], D=[[0.0]], dt=0.0), 0.1, "Inputs of the errors"),
        (ErrorPolytope([[[-1.0]]], [[1.0]], dt=0.0), 0.0, "dt"),
        (ErrorPolytope([[[-1.0]]], [[1.0]], dt=0.0), float("nan"), "dt"),
        (ErrorPolytope([[[900.0]], [[901.0]]], [[1.0]], dt=0.0), 1.0, "smaller dt"),
        (ErrorPolytope([[[500.0]], [[501.0]]], [[1.0]], dt=0.0), 1.0, "smaller dt"),
        (ErrorPolytope([[[-1e200]], [[-1.0]]], [[1.0]], dt=0.0), 1.0, "smaller dt"),
    ],
)
def test_what_has_no_samples_here_is_refused(errors: ErrorPolytope, dt: float, told: str) -> None:
    with pytest.raises(SpecError, match=told):
        sampled_polytope(errors, dt)


def test_a_drift_without_a_finite_bound_is_refused() -> None:
    growing = ErrorPolytope([[[900.0]], [[901.0]]], [[1.0]], dt=0.0)
    assert drift_within_samples(growing, 1e-3, 1.0) < 1e-5
    with pytest.raises(SpecError, match="smaller dt"):
        drift_within_samples(growing, 1.0, 1.0)
    with pytest.raises(SpecError, match="finite square"):
        ErrorPolytope([[[0.5]]], [[1.0]], ball=1e200)


@pytest.mark.long
def test_a_continuous_plant_over_a_region_is_not_told_to_be_sampled() -> None:
    plant = obsynth.PolytopicSystem(
        plant={
            "A": [[0, 1], ["-k", -1]], "C": [[1, 0], [0, 1]], "Bf": [[0], [1]], "fault_names": ["push"],
            "state_names": ["x", "v"],
        },
        scheduling={"k": [1.0, 3.0]},
    )  # fmt: skip
    with pytest.raises(PreconditionError, match=r"no vertices.*ui_pi_observer"):
        obsynth.discretise(plant, 0.1)
    with pytest.raises(PreconditionError, match=r"discrete time.*Take ui-pi-observer") as caught:
        obsynth.fault_estimation_filter(plant)
    assert "obsynth.discretise" not in str(caught.value)
    # What is printed was tried.
    assert obsynth.ui_pi_observer(plant).report.passed


def test_the_rounding_of_a_times_dt_is_in_the_remainder() -> None:
    """A lone vertex has no other remainder: e^(A dt) in many digits lies within it, A dt formed exactly."""
    rng, dt = np.random.default_rng(50), 0.1
    for _ in range(5):
        a = rng.normal(size=(2, 2))
        sampled = sampled_polytope(ErrorPolytope([a], [[1.0, 0.0]], dt=0.0), dt)
        with flint.ctx.workprec(300):
            exact = flint.arb_mat(2, 2, [flint.arb(float(x)) * flint.arb(dt) for x in a.ravel()]).exp()
            missed = [abs(exact[i, j] - flint.arb(float(sampled.A[0][i, j]))) for i in range(2) for j in range(2)]
            assert sum((m * m for m in missed), flint.arb(0)) < flint.arb(float(sampled.ball)) ** 2
        # What one rounding of each product moves the exponential by.
        least = 2.0**-54 * np.linalg.norm(dt * a) * np.exp(-np.linalg.norm(dt * a))
        assert sampled.ball > least
