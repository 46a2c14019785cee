"""Outliers, resets, bounds on states and sensors of their own times in the exported C of nonlinear observers."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import test_dae_c_export
from test_dae_c_export import FLAGS, as_run, run_c
from test_validate import designed

import obsynth
from obsynth import SpecError, dae_adaptive_observer, simulate_dae
from obsynth.observers.changed_options import changed

pytestmark = pytest.mark.usefixtures("taken_as_verified")
OPTIONS = {
    "gate": {"outliers": "gate"},
    "huber": {"outliers": "huber", "outlier_limit": 2.5},
    "sizes": {"outliers": "gate", "outlier_sizes": {"v1": 0.6, "v3": 0.3}},
    "reset": {"reset": 1e-4},
    "bounds": {"state_bounds": {"h1": [0.0, 0.2], "h2": [0.0, 0.22], "h3": [-1.0, 0.155]}},
    "late": {"sensors": {"v1": {"every": 3, "delay": 2}, "v3": {"delay": 4}}},
    "slow": {"sensors": {"v2": {"every": 5}}},
}
FORMS = {"forgetting": {"forgetting": 0.95}, "random-walk": {"random_walk": [[1e-6]]},
         "augmented-kalman": {"random_walk": [[1e-6]]}}  # fmt: skip
#: Bounds that levels reach from k = 50 on. Beyond them every sample of a sensor is far on one side, which a gate
#: believes: the wrong sample of 1e6 at k = 20 is left out because it stands alone.
LATER = {"state_bounds": {"h1": [0.0, 0.8], "h2": [0.0, 0.7], "h3": [-1.0, 0.75]}}
BOTH = {**OPTIONS["gate"], **OPTIONS["reset"], **LATER, **OPTIONS["late"]}


tanks = cache(designed)


@pytest.fixture(autouse=True)
def _compiled_in_less_time(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Warnings that take an optimiser are looked for where everything is at once."""
    if "everything" not in request.node.name:
        fast = ["-O0" if flag == "-O1" else flag for flag in test_dae_c_export.FLAGS]
        monkeypatch.setattr(test_dae_c_export, "FLAGS", fast)


def tank_observer(form: str, options: dict):
    made = tanks()
    return dae_adaptive_observer(
        made.plant, dt=1.0, form=form, Q=made.observer.Q, R=made.observer.R, initial_covariance=1e-4 * np.eye(3),
        initial_parameter_covariance=[[1e-4]], **FORMS[form], **options,
    )  # fmt: skip


def leaking(design, samples: int = 150) -> tuple[np.ndarray, np.ndarray]:
    """A leak that opens at k = 70, with single wrong samples of any size, gaps, and one sensor that steps, where a
    sample of 1e6 on the side of its onset and a blank one follow."""
    u = np.tile(design.plant.nominal_input, (samples, 1))
    leak = np.where(np.arange(samples) < 70, 0.0, 0.03)[:, None]
    y = np.array(simulate_dae(design.plant, u, dt=1.0, parameters=leak, R=design.observer.R, seed=3).outputs)
    y[20, 1] += 1e6
    y[33, 0] -= 0.5
    y[50:53] = np.nan
    y[60] = [np.nan, 1e200, 3.0]
    y[110:, 2] += 0.4
    y[111, 2], y[112, 2] = 1e6, np.nan
    return y, u


def assert_same(found: dict[str, np.ndarray], expected) -> None:
    """A late sensor has no innovation at the sample that is shown."""
    assert not found["returned"].any()
    for name in ("states", "state_deviations", "parameters", "parameter_deviations", "innovations"):
        values = getattr(expected, name)
        assert np.array_equal(np.isnan(found[name]), np.isnan(values)), name
        gaps, sizes = np.nan_to_num(found[name] - values), np.nan_to_num(values)
        assert (np.abs(gaps).max(axis=0) <= 1e-10 * np.abs(sizes).max(axis=0)).all(), name
    assert np.abs(found["nis"][:, 0] - expected.nis).max() <= 1e-9 * expected.nis.max()


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("form", "name"), [("forgetting", "gate"), ("augmented-kalman", "gate"),
                                            ("augmented-kalman", "sizes"), ("random-walk", "huber")])  # fmt: skip
