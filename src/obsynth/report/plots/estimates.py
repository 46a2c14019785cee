"""Plots of estimates of faults, parameters and states with the true values, and of residuals with thresholds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, real_array
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.observers.estimates import BAND_WIDTH, Estimates
from obsynth.plants.signal_names import index_of
from obsynth.report.plots.panels import (
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
    share_scale,
    tidy,
    with_unit,
)
from obsynth.results.number_texts import point_in_time

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: Of the model: a parameter that moves faster than the model says leaves it.
MODEL_BAND = "95 % band while the model holds"

CROSSING_MARKERS = ("o", "s", "^")

#: Around what is drawn there is this share of its range, and room for this many usual half-widths of the band.
ROOM_SHARE, USUAL_BANDS = 0.2, 3.0

#: Of more states the worst are drawn, unless axes or names are given.
MOST_STATE_PANELS = 12


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
        True faults ``(steps, nf)``, not delayed, NaN where not known; a single one may be ``(steps,)``.
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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(horizon=30, faults={"f1": obsynth.Step(size=1.0, start=10)})
    >>> run = obsynth.simulate(design, scenario)
    >>> axes = obsynth.plotting.plot_faults(run.estimates, faults=run.faults, dt=1.0)
    >>> len(axes)
    1
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
    share_scale(panels, [(units or {}).get(name) for name in estimates.fault_names])
    above: list[str] = []
    for panel in panels:
        labels = panel.get_legend_handles_labels()[1]
        # One above the other, panels share a legend that says the same; axes of the caller stand anywhere.
        if axes is not None or labels != above:
            legend_above(panel)
        above = labels
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
    >>> axes = obsynth.plotting.plot_parameters(run.estimates, parameters=run.parameters)
    >>> len(axes)
    1
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


def _worst_states(estimates: Estimates, states: ArrayLike | None) -> tuple[list[int], str]:
    """Return the states with the largest errors, relative to their ranges, and a sentence that says so; without a truth
    those with the widest bands."""
    true, values = _matching(states, estimates.states.shape, "states"), estimates.states
    if true is not None:
        misses = [true[: len(true) - late, i] - values[late:, i] for i, late in enumerate(estimates.state_delays)]
        size, ranges = np.array([np.nanmean(miss**2) ** 0.5 for miss in misses]), np.ptp(true, axis=0)
        what = "largest errors relative to their ranges"
    elif estimates.has_deviations:
        size, ranges, what = np.nanmedian(estimates.state_deviations, axis=0), np.ptp(values, axis=0), "widest bands"
    else:
        size, ranges, what = np.ptp(values, axis=0), np.ones(values.shape[1]), "largest motion"
    order = np.argsort(-size / np.where(ranges > 0.0, ranges, 1.0), kind="stable")[:MOST_STATE_PANELS]
    title = f"The {MOST_STATE_PANELS} of {values.shape[1]} states with the {what}"
    return [int(i) for i in order], title


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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(horizon=30, faults={"f1": obsynth.Step(size=1.0, start=10)})
    >>> run = obsynth.simulate(design, scenario)
    >>> axes = obsynth.plotting.plot_states(run.estimates, states=run.states, dt=1.0)
    >>> len(axes)
    2
    """
    known = estimates.state_names
    chosen = range(len(known)) if names is None else [index_of(name, known, what="The estimates") for name in names]
    title = ""
    if names is None and axes is None and len(known) > MOST_STATE_PANELS:
        chosen, title = _worst_states(estimates, states)
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
    if title and (figure := panels[0].get_figure()) is not None:
        figure.suptitle(title, fontsize="medium")
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
        if true is not None and not np.isnan(true[:, i]).all():
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


def _matching(values: ArrayLike | None, shape: tuple[int, ...], what: str) -> FloatArray | None:
    """Return the truth ``(samples, n)``, NaN where it is not known; a single signal may be ``(samples,)``."""
    if values is None:
        return None
    raw = np.asarray(values)
    raw = raw[:, None] if raw.ndim == 1 else raw
    unknown = np.isnan(raw) if raw.dtype.kind == "f" else np.zeros(raw.shape, dtype=bool)
    true = np.where(unknown, np.nan, as_matrix(np.where(unknown, 0.0, raw) if unknown.any() else raw, "true signals"))
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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(horizon=30, faults={"f1": obsynth.Step(size=1.0, start=10)})
    >>> run = obsynth.simulate(design, scenario)
    >>> axes = obsynth.plotting.plot_residuals(run.estimates, dt=1.0)
    >>> axes.get_xlabel()
    'time (s)'
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
    values = np.where(size > 0.0, size, np.nan) if positive else size
    panel.plot(time, values, label="norm of the residual", **RESIDUAL_STYLE)
    for (name, curve), style, marker in zip(curves.items(), THRESHOLD_STYLES, CROSSING_MARKERS, strict=False):
        panel.plot(time, curve, label=name, **style)
        crossed = np.flatnonzero(size > curve)
        if crossed.size:
            first = int(crossed[0])
            label = f"first above it at k = {first} ({point_in_time(time[first])})"
            mark(panel, time[first], size[first], label, marker=marker, color=style["color"])
    return finish(panel, "norm of the residual\n(units of the outputs)")


def _curve(value: ArrayLike, name: str, steps: int) -> FloatArray:
    curve = real_array(value, name)
    if curve.ndim and curve.shape != (steps,):
        raise SpecError(f"{name} needs one number, or {steps} of them: one for each sample.", path="threshold")
    return np.broadcast_to(curve, (steps,)).copy()
