"""The picture of a simulation: what is drawn where, with which names; whether it is beautiful is for eyes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import matplotlib.pyplot as plt

import obsynth
from obsynth.errors import SpecError
from obsynth.plotting import plot_detection, plot_simulation, plot_states
from obsynth.report.plots.panels import image_of
from obsynth.specs.loader import load_spec

pytestmark = pytest.mark.usefixtures("taken_as_verified")

DESIGNS = Path(__file__).parents[2] / "designs"


@pytest.fixture(scope="module")
def wang():
    spec = load_spec(DESIGNS / "wang2015" / "spec.yaml")
    design = obsynth.fault_estimation_filter(spec.plant)
    return design, spec.scenario, obsynth.simulate(design, spec.scenario)


@pytest.fixture(autouse=True)
def _closed_figures():
    yield
    plt.close("all")


def line(axes, start: str):
    return next(item for item in axes.get_lines() if str(item.get_label()).startswith(start))


@pytest.mark.long
def test_faults_residual_threshold_and_alarm(wang) -> None:
    design, scenario, simulation = wang
    found = obsynth.monitor(design, scenario).watch(simulation.estimates)
    panels = plot_simulation(simulation, detections=[found], units={"actuator 1": "pu"})
    assert [panel.get_ylabel() for panel in panels] == ["actuator 1 (pu)", "actuator 2", "norm of r"]
    assert [panel.get_xlabel() for panel in panels] == ["", "", "time (s)"]
    np.testing.assert_array_equal(line(panels[0], "fault, delayed by 1").get_ydata(), simulation.faults[:-1, 0])
    np.testing.assert_array_equal(line(panels[1], "estimate").get_ydata(), simulation.estimates.faults[:, 1])
    np.testing.assert_array_equal(line(panels[2], "pointwise bound").get_ydata(), found.threshold)
    alarm = line(panels[2], "alarm at 81 s: actuator 1")
    assert (alarm.get_xdata()[0], alarm.get_ydata()[0]) == (81.0, found.values[81])
    assert panels[2].get_yscale() == "log"


def test_what_does_not_decide_yet_and_no_alarm(wang) -> None:
    design, scenario, _ = wang
    quiet = scenario.replace(faults={})
    found = obsynth.monitor(design, quiet, "chi-square").watch(obsynth.simulate(design, quiet).estimates)
    panel = plot_detection(found, dt=1.0)
    shown = line(panel, "threshold").get_ydata()
    assert np.isnan(shown[0])
    assert np.isfinite(shown[-1])
    assert not any(str(item.get_label()).startswith("alarm") for item in panel.get_lines())


def test_a_threshold_that_begins_next_to_zero_does_not_stretch_the_picture(wang) -> None:
    design, scenario, simulation = wang
    found = obsynth.monitor(design, scenario).watch(simulation.estimates)
    limit = np.where(np.arange(len(found.threshold)) < 2, 5e-324, found.threshold)
    panel = plot_detection(replace(found, threshold=limit), dt=1.0)
    assert panel.get_ylim() == pytest.approx((np.median(limit) / 1000.0, 2.0 * found.values.max()))
    # Without disturbances a threshold decays below what rounding leaves of the residual.
    falling = np.maximum(10.0 ** -np.arange(len(limit), dtype=float), 5e-324)
    panel = plot_detection(replace(found, threshold=falling), dt=1.0)
    assert panel.get_ylim()[0] == np.finfo(float).eps * found.values.max()


def test_the_papers_threshold_says_what_it_is_not(wang) -> None:
    design, scenario, simulation = wang
    panel = plot_detection(obsynth.monitor(design, scenario, "paper").watch(simulation.estimates), dt=1.0)
    assert any("not a pointwise bound" in text.get_text() for text in panel.get_legend().get_texts())


@pytest.mark.long
def test_a_recursive_simulation_with_its_decision() -> None:
    spec = load_spec(DESIGNS / "moussaali2013_ltv" / "two_outputs.yaml")
    design = obsynth.design(spec.plant, spec.method, **dict(spec.options))
    simulation = obsynth.simulate(design, spec.scenario.replace(horizon=260))
    decision = obsynth.decide(design.observer, simulation.estimates)
    panels = plot_simulation(simulation, detections=[decision])
    assert [panel.get_ylabel() for panel in panels] == ["theta", "chi-square of theta"]
    np.testing.assert_array_equal(line(panels[0], "true").get_ydata(), simulation.parameters[:, 0])
    assert len(panels[0].collections) == 1
    np.testing.assert_array_equal(line(panels[1], "threshold").get_ydata(), decision.thresholds)
    assert decision.alarm is not None
    assert line(panels[1], f"alarm at {decision.alarm.k} s: theta").get_ydata()[0] == decision.alarm.value
    _, grid = plt.subplots(1, 1)
    assert plot_simulation(simulation, axes=[grid]) == [grid]


def test_a_simulation_in_which_nothing_is_estimated_is_no_empty_picture() -> None:
    plant = obsynth.DescriptorSystem(A=[[0.5]], C=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1})
    simulation = obsynth.simulate(obsynth.descriptor_kalman(plant), obsynth.Scenario(horizon=5))
    with pytest.raises(SpecError, match="plot_residuals"):
        plot_simulation(simulation)
    with pytest.raises(SpecError, match=r"or simulation\.estimates"):
        obsynth.plotting.plot_states(simulation)


def test_labels_beside_panels_one_above_the_other_do_not_cover_each_other() -> None:
    names = ("delta GENCLS 1", "delta GENCLS 2", "temperature of the wall", "omega GENCLS 2")
    plant = obsynth.DescriptorSystem(
        A=0.5 * np.eye(4), C=np.eye(4), Bf=np.eye(4)[:, :1], Bd=np.eye(4)[:, 1:2], dt=1.0, state_names=names,
        units=dict.fromkeys(names, "rad"),
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(plant)
    estimates = obsynth.simulate(design, obsynth.Scenario(horizon=30)).estimates
    drawn: list[plt.Axes] = []
    image_of(
        4, size=(7.5, 6.8), draw=lambda panels: drawn.extend(plot_states(estimates, units=plant.units, axes=panels))
    )
    boxes = [panel.yaxis.label.get_window_extent() for panel in drawn]
    assert len(boxes) == 4
    assert all(upper.y0 >= lower.y1 for upper, lower in pairwise(boxes))
