"""The engines of an observer of a DAE: stretches in CasADi, single steps, and C give the numbers of plain NumPy."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from dae_plants import diode, exchanger, linear
from test_dae_observer import BALANCES, drive, linear_observer, made, observer, record

import obsynth
from obsynth import DAEModel, DAEObserver, SolverError, SpecError, run_batch, simulate_dae
from obsynth.numerics.graph_equations import SMALL, solved
from obsynth.observers import batches as dae_batch
from obsynth.observers import progress
from obsynth.observers.nonlinear import c_code as dae_library
from obsynth.observers.nonlinear import observer as dae_records
from obsynth.plants.dae_functions import Compiled, DAEFunctions
from obsynth.plants.implicit_step import ImplicitStep

SIZES = np.array([2e3, 2e3, 5.0, 5.0, 0.1, 1e3])


@pytest.fixture(autouse=True)
def a_quick_compiler(monkeypatch) -> None:
    """Without optimisation, which takes most of the time; the test of the benchmark compiles with it."""
    monkeypatch.setattr(dae_library, "FLAGS", tuple("-O0" if flag == "-O2" else flag for flag in dae_library.FLAGS))


def by_hand(shipped: DAEObserver, y: np.ndarray, u: np.ndarray, moved: np.ndarray | float = 0.0) -> np.ndarray:
    """The audit's eleven steps as they are listed there, one after the other, in NumPy: states and parameters."""
    step = ImplicitStep(DAEFunctions(shipped.model, shipped.integration), shipped.dt)
    x, theta = shipped.initial_state + moved, np.array(shipped.initial_parameters)
    P, S, R, one = shipped.initial_covariance, shipped.initial_parameter_covariance, shipped.R, np.eye(len(x))
    Upsilon, rows = np.zeros((len(x), len(theta))), []
    h, H, L = step.functions.outputs(x, theta)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    for k in range(len(y)):
        if k:
            corrected = x + K @ (y[k - 1] - step.functions.outputs(x, theta)[0])  # 1
            solution = step.solve_carefully(corrected, u[k], theta)  # 2
            J, start, parameters = derivatives(step, solution.stages, corrected, u[k], theta)  # 3
            F, G, noise = (np.linalg.solve(J, right) for right in (-start, -parameters, one))
            P = F @ ((one - K @ H) @ P @ (one - K @ H).T + K @ R @ K.T) @ F.T + noise @ shipped.Q @ noise.T  # 4
            Upsilon = F @ (one - K @ H) @ Upsilon + G - F @ K @ L  # 5
            x = solution.x
            h, H, L = step.functions.outputs(x, theta)  # 6
            Omega, e = H @ Upsilon + L, y[k] - h
            Sigma = H @ P @ H.T + R  # 7
            weight = shipped.forgetting * (R if shipped.weight == "paper" else Sigma) + Omega @ S @ Omega.T
            Theta = S @ Omega.T @ np.linalg.inv(weight)
            S = (S - Theta @ Omega @ S) / shipped.forgetting  # 11
            x, theta = x + Upsilon @ Theta @ e, theta + Theta @ e  # 8, 9
            h, H, L = step.functions.outputs(x, theta)  # 10
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        rows.append(np.concatenate([x + K @ (y[k] - step.functions.outputs(x, theta)[0]), theta]))
    return np.array(rows)


def derivatives(step: ImplicitStep, *point: np.ndarray) -> tuple[np.ndarray, ...]:
    return Compiled(step.functions.derivative_function)(*point, np.array([step.dt]))


@pytest.mark.long
@pytest.mark.parametrize(("weight", "compiled"), [("innovation", None), ("innovation", True), ("paper", None)])
def test_the_numbers_are_those_of_the_audits_steps(weight, compiled) -> None:
    y, u = record()
    shipped = observer(weight=weight, guard="none", forgetting=0.97)
    found = shipped.run(y, u, compiled=compiled)
    gaps = (np.hstack([found.states, found.parameters]) - by_hand(shipped, y, u, found.projection)) / SIZES
    assert np.abs(gaps).max() < 1e-11


