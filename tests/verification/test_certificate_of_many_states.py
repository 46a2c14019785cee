"""The certificate of a filter of many states, from one solution of the transposed system."""

import numpy as np
import pytest

from obsynth.methods.fault_estimation_filter.certificate import ROOMS, _with_room
from obsynth.numerics.injection_problem import _natural_states
from obsynth.numerics.norms import hinf_norm
from obsynth.numerics.thin_doubling import FEWEST_STATES


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
    found = [q for q in (_with_room(a, b, c, d, 1.0 + more, noise) for more, noise in ROOMS) if q is not None]
    assert found
    q = found[0]
    assert np.all(np.tril(q, -1) == 0.0)
    change = np.linalg.inv(q)
    moved = np.block([[q @ a @ change, q @ b], [c @ change, d]])
    # In coordinates in which P is the identity the system shrinks everything, by the room at least.
    assert 1.0 - np.linalg.svd(moved)[1][0] ** 2 >= 0.5 * ROOMS[-1][0]


def test_a_level_below_the_norm_has_no_certificate():
    a, b, c, d = system(0)
    assert all(_with_room(a, 1.1 * b, c, 1.1 * d, 1.0 + more, noise) is None for more, noise in ROOMS)


def test_natural_states_of_many_are_those_in_which_the_system_shrinks():
    level = 1.3
    a, b, c, d = system(1, n=FEWEST_STATES, inputs=3)
    for scale in (1.0, 8.0):
        states = _natural_states(a, scale * b, c, scale * d, level * scale)
        inverse = np.linalg.inv(states)
        moved = np.block([[inverse @ a @ states, inverse @ b / level], [c @ states, d / level]])
        assert np.linalg.svd(moved)[1][0] < 1.0
