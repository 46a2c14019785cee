"""Thresholds over a box: they hold for exact plants inside it, are tight, and say what they are."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pandas as pd
import pytest
from benchmarks.campaigns.adaptive_thresholds import record_columns
from scipy.linalg import expm
from uncertain_plants import DRIVE, drive, wang

import obsynth
from obsynth.errors import PreconditionError, SpecError
from obsynth.monitoring.thresholds.adaptive_monitor import adaptive_plan
from obsynth.observers.saved_states import state_as_data, state_from_data
from obsynth.simulation.benches import make_bench
from obsynth.verification.over_tolerances.adaptive_recursion import AdaptiveState, adaptive_step, thresholds_of_records
from obsynth.verification.over_tolerances.plants_of_the_box import drawn_points, plant_at

START = 0.2


def exact_records(design: Any, points: np.ndarray, steps: int, seed: int, *, fault: float = 0.0) -> tuple:
    """Simulate exact plants of the box, with disturbances and noise at their bounds; return rows, u, y and faults."""
    plant, observer = design.linear
    generator = np.random.default_rng(seed)
    rows, inputs, outputs = [], [], []
    acting = np.zeros((steps, plant.nf))
    acting[steps // 2 :] = fault
    for q in points:
        true = plant_at(plant, plant.uncertainty.box.values(q))
        reduced = obsynth.eliminate_algebraic_states(true).plant
        x = generator.uniform(-START, START, reduced.nx)
        u = generator.uniform(-1.0, 1.0, (steps, plant.nu))
        d = 0.1 * generator.choice([-1.0, 1.0], (steps, plant.nd))
        v = generator.choice([-1.0, 1.0], (steps, plant.nw))
        y = np.empty((steps, plant.ny))
        for k in range(steps):
            y[k] = reduced.C @ x + reduced.D @ u[k] + reduced.Dd @ d[k] + reduced.Df @ acting[k] + reduced.Dw @ v[k]
            x = reduced.A @ x + reduced.B @ u[k] + reduced.Bd @ d[k] + reduced.Bf @ acting[k] + reduced.Bw @ v[k]
        estimates = observer.run(y, u if plant.nu else None)
        rows.append(np.hstack([estimates.states, estimates.faults, estimates.residuals]))
        inputs.append(u)
        outputs.append(y)
    return np.array(rows), np.array(inputs), np.array(outputs), acting


def start_set(design: Any) -> dict[str, float]:
    """Return bounds of all states: algebraic ones are wherever they are."""
    plant, _ = design.linear
    moving = plant.E.any(axis=0)
    return {name: START if moving[i] else 50.0 for i, name in enumerate(plant.state_names)}


@pytest.fixture(scope="module", params=["drive", "wang"])
def design(request) -> Any:
    return obsynth.fault_estimation_filter({"drive": drive, "wang": wang}[request.param]())


@pytest.fixture(scope="module")
def plan(design) -> Any:
    return adaptive_plan(design, np.array([0.1]), 1.0, initial_error=None, initial_set=start_set(design))[0]


@pytest.mark.long
def test_exact_plants_of_the_box_never_pass_their_threshold(design, plan) -> None:
    points = drawn_points(len(plan.names), 24, 7, vertices=0.7)
    rows, u, y, _ = exact_records(design, points, 150, 1)
    total, intervals = record_columns(plan, rows, u, y)
    values = np.abs(rows[:, :, design.observer.fault_rows.start :])
    assert np.all(values <= total)
    assert np.max(values / total) > 0.4
    assert np.all(intervals[..., 0] <= 0.0)
    assert np.all(intervals[..., 1] >= 0.0)


def test_intervals_hold_during_faults_and_find_them(design, plan) -> None:
    points = drawn_points(len(plan.names), 8, 11)
    quiet = record_columns(plan, *exact_records(design, points, 120, 2)[:3])[0]
    size = 3.0 * float(np.median(quiet[:, 60:]))
    rows, u, y, faults = exact_records(design, points, 120, 2, fault=size)
    total, intervals = record_columns(plan, rows, u, y)
    delay = design.observer.fault_delays[0]
    for k in range(61 + delay, 120):
        assert np.all(intervals[:, k, :, 0] <= faults[k - delay])
        assert np.all(intervals[:, k, :, 1] >= faults[k - delay])
    alarms = np.abs(rows[:, :, design.observer.fault_rows.start :]) > total
    assert alarms[:, 60 : 62 + delay].any(axis=(1, 2)).mean() >= 0.9


def test_constants_that_vary_need_the_varying_mode() -> None:
    """With q new at each sample the threshold for constant q is passed; that for varying q is not."""
    found = {}
    for variation in ("constant", "varying"):
        design = obsynth.fault_estimation_filter(wang("5 %", variation=variation), weight="paper")
        plant, observer = design.linear
        plan = adaptive_plan(design, np.array([0.0]), 1.0, initial_error=None, initial_set=start_set(design))[0]
        generator = np.random.default_rng(3)
        passed = 0
        for _ in range(2):
            x, steps = np.zeros(3), 60
            y, u = np.empty((steps, plant.ny)), generator.uniform(-2.0, 2.0, (steps, plant.nu))
            for k in range(steps):
                # E x(k+1) = A(q_k) x(k) + ..., the algebraic row at the value that acts at k.
                q = generator.choice([-1.0, 1.0], len(plan.names))
                true = obsynth.eliminate_algebraic_states(plant_at(plant, plant.uncertainty.box.values(q))).plant
                y[k] = true.C @ x + true.D @ u[k]
                x = true.A @ x + true.B @ u[k]
            estimates = observer.run(y, u)
            rows = np.hstack([estimates.states, estimates.faults, estimates.residuals])[None]
            total, _ = record_columns(plan, rows, u[None], y[None])
            passed += bool(np.any(np.abs(rows[:, :, observer.fault_rows.start :]) > total))
        found[variation] = passed
    assert found == {"constant": 2, "varying": 0}


@pytest.mark.long
@pytest.mark.parametrize("variation", ["constant", "varying"])
def test_a_sample_at_a_time_is_the_record(variation) -> None:
    design = obsynth.fault_estimation_filter(drive(variation=variation))
    bound = adaptive_plan(design, np.array([0.1]), 1.0, initial_error=0.3, initial_set=None)[0].bound
    generator = np.random.default_rng(0)
    estimates, u, y = (generator.normal(size=(1, 300, n)) for n in (3, 1, 2))
    record = thresholds_of_records(bound, estimates, u, y)
    state = AdaptiveState.of(bound)
    for k in range(300):
        state, found = adaptive_step(bound, state, estimates[0, k], u[0, k], y[0, k])
        assert found.total == pytest.approx(record.total[0, k], rel=1e-12)
        assert found.first == pytest.approx(record.first[0, k], rel=1e-9, abs=1e-15)
        if k == 150:
            state = state_from_data(AdaptiveState.of(bound), state_as_data(state))


def log_of(design: Any, rows: int = 120) -> pd.DataFrame:
    plant = design.plant
    _, u, y, _ = exact_records(design, np.zeros((1, len(plant.uncertainty.box.names))), rows, 4)
    data = {"time": plant.dt * np.arange(rows)}
    data |= {name: u[0, :, i] for i, name in enumerate(plant.input_names)}
    return pd.DataFrame(data | {name: y[0, :, i] for i, name in enumerate(plant.output_names)})


def test_tolerance_zero_is_the_nominal_monitor() -> None:
    design = obsynth.fault_estimation_filter(wang())
    exact = design.replace(plant=design.plant.replace(uncertainty=None))
    data = log_of(design)
    bounds = {"disturbance_bounds": {"w": 0.1}, "initial_error": 0.5}
    nominal = obsynth.run_on_data(exact, data, monitor=obsynth.online_monitor(exact, **bounds), warm_up=0.0).table
    zero = obsynth.online_monitor(exact, constants={"A": "0 %"}, **bounds)
    found = obsynth.run_on_data(exact, data, monitor=zero, warm_up=0.0).table
    assert found["threshold"].to_numpy() == pytest.approx(nominal["threshold"].to_numpy(), rel=1e-9)
    tiny = obsynth.online_monitor(exact, constants={"A": "1e-7 %"}, **bounds)
    near = obsynth.run_on_data(exact, data, monitor=tiny, warm_up=0.0).table
    assert near["threshold"].to_numpy() == pytest.approx(nominal["threshold"].to_numpy(), rel=1e-4)
    assert "assumes an exact model" in obsynth.online_monitor(exact, **bounds).statement


def test_columns_of_a_run() -> None:
    design = obsynth.fault_estimation_filter(drive())
    monitor = obsynth.online_monitor(
        design, noise_bound=1.0, disturbance_bounds={"load": 0.1}, initial_set={"x1": 0.2, "x2": [-0.2, 0.2], "x3": 0.2}
    )
    run = obsynth.run_on_data(design, log_of(design), monitor=monitor, warm_up=0.0)
    table = run.table
    assert not run.alarms
    assert np.all(table["lowest motor"] <= 0.0)
    assert np.all(table["highest motor"] >= 0.0)
    assert np.all(np.abs(table["fhat[motor]"]) <= table["threshold fhat[motor]"])
    shares = table[[f"share {name}" for name in ("J1", "J2", "k", "c", "b")]].to_numpy()
    assert np.all(shares >= 0.0)
    assert np.all(shares.sum(axis=1) < 1.0)
    assert "a constant outside its stated tolerance" in monitor.statement
    again = obsynth.run_on_data(design, log_of(design), monitor=monitor, warm_up=0.0).table
    assert again.equals(table)


@pytest.mark.long
def test_refusals_name_their_reason() -> None:
    design = obsynth.fault_estimation_filter(drive())
    with pytest.raises(SpecError, match="no entry for the state 'x2'"):
        obsynth.online_monitor(design, noise_bound=1.0, disturbance_bounds={"load": 0.1}, initial_set={"x1": 1.0})
    with pytest.raises(SpecError, match="names 'x9', which is no state of the plant"):
        obsynth.online_monitor(design, noise_bound=1.0, disturbance_bounds={"load": 0.1}, initial_set={"x9": 1.0})
    with pytest.raises(SpecError, match="appears in no matrix"):
        obsynth.online_monitor(design, constants={"spring": (1.0, 2.0)}, disturbance_bounds={"load": 0.1})
    with pytest.raises(SpecError, match="is for the monitor pointwise, not for window"):
        obsynth.online_monitor(design, "window", constants={"k": "1 %"})
    loud = obsynth.online_monitor(
        design, noise_bound=1.0, disturbance_bounds={"load": 0.1}, constants={name: "30 %" for name in ("J2", "k")}
    )
    assert "may grow" in loud.statement
    with pytest.raises(PreconditionError, match="singular, or not of index 1, inside the box"):
        obsynth.online_monitor(design, noise_bound=1.0, disturbance_bounds={"load": 0.1}, constants={"J2": "150 %"})


@pytest.mark.long
def test_plants_are_drawn_from_the_box() -> None:
    from uncertain_plants import DESIGNS

    from obsynth.specs.loader import load_spec

    design = obsynth.fault_estimation_filter(wang())
    exact = design.replace(plant=design.plant.replace(uncertainty=None))
    scenario = load_spec(DESIGNS / "wang2015" / "spec.yaml").scenario
    quiet, box = scenario.replace(faults={}, horizon=120), design.plant.uncertainty
    fixed, adaptive = obsynth.monitor(design, quiet), obsynth.monitor(design, quiet, constants=box)
    assert obsynth.evaluate(design, quiet, runs=30, monitor=fixed, plants=30).false_alarm_rate.value > 0.4
    assert obsynth.evaluate(design, quiet, runs=30, monitor=adaptive, plants=30).false_alarm_rate.value == 0.0
    faulty = scenario.replace(horizon=120)
    found = obsynth.evaluate(design, faulty, runs=20, monitor=obsynth.monitor(design, faulty, constants=box), plants=20)
    assert found.false_alarm_rate.value == 0.0
    assert found.missed_detection_rate.value == 0.0
    shares: dict[int, int] = {}

    class Counting(ThreadPoolExecutor):
        def submit(self, work: Any, /, task: Any) -> Any:
            bench, seeds = task
            shares[id(bench)] = shares.get(id(bench), 0) + len(seeds)
            return super().submit(work, task)

    with Counting(1) as executor:
        assert obsynth.evaluate(design, quiet, runs=10, plants=7, executor=executor).runs == 10
    assert sorted(shares.values()) == [1, 1, 1, 1, 2, 2, 2]
    with pytest.raises(SpecError, match="has none"):
        obsynth.evaluate(exact, quiet, runs=2, plants=2)
    with pytest.raises(SpecError, match="follows inputs and outputs"):
        adaptive.watch(obsynth.simulate(design, quiet).estimates)
    # No table is that of the adaptive rule; the exact model's, which lacks tolerances and the start, has its own name.
    with pytest.raises(SpecError, match="follows inputs and outputs"):
        _ = adaptive.threshold
    assert (adaptive.nominal_threshold <= fixed.threshold).all()
    assert adaptive.nominal_threshold[-1] == pytest.approx(fixed.threshold[-1], rel=1e-9)
    np.testing.assert_array_equal(fixed.nominal_threshold, fixed.threshold)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("size", [0.05, 0.3, 1.0])
def test_what_an_evaluation_counts_does_not_depend_on_what_is_left_out(design, size: float) -> None:
    plant, _ = design.linear
    steps, onset = 90, 45
    scenario = obsynth.Scenario(
        horizon=(steps - 0.5) * plant.dt, noise=1.0,
        inputs={name: obsynth.Sine(amplitude=1.0, frequency=2.0) for name in plant.input_names},
        faults={plant.fault_names[0]: obsynth.Step(size=size, start=onset * plant.dt)},
        disturbances={name: obsynth.Uniform(low=-0.1, high=0.1) for name in plant.disturbance_names},
    )  # fmt: skip
    watched = obsynth.monitor(design, scenario, constants=plant, noise_bound=1.0)
    box = plant.uncertainty.box
    for q in drawn_points(len(box.names), 6, 3):
        bench = make_bench(design.replace(plant=plant_at(plant, box.values(q))), scenario)
        runs = bench.run(range(20))
        some = watched.passed_in(runs, onset=onset)
        whole = watched.passed_in(runs)
        assert np.array_equal(some[:onset].any(axis=0), whole[:onset].any(axis=0))
        assert np.array_equal(some[onset:].any(axis=0), whole[onset:].any(axis=0))
        assert np.array_equal(np.argmax(some[onset:], axis=0), np.argmax(whole[onset:], axis=0))


PIECES, STEP = 5, 0.05


def switching_log(design: Any, q: np.ndarray, seed: int, steps: int = 120) -> pd.DataFrame:
    """Simulate an exact continuous plant of the box whose disturbance switches between samples, its input held."""
    plant = plant_at(design.linear[0], design.linear[0].uncertainty.box.values(q))
    smooth = obsynth.eliminate_algebraic_states(plant).plant
    rng = np.random.default_rng(seed)
    block = np.zeros((5, 5))
    block[:3] = np.hstack([smooth.A, smooth.B, smooth.Bd])
    piece = expm(block * STEP / PIECES)[:3]
    x, rows = rng.uniform(-START, START, 3), []
    inputs = rng.choice([-1.0, 1.0], steps)
    for k in range(steps):
        rows.append([k * STEP, inputs[k], *(smooth.C @ x)])
        for _ in range(PIECES):
            # Bang-bang at about the speed of the plant, in some runs faster.
            load = 0.1 * np.sign(np.sin(0.4 * k)) if seed % 2 else 0.1 * rng.choice([-1.0, 1.0])
            x = piece @ np.array([*x, inputs[k], load])
    return pd.DataFrame(rows, columns=["time", "torque", "w1", "w2"])


@pytest.fixture(scope="module")
def continuous() -> Any:
    written = {
        "E": [["J1", 0, 0], [0, "J2", 0], [0, 0, 1]], "A": [["-c - b", "c", "-k"], ["c", "-c - b", "k"], [1, -1, 0]],
        "B": [[1], [0], [0]], "C": [[1, 0, 0], [0, 1, 0]], "Bf": [[1], [0], [0]], "Bd": [[0], [1], [0]],
        "input_names": ["torque"], "output_names": ["w1", "w2"], "disturbance_names": ["load"],
    }  # fmt: skip
    sizes = {"J1": 0.5, "J2": 1.0, "k": 20.0, "c": 0.2, "b": 0.3}
    constants = {name: {"nominal": value, "tolerance": "2 %"} for name, value in sizes.items()}
    return obsynth.pd_observer(obsynth.uncertain_system(written, constants))


@pytest.mark.long
def test_continuous_designs_hold_for_disturbances_that_move_between_samples(continuous) -> None:
    plant, _ = continuous.linear
    monitor = obsynth.online_monitor(
        continuous, constants=plant, disturbance_bounds={"load": 0.1}, sample_time=STEP,
        initial_set=dict.fromkeys(plant.state_names, START),
    )  # fmt: skip
    assert "disturbances may move in between" in monitor.statement
    largest = 0.0
    for seed, q in enumerate(drawn_points(5, 6, 4, vertices=0.8)):
        found = obsynth.run_on_data(continuous, switching_log(continuous, q, seed), monitor=monitor, warm_up=0.0)
        assert not found.alarms
        table = found.table
        for name in ("fhat[f1]", "r[w1]", "r[w2]"):
            assert (table[name].abs() <= table[f"threshold {name}"]).all()
            largest = max(largest, float((table[name].abs() / table[f"threshold {name}"]).max()))
    assert largest > 0.3
    late = switching_log(continuous, np.zeros(5), 1)
    late.loc[60:, "time"] += 0.4 * STEP
    found = obsynth.run_on_data(continuous, late, monitor=monitor, warm_up=0.0, gap=1.0)
    assert found.table["threshold"][60:].isna().all()
    wave = {"torque": obsynth.Sine(amplitude=1.0, frequency=2.0)}
    with pytest.raises(PreconditionError, match="held"):
        obsynth.monitor(
            continuous, obsynth.Scenario(horizon=2, sample_time=STEP, inputs=wave), constants=plant,
            disturbance_bounds={"load": 0.1},
        )  # fmt: skip


def test_the_first_input_of_a_continuous_design_counts_once(continuous) -> None:
    """A sample at a time gives what the whole record gives, and the first input, whatever it is, is in both."""
    monitor = obsynth.online_monitor(
        continuous, constants=continuous.plant, disturbance_bounds={"load": 0.1}, sample_time=STEP,
        initial_set=dict.fromkeys(continuous.plant.state_names, START),
    )  # fmt: skip
    bound = monitor.rule.plan.bound
    assert bound.first is not None
    assert bound.first.any()
    generator = np.random.default_rng(1)
    sizes = (bound.drive.shape[-1] - 1, 1, 2)
    estimates, u, y = (generator.normal(size=(1, 12, n)) for n in sizes)
    record = thresholds_of_records(bound, estimates, u, y)
    state = AdaptiveState.of(bound)
    for k in range(12):
        state, found = adaptive_step(bound, state, estimates[0, k], u[0, k], y[0, k])
        assert found.total == pytest.approx(record.total[0, k], rel=1e-12)
    u[0, 0] *= 3.0
    assert (thresholds_of_records(bound, estimates, u, y).total[0, 1:] != record.total[0, 1:]).any()


def test_records_and_rows_of_continuous_designs_agree(continuous) -> None:
    plant, _ = continuous.linear
    scenario = obsynth.Scenario(horizon=3, sample_time=STEP, disturbances={"load": obsynth.Uniform(low=-0.1, high=0.1)})
    watched = obsynth.monitor(continuous, scenario, constants=plant)
    assert obsynth.evaluate(continuous, scenario, runs=20, plants=20, monitor=watched).false_alarm_rate.value == 0.0


def test_intervals_hold_while_the_effect_of_a_fault_varies() -> None:
    """What a fault did in the sample before, it did with the constant of that sample: correction 8.1 with varying q."""
    plant = obsynth.uncertain_system(
        {"A": [["0.5 * p", 0.1], [0.0, 0.4]], "Bf": [["p"], [0.3]], "C": [[1.0, 0.0], [0.0, 1.0]], "dt": 1.0},
        {"p": {"nominal": 1.0, "tolerance": "10 %"}}, variation="varying",
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(plant)
    first, _ = adaptive_plan(design, np.zeros(0), 0.0, initial_error=None, initial_set={"x1": 0.0, "x2": 0.0})
    assert first.intervals
    rng = np.random.default_rng(0)
    closest = 0.0
    for _ in range(40):
        q, f = rng.choice([-1.0, 1.0], 60), np.repeat(rng.normal(size=12), 5)
        x, y = np.zeros(2), np.empty((60, 2))
        for k in range(60):
            y[k], p = x, 1.0 + 0.1 * q[k]
            x = np.array([[0.5 * p, 0.1], [0.0, 0.4]]) @ x + np.array([p, 0.3]) * f[k]
        found = design.observer.run(y)
        rows = np.hstack([found.states, found.faults, found.residuals])[None]
        interval = record_columns(first, rows, np.zeros((1, 60, 0)), y[None])[1][0, :, 0]
        low, high = interval[1:, 0], interval[1:, 1]
        assert (low <= f[:-1]).all()
        assert (f[:-1] <= high).all()
        closest = max(closest, float(np.max(np.abs(f[:-1] - (low + high) / 2.0) / ((high - low) / 2.0))))
    assert closest > 0.8


@pytest.mark.long
@pytest.mark.parametrize("ranges", [{"J1": (0.45, 0.52)}, {"J2": (0.99, 1.15), "k": (17.0, 20.5)}])
def test_a_box_whose_middle_is_not_nominal_has_bounds(ranges, share) -> None:
    """A calibrated box is not symmetric: the remainder of inverses then leaves something at the nominal plant."""
    constants = {name: {"nominal": value, "range": ranges.get(name, (0.98 * value, 1.02 * value))}
                 for name, value in DRIVE.items()}  # fmt: skip
    plant = obsynth.uncertain_system(drive(), constants)
    design = obsynth.fault_estimation_filter(plant)
    assert obsynth.robustness(design).finite_for_ever
    start = dict.fromkeys(plant.state_names, 0.0)
    first, _ = adaptive_plan(design, np.zeros(1), 0.0, initial_error=None, initial_set=start)
    assert first.intervals
    u = np.sign(np.sin(2.0 * np.pi * np.arange(200) / 70.0))[:, None]
    shares = []
    # One of three corners: all pairs of ends of two constants are among them.
    for corner in share(list(itertools.product((0, 1), repeat=5)), 3):
        ends = dict(zip(plant.uncertainty.box.names, corner, strict=True))
        values = {name: (item.low, item.high)[ends[name]] for name, item in plant.uncertainty.box.constants.items()}
        exact = plant_at(plant, values)
        x, y = np.zeros(3), np.empty((200, 2))
        for k in range(200):
            y[k] = exact.C @ x
            x = exact.A @ x + exact.B @ u[k]
        found = design.observer.run(y, u)
        rows = np.hstack([found.states, found.faults, found.residuals])[None]
        thresholds, intervals = record_columns(first, rows, u[None], y[None])
        no = thresholds.shape[2]
        shares.append(np.max(np.abs(rows[0, 1:, -no:]) / thresholds[0, 1:]))
        assert (intervals[0, 1:, 0, 0] <= 0.0).all()
        assert (intervals[0, 1:, 0, 1] >= 0.0).all()
    assert 0.5 < max(shares) <= 1.0


def test_continuous_designs_without_a_disturbance_have_thresholds() -> None:
    plant = obsynth.uncertain_system(
        {"A": [["-p", 0.1], [0.0, -2.0]], "Bf": [[1.0], [0.3]], "C": [[1.0, 0.0], [0.0, 1.0]], "dt": 0.0},
        {"p": {"nominal": 1.0, "tolerance": "5 %"}},
    )
    design = obsynth.pd_observer(plant)
    monitor = obsynth.online_monitor(design, constants=plant, sample_time=0.1, initial_set={"x1": 1.0, "x2": 1.0})
    log = pd.DataFrame({"time": 0.1 * np.arange(30), "y1": np.exp(-0.105 * np.arange(30)), "y2": np.zeros(30)})
    table = obsynth.run_on_data(design, log, monitor=monitor, warm_up=0.0).table
    assert (table["r[y1]"].abs() <= table["threshold r[y1]"]).all()


def test_designs_without_residuals_are_watched_by_their_estimates() -> None:
    plant = obsynth.uncertain_system(
        {"A": [["p", 0.1], [0.0, 0.4]], "Bf": [[1.0], [0.3]], "C": [[1.0, 0.0], [0.0, 1.0]], "dt": 1.0},
        {"p": {"nominal": 0.5, "tolerance": "5 %"}},
    )
    design = obsynth.ui_pi_observer(plant)
    monitor = obsynth.online_monitor(design, constants=plant, initial_set={"x1": 1.0, "x2": 0.0})
    log = pd.DataFrame({"time": np.arange(20.0), "y1": 0.52 ** np.arange(20), "y2": np.zeros(20)})
    table = obsynth.run_on_data(design, log, monitor=monitor, warm_up=0.0).table
    assert (table["fhat[f1]"].abs() <= table["threshold fhat[f1]"]).all()
    assert (table["alarm"] == "").all()
    log["y1"] += np.where(np.arange(20) >= 10, 3.0, 0.0)
    assert (obsynth.run_on_data(design, log, monitor=monitor, warm_up=0.0).table["alarm"] != "").any()


@pytest.mark.one_in(3)
@pytest.mark.parametrize("p", [0.95, 1.0, 1.05])
def test_residuals_that_are_zero_but_for_rounding_refuse_no_bound(p: float) -> None:
    # An observer decoupled from d reads x3 = y2 as it is: that residual, and what the fault follows, are 1e-16.
    a = [[0.26, -0.21, 0.2], ["-0.21*p", "-1.06*p", 0.0], [0.37, 0.31, -1.0]]
    plant = obsynth.uncertain_system(
        {"E": np.diag([0.88, 1.61, 0.0]).tolist(), "A": a, "B": [[0.95], [1.18], [1.52]], "Bf": [[0.32], [-0.79], [0]],
         "Bd": [[1.16], [-0.17], [0.0]], "C": [[1, 0, 0], [0, 0, 1]], "dt": 1.0},
        {"p": {"nominal": 1.0, "tolerance": "5 %"}},
    )  # fmt: skip
    design = obsynth.ui_pi_observer(plant)
    states = dict.fromkeys(design.plant.state_names, 2.0)
    monitor = obsynth.online_monitor(design, disturbance_bounds={"d1": 0.1}, initial_set=states)
    rng, x, rows = np.random.default_rng(3), np.array([0.5, -0.7]), []
    for k in range(40):
        u, d = rng.choice([-1.0, 1.0]), 0.1 * rng.choice([-1.0, 1.0])
        third = 0.37 * x[0] + 0.31 * x[1] + 1.52 * u
        rows.append([float(k), u, x[0], third])
        into = [0.26 * x[0] - 0.21 * x[1] + 0.2 * third, -0.21 * p * x[0] - 1.06 * p * x[1]]
        x = (np.array(into) + np.array([0.95, 1.18]) * u + np.array([1.16, -0.17]) * d) / [0.88, 1.61]
    table = obsynth.run_on_data(
        design, pd.DataFrame(rows, columns=["time", "u1", "y1", "y2"]), monitor=monitor, warm_up=0.0
    ).table
    assert (table["fhat[f1]"].abs() <= table["threshold fhat[f1]"]).all()
    assert (table["fhat[f1]"].abs() > 0.01 * table["threshold fhat[f1]"]).any()
