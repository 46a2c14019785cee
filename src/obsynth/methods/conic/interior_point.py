r"""A primal-dual method for programmes with a few dense semidefinite blocks and few unknowns.

.. math:: \min_x c^T x, \quad s = b - A x \in K, \qquad \max_z -b^T z, \quad A^T z + c = 0, \quad z \in K

Only the unknowns are factored (Schur complement): general solvers pay n^6 for a dense block of order n.  With ``~``
for ``R^-1 U R^-T`` (z: ``R'UR``) of the scaling R, G the columns of A after it, ``r_x = A'z + c``,
``r_s = A x + s - b`` and ``ds~ + dz~ = q``, Newton's equations become ``G'G dx = -r_x - G'(q + r_s~)``,
``dz~ = G dx + q + r_s~``, ``ds~ = q - dz~``.  Sources: Todd, Toh, Tutuncu, SIAM J. Optim. 8 (1998) 769-796 (scaling);
Andersen, Dahl, Liu, Vandenberghe, in Optimization for Machine Learning (2011), whose start we take.

Semidefinite matrices as vectors, and the scaling of a pair of them that interior-point methods work in.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray

#: Vectors are scaled in parts of about so many numbers.
PART = 1 << 22


class SemidefiniteBlock:
    """Two semidefinite matrices with their Nesterov-Todd scaling R: ``R^-1 S R^-T = R'ZR = diag(values)``.

    Stored are lower triangles, row by row, off-diagonal entries times sqrt(2), so that inner products are kept.
    """

    def __init__(self, order: int, first: int) -> None:
        self.order, self.size = order, order * (order + 1) // 2
        self.part = slice(first, first + self.size)
        self._rows, self._columns = np.tril_indices(order)
        self._places = order * self._rows + self._columns
        self._entries = np.empty((order, order), dtype=np.intp)
        self._entries[self._rows, self._columns] = self._entries[self._columns, self._rows] = np.arange(self.size)
        self._weights = np.where(self._rows == self._columns, 1.0, np.sqrt(2.0))
        self._factor = self._inverse = np.eye(order)
        self._values = np.ones(order)

    def vector(self, matrix: FloatArray) -> FloatArray:
        """Return matrices ``(..., order, order)`` as vectors."""
        flat = matrix.reshape(*matrix.shape[:-2], self.order**2)
        return np.asarray(np.take(flat, self._places, axis=-1) * self._weights)

    def matrix(self, vector: FloatArray) -> FloatArray:
        """Return vectors ``(..., size)`` as matrices."""
        return np.take(vector / self._weights, self._entries, axis=-1)

    def scaled(self, s: FloatArray) -> FloatArray:
        """Return directions of s ``(count, size)`` in the scaling; unknowns of other blocks have none."""
        found, length = np.zeros_like(s), max(1, PART // self.order**2)
        there = np.flatnonzero(np.any(s, axis=1))
        for first in range(0, len(there), length):
            part = there[first : first + length]
            found[part] = self.vector(self._inverse @ (self.matrix(s[part]) @ self._inverse.T))
        return found

    def centre(self) -> FloatArray:
        """Return what s and z are in the scaling."""
        return self.vector(np.diag(self._values))

    def points(self) -> tuple[FloatArray, FloatArray]:
        """Return s and z."""
        s = (self._factor * self._values) @ self._factor.T
        return self.vector(s), self.vector((self._inverse.T * self._values) @ self._inverse)

    def least(self, point: FloatArray) -> float:
        """Return the smallest eigenvalue."""
        return float(np.linalg.eigvalsh(self.matrix(point))[0])

    def longest_step(self, direction: FloatArray) -> float:
        """Return how far one can go from the centre."""
        roots = np.sqrt(self._values)
        worst = float(np.linalg.eigvalsh(self.matrix(direction) / np.outer(roots, roots))[0])
        return -1.0 / worst if worst < 0.0 else np.inf

    def corrected(self, ds: FloatArray, dz: FloatArray, target: float) -> FloatArray:
        """Return q with ``centre o q = target I - ds o dz`` (o the symmetrised product)."""
        both = self.matrix(ds) @ self.matrix(dz)
        value = self.vector(target * np.eye(self.order) - 0.5 * (both + both.T))
        return np.asarray(value / (0.5 * (self._values[self._rows] + self._values[self._columns])))

    def move(self, s: FloatArray, z: FloatArray) -> None:
        """Go to a new pair, given in the present scaling."""
        # With L2'L1 = U diag(new) V' the next scaling is R L1 V diag(new)^-1/2: S and Z are not formed again, which
        # keeps their small eigenvalues.
        first, second = np.linalg.cholesky(self.matrix(s)), np.linalg.cholesky(self.matrix(z))
        left, values, right = np.linalg.svd(second.T @ first)
        roots = np.sqrt(values)
        self._factor = self._factor @ (first @ right.T / roots)
        self._inverse = (left / roots).T @ second.T @ self._inverse
        self._values = values


#: Relative shifts of the diagonal, tried in turn, that let a matrix through which rounding has made indefinite.
SHIFTS = (0.0, 1e-15, 1e-14, 1e-13, 1e-12, 1e-11)
REFINEMENTS = 2


class NormalEquations:
    """``G'G x = r``, with the columns of G as rows ``(n, m)``, by a Cholesky factorisation in units of the diagonal."""

    def __init__(self, columns: FloatArray) -> None:
        from scipy.linalg import cho_factor

        self._columns = columns
        matrix = columns @ columns.T
        self._unit = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(np.float64).tiny))
        matrix *= np.outer(self._unit, self._unit)
        if not np.all(np.isfinite(matrix)):
            raise np.linalg.LinAlgError("the normal equations are not finite")
        for shift in SHIFTS:
            try:
                self._factor = cho_factor(matrix + shift * np.eye(len(matrix)), overwrite_a=True, check_finite=False)
                return
            except np.linalg.LinAlgError:
                continue
        raise np.linalg.LinAlgError("the normal equations are not positive definite")

    def solution(self, right: FloatArray) -> FloatArray:
        """Return the solution ``(n,)``, refined with the columns themselves."""
        found = np.zeros_like(right)
        for _ in range(1 + REFINEMENTS):
            found = found + self._solved(right - self._columns @ (self._columns.T @ found))
        return found

    def _solved(self, right: FloatArray) -> FloatArray:
        from scipy.linalg import cho_solve

        return np.asarray(self._unit * cho_solve(self._factor, self._unit * right, check_finite=False))


