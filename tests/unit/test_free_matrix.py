"""The paper's free matrix S for plants in bad units: T E + N C = I holds in each unit."""

import numpy as np
import pytest

from obsynth.methods.fault_estimation_filter.prepared_plant import restricted_equivalent_from


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
