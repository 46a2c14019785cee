"""One self-contained HTML page about a design: the verdict first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path

from obsynth.data.run import DataRun
from obsynth.files.outputs import FileKind, write_atomically
from obsynth.methods.registry import REGISTRY, method_class
from obsynth.report.designs import (
    FITS,
    delay_curves,
    delay_table,
    fault_estimates,
    gains_if_linear,
    plant_facts,
    promises,
    recovered_states,
    tolerance_facts,
)
from obsynth.report.logs import agreement_section, data_section
from obsynth.report.page_tables import check_rows, copied_table, fact_rows, matrix_rows, table_lines, value_text
from obsynth.report.pictures import pictures_of
from obsynth.report.summary import summary
from obsynth.results.checks import VerificationReport
from obsynth.results.design import ObserverDesign
from obsynth.results.gain_sets import gain_set_digest
from obsynth.results.layout import verdict_line
from obsynth.simulation.scenario import Scenario

#: A page that `html_report` has written; the second mark is that of its first pages.
PAGE = FileKind("a report of obsynth", rb'name="generator" content="obsynth|<p class="verdict (holds|fails)">')
#: Gains with more entries are not printed: the gain set has them.
MOST_ENTRIES = 900


def html_report(
    design: ObserverDesign, path: str | Path, *, report: VerificationReport | None = None,
    gains_file: str | None = None, scenario: Scenario | None = None, system_file: str | None = None,
    run: DataRun | None = None, data_file: str | None = None, statement: str = "", rows: str | None = None,
) -> Path:  # fmt: skip
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
    """
    digest, own = gain_set_digest(design), {}
    if run is not None:
        own = {"On your data": list(data_section(design, run, statement)),
               "Does your data agree": list(agreement_section(design, run, rows))}  # fmt: skip
    shown = design if report in (None, design.report) else design.replace(report=report)
    reproduction = list(_reproduction(shown, digest, gains_file, system_file, data_file))
    return write_atomically(path, _page_text(shown, scenario, own, reproduction))


def _page_text(
    design: ObserverDesign, scenario: Scenario | None, own: Mapping[str, list[str]], reproduction: list[str]
) -> str:
    report = design.report
    style = files("obsynth.report").joinpath("page.css").read_text(encoding="utf-8")
    title = escape(f"{design.name}: {design.method}")
    state = "holds" if report.passed else "fails"
    sections = {
        **own,
        "In short": list(_in_short(design)),
        "Pictures": list(_pictures(design, scenario)),
        "What is promised": [*fact_rows(promises(design)), *_fault_estimates(design), *_recovered(design)],
        "Within the tolerances of the plant": list(_tolerances(design)),
        "What delay buys": list(_delay(design)),
        "Notes": list(_notes(design.notes)),
        "The plant": list(fact_rows(plant_facts(design.plant))),
        "Checks": list(check_rows(report.checks)) if report.checks else [],
        "Gains": list(_gains(design)),
        "How to reproduce this": reproduction,
    }
    shown = {heading: lines for heading, lines in sections.items() if lines}
    links = "".join(f'<a href="#{_anchor(heading)}">{heading}</a>' for heading in shown)
    parts = [
        "<!DOCTYPE html>", '<html lang="en">', "<head>", '<meta charset="utf-8">',
        '<meta name="generator" content="obsynth">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">', f"<title>{title}</title>",
        f"<style>{style}</style>", "</head>", "<body>", f"<h1>{title}</h1>",
        f'<p class="verdict {state}">{escape(verdict_line(report.checks).plain)}</p>',
        f"<nav>{links}</nav>",
    ]  # fmt: skip
    for heading, lines in shown.items():
        parts += [f'<section id="{_anchor(heading)}">', f"<h2>{heading}</h2>", *lines, "</section>"]
    return "\n".join([*parts, "</body>", "</html>"]) + "\n"


def _in_short(design: ObserverDesign) -> Iterator[str]:
    """Yield the facts of the summary and its warnings; what else it says stands in sections of its own."""
    found = summary(design)
    yield from fact_rows(found.facts)
    yield from (f'<p class="warning">Warning: {escape(text)}</p>' for text in found.warnings)


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


def _tolerances(design: ObserverDesign) -> Iterator[str]:
    if _fits(design) and (facts := tolerance_facts(design)):
        yield from fact_rows(facts)


def _fits(design: ObserverDesign) -> bool:
    """Whether observer and plant can be run together."""
    return all(check.name != FITS for check in design.report.failures)


def _delay(design: ObserverDesign) -> Iterator[str]:
    for curve in delay_curves(design):
        yield f"<h3>{escape(curve.fault)}</h3>"
        yield from copied_table(delay_table(curve))
        yield f"<p>{escape(curve.sentence)}</p>"


def _notes(notes: Sequence[str]) -> Iterator[str]:
    if notes:
        yield "<ul>"
        yield from (f"<li>{escape(note)}</li>" for note in notes)
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


def _reproduction(
    design: ObserverDesign, digest: str, gains_file: str | None, system_file: str | None, data_file: str | None
) -> Iterator[str]:
    import shlex

    from obsynth.version import __version__

    file = shlex.quote(gains_file or f"{design.name}.gains.json")
    yield "<p>Every check again, from the gain set alone and without a solver; and this page:</p>"
    again = f"obsynth report --gains {file} --out report.html"
    if system_file is not None:
        again += f" --system {shlex.quote(system_file)}"
    if data_file is not None:
        again += f" --data {shlex.quote(data_file)}"
    yield f"<pre>{escape(f'obsynth verify {file}')}\n{escape(again)}</pre>"
    yield from fact_rows([("obsynth", __version__)])
    yield f'<p class="soft">sha256 of the gain set</p><p class="digest">{digest}</p>'
    for title, data in (("Options", design.options), ("Solver", design.solver)):
        if data:
            yield f"<h3>{title}</h3>"
            yield from fact_rows((key, value_text(value)) for key, value in data.items())
