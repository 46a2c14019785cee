"""Windows, their proofs and their verdicts, each by the property that it must have."""

from __future__ import annotations

import re
from fractions import Fraction
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

import obsynth
from obsynth.methods.guaranteed_test import bank, regions
from obsynth.methods.guaranteed_test.bank import _smallest_groups, blind_to
from obsynth.methods.guaranteed_test.exact import Programmes, known_rows
from obsynth.methods.guaranteed_test.method import GuaranteedTestMethod
from obsynth.methods.guaranteed_test.problem import window_as_designed
from obsynth.methods.guaranteed_test.proofs import (
    columns_of,
    exact_multipliers,
    proved_least,
    proved_threshold,
    repaired_multipliers,
    repaired_point,
    rows_of,
)
from obsynth.monitoring.thresholds.guaranteed import GuaranteedRule
from obsynth.monitoring.thresholds.monitor import LinearSample, Sample
from obsynth.proofs.nearby_solutions import NearbySolution, rational_correction

BASIC: dict[str, Any] = {"course": "constant", "samples": 5, "fault": "f1", "free": "none"}


def random_plant(seed: int, *, singular: bool = False) -> obsynth.DescriptorSystem:
    rng = np.random.default_rng([463, seed])
    n, a = 3, rng.standard_normal((3, 3))
    a *= 0.9 / np.abs(np.linalg.eigvals(a)).max()
    e = np.diag([1.0, 1.0, 0.0]) if singular else np.eye(n)
    b, d = rng.standard_normal((n, 2)), rng.standard_normal((2, 2))
    # Some inputs reach neither some equations nor some outputs.
    b[0, 1] = d[1, 0] = b[2, 0] = 0.0
    return obsynth.DescriptorSystem(
        e,
        a,
        b,
        rng.standard_normal((2, n)),
        D=d,
        Bf=rng.standard_normal((n, 1)),
        Bd=rng.standard_normal((n, 1)),
        dt=0.1,
    )


def options(plant: obsynth.DescriptorSystem, **more: Any) -> dict[str, Any]:
    bounds = {"disturbance_bounds": {"d1": 0.2}, "noise_bound": dict.fromkeys(plant.output_names, 0.1)}
    return {**BASIC, **bounds, **more}


@cache
def design_of(seed: int, singular: bool = False, **more: Any) -> obsynth.GuaranteedTest:
    plant = random_plant(seed, singular=singular)
    return obsynth.guaranteed_test(plant, **options(plant, **more))


def window_of(design: obsynth.GuaranteedTest) -> Any:
    return window_as_designed(design.linear[0], GuaranteedTestMethod.of(design.options))