def test_on_a_linear_plant_too() -> None:
    rng = np.random.default_rng(4)
    y, u = rng.standard_normal((100, 2)), drive(100)
    shipped = linear_observer(guard="none", forgetting=0.95)
    found = shipped.run(y, u)
    assert not found.projection.any()
    # By hand matrices of condition 626 are inverted, estimates are up to 10.5, and 20 steps are remembered.
    rounding = 626 * np.finfo(float).eps * 10.5 * 20
    assert np.hstack([found.states, found.parameters]) == pytest.approx(by_hand(shipped, y, u), rel=0, abs=rounding)


FORMS = {
    "forgetting": {}, "random-walk": {"random_walk": np.diag([1e-6, 900.0])}, "augmented-kalman": {},
    "radau": {"form": "forgetting", "integration": "radau"}, "homotopies": {"form": "forgetting", "largest_move": 1e-4},
    "bounds": {"form": "forgetting", "lower": np.array([0.95, -np.inf]), "upper": np.array([1.0, 1e3])},
}  # fmt: skip


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", FORMS)
def test_stretches_steps_and_c_agree(name, monkeypatch) -> None:
    monkeypatch.setattr(dae_records, "SAMPLES_PER_CALL", 50)
    y, u = record(samples=120)
    y = np.array(y)
    y[50], y[70:90, 0] = np.nan, np.nan
    shipped = observer(**{"form": name, **FORMS[name]})
    steps = shipped.run(y, u, compiled=False)
    for compiled in (None, True):
        found = shipped.run(y, u, compiled=compiled)
        for field in dataclasses.fields(found):
            if field.name.endswith(("names", "delays")):
                continue
            values, expected = (np.asarray(getattr(one, field.name), dtype=float) for one in (found, steps))
            assert np.array_equal(np.isnan(values), np.isnan(expected)), field.name
            scale = max(float(np.nanmax(np.abs(expected), initial=0.0)), 1.0)
            assert np.nanmax(np.abs(values - expected), initial=0.0) <= 1e-11 * scale, (compiled, field.name)


def jumps() -> tuple[DAEObserver, np.ndarray, np.ndarray]:
    """A rectifier whose source jumps at random: plain Newton fails in places."""
    model, rng = diode(), np.random.default_rng(8)
    u = np.where(rng.random(400) < 0.1, 60.0, 0.0)[:, None]
    shipped = observer(
        model, dt=1e-3, Q=np.diag([0.0, 1e-10]), R=[[1e-6]], initial_covariance=1e-4 * np.eye(2),
        initial_parameter_covariance=[[1e4]], random_walk=np.zeros((1, 1)), lower=np.array([1.0]),
        upper=np.array([np.inf]),
    )  # fmt: skip
    return shipped, simulate_dae(model, u, dt=1e-3, R=[[1e-6]], seed=2).outputs, u


@pytest.mark.long
def test_a_hard_step_is_taken_by_itself_and_the_stretch_goes_on() -> None:
    shipped, y, u = jumps()
    running, alone = shipped.start(), 0
    careful = shipped.steps.implicit.solve_carefully

    def counted(*arguments, **options):
        nonlocal alone
        alone += 1
        return careful(*arguments, **options)

    shipped.steps.implicit.solve_carefully = counted
    steps = [running.raw_step(y[k], u[k]) for k in range(400)]
    assert 5 < alone < 200
    for compiled in (None, True):
        found = shipped.run(y, u, compiled=compiled)
        assert found.states == pytest.approx(np.array([row.x for row in steps]), rel=1e-9)
        assert found.parameters == pytest.approx(np.array([row.theta for row in steps]), rel=1e-9)
        assert found.residuals.max() < 1e-9


@pytest.mark.parametrize("compiled", [None, False, True])
def test_a_step_without_solution_is_named_by_every_engine(compiled) -> None:
    y, u = record(samples=300)
    u = np.array(u)
    u[270, 0], u[270, 3] = 1e3, -1.0
    with pytest.raises(SolverError, match=r"No solution at k = 270.*worst equation"):
        observer().run(y, u, compiled=compiled)


