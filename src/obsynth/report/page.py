"""One self-contained HTML page about a design: the verdict first.

Sections of a page about a recorded log: what a design says of it, and whether the two agree.

Tables of the page: facts, checks in the order of the argument, matrices; every text is escaped.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from obsynth.errors import ObsynthError
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.files.tables import aligned, standing_page
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.monitoring.alarms.events import NO_ALARM, alarm_notes, alarm_rows, silence
from obsynth.monitoring.calibration.diagnostics import Validation, draw_validation
from obsynth.monitoring.calibration.validating import states_innovations, validate
from obsynth.monitoring.logs.log_observer import DECIDING
from obsynth.monitoring.logs.run import DataRun
from obsynth.monitoring.plots.data import panel_count, plot_data
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray
from obsynth.report.designs import (
    delay_curves,
    delay_table,
    fault_estimates,
    gains_if_linear,
    plant_facts,
    promises,
    recovered_states,
    tolerance_facts,
)
from obsynth.report.headline import headline
from obsynth.report.pictures import pictures_of, shown_simulation, stacked
from obsynth.report.summary import summary
from obsynth.report.zoom import run_plots, simulation_plots, zoom_parts
from obsynth.results.checks import FITS, Check, Status
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import gain_set_digest
from obsynth.results.layout import headed_table, number, shown_numbers, verdict, verdict_line, worth
from obsynth.results.verification_report import VerificationReport
from obsynth.simulation.scenario import Scenario
from obsynth.version import __version__

#: Prefix of a check's name -> heading of its group; the others are about the shipped observer.
_CHECK_GROUPS = {"plant": "The plant", "exists": "Does such an observer exist?"}

_SHIPPED = "The shipped observer"

#: Characters of an option; a solver's log may be long.
LONGEST_VALUE = 400

#: What each word behind a verdict means.
CHECK_STATUSES: dict[Status, str] = {
    "proved": "with a bound on every rounding error, on the numbers that are stored",
    "recomputed": "in double precision, by a route that shares no intermediate result with the design",
    "estimated": "statistics, with the interval in which chance alone puts the number",
    "assumed": "stated in the gain set, and not checked",
}


_TEXT = (
    "Measured and predicted signals, innovations in a band of two deviations as the design expects them, and "
    "estimates in bands of two deviations."
)


#: A page that `html_report` has written.
PAGE = FileKind("a report of obsynth", rb'name="generator" content="obsynth"', suffix=".html")

#: Gains with more entries are not printed: the gain set has them.
MOST_ENTRIES = 900


def fact_rows(rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield a table of labels with one or more values each."""
    yield '<div class="scroll"><table class="facts"><tbody>'
    for label, *values in rows:
        cells = "".join(f"<td>{escape(value)}</td>" for value in values)
        yield f'<tr><th scope="row">{escape(label)}</th>{cells}</tr>'
    yield "</tbody></table></div>"


def copied_table(table: Table) -> Iterator[str]:
    """Yield a terminal's table as one of the page."""
    rows = zip(*(map(str, column.cells) for column in table.columns), strict=True)
    yield from table_lines([str(column.header) for column in table.columns], rows)


