"""Constant faults: what plant and stored observer make of them together is proved, in exact arithmetic."""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import flint
import numpy as np
import pytest
from corruption_tables import failed, last_digits, slow_plant

import obsynth
from obsynth import DescriptorSystem, ObserverDesign
from obsynth.methods.registry import method_class
from obsynth.proofs.balls import Ball
from obsynth.proofs.extended_balls import ExtendedBall
from obsynth.proofs.linear_equations import enclosed_solution
from obsynth.proofs.products import as_ball
from obsynth.verification import settled_faults
from obsynth.verification.constant_faults import constant_fault_row
from obsynth.verification.settled_faults import ConstantFaults

ROW = "constant fault"
#: Methods, their time, and options by which they are as fast as a sample, or a second.
METHODS = {
    "fault-estimation-filter": (1.0, {}), "ui-pi-observer": (0.0, {"decay": 1.0}), "pd-observer": (0.0, {"decay": 1.0}),
    "functional-filter": (1.0, {"decay": 0.5}), "optimal-filter": (1.0, {}),
}  # fmt: skip


def exact(matrix: np.ndarray) -> flint.fmpq_mat:
    """A matrix of doubles, exactly."""
    rows, columns = matrix.shape
    entries = [Fraction(float(value)) for value in np.ravel(matrix)]
    return flint.fmpq_mat(rows, columns, [flint.fmpq(e.numerator, e.denominator) for e in entries])


def missed_in_the_end(design: ObserverDesign) -> Fraction:
    """What the estimate of a unit fault misses once plant and observer have settled, in rational numbers."""
    plant, observer = design.plant, design.observer
    rows, discrete = observer.fault_rows, int(plant.dt > 0.0)
    still = exact(np.eye(observer.order)) * discrete - exact(observer.Az)
    state = (exact(plant.E) * discrete - exact(plant.A)).solve(exact(plant.Bf))
    seen = exact(plant.C) * state + exact(plant.Df)
    shown = exact(observer.Dy[rows]) * seen
    if observer.order:
        shown += exact(observer.Cz[rows]) * still.solve(exact(observer.By) * seen)
    return abs(Fraction(int(shown[0, 0].p), int(shown[0, 0].q)) - 1)


@pytest.mark.parametrize("method", METHODS)
def test_last_digits_of_an_observer_of_a_slow_plant_fail_this_row_alone(method: str) -> None:
    dt, options = METHODS[method]
    design = obsynth.design(slow_plant(dt), method, **options)
    assert design.report[ROW].status == "proved"
    assert missed_in_the_end(design) <= design.report[ROW].value <= 1e-3
    wrong = last_digits(design)
    missed = missed_in_the_end(wrong)
    assert missed > 1e-3
    assert failed(wrong) == {ROW}
    row = obsynth.verify(wrong)[ROW]
    assert missed <= row.value <= 1.1 * float(missed)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("method", METHODS)
def test_what_is_missed_is_judged_by_the_option(method: str) -> None:
    plant = slow_plant(METHODS[method][0])
    design = obsynth.design(plant, method, steady_error_limit=0.5)
    assert design.report[ROW].bound == 0.5
    with pytest.raises(obsynth.SpecError, match="steady_error_limit"):
        obsynth.design(plant, method, steady_error_limit=0.0)
    with pytest.raises(obsynth.VerificationError, match=ROW):
        obsynth.design(plant, method, steady_error_limit=1e-300)
    assert failed(design.replace(options={**design.options, "steady_error_limit": 0.0})) == {"options"}


TURNING = {"Phi": [[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]], "Cw": [[1.0, 0.0]]}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("limit", [5e-4, 2e-3, 0.5])
def test_no_limit_is_taken_where_nothing_is_claimed_of_constant_faults(limit: float) -> None:
    plant = DescriptorSystem(A=[[0.9, 0.1], [0.0, 0.8]], C=np.eye(2), Bf=[[1.0], [0.0]], dt=0.1)
    design = obsynth.ui_pi_observer(plant, fault_model=TURNING)
    assert ROW not in {row.name for row in design.report.checks}
    assert failed(design.replace(options={**design.options, "steady_error_limit": limit})) == {"options"}
    with pytest.raises(obsynth.VerificationError, match="leave steady_error_limit out"):
        obsynth.ui_pi_observer(plant, fault_model=TURNING, steady_error_limit=limit)


@pytest.mark.parametrize("norm", ["hinf", "h2"])
def test_model_matching_has_no_limit_of_constant_faults(norm: str) -> None:
    """Its estimate of a constant fault is another one: a limit in its file, or in a call, would be a false claim."""
    plant = DescriptorSystem(
        A=[[0.8]], Bf=[[0]], Bw=[[1, 0, 0]], C=[[1], [1]], Df=[[1], [0]], Dw=[[0, 0.5, 0], [0, 0, 1]], dt=1.0
    )
    matching = {"reference": ([[0.5]], [[1.0]], [[0.5]], [[0.0]]), "exact": False, "norm": norm}
    design = obsynth.optimal_filter(plant, **matching)
    assert "steady_error_limit" not in design.options
    for limit in (5e-4, 2e-3, 0.5):
        assert failed(design.replace(options={**design.options, "steady_error_limit": limit})) == {"options"}
        with pytest.raises(obsynth.SpecError, match="steady_error_limit is for exact fault maps"):
            obsynth.optimal_filter(plant, **matching, steady_error_limit=limit)


