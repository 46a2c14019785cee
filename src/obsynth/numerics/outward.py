"""Printed bounds: few digits, rounded outwards, so that the printed number is a bound as well."""

from __future__ import annotations

from decimal import ROUND_CEILING, ROUND_FLOOR, Context


def upper(bound: float, digits: int) -> float:
    """Return an upper bound in a few digits, the last rounded up."""
    return _rounded(bound, digits, ROUND_CEILING)


def lower(bound: float, digits: int) -> float:
    """Return a lower bound in a few digits, the last rounded down."""
    return _rounded(bound, digits, ROUND_FLOOR)


def upper_text(bound: float, digits: int = 4) -> str:
    """Return an upper bound as a text in a few digits, the last rounded up."""
    return f"{upper(bound, digits):.{digits}g}"


def lower_text(bound: float, digits: int = 4) -> str:
    """Return a lower bound as a text in a few digits, the last rounded down."""
    return f"{lower(bound, digits):.{digits}g}"


def _rounded(bound: float, digits: int, way: str) -> float:
    return float(Context(digits, way).create_decimal(repr(float(bound))))
