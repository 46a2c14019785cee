"""Elimination of the algebraic states of a large index-1 plant, by its sparsity."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.pencil_points import GENERIC_POINTS
from obsynth.numerics.ranks import NAMED_SHARE, RANK_TOLERANCE, numerical_rank, product_but_rounding
from obsynth.numerics.scaling import power_of_two_below
from obsynth.numerics.sparse import csr, dense, selection
from obsynth.numerics.sparse_factor import SolutionBounds, scales_by_all_entries, sparse_factor
from obsynth.numerics.sparse_structure import coarse_structure, components_of
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import listed
from obsynth.plants.transformations.idle_variables import (
    ActiveVariables,
    active_part,
    equation_name,
    own_first,
    settled_basis,
)
from obsynth.plants.transformations.recovery import StateRecovery, Transformation, state_point, with_states
from obsynth.plants.transformations.recovery_operator import RecoveryOperator, without_rounding

#: What to do about constraints that have to be differentiated.
INDEX_ADVICE = (
    "Combine the equations in which the force of a constraint acts so that it drops out, or differentiate the "
    "constraint (0 = a x becomes a x' = 0: move a from its row of A to that of E; this adds an integrator). Without "
    "elimination, obsynth check says which methods take the descriptor form."
)


def reduced_by_sparsity(plant: DescriptorSystem) -> Transformation | None:
    """Solve the algebraic equations of a plant with sparse factors; ``None`` where it does not have index 1.

    A note names states whose derivatives were taken as zero.
    """
    (dynamic_rows, algebraic_rows, dynamic, algebraic), names, neglected = split_by_derivatives(plant)
    count = dynamic.shape[1]
    if count == 0:
        raise PreconditionError(
            "Every state is algebraic: nothing is left after elimination. Solve the equations directly.",
            condition="dynamic states",
        )
    a, c = csr(plant.A), csr(plant.C)
    counts = (count, plant.nu, plant.nf, plant.nd, plant.nw)
    signals = np.hstack([dense(matrix) for matrix in (plant.B, plant.Bf, plant.Bd, plant.Bw)])
    inner = csr(algebraic_rows @ a @ algebraic)
    factor = sparse_factor(inner)
    if factor.singular:
        return None
    right = _side_by_side(algebraic_rows @ a @ dynamic, algebraic_rows @ csr(signals))
    solved, backward = factor.solve_with_error(right.toarray())
    solved[:, count:] = without_rounding(factor, solved[:, count:])
    solution = -solved
    dynamics = _side_by_side(dynamic_rows @ a @ dynamic, dynamic_rows @ csr(signals)).toarray()
    mass = sparse_factor(dynamic_rows @ csr(plant.E) @ dynamic)
    moved, backward_of_e = mass.solve_with_error(
        product_but_rounding(csr(dynamic_rows @ a @ algebraic), solution, dynamics)
    )
    direct = np.hstack([(c @ dynamic).toarray(), *(dense(m) for m in (plant.D, plant.Df, plant.Dd, plant.Dw))])
    outputs = product_but_rounding(csr(c @ algebraic), solution, direct)
    ends = np.cumsum(counts)[:-1]
    matrices = dict(zip(("A", "B", "Bf", "Bd", "Bw"), np.split(moved, ends, axis=1), strict=True))
    matrices |= dict(zip(("C", "D", "Df", "Dd", "Dw"), np.split(outputs, ends, axis=1), strict=True))
    operator = RecoveryOperator(dynamic, algebraic, inner, right, counts)
    recovery = StateRecovery.from_operator(plant.state_names, operator, np.eye(plant.nw), state_point(plant))
    bounds = SolutionBounds(max(factor.condition, mass.condition), max(backward, backward_of_e))
    notes = (
        f"Taken as algebraic, since the coefficients of their derivatives in E are less than {RANK_TOLERANCE:g} of the "
        f"largest in suitable units: {listed([repr(name) for name in neglected])}. Give E zeros there, or larger "
        "entries.",
    )
    reduced = with_states(plant, names, E=None, **matrices)
    return Transformation(plant, reduced, "", recovery, notes=notes if neglected else (), bounds=bounds)


def split_by_derivatives(
    plant: DescriptorSystem,
) -> tuple[tuple[Any, Any, Any, Any], tuple[str, ...], tuple[str, ...]]:
    """Return combinations of equations with E ``(count, nx)`` and without, bases of the states that E moves
    ``(nx, count)`` and does not, names of the former, and states whose derivatives count as zero beside the others.
    E is decomposed component by component of its pattern; names are their own where these are whole states."""
    e, a = csr(plant.E), csr(plant.A)
    parts = _components(e)
    pieces = _split(e, parts, _scales(e, a))
    if len(pieces.dynamic) < coarse_structure(e).structural_rank:
        # Small entries of E may be a matter of units: judged again with those that suit all entries.
        pieces = _split(e, parts, scales_by_all_entries(csr(abs(e) + abs(a))))
    moving = sorted(pieces.dynamic, key=lambda piece: piece[0])
    names = tuple(
        plant.state_names[piece[1][0]] if len(piece[1]) == 1 else f"xi {k}" for k, piece in enumerate(moving, 1)
    )
    neglected = tuple(plant.state_names[i] for i in sorted(set(pieces.neglected)))
    return pieces.matrices(), names, neglected


def _components(e: Any) -> list[tuple[Any, Any, FloatArray]]:
    """Return rows, columns and entries of the connected components of a sparse matrix."""
    row_part, column_part = components_of(e)
    moving = e.tocoo()
    with_entries = np.unique(row_part[moving.row])
    order = np.argsort(row_part, kind="stable"), np.argsort(column_part, kind="stable")
    starts = [np.searchsorted(part[o], with_entries) for part, o in zip((row_part, column_part), order, strict=True)]
    ends = [
        np.searchsorted(part[o], with_entries, side="right")
        for part, o in zip((row_part, column_part), order, strict=True)
    ]
    # Most components are single entries: slicing each would take most of the time.
    single = np.bincount(row_part[moving.row], weights=moving.data)[with_entries][:, None, None]
    blocks = []
    for k in range(len(with_entries)):
        rows = order[0][starts[0][k] : ends[0][k]]
        columns = order[1][starts[1][k] : ends[1][k]]
        block = e[rows][:, columns].toarray() if len(rows) * len(columns) > 1 else single[k]
        blocks.append((rows, columns, block))
    return blocks


def _split(e: Any, parts: list[tuple[Any, Any, FloatArray]], scales: tuple[FloatArray, FloatArray]) -> _Pieces:
    pieces, (row_scale, column_scale) = _Pieces(e.shape[0]), scales
    blocks = [
        (rows, columns, row_scale[rows][:, None] * block * column_scale[columns]) for rows, columns, block in parts
    ]
    largest = max((float(np.linalg.norm(block, 2)) for _, _, block in blocks), default=0.0)
    for rows, columns, block in blocks:
        pieces.add(rows, columns, block, row_scale[rows], column_scale[columns], largest)
    in_row, in_column = np.diff(e.indptr) > 0, np.bincount(e.indices, minlength=e.shape[1]) > 0
    pieces.rest(np.flatnonzero(~in_row), np.flatnonzero(~in_column))
    return pieces


class _Pieces:
    """Collects rows and columns of dynamic and algebraic parts, one component of E after the other."""

    def __init__(self, count: int) -> None:
        self.count = count
        # Each is a list of (place for sorting, indices, values).
        self.dynamic_rows: list[tuple[int, Any, FloatArray]] = []
        self.algebraic_rows: list[tuple[int, Any, FloatArray]] = []
        self.dynamic: list[tuple[int, Any, FloatArray]] = []
        self.algebraic: list[tuple[int, Any, FloatArray]] = []
        # States whose derivative has a coefficient, but one too small beside the others.
        self.neglected: list[int] = []

    def add(self, rows: Any, columns: Any, block: FloatArray, row_scale: Any, column_scale: Any, norm: float) -> None:
        """Split one component by its singular values, beside the norm of all of E."""
        if block.shape == (1, 1):
            whole_rows = whole_columns = abs(block[0, 0]) > RANK_TOLERANCE * norm
            rank = int(whole_rows)
            left_vectors, right_vectors, values = np.ones((1, 1)), np.ones((1, 1)), np.abs(block[0])
        else:
            left_vectors, values, right_vectors = np.linalg.svd(block)
            rank = numerical_rank(values, scale=norm)
            whole_rows, whole_columns = rank == len(rows), rank == len(columns)
            if not whole_columns:
                right_vectors[:rank] = settled_basis(right_vectors[:rank].T).T
        for k in range(rank, len(values)):
            if values[k] > len(values) * np.finfo(float).eps * values[0]:
                self.neglected.append(int(columns[np.argmax(np.abs(right_vectors[k]))]))
        self._put(self.dynamic_rows, self.algebraic_rows, rows, left_vectors.T * row_scale, rank, whole=whole_rows)
        self._put(self.dynamic, self.algebraic, columns, right_vectors * column_scale, rank, whole=whole_columns)

    def _put(self, target: Any, others: Any, places: Any, basis: FloatArray, rank: int, *, whole: bool) -> None:
        if whole:
            target += [(int(place), np.array([place]), np.ones(1)) for place in places]
            return
        target += [(int(places[0]), places, basis[k]) for k in range(rank)]
        others += [(int(places[0]), places, basis[k]) for k in range(rank, len(places))]

    def rest(self, rows: Any, columns: Any) -> None:
        """Add the equations and states that E does not touch."""
        self.algebraic_rows += [(int(row), np.array([row]), np.ones(1)) for row in rows]
        self.algebraic += [(int(column), np.array([column]), np.ones(1)) for column in columns]

    def matrices(self) -> tuple[Any, Any, Any, Any]:
        """Return the whole, in the order of equations and states: rows, then states as columns."""
        rows = self._matrix(self.dynamic_rows), self._matrix(self.algebraic_rows)
        return *rows, csr(self._matrix(self.dynamic).T), csr(self._matrix(self.algebraic).T)

    def _matrix(self, pieces: list[tuple[int, Any, FloatArray]]) -> Any:
        ordered = sorted(pieces, key=lambda piece: piece[0])
        if all(len(piece[1]) == 1 for piece in ordered):
            return selection([piece[0] for piece in ordered], self.count)
        starts = np.concatenate([[0], np.cumsum([len(piece[1]) for piece in ordered])])
        indices = np.concatenate([piece[1] for piece in ordered])
        values = np.concatenate([piece[2] for piece in ordered])
        return scipy.sparse.csr_array((values, indices, starts), shape=(len(ordered), self.count))


def _scales(e: Any, a: Any) -> tuple[FloatArray, FloatArray]:
    """Return the powers of two that bring the rows, then the columns, of ``[E A]`` near one."""

    def peaks(matrix: Any) -> FloatArray:
        largest = np.asarray(scipy.sparse.csc_array(abs(matrix)).max(axis=0).toarray()).ravel()
        return np.asarray(largest, dtype=np.float64)

    rows = 1.0 / power_of_two_below(np.maximum(peaks(e.T), peaks(a.T)))
    scaled = [matrix.multiply(rows[:, None]) for matrix in (e, a)]
    return rows, 1.0 / power_of_two_below(np.maximum(peaks(scaled[0]), peaks(scaled[1])))


def not_index_one(
    plant: DescriptorSystem, active: ActiveVariables, said: PreconditionError | None = None
) -> PreconditionError:
    """Return the refusal of a plant that does not have index 1 without its idle variables either: which part, and why.
    It goes on where ``said`` refused; its signals are the variables, none where nothing was found wrong."""
    part = active_part(plant, active)
    (_, algebraic_rows, _, algebraic), _, _ = split_by_derivatives(part)
    inner = csr(algebraic_rows @ csr(part.A) @ algebraic)
    factor = sparse_factor(inner)
    smallest, left_null, right_null = factor.null_vectors()
    if not factor.exactly_singular and smallest > RANK_TOLERANCE:
        return said or PreconditionError("", condition="index")
    generic = [sparse_factor(csr(part.A) - point * csr(part.E)) for point in GENERIC_POINTS[:2]]
    regular = any(not verdict.singular for verdict in generic)
    if regular:
        equations, variables = _leading(algebraic_rows, algebraic, left_null, right_null, inner)
    else:
        equations, variables = map(_named, generic[0].null_vectors()[1:])
    # As the plant was given: equations and variables that were left out count.
    variables = active.columns[variables]
    equations = own_first(active.rows[equations], variables)
    names = tuple(plant.state_names[i] for i in variables)
    numbers = listed([equation_name(plant, i) for i in equations])
    does = f"equation {numbers} does" if len(equations) == 1 else f"equations {numbers} do"
    does = f"{does} not determine {listed([repr(name) for name in names])}"
    if not regular:
        return PreconditionError(
            f"The plant is not regular: det(A - zE) is zero for every z, and {does}. Check for a missing or repeated "
            "equation.",
            condition="regularity",
            signals=names,
        )
    if said is not None and said.condition == "index":
        return PreconditionError(f"{said} {does[0].upper()}{does[1:]}.", condition="index", signals=names)
    return PreconditionError(
        f"The plant has index 2 or more: {does} without differentiating. {INDEX_ADVICE}",
        condition="index",
        signals=names,
    )


def _leading(rows: Any, basis: Any, left_null: FloatArray, right_null: FloatArray, inner: Any) -> tuple[Any, Any]:
    """Return the equations and variables of the null vectors; by the pattern alone, where that is singular already."""
    coarse = coarse_structure(inner)
    if coarse.structural_rank < inner.shape[0]:
        over, under = np.zeros(inner.shape[0]), np.zeros(inner.shape[0])
        over[coarse.over_rows], under[coarse.under_columns] = 1.0, 1.0
        return _named(abs(rows).T @ over), _named(abs(basis) @ under)
    return _named(abs(rows).T @ left_null), _named(abs(basis) @ right_null)


def _named(shares: FloatArray) -> Any:
    """Return the places of the leading entries, largest first."""
    order = np.argsort(-shares, kind="stable")
    return order[shares[order] >= NAMED_SHARE * max(float(np.max(shares, initial=0.0)), np.finfo(float).tiny)]


def _side_by_side(*blocks: Any) -> Any:
    return csr(scipy.sparse.hstack([csr(block) for block in blocks]))
