"""What known inputs do to the outputs at once is subtracted by recursive observers, whatever runs them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.observers.recursive.batches import run_batch
from obsynth.observers.recursive.steady_observer import steady_observer

D = np.array([[2.0, 0.0], [0.0, -0.5]])

DESIGNS = {
    "filter": (obsynth.descriptor_kalman, {}),
    "gate": (obsynth.descriptor_kalman, {"outliers": "gate"}),
    "early": (obsynth.descriptor_kalman, {"early_constraints": True}),
    "parameters": (obsynth.adaptive_observer, {}),
    "walk": (obsynth.adaptive_observer, {"form": "random-walk", "random_walk": 0.01}),
}


def plant(*, direct, early=False):
    """A sampled plant; with ``early`` one state is algebraic."""
    last = [0.0, 0.3, 0.0, -0.5] if early else [0.1, 0.3, 0.0, 0.5]
    return obsynth.DescriptorSystem(
        E=np.diag([1.0, 1.0, 0.0]) if early else None,
        A=[[0.9, 0.1, 0.0], [0.0, 0.8, last[0]], last[1:]],
        B=[[0.0, 1.0], [1.0, 0.0], [0.2, 0.1]],
        C=[[1.0, 0.0, 0.2], [0.0, 1.0, 1.0]],
        D=D if direct else None,
        Bf=[[1.0], [0.0], [0.0]],
        dt=1.0,
    )


def pair(name):
    function, options = DESIGNS[name]
    return [function(plant(direct=direct, early=name == "early"), Q=0.01, R=0.02, **options) for direct in (0, 1)]


def record(samples=40):
    rng = np.random.default_rng(3)
    return rng.normal(size=(samples, 2)), rng.normal(size=(samples, 2))


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", DESIGNS)
def test_estimates_are_those_of_the_outputs_without_it(name):
    without, direct = pair(name)
    assert direct.report.passed
    y, u = record()
    y[7, 0] = np.nan
    if name == "gate":
        y[20, 1] += 50.0
    one, other = without.observer.run(y, u), direct.observer.run(y + u @ D.T, u)
    for part in ("states", "faults", "state_deviations", "innovations", "nis"):
        np.testing.assert_allclose(getattr(other, part), getattr(one, part), atol=1e-9)
    if name == "gate":
        assert np.abs(one.states[20]).max() < 10.0


@pytest.mark.long
@pytest.mark.parametrize("name", ["filter", "early", "walk"])
def test_many_runs_and_the_kernel(name):
    without, direct = pair(name)
    y, u = record()
    one = without.observer.run(y, u)
    found = run_batch(direct.observer, (y + u @ D.T)[None], u)
    np.testing.assert_allclose(found.states[0], one.states, atol=1e-9)
    if name != "early":
        pytest.importorskip("numba")
        kernel = direct.observer.run(y + u @ D.T, u, compiled=True)
        np.testing.assert_allclose(kernel.states, one.states, atol=1e-9)


@pytest.mark.one_in(4)
@pytest.mark.parametrize("name", ["filter", "early", "parameters", "walk"])
def test_the_steady_state_has_it(name):
    steady = steady_observer(pair(name)[1].observer)
    y, u = record(2000)
    wanted = pair(name)[1].observer.run(y, u)
    found = steady.observer.run(y, u)
    np.testing.assert_allclose(found.states[-1], wanted.states[-1], atol=1e-7)
    np.testing.assert_allclose(found.faults[-1], wanted.faults[-1], atol=1e-7)


def test_a_missing_input_makes_the_outputs_that_it_reaches_uncertain():
    without, direct = pair("filter")
    y, u = record()
    full = direct.observer.run(y + u @ D.T, u)
    before = _after(direct.observer, y, u, 10)
    gap = np.array([np.nan, u[10, 1]])
    _, row = direct.observer.advance(before, y[10] + D @ u[10], gap)
    _, full = direct.observer.advance(before, y[10] + D @ u[10], u[10])
    _, blind = without.observer.advance(_after(without.observer, y, u, 10, subtracted=True), y[10], gap)
    # y1 says less where the input that reaches it is unknown; the input itself acts on the next state only.
    np.testing.assert_allclose(full.state_deviations, blind.state_deviations, rtol=1e-9)
    assert row.state_deviations[0] > 1.1 * full.state_deviations[0]
    assert (np.abs(row.x - full.x) <= 4.0 * row.state_deviations).all()
    nothing = np.full(2, np.nan)
    mean, covariance = direct.observer.recursion.predicted(before, nothing, gap)
    known, sure = direct.observer.recursion.predicted(before, nothing, u[10])
    assert covariance[0, 0] > sure[0, 0]
    assert np.isclose(covariance[1, 1], sure[1, 1])
    assert np.isclose(mean[1], known[1])


def _after(observer, y, u, count, *, subtracted=False):
    state = observer.init()
    for y_k, u_k in zip((y if subtracted else y + u @ D.T)[:count], u[:count], strict=True):
        state, _ = observer.advance(state, y_k, u_k)
    return state


def test_smoothing_and_files():
    without, direct = pair("filter")
    y, u = record()

    def smoothed(design, outputs):
        rows = {"time": np.arange(len(u)), "u1": u[:, 0], "u2": u[:, 1], "y1": outputs[:, 0], "y2": outputs[:, 1]}
        return obsynth.smooth(design, pd.DataFrame(rows)).states

    np.testing.assert_allclose(smoothed(direct, y + u @ D.T), smoothed(without, y), atol=1e-9)
    again = type(direct.observer).from_dict(direct.observer.as_dict())
    np.testing.assert_array_equal(again.plant.D.at(1), D)


def test_simulation_adds_what_the_observer_subtracts():
    design = pair("filter")[1]
    step = obsynth.Scenario(horizon=60.0, inputs={"u1": obsynth.Step(size=1.0, start=5.0)}, initial_state={"x1": 1.0})
    result = obsynth.simulate(design, step)
    assert np.abs(result.estimates.states[-1] - result.states[-1]).max() < 1e-3
