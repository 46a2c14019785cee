"""Stability and index 1 of a plant at every point of a box, by subdivision until each part is decided."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import continuous_lyapunov, discrete_lyapunov
from obsynth.numerics.ranks import ROUNDED_ZERO
from obsynth.plants.constants import ConstantsBox
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertainty import as_written
from obsynth.proofs.affine import AffineMatrix, affine_block, affine_inverse
from obsynth.proofs.exact_doubles import written_matrix
from obsynth.proofs.rational_matrices import nearest_doubles, null_basis, pivot_columns

#: Boxes after which a statement is left open.
MOST_BOXES = 150

#: The matrix over ``lower <= q <= upper``.
Build: TypeAlias = Callable[[FloatArray, FloatArray], AffineMatrix]

#: Halvings of the way to a point that fails.
BISECTIONS = 50

#: With more constants than this, not all vertices are looked at first.
MOST_VERTEX_CONSTANTS = 10

#: Norms computed in double precision are multiplied by this before they are compared.
_NORM_OUTWARD = 1.0 + 1e-9

#: What rounding takes from a product of matrices, beside its terms.
_PRODUCT_ROUNDING = 1e-14

#: What rounding may leave where a compressed row of E vanishes, beside the terms it is made of.
VANISHING_SHARE = 1e-13


@dataclass(frozen=True, eq=False)
class BoxVerdict:
    """``proved``, ``refuted`` (at a point ``q``) or ``open``, and how many boxes it took."""

    verdict: str
    boxes: int
    at: FloatArray | None = None


def subdivided(
    build: Build,
    count: int,
    holds_on: Callable[[AffineMatrix], bool],
    fails_at: Callable[[FloatArray], bool],
    exact_at: Callable[[FloatArray], FloatArray],
    *,
    most: int = MOST_BOXES,
) -> BoxVerdict:
    """Cut the box along the constant that matters most; ``build``: the matrix over a part, ``exact_at``: at a point."""
    if count <= MOST_VERTEX_CONSTANTS:
        for corner in itertools.product((-1.0, 1.0), repeat=count):
            point = np.array(corner)
            if fails_at(exact_at(point)):
                return BoxVerdict("refuted", 0, point)
    todo = [(-np.ones(count), np.ones(count))]
    done = 0
    while todo:
        lower, upper = todo.pop()
        done += 1
        try:
            part = build(lower, upper)
        except PreconditionError:
            part = None
        if part is not None and holds_on(part):
            continue
        middle = (lower + upper) / 2.0
        if fails_at(exact_at(middle)):
            return BoxVerdict("refuted", done, middle)
        sizes = upper - lower if part is None else np.abs(part.parts).sum(axis=(1, 2))
        if done >= most or not sizes.any():
            return BoxVerdict("open", done)
        i = int(np.argmax(sizes))
        cut_above, cut_below = lower.copy(), upper.copy()
        cut_above[i], cut_below[i] = middle[i], middle[i]
        todo += [(lower, cut_below), (cut_above, upper)]
    return BoxVerdict("proved", done)


def values_at(box: ConstantsBox, q: FloatArray) -> dict[str, float]:
    """Return the values of the uncertain constants at a point, without the rounding of zero."""
    values = box.values(q)
    sizes = {item.name: max(abs(item.low), abs(item.high)) for item in box.uncertain}
    return {name: 0.0 if abs(values[name]) < ROUNDED_ZERO * size else values[name] for name, size in sizes.items()}


def proved_regular(build: Build, count: int, exact_at: Callable[[FloatArray], FloatArray]) -> BoxVerdict:
    """Return whether a matrix is nonsingular on the whole box; a change of the determinant's sign refutes it."""
    middle = exact_at(np.zeros(count))
    if not middle.size:
        return BoxVerdict("proved", 0)
    sign = np.linalg.slogdet(middle)[0]

    def invertible(part: AffineMatrix) -> bool:
        try:
            affine_inverse(part)
        except (PreconditionError, np.linalg.LinAlgError):
            return False
        return True

    def singular(point: FloatArray) -> bool:
        return bool(np.linalg.slogdet(point)[0] * sign <= 0.0)

    decision = subdivided(build, count, invertible, singular, exact_at)
    if decision.at is None:
        return decision
    # Where, between the middle of the box and the point that fails, it begins to fail.
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        between = (low + high) / 2.0
        low, high = (low, between) if singular(exact_at(between * decision.at)) else (between, high)
    return BoxVerdict(decision.verdict, decision.boxes, np.asarray(high * decision.at))


def proved_stable(
    build: Build,
    count: int,
    exact_at: Callable[[FloatArray], FloatArray],
    *,
    discrete: bool,
    most: int = MOST_BOXES,
) -> BoxVerdict:
    """Return whether a matrix is stable on the whole box, in the norm of a Lyapunov function of each part's centre."""

    def stable(part: AffineMatrix) -> bool:
        return _contracts(part, discrete=discrete)

    def unstable(point: FloatArray) -> bool:
        values = np.linalg.eigvals(point)
        return bool(np.max(np.abs(values)) >= 1.0 if discrete else np.max(values.real) >= 0.0)

    return subdivided(build, count, stable, unstable, exact_at, most=most)


