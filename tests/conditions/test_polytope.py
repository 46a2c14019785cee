"""Vertex inequalities against closed forms, and their proofs against brute force."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from obsynth.conditions import ErrorPolytope, vertex_inequalities
from obsynth.conditions.polytope import witness_of
from obsynth.errors import SolverError, SpecError
from obsynth.methods.engines.fastest_decay import fastest_allowed_decay
from obsynth.methods.engines.vertex_certificates import best_decay, certified
from obsynth.proofs.vertex_inequalities import Witness, pairs_of, prove_decay, prove_gain, prove_mean_square
from obsynth.verification.over_region import worst_switching

_NO_GAIN = [np.zeros((2, 0))]


def _scalar(*poles: float) -> ErrorPolytope:
    return ErrorPolytope([[[a]] for a in poles], [[1.0]], B=[[1.0, 0.0]], D=[[0.0, 1.0]])


def _spring(b: float) -> ErrorPolytope:
    return ErrorPolytope([[[0, 1], [-1, -1]], [[0, 1], [-b, -1]]], np.zeros((0, 2)), dt=0.0)


def _least(errors: ErrorPolytope, name: str = "gamma_squared", **options: Any) -> float:
    found = vertex_inequalities(errors, **options)
    found.solve()
    return float(found.variables[name].value)


def test_scalar_gain_is_that_of_the_worst_pole() -> None:
    gains = np.linspace(0.5, 1.5, 400_001)
    truth = np.min(np.sqrt(1 + gains**2) / (1 - np.minimum(np.abs(1.2 - gains), 0.999999)))
    errors = _scalar(0.5, 0.9, 1.2)
    assert np.sqrt(_least(errors)) == pytest.approx(truth, rel=1e-6)
    made = certified(errors)
    assert made.level == pytest.approx(truth, rel=1e-3)
    assert made.level > truth
    closed = errors.closed(made.gains)
    assert not prove_gain(closed, made.witness, 0.999 * truth, discrete=True).proved


def test_scalar_mean_square_is_that_of_the_kalman_filter() -> None:
    errors = _scalar(0.5, 0.9, 1.2)
    truth = float(max(np.roots([1, -(1.2**2), -1])))
    assert _least(errors, "mean_square", goal="power") == pytest.approx(truth, rel=1e-6)
    made = certified(errors, goal="power")
    assert truth < made.level**2 < 1.01 * truth
    assert not prove_mean_square(errors.closed(made.gains), made.witness, np.sqrt(0.99 * truth), discrete=True).proved


def test_growth_of_two_matrices_is_the_golden_ratio() -> None:
    errors = ErrorPolytope([[[1, 1], [0, 1]], [[1, 0], [1, 1]]], np.zeros((0, 2)))
    rate, witness, gains = best_decay(errors, gains=_NO_GAIN, slowest=2.0)
    assert 0.0 <= rate - (1 + 5**0.5) / 2 < 2e-3
    assert not prove_decay(errors.closed(gains), witness, 1.617, discrete=True).proved


@pytest.mark.long
def test_frozen_stability_is_not_stability_over_the_region() -> None:
    rate, _, _ = best_decay(_spring(3.99), gains=_NO_GAIN)
    assert rate >= 0.0
    with pytest.raises(SolverError, match="no proof that there is none"):
        best_decay(_spring(4.01), gains=_NO_GAIN)


def _daafouz(a: float) -> ErrorPolytope:
    A0 = np.array([[0.8, -0.25, 0, 1], [1, 0, 0, 0], [0, 0, 0.2, 0.03], [0, 0, 1, 0]])
    turned = np.outer([0, 0, 1.0, 0], [0.8, -0.5, 0, 1])
    return ErrorPolytope([A0 - a * turned, A0 + a * turned], np.zeros((0, 4)))


@pytest.mark.one_in(5)
@pytest.mark.parametrize(("a", "lyapunov", "stable"), [
    (0.42, "common", True), (0.44, "common", False), (0.44, "vertex", True), (0.46, "vertex", True),
    (0.463, "vertex", False),
])  # fmt: skip
def test_a_matrix_at_each_vertex_proves_more(a: float, lyapunov: str, stable: bool) -> None:
    # Frozen, the plant is stable to 0.46200 (Daafouz, Bernussou 2001: 0.4619 by P at each vertex).
    found = vertex_inequalities(_daafouz(a), goal="decay", decay=1.0, lyapunov=lyapunov, gains=[np.zeros((4, 0))])
    found.solve()
    witness, gains = witness_of(_daafouz(a), found)
    assert prove_decay(_daafouz(a).closed(gains), witness, 1.0, discrete=True).proved is stable


def test_commutator_has_gain_one() -> None:
    B, Cz = [np.array([[1.0], [-1]]), np.array([[1.0], [1]])], [np.array([[-1.0, -1]]), np.array([[1.0, -1]])]
    errors = ErrorPolytope([-np.eye(2)] * 2, np.zeros((0, 2)), B=B, Cz=Cz, dt=0.0)
    made = certified(errors, gains=_NO_GAIN)
    assert 1.0 <= made.level < 1.001


def test_flexible_joint_has_no_limit_by_one_atom() -> None:
    A = np.array([[0, 1, 0, 0], [-48.6, -1.25, 48.6, 0], [0, 0, 0, 1], [19.5, 0, -19.5, 0]])
    turned = np.outer(np.eye(4)[3], np.eye(4)[2])
    B, D = np.hstack([np.eye(4) * 0.3, np.zeros((4, 2))]), np.hstack([np.zeros((2, 4)), np.eye(2) * 0.03])
    errors = ErrorPolytope([A - 3.33 * turned, A + 3.33 * turned], np.eye(4)[:2], B=B, D=D, dt=0.0)
    made = certified(errors, goal="power", decay=1.0, gain="constant")
    assert made.decay == 1.0
    assert np.linalg.norm(made.gains[0]) < 100.0


@pytest.mark.long
def test_descriptor_inequality_is_tighter_than_the_hull_of_the_reduced_map() -> None:
    A11, A12 = np.array([[-1.0, 0.5], [0, 0.2]]), np.array([[0.6, 0, 0.2], [0, 0.5, 0.5]])
    A21, C = np.array([[1.0, 0], [0, 1], [0.5, 0.5]]), np.array([[1.0, 0]])

    def A22(g: tuple[float, ...]) -> np.ndarray:
        return -np.array([[g[0] + g[1], -g[1], 0], [-g[1], g[1] + g[2], -g[2]], [0, -g[2], g[2] + g[3]]])

    corners = list(itertools.product((1.0, 3.0), repeat=4))

    def driven(n: int) -> dict[str, Any]:
        return {"B": np.hstack([np.eye(n, 2), np.zeros((n, 1))]), "D": [[0, 0, 0.3]], "Cz": np.eye(2, n), "dt": 0.0}

    full = ErrorPolytope(
        [np.block([[A11, A12], [A21, A22(g)]]) for g in corners], np.hstack([C, np.zeros((1, 3))]), differential=2,
        **driven(5),
    )  # fmt: skip
    reduced = [A11 - A12 @ np.linalg.solve(A22(g), A21) for g in corners]
    made = certified(full, gain="constant")
    assert made.least == pytest.approx(1.9598, abs=1e-3)
    assert certified(ErrorPolytope(reduced, C, **driven(2)), gain="constant").least <= made.least * 1.0001
    # The same certificate with a wrong structure proves nothing.
    other = Witness([np.eye(5)], [np.eye(5)], None, 0.0, 2)
    assert not prove_gain(full.closed(made.gains), other, 10.0, discrete=False).proved


def test_measured_scheduling_is_not_estimated_scheduling() -> None:
    # x' = (x - 2) x + u on [0, 1.9]: "A(x)" decays, the Jacobian 2 x - 2 does not.
    for ends, decays in (((-2.0, -0.1), True), ((-2.0, 1.8), False)):
        errors = ErrorPolytope([[[a]] for a in ends], np.zeros((0, 1)), dt=0.0)
        found = vertex_inequalities(errors, goal="decay", decay=0.05, gains=[np.zeros((1, 0))])
        found.solve()
        assert (
            prove_decay(errors.closed([np.zeros((1, 0))]), witness_of(errors, found)[0], 0.05, discrete=False).proved
            is decays
        )


def _random(seed: int, count: int = 2, n: int = 3) -> ErrorPolytope:
    rng = np.random.default_rng(seed)
    A = [rng.standard_normal((n, n)) for _ in range(count)]
    middle = sum(A) / count
    A = [middle + 0.4 * (a - middle) for a in A]
    size = max(abs(np.linalg.eigvals(a)).max() for a in A)
    B = np.hstack([rng.standard_normal((n, 2)), np.zeros((n, 1))])
    return ErrorPolytope([1.1 * a / size for a in A], np.eye(1, n), B=B, D=[[0, 0, 0.5]], Cz=np.eye(2, n))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(6))
def test_no_switching_exceeds_what_is_proved(seed: int) -> None:
    errors = _random(seed)
    try:
        made = certified(errors)
    except SolverError:
        pytest.skip("no common certificate")
    closed = [errors.at(weights, made.gains) for weights in np.eye(errors.count)]
    found = worst_switching(closed, horizon=24, starts=4)
    assert found <= made.level
    assert found >= 0.8 * made.level
    assert prove_decay(errors.closed(made.gains), made.witness, made.decay, discrete=True).proved


@pytest.mark.long
def test_slow_parameters_allow_a_smaller_gain_and_the_pairs_are_a_hexagon() -> None:
    fast, slow = (certified(_random(11), lyapunov="vertex", steps=steps).level for steps in (None, 0.05))
    assert slow < fast
    assert len(pairs_of(2, 0.1)) == 6
    assert len(pairs_of(2, None)) == 4
    assert len(pairs_of(2, 1.0)) == 4
    for now, then in pairs_of(2, 0.1):
        assert abs(now[1] - then[1]) <= 0.1 + 1e-15
    with pytest.raises(SpecError, match="two vertices"):
        pairs_of(3, 0.1)


def test_a_remainder_beside_a_is_covered() -> None:
    rng, errors = np.random.default_rng(4), _random(1)
    wide = ErrorPolytope(
        errors.A, list(errors.C), B=list(errors.B), D=list(errors.D), Cz=list(errors.Cz), Dz=list(errors.Dz), ball=0.05
    )
    made = certified(wide)
    assert made.level > certified(errors).level
    closed = [errors.at(weights, made.gains) for weights in np.eye(2)]
    worst = 0.0
    for _ in range(200):
        u, _, v = np.linalg.svd(rng.standard_normal((3, 3)))
        worst = max(worst, worst_switching([(M + 0.05 * u @ v, *rest) for M, *rest in closed], horizon=10, starts=0))
    assert worst <= made.level
    assert not prove_gain(wide.closed(made.gains), made.witness, made.level, discrete=True, ball=0.2).proved


def test_what_cannot_be_asked_is_refused() -> None:
    errors = _random(0)
    turning = ErrorPolytope(errors.A, [np.eye(1, 3), 2 * np.eye(1, 3)])
    with pytest.raises(SpecError, match="constant"):
        vertex_inequalities(turning)
    with pytest.raises(SpecError, match="Give one gain"):
        turning.closed([np.zeros((3, 1))] * 2)
    with pytest.raises(SpecError, match="2 vertices, A at 3"):
        ErrorPolytope([np.eye(2)] * 3, [np.eye(2)] * 2)
    with pytest.raises(SpecError, match="discrete time"):
        vertex_inequalities(_spring(2.0), steps=0.1)
    with pytest.raises(SpecError, match="needs the rate"):
        vertex_inequalities(errors, goal="decay")
    with pytest.raises(SpecError, match="all differential"):
        ErrorPolytope([-np.eye(2)], np.zeros((0, 2)), dt=0.0, differential=1, ball=0.1)


def test_in_continuous_time_one_gain_is_enough_and_it_is_small() -> None:
    # A lightly damped spring, k in [1, 6]: .8803 for any course (measured position).
    A = [[[0, 1], [-k, -0.4]] for k in (1.0, 6.0)]
    B, D = [[0, 0], [1.0, 0]], [[0, 0.1]]
    errors = ErrorPolytope(A, [[1.0, 0]], B=B, D=D, dt=0.0)
    made = certified(errors)
    assert len(made.gains) == 1
    assert np.linalg.norm(made.gains[0]) < 1e5
    assert made.level <= 1.001 * made.least


#: The flexible joint (Raghavan, Hedrick): states in radians and radians per second.
JOINT = np.array([[0, 1, 0, 0], [-48.6, -1.25, 48.6, 0], [0, 0, 0, 1], [19.5, 0, -19.5, 0.0]])


@pytest.mark.parametrize(("unit", "limit"), [(0.1, 10.0), (1.0, 1.0)])
def test_a_lipschitz_condition_depends_on_units(unit: float, limit: float) -> None:
    """Any term with a Lipschitz constant below the distance to unobservability, and none above, by units of x4."""
    turned = np.diag([1, 1, 1, unit]) @ JOINT @ np.diag([1, 1, 1, 1 / unit])

    def proved(constant: float) -> bool:
        errors = ErrorPolytope([turned], np.eye(2, 4), dt=0.0, ball=constant)
        try:
            _, witness, gains = best_decay(errors, limit=1e5)
        except SolverError:
            return False
        vertices = errors.closed(gains)
        assert not prove_decay(vertices, witness, 0.0, discrete=False, ball=1.5 * limit).proved
        return prove_decay(vertices, witness, 0.0, discrete=False, ball=constant).proved

    unseen = np.eye(4)[:, 2:]
    distance = min(
        np.linalg.svd((turned - 1j * w * np.eye(4)) @ unseen, compute_uv=False)[-1]
        for w in [0.0, *np.logspace(-4, 4, 2001)]
    )
    assert distance == pytest.approx(limit, rel=1e-3)
    assert proved(0.9 * limit)
    assert not proved(1.001 * limit)


def test_a_remainder_in_continuous_time_is_covered() -> None:
    """``x' = -a x + r x + w`` with ``|r| <= rho``: the gain is ``1 / (a - rho)``."""
    errors = ErrorPolytope([[[-2.0]]], np.zeros((0, 1)), B=[[1.0]], D=np.zeros((0, 1)), dt=0.0, ball=0.5)
    made = certified(errors, gains=[np.zeros((1, 0))])
    assert made.level == pytest.approx(1.0 / 1.5, rel=2e-3)
    assert made.level > 1.0 / 1.5
    vertices = errors.closed(made.gains)
    assert prove_gain(vertices, made.witness, made.level, discrete=False, ball=0.5).proved
    assert not prove_gain(vertices, made.witness, made.level, discrete=False, ball=0.55).proved


@pytest.mark.parametrize("dt", [0.0, 1.0])
def test_the_fastest_decay_of_a_matrix_is_where_its_proof_ends(dt: float) -> None:
    errors = ErrorPolytope([[[0.3, 0.2], [-0.1, 0.4]], [[0.1, 0.5], [0.0, 0.2]]], np.zeros((0, 2)), dt=dt)
    errors = errors if dt else ErrorPolytope([a - np.eye(2) for a in errors.A], np.zeros((0, 2)), dt=dt)
    witness = Witness([np.array([[1.0, 0.1], [0.1, 2.0]])])
    rate = fastest_allowed_decay(errors, _NO_GAIN, witness)
    assert rate is not None
    closed, room = errors.closed(_NO_GAIN), 1e-9 * (1.0 if dt else -1.0)
    assert prove_decay(closed, witness, rate + room, discrete=dt > 0.0).proved
    assert not prove_decay(closed, witness, rate - room, discrete=dt > 0.0).proved
