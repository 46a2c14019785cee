"""Faults in any units: the residual weight takes their inverse units, and loses no digits to faults in larger ones."""

import numpy as np
import pytest

import obsynth
from obsynth.analysis.existence.restricted_equivalent import prepare
from obsynth.methods.fault_estimation_filter.convex_problem import gain_problem


def random_plant(seed: int, units: list[float]) -> obsynth.DescriptorSystem:
    """Return a plant with E = I, as many outputs as faults and one more, and the faults in the given units."""
    rng = np.random.default_rng([14, seed])
    nf = len(units)
    nx, ny = nf + 3, nf + 1
    a = rng.normal(size=(nx, nx))
    a *= 0.9 / np.max(np.abs(np.linalg.eigvals(a)))
    c, bf, bd = rng.normal(size=(ny, nx)), rng.normal(size=(nx, nf)), rng.normal(size=(nx, 1))
    return obsynth.DescriptorSystem(E=None, A=a, C=c, Bf=bf * units, Bd=bd, dt=1.0)


@pytest.mark.parametrize("seed", range(5))
def test_the_weight_inverts_upsilon_in_the_units_of_each_fault(seed):
    units = [1.0, 2.0**40, 2.0**-40, 2.0**60]
    prepared = prepare(random_plant(seed, units))
    _, parts = gain_problem(prepared, free_weight=False)
    upsilon, weight = prepared.detectability.Upsilon, parts.W0
    lengths = np.linalg.norm(upsilon, axis=0)
    assert np.max(lengths) / np.min(lengths) > 1e25
    product = (lengths[:, None] * weight) @ (upsilon / lengths)
    assert np.max(np.abs(product - np.eye(len(units)))) < 1e-12


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(3))
def test_a_design_does_not_depend_on_the_units_of_the_faults_more_than_it_must(seed):
    alike = obsynth.fault_estimation_filter(random_plant(seed, [1.0, 1.0, 1.0]), weight="paper")
    apart = obsynth.fault_estimation_filter(random_plant(seed, [1.0, 2.0**30, 2.0**-30]), weight="paper")
    assert apart.report.passed
    # W is fixed here: its rows are in the units of the faults, exactly.
    assert apart.gains["W"] * np.array([[1.0], [2.0**30], [2.0**-30]]) == pytest.approx(alike.gains["W"], rel=1e-9)


@pytest.mark.one_in(3)
@pytest.mark.parametrize("seed", range(3))
def test_one_unit_for_all_faults_changes_no_free_weight(seed):
    """Units that differ between faults weigh them against each other in gamma: the best W is another one then."""
    alike = obsynth.fault_estimation_filter(random_plant(seed, [1.0] * 3))
    other = obsynth.fault_estimation_filter(random_plant(seed, [2.0**20] * 3))
    assert other.options["weight"] == alike.options["weight"]
    assert 2.0**20 * other.gains["W"] == pytest.approx(alike.gains["W"], rel=1e-8)
