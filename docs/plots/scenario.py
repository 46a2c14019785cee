"""The published example of a fault-estimation filter, on its scenario."""

import obsynth

spec = obsynth.load_spec("designs/wang2015/spec.yaml")
design = obsynth.fault_estimation_filter(spec.plant)
simulation = obsynth.simulate(design, spec.scenario)
obsynth.plotting.plot_simulation(simulation)
