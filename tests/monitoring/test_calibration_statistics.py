"""What a calibration is judged by, against numbers worked by hand or read from tables."""

from __future__ import annotations

import math
from statistics import NormalDist
from types import SimpleNamespace

import numpy as np
import pytest

from obsynth.monitoring.calibration import noise_proposals as calibrating
from obsynth.monitoring.calibration.diagnostics import (
    change_of_mean,
    consistency,
    mean_off,
    standing_out,
    whiteness,
    wrong_samples,
)
from obsynth.monitoring.calibration.explanations import explanations, regression_gain
from obsynth.monitoring.calibration.intervals import covariance_of, information, profile_box, quantile
from obsynth.monitoring.calibration.maximum import Maximum
from obsynth.monitoring.calibration.noise_states import NoiseStates, PlantWithNoise
from obsynth.results.calibration_files import box_row, calibration_text, read_calibration, verify_calibration


def test_a_quantile_is_shared_by_all_constants() -> None:
    assert quantile(0.95, 1, 1000, 0) == pytest.approx(NormalDist().inv_cdf(0.975))
    assert quantile(0.95, 5, 1000, 0) == pytest.approx(NormalDist().inv_cdf(0.995))
    # Student's t at 0.975 is 2.22814 for ten degrees of freedom, and 1.98197 for 109.
    assert quantile(0.95, 1, 13, 1) == pytest.approx(2.22814 * 1.05, rel=1e-5)
    assert quantile(0.95, 1, 112, 1) == pytest.approx(1.98197 * 1.025, rel=1e-5)


def test_covariances_and_what_is_not_determined() -> None:
    """Information 100 is a deviation of 0.1 widths; below 36 a direction is told; below 1 it counts as the width."""
    found = covariance_of(np.diag([100.0, 35.0, 0.25]), np.array([2.0, 3.0, 5.0]), ("a", "b", "c"))
    assert np.diag(found.covariance) == pytest.approx([0.04, 9.0 / 35.0, 25.0])
    assert [set(direction) for direction in found.undetermined] == [{"c"}, {"b"}]
    both = covariance_of(np.array([[50.0, -49.0], [-49.0, 50.0]]), np.ones(2), ("a", "b")).undetermined
    assert both == ({"a": pytest.approx(1.0), "b": pytest.approx(1.0)},)


@pytest.mark.parametrize(("held", "variance"), [(False, 0.1), (True, 0.01)])
def test_what_variances_share_with_a_constant_is_lost(held: bool, variance: float) -> None:
    """100 - 30^2 / 10 is left of the information where the other number is free, all of it where it is held."""
    problem = SimpleNamespace(names=("a",), widths=np.ones(2))
    objective = SimpleNamespace(problem=problem, low=np.array([-9.0, -9.0]), high=np.array([9.0, 9.0]))
    hessian = np.array([[100.0, 30.0], [30.0, 10.0]])
    found = information(hessian, objective, np.zeros(2), apart=np.array([False, held]))
    assert found.covariance[0, 0] == pytest.approx(variance)


def test_the_interval_of_a_mean_square() -> None:
    """Chi-square with ten degrees of freedom: 3.24697 and 20.48318 at 2.5 and 97.5 %."""
    found = consistency(12.0, 10)
    assert (found.value, found.low, found.high) == pytest.approx((1.2, 0.324697, 2.048318), rel=1e-5)
    assert found.holds
    assert not consistency(20.5, 10).holds
    assert not consistency(3.2, 10).holds


def test_whiteness_of_what_alternates() -> None:
    """Of 20 values +1 and -1 in turn the autocorrelations are -19/20, 18/20, ...: 22/20 (19 + 18 + 17 + 16) = 77."""
    found = whiteness(np.tile([1.0, -1.0], 10))
    assert found.statistic == pytest.approx(77.0)
    assert found.first == pytest.approx(-0.95)
    assert found.probability < 1e-14
    assert whiteness(np.array([])).probability == 1.0


@pytest.mark.parametrize(("size", "row"), [(0.95, None), (1.2, 30), (-1.2, 30)])
def test_a_change_of_mean_must_stand_out_of_all_rows_at_which_it_may_be(size: float, row: int | None) -> None:
    """A step of 0.95 in the middle of 60 rows is 13.5: more than 10.8, which one row may reach, less than 18.6 for all.

    One of 1.2 is 21.6 in its own unit, which is one here as the values are smaller.
    """
    assert change_of_mean(np.repeat([0.0, size], 30)[:, None]) == row
    assert change_of_mean(np.repeat([0.0, 9.0], 9)[:, None]) is None


