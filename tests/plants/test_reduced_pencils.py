"""The observable part of a pencil by reflections, and leaks of several groups of inputs at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.analysis.diagnosis.without_unknown_inputs import finite_values, left_part
from obsynth.analysis.existence.named_pencils import named_pencil
from obsynth.methods.ui_pi_observer.decoupling import decoupling_norm, decoupling_norms
from obsynth.plants.plant_units import PlantUnits
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"


@pytest.mark.parametrize("seed", range(5))
def test_hidden_states_are_taken_out_and_the_rest_is_kept(seed: int) -> None:
    """Two states that no output sees, in orthogonal coordinates: their eigenvalues are the zeros."""
    rng = np.random.default_rng(seed)
    seen, hidden, outputs = 9, 2, 2
    n = seen + hidden
    a = rng.normal(size=(n, n))
    a[:seen, seen:] = 0.0
    c = np.hstack([rng.normal(size=(outputs, seen)), np.zeros((outputs, hidden))])
    expected = np.sort_complex(np.linalg.eigvals(a[seen:, seen:]))
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    pencil_a = np.vstack([turn.T @ a @ turn, c @ turn])
    pencil_e = np.vstack([np.eye(n), np.zeros((outputs, n))])
    found = left_part(pencil_e, pencil_a)
    assert found.order == seen
    np.testing.assert_allclose(np.sort_complex(finite_values(found)), expected, rtol=1e-10)
    for own, whole in ((np.vstack([found.A, found.C]), pencil_a), (np.vstack([found.E, 0 * found.C]), pencil_e)):
        np.testing.assert_allclose(found.left_factor @ whole, own @ found.right_factor, rtol=0, atol=1e-12)


def test_a_group_of_inputs_leaks_as_much_as_by_itself() -> None:
    plant = load_spec(DESIGNS / "motor" / "spec.yaml").plant
    design = obsynth.functional_filter(plant)
    observer = design.linear[1]
    every = plant.replace(
        Bd=np.hstack([plant.Bd, plant.Bf]),
        Dd=np.hstack([plant.Dd, plant.Df]),
        disturbance_names=[*plant.disturbance_names, *(f"fault {name}" for name in plant.fault_names)],
    )
    rows = range(len(observer.Cz))
    of_disturbances, of_all = decoupling_norms(every, observer, [(rows, range(plant.nd)), (rows, range(every.nd))])
    # What must not reach the estimates does not, and the fault itself does, alone as in company.
    assert max(of_disturbances.relative, decoupling_norm(plant, observer).relative) < 1e-9
    assert of_all.relative == pytest.approx(decoupling_norm(every, observer).relative, rel=1e-6)
    assert of_all.relative > 1e-3


def test_points_one_by_one_leak_as_much_as_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """And a pole of the observer at one of them, the frequency zero, leaves the others alone."""
    plant = load_spec(DESIGNS / "motor" / "spec.yaml").plant
    observer = obsynth.functional_filter(plant).linear[1]
    faulty = plant.replace(Bd=plant.Bf, Dd=plant.Df, disturbance_names=["fault"], Bf=None, Df=None, fault_names=None)
    singular = replace(observer, Az=np.diag([0.0, *np.diag(observer.Az)[1:]]))
    together = [decoupling_norm(faulty, one) for one in (observer, singular)]
    monkeypatch.setattr("obsynth.methods.ui_pi_observer.decoupling.ENTRIES_AT_ONCE", 1)
    one_by_one = [decoupling_norm(faulty, one) for one in (observer, singular)]
    assert together[0].relative > 1e-3
    assert np.isinf(together[1].relative)
    assert together[1].frequency == 0.0
    # Products of stacks may be added up in another order: some units in the last place.
    for one, other in zip(together, one_by_one, strict=True):
        assert one.relative == pytest.approx(other.relative, rel=1e-9)


def test_a_witness_is_exact() -> None:
    """The changed plant hides the fault at the point, in fractions: the last column is a combination of the others."""
    plant = obsynth.DescriptorSystem(
        None, [[-1.0, 0.3], [0.7, -2.0]], C=[[1.0, 0.1], [0.25, 1.0]], Bf=[[0.4], [1e-3]], Bd=[[0.0], [1.0]]
    )
    named = named_pencil(plant, PlantUnits.of(plant).rounded(), [["A", "Bd", "Bf"], ["C", "Dd", "Df"]])
    witness = named.witness(1.0, 0j, last=True)
    assert witness is not None
    changed = witness.plant(plant)
    matrix = np.block([[changed.A, changed.Bd, changed.Bf], [changed.C, changed.Dd, changed.Df]])
    values = np.linalg.svd(matrix, compute_uv=False)
    assert values[-1] < 1e-12 * values[0]
