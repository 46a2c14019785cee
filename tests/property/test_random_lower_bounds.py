"""What is asked for just below the least gain is refused with a proof, whatever the units and however far the start."""

import numpy as np
import pytest

import obsynth
from obsynth.methods.fault_estimation_filter.gamma_lower_bound import proved_lower_bound
from obsynth.methods.fault_estimation_filter.inequality_search import search_least_gain
from obsynth.methods.fault_estimation_filter.prepared_plant import prepare
from obsynth.methods.fault_estimation_filter.synthesis import gain_problem


def random_plant(seed: int, units: float) -> obsynth.DescriptorSystem:
    """Return a plant of 4 to 9 states with E of rank nx - 2; every signal and equation in a unit of its own."""
    rng = np.random.default_rng([8, seed])
    nx, nf, nd = int(rng.integers(4, 10)), 2, 2
    ny = nf + 1 + int(rng.integers(0, 2))
    a = rng.normal(size=(nx, nx))
    a *= 1.1 / np.max(np.abs(np.linalg.eigvals(a)))
    hidden = rng.normal(size=(nx, 2))
    e = np.eye(nx) - hidden @ np.linalg.pinv(hidden)
    rows, states, outputs, faults, disturbances = (
        units ** rng.uniform(-1.0, 1.0, size) for size in (nx, nx, ny, nf, nd)
    )
    return obsynth.DescriptorSystem(
        E=rows[:, None] * e * states,
        A=rows[:, None] * a * states,
        C=outputs[:, None] * rng.normal(size=(ny, nx)) * states,
        Bf=rows[:, None] * rng.normal(size=(nx, nf)) * faults,
        Bd=rows[:, None] * rng.normal(size=(nx, nd)) * disturbances,
        dt=1.0,
    )


@pytest.mark.parametrize(("units", "gap"), [(1.0, 1e-4), (1e3, 1e-4), (1e6, 5e-3)])
def test_the_proved_lower_bound_is_close_to_the_least_gain_found(units, gap):
    weak = []
    for seed in range(8):
        problem, _ = gain_problem(prepare(random_plant(seed, units)), free_weight=False)
        least = search_least_gain(problem, solver="CLARABEL", polish=False)
        bound = proved_lower_bound(problem, solver="CLARABEL", best=least.injection)
        assert bound <= least.gain * (1.0 + 1e-9)
        if bound < (1.0 - gap) * least.gain:
            weak.append((seed, bound / least.gain))
    assert weak == []


def test_a_bound_is_not_improved_once_it_is_enough():
    problem, _ = gain_problem(prepare(random_plant(1, 1.0)), free_weight=False)
    least = search_least_gain(problem, solver="CLARABEL", polish=False)
    assert 0.5 * least.gain < proved_lower_bound(problem, solver="CLARABEL", enough=0.5 * least.gain) <= least.gain
