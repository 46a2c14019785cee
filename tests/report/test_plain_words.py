"""Sentences that readers did not understand are printed nowhere: by no text of the sources, and by no ``--help``."""

from __future__ import annotations

import argparse
import ast
from pathlib import Path

import pytest

import obsynth
from obsynth.cli.main import VERBS, obsynth_parser
from obsynth.report.summary import summary

SOURCE = Path(obsynth.__file__).parent
DESIGNS = Path(__file__).parents[2] / "designs"

#: Phrases that readers did not understand, and that have been replaced.
UNCLEAR = (
    "what the estimate never exceeds",
    "the bound, divided by the least of all tests",
    "which knows no scenario",
    "Alarm: learned first above",
    "of the plant as written is recovered as well",
    "rows were without a decision",
    "that need each of their sensors",
    "The goal is kept if one of these fails",
    "determine no rate",
    "whitened by an autoregression",
    "Not monitored, as they depend on the others",
    "least such gain found",
    "asymptotically every error decays",
    "except in thresholds over its tolerances",
    'none stated (under "',
    "the estimate cannot separate it from the fault",
    "a model with the stated noise (when none",
    "% per step on average",
    "largest miss ",
    "(computed twice)",
    "model assumes an exact model",
    "Deviation against delay",
    "as far as there are any",
    "to blame",
    "of no size",
    " and the like, but the design has",
    "Map signals to columns where their names differ",
    "is no JSON document",
    "is no valid ",
    "is output-nulling together with",
    "with `E` singular",
)


def texts_of(tree: ast.Module) -> list[tuple[int, str]]:
    """Return the texts of a module with their lines, without docstrings."""
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    return [
        (node.lineno, node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings
    ]


@pytest.mark.long
def test_no_text_of_the_sources_has_one() -> None:
    found = []
    for file in sorted(SOURCE.rglob("*.py")):
        texts = texts_of(ast.parse(file.read_text(encoding="utf-8")))
        found += [
            f"{file.relative_to(SOURCE)}:{line}: {part}" for line, text in texts for part in UNCLEAR if part in text
        ]
    assert len(list(SOURCE.rglob("*.py"))) > 100
    assert not found, "\n".join(found)


def test_texts_are_found_and_docstrings_are_not() -> None:
    tree = ast.parse('"""is no valid module"""\nprint(f"{name} is no valid spec")\n')
    assert texts_of(tree) == [(2, " is no valid spec")]


def test_no_help_has_one() -> None:
    parser = obsynth_parser()
    (verbs,) = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    texts = {name: " ".join(own.format_help().split()) for name, own in verbs.choices.items()}
    assert set(texts) == set(VERBS)
    assert [(name, part) for name, text in texts.items() for part in UNCLEAR if part in text] == []


@pytest.mark.parametrize("name", ["wang2015", "filasova", "motor"])
def test_no_summary_has_one(name: str) -> None:
    spec = obsynth.load_spec(DESIGNS / name / "spec.yaml")
    design = obsynth.design(spec.plant, spec.method, **dict(spec.options))
    text = " ".join(str(summary(design, everything=True)).split())
    assert "gamma" in text or "decay" in text
    assert [part for part in UNCLEAR if part in text] == []
