"""A scan of delta as a picture: decay, gains and noise over delta."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.results.delta_scan import DeltaScan

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Inches: width of the figure and height of one panel.
WIDTH = 7.5
PANEL_HEIGHT = 2.1
#: Where a decade has its marks.
TICKS = (1.0, 2.0, 5.0)
#: One panel each: its label and the curves in it, with their names and styles.
PANELS: tuple[tuple[str, tuple[tuple[str, str, dict[str, Any]], ...]], ...] = (
    ("decay (1/s)", (("decay", "rate at which errors die out", {"color": "black", "marker": "o"}),)),
    ("norm", (("gain", "gains [J L; M N]", {"color": "black", "marker": "o"}),)),
    (
        "gain to the fault error",
        (
            ("rate_gain", "from the rate of the fault (s)", {"color": "black", "marker": "o"}),
            ("noise_gain", "from noise", {"color": "tab:red", "marker": "s", "linestyle": "--"}),
            ("fast_noise_gain", "from fast noise", {"color": "tab:blue", "marker": "^", "linestyle": ":"}),
        ),
    ),
)


def plot_delta_scan(scan: DeltaScan, *, axes: Iterable[Axes] | None = None) -> list[Axes]:
    """Plot decay, gains and noise over delta, one panel each; a delta without gains is a gap.

    Parameters
    ----------
    scan : DeltaScan
        From `obsynth.pd_delta_scan`, or ``DeltaScan.from_dict(design.solver["delta_scan"])``.
    axes : iterable of Axes, optional
        Three; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        Of decay, norm of the gains, and gains to the fault error, with logarithmic scales.

    Raises
    ------
    SpecError
        The number of axes is not three.
    """
    if axes is None:
        import matplotlib.pyplot as plt

        _, grid = plt.subplots(
            len(PANELS), 1, sharex=True, squeeze=False, layout="constrained",
            figsize=(WIDTH, PANEL_HEIGHT * len(PANELS) + 0.5),
        )  # fmt: skip
        panels = list(grid[:, 0])
    else:
        panels = list(axes)
    if len(panels) != len(PANELS):
        raise SpecError(f"{len(panels)} axes were given, but {len(PANELS)} are needed.", path="axes")
    order = np.argsort(scan.delta)
    for panel, (label, curves) in zip(panels, PANELS, strict=True):
        for name, text, style in curves:
            values = getattr(scan, name)[order]
            panel.plot(scan.delta[order], np.where(values > 0.0, values, np.nan), label=text, markersize=4, **style)
        panel.set_xscale("log")
        _logarithmic(panel)
        panel.set_ylabel(label)
        panel.legend(loc="best")
        panel.grid(True, which="major", color="0.9", linewidth=0.6)
        panel.set_axisbelow(True)
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
    panels[-1].set_xlabel("delta (s)")
    if (figure := panels[0].get_figure()) is not None:
        figure.align_ylabels(panels)
    return panels


def _logarithmic(panel: Axes) -> None:
    """Give a panel a logarithmic scale with plain numbers at 1, 2 and 5, from one such number to another."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    panel.set_yscale("log")
    shown = np.concatenate([np.asarray(line.get_ydata(), dtype=np.float64) for line in panel.get_lines()])
    shown = shown[np.isfinite(shown)]
    if shown.size:
        steps = np.ravel(np.outer(10.0 ** np.arange(-12, 13), TICKS))
        below, above = steps[steps < shown.min()], steps[steps > shown.max()]
        panel.set_ylim(below[-1] if below.size else None, above[0] if above.size else None)
    panel.yaxis.set_major_locator(LogLocator(subs=TICKS))
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_locator(NullLocator())
