"""Methods side by side: the same clock and draws, one recommendation, refusals in one line, a log replayed."""

from __future__ import annotations

import html
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.methods.fault_figures import step_responses
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"


@pytest.fixture(scope="module")
def bicycle() -> obsynth.Comparison:
    spec = load_spec(DESIGNS / "bicycle" / "spec.yaml")
    scenario = spec.scenario.replace(horizon=10.0)
    return obsynth.compare(spec.plant, scenario=scenario, options={spec.method: spec.options}, runs=5)


@pytest.mark.long
def test_one_recommendation_with_its_reason(bicycle: obsynth.Comparison) -> None:
    assert bicycle.recommended == "functional-filter"
    assert "rms error" in bicycle.reason
    assert "decoupled from unknown inputs" in bicycle.reason
    assert bicycle.methods[0].method == bicycle.recommended
    ranked = [entry.relative_error for entry in bicycle.methods if not entry.refused and entry.fast_enough]
    assert ranked == sorted(ranked)


@pytest.mark.long
def test_an_interpreter_shows_results_as_their_text(bicycle: obsynth.Comparison) -> None:
    """Not every number of every design, as which four thousand lines stood in a notebook."""
    assert repr(bicycle) == str(bicycle)
    assert repr(bicycle).endswith(bicycle.advice)
    assert repr(obsynth.diagnose(load_spec(DESIGNS / "bicycle" / "spec.yaml").plant)).startswith(
        "What can be diagnosed"
    )


@pytest.mark.long
def test_a_notebook_shows_the_picture(bicycle: obsynth.Comparison) -> None:
    """It shows the figures that pyplot knows; a page leaves none open."""
    import matplotlib.pyplot as plt

    open_before = plt.get_fignums()
    figure = bicycle.plot()
    assert plt.gcf() is figure
    plt.close(figure)
    bicycle.page()
    assert plt.get_fignums() == open_before


def test_refused_methods_say_why_in_one_line(bicycle: obsynth.Comparison) -> None:
    assert bicycle["pd-observer"].refused.startswith(
        "pd-observer assumes more than this plant has: the condition 'continuous time' fails"
    )
    assert bicycle["descriptor-kalman"].refused == "estimates the state, but no fault"
    assert all("\n" not in text for text in bicycle.refusals)
    assert any(text.startswith("pd-observer: assumes more than this plant has") for text in bicycle.refusals)


def test_numbers_of_the_table_are_those_of_a_simulation(bicycle: obsynth.Comparison) -> None:
    entry = bicycle["functional-filter"]
    figures = entry.faults[0].figures
    response = entry.responses[:, 0]
    assert figures.most == pytest.approx(bicycle.sample_time * np.argmax(response >= 0.9))
    assert entry.faults[0].rms == pytest.approx(
        np.sqrt(np.mean((entry.estimates[:, 0] - bicycle.truth[:, 0]) ** 2)), rel=0.3
    )
    assert entry.design is not None
    assert entry.design.report.passed


@pytest.mark.long
@pytest.mark.parametrize("happening", [("a", "b"), ("a",)])
def test_units_of_a_fault_change_no_rank(happening: tuple[str, ...]) -> None:
    rng = np.random.default_rng(8)
    plant = obsynth.DescriptorSystem(
        np.diag([1.0, 1, 1, 0]), np.vstack([np.diag([0.8, 0.6, 0.5, 1]) + 0.1 * rng.normal(size=(4, 4))]),
        C=rng.normal(size=(3, 4)), Bf=[[1, 0], [0, 1], [0.3, 0.2], [0, 0]], Dw=0.05 * np.eye(3),
        fault_names=("a", "b"), dt=1.0,
    )  # fmt: skip
    found = []
    for unit in (1.0, 1e4, 1e-4):
        steps = {"a": obsynth.Step(size=1.0, start=20.0), "b": obsynth.Step(size=unit, start=40.0)}
        scenario = obsynth.Scenario(horizon=80.0, noise=1.0, faults={name: steps[name] for name in happening})
        own = plant.replace(Bf=plant.Bf @ np.diag([1.0, 1.0 / unit]))
        found.append(
            obsynth.compare(
                own, scenario=scenario, runs=3, methods=["functional-filter", "ui-pi-observer", "descriptor-kalman"],
                options={"ui-pi-observer": {"poles": [0.1, 0.15, 0.2, 0.25, 0.3, 0.35]}},
            )
        )  # fmt: skip
    for other in found[1:]:
        assert [entry.method for entry in other.methods] == [entry.method for entry in found[0].methods]
        for entry in (entry for entry in other.methods if not entry.refused):
            # Gains are found by searches, which end at other last digits.
            assert entry.relative_error == pytest.approx(found[0][entry.method].relative_error, rel=1e-3)


