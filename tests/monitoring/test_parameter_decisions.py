"""Decisions on parameters, and consistent simulation."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, get_args

import numpy as np
import pytest
from time_varying_plants import observer_for, printed, textbook, varying

from obsynth import PreconditionError, SpecError, TimeVaryingDescriptorSystem
from obsynth.monitoring.thresholds.parameter_decisions import Statistic, decide
from obsynth.simulation.linear import simulate_time_varying

SAMPLES, CHANGE = 160, 90
STATISTICS = get_args(Statistic)
PLANT = varying(horizon=SAMPLES)


def run(seed: int, *, jump: float = 0.0, adapt: dict | None = None, missing: bool = False):
    return cached(seed, jump, missing) if adapt is None else fresh(seed, jump, missing, adapt)


@cache
def cached(seed: int, jump: float, missing: bool):
    return fresh(seed, jump, missing, {})


def fresh(seed: int, jump: float, missing: bool, adapt: dict):
    rng = np.random.default_rng(seed)
    theta = np.zeros((SAMPLES, 2))
    theta[CHANGE:, 1] = jump
    mu = rng.standard_normal((SAMPLES, 3)) * np.sqrt([0.1, 0.2, 0.3])
    nu = rng.standard_normal((SAMPLES - 1, 2)) * np.sqrt([0.2, 0.4])
    u = rng.standard_normal((SAMPLES, 1))
    record = simulate_time_varying(PLANT, samples=SAMPLES, parameters=theta, u=u, equation_noise=mu, output_noise=nu)
    y = record.outputs.copy()
    if missing:
        y[20, 0] = np.nan
    observer = observer_for(PLANT, adapt={"forgetting": 0.95, "initial_covariance": 0.01 * np.eye(2), **adapt})
    return observer, observer.run(y, u)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("statistic", STATISTICS)
def test_false_alarms_are_as_rare_as_asked(statistic: str, share: Callable[..., Any]) -> None:
    """At 5 % more than seven of forty runs without a change alarm with 0.0007, more than four of twenty with 0.003."""
    alarms, seeds = 0, share(range(40), 2, together=True)
    for seed in seeds:
        decision = decide(*run(seed), statistic=statistic, false_alarms=0.05)
        alarms += decision.alarm is not None
        assert (decision.alarm is None) == (decision.values <= decision.thresholds).all()
    assert alarms <= {40: 7, 20: 4}[len(seeds)]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("statistic", STATISTICS)
def test_a_change_is_found_and_named(statistic: str) -> None:
    delays, onsets, named = [], [], []
    for seed in range(10):
        alarm = decide(*run(seed, jump=3.0), statistic=statistic, change=1.0).alarm
        assert alarm is not None
        assert 0.99 <= alarm.confidence <= 1.0
        delays.append(alarm.k - CHANGE)
        onsets.append(alarm.onset - CHANGE)
        named.append(alarm.parameter)
    assert min(delays) >= 0
    assert np.median(delays) <= 8
    assert abs(np.median(onsets)) <= 3
    # The CUSUM alarms earliest in terms of evidence, and its signature is that of a running regressor: it names worst.
    assert named.count("" if statistic == "nis" else "theta2") >= (4 if statistic == "cusum" else 8)


@pytest.mark.long
def test_the_glr_knows_the_onset_of_an_abrupt_change() -> None:
    """theta(k) acts on x(k) by the algebraic equation, and on x(k + 1) by the others: either is the onset."""
    onsets = [decide(*run(seed, jump=6.0), statistic="glr").alarm.onset for seed in range(8)]
    assert sum(onset in (CHANGE, CHANGE + 1) for onset in onsets) >= 7


def test_a_parameter_that_is_not_nominal_from_the_start() -> None:
    observer, found = run(0)
    for statistic in ("chi-square", "cusum", "glr", "nis"):
        assert decide(observer, found, statistic=statistic, nominal=[0.0, 4.0], change=1.0).alarm is not None


def test_missing_samples_and_the_random_walk() -> None:
    observer, found = run(3, missing=True)
    for statistic in STATISTICS:
        assert decide(observer, found, statistic=statistic).alarm is None
    walking, walked = run(3, jump=4.0, adapt={"form": "random-walk", "walk": 1e-4 * np.eye(2)})
    alarm = decide(walking, walked).alarm
    assert alarm is not None
    assert alarm.parameter == "theta2"
    with pytest.raises(SpecError, match="needs regressors"):
        decide(walking, walked, statistic="cusum")


@pytest.mark.parametrize("statistic", STATISTICS)
@pytest.mark.parametrize("samples", [0, 1, 2])
def test_short_records(statistic: str, samples: int) -> None:
    observer = observer_for(PLANT, adapt={})
    found = observer.run(np.zeros((samples, 2)), np.zeros((samples, 1)))
    decision = decide(observer, found, statistic=statistic, nominal=[0.1, 0.0])
    assert decision.alarm is None
    assert decision.values.shape == decision.thresholds.shape == (samples,)


def test_bad_options() -> None:
    observer, found = run(0)
    for options, part in (
        ({"statistic": "t-test"}, "statistic is 't-test'"),
        ({"false_alarms": 0.0}, "false_alarms is 0"),
        ({"nominal": [1.0]}, "nominal must be 2"),
        ({"change": -1.0}, "change must be"),
        ({"change": [1.0]}, "change must be"),
    ):
        with pytest.raises(SpecError, match=part):
            decide(observer, found, **options)
    with pytest.raises(SpecError, match="needs an observer that estimates"):
        decide(observer_for(PLANT), found)


def test_a_filter_without_parameters_has_the_nis() -> None:
    """A change of a parameter that the filter does not know is something that its model does not explain."""
    for jump, expected in ((0.0, False), (4.0, True)):
        observer = observer_for(PLANT, Q=np.diag([0.1, 0.2, 0.3]))
        rng = np.random.default_rng(2)
        theta = np.zeros((SAMPLES, 2))
        theta[CHANGE:, 1] = jump
        y = simulate_time_varying(
            PLANT, samples=SAMPLES, parameters=theta,
            equation_noise=rng.standard_normal((SAMPLES, 3)) * np.sqrt([0.1, 0.2, 0.3]),
            output_noise=rng.standard_normal((SAMPLES - 1, 2)) * np.sqrt([0.2, 0.4]),
        ).outputs  # fmt: skip
        decision = decide(observer, observer.run(y, np.zeros((SAMPLES, 1))), statistic="nis")
        assert (decision.alarm is not None) is expected
    assert decision.alarm.parameter == ""
    assert 0 <= decision.alarm.k - CHANGE <= 15


class TestSimulation:
    def test_every_equation_holds(self) -> None:
        rng = np.random.default_rng(4)
        theta, u, mu, nu = (rng.standard_normal(shape) for shape in ((20, 1), (20, 2), (20, 2), (19, 1)))
        plant = printed(horizon=20)
        found = simulate_time_varying(
            plant, samples=20, parameters=theta, u=u, equation_noise=mu, output_noise=nu, initial_state=[1.0, 2.0]
        )
        x = found.states
        for k in range(19):
            right = plant.A.at(k) @ x[k] + plant.B.at(k) @ u[k] + plant.Phi.at(k) @ theta[k] + mu[k]
            np.testing.assert_allclose(plant.E.at(k + 1) @ x[k + 1], right, rtol=0, atol=1e-12)
            np.testing.assert_allclose(found.outputs[k + 1], plant.C.at(k + 1) @ x[k + 1] + nu[k], atol=1e-13)
        assert np.isnan(found.outputs[0]).all()

    def test_the_printed_example_as_the_audit_has_it(self) -> None:
        """theta = 1 and the paper's inputs: max|x1| = 15.57, max|x2| = 14.16, x(1000) = (-2, 7e-6)."""
        k = np.arange(1001)
        u = np.column_stack([1 - np.exp(-0.018 * k) / 0.8 * np.sin(0.03 * k), 1 + np.exp(-0.03 * k) * np.sin(0.1 * k)])
        found = simulate_time_varying(printed(), samples=1001, parameters=[1.0], u=u, initial_state=[-2.0, 0.0])
        assert np.abs(found.states).max(axis=0) == pytest.approx([15.57, 14.16], abs=5e-3)
        assert found.states[-1] == pytest.approx([-2.0, 7e-6], abs=1e-5)

    def test_refusals(self) -> None:
        with pytest.raises(PreconditionError, match="index is higher than one"):
            simulate_time_varying(textbook(E=np.diag([1.0, 0]), A=[[1, 1], [1, 0]]), samples=5)
        with pytest.raises(SpecError, match="2 equations do not determine 3"):
            simulate_time_varying(
                TimeVaryingDescriptorSystem([[1, 0, 0], [0, 1, 0]], np.ones((2, 3)), C=np.eye(3), dt=1.0), samples=3
            )
        with pytest.raises(SpecError, match="parameters has shape"):
            simulate_time_varying(printed(), samples=5, parameters=np.zeros((4, 1)))


