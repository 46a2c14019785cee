"""Bisection over conditions: against known norms, and with solvers that fail at some levels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.conditions.bisection import bisected
from obsynth.errors import SolverError, SpecError

PLANT = obsynth.load_spec(Path(__file__).parents[2] / "designs/wang2015/spec.yaml").plant
#: The least gain of (45) for these T, N and W, by a Riccati equation.
LEAST = 1.46471681**2


def answers(limit: float, failing: tuple[float, float], *, upwards: bool = True):
    """Answers of a solver that fails in an interval; feasible above the limit, or below it."""
    asked = []

    def answer(level: float) -> str:
        asked.append(level)
        if failing[0] <= level <= failing[1]:
            return "unknown"
        return "feasible" if (level >= limit) is upwards else "infeasible"

    return answer, asked


@pytest.mark.parametrize("limit", [0.3, 2.0, 77.7])
@pytest.mark.parametrize("upwards", [True, False])
def test_the_limit_is_found_between_both_ends(limit: float, upwards: bool) -> None:
    answer, asked = answers(limit, (np.inf, np.inf), upwards=upwards)
    found = bisected(answer, 100.0 if upwards else 1e-3, 1e-3 if upwards else 100.0, 1e-4)
    for level in (found.feasible, found.infeasible):
        assert level == pytest.approx(limit, rel=3e-4)
    assert found.unknown == ()
    assert len(asked) <= 30


def test_a_solver_that_fails_says_nothing_of_a_level() -> None:
    # The limit is at 2; from 1.7 to 2.4 there is no answer, and in a narrow gap at 50.
    for failing in ((1.7, 2.4), (49.0, 51.0)):
        answer, _ = answers(2.0, failing)
        found = bisected(answer, 100.0, 0.0, 1e-4)
        outside = failing[0] > 2.0
        assert found.feasible == pytest.approx(2.0 if outside else 2.4, rel=1e-3)
        assert found.infeasible == pytest.approx(2.0 if outside else 1.7, rel=1e-3)
        assert all(failing[0] <= level <= failing[1] for level in found.unknown)
        assert found.unknown


def test_where_everything_is_feasible_the_other_end_is_the_result() -> None:
    answer, _ = answers(-1.0, (np.inf, np.inf))
    found = bisected(answer, 100.0, 0.0, 1e-4)
    assert found.feasible == 0.0
    assert np.isnan(found.infeasible)


@pytest.mark.long
def test_the_least_level_of_a_paper_is_that_of_the_riccati_equation() -> None:
    paper = obsynth.conditions.wang2015(PLANT, gamma=10.0)
    found = paper.bisect("gamma_squared", 100.0, 0.0, tolerance=1e-3)
    assert LEAST * (1.0 - 1e-6) <= found.feasible <= LEAST * 1.002
    # Levels that the solver is not sure of are below the least, and are not called infeasible.
    assert all(level < LEAST for level in found.unknown)
    assert paper.design().report.passed


@pytest.mark.long
def test_levels_where_clarabel_stalls_are_refuted_by_scs() -> None:
    """Below the least, Clarabel says "infeasible, inaccurate" or fails; SCS finds the inequality infeasible."""
    by_one = obsynth.conditions.wang2015(PLANT, gamma=10.0).bisect("gamma_squared", 9.0, 1.0, solver="CLARABEL")
    found = obsynth.conditions.wang2015(PLANT, gamma=10.0).bisect("gamma_squared", 9.0, 1.0)
    assert np.isnan(by_one.infeasible)
    assert LEAST * 0.995 <= found.infeasible < LEAST <= found.feasible <= LEAST * 1.002
    assert len(found.unknown) < len(by_one.unknown)


def test_an_error_of_the_solver_is_unknown_and_not_infeasible(monkeypatch: pytest.MonkeyPatch) -> None:
    paper = obsynth.conditions.wang2015(PLANT, gamma=10.0)
    real = type(paper).solve

    def failing(self, *, solver, settings) -> None:
        if 4.0 < self.parameters["gamma_squared"].value < 30.0:
            raise SolverError("failed")
        real(self, solver=solver, settings=settings)

    monkeypatch.setattr(type(paper), "solve", failing)
    found = paper.bisect("gamma_squared", 100.0, 0.0, tolerance=0.5)
    assert any(4.0 < level < 30.0 for level in found.unknown)
    assert not 4.0 < found.infeasible < 30.0
    with pytest.raises(SolverError, match=r"no answer at gamma_squared = 20 .*CLARABEL and SCS"):
        paper.bisect("gamma_squared", 20.0, 0.0)


def test_what_cannot_be_bisected_is_refused() -> None:
    with pytest.raises(SpecError, match="no parameter 'gamma'; there are: gamma_squared"):
        obsynth.conditions.wang2015(PLANT, gamma=10.0).bisect("gamma", 1.0, 0.0)
    with pytest.raises(SpecError, match="none: give wang2015 a gamma"):
        obsynth.conditions.wang2015(PLANT).bisect("gamma_squared", 1.0, 0.0)
    with pytest.raises(SpecError, match="tolerance is 0"):
        obsynth.conditions.wang2015(PLANT, gamma=10.0).bisect("gamma_squared", 9.0, 0.0, tolerance=0.0)
