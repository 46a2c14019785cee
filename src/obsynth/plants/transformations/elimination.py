"""Elimination of a plant's algebraic states: directly at index 1, by `index_reduction` above."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, counted
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.libraries import one_thread_if_small
from obsynth.numerics.ranks import but_rounding, product_but_rounding, rounding_rank
from obsynth.numerics.scaling import power_of_two_below
from obsynth.numerics.sparse import is_sparse
from obsynth.plants.descriptor import DescriptorSystem, note_source
from obsynth.plants.pencil import in_own_units, structure_of
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.transformations.exact_elimination import EXACT_ELIMINATION_UP_TO, exact_elimination, rounded_once
from obsynth.plants.transformations.idle_variables import (
    active_part,
    active_variables,
    everything_active,
    settled_basis,
)
from obsynth.plants.transformations.index_reduction import reduced_index
from obsynth.plants.transformations.recovery import (
    StateRecovery,
    Transformation,
    state_point,
    unchanged_states,
    with_states,
)
from obsynth.plants.transformations.sparse_elimination import INDEX_ADVICE, not_index_one, reduced_by_sparsity
from obsynth.plants.uncertainty import ELIMINATED
from obsynth.proofs.exact_doubles import holds_computed

#: Arrays of plants from this size on, with at most this share of entries that are not zero, are treated as sparse.
MANY_VARIABLES = 500

SPARSE_PENCIL_SHARE = 0.05


@arguments_checked
def eliminate_algebraic_states(plant: DescriptorSystem | Transformation) -> Transformation:
    """Solve the algebraic equations of a plant, so that ``E = I``.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Regular, either time.  Of a plant of index 2 or more (a mechanism with its constraints at position level) the
        minimal proper form is taken, of up to 64 states: nothing need be differentiated by hand.

    Returns
    -------
    Transformation
        Signals in algebraic equations end up in ``D, Df, Dd, Dw``.  Dynamic states keep their names when
        the null space of ``E`` is spanned by whole states; otherwise the new states ``xi 1, xi 2, ...``
        are orthogonal combinations (after scaling by powers of two).  ``dropped`` names variables that act on
        nothing and have no value without differentiating: they were left out, exactly, and are not recovered.

    Raises
    ------
    PreconditionError
        Not regular, no dynamic state at all, or an output needs the derivative of a signal, which is named (beyond 64
        states: index 2 or more).

    Notes
    -----
    Up to 64 states the equations are solved in rational arithmetic and every entry is rounded once.  Beyond that, and
    where data were computed, results so small beside the terms they come from that they are only rounding are set to
    zero: the flags of the recovery depend on what is exactly zero.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(E=[[1, 0], [0, 0]], A=[[-1, 1], [1, -2]], C=[[1, 0]])
    >>> reduced = obsynth.eliminate_algebraic_states(plant)
    >>> reduced.plant.A.tolist(), reduced.plant.nx
    ([[-0.5]], 1)
    """
    if isinstance(plant, Transformation):
        return plant.then(eliminate_algebraic_states(plant.plant))
    if _is_identity(plant.E):
        same = plant.dense()
        return Transformation(plant, same, "", unchanged_states(plant, same, from_state=np.eye(plant.nx)))
    with one_thread_if_small(plant.nx):
        if plant.nx > EXACT_ELIMINATION_UP_TO and (plant.is_sparse or _has_few_entries(plant)):
            return eliminated_by_sparsity(plant)
        arrays = plant.dense()
        transformation = eliminated_exactly(arrays) or _eliminated_in_floating_point(arrays)
    if not transformation.dropped and not transformation.is_of_lower_index:
        transformation = transformation.with_tolerances(ELIMINATED)
    note_source(arrays, transformation.plant)
    return transformation if arrays is plant else replace(transformation, source=plant)


def _is_identity(e: Any) -> bool:
    if not is_sparse(e):
        return bool(np.array_equal(e, np.eye(e.shape[0])))
    return bool(e.nnz == e.shape[0] and np.all(e.diagonal() == 1.0))


def _has_few_entries(plant: DescriptorSystem) -> bool:
    """Whether a plant given as arrays is solved better by its sparsity."""
    stored = np.count_nonzero(plant.A) + np.count_nonzero(plant.E) if plant.nx >= MANY_VARIABLES else plant.nx**2
    return bool(stored <= SPARSE_PENCIL_SHARE * plant.nx**2)


def eliminated_by_sparsity(plant: DescriptorSystem) -> Transformation:
    """Leave out what acts on nothing, and solve the algebraic equations by a sparse factor."""
    active = active_variables(plant)
    part = active_part(plant, active)
    elimination = reduced_by_sparsity(part)
    if elimination is None:
        raise not_index_one(plant, active)
    return replace(
        elimination,
        source=plant,
        description=_description(part, elimination.plant.nx, active.dropped),
        dropped=active.dropped,
        notes=tuple(filter(None, (active.note(), *elimination.notes))),
    )


def _without_idle_variables(plant: DescriptorSystem, refusal: PreconditionError) -> Transformation:
    """Leave out what acts on nothing where that helps; else say which equations and variables are at fault."""
    active = active_variables(plant)
    part = active_part(plant, active)
    try:
        if not active.dropped:
            raise refusal
        elimination = eliminated_exactly(part) or _eliminated_densely(part, _dynamic_count(part))
    except PreconditionError as error:
        if error.condition == "dynamic states":
            # It did not help: what is wrong with the plant as written is what a user can mend.
            active, error = everything_active(plant), refusal
        raise not_index_one(plant, active, error) from None
    return replace(
        elimination,
        source=plant,
        description=_description(part, elimination.plant.nx, active.dropped),
        dropped=active.dropped,
        notes=(active.note(),),
    )


def _description(plant: DescriptorSystem, count: int, dropped: Sequence[str] = ()) -> str:
    """Return what was done to a plant of which ``count`` states are left, in words."""
    done = (
        f"eliminated {counted(plant.nx - count, 'algebraic state')}"
        if count < plant.nx
        else "multiplied by the inverse of E"
    )
    if not dropped:
        return done
    return f"left out {counted(len(dropped), 'variable')} without an effect ({', '.join(dropped)}); {done}"


def eliminated_exactly(plant: DescriptorSystem, basis: FloatArray | None = None) -> Transformation | None:
    """Return the elimination in rational arithmetic, rounded once; ``None`` where it must be left to floating point.
    ``basis (nx, count)`` are the dynamic states to take, where they are combinations of those given."""
    exact = exact_elimination(plant)
    if exact is None:
        return None
    computed = holds_computed(plant.E) or holds_computed(plant.A)
    if computed and plant.nx - sum(structure_of(plant).infinite_block_sizes) != len(exact.pivots):
        # E or the algebraic equations are singular but for the rounding of their entries.
        return None
    count = len(exact.pivots)
    whole = int(np.sum(plant.E.any(axis=0))) == count
    names = tuple(plant.state_names[i] for i in exact.pivots) if whole else tuple(f"xi {i + 1}" for i in range(count))
    if not whole and basis is None:
        basis = _coordinates(plant, count)[1]
    matrices, states, sizes = rounded_once(exact, plant, None if whole else basis)
    new = with_states(plant, names, E=None, **matrices, exact=exact.numbers(sizes, own=whole))
    recovery = StateRecovery(
        plant.state_names,
        states["A"],
        states["B"],
        states["Bf"],
        states["Bd"],
        states["Bw"],
        np.eye(plant.nw),
        state_point(plant),
    )
    return Transformation(plant, new, _description(plant, count), recovery)


def dynamic_coordinates(plant: DescriptorSystem) -> FloatArray | None:
    """Return the basis ``(nx, count)`` of dynamic states that elimination takes; ``None`` for given states."""
    count = rounding_rank(in_own_units(plant)[0])
    return None if int(np.sum(plant.E.any(axis=0))) == count else _coordinates(plant, count)[1]


def _eliminated_in_floating_point(plant: DescriptorSystem) -> Transformation:
    try:
        count = _dynamic_count(plant)
    except PreconditionError as error:
        if error.condition == "dynamic states":
            raise
        try:
            return _without_idle_variables(plant, error)
        except PreconditionError as refusal:
            lowered = reduced_index(plant) if refusal.condition == "index" else None
            if lowered is None:
                raise
            return lowered
    return _eliminated_densely(plant, count)


def _eliminated_densely(plant: DescriptorSystem, count: int) -> Transformation:
    """Solve the algebraic equations of a plant with ``count`` dynamic states by LAPACK."""
    rows, dynamic, algebraic, names = _coordinates(plant, count)
    sizes = (count, plant.nu, plant.nf, plant.nd, plant.nw)
    signals = np.hstack([plant.B, plant.Bf, plant.Bd, plant.Bw])
    right_sides = rows @ np.hstack([plant.A @ dynamic, signals])
    coupling = rows @ plant.A @ algebraic
    # algebraic coordinates = solution @ [state; u; f; d; w]
    solution = _solved(-coupling[count:], right_sides[count:])
    reduced = _solved(
        rows[:count] @ plant.E @ dynamic, product_but_rounding(coupling[:count], solution, right_sides[:count])
    )
    direct = np.hstack([plant.C @ dynamic, plant.D, plant.Df, plant.Dd, plant.Dw])
    A, B, Bf, Bd, Bw = columns_of(reduced, sizes)
    C, D, Df, Dd, Dw = columns_of(product_but_rounding(plant.C @ algebraic, solution, direct), sizes)
    padded = np.hstack([dynamic, np.zeros((plant.nx, signals.shape[1]))])
    from_state, from_input, from_fault, from_disturbance, from_noise = columns_of(
        product_but_rounding(algebraic, solution, padded), sizes
    )
    new = with_states(plant, names, E=None, A=A, B=B, Bf=Bf, Bd=Bd, Bw=Bw, C=C, D=D, Df=Df, Dd=Dd, Dw=Dw)
    recovery = StateRecovery(
        plant.state_names,
        from_state,
        from_input,
        from_fault,
        from_disturbance,
        from_noise,
        np.eye(plant.nw),
        state_point(plant),
    )
    return Transformation(plant, new, _description(plant, count), recovery)


def algebraic_coordinates(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the row transformation and the bases of dynamic and algebraic states that an elimination uses."""
    if _is_identity(plant.E):
        return np.eye(plant.nx), np.eye(plant.nx), np.zeros((plant.nx, 0))
    return _coordinates(plant, _dynamic_count(plant))[:3]


