"""Weights and reference models of optimal filters as transfer functions, in every form in which they are written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest
import scipy.signal

import obsynth
from obsynth.specs.loader import design_of_spec, load_spec

PLANTS = {
    0.0: obsynth.DescriptorSystem(A=[[-1.0]], Bf=[[0]], Bw=[[1, 0]], C=[[1], [1]], Df=[[1], [0]], Dw=[[0, 0], [0, 1]]),
    0.5: obsynth.DescriptorSystem(
        A=[[0.5]], Bf=[[1]], Bw=[[1, 0, 0]], C=[[1], [1]], Df=[[1], [0]], Dw=[[0, 1, 0], [0, 0, 1]], dt=0.5
    ),
}
#: Of an error and of a noise: numerator and denominator.
WEIGHTS = {0.0: (([1, 10, 24], [1, 3, 2]), ([3], [1, 0.5])), 0.5: (([1, -0.5], [1, -0.9]), ([0.2], [1, -1.3, 0.4]))}
FORMS: dict[str, Any] = {
    "num, den": lambda num, den, dt: {"num": num, "den": den},
    "scipy TransferFunction": lambda num, den, dt: scipy.signal.TransferFunction(num, den, **_time(dt)),
    "scipy ZerosPolesGain": lambda num, den, dt: scipy.signal.TransferFunction(num, den, **_time(dt)).to_zpk(),
    "scipy StateSpace": lambda num, den, dt: scipy.signal.TransferFunction(num, den, **_time(dt)).to_ss(),
    "control TransferFunction": lambda num, den, dt: control.tf(num, den, dt),
}


def _time(dt: float) -> dict[str, float]:
    return {"dt": dt} if dt else {}


def options_in(form: str, dt: float) -> dict[str, Any]:
    """Return options of which the weights, and in continuous time the reference, are in one form."""
    error, noise = (FORMS[form](*weight, dt) for weight in WEIGHTS[dt])
    options: dict[str, Any] = {"weights": {"errors": error, "inputs": {"w1": noise}}}
    return options | ({"delay": 1} if dt else {"reference": FORMS[form]([5], [1, 5], dt)})


def weighted_gain(design: obsynth.ObserverDesign, dt: float) -> float:
    """Return the largest size of the weighted error on a grid, from plant and filter and polynomials alone."""
    plant, o = PLANTS[dt], design.observer
    turns = np.linspace(1e-3, np.pi - 1e-3, 400)
    largest = 0.0
    for p in np.exp(1j * turns) if dt else 1j * np.tan(turns / 2.0):
        seen = plant.C @ np.linalg.solve(p * plant.E - plant.A, plant.Bw.astype(complex)) + plant.Dw
        shown = o.Cz @ np.linalg.solve(p * np.eye(o.order) - o.Az, o.By.astype(complex)) + o.Dy
        error, noise = (np.polyval(num, p) / np.polyval(den, p) for num, den in WEIGHTS[dt])
        largest = max(largest, abs(error) * np.linalg.norm(shown @ seen * np.array([noise, *[1.0] * (plant.nw - 1)])))
    return largest


@pytest.mark.one_in(3)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("dt", PLANTS)
def test_a_transfer_function_is_the_same_weight_in_every_form(form: str, dt: float) -> None:
    design = obsynth.optimal_filter(PLANTS[dt], **options_in(form, dt))
    assert design.report.passed
    reached = weighted_gain(design, dt)
    assert design.least <= design.gain * (1 + 1e-12)
    assert reached <= design.gain * (1 + 1e-9)
    assert reached == pytest.approx(design.least, rel=1e-3)


def test_a_spec_states_transfer_functions(tmp_path: Path) -> None:
    (tmp_path / "spec.yaml").write_text(
        """
schema_version: 1
name: weighted
plant:
  dt: 0.5
  A: [[0.5]]
  C: [[1], [1]]
  Bf: [[1]]
  Df: [[1], [0]]
  Bw: [[1, 0, 0]]
  Dw: [[0, 1, 0], [0, 0, 1]]
method:
  id: optimal-filter
  options:
    delay: 1
    weights:
      errors: {num: [1, -0.5], den: [1, -0.9]}
      inputs: {w1: {num: [0.2], den: [1, -1.3, 0.4]}}
"""
    )
    design = design_of_spec(load_spec(tmp_path / "spec.yaml"))
    called = obsynth.optimal_filter(PLANTS[0.5], **options_in("num, den", 0.5))
    assert design.certificate.claims["gain"] == called.gain
    again = obsynth.load(design.save(tmp_path / "a.gains.json"))
    assert obsynth.verify(again).passed


def test_one_transfer_function_is_the_reference_of_each_fault() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.0]], Bf=[[0, 0]], Bw=[[0, 0]], C=[[0], [0]], Df=np.eye(2), Dw=np.diag([0.5, 2.0]), dt=1.0
    )
    design = obsynth.optimal_filter(plant, reference={"num": [1], "den": [1, 0]})
    assert design.gain == pytest.approx(2.0, rel=1e-8)
    assert np.shape(design.options["reference"]["D"]) == (2, 2)


@pytest.mark.parametrize(
    ("dt", "weight", "words"),
    [
        (0.0, {"num": [1, 2], "den": [1]}, "more zeros than poles: add fast poles"),
        (0.5, {"num": [1, 2], "den": [1]}, "more zeros than poles: divide it by z"),
        (0.0, scipy.signal.TransferFunction([1, 2], [1]), "no proper state space"),
        (0.0, scipy.signal.TransferFunction([1], [1, 0.5], dt=0.5), "dt = 0.5, the plant 0: give both the same.$"),
        (0.5, scipy.signal.TransferFunction([1], [1, 0.5]), r"sample_system\(..., 0.5, 'tustin'\)"),
        (0.0, {"num": ["x"], "den": [1, 1]}, "num of the weight is no list of numbers"),
        (0.0, {"num": [1], "den": [0, 0]}, "den of the weight is no list of numbers"),
        (0.0, {"num": [[1]], "den": [1, 1]}, "num of the weight is no list of numbers"),
        (0.0, {"num": [1], "den": [1, -1]}, "not stable"),
        # By the bilinear transformation its zeros are at -1, of which rounding makes two beside the circle.
        (0.5, control.sample_system(control.tf([1], [4, 4, 1]), 0.5, "tustin"), "no stable inverse"),
        (0.0, {"num": [1, 0], "den": [1, 1]}, "no stable inverse"),
        (0.0, {"num": [1], "den": [1, 1]}, "add one beyond the frequencies that matter"),
    ],
)
def test_transfer_functions_that_are_no_weights_of_errors_are_refused(dt: float, weight: Any, words: str) -> None:
    with pytest.raises(obsynth.SpecError, match=words):
        obsynth.optimal_filter(PLANTS[dt], weights={"errors": weight}, **({"delay": 1} if dt else {}))
