# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Time-varying descriptor plants: the Kalman gain as an inequality, and a parameter that drifts
#
# Moussa Ali and Zhang (IFAC ALCOSP 2013) build on the Kalman filter of a descriptor plant,
# $\hat x(k+1) = L\,(A\hat x(k) + Bu(k)) + K y(k+1)$ with $LE + KC = I$. Every such $[L\ K]$ is a particular one plus an
# output injection, and the steady covariance of its error $e(k+1) = LA\,e(k) + L\mu(k) - K\nu(k+1)$ (13) is a squared
# H2 norm: where the plant is constant, the Kalman gain is a convex problem, without a Riccati equation.

# %%
import matplotlib.pyplot as plt
import numpy as np

import obsynth

np.set_printoptions(precision=4, suppress=True)

# %%
constant = obsynth.DescriptorSystem(
    E=[[1, 0, 0], [0, 1, 0], [0, 0, 0]],
    A=[[0.9, 0.1, 0.0], [-0.2, 0.7, 0.1], [1.0, 0.5, -1.0]],
    C=[[1, 0, 0], [0, 0, 1]],
    dt=0.1,
)
kalman = obsynth.conditions.kalman(constant, Q=1.0, R=1.0)
for solver, settings in {"CLARABEL": {}, "SCS": {"eps_abs": 1e-9, "eps_rel": 1e-9}}.items():
    kalman.problem.solve(solver=solver, **settings)
    print(f"{solver:9} {kalman.problem.status}: trace of the covariance {kalman.problem.value:.6f}")
riccati = obsynth.steady_state_filter(constant, Q=1.0, R=1.0)
print(f"by the Riccati equation (16):      {np.trace(riccati.P):.6f}")
assert np.allclose(kalman.gains()["K"], riccati.K, atol=1e-3)
print(kalman.design(name="Kalman"))

# %% [markdown]
# ## Feasibility against the speed
#
# What a Riccati equation cannot do: the same with a region for the eigenvalues of $LA$. The smaller the disk, the
# larger the variance, without end: every mode can be moved here.

# %%
data = kalman.data
P, Y = kalman.variables["P"], kalman.variables["Y"]
radii, traces = [0.9, 0.7, 0.5, 0.4, 0.3, 0.2, 0.1], []
for radius in radii:
    disk = obsynth.conditions.region(data["LA"], P, obsynth.conditions.disk(0.0, radius), Y=Y, Cy=-data["N1A"])
    inside = kalman.changed(constraints=disk)
    inside.problem.solve(solver="CLARABEL")
    traces.append(inside.problem.value if inside.problem.status == "optimal" else np.nan)
    print(f"radius {radius}: {inside.problem.status:10} trace {traces[-1]:.4f}")
figure, axes = plt.subplots(figsize=(7.5, 3.0), layout="constrained")
axes.plot(radii, traces, "k-o")
axes.axhline(np.trace(riccati.P), color="0.6", linewidth=1)
axes.set(xlabel="radius of the disk for the eigenvalues of LA", ylabel="trace of the covariance")
plt.show()

# %% [markdown]
# A mode that neither decays nor shows ends it for any radius; the solver says infeasible, and `existence` says why:

# %%
hidden = obsynth.DescriptorSystem(None, [[1.5, 0.0], [0.0, 0.5]], C=[[0.0, 1.0]], dt=1.0)
lost = obsynth.conditions.kalman(hidden)
lost.problem.solve(solver="CLARABEL")
print(lost.problem.status, "-", lost.existence.failures[0].detail)

# %% [markdown]
# ## The published example, which varies in time
#
# Moussa Ali and Zhang (IFAC ALCOSP 2013) estimate states and a parameter of
#
# $$E_{k+1} x(k+1) = A_k x(k) + B_k u(k) + \Phi_k \theta + \mu(k), \qquad y(k+1) = C_{k+1} x(k+1) + \Psi_k \theta +
# \nu(k)$$
#
# with singular $E$. We take their example, show why their Figure 2 does not follow from their data, and what works.
# `docs/papers.md` and `designs/moussaali2013_ltv/NOTES.md` have the numbers and how the damaged print was read.

# %%


def rms(values):
    return np.sqrt(np.mean(values**2))


printed = obsynth.load_spec("../designs/moussaali2013_ltv/spec.yaml")
plant = printed.plant
print(plant)
print(f"E_1 =\n{plant.E.at(1)}\nA_0 =\n{plant.A.at(0)}\nPhi_3 =\n{plant.Phi.at(3)}")

# %% [markdown]
# ## 1. The data
#
# One equation has no $x(k+1)$: it holds between the states of one sample, so each new state is solved from one row of
# $E_{k+1}$ and one row of $A_{k+1}$ together. The parameter degrades from 1 to 0.5 from $k = 200$ on, with a time
# constant of 50 s; the sensor's noise has a standard deviation of 0.05. (Neither is printed; both are our choice.)

