"""Estimates of faults, parameters and states on the truth, and residuals against thresholds.

A simulation in one picture: faults against estimates, and what monitors and decisions saw.

A design on one's own data: measured outputs, estimates with intervals, residuals, statistics and alarms.

Pictures of guaranteed tests: how small a fault so many samples tell, and the interval in which it lies.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.data.log_observers import DECIDING
from obsynth.data.run import DataRun
from obsynth.errors import SpecError
from obsynth.experiments.monitors.monitor import Detection
from obsynth.experiments.simulation import Simulation
from obsynth.experiments.tolerance_study import ADAPTIVE, FIXED, ToleranceStudy
from obsynth.methods.guaranteed_test.result import GuaranteedTest
from obsynth.numerics.arguments import FloatArray, arguments_checked, as_matrix, real_array
from obsynth.observers.decisions import Decision
from obsynth.observers.running import BAND_WIDTH, Estimates
from obsynth.plants.descriptor import index_of
from obsynth.plotting.panels import (
    BAND_STYLE,
    ESTIMATE_STYLE,
    LINE_COLOURS,
    PANEL_HEIGHT,
    RESIDUAL_STYLE,
    THRESHOLD_STYLES,
    TRUE_STYLE,
    WIDE_AXIS,
    WIDTH,
    finish,
    label_time,
    legend_above,
    mark,
    new_panels,
    one_panel,
    plain_decades,
    short_dates,
    tidy,
    with_unit,
)
from obsynth.results.design import ObserverDesign, unverified_mark

if TYPE_CHECKING:
    import pandas as pd
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
#: Its axis ends at so many times the largest statistic, or the usual threshold.
ROOM_ABOVE = 2.0


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
            # An adaptive threshold may begin next to zero, one without disturbances ends there: at rounding level.
            usual, most = float(np.median(detection.threshold[deciding])), float(np.nanmax(shown))
            least = max(usual * 10.0**-DECADES_BELOW, float(np.finfo(np.float64).eps) * most)
            panel.set_ylim(least, ROOM_ABOVE * max(most, usual))
    if detection.k is not None:
        blamed = f": {detection.fault}" if detection.fault else ""
        mark(panel, time[detection.k], detection.values[detection.k], f"alarm at {detection.time:g} s{blamed}")
    return finish(panel, label)


#: Kinds of panels, in their order.
PANELS = ("outputs", "faults", "residuals", "statistic", "shares")
#: Letters in a line of the sentence below a picture: what fits below panels of a page, in small print.
STATEMENT_LETTERS = 105
#: Signals of a kind that are drawn.
MOST_DRAWN = 6
#: A statistic this many times above its threshold gets a logarithmic axis.
_FAR_ABOVE = 30.0
#: Rows in which nothing is decided lie in grey, those with an alarm in red.
_UNDECIDED_ROWS: dict[str, Any] = {"color": "0.9", "linewidth": 0.0, "zorder": 0}
_ALARM: dict[str, Any] = {"color": "tab:red", "alpha": 0.15, "linewidth": 0.0, "zorder": 0}


@arguments_checked
def plot_data(
    run: DataRun,
    *,
    design: ObserverDesign | None = None,
    show: Sequence[str] = PANELS,
    axes: Iterable[Axes] | None = None,
) -> list[Axes]:
    """Plot what a design says of measured data.

    Parameters
    ----------
    run : DataRun
        From `obsynth.run_on_data` without ``out``, so that it holds its table.
    design : ObserverDesign, optional
        Which was run: gives units, and the standard deviations of the fault estimates of linear designs.
    show : sequence of {"outputs", "faults", "residuals", "statistic", "shares"}, optional
        What is drawn, of what there is: measured outputs with their estimates, fault estimates with 95 % intervals of
        the stated noise (with adaptive thresholds: their threshold and the guaranteed interval of the fault), residuals
        with the thresholds of the run, the statistic of its monitor, and how much of an adaptive threshold each
        constant with a tolerance makes.
    axes : iterable of Axes, optional
        As many as there are panels; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each of the first six outputs and faults, one for the residuals of each unit, one for the statistic,
        one for the shares.  Rows in which nothing is decided (warm-up, gaps) lie in grey, rows with an alarm in red; in
        the panel of a fault those that name it.

    Raises
    ------
    SpecError
        The run holds no table, ``show`` names something else, or there are too few or too many axes.
    """
    if run.table is None or run.measured is None:
        raise SpecError("The run holds no table, since it was written to a file: run it without out.", path="run")
    unknown = [part for part in show if part not in PANELS]
    if isinstance(show, str) or unknown:
        raise SpecError(f"show is {show!r}: use some of {', '.join(PANELS)}.", path="show")
    plans = _plans(run.table, run.measured, show, design)
    panels = new_panels(axes, len(plans), size=(WIDTH, PANEL_HEIGHT * max(len(plans), 1) + 0.6))
    units = {} if design is None else dict(design.plant.units)
    # A marked alarm explains the red rows as well.
    told = {"alarm"} if any(part == "faults" and name in run.alarms for part, name in plans) else set[str]()
    drawing = _Drawing(run, run.table, units, design)
    for panel, (part, name) in zip(panels, plans, strict=True):
        _shade(panel, run.table, told, _alarm_rows(run, run.table, part, name))
        getattr(drawing, part)(panel, name)
        legend_above(panel)
        tidy(panel)
    mark = "" if design is None or not design.report.checks else unverified_mark(design.report)
    if panels and mark:
        panels[0].annotate(
            mark,
            (0.0, 1.0),
            xycoords="figure fraction",
            xytext=(4, -4),
            textcoords="offset points",
            va="top",
            fontsize=8,
            color="tab:red",
        )
    if panels and run.statement:
        # What an alarm means stands below the picture, as in the run's summary.
        panels[-1].annotate(
            fill(f"The threshold: {run.statement}.", STATEMENT_LETTERS),
            (0.0, 0.0),
            xycoords="axes fraction",
            xytext=(0, -36),
            textcoords="offset points",
            va="top",
            fontsize=7,
        )
    if panels and run.stamps.is_dated:
        short_dates(panels[-1], run.stamps.zone)
    elif panels:
        label_time(panels[-1])
    return panels


def panel_count(run: DataRun, show: Sequence[str] = PANELS, *, design: ObserverDesign | None = None) -> int:
    """Return how many axes `plot_data` needs."""
    return 0 if run.table is None or run.measured is None else len(_plans(run.table, run.measured, show, design))


def _plans(
    table: pd.DataFrame, measured: pd.DataFrame, show: Sequence[str], design: ObserverDesign | None
) -> list[tuple[str, str]]:
    """Return part and signal of each panel."""
    columns = [str(name) for name in table.columns]
    estimated = {name[5:-1] for name in columns if name.startswith("xhat[")}
    # The input of a linearised plant that is one in every row is in no log.
    shift = getattr(getattr(getattr(design, "plant", None), "uncertainty", None), "shift", None)
    outputs = [str(name) for name in measured.columns if name not in ("time", shift)]
    # Known inputs come first and are no outputs; of these the estimated ones say more.
    outputs.sort(key=lambda name: name not in estimated)
    plans = [("outputs", name) for name in outputs[:MOST_DRAWN]]
    plans += [("faults", name) for name in [name for name in columns if name.startswith("fhat[")][:MOST_DRAWN]]
    # Residuals of unlike units would hide one another.
    plans += [("residuals", unit) for unit in dict.fromkeys(_residual_units(columns, design).values())]
    plans += [("statistic", "")] if "statistic" in columns else []
    plans += [("shares", "")] if any(name.startswith("share ") for name in columns) else []
    return [plan for plan in plans if plan[0] in show]


def _residual_units(columns: Iterable[Any], design: ObserverDesign | None) -> dict[str, str]:
    """Return the residuals that are drawn, with their units."""
    units: Mapping[str, str] = {} if design is None else design.plant.units
    names = [str(name) for name in columns if str(name).startswith("r[")][:MOST_DRAWN]
    return {name: unit if (unit := units.get(name[2:-1], "")) != "1" else "" for name in names}


@dataclass(frozen=True)
class _Drawing:
    """What is drawn of a run: one method for each kind of panel, by its name, for the signal of that panel."""

    run: DataRun
    table: Any
    units: dict[str, str]
    design: Any

    def outputs(self, panel: Axes, name: str) -> None:
        """Draw a measured output with its estimate."""
        measured: Any = self.run.measured
        panel.plot(measured["time"], measured[name], label="measured", **{**TRUE_STYLE, "linewidth": 2.5})
        column = f"xhat[{name}]"
        if column in self.table:
            panel.plot(self._times(column), self.table[column], label="estimate", **ESTIMATE_STYLE)
        panel.set_ylabel(with_unit(name, self.units))

    def faults(self, panel: Axes, column: str) -> None:
        """Draw a fault estimate with its interval, its thresholds and its first alarm."""
        run, table = self.run, self.table
        name, times = column[5:-1], self._times(column)
        values, deviation = table[column].to_numpy(float), self._deviation(column)
        guaranteed, adaptive = f"lowest {name}" in table, f"threshold {column}" in table
        if guaranteed:
            low, high = table[f"lowest {name}"].to_numpy(float), table[f"highest {name}"].to_numpy(float)
            panel.fill_between(times, low, high, label="guaranteed interval", **BAND_STYLE)
        elif deviation is not None and not adaptive:
            low, high = values - BAND_WIDTH * deviation, values + BAND_WIDTH * deviation
            band = MODEL_BAND if f"sd {column}" in table else "95 % interval of the stated noise"
            panel.fill_between(times, low, high, label=band, **BAND_STYLE)
        panel.plot(times, values, label="estimate", **{**ESTIMATE_STYLE, "linestyle": "-"})
        if adaptive:
            limit = table[f"threshold {column}"].to_numpy(float)
            for side, label in ((limit, "threshold without a fault"), (-limit, None)):
                panel.plot(table["time"], side, label=label, **THRESHOLD_STYLES[0])
        if (level := run.thresholds.get(column)) is not None:
            biases = () if self.design is None else getattr(self.design.plant, "sensor_faults", ())
            centre = 0.0
            if self.design is not None and name not in biases:
                # Nonlinear plants estimate their parameters themselves, not deviations from a point.
                centre = getattr(self.design.plant, "operating_point", {}).get(name, 0.0)
            _limits(panel, centre, level, "threshold", THRESHOLD_STYLES[0])
        if column in run.alarms:
            row = int(table["alarm"].astype(str).str.contains(column, regex=False).to_numpy().argmax())
            mark(panel, times.iloc[row], values[row], f"alarm at {run.stamps.shown(run.alarms[column])}")
        panel.set_ylabel(with_unit(name, self.units))

    def residuals(self, panel: Axes, unit: str) -> None:
        """Draw the residuals of a unit with the thresholds of the run."""
        units = _residual_units(self.table.columns, self.design)
        names = [name for name, own in units.items() if own == unit]
        for name, colour in zip(names, LINE_COLOURS, strict=False):
            style = {**RESIDUAL_STYLE, "linewidth": 0.9, "color": colour}
            panel.plot(self.table["time"], self.table[name], label=name, **style)
        for i, name in enumerate(name for name in names if name in self.run.thresholds):
            style = THRESHOLD_STYLES[i % len(THRESHOLD_STYLES)]
            _limits(panel, 0.0, self.run.thresholds[name], f"threshold of {name}", style)
        panel.set_ylabel(with_unit("residuals", {"residuals": unit}))

    def statistic(self, panel: Axes, _: str) -> None:
        """Draw the statistic of the monitor with its threshold and its first alarm."""
        run, table = self.run, self.table
        panel.plot(table["time"], table["statistic"], label="statistic", **RESIDUAL_STYLE)
        panel.plot(table["time"], table["threshold"], label="threshold", **THRESHOLD_STYLES[0])
        values, levels = table["statistic"].to_numpy(float), table["threshold"].to_numpy(float)
        passed = np.flatnonzero(values > levels)
        own = [run.alarms[name] for name in run.alarms if name not in run.thresholds]
        if passed.size and own:
            first = int(passed[0])
            mark(panel, table["time"].iloc[first], values[first], f"first alarm at {run.stamps.shown(own[0])}")
        level = float(np.nanmax(levels, initial=0.0))
        if level > 0.0 and np.nanmax(values, initial=0.0) > _FAR_ABOVE * level:
            panel.set_yscale("symlog", linthresh=level)
        panel.set_ylabel("statistic")

    def shares(self, panel: Axes, _: str) -> None:
        """Stack what each constant makes of the threshold; those that make least count together."""
        names = [name for name in self.table.columns if name.startswith("share ")]
        values = 100.0 * np.nan_to_num(self.table[names].to_numpy(float))
        order = np.argsort(-values.mean(axis=0), kind="stable")
        shown, others = order[: MOST_DRAWN - 1], order[MOST_DRAWN - 1 :]
        parts = [values[:, i] for i in shown] + ([values[:, others].sum(axis=1)] if len(others) else [])
        labels = [names[i].removeprefix("share ") for i in shown] + (["other constants"] if len(others) else [])
        panel.stackplot(
            self.table["time"], parts, labels=labels, colors=LINE_COLOURS[: len(parts)], alpha=0.7, linewidth=0.0
        )
        panel.set_ylim(0.0, 100.0)
        panel.set_ylabel("share of the\nthreshold (%)")

    def _times(self, column: str) -> Any:
        """Return the time of which a column is the estimate."""
        own = f"time of {column}"
        return self.table[own if own in self.table else "time"]

    def _deviation(self, column: str) -> Any:
        if f"sd {column}" in self.table:
            return self.table[f"sd {column}"].to_numpy(float)
        # Of a continuous design it is that for one second between samples: of no use without the sampling.
        if self.design is None or not getattr(self.design.observer, "dt", 0.0) > 0.0:
            return None
        rows = (check.value for check in self.design.report.checks if check.name == f"noise in {column}")
        return next(map(float, rows), None)


def _limits(panel: Axes, centre: float, level: float, label: str, style: dict[str, Any]) -> None:
    """Draw a threshold on both sides of a centre."""
    for side, text in ((level, label), (-level, None)):
        panel.axhline(centre + side, label=text, **style)


def _alarm_rows(run: DataRun, table: Any, part: str, column: str) -> Any:
    """Return in which rows a panel shows an alarm: one of its own fault, of a residual, or of the monitor."""
    if part == "outputs" or "alarm" not in table:
        return np.zeros(len(table), dtype=bool)

    def concerns(alarm: str) -> bool:
        # "fhat[leak]; pointwise: leak or clog": what passed its threshold; a monitor and whom it names.
        by, _, named = alarm.partition(": ")
        if part == "faults":
            return by == column or column[5:-1] in named.split(" or ")
        return bool(by) and (by not in run.thresholds or (part == "residuals" and by.startswith("r[")))

    texts = table["alarm"].astype(str)
    return texts.map(lambda text: any(map(concerns, text.split("; ")))).to_numpy(bool)


def _shade(panel: Axes, table: Any, told: set[str], alarms: Any) -> None:
    """Shade the rows in which nothing is decided, and those with an alarm; each is explained in one panel."""
    undecided = ~table["status"].isin(DECIDING).to_numpy()
    marks = [(undecided, _UNDECIDED_ROWS, "warm-up or gap"), (alarms, _ALARM, "alarm")]
    times = table["time"]
    for where, style, label in marks:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int64)))
        for begin, end in edges.reshape(-1, 2):
            new = None if label in told else label
            told.add(label)
            panel.axvspan(times.iloc[begin], times.iloc[min(end, len(times) - 1)], label=new, **style)


#: Courses below this share of the largest number are zero but for rounding.
ROUNDED_COURSE = 1e-12
#: From this ratio of largest to smallest threshold on, its axis is logarithmic.
WIDE_THRESHOLDS = 5.0


@arguments_checked
def plot_least_thresholds(design: ObserverDesign, *, axes: Axes | None = None) -> Axes:
    """Plot the least threshold of a guaranteed test against the time that its samples take.

    Parameters
    ----------
    design : ObserverDesign
        By `obsynth.guaranteed_test` with ``samples="auto"``, so that there is a table.
    axes : Axes, optional
        Where; new ones by default.

    Returns
    -------
    Axes
        Threshold in the fault's unit against seconds from the begin of the fault to the verdict; the samples chosen
        are marked, and what lies below the curve no test finds.

    Raises
    ------
    SpecError
        The design is by another method.
    """
    found = GuaranteedTest.of(design)
    panel = one_panel(axes, size=(WIDTH, 1.6 * PANEL_HEIGHT))
    table = found.trade_off[np.isfinite(found.trade_off[:, 1])]
    before = int(found.options["before"]) if found.options["course"] == "step" else 0
    seconds = (table[:, 0] - 1 - before) * found.observer.dt
    panel.plot(seconds, table[:, 1], color="black", marker="o", markersize=4, label="least threshold of any test")
    panel.fill_between(seconds, 0.0, table[:, 1], color="0.9", label="no test without false alarms exists here")
    panel.plot(
        (found.samples - 1 - before) * found.observer.dt,
        found.threshold,
        marker="s",
        markersize=9,
        color="tab:red",
        linestyle="none",
        label=f"chosen: {found.samples} samples, proved",
    )
    sizes = table[:, 1]
    if sizes.size and sizes.min() > 0.0 and sizes.max() > WIDE_THRESHOLDS * sizes.min():
        panel.set_yscale("log")
        panel.set_ylim(bottom=0.7 * float(sizes.min()))
    else:
        panel.set_ylim(bottom=0.0)
    if seconds.size > 1 and seconds[0] > 0.0:
        # What a few more samples bring is of interest where they are few.
        plain_decades(panel, across=True)
    after = "from the step to the last sample" if before else "from the first to the last sample"
    return finish(panel, with_unit(found.fault, found.plant.units), below=f"{after} (s)")


@arguments_checked
def plot_intervals(design: ObserverDesign, estimates: Estimates, *, axes: Axes | None = None) -> Axes:
    """Plot the interval in which a guaranteed test says the fault lies, and where it alarms.

    Parameters
    ----------
    design : ObserverDesign
        By `obsynth.guaranteed_test`.
    estimates : Estimates
        What its observer said over a record, from its start.
    axes : Axes, optional
        Where; new ones by default.

    Returns
    -------
    Axes
        Residual with the threshold on both sides of it, against seconds; alarms are shaded from the first on.

    Raises
    ------
    SpecError
        The design is by another method.
    """
    found = GuaranteedTest.of(design)
    panel = one_panel(axes, size=(WIDTH, 1.6 * PANEL_HEIGHT))
    low, high = found.interval(estimates)
    seconds = np.arange(len(low)) * found.observer.dt
    panel.fill_between(seconds, low, high, color="0.85", label="interval")
    panel.plot(seconds, found.residual(estimates), color="black", linewidth=1.0, label="residual")
    panel.axhline(0.0, color="0.4", linewidth=0.8)
    alarms = np.flatnonzero(found.alarms(estimates))
    if alarms.size:
        panel.axvline(float(seconds[alarms[0]]), color="tab:red", linestyle="--", label="alarm")
    return finish(panel, with_unit(found.fault, found.plant.units))


@arguments_checked
def plot_hidden_course(design: ObserverDesign, *, fault: str | None = None, axes: Axes | None = None) -> Axes:
    """Plot the courses with which a fault looks like none: why no test finds a smaller one, or tells it from others.

    Parameters
    ----------
    design : ObserverDesign
        By `obsynth.guaranteed_test`: of a test its witness; of a bank what hides a fault from a smaller group.
    fault : str, optional
        Of a bank: which one; the first by default.
    axes : Axes, optional
        Where; new ones by default.

    Returns
    -------
    Axes
        Faults, disturbances and states over the window, each as a share of its largest value, which the legend has.

    Raises
    ------
    SpecError
        The design is by another method, or nothing hides the fault.
    """
    found = GuaranteedTest.of(design)
    plant, courses = found.plant, found.hidden_course(fault)
    if not courses:
        raise SpecError("No combination of signals hides this fault: there is none to draw.", path="fault")
    panel = one_panel(axes, size=(WIDTH, 1.6 * PANEL_HEIGHT))
    styles = dict.fromkeys(courses, "--")
    styles |= dict.fromkeys(plant.state_names, ":") | dict.fromkeys(found.fault_names, "-")
    sizes = {name: float(np.max(np.abs(course))) for name, course in courses.items()}
    largest = max(sizes.values())
    shown = [name for name in courses if sizes[name] > ROUNDED_COURSE * largest]
    # Faults first, then disturbances, then states.
    for name in sorted(shown, key=lambda name: ("-", "--", ":").index(styles.get(name, ":"))):
        style, unit = styles.get(name, ":"), plant.units.get(name, "")
        panel.plot(
            np.arange(len(courses[name])) * found.observer.dt,
            courses[name] / sizes[name],
            style,
            # What acts on a sampled plant is held between samples.
            drawstyle="default" if style == ":" else "steps-post",
            linewidth=1.0 if style == ":" else 1.8,
            label=f"{name}, up to {sizes[name]:.3g}{f' {unit}' if unit else ''}",
        )
    panel.axhline(0.0, color="0.4", linewidth=0.8)
    return finish(panel, "relative to its largest value", below="time (s)")


_MONITORS: tuple[dict[str, Any], ...] = (
    {"label": FIXED, "color": "tab:red", "linestyle": "--", "marker": "x"},
    {"label": ADAPTIVE, "color": "black", "linestyle": "-", "marker": "o"},
)


@arguments_checked
def plot_tolerances(study: ToleranceStudy, *, axes: Iterable[Axes] | None = None) -> list[Axes]:
    """Plot false alarms, and the least fault that is found in every run, against the tolerance.

    Parameters
    ----------
    study : ToleranceStudy
        From `obsynth.tolerance_study`.
    axes : iterable of Axes, optional
        Two; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        The fixed bound beside the adaptive threshold: false alarms above, least faults below; a monitor that tells no
        fault at some tolerance has no point there.

    Raises
    ------
    SpecError
        The argument is something else, or there are too few or too many axes.
    """
    panels = new_panels(axes, 2, size=(WIDTH, 2.0 * PANEL_HEIGHT + 0.8))
    unit = f" ({study.unit})" if study.unit else ""
    labels = ("runs with a\nfalse alarm (%)", f"least {study.fault}\nfound in every run{unit}")
    across = 100.0 * study.tolerances
    least = np.where(np.isfinite(study.least_faults), study.least_faults, np.nan)
    for panel, values, label in zip(panels, (100.0 * study.false_alarms, least), labels, strict=True):
        for j, style in enumerate(_MONITORS):
            panel.plot(across, values[:, j], linewidth=1.2, markersize=5.0, **style)
        panel.set_ylabel(label)
        legend_above(panel)
        tidy(panel)
    panels[0].set_ylim(-4.0, 104.0)
    known = least[np.isfinite(least)]
    if known.size and known.max() > WIDE_AXIS * known.min():
        plain_decades(panels[1])
    else:
        panels[1].set_ylim(bottom=0.0)
    panels[-1].set_xlabel("largest tolerance of a constant (%)")
    return panels
