"""Running on measured data: exact between irregular stamps, bridged gaps, states that are never poisoned."""

from __future__ import annotations

import io
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import obsynth
from obsynth import SpecError, run_on_data
from obsynth.monitoring.logs.clock import interval
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.loader import load_spec

ROOT = Path(__file__).parents[2]


def designed(folder: str) -> obsynth.ObserverDesign:
    spec = load_spec(ROOT / "designs" / folder / "spec.yaml")
    return obsynth.design(spec.plant, spec.method, name=spec.name, **dict(spec.options))


@pytest.fixture(scope="module")
def sampled() -> obsynth.ObserverDesign:
    return designed("wang2015")


@pytest.fixture(scope="module")
def continuous() -> obsynth.ObserverDesign:
    return designed("sharepasand")


def log_of(design, steps=60, *, faults=(0.3, -0.2)):
    """Return a log of the sampled plant under constant faults and random inputs, with the true states."""
    plant, _ = design.linear
    rng = np.random.default_rng(3)
    u = 0.1 * rng.normal(size=(steps, plant.nu))
    run = simulate_plant(plant, steps=steps, u=u, f=np.tile(faults, (steps, 1)), initial_state=0.1 * np.ones(plant.nx))
    table = pd.DataFrame(np.hstack([u, run.outputs]), columns=[*plant.input_names, *plant.output_names])
    table.insert(0, "time", np.arange(steps) * plant.dt)
    return table, run.states


def random_log(design, times, seed=4):
    plant, _ = design.linear
    names = [*plant.input_names, *plant.output_names]
    rng = np.random.default_rng(seed)
    table = pd.DataFrame(rng.normal(size=(len(times), len(names))), columns=names)
    table.insert(0, "time", times)
    return table


def estimates(table, kind):
    return table[[name for name in table.columns if name.startswith(f"{kind}[")]].to_numpy()


def test_the_numbers_of_a_frame_are_there_once(sampled):
    """Results were parts of 10,000 rows, which were joined and copied into the frame: a million rows took 505 MB."""
    import tracemalloc

    from obsynth.monitoring.logs.sinks import FrameSink
    from obsynth.monitoring.logs.stamps import Stamps

    rows = 20_000
    table = np.arange(3.0 * rows).reshape(3, rows)
    for room in (rows, 10):
        sink = FrameSink(("time", "a", "b"), Stamps(), room)
        for start in range(0, rows, 1000):
            sink(table[:, start : start + 1000].T.tolist())
        sink.frame()  # loads what pandas loads late
        tracemalloc.start()
        try:
            frame = sink.frame()
            held = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert held < 8 * rows  # not one column
        np.testing.assert_array_equal(frame.to_numpy().T, table)


def test_a_frame_gives_back_what_was_read(sampled, tmp_path):
    table = random_log(sampled, np.arange(25) * sampled.linear[1].dt)
    table.to_csv(tmp_path / "log.csv", index=False)
    runs = [run_on_data(sampled, data, chunk_rows=k) for data in (table, tmp_path / "log.csv") for k in (4, 100)]
    for run in runs:
        pd.testing.assert_frame_equal(run.measured, table)
        pd.testing.assert_frame_equal(run.table, runs[0].table)


def test_a_sampled_design_gives_what_its_observer_gives(sampled):
    table, _ = log_of(sampled)
    observer = sampled.linear[1]
    u, y = table[list(observer.input_names)].to_numpy(), table[list(observer.output_names)].to_numpy()
    wanted = observer.run(y, u)
    found = run_on_data(sampled, table).table
    assert np.allclose(estimates(found, "xhat"), wanted.states, rtol=0.0, atol=1e-12)
    assert np.allclose(estimates(found, "fhat"), wanted.faults, rtol=0.0, atol=1e-12)
    assert np.allclose(estimates(found, "r"), wanted.residuals, rtol=0.0, atol=1e-12)


def test_a_late_estimate_names_the_time_it_is_of(sampled):
    table, _ = log_of(sampled)
    found = run_on_data(sampled, table).table
    delay = sampled.observer.fault_delays[0]
    assert delay == 1
    assert np.array_equal(found["time of fhat[actuator 1]"], found["time"] - delay * sampled.observer.dt)
    assert "time of xhat" not in found.columns


