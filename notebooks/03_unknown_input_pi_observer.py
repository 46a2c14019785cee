# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # An unknown-input PI observer: the paper's pair, and what it is worth
#
# Share Pasand, Aliyari and Taghirad estimate faults of the descriptor plant
#
# $$E\dot x = A x + B u + B_f f + B_d d, \qquad y = C x$$
#
# whatever the unknown input $d$ does: the fault gets a model (a ramp, say), becomes part of the state, and an
# unknown-input observer estimates both. `obsynth.conditions.sharepasand` has the decoupling as data, and the gain as a
# problem of cvxpy.

# %%
import cvxpy as cp
import matplotlib.pyplot as plt
import numpy as np
from scipy.linalg import block_diag, eigvals, expm

import obsynth

np.set_printoptions(precision=4, suppress=True)

# %%
spec = obsynth.load_spec("../designs/sharepasand/spec.yaml")
plant, options = spec.plant, spec.options
given = {name: options[name] for name in ("E_sharp", "C_sharp", "G")}  # the paper's choice in (10), (11)
wanted = [-2, -3, -4, -5, -6]
paper = obsynth.conditions.sharepasand(plant, fault_model="ramp", poles=wanted, **given)
for solver in ("CLARABEL", "SCS"):
    paper.problem.solve(solver=solver)
    gains = paper.gains()
    print(f"{solver:9} {paper.problem.status}: poles {np.sort(np.linalg.eigvals(gains['Ahat']).real)}")
U, D = gains["U"], gains["D"]
print(f"U =\n{U}\nDhat =\n{D}\nHhat = {(U @ plant.Bf).ravel()}")

# %% [markdown]
# $U$, $\hat D$, $\hat H$ are the printed ones: $U B_d = 0$ and $U E + \hat D C = I$, so that the unknown input is gone
# from $\frac{d}{dt}(U E x) = U A x + U B u + U B_f f$. Of the printed $\hat A$ four entries have lost their decimal
# point; with them put back its poles are -10, -20, -30, for the states alone. The paper prints no $F$, and no $F$ makes
# all five poles with that $K$ faster than -1.86.

# %%
E, A, B, C, Bf, Bd = plant.E, plant.A, plant.B, plant.C, plant.Bf, plant.Bd
assert np.array_equal(U @ Bd, np.zeros((3, 1)))
assert np.array_equal(U @ E + D @ C, np.eye(3))
literal = np.array([[-20023, 0.354, 0], [0.939, -39977, -0.5], [-24452, 599736, 0]])
restored = np.array([[-20.023, 0.354, 0], [0.939, -39.977, -0.5], [-24.452, 599.736, 0]])
for name, matrix in (("as printed", literal), ("decimal points restored", restored)):
    K = ((U @ A - matrix) @ np.linalg.pinv(C)).round(3)
    print(f"{name:24} poles {np.linalg.eigvals(matrix)}")
print(f"K = \n{K}")

# %% [markdown]
# ## 1. Feasibility against the region
#
# Instead of poles, a region: $P(U_aA_a) - YC_a$ with $Y = PK_a$ makes a half-plane, a disk or a sector a linear matrix
# inequality. For this pair every region is feasible; what it costs is the gain, and with it the noise. How large $K_a$
# must be for a decay rate, and with a damping besides:

# %%
rates = [0.25, 0.5, 1.0, 2.0]
figure, axes = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
for damping, style in ((None, "k-o"), (0.8, "b--s")):
    sizes = []
    for rate in rates:
        region = obsynth.conditions.half_plane(rate) & obsynth.conditions.disk(0.0, 20.0)
        region = region if damping is None else region & obsynth.conditions.sector(damping)
        one = obsynth.conditions.sharepasand(plant, fault_model="ramp", region=region)
        one.problem.solve(solver="SCS", eps_abs=1e-5, eps_rel=1e-5)
        sizes.append(np.linalg.norm(one.gains()["K_a"], 2))
        assert region.margins(np.linalg.eigvals(one.gains()["Ahat"])).min() > -1e-2
    axes.semilogy(rates, sizes, style, label="no damping asked" if damping is None else f"damping {damping}")
axes.set(xlabel="decay rate asked for (1/s)", ylabel="norm of K_a")
axes.legend()
plt.show()

# %% [markdown]
# Where it ends: not at a region, but at a fault model. An exponential fault $e^{t/2}$ and an unknown input can mask
# each other, which Theorem 2 of the paper does not see: its test has no column for $B_d$. The solver says infeasible
# for any region, and `existence` says why.

# %%
lost = obsynth.conditions.sharepasand(plant, fault_model={"exponential": 0.5})
lost = lost.changed(constraints=[cp.trace(lost.variables["P"]) <= 1e6])
lost.problem.solve(solver="CLARABEL")
print(lost.problem.status)
for row in lost.existence.checks:
    print(f"{row.name:34s} {'holds' if row.passed else 'FAILS'}  {row.detail}")

