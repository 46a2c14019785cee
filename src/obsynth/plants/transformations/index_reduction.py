"""Reduction of a regular plant of index 2 or more to its minimal proper form.

Numbers as written are reduced in rational arithmetic, computed ones in floating point: there the counts of dynamic
states are those of the pencil's structure, and what is small beside rounding is zero.

With ``M = (s0 E - A)^-1 E`` at a rational s0 that is no eigenvalue, the states split into ``x = V z + W v``: V spans
the image of a power of M (the dynamic part), W its kernel. There ``M V = V J``, ``M W = W N`` with J regular and N
nilpotent, so (Weierstrass form; Dai 1989, section 1.2; Kunkel and Mehrmann 2006, section 2.1)

    ``z' = (s0 I - J^-1) z + J^-1 b q``,  ``v = G c q - G N v'``,  ``G = (I - s0 N)^-1``,

q being all signals. ``G N`` is nilpotent: v needs the derivative (discrete time: later samples) of a signal where
``(G N) G c`` has a column that is not zero. Unlike a differentiated constraint, nothing that the constraints say of the
positions and speeds is lost: z has as many entries as there are free initial values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy
from flint import fmpq, fmpq_mat

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE, but_rounding
from obsynth.numerics.suggestions import quoted_names
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exact_numbers import DECISIVE, ExactNumbers
from obsynth.plants.input_derivatives import MOST_DERIVATIVES, derivative_name, derivative_of
from obsynth.plants.pencil import in_own_units, structure_of
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.transformations.exact_elimination import EXACT_ELIMINATION_UP_TO
from obsynth.plants.transformations.recovery import StateRecovery, Transformation, state_point, with_states
from obsynth.proofs.exact_doubles import holds_computed, written_matrix
from obsynth.proofs.rational_matrices import (
    blocks,
    fractions_of,
    identity,
    nearest_doubles,
    null_basis,
    picked_columns,
    picked_rows,
    pivot_columns,
)

#: Points, in the plant's own unit of time, of which the farthest from an eigenvalue is taken in floating point.
_SHIFTS = (1.0, 0.7, 1.5, 0.3, 3.0)

_SIGNALS = (("Bu", "B", "D", "input_names"), ("Bf", "Bf", "Df", "fault_names"), ("Bd", "Bd", "Dd", "disturbance_names"),
            ("Bw", "Bw", "Dw", "noise_names"))  # fmt: skip


def reduced_index(plant: DescriptorSystem) -> Transformation | None:
    """Return the minimal proper form of a dense regular plant, and the way back to its states.

    Algebraic states and multipliers come back from states, inputs, faults, unknown inputs and noise; those that need
    the derivative of a signal and reach no output are `dropped`.

    Returns ``None`` for more than 64 states, or no dynamic state.

    Raises
    ------
    PreconditionError
        An output needs the derivative of a signal (in discrete time: a later sample), which is named.
    """
    split = _split(plant)
    if split is None:
        return None
    _require_proper(plant, split.differentiated_outputs)
    return _transformation(plant, split) if split.count else None


def improper_outputs(plant: DescriptorSystem) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the outputs that need derivatives of signals, and these signals."""
    split = _split(plant)
    return ((), ()) if split is None else _improper(plant, split.differentiated_outputs)


def with_input_derivatives(plant: DescriptorSystem) -> tuple[Transformation, tuple[str, ...]] | None:
    """Return the minimal proper form of a continuous plant whose outputs need derivatives of known inputs, which become
    known inputs of their own, and the names of these; ``None`` where outputs need those of other signals, derivatives
    of an order above three, or none.
    """
    split = None if plant.dt or plant.delays else _split(plant)
    if split is None or not split.count or not split.differentiated_outputs.any():
        return None
    if split.differentiated_outputs[:, plant.nu :].any():
        return None
    states: list[FloatArray] = []
    names: list[str] = []
    lost = (split.differentiated[:, plant.nu :] != 0.0).any(axis=1)
    for order, by_signal in enumerate(split.orders, 1):
        reached = _but_small(plant.C @ by_signal, np.abs(plant.C) @ np.abs(by_signal))
        for column, name in enumerate(plant.input_names):
            if not reached[:, column].any():
                # A state that needs it alone is not recovered.
                lost |= by_signal[:, column] != 0.0
            elif order > MOST_DERIVATIVES:
                return None
            else:
                states.append(by_signal[:, column])
                names.append(derivative_name(name, order))
    if set(names) & {*plant.input_names, *plant.output_names, *plant.state_names}:
        return None
    dropped = tuple(name for name, gone in zip(plant.state_names, lost.tolist(), strict=True) if gone)
    plain = replace(_transformation(plant, split), dropped=dropped)
    return _with_inputs(plain, names, np.column_stack(states)), tuple(names)


