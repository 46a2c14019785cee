"""The model of a window: the fault, the bounds, and the matrices of its samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import decide_rank
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.moving_disturbances import MovingColumns


@dataclass(frozen=True, eq=False)
class Bounds:
    """What keeps its bounds: disturbances, columns of noise, states.

    All of them half widths.  ``disturbance (nd,)``; ``noise_state (nx, n)``, ``noise_output (ny, n)`` and
    ``noise (n,)``: noise columns and their bounds; ``state`` and ``first`` ``(nx,)``: of the states at every and at the
    first sample, infinite without any.
    ``disturbance_middle (nd,)``, ``noise_middle (n,)``: the middles of their bounds, zero where not given.
    """

    disturbance: FloatArray
    noise_state: FloatArray
    noise_output: FloatArray
    noise: FloatArray
    state: FloatArray
    first: FloatArray
    disturbance_middle: FloatArray | None = None
    noise_middle: FloatArray | None = None
    #: What disturbances put into the states of a sampled plant where they move between samples, and their bounds there
    #: ``(nd,)``; ``every``: whether every course counts, and not only those that rest in each piece of a sample.
    moving: MovingColumns | None = None
    moving_bounds: FloatArray | None = None
    every: bool = False
    #: How many times what the columns leave counts.
    times_rest: float = 1.0

    @property
    def middles(self) -> Iterator[tuple[str, int, float]]:
        """Kind, number and middle of what does not move about zero."""
        for kind, middle in (("d", self.disturbance_middle), ("w", self.noise_middle)):
            for i, value in enumerate(() if middle is None else middle.tolist()):
                if value:
                    yield kind, i, value


@dataclass(frozen=True, eq=False)
class TestProblem:
    """What is asked of a window: the fault, its course, the samples, and what else may happen."""

    fault: int
    course: str
    samples: int
    lag: int = 0
    before: int = 0
    free: tuple[int, ...] = ()
    free_course: str = "any"
    disturbance: str = "any"
    disturbance_rate: FloatArray = field(default_factory=lambda: np.zeros(0))
    fault_rate: float = 0.0
    ellipsoid: bool = False
    #: Equations after the last sample, without outputs: sound where the record goes on.
    closing: int = 0


@dataclass(frozen=True, eq=False)
class Model:
    """The matrices of a plant over a window, by its samples, 0 first.

    Of each equation what multiplies the states after and before it, and known inputs; of each sample what multiplies
    the state in its outputs, and of faults, disturbances and noise (``f``, ``d``, ``w``) the number of the equation
    that they enter, what they do there and what they do to the outputs.
    """

    plant: DescriptorSystem | TimeVaryingDescriptorSystem
    equations: tuple[tuple[FloatArray, FloatArray, FloatArray], ...]
    output_maps: tuple[FloatArray, ...]
    columns: Mapping[str, Sequence[tuple[int, FloatArray, FloatArray]]]
    #: Whether E leads from each state to the next.
    regular: bool

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Numbers of states, equations of a sample, known inputs and outputs."""
        plant = self.plant
        return plant.nx, plant.nx if isinstance(plant, DescriptorSystem) else plant.ne, plant.nu, plant.ny

    @property
    def D(self) -> FloatArray:
        """What known inputs do to the outputs of their own sample."""
        plant = self.plant
        return plant.D if isinstance(plant, DescriptorSystem) else np.zeros((plant.ny, plant.nu))


def fault_names(plant: DescriptorSystem | TimeVaryingDescriptorSystem) -> tuple[str, ...]:
    """Return the names of the faults of a plant: of one that changes with k its parameters."""
    return plant.fault_names if isinstance(plant, DescriptorSystem) else plant.parameter_names


def disturbance_names(plant: DescriptorSystem | TimeVaryingDescriptorSystem) -> tuple[str, ...]:
    """Return the names of the disturbances; of a plant that changes with k one in each equation: ``mu1``, ..."""
    return (
        plant.disturbance_names if isinstance(plant, DescriptorSystem) else tuple(f"mu{i + 1}" for i in range(plant.ne))
    )


def constant_model(plant: DescriptorSystem, bounds: Bounds, test_problem: TestProblem) -> Model:
    """Return the same matrices at each sample."""
    regular = decide_rank(plant.E).full
    count = test_problem.samples - 1 if regular else test_problem.samples + test_problem.closing
    kinds = {
        "f": (plant.Bf, plant.Df),
        "d": (plant.Bd, plant.Dd),
        # Of disturbances that move between samples the values at the samples enter outputs alone.
        "d at samples": (plant.Bd * (1.0 if bounds.moving is None else ~bounds.moving.moved), plant.Dd),
        "w": (bounds.noise_state, bounds.noise_output),
    }
    span = range(max(count, test_problem.samples))
    columns = {kind: [(k, *matrices) for k in span] for kind, matrices in kinds.items()}
    return Model(plant, ((plant.E, plant.A, plant.B),) * count, (plant.C,) * test_problem.samples, columns, regular)


def varying_model(plant: TimeVaryingDescriptorSystem, samples: int, start: int) -> Model:
    """Return the matrices of the samples from k = ``start`` on, 1 or more.

    A fault of k acts on the way to sample k + 1, and shows in its outputs; of a window it is that of this sample.
    """
    last, ne, ny = start + samples, plant.ne, plant.ny
    # An equation whose state is determined by nothing else says something where E loses rows only.
    more = (plant.horizon is None or last <= plant.horizon) and not has_full_rows(plant.E.at(last))
    ks = range(start, last - 1 + int(more))
    columns = {
        "f": [(k, plant.Phi.at(start + k), plant.Psi.at(start + k)) for k in range(-1, max(len(ks), samples - 1))],
        "d": [(k, np.eye(ne), np.zeros((ny, ne))) for k in range(max(len(ks), samples))],
        "w": [(-1, np.zeros((ne, ny)), np.eye(ny))] * max(len(ks), samples),
    }
    equations = tuple((plant.E.at(k + 1), plant.A.at(k), plant.B.at(k)) for k in ks)
    regular = all(has_full_rows(after) for after, _, _ in equations)
    return Model(plant, equations, tuple(plant.C.at(start + k) for k in range(samples)), columns, regular)


def has_full_rows(matrix: FloatArray) -> bool:
    """Whether rows are independent: a state then satisfies them whatever stands on the right."""
    return matrix.shape[0] <= matrix.shape[1] and decide_rank(matrix).rank == len(matrix)
