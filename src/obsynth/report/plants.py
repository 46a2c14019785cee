"""The structure of a plant and the existence conditions of each method, for people."""

from __future__ import annotations

from collections.abc import Mapping

from rich.console import Console
from rich.text import Text

from obsynth.analysis.structure import Structure
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.report.designs import plant_facts
from obsynth.report.layout import complex_numbers, facts_table, name_list, print_section
from obsynth.report.verification import checks_table
from obsynth.results.report import VerificationReport


def check_report(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem | DAEModel,
    structures: Mapping[str, Structure],
    methods: Mapping[str, VerificationReport],
    *,
    console: Console,
    transformation: str = "",
) -> None:
    """Print the structure of a plant, and for each method whether it can serve this plant.

    Parameters
    ----------
    plant : DescriptorSystem, TimeVaryingDescriptorSystem or DAEModel
        The plant as the methods see it.
    structures : mapping of str to Structure
        Structures to compare, by a heading such as ``as written``; none for a plant that changes with k.
    methods : mapping of str to VerificationReport
        The existence conditions of each method, by its identifier.
    console : Console
        Where to print; its width decides the layout.
    transformation : str, optional
        What was done to the plant as written.
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
    for method, report in methods.items():
        title = f"Existence conditions of {method}"
        print_section(console, title, checks_table(report.checks, width=console.width))
        console.print(_existence_line(method, report))


def _existence_line(method: str, report: VerificationReport) -> Text:
    if report.passed:
        return Text(f"{method}: all conditions hold, so a design exists.", style="green")
    failed = ", ".join(check.name for check in report.failures) or "no condition was checked"
    return Text(f"{method}: IMPOSSIBLE for this plant: {failed}.", style="bold red")


def structure_facts(structure: Structure) -> dict[str, str]:
    """Return the facts about a plant's structure."""
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