@pytest.mark.long
def test_irregular_stamps_are_exact_for_signals_linear_between_rows(continuous):
    times = np.cumsum(np.random.default_rng(1).uniform(0.01, 0.2, size=25))
    table = random_log(continuous, times)
    observer = continuous.linear[1]
    signals = table[[*observer.input_names, *observer.output_names]].to_numpy()

    def slope(t, z):
        v = np.array([np.interp(t, times, column) for column in signals.T])
        return (
            observer.Az @ z
            + observer.Bu @ v[: len(observer.input_names)]
            + observer.By @ v[len(observer.input_names) :]
        )

    z, wanted = np.zeros(observer.order), []
    for k, v in enumerate(signals):
        if k:
            span = (times[k - 1], times[k])
            z = solve_ivp(slope, span, z, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        wanted.append(observer.Cz @ z + np.hstack([observer.Du, observer.Dy]) @ v)
    found = run_on_data(continuous, table).table
    scale = np.abs(wanted).max()
    assert np.allclose(np.hstack([estimates(found, kind) for kind in ("xhat", "fhat", "r")]), wanted, atol=1e-9 * scale)


@pytest.mark.long
def test_regular_stamps_equal_sample_observer(continuous):
    """The same recursion in other coordinates: a start at rest of the one is z = -Gamma_1 v(0) of the other."""
    table = random_log(continuous, 0.05 * np.arange(200))
    table.iloc[0, 1:] = 0.0
    observer = obsynth.sample_observer(continuous.observer, 0.05)
    u, y = table[list(observer.input_names)].to_numpy(), table[list(observer.output_names)].to_numpy()
    found = run_on_data(continuous, table).table
    wanted = observer.run(y, u).states
    assert np.allclose(estimates(found, "xhat"), wanted, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("how", ["missing values", "missing rows"])
def test_the_plant_model_bridges_a_gap(sampled, how):
    """Faults are constant and nothing disturbs: the model is exact, so the states are as well, in the gap and after."""
    table, states = log_of(sampled)
    lost = slice(40, 46)
    before = run_on_data(sampled, table).table
    if how == "missing values":
        table.iloc[lost, 3:] = np.nan
    else:
        # Inputs are held in rows that are not there: they must not change if the model is to be exact.
        plant = sampled.linear[0]
        u = table[list(plant.input_names)].to_numpy(copy=True)
        u[39:46] = u[39]
        run = simulate_plant(
            plant, steps=len(u), u=u, f=np.tile((0.3, -0.2), (len(u), 1)), initial_state=0.1 * np.ones(4)
        )
        states = run.states
        table[list(plant.input_names)], table[list(plant.output_names)] = u, run.outputs
        before = run_on_data(sampled, table).table
        table = table.drop(index=range(40, 46)).reset_index(drop=True)
        states = np.delete(states, lost, axis=0)
    found = run_on_data(sampled, table).table
    assert np.abs(estimates(before, "fhat")[39] - (0.3, -0.2)).max() < 1e-3
    miss = np.abs(estimates(found, "xhat") - states)
    floor = np.abs(estimates(before, "xhat")[39] - (states[39])).max() + 1e-3
    assert miss[40:].max() < 10.0 * floor
    if how == "missing values":
        assert set(found["status"][lost]) == {"gap"}
        assert np.array_equal(estimates(found, "fhat")[lost], np.tile(estimates(found, "fhat")[39], (6, 1)))
        assert np.isnan(estimates(found, "r")[lost]).all()
        assert found["status"][46] == "recovering"
    else:
        assert found["status"][40] == "recovering"
    assert found["status"].iloc[-1] == "ok"


@pytest.mark.long
def test_a_gap_in_continuous_time_is_bridged(continuous):
    """The true plant with a constant fault; in the gap the estimate follows the plant, which is unstable."""
    plant = obsynth.eliminate_algebraic_states(continuous.linear[0])
    times = np.concatenate([np.arange(0, 12.0, 0.05), np.arange(12.6, 14.0, 0.05)])
    fault, x0 = np.array([0.2]), np.array([0.1, -0.05])
    reduced = plant.plant

    def drive(t):
        return np.zeros(reduced.nu)

    def slope(t, x):
        return reduced.A @ x + reduced.B @ drive(t) + reduced.Bf @ fault

    x = solve_ivp(slope, (0.0, 15.0), x0, t_eval=times, method="DOP853", rtol=1e-12, atol=1e-13).y.T
    y = x @ reduced.C.T + fault @ reduced.Df.T
    true = x @ plant.recovery.from_state.T + fault @ plant.recovery.from_fault.T
    table = pd.DataFrame(np.hstack([np.zeros((len(times), reduced.nu)), y]),
                         columns=[*reduced.input_names, *reduced.output_names])  # fmt: skip
    table.insert(0, "time", times)
    whole = table.copy()
    table.iloc[200:210, 2:] = np.nan
    found = run_on_data(continuous, table)
    assert found.statuses["gap"] == 10
    rows = found.table
    assert set(rows["status"][200:210]) == {"gap"}
    assert rows["status"][240] == "recovering"  # after the rows that are not there: 0.65 s, in the middle of 0.05 s
    size = np.abs(true).max()
    assert (
        np.abs(estimates(rows, "xhat")[190:] - true[190:]).max() < 1e-3 * size
    )  # the plant outgrows a straight line between rows
    # Without the bridge the same rows would be taken as one straight line; with it the error is far smaller.
    straight = run_on_data(continuous, whole, gap=10.0).table
    error = np.abs(estimates(rows, "xhat")[240] - true[240]).max()
    assert error < 0.1 * np.abs(estimates(straight, "xhat")[240] - true[240]).max()


@pytest.fixture(scope="module")
def driven() -> obsynth.ObserverDesign:
    """An observer of x1' = -x1 + x2, x2' = -2 x2 + u, with a fault on x1 that stays zero."""
    plant = obsynth.DescriptorSystem(
        np.eye(2), [[-1.0, 1.0], [0.0, -2.0]], [[0.0], [1.0]], np.eye(2), Bf=[[1.0], [0.0]]
    )
    return obsynth.design(plant, "ui-pi-observer", fault_model="step")


@pytest.mark.parametrize("lost", ["rows", "outputs", "outputs of one sensor"])
def test_the_input_goes_on_as_a_straight_line_in_a_gap(driven, lost):
    """u = 0.3 t, of which x2 = 0.15 t - 0.075 (1 - e^-2t) and x1 follow: exact in the gap and at once after it."""
    times = 0.02 * np.arange(700)
    start, end = 400, 500
    x2 = 0.15 * times - 0.075 * (1.0 - np.exp(-2.0 * times))
    x1 = 0.15 * times - 0.225 + 0.3 * np.exp(-times) - 0.075 * np.exp(-2.0 * times)
    states = np.column_stack([x1, x2])
    assert np.abs(np.gradient(x1, times) + x1 - x2)[1:-1].max() < 1e-4  # the formula is right
    table = pd.DataFrame({"time": times, driven.linear[0].input_names[0]: 0.3 * times, "y1": x1, "y2": x2})
    if lost == "rows":
        table, states = table.drop(index=range(start, end)), np.delete(states, slice(start, end), axis=0)
    else:
        table.loc[start : end - 1, ["y1", "y2"] if lost == "outputs" else ["y2"]] = np.nan
    found = run_on_data(driven, table.reset_index(drop=True)).table
    # Between rows the outputs are curved, and the observer takes them as straight: that alone is below this.
    allowed = 2.0 * np.abs(estimates(found, "xhat")[300:start] - states[300:start]).max() + 1e-9
    assert allowed < 1e-4
    assert np.abs(estimates(found, "xhat")[start:] - states[start:]).max() < allowed
    assert list(found["status"][start : start + 1]) == (["recovering"] if lost == "rows" else ["gap"])
    # An input that is held at its last value would miss x2 by 0.3 * 2 s / 2 in the end.
    assert abs(0.3 * (times[end] - times[start]) / 2.0) > 1000.0 * allowed


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e308])
def test_a_bad_row_never_poisons_the_state(sampled, bad):
    table, states = log_of(sampled, 80)
    table.iloc[20, 3:] = bad
    found = run_on_data(sampled, table).table
    assert np.isfinite(estimates(found, "xhat")[70:]).all()
    assert np.abs(estimates(found, "xhat")[75:] - states[75:]).max() < 0.05 * np.abs(states).max()


