"""Reduction of a regular plant of index 2 or more to its minimal proper form, in rational arithmetic.

With ``M = (s0 E - A)^-1 E`` at a rational s0 that is no eigenvalue, the states split into ``x = V z + W v``: V spans
the image of a power of M (the dynamic part), W its kernel. There ``M V = V J``, ``M W = W N`` with J regular and N
nilpotent, so (Weierstrass form; Dai 1989, section 1.2; Kunkel and Mehrmann 2006, section 2.1)

    ``z' = (s0 I - J^-1) z + J^-1 b q``,  ``v = G c q - G N v'``,  ``G = (I - s0 N)^-1``,

q being all signals. ``G N`` is nilpotent: v needs the derivative (discrete time: later samples) of a signal where
``(G N) G c`` has a column that is not zero. Unlike a differentiated constraint, nothing that the constraints say of the
positions and speeds is lost: z has as many entries as there are free initial values.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from flint import fmpq, fmpq_mat

from obsynth.errors import PreconditionError
from obsynth.plants.descriptor import DECISIVE, DescriptorSystem, ExactNumbers
from obsynth.plants.pencil import structure_of
from obsynth.plants.transformations.exact_elimination import MOST_STATES_EXACTLY
from obsynth.plants.transformations.recovery import StateRecovery, Transformation, state_point, with_states
from obsynth.proofs.exact_arithmetic import (
    blocks,
    fractions_of,
    holds_computed,
    identity,
    nearest_doubles,
    null_basis,
    picked_columns,
    picked_rows,
    pivot_columns,
    written_matrix,
)

_SIGNALS = (("Bu", "B", "D", "input_names"), ("Bf", "Bf", "Df", "fault_names"), ("Bd", "Bd", "Dd", "disturbance_names"),
            ("Bw", "Bw", "Dw", "noise_names"))  # fmt: skip


def reduced_index(plant: DescriptorSystem) -> Transformation | None:
    """Return the minimal proper form of a dense regular plant, and the way back to its states.

    Algebraic states and multipliers come back from states, inputs, faults, unknown inputs and noise; those that need
    the derivative of a signal and reach no output are `dropped`.

    Returns ``None`` for more than 64 states, computed data, exact numbers from elsewhere, or no dynamic state.

    Raises
    ------
    PreconditionError
        An output needs the derivative of a signal (in discrete time: a later sample), which is named.
    """
    split = _split(plant)
    if split is None:
        return None
    _require_proper(plant, split.differentiated_outputs)
    return _transformation(plant, split) if split.A.nrows() else None


def improper_outputs(plant: DescriptorSystem) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the outputs that need derivatives of signals, and these signals."""
    split = _split(plant)
    return ((), ()) if split is None else _improper(plant, split.differentiated_outputs)


@dataclass(frozen=True, eq=False)
class _Split:
    """The proper form ``z' = A z + B q, y = C z + D q, x = V z + X q + (terms in derivatives of q)``, rational."""

    A: fmpq_mat
    B: fmpq_mat
    C: fmpq_mat
    D: fmpq_mat
    V: fmpq_mat
    X: fmpq_mat
    differentiated: fmpq_mat  # of the states, by what is differentiated once
    differentiated_outputs: fmpq_mat


def _split(plant: DescriptorSystem) -> _Split | None:
    if plant.nx > MOST_STATES_EXACTLY or plant.exact is not None:
        return None
    matrices = {name: written_matrix(getattr(plant, name)) for name in ("E", "A", "C")}
    shift, inverse = _regular_point(matrices["E"], matrices["A"])
    if inverse is None:
        return None
    moved = inverse * matrices["E"]
    power = moved
    while (again := power * power).rank() < power.rank():
        power = again
    count = int(power.rank())
    if count != plant.nx - sum(structure_of(plant).infinite_block_sizes):
        # Computed data: what is exactly zero only before rounding.
        return None
    dynamic, nilpotent = _basis(power, count), null_basis(power)
    whole = blocks([[dynamic, nilpotent]])
    back = whole.inv()
    inner = back * moved * whole
    at, rest = range(count), range(count, plant.nx)
    j, n = picked_columns(picked_rows(inner, at), at), picked_columns(picked_rows(inner, rest), rest)
    driven = back * inverse * blocks([[written_matrix(getattr(plant, name)) for _, name, _, _ in _SIGNALS]])
    inverse_j = j.inv()
    g = (identity(plant.nx - count) - shift * n).inv()
    algebraic = g * picked_rows(driven, rest)
    differentiated, states = nilpotent * (g * n * algebraic), nilpotent * algebraic
    direct = blocks([[written_matrix(getattr(plant, name)) for _, _, name, _ in _SIGNALS]])
    c = matrices["C"]
    return _Split(
        shift * identity(count) - inverse_j,
        inverse_j * picked_rows(driven, at),
        c * dynamic,
        c * states + direct,
        dynamic,
        states,
        differentiated,
        c * differentiated,
    )


