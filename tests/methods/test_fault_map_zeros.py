"""Exact fault maps at zeros of the faults that are not strictly stable, however far out and of however many lags."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import obsynth
from obsynth.methods.optimal_filter import fault_maps
from obsynth.methods.optimal_filter.reference import lag_model
from obsynth.verification.fault_map_zeros import VANISHING_SHARE, missed_zeros

FAR_OUT = obsynth.DescriptorSystem(
    A=[[-0.25, 0], [-0.5, -0.5]],
    C=[[-2.0, 0]],
    Bf=[[-4.0], [-1.0]],
    Df=[[-0.5]],
    Bw=[[2.0, 0], [3.0, 0]],
    Dw=[[0, 0.1]],
)
ZERO = 15.75


def plant_with_zero(rng, zero, *, dt=0.0, states=2, faults=1, turn=True):
    """Return a stable plant with one output for each fault and the zero in the first fault's column, turned or not."""
    count = states + faults
    A = np.triu(rng.uniform(-0.3, 0.3, (count, count)), 1) + np.diag(rng.uniform(0.2, 0.8, count) - (dt == 0.0))
    C, Bf, Df = rng.normal(size=(faults, count)), rng.normal(size=(count, faults)), 2.0 * np.eye(faults)
    # The first column of the transfer matrix vanishes at the zero: no faults but the first are in its direction.
    Df[:, 0] = -(C @ np.linalg.solve(zero * np.eye(count) - A, Bf))[:, 0]
    T = rng.normal(size=(count, count)) if turn else np.eye(count)
    Bw, Dw = (
        np.hstack([np.eye(count), np.zeros((count, faults))]),
        np.hstack([np.zeros((faults, count)), np.eye(faults)]),
    )
    inverse = np.linalg.inv(T)
    return obsynth.DescriptorSystem(A=T @ A @ inverse, C=C @ inverse, Bf=T @ Bf, Df=Df, Bw=T @ Bw, Dw=Dw, dt=dt)


def with_zero(zero, width, order):
    """Return ``(1 - s / zero) (w / (s + w))^order`` in coordinates that hide it."""
    a, b, c, d = lag_model(width, order, 1, 0.0)
    # s c (s I - a)^-1 b = c b + c a (s I - a)^-1 b.
    c, d = c - c @ a / zero, d - c @ b / zero
    turn = scipy.linalg.qr(np.random.default_rng(order).normal(size=a.shape))[0]
    return turn @ a @ turn.T, turn @ b, c @ turn.T, d


@pytest.mark.parametrize("seed", range(6))
def test_lags_of_every_order_are_refused_however_far_out_the_zero_is(seed) -> None:
    rng = np.random.default_rng(seed)
    for zero in (1.0, 4.7, 22.0, 105.0, 1000.0):
        plant = plant_with_zero(rng, zero, faults=1 + seed % 2, turn=seed > 2)
        for order in range(1, 9):
            model = lag_model(0.3, order, plant.nf, 0.0)
            missed = missed_zeros(plant, reference=model, delays=None)
            assert min(abs(other.value - zero) for other in missed) < 1e-6 * zero
            assert min(other.share for other in missed) > 0.01 > VANISHING_SHARE


@pytest.mark.one_in(4)
@pytest.mark.parametrize("zero", [1.0, 15.0, 120.0, 1000.0])
def test_existence_and_design_agree(zero) -> None:
    plant = plant_with_zero(np.random.default_rng(7), zero)
    report = obsynth.check(plant)["optimal-filter"]
    assert not report.passed
    assert "zero that is not strictly stable, at" in " ".join(check.detail for check in report.checks)
    for order in (1, 4, 8):
        with pytest.raises(obsynth.PreconditionError, match=r"zero that is not strictly stable, at .* exact to False"):
            obsynth.optimal_filter(plant, reference={"bandwidth": 0.3, "order": order})
    with pytest.raises(obsynth.PreconditionError, match="zero that is not strictly stable, at"):
        obsynth.optimal_filter(plant)


@pytest.mark.one_in(5)
@pytest.mark.parametrize("zero", [1.05, -1.3, 3.0, 12.0, 50.0])
def test_delays_are_refused_in_discrete_time(zero) -> None:
    plant = plant_with_zero(np.random.default_rng(3), zero, dt=1.0)
    for options in ({}, {"delay": 0}, {"delay": 8}):
        with pytest.raises(obsynth.PreconditionError, match=r"zero that is not strictly stable, at .* whatever delay"):
            obsynth.optimal_filter(plant, **options)


