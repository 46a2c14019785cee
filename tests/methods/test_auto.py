"""The method by default: existence first, then closed-form figures, and the design names what was taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.methods.fault_figures import fault_figures, on_the_clock
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"


def test_the_design_names_the_method_and_why(tmp_path: Path) -> None:
    plant = load_spec(DESIGNS / "motor" / "sampled.yaml").plant
    found = obsynth.design(plant)
    assert found.method == "functional-filter"
    assert found.notes[0].startswith("Method chosen by auto: functional-filter (its estimates reach every step")
    assert obsynth.load(found.save(tmp_path / "gains.json")).method == "functional-filter"


@pytest.mark.parametrize("seed", [pytest.param(seed, marks=[] if seed < 1 else pytest.mark.long) for seed in range(4)])
def test_the_choice_does_not_depend_on_units(seed: int) -> None:
    # A gain of 1e-3 in whatever units these are counted as none: with the unknown input in other units the choice was
    # another one for 13 of 14 random plants.
    rng = np.random.default_rng([7, seed])
    a = rng.standard_normal((3, 3))
    given = {
        "A": 0.8 * a / np.max(np.abs(np.linalg.eigvals(a))),
        "C": rng.standard_normal((2, 3)),
        "Bf": rng.standard_normal((3, 1)),
        "Bd": rng.standard_normal((3, 1)),
    }
    noise = {"y1": 0.1, "y2": 0.1}
    chosen = obsynth.design(obsynth.DescriptorSystem(**given, dt=1.0, sensor_noise=noise)).method
    for name, factor in (("Bd", 1e-5), ("Bd", 1e5), ("Bf", 1e-5), ("Bf", 1e5)):
        plant = obsynth.DescriptorSystem(**{**given, name: factor * given[name]}, dt=1.0, sensor_noise=noise)
        assert obsynth.design(plant).method == chosen
    kilo = {name: 1e3 * deviation for name, deviation in noise.items()}
    plant = obsynth.DescriptorSystem(**{**given, "C": 1e3 * given["C"]}, dt=1.0, sensor_noise=kilo)
    assert obsynth.design(plant).method == chosen


def test_an_unknown_input_counts_as_the_fault_that_moves_the_outputs_as_much() -> None:
    # The estimate is the output less its prediction: what is added to the state at once, of either.
    plant = obsynth.DescriptorSystem(None, [[0.5]], C=[[1.0]], Bf=[[2.0]], dt=1.0, sensor_noise={"y1": 0.1})
    design = obsynth.fault_estimation_filter(plant)
    loaded = plant.replace(Bd=[[6e-4]])
    (figures,) = fault_figures(loaded, design.observer, 60)
    assert figures.unknown_input_gain == pytest.approx(3e-4, rel=1e-9)
    assert figures.unknown_input_share == pytest.approx(1.0, rel=1e-9)


def test_an_estimate_as_slow_as_the_plant_comes_after_faster_ones() -> None:
    # A heater with three masses: averaging for as long as the plant settles has the least noise, but nobody waits.
    e, a = np.diag([900.0, 400, 2500, 0]), [[-6, 0, 0, 6], [0, -9, 1, 8], [0, 1, -3, 0], [6, 8, 0, -14]]
    plant = obsynth.DescriptorSystem(
        e, a, [[0.0], [1], [0], [0]], np.eye(3, 4), Bf=[[0], [-1], [0], [0]], Bd=[[0], [0], [2], [0]],
        Dw=0.1 * np.eye(3),
    )  # fmt: skip
    assert obsynth.design(obsynth.discretise(plant, 5.0)).method == "ui-pi-observer"


def test_unstable_plants_have_true_figures() -> None:
    plant = obsynth.DescriptorSystem(
        None, [[1.2, 1.0], [0.0, 0.5]], [[0.0], [1.0]], [[1.0, 0.0]], Bf=[[1.0], [0.0]], Dw=[[0.01]], dt=1.0
    )
    design = obsynth.functional_filter(plant)
    (found,) = fault_figures(plant, design.observer, 400)
    assert found.at_horizon == pytest.approx(1.0, abs=1e-6)
    assert found.peak < 2.0


def test_options_choose_among_the_methods_that_have_them() -> None:
    plant = load_spec(DESIGNS / "smib" / "spec.yaml").plant
    assert obsynth.design(plant, gamma=0.5).method == "fault-estimation-filter"
    with pytest.raises(obsynth.SpecError, match="No single method has the options delay, gamma"):
        obsynth.design(plant, gamma=0.5, delay=3)


def test_without_faults_the_state_is_observed() -> None:
    plant = obsynth.DescriptorSystem(None, [[0.5, 1], [0, 0.8]], None, [[1, 0]], dt=1.0)
    assert obsynth.design(plant).method == "ui-pi-observer"


def test_where_nothing_exists_the_reason_and_the_sensor_are_given() -> None:
    plant = obsynth.DescriptorSystem(None, [[0.5, 0], [0, 0.8]], None, ["x1"], Bf=["x2"], Dw=[[0.1]], dt=1.0)
    with pytest.raises(obsynth.PreconditionError, match=r"Measure one of: x2\.$"):
        obsynth.design(plant)


@pytest.mark.long
def test_spec_without_a_method(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (DESIGNS / "motor" / "one_encoder.yaml").read_text(encoding="utf-8").split("method:")[0]
    text = text.replace("[theta m, i]", "[theta m, theta l, i]").replace(
        "theta m: 1.0e-3, ", "theta m: 1.0e-3, theta l: 1.0e-3, "
    )
    spec = tmp_path / "spec.yaml"
    spec.write_text(text, encoding="utf-8")
    assert load_spec(spec).method == "auto"
    assert main(["check", "--system", str(spec)]) == 0
    assert capsys.readouterr().out.startswith("What can be diagnosed")
    target = tmp_path / "gains.json"
    assert main(["design", "--system", str(spec), "--output", str(target), "--quiet"]) == 0
    assert obsynth.load(target).method != "auto"


def test_figures_are_what_a_simulation_gives() -> None:
    spec = load_spec(DESIGNS / "smib" / "functional.yaml")
    design = obsynth.functional_filter(spec.plant, fault_rate=0.01)
    (found,) = fault_figures(on_the_clock(spec.plant, spec.plant.dt), design.observer, 400)
    scenario = obsynth.Scenario(horizon=8.0 - 0.02, faults={"tm GENCLS 1": obsynth.Step(size=1.0)})
    run = obsynth.simulate(design, scenario)
    estimate = run.estimates.faults[:, 0]
    assert found.at_horizon == pytest.approx(estimate[399], rel=1e-9)
    assert found.most == pytest.approx(0.02 * np.argmax(estimate >= 0.9))
    assert found.deviation == pytest.approx(design.certificate.matrices["deviations"][0, 0], rel=0.02)
    assert found.unknown_input_gain < 1e-9


@pytest.mark.long
def test_auto_and_compare_say_why_they_differ() -> None:
    plant = obsynth.DescriptorSystem(
        None, [[0.5, 0.25, 0.0], [0.0, 0.75, -0.25], [0.25, 0.0, 0.25]], C=[[1, 0, 0], [0, 1, 1]],
        Bf=[[1], [0], [1]], Bw=np.eye(3, 5), Dw=np.eye(2, 5, 3), dt=0.5,
    )  # fmt: skip
    chosen, compared = obsynth.design(plant), obsynth.compare(plant, runs=5)
    assert compared.recommended != chosen.method
    assert f"`method: auto` would choose {chosen.method}, because it ranks without your scenario" in compared.advice
    assert "obsynth compare ranks by errors over a scenario instead" in chosen.notes[0]
    alone = obsynth.compare(plant, methods=[chosen.method], runs=5)
    assert "auto" not in alone.advice


def hover() -> obsynth.DescriptorSystem:
    """Return a multicopter of 0.6 kg about hover, whose rotors follow within 50 ms, sampled at 50 Hz."""
    mass, drag, lag = 0.6, 0.1, 0.05
    plant = obsynth.DescriptorSystem(
        None, [[0, 1, 0], [0, -drag / mass, 1 / mass], [0, 0, -1 / lag]], [[0], [0], [1 / lag]],
        [[1, 0, 0], [0, 1, 0]], Bf=[[0], [1 / mass], [0]], fault_names=["lift"],
    )  # fmt: skip
    return obsynth.discretise(plant, 0.02).plant


def test_an_estimate_that_noise_drowns_is_not_taken_because_it_is_fast() -> None:
    """The weight is 5.9 N: an estimate of the lift with a deviation of 11 N says nothing."""
    plant = hover().replace(Bw=np.zeros((3, 2)), Dw=np.diag([0.02, 0.3]), noise_names=None)
    design = obsynth.design(plant)
    (found,) = fault_figures(plant, design.observer, 400)
    assert found.deviation < 0.6, design.notes[0]


def test_a_scenario_says_the_noise_and_how_large_faults_are() -> None:
    scenario = obsynth.Scenario(
        horizon=10.0, faults={"lift": obsynth.Step(size=0.6, start=5.0)}, sensor_noise={"y1": 0.02, "y2": 0.3}
    )
    plant = hover()
    design = obsynth.design(plant, scenario=scenario)
    (found,) = fault_figures(
        plant.replace(Bw=np.zeros((3, 2)), Dw=np.diag([0.02, 0.3]), noise_names=None), design.observer, 400
    )
    assert 2.0 * found.deviation < 0.6, design.notes[0]
    assert "its noise hides lift of the scenario" in design.notes[0]
    # Beside a scenario of another plant the choice is as without one.
    other = obsynth.Scenario(horizon=1.0, faults={"nobody": obsynth.Step(size=1.0)})
    assert obsynth.design(plant, scenario=other).method == obsynth.design(plant).method


def test_what_ranks_above_the_choice_is_named_and_what_does_not_exist() -> None:
    """A heated room in which people act as a draught does: a PD observer's estimate of a lost heater shows people."""
    conductances = np.array([[-310.0, 180.0, 90.0], [180.0, -180.0, 0.0], [90.0, 0.0, -120.0]])
    room = obsynth.DescriptorSystem(
        np.diag([4e5, 6e4, 2e6]), conductances, C=np.eye(3), Bf=[[0, 1], [-1, 0], [0, 0]], Bd=[[1], [0], [0]],
        fault_names=("lost power", "draught"), disturbance_names=("people",),
        sensor_noise={"y1": 0.05, "y2": 0.2, "y3": 0.1},
    )  # fmt: skip
    design = obsynth.design(room)
    assert design.method == "pd-observer"
    why = design.notes[0]
    for missing in ("fault-estimation-filter", "ui-pi-observer", "functional-filter"):
        assert missing in why.partition("none exists")[0]
    assert "optimal-filter is not among these, and ranks above it" in why
    # Which is so: it decouples the heater.
    crowd = obsynth.Scenario(horizon=3e5, sample_time=1000.0, disturbances={"people": obsynth.Step(size=100.0)})
    shown = [
        float(np.max(np.abs(obsynth.simulate(each, crowd).estimates.faults[:, 0])))
        for each in (design, obsynth.optimal_filter(room))
    ]
    assert shown[0] > 10.0
    assert shown[1] < 0.1 * shown[0]
