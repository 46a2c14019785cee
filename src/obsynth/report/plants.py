"""Printed reports on a plant: its structure, its diagnosable faults, the methods that exist for it, its matrices."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from obsynth.analysis.structure import Structure
from obsynth.files.outputs import yaml_text
from obsynth.files.tables import aligned
from obsynth.methods.optimal_filter.least_possible import least_possible_of
from obsynth.methods.region_trials import REGION_CONDITION
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.report.designs import plant_facts
from obsynth.results.checks import Check
from obsynth.results.layout import checks_table, facts_table, headed_table, print_section, printed
from obsynth.results.number_texts import complex_numbers, name_list
from obsynth.results.verification_report import VerificationReport
from obsynth.verification.plant import PLANT_MATRICES

if TYPE_CHECKING:
    from obsynth.analysis.diagnosis.verdicts import Diagnosis


#: Most printed rows of a bank of residuals.
MOST_BANK_ROWS = 12

#: Explanation of the columns in the table of faults.
_COLUMN_MEANINGS = (
    "detectable: some residual responds to the fault; steady state: also to a constant one. as a step, any signal: the "
    "fault can be estimated if it is a step, or whatever its time course. delay: samples, or derivatives of the "
    "outputs in continuous time. residual, filter: order of the smallest residual generator, and of a filter that "
    "estimates the fault."
)

#: Conditions that a plant is continuous, or discrete, with the remedy for each.
_TIME_CONDITIONS = {
    "exists: continuous time": "continuous only: design for the plant in continuous time (dt: 0, without sample_time), "
    "and sample the observer afterwards (obsynth.sample_observer)",
    "exists: discrete time": "discrete only: sample the plant first (transform: {sample_time: ...} in a spec, "
    "obsynth.discretise in Python)",
}

#: Conditions on options, which do not depend on the plant.
_OPTION_CONDITIONS = {"exists: bounds stated", "exists: fault named", "exists: region stated", "exists: stated"}

#: Name of the condition that one certificate covers a region, and the id of the method whose conditions are decided at
#: points of a region only.
_OVER_REGION, _REGION_OBSERVER = f"exists: {REGION_CONDITION}", "region-observer"

_PLANT_KIND, _OF_THIS_KIND = "exists: kind of plant", "exists: plant of this kind"

#: Conditions that say nothing about a plant but its kind.
_CONDITIONS_ON_THE_KIND = {_PLANT_KIND, _OF_THIS_KIND, *_TIME_CONDITIONS}

_PLANT_NAMES = ("state_names", "input_names", "output_names", "fault_names", "disturbance_names")


def plain_table(headings: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> Iterator[tuple[str, str]]:
    """Yield the lines of a table with their styles; the first and the last column are cut to fit the width."""
    columns = [aligned([row[i] for row in rows]) for i in range(len(headings))]
    rows = list(zip(*columns, strict=True))
    widths = [max(len(row[i]) for row in (headings, *rows)) for i in range(len(headings))]
    excess = sum(widths) + 2 * (len(widths) - 1) - width
    for column in (0, len(widths) - 1):
        cut = min(max(excess, 0), max(widths[column] - 16, 0))
        widths[column] -= cut
        excess -= cut

    def line(row: Sequence[str]) -> str:
        cells = (text if len(text) <= size else f"{text[: size - 1]}…" for text, size in zip(row, widths, strict=True))
        return "  ".join(f"{text:<{size}}" for text, size in zip(cells, widths, strict=True)).rstrip()

    yield line(headings), "bold"
    for row in rows:
        yield line(row), ""


def check_report(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | PolytopicSystem | DAEModel,
    structures: Mapping[str, Structure],
    methods: Mapping[str, VerificationReport],
    *,
    console: Console,
    own: str = "",
    transformation: str = "",
) -> None:
    """Print the structure of a plant, and the existence conditions of each method for plants of this kind.

    A method for another kind of plant has no table, unless it is the spec's ``own``: it has a line by `print_methods`.
    """
    facts = list(plant_facts(plant))
    if transformation:
        facts.insert(0, ("transformed", transformation))
    print_section(console, "Plant", facts_table(facts))
    columns = [structure_facts(structure) for structure in structures.values()]
    if columns:
        rows = [(label, *(column[label] for column in columns)) for label in columns[0]]
        headings = ["", *structures] if len(columns) > 1 else []
        print_section(console, "Structure (information, no verdict)", facts_table(rows, headings=headings))
    if isinstance(plant, DescriptorSystem) and (text := least_possible_of(plant)):
        console.print()
        console.print(Text(text))
    for method, report in methods.items():
        if method == own or not {check.name for check in report.failures} & _CONDITIONS_ON_THE_KIND:
            title = f"Existence conditions of {method}"
            print_section(console, title, checks_table(report.checks, width=console.width))


def is_unclear(failed: Sequence[Check]) -> bool:
    """Whether double precision could not decide any of the conditions that do not hold."""
    return bool(failed) and all(check.unclear for check in failed)


def _verdict(failed: Sequence[Check]) -> tuple[str, str]:
    """Return what conditions that do not hold mean for the plant, in words, and their style."""
    if is_unclear(failed):
        return "UNCLEAR for this plant", "bold red"
    if failed and all(check.of_the_method or check.unclear for check in failed):
        return "not for this plant as it is", "yellow"
    return "IMPOSSIBLE for this plant", "bold red"


def structure_facts(structure: Structure) -> dict[str, str]:
    """Return the structure of a plant as labels and texts."""
    blocks = [f"{size}" for size in structure.infinite_block_sizes]
    return {
        "pencil A - zE": "regular" if structure.regular else "NOT regular",
        "index": "-" if structure.index is None else str(structure.index),
        "rank of E": structure.rank_of_E.describe(),
        "finite eigenvalues": complex_numbers(structure.finite_eigenvalues),
        "infinite blocks": f"{len(blocks)}, of size {name_list(sorted(set(blocks)))}" if blocks else "none",
        "impulse-free": _yes(structure.impulse_free),
        "stable": _yes(structure.stable),
        "admissible": _yes(structure.admissible),
        "finitely observable": _yes(structure.finitely_observable),
        "unobservable modes": complex_numbers(structure.unobservable_modes),
        "detectable": _yes(structure.detectable),
        "undetectable modes": complex_numbers(structure.undetectable_modes),
        "impulse observable": _yes(structure.impulse_observable),
        "rank [E; C] = nx": _yes(structure.causally_observable),
        "unclear ranks": name_list(structure.unclear),
    }


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def diagnosis_report(diagnosis: Diagnosis, *, console: Console, everything: bool = True) -> None:
    """Print the verdicts on all faults with their sentences; with ``everything`` isolability and residuals as well."""
    if not diagnosis.faults:
        return
    print_section(console, diagnosis.heading, _rich_table(diagnosis.verdict_rows(), console))
    console.print(Text(_COLUMN_MEANINGS, style="dim"))
    if everything and len(diagnosis.faults) > 1:
        rows = diagnosis.bank_rows()
        print_section(
            console,
            "Isolability: which fault (row) can be distinguished from which (column)",
            _rich_table(diagnosis.isolability_rows(), console),
        )
        more = len(rows) - 1 - MOST_BANK_ROWS
        title = "Structured residuals" + (f" ({more} more are not shown; --json has them)" if more > 0 else "")
        if len(rows) > 1:
            print_section(console, title, _rich_table(rows[: MOST_BANK_ROWS + 1], console))
    for sentence in diagnosis.sentences:
        console.print(Text(sentence))
    for warning in diagnosis.warnings:
        console.print(Text(f"Warning: {warning}", style="yellow"))
    if diagnosis.sentences or diagnosis.warnings:
        console.print()


def _rich_table(rows: Sequence[Sequence[str]], console: Console) -> Table:
    table = headed_table(*rows[0])
    for column, (heading, *cells) in zip(table.columns, zip(*rows, strict=True), strict=True):
        column.overflow = "fold"
        # Columns of single words must keep their width, or rich cuts off the last columns.
        column.no_wrap = " " not in heading and all(len(cell) <= len(heading) for cell in cells)
    for row in rows[1:]:
        table.add_row(*(Text(text) for text in row))
    # Names stay on one line where the other columns still fit beside them. A table's least width counts longest words,
    # which rich misses by up to a letter a column.
    names = [row[0] for row in rows]
    added = max(map(len, names)) - max(len(word) for name in names for word in name.split())
    least = Measurement.get(console, console.options, table).minimum
    table.columns[0].no_wrap = least + added + len(table.columns) <= console.width
    return table


def _all_hold(report: VerificationReport, over_region: bool) -> str:
    """Return the conclusion of a report in which all conditions hold, in words."""
    if not over_region:
        return "all conditions hold, so a design exists"
    row = next((check for check in report.checks if check.name == _OVER_REGION), None)
    if row is None:
        return (
            "all conditions hold at points of the region; whether one certificate covers all of it is decided by a "
            "design (obsynth design)"
        )
    return f"all conditions hold, and {row.claim}: {row.detail}".rstrip(": ")


def method_lines(
    methods: Mapping[str, VerificationReport], *, own: str = "", over_region: bool = False
) -> Iterator[tuple[str, str, str]]:
    """Yield each method with its verdict and a style; methods for other kinds of plants share one last line."""
    others = []
    for method, report in methods.items():
        failed = report.failures
        names = {check.name for check in failed}
        own_method = " (the spec's method)" if method == own else ""
        if report.passed:
            yield method, f"{_all_hold(report, over_region or method == _REGION_OBSERVER)}{own_method}", "green"
        elif _PLANT_KIND in names and method != own:
            others.append(method)
        elif _OVER_REGION in names and is_unclear(failed):
            reason = failed[0].detail.removeprefix("Unclear: ")
            yield method, f"UNCLEAR for this region{own_method}: {reason}".rstrip("."), "bold red"
        elif names & set(_TIME_CONDITIONS):
            yield method, next(text for name, text in _TIME_CONDITIONS.items() if name in names) + own_method, "yellow"
        elif _OF_THIS_KIND in names:
            reason = next(check.detail for check in failed if check.name == _OF_THIS_KIND)
            reason = reason.replace("The plant", "the plant", 1) if reason.startswith("The plant") else reason
            yield method, f"not for this plant{own_method}: {reason}".rstrip("."), "yellow"
        elif names & _OPTION_CONDITIONS:
            reason = " ".join(check.detail for check in failed if check.name in _OPTION_CONDITIONS)
            yield method, f"needs more options{own_method}: {reason}".rstrip("."), "yellow"
        else:
            verdict, style = _verdict(failed)
            yield method, f"{verdict}{own_method}: {_reason(failed)}", style
    if others:
        yield "for other kinds of plants", ", ".join(others), "dim"


def methods_text(methods: Mapping[str, VerificationReport]) -> str:
    """Return the text of ``print(obsynth.check(plant))``."""
    over_region = any(_OVER_REGION in {check.name for check in report.checks} for report in methods.values())
    return printed(lambda console: print_methods(methods, own="", over_region=over_region, console=console))


def print_methods(
    methods: Mapping[str, VerificationReport], *, own: str, over_region: bool = False, console: Console
) -> None:
    """Print the verdict on each method."""
    for method, text, style in method_lines(methods, own=own, over_region=over_region):
        lines = textwrap.wrap(
            f"{method}: {text}", min(console.width, 120), subsequent_indent="  ", break_on_hyphens=False
        )
        for line in lines:
            console.print(Text(line, style=style), soft_wrap=True)


def _reason(failed: Sequence[Check]) -> str:
    if not failed:
        return "no condition was checked"
    # What no observer of this kind can do without comes first.
    first, *more = sorted(failed, key=lambda check: check.of_the_method)
    condition = "the method's condition" if first.of_the_method else "the condition"
    verdict = "is not decided" if first.unclear else "FAILS"
    sentence = f"{condition} '{first.name.removeprefix('exists: ')}' {verdict}. Needed: {first.claim}".rstrip(".")
    sentence += f". Found: {first.detail.removeprefix('Unclear: ')}".rstrip(".") if first.detail else ""
    if not more:
        return f"{sentence}."
    singular, plural = ("is not decided", "are not decided") if is_unclear(failed) else ("fails", "fail")
    return f"{sentence}. {len(more)} more condition{f' {singular}' if len(more) == 1 else f's {plural}'} (-v)."


def linear_plant_text(plant: DescriptorSystem) -> str:
    """Return operating point and matrices as text, with the signals of the columns."""
    lines = ["Operating point:"]
    for name, value in plant.operating_point.items():
        unit = plant.units.get(name, "1")
        lines.append(f"  {name} = {value:.8g}{'' if unit == '1' else ' ' + unit}")
    for name, signals in (
        ("E", plant.state_names),
        ("A", plant.state_names),
        ("B", plant.input_names),
        ("C", plant.state_names),
        ("Bf", plant.fault_names),
        ("Df", plant.fault_names),
        ("Bd", plant.disturbance_names),
    ):
        matrix = getattr(plant, name)
        if matrix.size and (np.any(matrix) or name in "EABC"):
            lines += [f"{name}, columns {', '.join(signals)}:"]
            lines += ["  " + "  ".join(f"{value + 0.0:>11.5g}" for value in row) for row in matrix]
    return "\n".join(lines)


def plant_document(plant: DescriptorSystem, source: str) -> str:
    """Return the plant as a YAML document that a spec can refer to, with all digits of its numbers."""
    data: dict[str, Any] = {"schema_version": 1, "dt": float(plant.dt)}
    for name in PLANT_MATRICES:
        matrix = getattr(plant, name)
        if matrix.size and (np.any(matrix) or name in "EAC"):
            data[name] = [[float(value) + 0.0 for value in row] for row in matrix]
    data |= {name: list(getattr(plant, name)) for name in _PLANT_NAMES if getattr(plant, name)}
    data["operating_point"] = {name: float(value) for name, value in plant.operating_point.items()}
    data["units"] = dict(plant.units)
    where = "at the operating point below and at nominal values of all constants"
    return f"# Linearised by obsynth from {source}, {where}.\n{yaml_text(data)}"
