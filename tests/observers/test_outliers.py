"""Wrong samples on a log: gates and Huber's weight in recursive and nonlinear observers, and in ``run``."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from test_validate import designed

import obsynth
from obsynth import SolverError, SpecError, run_on_data, simulate_dae
from obsynth.observers.outliers import beside_others
from obsynth.observers.saved_states import state_as_data, state_from_data

pytestmark = pytest.mark.usefixtures("taken_as_verified")

#: Samples of the records of a recursive observer: its gains are asked for no further.
RECORD = 110


tank_design = cache(designed)


@cache
def tank_log(samples=120, seed=2):
    design = tank_design()
    u = np.tile(design.plant.nominal_input, (samples, 1))
    true = simulate_dae(design.plant, u, dt=1.0, Q=np.diag([2e-5, 1.2e-5, 9e-7]), R=np.diag([1.7e-5, 4.8e-6, 2.7e-5]),
                        integration="backward-euler", seed=seed)  # fmt: skip
    return design, u, true


@cache
def filter_design(**options):
    plant = obsynth.TimeVaryingDescriptorSystem(
        E=[[1, 0], [0, 0]], A=[[0.9, 0.1], [0.5, 1.0]], B=[[1.0], [0.0]], C=np.eye(2), Phi=[[0.1], [0.0]], dt=1.0,
        horizon=RECORD,
    )  # fmt: skip
    return obsynth.adaptive_observer(
        plant, Q=np.diag([1e-4, 1e-4]), R=np.diag([1e-3, 1e-3]), forgetting=0.98, initial_state=[0.0, 0.0],
        initial_covariance=np.eye(2), initial_parameters=[0.0], initial_parameter_covariance=[[1.0]], **options,
    )  # fmt: skip


def filter_record(samples=RECORD, seed=5):
    rng = np.random.default_rng(seed)
    u, x, rows = np.sin(np.arange(samples) / 9.0)[:, None], np.zeros(2), []
    for k in range(samples):
        if k:
            first = 0.9 * x[0] + 0.1 * x[1] + u[k - 1, 0] + 0.05 + 0.01 * rng.standard_normal()
            x = np.array([first, -0.5 * first])
        rows.append([x[0], -0.5 * x[0]] + np.sqrt(1e-3) * rng.standard_normal(2))
    return np.array(rows), u


@pytest.mark.parametrize("kind", ["gate", "huber"])
def test_one_sample_off_by_a_million_costs_a_nonlinear_observer_less_than_two_deviations(kind):
    design, u, true = tank_log()
    observer = replace(design.observer, outliers=kind)
    clean = design.observer.run(true.outputs, u)
    spoiled = np.array(true.outputs)
    spoiled[60, 1] += 1e6
    found = observer.run(spoiled, u)
    late = slice(65, None)
    assert (np.abs(found.states - clean.states)[late] < 2.0 * clean.state_deviations[late]).all()
    assert (np.abs(found.parameters - clean.parameters)[late] < 2.0 * clean.parameter_deviations[late]).all()
    # Without, the same sample leads where the model has no next step.
    with pytest.raises(SolverError):
        design.observer.run(spoiled, u)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["gate", "huber"])
def test_one_sample_off_by_a_million_costs_a_recursive_observer_less_than_two_deviations(kind):
    y, u = filter_record()
    clean, robust = filter_design(), filter_design(outliers=kind)
    spoiled = y.copy()
    spoiled[80, 0] = 1e6
    found, wanted = robust.observer.run(spoiled, u), clean.observer.run(y, u)
    late = slice(85, None)
    assert (np.abs(found.states - wanted.states)[late] < 2.0 * wanted.state_deviations[late]).all()
    assert (np.abs(found.parameters - wanted.parameters)[late] < 2.0 * wanted.parameter_deviations[late]).all()


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["gate", "huber"])
def test_a_record_without_outliers_is_as_before(kind):
    y, u = filter_record()
    found, wanted = (
        filter_design(outliers=kind, outlier_limit=8.0).observer.run(y, u),
        filter_design().observer.run(y, u),
    )
    assert np.array_equal(found.states, wanted.states)
    design, u, true = tank_log()
    observer = replace(design.observer, outliers=kind, outlier_limit=8.0)
    assert np.abs(observer.run(true.outputs, u).states - design.observer.run(true.outputs, u).states).max() < 1e-12


def test_a_sensor_that_stays_away_is_believed_at_its_second_sample():
    y, u = filter_record()
    design = filter_design(outliers="gate")
    y[80:] += [3.0, 0.0]
    state = design.observer.init()
    refused = []
    for k in range(len(y)):
        state, _ = design.observer.advance(state, y[k], u[k])
        refused.append(state.refused.copy())
    assert refused[79].sum() == 0.0
    assert [counts[0, 0] for counts in refused[80:82]] == [1.0, 2.0]
    # One sample is left out in all, however long the sensor stays where it is.
    assert refused[-1][1].tolist() == [1.0, 0.0]


def test_samples_that_jump_from_side_to_side_are_left_out_one_by_one():
    y, u = filter_record()
    design = filter_design(outliers="gate")
    y[80, 0], y[81, 0], y[100, 0] = y[80, 0] + 5.0, y[81, 0] - 5.0, y[100, 0] - 5.0
    state, sides = design.observer.init(), []
    for k in range(len(y)):
        state, _ = design.observer.advance(state, y[k], u[k])
        sides.append(state.refused[0, 0])
    assert (sides[80], sides[81], sides[100], sides[101]) == (1.0, -2.0, -1.0, 0.0)
    assert state.refused[1].tolist() == [3.0, 0.0]


def gate_counts(observer, y, u, *, saved_at: int | None = None):
    """Samples of each sensor that are left out until each row; from a state that was saved before row ``saved_at``."""
    state, counts = observer.init(), []
    for k in range(len(y)):
        if k == saved_at:
            data = state_as_data(state)
            assert np.asarray(data["refused"]).shape == (4, y.shape[1])
            state = state_from_data(observer.init(), data)
        state, row = observer.advance(state, y[k], u[k])
        counts.append(state.refused[1])
    return np.array(counts), row


#: Onset of a fault of a sensor, in units of its step, and which of its first samples are left out.
ONSETS = {
    "step": ([1, 1, 1, 1], [1, 0, 0, 0]),
    "ramp": ([1, 2, 3, 4], [1, 0, 0, 0]),
    "square of time": ([1, 4, 9, 16], [1, 0, 0, 0]),
    "wild second": ([1, 1e6, 1, 1], [1, 1, 1, 0]),
    "wild third": ([1, 1, 1e6, 1], [1, 0, 1, 0]),
    "wild first": ([1e6, 1, 1, 1], [1, 1, 0, 0]),
    "wild on both sides": ([1, -1e6, 1e9, -1e3, 1], [1, 1, 1, 1, 1]),
    "wild and wilder": ([1e3, 1e6, 1e9, 1e12, 1], [1, 1, 1, 1, 1]),
    "blank between": ([1, np.nan, 1, 1], [1, 0, 0, 0]),
    "no number of a sensor": ([1, 1e200, 1e300, 1], [1, 1, 1, 1]),
}


@cache
def gated(kind):
    """Return a design with a gate, a record, where its onset is, the size of a step, and what a gate leaves out of it
    without an onset."""
    if kind == "recursive":
        design, (y, u), at = filter_design(outliers="gate"), filter_record(100), 80
    else:
        design, u, true = tank_log(80)
        design, y, at = replace(design, observer=replace(design.observer, outliers="gate")), np.array(true.outputs), 60
    # A second is ten deviations of the innovation: what the first samples that are believed leave is far no more.
    size = 10.0 * design.observer.run(y[: at + 1], u[: at + 1]).innovations[20:, 0].std()
    return design, y, u, at, size, gate_counts(design.observer, y, u)[0]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", ONSETS)
@pytest.mark.parametrize("kind", ["recursive", "nonlinear"])
def test_a_gate_believes_a_second_sample_as_far_off_as_the_first_and_no_wild_one(kind, name):
    onset, lost = np.array(ONSETS[name][0], dtype=float), ONSETS[name][1]
    design, y, u, at, size, clean = gated(kind)
    y = y.copy()
    y[at : at + len(onset), 0] += size * onset
    found, row = gate_counts(design.observer, y, u)
    new = np.diff(found[at - 1 : at + len(onset), 0])
    assert clean.sum() == 0.0
    assert new.tolist() == lost
    assert np.isfinite(row.x).all()
    assert np.abs(row.x).max() < 10.0
    resumed, again = gate_counts(design.observer, y, u, saved_at=at + 2)
    assert np.array_equal(resumed, found)
    assert np.array_equal(again.x, row.x)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("kind", ["recursive", "nonlinear"])
def test_a_sample_nearer_than_outliers_are_is_believed_at_once(kind):
    """A log told how far off its outliers are: what is nearer may be a fault, however many deviations it is."""
    design, y, u, at, size, _ = gated(kind)
    observer = replace(design.observer, outlier_sizes={design.plant.output_names[0]: 1.5 * size})
    for steps, lost in ((1.0, 0.0), (2.0, 1.0)):
        moved = y.copy()
        moved[at:, 0] += steps * size
        found = gate_counts(observer, moved[: at + 2], u[: at + 2])[0]
        assert gate_counts(design.observer, moved[: at + 2], u[: at + 2])[0][at, 0] == 1.0
        assert found[at].tolist() == [lost, *np.zeros(y.shape[1] - 1)]
    # Huber's weight pulls a sample no nearer than that.
    moved = y[: at + 1].copy()
    moved[at, 0] += 2.0 * size
    near, far = (replace(design.observer, outliers="huber", outlier_sizes=sizes).run(moved, u[: at + 1])
                 for sizes in (None, [1.5 * size, *np.zeros(y.shape[1] - 1)]))  # fmt: skip
    assert np.abs(far.innovations[at]).max() > 1.5 * np.abs(near.innovations[at]).max()


@pytest.mark.long
@pytest.mark.parametrize("kind", ["recursive", "nonlinear"])
def test_of_a_sensor_whose_outliers_are_known_two_in_a_row_are_left_out(kind):
    """Two wrong samples on one side may come together; three are a sensor, or a plant, that has moved. Of outliers that
    are no further off than samples may be the second is believed."""
    design, y, u, at, size, _ = gated(kind)
    near = replace(design.observer, outlier_sizes={design.plant.output_names[0]: 0.01 * size})
    moved = y.copy()
    moved[at : at + 2, 0] += 2.0 * size
    assert np.diff(gate_counts(near, moved[: at + 2], u[: at + 2])[0][at - 1 : at + 2, 0]).tolist() == [1.0, 0.0]
    observer = replace(design.observer, outlier_sizes={design.plant.output_names[0]: 1.5 * size})
    for count, lost in ((2, [1.0, 1.0, 0.0, 0.0]), (4, [1.0, 1.0, 0.0, 0.0])):
        moved = y.copy()
        moved[at : at + count, 0] += 2.0 * size
        found, row = gate_counts(observer, moved[: at + 4], u[: at + 4])
        assert np.diff(found[at - 1 : at + 4, 0]).tolist() == lost
        hidden = y.copy()
        hidden[at : at + 2, 0] = np.nan
        same = np.allclose(row.x, gate_counts(observer, hidden[: at + 4], u[: at + 4])[1].x, rtol=0.0, atol=1e-3 * size)
        assert same == (count == 2)


@pytest.mark.parametrize("kind", ["recursive", "nonlinear"])
def test_an_outlier_after_missing_inputs_is_left_out_however_unsure_the_prediction_is(kind):
    """What inputs may have been meanwhile widens the deviations so far that any sample would pass."""
    design, y, u, at, size, _ = gated(kind)
    known = replace(design.observer, outlier_sizes={design.plant.output_names[0]: 1.5 * size})
    nothing, wrong = np.full_like(y[0], np.nan), y[at].copy()
    wrong[0] += 4.0 * size
    for observer, lost in ((design.observer, 0.0), (known, 1.0)):
        state = observer.init()
        for k in range(at - 3):
            state, _ = observer.advance(state, y[k], u[k])
        # Inputs that moved as far as these before may be anywhere now.
        wide = np.stack([state.u - 1e3, state.u + 1e3, np.full_like(state.u, 1e3), *state.inputs[3:]])
        state = state._replace(inputs=wide)
        for k in range(at - 3, at):
            state, _ = observer.advance(state, nothing, np.full_like(u[k], np.nan))
        assert observer.advance(state, wrong, u[at])[0].refused[1, 0] == lost
        assert observer.advance(state, y[at], u[at])[0].refused[1, 0] == 0.0


@cache
def unsure(kind):
    """Return a plant that may be anywhere in the next row, with three sensors of it, and a record of 40 rows: in no row
    does a sample stand out by its own deviation."""
    rng, rows = np.random.default_rng(8), 40
    x = np.cumsum(rng.standard_normal(rows))
    y = np.outer(x, [1.0, 2.0, -1.0]) + 0.01 * rng.standard_normal((rows, 3))
    common = {"R": 1e-4 * np.eye(3), "initial_covariance": [[1.0]], "outliers": "gate"}
    if kind == "recursive":
        plant = obsynth.TimeVaryingDescriptorSystem(
            E=[[1.0]], A=[[1.0]], B=[[0.0]], C=[[1.0], [2.0], [-1.0]], dt=1.0, horizon=rows
        )
        return obsynth.descriptor_kalman(plant, Q=[[1.0]], initial_state=[0.0], **common), y, np.zeros((rows, 1))
    model = obsynth.DAEModel(
        {"way": "der(x) = drift"}, {"a": "x", "b": "2 * x", "c": "-x"}, states={"x": 0.0}, parameters={"drift": 0.0}
    )
    design = obsynth.dae_adaptive_observer(
        model, dt=1.0, Q=[[1e-6]], form="augmented-kalman", random_walk=[[1.0]], initial_parameter_covariance=[[1.0]],
        **common,
    )  # fmt: skip
    return design, y, np.zeros((rows, 0))


@pytest.mark.parametrize("kind", ["recursive", "nonlinear"])
def test_a_sample_that_the_others_of_its_row_exclude_is_left_out_where_the_prediction_is_unsure(kind):
    """What a fault may have done since made a wrong sample 3.6 deviations: it was taken, and what came after it left
    out."""
    design, y, u = unsure(kind)
    assert gate_counts(design.observer, y, u)[0][-1].sum() == 0.0
    for sensor in range(3):
        moved, hidden = y.copy(), y.copy()
        moved[30, sensor] += 0.4
        hidden[30, sensor] = np.nan
        found, row = gate_counts(design.observer, moved, u)
        assert np.flatnonzero(found[-1]).tolist() == [sensor]
        assert np.diff(found[28:, sensor]).tolist() == [0.0, 1.0, *np.zeros(9)]
        assert np.array_equal(row.x, gate_counts(design.observer, hidden, u)[1].x)
    # A sensor that stays there is believed at its second sample, and one that is nearer than outliers are, at once.
    moved = y.copy()
    moved[30:, 0] += 0.4
    assert np.diff(gate_counts(design.observer, moved[:32], u[:32])[0][29:, 0]).tolist() == [1.0, 0.0]
    # What comes after one is beyond outliers of any sensor by its own prediction, and where the others say.
    wrong = y.copy()
    wrong[30, 0] += 0.4
    known = replace(design.observer, outlier_sizes=[0.02, 0.02, 0.02])
    assert gate_counts(known, wrong, u)[0][-1].tolist() == [1.0, 0.0, 0.0]
    for size, lost in ((0.3, 1.0), (0.6, 0.0)):
        known = replace(design.observer, outlier_sizes=[size, 0.0, 0.0])
        assert gate_counts(known, moved[:31], u[:31])[0][-1, 0] == lost


@pytest.mark.parametrize("kind", ["recursive", "nonlinear"])
def test_what_moves_all_sensors_as_the_plant_does_is_believed(kind):
    design, y, u = unsure(kind)
    moved = y.copy()
    moved[30:] += 1.5 * np.array([1.0, 2.0, -1.0])
    found, row = gate_counts(design.observer, moved, u)
    assert found[-1].sum() == 0.0
    assert row.x[0] == pytest.approx(y[-1, 0] + 1.5, abs=0.05)


@pytest.mark.parametrize("seen", [[0, 1, 2], [0, 2], [1]])
def test_what_the_others_say_of_a_sample_is_its_conditional_mean(seen):
    rng = np.random.default_rng(3)
    root = rng.standard_normal((3, 3)) * [[1.0], [1e3], [1e-4]]
    covariance, off = root @ root.T, np.full(3, np.nan)
    off[seen] = (root @ rng.standard_normal(3))[seen]
    apart, deviation = beside_others(off, covariance)
    for i in range(3):
        others = [j for j in seen if j != i]
        gain = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, i])
        wanted = off[i] - gain @ off[others], np.sqrt(covariance[i, i] - gain @ covariance[others, i])
        assert np.array_equal(np.isnan([apart[i], deviation[i]]), [i not in seen] * 2)
        assert i not in seen or np.allclose([apart[i], deviation[i]], wanted, rtol=1e-6, atol=0.0)


def test_run_leaves_outliers_out_by_default_and_counts_them(tmp_path):
    design, u, true = tank_log()
    # An observer that has run before is as good as a new one.
    design.observer.run(true.outputs[:2], u[:2])
    table = pd.DataFrame({"time": np.arange(120.0), **dict(zip(("u1", "u3"), u.T, strict=True)),
                          **dict(zip(("v1", "v2", "v3"), np.array(true.outputs).T, strict=True))})  # fmt: skip
    clean = run_on_data(design, table)
    assert clean.outliers == {}
    # No warm-up is needed: the deviations of the start are stated.
    assert clean.statuses == {"ok": 120}
    spoiled = table.copy()
    spoiled.loc[[40, 90], "v3"] = [1e6, -1e6]
    found = run_on_data(design, spoiled)
    assert found.outliers == {"v3": 2}
    gap = np.abs(found.table["fhat[leak]"] - clean.table["fhat[leak]"])[95:]
    assert (gap < 2.0 * clean.table["sd fhat[leak]"][95:]).all()
    plain = run_on_data(design, spoiled, outliers="none")
    assert plain.outliers == {}
    with pytest.raises(SpecError, match="outliers"):
        run_on_data(design, table, outliers="some")


def test_options_are_checked_and_kept(tmp_path):
    design = filter_design(outliers="huber", outlier_limit=2.5, outlier_sizes=(0.0, 0.5))
    file = design.save(tmp_path / "gains.json")
    again = obsynth.load(file)
    assert (again.observer.outliers, again.observer.outlier_limit) == ("huber", 2.5)
    assert again.observer.outlier_sizes.tolist() == [0.0, 0.5]
    made = tank_design()
    sized = replace(made, observer=replace(made.observer, outliers="gate", outlier_sizes={"v2": 0.5}))
    assert obsynth.load(sized.save(tmp_path / "tank.json")).observer.outlier_sizes.tolist() == [0.0, 0.5, 0.0]
    wrong = ({"outliers": "some"}, {"outlier_limit": -1.0}, {"outlier_sizes": [-1.0, 0.0]}, {"outlier_sizes": {"z": 1}})
    for options in wrong:
        with pytest.raises(SpecError, match="outlier"):
            filter_design.__wrapped__(**options)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", ["gate", "huber"])
@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize("form", ["innovation", "literal", "random-walk"])
def test_an_output_that_a_step_needs_is_judged_by_the_algebraic_equations(form, early, kind):
    """y2 alone determines the algebraic state: without its equation a wrong value would pass, and stay for ever."""
    design = filter_design(form=form, early_constraints=early, random_walk=1e-6 if form == "random-walk" else None)
    observer = replace(design.observer, outliers=kind)
    y, u = filter_record()
    clean, wrong = design.observer.run(y, u), y.copy()
    wrong[60, 1] += 1e6
    found = observer.run(wrong, u)
    gaps = np.abs(found.states - clean.states)[65:], np.abs(found.parameters - clean.parameters)[65:]
    assert (gaps[0] < 2.0 * clean.state_deviations[65:]).all()
    assert (gaps[1] < 2.0 * clean.parameter_deviations[65:]).all()
    batch = obsynth.run_batch(observer, np.stack([wrong, y]), u)
    assert np.array_equal(batch.states[0], found.states)
    assert np.array_equal(batch.states[1], observer.run(y, u).states)
