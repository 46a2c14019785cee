# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Which sensor, which method?
#
# A motor drives a load through a flexible shaft. Part of its torque is lost, and nobody knows what the load draws. What
# must be measured so that the loss is distinguished from the load, and what estimates it best?

# %%
import numpy as np
import pandas as pd

import obsynth

motor = obsynth.load_spec("../designs/motor/one_encoder.yaml").plant
obsynth.diagnose(motor)

# %% [markdown]
# One encoder and the current are not enough, and the sentence says why: a step of torque looks exactly like a step of
# the load's, with the shaft wound up a little. It also names the state that would help. All least sets of sensors, for
# detecting and for estimating:

# %%
for goal in ("detect", "estimate"):
    print(obsynth.sensor_sets(motor, goal=goal))

# %% [markdown]
# So a second encoder, on the load. Is there a filter now?

# %%
better = obsynth.load_spec("../designs/motor/sampled.yaml").plant
found = obsynth.diagnose(better)
print(found)

# %% [markdown]
# Not the whole state is needed to estimate the torque: the unknown load is taken out of the plant first.

# %%
decoupled = obsynth.decouple(better)
print("order", decoupled.order, "without", decoupled.without)

# %% [markdown]
# How far the torque may walk from one sample to the next is what noise is weighed against; with it, delay buys
# accuracy.

# %%
design = obsynth.functional_filter(better, fault_rate=0.005, delay=5)
design

# %%
log, true = (pd.read_csv(f"../designs/motor/{name}.csv") for name in ("log", "true_log"))
estimate = design.observer.run(log[list(better.output_names)], log[["voltage"]]).faults[:, 0]
print(f"rms error {np.sqrt(np.mean((estimate - true['f']) ** 2)):.4f} Nm")

# %% [markdown]
# And the other methods? On the same clock, with the same draws of noise and load:

# %%
scenario = obsynth.Scenario(
    horizon=3.0,
    noise=1.0,
    faults={"torque": obsynth.Step(size=0.1, start=1.0)},
    disturbances={"load torque": obsynth.Sine(amplitude=0.2, frequency=0.5)},
)
options = {"functional-filter": {"fault_rate": 0.005, "delay": 5}}
compared = obsynth.compare(better, scenario=scenario, options=options, within=0.3, runs=5)
compared

# %%
figure = compared.plot()
