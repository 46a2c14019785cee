"""What the tests of the command line share: a gain set that several commands read is verified and bounded once."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from obsynth import ObserverDesign
from obsynth.cli import gain_sets
from obsynth.files.inputs import protect
from obsynth.report import designs as tables
from obsynth.report import page
from obsynth.report.terminal import output
from obsynth.results.gain_set_writing import gain_set_digest


@pytest.fixture(scope="session")
def verified_again() -> Callable[[Path], Any]:
    """Return what the verbs do with a gain set, and remember the outcome for exactly the bytes of the file."""
    really, known = output.verified_again, {}

    def remembered(path: Path) -> Any:
        if not path.is_file():
            return really(path)
        content = hashlib.sha256(path.read_bytes()).digest()
        if content not in known:
            known[content] = really(path)
        # As a file that is read is.
        protect(path)
        return known[content]

    return remembered


@pytest.fixture(autouse=True)
def _verified_once(verified_again: Callable[[Path], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """The verbs that hand a gain set on remember; ``verify`` does not."""
    for module in (output, gain_sets):
        monkeypatch.setattr(module, "verified_again", verified_again)


@pytest.fixture(scope="session")
def facts_once() -> Callable[[ObserverDesign], list[tuple[str, str]]]:
    """Return what a design promises within its tolerances, and remember it for exactly the contents of a gain set."""
    really, known = tables.tolerance_facts, {}

    def remembered(design: ObserverDesign) -> list[tuple[str, str]]:
        digest = gain_set_digest(design)
        if digest not in known:
            known[digest] = really(design)
        return known[digest]

    return remembered


@pytest.fixture(autouse=True)
def _tolerances_once(
    facts_once: Callable[[ObserverDesign], list[tuple[str, str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (tables, page):
        monkeypatch.setattr(module, "tolerance_facts", facts_once)