@pytest.mark.parametrize("singular", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_rows_are_lost_where_a_missing_sample_changes_them(seed: int, singular: bool) -> None:
    """Known inputs enter equations by B and outputs by D, outputs enter their own rows: no other row may be lost."""
    window, rng = window_of(design_of(seed, singular)), np.random.default_rng(seed)
    length = max(window.equations, window.test_problem.samples)
    y, u = rng.standard_normal((window.test_problem.samples, 2)), rng.standard_normal((length, 2))
    for signal, place in [("u", (1, 0)), ("u", (1, 1)), ("u", (length - 1, 0)), ("y", (2, 1)), ("y", (0, 0))]:
        blank = {"y": y.copy(), "u": u.copy()}
        blank[signal][place] = np.nan
        right, lost = known_rows(window, blank["y"], blank["u"])
        moved = {"y": y.copy(), "u": u.copy()}
        moved[signal][place] += 10.0
        changed = window.data(moved["y"], moved["u"][: len(u)]) != window.data(y, u)
        assert lost.tolist() == np.flatnonzero(changed).tolist(), (signal, place)
        assert not right[lost].any()
        kept = np.setdiff1d(np.arange(window.rows), lost)
        assert right[kept] == pytest.approx(window.data(y, u)[kept])


@pytest.mark.parametrize("seed", range(3))
def test_no_test_sees_a_lost_row(seed: int) -> None:
    window = window_of(design_of(seed))
    rows = np.array([1, window.outputs_at + 3])
    less = window.without(rows)
    found = Programmes(less, 0)
    programme, _, _ = found._programme(np.zeros((5, 2)), np.zeros((5, 2)))
    assert programme.test is not None
    values, radius = programme.test[0].values, programme.test[0].radius
    assert np.all(np.abs(values[rows]) + radius[rows] <= 1e-14 * np.abs(values).max())
    # With fewer rows no threshold is smaller.
    assert programme.test[1] >= design_of(seed).threshold * (1.0 - 1e-9)


def chain() -> obsynth.DescriptorSystem:
    """Return a plant of index three, of which later equations tell earlier states."""
    e = np.diag([1.0, 1.0], 1)
    e = np.block([[e, np.zeros((3, 1))], [np.zeros((1, 3)), np.eye(1)]])
    a = np.eye(4)
    a[3, 3], a[3, 0] = 0.5, 1.0
    return obsynth.DescriptorSystem(
        e, a, np.ones((4, 1)), [[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0]], Bf=[[0.0], [0.0], [0.0], [1.0]], dt=0.1
    )


def test_a_row_is_decided_with_what_is_known_then() -> None:
    """Programmes of a row have no equation after the last input that the test itself waits for."""
    design = obsynth.guaranteed_test(
        chain(), course="constant", samples=5, noise_bound={"y1": 0.1, "y2": 0.1}, free="none", exact=True
    )
    whole = window_of(design)
    assert whole.test_problem.closing == 2
    programmes = Programmes.of(design)
    rows = design.linear[1].order + 1
    assert programmes.window.equations <= rows
    low, high = programmes.interval(np.zeros((rows, 2)), np.zeros((rows, 1)))
    assert low < 0.0 < high
    shorter = Programmes(whole, 0)
    assert shorter.window.test_problem.closing == 0
    assert Programmes(whole, 2).window.test_problem.closing == 2
    assert Programmes(whole, 5).window.test_problem.closing == 2


@pytest.mark.parametrize("norm", ["box", "ellipsoid"])
@pytest.mark.parametrize("seed", range(4))
def test_a_witness_is_as_large_as_its_farthest_exact_point_allows(seed: int, norm: str) -> None:
    """The exact point is anywhere within the radius: all bounds must hold for each of these."""
    window, rng = window_of(design_of(seed, norm=norm)), np.random.default_rng(seed)
    bar, bounded = window.bar, window.bounded
    values = np.where(
        bounded, rng.uniform(-1.0, 1.0, len(bar)) * np.where(bounded, bar, 0.0), rng.standard_normal(len(bar))
    )
    values[0] = 0.7
    radius = np.where(bounded, rng.uniform(0.0, 2.0, len(bar)) * np.where(bounded, bar, 0.0), 0.1)
    found = proved_least(window, NearbySolution(values, radius))
    shares = (np.abs(values) + radius)[bounded] / bar[bounded]
    groups = window.group[bounded] if norm == "ellipsoid" else np.full(bounded.sum(), -1)
    worst = max(
        [1.0, *shares[groups < 0], *(np.sqrt(np.sum(shares[groups == g] ** 2)) for g in set(groups[groups >= 0]))]
    )
    near = np.where(bounded, 0.1 * np.where(bounded, bar, 0.0), 1.0)
    near[0] = 0.7
    assert proved_least(window, NearbySolution(near, np.zeros(len(bar)))) <= 0.7
    assert found <= 0.7 / worst * (1.0 + 1e-12)
    assert found >= 0.7 / worst * (1.0 - 1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_threshold_counts_how_far_multipliers_are_from_exact_ones(seed: int) -> None:
    window, rng = window_of(design_of(seed)), np.random.default_rng(seed)
    values = np.array(design_of(seed).certificate.matrices["multipliers"]).ravel()
    radius = rng.uniform(0.0, 0.1, len(values)) * np.abs(values)
    found, bar = proved_threshold(window, NearbySolution(values, radius)), np.where(window.bounded, window.bar, 0.0)
    matrix = window.matrix.toarray()
    for _ in range(20):
        other = values + radius * np.sign(rng.standard_normal(len(values)))
        assert bar @ np.abs(matrix.T @ other) <= found * (1.0 + 1e-12)
    assert found <= (bar @ (np.abs(matrix.T @ values) + np.abs(matrix).T @ radius)) * (1.0 + 1e-9)


def test_equations_that_contradict_each_other_have_no_step() -> None:
    matrix = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 1.0, 1.0]])
    weight = np.ones(3)
    third = Fraction(1, 3)
    assert rational_correction(matrix, weight, [third, third, Fraction(1)]) is None
    found = rational_correction(matrix, weight, [third, 2 * third, Fraction(1)])
    assert found is not None
    step = dict(zip(*found, strict=True))
    for row, wanted in zip(matrix, (third, 2 * third, Fraction(1)), strict=True):
        assert sum((Fraction(float(v)) * step.get(j, Fraction(0)) for j, v in enumerate(row)), Fraction(0)) == wanted


