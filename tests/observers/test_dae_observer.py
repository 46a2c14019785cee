"""The observer of a DAE: the identity of its errors, the Kalman filter it equals, gaps, bounds and honest spreads."""

from __future__ import annotations

import dataclasses
import pickle
import re
from functools import cache

import numpy as np
import pytest
from dae_plants import exchanger, linear

import obsynth
from obsynth import (
    DAEModel,
    DAEObserver,
    SolverError,
    SpecError,
    VerificationError,
    dae_adaptive_observer,
    run_batch,
    simulate_dae,
    verify,
)
from obsynth.numerics.arrays import read_only
from obsynth.plants.dae_functions import DAEFunctions
from obsynth.plants.implicit_step import ImplicitStep
from obsynth.types import Estimates

BALANCES = [(2e-4) ** 2, 75.0**2, 38.0**2, 0.0]  # 0.1 % of the flow, 0.5 % of the heat


def part(running, name):
    """What a running observer remembers under a name."""
    return running.observer.steps.part(running.state, name)


@cache
def shipped_observer() -> DAEObserver:
    return made(exchanger())


def observer(model=None, **changes) -> DAEObserver:
    """That of the heat exchanger, one for all, as its functions and its C are compiled once; or another one."""
    return shipped_observer() if model is None and not changes else made(model or exchanger(), **changes)


def made(model: DAEModel, **changes) -> DAEObserver:
    fields = {
        "model": model, "dt": 1.0, "Q": np.diag(BALANCES), "R": np.diag([1e4, 0.25]),
        "initial_state": model.nominal_state, "initial_covariance": np.diag([4e6, 4e6, 25.0, 25.0]),
        "initial_parameters": model.nominal_parameters, "initial_parameter_covariance": np.diag([1e-2, 1e6]),
        "random_walk": np.zeros((2, 2)), "lower": np.full(2, -np.inf), "upper": np.full(2, np.inf),
    }  # fmt: skip
    return DAEObserver(**{**fields, **changes})


def steady() -> np.ndarray:
    model = exchanger()
    step, x = ImplicitStep(DAEFunctions(model), 1000.0), model.nominal_state
    for _ in range(50):
        x = step.solve(x, model.nominal_input, model.nominal_parameters).x
    return x


def matrices(seed: int = 5, n: int = 4, q: int = 2, p: int = 2) -> dict[str, np.ndarray]:
    """A singular E: the last equation is algebraic."""
    rng = np.random.default_rng(seed)
    A = 0.3 * rng.standard_normal((n, n)) - np.eye(n)
    E = np.eye(n) + 0.1 * rng.standard_normal((n, n))
    E[-1] = 0.0
    return {"E": E, "A": A, "B": rng.standard_normal((n, 1)), "G": rng.standard_normal((n, q)),
            "C": rng.standard_normal((p, n)), "D": rng.standard_normal((p, q))}  # fmt: skip


def linear_observer(**changes) -> DAEObserver:
    model = linear(matrices())
    fields = {"Q": 0.01 * np.eye(4), "R": 0.04 * np.eye(2), "initial_covariance": np.eye(4), "dt": 0.25,
              "initial_parameter_covariance": np.eye(2)}  # fmt: skip
    return observer(model, **{**fields, **changes})


def drive(samples: int) -> np.ndarray:
    k = np.arange(samples)
    return np.column_stack([np.sin(0.3 * k), np.cos(0.11 * k)])


@pytest.mark.parametrize("weight", ["innovation", "paper"])
def test_what_the_parameters_do_not_explain_decays_by_itself(weight) -> None:
    """z_k = F (I - K H) z_{k-1} for z = x - x^ - Upsilon (theta - theta^); every wrong order violates it."""
    plant = linear_observer(forgetting=0.95, guard="none", weight=weight)
    step = ImplicitStep(DAEFunctions(plant.model), plant.dt)
    theta, u, x = np.array([0.7, -1.3]), drive(300), np.array([1.0, -1.0, 0.5, 0.2])
    x = step.solve(x, u[0], theta).x
    running, before, worst, factor = plant.start(), None, 0.0, None
    for k in range(300):
        if k:
            x = step.solve(x, u[k], theta).x
        y = step.functions.outputs(x, theta)[0]
        kept = np.eye(4) - part(running, "K") @ running.observer.steps.part(running.state, "H")
        row = running.raw_step(y, u[k])
        z = x - part(running, "x") - part(running, "Upsilon") @ (theta - part(running, "theta"))
        if before is not None:
            factor = row.part("F") @ kept
            worst = max(worst, np.abs(z - factor @ before).max())
        before = z
    assert worst < 1e-13
    assert np.abs(factor).max() > 1e-3
    assert part(running, "theta") == pytest.approx(theta, abs=1e-6)


