"""Claims x commands: what each command prints as a bound, a least or a proof, against plants that use all it allows.

A row of the table is a command, the claim in its output, and the words that the claim must carry: for which model, for
which disturbances, for which matrices.  The checks simulate the plant as written in continuous time, with disturbances
that jump inside samples at the worst times (or rest there, where the claim says so), by scipy alone.
"""

from __future__ import annotations

import re
import subprocess
import sys
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
    "design, a gain": (
        ["design", "--system", str(FILTER), "--output", "filter.json", "--quiet"],
        r"gamma = [0-9.]+, proved bound", ("the model is exact, all signals held over each sample",),
    ),
    "design, a gain of a plant that was sampled by its paper": (
        ["design", "--system", str(PAPER), "--output", "paper.json", "--quiet"],
        r"gamma = [0-9.]+, proved bound", ("the model is exact; only --monitor pointwise accounts for tolerances",),
    ),
    "compare": (
        ["compare", "--system", str(FILTER), "--runs", "2", "--quiet"],
        r"least of any causal filter",
        ("bound: largest estimate without a fault, for the exact model (tolerances not counted) and held disturbances",
         "gains and the least of any causal filter are of the exact model, with faults and disturbances that are held"),
    ),
    "evaluate, noise that the scenario leaves out": (
        ["evaluate", "--system", str(FILTER), "--runs", "2", "--monitor", "pointwise", "--noise-bound", "3", "--quiet"],
        r"never passed without a fault", ("no noise, as the scenario has none",),
    ),
    "evaluate, noise in the bound of estimates": (
        ["evaluate", "--system", str(FILTER), "--runs", "2", "--quiet"],
        r"\|estimate of loss of torque\| <=", ("noise within 3 standard deviations", "once the start has died out"),
    ),
}  # fmt: skip


@pytest.mark.long
def test_a_threshold_that_adapts_has_no_number_of_the_exact_model(capsys: pytest.CaptureFixture[str]) -> None:
    """That of the exact model was printed as the one within the tolerances."""
    command, _, _ = TABLE["evaluate, over tolerances"]
    assert main(command) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "Its threshold (it adapts to the signals of each run): never passed without a fault" in told
    assert "at the end of a run" not in told


@pytest.mark.long
def test_noise_that_a_test_has_bounds_of_is_in_no_deviations(capsys: pytest.CaptureFixture[str]) -> None:
    """Three deviations, the bound, were called one deviation."""
    command, _, _ = TABLE["evaluate, a guaranteed test"]
    assert main(command) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "sensor noise within its bounds (0.0034641 rad/s at motor speed" in told


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


@pytest.mark.long
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
    # Three digits are printed, the last rounded up; what is before these samples counts a little.
    assert 0.9 * bound <= found <= bound


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


