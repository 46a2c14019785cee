"""The extended Kalman filter of a plant of equations: against one written down here, with the faults of a design."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import obsynth

#: Two tanks with a tube between them; the flow through it is algebraic.
EQUATIONS = {
    "first": "der(h1) = inflow - tube",
    "second": "der(h2) = tube - 0.3 * sqrt(h2)",
    "between": "tube = 0.4 * sqrt(h1 - h2)",
}
NOMINAL = {"h1": 0.5**2 / 0.4**2 + 0.5**2 / 0.3**2, "h2": 0.5**2 / 0.3**2, "tube": 0.5}


def tanks(**more):
    return obsynth.DAEModel(EQUATIONS, {"gauge": "h2"}, states=NOMINAL, inputs={"inflow": 0.5}, **more)


def reference(y, u, *, dt, q, r, p0):
    """The filter by hand, backward Euler: x(k) = x(k-1) + dt f(x(k)), with h1, h2 as its states."""
    x, p = np.array([NOMINAL["h1"], NOMINAL["h2"]]), np.diag(p0)
    found = []
    for k in range(len(y)):
        if k:
            before, x = x, x.copy()
            for _ in range(50):
                tube = 0.4 * np.sqrt(x[0] - x[1])
                slope = 0.2 / np.sqrt(x[0] - x[1])
                jacobian = np.array([[-slope, slope], [slope, -slope - 0.15 / np.sqrt(x[1])]])
                gap = x - before - dt * np.array([u[k] - tube, tube - 0.3 * np.sqrt(x[1])])
                x = x - np.linalg.solve(np.eye(2) - dt * jacobian, gap)
            inverse = np.linalg.inv(np.eye(2) - dt * jacobian)
            # Q is of the right sides: dt Q dt enters the step.
            p = inverse @ (p + q * np.eye(2)) @ inverse.T
        h = np.array([[0.0, 1.0]])
        gain = p @ h.T / (h @ p @ h.T + r)
        x, p = x + (gain * (y[k] - x[1])).ravel(), (np.eye(2) - gain @ h) @ p
        found.append((x.copy(), np.sqrt(np.diag(p))))
    return found


def design_of(**more):
    return obsynth.extended_kalman(
        tanks(), dt=0.5, Q={"first": 1e-4, "second": 1e-4}, R={"gauge": 1e-3}, integration="backward-euler", **more
    )


@pytest.mark.long
def test_it_is_the_filter_by_hand():
    design, rng = design_of(), np.random.default_rng(2)
    assert design.report.passed
    u = 0.5 + 0.1 * np.sin(0.2 * np.arange(60))
    y = NOMINAL["h2"] + 0.05 * rng.normal(size=60)
    found = design.observer.run(y[:, None], u[:, None])
    p0 = np.diag(design.observer.initial_covariance)
    own = reference(y, u, dt=0.5, q=1e-4 * 0.5**2, r=1e-3, p0=p0[:2])
    np.testing.assert_allclose(found.states[:, :2], [x for x, _ in own], rtol=1e-6)
    np.testing.assert_allclose(found.state_deviations[5:, :2], [d for _, d in own][5:], rtol=1e-6)
    # The algebraic state follows its equation.
    np.testing.assert_allclose(found.states[1:, 2], 0.4 * np.sqrt(found.states[1:, 0] - found.states[1:, 1]), rtol=2e-2)


@pytest.mark.long
def test_auto_takes_it_and_the_adaptive_observer_without_parameters_is_it():
    options = {"dt": 0.5, "Q": {"first": 1e-4, "second": 1e-4}, "R": {"gauge": 1e-3}}
    assert obsynth.design(tanks(), **options).method == "extended-kalman"
    own, other = obsynth.extended_kalman(tanks(), **options), obsynth.dae_adaptive_observer(tanks(), **options)
    assert other.report.passed
    y, u = np.full((20, 1), 2.9), np.full((20, 1), 0.5)
    np.testing.assert_array_equal(own.observer.run(y, u).states, other.observer.run(y, u).states)
    with pytest.raises(obsynth.SpecError, match="the plant has no parameters: leave it out"):
        obsynth.dae_adaptive_observer(tanks(), **options, form="random-walk")


def test_parameters_are_named():
    plant = obsynth.DAEModel(
        {"tank": "der(level) = inflow - leak * sqrt(level)"}, {"gauge": "level"},
        states={"level": 1.0}, inputs={"inflow": 0.5}, parameters={"leak": 0.5},
    )  # fmt: skip
    with pytest.raises(obsynth.PreconditionError, match=r"leak\. Make them constants, or take dae-adaptive") as caught:
        obsynth.extended_kalman(plant, dt=1.0, Q=1e-4, R=1e-4)
    assert caught.value.condition == "known parameters"
    assert not obsynth.check(plant)["extended-kalman"].passed
    assert obsynth.dae_adaptive_observer(plant, dt=1.0, Q=1e-4, R=1e-4).report.passed


def failing(design):
    return {row.name for row in obsynth.verify(design).checks if not row.passed}


@pytest.mark.long
def test_its_checks_can_fail():
    design = design_of()
    observer = design.observer
    grown = replace(observer, R=400.0 * observer.R)
    assert "fits the plant" in failing(design.replace(observer=grown))
    both = design.replace(observer=grown, options={**design.options, "R": grown.R})
    assert "gains" in failing(both)
    assert "claims" in failing(
        design.replace(
            certificate=replace(design.certificate, claims={**design.certificate.claims, "contraction": 0.1})
        )
    )
    other = obsynth.DAEModel(
        {**EQUATIONS, "second": "der(h2) = tube - drain * sqrt(h2)"}, {"gauge": "h2"}, states=NOMINAL,
        inputs={"inflow": 0.5}, parameters={"drain": 0.3},
    )  # fmt: skip
    assert "exists: known parameters" in failing(design.replace(plant=other))


def test_nothing_is_said_of_parameters_that_a_plant_lacks():
    """An integrator that is followed slowly: its note was of errors of the parameters, and of a factor that forgets."""
    tank = obsynth.DAEModel({"level": "der(h) = inflow"}, {"gauge": "h"}, states={"h": 1.0}, inputs={"inflow": 0.0})
    slow = obsynth.extended_kalman(tank, dt=1.0, Q=1e-8, R=1e-2, initial_covariance=1e-4)
    assert slow.certificate.claims["contraction"] > 0.99
    assert not any("parameter" in note for note in slow.notes), slow.notes
