"""Random plants with unknown inputs: the verdict against brute force, placed poles, estimates that do not see d."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from ui_pi_plants import KINDS, Case, brute_force, exosystem_of, random_case

from obsynth import PreconditionError, SolverError, VerificationError, ui_pi_observer
from obsynth.analysis.existence.sharepasand import existence
from obsynth.plants.faults import exosystem

BATCHES, SIZE = 16, 24
Share = Callable[..., Sequence[Any]]
ALL = range(BATCHES * SIZE)


def batch(number: int) -> list[tuple[int, Case]]:
    return [(seed, random_case(seed)) for seed in range(number * SIZE, (number + 1) * SIZE)]


def decided(case: Case) -> bool:
    model = exosystem(case.model, case.plant.fault_names, case.plant.dt)
    return all(condition.holds for condition in existence(case.plant, model).conditions)


# Eight kinds of plants come in turn: an odd number of parts leaves each of them in a share.
@pytest.mark.one_in(4)
@pytest.mark.parametrize("number", range(BATCHES))
def test_the_verdict_is_that_of_the_pencil(number: int, share: Share) -> None:
    for seed, case in share(batch(number), 7):
        assert decided(case) == brute_force(case)[0], (seed, case.kind, case.model)


@pytest.mark.long
def test_every_kind_of_plant_is_there_with_both_verdicts() -> None:
    found = Counter((case.kind, brute_force(case)[0]) for case in map(random_case, ALL))
    assert {kind for kind, _ in found} == set(KINDS)
    for kind in ("undecouplable", "masked"):
        assert min(found[kind, True], found[kind, False]) >= 15, found
    assert found["fixed unstable", False] >= 30
    assert min(found[kind, True] for kind in ("generic", "direct", "fixed stable", "index 2", "not regular")) >= 30


@pytest.mark.parametrize("number", range(BATCHES))
def test_fixed_modes_are_the_drops_of_the_pencil(number: int, share: Share) -> None:
    for seed, case in share(batch(number), 7):
        exists, drops = brute_force(case)
        if exists:
            model = exosystem(case.model, case.plant.fault_names, case.plant.dt)
            fixed = existence(case.plant, model).fixed_modes
            for value in fixed:
                assert np.min(np.abs(drops - value), initial=np.inf) < 1e-5, (seed, fixed, drops)
            for value in drops:
                assert np.min(np.abs(fixed - value), initial=np.inf) < 1e-5, (seed, fixed, drops)


def wanted_poles(count: int, seed: int, dt: float) -> list[float]:
    """Real poles, the first three of them equal."""
    rates = np.random.default_rng(seed).uniform(0.5, 3.0, count)
    rates[:3] = rates[0] if count else rates[:3]
    return list(np.exp(-rates * dt)) if dt else list(-rates)


def group_means(poles: np.ndarray, wanted: list[float]) -> float:
    """Return the largest miss of a single pole, or of the mean of the three nearest to the triple one."""
    triple, rest = (wanted[0], wanted[3:]) if len(wanted) >= 3 else (None, wanted)
    left = list(poles)
    worst = 0.0
    for pole in rest:
        nearest = min(left, key=lambda value: abs(value - pole))
        left.remove(nearest)
        worst = max(worst, abs(nearest - pole) / abs(pole))
    if triple is not None:
        near = sorted(left, key=lambda value: abs(value - triple))[:3]
        worst = max(worst, abs(np.mean(near) - triple) / abs(triple))
    return worst


@pytest.mark.long
def test_repeated_poles_are_placed_or_refused(share: Share) -> None:
    """Some pairs are so close to unobservable ones that double precision cannot place a triple pole: few, and told."""
    placed, refused, seeds = 0, [], share(range(0, BATCHES * SIZE, 3), 14)
    for seed in seeds:
        case = random_case(seed)
        if not brute_force(case)[0]:
            continue
        model = exosystem(case.model, case.plant.fault_names, case.plant.dt)
        found = existence(case.plant, model)
        count = found.plant.nx + model.order - len(found.fixed_modes)
        poles = wanted_poles(count, seed, case.plant.dt)
        try:
            design = ui_pi_observer(case.plant, fault_model=case.model, poles=poles)
        except (SolverError, VerificationError):
            refused.append(seed)
            continue
        placed += 1
        assert group_means(np.linalg.eigvals(design.observer.Az), poles) < 1e-2, seed
        assert design.report["poles"].value < 1e-4, seed
    assert placed >= 0.66 * len(seeds)
    assert len(refused) <= 0.04 * len(seeds), refused


@pytest.mark.one_in(4)
@pytest.mark.parametrize("number", range(0, BATCHES, 2))
def test_default_designs_see_no_disturbance(number: int, share: Share) -> None:
    """Trajectories ``(x, d) e^{st}`` of the plant, at points that no grid of ours holds, give exact estimates."""
    rng = np.random.default_rng(number)
    refused = []
    for seed, case in share(batch(number), 9):
        if not brute_force(case)[0]:
            continue
        try:
            design = ui_pi_observer(case.plant, fault_model=case.model)
        except VerificationError:
            refused.append(seed)
            continue
        plant, observer = design.plant, design.observer
        for frequency in rng.uniform(0.01, 5.0, 3):
            point = np.exp(1j * frequency * plant.dt) if plant.dt else 1j * frequency
            null = scipy.linalg.null_space(np.hstack([point * plant.E - plant.A, -plant.Bd]))
            x, d = null[: plant.nx], null[plant.nx :]
            y = plant.C @ x + plant.Dd @ d
            z = np.linalg.solve(point * np.eye(observer.order) - observer.Az, observer.By @ y)
            estimates = observer.Cz @ z + observer.Dy @ y
            size = 1.0 + np.max(np.abs(observer.Dy)) + np.max(np.abs(z), initial=0.0)
            np.testing.assert_allclose(estimates[: plant.nx], x, rtol=0.0, atol=1e-8 * size, err_msg=str(seed))
            np.testing.assert_allclose(estimates[plant.nx :], 0.0, rtol=0.0, atol=1e-8 * size, err_msg=str(seed))
    assert len(refused) <= 1, refused


@pytest.mark.long
def test_the_failing_condition_is_raised_with_its_mode_and_signals(share: Share) -> None:
    seen, seeds = Counter(), share(ALL, 3)
    for seed in seeds:
        case = random_case(seed)
        if case.kind not in ("masked", "fixed unstable", "undecouplable") or brute_force(case)[0]:
            continue
        with pytest.raises(PreconditionError) as caught:
            ui_pi_observer(case.plant, fault_model=case.model)
        error = caught.value
        seen[case.kind, error.condition.split(")")[0]] += 1
        if case.kind == "fixed unstable" and error.condition.startswith("(D2"):
            assert error.mode == pytest.approx(1.2 if case.plant.dt else 0.3, rel=1e-6), seed
        if case.kind == "masked" and error.condition.startswith("(D3"):
            phi, _ = exosystem_of(case.model, 1, case.plant.dt)
            assert np.min(np.abs(np.linalg.eigvals(phi) - error.mode)) < 1e-4, seed
            assert "f1" in error.signals, seed
        assert error.signals, seed
    part = len(seeds) / len(ALL)
    assert seen["masked", "(D3"] >= 15 * part
    assert seen["fixed unstable", "(D2"] >= 30 * part
    assert seen["undecouplable", "(D1"] >= 15 * part