@pytest.mark.parametrize("compiled", [None, False, True])
def test_an_empty_record_gives_no_rows(compiled) -> None:
    found = observer().run(np.zeros((0, 2)), np.zeros((0, 4)), compiled=compiled)
    assert found.states.shape == (0, 4)
    assert found.parameter_covariances.shape == (0, 2, 2)


def chain(cells: int) -> DAEModel:
    """Stirred tanks in a row, with a valve each: twice as many states as tanks."""
    equations, states = {}, {}
    for i in range(cells):
        before = f"q{i - 1}" if i else "inflow"
        equations |= {f"tank {i}": f"der(level{i}) = {before} - q{i}", f"valve {i}": f"q{i} = c * sqrt(level{i})"}
        states |= {f"level{i}": 1.0, f"q{i}": 0.5}
    names = [*states, "inflow", "c", "last", "first"]
    return DAEModel(
        equations, {"last": f"level{cells - 1}", "first": "level0"}, states=states, inputs={"inflow": 0.5},
        parameters={"c": 0.5}, units=dict.fromkeys(names, "1"),
    )  # fmt: skip


@pytest.mark.long
def test_a_plant_too_large_to_unroll() -> None:
    """Above `SMALL` unknowns a factorisation is called: the same numbers as plain NumPy."""
    model, rng = chain(6), np.random.default_rng(1)
    assert model.nx > SMALL
    u = 0.5 + 0.05 * rng.standard_normal((60, 1))
    shipped = observer(
        model, dt=0.5, Q=1e-6 * np.eye(12), R=1e-4 * np.eye(2), initial_covariance=1e-4 * np.eye(12),
        initial_parameter_covariance=[[1e-2]], random_walk=np.zeros((1, 1)), lower=np.array([-np.inf]),
        upper=np.array([np.inf]), guard="none",
    )  # fmt: skip
    u[0] = 0.5  # so that the start is not moved
    y = simulate_dae(model, u, dt=0.5, parameters=[0.45], R=shipped.R, seed=1).outputs
    expected = by_hand(shipped, y, u)
    for compiled in (None, True):
        found = shipped.run(y, u, compiled=compiled)
        assert np.hstack([found.states, found.parameters]) == pytest.approx(expected, abs=1e-10)


def test_linear_equations_are_solved_with_pivots_and_singular_ones_have_no_result() -> None:
    import casadi as ca

    rng = np.random.default_rng(0)
    for n in (3, SMALL, SMALL + 1, 12):
        A, B = ca.MX.sym("A", n, n), ca.MX.sym("B", n, 2)
        function = Compiled(ca.Function("found", [A, B], [solved(A, B)]))
        matrix, right = rng.standard_normal((n, n)), rng.standard_normal((n, 2))
        matrix[0, 0] = 0.0  # without a pivot this divides by zero
        columns = [array.ravel(order="F") for array in (matrix, right)]
        assert function(*columns)[0] == pytest.approx(np.linalg.solve(matrix, right), rel=1e-10, abs=1e-12)
        matrix[:, 1] = 0.0
        assert not np.isfinite(function(matrix.ravel(order="F"), columns[1])[0]).all()