def test_a_plant_that_adds_up_its_fault_is_judged_by_the_errors_alone() -> None:
    # The pole is on the boundary: the state has no end.
    plant = DescriptorSystem(A=[[1.0, 1.0], [0.0, 1.0]], C=np.eye(2), Bf=[[0.0], [1.0]], dt=1.0)
    for method in ("fault-estimation-filter", "ui-pi-observer", "functional-filter", "optimal-filter"):
        row = obsynth.design(plant, method).report[ROW]
        assert row.passed, method
        assert "errors alone" in row.detail, method


def test_a_pole_that_rounding_moves_off_the_boundary_is_on_it() -> None:
    plant = DescriptorSystem(A=[[1.0 - 2.0**-53, 1.0], [0.0, 1.0]], C=np.eye(2), Bf=[[0.0], [1.0]], dt=1.0)
    row = obsynth.fault_estimation_filter(plant).report[ROW]
    assert row.passed
    assert row.value < 1e-9


def test_an_estimate_of_half_the_fault_fails_whatever_the_plant() -> None:
    for a in (0.5, 1.0):
        plant = DescriptorSystem(A=[[a]], C=[[1.0], [1.0]], Bf=[[1.0]], dt=1.0)
        design = obsynth.fault_estimation_filter(plant)
        rows = design.observer.fault_rows
        cz, dy = np.array(design.observer.Cz), np.array(design.observer.Dy)
        cz[rows] *= 0.5
        dy[rows] *= 0.5
        halved = design.replace(observer=dataclasses.replace(design.observer, Cz=cz, Dy=dy))
        model = method_class(design.method).error_model(halved)
        row = constant_fault_row(ConstantFaults(model, np.eye(1)), 1e-3, None)
        assert row.value == pytest.approx(0.5, rel=1e-6), a
        assert not row.passed, a


@pytest.mark.parametrize("seed", range(6))
def test_solutions_are_enclosed(seed: int) -> None:
    rng = np.random.default_rng([46, seed])
    n = int(rng.integers(1, 8))
    matrix = rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-6, 6, (n, 1)) * 10.0 ** rng.uniform(-6, 6, n)
    right = rng.standard_normal((n, 2))
    true = exact(matrix).solve(exact(right))
    for kind in (Ball, ExtendedBall):
        with flint.ctx.workprec(212):
            found = enclosed_solution(kind.exact(matrix), kind.exact(right))
            ball = found if isinstance(found, Ball) else as_ball(found.content)
        for i in range(n):
            for j in range(2):
                value = Fraction(int(true[i, j].p), int(true[i, j].q))
                away = abs(value - Fraction(float(ball.midpoint[i, j])))
                assert away <= Fraction(float(ball.radius[i, j])), (kind, i, j)
        assert np.all(ball.radius <= 1e-6 * np.max(np.abs(ball.midpoint), axis=0)[None, :] + 1e-300) or kind is Ball
    singular = np.vstack([matrix, matrix[:1]])[:, :n][-n:] if n > 1 else np.zeros((1, 1))
    singular[0] = singular[-1]
    for kind in (Ball, ExtendedBall):
        with flint.ctx.workprec(212):
            assert enclosed_solution(kind.exact(singular), kind.exact(right)) is None


def test_a_state_that_never_settles_in_practice_is_judged_by_the_errors_alone() -> None:
    # After 1e11 samples the state would be 1e22 times the fault, and rounding of any number of the observer beside it.
    a = np.array([[1.0 - 1e-11, 1.0], [0.0, 1.0 - 1e-11]])
    plant = DescriptorSystem(A=a, C=[[1.0, 0.0]], Bf=[[0.0], [1.0]], dt=1.0)
    design = obsynth.functional_filter(plant, decay=0.5)
    wrong = last_digits(design)
    assert missed_in_the_end(wrong) > 1.0
    row = obsynth.verify(wrong)[ROW]
    assert row.passed
    assert "errors alone" in row.detail


def test_units_of_faults_decide_nothing() -> None:
    """A fault beside another is as large as what it makes of the outputs."""
    found = []
    for unit in (1.0, 1e9):
        plant = DescriptorSystem(A=np.diag([0.5, 0.2]), C=np.eye(2), Bf=np.diag([1.0, unit]), dt=1.0)
        design = obsynth.fault_estimation_filter(plant)
        model = method_class(design.method).error_model(design)
        # An estimate of f1 that would have to hold a thousandth of f2.
        given = ConstantFaults(model, np.array([[1.0, 1e-3 * unit], [0.0, 1.0]]))
        found.append(constant_fault_row(given, 1e-6, None).value)
    assert found[0] == pytest.approx(found[1], rel=0.1)
    assert 1e-4 < found[0] < 1e-2


