"""Zoomable plots on a page: uPlot and the data are part of the page, which needs no network."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from html import escape
from importlib.resources import files
from itertools import pairwise
from typing import Any

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.report.plots.panels import (
    ESTIMATE_STYLE,
    MEASURED_STYLE,
    RESIDUAL_STYLE,
    THRESHOLD_STYLES,
    TRUE_STYLE,
    with_unit,
)

#: More samples than this are drawn by their least and largest value in as many bins: no peak is lost.
MOST_POINTS = 6000
#: In a second: what pandas counts dates in.
NANOSECONDS = 1e9
#: Significant digits of the values in a page.
DIGITS = 6
#: What a line shows -> colour, width in pixels, dashes.
LINES: Mapping[str, dict[str, Any]] = {
    "truth": {"stroke": "#000000", "width": TRUE_STYLE["linewidth"]},
    "estimate": {"stroke": ESTIMATE_STYLE["color"], "width": ESTIMATE_STYLE["linewidth"]},
    "measured": {"stroke": "#808080", "width": MEASURED_STYLE["linewidth"]},
    "residual": {"stroke": RESIDUAL_STYLE["color"], "width": RESIDUAL_STYLE["linewidth"]},
    "threshold": {"stroke": THRESHOLD_STYLES[0]["color"], "width": 1.5, "dash": [6, 4]},
}


def zoomable(
    label: str, time: Any, lines: Sequence[tuple[str, str, Any]], *, dated: bool = False, shift: float = 0.0
) -> str:
    """Return a box that opens to a plot.

    ``lines``: what each shows (a key of `LINES`), its label and its values ``(samples,)``.  ``dated``: times are
    seconds since 1970 in UTC, shown by a clock that is ``shift`` seconds ahead.
    """
    signals = [np.asarray(line[2], dtype=np.float64) for line in lines]
    columns = _thinned([np.asarray(time, dtype=np.float64), *signals])
    plot = {
        "label": label,
        "across": "time" if dated else "time (s)",
        "dated": dated,
        "shift": shift,
        "lines": [{**LINES[kind], "label": name} for kind, name, _ in lines],
        "values": [columns[0].tolist(), *map(_plain, columns[1:])],
    }
    return (
        f'<details class="zoom"><summary>{escape(label)}</summary>'
        f'<div class="plot" data-plot="{escape(json.dumps(plot, allow_nan=False), quote=True)}"></div></details>'
    )


def zoom_parts(plots: Iterable[str]) -> Iterator[str]:
    """Yield plots with what draws them; nothing where there are none."""
    boxes = list(plots)
    if not boxes:
        return
    folder = files("obsynth.report")
    yield f"<style>{folder.joinpath('zoom.css').read_text(encoding='utf-8')}</style>"
    yield '<p class="soft">Open a signal; drag to zoom in, double-click to zoom out.</p>'
    yield from boxes
    yield f"<script>{folder.joinpath('zoom.js').read_text(encoding='utf-8')}</script>"


def simulation_plots(simulation: Any, units: Mapping[str, str]) -> Iterator[str]:
    """Yield a plot of each fault (or parameter) with its estimate."""
    estimates, time = simulation.estimates, simulation.time
    true = simulation.faults[:, list(simulation.fault_columns)]
    estimated = estimates.parameters if estimates.has_deviations else estimates.faults
    for i, name in enumerate(estimates.fault_names):
        lines = [("truth", "true", true[:, i]), ("estimate", "estimate", estimated[:, i])]
        yield zoomable(with_unit(name, units), time, lines)


def run_plots(run: Any, units: Mapping[str, str]) -> Iterator[str]:
    """Yield a plot of each measured output and each fault estimate of a log, with the levels of the run."""
    if run.table is None or run.measured is None or not len(run.table):
        return
    import pandas as pd

    dated, time = bool(run.stamps.is_dated), run.table["time"]
    seconds, shift = time.to_numpy(), 0.0
    if dated:
        seconds = pd.to_datetime(time, utc=True).to_numpy("datetime64[ns]").astype(np.int64) / NANOSECONDS
        first = datetime.fromtimestamp(float(seconds[0]), run.stamps.zone or UTC)
        shift = (first.utcoffset() or timedelta()).total_seconds()
    for name in (str(name) for name in run.measured.columns if name != "time"):
        lines = [("measured", "measured", run.measured[name])]
        if f"xhat[{name}]" in run.table:
            lines.append(("estimate", "estimate", run.table[f"xhat[{name}]"]))
        yield zoomable(with_unit(name, units), seconds, lines, dated=dated, shift=shift)
    for column in (str(name) for name in run.table.columns if str(name).startswith("fhat[")):
        lines = [("estimate", "estimate", run.table[column])]
        if (level := run.thresholds.get(column)) is not None:
            lines += [("threshold", "threshold", np.full(len(run.table), side * level)) for side in (1.0, -1.0)]
        yield zoomable(with_unit(column[5:-1], units), seconds, lines, dated=dated, shift=shift)


def _thinned(columns: list[FloatArray]) -> list[FloatArray]:
    """Return columns of at most `MOST_POINTS` rows: of more the least and the largest value of each bin."""
    count = len(columns[0])
    if count <= MOST_POINTS:
        return columns
    edges = np.linspace(0, count, MOST_POINTS // 2 + 1).astype(np.int64)
    time = np.repeat([columns[0][begin] for begin in edges[:-1]], 2)
    ends = [
        np.ravel([(np.fmin.reduce(c[a:b]), np.fmax.reduce(c[a:b])) for a, b in pairwise(edges.tolist())])
        for c in columns[1:]
    ]
    return [time, *ends]


def _plain(column: FloatArray) -> list[float | None]:
    """Return numbers as JSON has them, short; what is not finite is missing."""
    return [float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None for value in column.tolist()]
