"""Pictures of results, readable without colour; nothing is shown or saved here."""

from obsynth.plotting.data import plot_data
from obsynth.plotting.estimates import plot_faults, plot_parameters, plot_residuals, plot_states
from obsynth.plotting.frequency import estimate_gains, plot_gains
from obsynth.plotting.simulation import plot_decision, plot_detection, plot_simulation
from obsynth.plotting.spectra import plot_poles
from obsynth.plotting.trade_off import plot_delta_scan, plot_tolerances, plot_trade_off

__all__ = [
    "estimate_gains",
    "plot_data",
    "plot_decision",
    "plot_delta_scan",
    "plot_detection",
    "plot_faults",
    "plot_gains",
    "plot_parameters",
    "plot_poles",
    "plot_residuals",
    "plot_simulation",
    "plot_states",
    "plot_tolerances",
    "plot_trade_off",
]
