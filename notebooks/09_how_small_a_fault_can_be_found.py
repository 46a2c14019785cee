# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # How small a fault can be found at all?
#
# A motor drives a load through a shaft and loses some of its torque. Both speeds are measured to 0.0035 rad/s, and the
# load draws anything within 1 N m. Which loss can be found without a single false alarm? That is a property of the
# plant and of these bounds, not of the filter: a test that nothing can beat is a linear programme, and its proof is
# shipped.

# %%
from fractions import Fraction

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import obsynth

spec = obsynth.load_spec("../designs/drive/guaranteed_test.yaml")
plant = spec.plant
bounds = {"disturbance_bounds": {"load torque": 1.0}, "noise_bound": 3}
step = obsynth.guaranteed_test(plant, "loss of torque", course="step", before=10, **bounds)
print(f"threshold {step.threshold:.6g} N m, no test has one below {step.least:.6g} N m")
print(f"a step of {step.surely_found:.4g} N m is certain to be detected within {step.delay:.2g} s")

# %% [markdown]
# Delay against size: more samples after the step detect a smaller one, up to a point.

# %%
step.plot()
plt.show()

# %% [markdown]
# Why is there no smaller one? Because of this course: twice the fault with these disturbances, and no fault with their
# opposites, give the very same samples. No function of them distinguishes the two.

# %%
obsynth.plotting.plot_hidden_course(step)
plt.show()

# %% [markdown]
# What the fault may do decides most. After healthy samples the twist of the shaft is known, and a small
# step is detectable.

# %%
rows = []
for course, samples in (("any", 10), ("constant", 10), ("constant", 30)):
    test = obsynth.guaranteed_test(plant, course=course, samples=samples, **bounds)
    rows.append((course, samples, test.threshold, test.least))
rows.append(("step after 10", step.samples, step.threshold, step.least))
pd.DataFrame(rows, columns=["course", "samples", "threshold", "least"]).round(6)

# %% [markdown]
# ## On a log
#
# The load does its worst within its bounds, the noise as well, and from 2 s on some torque is lost: less than the fixed
# threshold of ten samples. The least interval for the very samples of each row finds it all the same. Three rows miss a
# speed: their equations are left out, and the rest still gives a verdict. While the onset is in the window no constant
# loss explains it: an alarm, without an interval.

# %%
fixed = obsynth.guaranteed_test(plant, course="constant", samples=10, **bounds)
exact = obsynth.guaranteed_test(plant, course="constant", samples=10, exact=True, missing="solve", **bounds)
size, rng = 0.6 * fixed.threshold, np.random.default_rng(6)
bound, x, rows = 3.0 * np.diag(plant.Dw), np.zeros(3), []
for k in range(150):
    u = np.array([np.sin(np.pi * k * plant.dt)])
    rows.append([k * plant.dt, *u, *(plant.C @ x + bound * rng.uniform(-1.0, 1.0, 2))])
    fault = size if k * plant.dt >= 2.0 else 0.0
    x = plant.A @ x + plant.B @ u + plant.Bd @ rng.uniform(-1.0, 1.0, 1) + plant.Bf[:, 0] * fault
log = pd.DataFrame(rows, columns=["time", *plant.input_names, *plant.output_names])
log.loc[60:62, "load speed"] = np.nan
runs = {
    name: obsynth.run_on_data(test, log, monitor=obsynth.online_monitor(test))
    for name, test in (("fixed", fixed), ("exact", exact))
}
for name, run in runs.items():
    print(name, dict(run.alarms))

# %%
table = runs["exact"].table
_, axes = plt.subplots(figsize=(8, 3))
low, high = (table[f"{end} loss of torque"].astype(float) for end in ("lowest", "highest"))
axes.fill_between(table["time"], low, high, color="0.8", label="least interval")
axes.axhline(0.0, color="0.4", linewidth=0.8)
axes.plot(table["time"], np.where(table["time"] >= 2.0, size, 0.0), drawstyle="steps-post", label="loss of torque")
axes.set_xlabel("time (s)")
axes.set_ylabel("N m")
axes.legend(loc="upper left")
plt.show()

# %% [markdown]
# ## A proof that adds up
#
# The certificate of an alarm has one fraction for each equation of the window. Multiply, add: states cancel to the last
# digit, and what is left is a sum of disturbances and noise that their bounds do not allow. `obsynth verify` does it
# with fractions; nothing is rounded, and no solver is believed.

# %%
row = runs["exact"].alarm_rows["pointwise"]
proof = obsynth.prove_alarm(exact, log, row)
print(proof)
numbers = [Fraction(text) for text in proof.certificate["multipliers"]]
print(f"{len(numbers)} numbers; all bounds at once would have to be {100 * proof.margin:.1f} % wider")

# %% [markdown]
# ## Which fault is it?
#
# Three tanks, three faults. With three levels each fault has a test of its own, which is blind to the other two. With
# two levels no test of that kind exists, and the bank says which pair an alarm means.

# %%
tanks = obsynth.load_spec("../designs/tanks/spec.yaml").plant
bank = obsynth.guaranteed_test(tanks, isolate=True, course="constant", samples=12, noise_bound=3)
print(bank.groups)
two = tanks.replace(
    C=tanks.C[:2], D=None, Df=None, Dw=None, Bw=None, noise_names=None, output_names=["h1", "h2"],
    operating_point={}, units={},
)  # fmt: skip
pairs = obsynth.guaranteed_test(
    two, isolate=True, course="constant", samples=9, noise_bound={"h1": 0.003, "h2": 0.003}
)  # fmt: skip
for note in pairs.notes[::2]:
    print(note)

# %%
obsynth.plotting.plot_hidden_course(pairs, fault="leak 1")
plt.show()