def trials(samples: int = 60, count: int = 7) -> tuple[np.ndarray, np.ndarray]:
    model = exchanger()
    u = np.tile(model.nominal_input, (count, samples, 1))
    u[:, :, 0] *= 1.0 + 0.01 * np.random.default_rng(3).standard_normal((count, samples))
    y = [simulate_dae(model, u[i], dt=1.0, Q=np.diag(BALANCES), R=np.diag([1e4, 0.25]), seed=i).outputs
         for i in range(count)]  # fmt: skip
    return np.array(y), u


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("compiled", "shared"), [(False, True), (False, False), (True, True), (True, False)])
def test_a_batch_is_its_trials(compiled, shared, monkeypatch) -> None:
    monkeypatch.setattr(dae_batch, "BATCH_SAMPLES_PER_CALL", 180)
    y, u = trials()
    y[2, 20:30] = np.nan
    y[3, 5, 1] = np.nan
    inputs = u[0] if shared else u
    shipped, noted = observer(), []
    found = run_batch(shipped, y, inputs, compiled=compiled, progress=noted.append)
    assert noted[-1] == 7
    for i in range(7):
        alone = shipped.run(y[i], inputs if shared else u[i])
        for name, other in (("states", "states"), ("parameters", "parameters"), ("innovations", "innovations"),
                            ("parameter_covariances",) * 2, ("nis", "nis"), ("nis_degrees",) * 2,
                            ("residuals", "residuals")):  # fmt: skip
            assert getattr(found, name)[i] == pytest.approx(getattr(alone, other), rel=1e-11, abs=1e-12, nan_ok=True)


@pytest.mark.parametrize("compiled", [False, True])
def test_a_trial_without_solution_is_named(compiled) -> None:
    y, u = trials()
    u[4, 33, 0], u[4, 33, 3] = 1e3, -1.0
    with pytest.raises(SolverError, match="Trial 4: No solution at k = 33") as caught:
        run_batch(observer(), y, u, compiled=compiled)
    assert caught.value.record["trial"] == 4


def test_bad_batches_are_named() -> None:
    y, u = trials(samples=5, count=2)
    with pytest.raises(SpecError, match=r"y has shape \(5, 2\)"):
        run_batch(observer(), y[0], u)
    with pytest.raises(SpecError, match="u has shape"):
        run_batch(observer(), y, u[:, :4])
    with pytest.raises(SpecError, match="infinity"):
        run_batch(observer(), np.where(y > 0.0, np.inf, y), u)
    u[1, 3, 0] = np.nan
    with pytest.raises(SpecError, match="'m1' of trial 1 is nan at k = 3"):
        run_batch(observer(), y, u)


def test_without_a_compiler_it_runs_and_says_so_when_asked_for_c(monkeypatch) -> None:
    monkeypatch.setattr(dae_batch, "WORTH_COMPILING", 1)
    monkeypatch.setattr(dae_library, "COMPILERS", ("no-such-compiler",))
    monkeypatch.setenv("CC", "")
    y, u = trials(samples=20, count=2)
    assert np.isfinite(run_batch(made(exchanger()), y, u).states).all()
    with pytest.raises(SpecError, match="no C compiler"):
        run_batch(made(exchanger()), y, u, compiled=True)
    with pytest.raises(SpecError, match="no C compiler"):
        made(exchanger()).run(y[0], u[0], compiled=True)
    monkeypatch.setenv("CC", "false")
    with pytest.raises(SpecError, match="'false' fails"):
        made(exchanger()).run(y[0], u[0], compiled=True)


def test_a_long_run_shows_a_bar_and_a_short_one_does_not(capsys, monkeypatch) -> None:
    y, u = record(samples=600)
    observer().run(y, u, progress=True)
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    monkeypatch.setenv("FORCE_COLOR", "1")
    observer().run(y, u, progress=True)
    assert "samples" in capsys.readouterr().err
    observer().run(y, u)  # no terminal
    observer().run(y, u, progress=False)
    assert capsys.readouterr().err == ""
    noted: list[int] = []
    observer().run(y, u, progress=noted.append)
    assert noted == sorted(noted)
    assert noted[-1] == 600


def test_truths_are_the_same_in_stretches_and_step_by_step(monkeypatch) -> None:
    from obsynth.plants import dae_functions as dae_stretches

    model = exchanger()
    u = np.tile(model.nominal_input, (300, 1))
    u[:, 0] *= 1.0 + 0.01 * np.random.default_rng(0).standard_normal(300)
    options = {"dt": 1.0, "Q": np.diag(BALANCES), "R": np.diag([1e4, 0.25]), "seed": 5}
    together = simulate_dae(model, u, **options)
    monkeypatch.setattr(dae_stretches, "STRETCHES", (10**9,))
    alone = simulate_dae(model, u, **options)
    assert together.states == pytest.approx(alone.states, rel=1e-12)
    assert together.residuals.max() < 1e-12