def test_outliers_in_c(form, name, tmp_path) -> None:
    design = tank_observer(form, OPTIONS[name])
    y, u = leaking(design)
    expected = design.observer.run(y, u)
    assert np.abs(expected.states[25:100]).max() < 5.0
    if name == "sizes":
        # The sample that is 0.5 below its prediction is believed, with these, and the first of 0.4 still is not.
        without = replace(design.observer, outlier_sizes=None).run(y, u)
        assert np.abs(without.states - expected.states)[33].max() > 0.01
        assert np.array_equal(without.states[:33], expected.states[:33])
    assert_same(run_c(design, y, u, tmp_path), expected)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("kind", ["gate", "huber"])
@pytest.mark.parametrize("sizes", [None, [0.2, 0.0, 0.3], [0.02, 0.02, 0.02]])
def test_samples_that_the_others_of_their_row_exclude_in_c(kind, sizes, tmp_path) -> None:
    """The plant may be anywhere in the next row: no sample stands out by its own deviation."""
    model = obsynth.DAEModel(
        {"way": "der(x) = drift + push"}, {"a": "x", "b": "2 * x", "c": "0.5 - x"}, states={"x": 0.0},
        inputs={"push": 0.0}, parameters={"drift": 0.0},
    )  # fmt: skip
    design = dae_adaptive_observer(
        model, dt=1.0, Q=[[1e-6]], R=1e-4 * (np.eye(3) + 0.3), form="augmented-kalman", random_walk=[[1.0]],
        initial_covariance=[[1.0]], initial_parameter_covariance=[[1.0]], outliers=kind, outlier_sizes=sizes,
    )  # fmt: skip
    rng = np.random.default_rng(4)
    y = np.outer(np.cumsum(rng.standard_normal(60)), [1.0, 2.0, -1.0]) + np.array([0.0, 0.0, 0.5])
    y += 0.01 * rng.standard_normal((60, 3))
    y[20, 0] += 0.4
    y[25, 1] -= 0.5
    y[30, 2], y[30, 1] = y[30, 2] + 0.4, np.nan
    y[40:44, 2] += 0.4
    expected = design.observer.run(y, np.zeros((60, 1)))
    refused = state_after(design.observer, y).refused[1]
    assert (refused > 0.0).all()
    assert_same(run_c(design, y, np.zeros((60, 1)), tmp_path, quick=True), expected)


def state_after(observer, y):
    state = observer.init()
    for sample in y:
        state, _ = observer.advance(state, sample, np.zeros(1))
    return state


@pytest.mark.long
@pytest.mark.parametrize("asked", ["none", "huber"])
def test_an_export_takes_outliers_as_a_run_is_told_to(asked, tmp_path) -> None:
    """C could not be told to use every sample, as `run --outliers none` does."""
    design = tank_observer("augmented-kalman", {})
    y, u = leaking(design)
    y[20, 1], y[60, 1:], y[111, 2] = y[19, 1] + 0.05, np.nan, np.nan
    expected = changed(design.observer, outliers=asked).run(y, u)
    gated = changed(design.observer, outliers="gate").run(y, u)
    assert np.abs(gated.states - expected.states)[33].max() > 0.01
    assert_same(run_c(design, y, u, tmp_path, quick=True, outliers=asked), expected)
    with pytest.raises(SpecError, match="outliers"):
        obsynth.export(design, tmp_path / "a.c", outliers="all")


def test_an_export_of_a_linear_design_says_that_it_knows_no_outliers(tmp_path) -> None:
    plant = obsynth.DescriptorSystem(E=[[1.0]], A=[[0.5]], B=[[1.0]], C=[[1.0]], dt=1.0)
    design = obsynth.descriptor_kalman(plant, Q=[[1e-2]], R=[[1e-2]])
    with pytest.raises(SpecError, match="outliers is for nonlinear designs"):
        obsynth.export(design, tmp_path / "a.c", outliers="none")


