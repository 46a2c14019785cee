"""The filter polished by the inequality: which engine ran is said, and what it found is kept."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.errors import SolverError
from obsynth.methods.conic import lmi
from obsynth.methods.fault_estimation_filter import inequality_search, inequality_solutions
from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, WeightLimit, normalise


def plant(nd: int) -> obsynth.DescriptorSystem:
    """Return a plant of 14 states, six measurements and two faults."""
    rng = np.random.default_rng([47, nd])
    a = rng.standard_normal((14, 14))
    a /= np.max(np.abs(np.linalg.eigvals(a)))
    bf, bd = rng.standard_normal((14, 2)), 0.3 * rng.standard_normal((14, nd))
    return obsynth.DescriptorSystem(None, a, None, rng.standard_normal((6, 14)), Bf=bf, Bd=bd, dt=0.1)


def limited_problem() -> GainProblem:
    """Return a problem with two disturbances and a limit that does not bind, in normalised coordinates."""
    rng = np.random.default_rng(48)
    a = rng.standard_normal((5, 5))
    a *= 1.05 / np.max(np.abs(np.linalg.eigvals(a)))
    limit = WeightLimit(rng.standard_normal((2, 4)), np.eye(2, 4), 100.0)
    zeros = np.zeros((2, 2))
    c, z, b = rng.standard_normal((2, 5)), rng.standard_normal((2, 5)), rng.standard_normal((5, 2))
    return normalise(
        GainProblem(a, c, z, b, zeros, zeros, np.zeros((5, 2)), -np.eye(2), zeros, free_weight=True, weight_limit=limit)
    ).problem


def test_the_inequality_is_solved_by_the_fast_solver_and_nothing_is_lost() -> None:
    design = obsynth.fault_estimation_filter(plant(nd=9), engine="lmi")
    runs = [run for run in design.solver["runs"] if run["what"] == "least gain"]
    assert design.report.passed
    assert design.solver["engine"] == "lmi"
    assert [run["solver"] for run in runs] == ["central filter", "SCHUR"]
    assert (runs[1]["status"], runs[1]["version"]) == ("optimal", obsynth.__version__)
    default = obsynth.fault_estimation_filter(plant(nd=9))
    assert default.solver["engine"] == "riccati"
    polished = design.certificate.claims["gamma_min"]
    assert (1.0 - 1e-5) * default.certificate.claims["gamma_min"] <= polished
    assert polished <= default.certificate.claims["gamma_min"]


def test_where_a_bound_is_reached_the_record_says_that_there_is_nothing_to_polish() -> None:
    design = obsynth.fault_estimation_filter(plant(nd=1), engine="lmi")
    last = [run for run in design.solver["runs"] if run["what"] == "least gain"][-1]
    assert design.solver["engine"] == "riccati"
    assert last["solver"] == "lower bound"
    assert "nothing to polish" in last["status"]
    assert last["gain"] == pytest.approx(design.certificate.claims["gamma_min"])
    assert "lower bound" not in str(obsynth.fault_estimation_filter(plant(nd=1)).solver["runs"])


@pytest.mark.parametrize(("factor", "engine"), [(1.01, "riccati"), (1.0 + 5e-5, "lmi")])
def test_a_gamma_next_to_the_least_calls_the_inequality(factor: float, engine: str) -> None:
    least = obsynth.fault_estimation_filter(plant(nd=9)).certificate.claims["gamma_min"]
    design = obsynth.fault_estimation_filter(plant(nd=9), gamma=factor * least)
    assert design.report.passed
    assert design.solver["engine"] == engine
    assert ("SCHUR" in {run["solver"] for run in design.solver["runs"]}) == (engine == "lmi")


def test_solvers_are_named_where_asked_for() -> None:
    design = obsynth.fault_estimation_filter(plant(nd=9), engine="lmi", solver="CLARABEL")
    assert {run["solver"] for run in design.solver["runs"]} == {"central filter", "CLARABEL"}
    with pytest.raises(obsynth.SpecError, match="auto, SCHUR, CLARABEL, SCS"):
        obsynth.fault_estimation_filter(plant(nd=9), solver="MOSEK")


def test_a_solver_that_fails_costs_the_polish_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, what: str, **__: object) -> None:
        raise SolverError("broken", record={"what": what, "solver": "SCHUR", "status": "failed"})

    monkeypatch.setattr(lmi, "minimise", broken)
    design = obsynth.fault_estimation_filter(plant(nd=9), engine="lmi")
    assert design.report.passed
    outcomes = [run["outcome"] for run in design.solver["runs"] if run["solver"] == "SCHUR"]
    assert outcomes == ["broken"] * len(inequality_search.CEILINGS)


def test_gains_on_the_boundary_of_the_inequality_are_of_a_natural_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """With as many disturbances as measurements P - Z'Z tends to a singular matrix: without room the gains grow."""
    problem, sizes = limited_problem(), []
    for room in (inequality_solutions.RECOVERY_ROOM, 0.0):
        monkeypatch.setattr(inequality_solutions, "RECOVERY_ROOM", room)
        found = inequality_solutions.least_gain(problem, solver="SCHUR")
        sizes.append(float(np.linalg.norm(found.injection.R)))
        if room:
            # The room costs half of itself, 5e-6; rounding of gains of size 10, 2e-6 on the machine that rounds worst.
            assert problem.achieved_gain(found.injection) <= found.gain * (1.0 + 1e-5)
    assert sizes[0] < 0.5 * sizes[1]