@pytest.mark.long
def test_a_model_that_has_lost_the_plant_is_dropped(continuous):
    """The plant is unstable, 2/3 per second: after 100 s without sensors its model is off by e^66 times any error."""
    times = 0.05 * np.arange(2600)
    table = random_log(continuous, times)
    table.iloc[300:2300, 1:] = np.nan
    found = run_on_data(continuous, table).table
    assert np.abs(estimates(found, "xhat")[2299]).max() > 1e20
    assert found["status"][2300] == "warm-up"
    before, after = (np.abs(estimates(found, "xhat")[rows]).max() for rows in (slice(100, 300), slice(2300, 2600)))
    assert after < 3.0 * before
    assert found["status"].iloc[-1] == "ok"


def test_nothing_is_known_before_the_first_good_row(sampled):
    table, _ = log_of(sampled)
    table.iloc[:3, 1:] = np.nan
    found = run_on_data(sampled, table).table
    assert list(found["status"][:4]) == ["gap", "gap", "gap", "warm-up"]
    assert np.isnan(estimates(found, "xhat")[:3]).all()
    observer = sampled.linear[1]
    rest = table.iloc[3:]
    wanted = observer.run(rest[list(observer.output_names)].to_numpy(), rest[list(observer.input_names)].to_numpy())
    assert np.allclose(estimates(found, "xhat")[3:], wanted.states, rtol=0.0, atol=1e-12)


