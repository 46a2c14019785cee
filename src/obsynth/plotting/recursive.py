"""Decisions of recursive observers with their thresholds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from obsynth.observers.alarms import Decision
from obsynth.plotting.panels import MARK_STYLE, RESIDUAL_STYLE, THRESHOLD_STYLES, legend_above, new_panels, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: What each statistic says, on the vertical axis.
_LABELS = {"chi-square": "chi-square of theta", "cusum": "CUSUM", "glr": "likelihood ratio", "nis": "NIS over a window"}
#: Values below this share of the threshold say nothing, and would stretch a logarithmic axis.
LEAST_SHARE = 1e-3


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
    (panel,) = new_panels(None if axes is None else [axes], 1)
    time = dt * np.arange(len(decision.values))
    shown = np.isfinite(decision.thresholds)
    floor = LEAST_SHARE * float(np.min(decision.thresholds[shown], initial=1.0))
    panel.plot(time, np.maximum(decision.values, floor), label=decision.statistic, **RESIDUAL_STYLE)
    panel.plot(time[shown], decision.thresholds[shown], label="threshold", **THRESHOLD_STYLES[0])
    panel.set_yscale("log")
    alarm = decision.alarm
    if alarm is not None:
        blamed = f": {alarm.parameter}" if alarm.parameter else ""
        panel.plot(
            [dt * alarm.k], [alarm.value], marker="o", color="black", label=f"alarm at {dt * alarm.k:g} s{blamed}",
            **MARK_STYLE,
        )  # fmt: skip
        panel.axvline(dt * alarm.onset, color="0.4", linestyle=":", label=f"onset at {dt * alarm.onset:g} s")
    panel.set_ylabel(_LABELS.get(decision.statistic, decision.statistic))
    panel.set_xlabel("time (s)")
    legend_above(panel)
    tidy(panel)
    return panel
