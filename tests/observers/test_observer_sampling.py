"""A sampled observer equals the continuous one when the signals are linear between samples."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from obsynth import LinearObserver, SpecError
from obsynth.observers.linear.sampled import sample_observer


def observer(dt=0.0):
    rng = np.random.default_rng(5)
    return LinearObserver(
        Az=rng.normal(size=(3, 3)) - 2.0 * np.eye(3), Bu=rng.normal(size=(3, 1)), By=rng.normal(size=(3, 2)),
        Cz=rng.normal(size=(4, 3)), Du=rng.normal(size=(4, 1)), Dy=rng.normal(size=(4, 2)), dt=dt, input_names=("u",),
        output_names=("y1", "y2"), state_names=("a", "b"), fault_names=("f",), residual_names=("r",),
        state_delays=(0, 0), fault_delays=(0,),
    )  # fmt: skip


def test_sampling_is_exact_for_signals_that_are_linear_between_samples():
    dt, steps = 0.3, 12
    rng = np.random.default_rng(6)
    u, y = rng.normal(size=(steps, 1)), rng.normal(size=(steps, 2))
    u[0], y[0] = 0.0, 0.0
    continuous = observer()
    found = sample_observer(continuous, dt).run(y, u)
    times = dt * np.arange(steps)
    signals = np.hstack([u, y])

    def rate(t, z, k):
        v = signals[k] + (t - times[k]) / dt * (signals[k + 1] - signals[k])
        return continuous.Az @ z + continuous.Bu @ v[:1] + continuous.By @ v[1:]

    z = np.zeros(3)
    for k in range(steps):
        expected = continuous.Cz @ z + continuous.Du @ u[k] + continuous.Dy @ y[k]
        assert found.states[k] == pytest.approx(expected[:2], abs=1e-9)
        assert found.faults[k] == pytest.approx(expected[2:3], abs=1e-9)
        if k + 1 < steps:
            z = solve_ivp(rate, (times[k], times[k + 1]), z, args=(k,), rtol=1e-11, atol=1e-12).y[:, -1]


@pytest.mark.parametrize(
    ("dt", "wanted"), [(0.0, "positive"), (-1.0, "positive"), (np.nan, "number"), (np.inf, "number")]
)
def test_sampling_needs_a_positive_time(dt, wanted):
    with pytest.raises(SpecError, match=wanted):
        sample_observer(observer(), dt)


def test_a_discrete_observer_is_refused():
    with pytest.raises(SpecError, match="already"):
        sample_observer(observer(dt=0.1), 0.1)