def test_a_mean_is_off_where_it_is_no_chance() -> None:
    spread = np.tile([0.5, -0.5], 50)
    assert mean_off(0.5 + spread) == pytest.approx(0.5)
    assert mean_off(0.1 + spread) == 0.0
    assert mean_off(np.array([np.nan])) == 0.0


def test_values_far_from_all_others_are_no_measurements() -> None:
    column = np.tile([1.0, -1.0], 50)
    for rows, wrong in (([30], True), ([30, 31], True), ([30, 31, 32], False), ([0], False), ([99], False)):
        y = column.copy()
        y[rows] = 1e6
        assert np.flatnonzero(wrong_samples(y[:, None])[:, 0]).tolist() == (rows if wrong else [])


def test_what_stands_out_alone() -> None:
    column = np.tile([1.0, -1.0], 50)
    for rows, told in (([30], True), ([30, 60], True), ([30, 31], False), ([10, 30, 50, 70], False)):
        y = column.copy()
        y[rows] = 20.0
        assert np.flatnonzero(standing_out(y[:, None])[:, 0]).tolist() == (rows if told else [])


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ([20.0, -18.0], [30]),  # what a filter of noise of AR(.9) makes of one wrong sample
        ([-20.0, 18.0], [30]),
        ([20.0, -21.0], []),
        ([20.0, 18.0], []),
        ([20.0, -18.0, 16.0], []),
        ([20.0, 2.0, 20.0], [30, 32]),
    ],
)
def test_a_wrong_sample_of_a_sensor_with_coloured_noise_stands_out_with_the_one_after_it(values, told) -> None:
    column = np.tile([1.0, -1.0], 60)
    column[30 : 30 + len(values)] = values
    assert np.flatnonzero(standing_out(column[:, None])[:, 0]).tolist() == told
    # At the ends of a log nothing is beside.
    ends = np.tile([1.0, -1.0], 60)
    ends[0], ends[-2:] = 20.0, [20.0, -18.0]
    assert np.flatnonzero(standing_out(ends[:, None])[:, 0]).tolist() == [0, 118]


def explained(innovations: np.ndarray, inputs: np.ndarray | None = None, **more) -> dict[str, float]:
    n = len(innovations)
    given = {"constants": {}, "with_constant": lambda name, value: innovations, **more}
    inputs = np.zeros((n, 0)) if inputs is None else inputs[:, None]
    names = ["u"] * inputs.shape[1]
    return dict(explanations(innovations[:, None], inputs, ["y"], names, dt=0.1, **given))


def test_an_explanation_pays_for_its_coefficient() -> None:
    """1 +- 0.5 in 40 rows: an offset takes 50 to 10, so 20 log 5 - log(40) / 2."""
    found = explained(1.0 + np.tile([0.5, -0.5], 20))
    assert found["an offset of the sensor y"] == pytest.approx(20.0 * math.log(5.0) - 0.5 * math.log(40.0))


def test_inputs_that_act_later_or_earlier_are_told_apart() -> None:
    rng = np.random.default_rng(0)
    u = rng.standard_normal(60)
    moves = np.diff(u)
    for word, e in (("later", np.append(0.0, moves)), ("earlier", np.append(moves, 0.0))):
        best = max(explained(e + 0.01 * rng.standard_normal(60), u).items(), key=lambda item: item[1])[0]
        assert f"acts {word} than" in best


def test_a_constant_is_told_where_it_should_be() -> None:
    rng = np.random.default_rng(1)
    x, noise = rng.standard_normal(80), 0.01 * rng.standard_normal(80)
    found = explained(
        (1.0 - 2.0) * x + noise, constants={"k": 1.0}, with_constant=lambda _, k: ((k - 2.0) * x + noise)[:, None]
    )
    assert any(text.startswith("a constant k near 2 instead of 1") for text in found)


def test_a_constant_is_told_by_a_run_with_it_and_not_by_what_its_slope_foretells() -> None:
    """The slope at 1 asks for 2; with 2 the innovations are nearly what they were, so that nothing is explained."""
    rng = np.random.default_rng(1)
    x, noise = rng.standard_normal(80), 0.01 * rng.standard_normal(80)
    inputs = {"constants": {"k": 1.0}, "with_constant": lambda _, k: (x * max(2.0 - k, 0.999) + noise)[:, None]}
    assert not any("constant k" in text for text in explained(x + noise, **inputs))
    # Nor where the plant has no solution there.
    nowhere = lambda _, k: (x * (2.0 - k) + noise if k < 1.5 else np.full(80, np.nan))[:, None]  # noqa: E731
    assert not any("constant k" in text for text in explained(x + noise, constants={"k": 1.0}, with_constant=nowhere))


