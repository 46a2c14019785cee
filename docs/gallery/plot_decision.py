"""
A statistical decision
======================

`obsynth.plotting.plot_decision` draws the test of a parameter: the statistic, the threshold of a rate of false alarms, the
alarm and the estimated onset.
"""

import obsynth

plant = obsynth.TimeVaryingDescriptorSystem(
    E=[[1, 0], [0, 0]],
    A=[[0.9, "0.1 * sin(0.2 * k)"], [0.5, -1]],
    C=[[1, 0.2], [0, 1]],
    Phi=[["1 + 0.5 * cos(0.1 * k)"], [0.1]],
    dt=1.0,
    horizon=300,
    parameter_names=["leak"],
)
design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.95)
scenario = obsynth.Scenario(horizon=299, faults={"leak": obsynth.Step(size=0.1, start=150)}, noise=1.0, seed=1)
simulation = obsynth.simulate(design, scenario)
decision = obsynth.decide(design.observer, simulation.estimates, nominal=[0.0], false_alarms=0.01)
obsynth.plotting.plot_decision(decision, dt=plant.dt)
