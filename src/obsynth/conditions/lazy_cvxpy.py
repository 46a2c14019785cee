"""cvxpy under its own names, loaded at the first of them: it takes a second, and few designs solve an inequality."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    import cvxpy

    # Looked up once: from then on it is a name of this module.
    attribute = globals()[name] = getattr(cvxpy, name)
    return attribute
