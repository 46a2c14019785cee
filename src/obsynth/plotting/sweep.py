"""The picture of a sweep: a claim of every design over what was varied, and where there is none."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_number
from obsynth.plotting.panels import WIDTH, tidy

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEIGHT = 4.2
#: A ratio of the largest to the smallest value above which an axis is logarithmic.
LOGARITHMIC = 100.0
#: Markers of lines, in turn, and of cases without a design, by what they came to.
MARKERS = "osD^vP*Xh"
FAILED = {"impossible": "x", "infeasible": "+", "unknown": "1", "unverified": "2", "malformed": "|"}
#: At most so many lines get an entry of their own in the legend.
MOST_LINES = 8


class _Results(Protocol):
    @property
    def results(self) -> Sequence[Any]: ...


def plot_sweep(found: _Results, claim: str | None = None, *, parameter: str | None = None) -> Figure:
    """Draw a claim of every case over a parameter, one line for each combination of the others."""
    import matplotlib.pyplot as plt

    results = list(found.results)
    claim = _claim(results, claim)
    along = _parameter(results, parameter)
    figure, panel = plt.subplots(figsize=(WIDTH, HEIGHT), layout="constrained")
    lines: dict[str, list[tuple[float, Any]]] = {}
    for number, result in enumerate(results, 1):
        place = float(number) if along is None else float(result.parameters[along])
        lines.setdefault("" if along is None else _others(result, along), []).append((place, result))
    for number, (label, points) in enumerate(lines.items()):
        _draw_line(panel, sorted(points, key=lambda point: point[0]), claim, label, number)
    _mark_failures(panel, lines)
    values = [result.claims[claim] for result in results if claim in result.claims]
    if _spread(values):
        panel.set_yscale("log")
    if along is not None and _spread([place for points in lines.values() for place, _ in points]):
        panel.set_xscale("log")
    panel.set_xlabel("case" if along is None else along)
    panel.set_ylabel(claim)
    tidy(panel)
    if panel.get_legend_handles_labels()[1]:
        panel.legend(frameon=False, fontsize="small")
    return figure


def _draw_line(panel: Axes, points: list[tuple[float, Any]], claim: str, label: str, number: int) -> None:
    places = [place for place, _ in points]
    values = [result.claims.get(claim, np.nan) for _, result in points]
    known = label if label and number < MOST_LINES else None
    panel.plot(places, values, linewidth=1.0, marker=MARKERS[number % len(MARKERS)], markersize=4, label=known)


def _mark_failures(panel: Axes, lines: Mapping[str, list[tuple[float, Any]]]) -> None:
    """Mark cases without a design at the lower edge of the panel, by what they came to."""
    for status, marker in FAILED.items():
        places = [place for points in lines.values() for place, result in points if result.status == status]
        if places:
            panel.plot(
                places, [0.03] * len(places), marker, color="tab:red", markersize=8, clip_on=False,
                transform=panel.get_xaxis_transform(), label=f"{status}: {len(places)}",
            )  # fmt: skip


def _claim(results: list[Any], claim: str | None) -> str:
    counts: dict[str, int] = {}
    for result in results:
        for name in result.claims:
            counts[name] = counts.get(name, 0) + 1
    if claim is None and counts:
        return max(counts, key=lambda name: counts[name])
    if claim is None or claim not in counts:
        known = ", ".join(counts) or "none"
        raise SpecError(f"No design of the sweep claims {claim!r}; there are: {known}.", path="claim")
    return claim


def _parameter(results: list[Any], parameter: str | None) -> str | None:
    numbers = {}
    for name in {name for result in results for name in result.parameters}:
        values = [result.parameters.get(name) for result in results]
        if all(is_number(value) for value in values):
            numbers[name] = len(set(values))
    if parameter is not None and parameter not in numbers:
        known = ", ".join(numbers) or "none"
        raise SpecError(f"{parameter!r} is no number that was varied; there are: {known}.", path="parameter")
    varied = {name: count for name, count in numbers.items() if count > 1}
    return parameter or max(sorted(varied), key=lambda name: varied[name], default=None)


def _others(result: Any, along: str) -> str:
    stem = result.name.partition(",")[0]
    said = [f"{name.rpartition('.')[2]} = {value}" for name, value in result.parameters.items() if name != along]
    return ", ".join([stem, *said])


def _spread(values: list[float]) -> bool:
    positive = [value for value in values if value > 0.0]
    return len(positive) == len(values) > 1 and max(positive) >= LOGARITHMIC * min(positive)
