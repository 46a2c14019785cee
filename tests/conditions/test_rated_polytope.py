"""Slow parameters in continuous time: published and exact limits, certificates that prove nothing else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from obsynth.conditions import ErrorPolytope, rated_inequalities, vertex_inequalities
from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.bernstein import coefficients_on_pieces, product_coefficients
from obsynth.proofs.rated_inequalities import prove_rated_decay, prove_rated_gain

#: dG - Gd of G = 1 / (s + 1) and |d| <= 1, which is at most the rate of d (Peni, Seiler: about 20 % at 0.2).
COMMUTATOR = ErrorPolytope(
    [-np.eye(2)] * 2, np.zeros((0, 2)), B=[[[1.0], [-1]], [[1.0], [1]]], Cz=[[[-1.0, -1]], [[1.0, -1]]], dt=0.0
)
NONE = [np.zeros((2, 0))]


def spring(b: float) -> ErrorPolytope:
    """Return x'' + x' + k x = 0 with k in [1, b]."""
    return ErrorPolytope([[[0, 1], [-1, -1]], [[0, 1], [-b, -1]]], np.zeros((0, 2)), dt=0.0)


def matrices(gains: dict[str, FloatArray], degree: int) -> list[FloatArray]:
    return [gains[f"P[{k + 1}]"] for k in range(degree + 1)]


def solved_gain(errors: ErrorPolytope, rate: float, degree: int, pieces: int) -> tuple[float, list[FloatArray]]:
    """Return the least gain, and P at a thousandth above it."""
    found = rated_inequalities(errors, rate, degree=degree, pieces=pieces, gains=NONE)
    found.solve()
    least = float(found.variables["gamma_squared"].value) ** 0.5
    found = rated_inequalities(errors, rate, degree=degree, pieces=pieces, gains=NONE, level=1.001 * least)
    found.solve()
    return least, matrices(found.gains(), degree)


def is_stable(b: float, rate: float, degree: int = 2, pieces: int = 4) -> bool:
    found = rated_inequalities(spring(b), rate, goal="decay", degree=degree, pieces=pieces, gains=NONE)
    found.solve()
    P = matrices(found.gains(), degree)
    return prove_rated_decay(spring(b).closed(NONE), P, rate, 0.0).proved


def test_weights_are_those_of_the_polynomials() -> None:
    rng, d = np.random.default_rng(0), 3
    P, M = rng.standard_normal(d + 1), rng.standard_normal(2)

    def basis(degree: int, t: float) -> FloatArray:
        return np.array([math.comb(degree, j) * t**j * (1 - t) ** (degree - j) for j in range(degree + 1)])

    found = product_coefficients(d, 4)
    for piece in range(4):
        own = found[piece * (d + 2) : (piece + 1) * (d + 2)]
        plain = [w for _, w in coefficients_on_pieces(d, 4)][piece * (d + 1) : (piece + 1) * (d + 1)]
        for share in (0.0, 0.3, 1.0):
            t = (piece + share) / 4
            local, slope = basis(d + 1, share), 1e-6
            product = sum(b * (at.low @ P * M[0] + at.high @ P * M[1]) for b, at in zip(local, own, strict=True))
            assert product / (d + 1) == pytest.approx(basis(d, t) @ P * (M[0] * (1 - t) + M[1] * t), abs=1e-12)
            moved = sum(b * at.slope @ P for b, at in zip(local, own, strict=True)) / own[0].scale
            numeric = (basis(d, t + slope) @ P - basis(d, t - slope) @ P) / (2 * slope)
            assert moved == pytest.approx(numeric, abs=1e-7)
            ends = sum(b * at.ends @ M for b, at in zip(local, own, strict=True)) / own[0].scale
            assert ends == pytest.approx(M[0] * (1 - t) + M[1] * t, abs=1e-12)
            value = sum(b * w @ P for b, w in zip(basis(d, share), plain, strict=True))
            assert value == pytest.approx(basis(d, t) @ P, abs=1e-12)


@pytest.mark.long
def test_commutator_of_a_slow_gain_is_about_its_rate() -> None:
    least, P = solved_gain(COMMUTATOR, 0.1, 3, 8)
    assert 0.19 < least < 0.22
    vertices = COMMUTATOR.closed(NONE)
    assert prove_rated_gain(vertices, P, 0.1, 1.001 * least).proved
    assert not prove_rated_gain(vertices, P, 0.12, 1.001 * least).proved
    assert not prove_rated_gain(vertices, P, 0.1, 0.9 * least).proved


def test_a_piece_of_paper_proves_one_gain_for_one_rate() -> None:
    least, P = solved_gain(COMMUTATOR, 0.1, 1, 2)
    vertices = COMMUTATOR.closed(NONE)
    assert 0.2 < least < 1.0
    assert prove_rated_gain(vertices, P, 0.1, 1.001 * least).proved
    assert not prove_rated_gain(vertices, P, 0.5, 1.001 * least).proved
    assert not prove_rated_gain(vertices, P, 0.1, 0.2).proved  # the truth is 0.1 to 0.2
    assert not prove_rated_gain(vertices, [P[0] + [[0, 1e-9], [0, 0]], P[1]], 0.1, 2.0).proved
    assert not prove_rated_gain(vertices, P[:1], 0.1, 0.9).proved  # one P: 1 is the least
    assert not prove_rated_gain([*vertices, vertices[0]], P, 0.1, 2.0).proved
    assert not prove_rated_gain(vertices, [-p for p in P], 0.1, 2.0).proved
    assert not prove_rated_gain(vertices, P, -0.1, 2.0).proved
    assert not prove_rated_gain(vertices, P, 0.1, -2.0).proved
    assert not prove_rated_gain(vertices, [p[:1, :1] for p in P], 0.1, 2.0).proved


