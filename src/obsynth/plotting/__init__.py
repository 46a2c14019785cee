"""Pictures of results, readable without colour; nothing is shown or saved here.

A picture is imported when it is asked for: reports need the figures behind one of them, and no other.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.plotting.estimates import (
        plot_data,
        plot_decision,
        plot_detection,
        plot_faults,
        plot_hidden_course,
        plot_intervals,
        plot_least_thresholds,
        plot_parameters,
        plot_residuals,
        plot_simulation,
        plot_states,
        plot_tolerances,
    )
    from obsynth.plotting.trade_off import estimate_gains, plot_gains, plot_poles, plot_trade_off

__all__ = [
    "estimate_gains",
    "plot_data",
    "plot_decision",
    "plot_detection",
    "plot_faults",
    "plot_gains",
    "plot_hidden_course",
    "plot_intervals",
    "plot_least_thresholds",
    "plot_parameters",
    "plot_poles",
    "plot_residuals",
    "plot_simulation",
    "plot_states",
    "plot_tolerances",
    "plot_trade_off",
]

_PICTURE_HOMES = {
    name: module
    for module, names in {
        "estimates": (
            "plot_data plot_decision plot_detection plot_faults plot_hidden_course plot_intervals "
            "plot_least_thresholds plot_parameters plot_residuals plot_simulation plot_states "
            "plot_tolerances"
        ),
        "trade_off": "estimate_gains plot_gains plot_poles plot_trade_off",
    }.items()
    for name in names.split()
}


def __getattr__(name: str) -> Any:
    if name in _PICTURE_HOMES:
        return getattr(import_module(f"{__name__}.{_PICTURE_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
