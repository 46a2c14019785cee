"""The same observer with another way to treat outliers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.dae.steps import Steps
from obsynth.observers.recursive.observer import RecursiveObserver

Robust = TypeVar("Robust", RecursiveObserver, DAEObserver)


def with_outliers(observer: Robust, outliers: str) -> Robust:
    """Return the observer with outliers treated as asked; the steps of a nonlinear one are built once."""
    changes: dict[str, Any] = {"outliers": outliers}
    found = replace(observer, **changes)
    if isinstance(observer, DAEObserver) and isinstance(found, DAEObserver) and "steps" in vars(observer):
        # The gate stands outside of the compiled steps.
        vars(found)["steps"] = Steps(found, observer.steps.graph)
    return found
