"""Plots of trade-offs: one claim against another, a delay, a region, a rate or a swept option."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.optimal_filter.public import OptimalFilter
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.numerics.arguments import arguments_checked, is_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.suggestions import there_are
from obsynth.report.plots.panels import (
    LINE_COLOURS,
    PANEL_HEIGHT,
    WIDE_AXIS,
    WIDTH,
    finish,
    legend_above,
    new_panels,
    one_panel,
    plain_decades,
    tidy,
    with_unit,
)
from obsynth.results.design import ObserverDesign

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


#: Inches: height of the picture of a sweep.
SWEEP_HEIGHT = 4.2

#: A ratio of the largest to the smallest value above which an axis is logarithmic.
LOGARITHMIC = 100.0

#: Share of its height that an axis has above the largest value.
EDGE_MARGIN = 0.1

#: Markers of lines, in turn, and of cases without a design, by what they came to.
MARKERS = "osD^vP*Xh"

FAILED = {"impossible": "x", "infeasible": "+", "unknown": "1", "unverified": "2", "malformed": "|"}

#: At most so many lines get an entry of their own in the legend.
MOST_LINES = 8

#: So many cases have their names below, on several lines; all together have room for so many letters of a line.
MOST_NAMED_CASES, LETTERS_OF_CASES = 12, 96


@arguments_checked
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

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> designs = [obsynth.ui_pi_observer(plant, decay=decay) for decay in (0.2, 0.5, 1.0)]
    >>> axes = obsynth.plotting.plot_trade_off(designs, "decay", "noise_amplification")
    >>> len(axes)
    1
    """
    if len(designs) == 0:
        raise SpecError("A trade-off needs designs: give at least one.", path="designs")
    names = [against] if isinstance(against, str) else list(against)
    panels = new_panels(axes, len(names), size=(WIDTH, PANEL_HEIGHT * len(names) + 1.2))
    x = np.array([_number(design, along) for design in designs])
    order = np.argsort(x, kind="stable")
    for panel, name in zip(panels, names, strict=True):
        y = np.array([_number(design, name) for design in designs])
        panel.plot(x[order], y[order], color="black", linewidth=1.2, marker="o", markersize=5)
        for values in (x, y):
            if values.min() > 0.0 and values.max() > WIDE_AXIS * values.min():
                plain_decades(panel, across=values is x)
        panel.set_ylabel(_claim_label(name, [design.method for design in designs]))
        tidy(panel)
        panel.margins(x=0.03)
    if panels:
        panels[-1].set_xlabel(_claim_label(along, [design.method for design in designs]))
    return panels


@arguments_checked
def plot_delays(design: ObserverDesign, *, axes: Axes | None = None) -> Axes:
    """Plot the least gain and the least deviation of any filter with an exact fault map against its delay.

    Parameters
    ----------
    design : ObserverDesign
        By `obsynth.optimal_filter`, in discrete time, with a delay and not a reference model.
    axes : Axes, optional
        Where; new ones by default.

    Returns
    -------
    Axes
        Both against the delay in samples; the delay of this filter is marked, and what no delay falls below is dashed.

    Raises
    ------
    SpecError
        The design is by another method, or follows a reference model: it has no delay to choose.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.5]], C=[[1], [1]], Bf=[[0]], Df=[[1], [1]], Bw=[[0, 0]], Dw=[[1, 0], [0, 1]], dt=1.0
    ... )
    >>> obsynth.plotting.plot_delays(obsynth.optimal_filter(plant)).get_xlabel()
    'delay of the fault map (samples)'
    """
    filter_ = OptimalFilter.of(design)
    table = filter_.trade_off
    if not table:
        raise SpecError(
            f"Design {design.name!r} follows a reference model: there is no delay to choose.", path="design"
        )
    panel = one_panel(axes, size=(WIDTH, 1.6 * PANEL_HEIGHT))
    delays = [row.delay for row in table]
    lines = (
        ("least gain of any filter", [row.gain for row in table], "o", "-"),
        ("least deviation, white noise of unit intensity", [row.deviation for row in table], "s", ":"),
    )
    for label, values, marker, style in lines:
        panel.plot(delays, values, color="black", marker=marker, markersize=4, linestyle=style, label=label)
    panel.plot(
        filter_.delay,
        filter_.gain,
        marker="s",
        markersize=9,
        color="tab:red",
        linestyle="none",
        zorder=0,
        label=f"this filter: delay {filter_.delay}",
    )
    if filter_.non_causal_limit > 0.0:
        panel.axhline(filter_.non_causal_limit, color="0.5", linestyle="--", label="gain that no delay falls below")
    panel.set_xticks(delays)
    # A line at the upper edge would be taken for the frame.
    panel.margins(y=EDGE_MARGIN)
    panel.set_ylim(bottom=0.0)
    units = {design.plant.units.get(name, "1") for name in design.observer.fault_names}
    unit = f"{units.pop()} per unit of noise" if len(units) == 1 and units != {"1"} else "per unit of noise"
    return finish(panel, f"error of the fault estimates\n({unit})", below="delay of the fault map (samples)")


