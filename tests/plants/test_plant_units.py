"""What is said of a plant does not hang on the units of its states, equations, signals and time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import obsynth
from obsynth.plants.plant_units import PlantUnits

#: Units are two to a whole number up to this: nothing is rounded.
FARTHEST = 20


def random_plant(seed: int) -> obsynth.DescriptorSystem:
    """Return a plant of short numbers, often with hidden modes, integrators and an algebraic state."""
    rng = np.random.default_rng([91, seed])
    n, ny, nf, nd = (int(rng.integers(*ends)) for ends in ((2, 7), (1, 4), (1, 3), (0, 2)))
    a = np.round(rng.normal(size=(n, n)) * (rng.uniform(size=(n, n)) < 0.6), 2)
    a -= np.diag(np.round(rng.uniform(0.0, 2.0, n), 1))
    e, c = np.eye(n), np.round(rng.normal(size=(ny, n)), 2)
    if rng.uniform() < 0.4:
        e[-1, -1] = 0.0
    if rng.uniform() < 0.5:
        seen = int(rng.integers(1, n))
        a[:seen, seen:], c[:, seen:] = 0.0, 0.0
    if rng.uniform() < 0.3:
        a[:, 0] = 0.0
    b = [np.round(rng.normal(size=(n, count)), 1) for count in (nf, nd)]
    dt = 0.0 if seed % 2 else 0.1
    return obsynth.DescriptorSystem(e, 0.5 * a if dt else a, C=c, Bf=b[0], Bd=b[1], dt=dt)


def in_other_units(plant: obsynth.DescriptorSystem, seed: int) -> tuple[obsynth.DescriptorSystem, float]:
    """Return a plant in units that are powers of two, and what its eigenvalues are multiplied by."""
    rng = np.random.default_rng([5, seed])

    def units(count: int) -> np.ndarray:
        return np.exp2(rng.integers(-FARTHEST, FARTHEST + 1, count).astype(float))

    rate = 1.0 if plant.is_discrete else float(units(1)[0])
    rows, states, outputs, faults, unknown = map(units, (plant.nx, plant.nx, plant.ny, plant.nf, plant.nd))
    moved, shown = rate * rows[:, None], outputs[:, None]
    changed = plant.replace(
        E=rows[:, None] * plant.E * states, A=moved * plant.A * states, C=shown * plant.C * states,
        Bf=moved * plant.Bf * faults, Bd=moved * plant.Bd * unknown,
    )  # fmt: skip
    return changed, rate


#: Two roundings to double precision.
LAST_DIGIT = 4.0 * np.finfo(float).eps
CASES = pytest.mark.parametrize("seed", range(40))


@CASES
def test_natural_units_make_the_same_plant_of_any(seed: int) -> None:
    plant = random_plant(seed)
    natural = [PlantUnits.of(own).rounded().scaled_plant(own) for own in (plant, in_other_units(plant, seed)[0])]
    for name in ("E", "A", "C", "Bf", "Bd"):
        np.testing.assert_array_equal(*(getattr(own, name) for own in natural), err_msg=name)


def facts(found: obsynth.types.Structure) -> Iterator[object]:
    yield from (found.regular, found.index, found.infinite_block_sizes, found.stable, found.admissible)
    yield from (found.observability_normal_rank, found.finitely_observable, found.detectable)
    yield from (found.impulse_observable, found.causally_observable)
    yield from (decision.rank for decision in found.decisions.values())
    yield from (decision.clear for decision in found.decisions.values())


@pytest.mark.one_in(4)
@CASES
def test_structure_does_not_hang_on_units(seed: int) -> None:
    plant = random_plant(seed)
    other, rate = in_other_units(plant, seed)
    first, second = obsynth.analyse_structure(plant), obsynth.analyse_structure(other)
    assert list(facts(first)) == list(facts(second))
    for name in ("finite_eigenvalues", "unobservable_modes", "undetectable_modes"):
        here, there = (np.asarray(getattr(found, name)) for found in (first, second))
        # Those found exactly are rounded for printing, each in its own unit of time.
        np.testing.assert_allclose(rate * here, there, rtol=LAST_DIGIT, atol=0.0, err_msg=name)


@pytest.mark.parametrize("seed", range(12))
def test_elimination_does_not_hang_on_units(seed: int) -> None:
    # In units that differ by a million E looked singular, and the plant was refused as one of index 3.
    rng = np.random.default_rng([54, seed])
    e = np.eye(6) + np.diag(np.round(rng.uniform(-0.5, 0.5, 5), 2), 1)
    a = np.round(rng.normal(size=(6, 6)) * (rng.uniform(size=(6, 6)) < 0.6), 2)
    a[-1, -1] = 1.0
    if seed % 2:
        e[-1, -1] = 0.0
    plant = obsynth.DescriptorSystem(e, a, C=np.eye(1, 6), Bf=np.eye(6, 1))
    found = [obsynth.eliminate_algebraic_states(own).plant for own in (plant, in_other_units(plant, seed)[0])]
    assert found[0].nx == found[1].nx


@pytest.mark.one_in(4)
@pytest.mark.parametrize("seed", [0, 33, 46, 57, 59])
def test_whether_a_fault_shows_does_not_hang_on_units(seed: int) -> None:
    # Of a stiff plant in other units it was said that the fault reaches no output, that another T be given, or that
    # LAPACK gave up.
    stiff = obsynth.DescriptorSystem(
        A=[[0, -0.0013, 0.0015, 0, 0], [0, -0.022, 0.041, 0, 0], [0, 0, -0.59, 0, 0],
           [0, 0, -0.75, -0.48, -0.08], [0, 0, 0.0032, 0, -0.0057]],
        C=[[-0.71, -0.33, 0.03, 0, 1.62], [1.87, 0, 1.65, -0.81, 1.24], [1.58, 1.08, 0, -0.17, 0]],
        Bf=[[0], [-0.49], [-0.06], [0], [-0.51]],
        Bd=[[-0.42, 0.9], [1.16, 0], [-1.13, -2.77], [0, 0.28], [-0.02, 1.72]], dt=0.1,
    )  # fmt: skip
    plant = in_other_units(stiff, seed)[0]
    # Entries that are no short decimals: what shows is decided in floating point.
    assert obsynth.fault_estimation_filter(plant.replace(A=plant.A * (1.0 + 1e-15))).report.passed


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_fault_in_thousands_beside_one_in_millionths(dt: float) -> None:
    # What rounding leaves of the gain from the other fault was judged in units of neither: refused by verification.
    rng = np.random.default_rng(1)
    a = np.round(0.4 * rng.normal(size=(3, 3)), 2) - (0.0 if dt else 1.0) * np.eye(3)
    faults = np.array([2.0**18, 2.0**-12])
    plant = obsynth.DescriptorSystem(
        None, a, C=np.round(rng.normal(size=(3, 3)), 2), Bf=np.round(rng.normal(size=(3, 2)), 1) * faults,
        Dw=0.1 * np.eye(3), dt=dt,
    )  # fmt: skip
    assert obsynth.functional_filter(plant).report.passed


def test_an_integrator_that_no_noise_drives_is_named_in_any_unit() -> None:
    # Of numbers that nobody wrote so the zero was left to the Riccati equation, which ended in an error of the solver.
    plant = obsynth.DescriptorSystem(
        None, [[0.0, -0.83, 0.0], [0.0, -1.2, 0.3], [0.0, 0.76, -1.0]], C=[[-1.27, 0.14, 1.36], [0.24, -1.64, 1.22]],
        Bf=[[1.0], [0.5], [0.2]], Dw=np.diag([0.3, 0.02]),
    )  # fmt: skip
    states = 2.0 ** np.array([13, -7, 4])
    other = plant.replace(E=np.diag(states), A=plant.A * states, C=plant.C * states)
    for given in (plant, other, plant.replace(A=plant.A / 3.0)):
        with pytest.raises(obsynth.PreconditionError) as caught:
            obsynth.detection_filter(given)
        assert (caught.value.condition, caught.value.mode) == ("zeros of the unknown inputs", 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_what_rounding_left_of_rounding_does_not_count_in_the_units(seed: int) -> None:
    """Elimination leaves entries of 1e-33 and less where a network has none: they made units of 1e38 of 565 states."""
    rng = np.random.default_rng([38, seed])
    n = 12
    links = np.diag(-rng.uniform(0.5, 2.0, n)) + np.diag(rng.uniform(0.5, 2.0, n - 1), -1)
    links[0, -1] = 1.0
    left = np.where((links == 0.0) & (rng.uniform(size=(n, n)) < 0.5), 10.0 ** rng.uniform(-44, -33, (n, n)), 0.0)
    c = np.eye(1, n)
    own = in_other_units(obsynth.DescriptorSystem(A=links, C=c), seed)[0]
    disturbed = in_other_units(obsynth.DescriptorSystem(A=links + left, C=c), seed)[0]
    units, same = PlantUnits.of(disturbed), PlantUnits.of(own)
    assert np.max(np.abs(np.log2(units.states / same.states))) < 1e-6
    assert units.spread < 1e4 * max(1.0, same.spread)
