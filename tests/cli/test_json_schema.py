"""What ``--json`` prints fits the schema that the package has, command by command."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from obsynth.cli.main import VERBS, main

ROOT = Path(__file__).parents[2]
WANG = str(ROOT / "designs/wang2015/spec.yaml")
OVEN = str(ROOT / "docs/examples/thermal/spec.yaml")
REACTOR = str(ROOT / "docs/examples/reactor/spec.yaml")
SCHEMA: dict[str, Any] = json.loads(files("obsynth.cli").joinpath("results.schema.json").read_text(encoding="utf-8"))
LOG = ("--gains", "GAINS", "--data", "LOG", "--time-column", "Timestamp")
FAST = {
    "check": ("--system", OVEN),
    "verify": ("GAINS",),
    "run": (*LOG, "--threshold", "fhat[heater fault]=1", "--out", "OUT.csv"),
    "export": ("--gains", "GAINS", "--to", "OUT.c"),
    "sensors": ("--system", OVEN),
}
SLOW = {
    "plot": (*LOG, "--out", "OUT.png"),
    "thresholds": (*LOG, "--rows", "0:360"),
    "report": ("--gains", "GAINS", "--out", "OUT.html"),
    "sweep": ("--system", OVEN, "--set", "plant.transform.sample_time=[10, 20]", "--out", "OUT"),
    "simulate": ("--system", WANG, "--out", "OUT.csv"),
    "evaluate": ("--system", WANG, "--runs", "2"),
    "compare": ("--system", WANG, "--runs", "2"),
    "calibrate": ("--system", OVEN, "--data", "LOG", "--time-column", "Timestamp", "--rows", "0:360"),
    "linearise": ("--system", REACTOR),
}


def printed(words: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    main([*words, "--json"])
    return json.loads(capsys.readouterr().out)


def problems(document: Any) -> list[str]:
    return [
        f"{error.json_path}: {error.message}" for error in jsonschema.Draft202012Validator(SCHEMA).iter_errors(document)
    ]


@pytest.fixture(scope="module")
def oven(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("oven")
    assert main(["design", "--system", OVEN, "--output", str(folder / "oven.gains.json"), "--quiet"]) == 0
    rows = [f"{10 * k},100,{175.45 + 0.1 * (k % 3)},{147.27 + 0.1 * (k % 5)},{120 + 0.1 * (k % 7)}" for k in range(400)]
    (folder / "log.csv").write_text("\n".join(["Timestamp,power,heater,air,wall", *rows]) + "\n", encoding="utf-8")
    return {"GAINS": str(folder / "oven.gains.json"), "LOG": str(folder / "log.csv")}


@pytest.mark.parametrize(
    ("verb", "words"),
    [*FAST.items(), *(pytest.param(*item, marks=pytest.mark.long) for item in SLOW.items())],
    ids=[*FAST, *SLOW],
)
def test_a_result_fits_the_schema(verb: str, words: tuple[str, ...], oven, tmp_path: Path, capsys) -> None:
    words = tuple(oven.get(word, word) for word in words)
    words = tuple(str(tmp_path / word) if word.startswith("OUT") else word for word in words)
    document = printed([verb, *words], capsys)
    assert document["command"] == verb
    assert problems(document) == []


def test_a_design_and_an_error_fit_the_schema(tmp_path: Path, capsys) -> None:
    document = printed(["design", "--system", OVEN, "--output", str(tmp_path / "o.gains.json")], capsys)
    assert problems(document) == []
    assert problems(printed(["design", "--system", str(tmp_path / "none.yaml")], capsys)) == []
    # What is not so is found, in each of the ways in which a document may be wrong.
    assert problems({**document, "passed": "yes"}) == ["$.passed: 'yes' is not of type 'boolean'"]
    assert problems({name: value for name, value in document.items() if name != "gain_set"}) == [
        "$: 'gain_set' is a required property"
    ]
    assert problems({**document, "command": "desing"})
    assert problems({"error": "SpecError", "message": "", "exit_code": 1})
    assert problems({})


def test_the_schema_is_one_and_knows_every_command() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert set(SCHEMA["properties"]["command"]["enum"]) == set(VERBS)
    named = {rule["if"].get("properties", {}).get("command", {}).get("const") for rule in SCHEMA["allOf"]} - {None}
    assert named == set(VERBS)
