"""Bad input to ui-pi-observer: the right error, exit code and message, and no file; from the command line."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from obsynth.cli.main import main

PAPER = {
    "dt": 0.0,
    "E": [[1, 0, 0], [0, 0, 1], [0, 0, 0]],
    "A": [[-5, 0, 0], [0, -2, 0], [0, -3, -1]],
    "C": [[1, 0, 0], [0, 1, 0]],
    "Bf": [[1], [1], [1]],
    "Bd": [[1], [0], [-1]],
}
#: A mode at 0.3 that no output shows.
HIDDEN = {
    "dt": 0.0,
    "A": [[-1, 0], [0, 0.3]],
    "C": [[1, 0]],
    "Bf": [[1], [0]],
    "state_names": ["seen", "hidden"],
}
#: A stable mode at -1 that no output shows.
FIXED = {**HIDDEN, "A": [[-1, 0], [0, -2]]}
FIVE = [-2.0, -3.0, -4.0, -5.0, -6.0]

#: Name -> plant, options, error, exit code, fragments of the message, details of the error.
CASES: dict[str, tuple[dict, dict, str, int, tuple[str, ...], dict]] = {
    "poles without their conjugates": (
        PAPER, {"fault_model": "ramp", "poles": [[-2.0, 1.0], -3.0, -4.0, -5.0, -6.0]}, "SpecError", 2,
        ("-2+1j lacks its conjugate",), {"path": "method.options.poles"}),
    "unstable poles": (
        PAPER, {"fault_model": "ramp", "poles": [*FIVE[:4], 0.5]}, "SpecError", 2,
        ("0.5", "would not be stable", "left half plane"), {"path": "method.options.poles"}),
    "a pole on the boundary": (
        PAPER, {"fault_model": "ramp", "poles": [*FIVE[:4], 0.0]}, "SpecError", 2, ("would not be stable",), {}),
    "too few poles": (
        PAPER, {"fault_model": "ramp", "poles": FIVE[:4]}, "SpecError", 2, ("4 are given, but 5 can be placed",), {}),
    "a fixed mode listed with the poles": (
        FIXED, {"poles": [-1.0, -2.0, -3.0]}, "SpecError", 2,
        ("3 are given, but 2 can be placed", "fixed, not to be listed: -2"), {}),
    "everything wrong with the poles": (
        PAPER, {"fault_model": "ramp", "poles": [[1.0, 1.0]]}, "SpecError", 2,
        ("1 is given, but 5", "would not be stable", "1+1j lacks its conjugate"), {}),
    "a pole that is no number": (PAPER, {"poles": ["fast"]}, "SpecError", 2, ("poles",), {}),
    "a pole of three numbers": (PAPER, {"poles": [[1.0, 2.0, 3.0]]}, "SpecError", 2, ("poles",), {}),
    "a fixed unstable mode": (
        HIDDEN, {}, "PreconditionError", 3, ("(D2) zeros", "s = 0.3", "'hidden'", "Measure something"),
        {"condition": "(D2) zeros", "mode": [0.3, 0.0], "signals": ["hidden"]}),
    "more unknown inputs than outputs": (
        {**PAPER, "Bd": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, {}, "PreconditionError", 3,
        ("nd <= ny", "3 unknown inputs, 2 outputs"), {"signals": ["d1", "d2", "d3"]}),
    "a model order so high that the pair is lost": (
        PAPER, {"fault_model": {"polynomial": 40}}, "PreconditionError", 3,
        ("order of the fault model", "at the zero 0.5", "Lower its order"),
        {"condition": "order of the fault model", "mode": [0.5, 0.0], "signals": ["f1"]}),
    "a model order without meaning": (
        PAPER, {"fault_model": {"polynomial": 61}}, "SpecError", 2, ("from 0 (step) to 60",), {"path": "fault_model"}),
    "a fault in the direction of the unknown input": (
        {**PAPER, "Bf": PAPER["Bd"]}, {}, "PreconditionError", 3,
        ("(D3) fault model at 0", "the fault 'f1' is masked by the unknown input 'd1'"),
        {"mode": [0.0, 0.0], "signals": ["f1", "d1"]}),
    "an exponential at the zero of the plant": (
        PAPER, {"fault_model": {"exponential": 0.5}}, "PreconditionError", 3, ("s = 0.5", "masked"),
        {"mode": [0.5, 0.0], "signals": ["f1", "d1"]}),
    "an unknown input that no output shows at once": (
        {"dt": 0.0, "A": [[0, 1], [0, -1]], "C": [[1, 0]], "Bf": [[1], [0]], "Bd": [[0], [1]]}, {},
        "PreconditionError", 3, ("(D1) decoupling", "only a derivative", "Also fails"),
        {"signals": ["d1", "f1"]}),
    "an unknown fault model": (
        PAPER, {"fault_model": "wobble"}, "SpecError", 2, ("'wobble'", "step, ramp, parabola"), {}),
    "a sinusoid without frequency": (
        PAPER, {"fault_model": {"sinusoid": 0.0}}, "SpecError", 2, ("positive number in rad/s",), {}),
    "a model for a fault that is none": (
        PAPER, {"fault_model": {"f1": "step", "f2": "step"}}, "SpecError", 2, ("no signal named 'f2'",), {}),
    "no model for a fault": (
        {**PAPER, "Bf": [[1, 0], [1, 0], [1, 1]]}, {"fault_model": {"f1": "step"}}, "SpecError", 2,
        ("has no entry for 'f2'",), {}),
    "a fault model with a hidden state": (
        PAPER, {"fault_model": {"Phi": [[0, 0], [0, -1]], "Cw": [[1, 0]]}}, "SpecError", 2,
        ("is unobservable in the fault",), {}),
    "poles and a decay": (
        PAPER, {"poles": FIVE, "decay": 1.0}, "SpecError", 2, ("poles and decay are given",), {}),
    "poles and noise": (PAPER, {"poles": FIVE, "noise": {"process": 2.0}}, "SpecError", 2, ("noise weights",), {}),
    "a negative decay": (PAPER, {"decay": -1.0}, "SpecError", 2, ("decay",), {}),
    "an empty region": (
        PAPER, {"region": {"decay": 5.0, "radius": 2.0}}, "SpecError", 2, ("the region is empty",), {}),
    "a region without a side": (PAPER, {"region": {}}, "SpecError", 2, ("at least one of decay",), {}),
    "a region with an unknown side": (PAPER, {"region": {"width": 2.0}}, "SpecError", 2, ("width",), {}),
    "a cone in discrete time": (
        {**PAPER, "dt": 1.0}, {"region": {"damping": 0.5}}, "SpecError", 2, ("continuous time",), {}),
    "noise of an output that is none": (
        PAPER, {"noise": {"measurement": {"y1": 1.0, "y9": 1.0}}}, "SpecError", 2, ("missing ['y2']", "unknown ['y9']"),
        {}),
    "G alone": (PAPER, {"G": [[0, 1], [1, -1], [0, 0]]}, "SpecError", 2, ("come together",), {}),
    "E# and C# that are none": (
        PAPER, {"E_sharp": [[1, 0, 0], [0, 0, 1], [0, 1, 0]], "C_sharp": [[0, 0], [0, 2], [0, 0]], "G": [[0, 0]] * 3},
        "SpecError", 2, ("misses the identity by 1",), {"path": "E_sharp"}),
    "a singular I - G C": (
        PAPER, {"E_sharp": [[1, 0, 0], [0, 0, 1], [0, 1, 0]], "C_sharp": [[0, 0], [0, 1], [0, 0]],
                "G": [[1, 0], [0, 0], [0, 0]]},
        "SpecError", 2, ("I - G C is singular",), {"path": "G"}),
    "an unknown option": (PAPER, {"gamma": 1.0}, "SpecError", 2, ("unknown key",), {}),
    "an unknown objective": (PAPER, {"objective": "speed"}, "SpecError", 2, ("objective",), {}),
}  # fmt: skip


def run(folder: Path, plant: dict, options: dict, verb: str = "design") -> int:
    document: dict[str, Any] = {
        "schema_version": 1, "name": "case", "plant": copy.deepcopy(plant),
        "method": {"id": "ui-pi-observer", "options": options},
    }  # fmt: skip
    (folder / "spec.yaml").write_text(json.dumps(document), encoding="utf-8")
    extra = ["--quiet"] if verb == "design" else []
    return main([verb, "--system", "spec.yaml", "--json", *extra])


@pytest.mark.long
def test_the_bases_are_good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.chdir(tmp_path)
    for plant, options in ((PAPER, {"fault_model": "ramp", "poles": FIVE}), (FIXED, {"poles": [-1.0, -3.0]})):
        assert run(tmp_path, plant, options) == 0
        assert json.loads(capsys.readouterr().out)["passed"] is True
        assert main(["verify", "case.gains.json"]) == 0
        capsys.readouterr()


@pytest.mark.one_in(4)
@pytest.mark.parametrize("case", CASES)
def test_bad_input(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plant, options, kind, code, fragments, details = CASES[case]
    monkeypatch.chdir(tmp_path)
    assert run(tmp_path, plant, options) == code
    printed = capsys.readouterr()
    error = json.loads(printed.out)
    assert (error["error"], error["exit_code"]) == (kind, code)
    for fragment in fragments:
        assert fragment in error["message"]
    for name, value in details.items():
        assert error[name] == (pytest.approx(value, abs=1e-6) if name == "mode" else value)
    assert "Traceback" not in printed.err
    assert {path.name for path in tmp_path.iterdir()} == {"spec.yaml"}


def test_check_uses_the_fault_model_of_the_spec(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(tmp_path, PAPER, {"fault_model": {"exponential": 0.5}}, "check") == 3
    methods = json.loads(capsys.readouterr().out)["methods"]
    failing = [row["name"] for row in methods["ui-pi-observer"]["checks"] if not row["passed"]]
    assert failing == ["exists: (D3) fault model at 0.5"]
    assert run(tmp_path, PAPER, {"fault_model": "ramp"}, "check") == 0
    rows = json.loads(capsys.readouterr().out)["methods"]["ui-pi-observer"]["checks"]
    assert rows[-1]["name"] == "exists: fixed modes"
