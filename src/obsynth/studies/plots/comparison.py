"""Plot of a comparison: responses to steps, and estimates on the scenario."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.report.plots.panels import LINE_COLOURS, TRUE_STYLE, label_time, legend_above, tidy, with_unit
from obsynth.studies.compared_methods import ComparedMethod

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: How far a signal reaches is judged by this share of its samples.
SHOWN_SAMPLES = 0.98

#: Room below and above a fault in its panel, as a share of its range.
ROOM_AROUND_FAULT = 0.1

#: An estimate that reaches so many times as far as the fault and the best estimate has a panel of its own.
NOISIER = 3.0

#: Order in which truth is drawn among noise that would hide it.
ON_TOP = 20.0


def drawn_comparison(
    methods: Sequence[ComparedMethod],
    fault_names: Sequence[str],
    times: FloatArray,
    truth: FloatArray,
    *,
    sample_time: float,
    units: Mapping[str, str],
    new_figure: Callable[..., Figure],
) -> Figure:
    """Return the figure of a comparison, the best method first; ``truth (steps, nf)``, ``new_figure`` of matplotlib."""
    drawn = [entry for entry in methods if entry.faults]
    count = len(fault_names)
    far = [_far_noisier(drawn, name, truth[:, row]) for row, name in enumerate(fault_names)]
    columns = 3 if any(far) else 2
    figure = new_figure(figsize=(3.5 + 3.75 * (columns - 1), 2.8 * count), layout="constrained")
    axes = figure.subplots(count, columns, squeeze=False)
    figure.align_ylabels(axes)
    for row, name in enumerate(fault_names):
        left_panel, *panels = axes[row]
        sets = ([entry for entry in drawn if entry not in far[row]], far[row])
        for panel, entries in zip(panels, sets, strict=False):
            if not entries:
                panel.set_visible(False)
                continue
            over = {"zorder": ON_TOP} if entries is far[row] else {}
            if np.isfinite(truth[:, row]).any():
                panel.plot(times, truth[:, row], label="fault", **over, **TRUE_STYLE)
            panel.set_ylim(*_range(entries, name, truth[:, row]))
            panel.set_ylabel(with_unit(name, units))
        left_panel.axhline(1.0, color="0.8", linewidth=0.8)
        for rank, entry in enumerate(drawn):
            names = [fault.figures.fault for fault in entry.faults]
            if name not in names:
                continue
            column, colour = names.index(name), LINE_COLOURS[rank % len(LINE_COLOURS)]
            # The best lies on top.
            style: dict[str, Any] = {"color": colour, "zorder": 3.0 + len(drawn) - rank}
            response, estimate = np.clip(entry.responses[:, column], -1.0, 3.0), entry.estimates[:, column]
            left_panel.plot(np.arange(len(response)) * sample_time, response, label=entry.label, **style)
            noisy = entry in far[row]
            label = {"label": f"{entry.method}, far noisier"} if noisy else {}
            panels[int(noisy)].plot(times, estimate, **style, **label, linewidth=0.4 if noisy else 0.8)
        rise_times = [f.figures.most for entry in drawn for f in entry.faults if np.isfinite(f.figures.most)]
        length = max((len(entry.responses) for entry in drawn), default=2) * sample_time
        left_panel.set_xlim(0.0, min(max([3.0 * max(rise_times, default=length), 10.0 * sample_time]), length))
        left_panel.set_ylabel(f"estimate of a unit step\nof {name}")
        for panel in (left_panel, *panels):
            label_time(panel)
            tidy(panel)
        for panel in panels if row == 0 else panels[1:]:
            if panel.get_visible() and panel.get_legend_handles_labels()[0]:
                legend_above(panel)
    legend_above(axes[0, 0])
    return figure


def _far_noisier(entries: Sequence[ComparedMethod], name: str, truth: FloatArray) -> list[ComparedMethod]:
    """Return the methods whose estimate of a fault would hide the others in one panel; the first is none."""
    reaches = list[tuple[ComparedMethod, float]]()
    for entry in entries:
        names = [fault.figures.fault for fault in entry.faults]
        if name in names:
            reaches.append((entry, _reach(entry.estimates[:, names.index(name)])))
    if not reaches:
        return []
    most = NOISIER * max(_reach(truth), reaches[0][1])
    return [entry for entry, reach in reaches[1:] if reach > most]


def _range(entries: Sequence[ComparedMethod], name: str, truth: FloatArray) -> tuple[float, float]:
    """Return the ends of the panel of a fault: all of the truth, and of every estimate."""
    known = truth[np.isfinite(truth)]
    low, high = float(np.min(known, initial=0.0)), float(np.max(known, initial=0.0))
    for entry in entries:
        names = [fault.figures.fault for fault in entry.faults]
        if name in names:
            estimate = entry.estimates[:, names.index(name)]
            if np.isfinite(estimate).any():
                low, high = min(low, float(np.nanmin(estimate))), max(high, float(np.nanmax(estimate)))
    room = ROOM_AROUND_FAULT * (high - low or 1.0)
    return low - room, high + room


def _reach(values: FloatArray) -> float:
    """Return how far nearly all values of a signal reach from zero; 0 where none is known."""
    known = np.abs(values[np.isfinite(values)])
    return float(np.quantile(known, SHOWN_SAMPLES)) if known.size else 0.0
