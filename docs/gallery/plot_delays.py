"""
What a delay is worth
=====================

`obsynth.plotting.plot_delays` draws the least gain and the least deviation of any filter against its delay.
"""

import obsynth

plant = obsynth.DescriptorSystem(
    A=[[1.0]],
    C=[[1], [1]],
    Bf=[[0]],
    Df=[[1], [0]],
    Bw=[[1, 0]],
    Dw=[[0, 0], [0, 1]],
    dt=1.0,
)
design = obsynth.optimal_filter(plant, norm="h2")
obsynth.plotting.plot_delays(design)
