"""Affine matrices and numbers against exact fractions: what they hold, they hold to the last digit of a double."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from obsynth.errors import PreconditionError
from obsynth.proofs.affine import AffineMatrix, affine_block
from obsynth.proofs.affine_numbers import AffineNumber

Exact = np.ndarray  # of fractions


def exactly(values: np.ndarray | float) -> Exact:
    """Return doubles as fractions."""
    return np.vectorize(lambda value: Fraction(float(value)), otypes=[object])(np.asarray(values))


def member(matrix: AffineMatrix, q: tuple[int, ...], signs: np.ndarray) -> Exact:
    """Return one of the matrices, exactly: at a vertex, with the remainder at its bounds."""
    parts = sum((exactly(part) * share for share, part in zip(q, matrix.parts, strict=True)), exactly(matrix.center))
    return parts + exactly(matrix.radius) * signs


def holds(found: AffineMatrix, q: tuple[int, ...], wanted: Exact) -> bool:
    """Whether a matrix is among those of an affine one, at these unknowns."""
    missed = np.abs(wanted - member(found, q, np.zeros(found.shape, dtype=int)))
    return bool(np.all(missed <= exactly(found.radius)))


def drawn(seed: int, shape: tuple[int, int], *, part: float = 0.3, radius: float = 0.2) -> AffineMatrix:
    """Return a matrix of two unknowns whose affine parts and remainders are as large as stated."""
    rng = np.random.default_rng(seed)
    return AffineMatrix(
        rng.uniform(-1.0, 1.0, shape), part * rng.uniform(-1.0, 1.0, (2, *shape)), radius * rng.uniform(0.5, 1.0, shape)
    )


OPERATIONS = {
    "sum": (lambda a, b: a + b, lambda a, b: a + b),
    "difference": (lambda a, b: a - b, lambda a, b: a - b),
    "product": (lambda a, b: a @ b, lambda a, b: a @ b),
    "negative multiple": (lambda a, b: a.scaled(-0.7), lambda a, b: a * Fraction(-0.7)),
    "multiple from the left": (
        lambda a, b: a.after(np.array([[0.1, 0.7, -0.3]] * 3)),
        lambda a, b: exactly(np.array([[0.1, 0.7, -0.3]] * 3)) @ a,
    ),
    "block": (lambda a, b: affine_block([[a, b]]), lambda a, b: np.hstack([a, b])),
    "part": (lambda a, b: a[[2, 0], 1:], lambda a, b: a[[2, 0]][:, 1:]),
    "larger": (lambda a, b: a.enlarged(b.radius), lambda a, b: a + b * 0),
}


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.parametrize(
    ("one", "two"),
    [((0.3, 0.2), (0.3, 0.2)), ((0.0, 0.2), (0.3, 0.0)), ((0.3, 0.0), (0.0, 0.2)), ((0.3, 0.0), (0.3, 0.0)),
     ((0.0, 0.0), (0.0, 0.0))],
    ids=["both", "remainder by part", "part by remainder", "parts", "rounding alone"],
)  # fmt: skip
def test_every_member_is_held_exactly(name: str, one: tuple[float, float], two: tuple[float, float]) -> None:
    operation, exact = OPERATIONS[name]
    a = drawn(1, (3, 3), part=one[0], radius=one[1])
    b = drawn(2, (3, 3), part=two[0], radius=two[1])
    found, rng = operation(a, b), np.random.default_rng(3)
    for q in product((-1, 0, 1), repeat=2):
        for trial in range(6):
            # Remainders at their bounds, and those of both with the signs of the centres: the largest of all.
            ends = [rng.choice([-1, 1], (3, 3)) if trial else np.sign(x.center).astype(int) for x in (a, b)]
            assert holds(found, q, exact(member(a, q, ends[0]), member(b, q, ends[1])))


def test_remainders_add_up_where_a_remainder_is_all_there_is() -> None:
    """A matrix that is zero but for its remainder is no exact zero, on either side."""
    nothing = AffineMatrix(np.zeros((1, 1)), np.zeros((1, 1, 1)), np.full((1, 1), 0.5))
    one = AffineMatrix(np.ones((1, 1)), np.zeros((1, 1, 1)), np.full((1, 1), 0.25))
    for found in (nothing + one, one + nothing, one - nothing):
        assert found.center[0, 0] == 1.0
        assert 0.75 <= found.radius[0, 0] < 0.76
    assert (one @ nothing).radius[0, 0] >= 1.25 * 0.5


def test_bounds_of_the_whole_box() -> None:
    a = drawn(4, (3, 2))
    for q in product((-1, 1), repeat=2):
        for signs in (1, -1):
            whole = member(a, q, np.full((3, 2), signs))
            assert np.all(np.abs(whole) <= exactly(a.magnitude))
            assert np.all(np.abs(whole - exactly(a.center)) <= exactly(a.spread) + exactly(a.radius))
    # They are bounds that something reaches, but for rounding.
    assert np.all(a.magnitude <= (np.abs(a.center) + np.abs(a.parts).sum(axis=0) + a.radius) * (1.0 + 1e-14))


def test_a_part_of_the_box_holds_its_members_exactly() -> None:
    a = drawn(5, (2, 2), radius=0.0)
    lower, upper = np.array([-0.3, 0.1]), np.array([0.45, 0.7])
    part = a.on(lower, upper)
    for q in product((-1, 0, 1), repeat=2):
        inner = [Fraction(float(low)) + (Fraction(float(high)) - Fraction(float(low))) * Fraction(share + 1, 2)
                 for low, high, share in zip(lower, upper, q, strict=True)]  # fmt: skip
        assert holds(part, q, sum((exactly(g) * x for g, x in zip(a.parts, inner, strict=True)), exactly(a.center)))


def number(center: float, parts: tuple[float, float], radius: float = 0.0) -> AffineNumber:
    return AffineNumber(center, np.array(parts), radius)


def at(found: AffineNumber, q: list[int]) -> Fraction:
    """Return the affine part of a number at a vertex, exactly."""
    return Fraction(found.center) + sum(Fraction(float(g)) * share for g, share in zip(found.parts, q, strict=True))


NUMBERS = {
    "sum": lambda a, b: a + b,
    "difference": lambda a, b: a - b,
    "product": lambda a, b: a * b,
    "quotient": lambda a, b: a / b,
}


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("radii", [(0.0, 0.0), (0.05, 0.0), (0.0, 0.07), (0.05, 0.07)])
@pytest.mark.parametrize("parts", [((0.1, 0.0), (0.0, 0.3)), ((0.1, -0.2), (0.1, 0.2)), ((0.0, 0.0), (0.0, 0.0))])
def test_numbers_are_held_exactly(name: str, radii: tuple[float, float], parts: tuple) -> None:
    operation = NUMBERS[name]
    a, b = number(0.7, parts[0], radii[0]), number(1.1, parts[1], radii[1])
    found = operation(a, b)
    for *q, one, two in product((-1, 1), repeat=4):
        x, y = at(a, q) + Fraction(a.radius) * one, at(b, q) + Fraction(b.radius) * two
        middle, value = at(found, q), operation(x, y)
        assert abs(value - middle) <= Fraction(found.radius)
        low, high = found.interval
        assert Fraction(low) <= value <= Fraction(high)


def test_an_interval_is_rounded_outward() -> None:
    """1.1 less 1e-17 is no double: the interval ends at one below it."""
    low, high = number(1.1, (1e-17, 0.0)).interval
    assert Fraction(low) <= Fraction(1.1) - Fraction(1e-17)
    assert Fraction(high) >= Fraction(1.1) + Fraction(1e-17)


@pytest.mark.parametrize("half", [1e-4, 1e-2, 0.5])
def test_one_over_a_number_keeps_its_second_order(half: float) -> None:
    """``1 / (c + d) - (1 - d) = d^2 / (1 + d)``, which the remainder has to hold, however small d is."""
    found = number(1.0, (half, 0.0)).reciprocal()
    for sign in (-1, 1):
        exact = 1 / (1 + sign * Fraction(half))
        missed = abs(exact - Fraction(found.center) - sign * Fraction(float(found.parts[0])))
        assert missed <= Fraction(found.radius)
    # It is that of the tangent, no multiple of it: the least distance cubed is what it loses.
    assert found.radius <= 1.01 * half**2 / (1.0 - half) ** 3


@pytest.mark.parametrize("ends", [(0.0, 0.2), (-0.1, 0.1), (-0.2, 0.0)])
def test_a_divisor_that_reaches_zero_is_refused(ends: tuple[float, float]) -> None:
    low, high = ends
    with pytest.raises(PreconditionError, match="can be zero"):
        number((low + high) / 2, ((high - low) / 2, 0.0)).reciprocal()