def test_texts_and_picture(bicycle: obsynth.Comparison) -> None:
    assert "Take functional-filter" in str(bicycle)
    assert "<table>" in bicycle._repr_html_()
    step, scenario, noisier = bicycle.plot().axes
    assert step.get_xlabel() == "time (s)"
    # Nothing is cut; what is much noisier than the best estimate has a panel of its own, with the truth on top.
    for panel in (scenario, noisier):
        low, high = panel.get_ylim()
        truth, *estimates = panel.get_lines()
        assert truth.get_color() == "black"
        assert estimates
        for line in estimates:
            assert low <= np.nanmin(line.get_ydata()) <= np.nanmax(line.get_ydata()) <= high
    assert noisier.get_lines()[0].get_zorder() > noisier.get_lines()[1].get_zorder()
    assert [line.get_label() for line in noisier.get_lines()[1:]] == [
        text.get_text() for text in noisier.get_legend().get_texts()[1:]
    ]
    assert np.ptp(noisier.get_ylim()) > 2.0 * np.ptp(scenario.get_ylim())
    assert 'content="obsynth compare"' in bicycle.page()
    plain = json.loads(json.dumps(bicycle.to_dict()))
    header, first = bicycle.rows()[0], bicycle.rows()[1]
    assert [*plain["rows"][0]] == [*header]
    # Numbers are numbers, and each row names its method.
    assert {type(value) for row in plain["rows"] for name, value in row.items() if name not in header[:2]} <= {
        int,
        float,
    }
    assert all(row["method"] for row in plain["rows"])
    assert f"{plain['rows'][0]['deviation']:.3g}" == first[header.index("deviation")]


@pytest.mark.long
def test_options_are_those_of_the_plant_as_it_is_given() -> None:
    """The paper's poles -2 .. -6 and its decoupling are of its plant: for the samples, the method was refused."""
    spec = load_spec(DESIGNS / "sharepasand" / "spec.yaml")
    options = {spec.method: spec.options}
    found = obsynth.compare(spec.plant, scenario=spec.scenario, options=options, methods=[spec.method], runs=1)
    own = obsynth.ui_pi_observer(spec.plant, **spec.options)
    assert found[spec.method].design.gains["K_a"] == pytest.approx(own.gains["K_a"])
    # Of a plant that a spec samples they are of the samples, whatever else is compared on the plant before.
    sampled = load_spec(DESIGNS / "motor" / "sampled.yaml")
    options, methods = {sampled.method: sampled.options}, [sampled.method, "pd-observer"]
    found = obsynth.compare(sampled.transformation, options=options, methods=methods, runs=1)
    assert found[sampled.method].design.plant.dt == sampled.plant.dt
    assert found["pd-observer"].design.plant.dt == 0.0


def test_tolerances_make_a_bias() -> None:
    spec = load_spec(DESIGNS / "motor" / "sampled.yaml")
    scenario = spec.scenario.replace(horizon=3.0, faults={"torque": obsynth.Step(size=0.1, start=1.0)})
    source = spec.transformation.source
    common = {"scenario": scenario, "sample_time": 0.005, "runs": 4, "methods": ["functional-filter"]}
    exact = obsynth.compare(source, **common)
    off = obsynth.compare(source, tolerance=0.05, **common)
    assert off.methods[0].faults[0].bias > 3.0 * exact.methods[0].faults[0].bias


def test_the_bicycle_drives_with_its_lateral_speed() -> None:
    spec = load_spec(DESIGNS / "bicycle" / "spec.yaml")
    log = pd.read_csv(DESIGNS / "bicycle" / "log_with_vy.csv")
    log["steering"] = pd.read_csv(DESIGNS / "bicycle" / "true_log.csv")["f"]
    found = obsynth.compare(
        spec.plant, scenario=spec.scenario, options={spec.method: spec.options}, methods=[spec.method], data=log, runs=2
    )
    assert found.methods[0].faults[0].rms < 0.0015