def table_lines(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield a table with headings; all columns but the first hold numbers."""
    kinds, rows = ["", *["number"] * (len(headings) - 1)], [tuple(row) for row in rows]
    rows = list(zip(*map(aligned, zip(*rows, strict=True)), strict=True)) if rows else rows
    yield '<div class="scroll"><table class="copied"><thead><tr>'
    yield "".join(f'<th class="{kind}">{escape(text)}</th>' for kind, text in zip(kinds, headings, strict=True))
    yield "</tr></thead><tbody>"
    for row in rows:
        cells = (f'<td class="{kind}">{escape(text)}</td>' for kind, text in zip(kinds, row, strict=True))
        yield f"<tr>{''.join(cells)}</tr>"
    yield "</tbody></table></div>"


def check_rows(checks: Sequence[Check]) -> Iterator[str]:
    """Yield the table of the checks, those that fail in a group of their own at the top, and what the kinds mean."""
    yield '<div class="scroll"><table class="checks"><thead><tr>'
    yield "".join(
        f'<th class="{"number" if heading in ("value", "bound", "margin") else ""}">{heading}</th>'
        for heading in ("verdict", "check", "value", "bound", "margin", "source")
    )
    yield "</tr></thead>"
    for title, members in groupby(sorted(checks, key=_place), key=_group):
        yield f'<tbody><tr><th colspan="6" scope="rowgroup">{escape(title)}</th></tr>'
        yield from map(_row, members)
        yield "</tbody>"
    yield "</table></div>"
    yield "<h3>What the words mean</h3>"
    yield from fact_rows(
        (status, meaning)
        for status, meaning in CHECK_STATUSES.items()
        if any(check.status == status for check in checks)
    )


def _group(check: Check) -> str:
    return "What fails" if not check.passed else _CHECK_GROUPS.get(check.name.partition(":")[0], _SHIPPED)


def _place(check: Check) -> int:
    return ("What fails", *_CHECK_GROUPS.values(), _SHIPPED).index(_group(check))


def _row(check: Check) -> str:
    word = verdict(check).plain
    detail = f"<div>{escape(check.detail)}</div>" if check.detail else ""
    marked = f'<span class="kind">{escape(worth(check))}</span>'
    numbers = "".join(
        f'<td class="number{" none" if text in ("", "-") else ""}" data-label="{label}">{text}</td>'
        for label, text in zip(("value", "bound", "margin"), shown_numbers(check), strict=True)
    )
    return (
        f'<tr><td class="word {word.lower()}" data-label="verdict">{word}{marked}</td>'
        f'<td><strong>{escape(check.name)}</strong><div class="claim">{escape(check.claim)}</div>{detail}</td>'
        f'{numbers}<td class="source">{escape(check.source)}</td></tr>'
    )


def matrix_rows(matrix: FloatArray) -> Iterator[str]:
    """Yield a matrix ``(rows, cols)``; zeros are faint."""
    if not matrix.size:
        yield '<p class="soft">empty</p>'
        return
    yield '<div class="scroll tall"><table class="matrix"><tbody>'
    for row in matrix.tolist():
        cells = (
            f'<td class="number{"" if value else " zero"}">{number(value, digits=6) if value else "0"}</td>'
            for value in row
        )
        yield f"<tr>{''.join(cells)}</tr>"
    yield "</tbody></table></div>"


def value_text(value: Any) -> str:
    """Return an option or a solver's setting as one line: matrices by rows, diagonal ones as such; long ones cut."""
    text = _text(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]} ... (the gain set has all of it)"


def _text(value: Any) -> str:
    if value is None or isinstance(value, (bool, np.bool_)):
        return {None: "none", True: "yes", False: "no"}[None if value is None else bool(value)]
    if isinstance(value, (int, float)):
        return number(float(value), digits=7)
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_text(item)}" for key, item in value.items()) or "none"
    if isinstance(value, np.ndarray) and value.ndim == 2:
        if len(value) > 1 and value.shape[0] == value.shape[1] and not np.any(value[~np.eye(len(value), dtype=bool)]):
            return f"diag({', '.join(map(_text, np.diag(value).tolist()))})"
        return f"[{'; '.join(', '.join(map(_text, row)) for row in value.tolist())}]"
    if isinstance(value, (list, tuple)) and value and all(isinstance(item, Mapping) for item in value):
        return "; ".join(map(_text, value))
    if isinstance(value, (list, tuple, np.ndarray)):
        return f"[{', '.join(_text(item) for item in value)}]" if len(value) else "none"
    return str(value)


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
        yield f"<p>This log was not compared with the design: {escape(str(error))}</p>"
        return
    if rows is None:
        said = "The log agrees" if found.passed else "The log, taken as free of faults, does not agree"
    else:
        said = f"Rows {rows} of the log {'agree' if found.passed else 'do not agree'}"
    yield f'<p class="verdict {"holds" if found.passed else "fails"}">{said} with the design.</p>'
    yield from _listed(found.verdict)
    yield from fact_rows(_facts(found, rows))
    yield from copied_table(_sensors(design, found))
    panels = 2 * len(found.sensors) + len(found.estimates)
    yield stacked("", _TEXT, panels, lambda axes: draw_validation(found, axes)).html()


def _facts(found: Validation, rows: str | None) -> Iterator[tuple[str, str]]:
    first, last = found.log["rows"]
    every = (
        "" if rows is not None else (", all of them: they are assumed to be free of faults; select others by --rows")
    )
    yield "rows", f"{first} to {last - 1}{every}"
    nis = found.nis
    yield (
        "NIS",
        (f"{nis.value:.3g} per degree of freedom; {nis.low:.2f} to {nis.high:.2f} in 95 % of logs of this length"),
    )
    if found.change is not None:
        yield "change", f"the mean of the innovations changes at row {found.change}"


def _sensors(design: ObserverDesign, found: Validation) -> Table:
    table = headed_table("sensor", "unit", "mean square", "expected", "mean (deviations)", "white (p)", "variance")
    for name, sensor in found.sensors.items():
        ratio = found.ratios.get(name)
        told = (
            number(sensor.nis.value),
            f"{sensor.nis.low:.2f} to {sensor.nis.high:.2f}",
            f"{sensor.mean:+.2g}",
            f"{sensor.whiteness.probability:.2g}",
        )
        table.add_row(
            Text(name),
            design.plant.units.get(name, ""),
            *(told if sensor.nis.samples else ("not predicted", "", "", "")),
            "as designed" if ratio is None else f"{ratio:.2g} times R",
        )
    return table


