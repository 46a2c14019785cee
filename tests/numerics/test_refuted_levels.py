"""A level is refuted only where it does not hold, also where rounding in the doubling outgrows every margin."""

import numpy as np
import pytest

from obsynth.numerics.gain_levels import compared_gain
from obsynth.numerics.norms import balanced_realisation, hinf_norm


@pytest.mark.long
def test_no_level_that_holds_is_refuted():
    far = 0
    for seed in range(120):
        rng = np.random.default_rng([32, seed])
        n = int(rng.integers(3, 25))
        steep = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-1.5, 1.5) * (rng.random((n, n)) < rng.uniform(0.1, 1.0))
        q = np.linalg.qr(rng.normal(size=(n, n)))[0]
        a = q @ (np.triu(steep, 1) + np.diag(rng.uniform(-0.95, 0.95, n))) @ q.T
        b, c, d = rng.normal(size=(n, 2)), rng.normal(size=(2, n)), np.zeros((2, 2))
        if np.max(np.abs(np.linalg.eigvals(a))) >= 1.0:
            continue
        norm = hinf_norm(a, b, c, d).upper
        balanced = balanced_realisation(a, b, c)
        far += np.linalg.norm(balanced[0], 2) > 10.0
        for factor in (1.05, 2.0):
            assert compared_gain(*balanced, d, factor * norm) is not False, (seed, factor)
    assert far >= 20