def test_a_long_gap_starts_the_observer_again(continuous):
    times = np.concatenate([0.01 * np.arange(50), 1000.0 + 0.01 * np.arange(50)])
    found = run_on_data(continuous, random_log(continuous, times)).table
    fresh = run_on_data(continuous, random_log(continuous, times).iloc[50:]).table
    assert found["status"][50] == "warm-up"
    # The stamps 1000.01 resolve less than 0.01, alike in both runs.
    assert np.array_equal(estimates(found, "xhat")[50:], estimates(fresh, "xhat"))


def test_warm_up_is_until_the_slowest_mode_has_settled(sampled, continuous):
    table = random_log(continuous, 0.01 * np.arange(400))
    slowest = -np.linalg.eigvals(continuous.observer.Az).real.max()
    found = run_on_data(continuous, table).table
    first = found["time"][found["status"] == "ok"].iloc[0]
    assert abs(first - np.log(50.0) / slowest) <= 0.0101
    assert run_on_data(continuous, table, warm_up=0.0).statuses == {"ok": 400}
    assert run_on_data(sampled, log_of(sampled)[0], warm_up=7.0).statuses == {"warm-up": 7, "ok": 53}


class TestOperatingPoint:
    def shifted(self, design):
        plant, _ = design.linear
        point = {"x2": 10.0, "x1": -4.0, "u1": 5.0}
        changed = design.replace(plant=plant.replace(operating_point=point))
        table, _ = log_of(design)
        moved = table.copy()
        moved["x2"] += 10.0
        moved["u1"] += 5.0
        return changed, table, moved

    def test_it_is_subtracted_and_added_back(self, sampled):
        changed, table, moved = self.shifted(sampled)
        plain, found = run_on_data(sampled, table).table, run_on_data(changed, moved)
        assert np.allclose(found.table["xhat[x2]"], plain["xhat[x2]"] + 10.0, atol=1e-9)
        assert np.allclose(found.table["xhat[x1]"], plain["xhat[x1]"] - 4.0, atol=1e-9)
        assert np.allclose(found.table["xhat[x3]"], plain["xhat[x3]"], atol=1e-9)
        assert found.warnings == ()

    def test_data_that_begin_far_away_are_warned_of(self, sampled):
        changed, table, _ = self.shifted(sampled)
        first, second = sorted(run_on_data(changed, table).warnings)
        assert first.startswith("u1 begins at")
        assert second.startswith("x2 begins at")
        assert "operating point 10" in second

    def test_columns_and_scales(self, sampled):
        table, _ = log_of(sampled)
        wanted = run_on_data(sampled, table).table
        renamed = table.rename(columns={"x2": "speed", "time": "t"})
        renamed["speed"] *= 1000.0
        found = run_on_data(sampled, renamed, columns={"x2": "speed", "time": "t"}, scales={"x2": 1e-3}).table
        pd.testing.assert_frame_equal(found, wanted, rtol=1e-12, atol=1e-12)


