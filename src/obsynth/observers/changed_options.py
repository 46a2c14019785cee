"""Observers with changed options: with outlier rules for a run on data, or without any, as a plain recursion."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar

Robust = TypeVar("Robust", bound=Any)


def changed(observer: Robust, **options: Any) -> Robust:
    """Return the observer with other options; the steps of a nonlinear one are built once."""
    other = replace(observer, **options)
    if "steps" in vars(observer):
        # What these options do stands outside of the compiled steps.
        vars(other)["steps"] = type(observer.steps)(other, observer.steps.graph)
    return other


def as_run(observer: Robust, outliers: str | None = None, *, stated: str | None = None) -> Robust:
    """Return the observer as a run on data has it: outliers are left out where neither ``outliers``, nor what is
    ``stated`` in the options of its design, says anything of them."""
    wanted = outliers or stated or ("gate" if observer.outliers == "none" else observer.outliers)
    return observer if wanted == observer.outliers else changed(observer, outliers=wanted)


def rule_of_outliers(design: Any) -> str | None:
    """Return what the options of a design state about outliers, as far as its observer still has that rule."""
    stated: str | None = design.options.get("outliers")
    return stated if stated == design.observer.outliers else None


def plain_recursion(observer: Robust) -> Robust:
    """Return the recursion itself: every sensor at each row, at once, taken as it is, and no bounds on states."""
    if observer.outliers == "none" and not observer.sensors and observer.state_bounds is None:
        return observer
    return changed(observer, outliers="none", sensors=None, state_bounds=None)