@pytest.mark.long
def test_a_quiet_report_prints_nothing_on_stderr(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant = obsynth.DescriptorSystem(A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0)
    gains, page = tmp_path / "filter.json", tmp_path / "page.html"
    obsynth.fault_estimation_filter(plant).save(gains)
    command = ["report", "--gains", str(gains), "--out", str(page), "--force"]
    assert main([*command, "--quiet"]) == 0
    assert capsys.readouterr().err == ""
    assert main(command) == 0
    assert "drawing the page" in capsys.readouterr().err


@pytest.mark.long
def test_a_page_and_a_proof_say_for_what_gains_hold(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, design = filtered()
    gains, page, proof = (tmp_path / name for name in ("filter.json", "page.html", "proof.json"))
    design.save(gains)
    assert main(["report", "--gains", str(gains), "--out", str(page)]) == 0
    assert "the model is exact, all signals held over each sample" in page.read_text("utf-8")
    assert main(["export", "--gains", str(gains), "--to", str(proof), "--checker"]) == 0
    capsys.readouterr()
    told = subprocess.run(
        [sys.executable, "-I", str(tmp_path / "check_proof.py"), str(proof)], capture_output=True, text=True, check=True
    ).stdout
    assert re.search(r"^PROVED +gain: the l2 gain from the disturbances", told, re.MULTILINE)
    assert "NOT COVERED by this file: that the plant follows from the plant as written (elimination, sampling)" in told
    assert "All 6 claims are proved, for the numbers in this file." in told


#: An oscillator whose input and second sensor have dead times; its disturbance turns once within eight samples.
DEAD_TIME = """
schema_version: 1
name: dead-time
plant:
  dt: 0
  A: [[0, 1], [-60, -0.6]]
  E: [[1, 0], [0, 1]]
  B: [[0], [1]]
  Bf: [[0], [1]]
  Bd: [[1], [0.3]]
  C: [[1, 0], [0, 1]]
  input_names: [u]
  fault_names: [f]
  disturbance_names: [d]
  sensor_noise: {y1: 0.001, y2: 0.001}
  delays: {u: 0.2, y2: 0.3}
  transform: {sample_time: 0.1}
method: {id: fault-estimation-filter}
scenario:
  horizon: 6
  faults: {f: {kind: step, size: 1, start: 4}}
  disturbances: {d: {kind: uniform, low: -0.2, high: 0.2}}
  inputs: {u: {kind: sine, amplitude: 1, frequency: 1.0}}
  noise: 1
"""


def test_a_threshold_of_a_plant_with_dead_time_is_for_any_course(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The estimate of the sampled plant with its delay lines, driven by the plant as written, whose sensor is late."""
    file = tmp_path / "dead_time.yaml"
    file.write_text(DEAD_TIME, "utf-8")
    command = ["evaluate", "--system", str(file), "--runs", "2", "--quiet"]
    assert main([*command, "--monitor", "pointwise", "--noise-bound", "3"]) == 0
    text = capsys.readouterr().out
    told, found = paragraph(text, r"threshold \(([0-9.]+) at the end")
    for word in (MOVING_MONITOR, "d within 0.2", "sensor noise within 3 standard deviations", "assumes an exact model"):
        assert word in told, word
    estimate, size = paragraph(text, r"\|estimate of f\| <= ([0-9.]+)")
    assert HELD in estimate
    spec = obsynth.load_spec(file)
    sampled, observer = obsynth.design(spec.plant, spec.method, **spec.options).linear
    # Sensitivity of the last estimate to the outputs, and of these to the disturbance in each part of a sample.
    weights = np.zeros((SAMPLES, 2))
    for k, j in np.ndindex(SAMPLES, 2):
        y = np.zeros((SAMPLES, 2))
        y[k, j] = 1.0
        weights[k, j] = observer.run(y, np.zeros((SAMPLES, sampled.nu))).faults[-1, 0]
    inside = PARTS * 2
    a, b = np.array([[0.0, 1.0], [-60.0, -0.6]]), np.array([[1.0], [0.3]])
    part = expm(np.block([[a, b], [np.zeros((1, 3))]]) * 0.1 / inside)
    pulses = [part[:2, 2]]
    for _ in range(SAMPLES * inside):
        pulses.append(part[:2, :2] @ pulses[-1])
    effect = np.zeros(SAMPLES * inside)
    for k, j in np.ndindex(SAMPLES, 2):
        ends = k * inside - (0, 3 * inside)[j]
        effect[: max(ends, 0)] += weights[k, j] * np.array([pulses[ends - 1 - m][j] for m in range(max(ends, 0))])
    noise = 3.0 * 1e-3 * np.abs(weights).sum()
    moving = 0.2 * np.abs(effect).sum() + noise
    held = 0.2 * np.abs(effect.reshape(SAMPLES, inside).sum(axis=1)).sum() + noise
    assert 0.5 * float(found.group(1)) <= moving <= float(found.group(1)) * 1.0002
    assert 0.5 * float(size.group(1)) <= held <= float(size.group(1))
