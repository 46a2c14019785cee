"""The section of a page that asks whether a recorded log agrees with a design: innovations, verdict, what to change."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

from rich.table import Table
from rich.text import Text

from obsynth.calibration.diagnostics import Validation, draw_validation
from obsynth.calibration.validating import states_innovations, validate
from obsynth.data.run import DataRun
from obsynth.errors import ObsynthError
from obsynth.report.page_tables import copied_table, fact_rows
from obsynth.report.pictures import MARGIN, PANEL, WIDE, drawn
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
    source = drawn((WIDE, PANEL * panels + MARGIN), panels, lambda axes: draw_validation(found, axes))
    yield f'<figure class="wide"><img alt="{escape(_TEXT)}" src="{source}"><figcaption>{escape(_TEXT)}</figcaption>'
    yield "</figure>"


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
