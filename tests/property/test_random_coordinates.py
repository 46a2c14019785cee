"""Existence, indexes and zeros belong to the plant, not to its coordinates or units; planted zeros are found."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import obsynth
from obsynth.analysis.zeros import fault_zeros
from obsynth.methods.designing import check
from obsynth.methods.registry import method_class
from plants import Recipe, build, random_recipe, well_conditioned, with_conjugates

SEEDS = st.integers(0, 2**32 - 1)
METHOD = "fault-estimation-filter"
KINDS = st.sampled_from([
    {}, {"sensor_faults": 1}, {"explicit": True, "singularity": 0}, {"index_two": True}, {"feedthrough": True},
    {"hidden_modes": (0.5,)}, {"square": True},
    {"indexes": (1,), "zeros": (1.3,)}, {"indexes": (2,), "zeros": (-1.1, 0.4)}, {"hidden_modes": (1.2,)},
])  # fmt: skip


def transformed(plant, *, equations=None, states=None, outputs=None):
    """Return the plant with its equations, states (x = S z) and outputs changed."""
    rows = np.eye(plant.nx) if equations is None else equations
    change = np.eye(plant.nx) if states is None else states
    seen = np.eye(plant.ny) if outputs is None else outputs
    return plant.replace(
        E=rows @ plant.E @ change, A=rows @ plant.A @ change, C=seen @ plant.C @ change,
        **{name: rows @ getattr(plant, name) for name in ("B", "Bf", "Bd", "Bw")},
        **{name: seen @ getattr(plant, name) for name in ("D", "Df", "Dd", "Dw")},
    )  # fmt: skip


def verdict(plant):
    """Return whether a filter exists, and the name of the first condition that fails: of this method alone."""
    conditions = method_class(METHOD)().existence(plant)
    return all(row.holds for row in conditions), [row.name for row in conditions if not row.holds]


def indexes(plant):
    """Return the detectability indexes as the condition states them."""
    conditions = method_class(METHOD)().existence(plant)
    return [row.detail for row in conditions if row.name == "finite detectability indexes"]


def same_values(found, expected, tolerance):
    """Pair two sets of complex numbers by nearest neighbour."""
    left = list(map(complex, found))
    assert len(left) == len(expected), (found, expected)
    for value in expected:
        nearest = min(left, key=lambda other: abs(other - value))
        assert abs(nearest - value) <= tolerance * max(1.0, abs(value)), (found, expected)
        left.remove(nearest)


@given(SEEDS, KINDS)
def test_structure_does_not_depend_on_coordinates(seed, kind):
    rng = np.random.default_rng(seed)
    known = build(rng, random_recipe(rng, **{"largest": 8, **kind}))
    plant = known.plant
    original, zeros = verdict(plant), [zero.value for zero in fault_zeros(plant)[0]]
    report = check(plant)[METHOD]
    assert original == (report.passed, [row.name.removeprefix("exists: ") for row in report.failures])
    exists = all(abs(zero) < 1.0 for zero in known.zeros)
    assert original[0] is exists
    # Zeros of a random set may nearly coincide, and then move by the root of the rounding errors.
    same_values(zeros, known.zeros, 1e-4)
    changes = {
        "equations": well_conditioned(rng, plant.nx, spread=10.0),
        "states": well_conditioned(rng, plant.nx, spread=10.0),
        "outputs": well_conditioned(rng, plant.ny, spread=10.0),
    }
    for names in (("equations",), ("states",), ("outputs",), tuple(changes)):
        other = transformed(plant, **{name: changes[name] for name in names})
        assert verdict(other) == original
        assert indexes(other) == indexes(plant)
        same_values([zero.value for zero in fault_zeros(other)[0]], known.zeros, 1e-4)


@pytest.mark.long
@given(SEEDS)
def test_designs_exist_in_all_coordinates(seed):
    rng = np.random.default_rng(seed)
    known = build(rng, random_recipe(rng, largest=7))
    other = transformed(
        known.plant,
        equations=well_conditioned(rng, known.plant.nx, spread=10.0),
        states=well_conditioned(rng, known.plant.nx, spread=10.0),
        outputs=well_conditioned(rng, known.plant.ny, spread=10.0),
    )
    for plant in (known.plant, other):
        design = obsynth.fault_estimation_filter(plant)
        assert design.report.passed
        assert design.observer.fault_delays == known.indexes


@pytest.mark.long
@given(SEEDS, KINDS, st.sampled_from([1e3, 1e-3]))
def test_units_do_not_flip_the_verdict(seed, kind, factor):
    rng = np.random.default_rng(seed)
    known = build(rng, random_recipe(rng, **{"largest": 7, "nu": 2, **kind}))
    plant = known.plant
    one_output = np.ones(plant.ny)
    one_output[rng.integers(plant.ny)] = factor
    variants = [
        plant.replace(B=factor * plant.B, D=factor * plant.D),
        transformed(plant, outputs=factor * np.eye(plant.ny)),
        transformed(plant, outputs=np.diag(one_output)),
    ]
    exists = verdict(plant)
    for other in variants:
        assert verdict(other) == exists
        if exists[0]:
            design = obsynth.fault_estimation_filter(other)
            assert design.report.passed
            assert design.observer.fault_delays == known.indexes


#: Zeros that forbid a filter: on the circle and outside, real and in pairs.
FORBIDDEN = [1.0, -1.0, 1.0001, -1.5, 3.0, complex(0.6, 0.8), complex(1.0, 1.0), complex(-0.2, 1.4)]


@pytest.mark.one_in(4)
@pytest.mark.parametrize("zero", FORBIDDEN)
def test_planted_zero_outside_is_named(zero, share):
    # Each zero begins with another plant, so that the shares of all zeros together have every kind.
    for i in share(np.roll(np.arange(8), FORBIDDEN.index(zero)).tolist(), 3):
        rng = np.random.default_rng([26, FORBIDDEN.index(zero), i])
        pair, sensors = with_conjugates((zero,)), int(i % 4 == 3)
        recipe = Recipe(
            nx=int(rng.integers(5, 11)), ny=3, indexes=[(1,), (2,), (1, 1)][i % 3], zeros=pair,
            singularity=int(rng.integers(0, 4 - sensors)), radius=float(rng.uniform(0.3, 2.0)), sensor_faults=sensors,
        )  # fmt: skip
        known = build(rng, replace(recipe, nx=max(recipe.nx, sum(recipe.indexes) + len(pair) + 3)))
        with pytest.raises(obsynth.PreconditionError) as refusal:
            obsynth.fault_estimation_filter(known.plant)
        assert refusal.value.condition == "fault zeros"
        assert min(abs(refusal.value.mode - value) for value in pair) <= 1e-6
        assert refusal.value.signals
        assert set(refusal.value.signals) <= set(known.plant.fault_names)


@pytest.mark.long
@pytest.mark.parametrize("mode", [1.0, -1.2, 2.0])
def test_hidden_unstable_mode_is_named(mode):
    for i in range(5):
        rng = np.random.default_rng([27, i])
        known = build(rng, random_recipe(rng, hidden_modes=(mode,)))
        with pytest.raises(obsynth.PreconditionError) as refusal:
            obsynth.fault_estimation_filter(known.plant)
        assert refusal.value.condition == "fault zeros"
        assert abs(refusal.value.mode - mode) <= 1e-6
        assert set(refusal.value.signals) <= set(known.plant.state_names)


def test_zeros_just_inside_are_allowed(share):
    for i in share(range(5), 2):
        rng = np.random.default_rng([28, i])
        known = build(rng, random_recipe(rng, zeros=(0.999,), nx=6, ny=2, indexes=(1,)))
        assert obsynth.fault_estimation_filter(known.plant).report.passed
