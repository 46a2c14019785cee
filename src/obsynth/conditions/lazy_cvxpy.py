"""Lazy import of cvxpy, which takes a second to load and which few designs need."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    import cvxpy

    # Looked up once: from then on it is a name of this module.
    attribute = globals()[name] = getattr(cvxpy, name)
    return attribute
