"""What ``--json`` prints holds numbers as numbers, with no text that is one."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from obsynth.cli.main import main

ROOT = Path(__file__).parents[2]
SPEC = str(ROOT / "designs" / "wang2015" / "spec.yaml")
#: Sentences for people and what a solver says, which may begin with a number.
TEXTS = {"detail", "status"}
COMMANDS = {
    "check": ("check", "--system", SPEC),
    "design": ("design", "--system", SPEC, "--out", "GAINS"),
    "evaluate": ("evaluate", "--system", SPEC, "--runs", "2"),
    "simulate": ("simulate", "--system", SPEC, "--out", "RUN"),
    "compare": ("compare", "--system", SPEC, "--runs", "2"),
}


def numbers_as_texts(value: Any, path: str = "") -> Iterator[str]:
    """Yield where a text is a number, alone or with a unit behind it."""
    if isinstance(value, dict):
        for name, part in value.items():
            if name not in TEXTS:
                yield from numbers_as_texts(part, f"{path}.{name}")
    elif isinstance(value, list):
        for i, part in enumerate(value):
            yield from numbers_as_texts(part, f"{path}[{i}]")
    elif isinstance(value, str) and re.fullmatch(r"[-+]?\d[\d.,]*(e[-+]?\d+)?( \S+)?", value):
        yield f"{path}: {value!r}"


@pytest.mark.long
@pytest.mark.parametrize("name", COMMANDS)
def test_numbers_are_numbers(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {"GAINS": str(tmp_path / "filter.gains.json"), "RUN": str(tmp_path / "run.csv")}
    assert main([files.get(word, word) for word in (*COMMANDS[name], "--json")]) == 0
    assert list(numbers_as_texts(json.loads(capsys.readouterr().out))) == []


def test_a_text_that_is_a_number_is_seen() -> None:
    assert list(numbers_as_texts({"rows": [{"peak": "0.107 W"}, {"peak": 1.0}], "detail": "3 states"})) == [
        ".rows[0].peak: '0.107 W'"
    ]