@pytest.mark.one_in(3)
@pytest.mark.parametrize("adapt", [{}, {"form": "literal"}, {"form": "random-walk", "walk": 1e-4 * np.eye(2)}])
def test_a_start_far_from_nominal_is_no_alarm(adapt: dict) -> None:
    """The parameters are nominal, and the observer starts elsewhere: what is left of its initial-condition response
    says nothing."""
    for missing in (False, True):
        observer, found = run(1, missing=missing, adapt={**adapt, "initial_parameters": np.array([8.0, -9.0])})
        assert np.abs(found.parameters[0]).max() == 9.0
        decision = decide(observer, found, nominal=[0.0, 0.0], false_alarms=0.05)
        assert decision.values[0] == 0.0
        assert decision.alarm is None
        # With the same data, an observer that starts at the nominal values gives the same statistic.
        other, same = run(1, missing=missing, adapt={**adapt, "initial_parameters": np.zeros(2)})
        np.testing.assert_allclose(decision.values, decide(other, same).values, rtol=1e-7, atol=1e-9)
    observer, found = run(1, jump=3.0, adapt={**adapt, "initial_parameters": np.array([8.0, -9.0])})
    alarm = decide(observer, found, nominal=[0.0, 0.0]).alarm
    assert alarm is not None
    assert (alarm.parameter, 0 <= alarm.k - CHANGE <= 15) == ("theta2", True)


