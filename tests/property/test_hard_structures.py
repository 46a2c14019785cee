"""Plants of up to 49 states whose structure is hard on numerics: each gets a filter with a report that passes."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import block_diag

import obsynth
from plants import orthogonal


def described(rng: np.random.Generator, a: np.ndarray, *, ny: int, nf: int = 2, singular: int = 0) -> dict:
    """Return a plant with these dynamics, random faults, outputs and disturbances, and E of rank nx - singular."""
    nx = len(a)
    hidden = rng.normal(size=(nx, singular))
    return {
        "E": np.eye(nx) - hidden @ np.linalg.pinv(hidden) if singular else None,
        "A": a,
        "C": rng.normal(size=(ny, nx)) / np.sqrt(nx),
        "Bf": rng.normal(size=(nx, nf)),
        "Bd": 0.3 * rng.normal(size=(nx, 2)),
    }


def in_other_units(rng: np.random.Generator, plant: dict, most: float) -> dict:
    """Return the plant with each state, equation, output, fault and disturbance in a unit of its own."""
    rows, states = (most ** rng.uniform(-1.0, 1.0, len(plant["A"])) for _ in range(2))
    outputs = most ** rng.uniform(-1.0, 1.0, len(plant["C"]))
    e = np.eye(len(states)) if plant["E"] is None else plant["E"]
    return {
        "E": rows[:, None] * e * states,
        "A": rows[:, None] * plant["A"] * states,
        "C": outputs[:, None] * plant["C"] * states,
        **{
            name: rows[:, None] * plant[name] * most ** rng.uniform(-1.0, 1.0, plant[name].shape[1])
            for name in ("Bf", "Bd")
        },
    }


def spread(rng: np.random.Generator, radius: float, nx: int) -> np.ndarray:
    a = rng.normal(size=(nx, nx))
    return a * radius / np.max(np.abs(np.linalg.eigvals(a)))


def jordan_blocks(rng: np.random.Generator) -> dict:
    sizes = rng.integers(1, 6, 6)
    values = rng.choice([0.9999, 0.0, 1.0, -0.5, 0.9], 6)
    a = block_diag(*(value * np.eye(n) + np.eye(n, k=1) for value, n in zip(values, sizes, strict=True)))
    v = orthogonal(rng, len(a)) * 2.0 ** rng.uniform(-1.0, 1.0, len(a))
    return described(rng, v @ a @ np.linalg.inv(v), ny=len(a) // 2 + 2, singular=int(rng.integers(0, 2)))


def barely_stable_oscillators(rng: np.random.Generator) -> dict:
    radii, angles = rng.choice([0.9999, 0.99999, 1.0, 0.995], 12), np.sort(rng.uniform(0.01, 3.0, 12))
    a = block_diag(
        *(r * np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]) for r, t in zip(radii, angles, strict=True))
    )
    v = orthogonal(rng, 24)
    return described(rng, v @ a @ v.T, ny=4, nf=1)


def grid_of_nodes(rng: np.random.Generator) -> dict:
    path = np.diag(np.r_[1.0, 2.0 * np.ones(5), 1.0]) - np.eye(7, k=1) - np.eye(7, k=-1)
    a = np.eye(49) - 0.1 * (np.kron(path, np.eye(7)) + np.kron(np.eye(7), path))
    nodes = rng.permutation(49)
    measured, driven = np.eye(49)[nodes[:6]], np.eye(49)[:, nodes[6:8]]
    return {"E": None, "A": a, "C": measured, "Bf": np.eye(49)[:, nodes[:1]], "Bd": driven}


def chains_of_integrators(rng: np.random.Generator) -> dict:
    a = block_diag(*[np.eye(6) + 0.1 * np.eye(6, k=1)] * 5)
    firsts = np.eye(30)[::6]
    c = np.vstack([firsts, np.eye(30)[rng.permutation(30)[:2]] + 1e-3])
    return {"E": None, "A": a, "C": c, "Bf": np.eye(30)[:, [0]], "Bd": np.eye(30)[:, [5]]}


def few_outputs_of_an_unstable_plant(rng: np.random.Generator) -> dict:
    return described(rng, spread(rng, 2.5, 26), ny=5, singular=2)


def in_very_bad_units(rng: np.random.Generator) -> dict:
    nx = int(rng.integers(5, 40))
    plant = described(rng, spread(rng, 1.1, nx), ny=3 + nx // 4, singular=int(rng.integers(0, 3)))
    return in_other_units(rng, plant, 1e6)


def many_faults(rng: np.random.Generator) -> dict:
    return described(rng, spread(rng, 1.1, 30), ny=7, nf=6, singular=2)


def hardly_different_faults(rng: np.random.Generator) -> dict:
    plant = described(rng, spread(rng, 1.1, 12), ny=5)
    plant["Bf"][:, 1] = plant["Bf"][:, 0] + 1e-5 * plant["Bf"][:, 1]
    return plant


def hardly_visible_fault(rng: np.random.Generator, share: float = 1e-4, nx: int = 13) -> dict:
    plant = described(rng, spread(rng, 1.1, nx), ny=5)
    c, f = plant["C"], plant["Bf"][:, 0]
    plant["Bf"][:, 0] = f - np.linalg.pinv(c) @ (c @ f - share * rng.normal(size=5))
    return plant


def equal_disturbances_in_the_sensors_too(rng: np.random.Generator) -> dict:
    plant = described(rng, spread(rng, 1.1, 15), ny=6, singular=2)
    once = rng.normal(size=(6, 2))
    return {**plant, "Bd": np.hstack([plant["Bd"]] * 2), "Dd": np.hstack([once] * 2)}


STRUCTURES: dict[Callable[[np.random.Generator], dict], int] = {
    jordan_blocks: 4,
    barely_stable_oscillators: 2,
    grid_of_nodes: 2,
    chains_of_integrators: 4,
    few_outputs_of_an_unstable_plant: 4,
    in_very_bad_units: 8,
    many_faults: 3,
    hardly_different_faults: 4,
    hardly_visible_fault: 4,
    equal_disturbances_in_the_sensors_too: 2,
}


DROWNED = "Unclear: gains were found, but they are so large"
#: Where a filter of the equations exists, but rounding of its data would drown the fault, and the refusal says so.
AT_THE_LIMIT = {hardly_visible_fault: (DROWNED,)}


@pytest.mark.parametrize("structure", STRUCTURES, ids=lambda structure: structure.__name__)
def test_a_filter_is_found_and_proved(structure, share):
    failures = []
    for seed in share(range(STRUCTURES[structure]), 4):
        plant = obsynth.DescriptorSystem(**structure(np.random.default_rng([49, seed])), dt=0.1)
        try:
            passed = obsynth.fault_estimation_filter(plant).report.passed
        except obsynth.ObsynthError as error:
            passed = f"{type(error).__name__}: {error}"
        told = structure in AT_THE_LIMIT and any(text in str(passed) for text in AT_THE_LIMIT[structure])
        if passed is not True and not told:
            failures.append((seed, passed))
    assert failures == []


@pytest.mark.parametrize("engine", ["riccati", "lmi"])
def test_a_start_that_is_best_already(engine):
    plant = obsynth.DescriptorSystem(
        E=None, A=np.diag([0.5, 0.4]), C=np.eye(2), Bf=[[1.0], [0.0]], Bd=[[1.0], [0.0]], dt=1.0
    )
    design = obsynth.fault_estimation_filter(plant, engine=engine)
    assert design.certificate.claims["gamma_min"] == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_a_fault_that_hardly_shows_is_blamed_for_what_cannot_be_done(seed):
    plant = hardly_visible_fault(np.random.default_rng([50, seed]), share=1e-8, nx=12)
    with pytest.raises(obsynth.ObsynthError, match=r"outputs (very )?little within its delay"):
        obsynth.fault_estimation_filter(obsynth.DescriptorSystem(**plant, dt=0.1))
