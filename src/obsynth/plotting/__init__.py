"""Pictures of results, readable without colour; nothing is shown or saved here."""

from obsynth.plotting.faults import plot_faults, plot_poles, plot_residuals

__all__ = ["plot_faults", "plot_poles", "plot_residuals"]
