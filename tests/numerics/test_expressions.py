"""The arithmetic language of specs: right values, and nothing but arithmetic."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from obsynth.errors import SpecError
from obsynth.numerics.expressions import MAXIMUM_DEPTH, parse_expression


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1 + 2 * 3", 7.0),
        ("(1 + 2) * 3", 9.0),
        ("2 ** 3 ** 2", 512.0),
        ("-2 ** 2", -4.0),
        ("2 ** -1", 0.5),
        ("8 / 4 / 2", 1.0),
        ("5 - 3 - 1", 1.0),
        ("--3", 3.0),
        (".5e1 + 1.", 6.0),
        ("1e-3", 1e-3),
        ("k / (k + 1)", 0.8),
        ("exp(-k / 30) * sin(0.1 * k)", math.exp(-4 / 30) * math.sin(0.4)),
        ("min(k, 2) + max(k, 9)", 11.0),
        ("step(k - 4) + step(k - 5)", 1.0),
        ("sqrt(abs(-k)) + pi", 2.0 + math.pi),
        ("floor(2.7) + ceil(2.2) + sign(-3)", 4.0),
        (
            "where(k > 3, 1, 2) + 10 * where(k >= 4, 1, 2) + 100 * where(k < 4, 1, 2) + 1000 * where(k <= 4, 1, 2)",
            1211.0,
        ),
        ("where(k > 9, sqrt(-k), where(2 * k < 9, k, 0))", 4.0),
    ],
)
def test_values(text: str, value: float) -> None:
    assert float(parse_expression(text)({"k": 4.0})) == pytest.approx(value, rel=1e-15)


def test_words_of_python_are_names_as_any_other() -> None:
    expression = parse_expression("lambda * in\n + None - 1.e1 * e1")
    assert expression.names == {"lambda", "in", "None", "e1"}
    assert float(expression({"lambda": 2.0, "in": 3.0, "None": 4.0, "e1": 0.5})) == 5.0


@pytest.mark.parametrize("name", ["name_x", "name_", "name_name_x", "x_name_y", "_name_", "name"])
def test_no_name_is_taken_for_another(name: str) -> None:
    expression = parse_expression(f"2 * {name} + der(sin({name}) - {name})", rates=True)
    assert expression.names == {name}
    assert set(expression.rates) == {f"der(sin({name})-{name})"}


def test_arrays_and_names() -> None:
    expression = parse_expression("a * k ** 2 + step(k - 2)")
    assert expression.names == {"a", "k"}
    np.testing.assert_array_equal(expression({"a": 2.0, "k": np.arange(4.0)}), [0.0, 2.0, 9.0, 19.0])


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "ends too early"),
        ("1 +", "ends too early"),
        ("(1", "never closed"),
        ("1 2", "at '2'"),
        ("1)", "unmatched"),
        ("sin 1", "at '1'"),
        ("min(1)", "two arguments"),
        ("sin(1, 2)", "one argument"),
        ("eval(1)", "no function 'eval'"),
        ("__import__('os')", "no function '__import__'"),
        ("k.real", "not allowed"),
        ("k[0]", "not allowed"),
        ("k if k else 1", "where(a > b, c, d)"),
        ("k > 1 and k < 2", "where(a > b, c, d)"),
        ("k <= 1", "where(a > b, c, d)"),
        ("where(k, 1, 2)", "needs a comparison"),
        ("where(k > 1, 2)", "two values"),
        ("where(k > 1, 2, 3, 4)", "two values"),
        ("where(1 < k < 2, 2, 3)", "two values"),
        ("lambda: 1", "not a valid expression"),
        ("(lambda: 1)()", "not a valid expression"),
        ("[k for k in k]", "not a valid expression"),
        ("(k := 1)", "not allowed"),
        ("'k'", "not allowed"),
        ("1_000", "not allowed"),
        ("0x1F", "not allowed"),
        ("2j", "not allowed"),
        ("1 # 2", "'#' is not allowed"),
        ("2 ^ 3", "written **"),
        ("pow(k, 2)", "written **"),
        ("2k + 1", "A product is written with *"),
        ("2.5e-3 (k + 1)", "A product is written with *"),
        ("(k + 1)(k + 2)", "A product is written with *"),
        ("ln(k)", "The natural logarithm is log(x)."),
        ("arctan(k)", "asin, acos and atan"),
        ("atan2(k, 1)", "2 * atan(y / (sqrt(x**2 + y**2) + x))"),
        ("saturation(k, 0, 1)", "min(max(x, low), high)"),
        ("interp(k, 0, 1)", "a + b * max(x - c, 0)"),
        ("Piecewise(k, 1)", "where(a > b, c, d)"),
        ("sin(*k)", "not allowed"),
        ("sin(x=1)", "not allowed"),
        ("k, 1", "not allowed"),
        ("True and 1", "where(a > b, c, d)"),
        ("k == 1", "not allowed"),
        ("1 // 2", "not allowed"),
        ("²", "'²' is not allowed"),
        ("μ + 1", "'μ' is not allowed"),
        ("\ud800", "is not allowed"),
        ("1\x00", "'\\x00' is not allowed"),
        ("abs(" * 60 + "1" + ")" * 60, f"more than {MAXIMUM_DEPTH}"),
        ("-" * 60 + "1", f"more than {MAXIMUM_DEPTH}"),
        ("-" * 1999 + "1", f"more than {MAXIMUM_DEPTH}"),
        ("1" * 3000, "3000 characters"),
    ],
)
def test_what_is_no_arithmetic_is_refused(text: str, part: str) -> None:
    with pytest.raises(SpecError, match=re.escape(part)):
        parse_expression(text)


@pytest.mark.parametrize(
    "text",
    ["1e-3 * k + foo(k)", "2.5E6 * foo(k)", "foo(k) + (1 if k > 2 else 3)", "0.5 * (k + 1) * foo(k) - max(k, 1) / 3"],
)
def test_a_product_is_advised_only_where_one_is_missing(text: str) -> None:
    with pytest.raises(SpecError, match="is not a valid expression") as told:
        parse_expression(text)
    assert "A product" not in str(told.value)


def test_the_angle_that_is_advised_is_the_angle() -> None:
    angle = parse_expression("2 * atan(y / (sqrt(x**2 + y**2) + x))")
    for x, y in ((1.0, 2.0), (-1.0, 0.5), (-3.0, -1.0), (0.0, -2.0)):
        assert angle({"x": np.float64(x), "y": np.float64(y)}) == pytest.approx(np.arctan2(y, x), rel=1e-12)


def test_what_is_not_finite_is_left_to_the_caller_without_a_warning() -> None:
    assert np.isnan(parse_expression("0 / (k - k)")({"k": np.float64(1.0)}))
    assert np.isinf(parse_expression("9 ** 9 ** 9")({}))
