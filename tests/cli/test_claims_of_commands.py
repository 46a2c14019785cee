"""Claims x commands: what each command prints as a bound, a least or a proof, against plants that use all it allows.

A row of the table is a command, the claim in its output, and the words that the claim must carry: for which model, for
which disturbances, for which matrices.  The checks simulate the plant as written in continuous time, with disturbances
that jump inside samples at the worst times (or rest there, where the claim says so), by scipy alone.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm

import obsynth
from obsynth.cli.main import main

ROOT = Path(__file__).parents[2]
TEST, FILTER, PAPER = (ROOT / "designs" / name for name in
                       ("drive/guaranteed_test.yaml", "drive/spec.yaml", "wang2015/spec.yaml"))  # fmt: skip
PARTS, SAMPLES = 24, 30

EXACT, HELD = "if the model is exact", "disturbances are held between samples"
MOVING_BOUND = "if the model is exact and disturbances move within their bounds between samples"
MOVING_MONITOR = "disturbances move within their bounds between samples"
MOVING_TEST = "disturbances of any time course, between samples too"
MOVING_PROOF = "any course of disturbances within their bounds, between samples too"

#: Command, the claim, what stands in the same paragraph.
TABLE: dict[str, tuple[list[str], str, tuple[str, ...]]] = {
    "evaluate, estimates": (
        ["evaluate", "--system", str(FILTER), "--runs", "2", "--quiet"],
        r"\|estimate of loss of torque\| <= ([0-9.e-]+)", (EXACT, MOVING_BOUND),
    ),
    "evaluate, estimates of the paper": (
        ["evaluate", "--system", str(PAPER), "--runs", "2", "--quiet"],
        r"\|estimate of actuator 1\| <= ([0-9.e-]+)", (EXACT, HELD),
    ),
    "evaluate, over tolerances": (
        ["evaluate", "--system", str(FILTER), "--runs", "2", "--monitor", "pointwise", "--noise-bound", "3", "--quiet"],
        r"never passed without a fault", (MOVING_MONITOR, "constants", "an alarm is a fault, or a constant outside"),
    ),
    "evaluate, held": (
        ["evaluate", "--system", str(FILTER), "--runs", "2", "--monitor", "pointwise", "--noise-bound", "3",
         "--disturbance-course", "held", "--quiet"],
        r"never passed without a fault", (HELD, "constants"),
    ),
    "evaluate, a guaranteed test": (
        ["evaluate", "--system", str(TEST), "--runs", "2", "--monitor", "pointwise", "--quiet"],
        r"never passed without a fault", (MOVING_MONITOR, "constants", "an alarm is a fault, or a constant outside"),
    ),
    "design": (
        ["design", "--system", str(TEST), "--output", "test.json", "--quiet", "--verbose"],
        r"without the fault the residual never passes this", (MOVING_TEST,),
    ),
}  # fmt: skip


def paragraph(text: str, claim: str) -> tuple[str, re.Match[str]]:
    """Return the paragraph, in one line, in which a claim stands, and the claim."""
    for part in re.split(r"\n\s*\n", text):
        whole = " ".join(part.split())
        if (found := re.search(claim, whole)) is not None:
            return whole, found
    raise AssertionError(f"{claim} is not in the output:\n{text}")


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", TABLE)
def test_each_claim_says_what_it_holds_for(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command, claim, words = TABLE[name]
    assert main(command) == 0
    told, _ = paragraph(capsys.readouterr().out, claim)
    assert [word for word in words if word not in told] == []


@cache
def filtered() -> tuple[obsynth.Spec, obsynth.ObserverDesign]:
    spec = obsynth.load_spec(FILTER)
    return spec, obsynth.design(spec.plant, spec.method, **spec.options)


def in_pieces(plant: obsynth.DescriptorSystem, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what a sample, and a part of it, do to the states of a plant as written, and what a disturbance adds."""
    inverse = np.linalg.inv(plant.E)
    a, b = inverse @ plant.A, inverse @ plant.Bd
    n, nd = b.shape
    part = expm(np.block([[a, b], [np.zeros((nd, n + nd))]]) * dt / PARTS)
    return np.linalg.matrix_power(part[:n, :n], PARTS), part[:n, :n], part[:n, n:]