# %% [markdown]
# What decides is on the plant's own data: a rank (D1), the zeros from $d$ to $y$ (D2), and, exactly at each unstable
# eigenvalue of the fault model, whether fault and unknown input can mask each other (D3). Theorems 1, 2 and Lemma 6 of
# the paper are false as printed; `docs/papers.md` has the counterexamples.
#
# ## 2. Poles
#
# $\hat A = U_a A_a - K_a C_a$ can have any poles here. A pole may be asked for as often as one likes: five times $-4$
# needs one Jordan chain of length five, which the placement routines of scipy and python-control refuse.

# %%
five = obsynth.conditions.sharepasand(plant, fault_model="ramp", poles=[-4.0] * 5, **given)
five.problem.solve(solver="CLARABEL")
print("five times -4: characteristic polynomial", np.poly(five.gains()["Ahat"]))
print("norm of K_a for -2 ... -6:", np.linalg.norm(gains["K_a"], 2))

# %% [markdown]
# ## 3. One's own constraints
#
# The front door takes a region, constraints on the variables, and any solver of cvxpy for semidefinite programmes.

# %%
region = obsynth.conditions.half_plane(1.0) & obsynth.conditions.disk(0.0, 10.0)
one = obsynth.ui_pi_observer(plant, fault_model="ramp", region=region, constraints=lambda v: [cp.norm(v["Y"]) <= 2000])
print(np.linalg.eigvals(one.observer.Az), "proved:", one.report.passed)

# %% [markdown]
# ## 4. The same in one call
#
# The design comes with a report: identities, a proof of stability, decoupling measured from the plant, and limits.

# %%
design = obsynth.ui_pi_observer(plant, **options)
assert np.allclose(design.gains["U"], U, atol=1e-14)
assert design.report.passed
for check in design.report.checks:
    if check.kind in ("equality", "proved", "computed"):
        print(f"{check.name:28s} {check.value:12.4g}  (bound {check.bound:.3g}, {check.kind})")

# %% [markdown]
# ## 5. A ramp fault under a ramp plus a sine
#
# The plant has index 1: $x_2$ jumps with $f$ and $d$. Eliminating the algebraic state leaves an ordinary system; no
# input is differentiated. Plant, observer and the generators of $f$ and $d$ together are one autonomous linear system,
# so its matrix exponential is exact.


# %%
def run(design, fault, disturbance, start_fault, start_disturbance, *, end=20.0, step=0.01, onset=5.0):
    """Return time, fault and its estimate; the fault's generator is switched on at ``onset``."""
    observer, smooth = design.observer, obsynth.eliminate_algebraic_states(plant).plant
    nx, nz, nf = smooth.nx, observer.order, len(fault[0])
    f_row, d_row = fault[1], disturbance[1]
    zero = np.zeros
    y = np.hstack([smooth.C, zero((2, nz)), smooth.Df @ f_row, smooth.Dd @ d_row, smooth.D])
    top = np.hstack([smooth.A, zero((nx, nz)), smooth.Bf @ f_row, smooth.Bd @ d_row, smooth.B])
    middle = observer.By @ y
    middle[:, nx : nx + nz] += observer.Az
    middle[:, -1:] += observer.Bu
    rest = block_diag(fault[0], disturbance[0], [[0.0]])
    whole = np.vstack([top, middle, np.hstack([zero((len(rest), nx + nz)), rest])])
    estimate = observer.Dy @ y
    estimate[:, nx : nx + nz] += observer.Cz
    transition = expm(step * whole)
    state = np.concatenate([[0.5, -0.2], zero(nz), zero(nf), start_disturbance, [1.0]])
    time, rows = np.arange(0.0, end, step), []
    for t in time:
        if abs(t - onset) < step / 2:
            state[nx + nz : nx + nz + nf] = start_fault
        rows.append(state.copy())
        state = transition @ state
    rows = np.array(rows)
    return time, rows[:, nx + nz : nx + nz + nf] @ f_row[0], (rows @ estimate[observer.fault_rows][0])


ramp_course = (np.array([[0.0, 1], [0, 0]]), np.array([[1.0, 0]]))


def sine_course(frequency):
    return np.array([[0.0, frequency], [-frequency, 0.0]]), np.array([[1.0, 0.0]])


loud = (block_diag(ramp_course[0], sine_course(3.0)[0]), np.array([[0.5, 0.0, 2.0, 0.0]]))
loud_start = [0.0, 1.0, 0.0, 1.0]

time, fault, estimate = run(design, ramp_course, loud, [0.0, 1.0], loud_start)
_, _, calm = run(design, ramp_course, loud, [0.0, 1.0], np.zeros(4))
assert np.max(np.abs(estimate - calm)) < 1e-5  # the disturbance plays no role
fig, axes = plt.subplots(figsize=(7.5, 3.2))
axes.plot(time, fault, color="0.72", linewidth=4, label="fault")
axes.plot(time, estimate, "k--", linewidth=1.1, label="estimate")
axes.set(xlabel="time (s)", ylabel="fault", ylim=(-6, 16))
axes.legend()
fig.tight_layout()

# %% [markdown]
# At first the estimate goes the wrong way. No gain can help that: $(f, d) \to y$ has a zero at $+1/2$, so that
# $\hat f / f = T$ has $T(1/2) = 0$ for every stable decoupled observer. The report says what it costs.