@cache
def record(samples: int = 200, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    model, rng = exchanger(), np.random.default_rng(seed)
    u = np.tile(model.nominal_input, (samples, 1))
    u[:, 0] *= 1.0 + 0.01 * rng.standard_normal(samples)
    faults = np.column_stack([np.where(np.arange(samples) > 60, 0.9, 1.0), np.where(np.arange(samples) > 90, 2e3, 0.0)])
    found = simulate_dae(model, u, dt=1.0, parameters=faults, Q=np.diag(BALANCES), R=np.diag([1e4, 0.25]), seed=seed)
    return read_only(found.outputs), read_only(u)


def test_without_forgetting_it_is_the_augmented_kalman_filter() -> None:
    y, u = record()
    found = [observer(form=form, forgetting=1.0).run(y, u) for form in ("forgetting", "augmented-kalman")]
    scales = np.array([2e3, 2e3, 5.0, 5.0, 0.1, 1e3])  # the standard deviations at the start
    joined = [np.hstack([each.states, each.parameters]) for each in found]
    assert np.abs((joined[0] - joined[1]) / scales).max() < 1e-12
    spreads = [np.hstack([each.state_deviations, each.parameter_deviations]) for each in found]
    assert spreads[0] == pytest.approx(spreads[1], rel=1e-7)
    assert found[0].nis == pytest.approx(found[1].nis, rel=1e-7)


def test_with_r_in_the_gain_it_is_not() -> None:
    y, u = record()
    kalman = observer(form="augmented-kalman").run(y, u)
    paper = observer(forgetting=1.0, weight="paper").run(y, u)
    assert np.abs((paper.parameters - kalman.parameters) / [0.1, 1e3]).max() > 0.01


def test_the_linear_one_is_too() -> None:
    rng = np.random.default_rng(2)
    y, u = rng.standard_normal((100, 2)), drive(100)
    found = [linear_observer(form=form, forgetting=1.0).run(y, u) for form in ("forgetting", "augmented-kalman")]
    assert found[0].states == pytest.approx(found[1].states, abs=1e-12)
    assert found[0].parameters == pytest.approx(found[1].parameters, abs=1e-12)


@pytest.mark.parametrize("form", ["forgetting", "random-walk", "augmented-kalman"])
def test_every_form_tracks_both_faults(form) -> None:
    y, u = record(samples=300)
    walk = {} if form == "forgetting" else {"random_walk": np.diag([1e-6, 900.0])}
    found = observer(form=form, forgetting=0.95, **walk).run(y, u)
    assert found.parameters[-50:].mean(axis=0) == pytest.approx([0.9, 2e3], abs=150.0)
    assert found.parameters[-50:, 0].mean() == pytest.approx(0.9, abs=0.01)
    assert found.residuals.max() < 1e-9


@pytest.mark.parametrize("form", ["forgetting", "augmented-kalman"])
def test_sample_by_sample_is_the_whole_record(form) -> None:
    y, u = record(samples=60)
    shipped = observer(form=form, window=20)
    whole, running = shipped.run(y, u), shipped.start()
    rows = [running.step(y[k], u[k]) for k in range(60)]
    for name in ("states", "parameters", "nis", "excitation", "state_deviations"):
        assert np.concatenate([getattr(row, name) for row in rows]) == pytest.approx(getattr(whole, name), rel=1e-9)


def test_one_sample_says_all_that_a_record_says_at_it() -> None:
    y, u = record(30)
    y = np.array(y)
    y[7, 1] = np.nan
    whole, running = observer(window=5).run(y, u), observer(window=5).start()
    for k in range(len(y)):
        one = running.step(y[k], u[k])
        for field in dataclasses.fields(whole):
            own, other = getattr(one, field.name), getattr(whole, field.name)
            if field.name == "projection":
                assert np.array_equal(own, other if k == 0 else np.zeros(4))
            elif field.name.endswith(("_names", "_delays")) or field.name == "regressors":
                assert np.array_equal(own, other), field.name
            else:
                np.testing.assert_allclose(own[0], other[k], rtol=1e-9, atol=1e-12, err_msg=field.name)
                assert not own.flags.writeable
    copied = pickle.loads(pickle.dumps(one))
    assert type(copied) is Estimates
    assert np.array_equal(copied.parameters, one.parameters)
    with pytest.raises(AttributeError, match="'colour'"):
        one.colour  # noqa: B018


@pytest.mark.one_in(3)
@pytest.mark.parametrize("form", ["forgetting", "random-walk", "augmented-kalman"])
def test_the_spreads_are_honest(form) -> None:
    """40 runs with errors drawn from P_0 and S_0: squared errors in units of the covariance are one on average."""
    start, u = steady(), np.tile(exchanger().nominal_input, (80, 1))
    shipped = observer(
        form=form, forgetting=0.95, guard="none", initial_state=start,
        initial_parameter_covariance=np.diag([0.02**2, 500.0**2]),
    )  # fmt: skip
    outputs, thetas = [], []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        thetas.append(np.array([1.0, 0.0]) + rng.standard_normal(2) * [0.02, 500.0])
        off = start + rng.standard_normal(4) * [2e3, 2e3, 5.0, 5.0]
        truth = simulate_dae(shipped.model, u, dt=1.0, parameters=thetas[-1], initial_state=off, Q=shipped.Q,
                             R=shipped.R, seed=seed, integration="backward-euler")  # fmt: skip
        outputs.append(truth.outputs)
    found = run_batch(shipped, outputs, u)
    squares = []
    for i, theta in enumerate(thetas):
        for k in (40, 79):
            e = found.parameters[i, k] - theta
            squares.append(e @ np.linalg.solve(found.parameter_covariances[i, k], e) / 2)
    # 160 squares of standard normal numbers: the mean is one within 5 sqrt(2 / 160).
    assert abs(np.mean(squares) - 1.0) < 5 * np.sqrt(2 / 160)


def test_missing_channels_and_samples() -> None:
    y, u = record()
    y = np.array(y)
    y[50] = np.nan
    y[100:140, 0] = np.nan
    running = observer(guard="none").start()
    for k in range(200):
        before = part(running, "S").copy()
        row = running.raw_step(y[k], u[k])
        if k == 50:
            assert np.array_equal(part(running, "S"), before)
            assert row.degrees == 0
            assert row.nis == 0.0
        if k in (100, 139):
            assert row.degrees == 1
            assert np.isnan(row.innovation[0])
    assert np.isfinite(part(running, "posterior")).all()
    assert part(running, "theta") == pytest.approx([0.9, 2e3], abs=250.0)


def test_a_guard_bounds_s_where_excitation_ends() -> None:
    """Pressure alone, no excitation: without a guard S winds up, with it S stays below S_0."""
    units = {name: unit for name, unit in exchanger().units.items() if name != "temperature"}
    model = exchanger(outputs={"pressure": "p2 + psi"}, units=units)
    u = np.tile(model.nominal_input, (400, 1))
    y = simulate_dae(model, u, dt=1.0, R=[[1e4]], seed=4).outputs
    ends = {}
    for guard in ("none", "regularise"):
        running = observer(model, R=[[1e4]], guard=guard, forgetting=0.97).start()
        for k in range(400):
            running.raw_step(y[k], u[k])
        ends[guard] = np.linalg.eigvalsh(part(running, "S") / np.outer([0.1, 1e3], [0.1, 1e3]))[-1]
    assert ends["regularise"] <= 1.0 + 1e-9
    assert ends["none"] > 3.0


def test_bounds_hold() -> None:
    y, u = record()
    found = observer(lower=np.array([0.95, -np.inf]), upper=np.array([1.0, 1e3])).run(y, u)
    assert found.parameters[:, 0].min() == 0.95
    assert found.parameters[:, 0].max() <= 1.0
    assert found.parameters[:, 1].max() == 1e3


@pytest.mark.long
@pytest.mark.parametrize("bounds", [{"rate": [-np.inf, 0.9]}, [[-np.inf, 0.9]]])
def test_bounds_are_those_of_the_parameter_where_there_are_as_many_states(bounds) -> None:
    model = DAEModel(
        {"decay": "der(level) = 1 - rate * level"}, {"seen": "level"}, states={"level": 10.0},
        parameters={"rate": 0.5}, units={"level": "m", "rate": "1/s", "seen": "m"},
    )  # fmt: skip
    design = dae_adaptive_observer(model, dt=0.1, Q=1e-6, R=1e-4, bounds=bounds, initial_parameter_covariance=0.04)
    # The data ask for a rate of 2 1/s, and the level begins far above the bound.
    found = design.observer.run(0.5 + 9.5 * np.exp(-0.2 * np.arange(20))[:, None])
    assert (design.observer.lower.item(), design.observer.upper.item()) == (-np.inf, 0.9)
    assert found.parameters.max() == 0.9
    assert found.states[:5].min() > 3.0


def test_a_start_off_the_constraint_is_projected_and_said() -> None:
    y, u = record(samples=5)
    off = exchanger().nominal_state + np.array([2e4, 0.0, 0.0, 0.0])
    found = observer(initial_state=off).run(y, u)
    assert abs(found.projection[0]) > 1e3
    start = observer(initial_state=steady()).run(y, np.tile(exchanger().nominal_input, (5, 1)))
    assert np.array_equal(start.projection, np.zeros(4))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dt": 0.0}, "dt is 0"), ({"R": np.diag([1e4, 0.0])}, "R must be positive definite"),
        ({"Q": -np.eye(4)}, "Q is no covariance"), ({"Q": np.eye(3)}, "Q is"), ({"forgetting": 0.0}, "forgetting"),
        ({"form": "magic"}, "form is 'magic'"), ({"guard": "x"}, "guard"), ({"weight": "x"}, "weight"),
        ({"integration": "euler"}, "integration"), ({"window": 0}, "window"), ({"largest_move": 0.0}, "largest_move"),
        ({"upper": np.array([0.5, 1e3])}, "bounds"), ({"initial_state": np.zeros(3)}, "initial_state"),
    ],
)  # fmt: skip
def test_bad_options_are_named(changes, words) -> None:
    with pytest.raises(SpecError, match=words):
        observer(**changes)


