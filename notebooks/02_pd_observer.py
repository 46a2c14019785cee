# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A PD observer for states and actuator faults: your own plant, then step by step

# %%
import matplotlib.pyplot as plt
import numpy as np

import obsynth

np.set_printoptions(precision=4, suppress=True)

# %% [markdown]
# ## A plant of your own first
#
# A motor turns a load through a shaft that twists. The motor may lose torque, slowly or for good. The model stays in
# continuous time; the observer is sampled afterwards where a controller wants that.

# %%
inertia, load, stiffness, friction = 0.01, 0.05, 8.0, 0.02
drive = obsynth.DescriptorSystem(
    A=[[-friction / inertia, -stiffness / inertia, 0], [1, 0, -1], [0, stiffness / load, -friction / load]],
    B=[[1 / inertia], [0], [0]],
    C=["motor speed", "load speed"],
    Bf=[[-1 / inertia], [0], [0]],
    state_names=["motor speed", "twist", "load speed"],
    input_names=["torque"],
    fault_names=["lost torque"],
    sensor_noise={"motor speed": 0.01, "load speed": 0.01},
    units={"lost torque": "Nm"},
)
own = obsynth.pd_observer(drive)
print(own)

# %%
happens = obsynth.Scenario(
    horizon=20,
    sample_time=0.01,
    inputs={"torque": obsynth.Step(size=0.1)},
    faults={"lost torque": obsynth.Step(size=0.05, start=8)},
    noise=1,
)
obsynth.plotting.plot_simulation(obsynth.simulate(own, happens))
plt.show()
print("eigenvalues of the sampled observer:", np.abs(np.linalg.eigvals(obsynth.sample_observer(own.observer, 0.01).Az)))

# %% [markdown]
# The rest of this notebook builds such an observer from its error equations, with parts that lie inside the package.

# %% [markdown]
# ## The published example
#
# Filasova, Krokavec and Serbak estimate the states and slowly varying faults of
#
# $$\dot q = A q + B u + F f, \qquad y = C q$$
#
# with an observer that feeds back the output error $e_y = y - C\hat q$ and its derivative:
#
# $$\dot{\hat q} = A\hat q + Bu + F\hat f + J e_y + L\dot e_y, \qquad \dot{\hat f} = M e_y + N\dot e_y .$$
#
# We build it for their example from the error equations, and end where `obsynth.pd_observer` gets in one call. The
# paper has misprints and one trap; `designs/filasova/NOTES.md` lists them.

# %%
from pathlib import Path

from scipy.linalg import solve_continuous_are

from obsynth.methods.conic import lmi
from obsynth.numerics.continuous import spectral_abscissa
from obsynth.plotting import plot_delta_scan, plot_faults
from obsynth.simulation import simulate_plant
from obsynth.spec.documents import read_yaml

plant = obsynth.load_spec("../designs/filasova/spec.yaml").plant
A, B, C, F = plant.A, plant.B, plant.C, plant.Bf
nx, ny, nf = plant.nx, plant.ny, plant.nf
n = nx + nf
print(f"eigenvalues of the plant: {np.linalg.eigvals(A)}: unstable, which is no obstacle")

# %% [markdown]
# ## 1. The error equation
#
# With a constant fault, $e = [q - \hat q;\ f - \hat f]$ obeys $(I + L_o C_o)\dot e = (A_o - J_o C_o)\,e$ (33), where
#
# $$A_o = \begin{bmatrix} A & F \\ 0 & 0\end{bmatrix},\quad C_o = [C\ 0],\quad
# J_o = \begin{bmatrix} J \\ M\end{bmatrix},\quad L_o = \begin{bmatrix} L \\ N\end{bmatrix}.$$
#
# Gains that make it stable exist exactly when $(A_o, C_o)$ is detectable: $(A, C)$ detectable, and
# $\mathrm{rank}\,[A\ F;\ C\ 0] = n + p$ (3): no zero at $s = 0$, where a constant fault could hide.

# %%
Ao = np.block([[A, F], [np.zeros((nf, n))]])
Co = np.hstack([C, np.zeros((ny, nf))])
assert np.linalg.matrix_rank(np.block([[A, F], [C, np.zeros((ny, nf))]])) == n


