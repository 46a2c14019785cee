"""Pictures of results, readable without colour; nothing is shown or saved here.

A picture is imported when it is asked for: reports need the figures behind one of them, and no other.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.plotting.data import plot_data
    from obsynth.plotting.estimates import (
        plot_decision,
        plot_detection,
        plot_faults,
        plot_parameters,
        plot_residuals,
        plot_simulation,
        plot_states,
    )
    from obsynth.plotting.guaranteed import plot_hidden_course, plot_intervals, plot_least_thresholds
    from obsynth.plotting.spectra import estimate_gains, plot_gains, plot_poles
    from obsynth.plotting.trade_off import plot_tolerances, plot_trade_off

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
        "data": "plot_data",
        "estimates": (
            "plot_decision plot_detection plot_faults plot_parameters plot_residuals plot_simulation plot_states"
        ),
        "guaranteed": "plot_hidden_course plot_intervals plot_least_thresholds",
        "spectra": "estimate_gains plot_gains plot_poles",
        "trade_off": "plot_tolerances plot_trade_off",
    }.items()
    for name in names.split()
}


def __getattr__(name: str) -> Any:
    if name in _PICTURE_HOMES:
        return getattr(import_module(f"{__name__}.{_PICTURE_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