@pytest.mark.parametrize("seed", range(3))
def test_exact_multipliers_see_no_free_column_at_all(seed: int) -> None:
    window = window_of(design_of(seed))
    shipped = np.array(design_of(seed).certificate.matrices["multipliers"]).ravel()
    found = exact_multipliers(window, shipped)
    assert found is not None
    for column in np.flatnonzero(window.free):
        seen = sum(
            (found[i] * Fraction(float(v)) * int(t) for i, j, v, t in
             zip(window.i, window.j, window.value, window.times, strict=True) if j == column), Fraction(0),
        )  # fmt: skip
        assert seen == 0
    assert max(abs(float(value) - s) for value, s in zip(found, shipped, strict=True)) < 1e-9 * np.abs(shipped).max()


@pytest.mark.parametrize("seed", range(3))
def test_repaired_numbers_have_an_exact_solution_within_their_radius(seed: int) -> None:
    window = window_of(design_of(seed))
    test = repaired_multipliers(
        window, np.array(design_of(seed).certificate.matrices["multipliers"]).ravel(), refine=True
    )
    point = repaired_point(window, np.array(design_of(seed).certificate.matrices["witness"]).ravel(), refine=True)
    assert test is not None
    assert point is not None
    matrix, told = window.matrix.toarray(), [0, *np.flatnonzero(window.free)]
    missing = np.array([float(value) for value in columns_of(window, test.values)])[told] - np.eye(1, len(told)).ravel()
    assert np.all(np.abs(missing) <= np.abs(matrix[:, told]).T @ test.radius)
    left = np.array([float(value) for value in rows_of(window, point.values)])
    assert np.all(np.abs(left) <= np.abs(matrix) @ point.radius)


def threshold_by_another_solver(design: obsynth.GuaranteedTest) -> float:
    """Return the largest fault that bounds can hide: the primal programme, by scipy with its own matrices."""
    window = window_of(design)
    cost = -np.eye(1, len(window.bar)).ravel()
    ends = [(None, None) if not np.isfinite(bar) else (-bar, bar) for bar in window.bar]
    found = linprog(cost, A_eq=window.matrix.toarray(), b_eq=np.zeros(window.rows), bounds=ends, method="highs-ipm")
    return -float(found.fun)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("course", ["constant", "any", "ramp"])
@pytest.mark.parametrize("seed", range(2))
def test_threshold_and_least_enclose_what_bounds_can_hide(seed: int, course: str) -> None:
    design = design_of(seed, course=course, samples=6)
    hidden = threshold_by_another_solver(design)
    assert design.least <= hidden * (1.0 + 1e-7)
    assert design.threshold >= hidden * (1.0 - 1e-7)
    assert design.threshold <= design.least * (1.0 + 1e-6)


# The rule on data of any length.


def rule_of(design: obsynth.GuaranteedTest) -> GuaranteedRule:
    return GuaranteedRule(design)


def stepped(rule: GuaranteedRule, state: Any, k: int, values: np.ndarray, y: np.ndarray, u: np.ndarray) -> Any:
    said = LinearSample(values, u, y, 0)
    return rule.step(state, Sample(0.1 * k, values[:0], values[:0], said))


