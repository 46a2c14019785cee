"""The paper's free matrix S for plants in bad units: T E + N C = I holds in each unit."""

import numpy as np
import pytest

from obsynth import DescriptorSystem
from obsynth.analysis.existence import restricted_equivalent as conditions
from obsynth.analysis.existence.restricted_equivalent import restricted_equivalent_from
from obsynth.numerics.scaling import Scaling


@pytest.mark.parametrize("seed", range(6))
def test_states_in_small_units_are_not_taken_for_zero(seed):
    rng = np.random.default_rng([17, seed])
    nx, ny = 6, 3
    hidden = rng.normal(size=(nx, 2))
    e, c = np.eye(nx) - hidden @ np.linalg.pinv(hidden), rng.normal(size=(ny, nx))
    units = 10.0 ** rng.uniform(-12.0, 12.0, nx)
    s = rng.normal(size=(nx, nx + ny)) / units[:, None]
    t, n = restricted_equivalent_from(e * units, c * units, s)
    whole = t @ (e * units) + n @ (c * units)
    assert whole * units[:, None] / units == pytest.approx(np.eye(nx), abs=1e-9)


def test_units_that_were_tried_are_not_tried_again(monkeypatch):
    plant = DescriptorSystem(np.diag([1.0, 1.0, 0.0]), 0.5 * np.eye(3), None, np.eye(3), Bf=np.ones((3, 1)), dt=0.1)
    one, other = Scaling(*np.ones((3, 3))), Scaling(np.ones(3), np.array([1.0, 1e9, 1.0]), np.ones(3))
    same = Scaling(*np.ones((3, 3)))
    monkeypatch.setattr(conditions, "_units", lambda _: iter([one, other, same]))
    monkeypatch.setattr(conditions, "MOST_CONDITION", 0.5)
    plain, formed = conditions.restricted_equivalent, []
    monkeypatch.setattr(conditions, "restricted_equivalent", lambda *given: formed.append(1) or plain(*given))
    scaling, t, n = conditions._equivalent(plant)
    # Neither those that T cannot make up for, nor the same again.
    assert (scaling, len(formed)) == (one, 1)
    assert np.allclose(t @ plant.E + n @ plant.C, np.eye(3), rtol=0.0, atol=1e-14)
