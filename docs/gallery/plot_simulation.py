"""
A simulation: faults, estimates, residuals
==========================================

`obsynth.plotting.plot_simulation` is the first look at a design: each fault with its estimate, delayed as the estimate
is, and the residual below.
"""

import obsynth

spec = obsynth.load_spec("../../designs/wang2015/spec.yaml")
design = obsynth.fault_estimation_filter(spec.plant)
simulation = obsynth.simulate(design, spec.scenario)
obsynth.plotting.plot_simulation(simulation)
