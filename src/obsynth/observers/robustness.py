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
    return _changed(observer, {"outliers": outliers})


def plain_recursion(observer: Robust) -> Robust:
    """Return the recursion itself: every sensor at each row, at once, taken as it is, and no bounds on states."""
    return _changed(observer, {"outliers": "none", "sensors": None, "state_bounds": None})


def with_all_sensors(observer: Robust) -> Robust:
    """Return the observer with every sensor at each row, at once."""
    return _changed(observer, {"sensors": None})


def _changed(observer: Robust, changes: dict[str, Any]) -> Robust:
    found = replace(observer, **changes)
    if isinstance(observer, DAEObserver) and isinstance(found, DAEObserver) and "steps" in vars(observer):
        # The gate stands outside of the compiled steps.
        vars(found)["steps"] = Steps(found, observer.steps.graph)
    return found
