"""A plant over the box of its constants: matrices with proved remainders, transformed like the plant itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import UNTOUCHED_SHARE
from obsynth.plants.constants import ConstantsBox
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import algebraic_coordinates
from obsynth.plants.uncertainty import SAMPLED, UNCERTAIN_MATRICES, Uncertainty, as_written, matrices_of
from obsynth.proofs.affine import AffineMatrix, affine_block, affine_inverse, affine_zero_order_hold
from obsynth.proofs.balls import rounded_up

#: Their coordinates are rounded to this many digits: any invertible change of coordinates is exact.
COORDINATE_DIGITS = 9

#: What one state does to a row counts as rounding below this share of all that the row holds.
ROW_ROUNDING_SHARE = 1e-9

#: Inputs, in the order in which they stand side by side.
_INPUT_MATRICES, _DIRECT = ("B", "Bf", "Bd"), ("D", "Df", "Dd")


@dataclass(frozen=True, eq=False)
class AffinePlant:
    """The matrices ``E, A, ..., Dd`` of a plant over a box, for the state ``x'`` with ``x = coordinates x'``."""

    plant: DescriptorSystem
    box: ConstantsBox
    matrices: Mapping[str, AffineMatrix]
    coordinates: FloatArray
    #: Where disturbances move between samples: Bd and Dd have so many times their columns, then those of
    #: ``rest (k, nd)``, which says how far each goes per disturbance, and then those of the values at the samples.
    blocks: int = 0
    rest: FloatArray | None = None

    def disturbance_bounds(self, bounds: FloatArray) -> FloatArray:
        """Return the bounds of the columns of Bd and Dd for those of the disturbances ``(nd,)``."""
        rest = np.zeros(0) if self.rest is None else sums_of_bounds(self.rest, bounds)
        return np.concatenate([np.tile(bounds, self.blocks), rest, bounds])

    def __getattr__(self, name: str) -> AffineMatrix:
        """Return a matrix by its letter."""
        if name in UNCERTAIN_MATRICES:
            return self.matrices[name]
        raise AttributeError(name)

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return len(self.box.names)

    @property
    def offsets(self) -> FloatArray:
        """Where the nominal plant is in the unknowns."""
        return self.box.offsets


def sums_of_bounds(sizes: FloatArray, bounds: FloatArray) -> FloatArray:
    """Return ``sizes @ bounds``, rounded up, where zero times infinity is zero."""
    with np.errstate(invalid="ignore"):
        total = np.sum(np.where(sizes > 0.0, sizes * bounds, 0.0), axis=1)
    return np.asarray(np.where(total > 0.0, rounded_up(total, len(bounds) + 2), 0.0))


def affine_plant(plant: DescriptorSystem, box: ConstantsBox | None = None) -> AffinePlant:
    """Return a plant over a box of its constants; refused where algebraic rows move or what is inverted is singular."""
    uncertain = plant.uncertainty
    if uncertain is None:
        exact = {name: AffineMatrix.exact(matrix, 0) for name, matrix in matrices_of(plant).items()}
        return AffinePlant(plant, ConstantsBox({}), exact, np.eye(plant.nx))
    box = uncertain.box if box is None else box
    if not uncertain.steps:
        matrices = uncertain.affine(as_written(plant, uncertain), box)
        basis = untouched_coordinates(matrices)
        if not np.array_equal(basis, np.eye(len(basis))):
            matrices |= {name: matrices[name] @ basis for name in ("E", "A", "C")}
        return AffinePlant(plant, box, matrices, basis)
    # E(p) of the next sample has other constants than A(p) of this one: inverted, both would have the same.
    apart = box.variation == "varying" and all(kind != SAMPLED for kind, _ in uncertain.steps)
    reduced, basis = reduced_family(plant, uncertain, box, inverted=not apart)
    for kind, size in uncertain.steps:
        if kind == SAMPLED:
            inputs = affine_block([[reduced[name] for name in _INPUT_MATRICES]])
            a, held = affine_zero_order_hold(reduced["A"], inputs, size)
            reduced = {**reduced, "A": a, **_split(held, reduced, _INPUT_MATRICES)}
    back = {name: reduced[name].after(basis) for name in ("E", "A", *_INPUT_MATRICES)}
    return AffinePlant(plant, box, {**reduced, **back}, basis)


def moving_family(plant: DescriptorSystem, box: ConstantsBox, basis: FloatArray | None = None) -> AffineMatrix:
    """Return A over a box, without algebraic states, E inverted, before sampling, in ``basis`` of the dynamic state."""
    uncertain = plant.uncertainty
    if uncertain is None:
        return AffineMatrix.exact(plant.A, 0)
    written = as_written(plant, uncertain)
    return reduced_matrices(written, uncertain.affine(written, box), basis)["A"]


def reduced_family(
    plant: DescriptorSystem, uncertain: Uncertainty, box: ConstantsBox | None = None, *, inverted: bool = True
) -> tuple[dict[str, AffineMatrix], FloatArray]:
    """Return a plant over its box (or another) without algebraic states, and its coordinates.
    ``inverted``: E is inverted at each point of the box; else only at the nominal values, and E stays a family."""
    written = as_written(plant, uncertain)
    box = uncertain.box if box is None else box
    matrices, values = uncertain.affine(written, box), None
    if not inverted:
        values = uncertain.filled(written, {name: item.nominal for name, item in box.constants.items()})["E"]
    first = reduced_matrices(written, matrices, None, values)
    basis = untouched_coordinates(first)
    same = np.array_equal(basis, np.eye(len(basis)))
    return (first if same else reduced_matrices(written, matrices, basis, values)), basis


def moving_basis(plant: DescriptorSystem, box: ConstantsBox) -> FloatArray:
    """Return coordinates of the dynamic state in which what no constant touches is a state of its own."""
    uncertain = plant.uncertainty
    if uncertain is None:
        return np.eye(plant.nx)
    written = as_written(plant, uncertain)
    return untouched_coordinates(reduced_matrices(written, uncertain.affine(written, box), None))


def untouched_states(columns: FloatArray, sizes: FloatArray) -> list[int]:
    """Return states that drive none but each other: ``columns (m, n)`` of what they do, rows of A first.
    ``sizes (m,)``: of the rows; what is below `ROW_ROUNDING_SHARE` of these is rounding."""
    n = columns.shape[1]
    acting = np.abs(columns) > ROW_ROUNDING_SHARE * np.maximum(sizes, np.finfo(np.float64).tiny)[:, None]
    untouched = [j for j in range(n) if not acting[n:, j].any()]
    while True:
        others = [i for i in range(n) if i not in untouched]
        untouched_by_others = [j for j in untouched if not acting[others, j].any()]
        if untouched_by_others == untouched:
            return untouched
        untouched = untouched_by_others


def untouched_coordinates(matrices: Mapping[str, AffineMatrix]) -> FloatArray:
    """Return ``V (n, n)``, with inverse ``2 I - V``: columns of E V, A V, C V that the constants do not touch, if any.
    States whose own equations the constants move most become relative to those that they move least."""
    from obsynth.numerics.lapack import dgeqp3

    # What the constants multiply the state with, all rows of all of them.
    touched = np.vstack([matrices[name].parts.reshape(-1, matrices[name].shape[1]) for name in ("E", "A", "C")])
    n, moved = touched.shape[1], _moved(matrices)
    sizes = np.linalg.norm(touched, axis=1)
    rows = touched[sizes > 0.0] / sizes[sizes > 0.0][:, None]
    if not len(rows):
        return np.eye(n)
    _, values, right = np.linalg.svd(rows, full_matrices=False)
    rank = int(np.sum(values > UNTOUCHED_SHARE * values[0]))
    basis = right[:rank]
    reached = np.flatnonzero(np.abs(basis).max(axis=0) > UNTOUCHED_SHARE)
    if rank == len(reached):
        return np.eye(n)
    weights = moved[reached] / max(float(moved.max()), np.finfo(np.float64).tiny) + UNTOUCHED_SHARE
    pivots = reached[dgeqp3(basis[:, reached] * weights)[1][:rank] - 1]
    free = [j for j in reached.tolist() if j not in set(pivots.tolist())]
    coordinates = np.eye(n)
    inside = np.round(np.linalg.solve(basis[:, pivots], basis[:, free]), COORDINATE_DIGITS)
    coordinates[np.ix_(pivots, free)] = -inside
    return coordinates


def _moved(matrices: Mapping[str, AffineMatrix]) -> FloatArray:
    """Return how much the constants move each state ``(n,)``: through its own equation, or those of others."""
    a, e = matrices["A"], matrices["E"]
    moved_sizes = np.abs(a.parts).sum(axis=(0, 2)) + np.abs(e.parts).sum(axis=(0, 2))
    size = np.abs(a.center) / max(float(np.abs(a.center).max(initial=0.0)), np.finfo(np.float64).tiny)
    for _ in range(len(moved_sizes)):
        moved_sizes = np.maximum(moved_sizes, size @ moved_sizes)
    return np.asarray(moved_sizes)


def _split(whole: AffineMatrix, like: Mapping[str, AffineMatrix], names: tuple[str, ...]) -> dict[str, AffineMatrix]:
    """Return blocks of columns by name, as wide as those of ``like``."""
    ends = np.cumsum([0, *(like[name].shape[1] for name in names)])
    return {name: whole[:, ends[i] : ends[i + 1]] for i, name in enumerate(names)}


def reduced_matrices(
    written: Mapping[str, FloatArray],
    matrices: Mapping[str, AffineMatrix],
    basis: FloatArray | None,
    divided_by: FloatArray | None = None,
) -> dict[str, AffineMatrix]:
    """Return the plant with its algebraic states eliminated, in coordinates of its dynamic state.
    ``x2 = X0 z + xi``, X0 that of the middle, z dynamic state and inputs: what constants do not touch stays so.
    E is inverted over the box; where ``divided_by`` is given, rows are only multiplied by the inverse of this E."""
    n, count = len(written["A"]), matrices["A"].count
    rows, dynamic, algebraic = algebraic_coordinates(DescriptorSystem(written["E"], written["A"], C=np.zeros((1, n))))
    nd = dynamic.shape[1]
    v = np.eye(nd) if basis is None else basis
    e = matrices["E"].after(rows)
    _require_algebraic(e[nd:, :], e @ algebraic, ROW_ROUNDING_SHARE * float(np.abs(e.center).max(initial=0.0)))
    whole = affine_block(
        [[matrices["A"] @ np.hstack([dynamic @ v, algebraic]), *(matrices[k] for k in _INPUT_MATRICES)]]
    )
    a = whole.after(rows)
    state, inner = slice(0, nd), slice(nd, n)
    keep = [*range(nd), *range(n, a.shape[1])]
    direct = [[matrices["C"] @ (dynamic @ v), *(matrices[k] for k in _DIRECT)]]
    outputs, top = affine_block(direct), a[state, keep]
    if nd < n:
        middle = np.asarray(np.linalg.solve(a.center[inner, nd:n], -a.center[inner][:, keep]), dtype=np.float64)
        changed = a[inner, keep] + a[inner, inner] @ middle
        more = -(affine_inverse(a[inner, inner]) @ changed)
        top = top + a[state, inner] @ middle + a[state, inner] @ more
        algebraic_outputs = matrices["C"] @ algebraic
        outputs = outputs + algebraic_outputs @ middle + algebraic_outputs @ more
    back = 2.0 * np.eye(nd) - v
    if divided_by is None:
        top = (affine_inverse((e @ dynamic)[state, :]) @ top).after(back)
        ahead = AffineMatrix.exact(np.eye(nd), count)
    else:
        solved = back @ np.linalg.inv((rows @ divided_by @ dynamic)[state])
        top, ahead = top.after(solved), (e @ (dynamic @ v))[state, :].after(solved)
    like = {
        "A": AffineMatrix.exact(np.zeros((nd, nd)), count),
        **{k: matrices[k] for k in (*_INPUT_MATRICES, *_DIRECT)},
    }
    reduced = _split(top, like, ("A", *_INPUT_MATRICES))
    read = _split(outputs, {**like, "C": like["A"]}, ("C", *_DIRECT))
    return {"E": ahead, **reduced, **read}


def _require_algebraic(rows: AffineMatrix, columns: AffineMatrix, rounding: float) -> None:
    """Refuse a box that puts a derivative into an algebraic row, or of an algebraic state; what is at most
    ``rounding`` comes from combining rows or columns of an E that the constants may not touch at all."""
    advice = {
        "row": "The tolerances put a derivative into an algebraic equation (row {} of those that have none at the "
        "nominal values): the plant's order would change in the box. Give E no tolerance there.",
        "state": "The tolerances give a derivative to what is algebraic at the nominal values (state {} of those "
        "without one): which states are dynamic would change in the box. Multiply whole rows of E by a "
        "constant, or give E no tolerance there.",
    }
    for what, matrix, axis in (("row", rows, 1), ("state", columns, 0)):
        size = np.abs(matrix.center) + matrix.spread + matrix.radius
        moving = size.any(axis=axis)
        if moving.any() and size.max() <= rounding:
            raise PreconditionError(
                f"E is singular, but not by {what}s of zeros: which of its combinations vanish is known up to rounding "
                "alone, which tolerances do not allow. Combine the equations by hand so that each algebraic one has a "
                "row of zeros in E, and each algebraic state a column of zeros.",
                condition="algebraic rows",
            )
        if moving.any():
            numbers = ", ".join(str(i + 1) for i in np.flatnonzero(moving))
            raise PreconditionError(advice[what].format(numbers), condition="algebraic rows")
