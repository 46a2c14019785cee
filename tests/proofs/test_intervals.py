"""Ranges of expressions over boxes: never too narrow, and to one part in a thousand."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth.errors import PreconditionError
from obsynth.numerics.expressions import parse_expression
from obsynth.proofs.intervals import Interval, interval_of, range_over

_EXPRESSIONS = [
    ("0.5 / sqrt(x)", {"x": (0.02, 0.4)}),
    ("x ** 2 - x", {"x": (0.0, 1.0)}),
    ("sin(x) * x + y ** 2 - y * x", {"x": (-2.0, 3.0), "y": (-1.0, 2.0)}),
    ("cos(x) + cosh(y) - tanh(x * y)", {"x": (-1.0, 7.0), "y": (-1.0, 0.5)}),
    ("exp(-x) * log(y) - abs(x)", {"x": (-1.0, 2.0), "y": (0.5, 4.0)}),
    ("atan(x) + asin(y) + acos(y)", {"x": (-3.0, 2.0), "y": (-0.5, 0.9)}),
    ("min(x, y) * max(x, 1) / (2 + x)", {"x": (-1.0, 3.0), "y": (0.0, 2.0)}),
    ("x ** -2 + y ** 1.5 + x ** 3", {"x": (0.5, 3.0), "y": (0.1, 2.0)}),
    ("tan(x) + sinh(x) + sqrt(y)", {"x": (-1.2, 1.3), "y": (0.0, 2.0)}),
]


@pytest.mark.one_in(6)
@pytest.mark.parametrize(("text", "box"), _EXPRESSIONS)
def test_every_value_lies_in_the_range_which_is_hardly_wider(text: str, box: dict[str, tuple[float, float]]) -> None:
    expression = parse_expression(text)
    found, whole = range_over(expression, box), interval_of(expression, box)
    rng = np.random.default_rng(1)
    values = expression({name: rng.uniform(*ends, 200_000) for name, ends in box.items()})
    assert whole.low <= found.low <= values.min()
    assert values.max() <= found.high <= whole.high
    assert found.high - found.low <= 1.02 * (values.max() - values.min())


def test_single_operations_hold_their_exact_results() -> None:
    from fractions import Fraction

    rng = np.random.default_rng(2)
    for _ in range(500):
        x, y = (float(value) for value in rng.standard_normal(2))
        for found, exact in (
            (Interval(x, x) + y, Fraction(x) + Fraction(y)),
            (Interval(x, x) * y, Fraction(x) * Fraction(y)),
            (Interval(x, x) / y, Fraction(x) / Fraction(y)),
            (Interval(x, x) ** 3, Fraction(x) ** 3),
        ):
            assert Fraction(found.low) <= exact <= Fraction(found.high)


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("text", "told"),
    [("1 / x", "can be zero"), ("log(x)", "argument of log"), ("step(x)", "jumps"), ("sign(x)", "jumps")],
)
def test_what_is_not_bounded_or_jumps_is_refused(text: str, told: str) -> None:
    with pytest.raises(PreconditionError, match=told):
        range_over(parse_expression(text), {"x": (-1.0, 1.0)})


@pytest.mark.parametrize(
    ("text", "box", "ends"),
    [
        ("sqrt(x + 1)", {"x": (-1.0, 3.0)}, (0.0, 2.0)),
        ("sqrt(x * y)", {"x": (0.0, 1.0), "y": (0.0, 4.0)}, (0.0, 2.0)),
        ("sqrt(x / y)", {"x": (0.0, 4.0), "y": (1.0, 2.0)}, (0.0, 2.0)),
        ("sqrt(sqrt(x))", {"x": (0.0, 16.0)}, (0.0, 2.0)),
        ("sqrt(exp(x))", {"x": (-1000.0, 0.0)}, (0.0, 1.0)),
    ],
)
def test_the_edge_of_a_domain_belongs_to_it(
    text: str, box: dict[str, tuple[float, float]], ends: tuple[float, float]
) -> None:
    found = range_over(parse_expression(text), box)
    assert found.low <= ends[0] <= found.attained_low + 1e-12
    assert ends[1] <= found.high <= ends[1] * (1.0 + 1e-12)


def test_a_product_that_is_rounded_to_zero_is_not_zero() -> None:
    tiny = Interval(-1e-200, 1e-200) * Interval(1e-200, 1e-200)
    assert tiny.low < 0.0 < tiny.high
    assert (Interval(0.0, 1.0) * Interval(0.5, 1.0)).low == 0.0