def _with_inputs(plain: Transformation, names: list[str], by_input: FloatArray) -> Transformation:
    """Return a transformation whose plant has more known inputs, by which states of its source ``(nx, inputs)`` are
    moved at once."""
    source, plant, recovery = plain.source, plain.plant, plain.recovery
    count, units = len(names), dict(plant.units)
    for name in names:
        base, order = derivative_of(name, source.input_names) or ("", 0)
        if unit := source.units.get(base):
            units[name] = f"{unit}/s" if order == 1 else f"{unit}/s^{order}"
    more = plant.replace(
        B=np.hstack([plant.B, np.zeros((plant.nx, count))]),
        D=np.hstack([plant.D, source.C @ by_input]),
        input_names=[*plant.input_names, *names],
        units=units,
    )
    moved = replace(recovery, from_input=np.hstack([recovery.from_input, by_input]))
    signals = ", ".join(names)
    text = f"{plain.description}; {signals} {'is an input of its own' if count == 1 else 'are inputs of their own'}"
    return replace(plain, plant=more, recovery=moved, description=text)


@dataclass(frozen=True, eq=False)
class _Split:
    """The proper form ``z' = A z + B q, y = C z + D q, x = V z + X q + (terms in derivatives of q)``, in doubles."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    V: FloatArray
    X: FloatArray
    differentiated: FloatArray  # of the states, by what is differentiated once
    differentiated_outputs: FloatArray
    orders: tuple[FloatArray, ...]  # of the states, by the first derivatives, the second ones, ...
    chosen: tuple[int, ...]  # states of which V has the rows of an identity
    exact: Mapping[str, fmpq_mat] | None  # A, B, C, D as rational numbers

    @property
    def count(self) -> int:
        """Number of dynamic states."""
        return len(self.A)


def _split(plant: DescriptorSystem) -> _Split | None:
    if plant.nx > EXACT_ELIMINATION_UP_TO:
        return None
    count = plant.nx - sum(structure_of(plant).infinite_block_sizes)
    exact_split = _split_exactly(plant, count) if plant.exact is None else None
    if exact_split is None:
        return _split_in_floating_point(plant, count)
    if not exact_split.differentiated.any() or not _holds_computed(plant):
        return exact_split
    # What computed numbers make of a derivative may be their rounding.
    rounded = _split_in_floating_point(plant, count)
    same = rounded is not None and np.array_equal(rounded.differentiated != 0.0, exact_split.differentiated != 0.0)
    return exact_split if same else rounded


def _holds_computed(plant: DescriptorSystem) -> bool:
    return any(holds_computed(getattr(plant, name)) for name in ("E", "A", "C", "B", "Bf", "Bd", "Bw"))


def _split_exactly(plant: DescriptorSystem, wanted: int) -> _Split | None:
    """Return the rational split; ``None`` where it has another number of dynamic states than the pencil within
    rounding, as computed data are exactly singular only before they were rounded."""
    matrices = {name: written_matrix(getattr(plant, name)) for name in ("E", "A", "C")}
    shift, inverse = _regular_point(matrices["E"], matrices["A"])
    if inverse is None:
        return None
    moved = inverse * matrices["E"]
    power = moved
    while (again := power * power).rank() < power.rank():
        power = again
    count = int(power.rank())
    if count != wanted:
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
    exact = {
        "A": shift * identity(count) - inverse_j,
        "B": inverse_j * picked_rows(driven, at),
        "C": c * dynamic,
        "D": c * states + direct,
    }
    orders, term = [], algebraic
    while (term := fmpq(-1) * g * n * term).rank():
        orders.append(nearest_doubles(nilpotent * term))
    others = (dynamic, states, differentiated, c * differentiated)
    chosen = tuple(int(row) for row in pivot_columns(dynamic.transpose()))
    a, b, c_reduced, d, v, x, later, outputs = map(nearest_doubles, (*exact.values(), *others))
    return _Split(a, b, c_reduced, d, v, x, later, outputs, tuple(orders), chosen, exact)


def _split_in_floating_point(plant: DescriptorSystem, count: int) -> _Split | None:
    """Return the same for computed numbers, in the plant's own units."""
    units = PlantUnits.of(plant).rounded()
    e, a = in_own_units(plant)
    signals = [getattr(plant, name) for _, name, _, _ in _SIGNALS]
    direct = np.hstack([getattr(plant, name) for _, _, name, _ in _SIGNALS])
    entering = units.rate * units.equations[:, None] * np.hstack(signals)
    outputs = units.outputs[:, None]
    c = outputs * plant.C * units.states
    shift = max(_SHIFTS, key=lambda point: float(np.linalg.svd(point * e - a, compute_uv=False)[-1]))
    pencil = shift * e - a
    moved = np.linalg.solve(pencil, e)
    # The kernel of the power, and its image, which has the index as its exponent or more.
    left_vectors, _, right_vectors = np.linalg.svd(np.linalg.matrix_power(moved, structure_of(plant).index or 1))
    image, nilpotent = left_vectors[:, :count], right_vectors[count:].T
    rows = sorted(int(row) for row in scipy.linalg.qr(image.T, mode="r", pivoting=True)[1][:count])
    dynamic = np.linalg.solve(image[rows].T, image.T).T
    basis = np.hstack([dynamic, nilpotent])
    inner = np.linalg.solve(basis, moved @ basis)
    back = np.linalg.inv(basis)
    driven = back @ np.linalg.solve(pencil, entering)
    terms = np.abs(back) @ np.abs(np.linalg.inv(pencil)) @ np.abs(entering)
    constrained = _but_small(driven[count:], terms[count:])
    j, n = inner[:count, :count], inner[count:, count:]
    g = np.linalg.inv(np.eye(plant.nx - count) - shift * n)
    algebraic = g @ constrained
    inverse_j = np.linalg.inv(j)
    # Rounding in place of zeros would link states that are not linked: the units of the reduced plant would follow it.
    sizes = np.abs(np.linalg.inv(basis)) @ np.abs(moved) @ np.abs(basis)
    sizes = np.abs(inverse_j) @ sizes[:count, :count] @ np.abs(inverse_j)
    own = but_rounding(shift * np.eye(count) - inverse_j, np.max(sizes, initial=0.0))
    entered = np.abs(inverse_j) @ terms[:count] + sizes @ terms[:count]
    b = but_rounding(inverse_j @ driven[:count], np.max(entered, axis=0, initial=0.0))
    states = _but_small(nilpotent @ algebraic, np.abs(nilpotent) @ np.abs(g) @ np.abs(constrained))
    # Entries of n that are zero were rounded beside its largest one.
    coupled = np.abs(g @ n) + np.max(np.abs(g @ n), initial=0.0)
    later = np.abs(nilpotent) @ coupled @ np.abs(algebraic)
    differentiated = _but_small(nilpotent @ g @ n @ algebraic, later)
    v, factor = units.states[:, None], units.states[rows]
    orders, term = [], algebraic
    for order in range(1, plant.nx - count + 1):
        # What is rounding beside the terms of one order is not carried on to the next.
        term = _but_small(-g @ n @ term, coupled @ np.abs(term))
        if not term.any():
            break
        orders.append(v * _but_small(nilpotent @ term, np.abs(nilpotent) @ np.abs(term)) * units.rate**order)
    return _Split(
        own * factor[:, None] / factor / units.rate,
        b * factor[:, None] / units.rate,
        _but_small(c @ dynamic, np.abs(c) @ np.abs(dynamic)) / outputs / factor,
        _but_small(c @ states, np.abs(c) @ np.abs(states)) / outputs + direct,
        v * _but_small(dynamic, np.ones_like(dynamic)) / factor,
        v * states,
        v * differentiated,
        _but_small(c @ differentiated, np.abs(c) @ np.abs(differentiated)) / outputs,
        tuple(orders),
        tuple(rows),
        None,
    )