def data_section(design: ObserverDesign, run: DataRun, statement: str) -> Iterator[str]:
    """Yield a picture of a run, what was counted, and statistics of estimates and residuals in decided rows."""
    # The page itself tells what the threshold means.
    shown, count = replace(run, statement=""), panel_count(run, design=design)
    if count:
        text = (
            "Measured outputs and their estimates, fault estimates, residuals and the monitor's statistic. Grey: "
            "settling or gap, no decision. Red: alarm."
        )
        yield stacked("", text, count, lambda axes: plot_data(shown, design=design, axes=axes)).html()
    yield from fact_rows(_counts(run, statement))
    rows, more = alarm_rows(run.events, run.stamps.shown)
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
            found = (number(float(f(values))) for f in (np.min, np.mean, np.max, np.std))
            table.add_row(Text(name), unit, *found)
    yield "<h3>Statistics</h3>"
    yield from copied_table(table)


@arguments_checked
def html_report(
    design: ObserverDesign,
    path: str | Path,
    *,
    report: VerificationReport | None = None,
    gains_file: str | None = None,
    scenario: Scenario | None = None,
    system_file: str | None = None,
    run: DataRun | None = None,
    data_file: str | None = None,
    statement: str = "",
    rows: str | None = None,
    command: str | None = None,
) -> Path:
    """Write one HTML page about a design, complete in itself: it needs no network and no other file.

    Parameters
    ----------
    design : ObserverDesign
        Any design.
    path : path
        Where to write, atomically.
    report : VerificationReport, optional
        A new one, from `verify`; by default the one that the design holds.
    gains_file : str, optional
        Name of the gain set's file, for the command that reproduces the page.
    scenario : Scenario, optional
        What the design is shown on; by default each fault in turn.
    system_file : str, optional
        Name of the spec with that scenario, for the same command.
    run : DataRun, optional
        What `run_on_data` returned without ``out``: the design on measured data, shown first.
    data_file : str, optional
        Name of the log, for the same command.
    statement : str, optional
        What the monitor of that run promises.
    rows : str, optional
        ``"a:b"``: rows of that run without faults, for the question whether the log agrees with the design, asked of
        recursive and nonlinear designs; all by default.
    command : str, optional
        The command line that writes this page, for "How to reproduce this"; by default one is made of the names above.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    SpecError
        The file cannot be written, or the scenario does not fit the plant.
    PreconditionError
        The plant cannot be simulated on the scenario.

    Examples
    --------
    >>> import obsynth
    >>> from tempfile import TemporaryDirectory
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> with TemporaryDirectory() as folder:
    ...     print(obsynth.html_report(design, f"{folder}/report.html").name)
    report.html
    """
    digest, own = gain_set_digest(design), {}
    if run is not None:
        own = {
            "On your data": list(data_section(design, run, statement)),
            "Comparison with your data": list(agreement_section(design, run, rows)),
        }
    shown = design if report in (None, design.report) else design.replace(report=report)
    # What else the summary says stands in sections of its own.
    short, facts = summary(shown), tolerance_facts(shown) if _fits(shown) else []
    sections = {
        **own,
        "Summary": [
            *fact_rows(short.facts),
            *(f'<p class="warning">Warning: {escape(text)}</p>' for text in short.warnings),
        ],
        "Pictures": list(_pictures(shown, scenario)),
        "Zoom": list(zoom_parts(_zooms(shown, scenario, run))),
        "Claims": [*fact_rows(promises(shown)), *_fault_estimates(shown), *_recovered(shown)],
        "Tolerances": list(fact_rows(facts)) if facts else [],
        "Noise against delay": list(_delay(shown)),
        "Notes": list(_listed(shown.notes)) if shown.notes else [],
        "The plant": list(fact_rows(plant_facts(shown.plant))),
        "Checks": list(check_rows(shown.report.checks)) if shown.report.checks else [],
        "Gains": list(_gains(shown)),
        "How to reproduce this": list(
            _reproduction(shown, digest, gains_file, command or _command(shown, gains_file, system_file, data_file))
        ),
    }
    sections = {heading: lines for heading, lines in sections.items() if lines}
    links = "".join(f'<a href="#{_anchor(heading)}">{heading}</a>' for heading in sections)
    state = "holds" if shown.report.passed else "fails"
    written = datetime.now().astimezone().isoformat(sep=" ", timespec="minutes")
    parts = [
        *headline(shown, run),
        f'<p class="verdict {state}">{escape(verdict_line(shown.report.checks).plain)}</p>',
        f'<p class="soft">{escape(written)}; obsynth {__version__}; gain set {digest[:12]}</p>',
        f"<nav>{links}</nav>",
    ]
    for heading, lines in sections.items():
        parts += [f'<section id="{_anchor(heading)}">']
        if heading in FOLDED and shown.report.passed:
            parts += [f"<details><summary><h2>{heading}</h2></summary>", *lines, "</details>", "</section>"]
        else:
            parts += [f"<h2>{heading}</h2>", *lines, "</section>"]
    return write_atomically(path, standing_page(escape(f"{shown.name}: {shown.method}"), parts))


