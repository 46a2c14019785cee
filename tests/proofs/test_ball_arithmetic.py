"""Proofs in more digits than double precision has: against exact fractions, and for inequalities at their very edge."""

from __future__ import annotations

from fractions import Fraction

import flint
import numpy as np
import pytest

import obsynth
from obsynth.methods.pd_observer.certificate_proofs import prove_gains
from obsynth.observers.linear.observer import LinearObserver
from obsynth.proofs import definiteness as balls
from obsynth.proofs.balls import Ball
from obsynth.proofs.definiteness import LARGEST_ORDER, prove_positive_definite
from obsynth.proofs.extended_balls import Enclosed, ExtendedBall, block, prove_by_ball_arithmetic
from obsynth.verification.inequalities import prove_bounded_real, prove_gain, prove_stable

ULP = 2.0**-52


def fraction(value: flint.arb) -> Fraction:
    """Return an exact ball's number."""
    mantissa, exponent = value.man_exp()
    return Fraction(int(mantissa)) * Fraction(2) ** int(exponent)


def contains(ball: ExtendedBall, exact: list[list[Fraction]]) -> bool:
    return all(
        fraction(entry.lower()) <= value <= fraction(entry.upper())
        for row, values in zip(ball.entries(), exact, strict=True)
        for entry, value in zip(row, values, strict=True)
    )


def fractions(matrix: np.ndarray) -> np.ndarray:
    return np.array([[Fraction(value) for value in row] for row in matrix.tolist()], dtype=object)


