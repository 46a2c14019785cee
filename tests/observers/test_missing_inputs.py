"""Inputs that are missing count as they last were, within what their past changes let them be off by."""

from __future__ import annotations

import ctypes
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from test_flaws_of_logs import designed, log

import obsynth
from obsynth.monitoring.logs.log_run import LogRun
from obsynth.observers.nonlinear.c_code import FLAGS, compiler, shared_library

pytestmark = pytest.mark.usefixtures("taken_as_verified")
DT, RATE, GAIN = 0.1, 2.0, 3.0
FORMS = {
    "forgetting": {"forgetting": 0.98},
    "random-walk": {"form": "random-walk", "random_walk": [[1e-4]]},
    "augmented-kalman": {"form": "augmented-kalman", "random_walk": [[1e-4]]},
}


@cache
def lag(form: str = "augmented-kalman", integration: str = "backward-euler") -> obsynth.ObserverDesign:
    """Return an observer of a lag of first order, with a fault, and an input that acts at once."""
    model = obsynth.DAEModel(
        {"lag": f"der(x) = {RATE} * ({GAIN} * u - x) + f", "sum": "s = x + u"}, {"y": "x", "z": "s"},
        states={"x": 1.0, "s": 1.0}, inputs={"u": 0.5}, parameters={"f": 0.0},
    )  # fmt: skip
    return obsynth.dae_adaptive_observer(
        model, dt=DT, Q=np.diag([1e-6, 1e-6]), R=1e-4 * np.eye(2), integration=integration,
        initial_parameter_covariance=[[0.01]], **FORMS[form],
    )  # fmt: skip