def error_matrix(J, L):
    return np.linalg.solve(np.eye(n) + L @ Co, Ao - J @ Co)


# %% [markdown]
# ## 2. What is printed
#
# The printed gains reproduce all three printed spectra. The printed $P_1, P_3, Y, Z$ do not belong to them.

# %%
printed = read_yaml(Path("../designs/filasova/expected.yaml"))["printed"]
J, L, M, N = (np.array(printed[letter], dtype=float) for letter in "JLMN")
G = np.array(printed["G"], dtype=float)
print("A - J C:               ", np.linalg.eigvals(A - J @ C))
print("(I + L C)^-1 (A - J C):", np.linalg.eigvals(np.linalg.solve(np.eye(nx) + L @ C, A - J @ C)))
print("error system:          ", np.linalg.eigvals(error_matrix(np.vstack([J, M]), np.vstack([L, N]))))
missed = np.array(printed["P3"]).T @ np.block([[J, L], [M, N]]) - np.hstack([printed["Y"], printed["Z"]])
print(f"largest entry of P3' [J L] - [Y Z], as printed: {np.max(np.abs(missed)):.2f}")

# %% [markdown]
# ## 3. Theorem 1
#
# With $Y = P_3^T J_o$ and $Z = P_3^T L_o$, the observer is stable if for some $\delta > 0$ there are $P_1 > 0$, $P_3$,
# $Y$, $Z$ with $W < 0$ (40)-(43). The inequality is sound: if $(A_o - J_oC_o - s(I + L_oC_o))x = 0$, then $[x; sx]$
# makes of it $2\,\mathrm{Re}(s)\,x^*P_1x < 0$.


# %%
def inequality(P1, P3, Y, Z, delta, shift=0.0):
    As = Ao + shift * np.eye(n)
    W11 = As.T @ P3 + P3.T @ As - Y @ Co - Co.T @ Y.T
    W21 = P1 - P3 + delta * P3.T @ As - delta * Y @ Co - Co.T @ Z.T
    W22 = -delta * (P3 + P3.T + Z @ Co + Co.T @ Z.T)
    return lmi.symmetric_blocks([[W11], [W21, W22]])


def theorem_1(delta, shift=0.0, safe=True):
    P1, P3 = lmi.symmetric_variable(n), lmi.matrix_variable(n, n)
    Y, Z = lmi.matrix_variable(n, ny), lmi.matrix_variable(n, ny)
    constraints = [lmi.at_most(inequality(P1, P3, Y, Z, delta, shift), -1e-3)]
    if safe:
        constraints += [lmi.at_least(P1, 1e-3), lmi.at_least(P3 + P3.T, 2.0)]
        objective = lmi.frobenius_norm(Y, Z) + lmi.frobenius_norm(P3)
    else:
        constraints += [lmi.at_least(P1, 1.0)]
        objective = None
    status = lmi.minimise(objective, constraints, what="Theorem 1")["status"]
    P3 = lmi.value_of(P3)
    return np.linalg.solve(P3.T, lmi.value_of(Y)), np.linalg.solve(P3.T, lmi.value_of(Z)), status


# %% [markdown]
# **The trap.** The inequalities do not keep $P_3$ away from singular, and a solver that looks for just any solution
# goes there: "optimal", with useless gains. We minimise $\|[Y\ Z]\|_F + \|P_3\|_F$ with $P_3 + P_3^T \ge 2I$ instead:
# then $\|[J_o\ L_o]\| \le \|[Y\ Z]\|$.

# %%
for delta in (0.1, 1.0):
    for safe in (False, True):
        J1, L1, status = theorem_1(delta, safe=safe)
        label = "safe objective" if safe else "any solution"
        print(f"delta {delta:3}: {label:15} {status:8} norm of J {np.linalg.norm(J1, 2):8.2g}")
        assert not safe or np.linalg.norm(J1, 2) < 2.0

# %%
J1, L1, _ = theorem_1(0.1)
print(f"slowest eigenvalue {spectral_abscissa(error_matrix(J1, L1)):.4f} (printed gains: -0.3117)")
print(f"'P part' A - J C alone: {spectral_abscissa(A - J1[:nx] @ C):.4f}: nothing is promised about it")

