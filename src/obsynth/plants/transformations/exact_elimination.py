"""Elimination of algebraic states in rational arithmetic: every entry of the result is rounded once.

With bases N of ker E, L of its left null space, completed by unit vectors D and P, ``x = D z + N v``,
``L A N v = -L (A D z + B u)`` and ``P E D z+ = P (A D z + A N v + B u)``: index 1 is ``L A N`` nonsingular.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import flint
import numpy as np
from flint import fmpq, fmpq_mat

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import zero_order_hold
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exact_numbers import DECISIVE, ExactNumbers
from obsynth.proofs.exact_doubles import holds_computed, written_fraction, written_matrix, written_rows
from obsynth.proofs.rational_matrices import (
    blocks,
    fractions_of,
    identity,
    nearest_doubles,
    null_basis,
    picked_columns,
    picked_rows,
    pivot_columns,
    zeros_matrix,
)

#: Plants of more states are eliminated in floating point.
EXACT_ELIMINATION_UP_TO = 64

#: Digits (binary) in which coordinates that are not rational are changed.
COORDINATE_BITS = 600

_EXACT_INPUTS = ("B", "Bf", "Bd", "Bw")

_EXACT_DIRECT = ("D", "Df", "Dd", "Dw")


@dataclass(frozen=True, eq=False)
class ExactElimination:
    """The reduced plant and the recovery of its states, in rational coordinates."""

    matrices: Mapping[str, fmpq_mat]  # ``A, B, Bf, Bd, Bw, C, D, Df, Dd, Dw`` of the reduced plant
    recovery: Mapping[str, fmpq_mat]  # ``x`` from the new states (``A``) and the signals (``B, Bf, Bd, Bw``)
    pivots: tuple[int, ...]  # states that stand for the dynamic ones
    computed: bool  # whether some of the data were computed in floating point
    sizes: Mapping[str, FloatArray]  # of ``matrices``, the sums of the sizes of all terms
    uncleaned: Mapping[str, fmpq_mat] | None = None  # ``matrices`` before what may be rounding was set to zero

    def numbers(self, sizes: Mapping[str, FloatArray], *, own: bool) -> ExactNumbers:
        """Return those of the reduced plant, with the sizes of the terms in its coordinates; ``own``: these ones."""
        matrices: dict[str, fmpq_mat] = {"E": identity(len(self.pivots)), **self.matrices}
        decisive_sizes = {name: sizes[name] for name in DECISIVE if name in sizes}
        known = all(np.all(np.isfinite(part)) for part in decisive_sizes.values())
        exact = {name: fractions_of(matrices[name]) for name in DECISIVE}
        before = None if self.uncleaned is None else {"E": matrices["E"], **self.uncleaned}
        return ExactNumbers(
            exact,
            own=own,
            computed=self.computed,
            sizes=decisive_sizes if known else None,
            states=int(self.recovery["A"].nrows()),
            uncleaned=None if before is None else {name: fractions_of(before[name]) for name in DECISIVE},
        )


def exact_elimination(plant: DescriptorSystem) -> ExactElimination | None:
    """Return the elimination; ``None`` for too many states, or where no state can be eliminated so."""
    if plant.nx > EXACT_ELIMINATION_UP_TO or plant.exact is not None:
        return None
    computed = any(holds_computed(getattr(plant, name)) for name in ("E", "A", "C", *_EXACT_INPUTS, *_EXACT_DIRECT))
    elimination = _eliminated(plant, clean=computed)
    if elimination is None or not computed:
        return elimination
    before = _eliminated(plant, clean=False, sized=False)
    if before is None or all(elimination.matrices[name] == before.matrices[name] for name in elimination.matrices):
        return replace(elimination, computed=True)
    return replace(elimination, computed=True, uncleaned=before.matrices)


def _eliminated(plant: DescriptorSystem, *, clean: bool, sized: bool = True) -> ExactElimination | None:
    """Return the elimination; with ``clean`` what rounding of computed data may have left is zero.
    Without ``sized`` the sizes of terms are left out."""
    e, a, c = (written_matrix(matrix) for matrix in (plant.E, plant.A, plant.C))
    pivots, rows = pivot_columns(e), pivot_columns(e.transpose())
    if not pivots:
        return None
    null, left_null = null_basis(e), null_basis(e.transpose()).transpose()
    signals = [written_matrix(getattr(plant, name)) for name in _EXACT_INPUTS]
    whole = identity(plant.nx)
    keep, take = picked_columns(whole, pivots), picked_rows(whole, rows)
    right = blocks([[a * keep, *signals]])
    coupling = left_null * a * null
    if plant.nx > len(pivots) and coupling.det() == 0:
        return None
    direct = blocks([[c * keep, *(written_matrix(getattr(plant, name)) for name in _EXACT_DIRECT)]])
    states = blocks([[keep, *(zeros_matrix(plant.nx, int(signal.ncols())) for signal in signals)]])
    moving, leading = take * right, take * e * keep
    # The inverses are asked for their sizes alone.
    inverses = [_sizes(part.inv()) for part in (coupling, leading)] if clean or sized else []
    sizes = [np.zeros((int(part.nrows()), int(part.ncols()))) for part in (moving, direct)]
    if sized:
        with np.errstate(all="ignore"):
            sizes = _term_sizes((left_null, right), coupling, (take, a * null), (direct, c * null), leading, inverses)
    if plant.nx > len(pivots):
        algebraic = _solved_exactly(-coupling, left_null * right, inverses[0] if clean else None)
        moving = _sum(moving, take * (a * null), algebraic, clean=clean)
        direct = _sum(direct, c * null, algebraic, clean=clean)
        states = _sum(states, null, algebraic, clean=clean)
    moving = _solved_exactly(leading, moving, inverses[1] if clean else None)
    widths = [len(pivots), *(int(signal.ncols()) for signal in signals)]
    return ExactElimination(
        dict(zip(("A", *_EXACT_INPUTS), _split_exactly(moving, widths), strict=True))
        | dict(zip(("C", *_EXACT_DIRECT), _split_exactly(direct, widths), strict=True)),
        dict(zip(("A", *_EXACT_INPUTS), _split_exactly(states, widths), strict=True)),
        tuple(pivots),
        clean,
        dict(zip(("A", *_EXACT_INPUTS), np.split(sizes[0], np.cumsum(widths)[:-1], axis=1), strict=True))
        | dict(zip(("C", *_EXACT_DIRECT), np.split(sizes[1], np.cumsum(widths)[:-1], axis=1), strict=True)),
    )


def _term_sizes(
    constraints: tuple[fmpq_mat, fmpq_mat],
    coupling: fmpq_mat,
    equations: tuple[fmpq_mat, fmpq_mat],
    outputs: tuple[fmpq_mat, fmpq_mat],
    moving: fmpq_mat,
    inverses: Sequence[FloatArray],
) -> list[FloatArray]:
    """Return the sums of the sizes of all terms, of the dynamic equations and of the outputs.
    ``inverses``: sizes of the inverses of ``coupling`` and ``moving``."""
    (left_null, right), (take, across), (direct, output) = constraints, equations, outputs
    solver, inverse = inverses
    dynamic = _sizes(take) @ _sizes(right)
    if not coupling.nrows():
        return [inverse @ (_sizes(moving) @ (inverse @ dynamic)), _sizes(direct)]
    algebraic = solver @ (_sizes(coupling) @ (solver @ (_sizes(left_null) @ _sizes(right))))
    dynamic = dynamic + _sizes(take * across) @ algebraic
    return [inverse @ (_sizes(moving) @ (inverse @ dynamic)), _sizes(direct) + _sizes(output) @ algebraic]


def rounded_once(
    elimination: ExactElimination, plant: DescriptorSystem, dynamic: FloatArray | None
) -> tuple[dict[str, FloatArray], dict[str, FloatArray], dict[str, FloatArray]]:
    """Return matrices, recovery and sizes of terms as doubles; states ``dynamic (nx, count)`` instead of the pivots."""
    if dynamic is None:
        return (
            {name: nearest_doubles(matrix) for name, matrix in elimination.matrices.items()},
            {name: nearest_doubles(matrix) for name, matrix in elimination.recovery.items()},
            dict(elimination.sizes),
        )
    e = written_matrix(plant.E)
    rows = pivot_columns((picked_columns(e, elimination.pivots)).transpose())
    with flint.ctx.workprec(COORDINATE_BITS):
        # E dynamic z = E (unit vectors) z_rational
        change = flint.arb_mat(picked_rows(e * written_matrix(dynamic), rows)).solve(
            flint.arb_mat(picked_rows(picked_columns(e, elimination.pivots), rows))
        )
        back = change.inv()

        def moved(name: str, matrix: fmpq_mat, *, recovery: bool) -> FloatArray:
            work = flint.arb_mat(matrix) if matrix.nrows() and matrix.ncols() else None
            if work is None:
                return np.zeros((int(matrix.nrows()), int(matrix.ncols())))
            if name in ("A", "C"):
                work = work * back
            if not recovery and name in ("A", *_EXACT_INPUTS):
                work = change * work
            return _doubles(work)

        return (
            {name: moved(name, matrix, recovery=False) for name, matrix in elimination.matrices.items()},
            {name: moved(name, matrix, recovery=True) for name, matrix in elimination.recovery.items()},
            _moved_sizes(elimination.sizes, np.abs(_doubles(change)), np.abs(_doubles(back))),
        )


def _moved_sizes(sizes: Mapping[str, FloatArray], change: FloatArray, back: FloatArray) -> dict[str, FloatArray]:
    """Return sizes of terms in other coordinates of the states."""
    turned = {name: size @ back if name in ("A", "C") else size for name, size in sizes.items()}
    return {name: change @ size if name in ("A", *_EXACT_INPUTS) else size for name, size in turned.items()}


def _solved_exactly(matrix: fmpq_mat, right: fmpq_mat, inverse: FloatArray | None) -> fmpq_mat:
    """Return ``matrix^-1 right``; with the sizes of ``matrix^-1``, what rounding of the data may have left is zero."""
    solution = matrix.solve(right)
    return solution if inverse is None else _cleaned(solution, inverse @ (_sizes(matrix) @ _sizes(solution)))


def _sum(direct: fmpq_mat, factor: fmpq_mat, solution: fmpq_mat, *, clean: bool) -> fmpq_mat:
    result = direct + factor * solution
    return _cleaned(result, _sizes(direct) + _sizes(factor) @ _sizes(solution)) if clean else result


def _cleaned(result: fmpq_mat, size_of_terms: FloatArray) -> fmpq_mat:
    rows, columns = size_of_terms.shape
    significant = _sizes(result) > CANCELLATION_TOLERANCE * size_of_terms
    entries = [result[i, j] if significant[i, j] else fmpq(0) for i in range(rows) for j in range(columns)]
    return fmpq_mat(rows, columns, entries)


def _sizes(matrix: fmpq_mat) -> FloatArray:
    return np.abs(nearest_doubles(matrix))


def _doubles(matrix: Any) -> FloatArray:
    rows = [[0.0 if value.contains(0) else float(value) for value in row] for row in matrix.tolist()]
    return np.array(rows, dtype=np.float64)


def _split_exactly(matrix: fmpq_mat, widths: list[int]) -> list[fmpq_mat]:
    ends = np.cumsum(widths).tolist()
    return [picked_columns(matrix, range(end - width, end)) for end, width in zip(ends, widths, strict=True)]


def sampled_exact_numbers(smooth: DescriptorSystem, sample_time: float) -> ExactNumbers:
    """Return the exact numbers behind a plant that is sampled from one with ``E = I``."""
    step, known = written_fraction(sample_time), smooth.exact
    if known is None:
        computed = any(holds_computed(getattr(smooth, name)) for name in DECISIVE)
        return ExactNumbers({name: written_rows(getattr(smooth, name)) for name in DECISIVE}, step, computed=computed)
    sizes = None if known.sizes is None else _sampled_sizes(smooth, known.sizes, sample_time)
    return replace(known, sample_time=step, sizes=sizes, states=0)


def _sampled_sizes(
    smooth: DescriptorSystem, sizes: Mapping[str, FloatArray], sample_time: float
) -> dict[str, FloatArray] | None:
    """Return the sizes of terms once sampled: what cancelled before goes through the integral of ``exp(A t)``."""
    transition, held = zero_order_hold(smooth.A, np.hstack([smooth.Bf, smooth.Bd, np.eye(smooth.nx)]), sample_time)
    faults, disturbances, integral = np.split(np.abs(held), [smooth.nf, smooth.nf + smooth.nd], axis=1)
    sampled = dict(sizes)
    for name, own in (("A", np.abs(transition)), ("Bf", faults), ("Bd", disturbances)):
        sampled[name] = own + integral @ (sizes[name] - np.abs(getattr(smooth, name)))
    return sampled if all(np.all(np.isfinite(part)) for part in sampled.values()) else None