def random_matrix(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return np.ldexp(rng.uniform(-1.0, 1.0, shape), rng.integers(-60, 60, shape))


@pytest.mark.parametrize("bits", [30, 60, 128])
def test_sums_products_and_blocks_contain_the_exact_ones(bits: int) -> None:
    rng = np.random.default_rng(bits)
    for _ in range(50):
        a, b, c = (random_matrix(rng, (3, 3)) for _ in range(3))
        factor = float(rng.normal())
        with flint.ctx.workprec(bits):
            x, y, z = (ExtendedBall.exact(matrix) for matrix in (a, b, c))
            found = (x @ y - z.T).scaled(factor) + (-x)
            joined = block([[found, x], [y, z]])
        exact = (fractions(a) @ fractions(b) - fractions(c).T) * Fraction(factor) - fractions(a)
        assert contains(found, exact.tolist())
        everything = np.block([[exact, fractions(a)], [fractions(b), fractions(c)]])
        assert contains(joined, everything.tolist())


def test_a_ball_keeps_its_radius() -> None:
    rng = np.random.default_rng(1)
    ball = Ball(random_matrix(rng, (4, 3)), np.abs(random_matrix(rng, (4, 3))))
    found = ExtendedBall.of(ball)
    for sign in (-1, 0, 1):
        assert contains(found, (fractions(ball.midpoint) + sign * fractions(ball.radius)).tolist())
    # Arb keeps radii with 30 bits, rounded up.
    outside = fractions(ball.midpoint) + (1 + Fraction(1, 2**20)) * fractions(ball.radius)
    with flint.ctx.workprec(300):
        for row, values in zip(found.entries(), outside.tolist(), strict=True):
            assert all(fraction(entry.upper()) < value for entry, value in zip(row, values, strict=True))


def test_blocks_without_rows_or_columns() -> None:
    empty = ExtendedBall.exact(np.zeros((2, 0)))
    one = ExtendedBall.exact(np.eye(2))
    assert block([[one, empty], [empty.T, ExtendedBall.exact(np.zeros((0, 0)))]]).shape == (2, 2)
    assert (empty @ empty.T).shape == (2, 2)


def next_to_singular(rng: np.random.Generator, size: int, towards: float) -> np.ndarray:
    """Whole numbers, exactly singular with a null vector of full support, but for one diagonal entry."""
    factor = rng.integers(-9, 10, (size, size - 1)).astype(float)
    matrix = factor @ factor.T
    place = int(rng.integers(size))
    matrix[place, place] = np.nextafter(matrix[place, place], towards)
    return matrix


@pytest.mark.one_in(3)
@pytest.mark.parametrize("size", [12, 30, 64])
def test_one_unit_in_the_last_place_decides(size: int) -> None:
    """A Gram matrix of rank n - 1 is definite once any diagonal entry grows, and indefinite once one shrinks."""
    rng = np.random.default_rng(size)
    for _ in range(6):
        larger = prove_positive_definite(next_to_singular(rng, size, np.inf))
        assert (larger.proved, larger.means) == (True, "ball arithmetic")
        assert "python-flint" in larger.text
        smaller = prove_positive_definite(next_to_singular(rng, size, -np.inf))
        assert not smaller.proved
        assert "not positive definite" in smaller.reason
    factor = rng.integers(-9, 10, (size, size - 1)).astype(float)
    exactly = prove_positive_definite(factor @ factor.T)
    assert not exactly.proved
    assert "singular, or next to it" in exactly.reason


def test_the_lower_bound_is_one() -> None:
    """With the exact inverse by fractions: 1 / trace(X^-1) is below the smallest eigenvalue."""
    rng = np.random.default_rng(5)
    for size in (2, 5, 9):
        matrix = next_to_singular(rng, size, np.inf)
        found, _ = prove_by_ball_arithmetic(lambda kind, matrix=matrix: kind.exact(matrix))
        exact = flint.fmpq_mat(size, size, [flint.fmpq(*Fraction(v).as_integer_ratio()) for v in matrix.ravel()])
        trace = sum((exact.inv()[i, i] for i in range(size)), flint.fmpq(0))
        bound = flint.fmpq(*Fraction(found).as_integer_ratio())
        assert 0 < bound <= 1 / trace
        assert found == pytest.approx(float(1 / Fraction(int(trace.p), int(trace.q))))


def test_what_is_hopeless_ends_at_once() -> None:
    """Radii that swallow the pivots: no digits help."""
    ball = Ball(np.eye(3), np.full((3, 3), 0.6))
    assert prove_by_ball_arithmetic(lambda kind: kind.of(ball))[0] is None
    tried = []

    def endless(kind: type[Enclosed]) -> Enclosed:
        tried.append(flint.ctx.prec)
        return kind.exact(np.array([[1.0, np.inf], [np.inf, 1.0]]))

    assert prove_by_ball_arithmetic(endless)[0] is None
    assert tried == [128]


def test_the_precision_of_others_is_left_alone() -> None:
    before = flint.ctx.prec
    matrix = next_to_singular(np.random.default_rng(0), 5, np.inf)
    assert prove_positive_definite(matrix).means == "ball arithmetic"
    assert flint.ctx.prec == before

    def broken(kind: type[Enclosed]) -> Enclosed:
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError, match="broken"):
        prove_by_ball_arithmetic(broken)
    assert flint.ctx.prec == before


def test_a_larger_matrix_is_not_tried_and_the_reason_says_so() -> None:
    found = prove_positive_definite(next_to_singular(np.random.default_rng(0), LARGEST_ORDER + 1, np.inf))
    assert not found.proved
    assert f"up to order {LARGEST_ORDER}" in found.reason
    assert found.reason in found.text


def test_what_is_far_from_definite_needs_no_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(balls, "LARGEST_ORDER", 0)
    found = prove_positive_definite(next_to_singular(np.random.default_rng(0), 5, np.inf))
    assert not found.proved
    assert "up to order 0" in found.reason
    assert "up to order" not in prove_positive_definite(np.array([[1.0, 2.0], [2.0, 1.0]])).reason


# Inequalities of observers at their edge: formed again from the shipped numbers, where double precision cannot tell.


