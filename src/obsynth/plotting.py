"""Plots of results, readable without colour; functions return axes, and neither show nor save them.

A picture is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from obsynth.monitoring.plots.data import plot_data as plot_data
    from obsynth.report.plots.estimates import plot_faults as plot_faults
    from obsynth.report.plots.estimates import plot_parameters as plot_parameters
    from obsynth.report.plots.estimates import plot_residuals as plot_residuals
    from obsynth.report.plots.estimates import plot_states as plot_states
    from obsynth.report.plots.frequency import estimate_gains as estimate_gains
    from obsynth.report.plots.frequency import plot_gains as plot_gains
    from obsynth.report.plots.guaranteed import plot_hidden_course as plot_hidden_course
    from obsynth.report.plots.guaranteed import plot_intervals as plot_intervals
    from obsynth.report.plots.guaranteed import plot_least_thresholds as plot_least_thresholds
    from obsynth.report.plots.simulation import plot_decision as plot_decision
    from obsynth.report.plots.simulation import plot_detection as plot_detection
    from obsynth.report.plots.simulation import plot_simulation as plot_simulation
    from obsynth.report.plots.spectra import plot_poles as plot_poles
    from obsynth.report.plots.trade_off import plot_delays as plot_delays
    from obsynth.report.plots.trade_off import plot_trade_off as plot_trade_off
    from obsynth.studies.plots.tolerances import plot_tolerances as plot_tolerances

#: The pictures by the module that holds them.
_PICTURES = {
    "monitoring.plots.data": "plot_data",
    "report.plots.estimates": "plot_faults plot_parameters plot_residuals plot_states",
    "report.plots.frequency": "estimate_gains plot_gains",
    "report.plots.guaranteed": "plot_hidden_course plot_intervals plot_least_thresholds",
    "report.plots.simulation": "plot_decision plot_detection plot_simulation",
    "report.plots.spectra": "plot_poles",
    "report.plots.trade_off": "plot_delays plot_trade_off",
    "studies.plots.tolerances": "plot_tolerances",
}
_PICTURE_HOMES = {name: f"obsynth.{module}" for module, names in _PICTURES.items() for name in names.split()}

__all__ = sorted(_PICTURE_HOMES)


def __getattr__(name: str) -> Any:
    if name in _PICTURE_HOMES:
        return getattr(import_module(_PICTURE_HOMES[name]), name)
    from obsynth.numerics.suggestions import not_in_module

    raise not_in_module(__name__, name, __all__, {})


def __dir__() -> list[str]:
    return sorted(__all__)
