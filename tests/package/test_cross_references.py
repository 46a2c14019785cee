"""Modules and names that docstrings and comments refer to exist."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import pytest

import obsynth

PACKAGE = Path(obsynth.__file__).parent


def missing_references(text: str) -> list[str]:
    """Return the dotted names in single backticks that are neither modules nor names that stand in one."""
    missing = []
    for reference in re.findall(r"`(obsynth(?:\.\w+)+)`", text):
        parts = reference.split(".")
        known = max(k for k in range(1, len(parts) + 1) if is_module(parts[:k]))
        rest = parts[known:]
        origin = find_spec(".".join(parts[:known])).origin
        public = known == 1 and hasattr(obsynth, parts[1])
        if rest and not public and not re.search(rf"\b{rest[0]}\b", Path(origin).read_text()):
            missing.append(reference)
    return missing


def is_module(parts: list[str]) -> bool:
    path = PACKAGE.joinpath(*parts[1:])
    return path.is_dir() or path.with_suffix(".py").is_file()


@pytest.mark.parametrize("room", sorted(path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()))
def test_what_a_room_refers_to_exists(room: str) -> None:
    for module in (PACKAGE / room).rglob("*.py"):
        assert missing_references(module.read_text()) == [], module


def test_a_reference_to_nothing_is_seen() -> None:
    assert missing_references("as `obsynth.numerics.no_such_module` does") == ["obsynth.numerics.no_such_module"]
    assert missing_references("`obsynth.numerics.ranks.no_such_name`") == ["obsynth.numerics.ranks.no_such_name"]
