"""A simulation in one picture: faults against estimates, and what the monitors of its residual saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from obsynth.evaluation.monitors import Detection
from obsynth.evaluation.simulating import Simulation
from obsynth.plotting.faults import plot_faults
from obsynth.plotting.panels import MARK_STYLE, RESIDUAL_STYLE, THRESHOLD_STYLES, new_panels, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Names of the statistics on the vertical axis.
_LABELS = {
    "paper": "norm of r",
    "pointwise": "norm of r",
    "window": "window norm of r",
    "chi-square": "chi-square",
    "cusum": "CUSUM",
}
_THRESHOLDS = {
    "paper": "(66): not a pointwise bound",
    "pointwise": "pointwise bound",
    "window": "bound over the window",
    "chi-square": "threshold for Gaussian noise",
    "cusum": "threshold for Gaussian noise",
}
#: An estimate whose typical step from sample to sample is this share of its range is a band, not a line.
NOISY_SHARE = 0.05
#: Such a band lies under the truth.
_BAND = {"color": "0.7", "linewidth": 0.6, "linestyle": "-", "zorder": 1.8}
_TRUTH_ON_BAND = {"color": "black", "linewidth": 1.8, "zorder": 2.5}
#: Decades that a logarithmic axis shows below the lowest threshold.
DECADES_BELOW = 3


def plot_simulation(
    simulation: Simulation, *, detections: Sequence[Detection] = (), units: Mapping[str, str] | None = None
) -> list[Axes]:
    """Plot each fault with its estimate, and below them one panel for each monitor.

    Parameters
    ----------
    simulation : Simulation
        From `obsynth.simulate`.
    detections : sequence of Detection, optional
        What monitors saw in it.
    units : mapping, optional
        Unit of each fault by name, such as ``plant.units``.

    Returns
    -------
    list of Axes
        The faults' panels, then the monitors'; all share their time.

    Raises
    ------
    SpecError
        Never for a simulation and detections of its own.
    """
    count = len(simulation.estimates.fault_names)
    panels = new_panels(None, count + len(detections))
    dt = float(simulation.time[1]) if len(simulation.time) > 1 else 1.0
    plot_faults(simulation.estimates, faults=simulation.faults, dt=dt, units=units, axes=panels[:count])
    for panel, estimate in zip(panels[:count], simulation.estimates.faults.T, strict=True):
        if np.median(np.abs(np.diff(estimate))) > NOISY_SHARE * np.ptp(estimate):
            truth, band = panel.get_lines()
            truth.set(**_TRUTH_ON_BAND)
            band.set(**_BAND)
            panel.legend(loc="best")
    for panel, detection in zip(panels[count:], detections, strict=True):
        plot_detection(detection, dt=dt, axes=panel)
    for panel in panels[:-1]:
        panel.set_xlabel("")
    return panels


def plot_detection(detection: Detection, *, dt: float, axes: Axes | None = None) -> Axes:
    """Plot a statistic with its threshold and the alarm, on a logarithmic scale.

    Parameters
    ----------
    detection : Detection
        From ``monitor.watch``.
    dt : float, seconds
        Between samples.
    axes : Axes, optional
        New ones by default.

    Returns
    -------
    Axes
        Where the threshold is infinite, the monitor does not decide yet, and none is drawn.

    Raises
    ------
    SpecError
        Never for a detection as `obsynth.Monitor` makes it.
    """
    (panel,) = new_panels(None if axes is None else [axes], 1)
    time = dt * np.arange(len(detection.values))
    deciding = np.isfinite(detection.threshold) & (detection.threshold > 0.0)
    shown = np.where(detection.values > 0.0, detection.values, np.nan)
    panel.plot(time, shown, label="residual" if "norm" in _LABELS[detection.kind] else "statistic", **RESIDUAL_STYLE)
    panel.plot(time, np.where(deciding, detection.threshold, np.nan), label=_THRESHOLDS[detection.kind],
               **THRESHOLD_STYLES[0])  # fmt: skip
    if np.any(~np.isnan(shown)):
        panel.set_yscale("log")
        if deciding.any():
            panel.set_ylim(bottom=float(np.min(detection.threshold[deciding])) * 10.0**-DECADES_BELOW)
    if detection.k is not None:
        panel.plot(
            time[detection.k], detection.values[detection.k], marker="o", color="black",
            label=f"alarm at {detection.time:g} s" + (f": {detection.fault}" if detection.fault else ""), **MARK_STYLE,
        )  # fmt: skip
    panel.set_ylabel(_LABELS[detection.kind])
    panel.set_xlabel("time (s)")
    panel.legend(loc="best")
    tidy(panel)
    return panel
