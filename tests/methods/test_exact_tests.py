"""The least interval of each row, and windows with missing samples: on logs, resumed, and whatever the solver says."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.methods.guaranteed_test import exact

ROOT = Path(__file__).parents[2]
OPTIONS = {"course": "constant", "samples": 8, "disturbance_bounds": {"load torque": 1.0}, "noise_bound": 3}


@cache
def test_of(**more: object) -> obsynth.GuaranteedTest:
    plant = obsynth.load_spec(ROOT / "designs/drive/guaranteed_test.yaml").plant
    return obsynth.guaranteed_test(plant, **OPTIONS, **more)


test_of.__test__ = False  # type: ignore[attr-defined]


def log(size: float, *, steps: int = 40, seed: int = 11, bang: bool = False) -> pd.DataFrame:
    """Return a record of the drive with a constant fault, by its equations."""
    plant, rng = test_of().linear[0], np.random.default_rng(seed)
    bound, x, rows = 3.0 * np.diag(plant.Dw), rng.standard_normal(plant.nx), []

    def drawn(count: int) -> np.ndarray:
        found = rng.uniform(-1.0, 1.0, count)
        return np.sign(found) if bang else found

    for k in range(steps):
        u = np.array([np.sin(0.1 * k)])
        rows.append([k * plant.dt, *u, *(plant.C @ x + bound * drawn(2))])
        x = plant.A @ x + plant.B @ u + plant.Bd @ drawn(1) + plant.Bf[:, 0] * size
    return pd.DataFrame(rows, columns=["time", *plant.input_names, *plant.output_names])


def run(data: pd.DataFrame, **more: object) -> obsynth.types.DataRun:
    design = test_of(**more)
    return obsynth.run_on_data(design, data, monitor=obsynth.online_monitor(design))


@pytest.mark.long
def test_the_exact_interval_raises_an_alarm_that_no_fixed_test_finds() -> None:
    size = 0.7 * test_of().threshold
    data = log(size)
    fixed, found = run(data), run(data, exact=True)
    assert not fixed.alarms
    assert "pointwise" in found.alarms
    table = found.table.iloc[7:]
    low, high = (table[f"{end} loss of torque"].to_numpy(dtype=float) for end in ("lowest", "highest"))
    assert np.all((low <= size) & (size <= high))
    assert np.mean(high - low) < 0.6 * 2.0 * test_of().threshold
    assert np.isnan(found.table["threshold"].to_numpy(dtype=float)[:7]).all()
    assert "least interval for its own samples" in obsynth.online_monitor(test_of(exact=True)).statement


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(3))
def test_no_alarm_without_a_fault_at_all_bounds_at_once(seed: int) -> None:
    found = run(log(0.0, seed=seed, bang=True), exact=True)
    assert not found.alarms
    table = found.table.iloc[7:]
    assert np.all(table["lowest loss of torque"] <= 0.0)
    assert np.all(table["highest loss of torque"] >= 0.0)


@pytest.mark.long
def test_a_run_that_was_stopped_goes_on_to_the_last_digit(tmp_path: Path) -> None:
    data = log(test_of().threshold).drop(index=[17, 18])
    data.iloc[25, 2] = np.nan
    options = {"exact": True, "missing": "solve"}
    whole, design = run(data, **options).table, test_of(**options)
    parts = []
    for piece in (data.iloc[:20], data.iloc[20:]):
        parts.append(obsynth.run_on_data(design, piece, monitor=obsynth.online_monitor(design), state=tmp_path / "s"))
    again = pd.concat([part.table for part in parts], ignore_index=True)
    pd.testing.assert_frame_equal(again, whole.reset_index(drop=True), check_exact=True)


def test_a_window_that_no_course_explains_alarms_without_an_interval() -> None:
    size, quiet, faulty = 3.0 * test_of().threshold, log(0.0), log(0.0)
    plant = test_of().linear[0]
    # From row 20 on the motor loses torque: a constant fault explains no window that row 20 is in the middle of.
    response, x = [], np.zeros(plant.nx)
    for k in range(len(quiet)):
        response.append(plant.C @ x)
        x = plant.A @ x + plant.Bf[:, 0] * (size if k >= 20 else 0.0)
    faulty[list(plant.output_names)] += np.array(response)
    table = run(faulty, exact=True).table
    ends = table[["lowest loss of torque", "highest loss of torque"]].to_numpy(dtype=float)
    empty = np.isnan(ends[7:, 0])
    assert empty.any()
    assert (table["alarm"].iloc[7:][empty] != "").all()
    assert np.all(ends[7:20, 0] <= 0.0)
    assert np.all((ends[28:, 0] <= size) & (size <= ends[28:, 1]))


def blanked() -> pd.DataFrame:
    data = log(0.0, bang=True, steps=60)
    data.iloc[20:23, 2] = np.nan  # one of two speeds
    data.iloc[40, 1] = np.nan  # the known input
    return data.drop(index=[50])


@pytest.mark.long
def test_missing_samples_drop_their_rows_or_take_the_verdict() -> None:
    waiting, solved = run(blanked()).table, run(blanked(), missing="solve").table
    undecided = np.isnan(waiting["threshold"].to_numpy(dtype=float))
    # No verdict while the last eight rows are not all there.
    assert undecided[20:30].all()
    assert undecided[40:48].all()
    assert not undecided[[31, 39, 49]].any()
    thresholds, statistics = (solved[name].to_numpy(dtype=float)[7:] for name in ("threshold", "statistic"))
    assert np.isfinite(thresholds).all()
    assert np.all(statistics <= thresholds)
    full, known = test_of().threshold, thresholds[~undecided[7:]]
    assert known == pytest.approx(full, rel=1e-9)
    # Less is known where samples at an end of the window are missing; those in its middle tell nothing more.
    assert np.all(thresholds >= test_of().least * (1.0 - 1e-9))
    assert np.all(thresholds[13:16] > full * (1.0 + 1e-3))
    # What is left tells less, and no more than it can: the fault is found, later or not at all.
    faulty = blanked()
    faulty[["motor speed", "load speed"]] = log(4.0 * full, bang=True, steps=60)[["motor speed", "load speed"]]
    assert "pointwise" in run(faulty, missing="solve").alarms


def test_the_least_test_of_a_window_is_that_of_the_equations_without_the_lost_rows() -> None:
    programmes, (plant, _) = exact.Programmes.of(test_of()), test_of().linear
    y, u = np.zeros((8, plant.ny)), np.zeros((8, plant.nu))
    y[3] = np.nan
    value, threshold = programmes.least_test(y, u)
    window = programmes.window
    kept = np.setdiff1d(np.arange(window.rows), window.outputs_at + np.array([6, 7]))
    # The primal of the equations that are left, by another solver.
    import cvxpy as cp

    x = cp.Variable(len(window.bar))
    bounded = np.flatnonzero(window.bounded)
    limits = [window.matrix[kept] @ x == 0.0, cp.abs(x[bounded]) <= window.bar[bounded]]
    found = cp.Problem(cp.Maximize(x[0]), limits).solve(solver=cp.CLARABEL)
    assert (value, threshold) == (0.0, pytest.approx(found, rel=1e-6))
    # A missing input takes the equations that it enters, and no others.
    lost = u.copy()
    lost[2] = np.nan
    right, rows = exact.known_rows(window, np.ones((8, plant.ny)), lost)
    entered = np.flatnonzero(plant.B[:, 0])
    assert rows.tolist() == (2 * plant.nx + entered).tolist()
    assert np.isfinite(right).all()
    assert programmes.least_test(np.zeros((8, plant.ny)), lost)[1] > test_of().threshold
    # Nothing is told by no output at all.
    assert programmes.least_test(np.full((8, plant.ny), np.nan), u)[1] == np.inf


@pytest.mark.parametrize("said", ["nothing", "nonsense"])
def test_what_the_solver_says_proves_nothing(monkeypatch: pytest.MonkeyPatch, said: str) -> None:
    rng = np.random.default_rng(3)

    def answers(self: object, right: np.ndarray, sign: float):
        if said == "nonsense":
            yield rng.standard_normal(len(right))

    size = test_of().threshold
    programmes, data = exact.Programmes.of(test_of()), log(size)
    y = data[["motor speed", "load speed"]].to_numpy()[10:18]
    u = data[["torque"]].to_numpy()[10:18]
    best = programmes.interval(y, u)
    monkeypatch.setattr(exact._Programme, "answers", answers)
    low, high = programmes.interval(y, u)
    assert low <= best[0] <= size <= best[1] <= high
    assert high - low <= 2.0 * size * (1.0 + 1e-9)


def test_what_cannot_be_said_of_a_row_is_refused() -> None:
    for option in ({"exact": True}, {"missing": "solve"}):
        with pytest.raises(obsynth.SpecError, match="is for norm box"):
            test_of(norm="ellipsoid", **option)
    with pytest.raises(obsynth.SpecError, match="missing is 'guess': use one of wait, solve"):
        test_of(missing="guess")
