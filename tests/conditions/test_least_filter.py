"""The full-order inequalities of the least filters: they agree with the Riccati equations of the front door."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest

import obsynth
from obsynth import conditions

WALK = obsynth.DescriptorSystem(
    A=[[1.0]], C=[[1], [1]], Bf=[[0]], Df=[[1], [0]], Bw=[[1, 0]], Dw=[[0, 0], [0, 1]], dt=1.0
)


def random_plant(seed: int, states: int, dt: float = 1.0) -> obsynth.DescriptorSystem:
    rng = np.random.default_rng([47, seed])
    a = rng.normal(size=(states, states))
    a *= 0.9 / np.max(np.abs(np.linalg.eigvals(a)))
    return obsynth.DescriptorSystem(
        E=None,
        A=a if dt else a - 1.2 * np.eye(states),
        C=rng.normal(size=(3, states)),
        Bf=rng.normal(size=(states, 1)),
        Bw=np.hstack([rng.normal(size=(states, 1)), np.zeros((states, 3))]),
        Dw=np.hstack([np.zeros((3, 1)), 0.1 * np.eye(3)]),
        dt=dt,
    )


CASES = {
    "random walk": (WALK, {"delay": 2}),
    "4 states": (random_plant(0, 4), {"delay": 1}),
    "8 states": (random_plant(1, 8), {"delay": 1}),
    "continuous": (random_plant(3, 4, 0.0), {"reference": {"bandwidth": 5.0}}),
    "matching": (random_plant(4, 3), {"reference": {"bandwidth": 0.5}, "exact": False}),
}


# Whether the solver's last digits do is the processor's affair: what it found is compared.
@pytest.mark.one_in(4)
@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize("norm", ["hinf", "h2"])
@pytest.mark.parametrize("name", CASES)
def test_inequality_and_riccati_equation_agree(name: str, norm: str) -> None:
    plant, options = CASES[name]
    if norm == "h2" and not plant.is_discrete:
        with pytest.raises(obsynth.SpecError, match="discrete time"):
            conditions.h2_filter(plant, **options)
        return
    front = obsynth.optimal_filter(plant, norm=norm, **options)
    found = (conditions.hinf_filter if norm == "hinf" else conditions.h2_filter)(plant, **options)
    value = found.problem.solve(solver="CLARABEL")
    assert found.existence.passed
    assert found.data["unit"][0, 0] * np.sqrt(value) == pytest.approx(front.gain, rel=3e-5)
    design = obsynth.OptimalFilter.of(found.design(name="by hand"))
    assert design.report.passed
    # No filter is below the least of the other route.
    assert front.least * (1.0 - 1e-8) <= design.gain <= front.gain * (1.0 + 1e-5)
    assert design.least == pytest.approx(front.least, rel=1e-6)


@pytest.mark.long
def test_gains_are_those_of_the_innovation_and_may_be_worse() -> None:
    """Another constraint on Z0 gives a filter with a larger gain, which is what its design claims."""
    plant, options = CASES["4 states"]
    found = conditions.hinf_filter(plant, **options)
    found.problem.solve(solver="CLARABEL")
    gains = found.gains()
    assert gains["K"].shape == (len(found.data["A"]), len(found.data["C"]))
    least = obsynth.optimal_filter(plant, **options).gain
    changed = found.changed(constraints={"no Z0": found.variables["Z0"] == 0.0})
    changed.problem.solve(solver="CLARABEL")
    design = obsynth.OptimalFilter.of(changed.design())
    assert design.report.passed
    assert design.gain > 1.01 * least
    assert design.least <= least
    small = found.changed(
        constraints={"level": found.variables["gamma_squared"] <= 1.2**2 * changed.problem.value},
        objective=cp.norm(found.variables["Y"], "fro"),
    )
    small.problem.solve(solver="CLARABEL")
    assert small.design().report.passed


def test_what_leaves_nothing_to_choose_or_does_not_exist_is_refused() -> None:
    one = obsynth.DescriptorSystem(A=[[2.0]], C=[[1.0]], Bf=[[1]], Bw=[[1, 0]], Dw=[[0, 1]], dt=1.0)
    with pytest.raises(obsynth.SpecError, match="nothing to choose"):
        conditions.hinf_filter(one, delay=1)
    with pytest.raises(obsynth.PreconditionError, match="delay"):
        conditions.hinf_filter(one, delay=0)
    with pytest.raises(obsynth.SpecError, match="not stable"):
        conditions.hinf_filter(WALK, reference=([[2.0]], [[1.0]], [[1.0]], [[0.0]]))
    with pytest.raises(obsynth.SpecError, match="wind"):
        conditions.h2_filter(WALK, decoupled="wind")