def draw_region_trade_off(
    numbers: FloatArray,
    designs: Sequence[ObserverDesign | str],
    claim: tuple[str, FloatArray],
    reached: FloatArray,
    *,
    below: str,
    axes: Axes | None,
) -> Axes:
    """Draw a claim and its values over sizes of a region, or rates; places without a design are marked below."""
    panel = one_panel(axes, size=(WIDTH, 1.6 * PANEL_HEIGHT))
    methods = [design.method for design in designs if not isinstance(design, str)]
    name, proved = claim
    finite = np.isfinite(numbers)
    # Parameters that change at any rate are drawn to the right of the fastest rate.
    places = np.where(finite, numbers, 2.0 * float(np.max(numbers[finite], initial=0.5)))
    if np.isfinite(proved).any():
        panel.plot(places, proved, color="black", marker="o", markersize=4, label="proved")
    if np.isfinite(reached).any():
        panel.plot(places, reached, color="0.5", marker="x", linestyle=":", label="reached by some trajectory")
    missing = np.array([isinstance(design, str) for design in designs])
    panel.set_ylim(bottom=0.0)
    if missing.any():
        panel.plot(places[missing], np.zeros(missing.sum()), "x", color="tab:red", clip_on=False, label="no design")
    if not finite.all():
        panel.set_xticks(places, [f"{n:g}" if ok else "any" for n, ok in zip(numbers, finite, strict=True)])
    return finish(panel, _claim_label(name, methods), below=below)


def _claim_label(name: str, methods: Sequence[str]) -> str:
    """Return the name of a claim with its unit, as the methods state it."""
    known = (method_class(method).claims for method in dict.fromkeys(methods) if method in REGISTRY)
    claim = next((claims[name.partition("[")[0]] for claims in known if name.partition("[")[0] in claims), None)
    return with_unit(name.replace("_", " "), {name.replace("_", " "): claim.unit if claim else ""})


def _number(design: ObserverDesign, name: str) -> float:
    claims, checks = design.certificate.claims, {check.name: check.value for check in design.report.checks}
    options = {key: float(value) for key, value in design.options.items() if is_number(value)}
    for source in (claims, checks, options):
        if name in source:
            return float(source[name])
    raise SpecError(
        f"Design {design.name!r} has no {name!r}: its claims are {', '.join(claims) or 'none'}; names of checks and "
        f"numeric options ({', '.join(options) or 'none'}) go too.",
        path=name,
    )


