"""What is given: plants with named signals, their constants, faults and noise.

`descriptor`, `time_varying` and `dae` are the plants; `constants` and `uncertainty` their tolerances; `transformations`
makes plants from plants with the way back; `importing` reads models of other tools. What can be known about a plant
stands in `analysis`.

Main names: `DescriptorSystem`, `TimeVaryingDescriptorSystem`, `DAEModel`, `FaultModel`, `Constant`.
"""
