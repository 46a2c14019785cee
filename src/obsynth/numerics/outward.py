"""Bounds as short texts, rounded outwards: what is printed is a bound as well."""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, Context


def upper_text(bound: float, digits: int = 4) -> str:
    """Return an upper bound in a few digits, the last rounded up."""
    return _text(bound, digits, ROUND_CEILING)


def lower_text(bound: float, digits: int = 4) -> str:
    """Return a lower bound in a few digits, the last rounded down."""
    return _text(bound, digits, ROUND_FLOOR)


def _text(bound: float, digits: int, rounding: str) -> str:
    if not math.isfinite(bound):
        return f"{bound:g}"
    return f"{float(Context(digits, rounding).create_decimal(repr(float(bound)))):.{digits}g}"