def _contracts(part: AffineMatrix, *, discrete: bool) -> bool:
    """Return whether ``A'PA - P < 0`` (``A'P + PA < 0``) on a part, P that of its centre for ``-I``."""
    a = part.center
    root, inverse = _energy_coordinates(a, discrete=discrete)
    if not np.isfinite(inverse).all():
        return False
    # Once more in the coordinates of the first: there all modes count alike.
    a = root @ a @ inverse
    lyapunov = _lyapunov(a, discrete=discrete)
    if not np.linalg.eigvalsh(lyapunov)[0] > 0.0:
        return False
    parts = [root @ item @ inverse for item in part.parts]
    rest = np.abs(root) @ part.radius @ np.abs(inverse)
    rest = rest + _PRODUCT_ROUNDING * len(a) * (np.abs(root) @ part.magnitude @ np.abs(inverse))
    size, remainder = np.abs(lyapunov), largest_singular_value(rest)
    if discrete:
        first = sum(largest_singular_value(a.T @ lyapunov @ item + item.T @ lyapunov @ a) for item in parts)
        spread = np.abs(parts).sum(axis=0) + rest if parts else rest
        second = largest_singular_value(spread.T @ size @ spread)
        second += 2.0 * largest_singular_value(np.abs(a.T) @ size) * remainder
        middle = a.T @ lyapunov @ a - lyapunov
    else:
        first = sum(largest_singular_value(lyapunov @ item + item.T @ lyapunov) for item in parts)
        second = 2.0 * largest_singular_value(size) * remainder
        middle = lyapunov @ a + a.T @ lyapunov
    rounding = _PRODUCT_ROUNDING * len(a) * largest_singular_value(size) * (1.0 + largest_singular_value(a) ** 2)
    return float(np.linalg.eigvalsh((middle + middle.T) / 2.0)[-1]) + (first + second + rounding) * _NORM_OUTWARD < 0.0


def _lyapunov(a: FloatArray, *, discrete: bool) -> FloatArray:

    weight = np.eye(len(a))
    solution = discrete_lyapunov(a.T, weight) if discrete else continuous_lyapunov(a.T, -weight)
    return np.asarray((solution + solution.T) / 2.0)


def _energy_coordinates(a: FloatArray, *, discrete: bool) -> tuple[FloatArray, FloatArray]:
    """Return S and its inverse, in whose coordinates Lyapunov's function is a sum of squares; NaN if there is none."""
    values, vectors = np.linalg.eigh(_lyapunov(a, discrete=discrete))
    if not values[0] > 0.0:
        return np.full_like(a, np.nan), np.full_like(a, np.nan)
    return (vectors * np.sqrt(values)).T, vectors / np.sqrt(values)


def index_one_on_box(plant: DescriptorSystem) -> BoxVerdict:
    """Return whether ``[E_dyn; A_alg](q)`` is nonsingular on the box; `PreconditionError` where rows become dynamic."""
    written = plant.uncertainty
    if written is None:
        from obsynth.plants.pencil import structure_of

        index = structure_of(plant).index
        return BoxVerdict("proved" if index is not None and index <= 1 else "refuted", 0, np.zeros(0))
    numbers = as_written(plant, written)
    affine = written.affine(numbers, written.box)
    # Rows of E of full rank, and combinations of its rows that vanish exactly.
    e = affine["E"].at(written.box.offsets)
    n = len(e)
    exact = written_matrix(e.T)
    chosen = pivot_columns(exact)
    null = nearest_doubles(null_basis(exact)) if len(chosen) < n else np.zeros((n, 0))
    dynamic, algebraic = np.eye(n)[chosen], np.asarray(null.T)
    changed, size = affine["E"].after(algebraic), np.abs(algebraic) @ affine["E"].magnitude
    moving = np.abs(changed.parts).sum(axis=0) > VANISHING_SHARE * size
    if moving.any():
        rows = np.flatnonzero(np.abs(algebraic[moving.any(axis=1)]).sum(axis=0))
        raise PreconditionError(
            f"A tolerance puts a derivative into an algebraic equation (rows {', '.join(str(i + 1) for i in rows)}): "
            "the plant's order changes inside the box. Give these rows of E no tolerance of their own.",
            condition="algebraic rows",
        )

    def build(lower: FloatArray, upper: FloatArray) -> AffineMatrix:
        families = written.affine(numbers, written.box.part(lower, upper))
        return affine_block([[families["E"].after(dynamic)], [families["A"].after(algebraic)]])

    def exactly(q: FloatArray) -> FloatArray:
        matrices = written.filled(numbers, written.box.values(q))
        return np.vstack([dynamic @ matrices["E"], algebraic @ matrices["A"]])

    return proved_regular(build, len(written.box.names), exactly)