#: Relative gap, and relative residuals of both equations, at which the search ends.
TOLERANCE = 1e-6
#: The gap is relative to the objective, or to this where that is smaller.
SMALLEST_OBJECTIVE = 1e-2
#: What a search that cannot go on must have reached to count as an inaccurate answer.
INACCURATE_GAP = 1e-2
INACCURATE_RESIDUAL = 1e-4
#: Multipliers whose equation is met to this accuracy, relative to the objective, show that there is no solution.
INFEASIBLE_RAY = 1e-8
MOST_ITERATIONS = 80
#: Steps without coming closer than ever before, after which rounding has the upper hand; only close to the end.
PATIENCE = 5
#: Share of the way to the boundary; the step below which a plain one towards the middle is tried, and this share of the
#: mean of s z as its target; and the step below which nothing moves any more.
STEP_SHARE = 0.98
SHORT_STEP = 0.1
CENTRING = 0.5
SHORTEST_STEP = 1e-4
#: Distance to the boundary, relative to the size, below which a starting point is moved inside.
START_MARGIN = 1e-8


@dataclass(frozen=True, eq=False)
class ConeSolution:
    """Where a search ended."""

    x: FloatArray  # unknowns (n,)
    z: FloatArray  # multipliers (m,)
    status: str
    iterations: int  # number of factorisations


def _joined(parts: Iterable[FloatArray]) -> FloatArray:
    return np.concatenate(list(parts))


@dataclass(frozen=True, eq=False)
class _State:
    """A point, the residuals of both equations, and the relative gap."""

    x: FloatArray
    z: FloatArray
    dual: FloatArray
    primal: FloatArray
    gap: float
    residual: float  # the larger relative one
    ray: float  # |A'z| / -b'z: zero for z in the cone shows that there is no x

    @property
    def distance(self) -> float:
        return max(self.gap, self.residual)

    @property
    def is_final(self) -> bool:
        return self.distance <= TOLERANCE or self.ray <= INFEASIBLE_RAY

    @property
    def status(self) -> str:
        if self.distance <= TOLERANCE:
            return "optimal"
        if self.gap <= INACCURATE_GAP and self.residual <= INACCURATE_RESIDUAL:
            return "optimal_inaccurate"
        return "infeasible" if self.ray <= INFEASIBLE_RAY else "failed"


