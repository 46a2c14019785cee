"""CasADi under its own names, loaded at the first of them: few plants need it, and it has 93 MB."""

from __future__ import annotations

from typing import Any


def __getattr__(name: str) -> Any:
    import casadi

    # Looked up once: from then on it is a name of this module.
    attribute = globals()[name] = getattr(casadi, name)
    return attribute
