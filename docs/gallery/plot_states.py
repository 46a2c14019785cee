"""
State estimates
===============

`obsynth.plotting.plot_states` draws each state with its estimate. Observers that know covariances have a 95 % band.
"""

import obsynth

spec = obsynth.load_spec("../../designs/moussaali2013_ltv/spec.yaml")
design = obsynth.design(spec.plant, spec.method, name=spec.name, **spec.options)
simulation = obsynth.simulate(design, spec.scenario)
obsynth.plotting.plot_states(simulation.estimates, states=simulation.states, dt=spec.plant.dt)