def _but_small(values: FloatArray, sizes: FloatArray) -> FloatArray:
    """Return values without those that are only rounding beside the sizes of their terms."""
    largest = float(np.max(sizes, initial=0.0))
    return np.where(np.abs(values) > RANK_TOLERANCE * np.maximum(sizes, largest), values, 0.0)


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


def _improper(plant: DescriptorSystem, differentiated: FloatArray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    signals = [name for *_, field in _SIGNALS for name in getattr(plant, field)]
    acts = differentiated != 0.0
    outputs = tuple(name for name, reached in zip(plant.output_names, acts.any(axis=1), strict=True) if reached)
    return outputs, tuple(name for name, acting in zip(signals, acts.any(axis=0), strict=True) if acting)


def _require_proper(plant: DescriptorSystem, differentiated: FloatArray) -> None:
    """Raise `PreconditionError` where an output needs a derivative, and name the signals."""
    outputs, needed = _improper(plant, differentiated)
    if needed:
        word = "a later sample" if plant.dt else "the derivative"
        several = len(outputs) > 1
        raise PreconditionError(
            f"The plant has index 2 or more, and its output{'s' if several else ''} {quoted_names(outputs)} "
            f"need{'' if several else 's'} {word} of {quoted_names(needed)}, as a constraint ties them to it: there "
            f"is no proper form with {'these outputs' if several else 'this output'}.",
            condition="index",
            signals=(*outputs, *needed),
        )


def _transformation(plant: DescriptorSystem, split: _Split) -> Transformation:
    count, ends = split.count, np.cumsum([0, plant.nu, plant.nf, plant.nd, plant.nw]).tolist()

    def parts(matrix: FloatArray) -> list[FloatArray]:
        return [matrix[:, first:last] for first, last in pairwise(ends)]

    matrices = {"A": split.A, "C": split.C}
    matrices |= dict(zip(("B", "Bf", "Bd", "Bw"), parts(split.B), strict=True))
    matrices |= dict(zip(("D", "Df", "Dd", "Dw"), parts(split.D), strict=True))
    own_states = not split.X[list(split.chosen)].any()
    names = [plant.state_names[i] for i in split.chosen] if own_states else [f"xi {i + 1}" for i in range(count)]
    new = with_states(
        plant,
        names,
        E=None,
        **matrices,
        exact=_exact_numbers(plant, split, ends),
        uncertainty=None if plant.uncertainty is None else plant.uncertainty.left_behind("its index was reduced"),
    )
    point = state_point(plant)
    by_input, by_fault, by_disturbance, by_noise = parts(split.X)
    recovery = StateRecovery(
        plant.state_names, split.V, by_input, by_fault, by_disturbance, by_noise, np.eye(plant.nw), point
    )
    lost = (split.differentiated != 0.0).any(axis=1).tolist()
    dropped = tuple(name for name, gone in zip(plant.state_names, lost, strict=True) if gone)
    text = f"reduced the index; {count} of {plant.nx} states are free, the others follow from constraints"
    return Transformation(plant, new, text, recovery, dropped=dropped, is_of_lower_index=True)


def _exact_numbers(plant: DescriptorSystem, split: _Split, ends: list[int]) -> ExactNumbers | None:
    """Return the rational numbers that decide about the reduced plant."""
    if split.exact is None:
        return None
    (first, last), (begin, end) = (ends[1:3], ends[2:4])
    exact = {"E": identity(split.count), "A": split.exact["A"], "C": split.exact["C"]}
    for names, matrix in ((("Bf", "Bd"), split.exact["B"]), (("Df", "Dd"), split.exact["D"])):
        exact |= {
            names[0]: picked_columns(matrix, range(first, last)),
            names[1]: picked_columns(matrix, range(begin, end)),
        }
    computed = any(holds_computed(getattr(plant, name)) for name in ("E", "A", "C", "B", "Bf", "Bd"))
    return ExactNumbers({name: fractions_of(exact[name]) for name in DECISIVE}, computed=computed, states=plant.nx)
