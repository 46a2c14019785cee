"""Random plants for the PD observer, solvable by construction: Theorem 1 has a solution exactly when they say so.

``(A, C)`` is detectable because the hidden block, which the outputs do not see, is stable and everything else is
generic; ``rank [A F; C Df]`` is full because the zeros, where a square plant has any, are random numbers.  The tests
check both facts again, by singular values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag

import obsynth


@dataclass(frozen=True)
class Recipe:
    """What a random plant is made of; all numbers are drawn from the given generator."""

    nx: int
    ny: int
    nf: int
    sensor_faults: int = 0
    hidden: tuple[complex, ...] = ()
    radius: float = 2.0
    spread: float = 1.0
    units: float = 1.0
    time_unit: float = 1.0
    algebraic: int = 0
    feedthrough: bool = False
    disturbances: int = 0
    noise: int = 0
    chain: bool = False


def random_recipe(rng: np.random.Generator, **fixed: Any) -> Recipe:
    """Return a recipe with random sizes; ``fixed`` entries are taken as given."""
    nx = fixed.pop("nx", int(rng.integers(2, 8)))
    hidden = fixed.get("hidden", ())
    ny = fixed.pop("ny", int(rng.integers(1, min(nx, 4) + 1)))
    nf = fixed.pop("nf", int(rng.integers(1, min(nx, ny) + 1)))
    return Recipe(nx=nx + len(hidden), ny=ny, nf=nf, **fixed)


def real_blocks(values: tuple[complex, ...]) -> np.ndarray:
    """Return a real block-diagonal matrix with these eigenvalues; a complex one stands for its pair."""
    parts = [[[v.real, v.imag], [-v.imag, v.real]] if complex(v).imag else [[complex(v).real]] for v in values]
    return np.asarray(block_diag(*parts)) if parts else np.zeros((0, 0))


def build(rng: np.random.Generator, recipe: Recipe) -> obsynth.DescriptorSystem:
    """Return the plant of a recipe."""
    hidden = real_blocks(recipe.hidden)
    count = len(hidden)
    seen = recipe.nx - len(recipe.hidden)
    nx, ny = seen + count, recipe.ny
    own = rng.normal(size=(seen, seen)) * recipe.radius / np.sqrt(seen)
    if recipe.chain:
        own = np.diag(np.ones(seen - 1), 1)
    if recipe.spread > 1.0:
        rates = recipe.spread ** rng.uniform(-1.0, 1.0, seen)
        own = own * np.sqrt(np.outer(rates, rates))
    a = np.zeros((nx, nx))
    a[:seen, :seen], a[seen:, seen:] = own, hidden
    a[seen:, :seen] = rng.normal(size=(count, seen))  # the hidden part is driven, and shows nowhere
    c = np.hstack([rng.normal(size=(ny, seen)), np.zeros((ny, count))])
    if recipe.chain:
        c = np.zeros((ny, nx))
        c[0, 0] = 1.0
        c[1:, :seen] = rng.normal(size=(ny - 1, seen))
    bf, df = rng.normal(size=(nx, recipe.nf)), np.zeros((ny, recipe.nf))
    if recipe.chain:
        bf = np.zeros((nx, recipe.nf))
        bf[seen - 1, 0] = 1.0
        bf[:seen, 1:] = rng.normal(size=(seen, recipe.nf - 1))
    for i in range(recipe.sensor_faults):
        bf[:, i], df[:, i] = 0.0, rng.normal(size=ny)
    data: dict[str, np.ndarray] = {
        "A": a, "B": rng.normal(size=(nx, 1)), "C": c, "Bf": bf, "Df": df,
        "D": rng.normal(size=(ny, 1)) if recipe.feedthrough else np.zeros((ny, 1)),
        "Bd": rng.normal(size=(nx, recipe.disturbances)),
        "Dd": rng.normal(size=(ny, recipe.disturbances)) if recipe.feedthrough else np.zeros((ny, recipe.disturbances)),
        "Bw": 0.01 * rng.normal(size=(nx, recipe.noise)), "Dw": 0.01 * rng.normal(size=(ny, recipe.noise)),
    }  # fmt: skip
    change = np.linalg.qr(rng.normal(size=(nx, nx)))[0]
    data = transformed(data, np.eye(nx) if recipe.chain else change)
    for name in ("A", "B", "Bf", "Bd", "Bw"):
        data[name] = data[name] / recipe.time_unit
    data = in_units(rng, data, recipe.units)
    return with_algebraic_states(rng, data, recipe.algebraic)


def transformed(data: Mapping[str, np.ndarray], change: np.ndarray) -> dict[str, np.ndarray]:
    """Return the plant in the coordinates ``x = change z`` (orthogonal)."""
    found = dict(data)
    for name in ("A", "B", "Bf", "Bd", "Bw"):
        found[name] = change.T @ data[name]
    found["A"], found["C"] = found["A"] @ change, data["C"] @ change
    return found


def in_units(rng: np.random.Generator, data: Mapping[str, np.ndarray], most: float) -> dict[str, np.ndarray]:
    """Return the plant with states, outputs and faults in units that differ by up to ``most`` either way."""
    if most == 1.0:
        return dict(data)
    nx, ny, nf = len(data["A"]), len(data["C"]), data["Bf"].shape[1]
    states, outputs, faults = (most ** rng.uniform(-1.0, 1.0, size) for size in (nx, ny, nf))
    found = dict(data)
    for name in ("A", "B", "Bf", "Bd", "Bw"):
        found[name] = found[name] / states[:, None]
    for name in ("C", "D", "Df", "Dd", "Dw"):
        found[name] = found[name] * outputs[:, None]
    for name in ("A", "C"):
        found[name] = found[name] * states
    for name in ("Bf", "Df"):
        found[name] = found[name] * faults
    return found


def with_algebraic_states(
    rng: np.random.Generator, data: Mapping[str, np.ndarray], count: int
) -> obsynth.DescriptorSystem:
    """Return the plant with algebraic states that follow the others, mixed into one singular pencil of index 1."""
    if not count:
        return obsynth.DescriptorSystem(None, **data)
    nx = len(data["A"])
    total = nx + count
    e = np.zeros((total, total))
    e[:nx, :nx] = np.eye(nx)
    a = np.zeros((total, total))
    a[:nx, :nx] = data["A"]
    a[nx:, :nx], a[nx:, nx:] = rng.normal(size=(count, nx)), -np.eye(count) + 0.2 * rng.normal(size=(count, count))
    rows, columns = (np.linalg.qr(rng.normal(size=(total, total)))[0] for _ in range(2))
    found = {
        name: rows @ np.vstack([data[name], np.zeros((count, data[name].shape[1]))]) for name in ("B", "Bf", "Bd", "Bw")
    }
    found |= {name: data[name] for name in ("D", "Df", "Dd", "Dw")}
    found["C"] = np.hstack([data["C"], np.zeros((len(data["C"]), count))]) @ columns
    return obsynth.DescriptorSystem(rows @ e @ columns, rows @ a @ columns, **found)
