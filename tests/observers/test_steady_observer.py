"""The steady state of recursive observers: in any units, of slow plants in few steps, and where the recursion ends."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.recursive.gain_schedule import gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.steady_observer import SteadyObserver, steady_observer

#: Steps after which the recursion itself, one step after the other, has settled on the plants below.
MANY = 6_000


def recursive(plant: obsynth.DescriptorSystem, q: FloatArray, r: FloatArray) -> RecursiveObserver:
    if not plant.nf:
        return obsynth.descriptor_kalman(plant, Q=np.diag(q), R=np.diag(r)).recursive[1]
    # By default how far parameters are trusted follows the units of the plant, in powers of two.
    return obsynth.adaptive_observer(
        plant, Q=np.diag(q), R=np.diag(r), initial_parameter_covariance=np.eye(plant.nf)
    ).recursive[1]


def steady(plant: obsynth.DescriptorSystem, q: FloatArray, r: FloatArray) -> SteadyObserver:
    return steady_observer(recursive(plant, q, r))


def random_plant(
    seed: int, units: FloatArray, nf: int, *, noise_free: bool
) -> tuple[obsynth.DescriptorSystem, FloatArray, FloatArray]:
    """Return the same plant in other units ``(4,)`` of its states, and the variances of its noise."""
    rng = np.random.default_rng(seed)
    a, c, bf = rng.normal(size=(4, 4)), rng.normal(size=(3, 4)), rng.normal(size=(4, nf))
    a *= rng.choice([0.5, 0.95, 1.02]) / np.max(np.abs(np.linalg.eigvals(a)))
    q, r = rng.uniform(0.1, 1.0, size=4), rng.uniform(0.1, 1.0, size=3)
    if noise_free:
        q[0] = q[1] = r[0] = 0.0
    plant = obsynth.DescriptorSystem(A=units[:, None] * a / units, C=c / units, Bf=units[:, None] * bf, dt=1.0)
    return plant, q * units**2, r


@pytest.mark.one_in(6)
@pytest.mark.parametrize("noise_free", [False, True])
@pytest.mark.parametrize("nf", [0, 2])
@pytest.mark.parametrize("seed", range(2))
def test_gains_settle_in_any_units(seed: int, nf: int, noise_free: bool) -> None:
    # In units that differ by 1e6 the last digits of the gains go to and fro by 1e-11, which was "almost unobservable".
    same, other = np.ones(4), np.array([1e-3, 1.0, 1e3, 1e2])
    small = steady(*random_plant(seed, same, nf, noise_free=noise_free)).observer
    wide = steady(*random_plant(seed, other, nf, noise_free=noise_free)).observer
    for z in np.exp(1j * np.array([0.01, 0.3, 2.0])):
        expected, got = (o.Cz @ np.linalg.solve(z * np.eye(o.order) - o.Az, o.By) + o.Dy for o in (small, wide))
        np.testing.assert_allclose(
            got[:4] / other[:, None], expected[:4], rtol=1e-6, atol=1e-6 * np.abs(expected).max()
        )


@pytest.mark.one_in(2)
@pytest.mark.parametrize("faults", [False, True])
def test_slow_gains_settle_in_few_steps_where_the_recursion_ends(faults: bool) -> None:
    # Two modes that almost keep their value, one of them with hardly any noise: 4,900 steps one after the other.
    plant = obsynth.DescriptorSystem(
        A=[[0.999, 0.01], [0.0, 0.998]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]] if faults else None, dt=1.0
    )
    q, r = np.array([1e-8, 1e-6]), np.array([1.0])
    settled = steady(plant, q, r)
    assert settled.steps < (2000 if faults else 600)
    *_, last = gain_steps(recursive(plant, q, r), MANY)
    expected = np.hstack([last.step.A @ last.gain[:, :2], last.step.A @ last.gain[:, 2:]])
    got = np.hstack([settled.observer.Az[:2, :2], settled.observer.By[:2]])
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=1e-10)


@pytest.mark.long
def test_faults_that_the_sensors_cancel_have_settled() -> None:
    # As many exact sensors as states: the state is read off, and what faults do to its estimate is rounding of zero.
    rng = np.random.default_rng(98)
    plant = obsynth.DescriptorSystem(
        A=0.5 * rng.normal(size=(3, 3)),
        C=rng.normal(size=(3, 3)) * [1e3, 1.0, 1e-3],
        Bf=rng.normal(size=(3, 2)),
        dt=1.0,
    )
    settled = steady(plant, np.ones(3), np.zeros(3))
    assert settled.steps < 5000
    np.testing.assert_allclose(settled.observer.Dy[:3] @ plant.C, np.eye(3), atol=1e-6)


@pytest.mark.one_in(2)
@pytest.mark.parametrize("faults", [False, True])
def test_gains_of_which_a_rest_decays_over_millions_of_steps_settle(faults: bool) -> None:
    # A rest of 1e-8 was left to the recursion, which took all of its steps and said that there is no limit.
    q, r = 3e-10, 1.0
    plant = obsynth.DescriptorSystem(A=[[1.0]], C=[[1.0]], Bf=np.full((1, int(faults)), 1.0), dt=1.0)
    found = steady(plant, np.array([q]), np.array([r]))
    predicted = 0.5 * (q + np.sqrt(q * q + 4.0 * q * r))
    gain = predicted / (predicted + r)
    assert 1.0 - gain > 0.99998
    assert found.steps < 3_000
    np.testing.assert_allclose(found.observer.Az[0, 0], 1.0 - gain, rtol=0.0, atol=1e-12)


def test_gains_that_fall_asleep_are_refused_before_they_are_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    # A constant that nothing disturbs, beside a state that noise moves.
    plant = obsynth.DescriptorSystem(A=np.diag([1.0, 0.5]), C=np.eye(2), dt=1.0)
    asleep = recursive(plant, np.array([0.0, 1.0]), np.ones(2))
    known = obsynth.descriptor_kalman(plant, Q=np.diag([0.0, 1.0]), R=np.eye(2), initial_covariance=np.diag([0.0, 1.0]))
    monkeypatch.setattr("obsynth.observers.recursive.steady_observer.gain_steps", lambda *_, **__: pytest.fail("taken"))
    with pytest.raises(obsynth.PreconditionError, match="z = 1 the noise does not act"):
        steady_observer(asleep)
    # What is known exactly at first is not learnt, and its gains have a limit.
    with pytest.raises(pytest.fail.Exception, match="taken"):
        steady_observer(known.recursive[1])