def test_bad_records_are_named() -> None:
    y, u = record(samples=20)
    u = np.array(u)
    u[7, 1] = np.nan
    with pytest.raises(SpecError, match=r"'Tin' is nan at k = 7"):
        observer().run(y, u)
    with pytest.raises(SpecError, match="u has 19 samples"):
        observer().run(y, np.ones((19, 4)))
    running = observer().start()
    with pytest.raises(SpecError, match="at k = 0"):
        running.step(y[0], u[7])
    assert running.state.k == 0


def test_an_impossible_input_names_its_sample() -> None:
    y, u = record(samples=20)
    u = np.array(u)
    u[12, 3] = -1.0  # a valve open the wrong way sucks without end
    u[12, 0] = 1e3
    with pytest.raises(SolverError, match="k = 12"):
        observer().run(y, u)


def test_saved_as_data_it_is_the_same() -> None:
    y, u = record(samples=30)
    first = observer(integration="radau")
    second = DAEObserver.from_dict(first.as_dict())
    assert np.array_equal(first.run(y, u).states, second.run(y, u).states)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dt": -1.0}, "dt is -1.0: give the seconds"), ({"dt": "1"}, "dt is '1'"), ({"window": 2.5}, "window is 2.5"),
        ({"forgetting": "x"}, "forgetting is 'x'"), ({"largest_move": "x"}, "largest_move is 'x'"),
        ({"R": np.diag([1e4, 0.0])}, "variance of 'temperature' is 0"),
        ({"R": np.array([[1e4, 50.0], [50.0, 0.25]])}, "R must be positive definite, but it is singular"),
        ({"upper": np.array([0.5, 1e3])}, r"bounds\.phi: the lower bound \(-inf\).*upper one \(0.5\)"),
        ({"initial_state": np.array([np.nan, 1.0, 1.0, 1.0])}, r"initial_state\.p1 is nan"),
        ({"initial_state": np.ones(3)}, "4 finite number.*p1, p2, T1, T2"),
    ],
)  # fmt: skip
def test_bad_fields_are_named_with_their_signals(changes, words) -> None:
    with pytest.raises(SpecError, match=words):
        observer(**changes)


