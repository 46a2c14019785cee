"""Specs of nonlinear plants that are wrong: each says what and where, and ends with the right exit code."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from obsynth.cli.main import main

GOOD: dict[str, Any] = {
    "schema_version": 1, "name": "tank",
    "plant": {
        "kind": "dae",
        "equations": {"balance": "area * der(level) = inflow - outflow", "valve": "outflow = c * sqrt(level)"},
        "outputs": {"seen": "level", "flow": "outflow"}, "states": {"level": 1.0, "outflow": 0.5},
        "inputs": {"inflow": 0.5}, "parameters": {"c": 0.5}, "constants": {"area": 2.0},
        "units": {"level": "m", "outflow": "m3/s", "inflow": "m3/s", "c": "m2.5/s", "seen": "m", "flow": "m3/s"},
    },
    "method": {
        "id": "dae-adaptive-observer",
        "options": {"dt": 1.0, "Q": {"balance": 1e-6}, "R": {"seen": 1e-4, "flow": 1e-4}},
    },
}  # fmt: skip


def changed(path: str, value: Any) -> dict[str, Any]:
    def copy(node: Any) -> Any:
        return {key: copy(item) for key, item in node.items()} if isinstance(node, dict) else node

    document = copy(GOOD)
    *outer, last = path.split("/")
    node = document
    for key in outer:
        node = node[key]
    if value is None:
        del node[last]
    else:
        node[last] = value
    return document


def run(document: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    text = io.StringIO()
    YAML(typ="safe").dump(document, text)
    spec = folder / "spec.yaml"
    spec.write_text(text.getvalue(), encoding="utf-8")
    code = main(["design", "--system", str(spec), "--quiet", "-v", "--output", str(folder / "gains.json")])
    captured = capsys.readouterr()
    return code, captured.err if code else captured.out


@pytest.mark.long
def test_the_good_one_is_designed_saved_and_verified(tmp_path, capsys) -> None:
    code, text = run(GOOD, tmp_path, capsys)
    assert code == 0
    assert "deviation after the nominal run" in text
    assert main(["verify", str(tmp_path / "gains.json")]) == 0
    assert main(["check", "--system", str(tmp_path / "spec.yaml")]) == 0


@pytest.mark.one_in(4)
@pytest.mark.parametrize(
    ("path", "value", "code", "words"),
    [
        ("plant/equations/valve", "outflow = c * sqrt(levle)", 2, ["equations.valve", "'levle'"]),
        ("plant/equations/valve", None, 2, ["1 equation for 2 states", "too few"]),
        ("plant/equations/valve", "inflow = 1", 2, ["'valve'", "neither a state"]),
        ("plant/equations/valve", "outflow = import os", 2, ["equations.valve", "'import os'", "invalid syntax"]),
        ("plant/equations/valve", 3.0, 2, ["equations", "a text"]),
        ("plant/units/x", "m", 2, ["units names 'x'"]),
        ("plant/parameters/d", 1.0, 2, ["parameter 'd' enters no equation"]),
        ("plant/inputs/spare", 1.0, 2, ["input 'spare' enters no equation"]),
        ("plant/states/level", "one", 2, ["must be a number"]),
        ("plant/statse", {}, 2, ["unknown key", "'states'"]),
        ("method/options/dt", 0.0, 2, ["method.options.dt", "greater than 0"]),
        ("method/options/dt", None, 2, ["dt is missing"]),
        ("method/options/R", {"seen": 1e-4}, 2, ["R must be positive definite"]),
        ("method/options/R", {"sen": 1e-4}, 2, ["no signal named 'sen'", "'seen'"]),
        ("method/options/Q", {"balance": -1.0}, 2, ["method.options.Q"]),
        ("method/options/integration", "euler", 2, ["'backward-euler'"]),
        ("method/id", "adaptive-observer", 2, ["method.options"]),
        ("plant/equations/valve", "level = c", 3, ["index 2", "valve"]),
        ("plant/equations/balance", "2 * outflow - inflow = 2 * c * sqrt(level) - inflow", 3,
         ["not independent", "'balance'"]),
        ("plant/equations/balance", "outflow = 2 * c * sqrt(level) + inflow", 5, ["No solution at k = 0", "equation"]),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(path, value, code, words, tmp_path, capsys) -> None:
    found, text = run(changed(path, value), tmp_path, capsys)
    flat = " ".join(text.split())
    assert found == code, flat
    assert [word for word in words if word not in flat] == [], flat
    assert not (tmp_path / "gains.json").exists()