# %% [markdown]
# ## 4. Without derivatives
#
# With $\nu = (I + L_oC_o)\,\xi - L_o\,(y - Du)$, $\xi = [\hat q; \hat f]$, no derivative of $y$ is left:
#
# $$\dot\nu = (A_o - KC_o)\,\nu + B_ou + Ky, \qquad \xi = \nu + S\,(y - C_o\nu), \qquad
# S = (I + L_oC_o)^{-1}L_o,\ K = J_o + (A_o - J_oC_o)S .$$
#
# A PD observer is a Luenberger observer whose estimate is corrected by $S$ times its own residual. This is what is
# shipped.

# %%
S = np.linalg.solve(np.eye(n) + L1 @ Co, L1)
K = J1 + (Ao - J1 @ Co) @ S
print(f"slowest eigenvalue of A - K C: {spectral_abscissa(Ao - K @ Co):.4f}")

# %% [markdown]
# ## 5. The same in one call
#
# The gains agree to the solver's accuracy; the realisation follows from them. The report proves the inequality for the
# shipped matrices, with every rounding error bounded, and recomputes the rest from the plant and the realisation.

# %%
design = obsynth.pd_observer(plant, delta=0.1, name="filasova")
np.testing.assert_allclose(np.vstack([design.gains["J"], design.gains["M"]]), J1, rtol=0, atol=1e-5)
np.testing.assert_allclose(np.vstack([design.gains["L"], design.gains["N"]]), L1, rtol=0, atol=1e-5)
np.testing.assert_allclose(design.observer.By, K, rtol=0, atol=1e-4)
assert design.report.passed
for row in design.report.checks:
    if row.kind in ("proved", "equality", "computed"):
        print(f"{row.kind:9} {row.name:24} {row.value:10.3g}   bound {row.bound:.3g}")

# %% [markdown]
# ## 6. A decay rate
#
# $e = e^{-\alpha t}w$ turns the error equation into that of $A_o + \alpha I$ with $J' = J_o - \alpha L_o$. So the
# theorem is solved for $A_o + \alpha I$, and then $J_o = J' + \alpha L_o$. Without the second term the loop is another
# one.

# %%
for alpha in (0.0, 1.0, 2.0, 5.0):
    J2, L2, _ = theorem_1(0.1, shift=alpha)
    right, wrong = spectral_abscissa(error_matrix(J2 + alpha * L2, L2)), spectral_abscissa(error_matrix(J2, L2))
    assert right < -alpha
    print(f"alpha {alpha:3}: slowest {right:6.2f}   norm of J {np.linalg.norm(J2 + alpha * L2, 2):5.1f}   "
          f"(without alpha L: {wrong:6.2f})")  # fmt: skip

# %% [markdown]
# ## 7. What delta does
#
# $\delta$ never decides whether Theorem 1 has a solution, only which one comes out. For large $\delta$ the slowest
# eigenvalue sits near $-1/\delta$; for small $\delta$ gains grow a little. The default is the inverse of the plant's
# fastest mode, 0.115 s here. Speed is better asked for as a decay rate.

# %%
panels = plot_delta_scan(obsynth.pd_delta_scan(plant, np.logspace(-3, 1, 13)))

# %% [markdown]
# ## 8. The paper's scenario, and what G does
#
# A unit fault of actuator 1 from 30 to 70 s, of actuator 2 from 100 to 140 s. The plant is unstable, so it gets a state
# feedback; the observer's error does not depend on it. The outputs are sampled every 0.01 s, with and without noise of
# standard deviation 0.01, and the observer runs on the samples by a first-order hold.
#
# The paper multiplies the integral by a matrix $G$ (25), which is in neither theorem. It acts inside the loop, as $GM$
# and $GN$.

# %%
step, steps = 0.01, 16_000
time = step * np.arange(steps)
faults = np.column_stack([(time >= 30) & (time < 70), (time >= 100) & (time < 140)]).astype(float)
feedback = B.T @ solve_continuous_are(A, B, np.eye(nx), np.eye(2))
closed_loop = obsynth.discretise(plant.replace(A=A - B @ feedback), step).plant
run = simulate_plant(closed_loop, steps=steps, f=faults, initial_state=[0.1, -0.2, 0.3, 0.1])
inputs = -run.states @ feedback.T
noise = 0.01 * np.random.default_rng(5).standard_normal(run.outputs.shape)