def test_recursive_observers_keep_their_batches() -> None:
    plant = obsynth.TimeVaryingDescriptorSystem(None, [[0.5]], None, [[1.0]], dt=1.0)
    shipped = obsynth.descriptor_kalman(plant, Q=[[1.0]], R=[[1.0]]).observer
    y = np.ones((2, 5, 1))
    assert run_batch(shipped, y).states[1] == pytest.approx(shipped.run(y[1]).states)


@pytest.mark.long
def test_functions_of_python_run_as_c_as_well() -> None:
    rng = np.random.default_rng(4)
    y, u = rng.standard_normal((40, 2)), drive(40)
    shipped = linear_observer()
    assert not linear(dict(zip("EABGCD", [np.eye(1)] * 6, strict=True))).is_data
    assert shipped.run(y, u, compiled=True).states == pytest.approx(shipped.run(y, u).states, abs=1e-12)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("compiled", [None, False, True])
def test_a_step_that_becomes_singular_along_the_run_is_named(compiled) -> None:
    """The gain of a sensor falls to nothing: what it shows no longer determines the state behind it."""
    model = DAEModel(
        {"moves": "der(a) = -c * a", "holds": "gain * z = a"}, {"seen": "a"}, states={"a": 1.0, "z": 1.0},
        inputs={"gain": 1.0}, parameters={"c": 0.5}, units=dict.fromkeys(["a", "z", "gain", "c", "seen"], "1"),
    )  # fmt: skip
    shipped = observer(
        model, dt=0.1, Q=1e-6 * np.eye(2), R=[[1e-4]], initial_covariance=1e-4 * np.eye(2),
        initial_parameter_covariance=[[1e-2]], random_walk=np.zeros((1, 1)), lower=np.array([-np.inf]),
        upper=np.array([np.inf]),
    )  # fmt: skip
    u = np.ones((40, 1))
    u[23] = 1e-14
    y = np.exp(-0.05 * np.arange(40))[:, None]
    assert shipped.run(y[:23], u[:23], compiled=compiled).conditions.max() < 100.0
    with pytest.raises(SolverError, match=r"singular at k = 23 .*'holds' do not determine 'z'"):
        shipped.run(y, u, compiled=compiled)
    running = shipped.start()
    for k in range(23):
        running.step(y[k], u[k])
    memory = running.state.memory
    with pytest.raises(SolverError, match="singular at k = 23"):
        running.step(y[23], u[23])
    assert running.state.k == 23
    assert running.state.memory is memory
    running.step(y[23], u[22])


@pytest.mark.one_in(2)
@pytest.mark.parametrize("form", ["forgetting", "augmented-kalman"])
def test_without_parameters_it_is_a_kalman_filter_of_the_states(form) -> None:
    tank = DAEModel(
        {"balance": "2 * der(level) = inflow - outflow", "valve": "outflow = 0.5 * sqrt(level)"}, {"flow": "outflow"},
        states={"level": 1.0, "outflow": 0.5}, inputs={"inflow": 0.5},
        units=dict.fromkeys(["level", "outflow", "inflow", "flow"], "1"),
    )  # fmt: skip
    none = np.zeros(0)
    shipped = observer(
        tank, dt=0.5, Q=np.diag([1e-4, 0.0]), R=[[1e-4]], initial_covariance=1e-2 * np.eye(2), form=form,
        initial_parameters=none, initial_parameter_covariance=np.zeros((0, 0)), random_walk=np.zeros((0, 0)),
        lower=none, upper=none,
    )  # fmt: skip
    y = simulate_dae(tank, np.full((60, 1), 0.5), dt=0.5, initial_state=[1.5, 0.6], seed=1).outputs
    for compiled in (None, True):
        found = shipped.run(y, np.full((60, 1), 0.5), compiled=compiled)
        assert found.parameters.shape == (60, 0)
        assert found.states[-1, 1] == pytest.approx(y[-1, 0], rel=1e-3)
