"""Riccati equations of filters: against SciPy's solver and against what the equation says."""

from dataclasses import replace
from functools import cache

import mpmath
import numpy as np
import pytest
from scipy.linalg import block_diag, solve_continuous_are, solve_discrete_are

from obsynth.numerics.central_equation import CentralEquation, Whitened, central_injection
from obsynth.numerics.central_filter import NOISE_WEIGHTS, central_filter_at, placed_filters, search_central_filter
from obsynth.numerics.doubling import continuous_riccati_solution, doubled_riccati_solution
from obsynth.numerics.gain_levels import compared_gain
from obsynth.numerics.injection_problem import GainProblem, Injection
from obsynth.numerics.matrix_equations import bounded_real_matrix
from obsynth.numerics.norms import hinf_norm, largest_peak, spectral_radius
from obsynth.numerics.thin_doubling import FIRST_POWER, RankWatch


def random_problem(rng, n=5, m=2, q=1, nd=3, free_weight=False):
    a = rng.normal(size=(n, n))
    return GainProblem(
        A=1.2 * a / spectral_radius(a),
        C=rng.normal(size=(m, n)),
        Z=rng.normal(size=(q, n)),
        B=rng.normal(size=(n, nd)),
        D=rng.normal(size=(m, nd)),
        Zd=0.2 * rng.normal(size=(q, nd)),
        Bn=np.zeros((n, m)),
        Dn=-np.eye(m),
        Zn=np.zeros((q, m)),
        free_weight=free_weight,
    )


@pytest.mark.parametrize("level", [np.inf, 8.0])
def test_doubling_agrees_with_scipy(level):
    rng = np.random.default_rng(1)
    for _ in range(20):
        n, p = 6, 3
        a, h, b = rng.normal(size=(n, n)), rng.normal(size=(p, n)), rng.normal(size=(n, n))
        k = rng.normal(size=(p, n))
        weight = k @ k.T + np.diag([0.1, 0.1, 0.1 if level == np.inf else -((level * 10.0) ** 2)])
        found = doubled_riccati_solution(a, h, b @ b.T, weight, b @ k.T)
        expected = solve_discrete_are(a.T, h.T, b @ b.T, weight, s=b @ k.T)
        assert found is not None
        assert np.linalg.norm(found - expected) <= 1e-8 * np.linalg.norm(expected)


