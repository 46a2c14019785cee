"""What one promise costs in another: designs against one another, and a scan of delta as a picture."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.tolerance_study import ADAPTIVE, FIXED, ToleranceStudy
from obsynth.numerics.arguments import is_number, require_kind
from obsynth.plotting.panels import PANEL_HEIGHT, WIDTH, legend_above, new_panels, plain_decades, tidy
from obsynth.results.delta_scan import DeltaScan
from obsynth.results.design import ObserverDesign

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: From this ratio of largest to smallest on, an axis is logarithmic.
WIDE_SPREAD = 10.0


def plot_trade_off(
    designs: Sequence[ObserverDesign], along: str, against: str | Sequence[str], *, axes: Iterable[Axes] | None = None
) -> list[Axes]:
    """Plot what several designs claim (or what was found in their reports) against one of their claims.

    Parameters
    ----------
    designs : sequence of ObserverDesign
        Such as designs of one plant with several values of an option.
    along : str
        Claim, check or numeric option on the horizontal axis, such as ``"decay"``.
    against : str or sequence of str
        Claims, checks or numeric options, one panel each, such as ``"noise_amplification"`` or
        ``"noise in fhat[valve]"``.
    axes : iterable of Axes, optional
        One for each of ``against``; new ones, one above the other, by default.

    Returns
    -------
    list of Axes
        One for each of ``against``; logarithmic where the values spread over more than a decade.

    Raises
    ------
    SpecError
        No design, or one that has no such number (the names that it has are listed).
    """
    if not designs:
        raise SpecError("A trade-off needs designs: give at least one.", path="designs")
    names = [against] if isinstance(against, str) else list(against)
    panels = new_panels(axes, len(names), size=(WIDTH, PANEL_HEIGHT * len(names) + 1.2))
    x = np.array([_number(design, along) for design in designs])
    order = np.argsort(x, kind="stable")
    for panel, name in zip(panels, names, strict=True):
        y = np.array([_number(design, name) for design in designs])
        panel.plot(x[order], y[order], color="black", linewidth=1.2, marker="o", markersize=5)
        for values, scale in ((x, panel.set_xscale), (y, panel.set_yscale)):
            if values.min() > 0.0 and values.max() > WIDE_SPREAD * values.min():
                scale("log")
        panel.set_ylabel(name)
        tidy(panel)
        panel.margins(x=0.03)
    if panels:
        panels[-1].set_xlabel(along)
    return panels


def _number(design: ObserverDesign, name: str) -> float:
    claims, checks = design.certificate.claims, {check.name: check.value for check in design.report.checks}
    options = {key: float(value) for key, value in design.options.items() if is_number(value)}
    for source in (claims, checks, options):
        if name in source:
            return float(source[name])
    raise SpecError(
        f"Design {design.name!r} has no {name!r}: its claims are {', '.join(claims) or 'none'}; names of checks and "
        f"numeric options ({', '.join(options) or 'none'}) go too.", path=name,
    )  # fmt: skip


#: Inches: height of one panel.
_SCAN_HEIGHT = 2.1
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
    panels = new_panels(axes, len(PANELS), size=(WIDTH, _SCAN_HEIGHT * len(PANELS) + 0.5))
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


_MONITORS: tuple[dict[str, Any], ...] = (
    {"label": FIXED, "color": "tab:red", "linestyle": "--", "marker": "x"},
    {"label": ADAPTIVE, "color": "black", "linestyle": "-", "marker": "o"},
)


def plot_tolerances(study: ToleranceStudy, *, axes: Iterable[Axes] | None = None) -> list[Axes]:
    """Plot false alarms, and the least fault that is told in every run, against the tolerance.

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
    require_kind(study, ToleranceStudy, "study", "what obsynth.tolerance_study returns")
    panels = new_panels(axes, 2, size=(WIDTH, 2.0 * PANEL_HEIGHT + 0.8))
    unit = f" ({study.unit})" if study.unit else ""
    labels = ("runs with a\nfalse alarm (%)", f"least {study.fault}\ntold in every run{unit}")
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
    if known.size and known.max() > WIDE_SPREAD * known.min():
        plain_decades(panels[1])
    else:
        panels[1].set_ylim(bottom=0.0)
    panels[-1].set_xlabel("largest tolerance of a constant (%)")
    return panels
