"""Variables without effect on a plant, such as filters with zero time constants, found by its sparsity pattern.

No output depends on them nor on what depends on them: they are left out exactly, with as many equations.  With them
the plant would have index 2, or would not be regular.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import scipy

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.pencil_points import GENERIC_POINTS
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.numerics.sparse import Indices, csr
from obsynth.numerics.sparse_factor import SparseFactor, scales_by_all_entries, sparse_factor
from obsynth.numerics.sparse_structure import CoarseStructure, blocks_of, coarse_structure, unmatched_instead
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import listed
from obsynth.plants.transformations.recovery import with_states

#: Rank that a matrix may lack beyond what its shape says, to begin with.
BORDER = 8

#: Lengths of projected states that differ by less count as equal: the first is taken, and not the one that rounding
#: makes larger.
EQUAL_LENGTHS = 1.0 - 1e-6

#: Binary digits of coordinates that are combinations: what rounding of a basis may be, times a million, is below.
BASIS_DIGITS = 20

#: How much rather a repeated equation is left out whose own variable is left out.
OTHERS_WEIGHT = 1e-3


@dataclass(frozen=True, eq=False)
class ActiveVariables:
    """What is left of a plant without its idle variables; names of these, and numbers of their equations from 1."""

    rows: Indices
    columns: Indices
    dropped: tuple[str, ...]
    equations: tuple[int, ...]

    def note(self) -> str:
        """Return one sentence for a reader; empty when nothing was dropped."""
        if not self.dropped:
            return ""
        return (
            "Left out, as they have no effect on the other variables and the outputs: "
            f"{', '.join(map(repr, self.dropped))} (with "
            f"{'equations' if len(self.equations) > 1 else 'equation'} {', '.join(map(str, self.equations))}); "
            "the rest of the plant is the same, and their values are not estimated."
        )


def active_variables(plant: DescriptorSystem) -> ActiveVariables:
    """Return which equations and variables stay: not those that act on nothing and cannot be solved for."""
    e, a, c = csr(plant.E), csr(plant.A), csr(plant.C)
    rows, columns = np.arange(plant.nx), np.arange(plant.nx)
    if not plant.ny:
        # Without any output nothing says what a variable is there for.
        return everything_active(plant)
    pattern = csr(abs(e) + abs(a))
    coarse = coarse_structure(pattern)
    if coarse.structural_rank < plant.nx:
        surplus = _surplus_equations(plant, coarse, e, a, c)
        if surplus is None:
            raise_structurally_singular(plant, coarse.over_rows, coarse.under_columns)
        rows, columns = np.setdiff1d(rows, surplus), np.setdiff1d(columns, coarse.under_columns)
        pattern = pattern[rows][:, columns]
        coarse = coarse_structure(pattern)
        if coarse.structural_rank < len(rows):
            raise_structurally_singular(plant, rows[coarse.over_rows], columns[coarse.under_columns])
    idle_rows, idle_columns = _idle(e[rows][:, columns], pattern, coarse, c[:, columns], plant, rows, columns)
    kept_rows, kept_columns = np.delete(rows, idle_rows), np.delete(columns, idle_columns)
    if not len(kept_columns):
        # No output sees anything: what is wrong with the plant is not that some variable acts on nothing.
        return everything_active(plant)
    dropped, unneeded = (np.setdiff1d(np.arange(plant.nx), active) for active in (kept_columns, kept_rows))
    names, numbers = tuple(plant.state_names[i] for i in dropped), tuple(int(i) + 1 for i in unneeded)
    return ActiveVariables(kept_rows, kept_columns, names, numbers)


def everything_active(plant: DescriptorSystem) -> ActiveVariables:
    """Return that all equations and variables stay."""
    return ActiveVariables(np.arange(plant.nx), np.arange(plant.nx), (), ())


def active_part(plant: DescriptorSystem, found: ActiveVariables) -> DescriptorSystem:
    """Return the plant without idle variables."""
    if not found.dropped:
        return plant
    rows, columns = found.rows, found.columns
    changes: dict[str, Any] = {name: getattr(plant, name)[rows] for name in ("B", "Bf", "Bd", "Bw")}
    changes |= {name: getattr(plant, name)[rows][:, columns] for name in ("E", "A")}
    return with_states(plant, [plant.state_names[i] for i in columns], C=plant.C[:, columns], **changes)


def _surplus_equations(plant: DescriptorSystem, coarse: CoarseStructure, e: Any, a: Any, c: Any) -> Indices | None:
    """Return the equations of these variables alone, and as many more as follow from others, if that is exact."""
    if c[:, coarse.under_columns].nnz or not _solvable(plant, coarse.under_rows, coarse.under_columns):
        return None
    rows = coarse.over_rows
    combinations, scale = _left_null_space(csr(a - GENERIC_POINTS[0] * e)[rows][:, coarse.over_columns])
    if not _say_nothing(plant, rows, scale, combinations):
        return None
    # By convention the equation of a variable has its number, and goes with it.
    weights = np.where(np.isin(rows, coarse.under_columns), 1.0, OTHERS_WEIGHT)
    _, _, order = scipy.linalg.qr((weights[:, None] * combinations).T, mode="economic", pivoting=True)
    # Where more equations are repeated than variables are in too few, those that the pattern can do without.
    left_out = unmatched_instead(csr(abs(e) + abs(a)), coarse, rows[order[: combinations.shape[1]]])
    return None if left_out is None else np.union1d(coarse.under_rows, left_out)


def _say_nothing(plant: DescriptorSystem, rows: Indices, scale: FloatArray, combinations: FloatArray) -> bool:
    """Whether combinations of scaled equations are ``0 = 0``, with known inputs, faults and noise as well."""
    everything = [csr(getattr(plant, name))[rows] for name in ("E", "A", "B", "Bf", "Bd", "Bw")]
    scaled = csr(scipy.sparse.diags_array(scale) @ scipy.sparse.hstack(everything))
    peaks = np.zeros(scaled.shape[1])
    np.maximum.at(peaks, scaled.indices, np.abs(scaled.data))
    combined = np.abs(scaled.T @ combinations)
    return bool(np.all(combined <= RANK_TOLERANCE * peaks[:, None] * np.max(np.abs(combinations), axis=0, initial=0.0)))


def _solvable(plant: DescriptorSystem, rows: Indices, columns: Indices) -> bool:
    """Whether equations can be solved for some of their variables, whatever the others are."""
    if not len(rows):
        return True
    part = csr(csr(plant.A) - GENERIC_POINTS[0] * csr(plant.E))[rows][:, columns]
    if len(rows) == len(columns) and not sparse_factor(part).singular:
        return True
    arrays = part.toarray()
    pencil = equilibrate_pencil(np.zeros_like(arrays), arrays)
    left_vectors, values, _ = np.linalg.svd(pencil.A)
    rank = int(np.sum(values > RANK_TOLERANCE * np.max(values, initial=np.finfo(float).tiny)))
    # Else these combinations of them are a condition on the others, and leaving them out would not be exact.
    return _say_nothing(plant, rows, pencil.rows, left_vectors[:, rank:])


def _left_null_space(tall: Any) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal left null basis of a matrix with scaled rows, and the scales: one solution, bordered.
    With random G and H ``[M G; H 0]`` is nonsingular; its left solutions for the columns of G hold the null space."""
    (count, width), rng, more = tall.shape, np.random.default_rng(2), 0
    rows, columns = scales_by_all_entries(tall)
    scaled = csr(scipy.sparse.diags_array(rows) @ tall @ scipy.sparse.diags_array(columns))
    while True:
        wanted = count - width + more
        border, below = rng.normal(size=(count, wanted)), rng.normal(size=(more, width))
        factor = SparseFactor(
            scipy.sparse.block_array([[scaled, csr(border)], [csr(below), None]] if more else [[scaled, border]])
        )
        right = np.vstack([np.zeros((width, wanted)), np.eye(wanted)])
        basis = np.linalg.qr(factor.solve_transposed(right)[:count])[0]
        _, values, turned = np.linalg.svd(np.linalg.qr(scaled.T @ basis)[1])
        null = wanted - int(np.sum(values > RANK_TOLERANCE * max(1.0, np.max(np.abs(scaled.data), initial=0.0))))
        # A border of rows costs fill, and is needed only where columns are dependent as well.
        if (more == 0 and not factor.singular) or (more and null < wanted) or more == width:
            return basis @ turned[wanted - null :].T, rows
        more = min(max(BORDER, 2 * more), width)


