"""Faults that change between samples, where the zero-order hold is not exact: what the filter then estimates.

The continuous plant is simulated exactly over the parts of an interval.  What must come out is known from the integral

    x((k + 1) h) = exp(a h) x(k h) + int_0^h exp(a (h - t)) b f(k h + t) dt,

written down by hand: the estimate is the constant fault with the same integral, the mean of f weighted by
exp(a (h - t)).  Starting at rest, no other error is in the way.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

from obsynth import DescriptorSystem, discretise, fault_estimation_filter

POLE = -2.0
STEPS, CHANGE = 12, 5


def first_order(step: float):
    """x' = POLE x + f, y = x, and its filter."""
    plant = DescriptorSystem(None, [[POLE]], C=[[1.0]], Bf=[[1.0]])
    return fault_estimation_filter(discretise(plant, step).plant).observer


def two_states(step: float):
    """Position and speed, both measured; the fault is a force."""
    plant = DescriptorSystem(None, TWO, C=[[1.0, 0.0], [0.0, 1.0]], Bf=[[0.0], [1.0]])
    return fault_estimation_filter(discretise(plant, step).plant).observer


TWO = np.array([[0.0, 1.0], [-3.0, -0.8]])


def estimates(observer, samples) -> np.ndarray:
    """Fault estimates by the sample of the fault: what is said at k + delay is about k."""
    found = observer.run(np.array(samples)).faults[:, 0]
    (delay,) = observer.fault_delays
    return found[delay:]


def with_step(a: np.ndarray, b: np.ndarray, step: float, late: float, size: float) -> np.ndarray:
    """Samples of x for a fault that jumps to ``size`` at the part ``late`` of interval CHANGE, piece by piece."""
    n = len(a)

    def held(duration: float, value: float, x: np.ndarray) -> np.ndarray:
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n] = a, b * value
        return expm(block * duration)[:n] @ np.append(x, 1.0)

    states = [np.zeros(n)]
    for k in range(STEPS):
        x = states[-1]
        if k == CHANGE:
            x = held((1.0 - late) * step, size, held(late * step, 0.0, x))
        else:
            x = held(step, size if k > CHANGE else 0.0, x)
        states.append(x)
    return np.array(states)


@pytest.mark.parametrize("late", [0.0, 0.1, 0.5, 0.9])
@pytest.mark.parametrize("step", [0.01, 0.1, 1.0])
def test_a_step_within_an_interval_is_weighted_there_and_exact_from_the_next_one_on(step: float, late: float) -> None:
    size = 3.0
    found = estimates(first_order(step), with_step(np.array([[POLE]]), np.ones(1), step, late, size))
    weight = np.expm1(POLE * step * (1.0 - late)) / np.expm1(POLE * step)
    np.testing.assert_allclose(found[:CHANGE], 0.0, atol=1e-12)
    assert found[CHANGE] == pytest.approx(weight * size, rel=1e-10)
    np.testing.assert_allclose(found[CHANGE + 1 :], size, rtol=1e-9)


def test_for_short_intervals_the_weight_is_the_share_of_the_interval() -> None:
    """The weight is 1 - late, less half of a h late (1 - late), and so on: its limit is reached in proportion to h."""
    late = 0.3
    misses = []
    for step in (0.02, 0.01, 0.005):
        found = estimates(first_order(step), with_step(np.array([[POLE]]), np.ones(1), step, late, 1.0))
        misses.append(found[CHANGE] - (1.0 - late))
    expected = -0.5 * POLE * np.array([0.02, 0.01, 0.005]) * late * (1.0 - late)
    np.testing.assert_allclose(np.abs(misses), np.abs(expected), rtol=0.02)


@pytest.mark.parametrize("step", [0.01, 0.1, 0.5])
def test_a_ramp_is_estimated_by_its_weighted_mean(step: float) -> None:
    """f = t: the mean over the interval is (k + 1/2) h; the weights move it by a h^2 / 12 at most, towards its end."""
    times = step * np.arange(STEPS + 1)
    # x' = a x + t from rest.
    samples = (np.expm1(POLE * times) - POLE * times) / POLE**2
    found = estimates(first_order(step), samples[:, None])
    start = times[:-1]
    total, moment = np.expm1(POLE * step) / POLE, (np.expm1(POLE * step) - POLE * step) / POLE**2
    np.testing.assert_allclose(found, start + moment / total, rtol=1e-9, atol=1e-11)
    mean = start + 0.5 * step
    assert np.all(found > mean)
    assert np.max(found - mean) <= abs(POLE) * step**2 / 12.0
    # Neither the value at the sample nor that at the next one: half an interval away from both.
    np.testing.assert_allclose(found - start, 0.5 * step, rtol=abs(POLE) * step / 6.0)


def test_a_sine_is_estimated_by_its_weighted_mean() -> None:
    step, frequency = 0.2, 3.0
    times = step * np.arange(STEPS + 1)
    samples = np.array([
        quad(lambda t, end=end: np.exp(POLE * (end - t)) * np.sin(frequency * t), 0.0, end, epsabs=1e-13)[0]
        for end in times
    ])  # fmt: skip
    weights = np.expm1(POLE * step) / POLE
    expected = [
        quad(lambda t, k=k: np.exp(POLE * (step - t)) * np.sin(frequency * (k * step + t)), 0.0, step)[0] / weights
        for k in range(STEPS)
    ]
    np.testing.assert_allclose(estimates(first_order(step), samples[:, None]), expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("late", [0.25, 0.75])
def test_of_two_states_the_wrong_part_of_a_step_decays(late: float) -> None:
    """A late step moves the two states in another proportion than a constant fault does.

    What of that the estimate cannot explain is an error of the state, and decays: for short intervals the
    estimate in the interval of the change is the share of the interval, and afterwards the fault itself.
    """
    step, size = 1e-3, 2.0
    found = estimates(two_states(step), with_step(TWO, np.array([0.0, 1.0]), step, late, size))
    np.testing.assert_allclose(found[:CHANGE], 0.0, atol=1e-10)
    assert found[CHANGE] == pytest.approx((1.0 - late) * size, abs=5.0 * step)
    np.testing.assert_allclose(found[CHANGE + 1 :], size, atol=5.0 * step)