@pytest.mark.parametrize(("radius", "stable"), [(1.0 - ULP / 2, True), (1.0, False), (1.0 + ULP, False)])
def test_stability_of_samples_at_the_unit_circle(radius: float, stable: bool) -> None:
    a = radius * np.array([[0.0, 1.0], [1.0, 0.0]])
    found = prove_stable(a, np.eye(2), 0.1)
    assert found.proved is stable
    if stable:
        assert found.means == "ball arithmetic"


@pytest.mark.parametrize(("rate", "stable"), [(-1e-25, True), (0.0, False), (1e-25, False)])
def test_stability_in_continuous_time_at_the_axis(rate: float, stable: bool) -> None:
    """A rotation that hardly decays: with this factor the inequality holds exactly when it does."""
    a = np.array([[rate, 0.1], [-0.1, rate]])
    assert prove_stable(a, np.eye(2), 0.0).proved is stable


def static_filter(direct: float) -> tuple[obsynth.DescriptorSystem, LinearObserver]:
    """A filter without dynamics whose fault error is ``direct`` times the disturbance."""
    plant = obsynth.DescriptorSystem(None, [[0.0]], C=[[1.0]], Bf=[[1.0]], Bd=[[0.0]], Dd=[[1.0]], dt=1.0)
    observer = LinearObserver(
        Az=np.zeros((1, 1)), Bu=np.zeros((1, 0)), By=np.zeros((1, 1)), Cz=np.zeros((2, 1)),
        Dy=np.array([[0.0], [direct]]), Du=np.zeros((2, 0)), dt=1.0, input_names=(), output_names=plant.output_names,
        state_names=plant.state_names, fault_names=plant.fault_names, residual_names=(), state_delays=(0,),
        fault_delays=(0,),
    )  # fmt: skip
    return plant, observer


@pytest.mark.parametrize("direct", [1.0, 0.1, 1.0 / 3.0, 1e5 / 7.0])
def test_a_gain_is_proved_one_unit_in_the_last_place_above_the_norm_and_not_at_it(direct: float) -> None:
    plant, observer = static_filter(direct)
    for gain, below in ((np.nextafter(direct, np.inf), True), (direct, False), (np.nextafter(direct, 0.0), False)):
        found = prove_bounded_real(plant, observer, np.eye(1), np.eye(1), float(gain))
        assert found.proved is below, gain


@pytest.mark.parametrize(("decay", "proved"), [(1.0 - ULP / 2, True), (1.0, False), (1.0 + ULP, False)])
def test_the_pd_inequality_at_the_decay_rate_itself(decay: float, proved: bool) -> None:
    a, none, one = np.array([[-1.0, 0.0], [0.0, -3.0]]), np.zeros((2, 1)), np.eye(2)
    assert prove_gains(a, none.T, none, none, one, one, delta=1e-9, decay=decay).proved is proved


def test_an_l2_gain_in_continuous_time() -> None:
    """``x' = -x + v``, ``z = x`` has the gain 1, and P = 1 proves every level above it: at 1 the form is singular."""
    a, b, c, p = -np.eye(1), Ball.exact(np.eye(1)), np.eye(1), np.eye(1)
    assert prove_gain(a, b, c, p, 1.0 + ULP).means == "ball arithmetic"
    assert not prove_gain(a, b, c, p, 1.0).proved


def test_the_report_says_which_proof_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = obsynth.DescriptorSystem(None, [[0.5, 1.0], [0.0, -1.0]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]])
    design = obsynth.pd_observer(plant)
    assert design.report["LMI"].detail.startswith("Cholesky")
    monkeypatch.setattr(balls, "_by_cholesky", lambda *_: balls.DefinitenessProof(False, 0.0, 1.0))
    again = obsynth.verify(design)
    assert again.passed
    assert again["LMI"].detail.startswith("ball arithmetic with 128 bits")
    monkeypatch.setattr(balls, "LARGEST_ORDER", 0)
    failed = obsynth.verify(design)["LMI"]
    assert not failed.passed
    assert "up to order 0" in failed.detail
