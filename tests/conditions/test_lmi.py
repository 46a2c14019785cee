"""Whatever a semidefinite solver does ends in numbers or in a `SolverError` with the record of the run."""

from __future__ import annotations

import clarabel
import cvxpy
import numpy as np
import pytest

import obsynth
from obsynth.conditions import lmi
from obsynth.errors import SolverError


class PanicException(BaseException):
    """As pyo3 raises it: no `Exception`."""


def least_trace() -> dict[str, object]:
    """Return the record of ``min trace X`` under ``X >= I``."""
    x = lmi.symmetric_variable(2)
    record = lmi.minimise(cvxpy.trace(x), [lmi.at_least(x, 1.0)], what="a matrix")
    np.testing.assert_allclose(lmi.value_of(x), np.eye(2), atol=1e-6)
    return record


def solver_that_raises(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def broken(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(clarabel, "DefaultSolver", broken)


def test_a_run_has_a_record() -> None:
    record = least_trace()
    assert record["status"] == "optimal"
    assert {"what", "solver", "version", "settings", "iterations"} <= set(record)


@pytest.mark.parametrize(
    "error",
    [PanicException("Eigval error: Eigen(1)"), RuntimeError("broken"), MemoryError(), ZeroDivisionError("by zero")],
    ids=lambda error: type(error).__name__,
)
def test_a_crash_is_contained(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    solver_that_raises(monkeypatch, error)
    with pytest.raises(SolverError, match=f"a matrix.*{type(error).__name__}.*inconclusive") as caught:
        least_trace()
    record = caught.value.record
    assert (record["solver"], record["status"]) == ("CLARABEL", "crashed")
    assert record["reason"] == (f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
    # Nothing that is different when the same is done again.
    assert "seconds" not in record
    assert caught.value.__cause__ is error


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_who_wants_out_gets_out(monkeypatch: pytest.MonkeyPatch, error: type[BaseException]) -> None:
    solver_that_raises(monkeypatch, error())
    with pytest.raises(error):
        least_trace()


def test_no_numbers_is_an_error_with_the_record() -> None:
    x = lmi.symmetric_variable(2)
    with pytest.raises(SolverError, match="infeasible") as caught:
        lmi.minimise(None, [lmi.at_least(x, 1.0), lmi.at_most(x, -1.0)], what="nothing")
    assert caught.value.record["status"].startswith("infeasible")
    assert caught.value.record["iterations"] is not None


def test_a_panic_does_not_stop_a_method_that_can_do_without_a_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through a public function: a Riccati equation takes over, and the record says what happened to the solver."""
    solver_that_raises(monkeypatch, PanicException("Eigval error: Eigen(1)"))
    plant = obsynth.DescriptorSystem(None, [[0.5, 1.0], [0.0, -1.0]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]])
    assert obsynth.pd_observer(plant).report.passed
    with pytest.raises(SolverError, match="PanicException") as caught:
        obsynth.pd_observer(plant, gain_bound=5.0)
    assert caught.value.record["status"] == "crashed"
