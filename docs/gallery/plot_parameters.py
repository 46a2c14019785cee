"""
Parameter estimates with their band
===================================

`obsynth.plotting.plot_parameters` is for adaptive observers: the parameter, its estimate, and the 95 % band of the model.
"""

import obsynth

plant = obsynth.TimeVaryingDescriptorSystem(
    E=[[1, 0], [0, 0]],
    A=[[0.9, "0.1 * sin(0.2 * k)"], [0.5, -1]],
    C=[[1, 0.2], [0, 1]],
    Phi=[["1 + 0.5 * cos(0.1 * k)"], [0.1]],
    dt=1.0,
    horizon=150,
    parameter_names=["leak"],
)
design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.95)
scenario = obsynth.Scenario(horizon=149, faults={"leak": obsynth.Step(size=0.5, start=75)}, noise=1.0, seed=1)
simulation = obsynth.simulate(design, scenario)
obsynth.plotting.plot_parameters(simulation.estimates, parameters=simulation.parameters, dt=plant.dt)
