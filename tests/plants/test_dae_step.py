"""The implicit step: against closed forms, finite differences at steps other than one second, and hard inputs."""

from __future__ import annotations

import numpy as np
import pytest
from dae_plants import ROD, diode, exchanger, pendulum

from obsynth import DAEModel, SolverError, SpecError
from obsynth.plants.dae_functions import DAEFunctions
from obsynth.plants.implicit_step import ImplicitStep

METHODS = ("backward-euler", "radau")


def decay() -> DAEModel:
    return DAEModel({"decay": "der(a) = -r * a"}, {"seen": "a"}, states={"a": 1.0}, parameters={"r": 2.0},
                    units=dict.fromkeys(["a", "r", "seen"], "1"))  # fmt: skip


@pytest.mark.parametrize(
    ("method", "expected"),
    [("backward-euler", lambda z: 1 / (1 + z)),
     ("radau", lambda z: (1 - 2 * z / 5 + z**2 / 20) / (1 + 3 * z / 5 + 3 * z**2 / 20 + z**3 / 60))],
)  # fmt: skip
def test_the_stability_functions_are_those_of_the_methods(method, expected) -> None:
    step = ImplicitStep(DAEFunctions(decay(), method), 0.3)
    found = step.solve(np.array([1.5]), np.zeros(0), np.array([2.0])).x[0]
    assert found == pytest.approx(1.5 * expected(0.6), rel=1e-14)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dt", [0.01, 0.37, 10.0])
def test_sensitivities_equal_finite_differences(method, dt) -> None:
    """Central differences of converged steps; a lost dt would show at these steps."""
    model = exchanger()
    step = ImplicitStep(DAEFunctions(model, method), dt)
    u, theta = model.nominal_input * [1.05, 1.0, 1.0, 0.98], np.array([0.9, 500.0])
    x = step.solve(model.nominal_state, u, theta).x
    F, G, _ = step.sensitivities(step.solve(x, u, theta), x, u, theta)
    steps = 1e-5 * np.concatenate([model.state_scales, [1.0, 1e3]])
    ends = model.state_scales
    for j, size in enumerate(steps):
        moved = np.zeros(6)
        moved[j] = size
        sides = [step.solve(x + s * moved[:4], u, theta + s * moved[4:]).x for s in (1.0, -1.0)]
        slope = (sides[0] - sides[1]) / (2 * size) / ends * (steps[j] / 1e-5)
        exact = np.hstack([F, G])[:, j] / ends * (steps[j] / 1e-5)
        assert np.abs(slope - exact).max() < 1e-8


def test_noise_gain_equals_finite_differences_in_the_equations() -> None:
    model = exchanger()
    step = ImplicitStep(DAEFunctions(model), 0.37)
    u, theta, x = model.nominal_input, model.nominal_parameters, model.nominal_state
    _, _, noise = step.sensitivities(step.solve(x, u, theta), x, u, theta)
    equations = dict(model.equations)
    # 0.5 W on the right side of the energy balance.
    moved = model.replace(equations={**equations, "energy": equations["energy"] + " + 0.5"})
    sides = [ImplicitStep(DAEFunctions(m), 0.37).solve(x, u, theta).x for m in (moved, model)]
    assert (sides[0] - sides[1]) / 0.5 == pytest.approx(noise[:, 1], rel=1e-6)


@pytest.mark.parametrize("volts", [5.0, 60.0, 300.0])
def test_a_diode_takes_large_steps_of_its_source(volts) -> None:
    model = diode()
    step = ImplicitStep(DAEFunctions(model), 1e-3)
    x = step.solve(np.array([0.0, 0.0]), np.array([0.0]), model.nominal_parameters).x
    found = step.solve(x, np.array([volts]), model.nominal_parameters, before=np.array([0.0]))
    v, c = found.x
    assert (volts - v - c) / 10.0 == pytest.approx(1e-12 * np.expm1(v / 0.02585), rel=1e-8)
    assert found.residual < 1e-12