@dataclass(frozen=True, eq=False)
class _Programme:
    """The data, with the columns of A as rows: ``(n, m)``."""

    c: FloatArray
    columns: FloatArray
    b: FloatArray
    blocks: tuple[SemidefiniteBlock, ...]

    def start(self) -> FloatArray:
        """Set the blocks to the least s and z of the equations, moved inside the cone, and return x."""
        normal = NormalEquations(self.columns)
        x = normal.solution(self.columns @ self.b)
        s, z = self.b - self.columns.T @ x, -self.columns.T @ normal.solution(self.c)
        for block in self.blocks:
            block.move(*(self._inside(point)[block.part] for point in (s, z)))
        return x

    def _inside(self, point: FloatArray) -> FloatArray:
        least = min(block.least(point[block.part]) for block in self.blocks)
        if least > START_MARGIN * max(1.0, float(np.linalg.norm(point))):
            return point
        identity = _joined(block.vector(np.eye(block.order)) for block in self.blocks)
        return np.asarray(point + (1.0 - min(least, 0.0)) * identity)

    def state(self, x: FloatArray) -> _State:
        """Return how far the equations and the gap are from zero."""
        s, z = (_joined(points) for points in zip(*(block.points() for block in self.blocks), strict=True))
        dual, primal = self.columns @ z + self.c, self.columns.T @ x + s - self.b
        size = max(abs(float(self.c @ x)), abs(float(self.b @ z)), SMALLEST_OBJECTIVE)
        pairs = ((dual, self.c), (primal, self.b))
        worst = max(float(np.linalg.norm(r)) / max(1.0, float(np.linalg.norm(data))) for r, data in pairs)
        below = -float(self.b @ z)
        ray = float(np.linalg.norm(dual - self.c)) / below if below > 0.0 else np.inf
        return _State(x, z, dual, primal, float(s @ z) / size, worst, ray)

    def step(self, now: _State) -> tuple[FloatArray, float]:
        """Take Mehrotra's step, or where that is short a plain one; return the next x and the shorter length."""
        newton = _Newton(self, now)
        predicted = newton.direction(0.0)
        target = min(1.0, max(0.0, newton.left_after(predicted))) ** 3
        found = newton.direction(target, predicted)
        if found.length < SHORT_STEP:
            found = max(found, newton.direction(CENTRING), key=lambda move: move.length)
        s, z = newton.centre + found.forward * found.s, newton.centre + found.back * found.z
        for block in self.blocks:
            block.move(s[block.part], z[block.part])
        return now.x + found.forward * found.x, found.length


@dataclass(frozen=True, eq=False)
class _Direction:
    """A direction, s and z in the scaling, and the lengths of its primal and dual steps."""

    x: FloatArray
    s: FloatArray
    z: FloatArray
    forward: float
    back: float

    @property
    def length(self) -> float:
        return min(self.forward, self.back)


class _Newton:
    """Newton's equations at one point: a factorisation for several right-hand sides."""

    def __init__(self, programme: _Programme, now: _State) -> None:
        self._blocks, self._dual = programme.blocks, now.dual
        self._columns = np.hstack([block.scaled(programme.columns[:, block.part]) for block in self._blocks])
        self._normal = NormalEquations(self._columns)
        self._offset = _joined(block.scaled(now.primal[None, block.part])[0] for block in self._blocks)
        self.centre = _joined(block.centre() for block in self._blocks)
        self._mean = float(self.centre @ self.centre) / sum(block.order for block in self._blocks)

    def direction(self, target: float, before: _Direction | None = None) -> _Direction:
        """Return the direction to ``target`` times the present mean of s z, with the second order of another one."""
        ds, dz = (np.zeros_like(self.centre),) * 2 if before is None else (before.s, before.z)
        wanted = (block.corrected(ds[block.part], dz[block.part], target * self._mean) for block in self._blocks)
        q = _joined(wanted) - self.centre
        dx = self._normal.solution(-self._dual - self._columns @ (self._offset + q))
        dz = self._columns.T @ dx + self._offset + q
        lengths = (min(1.0, STEP_SHARE * self._longest(move)) for move in (q - dz, dz))
        return _Direction(dx, q - dz, dz, *lengths)

    def left_after(self, move: _Direction) -> float:
        """Return the share of the gap that is left after a step."""
        s, z = self.centre + move.forward * move.s, self.centre + move.back * move.z
        return float(s @ z) / float(self.centre @ self.centre)

    def _longest(self, move: FloatArray) -> float:
        return min(block.longest_step(move[block.part]) for block in self._blocks)


def solve_cone_programme(c: FloatArray, a: FloatArray, b: FloatArray, orders: Sequence[int]) -> ConeSolution:
    """Return the solution of a cone programme; ``c (n,)``, ``a (m, n)``, ``b (m,)``."""
    ends = np.cumsum([0, *(order * (order + 1) // 2 for order in orders)])
    blocks = tuple(SemidefiniteBlock(order, int(first)) for order, first in zip(orders, ends[:-1], strict=True))
    programme = _Programme(c, np.ascontiguousarray(a.T), b, blocks)
    with np.errstate(all="ignore"):  # what overflows is not finite, and ends the search
        best = now = programme.state(programme.start())
        length, count, closest = 1.0, 0, 0
        while not now.is_final and length >= SHORTEST_STEP and count < MOST_ITERATIONS:
            if best.status != "failed" and count >= closest + PATIENCE:
                break
            try:
                x, length = programme.step(now)
            except np.linalg.LinAlgError:
                break  # rounding has the last word: what was reached is judged by itself
            now, count = programme.state(x), count + 1
            if now.is_final or now.distance < best.distance:
                best, closest = now, count
    return ConeSolution(best.x, best.z, best.status, count)
