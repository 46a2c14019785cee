"""Options of the Kalman filter of a constant plant that a filter over a region does not have."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_NOT_OVER_REGION = (
    "initial_state", "initial_covariance", "early_constraints", "outliers", "outlier_limit", "outlier_sizes", "sensors",
    "state_bounds",
)  # fmt: skip


def not_over_region(options: Mapping[str, Any]) -> list[str]:
    """Return which of these options are stated."""
    return [name for name in _NOT_OVER_REGION if options.get(name) is not None and options[name] is not False]
