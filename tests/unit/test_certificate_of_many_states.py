"""The certificate of a filter of many states, from one solution of the transposed system."""

import numpy as np
import pytest

from obsynth.methods.fault_estimation_filter.certificate import ROOMS, _with_room
from obsynth.numerics.norms import hinf_norm


def system(seed, n=40, inputs=7):
    """A stable system with states in very different units, scaled to a norm just below one."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    a *= 0.97 / np.max(np.abs(np.linalg.eigvals(a)))
    b, c, d = rng.normal(size=(n, inputs)), rng.normal(size=(2, n)), rng.normal(size=(2, inputs))
    size = hinf_norm(a, b, c, d).upper * 1.005
    units = np.ldexp(1.0, rng.integers(-12, 12, size=n))
    return a * units / units[:, None], b / units[:, None] / size, c * units, d / size


@pytest.mark.parametrize("seed", range(3))
def test_one_solution_of_the_transposed_system_meets_the_inequality(seed):
    a, b, c, d = system(seed)
    found = [q for q in (_with_room(a, b, c, d, room) for room in ROOMS) if q is not None]
    assert found
    q = found[0]
    assert np.all(np.tril(q, -1) == 0.0)
    change = np.linalg.inv(q)
    moved = np.block([[q @ a @ change, q @ b], [c @ change, d]])
    # In coordinates in which P is the identity the system shrinks everything, by the room at least.
    assert 1.0 - np.linalg.svd(moved)[1][0] ** 2 >= 0.5 * ROOMS[-1]


def test_a_level_below_the_norm_has_no_certificate():
    a, b, c, d = system(0)
    assert all(_with_room(a, 1.1 * b, c, 1.1 * d, room) is None for room in ROOMS)
