"""Pages that are made at each build: the reference from the public names, designs and notebooks from their folders."""

from __future__ import annotations

import inspect
import re
import shutil
from pathlib import Path

from references import command_reference, spec_reference

import obsynth

MADE = "made"
#: Module prefix -> section of the reference, in order; the first that fits.
SECTIONS = (
    ("obsynth.errors", "Errors"),
    ("obsynth.plants.importing", "Plants from other tools"),
    ("obsynth.specs", "Specs"),
    ("obsynth.plants", "Plants"),
    ("obsynth.analysis", "What is possible"),
    ("obsynth.methods", "Designs"),
    ("obsynth.verification", "Verification"),
    ("obsynth.results", "Results"),
    ("obsynth.studies", "Studies"),
    ("obsynth.observers", "Observers"),
    ("obsynth.simulation", "Simulation"),
    ("obsynth.monitoring.calibration", "Calibration"),
    ("obsynth.monitoring.alarms", "Alarms and their proofs"),
    ("obsynth.monitoring.thresholds", "Thresholds"),
    ("obsynth.monitoring", "Measured data"),
    ("obsynth.exporting", "Export and reports"),
    ("obsynth.report", "Export and reports"),
)
ORDER = (
    "Plants", "Plants from other tools", "Specs", "What is possible", "Designs", "Conditions", "Verification", "Results",
    "Studies", "Observers", "Simulation", "Measured data", "Thresholds", "Alarms and their proofs", "Calibration",
    "Export and reports", "Other", "Pictures", "Errors",
)  # fmt: skip


def write_sources(folder: Path) -> None:
    """Write the pages into ``folder / made``."""
    target = folder / MADE
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    (target / "reference.rst").write_text(_reference(), encoding="utf-8")
    (target / "spec.md").write_text(spec_reference(), encoding="utf-8")
    (target / "commands.md").write_text(command_reference(), encoding="utf-8")
    _designs(folder.parent, target)
    _notebooks(folder.parent, target)
    shutil.copy(folder.parent / "CHANGELOG.md", target / "changelog.md")


def _section(item: object) -> str:
    module = getattr(item, "__module__", "") or ""
    return next((title for prefix, title in SECTIONS if module.startswith(prefix)), "Other")


def _reference() -> str:
    import obsynth.conditions
    import obsynth.plotting
    import obsynth.types

    found: dict[str, list[str]] = {}
    # A second name of the same thing has no page of its own.
    for name in (name for name in obsynth.__all__ if getattr(getattr(obsynth, name), "__name__", name) == name):
        found.setdefault(_section(getattr(obsynth, name)), []).append(f"obsynth.{name}")
    for name in obsynth.types.__all__:
        found.setdefault(_section(getattr(obsynth.types, name)), []).append(f"obsynth.types.{name}")
    found["Conditions"] = [f"obsynth.conditions.{name}" for name in obsynth.conditions.__all__]
    found["Pictures"] = [f"obsynth.plotting.{name}" for name in obsynth.plotting.__all__]
    lines = [
        "API reference",
        "=============",
        "",
        "All public functions and classes; each function has an example.",
        "",
    ]
    for title in (title for title in ORDER if title in found):
        names = sorted(found[title], key=lambda name: (not _is_function(name), name.lower()))
        lines += [title, "-" * len(title), "", ".. autosummary::", "   :toctree: api", "   :nosignatures:", ""]
        lines += [*(f"   {name}" for name in names), ""]
    return "\n".join(lines)


def _is_function(name: str) -> bool:
    value: object = obsynth
    for part in name.split(".")[1:]:
        value = getattr(value, part)
    return inspect.isfunction(value)


def _designs(root: Path, target: Path) -> None:
    """Copy the notes of each design, below a list of them."""
    entries = []
    for notes in sorted(root.glob("designs/*/NOTES.md")):
        name = notes.parent.name
        text = notes.read_text(encoding="utf-8")
        (target / f"design_{name}.md").write_text(_without_files(text), encoding="utf-8")
        entries.append(f"design_{name}")
    head = ["# Published examples and real plants", "", "One page for each: the source, what is misprinted in it, and what we",
            "do otherwise.", ""]  # fmt: skip
    lines = [*head, "```{toctree}", ":maxdepth: 1", "", *entries, "```", ""]
    (target / "designs.md").write_text("\n".join(lines), encoding="utf-8")


def _notebooks(root: Path, target: Path) -> None:
    entries = []
    for notebook in sorted(root.glob("notebooks/*.ipynb")):
        shutil.copy(notebook, target / notebook.name)
        entries.append(notebook.stem)
    lines = ["# Notebooks", "", "```{toctree}", ":maxdepth: 1", "", *entries, "```", ""]
    (target / "notebooks.md").write_text("\n".join(lines), encoding="utf-8")


def _without_files(text: str) -> str:
    """Return a page whose links to files of the repository are plain names."""
    return re.sub(r"\[([^\]]+)\]\((?!https?:)[^)]*\)", r"\1", text)
