"""One self-contained HTML page about a design: the verdict first."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from pathlib import Path

from obsynth.numerics.arrays import FloatArray
from obsynth.report.designs import plant_facts, promises
from obsynth.report.layout import number, verdict
from obsynth.report.page_style import STYLE
from obsynth.report.pictures import pictures_of
from obsynth.report.verification import verdict_line
from obsynth.results.design import ObserverDesign
from obsynth.results.report import Check, VerificationReport
from obsynth.results.serialise import design_as_dict, plain, write_atomically

#: Gains with more entries are not printed: the gain set has them.
MOST_ENTRIES = 900


def html_report(
    design: ObserverDesign, path: str | Path, *, report: VerificationReport | None = None, gains_file: str | None = None
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

    Returns
    -------
    Path
        The file.

    Raises
    ------
    SpecError
        The file cannot be written.
    """
    return write_atomically(path, page_text(design, design.report if report is None else report, gains_file=gains_file))


def page_text(design: ObserverDesign, report: VerificationReport, *, gains_file: str | None = None) -> str:
    """Return the page.

    Parameters
    ----------
    design : ObserverDesign
        Any design.
    report : VerificationReport
        Its verdict and its checks.
    gains_file : str, optional
        Name of the gain set's file.
    """
    digest = str(design_as_dict(design)["sha256"])
    title = escape(f"{design.name}: {design.method}")
    line = verdict_line(report).plain
    state = "holds" if report.passed else "fails"
    parts = [
        "<!DOCTYPE html>", '<html lang="en">', "<head>", '<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">', f"<title>{title}</title>",
        f"<style>{STYLE}</style>", "</head>", "<body>", f"<h1>{title}</h1>",
        f'<p class="verdict {state}">{escape(line)}</p>',
        *_section("What is promised", _facts(promises(design))), *_section("Plant", _facts(plant_facts(design.plant))),
        *_section("Checks", _checks(report.checks)), *_section("Notes", _notes(design.notes)),
        *_section("Pictures", _pictures(design)), *_section("Gains", _gains(design)),
        *_section("How to reproduce this", _reproduction(design, digest, gains_file)), "</body>", "</html>",
    ]  # fmt: skip
    return "\n".join(parts) + "\n"


def _section(title: str, content: Iterable[str]) -> Iterator[str]:
    lines = list(content)
    if lines:
        yield f"<section>\n<h2>{escape(title)}</h2>"
        yield from lines
        yield "</section>"


def _facts(rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield '<div class="scroll"><table class="facts"><tbody>'
    for label, *values in rows:
        cells = "".join(f"<td>{escape(value)}</td>" for value in values)
        yield f'<tr><td class="soft">{escape(label)}</td>{cells}</tr>'
    yield "</tbody></table></div>"


def _checks(checks: Sequence[Check]) -> Iterator[str]:
    headings = ("check", "claim", "value", "bound", "margin", "verdict", "kind", "source")
    yield '<div class="scroll"><table class="checks"><thead><tr>'
    yield "".join(f"<th>{heading}</th>" for heading in headings)
    yield "</tr></thead><tbody>"
    for check in checks:
        word = verdict(check).plain
        claim = f"{check.claim}; {check.detail}" if check.detail else check.claim
        numbers = "".join(
            f'<td class="number" data-label="{label}">{number(value)}</td>'
            for label, value in (("value", check.value), ("bound", check.bound), ("margin", check.margin))
        )
        yield (
            f"<tr><td><strong>{escape(check.name)}</strong></td><td>{escape(claim)}</td>{numbers}"
            f'<td class="{word.lower()}" data-label="verdict">{word}</td>'
            f'<td data-label="kind">{escape(check.kind)}</td>'
            f'<td class="soft" data-label="source">{escape(check.source)}</td></tr>'
        )
    yield "</tbody></table></div>"


def _notes(notes: Sequence[str]) -> Iterator[str]:
    if notes:
        yield "<ul>"
        yield from (f"<li>{escape(note)}</li>" for note in notes)
        yield "</ul>"


def _pictures(design: ObserverDesign) -> Iterator[str]:
    for picture in pictures_of(design):
        yield (
            f'<figure><h3>{escape(picture.title)}</h3><img alt="{escape(picture.text)}" src="{picture.source}">'
            f"<figcaption>{escape(picture.text)}</figcaption></figure>"
        )


def _gains(design: ObserverDesign) -> Iterator[str]:
    for name, matrix in design.gains.items():
        shape = " by ".join(map(str, matrix.shape))
        yield f'<h3>{escape(name)} <span class="soft">({shape})</span></h3>'
        if matrix.size > MOST_ENTRIES or matrix.ndim != 2:
            yield "<p>Too large to be printed: see the gain set.</p>"
        else:
            yield from _matrix(matrix)


def _matrix(matrix: FloatArray) -> Iterator[str]:
    yield '<div class="scroll"><table class="matrix"><tbody>'
    for row in matrix.tolist():
        yield "<tr>" + "".join(f'<td class="number">{number(value, digits=6)}</td>' for value in row) + "</tr>"
    yield "</tbody></table></div>"


def _reproduction(design: ObserverDesign, digest: str, gains_file: str | None) -> Iterator[str]:
    import shlex

    from obsynth import __version__

    file = shlex.quote(gains_file or f"{design.name}.gains.json")
    yield "<p>Every check again, from the gain set alone and without a solver; and this page:</p>"
    yield f"<pre>{escape(f'obsynth verify {file}')}\n{escape(f'obsynth report --gains {file} --out report.html')}</pre>"
    yield from _facts([("obsynth", __version__), ("sha256 of the gain set", digest)])
    for title, data in (("Options", design.options), ("Solver", design.solver)):
        if data:
            yield f"<h3>{title}</h3>"
            yield f"<pre>{escape(json.dumps(plain(data), indent=1, ensure_ascii=False))}</pre>"
