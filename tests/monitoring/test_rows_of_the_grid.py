"""A sampled design counts samples: stamps that are off and rows that are missing change nothing of what is decided."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from test_c_on_logs import told
from test_flaws_of_logs import designed, heated, log, recursive
from test_missing_inputs import lag, log_of, measured

import obsynth
from obsynth.errors import SpecError

pytestmark = pytest.mark.usefixtures("taken_as_verified")
DT, ROWS, FAULT_AT = 0.1, 220, 170
BLANK = (*range(60, 64), *range(110, 112), 140)
BOUNDS: dict[str, Any] = {"disturbance_bounds": {"d": 0.2}, "noise_bound": 3**0.5}
QUIET: dict[str, Any] = {"scenario": obsynth.Scenario(horizon=20.0, noise=1.0), "false_alarms": 0.01}
LINEAR: dict[str, dict[str, Any]] = {
    "pointwise": BOUNDS, "window": {**BOUNDS, "window": 5}, "chi-square": {"window": 3, **QUIET},
    "cusum": {"change": 2.0, **QUIET}, "learned": {}, "levels": {},
}  # fmt: skip
STEPPING: dict[str, dict[str, Any]] = {
    "chi-square": {"false_alarms": 0.01}, "nis": {"false_alarms": 0.01}, "learned": {}, "levels": {},
}  # fmt: skip
CASES = [
    *(("ui-pi-observer", kind) for kind in LINEAR),
    *(("recursive", kind) for kind in STEPPING),
    ("recursive", "cusum"),
    *(("nonlinear", kind) for kind in STEPPING),
    ("guaranteed", "pointwise"),
]


@cache
def design_of(name: str) -> obsynth.ObserverDesign:
    if name == "guaranteed":
        return obsynth.guaranteed_test(heated(), fault="f", samples=14, **BOUNDS)
    return {"recursive": recursive, "nonlinear": lag}.get(name, lambda: designed(name))()


@cache
def monitor_of(name: str, kind: str) -> obsynth.types.Monitor | None:
    if kind == "levels":
        return None
    design = design_of(name)
    if kind == "learned":
        # The fault shall alarm whatever the input does, and however slowly the estimates follow it.
        return obsynth.online_monitor(design, "learned", normal=replace(told(design), ranges=None, memory=0.0))
    if name == "guaranteed":
        return obsynth.online_monitor(design)
    options = (
        {"change": 0.2, "false_alarms": 0.01} if (name, kind) == ("recursive", "cusum") else STEPPING.get(kind, {})
    )
    return obsynth.online_monitor(design, kind, **(LINEAR[kind] if name == "ui-pi-observer" else options))


@cache
def noisy(name: str, rows: int = ROWS) -> pd.DataFrame:
    """A log of a fault that begins late."""
    if name == "nonlinear":
        u, y = measured(rows)
        y[FAULT_AT:ROWS] += 0.3
        return log_of(u, y)
    data, rng = log(rows=rows), np.random.default_rng(4)
    faulty = log(fault=0.5, rows=ROWS - FAULT_AT)[["a", "b"]].to_numpy() - log(rows=ROWS - FAULT_AT)[["a", "b"]]
    data.loc[FAULT_AT : ROWS - 1, ["a", "b"]] += faulty.to_numpy()
    data[["a", "b"]] += 0.01 * rng.standard_normal((rows, 2))
    return data


def blanked(name: str, rows: int = ROWS) -> pd.DataFrame:
    data = noisy(name, rows).copy()
    data.loc[[*BLANK, *range(80, 82)], [column for column in data if column != "time"]] = np.nan
    # Single cells as well, the last before the fault.
    data.loc[[95, 165], data.columns[-1]] = np.nan
    return data


def run(name: str, kind: str, data: pd.DataFrame, **options: Any) -> pd.DataFrame:
    design = design_of(name)
    fault = f"fhat[{design.observer.fault_names[0]}]" if design.observer.fault_names else ""
    levels = {fault: 0.3} if kind == "levels" else {}
    waiting = {} if name == "guaranteed" else {"warm_up": 3 * DT}
    found = obsynth.run_on_data(
        design, data, thresholds=levels, monitor=monitor_of(name, kind), **waiting, **options
    ).table
    assert found is not None
    return found


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("name", "kind"), CASES)
def test_stamps_that_jitter_decide_as_regular_ones(name: str, kind: str) -> None:
    data, rng = blanked(name), np.random.default_rng(7)
    wanted = run(name, kind, data)
    # A clock whose stamps are off by a fifth of a sample, and which tells dates of today.
    data["time"] = 1.79e9 + data["time"] + DT * rng.uniform(-0.2, 0.2, ROWS)
    found = run(name, kind, data)
    times = [column for column in wanted if column.startswith("time")]
    pd.testing.assert_frame_equal(found.drop(columns=times), wanted.drop(columns=times))
    assert (wanted["alarm"][FAULT_AT:] != "").any()


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("name", "kind"), CASES)
def test_rows_that_are_missing_decide_as_rows_without_signals(name: str, kind: str, tmp_path: Path) -> None:
    data = blanked(name)
    wanted = run(name, kind, data).drop(index=[*BLANK]).reset_index(drop=True)
    dropped = data.drop(index=[*BLANK]).reset_index(drop=True)
    pd.testing.assert_frame_equal(run(name, kind, dropped), wanted)
    # The same where a run goes on from a saved state in front of the rows that are missing.
    state = tmp_path / "state.json"
    parts = [run(name, kind, part, state=state) for part in (dropped[:60], dropped[60:])]
    pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), wanted)


@pytest.mark.parametrize("kind", ["ui-pi-observer", "recursive", "nonlinear"])
@pytest.mark.long
def test_thresholds_learned_from_rows_that_are_missing_are_those_of_rows_without_signals(kind: str) -> None:
    data = blanked(kind, 500)
    found = [
        obsynth.learn_thresholds(design_of(kind), log, false_alarms="1 per 50 rows")
        for log in (data, data.drop(index=[*BLANK]))
    ]
    np.testing.assert_array_equal(found[0].levels, found[1].levels)
    np.testing.assert_array_equal(found[0].scales, found[1].scales)


def test_rows_that_a_saved_state_has_are_left_out_however_many_they_are(tmp_path: Path) -> None:
    """A log that grows is read again as a whole; there were ten such rows at most."""
    data, state = log(), tmp_path / "s.json"
    wanted = run("ui-pi-observer", "levels", data)
    run("ui-pi-observer", "levels", data[:60], state=state)
    found = run("ui-pi-observer", "levels", data, state=state)
    assert found["status"][:60].isin(["out of order", "repeated stamp"]).all()
    pd.testing.assert_frame_equal(found[60:], wanted[60:])
    twice = pd.concat([data[:60], data[:30]], ignore_index=True)
    with pytest.raises(SpecError, match=r"falls from [^;]* s, as it has since row 61\."):
        run("ui-pi-observer", "levels", twice)


def test_a_repeated_row_after_a_saved_state_is_left_out_where_stamps_jitter(tmp_path: Path) -> None:
    data, rng = noisy("ui-pi-observer").copy(), np.random.default_rng(9)
    data["time"] += DT * rng.uniform(-0.2, 0.2, ROWS)
    data = pd.concat([data[:81], data[80:]], ignore_index=True)
    wanted, state = run("ui-pi-observer", "levels", data), tmp_path / "state.json"
    parts = [run("ui-pi-observer", "levels", part, state=state) for part in (data[:81], data[81:])]
    pd.testing.assert_frame_equal(pd.concat(parts, ignore_index=True), wanted)
    assert wanted["status"][81] == "repeated stamp"


def test_alarms_on_both_sides_of_many_missing_rows_are_two() -> None:
    design, data = recursive(), log(fault=0.5, rows=ROWS)
    gone = [*range(120, 150)]
    blank = data.copy()
    blank.loc[gone, ["u", "a", "b"]] = np.nan
    for found, last in ((blank, ROWS), (data.drop(index=gone), ROWS - len(gone))):
        run = obsynth.run_on_data(design, found, thresholds={"fhat[f]": 0.1})
        before, after = run.events
        assert (before.last_row, after.last_row) == (120, last)
        assert after.end == pytest.approx((ROWS - 1) * DT)
    short = data.drop(index=gone[:10])
    assert len(obsynth.run_on_data(design, short, thresholds={"fhat[f]": 0.1}).events) == 1
