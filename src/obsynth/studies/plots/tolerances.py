"""Plot of a tolerance study."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.numerics.arguments import arguments_checked
from obsynth.report.plots.panels import PANEL_HEIGHT, WIDE_AXIS, WIDTH, legend_above, new_panels, plain_decades, tidy
from obsynth.studies.tolerance_study import ADAPTIVE, FIXED, ToleranceStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "B": [[1]], "C": [[1]], "Bf": [[1]], "dt": 1.0},
    ...     {"a": {"nominal": 0.5, "tolerance": "5 %"}},
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(
    ...     horizon=20, inputs={"u1": obsynth.Step(size=1.0)}, faults={"f1": obsynth.Step(size=1.0, start=10)}
    ... )
    >>> study = obsynth.tolerance_study(design, scenario, tolerances=(0.0, 0.05), runs=4)
    >>> axes = obsynth.plotting.plot_tolerances(study)
    >>> len(axes)
    2
    """
    panels = new_panels(axes, 2, size=(WIDTH, 2.0 * PANEL_HEIGHT + 0.8))
    unit = f" ({study.unit})" if study.unit else ""
    labels = ("runs with a\nfalse alarm (%)", f"smallest {study.fault}\ndetected in every run{unit}")
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
