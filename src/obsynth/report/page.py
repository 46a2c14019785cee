"""The HTML page about a design: one self-contained file, with the verdict first."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from datetime import datetime
from html import escape
from pathlib import Path

from obsynth.files.outputs import FileKind, write_atomically
from obsynth.files.tables import standing_page
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.numerics.arguments import arguments_checked
from obsynth.report.designs import (
    UNVERIFIED_NOTES,
    delay_curves,
    delay_table,
    fault_estimates,
    gains_if_linear,
    plant_facts,
    promises,
    recovered_states,
    tolerance_facts,
)
from obsynth.report.headline import DataRun, headline
from obsynth.report.page_tables import check_rows, copied_table, fact_rows, listed, matrix_rows, table_lines, value_text
from obsynth.report.pictures import pictures_of, shown_simulation
from obsynth.report.summary import summary
from obsynth.report.zoom import run_plots, simulation_plots, zoom_parts
from obsynth.results.checks import FITS
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_set_writing import gain_set_digest
from obsynth.results.layout import verdict_line
from obsynth.results.registered import registered
from obsynth.results.verification_report import VerificationReport
from obsynth.simulation.scenario import Scenario
from obsynth.version import __version__

#: A page that `html_report` has written.
PAGE = FileKind("a report of obsynth", rb'name="generator" content="obsynth"', suffix=".html")

#: Gains with more entries are not printed: the gain set has them.
MOST_ENTRIES = 900

#: Sections that are closed at first, unless a check fails.
FOLDED = ("Checks", "Gains", "The plant")


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
        own = registered("page_sections_of_run")(design, run, statement, rows)
    verified = design if report in (None, design.report) else design.replace(report=report)
    # What else the summary says stands in sections of its own.
    short, facts = summary(verified), tolerance_facts(verified) if _fits(verified) else []
    sections = {
        **own,
        "Summary": [
            *fact_rows(short.facts),
            *(f'<p class="warning">Warning: {escape(text)}</p>' for text in short.warnings),
        ],
        "Pictures": list(_pictures(verified, scenario)),
        "Zoom": list(zoom_parts(_zooms(verified, scenario, run))),
        "Claims": [*fact_rows(promises(verified)), *_fault_estimates(verified), *_recovered(verified)],
        "Tolerances": list(fact_rows(facts)) if facts else [],
        "Noise against delay": list(_delay(verified)),
        "Notes": [f"<p>{UNVERIFIED_NOTES}</p>", *listed(verified.notes)] if verified.notes else [],
        "The plant": list(fact_rows(plant_facts(verified.plant))),
        "Checks": list(check_rows(verified.report.checks)) if verified.report.checks else [],
        "Gains": list(_gains(verified)),
        "How to reproduce this": list(
            _reproduction(
                verified, digest, gains_file, command or _command(verified, gains_file, system_file, data_file)
            )
        ),
    }
    sections = {heading: lines for heading, lines in sections.items() if lines}
    links = "".join(f'<a href="#{_anchor(heading)}">{heading}</a>' for heading in sections)
    state = "holds" if verified.report.passed else "fails"
    written = datetime.now().astimezone().isoformat(sep=" ", timespec="minutes")
    parts = [
        *headline(verified, run, interval=None if scenario is None else scenario.sample_time),
        f'<p class="verdict {state}">{escape(verdict_line(verified.report.checks).plain)}</p>',
        f'<p class="soft">{escape(written)}; obsynth {__version__}; gain set {digest[:12]}</p>',
        f"<nav>{links}</nav>",
    ]
    for heading, lines in sections.items():
        parts += [f'<section id="{_anchor(heading)}">']
        if heading in FOLDED and verified.report.passed:
            parts += [f"<details><summary><h2>{heading}</h2></summary>", *lines, "</details>", "</section>"]
        else:
            parts += [f"<h2>{heading}</h2>", *lines, "</section>"]
    return write_atomically(path, standing_page(escape(f"{verified.name}: {verified.method}"), parts), kind=PAGE)


def _zooms(design: ObserverDesign, scenario: Scenario | None, run: DataRun | None) -> Iterator[str]:
    """Yield plots of the log, or of the simulation where there is none."""
    if run is not None:
        yield from run_plots(run, design.plant.units)
    elif _fits(design) and (demonstration := shown_simulation(design, scenario)) is not None:
        yield from simulation_plots(demonstration[1], design.plant.units)


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
        yield f"<h3>{escape(curve.title)}</h3>"
        yield from copied_table(delay_table(curve))
        yield f"<p>{escape(curve.sentence)}</p>"


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