def plot_sweep(results: Sequence[Any], claim: str | None = None, *, parameter: str | None = None) -> Figure:
    """Draw a claim of every case over a parameter, one line for each combination of the others."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    along = _parameter(results, parameter)
    claim = _claim(results, claim, along)
    figure, panel = plt.subplots(figsize=(WIDTH, SWEEP_HEIGHT), layout="constrained")
    several = len({result.name.partition(",")[0] for result in results}) > 1
    lines: dict[str, list[tuple[float, Any]]] = {}
    for number, result in enumerate(results, 1):
        place = float(number) if along is None else float(result.parameters[along])
        label = "" if along is None else _others(result, along, several=several)
        lines.setdefault(label, []).append((place, result))
    for number, (label, points) in enumerate(lines.items()):
        points.sort(key=lambda point: point[0])
        panel.plot(
            [place for place, _ in points],
            [result.claims.get(claim, np.nan) for _, result in points],
            # Between cases that only have names there is nothing.
            linewidth=0.0 if along is None else 1.0,
            color=LINE_COLOURS[number % len(LINE_COLOURS)],
            marker=MARKERS[number % len(MARKERS)],
            markersize=4,
            label=label if label and number < MOST_LINES else None,
        )
    # Cases without a design are marked at the lower edge, by what they came to.
    for status, marker in FAILED.items():
        places = [place for points in lines.values() for place, result in points if result.status == status]
        if places:
            panel.plot(
                places,
                [0.03] * len(places),
                marker,
                color="tab:red",
                markersize=8,
                clip_on=False,
                transform=panel.get_xaxis_transform(),
                label=f"{status}: {len(places)}",
            )
    values = [result.claims[claim] for result in results if claim in result.claims]
    if _spread(values):
        panel.set_yscale("log")
    elif values and all(float(value).is_integer() for value in values):
        panel.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    if along is not None and _spread([place for points in lines.values() for place, _ in points]):
        panel.set_xscale("log")
    if along is None:
        _mark_cases(panel, [result.name for result in results])
    else:
        panel.set_xlabel(_claim_label(along, [result.facts.get("method", "") for result in results]))
    panel.set_ylabel(_claim_label(claim, [result.facts.get("method", "") for result in results]))
    tidy(panel)
    if panel.get_legend_handles_labels()[1]:
        legend_above(panel)
    return figure


def _mark_cases(panel: Axes, names: Sequence[str]) -> None:
    """Mark the cases by their names, many of them by whole numbers, and leave space for all of them, also for those
    without the claim."""
    from matplotlib.ticker import MaxNLocator

    panel.set_xlim(0.5, len(names) + 0.5)
    if len(names) <= MOST_NAMED_CASES:
        letters = LETTERS_OF_CASES // len(names)
        panel.set_xticks(range(1, len(names) + 1), [fill(name, letters) for name in names])
        panel.set_xlabel("case")
        return
    panel.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    panel.set_xlabel("case (row of the table)")


def _claim(results: Sequence[Any], claim: str | None, along: str | None) -> str:
    """Return the claim that is drawn: by default the most frequent one that is not the parameter itself."""
    counts: Counter[str] = Counter(name for result in results for name in result.claims)
    if claim is None and counts:
        varied = "" if along is None else along.rpartition(".")[2]
        return max(counts, key=lambda name: (name != varied, counts[name]))
    if claim is None or claim not in counts:
        raise SpecError(f"No design of the sweep claims {claim!r}; {there_are(claim, counts)}", path="claim")
    return claim


def _parameter(results: Sequence[Any], parameter: str | None) -> str | None:
    numbers = {}
    for name in {name for result in results for name in result.parameters}:
        values = [result.parameters.get(name) for result in results]
        if all(is_number(value) for value in values):
            numbers[name] = len(set(values))
    if parameter is not None and parameter not in numbers:
        raise SpecError(
            f"{parameter!r} is no number that was varied; {there_are(parameter, numbers)}", path="parameter"
        )
    varied = {name: count for name, count in numbers.items() if count > 1}
    return parameter or max(sorted(varied), key=lambda name: varied[name], default=None)


def _others(result: Any, along: str, *, several: bool) -> str:
    """Return the values of the other parameters of a case, after the name of its plant where there are several."""
    plant = [result.name.partition(",")[0]] if several else []
    values = [f"{name.rpartition('.')[2]} = {value}" for name, value in result.parameters.items() if name != along]
    return ", ".join([*plant, *values])


def _spread(values: list[float]) -> bool:
    positive = [value for value in values if value > 0.0]
    return len(positive) == len(values) > 1 and max(positive) >= LOGARITHMIC * min(positive)