def measured(rows: int = 200, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs that stay for 7 rows, and outputs."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.2, 0.8, rows // 7 + 1), 7)[:rows, None]
    found = obsynth.simulate_dae(lag().plant, u, dt=DT, R=1e-4 * np.eye(2), integration="backward-euler", seed=seed)
    return u, np.array(found.outputs)


def log_of(u: np.ndarray, y: np.ndarray) -> pd.DataFrame:
    return pd.DataFrame({"time": DT * np.arange(len(u)), "u": u[:, 0], "y": y[:, 0], "z": y[:, 1]})


#: Share of an input that a step of a lag takes: 1 - R(-h) of the stability function R.
H = RATE * DT
SHARES = {
    "backward-euler": H / (1 + H),
    "radau": 1 - (1 - 2 / 5 * H + H**2 / 20) / (1 + 3 / 5 * H + 3 / 20 * H**2 + H**3 / 60),
}


@pytest.mark.one_in(4)
@pytest.mark.parametrize("integration", list(SHARES))
@pytest.mark.parametrize("form", list(FORMS))
def test_a_step_without_its_input_is_as_uncertain_as_its_past_changes_allow(form: str, integration: str) -> None:
    u, y = measured()
    observer, lost = lag(form, integration).observer, np.full(2, np.nan)
    state = observer.init()
    for k in range(100):
        state, _ = observer.advance(state, y[k], u[k])
    change, width = np.abs(np.diff(u[:100, 0])).max(), np.ptp(u[:100, 0])
    held = missing = state
    off, carried = 0.0, np.zeros((2, 2))
    for k in range(1, 4):
        share = SHARES[integration] * GAIN
        before = np.array([[share], [share + 1.0]])
        # What the step before was off by goes on into this one.
        decayed = 1.0 - SHARES[integration]
        held, row = observer.advance(held, lost, u[99])
        missing, other = observer.advance(missing, lost, np.array([np.nan]))
        np.testing.assert_allclose(other.x, row.x, rtol=1e-12)
        reach = min(k * change, width)
        added = ((off + reach) ** 2 - off**2) * (before @ before.T)
        more = other.covariance - row.covariance
        np.testing.assert_allclose(more, carried + added, rtol=1e-6)
        carried = more[0, 0] * decayed**2 * np.ones((2, 2))
        off += reach


@pytest.mark.one_in(3)
@pytest.mark.parametrize("form", list(FORMS))
def test_an_input_that_moves_while_it_is_missing_moves_no_fault(form: str) -> None:
    """Each gap hides a jump of the input, the first one the largest of all."""
    worst = []
    for seed in range(4):
        u, _ = measured(seed=seed)
        jumps = np.flatnonzero(np.diff(u[:, 0])) + 1
        u[jumps[3] :] += 0.5
        y = np.array(
            obsynth.simulate_dae(
                lag().plant, u, dt=DT, R=1e-4 * np.eye(2), integration="backward-euler", seed=seed
            ).outputs
        )
        data = log_of(u, y)
        for k, row in enumerate(jumps[3::3]):
            data.loc[row - (k % 2) : row + k % 3, "u"] = np.nan
        run = obsynth.run_on_data(lag(form), data)
        assert run.table is not None
        after = run.table[30:]
        assert set(after["status"]) == {"ok", "gap"}
        worst.append((after["fhat[f]"].abs() / after["sd fhat[f]"]).max())
    # 4 records of 170 rows, correlated over some ten: 4.5 deviations come once in 1,000 such tests.
    assert max(worst) <= 4.5


def test_a_wrong_sample_beside_a_missing_input_is_left_out() -> None:
    u, y = measured()
    y[100, 0] += 0.3
    data = log_of(u, y)
    data.loc[100, "u"] = np.nan
    run = obsynth.run_on_data(lag(), data)
    assert run.outliers == {"y": 1}
    assert run.table is not None
    assert (run.table["fhat[f]"].abs() / run.table["sd fhat[f]"])[60:].max() <= 4.5


@pytest.mark.long
def test_a_gap_goes_on_over_a_saved_state(tmp_path) -> None:
    u, y = measured()
    data, state = log_of(u, y), tmp_path / "state.json"
    data.loc[90:93, "u"] = np.nan
    data = data.drop(index=range(120, 124)).reset_index(drop=True)
    whole = obsynth.run_on_data(lag(), data).table
    parts = [obsynth.run_on_data(lag(), data.iloc[rows], state=state).table
             for rows in (slice(0, 91), slice(91, 93), slice(93, 94), slice(94, 120), slice(120, None))]  # fmt: skip
    pd.testing.assert_frame_equal(whole, pd.concat(parts, ignore_index=True), check_exact=True)


def test_the_inputs_of_delayed_samples_may_be_missing() -> None:
    u, y = measured()
    u[100:102] = np.nan
    observer = lag().observer
    running, delayed = observer.start(), replace(observer, sensors={"z": {"delay": 3}}).start()
    arriving = np.column_stack([y[:, 0], np.concatenate([[np.nan] * 3, y[:-3, 1]])])
    for k in range(110):
        found = delayed.step(arriving[k], u[k])
        known = y[k] if k < 107 else np.array([y[k, 0], np.nan])
        wanted = running.step(known, u[k])
    np.testing.assert_allclose(found.states, wanted.states, rtol=1e-12)
    np.testing.assert_allclose(found.state_deviations, wanted.state_deviations, rtol=1e-12)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("rows", [2, 6, 15])
@pytest.mark.parametrize("method", ["ui-pi-observer", "fault-estimation-filter"])
def test_levels_of_linear_designs_decide_after_inputs_that_were_missing(method: str, rows: int) -> None:
    design = designed(method)
    clean, data = log(rows=200), log(rows=200)
    data.loc[100 : 99 + rows, "u"] = np.nan
    wanted = obsynth.run_on_data(design, clean).table
    found = LogRun(design).estimates(data["time"].tolist(), data.iloc[:, 1:].to_numpy())
    assert wanted is not None
    columns = [name for name in wanted.columns if name.startswith(("fhat[", "r["))]
    places = [list(LogRun(design).observer.columns).index(name) for name in columns]
    after = [k for k, row in enumerate(found) if row.status == "recovering"]
    assert after[0] == 100 + rows
    excess = np.array([found[k].excess for k in after])[:, places]
    away = np.abs([found[k].values[places] for k in after] - wanted[columns].to_numpy()[after])
    # 1e-12: rounding of rows that the gap does not reach.  A residual that changes its sign may be left more by inputs
    # that were not off by the same all through the gap: 6 numbers of 300.
    assert (away <= excess + 1e-12)[:, columns.index("fhat[f]")].all()
    assert (away <= 2.5 * excess + 1e-12).all()
    # A fault that the excess is small beside is found in these rows: before, no level decided in them.
    broken = log(rows=200, fault=20.0 * excess.max())
    broken["u"] = data["u"]
    run = obsynth.run_on_data(design, broken, thresholds={"fhat[f]": 1e-3})
    assert run.table is not None
    assert run.table["alarm"][after[0]] == "fhat[f]"
    assert "recovering" not in run.silent


def test_outputs_that_were_measured_all_through_a_gap_of_an_input_start_nothing_again() -> None:
    """The model stood in for no output: that it lost the plant meanwhile moved nothing."""
    design, data = designed("ui-pi-observer"), log(rows=300)
    data.loc[100:140, "u"] = np.nan
    data[["a", "b"]] += np.where(np.arange(300) > 120, 50.0, 0.0)[:, None]
    run = obsynth.run_on_data(design, data)
    assert run.table is not None
    assert "warm-up" not in set(run.table["status"][100:])


def alarms_in_c(data: pd.DataFrame, level: float, folder: Path) -> np.ndarray:
    """Return what the exported observer says of a level in each row."""
    obsynth.export(lag(), folder / "lag.c", thresholds={"fhat[f]": level})
    (folder / "run.c").write_text(
        '#include "lag.h"\nvoid run(const double *in, int *alarm, int rows) {\n'
        "static lag_state state; lag_estimates e; lag_reset(&state);\n"
        "for (; rows-- > 0; in += 3) { lag_step(&state, in, in + 1, &e); *alarm++ = state.alarm[0]; } }\n"
    )
    command = compiler()
    assert command is not None, "these tests need a C compiler"
    texts = {name: (folder / name).read_text() for name in ("lag.h", "lag.c", "run.c")}
    library = ctypes.CDLL(str(shared_library(folder, texts, [*command, *FLAGS], path="test")))
    rows, alarms = np.ascontiguousarray(data[["u", "y", "z"]], dtype=np.float64), np.zeros(len(data), dtype=np.intc)
    double, whole = (ctypes.POINTER(kind) for kind in (ctypes.c_double, ctypes.c_int))
    library.run(rows.ctypes.data_as(double), alarms.ctypes.data_as(whole), len(data))
    return alarms > 0


@pytest.mark.long
def test_levels_are_as_many_times_higher_as_faults_are_less_certain_after_missing_samples(tmp_path) -> None:
    u, y = measured(rows=600)
    data, rng = log_of(u, y), np.random.default_rng(3)
    gaps = [range(first, first + int(rng.integers(1, 5))) for first in range(40, 590, 14)]
    for i, gap in enumerate(gaps):
        data.loc[[*gap], "u" if i % 2 else "y"] = np.nan
    table = obsynth.run_on_data(lag(), data).table
    assert table is not None
    level = float(table["fhat[f]"].abs().median())
    whole = obsynth.run_on_data(lag(), data, thresholds={"fhat[f]": level}).table
    # What is expected, from the columns of the table alone.
    wanted, grown, usual, before = [], 0, 0.0, 0.0
    for status, size, spread in zip(table["status"], table["fhat[f]"].abs(), table["sd fhat[f]"], strict=True):
        usual = before if status != "ok" and not usual else usual
        usual = usual if spread > usual else 0.0
        share = spread / usual if usual else 1.0
        wanted.append("fhat[f]" if status != "gap" and size > level * share else "")
        grown += status != "gap" and level < size <= level * share
        before = spread
    assert grown >= 5
    assert whole is not None
    assert whole["alarm"].tolist() == wanted
    assert alarms_in_c(data, level, tmp_path).tolist() == [bool(text) for text in wanted]
    state = tmp_path / "state.json"
    parts = [obsynth.run_on_data(lag(), part, thresholds={"fhat[f]": level}, state=state).table
             for part in (data[:41], data[41:62], data[62:])]  # fmt: skip
    pd.testing.assert_frame_equal(whole, pd.concat(parts, ignore_index=True))