def test_a_reset_forgets_the_start_at_times_that_data_choose() -> None:
    observer, found = run(1, adapt={"reset": 1e-6, "initial_parameters": np.array([8.0, -9.0])})
    with pytest.raises(SpecError, match="chi-square with reset"):
        decide(observer, found, nominal=[0.0, 0.0])
    assert decide(observer, found, nominal=[0.0, 0.0], statistic="glr", false_alarms=0.05).alarm is None


def test_the_glr_where_excitation_decays() -> None:
    """The information on a change sinks below what double precision holds; no warning, and no alarm."""
    plant = TimeVaryingDescriptorSystem(None, [["0.5 + 0 * k"]], C=[[1]], Phi=[["exp(-k)"]], dt=1.0)
    observer = observer_for(plant, adapt={})
    y = np.random.default_rng(4).standard_normal((760, 1)) * 0.5
    found = decide(observer, observer.run(y), statistic="glr")
    assert found.alarm is None
    assert np.isfinite(found.values).all()
    assert found.values[:300].max() > 0.1
    assert (found.values[-10:] == 0.0).all()


def test_estimates_of_another_observer() -> None:
    one, other = observer_for(varying(), adapt={}), observer_for(textbook(), adapt={})
    found = other.run(np.zeros((5, other.plant.ny)), np.zeros((5, other.plant.nu)))
    with pytest.raises(SpecError, match="other states or parameters"):
        decide(one, found)