class TestAlarms:
    def test_they_name_the_column_and_the_time_and_wait_for_the_warm_up(self, sampled):
        table, _ = log_of(sampled)
        found = run_on_data(sampled, table, thresholds={"fhat[actuator 1]": 0.25, "fhat[actuator 2]": 0.25})
        ok = found.table["status"] == "ok"
        above = ok & (found.table["fhat[actuator 1]"].abs() > 0.25)
        assert found.alarms["fhat[actuator 1]"] == found.table["time"][above].iloc[0]
        assert set(found.table["alarm"][~ok]) == {""}
        assert found.table["alarm"].iloc[-1] == "fhat[actuator 1]"

    def test_they_are_suspended_in_a_gap(self, sampled):
        table, _ = log_of(sampled)
        table.iloc[50:, 3:] = np.nan
        found = run_on_data(sampled, table, thresholds={"fhat[actuator 1]": 0.25}).table
        assert found["alarm"][49] == "fhat[actuator 1]"
        assert set(found["alarm"][50:]) == {""}


class TestSameResults:
    @pytest.fixture(params=["sampled", "continuous"])
    def case(self, request, tmp_path):
        design = request.getfixturevalue(request.param)
        times = np.arange(60) * design.observer.dt if design.observer.dt else 0.1 * np.arange(60)
        table = random_log(design, times)
        table.iloc[10:14, 2] = np.nan
        table.iloc[33, 1:] = np.nan
        table = table.drop(index=[20, 21, 22]).reset_index(drop=True)
        source = tmp_path / "log.csv"
        table.to_csv(source, index=False)
        run_on_data(design, source, tmp_path / "whole.csv", thresholds={estimate_of(design): 0.5})
        return design, source, (tmp_path / "whole.csv").read_text(), tmp_path

    @pytest.mark.parametrize("rows", [1, 7, 1000])
    def test_in_chunks(self, case, rows):
        design, source, wanted, folder = case
        run_on_data(design, source, folder / "out.csv", chunk_rows=rows, thresholds={estimate_of(design): 0.5})
        assert (folder / "out.csv").read_text() == wanted

    def test_from_a_stream_row_by_row(self, case):
        design, source, wanted, _ = case
        lines, out = iter(source.read_text().splitlines(keepends=True)), io.StringIO()
        answered = []

        class Source(io.StringIO):
            def readline(self, *_):
                answered.append(out.getvalue().count("\n"))
                return next(lines, "")

        run_on_data(design, Source(), out, thresholds={estimate_of(design): 0.5})
        assert out.getvalue() == wanted
        # Before each further line is read, every line so far has been answered.
        assert answered[2:] == list(range(2, len(answered)))

    def test_from_parquet_and_a_frame(self, case):
        design, source, wanted, folder = case
        frame = pd.read_csv(source)
        frame.to_parquet(folder / "log.parquet")
        levels = {estimate_of(design): 0.5}
        run_on_data(design, folder / "log.parquet", folder / "out.csv", chunk_rows=9, thresholds=levels)
        assert (folder / "out.csv").read_text() == wanted
        run_on_data(design, source, folder / "out.parquet", chunk_rows=9, thresholds=levels)
        table = run_on_data(design, frame, thresholds=levels).table
        pd.testing.assert_frame_equal(pd.read_parquet(folder / "out.parquet"), table, check_dtype=False)

    @pytest.mark.one_in(6)
    @pytest.mark.parametrize("cut", [1, 12, 20, 33, 34])
    def test_when_stopped_and_gone_on(self, case, cut):
        design, source, wanted, folder = case
        head, *rows = source.read_text().splitlines(keepends=True)
        found = ""
        for part in (rows[:cut], rows[cut:]):
            (folder / "part.csv").write_text(head + "".join(part))
            run_on_data(design, folder / "part.csv", folder / "out.csv", state=folder / "state.json",
                        thresholds={estimate_of(design): 0.5})  # fmt: skip
            found += "".join((folder / "out.csv").read_text().splitlines(keepends=True)[bool(found) :])
        assert found == wanted


def estimate_of(design):
    return f"fhat[{design.observer.fault_names[0]}]"


