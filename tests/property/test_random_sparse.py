"""Sparse plants with round numbers, as people type them: modes at -1, 0 and 1, faults that hit one row.

What holds by cancellation on random plants holds exactly here, and ranks fall by whole numbers.
"""

import numpy as np
import pytest

import obsynth
from obsynth.methods.designing import check
from obsynth.methods.registry import method_class


def sparse_plant(seed: int) -> obsynth.DescriptorSystem:
    """Return a plant."""
    rng = np.random.default_rng([47, seed])
    nx, nf = int(rng.integers(3, 8)), int(rng.integers(1, 3))
    algebraic = int(rng.integers(0, 2))
    ny = min(nf + int(rng.integers(0, 3)), nx)
    a = np.where(rng.random((nx, nx)) < 0.35, rng.integers(-9, 10, (nx, nx)) / 10.0, 0.0)
    a /= max(1.0, 1.2 * float(np.max(np.abs(np.linalg.eigvals(a)))))
    e = np.eye(nx)
    pick = rng.permutation(nx)[:ny]
    if algebraic:
        # The last equation is 0 = -x + ..., and its state is measured: rank [E; C] = nx.
        e[-1], a[-1, -1], pick[-1] = 0.0, -1.0, nx - 1
    c = np.eye(nx)[np.unique(pick)]
    bf, df = np.zeros((nx, nf)), np.zeros((len(c), nf))
    for j in range(nf):
        bf[rng.integers(nx), j] = 1.0
    if rng.random() < 0.3:
        bf[:, 0], df[rng.integers(len(c)), 0] = 0.0, 1.0
    bd = np.where(rng.random((nx, 1)) < 0.5, 0.3, 0.0)
    dd = np.where(rng.random((len(c), 1)) < 0.3, 0.3, 0.0)
    if rng.random() < 0.4 or not bd.any():
        return obsynth.DescriptorSystem(e, a, None, c, Bf=bf, Df=df, dt=0.1)
    return obsynth.DescriptorSystem(e, a, None, c, Bf=bf, Df=df, Bd=bd, Dd=dd, dt=0.1)


def may_exist(plant):
    """Whether the conditions of the fault-estimation filter alone hold."""
    return all(condition.holds for condition in method_class("fault-estimation-filter")().existence(plant))


@pytest.mark.long
def test_every_sparse_plant_is_solved_or_refused_with_its_condition(share):
    solved, refused, failures = 0, 0, []
    seeds = share(range(120), 5)
    for seed in seeds:
        plant = sparse_plant(seed)
        exists = may_exist(plant)
        if seed % 4 == 0:
            assert check(plant)["fault-estimation-filter"].passed is exists
        if not exists:
            refused += 1
            continue
        try:
            design = obsynth.fault_estimation_filter(plant)
        except obsynth.ObsynthError as error:
            failures.append((seed, str(error)))
            continue
        assert design.report.passed
        solved += 1
    assert failures == []
    assert solved >= 0.5 * len(seeds), (solved, refused)


@pytest.mark.long
def test_plants_of_algebraic_equations_alone():
    solved = 0
    for seed in range(100):
        rng = np.random.default_rng([53, seed])
        nx = int(rng.integers(1, 4))
        ny = int(rng.integers(1, nx + 2))
        a, c = rng.integers(-3, 4, (nx, nx)) / 2.0, rng.integers(-1, 2, (ny, nx)).astype(float)
        df = rng.integers(-2, 3, (ny, 1)).astype(float)
        plant = obsynth.DescriptorSystem(np.zeros((nx, nx)), a, None, c, Df=df, dt=0.1)
        exists = may_exist(plant)
        if seed % 4 == 0:
            assert check(plant)["fault-estimation-filter"].passed is exists
        if exists:
            assert obsynth.fault_estimation_filter(plant).report.passed, seed
            solved += 1
    assert solved >= 20, solved
