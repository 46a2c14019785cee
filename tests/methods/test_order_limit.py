"""Optimal filters of few states: the fault map is kept, the order is the one asked for, and its gain is near the best.

The truths are those of another way: filters of finite response, by least squares and by a convex programme.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

import obsynth
from obsynth.methods.registry import error_model
from obsynth.results.design import Certificate

#: A random walk on y2, and on y1 with the fault: what is late by three samples and remembers three is a sum of four
#: samples of y2 with weights whose sum is one.
WALK = obsynth.DescriptorSystem(
    A=[[1.0]], Bf=[[0]], Bw=[[1, 0]], C=[[1], [1]], Df=[[1], [0]], Dw=[[0, 0], [0, 1]], dt=1.0
)
STEPS = np.array([[float(j < 3 - i) for j in range(3)] for i in range(4)])
TWO_SENSORS = obsynth.DescriptorSystem(
    A=[[-1.0]], Bf=[[0]], Bw=[[1, 0]], C=[[1], [1]], Df=[[1], [0]], Dw=[[0, 0], [0, 1]], dt=0.0
)


def plant(seed: int, *, n: int = 5, nd: int = 0) -> obsynth.DescriptorSystem:
    """Return a plant of two faults, an input, and noise on every state and output."""
    rng = np.random.default_rng([4701, seed])
    a = rng.normal(size=(n, n))
    a *= (1.1 if seed % 2 else 0.85) / np.max(np.abs(np.linalg.eigvals(a)))
    return obsynth.DescriptorSystem(
        A=a, B=rng.normal(size=(n, 1)), C=rng.normal(size=(4, n)), Bf=rng.normal(size=(n, 2)),
        Bd=rng.normal(size=(n, nd)), Bw=np.hstack([0.3 * rng.normal(size=(n, n)), np.zeros((n, 4))]),
        Dw=np.hstack([np.zeros((4, n)), 0.2 * np.eye(4)]), dt=1.0,
    )  # fmt: skip


def test_the_mean_square_is_that_of_least_squares_over_four_samples() -> None:
    design = obsynth.optimal_filter(WALK, delay=3, norm="h2", order_limit=3)
    assert design.report.passed
    assert design.observer.order == 3
    # Noise of y2, and the steps of the walk between its samples and the oldest one.
    squares = STEPS @ STEPS.T + np.eye(4)
    weights = np.linalg.solve(squares, np.ones(4))
    weights /= weights.sum()
    assert design.gain == pytest.approx(np.sqrt(weights @ squares @ weights), rel=1e-8)
    full = obsynth.optimal_filter(WALK, delay=3, norm="h2")
    assert full.observer.order == 4
    assert design.least == full.gain < design.gain
    assert "Least deviation over all causal linear filters" in design.notes[0]
    assert "this filter: 0.78679579" in design.notes[0]


def test_the_gain_is_that_of_a_convex_programme_over_four_samples() -> None:
    """One sample of y2, three samples old, has gain 1, which no filter of any order beats."""
    design = obsynth.optimal_filter(WALK, delay=3, order_limit=3)
    assert design.report.passed
    assert design.observer.order == 3
    assert 1.0 - 1e-9 <= design.least <= 1.0 <= design.gain <= 1.002


@pytest.mark.parametrize(
    ("seed", "norm"),
    [pytest.param(0, "hinf", marks=pytest.mark.long), pytest.param(1, "hinf", marks=pytest.mark.long), (1, "h2")],
)
def test_a_filter_of_fewer_states_keeps_fault_map_and_decoupling(seed: int, norm: str, tmp_path) -> None:
    case = plant(seed, nd=1)
    full = obsynth.optimal_filter(case, delay=1, decoupled="d1", norm=norm)
    limit = full.observer.order - 1
    design = obsynth.optimal_filter(case, delay=1, decoupled="d1", norm=norm, order_limit=limit)
    assert {"decoupling", "fault map"} <= {check.name for check in design.report.checks if check.passed}
    assert design.report.passed
    assert design.observer.order <= limit
    assert design.least <= full.gain * (1.0 + 1e-9)
    assert full.least * (1.0 - 1e-6) <= design.gain <= 1.1 * full.gain
    assert "a local minimum for its order" in design.notes[-1]
    again = obsynth.load(design.save(tmp_path / "few.gains.json"))
    assert obsynth.verify(again).passed
    assert again.options["order_limit"] == limit
    # Faults pass a sample late, whatever u and d do.
    rng = np.random.default_rng(seed)
    f, u, d, x = rng.normal(size=(60, 2)), rng.normal(size=(60, 1)), rng.normal(size=(60, 1)), np.zeros(case.nx)
    y = np.zeros((60, 4))
    for k in range(60):
        y[k] = case.C @ x
        x = case.A @ x + case.B @ u[k] + case.Bf @ f[k] + case.Bd @ d[k]
    estimates = design.observer.run(y, u).faults
    size = float(np.max(np.abs(y)))
    np.testing.assert_allclose(estimates[1:], f[:-1], atol=1e-8 * max(size, 1.0))


@pytest.mark.parametrize(
    ("case", "options", "limit", "room"),
    [
        (TWO_SENSORS, {"reference": {"bandwidth": 2.0}, "weights": {"errors": 3.0, "inputs": {"w2": 0.5}}}, 1, 1.01),
        (plant(1, n=2), {"reference": {"bandwidth": 1.0}, "exact": False}, 2, 1.01),
    ],
    ids=["weights", "matching"],
)
def test_other_problems_have_filters_of_few_states(case, options, limit, room) -> None:
    full = obsynth.optimal_filter(case, **options)
    assert full.observer.order > limit
    design = obsynth.optimal_filter(case, **options, order_limit=limit)
    assert design.report.passed
    assert design.observer.order <= limit
    assert full.least * (1.0 - 1e-6) <= design.gain <= room * full.gain


def test_the_mean_square_of_two_states_in_continuous_time_has_its_closed_form() -> None:
    """4 / (s + 2)^2 of y1 and (p (s + 1) - 4) / (s + 2)^2 of y2 see no state: (6 p^2 - 8 p + 16) / 32, p = 2/3."""
    options = {"reference": {"bandwidth": 2.0, "order": 2}, "norm": "h2"}
    design = obsynth.optimal_filter(TWO_SENSORS, **options, order_limit=2)
    assert design.report.passed
    assert design.observer.order == 2
    assert design.gain == pytest.approx((5 / 12) ** 0.5, rel=1e-8)


def test_the_gain_of_one_state_in_continuous_time_has_its_closed_form() -> None:
    """2 / (s + 2) of y1 and (p (s + 1) - 2) / (s + 2) of y2: p at infinity, (p^2 + (p - 2)^2) / 4 at zero, squared."""
    design = obsynth.optimal_filter(TWO_SENSORS, reference={"bandwidth": 2.0}, order_limit=1)
    assert design.report.passed
    assert design.observer.order == 1
    assert (3**0.5 - 1.0) * (1.0 - 1e-12) <= design.gain <= (3**0.5 - 1.0) * 1.002


def test_a_filter_that_is_small_enough_is_left_as_it_is() -> None:
    full = obsynth.optimal_filter(WALK, delay=1)
    limited = obsynth.optimal_filter(WALK, delay=1, order_limit=full.observer.order)
    assert (limited.gain, limited.least, limited.observer.order) == (full.gain, full.least, full.observer.order)
    assert limited.notes == full.notes


@pytest.mark.long
def test_too_few_states_are_refused_with_the_order_that_works() -> None:
    case = plant(0, nd=1)
    with pytest.raises(obsynth.InfeasibleError, match=r"at least \d .*order_limit=\d+\.$") as refusal:
        obsynth.optimal_filter(case, delay=1, decoupled="d1", order_limit=1)
    assert refusal.value.necessary
    works = int(str(refusal.value).rpartition("=")[2].rstrip("."))
    assert works >= refusal.value.lower_bound > 1
    design = obsynth.optimal_filter(case, delay=1, decoupled="d1", order_limit=works)
    assert design.report.passed
    assert design.observer.order <= works
    with pytest.raises(obsynth.SpecError, match="order_limit"):
        obsynth.optimal_filter(WALK, order_limit=0)


def test_three_samples_of_delay_need_three_states() -> None:
    """y1 is read three samples late: no filter of two states has it."""
    with pytest.raises(obsynth.InfeasibleError, match=r"at least 3 .*order_limit=3"):
        obsynth.optimal_filter(WALK, delay=3, order_limit=2)


def test_a_design_above_its_own_limit_fails() -> None:
    design = obsynth.optimal_filter(WALK, delay=3, norm="h2", order_limit=3)
    for limit, passed in ((3, True), (2, False), ("few", False)):
        other = design.replace(options={**design.options, "order_limit": limit})
        assert obsynth.verify(other).passed is passed


def test_modes_that_y_does_not_reach_are_states_all_the_same() -> None:
    """A is nilpotent: rounding in rows of the filter that are zero left no T, and the search gave up."""
    case = obsynth.DescriptorSystem(
        A=np.diag([0.5, 0.0, 0.0]) + np.eye(3, k=-1), Bf=[[1, 0], [0, 0], [0, 1]], Bw=np.zeros((3, 2)),
        C=[[0, 1, 0], [0, 0, 1]], Dw=np.diag([1.0, 2.0]), dt=1.0,
    )  # fmt: skip
    design = obsynth.optimal_filter(case, delay=[2, 1], order_limit=3)
    assert design.report.passed
    assert design.observer.order == 3
    assert design.least == pytest.approx(design.gain, rel=1e-6)


@pytest.mark.long
def test_more_states_are_never_worse_than_no_filter() -> None:
    """The search of two states ends where the gain has a peak of 3.26 between the angles that it looks at."""
    rng = np.random.default_rng([9, 131])
    rng.integers(2, 6), rng.integers(1, 4), rng.integers(1, 3), rng.choice([0, 1.0])
    a = rng.standard_normal((2, 2))
    case = obsynth.DescriptorSystem(
        A=a - (max(np.linalg.eigvals(a).real) + 0.3) * np.eye(2),
        C=rng.standard_normal((2, 2)),
        Bf=rng.standard_normal((2, 2)),
        Df=rng.standard_normal((2, 2)) * (rng.random() < 0.5),
        Bw=np.hstack([rng.standard_normal((2, 2)) * 0.3, np.zeros((2, 2))]),
        Dw=np.hstack([np.zeros((2, 2)), 0.1 * np.eye(2)]),
    )
    design = obsynth.optimal_filter(case, reference={"bandwidth": 1.0}, exact=False, order_limit=2)
    assert design.report.passed
    assert design.gain <= 1.0 + 1e-6


@pytest.mark.long
def test_a_search_that_reaches_no_error_at_all_ends_there() -> None:
    case = obsynth.DescriptorSystem(
        E=[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
        A=[[-1.25, -0.0, 0.25, -0.75], [0.5, -1.0, 0.25, 0.5], [0.25, -0.5, -1.5, 0.25], [0.25, 0.5, 0.25, -0.75]],
        C=[[2.0, 4.0, 1.0, -0.0], [-2.0, -2.0, -1.0, 0.0], [0.0, 3.0, -4.0, -2.0]],
        B=[[-2.0, -2.0], [-1.0, 0.0], [3.0, -0.0], [2.0, 4.0]],
        Bf=[[2.0], [1.0], [0.0], [1.0]],
        Df=[[0.0], [0.0], [0.0]],
        Bd=[[0.5], [0.0], [0.5], [0.5]],
        Dd=[[0.0], [0.0], [0.0]],
    )
    design = obsynth.optimal_filter(case, reference={"bandwidth": 3.0}, decoupled="d1", order_limit=2)
    assert design.report.passed


def _matching(seed: int, dt: float) -> tuple[obsynth.DescriptorSystem, dict[str, list[list[float]]]]:
    """Return a plant without known inputs whose modes decay, outputs in units of their own, and a lag to be matched."""
    rng = np.random.default_rng([4712, seed])
    a = rng.normal(size=(4, 4))
    poles = np.linalg.eigvals(a)
    a = 0.85 * a / np.max(np.abs(poles)) if dt else a - (np.max(poles.real) + 0.3) * np.eye(4)
    units = np.array([[1.0], [50.0]])
    case = obsynth.DescriptorSystem(
        A=a, C=units * rng.normal(size=(2, 4)), Bf=rng.normal(size=(4, 1)),
        Bw=np.hstack([0.3 * rng.normal(size=(4, 1)), np.zeros((4, 2))]),
        Dw=np.hstack([np.zeros((2, 1)), 0.3 * np.diag(units.ravel())]), dt=dt,
    )  # fmt: skip
    pole = 0.6 if dt else -1.5
    return case, {"A": [[pole]], "B": [[1.0]], "C": [[1.0 - pole if dt else -pole]], "D": [[0.0]]}


def _covariance(a: np.ndarray, b: np.ndarray, dt: float) -> np.ndarray:
    if dt:
        return scipy.linalg.solve_discrete_lyapunov(a, b @ b.T)
    return scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)


def _truncated(parts: tuple[np.ndarray, ...], order: int, dt: float) -> tuple[np.ndarray, ...]:
    """Return a balanced truncation by the square-root method, from the Gramians of scipy."""
    a, b, c, d = parts
    roots = []
    for gramian in (_covariance(a, b, dt), _covariance(a.T, c.T, dt)):
        sizes, directions = np.linalg.eigh(0.5 * (gramian + gramian.T))
        roots.append(directions * np.sqrt(np.maximum(sizes, 0.0)))
    left, values, right = np.linalg.svd(roots[1].T @ roots[0])
    out = roots[0] @ right[:order].T / np.sqrt(values[:order])
    into = (roots[1] @ left[:, :order] / np.sqrt(values[:order])).T
    return into @ a @ out, into @ b, c @ out, d


def _norm_of_error(case: obsynth.DescriptorSystem, reference: dict, parts: tuple[np.ndarray, ...], norm: str) -> float:
    """Return the norm from faults and noise to what a filter misses of the reference model, by its whole cascade."""
    (a, b, c, d), (ar, br, cr, _) = parts, (np.array(reference[name]) for name in "ABCD")
    n, k, m = case.nx, len(a), len(ar)
    whole = np.block([[case.A, np.zeros((n, k + m))], [b @ case.C, a, np.zeros((k, m))], [np.zeros((m, n + k)), ar]])
    driven = np.block([[case.Bf, case.Bw], [b @ case.Df, b @ case.Dw], [br, np.zeros((m, case.nw))]])
    read, through = np.hstack([d @ case.C, c, -cr]), np.hstack([d @ case.Df, d @ case.Dw])
    if norm == "h2":
        return float(np.sqrt(np.trace(read @ _covariance(whole, driven, case.dt) @ read.T) + np.sum(through**2)))
    half = np.linspace(0.0, np.pi, 4000, endpoint=False)
    points = np.exp(1j * half) if case.dt else 1j * np.tan(0.5 * half)
    states = np.linalg.solve(points[:, None, None] * np.eye(len(whole)) - whole, driven.astype(complex))
    return float(np.max(np.linalg.svd(read @ states + through, compute_uv=False)))


@pytest.mark.parametrize(
    ("seed", "dt", "norm"),
    [
        (0, 1.0, "h2"),
        (1, 0.0, "h2"),
        pytest.param(0, 1.0, "hinf", marks=pytest.mark.long),
        pytest.param(2, 0.0, "hinf", marks=pytest.mark.long),
    ],
)
def test_no_plain_truncation_is_better(seed: int, dt: float, norm: str, tmp_path) -> None:
    case, reference = _matching(seed, dt)
    full = obsynth.optimal_filter(case, reference=reference, exact=False, norm=norm)
    shipped = [full.observer.Az, full.observer.By, full.observer.Cz, full.observer.Dy]
    for order in (1, 2):
        design = obsynth.optimal_filter(case, reference=reference, exact=False, norm=norm, order_limit=order)
        assert design.report.passed
        assert design.observer.order == order
        plain = _norm_of_error(case, reference, _truncated(shipped, order, dt), norm)
        own = [design.observer.Az, design.observer.By, design.observer.Cz, design.observer.Dy]
        recomputed = _norm_of_error(case, reference, own, norm)
        assert full.least * (1.0 - 1e-6) <= recomputed <= design.gain * (1.0 + 1e-6) <= plain * (1.0 + 1e-5)
    assert any("are in the errors of this filter" in note for note in design.notes)
    assert obsynth.verify(obsynth.load(design.save(tmp_path / "few.gains.json"))).passed


def test_what_the_errors_hold_of_the_plant_is_verified() -> None:
    case, reference = _matching(0, 1.0)
    design = obsynth.optimal_filter(case, reference=reference, exact=False, norm="h2", order_limit=2)
    matrices, claims = design.certificate.matrices, design.certificate.claims
    held = matrices["modes_A"]
    assert held.shape == (2 + case.nx, case.nx)
    # From a start that is not at rest the errors die out with the plant's modes, as the error model says.
    start = np.ones(case.nx)
    y = np.array([case.C @ np.linalg.matrix_power(case.A, k) @ start for k in range(12)])
    estimates = design.observer.run(y).faults[:, 0]
    model = error_model(design)
    error, expected = model.own @ case.E @ start, []
    for _ in range(12):
        expected.append(-float((model.observer.Cz @ error)[0]))
        error = model.Az @ error
    np.testing.assert_allclose(estimates, expected, atol=1e-9)
    for changed in (held * 1.01, np.zeros_like(held), held[:, :2]):
        other = design.replace(certificate=Certificate({**matrices, "modes_A": changed}, claims))
        assert not obsynth.verify(other).passed
    without = {name: part for name, part in matrices.items() if name not in ("modes_A", "modes_C")}
    assert not obsynth.verify(design.replace(certificate=Certificate(without, claims))).passed
