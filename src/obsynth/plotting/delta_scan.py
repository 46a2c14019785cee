"""A scan of delta as a picture: decay, gains and noise over delta."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.plotting.panels import WIDTH, legend_above, new_panels, plain_decades, tidy
from obsynth.results.delta_scan import DeltaScan

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Inches: height of one panel.
PANEL_HEIGHT = 2.1
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
    panels = new_panels(axes, len(PANELS), size=(WIDTH, PANEL_HEIGHT * len(PANELS) + 0.5))
    order = np.argsort(scan.delta)
    for panel, (label, curves) in zip(panels, PANELS, strict=True):
        for name, text, style in curves:
            values = getattr(scan, name)[order]
            panel.plot(scan.delta[order], np.where(values > 0.0, values, np.nan), label=text, markersize=4, **style)
        panel.set_xscale("log")
        plain_decades(panel)
        panel.set_ylabel(label)
        legend_above(panel)
        tidy(panel)
    panels[-1].set_xlabel("delta (s)")
    if (figure := panels[0].get_figure()) is not None:
        figure.align_ylabels(panels)
    return panels