def test_a_regressor_counts_beside_others() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.standard_normal(50), rng.standard_normal(50)
    assert regression_gain(x, [], x + 1e-3 * y) > 100.0
    assert regression_gain(x + 0.1 * y, [x], x) == pytest.approx(0.0, abs=1e-9)


def test_correlations_are_sought_between_a_third_of_a_sample_and_the_length_of_the_log() -> None:
    inner = SimpleNamespace(
        values={}, state_names=("x",), equation_names=("x",), unstated=set(), units={}, has_levels=False, notes=(),
        unknown_inputs=(), walking=(), nominal_signals=np.zeros(0), nominal_state=np.zeros(1), state_scales=np.ones(1),
        state_deviations=np.ones(1), own_integration="radau",
    )  # fmt: skip
    log = SimpleNamespace(output_names=("y",), dt=0.1, samples=400, y=np.random.default_rng(0).normal(size=(400, 1)))
    found = PlantWithNoise(inner, NoiseStates({"y": None}), log)
    assert found.bounds["correlation of y"] == pytest.approx((math.log(0.03), math.log(40.0)))
    assert found.values["correlation of y"] == pytest.approx(math.log(1.0))


@pytest.mark.parametrize(("nats", "taken"), [(8.5, False), (9.5, True)])
def test_a_state_for_coloured_noise_pays_for_two_numbers(monkeypatch, nats: float, taken: bool) -> None:
    """Log(400) = 5.99 for both numbers together, and three nats that no explanation is below."""
    found, told, _ = states_of_colour(monkeypatch, nats, needed=7)
    assert bool(found) == taken == bool(told)


@pytest.mark.parametrize(
    ("nats", "needed", "told"), [(8.5, 5, True), (8.5, 6, False), (5.5, 5, False), (9.5, 5, False)]
)
def test_coloured_noise_that_process_noise_stands_for_is_told(
    monkeypatch, nats: float, needed: int, told: bool
) -> None:
    """A level that a sensor with coloured noise shows was followed by process noise, and a jump of that sensor was a
    fault of the plant; the colour saves the process noise, and adds no number."""
    *_, remarks = states_of_colour(monkeypatch, nats, needed=needed)
    assert bool(remarks) == told
    assert all("over about 14 s" in text and "{y: {correlation: unknown}}" in text for text in remarks)


def states_of_colour(monkeypatch, nats: float, *, needed: int) -> tuple:
    """Return the states, and what is told, where coloured noise of one sensor is better by so many nats and the log
    needs so many numbers beside it, five without it."""
    known = SimpleNamespace(t={"correlation of y": math.log(14.0)})
    known.best = lambda problem: (100.0 - nats, known, lambda: needed)
    monkeypatch.setattr(calibrating, "_needed_by_fit", lambda problem, fit: 5)
    monkeypatch.setattr(calibrating, "_proposals", lambda problem, fit: {("coloured", "y")})
    monkeypatch.setattr(calibrating, "like_problem", lambda problem, new: new)
    monkeypatch.setattr(calibrating, "_SearchStart", SimpleNamespace(of=lambda problem, fit: known))
    problem = SimpleNamespace(
        output_names=("y",), plant=SimpleNamespace(unknown_inputs=()), log=SimpleNamespace(samples=400)
    )
    return calibrating.proposed_states(
        problem, SimpleNamespace(value=100.0), NoiseStates(), ("coloured",), lambda states: problem, lambda text: None
    )


FILE = {
    "constants": {
        "k": {"nominal": 2.0, "range": [1.5, 2.5], "open": [], "unit": "N/m"},
        "m": {"nominal": 1.0, "range": [0.9, 1.2], "open": [], "unit": "kg"},
    },
    "level": 0.95, "stands": True, "log": {"digest": "ab" * 32},
}  # fmt: skip


def changed(where: tuple[str, ...], value: object) -> dict:
    import copy

    found = copy.deepcopy(FILE)
    part = found
    for key in where[:-1]:
        part = part[key]
    part[where[-1]] = value
    return found


