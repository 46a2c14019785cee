"""Variables that act on nothing: found by the pattern of a plant, named, and left out exactly.

A filter whose time constants are zero may ask for the derivative of what it filters, or may leave its output free.
When neither an output nor a state depends on such a variable, it can be left out together with its equation: what is
left is determined by the other equations alone.  With it the plant would have index 2, or would not be regular.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.sparse import Indices, blocks_of, coarse_structure, csr
from obsynth.numerics.sparse_factor import SparseFactor
from obsynth.plants.descriptor import DescriptorSystem

#: A point without meaning, at which a pencil has its normal rank.
GENERIC_POINT = 0.7391
#: Steps of subspace iteration for left null vectors of a pencil, whose other singular values are far away.
SUBSPACE_STEPS = 3


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
            f"Left out, since they act on no state and no output: {', '.join(map(repr, self.dropped))} (with "
            f"equation{'s' if len(self.equations) > 1 else ''} {', '.join(map(str, self.equations))}); nothing else "
            "changes, and their values are not estimated."
        )


def active_variables(plant: DescriptorSystem) -> ActiveVariables:
    """Return which equations and variables stay: not those that act on nothing and cannot be solved for."""
    e, a, c = csr(plant.E), csr(plant.A), csr(plant.C)
    rows, columns = np.arange(plant.nx), np.arange(plant.nx)
    if not plant.ny:
        # Without any output nothing says what a variable is there for.
        return ActiveVariables(rows, columns, (), ())
    unused = np.flatnonzero(_empty_columns(e) & _empty_columns(a) & _empty_columns(c))
    if unused.size:
        gone = _repeated_equations(plant, e, a, unused)
        rows, columns = np.delete(rows, gone), np.delete(columns, unused)
    idle_rows, idle_columns = _idle(e[rows][:, columns], a[rows][:, columns], c[:, columns], plant, rows, columns)
    kept_rows, kept_columns = np.delete(rows, idle_rows), np.delete(columns, idle_columns)
    dropped, unneeded = (np.setdiff1d(np.arange(plant.nx), kept) for kept in (kept_columns, kept_rows))
    names, numbers = tuple(plant.state_names[i] for i in dropped), tuple(int(i) + 1 for i in unneeded)
    return ActiveVariables(kept_rows, kept_columns, names, numbers)


def active_part(plant: DescriptorSystem, found: ActiveVariables) -> DescriptorSystem:
    """Return the plant without idle variables."""
    from obsynth.analysis.transformations.recovery import with_states

    if not found.dropped:
        return plant
    rows, columns = found.rows, found.columns
    changes: dict[str, Any] = {name: getattr(plant, name)[rows] for name in ("B", "Bf", "Bd", "Bw")}
    changes |= {name: getattr(plant, name)[rows][:, columns] for name in ("E", "A")}
    return with_states(plant, [plant.state_names[i] for i in columns], C=plant.C[:, columns], **changes)


def _empty_columns(matrix: Any) -> Any:
    return np.bincount(matrix.indices, minlength=matrix.shape[1]) == 0


def _repeated_equations(plant: DescriptorSystem, e: Any, a: Any, unused: Indices) -> Indices:
    """Return as many equations that follow from others as there are variables in no equation."""
    from scipy.sparse import hstack

    inputs = [csr(matrix) for matrix in (plant.B, plant.Bf, plant.Bd, plant.Bw) if matrix.shape[1]]
    found = _left_null_space(csr(a - GENERIC_POINT * e), len(unused))
    # A combination with constant coefficients, of known inputs, faults and noise as well: only then nothing is lost.
    everything = csr(hstack([e, a, *inputs]))
    left = np.abs(everything.T @ found)
    sizes = np.abs(everything.T) @ np.abs(found)
    # An equation without any term is no repetition: something is missing there.
    empty = bool(np.any(np.diff(everything.indptr) == 0))
    if empty or np.any(left > RANK_TOLERANCE * np.max(sizes, initial=0.0)):
        names = [plant.state_names[i] for i in unused]
        raise PreconditionError(
            f"The plant is not regular, det(A - zE) is zero for every z: {listed(names)} "
            f"{'is' if len(names) == 1 else 'are'} in no equation and no output, and no equation repeats others. Check "
            "for missing terms.", condition="regularity", signals=names,
        )  # fmt: skip
    own = found[unused]
    if np.linalg.svd(own, compute_uv=False)[-1] > np.sqrt(RANK_TOLERANCE) * np.max(np.abs(found)):
        return unused
    from scipy.linalg import qr

    _, _, order = qr(found.T, mode="economic", pivoting=True)
    return np.sort(np.asarray(order[: len(unused)], dtype=np.int64))


def _left_null_space(matrix: Any, count: int) -> FloatArray:
    """Return an orthonormal basis of ``count`` left null vectors, by subspace iteration."""
    factor = SparseFactor(matrix)
    basis = np.linalg.qr(np.random.default_rng(2).normal(size=(matrix.shape[0], count)))[0]
    for _ in range(SUBSPACE_STEPS):
        basis = np.linalg.qr(factor.solve_transposed(np.linalg.qr(factor.solve_unrefined(basis))[0]))[0]
    return np.asarray(basis)


def _idle(e: Any, a: Any, c: Any, plant: DescriptorSystem, rows: Indices, columns: Indices) -> tuple[Indices, Indices]:
    """Return the rows and columns of idle blocks that cannot be solved for without differentiating."""
    pattern = csr(abs(e) + abs(a))
    coarse = coarse_structure(pattern)
    if coarse.structural_rank < pattern.shape[0]:
        raise_structurally_singular(plant, rows[coarse.over_rows], columns[coarse.under_columns])
    count, block = blocks_of(pattern, coarse.row_of_column)
    block_of_row = np.empty(len(rows), dtype=np.int64)
    block_of_row[coarse.row_of_column] = block
    acting = np.zeros(count, dtype=bool)
    moving = e.tocoo()
    inside = block_of_row[moving.row] == block[moving.col]
    acting[block[moving.col[inside]]] = True
    acting[block[np.unique(c.indices)]] = True
    links = pattern.tocoo()
    from_block, to_block = block[links.col], block_of_row[links.row]
    acting = _spread(acting, to_block, from_block)
    # What an idle block needs that is not known without differentiating makes it unknown as well.
    unknown = np.zeros(count, dtype=bool)
    unknown[block_of_row[moving.row]] = True
    unknown[_undetermined_blocks(plant, rows, columns, block_of_row, block, ~acting)] = True
    unknown = _spread(unknown & ~acting, from_block, to_block, within=~acting) & ~acting
    return np.flatnonzero(unknown[block_of_row]), np.flatnonzero(unknown[block])


def _spread(marked: Any, source: Indices, target: Indices, *, within: Any = None) -> Any:
    """Mark every target of a link whose source is marked, until nothing changes."""
    found = marked.copy()
    while True:
        more = found.copy()
        more[target[found[source]]] = True
        more &= True if within is None else within
        if np.array_equal(more, found):
            return found
        found = more


def _undetermined_blocks(
    plant: DescriptorSystem, rows: Indices, columns: Indices, block_of_row: Indices, block: Indices, idle: Any
) -> list[int]:
    """Return the idle blocks that their equations do not determine, but where these ask nothing of other variables."""
    from scipy.sparse import hstack

    found = []
    # A block of one variable is its entry of A, which is there.
    several = np.flatnonzero(idle & (np.bincount(block, minlength=len(idle)) > 1))
    everything = csr(hstack([csr(getattr(plant, name)) for name in ("E", "A", "B", "Bf", "Bd", "Bw")]))
    for number in several:
        own, variables = rows[block_of_row == number], columns[block == number]
        inner = csr(plant.A)[own][:, variables]
        if SparseFactor(inner).singular:
            left, values, _ = np.linalg.svd(inner.toarray())
            free = left[:, values <= RANK_TOLERANCE * max(float(values[0]), np.finfo(float).tiny)]
            terms = np.abs(everything[own].T) @ np.abs(free)
            # Else they are a condition on the others, and leaving them out would not be exact.
            if np.all(np.abs(everything[own].T @ free) <= RANK_TOLERANCE * np.max(terms, initial=0.0)):
                found.append(int(number))
    return found


def raise_structurally_singular(plant: DescriptorSystem, equations: Indices, variables: Indices) -> None:
    """Refuse a plant whose pattern alone leaves variables free, and name them and the surplus equations."""
    names = [plant.state_names[i] for i in variables]
    raise PreconditionError(
        "The plant is not regular, det(A - zE) is zero for every z and whatever the numbers are: "
        f"{listed(names)} {'is' if len(names) == 1 else 'are'} in too few equations, and equations "
        f"{listed([equation_name(plant, i) for i in equations], quoted=False)} hold too few variables. Check for a "
        "missing or repeated equation.", condition="regularity", signals=names,
    )  # fmt: skip


def equation_name(plant: DescriptorSystem, row: int) -> str:
    """Return the number of an equation and the variable of the same number, whose equation it is by convention."""
    return f"{int(row) + 1} (of {plant.state_names[int(row)]!r})"


def listed(names: list[str], *, most: int = 6, quoted: bool = True) -> str:
    """Return some names in words, and how many more there are."""
    shown = [repr(name) if quoted else name for name in names[:most]]
    return ", ".join(shown) + (f" and {len(names) - most} more" if len(names) > most else "")
