# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # My model is 5 % wrong
#
# Every proof is about one matrix, and no plant has it. Here a motor drives a load through a shaft; both inertias, the
# stiffness, the damping and the friction are known to 5 %. We state that, ask what still holds, and get thresholds and
# intervals that hold for *every* drive within the tolerances.

# %%
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import obsynth

spec = obsynth.load_spec("../designs/drive/spec.yaml")
plant = spec.plant
for name, constant in plant.uncertainty.box.constants.items():
    print(f"{name:3s} {constant.nominal:5.2f} {constant.unit:10s} {constant.low:.3f} .. {constant.high:.3f}")

# %% [markdown]
# One constant is one unknown, wherever it stands: the stiffness is in two equations. Sampling turns sums into
# exponentials; what is not affine goes into a remainder with a proved bound.

# %%
design = obsynth.design(plant, spec.method, name=spec.name, **dict(spec.options))
print(obsynth.robustness(design))

# %% [markdown]
# ## A drive that is not the nominal one
#
# We take a corner of the box, let the unknown load torque jump between its bounds, and lose 1.5 N m of torque at 4 s.

# %%
box = plant.uncertainty.box
J1, J2, stiffness, c, b = (constant.high if up else constant.low for up, constant in zip(
    (True, False, True, False, True), box.constants.values(), strict=True
))  # fmt: skip
true = obsynth.discretise(
    obsynth.DescriptorSystem(
        np.diag([J1, J2, 1.0]), [[-c - b, c, -stiffness], [c, -c - b, stiffness], [1.0, -1.0, 0.0]], [[1], [0], [0]],
        [[1, 0, 0], [0, 1, 0]], Bf=[[1], [0], [0]], Bd=[[0], [1], [0]],
    ),
    plant.dt,
).plant  # fmt: skip
generator = np.random.default_rng(7)
steps, dt = 300, plant.dt
x, rows = np.zeros(3), []
for k in range(steps):
    u = np.array([np.sin(np.pi * k * dt)])
    y = true.C @ x + 0.002 * generator.uniform(-1.0, 1.0, 2)
    rows.append([k * dt, *u, *y])
    fault = np.array([-1.5 if k * dt >= 4.0 else 0.0])
    x = true.A @ x + true.B @ u + true.Bd @ (0.2 * generator.choice([-1.0, 1.0], 1)) + true.Bf @ fault
log = pd.DataFrame(rows, columns=["time", "torque", "motor speed", "load speed"])

# %%
bounds = {"disturbance_bounds": {"load torque": 0.2}, "noise_bound": np.sqrt(3.0)}
start = {name: 0.05 for name in plant.state_names}
adaptive = obsynth.online_monitor(design, constants=plant.uncertainty, initial_set=start, **bounds)
exact = design.replace(plant=plant.replace(uncertainty=None))
fixed = obsynth.online_monitor(exact, initial_error=0.1, **bounds)
found = obsynth.run_on_data(design, log, monitor=adaptive, warm_up=0.0)
before = obsynth.run_on_data(exact, log, monitor=fixed, warm_up=0.0)
print("adaptive:", dict(found.alarms))
print("exact model:", dict(before.alarms))

# %%
table = found.table
figure, axes = plt.subplots(2, 1, figsize=(8, 6), sharex=True)
name = "loss of torque"
axes[0].fill_between(table["time"], table[f"lowest {name}"], table[f"highest {name}"], color="0.85", label="guaranteed")
axes[0].plot(table["time"], table[f"fhat[{name}]"], label="estimate")
axes[0].plot(table["time"] - dt, np.where(table["time"] - dt >= 4.0, -1.5, 0.0), "k--", label="true fault")
axes[0].set_ylabel(f"{name} (N m)")
axes[0].legend()
shares = [f"share {constant}" for constant in box.names]
axes[1].stackplot(table["time"], table[shares].to_numpy().T, labels=box.names)
axes[1].set(xlabel="time (s)", ylabel="share of the interval")
axes[1].legend(ncol=5)
figure.tight_layout()

# %% [markdown]
# The interval holds the true fault at every sample. After the fault it excludes zero: that *this* drive has lost torque
# is proved, as far as its constants are within their tolerances.
#
# ## An alarm that can be checked
#
# An alarm can be handed on as a certificate: a window of the log, the tolerances, and multipliers that anybody can
# check in exact arithmetic, without a solver.

# %%
row = int(np.argmax(table["time"] >= 4.2)) + 1
proof = obsynth.prove_alarm(design, log, row, window=12, initial_set=start, **bounds)
print(proof)
print(obsynth.prove_alarm(design, log, 150, window=12, initial_set=start, **bounds))

# %% [markdown]
# ## How wrong may the model be?
#
# The fixed bound of the exact model alarms without a fault; the adaptive threshold never does, and pays for that with
# the least fault that it detects. Each point is 20 plants of the box, half of them vertices.

# %%
study = obsynth.tolerance_study(design, spec.scenario, tolerances=[0, "1 %", "2 %", "5 %", "10 %"], noise_bound=4.0)
print(study)
axes = obsynth.plotting.plot_tolerances(study)
