"""The section of a page about measured data: a picture first, then what was counted."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

import numpy as np
from rich.text import Text

from obsynth.data.log_estimator import DECIDING
from obsynth.data.run import DataRun
from obsynth.plotting.data import panel_count, plot_data
from obsynth.report.layout import headed_table, number
from obsynth.report.page_tables import copied_table, fact_rows
from obsynth.report.pictures import MARGIN, PANEL, WIDE, drawn
from obsynth.results.design import ObserverDesign


def data_section(design: ObserverDesign, run: DataRun, statement: str) -> Iterator[str]:
    """Yield a picture of a run, what was counted, and statistics of estimates and residuals in decided rows."""
    count = panel_count(run)
    if count:
        text = ("Measured outputs and their estimates, fault estimates, residuals and the monitor's statistic, as far "
                "as there are any. Nothing is decided in grey rows; rows with an alarm are red.")  # fmt: skip
        source = drawn((WIDE, PANEL * count + MARGIN), count, lambda axes: plot_data(run, design=design, axes=axes))
        yield (f'<figure class="wide"><img alt="{escape(text)}" src="{source}"><figcaption>{escape(text)}</figcaption>'
               "</figure>")  # fmt: skip
    yield from fact_rows(_counts(run, statement))
    yield from (f'<p class="warning">Warning: {escape(text)}</p>' for text in run.warnings)
    yield from _statistics(design, run)


def _counts(run: DataRun, statement: str) -> Iterator[tuple[str, str]]:
    yield "rows", f"{run.rows}: " + ", ".join(f"{count} {status}" for status, count in run.statuses.items())
    for name, time in run.alarms.items():
        fault = f"; {run.isolated} stands out" if run.isolated and name not in run.thresholds else ""
        yield "alarm", f"{name}, first at {run.stamps.shown(time)}{fault}"
    if not run.alarms:
        yield "alarm", "none"
    if statement:
        yield "threshold", statement


def _statistics(design: ObserverDesign, run: DataRun) -> Iterator[str]:
    if run.table is None:
        return
    decided = run.table[run.table["status"].isin(DECIDING)]
    names = [name for name in run.table.columns if name.startswith(("fhat[", "r["))]
    if not len(decided) or not names:
        return
    table = headed_table("in decided rows", "unit", "least", "mean", "largest", "deviation")
    for name in names:
        values = decided[name].to_numpy(dtype=np.float64)
        values = values[np.isfinite(values)]
        if values.size:
            unit = design.plant.units.get(name[name.index("[") + 1 : -1], "")
            found = (number(float(f(values))) for f in (np.min, np.mean, np.max, np.std))
            table.add_row(Text(name), unit, *found)
    yield "<h3>Statistics</h3>"
    yield from copied_table(table)