def pumped(b: float) -> float:
    """Return what is left of the amplitude of x'' + x' + k x after half a turn of the worst switching of k in [1, b]:
    b while |x| falls, 1 while it grows."""
    slow, fast = math.sqrt(0.75), math.sqrt(b - 0.25)
    falling = (math.pi - math.atan(2 * fast)) / fast
    speed = -math.exp(-falling / 2) * b / fast * math.sin(fast * falling)
    rising = math.atan(2 * slow) / slow
    return abs(speed) / slow * math.exp(-rising / 2) * math.sin(slow * rising)


@pytest.mark.long
def test_a_slow_spring_is_stable_where_a_fast_one_is_not() -> None:
    limit = brentq(lambda b: pumped(b) - 1.0, 2.0, 60.0)
    assert limit == pytest.approx(6.7102, abs=1e-4)
    assert is_stable(6.0, 1.0)
    assert not is_stable(6.0, 200.0)
    assert not is_stable(1.02 * limit, 200.0)


def test_without_a_rate_nothing_is_gained_over_one_matrix() -> None:
    assert is_stable(3.9, 1e4, degree=1, pieces=1)
    assert not is_stable(4.1, 1e4, degree=1, pieces=1)
    assert is_stable(4.1, 0.1, degree=1, pieces=1)


def test_a_gain_that_changes_buys_more_where_the_parameter_is_slow() -> None:
    errors = ErrorPolytope(
        [[[0, 1], [-1, -0.1]], [[0, 1], [-6, -0.1]]], [[1.0, 0]], B=[[0.0, 0], [1, 0]], D=[[0.0, 1]], dt=0.0
    )
    any_course = vertex_inequalities(errors)
    any_course.solve()
    slow = rated_inequalities(errors, 0.1, degree=1, pieces=1)
    slow.solve()
    level = 1.001 * float(slow.variables["gamma_squared"].value) ** 0.5
    assert level < float(any_course.variables["gamma_squared"].value) ** 0.5
    assert slow.gains()["L[1]"].shape == (2, 1)


@pytest.mark.parametrize(
    ("errors", "options", "told"),
    [
        (ErrorPolytope([np.eye(2)] * 3, np.zeros((0, 2)), dt=0.0), {}, "two vertices"),
        (ErrorPolytope([np.eye(2)] * 2, np.zeros((0, 2)), dt=1.0), {}, "continuous time"),
        (COMMUTATOR, {"rate": -1.0}, "rate is"),
        (COMMUTATOR, {"rate": np.inf}, "rate is"),
        (COMMUTATOR, {"pieces": 3}, "power of two"),
        (COMMUTATOR, {"degree": 6}, "degree is"),
        (COMMUTATOR, {"decay": -1.0}, "decay is"),
        (ErrorPolytope([-np.eye(1)] * 2, [[[1.0]], [[2.0]]], dt=0.0), {}, "same C and D"),
    ],
)
def test_what_does_not_fit_is_refused(errors: ErrorPolytope, options: dict[str, float], told: str) -> None:
    arguments = {"rate": 0.1, **options}
    rate = arguments.pop("rate")
    with pytest.raises(SpecError, match=told):
        rated_inequalities(errors, rate, **arguments)  # type: ignore[arg-type]


def lag(rate: float = 1.0, gain: float = 0.5) -> ErrorPolytope:
    """Return e' = -rate e + w, z = gain e, at both vertices."""
    return ErrorPolytope([[[-rate]]] * 2, np.zeros((0, 1)), B=[[1.0]], D=np.zeros((0, 1)), Cz=[[gain]], dt=0.0)


def test_each_number_of_a_scalar_certificate_counts() -> None:
    vertices, none = lag().closed([np.zeros((1, 0))]), [np.zeros((1, 0))]
    one = [np.array([[1.0]])]
    # The gain of the lag is a half; P = 1/4 proves it.
    quarter = [np.array([[0.25]])] * 2
    assert prove_rated_gain(vertices, quarter, 0.0, 0.51).proved
    assert not prove_rated_gain(vertices, quarter, 0.0, 0.49).proved
    assert not prove_rated_gain(vertices, quarter, 0.0, 0.3).proved
    # Its decay is one.
    assert prove_rated_decay(vertices, one, 0.0, 0.99).proved
    assert not prove_rated_decay(vertices, one, 0.0, 1.01).proved
    # A P that grows with t proves nothing where t falls fast enough, and the other way round.
    growing = [np.array([[1.0]]), np.array([[4.0]])]
    assert prove_rated_decay(vertices, growing, 0.5, 0.0).proved
    assert not prove_rated_decay(vertices, growing, 2.0, 0.0).proved
    assert not prove_rated_decay(vertices, growing[::-1], 2.0, 0.0).proved
    # A negative P beside an unstable error satisfies the other inequality.
    unstable = lag(-1.0).closed(none)
    assert not prove_rated_decay(unstable, [np.array([[-1.0]])], 0.0, 0.0).proved
