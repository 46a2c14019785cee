"""Packages that only some users need: imported when asked for, and named when they are missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from obsynth.errors import SpecError


def imported(module: str, *, extra: str | None, what: str = "This") -> Any:
    """Return a module; where it is not installed, raise `SpecError` with the one command that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        wanted = package if extra is None else f"'obsynth[{extra}]'"
        raise SpecError(
            f"{what} needs {package}, which is not installed: pip install {wanted}", path=package
        ) from error
