"""
Parameter estimates with their band
===================================

`obsynth.plotting.plot_parameters` is for adaptive observers: the parameter, its estimate, and the 95 % band of the model.
"""

import obsynth

spec = obsynth.load_spec("../../designs/moussaali2013_ltv/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
simulation = obsynth.simulate(design, spec.scenario)
obsynth.plotting.plot_parameters(simulation.estimates, parameters=simulation.parameters, dt=spec.plant.dt)
