"""Signals by the names of other tools: each message says what to write, and what it says is taken."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import obsynth
from obsynth.specs.remedies import OTHER_KINDS

PLANT = "schema_version: 1\nname: one\nplant: {dt: 1.0, A: [[0.5]], C: [[1.0]], Bf: [[1.0]], fault_names: [leak]}\n"


def spec_with(folder: Path, profile: str) -> Path:
    file = folder / "spec.yaml"
    file.write_text(f"{PLANT}scenario: {{horizon: 30, faults: {{leak: {{{profile}}}}}}}\n", encoding="utf-8")
    return file


@pytest.mark.parametrize("name", sorted(OTHER_KINDS))
def test_the_kind_that_is_meant_is_named(name: str, tmp_path: Path) -> None:
    with pytest.raises(obsynth.SpecError, match=r"scenario\.faults\.leak\.kind.*Write kind: \w+") as refused:
        obsynth.load_spec(spec_with(tmp_path, f"kind: {name}"))
    written = re.search(r"Write (kind: [\w-]+(?:, \w+: \d+)*)", str(refused.value))
    assert written is not None
    if "size" in written.group(1):
        assert obsynth.load_spec(spec_with(tmp_path, written.group(1))).scenario is not None


def test_a_word_that_is_misspelt_is_still_guessed(tmp_path: Path) -> None:
    with pytest.raises(obsynth.SpecError, match="Did you mean 'step'"):
        obsynth.load_spec(spec_with(tmp_path, "kind: setp, size: 1"))
