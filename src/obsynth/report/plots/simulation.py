"""Plots of a simulation: faults with estimates, statistics of monitors, and decisions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.detection import Decision, Detection
from obsynth.report.plots.estimates import plot_faults, plot_parameters
from obsynth.report.plots.panels import (
    RESIDUAL_STYLE,
    THRESHOLD_STYLES,
    finish,
    legend_above,
    mark,
    new_panels,
    one_panel,
)
from obsynth.results.number_texts import point_in_time
from obsynth.simulation.simulate import Simulation

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: What each statistic says, on the vertical axis.
_DECISION_LABELS = {
    "chi-square": "chi-square of theta",
    "cusum": "CUSUM",
    "glr": "likelihood ratio",
    "nis": "NIS over a window",
}

#: Values below this share of the threshold say nothing, and would stretch a logarithmic axis.
LEAST_SHARE = 1e-3

#: Of each kind of monitor: its statistic on the vertical axis, and its threshold.
_DETECTIONS = {
    "paper": ("norm of r", "(66): not a pointwise bound"),
    "pointwise": ("norm of r", "pointwise bound"),
    "window": ("window norm of r", "bound over the window"),
    "chi-square": ("chi-square", "threshold for Gaussian noise"),
    "cusum": ("CUSUM", "threshold for Gaussian noise"),
}

#: An estimate whose typical step from sample to sample is this share of its range is a band, not a line.
NOISY_SHARE = 0.05

#: Such a band lies under the truth.
_BAND_LINE = {"linewidth": 0.6, "zorder": 1.8}

_TRUTH_ON_BAND = {"color": "black", "linewidth": 1.8, "zorder": 2.5}

#: Decades that a logarithmic axis shows below the lowest threshold.
DECADES_BELOW = 3

#: Its axis ends at so many times the largest statistic, or the usual threshold.
ROOM_ABOVE = 2.0


@arguments_checked
def plot_decision(decision: Decision, *, dt: float = 1.0, axes: Axes | None = None) -> Axes:
    """Plot a decision statistic, its threshold, and the alarm with its onset, on a logarithmic scale.

    Parameters
    ----------
    decision : Decision
        From `obsynth.decide`.
    dt : float, optional, seconds
        Time between samples.
    axes : Axes, optional
        New ones by default.

    Returns
    -------
    Axes
        With the statistic.

    Raises
    ------
    SpecError
        Never for a decision as `obsynth.decide` makes it.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.TimeVaryingDescriptorSystem(
    ...     E=None,
    ...     A=[["0.9 + 0.05 * sin(k)"]],
    ...     C=[[1.0]],
    ...     Phi=[[1.0]],
    ...     dt=1.0,
    ...     horizon=100,
    ...     parameter_names=["leak"],
    ... )
    >>> design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.95)
    >>> scenario = obsynth.Scenario(horizon=99, faults={"leak": obsynth.Step(size=0.5, start=40)}, noise=1.0)
    >>> run = obsynth.simulate(design, scenario)
    >>> decision = obsynth.decide(design.observer, run.estimates, nominal=[0.0])
    >>> obsynth.plotting.plot_decision(decision).get_xlabel()
    'time (s)'
    """
    panel = one_panel(axes)
    time = dt * np.arange(len(decision.values))
    has_threshold = np.isfinite(decision.thresholds)
    floor = LEAST_SHARE * float(np.min(decision.thresholds[has_threshold], initial=1.0))
    panel.plot(time, np.maximum(decision.values, floor), label=decision.statistic, **RESIDUAL_STYLE)
    panel.plot(time[has_threshold], decision.thresholds[has_threshold], label="threshold", **THRESHOLD_STYLES[0])
    panel.set_yscale("log")
    alarm = decision.alarm
    if alarm is not None:
        blamed = f": {alarm.parameter}" if alarm.parameter else ""
        mark(panel, dt * alarm.k, alarm.value, f"alarm at {point_in_time(dt * alarm.k)}{blamed}")
        panel.axvline(dt * alarm.onset, color="0.4", linestyle=":", label=f"onset at {point_in_time(dt * alarm.onset)}")
    return finish(panel, _DECISION_LABELS.get(decision.statistic, decision.statistic))


@arguments_checked
def plot_simulation(
    simulation: Simulation,
    *,
    detections: Sequence[Detection | Decision] = (),
    units: Mapping[str, str] | None = None,
    axes: Iterable[Axes] | None = None,
) -> list[Axes]:
    """Plot each fault (or parameter, with its 95 % band) with its estimate, and below them one panel for each monitor.

    Parameters
    ----------
    simulation : Simulation
        From `obsynth.simulate`.
    detections : sequence of Detection or Decision, optional
        What monitors saw in it, from ``monitor.watch`` or `obsynth.decide`.
    units : mapping, optional
        Unit of each fault by name, such as ``plant.units``.
    axes : iterable of Axes, optional
        As many as faults and detections; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        The faults' panels, then the monitors'; all share their time.

    Raises
    ------
    SpecError
        There are too few or too many axes, or nothing to draw: no fault is estimated and no monitor given.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(horizon=30, faults={"f1": obsynth.Step(size=1.0, start=10)})
    >>> axes = obsynth.plotting.plot_simulation(obsynth.simulate(design, scenario))
    >>> axes[-1].get_xlabel()
    'time (s)'
    """
    dt = float(simulation.time[1]) if len(simulation.time) > 1 else 1.0
    count = len(simulation.estimates.fault_names)
    if not count + len(detections):
        raise SpecError(
            "The simulated design estimates no faults: give what its monitor saw, detections=[...], or draw "
            "plot_residuals(simulation.estimates) or plot_states(simulation.estimates).",
            path="simulation",
        )
    panels = new_panels(axes, count + len(detections))
    true = simulation.faults[:, list(simulation.fault_columns)]
    if simulation.estimates.has_deviations:
        plot_parameters(simulation.estimates, parameters=true, dt=dt, units=units, axes=panels[:count])
    else:
        _plot_linear(simulation, true, panels[:count], dt, units)
    for panel, detection in zip(panels[count:], detections, strict=True):
        if isinstance(detection, Decision):
            plot_decision(detection, dt=dt, axes=panel)
        else:
            plot_detection(detection, dt=dt, axes=panel)
    for panel in panels[:-1]:
        panel.set_xlabel("")
    return panels


def _plot_linear(
    simulation: Simulation, true: FloatArray, panels: list[Axes], dt: float, units: Mapping[str, str] | None
) -> None:
    plot_faults(simulation.estimates, faults=true, dt=dt, units=units, axes=panels)
    for panel, estimate in zip(panels, simulation.estimates.faults.T, strict=True):
        if np.median(np.abs(np.diff(estimate))) > NOISY_SHARE * np.ptp(estimate):
            truth, band = panel.get_lines()
            truth.set(**_TRUTH_ON_BAND)
            band.set(**_BAND_LINE)
            legend_above(panel)


@arguments_checked
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
        Never for a detection as `obsynth.types.Monitor` makes it.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(
    ...     horizon=30,
    ...     faults={"f1": obsynth.Step(size=1.0, start=10)},
    ...     disturbances={"d1": obsynth.Uniform(low=-0.1, high=0.1)},
    ... )
    >>> detection = obsynth.monitor(design, scenario).watch(obsynth.simulate(design, scenario).estimates)
    >>> obsynth.plotting.plot_detection(detection, dt=1.0).get_xlabel()
    'time (s)'
    """
    panel = one_panel(axes)
    time = dt * np.arange(len(detection.values))
    deciding = np.isfinite(detection.threshold) & (detection.threshold > 0.0)
    values = np.where(detection.values > 0.0, detection.values, np.nan)
    label, threshold = _DETECTIONS[detection.kind]
    panel.plot(time, values, label="residual" if "norm" in label else "statistic", **RESIDUAL_STYLE)
    panel.plot(time, np.where(deciding, detection.threshold, np.nan), label=threshold, **THRESHOLD_STYLES[0])
    if np.any(~np.isnan(values)):
        panel.set_yscale("log")
        if deciding.any():
            # An adaptive threshold may begin next to zero, one without disturbances ends there: at rounding level.
            usual, most = float(np.median(detection.threshold[deciding])), float(np.nanmax(values))
            least = max(usual * 10.0**-DECADES_BELOW, float(np.finfo(np.float64).eps) * most)
            panel.set_ylim(least, ROOM_ABOVE * max(most, usual))
    if detection.k is not None:
        blamed = f": {detection.fault}" if detection.fault else ""
        label_of_alarm = f"alarm at {point_in_time(float(time[detection.k]))}{blamed}"
        mark(panel, time[detection.k], detection.values[detection.k], label_of_alarm)
    return finish(panel, label)
