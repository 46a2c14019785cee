"""Random plants that have a fault-estimation filter (or provably none) by construction.

A plant is built backwards from its error system.  In chain coordinates every fault i owns a chain of ``rho_i`` states
``e_i1 <- e_i2 <- ... <- f_i`` of which the outputs see only the first, so the index is ``rho_i`` and the columns
``C e_i1`` are Upsilon.  On the other states the part of the outputs that no fault moves observes everything except the
planted invariant zeros.  Then everything that leaves indexes and zeros alone is applied at random: output injection,
sensor faults as extra outputs, state, equation and output transformations, and

    E = T^-1 (I - N C),  A = T^-1 A1,  ...          with any nonsingular T and any N,

which gives ``T E + N C = I``, hence ``rank [E; C] = nx``, with E of any rank from ``nx - ny`` on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import block_diag, eigvals, null_space

import obsynth

Array = np.ndarray[Any, np.dtype[np.float64]]


@dataclass(frozen=True)
class Recipe:
    """What a random plant shall look like.

    Parameters
    ----------
    nx, ny, nu, nd : int
        Sizes of the plant; ``nx`` counts the states before any sensor fault is appended.
    indexes : tuple of int
        Detectability index of each actuator fault.
    sensor_faults : int
        Faults that act on an output of their own (which is then mixed with the others).
    mixed_sensor_faults : bool
        Whether the sensor faults act on the states as well.
    zeros : tuple of complex
        Invariant zeros to plant, pairs included.
    hidden_modes : tuple of float
        Real modes that no output ever shows.
    singularity : int
        ``nx - rank E``, at most the number of outputs without sensor faults of their own.
    index_two : bool
        Whether the pencil shall have index 2 or more (needs a singular E).
    explicit : bool
        E = I (``singularity`` must be 0).
    radius : float
        Size of the free part of the dynamics, roughly the spectral radius.
    feedthrough : bool
        Whether D and Dd are random instead of zero.
    disturbance : str
        ``"random"``, ``"invisible"`` (acts on a hidden mode only; needs one), ``"zero"``, ``"sensor"`` (Dd only),
        ``"fault"`` (enters like a further fault, so that a free W decouples it) or ``"large"``
        (large entries).
    noise : int
        Number of noise inputs, through Bw and Dw.
    scales : float
        States, equations, outputs, inputs and so on are multiplied by factors up to this one, either way.
    """

    nx: int
    ny: int
    indexes: tuple[int, ...] = (1,)
    nu: int = 1
    nd: int = 1
    sensor_faults: int = 0
    mixed_sensor_faults: bool = False
    zeros: tuple[complex, ...] = ()
    hidden_modes: tuple[float, ...] = ()
    singularity: int = 0
    index_two: bool = False
    explicit: bool = False
    radius: float = 1.0
    feedthrough: bool = False
    disturbance: str = "random"
    noise: int = 0
    scales: float = 1.0


@dataclass(frozen=True)
class KnownPlant:
    """A plant with the structure it was built to have.

    Parameters
    ----------
    plant : obsynth.DescriptorSystem
        The plant.
    indexes : tuple of int
        Detectability index of each fault, sensor faults last.
    zeros : tuple of complex
        All invariant zeros from the faults to the outputs.
    recipe : Recipe
        What was asked for.
    """

    plant: obsynth.DescriptorSystem
    indexes: tuple[int, ...]
    zeros: tuple[complex, ...]
    recipe: Recipe = field(repr=False)


def orthogonal(rng: np.random.Generator, size: int) -> Array:
    """Return a random orthogonal matrix."""
    q, r = np.linalg.qr(rng.normal(size=(size, size)))
    return np.asarray(q * np.sign(np.diag(r)))


def well_conditioned(rng: np.random.Generator, rows: int, columns: int | None = None, spread: float = 2.0) -> Array:
    """Return a random matrix of full rank with singular values in ``[1 / spread, spread]``."""
    columns = rows if columns is None else columns
    sizes = spread ** rng.uniform(-1.0, 1.0, min(rows, columns))
    return orthogonal(rng, rows)[:, : len(sizes)] * sizes @ orthogonal(rng, columns)[: len(sizes)]


def real_block(values: Sequence[complex]) -> Array:
    """Return a real block-diagonal matrix with these eigenvalues; complex ones stand for their pair."""
    blocks = []
    for value in map(complex, values):
        if value.imag > 0.0:
            blocks.append(np.array([[value.real, value.imag], [-value.imag, value.real]]))
        elif value.imag == 0.0:
            blocks.append(np.array([[value.real]]))
    return np.asarray(block_diag(*blocks)) if blocks else np.zeros((0, 0))


def with_conjugates(values: Sequence[complex]) -> tuple[complex, ...]:
    """Return the values with the conjugate of each complex one added."""
    pairs = [(v, v.conjugate()) if v.imag else (v,) for v in map(complex, values)]
    return tuple(v for pair in pairs for v in pair)


def random_zeros(rng: np.random.Generator, count: int, most: float = 0.9) -> tuple[complex, ...]:
    """Return ``count`` zeros inside the circle of radius ``most``, in pairs (both members) or real."""
    found: list[complex] = []
    while len(found) < count:
        modulus = most * rng.uniform(0.1, 1.0)
        if count - len(found) >= 2 and rng.random() < 0.4:
            value = modulus * np.exp(1j * rng.uniform(0.2, np.pi - 0.2))
            found += [complex(value), complex(value).conjugate()]
        else:
            found.append(complex(modulus * rng.choice([-1.0, 1.0])))
    return tuple(found)


def build(rng: np.random.Generator, recipe: Recipe) -> KnownPlant:
    """Return a random plant as asked for.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of every random choice.
    recipe : Recipe
        Must fit: ``sum(indexes) + len(zeros) + len(hidden_modes) <= nx``, with room for the observed rest.
    """
    base_outputs = recipe.ny - recipe.sensor_faults
    decoupled = recipe.nd if recipe.disturbance == "fault" else 0
    chains = recipe.indexes + (1,) * decoupled
    a1, f, c, first = _chain_system(rng, recipe, chains, base_outputs)
    nx, nf = recipe.nx, len(recipe.indexes)
    disturbances = f[:, nf:] if decoupled else _disturbances(rng, recipe, nx)
    f = f[:, :nf]
    sensed = rng.normal(size=(recipe.sensor_faults, nx))
    sensed[:, : len(first)][:, ~first] = 0.0  # must not see a chain earlier than the other outputs do
    hidden = len(recipe.hidden_modes)
    if hidden:
        sensed[:, nx - hidden :] = 0.0
    a1, n = _output_injection(rng, recipe, a1, c)
    through = rng.normal(size=(nx, recipe.sensor_faults)) * (0.5 if recipe.mixed_sensor_faults else 0.0)
    a1 = a1 + through @ sensed
    faults = np.hstack([f, through])
    outputs = np.vstack([c, sensed])
    direct = np.vstack([np.zeros((base_outputs, nf + recipe.sensor_faults)),
                        np.hstack([np.zeros((recipe.sensor_faults, nf)), np.eye(recipe.sensor_faults)])])  # fmt: skip
    # State, equation and output coordinates.
    change, mixing = well_conditioned(rng, nx), well_conditioned(rng, recipe.ny)
    rows = np.linalg.inv(change) if recipe.explicit else well_conditioned(rng, nx)
    e = rows @ (np.eye(nx) - n @ c) @ change
    data = {
        "E": np.eye(nx) if recipe.explicit else e,
        "A": rows @ a1 @ change,
        "B": rows @ rng.normal(size=(nx, recipe.nu)),
        "C": mixing @ outputs @ change,
        "Bf": rows @ faults,
        "Df": mixing @ direct,
        "Bd": rows @ disturbances,
        "Bw": rows @ rng.normal(size=(nx, recipe.noise)) * 0.01,
        "Dw": rng.normal(size=(recipe.ny, recipe.noise)) * 0.01,
    }
    if recipe.feedthrough:
        data["D"] = rng.normal(size=(recipe.ny, recipe.nu))
    if recipe.nd and (recipe.feedthrough or recipe.disturbance == "sensor") and recipe.disturbance != "invisible":
        data["Dd"] = rng.normal(size=(recipe.ny, recipe.nd))
    data = _scaled(rng, data, recipe.scales, explicit=recipe.explicit)
    plant = obsynth.DescriptorSystem(**data, dt=float(rng.choice([0.02, 0.1, 1.0])))
    zeros = with_conjugates([*(z for z in map(complex, recipe.zeros) if z.imag >= 0.0), *recipe.hidden_modes])
    return KnownPlant(plant, recipe.indexes + (1,) * recipe.sensor_faults, zeros, recipe)


def _chain_system(
    rng: np.random.Generator, recipe: Recipe, chains: tuple[int, ...], ny: int
) -> tuple[Array, Array, Array, Any]:
    """Return ``A1, F, C`` in chain coordinates and which chain states the outputs see."""
    nx, nf, hidden = recipe.nx, len(chains), len(recipe.hidden_modes)
    length = sum(chains)
    a1, f, c = np.zeros((nx, nx)), np.zeros((nx, nf)), np.zeros((ny, nx))
    basis = orthogonal(rng, ny)
    upsilon, rest_of_outputs = basis[:, :nf] @ well_conditioned(rng, nf), basis[:, nf:]
    first = np.zeros(length, dtype=bool)
    start = 0
    for i, index in enumerate(chains):
        a1[start : start + index - 1, start + 1 : start + index] = np.eye(index - 1)
        f[start + index - 1, i], c[:, start], first[start] = 1.0, upsilon[:, i], True
        start += index
    # Order of the other states: planted zeros, observed ones, hidden ones.
    zero_block = real_block(recipe.zeros)
    nz = len(zero_block)
    observed = nx - length - nz - hidden
    if observed < ny - nf or (ny == nf and observed > 0):
        raise ValueError(f"{recipe} does not fit: {observed} states are left for {ny - nf} free outputs.")
    free = rng.normal(size=(observed, observed))
    if observed:
        free *= recipe.radius * rng.uniform(0.5, 1.0) / max(np.abs(np.linalg.eigvals(free)))
    rest = block_diag(zero_block, free, np.diag(recipe.hidden_modes)) if nx > length else np.zeros((0, 0))
    rest = np.asarray(rest).reshape(nx - length, nx - length)
    visible = slice(length, nx - hidden)
    rest[:nz, nz : nz + observed] = rng.normal(size=(nz, observed)) * 0.5
    rest[nz + observed :, : nz + observed] = rng.normal(size=(hidden, nz + observed)) * 0.5
    a1[length:, length:] = rest
    a1[:length, visible] = rng.normal(size=(length, nz + observed)) * 0.5
    c[:, visible] = upsilon @ rng.normal(size=(nf, nz + observed)) * 0.5
    if ny > nf:
        c[:, length + nz : nx - hidden] += rest_of_outputs @ well_conditioned(rng, ny - nf, observed)
    return a1, f, c, first


def _output_injection(rng: np.random.Generator, recipe: Recipe, a1: Array, c: Array) -> tuple[Array, Array]:
    """Return ``A1 + G C`` and N: rank, index and poles of the plant change, its indexes and zeros do not."""
    nx, ny = a1.shape[0], c.shape[0]
    count = recipe.singularity
    if recipe.explicit:
        return a1 + 0.5 * recipe.radius * rng.normal(size=(nx, ny)) @ c, np.zeros((nx, ny))
    kernel_in_outputs = orthogonal(rng, ny)[:, :count]
    kernel = np.linalg.pinv(c) @ kernel_in_outputs + null_space(c) @ rng.normal(size=(nx - ny, count))
    pick = np.linalg.pinv(c @ kernel) if count else np.zeros((0, ny))
    n = kernel @ pick + 0.3 * rng.normal(size=(nx, ny)) @ (np.eye(ny) - c @ kernel @ pick)
    e = np.eye(nx) - n @ c
    best, best_radius = a1, np.inf
    for attempt in range(30):
        trial = a1 + recipe.radius * 0.9**attempt * rng.normal(size=(nx, ny)) @ c
        if recipe.index_two and count:
            # Index 1 means that (left null)' A (null) is invertible: take one direction of it away.
            left = null_space(e.T)
            block = left.T @ trial @ kernel
            wanted = block - np.outer(block[:, 0], np.eye(count)[0])
            trial = trial + left @ (wanted - block) @ pick @ c
        radius = finite_radius(e, trial)
        if radius < best_radius:
            best, best_radius = trial, radius
        if radius <= 2.0:
            break
    return best, n


def finite_radius(e: Array, a: Array) -> float:
    """Return roughly the largest modulus of a finite eigenvalue of ``A - z E``."""
    values = eigvals(a, e, homogeneous_eigvals=True)
    alpha, beta = np.abs(values[0]), np.abs(values[1])
    finite = beta > 1e-8 * np.maximum(alpha, 1e-300)
    return float(np.max(alpha[finite] / beta[finite], initial=0.0))


def _disturbances(rng: np.random.Generator, recipe: Recipe, nx: int) -> Array:
    found = rng.normal(size=(nx, recipe.nd))
    if recipe.disturbance in ("zero", "sensor"):
        return np.zeros_like(found)
    if recipe.disturbance == "invisible":
        found[: nx - len(recipe.hidden_modes)] = 0.0
    if recipe.disturbance == "large":
        found *= 100.0
    return found


def _scaled(rng: np.random.Generator, data: dict[str, Array], most: float, *, explicit: bool) -> dict[str, Array]:
    """Change the units of every signal and equation by random factors up to ``most``, either way."""
    if most == 1.0:
        return data
    nx, ny = data["A"].shape[0], data["C"].shape[0]
    states, rows, outputs = (most ** rng.uniform(-1.0, 1.0, size) for size in (nx, nx, ny))
    if explicit:
        rows = 1.0 / states
    result: dict[str, Array] = {}
    for name, matrix in data.items():
        left = outputs if name[0] in "CD" else rows
        right = states if name in ("E", "A", "C") else None
        result[name] = left[:, None] * matrix * (1.0 if right is None else right)
    for pair in (("B", "D"), ("Bf", "Df"), ("Bd", "Dd")):
        columns = most ** rng.uniform(-1.0, 1.0, data[pair[0]].shape[1])
        for name in pair:
            if name in result:
                result[name] = result[name] * columns
    return result


def random_recipe(rng: np.random.Generator, *, largest: int = 10, longest_index: int = 3, **fixed: Any) -> Recipe:
    """Return a recipe with random sizes that fits; ``fixed`` entries are taken as given.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of every random choice.
    largest : int
        Largest ``nx``.
    longest_index : int
        Largest detectability index.
    **fixed
        Fields of `Recipe`; ``"square": True`` asks for as many faults as outputs.
    """
    square = fixed.pop("square", None)
    while True:
        nx = fixed.get("nx", int(rng.integers(3, largest + 1)))
        sensors = fixed.get("sensor_faults", 0)
        ny = fixed.get("ny", int(rng.integers(1, min(nx, 5) + 1)))
        free_outputs = ny - sensors
        if free_outputs < 1:
            continue
        nd = fixed.get("nd", int(rng.integers(0, 4)))
        chained = nd if fixed.get("disturbance") == "fault" else 0
        if free_outputs <= chained:
            continue
        nf = free_outputs if square else int(rng.integers(1, free_outputs - chained + 1))
        indexes = fixed.get("indexes", tuple(int(rho) for rho in rng.integers(1, longest_index + 1, nf)))
        hidden = fixed.get("hidden_modes", ())
        rest = nx - sum(indexes) - chained - len(hidden)
        least = free_outputs - len(indexes) - chained
        if len(indexes) + chained > free_outputs or rest < least:
            continue
        if "zeros" in fixed:
            zeros = fixed["zeros"]
        else:
            count = rest if least == 0 else int(rng.integers(0, rest - least + 1)) * int(rng.random() < 0.5)
            zeros = random_zeros(rng, count)
        if rest - len(zeros) < least or (least == 0 and rest > len(zeros)):
            continue
        explicit = fixed.get("explicit", False)
        most = 0 if explicit else free_outputs
        singularity = fixed.get("singularity", int(rng.integers(0, most + 1)))
        if fixed.get("index_two"):
            singularity = max(singularity, 1)
        if singularity > most or singularity >= nx:
            continue
        return Recipe(
            **{**dict(
                nx=nx, ny=ny, indexes=indexes, nu=int(rng.integers(0, 3)), nd=nd, zeros=zeros, singularity=singularity,
                radius=float(rng.uniform(0.3, 2.0)),
            ), **fixed}
        )  # fmt: skip