def test_a_filter_that_was_designed_without_looking_at_the_zero_fails_its_row(monkeypatch) -> None:
    """Its transfer functions differ from those of four lags by 4e-7 only."""
    monkeypatch.setattr(fault_maps, "require_vanishing", lambda *_, **__: None)
    with pytest.raises(obsynth.VerificationError, match="zeros of the faults") as refused:
        obsynth.optimal_filter(FAR_OUT, reference={"bandwidth": 0.36667, "order": 4})
    failing = [check for check in refused.value.report.checks if not check.passed]
    assert [check.name for check in failing] == ["zeros of the faults"]
    assert failing[0].detail == "15.75"


@pytest.mark.one_in(3)
@pytest.mark.parametrize("order", [1, 2, 4])
def test_a_reference_model_that_has_the_zero_is_designed(order) -> None:
    design = obsynth.optimal_filter(FAR_OUT, reference=with_zero(ZERO, 0.5, order))
    assert design.report.passed
    assert any(check.name == "zeros of the faults" for check in design.report.checks)
    # A zero that is written with seven digits is that zero; one of three is not.
    assert obsynth.optimal_filter(FAR_OUT, reference=with_zero(ZERO * (1 + 1e-8), 0.5, order)).report.passed
    with pytest.raises(obsynth.PreconditionError, match=r"15\.75"):
        obsynth.optimal_filter(FAR_OUT, reference=with_zero(ZERO * 1.001, 0.5, order))


def test_only_the_fault_in_the_zeros_direction_must_vanish() -> None:
    plant = plant_with_zero(np.random.default_rng(5), 9.0, faults=2)
    a, b, c, d = with_zero(9.0, 0.5, 2)
    lag = lag_model(0.5, 2, 1, 0.0)
    model = tuple(scipy.linalg.block_diag(*pair) for pair in zip((a, b, c, d), lag, strict=True))
    assert obsynth.optimal_filter(plant, reference=model).report.passed
    swapped = tuple(scipy.linalg.block_diag(*pair) for pair in zip(lag, (a, b, c, d), strict=True))
    with pytest.raises(obsynth.PreconditionError, match="strictly stable, at 9,"):
        obsynth.optimal_filter(plant, reference=swapped)


def test_matching_stable_zeros_and_a_second_output_are_not_refused() -> None:
    assert obsynth.optimal_filter(FAR_OUT, reference={"bandwidth": 0.4, "order": 4}, exact=False).report.passed
    stable = FAR_OUT.replace(Df=[[0.5]])
    second = obsynth.DescriptorSystem(
        A=FAR_OUT.A,
        C=[[-2.0, 0], [0, 1.0]],
        Bf=FAR_OUT.Bf,
        Df=[[-0.5], [0.3]],
        Bw=np.hstack([FAR_OUT.Bw, np.zeros((2, 1))]),
        Dw=[[0, 0.1, 0], [0, 0, 0.1]],
    )
    for plant in (stable, second):
        assert missed_zeros(plant, reference=lag_model(0.4, 1, 1, 0.0), delays=None) == ()
        assert obsynth.optimal_filter(plant).report.passed


@pytest.mark.parametrize("zeros", [(2.0, 2.0), (0.0, 0.0), (3.0, 3.0, 3.0), (1 + 2j, 1 - 2j)])
def test_zeros_of_some_multiplicity_on_the_boundary_and_pairs_are_recognised(zeros) -> None:
    count = len(zeros)
    numerator, denominator = np.poly(zeros).real, np.poly(-1.0 - np.arange(count))
    A, B, C, D = scipy.signal.tf2ss(numerator, denominator)
    plant = obsynth.DescriptorSystem(A=A, C=C, Bf=B, Df=D, Bw=np.zeros((count, 1)), Dw=[[1.0]])
    good = scipy.signal.tf2ss(numerator, np.poly([-2.0] * (count + 1)))
    assert all(zero.share <= VANISHING_SHARE for zero in missed_zeros(plant, reference=good, delays=None))
    missed = missed_zeros(plant, reference=lag_model(0.4, 3, 1, 0.0), delays=None)
    assert len(missed) >= 1
    assert all(zero.share > VANISHING_SHARE for zero in missed)