@pytest.mark.long
def test_a_sample_beside_a_missing_input_is_left_out_however_near_it_is(tmp_path) -> None:
    """As near as a fault may be, which is believed at once where the inputs are known."""
    design = tank_observer("augmented-kalman", OPTIONS["sizes"])
    y, u = leaking(design)
    whole = design.observer.run(y[:60], u[:60])
    u[33] = np.nan
    running = design.observer.start()
    found = run_c(design, y[:60], u[:60], tmp_path, quick=True)
    expected = [running.step(*sample) for sample in zip(y[:60], u[:60], strict=True)]
    states = np.array([said.states[0] for said in expected])
    assert np.abs(found["states"] - states).max() <= 1e-10
    assert np.abs(found["states"][:33] - whole.states[:33]).max() <= 1e-10
    # The sample of 0.5 below moves the first level by more than ten of its deviations.
    assert whole.states[33, 0] - states[33, 0] < -10.0 * expected[33].state_deviations[0, 0]


@pytest.mark.long
def test_two_outliers_in_a_row_and_one_after_missing_inputs_in_c(tmp_path) -> None:
    """They are left out where the sensor's outliers are known; the third of a row is believed."""
    design = tank_observer("augmented-kalman", OPTIONS["sizes"])
    y, u = leaking(design)
    y[30:32, 0] += 2.0
    u[10] *= 3.0
    u[39:41] = np.nan
    y[41, 2] -= 1.0
    running, refused = design.observer.start(), []
    found = run_c(design, y[:60], u[:60], tmp_path, quick=True)
    states = []
    for sample in zip(y[:60], u[:60], strict=True):
        states.append(running.step(*sample).states[0])
        refused.append(running.state.refused[1])
    assert np.abs(found["states"] - states).max() <= 1e-10
    lost = np.diff(refused, axis=0, prepend=0.0)
    assert lost[30:33, 0].tolist() == [1.0, 1.0, 0.0]
    assert lost[41, 2] == 1.0


@pytest.mark.one_in(3)
@pytest.mark.parametrize("form", FORMS)
def test_everything_at_once_in_c(form, tmp_path) -> None:
    design = tank_observer(form, BOTH)
    y, u = leaking(design)
    expected = design.observer.run(y, u)
    upper = np.array([high for _, high in LATER["state_bounds"].values()])
    assert (expected.states <= upper).all()
    assert (expected.states[75:] == upper).any(axis=0).all()
    assert_same(run_c(design, y, u, tmp_path), expected)


@pytest.mark.one_in(4)
@pytest.mark.parametrize(("form", "name"), [("forgetting", "reset"), ("augmented-kalman", "reset"),
                                            ("forgetting", "bounds"), ("random-walk", "late"),
                                            ("augmented-kalman", "slow")])  # fmt: skip
def test_each_option_in_c_does_what_it_does_in_python(form, name, tmp_path) -> None:
    design, leak = tank_observer(form, OPTIONS[name]), np.where(np.arange(120) < 50, 0.0, 0.03)[:, None]
    u = np.tile(design.plant.nominal_input, (120, 1))
    y = np.array(simulate_dae(design.plant, u, dt=1.0, parameters=leak, R=design.observer.R, seed=3).outputs)
    expected = as_run(design).run(y, u)
    plain = replace(design.observer, outliers="none", reset=0.0, state_bounds=None, sensors=None)
    assert np.abs(plain.run(y, u).states - expected.states).max() > 1e-6
    assert_same(run_c(design, y, u, tmp_path), expected)


