"""Multipliers (diagonal, full, a ball) against values that are computed by hand, for plants of one state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from obsynth.conditions import ErrorPolytope, SlopedErrors, slope_inequality, vertex_inequalities
from obsynth.conditions.problem import Conditions


def _solved(problem: Conditions, name: str) -> float:
    problem.solve()
    return float(problem.variables[name].value)


def _sloped(slopes: tuple[float, ...], *, measured: bool = False) -> SlopedErrors:
    """Return ``e' = (-2 + sum slopes_k d_k) e + w`` and, where it is measured, ``y = e + v``."""
    B, C, D = ([[1.0, 0.0]], [[1.0]], [[0.0, 1.0]]) if measured else ([[1.0]], np.zeros((0, 1)), np.zeros((0, 1)))
    nominal = ErrorPolytope([[[-2.0]]], C, B=B, D=D, dt=0.0)
    count = len(slopes)
    return SlopedErrors(nominal, np.array([slopes]), np.zeros((nominal.outputs, count)), np.ones((count, 1)))


@pytest.mark.parametrize("multiplier", ["diagonal", "full"])
@pytest.mark.parametrize("slopes", [(0.5,), (0.7, -0.4)])
def test_gain_and_mean_square_are_those_of_the_slowest_plant(multiplier: str, slopes: tuple[float, ...]) -> None:
    # The slowest is e' = -a e + w with a = 2 - sum |slopes|: the gain is 1 / a, the mean square 1 / (2 a).
    a = 2.0 - sum(map(abs, slopes))
    squared = _solved(slope_inequality(_sloped(slopes), goal="gain", multiplier=multiplier), "gamma_squared")
    assert squared == pytest.approx(a**-2, rel=1e-5)
    mean = _solved(slope_inequality(_sloped(slopes), goal="power", multiplier=multiplier), "mean_square")
    assert mean == pytest.approx(0.5 / a, rel=1e-5)


@pytest.mark.parametrize("multiplier", ["diagonal", "full"])
def test_the_best_gain_of_a_measured_state(multiplier: str) -> None:
    # The gain of e' = -(a + L) e + w - L v is sqrt(1 + L^2) / (a + L): least at L = 1 / a, and 1 / sqrt(1 + a^2) there.
    problem = slope_inequality(_sloped((0.5,), measured=True), multiplier=multiplier)
    assert _solved(problem, "gamma_squared") == pytest.approx(1.0 / (1.0 + 1.5**2), rel=1e-5)
    assert problem.gains()["L[1]"][0, 0] == pytest.approx(1.0 / 1.5, rel=1e-2)


@pytest.mark.parametrize("multiplier", ["diagonal", "full"])
def test_decay_ends_at_that_of_the_slowest_plant(multiplier: str) -> None:
    for decay, holds in ((1.49, True), (1.51, False)):
        problem = slope_inequality(_sloped((0.5,)), goal="decay", decay=decay, multiplier=multiplier)
        assert (_solved(problem, "room") > 1e-6) is holds


@pytest.mark.parametrize(("dt", "pole", "limit"), [(0.0, -2.0, 1.0 / 1.5), (1.0, 0.3, 1.0 / (1.0 - 0.8))])
def test_a_ball_moves_the_pole_by_its_radius(dt: float, pole: float, limit: float) -> None:
    # e' = (-2 + r) e + w has the gain 1 / (2 - rho), e+ = (.3 + r) e + w the gain 1 / (1 - .3 - rho); |r| <= rho = .5.
    nothing: dict[str, Any] = {"C": np.zeros((0, 1)), "D": np.zeros((0, 1))}
    errors = ErrorPolytope([[[pole]]], B=[[1.0]], dt=dt, ball=0.5, **nothing)
    problem = vertex_inequalities(errors, gains=[np.zeros((1, 0))])
    assert _solved(problem, "gamma_squared") ** 0.5 == pytest.approx(limit, rel=1e-5)