#: Sections that are closed at first, unless a check fails.
FOLDED = ("Checks", "Gains", "The plant")


def _zooms(design: ObserverDesign, scenario: Scenario | None, run: DataRun | None) -> Iterator[str]:
    """Yield plots of the log, or of the simulation where there is none."""
    if run is not None:
        yield from run_plots(run, design.plant.units)
    elif _fits(design) and (found := shown_simulation(design, scenario)) is not None:
        yield from simulation_plots(found[1], design.plant.units)


def _anchor(heading: str) -> str:
    return heading.lower().replace(" ", "-")


def _fault_estimates(design: ObserverDesign) -> Iterator[str]:
    if design.observer.fault_names:
        headings, rows = fault_estimates(design, gains_if_linear(design))
        yield f"<h3>{headings[0].capitalize()} estimates</h3>"
        yield from table_lines(headings, rows)


def _recovered(design: ObserverDesign) -> Iterator[str]:
    if design.recovery is not None:
        yield "<h3>States of the plant as written</h3>"
        yield from fact_rows(recovered_states(design.recovery))


def _fits(design: ObserverDesign) -> bool:
    """Whether observer and plant can be run together."""
    return all(check.name != FITS for check in design.report.failures)


def _delay(design: ObserverDesign) -> Iterator[str]:
    for curve in delay_curves(design):
        yield f"<h3>{escape(curve.fault)}</h3>"
        yield from copied_table(delay_table(curve))
        yield f"<p>{escape(curve.sentence)}</p>"


def _listed(texts: Sequence[str]) -> Iterator[str]:
    yield "<ul>"
    yield from (f"<li>{escape(text)}</li>" for text in texts)
    yield "</ul>"


def _pictures(design: ObserverDesign, scenario: Scenario | None) -> Iterator[str]:
    if not _fits(design):
        yield "<p>None: the observer does not fit its plant.</p>"
        return
    if figures := [picture.html() for picture in pictures_of(design, scenario=scenario)]:
        yield from ('<div class="pictures">', *figures, "</div>")


def _gains(design: ObserverDesign) -> Iterator[str]:
    source = method_class(design.method).source if design.method in REGISTRY else ""
    if not design.gains:
        return
    if source:
        yield f'<p class="soft">Letters as in {escape(source)}. Six digits are shown: the gain set has all of them.</p>'
    yield '<div class="gains">'
    for name, matrix in design.gains.items():
        shape = " by ".join(map(str, matrix.shape))
        yield f'<div><h3>{escape(name)} <span class="soft">({shape})</span></h3>'
        if matrix.size > MOST_ENTRIES or matrix.ndim != 2:
            yield "<p>Too large to be printed: see the gain set.</p>"
        else:
            yield from matrix_rows(matrix)
        yield "</div>"
    yield "</div>"


def _command(design: ObserverDesign, gains_file: str | None, system_file: str | None, data_file: str | None) -> str:
    """Return a command line that writes a page of these files."""
    words = ["obsynth", "report", "--gains", gains_file or f"{design.name}.gains.json", "--out", "report.html"]
    for flag, file in (("--system", system_file), ("--data", data_file)):
        words += [flag, file] if file is not None else []
    return shlex.join(words)


def _reproduction(design: ObserverDesign, digest: str, gains_file: str | None, again: str) -> Iterator[str]:
    file = shlex.quote(gains_file or f"{design.name}.gains.json")
    yield "<p>Every check again, from the gain set alone and without a solver; and this page:</p>"
    yield f"<pre>{escape(f'obsynth verify {file}')}\n{escape(again)}</pre>"
    yield from fact_rows([("obsynth", __version__)])
    yield f'<p class="soft">sha256 of the gain set</p><p class="digest">{digest}</p>'
    for title, data in (("Options", design.options), ("Solver", design.solver)):
        if data:
            yield f"<h3>{title}</h3>"
            yield from fact_rows((key, value_text(value)) for key, value in data.items())