# %%
samples = 1001
k = np.arange(samples)
u = np.column_stack([1 - np.exp(-0.018 * k) / 0.8 * np.sin(0.03 * k), 1 + np.exp(-0.03 * k) * np.sin(0.1 * k)])
theta = np.where(k < 200, 1.0, 0.5 + 0.5 * np.exp(-(k - 200) / 50))
noise = 0.05 * np.random.default_rng(1).standard_normal((samples - 1, 2))
ends_later = plant.replace(horizon=None)
run = obsynth.simulate_time_varying(
    ends_later, samples=samples, parameters=theta[:, None], u=u, initial_state=[-2.0, 0.0], output_noise=noise[:, 1:]
)
_, axes = plt.subplots(figsize=(7.5, 2.8), layout="constrained")
axes.plot(k, run.outputs[:, 0], color="black", linewidth=0.8)
axes.set_xlabel("time (s)")
axes.set_ylabel("y")
plt.show()

# %% [markdown]
# ## 2. The filter: one orthogonal factorisation per sample
#
# Everything known about $x(k+1)$ is one least-squares problem, (6): $Y_k = H_{k+1} x(k+1) + V_k$ with $H = [E; C]$.
# With $H = [Q_1\; Q_2]\,[R_H; 0]$ and a square root $S$ of the covariance of $V_k$, the part $Q_2^T Y$ does not see
# the state at all: whitened, it is the **parity innovation**, $N(0, I)$. It holds all that the data say about anything
# else.

# %%
H = np.vstack([plant.E.at(1), plant.C.at(1)])
S = np.zeros((3, 5))
S[:2, :2], S[:2, 2:4], S[2:, 4:] = plant.A.at(0), 1e-2 * np.eye(2), 0.05
Q, R = np.linalg.qr(H, mode="complete")
kept, parity = Q[:, :2].T, Q[:, 2:].T
innovation = parity / np.sqrt(parity @ S @ S.T @ parity.T)  # whitened
estimate = np.linalg.solve(R[:2], kept - kept @ S @ S.T @ innovation.T @ innovation)
L, K = estimate[:, :2], estimate[:, 2:]
assert np.allclose(L @ plant.E.at(1) + K @ plant.C.at(1), np.eye(2))
assert np.allclose(innovation @ S @ S.T @ innovation.T, np.eye(1))
print(f"L =\n{L}\nK =\n{K}\nfrom data to the innovation: {innovation}")

# %% [markdown]
# ## 3. Why the printed observer never learns
#
# (18) learns from $y(k+1) - C\hat x(k+1)$. That residual has only $\mathrm{rank}\,E + n_y - n_x$ independent
# components, which the paper does not say. Here this is $1 + 1 - 2 = 0$: row 2 of $K$ above is 1, and the second row of
# $L$ is zero, so $\hat x_2 = y$ whatever $\theta$ is. We refuse it:

# %%
try:
    literal = obsynth.load_spec("../designs/moussaali2013_ltv/as_printed.yaml")
    obsynth.design(literal.plant, literal.method, **literal.options)
except obsynth.PreconditionError as error:
    print(error)

# %% [markdown]
# ## 4. A better residual is not enough
#
# The innovation form, our default, learns from the parity innovation instead. It finds $\theta$ at once, and then the
# excitation ends: both entries of $\Phi_k$ tend to one, and the effect of a *constant* parameter on $y$ decays. The
# guard keeps the estimate where it is, instead of letting it blow up. The band is that of a constant parameter: it
# widens as far as forgetting goes, and knows nothing of the change, which was never seen.

# %%
innovation = obsynth.adaptive_observer(plant, Q=1e-4, R=2.5e-3, forgetting=0.95)
frozen = innovation.observer.run(run.outputs, u)
obsynth.plotting.plot_parameters(frozen, parameters=theta)[0].set_ylim(0.3, 1.5)
plt.show()
print(innovation.notes[0])
print(f"information in the last 50 samples at k = 100, 300, 500, 1000: {frozen.excitation[[100, 300, 500, 1000]]}")

# %% [markdown]
# ## 5. What works on the printed data: a parameter that walks
#
# $y$ does see a *change* of $\theta$, multiplied by $k/1.5$. With the parameter among the states as a random walk, and
# hardly any noise in the equations, the fault is followed.

# %%
walking = obsynth.design(plant, printed.method, name="design A", **printed.options)
assert walking.report.passed
followed = walking.observer.run(run.outputs, u)
obsynth.plotting.plot_parameters(followed, parameters=theta)[0].set_ylim(0.3, 1.3)
plt.show()
error = followed.parameters[:, 0] - theta
print(f"rms error before and after the fault: {rms(error[100:200]):.4f}, {rms(error[400:]):.4f}")