# %%
system = np.block([[A, np.hstack([Bf, Bd])], [C, np.zeros((2, 2))]])
values = eigvals(system, block_diag(E, np.zeros((2, 2))))
print("zero of (f, d) -> y:", values[np.isfinite(values) & (np.abs(values) < 1e6)].real)
print(design.report["limit at 0.5"].detail)

# %% [markdown]
# ## 6. What the order of the model does
#
# A step model on a ramp ends with a constant error, which the report predicts; higher orders follow, and pay in noise.

# %%
fig, axes = plt.subplots(figsize=(7.5, 3.2))
axes.plot(time, fault, color="0.72", linewidth=4, label="fault")
for model, style in (("step", "b:"), ("ramp", "k--"), ("parabola", "r-.")):
    count = 3 + obsynth.fault_model(model).order
    each = obsynth.ui_pi_observer(plant, fault_model=model, poles=[-2 - k for k in range(count)])
    _, _, estimate = run(each, ramp_course, loud, [0.0, 1.0], loud_start)
    noise = each.certificate.claims["noise_amplification"]
    error = each.report["steady error[fault]"]
    print(f"{model:9s} error at 20 s {estimate[-1] - fault[-1]:9.5f}, noise amplification {noise:8.1f}")
    print(f"{'':9s} predicted: {error.value:.5f} when {error.claim.split('when ')[1]}")
    axes.plot(time, estimate, style, linewidth=1.2, label=f"{model} model")
axes.set(xlabel="time (s)", ylabel="fault", ylim=(-16, 16))
axes.legend()
fig.tight_layout()

# %% [markdown]
# ## 7. A sinusoidal fault
#
# To a ramp model a sinusoid is something else: its amplitude in the estimate means nothing (the paper says "a fine
# indicative of fault occurrence"). `fault_response` is $\hat f/f$. With a sinusoidal model of the right frequency the
# estimate is exact.

# %%
frequencies = np.geomspace(0.02, 20.0, 300)
matched = obsynth.ui_pi_observer(plant, fault_model={"sinusoid": 1.0}, poles=wanted)
fig, (left, right) = plt.subplots(1, 2, figsize=(7.5, 3.2))
for each, style, label in ((design, "k--", "ramp model"), (matched, "b-", "sinusoid, 1 rad/s")):
    left.loglog(frequencies, np.abs(obsynth.fault_response(each, frequencies)[:, 0, 0]), style, label=label)
left.axhline(1.0, color="0.72", linewidth=1)
left.set(xlabel="frequency (rad/s)", ylabel="|fhat / f|")
left.legend(fontsize=8)
for each, style in ((design, "k--"), (matched, "b-")):
    time, fault, estimate = run(each, sine_course(1.0), loud, [0.0, 1.0], loud_start)
    right.plot(time, estimate, style, linewidth=1.1)
right.plot(time, fault, color="0.72", linewidth=4, zorder=0)
right.set(xlabel="time (s)", ylabel="fault (grey) and estimates")
fig.tight_layout()
print("at 1 rad/s:", [complex(np.round(obsynth.fault_response(each, [1.0])[0, 0, 0], 6)) for each in (design, matched)])
print("error of the matched model at 20 s:", f"{estimate[-1] - fault[-1]:.1e}")

# %% [markdown]
# ## 8. A plant of your own
#
# An oven: heater, air and wall store heat, the surface of the heater stores none, so its balance is algebraic. The
# heater may lose power. Nobody measures the temperature of the room, and no estimate shall show it.

# %%
oven = obsynth.DescriptorSystem(
    E=np.diag([500.0, 1500.0, 9000.0, 0.0]),  # J/K
    A=[[-10, 0, 0, 10], [0, -5, 2, 3], [0, 2, -4, 1], [10, 3, 1, -14]],  # W/K
    B=[[1], [0], [0], [0]],
    C=["heater", "air", "wall"],
    Bf=[[-1], [0], [0], [0]],
    Bd=[[0], [0], [1], [0]],
    state_names=["heater", "air", "wall", "surface"],
    input_names=["power"],
    fault_names=["lost power"],
    disturbance_names=["room"],
    sensor_noise={"heater": 0.1, "air": 0.1, "wall": 0.1},
    units={"lost power": "W"},
)
own = obsynth.ui_pi_observer(obsynth.discretise(oven, 10.0), fault_model="step")
print(own)

# %%
happens = obsynth.Scenario(
    horizon=3600,
    faults={"lost power": obsynth.Step(size=60, start=1200)},
    disturbances={"room": obsynth.Sine(amplitude=4, frequency=0.002)},
    noise=1,
)
obsynth.plotting.plot_simulation(obsynth.simulate(own, happens))
plt.show()

# %% [markdown]
# ## 9. Without any numbers
#
# Without poles the toolbox takes the fastest Kalman gain, up to the median speed of the plant's own modes, that costs
# at most ten times the noise of the quietest one.

# %%
default = obsynth.ui_pi_observer(plant, fault_model="ramp")
for name, value in default.certificate.claims.items():
    print(f"{name:20s} {value:.3f}")
assert default.report.passed