def test_units_do_not_decide_whether_a_covariance_is_definite() -> None:
    assert observer(initial_parameter_covariance=np.diag([1e-20, 1e14])).order == 6


def test_bad_arguments_of_a_run_are_named() -> None:
    y, u = record(samples=5)
    for options, words in (({"compiled": "x"}, "compiled is 'x'"), ({"progress": 3}, "progress is 3")):
        with pytest.raises(SpecError, match=words):
            observer().run(y, u, **options)
    with pytest.raises(SpecError, match="'m1' is nan at k = 0"):
        observer().start().step(y[0], [np.nan, 450.0, 15150.0, 1.0])
    with pytest.raises(SpecError, match="u must be 4 finite"):
        observer().start().step(y[0], ["x", 450.0, 15150.0, 1.0])


def test_an_observer_travels_to_another_process_after_it_has_run() -> None:
    shipped = observer()
    shipped.run(*record(samples=3))
    assert set(shipped.__getstate__()) == {field.name for field in dataclasses.fields(shipped)}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"dt": 0.0}, "dt is 0.0: give the seconds"), ({"parameters": [np.nan, 0.0]}, r"parameters\.phi is nan"),
        ({"parameters": np.ones((3, 2))}, r"parameters is \(3, 2\)"), ({"seed": -1}, "seed is -1"),
        ({"initial_state": ["a", 1, 1, 1]}, "initial_state is a list"), ({"Q": [[1.0]]}, "Q is 1 by 1"),
        ({"u": np.full((5, 4), np.nan)}, "'m1' is nan at k = 0"), ({"u": None}, "u is missing"),
        ({"integration": "rk4"}, "'rk4'"),
    ],
)  # fmt: skip
def test_bad_simulations_are_named(arguments, words) -> None:
    given = {"u": np.tile(exchanger().nominal_input, (5, 1)), "dt": 1.0, **arguments}
    with pytest.raises(SpecError, match=words):
        simulate_dae(exchanger(), given.pop("u"), **given)