def estimate(observer, outputs):
    return obsynth.sample_observer(observer, step).run(outputs, inputs)


printed_gains = {"J": J, "L": L, "M": M, "N": N}
designs = {
    "printed gains": obsynth.design_from_gains(plant, "pd-observer", **printed_gains),
    "printed gains, printed G": obsynth.design_from_gains(plant, "pd-observer", **printed_gains, adaptation_gain=G),
    "ours": design,
    "ours, decay 2": obsynth.pd_observer(plant, delta=0.1, decay=2.0),
}
print(f"{'':26}slowest   settling (s)   deviation of fhat   norm noise -> fault error")
for label, one in designs.items():
    assert one.report.passed
    clean = estimate(one.observer, run.outputs)
    noisy = estimate(one.observer, run.outputs + noise)
    window = (time >= 30) & (time < 70)
    outside = np.flatnonzero(np.abs(clean.faults[window, 0] - 1.0) > 0.02)
    deviation = np.std((noisy.faults - clean.faults)[2000:], axis=0)
    print(f"{label:26}{one.report['error system'].value:7.3f}{step * (outside[-1] + 1):13.2f}"
          f"{deviation.max():18.4f}{one.report['noise in the fault estimate'].value:22.2f}")  # fmt: skip

# %% [markdown]
# With the printed gains and $G = I$, then with the printed $G$: six times faster at the first fault, ten times noisier.

# %%
figure, axes = plt.subplots(2, 2, sharex=True, sharey=True, layout="constrained", figsize=(10.0, 4.6))
for column, label in enumerate(("printed gains", "printed gains, printed G")):
    noisy = estimate(designs[label].observer, run.outputs + noise)
    plot_faults(noisy, faults=faults, dt=step, axes=axes[:, column])
    axes[0, column].set_title(label, pad=18)

# %% [markdown]
# Our own designs need no $G$: the decay rate does the same, with a proof.

# %%
figure, axes = plt.subplots(2, 2, sharex=True, sharey=True, layout="constrained", figsize=(10.0, 4.6))
for column, label in enumerate(("ours", "ours, decay 2")):
    noisy = estimate(designs[label].observer, run.outputs + noise)
    plot_faults(noisy, faults=faults, dt=step, axes=axes[:, column])
    axes[0, column].set_title(label, pad=18)

# %% [markdown]
# Without noise, every design ends at the true faults: $G$ does not set their size.

# %%
for label, one in designs.items():
    last = estimate(one.observer, run.outputs).faults[[6_999, 13_999]]
    print(f"{label:26} fault 1 at 70 s {last[0]}   fault 2 at 140 s {last[1]}")
    assert np.max(np.abs(last - np.eye(2))) < 1e-3

# %% [markdown]
# ## 9. A G that was not designed for
#
# That the printed $G$ keeps the printed loop stable is luck. With other gains from the same theorems it does not, and
# putting it there is refused. Given as `adaptation_gain` the design is for it; `adaptation_range` gives one design for
# every $gI$ in a range, proved at both ends.

# %%
other = obsynth.pd_observer(plant, theorem=2, delta=0.01, decay=0)
print(f"G = I: slowest {other.report['error system'].value:.3f}")
try:
    obsynth.apply_adaptation_gain(other, G)
except obsynth.VerificationError as error:
    print(error)

# %%
for label, option in {"designed for G": {"adaptation_gain": G}, "for 1 to 12": {"adaptation_range": [1, 12]}}.items():
    found = obsynth.pd_observer(plant, delta=0.1, decay=0, **option)
    print(f"{label:15} slowest {found.report['error system'].value:.3f}, proved: {found.report.passed}")

# %% [markdown]
# ## 10. What is impossible, explained
#
# A zero at $s = 0$ from a fault to the outputs: the speed of a mass on a spring does not show a constant force.

# %%
spring = obsynth.DescriptorSystem(None, [[0, 1], [-1, -0.5]], C=[[0, 1]], Bf=[[0], [1]], fault_names=["force"])
try:
    obsynth.pd_observer(spring)
except obsynth.PreconditionError as error:
    print(error)

# %%
plt.close("all")
