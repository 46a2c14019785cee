"""Beside the threshold of every method stands the least that any test can have."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import obsynth
from obsynth.cli.main import main
from obsynth.studies.least_thresholds import design_beside_least, in_words, thresholds_beside_least
from obsynth.studies.tables import comparison_report

DRIVE = Path(__file__).parents[2] / "designs/drive/spec.yaml"


def test_the_drive_s_filter_beside_the_least() -> None:
    spec = obsynth.load_spec(DRIVE)
    scenario = spec.scenario.replace(noise=1.0, disturbances={"load torque": obsynth.Uniform(low=-1.0, high=1.0)})
    design = obsynth.design(spec.plant, spec.method)
    bound, least = design_beside_least(design, scenario)["loss of torque"]
    # The residual of this filter is the estimate itself, and its monitor has a proved bound, with the start in it.
    watched = obsynth.monitor(design, scenario, noise_bound=3.0)
    assert bound == pytest.approx(watched.threshold[-1], rel=1e-3)
    # Measured with the same bounds: a fault of any time course, told one sample later.
    assert least == pytest.approx(1.1996048, rel=2e-4)
    assert "1.18 times the optimum" in in_words("loss of torque", bound, least)


@pytest.mark.long
def test_compare_and_evaluate_say_how_far_from_the_least_each_method_is(capsys: pytest.CaptureFixture[str]) -> None:
    spec = obsynth.load_spec(DRIVE)
    found = obsynth.compare(spec.plant, scenario=spec.scenario, runs=2, methods=["fault-estimation-filter"])
    fault = found["fault-estimation-filter"].faults[0]
    assert 1.0 <= fault.bound / fault.least < 2.0
    header, row = found.rows()
    assert row[header.index("bound / optimum")] == f"{fault.bound / fault.least:.3g}"
    # No number is cut on a terminal of eighty columns.
    printed = io.StringIO()
    comparison_report(found, console=Console(file=printed, width=80))
    for name in ("deviation", "gain from d", "bound", "rms"):
        assert f"  {name.removesuffix(' from d')}" in printed.getvalue()
        assert f" {row[header.index(name)]}" in printed.getvalue()
    assert "…" not in printed.getvalue()
    assert main(["evaluate", "--system", str(DRIVE), "--runs", "2", "--quiet"]) == 0
    assert "times the optimum of all tests with its delay on at most 32 samples of inputs and outputs" in " ".join(
        capsys.readouterr().out.split()
    )


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("decay", [0.001, 0.02])
def test_no_record_passes_the_bound_of_an_observer_that_is_slower_than_the_plant(seed: int, decay: float) -> None:
    """Responses were followed for some settling times of the plant: of slow observers a small part of them."""
    rng = np.random.default_rng([46, seed])
    n = int(rng.integers(1, 4))
    A = rng.standard_normal((n, n))
    plant = obsynth.DescriptorSystem(
        A=0.3 * A / np.abs(np.linalg.eigvals(A)).max(), C=np.eye(n), Bf=np.ones((n, 1)), dt=1.0,
        sensor_noise={f"y{i + 1}": 0.1 for i in range(n)},
    )  # fmt: skip
    design = obsynth.functional_filter(plant, decay=decay)
    scenario = obsynth.Scenario(horizon=50, noise=1.0)
    bound = design_beside_least(design, scenario)["f1"][0]
    (entry,) = obsynth.compare(
        plant, methods=["functional-filter"], options={"functional-filter": {"decay": decay}}, runs=2
    ).methods
    observer, steps = design.observer, 20_000
    # Noise at three deviations in every sample, with the sign of its effect on the last estimate.
    worst, ahead = np.abs(observer.Dy[observer.fault_rows][0]).sum(), observer.Cz[observer.fault_rows][0]
    for _ in range(steps):
        worst, ahead = worst + np.abs(ahead @ observer.By).sum(), ahead @ observer.Az
    for stated in (bound, entry.faults[0].bound):
        assert 0.3 * worst * (1.0 - 1e-9) <= stated <= 0.3 * worst * (1.0 + 1e-5)


@pytest.mark.long
def test_a_comparison_says_that_gains_which_move_are_taken_once_they_have_settled() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1}, noise_names=["n1"]
    )
    methods = ["adaptive-observer", "functional-filter"]
    comparison = obsynth.compare(plant, methods=methods, options={methods[0]: {"Q": 0.01}}, runs=2)
    observer = comparison[methods[0]].design.observer
    # Noise that is largest at the start, with the signs of its effects on the third estimate.
    effects = [observer.run(0.3 * np.eye(6)[:, [k]]).faults[:, 0] for k in range(6)]
    assert np.abs(effects).sum(axis=0).max() > comparison[methods[0]].faults[0].bound
    assert "Figures of adaptive-observer are those of gains that have settled" in comparison.meanings()
    assert "have settled" not in obsynth.compare(plant, methods=methods[1:], runs=2).meanings()


@pytest.mark.long
def test_the_command_line_says_which_sensor_finds_a_fault(capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["sensors", "--system", str(DRIVE.with_name("guaranteed_test.yaml")), "--set", "noise=0.0005", "--quiet"]
    assert main([*asked, "--goal", "threshold", "--below", "0.04", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["sets"]
    assert found["sensors"] == ["twist"]
    assert found["threshold"] <= 0.04
    assert found["samples"] == 30
    assert main([*asked, "--goal", "threshold", "--below", "0.0001"]) == 3
    assert "the least is 0.037" in " ".join(capsys.readouterr().err.split())
    assert main([*asked, "--below", "0.04"]) == 2
    assert "--below is for --goal threshold" in capsys.readouterr().err


def test_the_bound_of_a_scenario_counts_disturbances_that_begin_after_the_observer_has_settled() -> None:
    """``evaluate`` said "Fault-free ... |estimate of f1| <= 0.048" where the scenario itself reached 1."""
    plant = obsynth.DescriptorSystem(
        A=[[0.5, 0.1], [0.0, 0.6]],
        C=np.eye(2),
        Bf=[[1.0], [0.0]],
        Bd=[[0.5], [1.0]],
        dt=1.0,
        sensor_noise={"y1": 0.01, "y2": 0.01},
    )
    design = obsynth.fault_estimation_filter(plant)
    late = obsynth.Scenario(horizon=500, noise=1, disturbances={"d1": obsynth.Step(size=2.0, start=400.0)})
    ((bound, _),) = design_beside_least(design, late).values()
    x, outputs = np.zeros(2), []
    for k in range(500):
        outputs.append(x)
        x = plant.A @ x + plant.Bd[:, 0] * (2.0 if k >= 400 else 0.0)
    largest = np.abs(design.observer.run(np.array(outputs)).faults).max()
    assert largest > 0.9
    assert bound >= largest


def test_the_bound_counts_what_comes_after_the_steps_that_were_followed() -> None:
    plant = obsynth.DescriptorSystem(A=[[0.95]], C=[[1.0]], Bf=[[1.0]], Dw=[[0.1]], dt=1.0)
    radius, steps = 0.99, 1500
    response = 0.1 * radius ** np.arange(steps)
    impulses = np.stack([np.eye(1, steps)[0], response], axis=1)[:, None]
    ((bound, _),) = thresholds_beside_least(plant, impulses, ["f1"], np.zeros(0), radius)
    # Three deviations of noise at every sample; of the whole sum 2.8e-7 are left after these steps.
    whole = 3.0 * 0.1 / (1.0 - radius)
    assert 3.0 * response.sum() < whole * (1.0 - 2e-7)
    assert bound == pytest.approx(whole, rel=1e-12)