def levitated() -> DAEModel:
    """Return a ball below a magnet, which falls or sticks at any constant voltage."""
    return DAEModel(
        {"place": "der(z) = v", "force": "m * (1 + load) * der(v) = m * (1 + load) * 9.81 - 5e-4 * i * i / (z * z)",
         "coil": "0.05 * der(i) = volt - 2 * i"},
        {"Z": "z", "I": "i"}, states={"z": 0.01, "v": 0.0, "i": 0.99}, inputs={"volt": 1.98}, parameters={"load": 0.0},
        constants={"m": 0.5},
    )  # fmt: skip


def filled() -> DAEModel:
    """Return a tank whose level a controller keeps: at constant flows it is empty after eight seconds."""
    return DAEModel(
        {"tank": "der(h) = feed * (1 - loss) - out - 0.02 * sqrt(h)"}, {"L": "h"}, states={"h": 1.0},
        inputs={"feed": 0.1, "out": 0.22}, parameters={"loss": 0.0},
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("model", "dt", "fewer"), [(levitated(), 0.002, False), (filled(), 1.0, True)])
def test_a_plant_that_only_a_controller_keeps_at_its_nominal_point_has_a_design(
    model: DAEModel, dt: float, fewer: bool
) -> None:
    """It was refused: at constant nominal inputs it comes to where its equations have no solution."""
    design = dae_adaptive_observer(
        model, dt=dt, Q={name: 1e-8 for name in model.equation_names}, R=np.diag([1e-8, 1e-4][: model.ny]),
        form="augmented-kalman", random_walk=[[1e-6]], initial_parameter_covariance=[[1e-3]],
        initial_covariance=np.diag([1e-6, 1e-2, 1e-2][: model.nx]),
    )  # fmt: skip
    steps = design.certificate.claims["steps"]
    told = [note for note in design.notes if f"over {steps:.0f} steps in place of 100" in note]
    assert (steps < 10.0, len(told)) == (fewer, int(fewer))
    assert verify(design).passed
    for name in ("NEES", "NIS"):
        (row,) = [check for check in design.report.checks if check.name == name]
        assert "runs of 40 steps" not in row.detail


