"""
Fault estimates on the true faults
==================================

`obsynth.plotting.plot_faults` compares estimates with the truth of a simulation. Use it to see delay, noise, and what
disturbances do.
"""

import obsynth

spec = obsynth.load_spec("../../designs/wang2015/spec.yaml")
design = obsynth.fault_estimation_filter(spec.plant)
simulation = obsynth.simulate(design, spec.scenario)
obsynth.plotting.plot_faults(simulation.estimates, faults=simulation.faults, dt=spec.plant.dt)
