"""Slopes of expressions over boxes: difference quotients lie in them, and they are hardly wider; jumps are refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from obsynth.errors import PreconditionError
from obsynth.numerics.expressions import parse_expression
from obsynth.proofs import slopes
from obsynth.proofs.slopes import slope_over

_EXPRESSIONS = [
    ("0.5 * s / sqrt(s ** 2 + 0.01)", {"s": (-1.0, 1.0)}),
    ("(1 - c) * 0.1 * s / sqrt(s + 0.01)", {"s": (0.02, 0.4), "c": (0.0, 0.5)}),
    ("s * c + sin(s) * cos(c) - tan(0.5 * s)", {"s": (-1.0, 1.5), "c": (-2.0, 2.0)}),
    ("exp(-s) * atan(c * s) + tanh(s)", {"s": (-1.0, 2.0), "c": (0.5, 2.0)}),
    ("asin(0.5 * s) - acos(0.5 * s) + sinh(s) * cosh(s)", {"s": (-1.0, 1.0)}),
    ("log(s) + log10(s) + s ** 1.5 + s ** -2 + c ** s", {"s": (0.5, 3.0), "c": (0.5, 2.0)}),
    ("abs(s) + min(s, c) - max(0.5 * s, 0.2)", {"s": (-1.0, 2.0), "c": (0.0, 1.0)}),
    ("floor(0.1 * s) + sign(s) + s", {"s": (0.5, 3.0)}),
]


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("text", "box"), _EXPRESSIONS)
def test_every_difference_quotient_lies_in_the_slope(text: str, box: dict[str, tuple[float, float]]) -> None:
    expression, rng = parse_expression(text), np.random.default_rng(3)
    found = slope_over(expression, "s", box)
    one, other = rng.uniform(*box["s"], (2, 100_000))
    # Near pairs too, whose quotients come near the ends.
    other[::2] = np.clip(one[::2] + 1e-3 * rng.standard_normal(50_000), *box["s"])
    rest = {name: rng.uniform(*ends, 100_000) for name, ends in box.items() if name != "s"}
    apart = np.abs(one - other) > 1e-6
    with np.errstate(invalid="ignore", divide="ignore"):
        quotients = (expression({"s": one, **rest}) - expression({"s": other, **rest})) / (one - other)
    quotients = quotients[apart]
    room = 1e-8 * max(abs(found.low), abs(found.high))
    assert found.low - room <= quotients.min()
    assert quotients.max() <= found.high + room
    # Bounds are near slopes that are attained, but where an edge has all slopes between two.
    assert found.high - found.low <= 1.1 * (quotients.max() - quotients.min()) or "abs" in text


def test_monotone_slopes_are_exact_to_rounding() -> None:
    found = slope_over(parse_expression("sqrt(s)"), "s", {"s": (0.02, 0.4)})
    assert found.low == pytest.approx(0.5 / math.sqrt(0.4), rel=1e-13)
    assert found.high == pytest.approx(0.5 / math.sqrt(0.02), rel=1e-13)
    assert found.low <= 0.5 / math.sqrt(0.4)
    assert found.high >= 0.5 / math.sqrt(0.02)


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("sqrt(s)", "can be zero"),
        ("abs(s) ** 0.5", "must be positive"),
        ("1 / (s - 0.5)", "can be zero"),
        ("sign(s - 0.5)", "jumps"),
        ("step(s - 0.5) * s", "jumps"),
        ("where(s < 0.5, s, 2 * s)", "may jump"),
        ("log(s - 0.5)", "argument of log"),
    ],
)
def test_slopes_that_are_not_bounded_are_refused(text: str, told: str) -> None:
    with pytest.raises(PreconditionError, match=told):
        slope_over(parse_expression(text), "s", {"s": (0.0, 1.0)})


def test_a_slope_over_one_box_is_enclosed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quotient with three arguments takes a second: existence, design and verification each ask for it."""
    boxes: list[object] = []
    enclosed = slopes.enclosed_range

    def counted(enclosure: Any, value: Any, box: Any) -> Any:
        boxes.append(box)
        return enclosed(enclosure, value, box)

    monkeypatch.setattr(slopes, "enclosed_range", counted)
    text = "(a * sin(s) - 0.123 * cos(s)) / (1 + 0.2 * s ** 2)"
    found = [slope_over(parse_expression(text), "s", {"s": (-0.5, high), "a": (1.0, 2.0)}) for high in (0.5, 0.5, 0.75)]
    assert boxes == [[(1.0, 2.0), (-0.5, 0.5)], [(1.0, 2.0), (-0.5, 0.75)]]
    assert found[0] == found[1] != found[2]