def tank_with_overflow(deviation: float) -> object:
    """Its outflow is defined for levels from the bottom, 0 m, to the brim, 2 m."""
    model = DAEModel(
        {"balance": "der(h) = (1 - worn) * pump - sqrt(h) + 0.1 * sqrt(2 - h)"}, {"level": "h"}, states={"h": 1.0},
        inputs={"pump": 0.9}, parameters={"worn": 0.0},
    )  # fmt: skip
    return dae_adaptive_observer(
        model, dt=0.5, Q=1e-6, R=1e-4, form="augmented-kalman", random_walk=1e-8, initial_parameter_covariance=1e-4,
        initial_covariance=deviation**2,
    )  # fmt: skip


@pytest.mark.long
def test_starts_that_are_no_states_of_the_plant_are_drawn_again() -> None:
    """A level that is known to 0.6 m around 1 m: one start of ten is below the bottom or above the brim."""
    rows = {row.name: row for row in tank_with_overflow(0.6).report.checks}
    assert "starts that have no first step were drawn again: " in rows["NEES"].detail


def test_where_most_starts_are_no_states_it_says_so() -> None:
    """Known to 50 m around 1 m: 98 % of the starts are below the bottom or above the brim."""
    with pytest.raises(VerificationError, match=r"realisation fails: runs: No solution at k = 1: .*'balance'"):
        tank_with_overflow(50.0)


@pytest.mark.long
def test_a_reactor_that_may_run_away_is_designed() -> None:
    """It was refused: from some starts within the default deviations an exothermic reactor ignites, and the equations
    of a step have no solution then, in however few steps."""
    reactor = DAEModel(
        {
            "mass": "V * der(c) = q * (1 - c) - V * k0 * exp(-EoR / T) * c",
            "heat": "V * rho * cp * der(T) = q * rho * cp * (350 - T) + dH * V * k0 * exp(-EoR / T) * c "
            "+ UA * (Tc - T)",
        },
        {"T": "T"}, states={"c": 0.5, "T": 350.0}, inputs={"Tc": 300.0},
        constants={"V": 100, "q": 100, "k0": 7.2e10, "EoR": 8750, "rho": 1000, "cp": 0.239, "dH": 5e4, "UA": 5e4},
    )  # fmt: skip
    made = obsynth.extended_kalman(reactor, dt=0.05, Q={"mass": 1e-6, "heat": 1.0}, R={"T": 0.01})
    (row,) = [check for check in made.report.checks if check.name == "NEES"]
    assert re.search(r"starts that have no solution over [23] steps were drawn again: \d+", row.detail)


@pytest.mark.parametrize("form", ["random-walk", "augmented-kalman"])
def test_errors_decay_as_where_the_parameters_are_known_whatever_the_form(form: str) -> None:
    """A battery whose resistance may walk was refused in the form of one joint filter: the state's rows of its gain
    also make up for what it moves the resistance by, and have no decay of their own."""
    battery = DAEModel(
        {"charge": "7200 * der(s) = -current", "branch": "1000 * der(v) = current - 50 * v"},
        {"voltage": "3.2 + s - v - r * current"},
        states={"s": 0.8, "v": 0.0}, inputs={"current": 1.0}, parameters={"r": 0.05},
    )  # fmt: skip
    design = dae_adaptive_observer(
        battery, dt=1.0, Q={"charge": 1e-3, "branch": 1e-3}, R=1e-4, form=form, random_walk=1e-8,
        initial_parameter_covariance=1e-3,
    )  # fmt: skip
    # The filter of the states alone, written out; the last transition has the gain of the sample before it.
    F, H = np.diag([1.0, 1.0 / 1.05, 0.0]), np.array([[1.0, -1.0, -0.05]])
    noise, P = np.diag([1e-3 / 7200.0**2, 1e-3 / 1050.0**2, 0.0]), np.array(design.observer.initial_covariance)
    for _ in range(100):
        K = P @ H.T / (H @ P @ H.T + 1e-4)
        P = F @ (np.eye(3) - K @ H) @ P @ F.T + noise
    before = np.max(np.abs(np.linalg.eigvals(F @ (np.eye(3) - K @ H))))
    # In the form of two filters the walk of the resistance leaves some noise to the states.
    assert design.certificate.claims["contraction"] == pytest.approx(
        before, abs=3e-3 if form == "random-walk" else 1e-9
    )
    assert before < 0.99
