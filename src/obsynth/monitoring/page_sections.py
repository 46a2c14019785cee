"""Sections of a page about a recorded log: what a design says of it, and whether the two agree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from html import escape

import numpy as np
from rich.table import Table
from rich.text import Text

from obsynth.errors import ObsynthError, SpecError
from obsynth.monitoring.alarms.events import NO_ALARM, alarm_notes, alarm_rows, silence
from obsynth.monitoring.calibration.diagnostics import Validation, draw_validation
from obsynth.monitoring.calibration.validating import states_innovations, validate
from obsynth.monitoring.logs.log_observer import DECIDING
from obsynth.monitoring.logs.run import DataRun
from obsynth.monitoring.plots.data import panel_count, plot_data
from obsynth.monitoring.thresholds.parameter_decisions import decide
from obsynth.monitoring.thresholds.residual_monitor import monitor
from obsynth.observers.detection import Decision, Detection
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.report.page_tables import copied_table, fact_rows, listed, table_lines
from obsynth.report.pictures import stacked
from obsynth.results.design import ObserverDesign
from obsynth.results.layout import headed_table
from obsynth.results.number_texts import number
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.simulate import Simulation

_TEXT = (
    "Measured and predicted signals, innovations in a band of two deviations as the design expects them, and "
    "estimates in bands of two deviations."
)


def page_sections_of_run(
    design: ObserverDesign, run: DataRun, statement: str, rows: str | None
) -> dict[str, list[str]]:
    """Return the sections of a page about a run, lines of HTML by heading; ``statement``: what its threshold means,
    ``rows``: which of them are free of faults."""
    return {
        "On your data": list(data_section(design, run, statement)),
        "Comparison with your data": list(agreement_section(design, run, rows)),
    }


def agreement_section(design: ObserverDesign, run: DataRun, rows: str | None) -> Iterator[str]:
    """Yield verdict, table by sensor and picture of a run's log; nothing for designs without expected innovations."""
    if run.measured is None or not states_innovations(design):
        return
    try:
        # What was read is in the signals' units already.
        validation = validate(design, run.measured, rows=rows, scales=dict.fromkeys(run.measured.columns, 1.0))
    except ObsynthError as error:
        if rows is not None:
            raise
        yield f"<p>This log was not compared with the design: {escape(str(error))}</p>"
        return
    if rows is None:
        verdict = "The log agrees" if validation.passed else "The log, taken as free of faults, does not agree"
    else:
        verdict = f"Rows {rows} of the log {'agree' if validation.passed else 'do not agree'}"
    yield f'<p class="verdict {"holds" if validation.passed else "fails"}">{verdict} with the design.</p>'
    yield from listed(validation.verdict)
    yield from fact_rows(_facts(validation, rows))
    yield from copied_table(_sensors(design, validation))
    panels = 2 * len(validation.sensors) + len(validation.estimates)
    yield stacked("", _TEXT, panels, lambda axes: draw_validation(validation, axes)).html()


def _facts(validation: Validation, rows: str | None) -> Iterator[tuple[str, str]]:
    first, last = validation.log["rows"]
    assumption = (
        "" if rows is not None else (", all of them: they are assumed to be free of faults; select others by --rows")
    )
    yield "rows", f"{first} to {last - 1}{assumption}"
    nis = validation.nis
    yield (
        "NIS",
        (f"{nis.value:.3g} per degree of freedom; {nis.low:.2f} to {nis.high:.2f} in 95 % of logs of this length"),
    )
    if validation.change is not None:
        yield "change", f"the mean of the innovations changes at row {validation.change}"


def _sensors(design: ObserverDesign, validation: Validation) -> Table:
    table = headed_table("sensor", "unit", "mean square", "expected", "mean (deviations)", "white (p)", "variance")
    for name, sensor in validation.sensors.items():
        ratio = validation.ratios.get(f"R of {name}", validation.ratios.get(name))
        cells = (
            number(sensor.nis.value),
            f"{sensor.nis.low:.2f} to {sensor.nis.high:.2f}",
            f"{sensor.mean:+.2g}",
            f"{sensor.whiteness.probability:.2g}",
        )
        table.add_row(
            Text(name),
            design.plant.units.get(name, ""),
            *(cells if sensor.nis.samples else ("not predicted", "", "", "")),
            "as designed" if ratio is None else f"{ratio:.2g} times R",
        )
    return table


def data_section(design: ObserverDesign, run: DataRun, statement: str) -> Iterator[str]:
    """Yield a picture of a run, what was counted, and statistics of estimates and residuals in decided rows."""
    # The page itself tells what the threshold means.
    without_statement, count = replace(run, statement=""), panel_count(run, design=design)
    if count:
        watched = bool(run.statement or run.thresholds)
        text = (
            f"Measured outputs and their estimates, fault estimates, residuals{' and what is monitored' * watched}. "
            f"Grey: settling or gap, no decision.{' Red: alarm.' * bool(run.events)}"
        )
        yield stacked("", text, count, lambda axes: plot_data(without_statement, design=design, axes=axes)).html()
    yield from fact_rows(_counts(run, statement))
    rows, more = alarm_rows(run.events, run.stamps.shown, design.plant.units)
    if rows:
        yield "<h3>Alarms</h3>"
        yield from table_lines(rows[0], rows[1:])
        yield f"<p>and {more} more</p>" if more else ""
        yield from (f"<p>{escape(text)}</p>" for text in alarm_notes(run.events))
    yield from (f'<p class="warning">Warning: {escape(text)}</p>' for text in run.warnings)
    yield from _statistics(design, run)


def _counts(run: DataRun, statement: str) -> Iterator[tuple[str, str]]:
    yield "rows", f"{run.rows}: " + ", ".join(f"{count} {status}" for status, count in run.statuses.items())
    if statement or run.thresholds:
        for text in silence(run, "the monitor" if statement else "any threshold"):
            yield "alarms" if text.startswith(NO_ALARM) else "undecided", text
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
            cells = (number(float(f(values))) for f in (np.min, np.mean, np.max, np.std))
            table.add_row(Text(name), unit, *cells)
    yield "<h3>Statistics</h3>"
    yield from copied_table(table)


def detections(design: ObserverDesign, scenario: Scenario, simulation: Simulation) -> Iterator[Detection | Decision]:
    """Yield what the first monitor sees that this design and this scenario have; nothing where they have none."""
    if isinstance(design.observer, RecursiveObserver) and design.observer.fault_names:
        yield decide(design.observer, simulation.estimates)
    if not isinstance(design.observer, LinearObserver):
        return
    for kind in ("pointwise", "chi-square"):
        try:
            yield monitor(design, scenario, kind).watch(simulation.estimates)
        except SpecError:
            # A signal without a bound, or without a covariance; a continuous design has neither threshold.
            continue
        return
