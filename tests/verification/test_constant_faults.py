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
from obsynth.verification.constant_faults import ConstantFaults, constant_fault_row

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