def pendulum(**changes: object) -> obsynth.DescriptorSystem:
    # Unstable, with an actuator and an algebraic force.
    given = {"B": [[0], [0], [5], [0]], "Bf": [[0], [1], [0], [0]], "Dw": 0.001 * np.eye(2)} | changes
    e, a = np.diag([1.0, 1, 1, 0]), [[0, 1, 0, 0], [9.8, -0.1, 0, 1], [0, 0, -5, 0], [0, 0, 1, -1]]
    return obsynth.DescriptorSystem(e, a, C=[[1, 0, 0, 0], [0, 0, 1, 0]], **given)


def test_an_unstable_descriptor_plant_is_held_and_compared() -> None:
    found = obsynth.compare(pendulum(), runs=2, tolerance=0.02, methods=["functional-filter", "ui-pi-observer"])
    assert "a state feedback stabilises the plant" in found.setting
    for entry in found.methods:
        assert entry.faults[0].figures.at_horizon == pytest.approx(1.0, abs=0.05)
        assert entry.faults[0].rms < 0.5


def test_an_unstable_plant_without_inputs_is_followed_for_as_long_as_numbers_tell() -> None:
    whole = obsynth.compare(pendulum(), runs=1, methods=["functional-filter"])
    found = obsynth.compare(pendulum(B=None), runs=1, methods=["functional-filter"])
    assert found.times[-1] < 0.5 * whole.times[-1]
    assert found.methods[0].faults[0].rms < 1.0


@pytest.mark.parametrize("sampled", [False, True])
def test_constants_are_drawn_within_their_stated_tolerances(sampled: bool) -> None:
    matrices = {
        "A": [["-k/m", 1.0], [0, -2.0]], "B": [[0], ["1/m"]], "C": np.eye(2), "Bf": [[1.0], [0]],
        "Dw": 0.01 * np.eye(2),
    }  # fmt: skip
    tolerances = {"k": {"nominal": 2.0, "tolerance": "5 %"}, "m": {"nominal": 1.5, "tolerance": "5 %"}}
    plant = obsynth.uncertain_system(matrices, tolerances)
    scenario = obsynth.Scenario(
        horizon=20.0, sample_time=0.1, inputs={"u1": obsynth.Step(size=1.0)}, noise=1.0,
        faults={"f1": obsynth.Step(size=0.5, start=10.0)},
    )  # fmt: skip
    common = {"runs": 4, "methods": ["functional-filter"], "scenario": scenario}
    if sampled:
        plant = obsynth.discretise(plant, 0.1).plant
        common["scenario"] = scenario.replace(sample_time=None)
    boxed = obsynth.compare(plant, **common)
    exact = obsynth.compare(plant.replace(uncertainty=None), **common)
    assert "constants within their tolerances" in boxed.setting
    assert boxed.methods[0].faults[0].bias > 3.0 * exact.methods[0].faults[0].bias


