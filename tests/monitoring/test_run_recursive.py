"""Recursive and nonlinear designs on measured data: their own step, row by row, with bad rows and saved states."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth import PreconditionError, SpecError, TimeVaryingDescriptorSystem, run_on_data
from obsynth.specs.loader import load_spec

pytestmark = pytest.mark.usefixtures("taken_as_verified")
ROOT = Path(__file__).parents[2]
DT = 0.1
POINT = np.array([10.0, 0.0])
PLANT = TimeVaryingDescriptorSystem(
    E=[[1, 0, 0], [0, 1, 0], [0, 0, 0]], A=[[0.9, 0.1, 0], [-0.2, 0.7, 0.1], [1, 0.5, -1]], B=[[0], [1], [0.3]],
    C=[[1, 0, 0], [0, 0, 1]], Phi=[[0], [1], [0]], dt=DT, input_names=["valve"], output_names=["level", "flow"],
    parameter_names=["leak"], operating_point={"valve": 2.0, "level": 10.0, "x1": 10.0, "leak": 0.5},
)  # fmt: skip
Q = np.diag([1e-3, 1e-3, 1e-4])
DESIGNS = {
    "filter": lambda: obsynth.descriptor_kalman(PLANT, Q=Q, R=1e-2),
    "early": lambda: obsynth.descriptor_kalman(PLANT, Q=Q, R=1e-2, early_constraints=True),
    "innovation": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, forgetting=0.95),
    "resetting": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, forgetting=0.95, reset=1e-3),
    "directional": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, forgetting=0.95, guard="directional"),
    "literal": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, forgetting=0.95, form="literal"),
    "walk": lambda: obsynth.adaptive_observer(PLANT, Q=Q, R=1e-2, form="random-walk", random_walk=1e-4),
}


def tank() -> obsynth.ObserverDesign:
    model = obsynth.DAEModel(
        equations={"balance": "area * der(level) = inflow - c * out", "valve": "out - sqrt(level) = 0"},
        outputs={"height": "level", "drain": "out"}, states={"level": 1.0, "out": 1.0}, inputs={"inflow": 1.0},
        parameters={"c": 1.0}, constants={"area": 2.0},
        units={"level": "m", "out": "m0.5", "inflow": "m3/s", "c": "1", "height": "m", "drain": "m0.5", "area": "m2"},
    )  # fmt: skip
    return obsynth.dae_adaptive_observer(
        model, dt=DT, Q={"balance": 1e-8}, R={"height": 1e-4, "drain": 1e-4}, forgetting=0.95
    )


DESIGNS["nonlinear"] = tank
LINEAR = [name for name in DESIGNS if name != "nonlinear"]


@cache
def designed(name: str) -> obsynth.ObserverDesign:
    return DESIGNS[name]()


def log_of(name: str, samples: int = 60, *, change: float = 0.3) -> pd.DataFrame:
    """Return absolute values, as a log has them."""
    rng = np.random.default_rng(5)
    if name == "nonlinear":
        u = 1.0 + 0.1 * np.sin(0.2 * np.arange(samples))[:, None]
        y = obsynth.simulate_dae(designed(name).plant, u, dt=DT, R=1e-4 * np.eye(2), seed=1).outputs
        return table_of(np.hstack([u, y]), ["inflow", "height", "drain"])
    u = 0.3 * rng.normal(size=(samples, 1))
    theta = np.where(np.arange(samples) > 30, change, 0.0)[:, None]
    run = obsynth.simulate_time_varying(PLANT, samples=samples, u=u, parameters=theta,
                                        output_noise=0.1 * rng.normal(size=(samples - 1, 2)))  # fmt: skip
    return table_of(np.hstack([u + 2.0, run.outputs + POINT]), ["valve", "level", "flow"])


def table_of(values: np.ndarray, names: list[str]) -> pd.DataFrame:
    table = pd.DataFrame(values, columns=names)
    table.insert(0, "time", DT * np.arange(len(values)))
    return table


def direct(name: str, table: pd.DataFrame):
    design = designed(name)
    values = table.iloc[:, 1:].to_numpy() - ([0, 0, 0] if name == "nonlinear" else [2.0, 10.0, 0.0])
    return design.observer.run(values[:, 1:], values[:, :1])


def columns(table: pd.DataFrame, start: str) -> np.ndarray:
    return table[[name for name in table.columns if name.startswith(start)]].to_numpy()


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", DESIGNS)
def test_a_run_gives_what_the_observer_gives_in_absolute_values(name):
    table = log_of(name)
    wanted, found = direct(name, table), run_on_data(designed(name), table, outliers="none").table
    point = [0.0, 0.0] if name == "nonlinear" else [10.0, 0.0, 0.0]
    np.testing.assert_allclose(columns(found, "xhat["), wanted.states + point, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(columns(found, "sd xhat["), wanted.state_deviations, rtol=1e-13)
    if wanted.parameters.shape[1]:
        at = 0.0 if name == "nonlinear" else 0.5
        np.testing.assert_allclose(columns(found, "fhat["), wanted.parameters + at, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(columns(found, "sd fhat["), wanted.parameter_deviations, rtol=1e-13)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", DESIGNS)
def test_missing_outputs_are_the_filters_own_business(name):
    table = log_of(name)
    table.iloc[20:24, 2] = np.nan
    table.iloc[40:43, 2:] = np.nan
    wanted, done = direct(name, table), run_on_data(designed(name), table, outliers="none")
    point = [0.0, 0.0] if name == "nonlinear" else [10.0, 0.0, 0.0]
    np.testing.assert_allclose(columns(done.table, "xhat["), wanted.states + point, rtol=1e-12, atol=1e-12)
    assert set(done.table["status"][20:24]) == {"partial"}
    assert set(done.table["status"][40:43]) == {"gap"}
    assert done.table["status"][43] == "ok"


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", LINEAR)
def test_rows_that_are_not_there_are_samples_without_outputs(name):
    table = log_of(name)
    holed = table.copy()
    holed.iloc[20:26, 1:] = np.nan
    wanted = run_on_data(designed(name), holed, warm_up=0.0).table
    found = run_on_data(designed(name), table.drop(index=range(20, 26)).reset_index(drop=True), warm_up=0.0).table
    kept = [k for k in range(60) if not 20 <= k < 26]
    np.testing.assert_array_equal(columns(found, "xhat["), columns(wanted, "xhat[")[kept])
    # Inputs were guessed in between, and the status says so.
    again = run_on_data(designed(name), table.drop(index=range(20, 26)), warm_up=5 * DT).table
    assert list(again["status"][18:26]) == ["ok", "ok", *["recovering"] * 4, "ok", "ok"]


def test_a_missing_input_is_held_within_its_changes_and_said():
    table = log_of("filter")
    table.loc[30, "valve"] = np.nan
    found = run_on_data(designed("filter"), table, warm_up=3 * DT).table
    assert list(found["status"][29:35]) == ["ok", "gap", "recovering", "recovering", "ok", "ok"]
    filled = table.copy()
    filled.loc[30, "valve"] = table.loc[29, "valve"]
    same = run_on_data(designed("filter"), filled, warm_up=0.0).table
    # The input of a row acts in the step after it.
    np.testing.assert_array_equal(columns(found, "xhat[")[:31], columns(same, "xhat[")[:31])
    wider = columns(found, "sd xhat[") / columns(same, "sd xhat[")
    assert (wider[:31] == 1.0).all()
    assert wider[31].max() > 1.5
    assert (wider[31:] >= 1.0 - 1e-12).all()
    table = log_of("nonlinear")
    table.loc[0, "inflow"] = np.nan
    # A nonlinear model has no zero to begin with: it begins in the row in which all inputs are known.
    late = run_on_data(designed("nonlinear"), table).table
    alone = run_on_data(designed("nonlinear"), table.iloc[1:]).table
    assert late["status"][0] == "gap"
    assert late.iloc[0, 2:].isna().all()
    pd.testing.assert_frame_equal(late.iloc[1:].reset_index(drop=True), alone)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", LINEAR)
def test_a_bad_row_never_poisons_the_state(name, share):
    holed = log_of(name)
    holed.iloc[20, 2:] = np.nan
    expected = columns(run_on_data(designed(name), holed).table, "xhat[")
    # One of the numbers for each design, another for the next.
    for bad in share(np.roll([np.inf, -np.inf, 1e308], LINEAR.index(name)), 3):
        table = log_of(name)
        table.iloc[20, 2:] = bad
        found = run_on_data(designed(name), table).table
        assert np.isfinite(columns(found, "xhat[")).all()
        assert found["status"][20] == "gap"
        np.testing.assert_array_equal(columns(found, "xhat["), expected)


@pytest.mark.parametrize("bad", [np.inf, 1e9, 1e308])
def test_nor_does_an_outlier_that_leads_a_nonlinear_model_astray(bad):
    """With 1e9 the state is a number from which there is no step: the observer starts again."""
    table = log_of("nonlinear", 100)
    table.iloc[20, 2:] = bad
    found = run_on_data(designed("nonlinear"), table).table
    truth = np.sqrt(table["height"].to_numpy())[-20:]
    assert np.isfinite(columns(found, "xhat[")).all()
    assert np.abs(columns(found, "xhat[")[-20:, 1] - truth).max() < 0.05


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", DESIGNS)
def test_a_run_that_stops_and_goes_on_gives_the_same_bytes(name, tmp_path, share):
    table = log_of(name)
    table.iloc[20:24, 2] = np.nan
    table = table.drop(index=[40, 41]).reset_index(drop=True)
    kind = "nis" if name in ("filter", "early") else "chi-square"
    table.to_csv(tmp_path / "log.csv", index=False)

    def monitor() -> obsynth.types.Monitor:
        return obsynth.online_monitor(designed(name), kind, false_alarms=0.3)

    run_on_data(designed(name), tmp_path / "log.csv", tmp_path / "whole.csv", monitor=monitor(), warm_up=DT)
    head, *rows = (tmp_path / "log.csv").read_text().splitlines(keepends=True)
    # One of the places for each design, another for the next.
    for cut in share(np.roll([1, 22, 41], list(DESIGNS).index(name)), 3):
        found = ""
        for part in (rows[:cut], rows[cut:]):
            (tmp_path / "part.csv").write_text(head + "".join(part))
            run_on_data(designed(name), tmp_path / "part.csv", tmp_path / "out.csv", state=tmp_path / f"{cut}.json",
                        monitor=monitor(), warm_up=DT, chunk_rows=7)  # fmt: skip
            found += "".join((tmp_path / "out.csv").read_text().splitlines(keepends=True)[bool(found) :])
        assert found == (tmp_path / "whole.csv").read_text()


def test_a_saved_state_wants_the_same_options(tmp_path):
    state, table = tmp_path / "state.json", log_of("filter")
    run_on_data(designed("filter"), table[:30], state=state)
    with pytest.raises(SpecError, match="another warm-up"):
        run_on_data(designed("filter"), table[30:], state=state, warm_up=1.0)
    with pytest.raises(SpecError, match="another monitor"):
        run_on_data(
            designed("filter"), table[30:], state=state, monitor=obsynth.online_monitor(designed("filter"), "nis")
        )
    with pytest.raises(SpecError, match="another gain set"):
        run_on_data(designed("walk"), table[30:], state=state)


def test_a_record_longer_than_the_model_is_refused_with_the_row():
    spec = load_spec(ROOT / "designs/smib/spec_inertia.yaml")
    short = spec.plant.replace(horizon=10)
    design = obsynth.design(short, spec.method, **spec.options)
    table = table_of(np.zeros((20, 3)), list(short.output_names))
    table["time"] = 0.02 * np.arange(20)
    with pytest.raises(SpecError, match="Row 12: The record has 12 samples"):
        run_on_data(design, table)


@cache
def without_noise() -> obsynth.ObserverDesign:
    return obsynth.descriptor_kalman(PLANT, Q=0.0, R=0.0)


def test_contradicting_data_are_refused_with_the_row():
    design = without_noise()
    with pytest.raises(PreconditionError, match="Row 3: Equations or outputs without noise contradict"):
        run_on_data(design, log_of("filter"))


def test_a_stream_goes_on_after_a_row_that_was_refused(tmp_path):
    """The state of the rows that were answered is saved, and the next part may begin with the row as it should be."""
    import io

    design = without_noise()
    run = obsynth.simulate_time_varying(PLANT, samples=12, u=np.ones((12, 1)))
    table = table_of(np.hstack([np.full((12, 1), 3.0), run.outputs + POINT]), ["valve", "level", "flow"])
    lines = table.to_csv(index=False).splitlines(keepends=True)
    whole = io.StringIO()
    run_on_data(design, io.StringIO("".join(lines)), whole)
    cells = lines[6].split(",")
    wrong = ",".join([*cells[:2], "99.0", *cells[3:]])
    parts, out = ([*lines[:6], wrong], lines[:1] + lines[6:]), io.StringIO()
    with pytest.raises(PreconditionError, match="Row 6: Equations or outputs"):
        run_on_data(design, io.StringIO("".join(parts[0])), out, state=tmp_path / "state.json")
    rest = io.StringIO()
    run_on_data(design, io.StringIO("".join(parts[1])), rest, state=tmp_path / "state.json")
    assert out.getvalue() + "".join(rest.getvalue().splitlines(keepends=True)[1:]) == whole.getvalue()


def test_there_is_no_warm_up_unless_one_is_stated():
    """The deviations at the start are those of the stated covariance, so that every row may decide."""
    table = log_of("filter")
    assert set(run_on_data(designed("filter"), table).statuses) == {"ok"}
    done = run_on_data(designed("filter"), table, warm_up=5 * DT)
    assert done.statuses == {"warm-up": 5, "ok": 55}


@pytest.mark.parametrize("name", ["filter", "nonlinear"])
def test_a_continuous_option_is_refused(name):
    with pytest.raises(SpecError, match="gap is for continuous-time designs"):
        run_on_data(designed(name), log_of(name), gap=1.0)
    with pytest.raises(SpecError, match="warm_up is -1"):
        run_on_data(designed(name), log_of(name), warm_up=-1.0)


@pytest.mark.long
def test_deviations_are_honest_in_a_gap():
    """Over many runs, errors in a gap are as large as the column says."""
    design, errors, said = designed("filter"), [], []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        run = obsynth.simulate_time_varying(
            PLANT, samples=18, equation_noise=rng.normal(size=(18, 3)) @ np.sqrt(Q), u=np.zeros((18, 1)),
            output_noise=0.1 * rng.normal(size=(17, 2)), initial_state=rng.normal(size=3),
        )  # fmt: skip
        table = table_of(np.hstack([np.full((18, 1), 2.0), run.outputs + POINT]), ["valve", "level", "flow"])
        table.iloc[10:16, 2:] = np.nan
        found = run_on_data(design, table, warm_up=0.0).table
        errors.append(columns(found, "xhat[")[15] - [10.0, 0.0, 0.0] - run.states[15])
        said.append(columns(found, "sd xhat[")[15])
    ratio = np.sqrt(np.mean(np.array(errors) ** 2, axis=0)) / said[0]
    # Of the algebraic state, noise of the next equation is not in the record's model of a start: the first two count.
    assert ((ratio[:2] > 0.8) & (ratio[:2] < 1.2)).all()


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["recursive", "linear"])
def test_scales_of_a_plant_are_those_of_its_log(kind):
    """What the log holds, times the factor, is in the signal's unit; a call may say otherwise."""
    if kind == "recursive":
        scaled = obsynth.descriptor_kalman(PLANT.replace(scales={"level": 1e-3, "valve": -1.0}), Q=Q, R=1e-2)
        plain, table = designed("filter"), log_of("filter")
    else:
        plain = obsynth.pd_observer(obsynth.DescriptorSystem(
            None, [[-1.0, 1.0], [0.0, -2.0]], [[0.0], [1.0]], np.eye(2), Bf=[[0.0], [1.0]], input_names=["valve"],
            output_names=["level", "flow"],
        ))  # fmt: skip
        scaled = plain.replace(plant=plain.plant.replace(scales={"level": 1e-3, "valve": -1.0}))
        table = log_of("filter")
        table.iloc[0, 2:] = 10.0
    raw = table.copy()
    raw["level"] *= 1e3
    raw["valve"] *= -1.0
    wanted = run_on_data(plain, table).table
    pd.testing.assert_frame_equal(run_on_data(scaled, raw).table, wanted, rtol=1e-9, atol=1e-9)
    raw["level"] *= 2.0
    pd.testing.assert_frame_equal(
        run_on_data(scaled, raw, scales={"level": 0.5e-3}).table, wanted, rtol=1e-9, atol=1e-9
    )
    with pytest.raises(SpecError, match="no input or output"):
        PLANT.replace(scales={"x1": 2.0})
    with pytest.raises(SpecError, match="scale of 'level' is 0"):
        PLANT.replace(scales={"level": 0.0})
