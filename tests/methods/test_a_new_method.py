"""A new method is its folder and one line of the registry: spec, CLI, report, files and verification follow."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from luenberger_method import LuenbergerObserver

import obsynth
from obsynth.cli.main import main
from obsynth.methods.method import Synthesis
from obsynth.methods.registry import REGISTRY, error_model
from obsynth.specs.loader import load_spec
from obsynth.verification.error_system import ErrorModel

SPEC = """\
schema_version: 1
name: toy
plant:
  dt: 0.1
  A: [[1.1, 0.1], [0.0, 0.9]]
  B: [[0.0], [1.0]]
  C: [[1.0, 0.0], [0.0, 1.0]]
method: {id: luenberger-observer, options: {pole: 0.25}}
scenario: {horizon: 2, inputs: {u1: {kind: step, size: 1.0}}, initial_state: {x1: 1.0}}
"""


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(REGISTRY, "luenberger-observer", "luenberger_method:LuenbergerObserver")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("spec.yaml").write_text(SPEC, encoding="utf-8")
    return tmp_path


def designed() -> obsynth.ObserverDesign:
    plant = obsynth.DescriptorSystem(None, [[1.1, 0.1], [0.0, 0.9]], [[0.0], [1.0]], np.eye(2), dt=0.1)
    return obsynth.design(plant, "luenberger-observer", pole=0.25)


def test_options_are_checked_alike_in_python_and_specs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert load_spec("spec.yaml").options == {"pole": 0.25}
    Path("spec.yaml").write_text(SPEC.replace("0.25", "1.25"), encoding="utf-8")
    with pytest.raises(obsynth.SpecError, match=r"method\.options\.pole: must be less than 1"):
        load_spec("spec.yaml")
    Path("spec.yaml").write_text(SPEC.replace("pole:", "poll:"), encoding="utf-8")
    with pytest.raises(obsynth.SpecError, match="Did you mean 'pole'"):
        load_spec("spec.yaml")
    with pytest.raises(obsynth.SpecError, match=r"pole is 1\.25: give a number above 0 and below 1"):
        obsynth.design(designed().plant, "luenberger-observer", pole=1.25)
    with pytest.raises(obsynth.SpecError, match=r"at least 0\.5"):
        obsynth.design(designed().plant, "luenberger-observer", kind="slow", pole=0.2)


def test_the_whole_command_line_knows_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["design", "--system", "spec.yaml"]) == 0
    assert "Luenberger" in capsys.readouterr().out + json.dumps(obsynth.load("toy.gains.json").report.as_dict())
    assert main(["verify", "toy.gains.json"]) == 0
    assert main(["simulate", "--system", "spec.yaml", "--out", "run.csv", "--quiet"]) == 0
    assert main(["run", "--gains", "toy.gains.json", "--data", "run.csv", "--out", "estimates.csv"]) == 0
    assert main(["report", "--gains", "toy.gains.json", "--out", "report.html"]) == 0
    assert "Luenberger 1964" in Path("report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["check", "--system", "spec.yaml", "--json"]) == 0
    assert "luenberger-observer" in capsys.readouterr().out


def test_existence_is_refused_by_its_own_condition() -> None:
    plant = obsynth.DescriptorSystem(None, [[0.5, 0.1], [0.0, 0.2]], C=[[2.0, 0.0]], dt=1.0)
    with pytest.raises(obsynth.PreconditionError, match="states measured"):
        obsynth.design(plant, "luenberger-observer")


def test_a_corrupted_design_fails(tmp_path: Path) -> None:
    good = designed()
    assert obsynth.verify(obsynth.load(good.save(tmp_path / "a.json"))).passed
    wrong = good.replace(observer=replace(good.observer, Az=good.observer.Az + 0.5 * np.eye(2)))
    assert {row.name for row in obsynth.verify(wrong).failures} == {"error dynamics", "radius"}


class TrustingObserver(LuenbergerObserver):
    """The same with a map in its certificate, which is zero, and which no check of its own looks at."""

    id = "trusting-observer"
    witnesses = frozenset({"tracking"})

    def synthesise(self, plant: obsynth.DescriptorSystem, *, progress: Callable[[str], None]) -> Synthesis:
        found = super().synthesise(plant, progress=progress)
        zero = obsynth.Certificate({"tracking": np.zeros((2, 2))}, found.certificate.claims)
        return replace(found, certificate=zero)

    @classmethod
    def error_model(cls, design: obsynth.ObserverDesign) -> ErrorModel:
        return ErrorModel(*design.linear, design.certificate.matrices["tracking"])


def test_a_zero_error_model_is_not_verified(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(REGISTRY, TrustingObserver.id, f"{__name__}:TrustingObserver")
    with pytest.raises(obsynth.VerificationError) as caught:
        obsynth.design(designed().plant, TrustingObserver.id, pole=0.25)
    assert {row.name for row in caught.value.report.failures} == {"error model"}


def test_thresholds_follow_from_the_error_model() -> None:
    """A method gets monitors over tolerances by its error model alone: T E x with T = E^-1."""
    scaled = obsynth.DescriptorSystem(
        [[2.0, 0.0], [0.0, 4.0]], [[2.2, 0.2], [0.0, 3.6]], [[0.0], [1.0]], np.eye(2), dt=0.1
    )
    design = obsynth.design(scaled, "luenberger-observer", pole=0.25)
    assert design.report.passed
    np.testing.assert_array_equal(error_model(design).own, np.diag([0.5, 0.25]))