def rows_for(steps: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return 0.05 * rng.standard_normal((steps, 2)), rng.standard_normal((steps, 2))


@pytest.mark.parametrize("skipped", [1, 2, 4])
def test_rows_that_were_skipped_are_rows_without_samples(skipped: int) -> None:
    """Under ``missing: solve`` a log that leaves rows out is one that has them blank."""
    rule = rule_of(design_of(1, missing="solve"))
    y, u = rows_for(14)
    blank = np.full(2, np.nan)
    verdicts = []
    for way in ("skipped", "blank"):
        state, found = rule.init(), []
        for k in range(6):
            state, _ = stepped(rule, state, k, np.zeros(1), y[k], u[k])
        if way == "skipped":
            state = rule.restart(state, skipped)
        else:
            for k in range(skipped):
                state, _ = stepped(rule, state, 6 + k, np.full(1, np.nan), blank, blank)
        for k in range(6 + skipped, 14):
            state, judged = stepped(rule, state, k, np.zeros(1), y[k], u[k])
            found.append([judged.statistic, judged.threshold])
        verdicts.append(np.array(found))
    np.testing.assert_array_equal(verdicts[0], verdicts[1])
    assert np.isfinite(verdicts[0]).any()


@pytest.mark.parametrize("missing", ["solve", "wait"])
def test_the_fixed_test_says_nothing_of_a_window_with_an_incomplete_row(missing: str) -> None:
    """What the observer says of such a window is no test's value: here it is a million."""
    design = design_of(1, missing=missing)
    rule, (y, u) = rule_of(design), rows_for(20)
    y[9, 1] = np.nan
    state, before = rule.init(), rule._length
    for k in range(20):
        values = np.full(1, 1e6) if 9 <= k < 9 + before else np.zeros(1)
        state, judged = stepped(rule, state, k, values, y[k], u[k])
        if 9 <= k < 9 + before and np.isfinite(judged.statistic):
            assert missing == "solve"
            assert judged.statistic < 1e3
            assert judged.threshold >= design.threshold * (1.0 - 1e-9)
        if missing == "wait":
            assert np.isfinite(judged.statistic) == (before - 1 <= k < 9 or k >= 9 + before)


def test_a_window_begins_again_after_rows_that_are_missing() -> None:
    rule, (y, u) = rule_of(design_of(0)), rows_for(12)
    state = rule.init()
    for k in range(6):
        state, _ = stepped(rule, state, k, np.zeros(1), y[k], u[k])
    state, found = rule.restart(state, 1), []
    for k in range(7, 12):
        state, judged = stepped(rule, state, k, np.zeros(1), y[k], u[k])
        found.append(np.isfinite(judged.statistic))
    assert found == [False] * (rule._length - 1) + [True] * (5 - rule._length + 1)


def test_a_verdict_waits_for_a_full_window() -> None:
    rule, (y, u) = rule_of(design_of(0)), rows_for(8)
    state, found = rule.init(), []
    for k in range(8):
        state, judged = stepped(rule, state, k, np.zeros(1), y[k], u[k])
        found.append(np.isfinite(judged.statistic))
    assert found == [k >= rule._length - 1 for k in range(8)]


def test_the_threshold_has_what_rounding_adds_for_the_largest_signals_so_far() -> None:
    design = design_of(0)
    rule, (y, u) = rule_of(design), rows_for(12)
    u[3] *= 1e6
    state, rounding = rule.init(), np.array(design.certificate.matrices["rounding"]).ravel()
    for k in range(12):
        state, judged = stepped(rule, state, k, np.zeros(1), y[k], u[k])
        largest = np.abs(np.hstack([u, y])[: k + 1]).max(axis=0)
        assert judged.threshold == pytest.approx(design.threshold + rounding @ largest, rel=1e-14)


# Banks, and regions of nonlinear plants.


def three_faults() -> obsynth.DescriptorSystem:
    """Return a plant whose first fault is hidden by the third, and not by the second."""
    bf = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.5, 0.0, 0.5]])
    return obsynth.DescriptorSystem(
        None, [[0.5, 0.1, 0.0], [0.0, 0.6, 0.2], [0.1, 0.0, 0.4]], np.zeros((3, 1)), np.eye(3), Bf=bf, dt=0.1
    )


