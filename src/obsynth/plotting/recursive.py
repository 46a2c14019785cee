"""Estimates of recursive observers with their confidence bands, and decisions with their thresholds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.observers.alarms import Decision
from obsynth.observers.dae_estimates import DAEEstimates
from obsynth.observers.recursive_estimates import RecursiveEstimates
from obsynth.plotting.faults import ESTIMATE_STYLE, PANEL_HEIGHT, TRUE_STYLE, WIDTH

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Standard deviations on each side: 95 % of a normal variable.
BAND_WIDTH = 1.96
_BAND: dict[str, Any] = {"color": "tab:blue", "alpha": 0.25, "linewidth": 0.0}
_THRESHOLD: dict[str, Any] = {"color": "tab:red", "linewidth": 1.6, "linestyle": "--"}


def plot_parameters(
    estimates: RecursiveEstimates | DAEEstimates,
    *,
    parameters: ArrayLike | None = None,
    dt: float = 1.0,
    units: Mapping[str, str] | None = None,
) -> list[Axes]:
    """Plot each parameter estimate with its 95 % band, on the true parameter.

    Parameters
    ----------
    estimates : RecursiveEstimates or DAEEstimates
        From a run.
    parameters : array_like, optional
        True parameters ``(samples, nq)``; a single one may be ``(samples,)``.
    dt : float, optional, seconds
        Time between samples.
    units : mapping, optional
        Unit of each parameter by name.

    Returns
    -------
    list of Axes
        One for each parameter.

    Raises
    ------
    SpecError
        The true parameters have the wrong shape.
    """
    return _panels(
        estimates.parameters, estimates.parameter_deviations, estimates.parameter_names, parameters, dt, units or {}
    )


def plot_states(
    estimates: RecursiveEstimates | DAEEstimates,
    *,
    states: ArrayLike | None = None,
    dt: float = 1.0,
    units: Mapping[str, str] | None = None,
) -> list[Axes]:
    """Plot each state estimate with its 95 % band, on the true state; where it is undetermined there is no band.

    Parameters
    ----------
    estimates : RecursiveEstimates or DAEEstimates
        From a run.
    states : array_like, optional
        True states ``(samples, nx)``.
    dt : float, optional, seconds
        Time between samples.
    units : mapping, optional
        Unit of each state by name.

    Returns
    -------
    list of Axes
        One for each state.

    Raises
    ------
    SpecError
        The true states have the wrong shape.
    """
    return _panels(estimates.states, estimates.state_deviations, estimates.state_names, states, dt, units or {})


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
    """
    if axes is None:
        (axes,) = _new_panels(1)
    time = dt * np.arange(len(decision.values))
    shown = np.isfinite(decision.thresholds)
    axes.plot(time, np.maximum(decision.values, 1e-2), color="black", linewidth=1.0, label=decision.statistic)
    axes.plot(time[shown], decision.thresholds[shown], **_THRESHOLD, label="threshold")
    axes.set_yscale("log")
    alarm = decision.alarm
    if alarm is not None:
        axes.plot(
            [dt * alarm.k], [alarm.value], "o", color="tab:red", markersize=7, label=f"alarm at {dt * alarm.k:g} s"
        )
        axes.axvline(dt * alarm.onset, color="0.4", linestyle=":", label=f"onset at {dt * alarm.onset:g} s")
    axes.set_xlabel("time (s)")
    axes.legend(loc="best", fontsize="small")
    return axes


def _panels(
    values: FloatArray, deviations: FloatArray, names: tuple[str, ...], truth: ArrayLike | None, dt: float,
    units: Mapping[str, str],
) -> list[Axes]:  # fmt: skip
    true = None
    if truth is not None:
        raw = np.asarray(truth)
        true = as_matrix(raw[:, None] if raw.ndim == 1 else raw, "true signals")
        if true.shape != values.shape:
            raise SpecError(
                f"The true signals have shape {true.shape}, but the estimates {values.shape}.", path="truth"
            )
    panels = _new_panels(len(names))
    time = dt * np.arange(len(values))
    for i, (axes, name) in enumerate(zip(panels, names, strict=True)):
        half = np.where(np.isfinite(deviations[:, i]), BAND_WIDTH * deviations[:, i], np.nan)
        if true is not None:
            axes.plot(time, true[:, i], **TRUE_STYLE, label="true")
        axes.fill_between(time, values[:, i] - half, values[:, i] + half, **_BAND, label="95 % band")
        axes.plot(time, values[:, i], **ESTIMATE_STYLE, label="estimate")
        unit = units.get(name, "")
        axes.set_ylabel(f"{name} ({unit})" if unit else name)
    panels[0].legend(loc="best", fontsize="small")
    panels[-1].set_xlabel("time (s)")
    return panels


def _new_panels(count: int) -> list[Axes]:
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(
        count, 1, sharex=True, squeeze=False, figsize=(WIDTH, PANEL_HEIGHT * count + 0.6), layout="constrained"
    )
    return list(axes[:, 0])