@pytest.mark.parametrize(
    ("where", "value", "rows"),
    [
        ((), None, set()),
        (("constants", "k", "nominal"), 2.6, {"box", "ranges"}),
        (("constants", "k", "nominal"), 2.1, {"ranges"}),
        (("constants", "k", "range"), [1.6, 2.5], {"ranges"}),
        (("constants", "k", "range"), [1.5001, 2.5], set()),
        (("constants", "m", "unit"), "g", {"ranges"}),
        (("constants", "m", "open"), ["low"], {"ranges"}),
        (("constants",), {"k": FILE["constants"]["k"]}, {"ranges"}),
        (("level",), 0.9, {"ranges"}),
        (("level",), 1.0, {"box", "ranges"}),
        (("log", "digest"), "cd" * 32, {"log"}),
    ],
)  # fmt: skip
def test_a_calibration_file_is_compared_with_the_calibration_done_again(tmp_path, where, value, rows) -> None:
    file = tmp_path / "box.json"
    file.write_text(calibration_text(changed(where, value) if where else FILE))
    assert {check.name for check in verify_calibration(file, FILE).failures} == rows
    edited = tmp_path / "edited.json"
    edited.write_text(file.read_text().replace('"unit": "N/m"', '"unit": "N/mm"'))
    assert "digest" in {check.name for check in verify_calibration(edited).failures}


def test_a_box_is_that_of_its_calibration_file_entry_by_entry(tmp_path) -> None:
    file = tmp_path / "box.json"
    file.write_text(calibration_text(FILE))
    sha = read_calibration(file)["sha256"]

    def box(**other) -> SimpleNamespace:
        items = {
            name: SimpleNamespace(low=item["range"][0], high=item["range"][1], nominal=item["nominal"])
            for name, item in FILE["constants"].items()
        }
        given = {"calibration": sha, "digest": "ab" * 32, "level": 0.95, "calibrated": ("k", "m"), "constants": items}
        return SimpleNamespace(**{**given, **other})

    assert box_row(box(), file).passed
    narrow = {**box().constants, "m": SimpleNamespace(low=0.95, high=1.2, nominal=1.0)}
    moved = {**box().constants, "m": SimpleNamespace(low=0.9, high=1.2, nominal=1.05)}
    for other in (
        {"calibration": "0" * 64}, {"digest": "cd" * 32}, {"level": 0.9}, {"constants": narrow}, {"constants": moved},
    ):  # fmt: skip
        assert not box_row(box(**other), file).passed


class Quadratic:
    """Half of ``z' H z`` of constants in widths of their bounds, between ends."""

    bent, nt = False, 2

    def __init__(self, hessian: np.ndarray, ends: np.ndarray) -> None:
        widths = np.array([2.0, 0.3])
        self.hessian, (self.low, self.high), self.avoided = hessian, ends / widths, np.zeros(2)
        self.problem = SimpleNamespace(names=("a", "b"), widths=widths, low=ends[0], high=ends[1])

    def __call__(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        return 0.5 * float(z @ self.hessian @ z), self.hessian @ z


def test_a_box_ends_where_the_deviance_says_or_at_the_bound_that_was_given() -> None:
    """The root of the deviance is |z| over its deviation: 2 is reached at 0.2 and 0.4 widths, with b led along."""
    covariance = np.array([[0.01, 0.003], [0.003, 0.04]])
    ends = np.array([[-2.0, -0.3], [2.0, 0.023]])
    objective = Quadratic(np.linalg.inv(covariance), ends)
    best = Maximum(np.zeros(2), 0.0, objective.hessian, np.zeros(2))
    (low, high), (below, above) = profile_box(objective, best, 2.0, SimpleNamespace(undetermined=()))
    assert (low.value, high.value) == pytest.approx((-0.4, 0.4), rel=0.03)
    assert below.value == pytest.approx(-0.12, rel=0.03)
    assert [side.is_open for side in (low, high, below)] == [False] * 3
    # The bound itself, not what a division and a product leave of it.
    assert above.is_open
    assert above.value == 0.023 != 0.023 / 0.3 * 0.3
    there = Maximum(np.array([0.0, 0.023 / 0.3]), 0.0, objective.hessian, np.zeros(2))
    at_it = profile_box(objective, there, 2.0, SimpleNamespace(undetermined=()))[1][1]
    assert (at_it.value, at_it.is_open) == (0.023, True)


def test_rows_in_which_a_move_of_a_constant_has_no_number_are_left_out() -> None:
    """A move beyond what the plant can be simulated with ended in LAPACK's words: its SVD did not converge."""
    rng = np.random.default_rng(3)
    column, other = rng.standard_normal((2, 60))
    regressor = column + 0.5 * rng.standard_normal(60)
    broken = np.where(np.arange(60) % 5 == 0, np.nan, other)
    kept = np.isfinite(broken)
    found = regression_gain(column, [broken], regressor)
    assert found == pytest.approx(regression_gain(column[kept], [other[kept]], regressor[kept]), rel=1e-12)
    assert regression_gain(column, [np.full(60, np.nan)], regressor) == 0.0
