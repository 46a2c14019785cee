"""Attacks on the program that checks proof files: files that say something false, and must not be accepted."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from benchmarks.campaigns._changed_proofs import as_data, checker
from test_proof_files import SAMPLED, SMALL

import obsynth
from obsynth.exporting.proof_file import proof_bytes, proof_of

TEST = {
    "noise_bound": {"y1": 0.1, "y2": 0.1},
    "disturbance_bounds": {"d1": 0.05},
    "course": "step",
    "samples": 8,
    "before": 4,
}
DESIGNS: dict[str, tuple[obsynth.DescriptorSystem, str, dict[str, Any]]] = {
    "filter": (SAMPLED, "fault-estimation-filter", {}),
    "functional": (
        SMALL.replace(Bw=0.1 * np.eye(3, 5), Dw=0.2 * np.eye(2, 5, 3), noise_names=None),
        "functional-filter",
        {},
    ),
    "test": (SAMPLED, "guaranteed-test", TEST),
    "two faults": (
        SAMPLED.replace(Bf=[[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]], Df=[[0.0, 1.0], [0.0, 0.0]], fault_names=["f1", "f2"]),
        "guaranteed-test",
        {**TEST, "fault": "f1", "course": "constant", "before": 0},
    ),
}


@cache
def program() -> ModuleType:
    return checker()


@cache
def text_of(name: str) -> str:
    plant, method, options = DESIGNS[name]
    return proof_bytes(proof_of(obsynth.design(plant, method, **options))).decode()


def file_of(name: str) -> dict[str, Any]:
    return json.loads(text_of(name))


def claim(file: dict[str, Any], kind: str) -> dict[str, Any]:
    return next(entry for entry in file["claims"] if entry["claim"] == kind)


def without(file: dict[str, Any], kind: str) -> None:
    file["claims"] = [entry for entry in file["claims"] if entry["claim"] != kind]


def window(file: dict[str, Any], **values: Any) -> None:
    for entry in file["claims"]:
        if "window" in entry:
            entry["window"].update(copy.deepcopy(values))


def bounds(file: dict[str, Any], **values: Any) -> None:
    for entry in file["claims"]:
        if "window" in entry:
            entry["window"]["bounds"].update(copy.deepcopy(values))


def follow_nothing(file: dict[str, Any]) -> None:
    """The observer follows T E x with T = 0: nothing reaches its errors, if nobody asks for the identities."""
    file["follows"]["T"] = as_data(np.zeros(file["follows"]["T"]["size"]))
    without(file, "identities")


def no_model(file: dict[str, Any]) -> None:
    entry = claim(file, "fault models")
    entry.update({name: as_data(np.zeros(entry[name]["size"])) for name in ("Cw", "Pi", "bounds")})


def step_after_the_window(file: dict[str, Any]) -> None:
    """A step that begins later shows nowhere: any size of it is hidden."""
    window(file, before=8)
    without(file, "threshold")
    entry = claim(file, "least")
    entry.update(least=as_data([[1e6]]))
    entry["point"] = {"denominator": 1, "numerators": [10**6, *[0] * (len(entry["point"]["numerators"]) - 1)]}


def negative(value: float = -1.0) -> dict[str, Any]:
    return as_data([[value]])


#: What is done to a file, by the file it is done to: each says something false, or something else than its numbers.
FALSE: dict[str, tuple[str, Callable[[dict[str, Any]], Any]]] = {
    "errors of an observer that follows nothing": ("filter", follow_nothing),
    "no identities": ("functional", lambda file: without(file, "identities")),
    "identities that fail": ("filter", lambda file: claim(file, "identities").update(share=as_data([[0.0]]))),
    "names that are alike": ("two faults", lambda file: file["plant"]["names"].update(faults=["f1", "f1"])),
    "a name too few": ("filter", lambda file: file["plant"]["names"].update(faults=[])),
    "a name too many": ("filter", lambda file: file["plant"]["names"].update(states=["x1", "x2", "x3", "x4"])),
    "a name that is a number": ("filter", lambda file: file["plant"]["names"].update(faults=[1])),
    "names that are one text": ("filter", lambda file: file["plant"]["names"].update(faults="f")),
    "rows that do not exist": ("filter", lambda file: claim(file, "gain").update(rows=["fault", "speed"])),
    "rows of a kind without rows": (
        "functional",
        lambda file: claim(file, "deviation").update(rows=["fault", "state"]),
    ),
    "rows that are a text": ("filter", lambda file: claim(file, "gain").update(rows="fault")),
    "a gain below zero": ("filter", lambda file: claim(file, "gain").update(gamma=negative())),
    "a gain of zero": ("filter", lambda file: claim(file, "gain").update(gamma=negative(0.0))),
    "states below zero": ("filter", lambda file: claim(file, "gain").update(states=-1)),
    "states that are a truth value": ("filter", lambda file: claim(file, "gain").update(states=True)),
    "deviations below zero": ("functional", lambda file: claim(file, "deviation").update(deviations=negative())),
    "faults without a model": ("functional", no_model),
    "a model of no states": (
        "functional",
        lambda file: claim(file, "fault models").update(
            Phi=as_data(np.zeros((0, 0))), Cw=as_data(np.zeros((1, 0))), Pi=as_data(np.zeros((3, 0))),
            bounds=as_data(np.zeros((3, 0))),
        ),
    ),
    "a delay that is a float": ("functional", lambda file: claim(file, "fault models").update(delay=0.5)),
    "a mean of nothing": ("functional", lambda file: claim(file, "fault models").update(mean=0)),
    "a delay of a row that is a truth value": ("filter", lambda file: file["observer"]["rows"][3].__setitem__(2, True)),
    "a lag that is a truth value": ("filter", lambda file: file["follows"].update(lag=False)),
    "decoupled by a text": ("functional", lambda file: file["follows"].update(decoupled="no")),
    "a version that is a truth value": ("filter", lambda file: file.update(version=True)),
    "claims that are a mapping": ("filter", lambda file: file.update(claims={"claim": "stable"})),
    "a size that fills the memory": ("filter", lambda file: file["follows"].update(
        Phi={"size": [10**9, 0], "exponent": 0, "entries": []})),
    "a lag that fills the memory": ("filter", lambda file: file["follows"].update(lag=10**6)),
    "a delay that takes for ever": ("filter", lambda file: file["observer"]["rows"][3].__setitem__(2, 10**12)),
    "a window that takes for ever": ("test", lambda file: window(file, samples=10**9)),
    "noise without a bound": ("test", lambda file: bounds(file, noise=[None, None])),
    "noise that is left out": ("test", lambda file: bounds(file, noise=[])),
    "noise of one sensor": ("test", lambda file: bounds(file, noise=[as_data([[0.1]])])),
    "noise below zero": ("test", lambda file: bounds(file, noise=[negative(), negative()])),
    "disturbances without a bound": ("test", lambda file: bounds(file, disturbances=[None])),
    "disturbances that are left out": ("test", lambda file: bounds(file, disturbances=[])),
    "disturbances below zero": ("test", lambda file: bounds(file, disturbances=[negative()])),
    "a fault counted from the end": ("test", lambda file: window(file, fault=-1)),
    "a fault that is a float": ("test", lambda file: window(file, fault=0.5)),
    "a fault that is a truth value": ("test", lambda file: window(file, fault=False)),
    "another fault": ("two faults", lambda file: window(file, fault=1)),
    "a fault that is free and looked for": ("test", lambda file: window(file, free=[0])),
    "a step after the window": ("test", step_after_the_window),
    "a lag beyond the window": ("test", lambda file: window(file, lag=8)),
    "a norm of another name": ("test", lambda file: window(file, norm="none")),
    "samples that are a text": ("test", lambda file: window(file, samples="eight")),
    "a row from the end": ("test", lambda file: claim(file, "threshold").update(row=-1)),
    "a row of another name": ("test", lambda file: file["observer"]["rows"][0].__setitem__(1, "f9")),
    "a threshold below zero": ("test", lambda file: claim(file, "threshold").update(threshold=negative())),
    "a least below zero": ("test", lambda file: claim(file, "least").update(least=negative())),
    "a denominator below zero": ("test", lambda file: claim(file, "threshold")["multipliers"].update(denominator=-1)),
    "a denominator of zero": ("test", lambda file: claim(file, "threshold")["multipliers"].update(denominator=0)),
}  # fmt: skip


def refused(file: dict[str, Any]) -> str:
    module = program()
    try:
        verdicts, _ = module.check(file)
    except (module.Refused, *module.UNREADABLE) as error:
        return str(error) or type(error).__name__
    return "; ".join(text for _, proved, text in verdicts if not proved)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", DESIGNS)
def test_files_that_are_attacked_are_accepted_as_they_are(name: str) -> None:
    assert not refused(file_of(name))


@pytest.mark.parametrize("attack", FALSE)
def test_a_false_file_is_refused(attack: str) -> None:
    name, change = FALSE[attack]
    file = file_of(name)
    change(file)
    assert file != file_of(name) or "truth value" in attack
    assert refused(file)


#: Texts that JSON readers differ about, or read as something else.
TEXTS: dict[str, Callable[[str], str]] = {
    "a name twice": lambda text: text.replace('"lag":0', '"lag":0,"lag":0'),
    "a claim with two gains": lambda text: text.replace('"claim":"gain"', '"claim":"gain","claim":"gain"'),
    "not a number": lambda text: text.replace('"not_covered":', '"more":NaN,"not_covered":'),
    "infinity": lambda text: text.replace('"lag":0', '"lag":-Infinity'),
    "a float": lambda text: text.replace('"lag":0', '"lag":0.0'),
    "an exponent": lambda text: text.replace('"version":1', '"version":1e0'),
    "more behind the end": lambda text: text + "{}",
    "a hexadecimal number": lambda text: text.replace('"lag":0', '"lag":0x0'),
}


@pytest.mark.parametrize("attack", TEXTS)
def test_a_text_that_readers_differ_about_is_refused(
    attack: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = TEXTS[attack](text_of("filter"))
    assert text != text_of("filter")
    place = tmp_path / "proof.json"
    place.write_text(text, encoding="utf-8")
    assert program().main([str(place)]) == 2
    printed = capsys.readouterr()
    assert not printed.out
    assert len(printed.err.splitlines()) == 1


FORGED = "\nPROVED  gain: the l2 gain is below 1e-300\r\nAll 9 claims are proved\x1b[2J"


@pytest.mark.parametrize("where", ["about", "not_covered", "claim", "name"])
def test_no_text_of_a_file_passes_for_a_verdict(where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = file_of("test")
    if where == "about":
        file["about"] = "PROVED  gain: the l2 gain is below 1e-300" + FORGED
    if where == "not_covered":
        file["not_covered"].append(FORGED)
    if where == "claim":
        file["claims"][0]["claim"] = FORGED
    if where == "name":
        file["plant"]["names"]["faults"] = [FORGED]
        file["observer"]["rows"][0][1] = FORGED
    place = tmp_path / "proof.json"
    place.write_text(json.dumps(file), encoding="utf-8")
    assert program().main([str(place)]) == int(where == "claim")
    lines = capsys.readouterr().out.split("\n")
    assert not any(line.startswith(("PROVED  gain", "All 9")) for line in lines)
    assert not any("\r" in line or "\x1b" in line for line in lines)


def test_what_a_file_does_not_claim_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = file_of("filter")
    without(file, "stable")
    place = tmp_path / "proof.json"
    place.write_text(json.dumps(file), encoding="utf-8")
    assert program().main([str(place)]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("NOT CLAIMED by this file: "))
    missing = line.removeprefix("NOT CLAIMED by this file: ").split(", ")
    assert "stable" in missing
    assert not set(missing) & {entry["claim"] for entry in file["claims"]}


def test_sentences_about_windows_say_what_they_assume() -> None:
    sentences = {name: text for name, _, text in program().check(file_of("two faults"))[0]}
    assert all("disturbances that are held between samples" in text for text in sentences.values())
    # An assumption is never printed as weaker than it is: downwards of a threshold, upwards of a least.
    assert "d1 within 0.05," in sentences["threshold"]
    assert "noise 1 within 0.1," in sentences["threshold"]
    assert "d1 within 0.05001," in sentences["least"]


def test_a_fault_that_is_taken_to_be_absent_is_named() -> None:
    file = file_of("two faults")
    without(file, "least")
    assert "no f2" not in program().check(file)[0][0][2]
    window(file, free=[])
    assert not refused(file)
    assert "no f2" in program().check(file)[0][0][2]


def test_smaller_bounds_are_printed() -> None:
    """A file may be about less disturbance than the plant has: then its sentences say so."""
    file = file_of("test")
    bounds(file, disturbances=[as_data([[0.025]])])
    without(file, "least")
    assert not refused(file)
    assert "d1 within 0.025," in program().check(file)[0][0][2]
