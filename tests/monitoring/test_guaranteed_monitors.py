"""Guaranteed tests that run: monitors of records and of data, gaps, C; and the bank that isolates."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.results.design import Certificate

ROOT = Path(__file__).parents[2]


@cache
def spec() -> obsynth.Spec:
    return obsynth.load_spec(ROOT / "designs/drive/guaranteed_test.yaml")


@cache
def drive() -> obsynth.ObserverDesign:
    return obsynth.design(spec().plant, "guaranteed-test", **spec().options)


@pytest.mark.long
def test_the_step_is_found_and_nothing_before_it() -> None:
    watched = obsynth.monitor(drive(), spec().scenario)
    # Held between samples the load torque allows 0.045456; as it likes, half as much again.
    least = drive().certificate.claims["least"]
    assert 1.4 * 0.045456 < least <= drive().certificate.claims["threshold"] < 1.6 * 0.045456
    assert f"no function of these samples has a threshold below {least:.6g}" in watched.statement
    found = watched.watch(obsynth.simulate(drive(), spec().scenario).estimates)
    # Found at the latest 19 samples after the step at 4 s, though 0.1 N m are no more than 1.5 times the threshold.
    assert found.time is not None
    assert 4.0 < found.time <= 4.0 + 0.38 + 1e-9
    assert np.isinf(found.threshold[:29]).all()
    many = obsynth.evaluate(drive(), spec().scenario, runs=20, monitor=watched)
    assert many.false_alarm_rate.value == 0.0


def log() -> pd.DataFrame:
    run = obsynth.simulate(drive(), spec().scenario)
    plant = drive().linear[0]
    columns = {"time": np.arange(len(run.outputs)) * plant.dt}
    columns |= dict(zip(plant.input_names, run.inputs.T, strict=True))
    columns |= dict(zip(plant.output_names, run.outputs.T, strict=True))
    return pd.DataFrame(columns)


def test_a_log_alarms_once_and_rows_after_a_gap_give_no_verdict() -> None:
    data = log()
    table = obsynth.run_on_data(drive(), data, monitor=obsynth.online_monitor(drive())).table
    alarms = table.loc[table["alarm"] != "", "time"]
    assert 4.0 < alarms.min() <= 4.38 + 1e-9
    thresholds = table["threshold"].to_numpy(dtype=float)
    assert np.isnan(thresholds[:29]).all()
    # Rounding is in the threshold, and does not count.
    assert np.all(thresholds[29:] >= drive().certificate.claims["threshold"])
    assert np.nanmax(thresholds) < drive().certificate.claims["threshold"] * (1.0 + 1e-9)
    gapped = data.drop(index=range(100, 103))
    table = obsynth.run_on_data(drive(), gapped, monitor=obsynth.online_monitor(drive())).table
    undecided = np.isnan(table["threshold"].to_numpy(dtype=float))
    assert undecided[100:129].all()
    assert not undecided[130:].any()


def test_bounds_of_a_design_are_not_changed_by_its_monitor() -> None:
    with pytest.raises(obsynth.SpecError, match="noise_bound cannot be given"):
        obsynth.monitor(drive(), spec().scenario, noise_bound=2.0)
    with pytest.raises(obsynth.SpecError, match="its own threshold"):
        obsynth.online_monitor(drive(), "cusum")


@cache
def tanks() -> obsynth.DescriptorSystem:
    return obsynth.load_spec(ROOT / "designs/tanks/spec.yaml").plant


LEVELS = ("leak 1", "leak 2", "clog 13")
OPTIONS = {"course": "constant", "samples": 12, "noise_bound": 3.0}


@cache
def three() -> obsynth.GuaranteedTest:
    return obsynth.guaranteed_test(tanks(), isolate=True, **OPTIONS)


@pytest.mark.long
def test_three_levels_isolate_three_faults() -> None:
    bank = three()
    assert bank.report.passed
    assert bank.groups == (("leak 1",), ("leak 2",), ("clog 13",))
    with pytest.raises(obsynth.SpecError, match="No combination of signals hides this fault"):
        obsynth.plotting.plot_hidden_course(bank)
    assert set(bank.pairs) == {(one, two) for one in LEVELS for two in LEVELS if one != two}
    # Blind to less, a test is no worse; blind to all others it is that alone.
    assert all(bank.pairs[one, two] <= bank.tests[LEVELS.index(one)].threshold for one, two in bank.pairs)
    alone = obsynth.guaranteed_test(tanks(), "leak 2", **OPTIONS)
    assert bank.tests[1].threshold == pytest.approx(alone.threshold, rel=1e-12)
    with pytest.raises(obsynth.SpecError, match="is a bank"):
        _ = bank.threshold
    plant, rng = tanks(), np.random.default_rng(2)
    # Leak 2 alone, of twice its threshold, with noise within its bounds and an input that moves.
    size = 1.001 * bank.tests[1].surely_found
    x, rows, inputs = np.zeros(3), [], []
    for _ in range(20):
        u = 1e-6 * rng.standard_normal(2)
        rows.append(plant.C @ x + plant.Dw @ rng.uniform(-3.0, 3.0, 3))
        inputs.append(u)
        x = plant.A @ x + plant.B @ u + plant.Bf[:, 1] * size
    y, u = np.array(rows), np.array(inputs)
    for test in bank.tests:
        assert test.alarms(test.observer.run(y, u))[-1] == (test.fault == "leak 2")
    point = [plant.operating_point.get(name, 0.0) for name in (*plant.input_names, *plant.output_names)]
    data = pd.DataFrame(np.hstack([u, y]) + point, columns=[*plant.input_names, *plant.output_names])
    data.insert(0, "time", np.arange(20) * plant.dt)
    run = obsynth.run_on_data(bank, data, monitor=obsynth.online_monitor(bank))
    assert run.isolated == "leak 2"
    assert {event.fault for event in run.events} == {"leak 2"}


@pytest.mark.long
def test_a_bank_over_many_runs_is_never_wrong(tmp_path: Path) -> None:
    size = 2.0 * three().tests[0].threshold
    scenario = obsynth.load_spec(ROOT / "designs/tanks/spec.yaml").scenario.replace(
        horizon=60.0, faults={"leak 1": obsynth.Step(size=1.05 * size, start=20.0)}, sensors={}, disturbances={}
    )
    bounded = scenario.replace(noise=1.0)
    watched = obsynth.monitor(three(), bounded)
    found = obsynth.evaluate(three(), bounded, runs=10, monitor=watched)
    # Noise of one deviation does not pass three: no alarm is false, no fault is missed, none is taken for another.
    assert (found.false_alarm_rate.value, found.missed_detection_rate.value) == (0.0, 0.0)
    assert found.isolation_error_rate.value == 0.0
    seen = watched.watch(obsynth.simulate(three(), bounded).estimates)
    assert seen.fault == "leak 1"
    assert np.all(seen.threshold[11:] == 1.0)


@pytest.mark.long
def test_exact_intervals_over_many_runs() -> None:
    plant, size = drive().linear[0], 0.4
    options = {"course": "constant", "samples": 8, "disturbance_bounds": 1.0, "noise_bound": 3}
    fixed, exact = obsynth.guaranteed_test(plant, **options), obsynth.guaranteed_test(plant, exact=True, **options)
    scenario = spec().scenario.replace(horizon=1.0, faults={"loss of torque": obsynth.Step(size=size, start=0.4)})
    found = {test: obsynth.evaluate(test, scenario, runs=4, monitor=obsynth.monitor(test, scenario))
             for test in (fixed, exact)}  # fmt: skip
    assert (found[fixed].missed_detection_rate.value, found[exact].missed_detection_rate.value) == (1.0, 0.0)
    assert found[exact].false_alarm_rate.value == 0.0


@pytest.mark.long
def test_two_levels_tell_pairs_and_name_the_smallest_group(tmp_path: Path) -> None:
    two = tanks().replace(C=tanks().C[:2], D=None, Df=None, Dw=None, Bw=None, noise_names=None,
                          output_names=["h1", "h2"], operating_point={}, units={})  # fmt: skip
    bank = obsynth.guaranteed_test(
        two, isolate=True, **{**OPTIONS, "noise_bound": {"h1": 0.003, "h2": 0.003}, "samples": 9}
    )
    assert all(np.isfinite(size) for size in bank.pairs.values())
    assert all(len(group) == 2 for group in bank.groups)
    assert bank.report["smallest group[leak 1]"].passed
    assert "together give the same outputs" in " ".join(bank.notes)
    # What is drawn is a course of the plant that no output shows.
    course = bank.hidden_course("leak 2")
    x, f = (np.array([course.get(name, np.zeros(8)) for name in names]).T for names in (two.state_names, LEVELS))
    assert np.abs(x[1:] - x[:-1] @ two.A.T - f[:-1] @ two.Bf.T).max() <= 1e-12 * np.abs(f).max()
    assert np.abs(x @ two.C.T).max() <= 1e-12 * np.abs(x).max()
    assert course["leak 2"].tolist() == [1.0] * 8
    page = obsynth.html_report(bank, tmp_path / "bank.html").read_text()
    assert "Why leak 2 is not isolated" in page
    saved = obsynth.load(bank.save(tmp_path / "bank.json"))
    assert obsynth.verify(saved).passed
    monitor = obsynth.online_monitor(saved)
    assert "never passed without leak 1 or clog 13 while" in monitor.statement
    # One fault less in a group, or a smaller threshold of a pair, is a claim that does not hold.
    groups, pairs = saved.certificate.matrices["groups"].copy(), saved.certificate.matrices["pairs"].copy()
    groups[0], pairs[0, 1] = [1.0, 0.0, 0.0], 0.999 * pairs[0, 1]
    for name, changed, row in (("groups", groups, "certificate[leak 1]"), ("pairs", pairs, "pairs")):
        certificate = Certificate({**saved.certificate.matrices, name: changed}, saved.certificate.claims)
        assert row in {check.name for check in obsynth.verify(saved.replace(certificate=certificate)).failures}
    whole = np.ones((3, 3))
    certificate = Certificate({**saved.certificate.matrices, "groups": whole}, saved.certificate.claims)
    assert not obsynth.verify(saved.replace(certificate=certificate)).passed


def test_the_least_interval_of_a_window_holds_the_fault_and_finds_what_no_fixed_test_does() -> None:
    options = {"course": "constant", "samples": 8, "disturbance_bounds": {"load torque": 1.0}, "noise_bound": 3}
    test = obsynth.guaranteed_test(spec().plant, **options)
    plant, rng, fault = test.linear[0], np.random.default_rng(11), test.threshold
    bound = 3.0 * np.diag(plant.Dw)
    x, rows = rng.standard_normal(plant.nx), []
    for _ in range(14):
        rows.append(plant.C @ x + bound * rng.uniform(-1.0, 1.0, 2))
        x = plant.A @ x + plant.Bd[:, 0] * rng.uniform(-1.0, 1.0) + plant.Bf[:, 0] * fault
    y, u = np.array(rows), np.zeros((14, 1))
    low, high = test.exact_interval(y, u)
    assert np.isnan(low[:7]).all()
    assert np.all((low[7:] <= fault) & (fault <= high[7:]))
    fixed = test.interval(test.observer.run(y, u))
    assert np.all(high[7:] - low[7:] < 0.8 * (fixed[1] - fixed[0])[7:])
    # The fixed test is silent on some row on which zero is outside of the least interval.
    assert np.any((low[7:] > 0.0) & (fixed[0][7:] <= 0.0))


def test_the_cheapest_sensors_for_a_threshold() -> None:
    plant = obsynth.DescriptorSystem(
        None, [[1.0, 1.0], [0.0, 1.0]], C=[[1.0, 0.0]], Bd=[[0.0], [1.0]], Bf=[[0.0], [1.0]], dt=1.0,
        state_names=["position", "speed"], output_names=["gauge"], sensor_noise={"gauge": 0.5},
    )  # fmt: skip
    test = {"course": "constant", "samples": 5, "disturbance_bounds": 0.25, "noise_bound": 1.0}
    asked = {"goal": "threshold", "fault": "f1", "noise": 0.05, "candidates": ["speed", "position"], "test": test}
    # The gauge alone has W + 16 V / 16 = 0.75; a speed with V = 0.05 has W + 2 V / 4 = 0.275.
    found = obsynth.sensor_sets(plant, below=0.3, **asked)
    assert found.sets[0].sensors == ("speed",)
    assert found.sets[0].threshold is not None
    assert found.sets[0].threshold <= 0.275 + 1e-9
    assert obsynth.sensor_sets(plant, below=0.76, **asked).sets[0].sensors == ()
    assert "samples" in str(found)
    with pytest.raises(obsynth.PreconditionError, match=r"the least is 0\.2"):
        obsynth.sensor_sets(plant, below=0.25, **asked)
    with pytest.raises(obsynth.SpecError, match="needs fault"):
        obsynth.sensor_sets(plant, goal="threshold", noise=0.05)


def test_sensors_of_a_plant_of_equations_say_how_to_make_it_linear(capsys: pytest.CaptureFixture[str]) -> None:
    spec = Path(__file__).parents[2] / "designs" / "diode_circuit" / "spec.yaml"
    assert main(["sensors", "--system", str(spec)]) == obsynth.SpecError.exit_code
    assert "transform: {linearise: {at: equilibrium" in " ".join(capsys.readouterr().err.split())