# %% [markdown]
# The states, with their bands:

# %%
panels = obsynth.plotting.plot_states(followed, states=run.states)
plt.show()

# %% [markdown]
# ## 6. What agrees with the paper's text: $C = I$
#
# With both states measured there is one residual direction, and (18) as printed does what the text says.

# %%
two = obsynth.load_spec("../designs/moussaali2013_ltv/two_outputs.yaml")
both = obsynth.simulate_time_varying(
    two.plant.replace(horizon=None), samples=samples, parameters=theta[:, None], u=u, initial_state=[-2.0, 0.0],
    output_noise=noise,
)  # fmt: skip
design = obsynth.design(two.plant, two.method, name="design B", **{**two.options, "initial_parameters": [1.0]})
estimates = design.observer.run(both.outputs, u)
obsynth.plotting.plot_parameters(estimates, parameters=theta)[0].set_ylim(0.3, 1.3)
plt.show()
for check in design.report.checks:
    verdict = "holds" if check.passed else "FAILS"
    print(f"{check.name:32s} {check.value:10.3g}   {'info' if check.kind == 'information' else verdict}")

# %% [markdown]
# ## 7. The decision
#
# Has $\theta$ left its nominal value, 1? The threshold is for a false alarm in at most 1 % of such runs. The chi-square
# statistic compares the estimate with its own covariance (which $S_k$ of (18i) is not); the GLR restarts the signature
# of the change at every candidate onset.

# %%
_, pair = plt.subplots(2, 1, sharex=True, figsize=(7.5, 5.0), layout="constrained")
for axes, statistic in zip(pair, ("chi-square", "glr"), strict=True):
    decision = obsynth.decide(design.observer, estimates, statistic=statistic, nominal=[1.0], false_alarms=0.01)
    obsynth.plotting.plot_decision(decision, axes=axes)
    alarm = decision.alarm
    print(f"{statistic}: {alarm.parameter} at k = {alarm.k}, onset {alarm.onset}, confidence {alarm.confidence:.4f}")
plt.show()

# %% [markdown]
# ## 8. Missing samples
#
# Nothing is measured for three samples. $E$ alone does not determine the state, so the observer says that the states
# are unknown for that time (their deviations are infinite) and goes on as soon as it can. Decisions go on as well: the
# signatures of the GLR are those of the record with its gap.

# %%
gappy = both.outputs.copy()
gappy[50:53] = np.nan
robust = obsynth.adaptive_observer(two.plant, Q=1e-4, R=2.5e-3, forgetting=0.95, initial_parameters=[1.0])
holes = robust.observer.run(gappy, u)
print("deviations of the states around the gap:")
print(holes.state_deviations[48:56])
assert np.isinf(holes.state_deviations[50:53]).any()
assert np.isfinite(holes.state_deviations[53:]).all()
alarm = obsynth.decide(robust.observer, holes, statistic="glr", nominal=[1.0], false_alarms=0.01).alarm
print(f"glr: {alarm.parameter} at k = {alarm.k}, onset {alarm.onset}, confidence {alarm.confidence:.4f}")

# %% [markdown]
# ## 9. A plant of your own
#
# A tank whose heater warms a stream that is not constant, with a sensor behind a mixing point that stores nothing. The
# matrices hold expressions in `k`; the parameter is the share of the heating power that is missing.

# %%
tank = obsynth.TimeVaryingDescriptorSystem(
    E=[[1, 0], [0, 0]],
    A=[["0.9 - 0.05 * sin(0.02 * k)", 0], [0.8, -1]],
    B=[[0.1], [0]],
    C=[[0, 1]],
    Phi=[["-0.1 * (1 + 0.2 * cos(0.05 * k))"], [0]],
    dt=1.0,
    horizon=600,
    state_names=["tank", "mixed"],
    input_names=["power"],
    output_names=["thermometer"],
    parameter_names=["lost power"],
)
own = obsynth.adaptive_observer(tank, Q=1e-6, R=1e-4, forgetting=0.95)
print(own)

# %%
power = np.ones((600, 1))
lost = np.where(np.arange(600) < 300, 0.0, 0.4)[:, None]
error = 0.01 * np.random.default_rng(0).standard_normal((599, 1))
measured = obsynth.simulate_time_varying(
    tank, samples=600, parameters=lost, u=power, initial_state=[0.0, 0.0], output_noise=error
)
found = own.observer.run(measured.outputs, power)
obsynth.plotting.plot_parameters(found, parameters=lost)
plt.show()

# %% [markdown]
# The band is that of the stated noise, for a parameter that keeps still: after a jump the estimate follows as fast as
# `forgetting` lets it.

# %%
plt.close("all")