#: All that single precision has to carry beside the plain filter; no reset, which counts squares of innovations.
WIDE = {"state_bounds": {"h1": [0.0, 5.0], "h2": [0.0, 5.0], "h3": [-1.0, 5.0]}}
FLOATS = {"plain": {}, "all": {**OPTIONS["gate"], **WIDE, **OPTIONS["late"]}}


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", FLOATS)
def test_floats_keep_near_doubles_and_say_how_near_they_were_measured(name, tmp_path) -> None:
    design = tank_observer("forgetting", FLOATS[name])
    source, header = obsynth.export(design, tmp_path / "tank.c", precision="float", warm_up=0.0)
    said = header.read_text().splitlines()[0]
    assert said.startswith('/* "Floats: measured, not proved: the largest error against double precision in 2 records')
    stated = {part.split()[0]: float(part.split()[1]) for part in said.split("): ")[1].split(";")[0].split(", ")}
    assert list(stated) == ["xhat[h1]", "xhat[h2]", "xhat[h3]", "fhat[leak]"]
    assert all(0.0 < error < 1e-4 for error in stated.values())
    kept = [line for text in (source, header) for line in text.read_text().splitlines() if "double" in line]
    assert all("time" in line or "warm_up" in line or line == said for line in kept)
    y, u = (part[:110] for part in leaking(design))
    y[60, 1] = 1e30  # no float is larger than 3e38
    if name == "plain":
        y[[20, 33, 60], [1, 0, 1]] = y[60, 2] = np.nan
    (tmp_path / "run.c").write_text(
        '#include "tank.h"\n#include <stdio.h>\nint main(void) { static tank_state s; tank_estimates e; float in[5];\n'
        "tank_reset(&s); while (fread(in, 4, 5, stdin) == 5) { int i, failed = tank_step(&s, in, in + 2, &e);\n"
        "float end = (float)failed; for (i = 0; i < 3; i++) fwrite(&e.states[i], 4, 1, stdout);\n"
        "fwrite(&e.faults[0], 4, 1, stdout); fwrite(&end, 4, 1, stdout); } return 0; }\n"
    )
    command = ["cc", *FLAGS, source, tmp_path / "run.c", "-o", tmp_path / "run", "-lm"]
    subprocess.run(command, check=True)
    given = np.hstack([u, y]).astype(np.float32)
    done = subprocess.run([tmp_path / "run"], input=given.tobytes(), capture_output=True, check=True)
    found = np.frombuffer(done.stdout, np.float32).reshape(len(y), 5).astype(float)
    exact = given.astype(float)
    expected = as_run(design).run(exact[:, 2:], exact[:, :2])
    # Another record than those it was measured on, of which 1e6 and blanks are part: within some times as much.
    gaps = np.abs(found[:, :4] - np.hstack([expected.states, expected.faults])).max(axis=0)
    assert (gaps <= 30.0 * np.array(list(stated.values()))).all()


@pytest.mark.long
def test_floats_are_refused_where_they_cannot_carry_an_observer_or_nobody_can_measure(tmp_path, monkeypatch) -> None:
    design = tank_observer("forgetting", {})
    exact = replace(design, observer=replace(design.observer, Q=1e-22 * np.eye(3), R=1e-20 * np.eye(3)))
    with pytest.raises(SpecError, match="does not carry"):
        obsynth.export(exact, tmp_path / "tank.c", precision="float", unverified=True)
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(SpecError, match="C compiler"):
        obsynth.export(design, tmp_path / "tank.c", precision="float")
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_bounds_that_many_states_break_at_once_and_one_that_is_known_exactly(tmp_path) -> None:
    design = tank_observer("forgetting", {"state_bounds": {"h1": [0.1, 0.12], "h2": [0.1, 0.11], "h3": [0.1, 0.1005]}})
    y, u = leaking(design)
    known = replace(design.observer, initial_covariance=np.diag([0.0, 1e-4, 1e-4]), Q=np.diag([0.0, 1e-9, 1e-9]))
    # Where h1 is known to be outside, at k = 0, no move keeps all bounds; later its deviation would be rounding alone.
    for observer, samples in ((design.observer, 19), (known, 1)):
        made = replace(design, observer=observer)
        assert_same(run_c(made, y[:samples], u[:samples], tmp_path), as_run(made).run(y[:samples], u[:samples]))
