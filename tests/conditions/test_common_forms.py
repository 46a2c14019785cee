"""Inequalities of PD observers with the plants' numbers as parameters say what they say with the numbers in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from obsynth.conditions import pd_inequalities
from obsynth.conditions.pd_inequalities import PdSolution, PdTask, solve
from obsynth.errors import SolverError


def task(seed: int, *, theorem: int = 1, decay: float = 0.0, plants: int = 1, integrator: bool = False) -> PdTask:
    rng = np.random.default_rng([52, seed])
    n, ny = 4, 2
    a = rng.normal(size=(n, n)) + 0.5 * np.eye(n)  # no gain is no solution
    if integrator:
        a[-1] = 0.0
    c = rng.normal(size=(ny, n))
    return PdTask(
        plants=tuple((a * (1.0 + 0.1 * i), c) for i in range(plants)), theorem=theorem, delta=0.7, decay=decay,
        disk=None, gain_bound=None, gain_unit=1.0, rate_gain=None, noise_gain=None, rate=np.zeros((n, 1)),
        fault_error=np.zeros((1, n)), process=np.zeros((n, 0)), sensor=np.zeros((ny, 0)), sensor_rate=np.zeros((ny, 0)),
    )  # fmt: skip


TASKS = {
    "plain": task(1), "an integrator": task(2, integrator=True), "a decay": task(3, decay=0.5),
    "another with the same form": task(4), "symmetric": task(5, theorem=2, decay=0.2), "two plants": task(6, plants=2),
}  # fmt: skip


def both(one: PdTask, monkeypatch: pytest.MonkeyPatch) -> tuple[PdSolution, PdSolution]:
    common = solve(one, solver="CLARABEL")
    monkeypatch.setattr(pd_inequalities, "STATES_OF_COMMON_FORMS", 0)
    alone = solve(one, solver="CLARABEL")
    monkeypatch.undo()
    return common, alone


def test_one_form_for_all_numbers_of_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other, so that what a task leaves in the form would show in the next."""
    for name, one in TASKS.items():
        common, alone = both(one, monkeypatch)
        assert common.record["iterations"] == alone.record["iterations"], name
        for part in ("J", "L", "P3"):
            size = float(np.abs(getattr(alone, part)).max())
            assert size > 1e-3, (name, part)
            np.testing.assert_allclose(getattr(common, part), getattr(alone, part), rtol=0.0, atol=1e-6 * size)


def test_what_has_no_solution_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    one = TASKS["plain"]
    before = solve(one, solver="CLARABEL")
    ((a, c),) = one.plants
    unseen = replace(one, plants=((a + 20.0 * np.eye(len(a)), 0.0 * c),))
    with pytest.raises(SolverError, match="infeasible"):
        solve(unseen, solver="CLARABEL")
    np.testing.assert_array_equal(solve(one, solver="CLARABEL").J, before.J)
