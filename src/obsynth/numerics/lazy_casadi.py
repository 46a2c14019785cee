"""Lazy import of CasADi, which has 93 MB and which few plants need."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    import casadi

    # Looked up once: from then on it is a name of this module.
    attribute = globals()[name] = getattr(casadi, name)
    return attribute