@pytest.mark.long
def test_a_log_is_replayed_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = pd.read_csv(DESIGNS / "motor" / "log.csv").iloc[:800]
    log["torque"] = pd.read_csv(DESIGNS / "motor" / "true_log.csv")["f"].iloc[:800]
    log.to_csv(tmp_path / "log.csv", index=False)
    spec, page = DESIGNS / "motor" / "sampled.yaml", tmp_path / "page.html"
    arguments = ["compare", "--system", str(spec), "--data", str(tmp_path / "log.csv"), "--runs", "2", "--quiet"]
    assert main([*arguments, "--out", str(page), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["recommended"]
    errors = {entry["method"]: entry["relative_error"] for entry in found["methods"]}
    assert errors["functional-filter"] < errors["fault-estimation-filter"]
    assert page.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert main([*arguments]) == 0
    assert "Take " in capsys.readouterr().out


def test_bad_arguments(tmp_path: Path) -> None:
    plant = load_spec(DESIGNS / "bicycle" / "spec.yaml").plant
    with pytest.raises(obsynth.SpecError, match="use some of"):
        obsynth.compare(plant, methods=["magic"])
    with pytest.raises(obsynth.SpecError, match="tolerance"):
        obsynth.compare(plant, tolerance=-1.0)
    with pytest.raises(obsynth.SpecError, match="no columns 'steer', 'r', 'ay'"):
        obsynth.compare(plant, data=pd.DataFrame({"vy": [0.0]}), runs=1, methods=["functional-filter"])
    with pytest.raises(obsynth.SpecError, match="no faults"):
        obsynth.compare(plant.replace(Bf=None, Df=None, fault_names=None, units={}))


@pytest.mark.long
def test_the_page_lists_meanings_and_refusals_and_names_units(bicycle: obsynth.Comparison) -> None:
    page = bicycle.page()
    assert "<td>steering (rad)</td>" in page
    for refusal in bicycle.refusals:
        assert f"<li>{html.escape(refusal)}</li>" in page
        assert "..." not in refusal
    assert "<li>s to alarm: median detection delay; never: not within the run</li>" in page


def test_a_plant_that_settles_over_thousands_of_samples_needs_no_scenario():
    """Every fault has its turn in the runs, however slow the plant is."""
    plant = obsynth.DescriptorSystem(
        A=np.diag([0.9995, 0.999]), C=np.eye(2), Bf=np.eye(2), dt=1.0, sensor_noise={"y1": 0.1, "y2": 0.1}
    )
    compared = obsynth.compare(plant, methods=["fault-estimation-filter"], runs=2)
    (entry,) = compared.methods
    assert np.all(np.any(compared.truth == 1.0, axis=0))
    assert all(np.isfinite(fault.detection_delay) for fault in entry.faults)


def test_deviations_for_noise_that_nobody_states_say_so() -> None:
    parts = {"A": [[0.9, 0.1], [0.0, 0.8]], "C": np.eye(2), "Bf": [[1.0], [0.0]], "dt": 1.0}
    assumed = "The plant states no noise: deviations are for white noise of deviation 1 on every output."
    for noise in (None, {"y1": 0.1, "y2": 0.1}):
        plant = obsynth.DescriptorSystem(**parts, sensor_noise=noise)
        found = obsynth.compare(plant, methods=["functional-filter"], runs=2)
        assert (assumed in found.meanings()) == (noise is None)
    plant = obsynth.DescriptorSystem(**parts, sensor_noise={"y1": 0.1, "y2": 0.1})
    recursion = replace(found.methods[0], design=obsynth.design(plant, "adaptive-observer"))
    both = replace(found, methods=(*found.methods, recursion))
    assert assumed not in both.meanings()  # the recursion keeps its covariances, and its plant has no noise


def test_a_bound_that_is_rounding_is_shown_as_zero() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1.0], [0.0]], Bd=[[0.3], [1.0]], dt=1.0
    )
    scenario = obsynth.Scenario(
        horizon=40, faults={"f1": obsynth.Step(size=1.0, start=10)}, disturbances={"d1": obsynth.Step(size=1.0)}
    )
    found = obsynth.compare(plant, scenario=scenario, methods=["ui-pi-observer"], runs=2)
    (fault,) = found["ui-pi-observer"].faults
    header, row = found.rows()
    assert fault.bound < 1e-12
    assert row[header.index("bound")] == "0"


@pytest.mark.long
def test_what_was_not_followed_is_not_called_never() -> None:
    """The battery's filter reaches 90 % after 4,855 s, of runs of 3,600 s: the table said never."""
    spec = load_spec(DESIGNS.parent / "docs/examples/battery/spec.yaml")
    found = obsynth.compare(
        spec.transformation, scenario=spec.scenario, methods=["functional-filter", "ui-pi-observer"], runs=2
    )
    header, *rows = found.rows()
    row = next(row for row in rows if row[0] == "functional-filter")
    assert row[header.index("s to 90 %")] == "> 3600"
    assert "90 % of a step is not reached within 4860 s (81 min) by functional-filter" in found.advice
    plant, observer = found["functional-filter"].design.linear
    response = step_responses(plant, observer, 1200)[1][:, 0, 0]
    assert 3600 < 5 * np.argmax(response >= 0.9) < 4860


def test_a_small_gain_from_unknown_inputs_is_no_decoupling() -> None:
    """Of a gain of 8.9e-4 it was said that unknown inputs are decoupled."""
    plant = obsynth.DescriptorSystem(A=[[0.9]], C=[[1.0]], Bf=[[1.0]], Bd=[[1e-4]], dt=1.0)
    found = obsynth.compare(plant, methods=["fault-estimation-filter"], runs=2)
    assert found.methods[0].faults[0].figures.unknown_input_gain == pytest.approx(1e-4, rel=1e-6)
    assert "gain from unknown inputs 0.0001" in found.advice
