# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # One proof over a region
#
# A spring whose stiffness k moves between 1 and 6 is stable wherever k rests. Let k move: is it still? And can one
# observer, with one proof, serve every course of k?

# %%
import matplotlib.pyplot as plt
import numpy as np

import obsynth

spring = obsynth.PolytopicSystem(
    plant={"A": [[0, 1], ["-k", -0.4]], "C": [[1, 0]], "Bd": [[0], [1]], "Bf": [[0], [1]], "state_names": ["x", "v"]},
    scheduling={"k": {"range": [1, 6], "unit": "N/m"}},
)
for k in (1, 3, 6):
    print(f"k = {k}: poles {np.linalg.eigvals(spring.at({'k': k}).A).round(3)}")

# %% [markdown]
# Rested points prove nothing. Large k while the spring comes back, small k while it leaves: it pumps itself up.

# %%
step, x = 0.01, np.array([1.0, 0.0])
steps = {k: np.linalg.matrix_power(np.eye(2) + step / 64 * spring.at({"k": k}).A, 64) for k in (1, 6)}
sizes = []
for _ in range(1500):
    x = steps[6 if x[0] * x[1] < 0 else 1] @ x
    sizes.append(np.linalg.norm(x))
plt.semilogy(step * np.arange(1500), sizes)
plt.xlabel("t (s)")
plt.ylabel("size of the state")
plt.show()

# %% [markdown]
# An observer with one certificate over the whole region has no such course. Below: a linear plant of Wang et al. (2015)
# whose first entry moves with a measured speed. The claim is proved at the vertices in ball arithmetic, for every
# course of the speed; the worst course that was found tells how near it is to the truth.

# %%
plant = obsynth.PolytopicSystem(
    plant={
        "E": np.diag([1, 1, 1, 0]),
        "A": [
            ["0.9 + 0.3 * v", 0.005, -0.095, 0],
            [0.005, 0.995, 0.0997, 0],
            [0.095, -0.0997, 0.99, 0],
            [1, 0, 1, 1],
        ],
        "C": [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "Bf": [[0.1, 0], [1, 1], [-0.1, 1], [-1, 0]],
        "Bd": [[1], [1], [1], [0]],
        "dt": 1.0,
    },
    scheduling={"v": {"range": [-1, 1], "unit": "m/s", "column": "speed"}},
)
design = obsynth.fault_estimation_filter(plant)
print(design.report["LMI"].claim)
print(design.report["worst switching found"].detail)

# %% [markdown]
# What does a larger region cost?

# %%
found = obsynth.region_trade_off(plant, sizes=[0.1, 0.4, 0.7, 1.0])
found.plot()
plt.show()
found.table().drop(columns="why").round(4)

# %% [markdown]
# The speed moves, a fault begins, and nothing of either is left in the estimate but the disturbance.

# %%
scenario = obsynth.Scenario(
    horizon=150,
    faults={"f1": obsynth.Step(size=1.0, start=75)},
    scheduling={"v": obsynth.Sine(amplitude=0.9, frequency=0.3)},
)
run = obsynth.simulate(design, scenario)
plt.plot(run.time, run.estimates.faults[:, 0], label="estimate of f1")
plt.plot(run.time, run.inputs[:, 0], ":", label="v")
plt.xlabel("t (s)")
plt.legend()
plt.show()
print(f"largest error after warm-up: {np.nanmax(np.abs(run.fault_errors[run.fault_warm_up :])):.1e}")

# %% [markdown]
# **A Lipschitz constant is no property of the plant.** A flexible joint with `3.33 sin(angle)`: in rad/s the classical
# condition fails, with speeds in tenths it passes. The slope of one sine, proved over the region, does not depend on
# units.

# %%
claims = []
for scale in (1.0, 10.0):
    joint = obsynth.DAEModel(
        {
            "motor": "der(a) = s",
            "torque": "der(s) = -48.6 * (a - b) - 1.25 * s + 21.6 * u",
            "link": f"der(b) = w * {scale}",
            "load": f"der(w) * {scale} = 19.5 * (a - b) - 3.33 * sin(b)",
        },
        {"angle": "a", "speed": "s"},
        states={"a": 0.0, "s": 0.0, "b": 0.0, "w": 0.0},
        inputs={"u": 0.0},
    )
    one = obsynth.region_observer(
        joint, region={"b": [-3.2, 3.2]}, sample_time=0.01, noise={"angle": 0.03, "speed": 0.03, "der(b)": 0.3},
        wanted={"b": 1.0}, decay=1.0,
    )  # fmt: skip
    claims.append(one.certificate.claims["region_deviation"])
    print(f"speeds in units of {scale:g} rad/s: deviation of b below {claims[-1]:.4f}, decay proved")

# %% [markdown]
# **Two tanks with a leak.** Nothing is linearised: the slopes of the roots are enclosed over the region, and the leak
# is estimated with a proved deviation, for every trajectory there.

# %%
tanks = obsynth.DAEModel(
    {
        "first": "2.0 * der(h1) = q - between - leak",
        "second": "2.0 * der(h2) = between - out",
        "valve": "out = 0.1 * sqrt(h2)",
    },
    {"l1": "h1", "l2": "h2"},
    states={"h1": 0.51, "h2": 0.25, "out": 0.05},
    inputs={"q": 0.05},
    parameters={"leak": 0.0},
    definitions={"between": "0.1 * (h1 - h2) / sqrt(abs(h1 - h2) + 0.01)"},
)
levels = obsynth.region_observer(
    tanks,
    region={"h2": [0.05, 0.6], "h1 - h2": [0.02, 0.55]},
    sample_time=2.0,
    noise={"l1": 1e-3, "l2": 1e-3, "leak": 1e-4},
)
leaking = obsynth.Scenario(horizon=600, noise=1.0, faults={"leak": obsynth.Step(size=0.01, start=200)})
run = obsynth.simulate(levels, leaking)
plt.plot(run.time, run.estimates.faults[:, 0], label="estimate")
plt.plot(run.time, run.faults[:, 0], label="leak")
plt.xlabel("t (s)")
plt.legend()
plt.show()
proved = levels.certificate.claims["region_deviation"]
print(f"deviation of the leak: proved below {proved:.2e}, here {run.fault_errors[run.time > 400].std():.2e}")
