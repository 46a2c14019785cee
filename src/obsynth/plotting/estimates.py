"""Estimates of faults, parameters and states on the truth, and residuals against thresholds.

A simulation in one picture: faults against estimates, and what monitors and decisions saw.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.experiments.monitors.monitor import Detection
from obsynth.experiments.simulation import Simulation
from obsynth.numerics.arguments import arguments_checked, real_array
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.observers.decisions import Decision
from obsynth.observers.running import BAND_WIDTH, Estimates
from obsynth.plants.validation import index_of
from obsynth.plotting.panels import (
    BAND_STYLE,
    ESTIMATE_STYLE,
    RESIDUAL_STYLE,
    THRESHOLD_STYLES,
    TRUE_STYLE,
    finish,
    label_time,
    legend_above,
    mark,
    new_panels,
    one_panel,
    tidy,
    with_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Of the model: a parameter that moves faster than the model says leaves it.
MODEL_BAND = "95 % band while the model holds"
CROSSING_MARKERS = ("o", "s", "^")
#: Around what is drawn there is this share of its range, and room for this many usual half-widths of the band.
ROOM_SHARE, USUAL_BANDS = 0.2, 3.0


@arguments_checked
def plot_faults(
    estimates: Estimates,
    *,
    faults: ArrayLike | None = None,
    dt: float = 1.0,
    units: Mapping[str, str] | None = None,
    axes: Iterable[Axes] | None = None,
) -> list[Axes]:
    """Plot each fault estimate, on the true fault delayed by its detectability index.

    Parameters
    ----------
    estimates : Estimates
        From a run of an observer; ``faults (steps, nf)``.
    faults : array_like, optional
        True faults ``(steps, nf)``, not delayed; a single one may be ``(steps,)``.
    dt : float, optional, seconds
        Time between samples.
    units : mapping, optional
        Unit of each fault by name, such as ``plant.units``.
    axes : iterable of Axes, optional
        One for each fault; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each fault.

    Raises
    ------
    SpecError
        ``faults`` has the wrong shape, or there are too few or too many axes.
    """
    panels = new_panels(axes, len(estimates.fault_names))
    _draw(
        panels,
        range(len(panels)),
        estimates.faults,
        estimates.fault_names,
        faults,
        dt,
        units,
        what="faults",
        delays=estimates.fault_delays,
    )
    for panel in panels:
        legend_above(panel)
    return panels


@arguments_checked
def plot_parameters(
    estimates: Estimates,
    *,
    parameters: ArrayLike | None = None,
    dt: float = 1.0,
    units: Mapping[str, str] | None = None,
    axes: Iterable[Axes] | None = None,
) -> list[Axes]:
    """Plot each parameter estimate with the 95 % band of its model, on the true parameter.

    Parameters
    ----------
    estimates : Estimates
        From a run.
    parameters : array_like, optional
        True parameters ``(samples, nq)``; a single one may be ``(samples,)``.
    dt : float, optional, seconds
        Time between samples.
    units : mapping, optional
        Unit of each parameter by name.
    axes : iterable of Axes, optional
        One for each parameter; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each parameter.

    Raises
    ------
    SpecError
        The true parameters have the wrong shape, or there are too few or too many axes.
    """
    panels = new_panels(axes, len(estimates.parameter_names))
    _draw(
        panels,
        range(len(panels)),
        estimates.parameters,
        estimates.parameter_names,
        parameters,
        dt,
        units,
        what="parameters",
        deviations=estimates.parameter_deviations,
    )
    return panels


@arguments_checked
def plot_states(
    estimates: Estimates,
    *,
    states: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    dt: float = 1.0,
    units: Mapping[str, str] | None = None,
    axes: Iterable[Axes] | None = None,
) -> list[Axes]:
    """Plot each state estimate on the true state, delayed as the estimate is; recursive observers with a 95 % band.

    Parameters
    ----------
    estimates : Estimates
        From a run.  Where a state is undetermined there is no band.
    states : array_like, optional
        True states ``(samples, nx)``, not delayed.
    names : sequence of str, optional
        Which states, in this order; all by default.
    dt : float, optional, seconds
        Time between samples.
    units : mapping, optional
        Unit of each state by name.
    axes : iterable of Axes, optional
        One for each state shown; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each state shown.

    Raises
    ------
    SpecError
        The true states have the wrong shape, a name is unknown, or there are too few or too many axes.
    """
    known = estimates.state_names
    chosen = range(len(known)) if names is None else [index_of(name, known, what="The estimates") for name in names]
    panels = new_panels(axes, len(chosen))
    _draw(
        panels,
        chosen,
        estimates.states,
        known,
        states,
        dt,
        units,
        what="states",
        delays=estimates.state_delays,
        deviations=estimates.state_deviations if estimates.has_deviations else None,
    )
    return panels


def _draw(
    panels: Sequence[Axes],
    chosen: Sequence[int],
    values: FloatArray,
    names: Sequence[str],
    truth: ArrayLike | None,
    dt: float,
    units: Mapping[str, str] | None,
    *,
    what: str,
    delays: Sequence[int] | None = None,
    deviations: FloatArray | None = None,
) -> None:
    """Draw one chosen column of ``values (samples, n)`` on each panel, on the truth delayed as the estimate is."""
    true, word = _matching(truth, values.shape, what), "fault" if what == "faults" else "true"
    time, steps = dt * np.arange(len(values)), len(values)
    for panel, i in zip(panels, chosen, strict=True):
        late = 0 if delays is None else delays[i]
        if true is not None:
            label = f"{word}, delayed by {late} sample{'s' * (late > 1)}" if late else word
            panel.plot(time[late:], true[: steps - late, i], **TRUE_STYLE, label=label)
        if deviations is not None:
            half = np.where(np.isfinite(deviations[:, i]), BAND_WIDTH * deviations[:, i], np.nan)
            low, high = values[:, i] - half, values[:, i] + half
            label = MODEL_BAND + (
                "" if true is None else _share_within(true[: steps - late, i], low[late:], high[late:])
            )
            panel.fill_between(time, low, high, **BAND_STYLE, label=label)
        panel.plot(time, values[:, i], **ESTIMATE_STYLE, label="estimate")
        panel.set_ylabel(with_unit(names[i], units))
        tidy(panel)
        if deviations is not None:
            _show_what_moves(panel, values[:, i] if true is None else np.hstack([values[:, i], true[:, i]]), half)
    if panels:
        legend_above(panels[0])
        label_time(panels[-1])


def _share_within(true: FloatArray, low: FloatArray, high: FloatArray) -> str:
    """Return how often the truth lies in a band, in words: a parameter that moves leaves that of its model."""
    known = np.isfinite(true) & np.isfinite(low)
    held = np.count_nonzero((low <= true) & (true <= high) & known)
    return f", contains the truth in {100.0 * held / np.count_nonzero(known):.0f} % of samples" if known.any() else ""


def _matching(given: ArrayLike | None, shape: tuple[int, ...], what: str) -> FloatArray | None:
    """Return the truth ``(samples, n)``; a single signal may be ``(samples,)``."""
    if given is None:
        return None
    raw = np.asarray(given)
    true = as_matrix(raw[:, None] if raw.ndim == 1 else raw, "true signals")
    if true.shape != shape:
        raise SpecError(
            f"The true signals have shape {true.shape}, but the estimates {shape} (samples by signals).", path=what
        )
    return true


def _show_what_moves(panel: Axes, drawn: FloatArray, half: FloatArray) -> None:
    """Let a wide band at the start, or where samples are missing, leave the picture: not what is in it vanish."""
    known = drawn[np.isfinite(drawn)]
    usual = half[np.isfinite(half)]
    if not known.size or not usual.size:
        return
    room = max(ROOM_SHARE * float(np.ptp(known)), USUAL_BANDS * float(np.median(usual)))
    if room > 0.0:
        panel.set_ylim(float(known.min()) - room, float(known.max()) + room)


@arguments_checked
def plot_residuals(
    estimates: Estimates,
    *,
    threshold: ArrayLike | Mapping[str, ArrayLike] | None = None,
    dt: float = 1.0,
    axes: Axes | None = None,
) -> Axes:
    """Plot the norm of the residual, with thresholds and the first sample at which each is crossed.

    Parameters
    ----------
    estimates : Estimates
        From a run of an observer; ``residuals (steps, nr)``.
    threshold : array_like or mapping of str to array_like, optional
        A number or a curve ``(steps,)``, or up to three of them by name.
    dt : float, optional, seconds
        Time between samples.
    axes : Axes, optional
        New ones by default.

    Returns
    -------
    Axes
        With a vertical logarithmic scale, where a residual of exactly zero has no place; linear if all are zero.

    Raises
    ------
    SpecError
        A threshold has the wrong length, or there are more than three.
    """
    steps = len(estimates.residuals)
    named = threshold if isinstance(threshold, Mapping) else {} if threshold is None else {"threshold": threshold}
    curves = {name: _curve(value, name, steps) for name, value in named.items()}
    if len(curves) > len(THRESHOLD_STYLES):
        raise SpecError(f"{len(curves)} thresholds are too many for one picture: give at most 3.", path="threshold")
    panel = one_panel(axes)
    time, size = dt * np.arange(steps), np.linalg.norm(estimates.residuals, axis=1)
    if positive := bool(np.any(size > 0.0)):
        panel.set_yscale("log")
    shown = np.where(size > 0.0, size, np.nan) if positive else size
    panel.plot(time, shown, label="norm of the residual", **RESIDUAL_STYLE)
    for (name, curve), style, marker in zip(curves.items(), THRESHOLD_STYLES, CROSSING_MARKERS, strict=False):
        panel.plot(time, curve, label=name, **style)
        crossed = np.flatnonzero(size > curve)
        if crossed.size:
            first = int(crossed[0])
            label = f"first above it at k = {first} ({time[first]:g} s)"
            mark(panel, time[first], size[first], label, marker=marker, color=style["color"])
    return finish(panel, "norm of the residual")


def _curve(value: ArrayLike, name: str, steps: int) -> FloatArray:
    curve = real_array(value, name)
    if curve.ndim and curve.shape != (steps,):
        raise SpecError(f"{name} needs one number, or {steps} of them: one for each sample.", path="threshold")
    return np.broadcast_to(curve, (steps,)).copy()


#: What each statistic says, on the vertical axis.
_DECISION_LABELS = {
    "chi-square": "chi-square of theta",
    "cusum": "CUSUM",
    "glr": "likelihood ratio",
    "nis": "NIS over a window",
}
#: Values below this share of the threshold say nothing, and would stretch a logarithmic axis.
LEAST_SHARE = 1e-3


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
    """
    panel = one_panel(axes)
    time = dt * np.arange(len(decision.values))
    shown = np.isfinite(decision.thresholds)
    floor = LEAST_SHARE * float(np.min(decision.thresholds[shown], initial=1.0))
    panel.plot(time, np.maximum(decision.values, floor), label=decision.statistic, **RESIDUAL_STYLE)
    panel.plot(time[shown], decision.thresholds[shown], label="threshold", **THRESHOLD_STYLES[0])
    panel.set_yscale("log")
    alarm = decision.alarm
    if alarm is not None:
        blamed = f": {alarm.parameter}" if alarm.parameter else ""
        mark(panel, dt * alarm.k, alarm.value, f"alarm at {dt * alarm.k:g} s{blamed}")
        panel.axvline(dt * alarm.onset, color="0.4", linestyle=":", label=f"onset at {dt * alarm.onset:g} s")
    return finish(panel, _DECISION_LABELS.get(decision.statistic, decision.statistic))


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
_BAND_LINE = {"color": "0.7", "linewidth": 0.6, "linestyle": "-", "zorder": 1.8}
_TRUTH_ON_BAND = {"color": "black", "linewidth": 1.8, "zorder": 2.5}
#: Decades that a logarithmic axis shows below the lowest threshold.
DECADES_BELOW = 3


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
        There are too few or too many axes.
    """
    dt = float(simulation.time[1]) if len(simulation.time) > 1 else 1.0
    count = len(simulation.estimates.fault_names)
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
    """
    panel = one_panel(axes)
    time = dt * np.arange(len(detection.values))
    deciding = np.isfinite(detection.threshold) & (detection.threshold > 0.0)
    shown = np.where(detection.values > 0.0, detection.values, np.nan)
    label, threshold = _DETECTIONS[detection.kind]
    panel.plot(time, shown, label="residual" if "norm" in label else "statistic", **RESIDUAL_STYLE)
    panel.plot(time, np.where(deciding, detection.threshold, np.nan), label=threshold, **THRESHOLD_STYLES[0])
    if np.any(~np.isnan(shown)):
        panel.set_yscale("log")
        if deciding.any():
            # An adaptive threshold may begin next to zero: its least value says nothing about the picture.
            panel.set_ylim(bottom=float(np.median(detection.threshold[deciding])) * 10.0**-DECADES_BELOW)
    if detection.k is not None:
        blamed = f": {detection.fault}" if detection.fault else ""
        mark(panel, time[detection.k], detection.values[detection.k], f"alarm at {detection.time:g} s{blamed}")
    return finish(panel, label)
