"""
A guaranteed threshold over time
================================

`obsynth.plotting.plot_detection` draws the statistic of a monitor, its threshold, and the alarm. This threshold is never
passed without a fault while disturbances keep their bounds.
"""

import obsynth

spec = obsynth.load_spec("../../designs/wang2015/spec.yaml")
design = obsynth.fault_estimation_filter(spec.plant)
simulation = obsynth.simulate(design, spec.scenario)
monitor = obsynth.monitor(design, spec.scenario, "pointwise")
obsynth.plotting.plot_detection(monitor.watch(simulation.estimates), dt=spec.plant.dt)
