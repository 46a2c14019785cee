"""
The residual and its threshold
==============================

`obsynth.plotting.plot_residuals` draws the norm of the residual with a threshold, and the first sample above it.
"""

import numpy as np

import obsynth

spec = obsynth.load_spec("../../designs/wang2015/spec.yaml")
design = obsynth.fault_estimation_filter(spec.plant)
simulation = obsynth.simulate(design, spec.scenario)
level = np.full(len(simulation.estimates.residuals), 0.3)
obsynth.plotting.plot_residuals(simulation.estimates, threshold=level, dt=spec.plant.dt)