class TestState:
    def test_of_another_gain_set_or_damaged_is_refused(self, sampled, continuous, tmp_path):
        state = tmp_path / "state.json"
        table = random_log(continuous, [0.0, 0.1])
        run_on_data(continuous, table, state=state)
        with pytest.raises(SpecError, match="another gain set"):
            run_on_data(sampled, log_of(sampled)[0], state=state)
        with pytest.raises(SpecError, match="another gap or warm-up"):
            run_on_data(continuous, table, state=state, warm_up=3.0)
        state.write_text(state.read_text().replace("0.1", "0.2"))
        with pytest.raises(SpecError, match="digest does not match"):
            run_on_data(continuous, table, state=state)

    def test_is_left_alone_by_a_run_that_fails(self, continuous, tmp_path):
        state = tmp_path / "state.json"
        run_on_data(continuous, random_log(continuous, [0.0, 0.1]), state=state)
        before = state.read_text()
        with pytest.raises(SpecError, match="Row 1 has no time"):
            run_on_data(continuous, random_log(continuous, [np.nan, 0.2]), state=state)
        assert state.read_text() == before


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, *[1.0] * 12], "Row 13 repeats the time 1 s"),
        ([0.0, 1.0, *[0.5] * 12], "Row 13: the time falls from 1 to 0.5 s"),
        ([0.0, 1.0, 2.48], r"Row 3 comes 1\.48 s after the row before, but the design has dt = 1 s"),
        ([0.0, 2.0, 4.0], "Row 3: the log is sampled every 2 s, but the design needs 1 s"),
        ([0.0, 0.5, 1.0], "Row 2 comes 0.5 s"),
        ([0.0, np.nan, 2.0], "Row 2 has no time"),
    ],
)  # fmt: skip
def test_stamps_that_a_sampled_design_refuses(sampled, times, message):
    with pytest.raises(SpecError, match=message):
        run_on_data(sampled, random_log(sampled, times))


def test_options_are_checked(sampled, continuous):
    table = random_log(continuous, [0.0, 0.1])
    with pytest.raises(SpecError, match="gap is 0"):
        run_on_data(continuous, table, gap=0.0)
    with pytest.raises(SpecError, match="gap is for continuous"):
        run_on_data(sampled, log_of(sampled)[0], gap=3.0)
    with pytest.raises(SpecError, match="warm_up is -1"):
        run_on_data(continuous, table, warm_up=-1.0)
    with pytest.raises(SpecError, match="chunk_rows"):
        run_on_data(continuous, table, chunk_rows=0)
    with pytest.raises(SpecError, match="no input or output of this observer"):
        run_on_data(continuous, table, columns={"speed": "y1"})
    with pytest.raises(SpecError, match="'time' is no input"):
        run_on_data(continuous, table, columns={"time": "time"}, scales={"time": 1e-3})
    with pytest.raises(SpecError, match="scale of 'y1'"):
        run_on_data(continuous, table, scales={"y1": 0.0})
    with pytest.raises(SpecError, match="no column 'fhat' to monitor"):
        run_on_data(continuous, table, thresholds={"fhat": 1.0})
    with pytest.raises(SpecError, match="give a positive number"):
        run_on_data(continuous, table, thresholds={"fhat[fault]": -1.0})


@pytest.mark.parametrize("dt", [0.0, 0.5])
def test_a_plant_without_known_inputs_goes_on_from_a_saved_state(tmp_path, dt):
    """There is nothing to remember of the inputs, in as many samples as the estimates lag."""
    A = [[-0.5, 1.0], [-2.0, -0.8]] if dt == 0.0 else [[0.7, 0.1], [0.0, 0.5]]
    plant = obsynth.DescriptorSystem(None, A, C=np.eye(2), Bf=[[0.0], [1.0]], dt=dt)
    design = obsynth.ui_pi_observer(plant) if dt == 0.0 else obsynth.fault_estimation_filter(plant)
    log = random_log(design, np.arange(60) * 0.5)
    log.loc[20:24, plant.output_names[0]] = np.nan
    whole = run_on_data(design, log).table
    for cut in (1, 2, 10, 22, 26, 59):
        state = tmp_path / f"{cut}.json"
        parts = [run_on_data(design, part, state=state).table for part in (log[:cut], log[cut:])]
        pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), whole, check_exact=True)


def test_equal_intervals_are_equal_in_spite_of_rounding():
    stamps = [0.1 * k for k in range(1000)]
    assert {interval(a, b) for a, b in pairwise(stamps)} == {0.1}
    assert interval(0.0, 1e-300) == 1e-300
    assert interval(1.0, 1.0 + 2.0**-52) > 0.0


