"""Whether a recorded log without faults agrees with a design: the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.calibration.diagnostics import Consistency, Whiteness
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.estimates import BAND_WIDTH

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class SensorValidation:
    """What the innovations of one sensor say."""

    nis: Consistency  # mean square in units of the expected variance, with its 95 % interval
    mean: float  # of the innovations, in standard deviations of such a mean for white ones; beyond 3 it is an offset
    whiteness: Whiteness  # test of Ljung and Box


@dataclass(frozen=True, eq=False)
class Validation:
    """Whether a log agrees with a design.

    Parameters
    ----------
    passed : bool
        Whether every check holds.
    name : str
        Of the design.
    nis : Consistency
        Normalised innovations squared per degree of freedom, with its 95 % interval.
    sensors : mapping of str to SensorValidation
        By output.
    ratios : mapping of str to float
        Likeliest variance on this log over that of the design, by noisy equation and by sensor, where the log tells
        them apart clearly.
    change : int or None
        Row of the log at which the mean of the innovations changes.
    verdict : tuple of str
        A sentence for each thing that was found, with what to change.
    innovations, deviations, measured, predicted : FloatArray
        ``(n, ny)``, in units of the outputs; NaN where nothing was measured.
    estimates : mapping of str to FloatArray
        ``(n, 2)``: each estimated parameter with its standard deviation.
    log : mapping
        ``source``, ``rows``, ``digest``, ``samples`` and ``dt``.
    """

    passed: bool
    name: str
    nis: Consistency
    sensors: Mapping[str, SensorValidation]
    ratios: Mapping[str, float]
    change: int | None
    verdict: tuple[str, ...]
    innovations: FloatArray
    deviations: FloatArray
    measured: FloatArray
    predicted: FloatArray
    estimates: Mapping[str, FloatArray]
    log: Mapping[str, Any]

    def __str__(self) -> str:
        rows = f"rows {self.log['rows'][0]}:{self.log['rows'][1]}"
        state = "agrees" if self.passed else "DOES NOT AGREE"
        lines = [f"{self.log['source'] or 'The log'}, {rows}, {state} with the design {self.name!r}."]
        nis = self.nis
        lines.append(f"  NIS per degree of freedom {nis.value:.3g} (95 %: {nis.low:.2f} to {nis.high:.2f})")
        width = max(len(name) for name in self.sensors)
        lines.append(f"  {'':<{width}}  mean square  mean (deviations)  white (p)")
        for name, found in self.sensors.items():
            lines.append(f"  {name:<{width}}  {found.nis.value:<11.3g}  {found.mean:<+17.2g}  "
                         f"{found.whiteness.probability:.2g}")  # fmt: skip
        return "\n".join([*lines, *(f"  - {sentence}" for sentence in self.verdict)])

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the records as plain data."""
        return {
            "passed": self.passed, "name": self.name, "nis": vars(self.nis) | {"holds": self.nis.holds},
            "sensors": {name: {"nis": vars(found.nis) | {"holds": found.nis.holds}, "mean": found.mean,
                               "whiteness": vars(found.whiteness)} for name, found in self.sensors.items()},
            "ratios": dict(self.ratios), "change": self.change, "verdict": list(self.verdict), "log": dict(self.log),
        }  # fmt: skip

    def plot(self) -> Figure:
        """Return a picture: measured and predicted signals, innovations in their band, estimates."""
        return _figure(self)


def _figure(found: Validation) -> Figure:
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
        band = BAND_WIDTH * found.deviations[:, i]
        said.fill_between(time, -band, band, color="tab:blue", alpha=0.15, linewidth=0.0)
        said.plot(time, found.innovations[:, i], color="black", linewidth=0.8, marker=".", markersize=3)
        said.set_ylabel(f"innovation\nof {name}")
    for panel, (name, columns) in zip(panels[2 * len(names) :], found.estimates.items(), strict=True):
        value, band = columns[:, 0], BAND_WIDTH * columns[:, 1]
        panel.fill_between(time, value - band, value + band, color="tab:blue", alpha=0.25, linewidth=0.0)
        panel.plot(time, value, color="black", linewidth=1.1)
        panel.set_ylabel(name)
    for panel in panels:
        panel.grid(True, color="0.9", linewidth=0.6)
    panels[-1].set_xlabel("row of the log")
