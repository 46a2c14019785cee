"""Optimal filters of random plants in other units and other coordinates have the same gain: each failed in some."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.methods.optimal_filter.late_outputs import with_late_outputs
from obsynth.methods.optimal_filter.method import OptimalFilterMethod
from obsynth.methods.optimal_filter.realisation import minimal, realisations
from obsynth.numerics.gramians import gramian_factor


def test_what_passes_at_once_is_rounding_beside_what_passes_in_the_end() -> None:
    """Beside rates of 1e-3 it was none: a plant in seconds was designed, and inconclusive in milliseconds."""
    rates = np.diag([-2.0, -1.0])
    for slower in (1.0, 1e3, 1e6):
        filter_ = rates / slower, np.array([[1.0], [0.5]]) / slower, np.ones((1, 2)), np.array([[1e-14]])
        *_, passed = minimal(filter_, discrete=False)
        assert passed == 0.0
        *_, passed = minimal((*filter_[:3], np.array([[1e-10]])), discrete=False)
        assert passed == 1e-10


def test_a_filter_is_tried_without_entries_that_are_rounding_of_many_products_too() -> None:
    """Mixed outputs left 2e-14 of a row of the filter, which no state of the plant explains."""
    rates, read = np.array([[-2.0, 5.0], [0.0, -40.0]]), np.array([[0.5, 2e-14], [0.9, -1e-14]])
    filter_ = rates, np.ones((2, 3)), read, np.zeros((2, 3))
    found = realisations(filter_, np.ones(3), discrete=False)
    assert [len(a) for a, *_ in found] == [2, 2]
    assert [np.linalg.matrix_rank(c, tol=1e-300) for _, _, c, _ in found] == [2, 1]


def test_outputs_a_sample_late_have_the_least_gain_of_a_sample_less_delay() -> None:
    """The filter reads what was a sample ago, by copies of which its own T was rounding."""
    plant = obsynth.DescriptorSystem(
        A=[[0.85]],
        C=[[-0.6], [-0.2], [0.6]],
        Bf=[[0.5]],
        Bw=[[0.2, 0, 0, 0]],
        Dw=np.hstack([np.zeros((3, 1)), 0.7 * np.eye(3)]),
        dt=1.0,
    )
    own = obsynth.optimal_filter(plant, delay=2)
    late = obsynth.optimal_filter(with_late_outputs(plant, 1), delay=3)
    assert late.report.passed
    assert late.gain == pytest.approx(own.gain, rel=1e-7)


def test_a_deviation_that_is_small_beside_what_the_noise_could_do_is_claimed_and_verified_alike() -> None:
    """One claimed as it was computed was then compared as a bound of rounding, and missed it in the last digit.

    With a tenth of that noise "white noise passes whatever the filter" was said, of rounding.
    """
    states = np.array([[-0.288, 0.191], [-0.224, -0.592], [0.265, -0.22]])
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 1.0, 0.0]),
        A=[[-0.785, 0.511, 0.774], [0.539, -0.374, -1.592], [0.326, 0.053, 1.628]],
        C=[[-1.489, -2.075, 0.785], [-1.337, 0.052, 1.869], [-1.399, 0.416, -2.45]],
        Bf=[[1.442], [0.019], [-2.082]],
        Df=[[0.352], [0.797], [0.508]],
        Bw=np.hstack([1e-4 * states, np.zeros((3, 3))]),
        Dw=1.8e-6 * np.eye(3, 5, k=2),
    )
    options = {"reference": {"bandwidth": 2.0}, "norm": "h2"}
    design = obsynth.optimal_filter(plant, **options)
    assert design.report.passed
    assert design.gain == pytest.approx(1.728e-6, rel=1e-3)
    less_noise = plant.replace(Bw=0.1 * plant.Bw, Dw=0.1 * plant.Dw)
    assert OptimalFilterMethod(**options).existence(less_noise)[-1].holds


@pytest.mark.long
def test_a_long_delay_keeps_no_state_that_hardly_counts() -> None:
    """With 47 states, of which 15 count, no gain near that of the filter was proved: the default was inconclusive."""
    rng = np.random.default_rng([98, 6, 2])
    a = rng.normal(size=(6, 6))
    a *= 0.95 / float(np.max(np.abs(np.linalg.eigvals(a))))
    rng.normal(size=(6, 1))
    c, faults, noise = rng.normal(size=(3, 6)), rng.normal(size=(6, 2)), rng.normal(size=(6, 1))
    plant = obsynth.DescriptorSystem(
        A=a,
        C=c,
        Bf=faults,
        Bw=np.hstack([noise, np.zeros((6, 3))]),
        Dw=np.hstack([np.zeros((3, 1)), 0.05 * np.eye(3)]),
        dt=1.0,
    )
    design = obsynth.optimal_filter(plant, delay=6)
    assert design.report.passed
    assert design.observer.order == 15
    assert design.gain * (1 - 2e-7) <= design.least <= design.gain


def test_the_factor_of_a_sum_over_all_samples_keeps_small_directions() -> None:
    a, b = np.diag([0.5, 0.9]), np.array([[1.0], [1e-12]])
    factor = gramian_factor(a, b)
    assert factor @ factor.T == pytest.approx(b @ b.T / (1.0 - np.outer([0.5, 0.9], [0.5, 0.9])), rel=1e-12)
    _, triangle = np.linalg.qr(factor.T)
    exact = 1e-12 * np.sqrt(1 / 0.19 - 0.75 / 0.55**2)
    assert abs(triangle[1, 1]) == pytest.approx(exact, rel=1e-10)