def _regular_point(e: fmpq_mat, a: fmpq_mat) -> tuple[fmpq, fmpq_mat | None]:
    """Return a rational s0 and ``(s0 E - A)^-1``; no inverse where the pencil is not regular."""
    for number in range(int(e.nrows()) + 1):
        # As many points as the degree of the determinant, and one more: not all of them are zeros.
        shift = fmpq(number + 1)
        pencil = shift * e - a
        if pencil.det() != 0:
            return shift, pencil.inv()
    return fmpq(0), None


def _basis(power: fmpq_mat, count: int) -> fmpq_mat:
    """Return a basis of an image in which as many rows as it has columns, the first ones possible, form an identity."""
    image = picked_columns(power, pivot_columns(power)[:count])
    rows = pivot_columns(image.transpose())
    return image * picked_rows(image, rows).inv()


def _improper(plant: DescriptorSystem, differentiated: fmpq_mat) -> tuple[tuple[str, ...], tuple[str, ...]]:
    signals = [name for *_, field in _SIGNALS for name in getattr(plant, field)]
    outputs = [name for row, name in enumerate(plant.output_names) if _is_reached(differentiated, row)]
    return tuple(outputs), tuple(name for column, name in enumerate(signals) if _acts(differentiated, column))


def _require_proper(plant: DescriptorSystem, differentiated: fmpq_mat) -> None:
    """Raise `PreconditionError` where an output needs a derivative, and name the signals."""
    outputs, needed = _improper(plant, differentiated)
    if needed:
        word = "a later sample" if plant.dt else "the derivative"
        several = len(outputs) > 1
        raise PreconditionError(
            f"The plant has index 2 or more, and its output{'s' if several else ''} {', '.join(outputs)} "
            f"need{'' if several else 's'} {word} of {', '.join(needed)}, as a constraint ties them to it: there is no "
            f"proper form with {'these outputs' if several else 'this output'}.",
            condition="index",
            signals=(*outputs, *needed),
        )


def _is_reached(matrix: fmpq_mat, row: int) -> bool:
    return any(matrix[row, column] != 0 for column in range(int(matrix.ncols())))


def _acts(matrix: fmpq_mat, column: int) -> bool:
    return any(matrix[row, column] != 0 for row in range(int(matrix.nrows())))


def _transformation(plant: DescriptorSystem, split: _Split) -> Transformation:
    dynamic, states, differentiated = split.V, split.X, split.differentiated
    a, b, c, d = split.A, split.B, split.C, split.D
    count, ends = int(a.nrows()), np.cumsum([0, plant.nu, plant.nf, plant.nd, plant.nw]).tolist()

    def parts(matrix: fmpq_mat) -> list[fmpq_mat]:
        return [picked_columns(matrix, range(first, last)) for first, last in pairwise(ends)]

    found = {"A": a, "C": c}
    found |= dict(zip(("B", "Bf", "Bd", "Bw"), parts(b), strict=True))
    found |= dict(zip(("D", "Df", "Dd", "Dw"), parts(d), strict=True))
    pivots = pivot_columns(dynamic.transpose())
    whole = not any(states[i, k] != 0 for i in pivots for k in range(int(states.ncols())))
    names = [plant.state_names[i] for i in pivots] if whole else [f"xi {i + 1}" for i in range(count)]
    computed = any(holds_computed(getattr(plant, name)) for name in ("E", "A", "C", "B", "Bf", "Bd"))
    exact = {"E": identity(count), **found}
    new = with_states(
        plant,
        names,
        E=None,
        **{name: nearest_doubles(matrix) for name, matrix in found.items()},
        exact=ExactNumbers({name: fractions_of(exact[name]) for name in DECISIVE}, computed=computed, states=plant.nx),
        uncertainty=None if plant.uncertainty is None else plant.uncertainty.left_behind("its index was reduced"),
    )
    by_input, by_fault, by_disturbance, by_noise = (nearest_doubles(part) for part in parts(states))
    recovery = StateRecovery(
        plant.state_names,
        nearest_doubles(dynamic),
        by_input,
        by_fault,
        by_disturbance,
        by_noise,
        np.eye(plant.nw),
        state_point(plant),
    )
    lost = tuple(name for row, name in enumerate(plant.state_names) if _is_reached(differentiated, row))
    text = f"reduced the index; {count} of {plant.nx} states are free, the others follow from constraints"
    return Transformation(plant, new, text, recovery, dropped=lost, is_of_lower_index=True)
