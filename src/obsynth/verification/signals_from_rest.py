"""Final samples of invisible signals that start from rest, and their continuation for plants of index above one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import structure_of
from obsynth.proofs.ball_kernels import (
    exact_kernel,
    independent_columns,
    pivots_of,
    solution_with_free,
    solution_with_one_free,
)
from obsynth.proofs.balls import Ball
from obsynth.proofs.complex_balls import beside, columns_of, complex_matrix, real_matrix, rows_of, stacked, zeros


def has_index_one(plant: DescriptorSystem) -> bool:
    """Whether every trajectory can be continued after now without inputs."""
    return samples_after(plant) == 0


def samples_after(plant: DescriptorSystem) -> int:
    """Return for how many samples after now the equations are to hold, so that a trajectory can be continued.

    None for index 1.  Beyond, states depend on inputs of some samples later: where the equations hold for as many
    samples as the index, the states up to now are those of a whole trajectory without inputs after these.
    """
    index = structure_of(plant).index
    if index is None:
        return plant.nx
    return index if index > 1 else 0


def signals_from_rest(
    plant: DescriptorSystem,
    hidden: tuple[FloatArray, FloatArray],
    noise: tuple[FloatArray, FloatArray],
    samples: int,
    estimated: int,
    *,
    free: FloatArray | None = None,
) -> tuple[list[Any], list[Any]]:
    """Return the inputs ``(h, w)``, and the states, of each sample, solutions from rest with y = 0 as columns.

    Of these, what is independent in w and the first ``estimated`` of h, the faults; or the one with some free entries.
    """
    system, places = equations_from_rest(plant, hidden, noise, samples)
    if free is not None:
        pivots, others = pivots_of(system)
        nearby = [Ball.exact(system[:, pivots])]
        given = real_matrix(free[:, None])
        one = flint.acb_mat(solution_with_free(real_matrix(system), nearby, pivots, others, given))
        return [rows_of(one, place) for place in places], _states_of(one, places, plant)
    try:
        pivots, others = pivots_of(system)
        solved = columns_of(complex_matrix(system + 0j), pivots).solve(-columns_of(complex_matrix(system + 0j), others))
        columns = [solution_with_one_free(solved, pivots, others, j) for j in range(len(others))]
        solutions = beside(columns) if columns else zeros(system.shape[1], 0)
    except ZeroDivisionError:
        solutions = exact_kernel(system)
    parts = [rows_of(solutions, place) for place in places]
    counted = [*range(estimated), *range(hidden[0].shape[1], len(places[0]))]
    independent = independent_columns(stacked([rows_of(part, counted) for part in parts]))
    solutions = columns_of(solutions, independent)
    return [columns_of(part, independent) for part in parts], _states_of(solutions, places, plant)


def _states_of(solutions: Any, places: Sequence[range], plant: DescriptorSystem) -> list[Any]:
    """Return the states of each sample of solutions from rest: before its inputs, of the first one what is loose."""
    first = zeros(plant.nx, solutions.ncols())
    for row, state in enumerate(_loose_states(plant)):
        for column in range(solutions.ncols()):
            first[state, column] = solutions[row, column]
    return [first, *(rows_of(solutions, range(place.start - plant.nx, place.start)) for place in places[1:])]


def _loose_states(plant: DescriptorSystem) -> list[int]:
    """Return the states that no derivative or next sample holds: they may be anything at the start."""
    return [i for i in range(plant.nx) if not plant.E[:, i].any()]


def equations_from_rest(
    plant: DescriptorSystem,
    hidden: tuple[FloatArray, FloatArray],
    noise: tuple[FloatArray, FloatArray],
    samples: int,
) -> tuple[FloatArray, list[range]]:
    """Return the equations of last samples from rest with y = 0, and where the inputs of each are in the unknowns.

    Those after now follow, of whose outputs nothing is required.
    """
    nx, ny = plant.nx, plant.ny
    (bh, dh), (bw, dw) = hidden, noise
    inputs, through = np.hstack([bh, bw]), np.hstack([dh, dw])
    count = inputs.shape[1]
    loose = _loose_states(plant)
    block, every = count + nx, samples + samples_after(plant)
    system = np.zeros((every * (nx + ny), len(loose) + every * block))
    places = []
    for j in range(every):
        row, own = j * (nx + ny), len(loose) + j * block
        states, outputs = slice(row, row + nx), slice(row + nx, row + nx + ny)
        before = slice(own - nx, own) if j else slice(0, len(loose))
        system[states, before] = -plant.A if j else -plant.A[:, loose]
        system[states, own : own + count] = -inputs
        system[states, own + count : own + block] = plant.E
        if j < samples:
            system[outputs, before] = plant.C if j else plant.C[:, loose]
            system[outputs, own : own + count] = through
        places.append(range(own, own + count))
    return system[system.any(axis=1)], places