def _idle(
    e: Any, pattern: Any, coarse: CoarseStructure, c: Any, plant: DescriptorSystem, rows: Indices, columns: Indices
) -> tuple[Indices, Indices]:
    """Return the rows and columns of idle blocks that cannot be solved for without differentiating."""
    count, block = blocks_of(pattern, coarse.row_of_column)
    block_of_row = np.empty(len(rows), dtype=np.int64)
    block_of_row[coarse.row_of_column] = block
    links = pattern.tocoo()
    from_block, to_block = block[links.col], block_of_row[links.row]
    measured = np.zeros(count, dtype=bool)
    measured[block[np.unique(c.indices)]] = True
    measured = _spread(measured, to_block, from_block)
    moving = e.tocoo()
    inside = block_of_row[moving.row] == block[moving.col]
    differentiated = np.zeros(len(columns), dtype=bool)
    differentiated[moving.col[inside]] = True
    # What an idle block needs that is not known without differentiating makes it unknown as well.
    unknown = np.zeros(count, dtype=bool)
    unknown[block_of_row[moving.row[~differentiated[moving.col]]]] = True
    unknown[_undetermined_blocks(plant, rows, columns, block_of_row, block, ~measured)] = True
    unknown = _spread(unknown & ~measured, from_block, to_block, within=~measured) & ~measured
    idle = np.flatnonzero(unknown[block_of_row]), np.flatnonzero(unknown[block])
    nothing = np.zeros(0, dtype=np.int64)
    return idle if _solvable(plant, rows[idle[0]], columns[idle[1]]) else (nothing, nothing)


