"""Separation of the left singular part of a pencil by orthogonal transformations, and the rows that span it.

Without finite zeros, infinite and right singular part, ``[A_o - s E_o; C_o]`` is left: observable, with the left null
space of the whole.  The pencil must come balanced; balancing again on the way would blow rounding up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import ComplexArray, FloatArray, largest_singular_value
from obsynth.numerics.lapack import LAPACK_BLOCK, pencil_eigenvalues
from obsynth.numerics.logarithmic_balance import LogBalance
from obsynth.numerics.ranks import RankDecision, rank_from
from obsynth.numerics.scaling import equilibrate_pencil, power_of_two_below
from obsynth.numerics.staircase import full_svd
from obsynth.plants.plant_units import FAR_UNITS, moves_by_steps, step_change

#: Pencils of more columns are of plants of many parts, whose couplings outnumber what each part is made of.
BY_LEAST_SQUARES = 40


@dataclass(frozen=True, eq=False)
class PencilUnits:
    """Powers of two by which rows ``(m,)``, columns ``(n,)`` and s are multiplied so that entries are near one."""

    rows: FloatArray
    columns: FloatArray
    time: float

    @classmethod
    def of(cls, E: FloatArray, A: FloatArray, *, sampled: bool = False) -> PencilUnits:
        """Return the units of ``A - sE (m, n)``; those of the data play no role, that of time included.

        Where a ``sampled`` plant is so slow that A is nearly E, they are those of what a step changes."""
        units = cls._balanced(E, A)
        if sampled and A.size:
            change = step_change(E, A)
            by_steps = cls._balanced(E, change)
            rows = np.where(E.any(axis=1), by_steps.rows * by_steps.time, by_steps.rows)
            apart = float(np.ptp(np.log2(by_steps.columns) - np.log2(units.columns)))
            if moves_by_steps(E, change, rows, by_steps.columns) and apart > np.log2(FAR_UNITS):
                return cls(rows, by_steps.columns, 1.0)
        return units

    @classmethod
    def _balanced(cls, E: FloatArray, A: FloatArray) -> PencilUnits:
        m, n = A.shape
        balance = LogBalance(m + n + 1)
        rows, columns = range(m), range(m, m + n)
        balance.add(A, rows, columns)
        balance.add(E, rows, columns, common=m + n)
        factors = np.exp2(balance.solve(whole=True))
        units = cls(factors[:m], factors[m : m + n], float(factors[-1]))
        return units if n <= BY_LEAST_SQUARES else units._held_together(E, A)

    def _held_together(self, E: FloatArray, A: FloatArray) -> PencilUnits:
        """Return units with the largest entry of each row and column near one, and both matrices of one size.

        Many parts that hardly touch each other pull units by least squares apart, until E looks singular."""
        e, a = (self.rows[:, None] * part * self.columns for part in (E, A))
        largest, moving = float(np.linalg.norm(a)), float(np.linalg.norm(e))
        time = float(power_of_two_below(np.array(largest / moving))) if largest and moving else self.time
        pencil = equilibrate_pencil(time * e, a)
        return PencilUnits(self.rows * pencil.rows, self.columns * pencil.columns, time)


@dataclass(frozen=True, eq=False)
class LeftPart:
    """The left singular part of a pencil: ``left_factor @ (A - sE) = [A_o - s E_o; C_o] @ right_factor``."""

    E: FloatArray  # ``(k, k)``, as A
    A: FloatArray
    C: FloatArray  # ``(p, k)``
    left_factor: FloatArray  # ``(k + p, m)``
    right_factor: FloatArray  # ``(k, n)``
    Ez: FloatArray  # of the finite zeros, as Az
    Az: FloatArray
    decisions: tuple[RankDecision, ...]

    @property
    def order(self) -> int:
        """Number of its states."""
        return int(self.E.shape[0])


def left_part(E: FloatArray, A: FloatArray) -> LeftPart:
    """Return the left singular part of a balanced pencil ``(m, n)``."""
    decisions: list[RankDecision] = []
    size_e, size_a = largest_singular_value(E), largest_singular_value(A)
    left_factor = np.eye(E.shape[0])
    right_factor = np.eye(E.shape[1])
    while E.shape[1]:
        _, values, basis = full_svd(E)
        decision = rank_from(values, expected=E.shape[1], scale=size_e)
        decisions.append(decision)
        if decision.rank == E.shape[1]:
            break
        # The columns that E does not see go, with the rows that A reaches from them.
        kernel, complement = basis[decision.rank :].T, basis[: decision.rank].T
        reached, values, _ = full_svd(A @ kernel)
        decision = rank_from(values, expected=kernel.shape[1], scale=size_a)
        decisions.append(decision)
        left_null = reached[:, decision.rank :].T
        E, A, left_factor = left_null @ E @ complement, left_null @ A @ complement, left_null @ left_factor
        right_factor = complement.T @ right_factor
    k = E.shape[1]
    rows = np.linalg.svd(E)[0] if k else np.eye(E.shape[0])
    state, output = rows[:, :k].T, rows[:, k:].T
    e, a, c = state @ E, state @ A, output @ A
    left_factor = np.vstack([state @ left_factor, output @ left_factor])
    return _without_zeros(e, a, c, left_factor, right_factor, size_a, decisions)


def _without_zeros(
    e: FloatArray,
    a: FloatArray,
    c: FloatArray,
    left_factor: FloatArray,
    right_factor: FloatArray,
    size: float,
    decisions: list[RankDecision],
) -> LeftPart:
    """Take out the unobservable part: what stays are the states that the outputs see."""
    k, p = e.shape[0], c.shape[0]
    hidden = np.eye(k)
    if c.size:
        _, values, basis = full_svd(c)
        decision = rank_from(values, expected=min(c.shape), scale=size)
        decisions.append(decision)
        hidden = basis[decision.rank :].T
    hidden = _invariant(e, a, hidden, size, decisions)
    count = hidden.shape[1]
    if count == 0:
        nothing = np.zeros((0, 0))
        return LeftPart(e, a, c, left_factor, right_factor, nothing, nothing, tuple(decisions))
    rows = np.linalg.qr(e @ hidden, mode="complete")[0]
    zero, remaining = rows[:, :count].T, rows[:, count:].T
    observable = np.linalg.qr(hidden, mode="complete")[0][:, count:]
    left_factor = np.vstack([remaining @ left_factor[:k], left_factor[k : k + p]])
    return LeftPart(
        remaining @ e @ observable,
        remaining @ a @ observable,
        c @ observable,
        left_factor,
        observable.T @ right_factor,
        zero @ e @ hidden,
        zero @ a @ hidden,
        tuple(decisions),
    )


def _invariant(
    e: FloatArray, a: FloatArray, hidden: FloatArray, size: float, decisions: list[RankDecision]
) -> FloatArray:
    """Return the largest part V of a space ``(k, h)``, orthonormal, with ``a V`` within ``e V``.

    In coordinates of the space and of ``e V`` only what leaves is factored; each step turns both by reflections."""
    from obsynth.numerics.lapack import dgeqrf, dormqr

    count = hidden.shape[1]
    rows, square = np.linalg.qr(e @ hidden, mode="complete")
    turned = rows.T @ (a @ hidden)
    moving, staying, leaving = square[:count], turned[:count], turned[count:]
    while count:
        left_vectors, values, right_vectors = np.linalg.svd(leaving, full_matrices=False)
        # What has no row of its own is zero but for the rounding of what it is the rest of.
        padded = values if len(leaving) >= count else np.append(values, np.finfo(np.float64).eps * size)
        decision = rank_from(padded, expected=count, scale=size)
        decisions.append(decision)
        rank, count = decision.rank, count - decision.rank
        if rank == 0:
            break
        turn = _reflection(right_vectors[:rank].T)
        hidden, moving, staying = (turn(part)[:, rank:] for part in (hidden, moving, staying))
        still_leaving = turn(left_vectors[:, rank:].T @ leaving)[:, rank:]
        if count:
            packed, factors, _, _ = dgeqrf(moving, lwork=LAPACK_BLOCK * count)
            moving, staying = (
                np.triu(packed[:count]),
                dormqr("L", "T", packed, factors, staying, LAPACK_BLOCK * count)[0],
            )
        leaving, staying = np.vstack([still_leaving, staying[count:]]), staying[:count]
    return hidden


def _reflection(basis: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what turns rows so that the span of an orthonormal basis ``(n, r)`` comes first (block reflector)."""
    count = basis.shape[1]
    left_vectors, values, right_vectors = np.linalg.svd(basis[:count])
    # [Schreiber, Parlett 1988]: the polar factor's sign that nothing cancels with.
    across = basis.copy()
    across[:count] += left_vectors @ right_vectors
    inner = right_vectors.T @ ((right_vectors @ across.T) / (1.0 + values)[:, None])
    return lambda matrix: matrix - (matrix @ across) @ inner


def finite_values(part: LeftPart) -> ComplexArray:
    """Return the finite zeros that were taken out, complex, conjugate pairs exact."""
    if part.Ez.shape[0] == 0:
        return np.zeros(0, dtype=np.complex128)
    alpha, beta = pencil_eigenvalues(part.Az, part.Ez)
    return np.asarray(alpha / beta, dtype=np.complex128)
