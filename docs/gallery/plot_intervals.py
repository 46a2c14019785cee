"""
Guaranteed intervals of a fault
===============================

`obsynth.plotting.plot_intervals` draws the interval in which the fault lies for certain, row by row, and the alarm.
"""

import obsynth

spec = obsynth.load_spec("../../designs/drive/guaranteed_test.yaml")
test = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
simulation = obsynth.simulate(test, spec.scenario)
obsynth.plotting.plot_intervals(test, simulation.estimates)
