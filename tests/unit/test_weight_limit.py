"""A limit on the residual weight holds to the last digit, whatever a solver's rounding does."""

import numpy as np
import pytest

from obsynth.synthesis.gain_problem import WeightLimit


@pytest.mark.parametrize("excess", [1e-15, 1e-11, 1e-6, 3.0])
def test_what_rounding_let_out_is_drawn_back(excess: float) -> None:
    rng = np.random.default_rng(5)
    fixed, free, v = rng.standard_normal((2, 4)), rng.standard_normal((2, 4)), rng.standard_normal((2, 2))
    v *= 5.0
    bound = float(np.linalg.norm(fixed + v @ free, 2)) / (1.0 + excess)
    kept = WeightLimit(fixed, free, bound).kept(v)
    assert np.linalg.norm(fixed + kept @ free, 2) <= bound
    if excess < 1.0:
        np.testing.assert_allclose(kept, v, rtol=10.0 * excess + 1e-11)


def test_what_is_within_stays_as_it_is() -> None:
    fixed, v = np.eye(2, 3), np.full((2, 1), 0.1)
    limit = WeightLimit(fixed, np.array([[0.0, 0.0, 1.0]]), 2.0)
    assert limit.kept(v) is v