def test_a_smallest_group_is_refuted_by_each_smaller_one() -> None:
    """The claim that only {f1, f2, f3} can be told fails: {f1, f3} can, which is the second smaller group."""
    plant = three_faults()
    asked = GuaranteedTestMethod(
        course="step", before=3, samples=7, noise_bound=dict.fromkeys(plant.output_names, 0.1), isolate=True
    )
    # Insensitive to f3 there is no test of f1, insensitive to f2 there is one.
    assert bank.proved_hidden(plant, blind_to(asked, plant, 0, [1]))
    assert not bank.proved_hidden(plant, blind_to(asked, plant, 0, [2]))
    groups = np.array([[1.0, 1.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    design: Any = SimpleNamespace(
        linear=(plant, None), certificate=SimpleNamespace(matrices={bank.BANK_GROUPS: groups})
    )
    rows = {row.name: row for row in _smallest_groups(design, asked)}
    assert not rows["smallest group[f1]"].passed
    assert rows["smallest group[f1]"].value == 1.0
    assert rows["smallest group[f3]"].passed
    assert set(rows) == {"smallest group[f1]", "smallest group[f3]"}


def remainder_plant(**changes: Any) -> Any:
    own, nx, ny = 1, 2, 1
    fields = {
        "E": np.eye(nx), "A": 0.5 * np.eye(nx), "B": np.zeros((nx, 1)), "C": np.ones((ny, nx)),
        "Bd": np.hstack([np.ones((nx, own)), np.eye(nx), np.zeros((nx, ny))]),
        "Dd": np.hstack([np.zeros((ny, own)), np.zeros((ny, nx)), np.eye(ny)]),
        "dt": 0.5,
    }  # fmt: skip
    return SimpleNamespace(linear=(obsynth.DescriptorSystem(**{**fields, **changes}), None))


def test_a_remainder_is_of_a_plant_with_one_disturbance_for_each_state_and_output() -> None:
    assert regions._represents_remainder(remainder_plant(), 1)
    whole = remainder_plant().linear[0]
    for changes in (
        {"E": np.diag([1.0, 2.0])},
        {"E": np.diag([1.0, 0.0])},
        {"Bd": 0.5 * whole.Bd},
        {"Dd": 0.5 * whole.Dd},
        {"Bd": whole.Bd[:, [0, 2, 1, 3]]},
    ):
        assert not regions._represents_remainder(remainder_plant(**changes), 1), changes


@pytest.mark.parametrize(
    ("dt", "size", "names", "passed"),
    [
        (0.5, 0.9, ("a", "b", "c"), True),
        (0.25, 0.9, ("a", "b", "c"), False),
        (0.5, 1.1, ("a", "b", "c"), False),
        (0.5, 0.9, ("a", "c", "b"), False),
    ],
)
def test_a_remainder_is_of_the_sample_time_that_was_asked_for(
    dt: float, size: float, names: tuple[str, ...], passed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = remainder_plant(dt=dt, disturbance_names=["rain", "a", "b", "c"]).linear[0]
    asked = SimpleNamespace(
        model={"inputs": {"rain": 0.0}}, region={}, sample_time=0.5, given=None,
        disturbance_bounds={"a": 1.0, "b": 1.0, "c": 1.0},
    )  # fmt: skip
    design: Any = SimpleNamespace(linear=(plant, None), options={})
    monkeypatch.setattr(regions, "DAEModel", lambda **_: None)
    bounds = dict(zip(names, (size, 0.1, 0.2), strict=True))
    monkeypatch.setattr(regions, "bounded_model", lambda *_, **__: (None, bounds))
    assert regions.remainder_check(design, lambda _: asked).passed == passed


def test_sizes_in_the_notes_of_a_bank_are_bounds() -> None:
    """In six digits they are rounded up: of six numbers, those rounded to the nearest would hardly all be above."""
    a = [[0.5, 0.1, 0.0], [0.0, 0.6, 0.2], [0.1, 0.0, 0.4]]
    plant = obsynth.DescriptorSystem(None, a, np.zeros((3, 1)), np.eye(3), Bf=np.eye(3), dt=0.1)
    noise = {name: 0.1 / 3.0**i for i, name in enumerate(plant.output_names)}
    made = obsynth.guaranteed_test(plant, isolate=True, course="step", before=3, samples=7, noise_bound=noise)
    told = re.findall(r"threshold ([^ ]+), ([^ ]+) is certain to be detected", " ".join(made.notes))
    assert len(told) == plant.nf
    for test, (threshold, certain) in zip(made.tests, told, strict=True):
        assert 0.0 <= float(threshold) / test.threshold - 1.0 < 1e-5
        assert 0.0 <= float(certain) / test.surely_found - 1.0 < 1e-5