def _spread(marked: Any, source: Indices, target: Indices, *, within: Any = None) -> Any:
    """Mark every target of a link whose source is marked, until nothing changes."""
    spread = marked.copy()
    while True:
        more = spread.copy()
        more[target[spread[source]]] = True
        more &= True if within is None else within
        if np.array_equal(more, spread):
            return spread
        spread = more


def _undetermined_blocks(
    plant: DescriptorSystem, rows: Indices, columns: Indices, block_of_row: Indices, block: Indices, idle: Any
) -> list[int]:
    """Return the idle blocks that their equations do not determine."""
    # A block of one variable is its entry, which is there.
    several = np.flatnonzero(idle & (np.bincount(block, minlength=len(idle)) > 1))
    if not several.size:
        return []
    pencil = csr(csr(plant.A) - GENERIC_POINTS[0] * csr(plant.E))
    parts = ((number, rows[block_of_row == number], columns[block == number]) for number in several)
    return [int(number) for number, own, variables in parts if sparse_factor(pencil[own][:, variables]).singular]


def raise_structurally_singular(plant: DescriptorSystem, equations: Indices, variables: Indices) -> NoReturn:
    """Refuse a plant whose pattern alone leaves variables free, and name them and the surplus equations."""
    equations, variables = own_first(equations, variables), own_first(variables, equations)
    names = [plant.state_names[i] for i in variables]
    raise PreconditionError(
        "The plant is not regular, det(A - zE) is zero for every z and all values of the entries: "
        f"{listed([repr(name) for name in names])} {'is' if len(names) == 1 else 'are'} in too few equations, and "
        f"equations {listed([equation_name(plant, i) for i in equations])} hold too few variables. Check for a "
        "missing or repeated equation.",
        condition="regularity",
        signals=names,
    )


def own_first(places: Indices, others: Indices) -> Indices:
    """Return the places with those first that are among others: equations of such variables, or the reverse."""
    return places[np.argsort(~np.isin(places, others), kind="stable")]


def equation_name(plant: DescriptorSystem, row: int) -> str:
    """Return the number of an equation and the variable of the same number, whose equation it is by convention."""
    return f"{int(row) + 1} (of {plant.state_names[int(row)]!r})"


def settled_basis(directions: FloatArray) -> FloatArray:
    """Return a basis ``(n, m)`` of the span of orthonormal columns that does not hang on how these were turned.

    Singular vectors of values that are equal are any, and so is every sign: another machine would make another plant.
    This one is the pivoted Cholesky factor of the projection, in few digits: any basis that E tells apart will do.
    """
    remainder, columns = directions @ directions.T, []
    for _ in range(directions.shape[1]):
        sizes = np.diag(remainder)
        first = int(np.flatnonzero(sizes >= EQUAL_LENGTHS * np.max(sizes))[0])
        columns.append(remainder[:, first] / np.sqrt(sizes[first]))
        remainder = remainder - np.outer(columns[-1], columns[-1])
    return np.asarray(np.ldexp(np.round(np.ldexp(np.array(columns).T, BASIS_DIGITS)), -BASIS_DIGITS))
