"""GLR and gains along records with missing samples: signatures are those of the record, not of the whole model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from time_varying_plants import observer_for, record, varying

from obsynth import RecursiveObserver, TimeVaryingDescriptorSystem, decide
from obsynth.observers.recursive.gain_schedule import gain_steps

SAMPLES = 40
#: Single outputs, both at once, several in a row (so that H_k loses rank and states stay open for a while).
MISSING = ((4, 0), (7, 1), (11, 0), (11, 1), (12, 0), (12, 1), (13, 1), (20, 0), (21, 0), (30, 1))
FORMS = {
    "innovation": {}, "literal": {"form": "literal"}, "directional": {"guard": "directional"},
}  # fmt: skip


def gappy(plant: TimeVaryingDescriptorSystem) -> tuple[np.ndarray, np.ndarray]:
    y, u = record(plant, SAMPLES, seed=8)
    y = y.copy()
    for k, output in MISSING:
        y[k, output] = np.nan
    return y, u


def observer(early: bool = False, **adapt: object) -> RecursiveObserver:
    return observer_for(varying(horizon=SAMPLES), adapt=adapt, early_constraints=early)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_gains_reproduce_a_run_with_gaps(form: str, early: bool) -> None:
    """Estimates are linear in the data: the gains of a record, applied to it, give the run sample by sample."""
    shipped = observer(early, **FORMS[form])
    plant = shipped.plant
    y, u = gappy(plant)
    found = shipped.run(y, u)
    assert np.array_equal(found.received, ~np.isnan(y))
    assert np.isinf(found.state_deviations[12]).any() != early
    x, theta = np.zeros(3), np.zeros(2)
    for k, gains in enumerate(gain_steps(shipped, SAMPLES - 1, received=found.received), 0 if early else 1):
        outputs = np.nan_to_num(y[k]) if k else np.zeros(0)
        before = u[k - 1] if k else np.zeros(1)
        data = np.concatenate([gains.step.A @ x + gains.step.B @ before, outputs, gains.step.Dn @ u[k]])
        x, theta = gains.gain @ data, gains.retain @ theta + gains.learn @ data
        np.testing.assert_allclose(theta, found.parameters[k], rtol=0, atol=1e-11)
        np.testing.assert_allclose(x + gains.Upsilon @ theta, found.states[k], rtol=0, atol=1e-10)
        np.testing.assert_allclose(gains.spread @ gains.spread.T, found.parameter_covariances[k], rtol=0, atol=1e-11)
        expected = found.innovations[k][: len(gains.parity)]
        np.testing.assert_allclose(gains.parity @ data, expected, rtol=0, atol=1e-10)
        np.testing.assert_allclose(gains.G, found.regressors[k][: len(gains.parity)], rtol=0, atol=1e-10)


@pytest.mark.parametrize("early", [False, True])
def test_the_glr_is_the_likelihood_ratio_of_the_record(early: bool) -> None:
    """Against a jump that is put into the data: the innovations of the difference are the signature."""
    plant, onset, theta = varying(horizon=SAMPLES), 9, np.array([0.7, -1.2])
    shipped = observer(early)
    y, u = gappy(plant)
    # The jump enters as an input that acts from the onset on: inputs Phi theta, and Psi theta in the outputs.
    wide = plant.replace(B=lambda k: np.hstack([plant.B.at(k), plant.Phi.at(k)]), input_names=None)
    quiet = observer_for(wide, adapt={}, early_constraints=early)
    pushed = np.hstack([u, np.zeros((SAMPLES, 2))])
    pushed[onset:, 1:] = theta
    moved = y.copy()
    for k in range(onset, SAMPLES - 1):
        moved[k + 1] -= plant.Psi.at(k) @ theta
    first = quiet.run(y, np.hstack([u, np.zeros((SAMPLES, 2))])).innovations
    second = quiet.run(moved, pushed).innovations
    signature = np.nan_to_num(first - second)
    late = slice(onset, None) if early else slice(onset + 1, None)
    assert not signature[: late.start].any()
    # Data that are nothing but the jump: the statistic is the squared length of the signature at the true onset.
    values = decide(shipped, estimates_of(shipped, signature, y, u), statistic="glr", false_alarms=0.5).values
    assert values[-1] == pytest.approx(float(np.sum(signature**2)), rel=1e-9)


def estimates_of(shipped: RecursiveObserver, innovations: np.ndarray, y: np.ndarray, u: np.ndarray):
    import dataclasses

    found = shipped.run(y, u)
    padded = np.where(np.isnan(found.innovations), np.nan, innovations)
    return dataclasses.replace(found, innovations=padded)


@pytest.mark.long
@pytest.mark.parametrize("gaps", ["single", "bursts"])
def test_false_alarms_of_the_glr_with_gaps(gaps: str, share: Callable[..., Any]) -> None:
    """Runs at 5 %: of thirty, more than six alarm with probability 0.0006, and of ten, more than three with 0.001."""
    rng = np.random.default_rng(3)
    plant = TimeVaryingDescriptorSystem(
        None, [[0.8, 0.1], [0, "0.6 + 0.1 * sin(k)"]], C=np.eye(2), Phi=[[1], ["cos(k)"]], dt=1.0, horizon=120
    )
    shipped = observer_for(plant, Q=0.1 * np.eye(2), R=0.2 * np.eye(2), adapt={})
    alarms, found = 0, 0
    runs = share(range(30), 3, together=True)
    for _ in runs:
        for jump in (0.0, 1.5):
            x, y = rng.standard_normal(2), np.full((121, 2), np.nan)
            for k in range(120):
                step = plant.Phi.at(k)[:, 0] * (jump if k >= 60 else 0.0)
                x = plant.A.at(k) @ x + step + np.sqrt(0.1) * rng.standard_normal(2)
                y[k + 1] = x + np.sqrt(0.2) * rng.standard_normal(2)
            lost = rng.random((121, 2)) < 0.2 if gaps == "single" else (np.arange(121) % 15 < 4)[:, None]
            alarm = decide(shipped, shipped.run(np.where(lost, np.nan, y)), statistic="glr", false_alarms=0.05).alarm
            if jump:
                found += alarm is not None and abs(alarm.onset - 60) <= 8
            else:
                alarms += alarm is not None
    assert alarms <= {30: 6, 10: 3}[len(runs)]
    assert found >= 25 / 30 * len(runs)
