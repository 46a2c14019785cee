"""The filter polished by the inequality: which engine ran is said, and what it found is kept."""

from __future__ import annotations

from functools import cache
from importlib.metadata import version

import numpy as np
import pytest

import obsynth
from obsynth.errors import SolverError
from obsynth.methods.fault_estimation_filter import small_gains


def plant(nd: int) -> obsynth.DescriptorSystem:
    """Return a plant of 14 states, six measurements and two faults."""
    rng = np.random.default_rng([47, nd])
    a = rng.standard_normal((14, 14))
    a /= np.max(np.abs(np.linalg.eigvals(a)))
    bf, bd = rng.standard_normal((14, 2)), 0.3 * rng.standard_normal((14, nd))
    return obsynth.DescriptorSystem(None, a, None, rng.standard_normal((6, 14)), Bf=bf, Bd=bd, dt=0.1)


@cache
def filtering(nd: int) -> obsynth.ObserverDesign:
    """Return what is designed by default."""
    return obsynth.fault_estimation_filter(plant(nd))


@pytest.mark.long
def test_the_inequality_is_asked_and_nothing_is_lost() -> None:
    design = obsynth.fault_estimation_filter(plant(nd=9), engine="lmi")
    runs = [run for run in design.solver["runs"] if run["what"] == "least gain"]
    assert design.report.passed
    assert design.solver["engine"] == "lmi"
    assert [run["solver"] for run in runs] == ["central filter", "CLARABEL"]
    assert runs[1]["version"] == version("clarabel")
    default = filtering(nd=9)
    assert default.solver["engine"] == "riccati"
    polished = design.certificate.claims["gamma_min"]
    assert (1.0 - 1e-5) * default.certificate.claims["gamma_min"] <= polished
    assert polished <= default.certificate.claims["gamma_min"]
    assert np.linalg.norm(design.gains["R"]) <= np.linalg.norm(default.gains["R"])


@pytest.mark.long
def test_where_a_bound_is_reached_the_record_says_that_there_is_nothing_to_polish() -> None:
    design = obsynth.fault_estimation_filter(plant(nd=1), weight="paper", engine="lmi")
    last = [run for run in design.solver["runs"] if run["what"] == "least gain"][-1]
    assert last["solver"] == "lower bound"
    assert "the lower bound is reached" in last["status"]
    assert last["gain"] == pytest.approx(design.certificate.claims["gamma_min"])
    assert "lower bound" not in str(filtering(nd=1).solver["runs"])


@pytest.mark.one_in(2)
@pytest.mark.parametrize(("factor", "engine"), [(1.01, "riccati"), (1.0 + 5e-5, "lmi")])
def test_a_gamma_next_to_the_least_calls_the_inequality(factor: float, engine: str) -> None:
    least = filtering(nd=9).certificate.claims["gamma_min"]
    design = obsynth.fault_estimation_filter(plant(nd=9), gamma=factor * least)
    assert design.report.passed
    assert design.solver["engine"] == engine
    assert ("CLARABEL" in {run["solver"] for run in design.solver["runs"]}) == (engine == "lmi")


def test_solvers_that_there_are_not_are_named_with_those_that_there_are() -> None:
    for name in ("MOSEK", "SCHUR", "auto"):
        with pytest.raises(obsynth.SpecError, match=f"no solver '{name}' .*: CLARABEL, SCS"):
            obsynth.fault_estimation_filter(plant(nd=9), solver=name)


def test_a_solver_that_fails_costs_the_polish_only(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_problem: object, what: str, _solver: str) -> None:
        raise SolverError("broken", record={"what": what, "solver": "CLARABEL", "status": "failed"})

    monkeypatch.setattr(small_gains, "solved", broken)
    design = obsynth.fault_estimation_filter(plant(nd=9), engine="lmi")
    assert design.report.passed
    outcomes = [run["outcome"] for run in design.solver["runs"] if run["solver"] == "CLARABEL"]
    assert set(outcomes) == {"broken"}
    assert len(outcomes) == 3  # the least gain, small gains, small gains that decay fast