def outputs(plant: obsynth.DescriptorSystem, dt: float, signs: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the outputs of the plant as written, from rest, for disturbances ``(samples, PARTS, nd)``."""
    _, step, push = in_pieces(plant, dt)
    x, y = np.zeros(plant.nx), []
    for now, white in zip(signs, noise, strict=True):
        y.append(plant.C @ x + white)
        for d in now:
            x = step @ x + push @ d
    return np.array(y)


def worst(plant: obsynth.DescriptorSystem, dt: float, row: Any, *, held: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return signs of disturbances and of noise that make a row of a record ``(SAMPLES, ny)`` largest at its end."""
    ones = np.eye(SAMPLES * plant.ny).reshape(-1, SAMPLES, plant.ny)
    weights = np.array([row(y) for y in ones]).reshape(SAMPLES, -1)
    _, step, push = in_pieces(plant, dt)
    signs, ahead = np.zeros((SAMPLES, PARTS, plant.nd)), np.zeros(plant.nx)
    for k in range(SAMPLES - 1, -1, -1):
        for part in range(PARTS - 1, -1, -1):
            signs[k, part] = ahead @ push
            ahead = ahead @ step
        ahead = ahead + weights[k] @ plant.C
    if held:
        signs[:] = signs.sum(axis=1, keepdims=True)
    return np.sign(signs), np.sign(weights)


def test_the_bound_of_estimates_is_of_the_exact_model_and_moving_disturbances(
    capsys: pytest.CaptureFixture[str],
) -> None:
    command, claim, _ = TABLE["evaluate, estimates"]
    assert main(command) == 0
    bound = float(paragraph(capsys.readouterr().out, claim)[1].group(1))
    _, design = filtered()
    assert design.source is not None
    plant, (sampled, observer), dt = design.source.plant, design.linear, design.linear[0].dt

    def row(y: np.ndarray) -> float:
        return float(observer.run(y, np.zeros((len(y), sampled.nu))).faults[-1, 0])

    signs, noise = worst(plant, dt, row, held=False)
    sizes = 3.0 * np.abs(sampled.Dw).sum(axis=1)
    found = row(outputs(plant, dt, 0.2 * signs, noise * sizes))
    # Three digits are printed; what is before these samples counts a little.
    assert 0.9 * bound <= found <= bound * 1.005


@pytest.mark.long
def test_a_threshold_over_tolerances_is_for_corners_and_courses_between_samples(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    _, design = filtered()
    assert design.source is not None
    sampled, observer = design.linear
    dt, uncertain = sampled.dt, sampled.uncertainty
    assert uncertain is not None

    def row(y: np.ndarray) -> float:
        return float(observer.run(y, np.zeros((len(y), sampled.nu))).faults[-1, 0])

    signs, noise = worst(design.source.plant, dt, row, held=False)
    y = outputs(design.source.plant, dt, 0.2 * signs, noise * 3.0 * np.abs(sampled.Dw).sum(axis=1))
    data = pd.DataFrame(np.hstack([np.zeros((SAMPLES, sampled.nu)), y]), columns=[*sampled.input_names,
                                                                                  *sampled.output_names])  # fmt: skip
    data.insert(0, "time", dt * np.arange(SAMPLES))
    data.to_csv("log.csv", index=False)
    design.save("filter.json")
    limits = ["--disturbance", "load torque=0.2", "--noise-bound", "3"]
    start = [part for name in sampled.state_names for part in ("--initial", f"{name}=0")]
    found = {}
    for course in ("any", "held"):
        command = [
            "run",
            "--gains",
            "filter.json",
            "--data",
            "log.csv",
            "--out",
            f"{course}.csv",
            "--monitor",
            "pointwise",
        ]
        assert main([*command, "--disturbance-course", course, *limits, *start, "--warm-up", "0", "--force"]) == 0
        told = " ".join(capsys.readouterr().out.split())
        assert (MOVING_MONITOR if course == "any" else HELD) in told
        found[course] = pd.read_csv(f"{course}.csv").iloc[-1]
    assert found["any"]["statistic"] <= found["any"]["threshold"]
    assert found["held"]["threshold"] < found["any"]["threshold"]
    command = ["prove-alarm", "--gains", "filter.json", "--data", "log.csv", "--row", str(SAMPLES), *limits, *start]
    assert main([*command, "--window", "8"]) in (0, 1, 5)
    told = " ".join(capsys.readouterr().out.split())
    assert "Cannot be proved" in told
    assert MOVING_PROOF in told


def test_the_least_gain_of_a_filter_is_that_of_its_matrices() -> None:
    plant = obsynth.load_spec(PAPER).plant
    level = obsynth.conditions.wang2015(plant, gamma=1.1).existence["exists: gamma"]
    assert not level.passed
    assert "none with this T, N and W is below" in level.detail
    with pytest.raises(obsynth.InfeasibleError, match="for this T, N and W"):
        obsynth.fault_estimation_filter(plant, weight="paper", gamma=1.1)
    # Another weight reaches it: the sentence is about these matrices alone.
    assert obsynth.fault_estimation_filter(plant, weight="free", gamma=1.1).certificate.claims["gamma"] <= 1.1