def _dynamic_count(plant: DescriptorSystem) -> int:
    pencil = structure_of(plant)
    if pencil.index is None:
        raise PreconditionError(
            "The plant is not regular: det(A - zE) is zero for every z, so its equations do not determine the "
            "states. Check for a missing or repeated equation.",
            condition="regularity",
        )
    if pencil.index > 1:
        raise PreconditionError(
            f"The plant has index {pencil.index}: its algebraic equations cannot be solved for the algebraic states "
            f"without differentiating. {INDEX_ADVICE}",
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
    units = PlantUnits.of(plant).rounded()
    left_vectors, _, right_vectors = np.linalg.svd(in_own_units(plant)[0])
    moving_rows, moving = plant.E.any(axis=1), plant.E.any(axis=0)
    rows = left_vectors.T
    if np.sum(moving_rows) == count:
        rows = np.eye(plant.nx)[np.argsort(~moving_rows, kind="stable")]
    rows = rows * units.equations
    if np.sum(moving) == count:
        order = np.argsort(~moving, kind="stable")
        basis, names = np.eye(plant.nx)[:, order], tuple(plant.state_names[i] for i in order[:count])
    else:
        directions = np.hstack([settled_basis(right_vectors[:count].T), right_vectors[count:].T])
        basis, names = units.states[:, None] * directions, tuple(f"xi {i + 1}" for i in range(count))
    return rows, basis[:, :count], basis[:, count:], names


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return ``matrix^-1 right`` with entries that are only rounding set to zero."""
    scale = 1.0 / power_of_two_below(np.max(np.abs(matrix), axis=1, initial=0.0))[:, None]
    scaled = scale * matrix
    solution: FloatArray = np.asarray(np.linalg.solve(scaled, scale * right), dtype=np.float64)
    inverse = np.abs(np.linalg.inv(scaled))
    return but_rounding(solution, inverse @ (np.abs(scaled) @ np.abs(solution)))


def columns_of(matrix: FloatArray, sizes: Sequence[int]) -> list[FloatArray]:
    """Split a matrix into blocks of columns of the given sizes."""
    return np.split(matrix, np.cumsum(sizes)[:-1], axis=1)