@pytest.mark.parametrize("n", [1, 4, 40])
def test_doubling_agrees_with_scipy_in_continuous_time(n):
    rng = np.random.default_rng(n)
    for _ in range(10):
        a, c, b = rng.normal(size=(n, n)), rng.normal(size=(max(n // 2, 1), n)), rng.normal(size=(n, n))
        measured = 10.0 ** rng.uniform(-1.0, 1.0) * np.eye(len(c))
        found = continuous_riccati_solution(a, c, b @ b.T, measured)
        expected = solve_continuous_are(a.T, c.T, b @ b.T, measured)
        assert np.linalg.norm(found - expected) <= 1e-8 * np.linalg.norm(expected)


def test_doubling_in_continuous_time_gives_nothing_that_is_stable_for_what_is_not_seen():
    # x grows and nothing is measured of it: no stabilising solution.
    found = continuous_riccati_solution(np.diag([1.0, -1.0]), np.array([[0.0, 1.0]]), np.eye(2), np.eye(1))
    assert found is None


def test_doubling_says_so_when_there_is_no_solution():
    # x grows and nothing is measured of it.
    assert doubled_riccati_solution(2.0 * np.eye(1), np.zeros((1, 1)), np.eye(1), np.eye(1), np.zeros((1, 1))) is None


@pytest.mark.parametrize("seed", range(4))
def test_the_heaviest_noise_is_the_same_wherever_its_search_begins(seed):
    problem = random_problem(np.random.default_rng([52, seed]))
    level = 2.0 * search_central_filter(problem, central_injection(problem, 1e6, noise=1e-1))[1]

    def found(near):
        return [*placed_filters(problem, level, reaches=lambda item: problem.achieved_gain(item) <= level, near=near)]

    usual = found(None)
    assert usual
    assert 0 < usual[0][0] < len(NOISE_WEIGHTS) - 1
    for near in (0, usual[0][0], len(NOISE_WEIGHTS) - 1):
        for (place, injection), (other_place, other) in zip(found(near), usual, strict=True):
            assert place == other_place
            np.testing.assert_array_equal(injection.R, other.R)


@pytest.mark.parametrize("free_weight", [False, True])
def test_central_filter_meets_its_level_and_none_exists_far_below(free_weight):
    rng = np.random.default_rng(2)
    for _ in range(10):
        problem = random_problem(rng, free_weight=free_weight)
        start = central_injection(problem, 1e6, noise=1e-1)
        assert start is not None
        best, gain = search_central_filter(problem, start)
        a, b, z, zd = problem.closed_loop(best)
        assert spectral_radius(a) < 1.0
        assert hinf_norm(a, b, z, zd).upper == gain
        for level in (1.0001 * gain, 2.0 * gain, 100.0 * gain):
            found = central_filter_at(problem, level)
            assert found is not None
            assert problem.achieved_gain(found) < level
        assert central_filter_at(problem, 0.999 * gain) is None


def test_a_fixed_weight_is_left_alone():
    problem = random_problem(np.random.default_rng(3))
    found = central_injection(problem, 1e3, noise=1e-2)
    assert isinstance(found, Injection)
    assert not np.any(found.V)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("n", [1, 4, 30])
def test_the_equation_tells_levels_above_the_norm_from_levels_below(n):
    rng = np.random.default_rng(n)
    for _ in range(20):
        a = rng.normal(size=(n, n))
        a *= rng.uniform(0.3, 0.99) / spectral_radius(a)
        b, c, d = rng.normal(size=(n, 3)), rng.normal(size=(2, n)), rng.normal(size=(2, 3))
        norm = hinf_norm(a, b, c, d).value
        assert compared_gain(a, b, c, d, 1.00001 * norm)
        assert not compared_gain(a, b, c, d, 0.9999 * norm)


def test_many_states_are_judged_as_few_are():
    problem = random_problem(np.random.default_rng(5), n=70, m=8, nd=6)
    start = central_injection(problem, 1e6, noise=1e-1)
    best, bound = search_central_filter(problem, start)
    gain = problem.achieved_gain(best)
    assert gain <= bound * (1.0 + 1e-6)
    # At its optimum the response is flat, and the equation is singular at every frequency.
    assert bound <= 1.005 * gain
    assert problem.reaches(best, 1.005 * gain)
    assert not problem.reaches(best, 0.999 * gain)


@pytest.mark.parametrize("free_weight", [False, True])
@pytest.mark.parametrize(("m", "nd"), [(1, 1), (2, 3), (5, 2)])
def test_exact_measurements_need_fewer_states(free_weight, m, nd):
    """Without the disturbance in a measurement, the small equation's solution is that of the one in all states."""
    rng, noise = np.random.default_rng([6, m, nd]), 1e-3
    for _ in range(5):
        problem = random_problem(rng, n=6, m=m, nd=nd, free_weight=free_weight)
        problem = replace(problem, D=np.zeros((m, nd)), Zd=np.zeros((1, nd)))
        equation, level = CentralEquation.of(problem, noise=noise), 1e3 * problem.disturbance_size
        assert equation.a.shape == (6 - m, 6 - m)
        hidden = equation.solution(level)
        assert hidden is not None
        process = problem.B @ problem.B.T + (noise * np.linalg.norm(problem.B, 2)) ** 2 * np.eye(6)
        y = hidden + process
        h = np.vstack([problem.C, problem.Z])
        total = h @ y @ h.T - np.diag([0.0] * m + [level**2])
        through = problem.A @ y @ h.T
        right = problem.A @ y @ problem.A.T - through @ np.linalg.solve(total, through.T) + process
        assert np.linalg.norm(y - right) <= 1e-9 * np.linalg.norm(problem.A @ y @ problem.A.T)
        found, margin = equation.filter_and_margin(level)
        assert problem.achieved_gain(found) < level
        assert 0.0 < margin < 1.0


@pytest.mark.parametrize("noise", [1e-6, 1e-8, 1e-10])
def test_what_measurements_leave_of_a_disturbance_that_they_show_is_told_to_its_digits(noise):
    """The disturbance is in three measurements but for the noise: what is left of it is the square of that."""
    rng = np.random.default_rng(11)
    b, d, zd = rng.normal(size=(4, 2)), rng.normal(size=(3, 2)), rng.normal(size=(1, 2))
    white = Whitened.of(d, noise, b, zd)
    with mpmath.workdps(60):
        B, D = mpmath.matrix(b.tolist()), mpmath.matrix(d.tolist())
        left = B * B.T - B * D.T * (D * D.T + mpmath.mpf(noise) ** 2 * mpmath.eye(3)) ** -1 * D * B.T
        exact = np.array((left / mpmath.mpf(noise) ** 2).tolist(), dtype=float)
    # U is orthonormal to 1e-15, and what is looked for of the size of the noise.
    found = white.state_left @ white.state_left.T / noise**2
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=1e-14 / noise * np.abs(exact).max())
    both = np.hstack([d, noise * np.eye(3)])
    np.testing.assert_allclose(white.factor @ white.factor.T, both @ both.T, atol=1e-14)
    np.testing.assert_allclose(white.known @ white.factor.T, b @ d.T, atol=1e-14)


def test_the_margin_vanishes_at_the_least_level():
    rng = np.random.default_rng(7)
    for _ in range(5):
        problem = random_problem(rng, n=6, m=2, nd=2)
        problem = replace(problem, D=np.zeros((2, 2)), Zd=np.zeros((1, 2)))
        equation = CentralEquation.of(problem, noise=1e-6)
        _, least = search_central_filter(problem, central_injection(problem, 1e6, noise=1e-1))
        margins = [equation.filter_and_margin(least * (1.0 + share))[1] for share in (1e-2, 1e-3, 1e-4)]
        assert margins[0] == pytest.approx(10.0 * margins[1], rel=0.2)
        assert margins[1] == pytest.approx(10.0 * margins[2], rel=0.2)
        assert equation.filter_and_margin(least * (1.0 - 1e-4))[0] is None


def test_a_level_far_below_the_norm_is_refuted_and_not_left_open():
    rng = np.random.default_rng(8)
    for _ in range(20):
        a = rng.normal(size=(8, 8))
        a *= 0.9 / spectral_radius(a)
        b, c, d = rng.normal(size=(8, 3)), rng.normal(size=(2, 8)), rng.normal(size=(2, 3))
        norm = hinf_norm(a, b, c, d).value
        assert compared_gain(a, b, c, d, 1.01 * norm) is True
        assert compared_gain(a, b, c, d, 0.5 * norm) is False


def test_a_level_that_is_exceeded_in_finitely_many_steps_has_no_certificate_and_asks_no_second_solver(monkeypatch):
    asked = []
    monkeypatch.setattr("scipy.linalg.solve_discrete_are", lambda *args, **options: asked.append(1))
    rng = np.random.default_rng(9)
    for n in (3, 12):
        for _ in range(10):
            a = rng.normal(size=(n, n))
            a *= 0.9 / spectral_radius(a)
            b, c, d = rng.normal(size=(n, 2)), rng.normal(size=(2, n)), 0.1 * rng.normal(size=(2, 2))
            norm = hinf_norm(a, b, c, d).value
            assert bounded_real_matrix(a, b, c, d, 0.9 * norm, slack=1e-6 * norm**2) is None
            p = bounded_real_matrix(a, b, c, d, 1.1 * norm, slack=1e-8)
            left = (1.1 * norm) ** 2 * np.eye(2) - d.T @ d - b.T @ p @ b
            through = a.T @ p @ b + c.T @ d
            rest = p - a.T @ p @ a - c.T @ c - through @ np.linalg.solve(left, through.T)
            assert np.linalg.eigvalsh(left)[0] > 0.0
            assert np.linalg.eigvalsh(0.5 * (rest + rest.T))[0] > 0.0
    assert asked == []


@cache
def slow_and_fast(level):
    """Return an equation of 240 states, of which six are slow, and its solution."""
    rng = np.random.default_rng(3)
    n, p = 240, 4
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    a = turn @ np.diag(np.concatenate([0.9999 - 0.002 * np.arange(6), np.linspace(-0.9, 0.9, n - 6)])) @ turn.T
    h, b = rng.normal(size=(p, n)), rng.normal(size=(n, 8))
    process, weight = b @ b.T, np.diag([1.0, 1.0, 1.0, 1.0 if level == np.inf else -(level**2)])
    return a, h, process, weight, solve_discrete_are(a.T, h.T, process, weight)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("spread", [0.0, 12.0])
@pytest.mark.parametrize("level", [np.inf, 3000.0])
def test_an_equation_of_slow_and_fast_states_is_solved_in_fewer_of_them(spread, level):
    # After some doublings the power has the rank of the slow states, whatever the units of the states.
    a, h, process, weight, expected = slow_and_fast(level)
    units = np.exp2(np.round(np.random.default_rng(4).uniform(-spread, spread, len(a))))
    sizes = np.sqrt(np.abs(np.diag(expected)))
    found = doubled_riccati_solution(
        a * units / units[:, None], h * units, process / np.outer(units, units), weight, np.zeros(h.shape[::-1])
    )
    assert found is not None
    assert np.max(np.abs(found * np.outer(units, units) - expected) / np.outer(sizes, sizes)) <= 1e-8


@pytest.mark.one_in(2)
@pytest.mark.parametrize("rows", [2, 60, 130, 230])
def test_many_states_with_few_or_many_measurements(rows):
    # Up to 0.7 n rows the first doublings are done with these; from there on with the matrix they make.
    rng, n = np.random.default_rng(rows), 240
    a = 1.02 * rng.normal(size=(n, n)) / np.sqrt(n)
    h, b = rng.normal(size=(rows, n)) / np.sqrt(n), rng.normal(size=(n, 5))
    process, cross = b @ b.T + 0.1 * np.eye(n), 0.1 * rng.normal(size=(n, rows)) / np.sqrt(n)
    weight = np.diag(rng.uniform(1.0, 2.0, rows))
    found = doubled_riccati_solution(a, h, process, weight, cross)
    expected = solve_discrete_are(a.T, h.T, process, weight, s=cross)
    assert np.linalg.norm(found - expected) <= 1e-9 * np.linalg.norm(expected)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("inputs", [2, 40])
def test_levels_of_many_states_are_told_from_either_side(inputs):
    rng, n = np.random.default_rng(inputs), 210
    a = 0.95 * rng.normal(size=(n, n)) / np.sqrt(n)
    b, c, d = rng.normal(size=(n, inputs)), rng.normal(size=(3, n)) / n, 0.1 * rng.normal(size=(3, inputs))
    norm = largest_peak(a, b, c, d)
    for way in ((a, b, c, d), (a.T, c.T, b.T, d.T)):
        assert compared_gain(*way, 1.001 * norm) is True
        assert compared_gain(*way, 0.9 * norm) is not True
        assert compared_gain(*way, 0.5 * norm) is False
        slack, level = 1e-3 * np.linalg.norm(way[2], 2) ** 2, 1.1 * norm
        p = bounded_real_matrix(*way, level, slack=slack)
        assert p is not None
        # In coordinates in which P is I the inequality says that the whole matrix is a contraction.
        root = np.linalg.cholesky(p).T
        states, inputs_of_one = np.linalg.inv(root), np.eye(way[1].shape[1]) / level
        moved = block_diag(root, np.eye(len(way[2]))) @ np.block([[way[0], way[1]], [way[2], way[3]]])
        assert np.linalg.norm(moved @ block_diag(states, inputs_of_one), 2) < 1.0
        assert bounded_real_matrix(*way, 0.5 * norm, slack=slack) is None


def test_what_is_left_of_a_power_is_found_and_a_full_power_is_left_alone():
    rng = np.random.default_rng(4)
    n = 220
    slow = rng.normal(size=(n, 30)) @ rng.normal(size=(30, n))
    watch = RankWatch()
    assert [watch.slow_part(slow) is None for _ in range(FIRST_POWER)] == [True] * FIRST_POWER
    part = watch.slow_part(slow)
    assert part is not None
    assert np.linalg.norm(part[0] @ part[1] - slow) <= 1e-13 * np.linalg.norm(slow)
    full = RankWatch()
    assert all(full.slow_part(np.eye(n) + 1e-3 * slow) is None for _ in range(2 * FIRST_POWER))
    assert all(RankWatch().slow_part(np.full((n, n), np.nan)) is None for _ in range(2))
