"""Sections of a page about a recorded log: what a design says of it, and whether the two agree."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

import numpy as np
from rich.table import Table
from rich.text import Text

from obsynth.calibration.diagnostics import Validation, draw_validation
from obsynth.calibration.validating import states_innovations, validate
from obsynth.data.log_estimator import DECIDING
from obsynth.data.run import DataRun
from obsynth.errors import ObsynthError
from obsynth.plotting.data import panel_count, plot_data
from obsynth.report.page_tables import copied_table, fact_rows
from obsynth.report.pictures import stacked
from obsynth.results.design import ObserverDesign
from obsynth.results.layout import headed_table, number

_TEXT = ("Measured and predicted signals, innovations in a band of two deviations as the design expects them, and "
         "estimates in bands of two deviations.")  # fmt: skip


def agreement_section(design: ObserverDesign, run: DataRun, rows: str | None) -> Iterator[str]:
    """Yield verdict, table by sensor and picture of a run's log; nothing for designs without expected innovations."""
    if run.measured is None or not states_innovations(design):
        return
    try:
        # What was read is in the signals' units already.
        found = validate(design, run.measured, rows=rows, scales=dict.fromkeys(run.measured.columns, 1.0))
    except ObsynthError as error:
        if rows is not None:
            raise
        yield f"<p>Not asked of this log: {escape(str(error))}</p>"
        return
    state = "holds" if found.passed else "fails"
    sentence = "The log agrees with the design." if found.passed else "The log does not agree with the design."
    yield f'<p class="verdict {state}">{sentence}</p>'
    yield "<ul>"
    yield from (f"<li>{escape(text)}</li>" for text in found.verdict)
    yield "</ul>"
    yield from fact_rows(_facts(found, rows))
    yield from copied_table(_sensors(design, found))
    panels = 2 * len(found.sensors) + len(found.estimates)
    yield stacked("", _TEXT, panels, lambda axes: draw_validation(found, axes)).html()


def _facts(found: Validation, rows: str | None) -> Iterator[tuple[str, str]]:
    first, last = found.log["rows"]
    every = "" if rows is not None else ", all: taken as free of faults; --rows names those that are"
    yield "rows", f"{first} to {last - 1}{every}"
    nis = found.nis
    yield "NIS", f"{nis.value:.3g} per degree of freedom; {nis.low:.2f} to {nis.high:.2f} in 95 % of logs like this one"
    if found.change is not None:
        yield "change", f"the mean of the innovations changes at row {found.change}"


def _sensors(design: ObserverDesign, found: Validation) -> Table:
    table = headed_table("sensor", "unit", "mean square", "expected", "mean (deviations)", "white (p)", "variance")
    for name, sensor in found.sensors.items():
        ratio = found.ratios.get(name)
        table.add_row(
            Text(name), design.plant.units.get(name, ""), number(sensor.nis.value),
            f"{sensor.nis.low:.2f} to {sensor.nis.high:.2f}", f"{sensor.mean:+.2g}",
            f"{sensor.whiteness.probability:.2g}", "as designed" if ratio is None else f"{ratio:.2g} times R",
        )  # fmt: skip
    return table


def data_section(design: ObserverDesign, run: DataRun, statement: str) -> Iterator[str]:
    """Yield a picture of a run, what was counted, and statistics of estimates and residuals in decided rows."""
    count = panel_count(run)
    if count:
        text = ("Measured outputs and their estimates, fault estimates, residuals and the monitor's statistic, as far "
                "as there are any. Nothing is decided in grey rows; rows with an alarm are red.")  # fmt: skip
        yield stacked("", text, count, lambda axes: plot_data(run, design=design, axes=axes)).html()
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