@pytest.mark.parametrize("method", ["functional-filter", "ui-pi-observer"])
def test_equations_without_a_next_state_count_where_the_state_has_no_end(method: str) -> None:
    plant = DescriptorSystem(
        E=np.diag([1.0, 0.0]), A=np.diag([1.0, -1.0]), C=np.eye(2), Bf=[[1.0], [1.0]], dt=1.0
    )  # fmt: skip
    row = obsynth.design(plant, method).report[ROW]
    assert row.passed
    assert "errors alone" in row.detail


def test_a_fault_is_what_its_model_shows_of_a_state_that_stays() -> None:
    plant = DescriptorSystem(A=[[1.0]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    model = {"Phi": [[1.0]], "Cw": [[4.0]]}
    row = obsynth.ui_pi_observer(plant, fault_model=model).report[ROW]
    assert row.passed
    assert row.value < 1e-9


def test_of_a_fault_model_without_a_constant_nothing_is_said() -> None:
    plant = DescriptorSystem(A=[[0.5]], C=[[1.0]], Bf=[[1.0]], dt=1.0)
    design = obsynth.ui_pi_observer(plant, fault_model={"sinusoid": 0.7})
    assert ROW not in {row.name for row in design.report.checks}


@pytest.mark.parametrize("method", ["fault-estimation-filter", "ui-pi-observer", "functional-filter", "optimal-filter"])
def test_faults_of_sensors_are_followed_too(method: str) -> None:
    plant = DescriptorSystem(A=[[0.5]], C=[[1.0], [1.0]], Bf=[[0.0]], Df=[[1.0], [0.0]], dt=1.0)
    assert obsynth.design(plant, method).report[ROW].value < 1e-9


def test_an_optimal_filter_settles_at_its_reference() -> None:
    plant = DescriptorSystem(A=[[0.5]], C=[[1.0], [1.0]], Bf=[[1.0]], dt=1.0, sensor_noise={"y1": 0.1, "y2": 0.1})
    reference = {"A": [[0.5]], "B": [[0.5]], "C": [[4.0]], "D": [[0.0]]}
    design = obsynth.optimal_filter(plant, reference=reference)
    assert missed_in_the_end(design) > 1
    assert design.report[ROW].value < 1e-6
    matching = obsynth.optimal_filter(plant, reference=reference, exact=False)
    assert ROW not in {row.name for row in matching.report.checks}


@pytest.mark.parametrize("seed", range(4))
def test_solutions_of_all_members_are_enclosed(seed: int) -> None:
    rng = np.random.default_rng([46, 7, seed])
    n = int(rng.integers(2, 6))
    matrix, right = rng.standard_normal((n, n)) + 3.0 * np.eye(n), rng.standard_normal((n, 1))
    away, beside = 1e-3 * rng.random((n, n)), 1e-3 * rng.random((n, 1))
    found = enclosed_solution(Ball(matrix, away), Ball(right, beside))
    for turn in range(40):
        of_matrix = rng.choice([-1.0, 1.0], (n, n)) * away * (turn % 3 != 1)
        of_right = rng.choice([-1.0, 1.0], (n, 1)) * beside * (turn % 3 != 2)
        solution = np.linalg.solve(matrix + of_matrix, right + of_right)
        assert np.all(np.abs(solution - found.midpoint) <= found.radius * (1.0 + 1e-9))


@pytest.mark.parametrize(
    ("slow", "settles"), [(0.9, True), (1.0 - 1e-5, True), (1.0 - 1e-8, False), (1.0 - 1e-14, False), (1.0, False)]
)
def test_whether_many_states_settle_is_told_without_digits_as_it_is_with_them(
    slow: float, settles: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(52)
    count = settled_faults.FEW_STATES_IN_BITS + 1
    turn = np.linalg.qr(rng.normal(size=(count, count)))[0]
    A = turn @ np.diag([slow, *rng.uniform(-0.9, 0.9, count - 1)]) @ turn.T
    plant = obsynth.DescriptorSystem(A=A, C=np.eye(count), Bf=rng.normal(size=(count, 1)), dt=1.0)
    asked: list[int] = []
    told = settled_faults._state_at
    monkeypatch.setattr(
        settled_faults, "_state_at", lambda plant, point, bits: (asked.append(bits), told(plant, point, bits))[1]
    )
    quick = settled_faults.has_steady_state(plant, None, settled_faults.SLOWEST_SETTLING)
    needs_digits = any(asked)
    assert settled_faults.LAST_BITS not in asked
    monkeypatch.setattr(settled_faults, "FEW_STATES_IN_BITS", count)
    assert quick == settled_faults.has_steady_state(plant, None, settled_faults.SLOWEST_SETTLING) == settles
    # Within rounding of an integrator doubles enclose no state.
    assert needs_digits == (1.0 - slow < 1e-12)