@pytest.mark.parametrize("continuous", [False, True])
def test_rows_in_one_piece_are_those_of_single_steps_bit_for_bit(continuous, monkeypatch):
    """With bad cells, missing rows, irregular stamps in continuous time, an overflow, and pieces of any length."""
    from obsynth.monitoring.logs import log_run as data_run

    rng = np.random.default_rng(8)
    a = 0.4 * rng.normal(size=(3, 3))
    plant = obsynth.DescriptorSystem(
        None,
        a - 3.0 * np.eye(3) if continuous else a,
        rng.normal(size=(3, 1)),
        np.eye(3)[:2],
        Bf=np.eye(3)[:, :1],
        dt=0.0 if continuous else 0.1,
    )
    design = obsynth.ui_pi_observer(plant)
    run = data_run.LogRun(design)
    count = 300
    intervals = rng.uniform(0.05, 0.3, count) if continuous else np.full(count, 0.1)
    intervals[[40, 200]] = 7.0
    times = np.cumsum(intervals)
    values = rng.normal(size=(count, 3))
    values[60, 1], values[61], values[150, 0], values[[250, 251]] = np.nan, np.nan, np.inf, 1e308
    monkeypatch.setattr(data_run, "ROWS_AT_ONCE", 37)
    whole = run.estimates(times.tolist(), values)
    single = data_run.LogRun(design)
    monkeypatch.setattr(type(single.observer), "takes_pieces", False)
    rows = single.estimates(times.tolist(), values)
    assert {row.status for row in rows} >= {"ok", "gap", "recovering"}
    for number, (ours, theirs) in enumerate(zip(whole, rows, strict=True)):
        assert (ours.status, ours.skipped, ours.settled) == (theirs.status, theirs.skipped, theirs.settled), number
        np.testing.assert_array_equal(ours.values, theirs.values, err_msg=str(number))
    for name, value in run.as_dict()["observer"].items():
        np.testing.assert_array_equal(value, single.as_dict()["observer"][name], err_msg=name)


def test_an_alarm_of_the_initial_condition_response_is_told_with_a_warm_up_that_is_long_enough():
    plant = obsynth.DescriptorSystem(
        A=[[0.98]], B=[[0.02]], C=["level"], Bf=[[0.02]], dt=1.0, state_names=["level"], sensor_noise={"level": 1e-3}
    )
    design = obsynth.ui_pi_observer(plant)
    # Other than what is stuck, a sensor moves.
    rows = pd.DataFrame({"time": np.arange(400.0), "u1": 10.0, "level": 10.0 + 1e-6 * (np.arange(400) % 2)})
    levels = {"fhat[f1]": 0.01}
    (told,) = run_on_data(design, rows, thresholds=levels).warnings
    assert "level begins 1e+04 deviations of its noise from zero (no operating point is stated)" in told
    longer = float(told.rpartition("--warm-up ")[2].rstrip(")."))
    quiet = run_on_data(design, rows, thresholds=levels, warm_up=longer)
    assert (quiet.alarms, quiet.warnings) == ({}, ())
    # At its operating point it alarms of nothing, and an alarm that comes later is a fault.
    known = design.replace(plant=plant.replace(operating_point={"u1": 10.0, "level": 10.0}))
    assert run_on_data(known, rows, thresholds=levels).warnings == ()
    late = rows.assign(level=rows["level"] + np.where(rows["time"] > 300.0, 0.5, 0.0))
    found = run_on_data(design, late, thresholds=levels, warm_up=longer)
    assert found.alarms
    assert found.warnings == ()


@pytest.mark.long
def test_a_log_that_begins_at_other_states_than_a_nonlinear_design_is_told_of_where_it_alarms():
    tank = obsynth.DAEModel(
        {"balance": "2.0 * der(level) = inflow - c * sqrt(level)"},
        {"gauge": "level"},
        states={"level": 1.0},
        inputs={"inflow": 0.1},
        parameters={"c": 0.1},
    )
    walk = {"random_walk": 1e-8, "initial_parameter_covariance": 1e-6}
    design = obsynth.dae_adaptive_observer(tank, dt=1.0, Q=1e-8, R=1e-6, **walk)
    monitor = obsynth.online_monitor(design, "nis")
    for level, told in ((1.0, 0), (2.0, 1)):
        inflow = 0.1 * np.sqrt(level)
        log = pd.DataFrame({"time": np.arange(60.0), "inflow": inflow, "gauge": level})
        found = run_on_data(design, log, monitor=monitor)
        assert bool(found.alarms) == bool(told)
        assert sum("begin at other states than the design" in text for text in found.warnings) == told
