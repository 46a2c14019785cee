"""Pictures of results, readable without colour; nothing is shown or saved here."""

from obsynth.plotting.delta_scan import plot_delta_scan
from obsynth.plotting.faults import plot_faults, plot_poles, plot_residuals
from obsynth.plotting.frequency import plot_continuous_poles, plot_gains
from obsynth.plotting.recursive import plot_decision, plot_parameters, plot_states
from obsynth.plotting.simulation import plot_detection, plot_simulation

__all__ = [
    "plot_continuous_poles",
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
]
