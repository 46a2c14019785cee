"""Solving the algebraic equations of an index-1 plant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from obsynth.analysis.transformations.exact_elimination import exact_elimination, rounded_once
from obsynth.analysis.transformations.recovery import (
    StateRecovery,
    Transformation,
    state_point,
    unchanged_states,
    with_states,
)
from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.pencils import pencil_structure
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE
from obsynth.numerics.scaling import equilibrate_pencil, power_of_two_below
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.origin import with_origin
from obsynth.proofs.written_numbers import computed_entries


def eliminate_algebraic_states(plant: DescriptorSystem) -> Transformation:
    """Solve the algebraic equations of an index-1 plant, so that ``E = I``.

    Parameters
    ----------
    plant : DescriptorSystem
        Regular, index 0 or 1, either time.

    Returns
    -------
    Transformation
        Signals in algebraic equations end up in ``D, Df, Dd, Dw``.  Dynamic states keep their names when
        the null space of ``E`` is spanned by whole states; otherwise the new states ``xi 1, xi 2, ...``
        are orthogonal combinations (after scaling by powers of two).

    Raises
    ------
    PreconditionError
        Not regular, index 2 or more, or no dynamic state at all.

    Notes
    -----
    Up to 64 states the equations are solved in rational arithmetic and every entry is rounded once.  Beyond that, and
    where data were computed, results so small beside the terms they come from that they are only rounding are set to
    zero: the flags of the recovery depend on what is exactly zero.
    """
    if np.array_equal(plant.E, np.eye(plant.nx)):
        return Transformation(plant, plant, "", unchanged_states(plant, plant, from_state=np.eye(plant.nx)))
    return eliminated_exactly(plant) or _eliminated_in_floating_point(plant)


def eliminated_exactly(plant: DescriptorSystem, basis: FloatArray | None = None) -> Transformation | None:
    """Return the elimination in rational arithmetic, rounded once; ``None`` where it must be left to floating point.

    ``basis (nx, count)`` are the dynamic states to take, where they are combinations of those given.
    """
    exact = exact_elimination(plant)
    if exact is not None and computed_entries(plant.E) and _dynamic_count(plant) != len(exact.pivots):
        return None
    if exact is None:
        return None
    count = len(exact.pivots)
    whole = int(np.sum(plant.E.any(axis=0))) == count
    names = tuple(plant.state_names[i] for i in exact.pivots) if whole else tuple(f"xi {i + 1}" for i in range(count))
    if not whole and basis is None:
        basis = _coordinates(plant, count)[1]
    matrices, states = rounded_once(exact, plant, None if whole else basis)
    new = with_states(plant, names, E=None, **matrices)
    recovery = StateRecovery(
        plant.state_names, states["A"], states["B"], states["Bf"], states["Bd"], states["Bw"], np.eye(plant.nw),
        state_point(plant),
    )  # fmt: skip
    return Transformation(plant, with_origin(new, exact.origin), _done(plant, count), recovery)


def dynamic_coordinates(plant: DescriptorSystem) -> FloatArray | None:
    """Return the basis ``(nx, count)`` of dynamic states that elimination takes; ``None`` for given states."""
    count = int(np.linalg.matrix_rank(equilibrate_pencil(plant.E, plant.A).E))
    return None if int(np.sum(plant.E.any(axis=0))) == count else _coordinates(plant, count)[1]


def _done(plant: DescriptorSystem, count: int) -> str:
    return f"eliminated {plant.nx - count} algebraic states" if count < plant.nx else "multiplied by the inverse of E"


def _eliminated_in_floating_point(plant: DescriptorSystem) -> Transformation:
    count = _dynamic_count(plant)
    rows, dynamic, algebraic, names = _coordinates(plant, count)
    sizes = (count, plant.nu, plant.nf, plant.nd, plant.nw)
    signals = np.hstack([plant.B, plant.Bf, plant.Bd, plant.Bw])
    right_sides = rows @ np.hstack([plant.A @ dynamic, signals])
    coupling = rows @ plant.A @ algebraic
    # algebraic coordinates = solution @ [state; u; f; d; w]
    solution = _solved(-coupling[count:], right_sides[count:])
    reduced = _solved(rows[:count] @ plant.E @ dynamic, _sum(right_sides[:count], coupling[:count], solution))
    direct = np.hstack([plant.C @ dynamic, plant.D, plant.Df, plant.Dd, plant.Dw])
    A, B, Bf, Bd, Bw = columns_of(reduced, sizes)
    C, D, Df, Dd, Dw = columns_of(_sum(direct, plant.C @ algebraic, solution), sizes)
    padded = np.hstack([dynamic, np.zeros((plant.nx, signals.shape[1]))])
    from_state, from_input, from_fault, from_disturbance, from_noise = columns_of(
        _sum(padded, algebraic, solution), sizes
    )
    new = with_states(plant, names, E=None, A=A, B=B, Bf=Bf, Bd=Bd, Bw=Bw, C=C, D=D, Df=Df, Dd=Dd, Dw=Dw)
    recovery = StateRecovery(
        plant.state_names, from_state, from_input, from_fault, from_disturbance, from_noise, np.eye(plant.nw),
        state_point(plant),
    )  # fmt: skip
    return Transformation(plant, new, _done(plant, count), recovery)


def _dynamic_count(plant: DescriptorSystem) -> int:
    pencil = pencil_structure(plant.E, plant.A)
    if pencil.index is None:
        raise PreconditionError(
            "The plant is not regular: det(A - zE) is zero for every z, so its equations do not determine the "
            "states. Check for a missing or repeated equation.",
            condition="regularity",
        )
    if pencil.index > 1:
        raise PreconditionError(
            f"The plant has index {pencil.index}: its algebraic equations cannot be solved for the algebraic states "
            "without differentiating. Differentiate the constraints, or use a method that takes the descriptor form.",
            condition="index",
        )
    count = plant.nx - len(pencil.infinite_block_sizes)
    if count == 0:
        raise PreconditionError(
            "Every state is algebraic: nothing is left after elimination. Solve the equations directly.",
            condition="dynamic states",
        )
    return count


def _coordinates(plant: DescriptorSystem, count: int) -> tuple[FloatArray, FloatArray, FloatArray, tuple[str, ...]]:
    """Return row transformation, bases of dynamic and algebraic states, names of the dynamic ones."""
    pencil = equilibrate_pencil(plant.E, plant.A)
    left, _, right = np.linalg.svd(pencil.E)
    moving_rows, moving = plant.E.any(axis=1), plant.E.any(axis=0)
    rows = left.T
    if np.sum(moving_rows) == count:
        rows = np.eye(plant.nx)[np.argsort(~moving_rows, kind="stable")]
    rows = rows * pencil.rows
    if np.sum(moving) == count:
        order = np.argsort(~moving, kind="stable")
        basis, names = np.eye(plant.nx)[:, order], tuple(plant.state_names[i] for i in order[:count])
    else:
        basis, names = pencil.columns[:, None] * right.T, tuple(f"xi {i + 1}" for i in range(count))
    return rows, basis[:, :count], basis[:, count:], names


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrix^-1 right`` with entries that are only rounding set to zero."""
    scale = 1.0 / power_of_two_below(np.max(np.abs(matrix), axis=1, initial=0.0))[:, None]
    scaled = scale * matrix
    solution: FloatArray = np.asarray(np.linalg.solve(scaled, scale * right), dtype=np.float64)
    inverse = np.abs(np.linalg.inv(scaled))
    return _cleaned(solution, inverse @ (np.abs(scaled) @ np.abs(solution)))


def _sum(direct: FloatArray, factor: FloatArray, solution: FloatArray) -> FloatArray:
    """Return ``direct + factor solution`` with entries that are only rounding set to zero."""
    return _cleaned(direct + factor @ solution, np.abs(direct) + np.abs(factor) @ np.abs(solution))


def _cleaned(result: FloatArray, size_of_terms: FloatArray) -> FloatArray:
    return np.where(np.abs(result) > CANCELLATION_TOLERANCE * size_of_terms, result, 0.0)


def columns_of(matrix: FloatArray, sizes: Sequence[int]) -> list[FloatArray]:
    """Split a matrix into blocks of columns of the given sizes."""
    return np.split(matrix, np.cumsum(sizes)[:-1], axis=1)
