"""What the panels of a picture of data show: nothing that says nothing, and no estimate that hides its measurement."""

import numpy as np
import pandas as pd

import obsynth
from obsynth.plotting import plot_data


def labels(panels) -> list[str]:
    return [panel.get_ylabel() for panel in panels]


def test_inputs_of_one_value_have_no_panel_and_are_named_below() -> None:
    """A log of a converter at constant duty had two panels, each with a straight line."""
    plant = obsynth.DescriptorSystem(
        A=[[0.5]],
        B=[[1.0, 1.0]],
        C=[[1.0]],
        Bf=[[1.0]],
        dt=1.0,
        input_names=["duty", "load"],
        output_names=["level"],
        units={"duty": "V", "load": "A", "level": "m"},
    )
    design = obsynth.fault_estimation_filter(plant)
    log = pd.DataFrame({"time": range(40), "duty": 12.0, "load": np.arange(40) % 7.0, "level": 0.0})
    run = obsynth.run_on_data(design, log, thresholds={"fhat[f1]": 1e3})
    panels = plot_data(run, design=design)
    (load,) = [panel for panel in panels if panel.get_ylabel() == "load (A)"]
    assert load.get_lines()[0].get_label() == "input"
    assert "duty (V)" not in labels(panels)
    (text,) = [item.get_text() for item in panels[-1].texts if item.get_text().startswith("Constant inputs")]
    assert text.splitlines()[0] == "Constant inputs: duty 12 V."


def test_an_estimate_that_a_disturbance_biases_does_not_hide_the_measurement() -> None:
    """The voltage of a converter, an algebraic state, was hidden behind its estimate, a hundred times as noisy."""
    plant = obsynth.DescriptorSystem(
        E=np.diag([33e-6, 100e-6, 0.0]),
        A=[[-0.04, 0.0, -1.0], [0.0, -50.0, 50.0], [1.0, 50.0, -50.0]],
        B=[[1.0], [0.0], [0.0]],
        C=[[1, 0, 0], [0, 0, 1]],
        Bf=[[-1.0], [0.0], [0.0]],
        Bd=[[0.0], [0.0], [-1.0]],
        state_names=["iL", "vC", "vo"],
        output_names=["iL", "vo"],
        sensor_noise={"iL": 0.02, "vo": 0.01},
    )
    design = obsynth.ui_pi_observer(obsynth.discretise(plant, 1e-5))
    rng = np.random.default_rng(0)
    log = pd.DataFrame({"time": 1e-5 * np.arange(50), "u1": 0.0, "iL": rng.normal(size=50), "vo": rng.normal(size=50)})
    run = obsynth.run_on_data(design, log, thresholds={"fhat[f1]": 1e3})
    assert run.recovered["vo"] == "biased by the disturbance"
    drawn = {
        panel.get_ylabel(): [line.get_label() for line in panel.get_lines()]
        for panel in plot_data(run, design=design, show=["outputs"])
    }
    assert drawn == {"iL": ["measured", "estimate"], "vo": ["measured"]}
