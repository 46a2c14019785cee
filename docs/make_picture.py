"""Draw ``docs/fault_estimation.png``: the faults of the paper's example and their estimates.

Run ``python docs/make_picture.py`` from anywhere.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import obsynth
from obsynth.plotting import plot_faults
from obsynth.report.plots.panels import label_time
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.loader import load_spec

mpl.use("Agg")
HERE = Path(__file__).parent
STEPS = 200
#: Inches, and pixels of the width.
SIZE, WIDTH_IN_PIXELS = (10.0, 2.8), 1500


def main() -> None:
    """Simulate section 4 of Wang et al. (2015) and draw the estimates on the delayed faults."""
    plant = load_spec(HERE.parent / "designs" / "wang2015" / "spec.yaml").plant
    design = obsynth.fault_estimation_filter(plant)
    k = np.arange(STEPS)
    inputs = np.column_stack([2.0 * np.sin(k)] * 2)
    faults = np.column_stack([np.where(k >= 80, 1.0, 0.0), np.where(k >= 100, 1.2 * np.sin(0.1 * k), 0.0)])
    disturbance = np.random.default_rng(2015).uniform(0.0, 0.1, STEPS)
    run = simulate_plant(plant, steps=STEPS, u=inputs, f=faults, d=disturbance, initial_state=[0.5, 1.0, 0.0, -0.5])
    start = np.array([0.0, 1.0, 0.0, -0.5]) - design.gains["N"] @ run.outputs[0]
    estimates = design.observer.run(run.outputs, inputs, initial_state=start)
    # Side by side: on the first screen of a page there is room for more.
    figure, panels = plt.subplots(1, 2, figsize=SIZE, layout="constrained")
    plot_faults(estimates, faults=faults, dt=plant.dt, axes=panels)
    for panel in panels:
        label_time(panel)
    figure.savefig(HERE / "fault_estimation.png", dpi=WIDTH_IN_PIXELS / figure.get_size_inches()[0])


if __name__ == "__main__":
    main()
