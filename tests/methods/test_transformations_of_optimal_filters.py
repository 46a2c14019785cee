"""T of filters of many states, by Sylvester's equation: a small row keeps its entries, wrong filters are refused."""

import numpy as np

import obsynth
from obsynth.methods.optimal_filter.transformation import FilterAndPlant, by_sylvester


def followed_plant(*, small: float) -> tuple[FilterAndPlant, np.ndarray]:
    """Return a filter that follows a plant by a known T, whose last row is small, with Bd in the kernel of T."""
    rng = np.random.default_rng(71)
    n, m = 20, 12
    A, C = 0.1 * rng.normal(size=(n, n)), np.eye(n)
    T = rng.normal(size=(m, n))
    T[-1] *= small
    a, c = np.diag(np.linspace(0.5, 0.9, m)), rng.normal(size=(2, m))
    bd = np.linalg.svd(T)[2][-1:].T
    b, d = T @ A - a @ T, -c @ T
    none = np.zeros((0, n))
    return FilterAndPlant(a, b, c, d, np.eye(n), A, C, bd, np.zeros((n, 1)), none), T


def test_a_small_row_of_t_keeps_its_entries():
    # Beside the largest entry of all rows, 1e-14 of it is less than what counts as rounding.
    of, wanted = followed_plant(small=1e-14)
    found, _ = by_sylvester(of, np.ones(20))
    t = found.T
    assert found.S.shape == (2, 0)
    assert found.share == 1e-9
    assert np.max(np.abs(t[-1] - wanted[-1])) <= 1e-9 * np.max(np.abs(wanted[-1]))


def test_rows_that_the_filter_does_not_follow_are_refused():
    of, _ = followed_plant(small=1.0)
    assert by_sylvester(of._replace(d=of.d + 1e-3), np.ones(20)) == (None, True)


def test_a_disturbance_that_reaches_the_filter_is_refused():
    of, _ = followed_plant(small=1.0)
    assert by_sylvester(of._replace(Bd=of.Bd + 1e-3), np.ones(20)) == (None, True)


def test_a_filter_of_forty_states_follows_its_plant():
    rng = np.random.default_rng(72)
    n = 40
    a = rng.normal(size=(n, n))
    plant = obsynth.DescriptorSystem(
        A=0.9 * a / np.max(np.abs(np.linalg.eigvals(a))),
        B=rng.normal(size=(n, 1)),
        C=rng.normal(size=(3, n)),
        Bf=rng.normal(size=(n, 1)),
        Bw=np.hstack([0.05 * rng.normal(size=(n, 2)), np.zeros((n, 3))]),
        Dw=np.hstack([np.zeros((3, 2)), 0.05 * np.eye(3)]),
        dt=1.0,
    )
    design = obsynth.optimal_filter(plant, reference={"bandwidth": 0.7}, exact=False, norm="h2")
    t, observer = design.gains["T"], design.linear[1]
    # z follows T x: A z + B y = T A x, and B u enters as it does the plant.
    assert np.max(np.abs(observer.Az @ t + observer.By @ plant.C - t @ plant.A)) <= 1e-9 * np.max(np.abs(t))
    assert np.max(np.abs(observer.Bu - t @ plant.B)) <= 1e-12 * np.max(np.abs(t @ plant.B))
