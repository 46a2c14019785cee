"""A limit on the residual weight holds to the last digit, whatever a solver's rounding does."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.errors import InfeasibleError
from obsynth.numerics.injection_problem import WeightLimit

#: A rod of 24 cells, heated in two, with one sensor on each and one between.
SIZE = 24
ROD = obsynth.DescriptorSystem(
    None, 0.6 * np.eye(SIZE) + 0.19 * (np.eye(SIZE, k=1) + np.eye(SIZE, k=-1)), C=np.eye(SIZE)[[4, 12, 20]],
    Bf=np.eye(SIZE)[:, [4, 20]], Bd=np.eye(SIZE)[:, [14]], Dw=0.01 * np.eye(3), Bw=np.zeros((SIZE, 3)), dt=1.0,
)  # fmt: skip


@pytest.mark.parametrize("excess", [1e-15, 1e-11, 1e-6, 3.0])
def test_what_rounding_let_out_is_drawn_back(excess: float) -> None:
    rng = np.random.default_rng(5)
    fixed, free, v = rng.standard_normal((2, 4)), rng.standard_normal((2, 4)), rng.standard_normal((2, 2))
    v *= 5.0
    bound = float(np.linalg.norm(fixed + v @ free, 2)) / (1.0 + excess)
    kept = WeightLimit(fixed, free, bound).within_bound(v)
    assert np.linalg.norm(fixed + kept @ free, 2) <= bound
    if excess < 1.0:
        np.testing.assert_allclose(kept, v, rtol=10.0 * excess + 1e-11)


def test_what_is_within_stays_as_it_is() -> None:
    fixed, v = np.eye(2, 3), np.full((2, 1), 0.1)
    limit = WeightLimit(fixed, np.array([[0.0, 0.0, 1.0]]), 2.0)
    assert limit.within_bound(v) is v


@pytest.mark.long
def test_a_limit_that_costs_nothing_calls_no_solver() -> None:
    free = obsynth.fault_estimation_filter(ROD)
    size = float(np.linalg.norm(free.gains["W"], 2))
    design = obsynth.fault_estimation_filter(ROD, residual_weight_limit=10.0 * size)
    assert design.solver["engine"] == "riccati"
    assert design.certificate.claims["gamma"] == free.certificate.claims["gamma"]
    np.testing.assert_array_equal(design.gains["W"], free.gains["W"])
    with pytest.raises(InfeasibleError, match="Raise residual_weight_limit"):
        obsynth.fault_estimation_filter(ROD, residual_weight_limit=0.1 * size)


def test_a_limit_below_what_the_equations_find_is_kept_all_the_same() -> None:
    plant = obsynth.DescriptorSystem(
        None, [[0.5, 0.2, 0.0], [0.0, 0.6, 0.3], [0.1, 0.0, 0.4]], C=np.eye(3), Bf=[[1], [0.5], [0]],
        Bd=[[0.3], [1], [0.2]], dt=1.0,
    )  # fmt: skip
    free = obsynth.fault_estimation_filter(plant, weight="free")
    upsilon, found = free.gains["Upsilon"], float(np.linalg.norm(free.gains["W"], 2))
    least = 1.0 / float(np.linalg.svd(upsilon, compute_uv=False)[-1])
    limit = 0.5 * (least + found)
    design = obsynth.fault_estimation_filter(plant, residual_weight_limit=limit)
    assert least < limit < found
    assert np.linalg.norm(design.gains["W"], 2) <= limit
    assert design.report.passed
    assert design.certificate.claims["gamma"] > free.certificate.claims["gamma"]


def plant(seed: int) -> obsynth.DescriptorSystem:
    """Return a plant of six states whose outputs have units far apart."""
    rng = np.random.default_rng([102, seed])
    a = rng.normal(size=(6, 6))
    a *= 1.1 / np.max(np.abs(np.linalg.eigvals(a)))
    c = rng.normal(size=(4, 6)) * 10.0 ** rng.uniform(-2.0, 2.0, size=(4, 1))
    return obsynth.DescriptorSystem(
        None, a, None, c, Bf=rng.normal(size=(6, 2)), Bd=0.3 * rng.normal(size=(6, 2)), dt=0.1
    )


@pytest.mark.long
def test_a_limit_just_above_the_least_weight_is_kept(share: Callable[..., Any]) -> None:
    for seed in share(range(4), 2):
        assert_kept_above_the_least_weight(seed)


def assert_kept_above_the_least_weight(seed: int) -> None:
    faulty = plant(seed)
    upsilon = obsynth.fault_estimation_filter(faulty).gains["Upsilon"]
    least = 1.0 / np.linalg.svd(upsilon, compute_uv=False)[-1]
    design = obsynth.fault_estimation_filter(faulty, residual_weight_limit=1.001 * least)
    assert design.report.passed
    assert np.linalg.norm(design.gains["W"], 2) <= 1.001 * least
    with pytest.raises(obsynth.InfeasibleError, match="the least is"):
        obsynth.fault_estimation_filter(faulty, residual_weight_limit=0.999 * least)
