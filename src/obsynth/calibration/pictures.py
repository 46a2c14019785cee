"""Pictures of calibrations and validations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from obsynth.numerics.arrays import SMALLEST

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from obsynth.calibration.result import Calibration
    from obsynth.calibration.validation import Validation
    from obsynth.calibration.validity import Validity

#: Deviations within which 95 % of white normal innovations lie.
BAND = 1.96


def calibration_figure(found: Calibration) -> Figure:
    """Return each constant in its box, and the whitened innovations of each sensor."""
    import matplotlib.pyplot as plt

    sensors = len(found.output_names)
    heights = [0.6 + 0.35 * len(found.names), *[1.7] * sensors]
    figure, panels = plt.subplots(
        sensors + 1, 1, layout="constrained", squeeze=False, figsize=(7.5, 0.5 + sum(heights)),
        gridspec_kw={"height_ratios": heights},
    )  # fmt: skip
    _boxes(panels[0, 0], found)
    time = found.log["rows"][0] + np.arange(len(found.innovations))
    for panel, name, column in zip(panels[1:, 0], found.output_names, found.innovations.T, strict=True):
        panel.axhspan(-BAND, BAND, color="tab:blue", alpha=0.15, linewidth=0.0)
        panel.plot(time, column, color="black", linewidth=0.8, marker=".", markersize=3)
        panel.set_ylabel(f"{name}\n(deviations)")
        panel.grid(True, color="0.9", linewidth=0.6)
        if found.change is not None:
            panel.axvline(found.change, color="tab:red", linestyle="--", linewidth=1.2)
    panels[1, 0].set_title("Innovations; 95 % lie in the band", fontsize=10, loc="left")
    panels[-1, 0].set_xlabel("row of the log")
    return figure


def _boxes(panel: object, found: Calibration) -> None:
    """Draw boxes relative to their nominal values, so that constants of all sizes stand side by side."""
    from matplotlib.axes import Axes

    if not isinstance(panel, Axes):
        return
    opened = set(found.box.open_sides)
    for i, (name, value) in enumerate(found.nominal.items()):
        size = abs(value) or max(abs(found.box.low[name]), abs(found.box.high[name]), SMALLEST)
        low, high = (found.box.low[name] - value) / size * 100.0, (found.box.high[name] - value) / size * 100.0
        panel.plot([low, high], [i, i], color="0.5", linewidth=3.0, solid_capstyle="butt")
        for side, end in (("low", low), ("high", high)):
            marker = ("<" if side == "low" else ">") if (name, side) in opened else "|"
            panel.plot([end], [i], color="black", marker=marker, markersize=9, linestyle="none")
        panel.plot([0.0], [i], color="black", marker="o", markersize=4)
    panel.set_yticks(range(len(found.nominal)), [f"{name} = {value:.4g}" for name, value in found.nominal.items()])
    panel.set_ylim(len(found.nominal) - 0.5, -0.5)
    panel.set_xlabel("per cent of the value")
    panel.set_title(f"{100 * found.box.level:g} % box, all at once (arrows: open)", fontsize=10, loc="left")
    panel.grid(True, axis="x", color="0.9", linewidth=0.6)


def validation_figure(found: Validation) -> Figure:
    """Return measured and predicted signals, innovations in their band, and each estimate with its own."""
    import matplotlib.pyplot as plt

    count = 2 * len(found.sensors) + len(found.estimates)
    figure, panels = plt.subplots(
        count, 1, layout="constrained", squeeze=False, sharex=True, figsize=(7.5, 0.6 + 1.5 * count)
    )
    draw_validation(found, list(panels[:, 0]))
    return figure


def draw_validation(found: Validation, panels: Sequence[Axes]) -> None:
    """Draw signal and innovation of each sensor, then each estimate, on a panel each."""
    names, time = list(found.sensors), found.log["rows"][0] + np.arange(len(found.innovations))
    for i, name in enumerate(names):
        signals, said = panels[2 * i], panels[2 * i + 1]
        signals.plot(time, found.measured[:, i], color="0.7", linewidth=3.0, label="measured")
        signals.plot(time, found.predicted[:, i], color="black", linewidth=1.0, linestyle="--", label="predicted")
        signals.set_ylabel(name)
        signals.legend(fontsize=8, loc="upper left", frameon=False, ncols=2)
        band = BAND * found.deviations[:, i]
        said.fill_between(time, -band, band, color="tab:blue", alpha=0.15, linewidth=0.0)
        said.plot(time, found.innovations[:, i], color="black", linewidth=0.8, marker=".", markersize=3)
        said.set_ylabel(f"innovation\nof {name}")
    for panel, (name, columns) in zip(panels[2 * len(names) :], found.estimates.items(), strict=True):
        value, band = columns[:, 0], BAND * columns[:, 1]
        panel.fill_between(time, value - band, value + band, color="tab:blue", alpha=0.25, linewidth=0.0)
        panel.plot(time, value, color="black", linewidth=1.1)
        panel.set_ylabel(name)
    for panel in panels:
        panel.grid(True, color="0.9", linewidth=0.6)
    panels[-1].set_xlabel("row of the log")


def validity_figure(found: Validity) -> Figure:
    """Return outputs of plant and linear model, and their difference in deviations of the sensor."""
    import matplotlib.pyplot as plt

    names = list(found.by_sensor)
    figure, panels = plt.subplots(
        2 * len(names), 1, layout="constrained", squeeze=False, sharex=True, figsize=(7.5, 0.6 + 3.0 * len(names))
    )
    for i, name in enumerate(names):
        signals, apart = panels[2 * i, 0], panels[2 * i + 1, 0]
        signals.plot(found.time, found.nonlinear[:, i], color="0.7", linewidth=3.0, label="nonlinear")
        signals.plot(found.time, found.linear[:, i], color="black", linewidth=1.0, linestyle="--", label="linear")
        signals.set_ylabel(name)
        signals.legend(fontsize=8, loc="best", frameon=False, ncols=2)
        apart.axhspan(-1.0, 1.0, color="tab:blue", alpha=0.15, linewidth=0.0)
        apart.plot(found.time, (found.linear - found.nonlinear)[:, i] / found.deviations[name], color="black")
        apart.set_ylabel(f"difference of\n{name} (deviations)")
    for panel in panels[:, 0]:
        panel.grid(True, color="0.9", linewidth=0.6)
    panels[-1, 0].set_xlabel("time (s)")
    return figure