def test_where_damped_newton_gives_up_the_homotopy_goes_on() -> None:
    """A knee ten times as sharp: 25 iterations are not enough at once, and the input's last value is the way out."""
    model = diode()
    sharp = model.replace(constants={**model.constants, "VT": 0.002})
    step, theta = ImplicitStep(DAEFunctions(sharp), 1e-3), model.nominal_parameters
    x = step.solve(np.zeros(2), np.zeros(1), theta).x
    with pytest.raises(SolverError, match="No solution"):
        step.solve(x, np.array([300.0]), theta)
    found = step.solve(x, np.array([300.0]), theta, before=np.zeros(1))
    v, c = found.x
    assert found.subsolves > 1
    assert (300.0 - v - c) / 10.0 == pytest.approx(1e-12 * np.expm1(v / 0.002), rel=1e-6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("far", [1.0, 1e3, 1e7])
def test_the_careful_step_is_the_quick_one_bit_for_bit(method, far) -> None:
    """Where rounding decides whether a step is solved, both decide alike, and so does C, which has this function."""
    model = exchanger()
    rng, step = np.random.default_rng(3), ImplicitStep(DAEFunctions(model, method), 0.37)
    u, theta = model.nominal_input, np.array([0.9, 500.0])
    trusted = 0
    for _ in range(20):
        x = model.nominal_state + far * model.state_scales * rng.standard_normal(model.nx)
        stages, _, is_trusted = step._fast(x, u, theta)
        if is_trusted[0, 0] == 1.0:
            trusted += 1
            assert (step.solve_carefully(x, u, theta).stages == stages[:, 0]).all()
    assert trusted > 0 or far > 1e6


def cubic() -> DAEModel:
    """z^3 - z = u: three roots for small u."""
    return DAEModel({"moves": "der(a) = -a * k", "fold": "z ** 3 - z = u"}, {"seen": "z"},
                    states={"a": 1.0, "z": -1.0}, inputs={"u": 0.0}, parameters={"k": 1.0},
                    units=dict.fromkeys(["a", "z", "u", "k", "seen"], "1"))  # fmt: skip


def test_of_several_roots_the_connected_one_is_taken() -> None:
    """From z = 0.5 plain Newton lands on another branch; a homotopy in the input stays on its own."""
    start, theta = np.array([1.0, 0.5]), np.array([1.0])
    before, after = np.array([0.5**3 - 0.5]), np.array([0.37])
    left, middle, _ = sorted(np.roots([1.0, 0.0, -1.0, -0.37]).real)
    far = ImplicitStep(DAEFunctions(cubic()), 1.0).solve(start, after, theta, before=before)
    near = ImplicitStep(DAEFunctions(cubic()), 1.0, largest_move=0.6).solve(start, after, theta, before=before)
    assert far.x[1] == pytest.approx(left, abs=1e-12)
    assert near.x[1] == pytest.approx(middle, abs=1e-12)
    assert near.subsolves > 1


def test_no_solution_names_k_iteration_and_equation() -> None:
    model = DAEModel({"moves": "der(a) = -a * k", "square": "z ** 2 = u"}, {"seen": "z"},
                     states={"a": 1.0, "z": 1.0}, inputs={"u": 1.0}, parameters={"k": 1.0},
                     units=dict.fromkeys(["a", "z", "u", "k", "seen"], "1"))  # fmt: skip
    step = ImplicitStep(DAEFunctions(model), 1.0)
    with pytest.raises(SolverError, match=r"No solution at k = 17.*iteration.*'square'") as caught:
        step.solve(np.ones(2), np.array([-1.0]), np.ones(1), before=np.array([1.0]), k=17)
    assert caught.value.record["k"] == 17
    assert caught.value.record["equation"] == "square"


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(SpecError, match="backward-euler, radau"):
        DAEFunctions(decay(), "euler")


def test_radau_keeps_the_energy_that_backward_euler_loses() -> None:
    """A pendulum without friction: after 200 steps of 0.01 s radau has its energy to 1e-7, backward Euler has not."""
    model = pendulum(ROD[1])
    lost = {}
    for method in METHODS:
        step = ImplicitStep(DAEFunctions(model, method), 0.01)
        x = np.array(model.nominal_state)
        energy = [0.5 * (x[2] ** 2 + x[3] ** 2) + 9.81 * x[1]]
        for _ in range(200):
            x = step.solve(x, np.zeros(0), np.zeros(1)).x
        energy.append(0.5 * (x[2] ** 2 + x[3] ** 2) + 9.81 * x[1])
        lost[method] = energy[0] - energy[1]
    assert abs(lost["radau"]) < 1e-7
    assert abs(lost["backward-euler"]) > 1e-2


def test_a_conservative_balance_keeps_its_mass_exactly() -> None:
    """Closed vessel, volume jumping at random: mass does not drift, and does with p' V + p V'."""
    units = dict.fromkeys(["p", "V", "place", "k", "seen"], "1")
    kept = DAEModel({"mass": "der(p * V) = 0", "volume": "V = place * k"}, {"seen": "p"},
                    states={"p": 3.0, "V": 3.0}, inputs={"place": 3.0}, parameters={"k": 1.0}, units=units)  # fmt: skip
    lossy = kept.replace(equations={"mass": "der(p) * V + p * der(V) = 0", "volume": "V = place * k"})
    rng = np.random.default_rng(3)
    places = 3.0 + 0.03 * rng.standard_normal(1000)
    drift = {}
    for name, model in (("kept", kept), ("lossy", lossy)):
        step, x = ImplicitStep(DAEFunctions(model), 1.0), np.array([3.0, 3.0])
        for place in places:
            x = step.solve(x, np.array([place]), np.ones(1)).x
        drift[name] = abs(x[0] * x[1] / 9.0 - 1.0)
    assert drift["kept"] < 1e-12
    assert drift["lossy"] > 1e-2
