"""A plant without its unknown inputs: what all questions of diagnosis are asked of, and what filters are built on.

What is left of a pencil without finite zeros, infinite and right singular part, by orthogonal transformations with the
rows it is made of, is ``[A_o - s E_o; C_o]``: observable, with the left null space of the whole. The pencil must come
balanced; balancing again on the way would blow rounding up.

One fault on a decoupled plant: whether it shows, where it does not, how fast it does, and by which equations.

In floating point; exactly for small plants whose numbers are as somebody wrote them.

With N a minimal polynomial basis of the left null space of the unknowns' pencil, the zeros of the fault are those of
the greatest common divisor of ``g = N [bf; df]``; decoupled: where ``[F; G]`` lies in the range of ``[A - sE; C]``.

Least order of a residual that shows a fault, the least degree in y and u of an equation without states: of ``z+ = A z +
F f + K w``, ``0 = C z + G f + L w`` with w = [u; y], the equations of degree m in w are spanned by ``s^k e``, k <= m,
with e those of degree 0: the rows, and derivatives of equations that hold no w, which cost nothing. That is the least
degree of a minimal polynomial basis (Forney 1975) among its rows that show the fault.

What hides a fault, as a motion in one sentence, and which sensors would let it be detected or estimated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from itertools import combinations, dropwhile
from typing import ClassVar, NamedTuple

import numpy as np
from flint import fmpq, fmpq_mat, fmpq_poly, fmpz_poly
from numpy.typing import NDArray

from obsynth.analysis.transformations.linear_plants import Transformation, linear_plant
from obsynth.analysis.zeros import are_outside
from obsynth.errors import SpecError
from obsynth.numerics.arguments import ComplexArray, FloatArray, arguments_checked, largest_singular_value, read_only
from obsynth.numerics.lapack import LAPACK_BLOCK, pencil_eigenvalues
from obsynth.numerics.libraries import on_one_thread_if_small
from obsynth.numerics.pencils import FiniteZeros, full_svd
from obsynth.numerics.ranks import (
    CLEAR_GAP,
    MARKOV_TOLERANCE,
    RANK_TOLERANCE,
    TRACE_TOLERANCE,
    RankDecision,
    product_but_rounding,
    rank_from,
)
from obsynth.numerics.scaling import LogBalance, equilibrate_pencil, power_of_two_below
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_arithmetic import (
    ExactPencil,
    Root,
    blocks,
    holds_computed,
    identity,
    left_null_basis,
    locate_roots,
    null_basis,
    picked_columns,
    picked_rows,
    pivot_columns,
    primitive,
    row_basis,
    written_fraction,
    written_matrix,
    zeros_matrix,
)

#: Pencils of more columns are of plants of many parts, whose couplings outnumber what each part is made of.
BY_LEAST_SQUARES = 40


@dataclass(frozen=True, eq=False)
class PencilUnits:
    """Powers of two by which rows ``(m,)``, columns ``(n,)`` and s are multiplied so that entries are near one."""

    rows: FloatArray
    columns: FloatArray
    time: float

    @classmethod
    def of(cls, E: FloatArray, A: FloatArray) -> PencilUnits:
        """Return the units of ``A - sE (m, n)``; those of the data play no role, that of time included."""
        m, n = A.shape
        balance = LogBalance(m + n + 1)
        rows, columns = range(m), range(m, m + n)
        balance.add(A, rows, columns)
        balance.add(E, rows, columns, common=m + n)
        factors = np.exp2(balance.solve(whole=True))
        found = cls(factors[:m], factors[m : m + n], float(factors[-1]))
        return found if n <= BY_LEAST_SQUARES else found._held_together(E, A)

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
    """What is left of a pencil: ``left @ (A - sE) = [A_o - s E_o; C_o] @ right``."""

    E: FloatArray  # ``(k, k)``, as A
    A: FloatArray
    C: FloatArray  # ``(p, k)``
    left: FloatArray  # ``(k + p, m)``
    right: FloatArray  # ``(k, n)``
    Ez: FloatArray  # of the finite zeros, as Az
    Az: FloatArray
    decisions: tuple[RankDecision, ...]

    @property
    def order(self) -> int:
        """Number of states left."""
        return int(self.E.shape[0])


def left_part(E: FloatArray, A: FloatArray) -> LeftPart:
    """Return the left singular part of a balanced pencil ``(m, n)``."""
    decisions: list[RankDecision] = []
    size_e, size_a = largest_singular_value(E), largest_singular_value(A)
    left = np.eye(E.shape[0])
    right = np.eye(E.shape[1])
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
        rest = reached[:, decision.rank :].T
        E, A, left = rest @ E @ complement, rest @ A @ complement, rest @ left
        right = complement.T @ right
    k = E.shape[1]
    rows = np.linalg.svd(E)[0] if k else np.eye(E.shape[0])
    state, output = rows[:, :k].T, rows[:, k:].T
    e, a, c = state @ E, state @ A, output @ A
    left = np.vstack([state @ left, output @ left])
    return _without_zeros(e, a, c, left, right, size_a, decisions)


def _without_zeros(
    e: FloatArray,
    a: FloatArray,
    c: FloatArray,
    left: FloatArray,
    right: FloatArray,
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
        return LeftPart(e, a, c, left, right, nothing, nothing, tuple(decisions))
    rows = np.linalg.qr(e @ hidden, mode="complete")[0]
    zero, kept = rows[:, :count].T, rows[:, count:].T
    seen = np.linalg.qr(hidden, mode="complete")[0][:, count:]
    left = np.vstack([kept @ left[:k], left[k : k + p]])
    return LeftPart(
        kept @ e @ seen,
        kept @ a @ seen,
        c @ seen,
        left,
        seen.T @ right,
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
        left, values, right = np.linalg.svd(leaving, full_matrices=False)
        # What has no row of its own is zero but for the rounding of what it is the rest of.
        shown = values if len(leaving) >= count else np.append(values, np.finfo(np.float64).eps * size)
        decision = rank_from(shown, expected=count, scale=size)
        decisions.append(decision)
        rank, count = decision.rank, count - decision.rank
        if rank == 0:
            break
        turn = _reflection(right[:rank].T)
        hidden, moving, staying = (turn(part)[:, rank:] for part in (hidden, moving, staying))
        kept = turn(left[:, rank:].T @ leaving)[:, rank:]
        if count:
            packed, factors, _, _ = dgeqrf(moving)
            moving, staying = (
                np.triu(packed[:count]),
                dormqr("L", "T", packed, factors, staying, LAPACK_BLOCK * count)[0],
            )
        leaving, staying = np.vstack([kept, staying[count:]]), staying[:count]
    return hidden


def _reflection(basis: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what turns rows so that the span of an orthonormal basis ``(n, r)`` comes first (block reflector)."""
    count = basis.shape[1]
    left, values, right = np.linalg.svd(basis[:count])
    # [Schreiber, Parlett 1988]: the polar factor's sign that nothing cancels with.
    across = basis.copy()
    across[:count] += left @ right
    inner = right.T @ ((right @ across.T) / (1.0 + values)[:, None])
    return lambda matrix: matrix - (matrix @ across) @ inner


def finite_values(left: LeftPart) -> ComplexArray:
    """Return the finite zeros that were taken out, complex, conjugate pairs exact."""
    if left.Ez.shape[0] == 0:
        return np.zeros(0, dtype=np.complex128)
    alpha, beta = pencil_eigenvalues(left.Az, left.Ez)
    return np.asarray(alpha / beta, dtype=np.complex128)


#: Entries of unit rows below this are rounding of the orthogonal transformations that made them.
ROTATION_ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class DecoupledPlant:
    r"""What a plant tells without its unknown inputs.

    .. math::
        E z^+ = A z + B_u u + B_y y + F f + N w, \qquad H y = C z + D_u u + G f + M w

    with E regular and (E, A, C) observable: an ordinary plant whose known inputs are u **and y**, on which no unknown
    input acts.  Its order is the sum of the left Kronecker indices of ``[A - sE, Bd; C, Dd]``.

    Parameters
    ----------
    E, A : FloatArray
        ``(k, k)``.
    C : FloatArray
        ``(p, k)``.
    Bu, By, F, N : FloatArray
        ``(k, nu)``, ``(k, ny)``, ``(k, faults kept)``, ``(k, nw)``.
    Du, H, G, M : FloatArray
        ``(p, nu)``, ``(p, ny)``, ``(p, faults kept)``, ``(p, nw)``.
    rows : FloatArray
        ``(k + p, nx + ny)``: the combinations of the plant's equations, and of its outputs, that these rows are.
    states : FloatArray
        ``(k, nx)``: ``z = states @ x``.
    removed : ComplexArray
        Finite zeros of the pencil of the unknown inputs, 1/s (or dimensionless).  They need not be stable: no filter
        has a pole there.
    source : DescriptorSystem
        The plant.
    faults : tuple of str
        The faults kept, in the order of the columns of F.
    without : tuple of str
        What was removed: the unknown inputs, and faults that are not to show.
    fault_sizes : FloatArray
        Sizes of the faults' columns in balanced units, before the reduction.
    signal_sizes : FloatArray
        The same of the columns of ``[u; y]``; one for those that are zero.
    time : float
        Unit of s in which the plant is balanced, 1/s.
    decisions : tuple of RankDecision
        Every rank decided on the way.
    """

    E: FloatArray
    A: FloatArray
    C: FloatArray
    Bu: FloatArray
    By: FloatArray
    F: FloatArray
    N: FloatArray
    Du: FloatArray
    H: FloatArray
    G: FloatArray
    M: FloatArray
    rows: FloatArray
    states: FloatArray
    removed: ComplexArray
    source: DescriptorSystem
    faults: tuple[str, ...]
    without: tuple[str, ...]
    fault_sizes: FloatArray
    signal_sizes: FloatArray
    time: float
    decisions: tuple[RankDecision, ...]

    @property
    def order(self) -> int:
        """Number of states left."""
        return int(self.E.shape[0])

    @property
    def signals(self) -> FloatArray:
        """Columns ``(k + p, nu + ny)`` of ``[u; y]`` in both equations, each in units of its size."""
        return np.asarray(np.block([[self.Bu, self.By], [self.Du, -self.H]]) / self.signal_sizes)

    @property
    def thinnest(self) -> RankDecision | None:
        """The least clear rank decision; ``None`` where nothing had to be decided."""
        return min(self.decisions, key=lambda decision: decision.gap, default=None)

    @property
    def plant(self) -> DescriptorSystem:
        """The decoupled plant by itself: inputs ``[u; y]``, outputs ``H y``."""
        p, ny = len(self.C), self.By.shape[1]
        source = self.source
        return DescriptorSystem(
            self.E,
            self.A,
            np.hstack([self.Bu, self.By]),
            self.C if p else np.zeros((0, self.order)),
            D=np.hstack([self.Du, np.zeros((p, ny))]),
            Bf=self.F,
            Df=self.G,
            Bw=self.N,
            Dw=self.M,
            dt=source.dt,
            input_names=(*source.input_names, *(f"measured {name}" for name in source.output_names)),
            output_names=[f"r{i + 1}" for i in range(p)],
            state_names=[f"z{i + 1}" for i in range(self.order)],
            fault_names=self.faults,
            noise_names=source.noise_names,
        )


@arguments_checked
@on_one_thread_if_small
def decouple(
    plant: DescriptorSystem | Transformation, *, without: Sequence[str] = (), faults: Sequence[str] | None = None
) -> DecoupledPlant:
    """Remove the unknown inputs, and faults that are to have no effect, from a plant.

    Exact for descriptor plants of any index, and whatever the unknown inputs, the faults removed and the initial state
    are.  What is decided on the way does not depend on the units of the data, that of time included.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        Either time; ``sE - A`` need not be regular.
    without : sequence of str, optional
        Names of faults to remove together with every unknown input.
    faults : sequence of str, optional
        Names of the faults to keep; all that are not removed by default.  The others are taken to be absent.

    Returns
    -------
    DecoupledPlant
        ``F (k, len(faults))`` and its like; the order k is the sum of the left Kronecker indices.

    Raises
    ------
    SpecError
        A name is unknown, or stands in both lists.

    References
    ----------
    .. [Frisk] E. Frisk, M. Nyberg, "A minimal polynomial basis solution to residual generation for fault diagnosis in
       linear systems", Automatica 37, 2001: the null space; here it is never formed, but reduced to a state space.
    """
    plant = linear_plant(plant)
    removed = fault_numbers(plant, without, "without")
    kept = (
        [i for i in range(plant.nf) if i not in removed] if faults is None else fault_numbers(plant, faults, "faults")
    )
    both = [plant.fault_names[i] for i in kept if i in removed]
    if both:
        raise SpecError(f"{', '.join(both)}: a fault cannot be kept and removed.", path="without")
    return decoupled(plant, removed, kept)


def fault_numbers(plant: DescriptorSystem, names: Sequence[str], where: str) -> list[int]:
    """Return the columns of faults by name."""
    listed = [names] if isinstance(names, str) else list(names)
    unknown = [name for name in listed if name not in plant.fault_names]
    if unknown:
        raise SpecError(
            f"{', '.join(map(repr, unknown))}: no such fault; there are: {', '.join(plant.fault_names) or 'none'}.",
            path=where,
        )
    return [plant.fault_names.index(name) for name in dict.fromkeys(listed)]


def decoupled(plant: DescriptorSystem, removed: Sequence[int], kept: Sequence[int]) -> DecoupledPlant:
    """Remove the unknown inputs and the faults ``removed`` from a plant; keep the columns ``kept``."""
    nx, ny = plant.nx, plant.ny
    pencil_e, pencil_a = unknowns_pencil(plant, removed)
    units = PencilUnits.of(pencil_e, pencil_a)
    found = left_part(
        units.rows[:, None] * pencil_e * units.columns * units.time, units.rows[:, None] * pencil_a * units.columns
    )
    # Rows of the orthogonal reduction have unit length: what is below rounding is nothing.
    rows = np.array(found.left)
    moving = units.rows[:nx, None] * plant.E * units.columns[:nx]
    rows[found.order :, :nx] = _without_dynamics(rows[found.order :, :nx], moving)
    rows = np.where(np.abs(rows) > ROTATION_ROUNDING, rows, 0.0) * units.rows
    faults = np.vstack([plant.Bf, plant.Df])[:, list(kept)]
    signals = np.block([[plant.B, np.zeros((nx, ny))], [plant.D, -np.eye(ny)]])
    sizes = np.linalg.norm(units.rows[:, None] * signals, axis=0)
    k = found.order
    parts = {
        "u": product_but_rounding(rows, signals[:, : plant.nu]),
        "y": product_but_rounding(rows, signals[:, plant.nu :]),
        "f": product_but_rounding(rows, faults),
        "w": product_but_rounding(rows, np.vstack([plant.Bw, plant.Dw])),
    }
    return DecoupledPlant(
        E=read_only(_told(found.E) / units.time),
        A=read_only(_told(found.A)),
        C=read_only(_told(found.C)),
        Bu=read_only(parts["u"][:k]),
        By=read_only(parts["y"][:k]),
        F=read_only(parts["f"][:k]),
        N=read_only(parts["w"][:k]),
        Du=read_only(parts["u"][k:]),
        H=read_only(-parts["y"][k:]),
        G=read_only(parts["f"][k:]),
        M=read_only(parts["w"][k:]),
        rows=read_only(rows),
        states=read_only((found.right / units.columns)[:, :nx]),
        removed=finite_values(found) * units.time,
        source=plant,
        faults=tuple(plant.fault_names[i] for i in kept),
        without=(*plant.disturbance_names, *(plant.fault_names[i] for i in removed)),
        fault_sizes=read_only(np.linalg.norm(units.rows[:, None] * faults, axis=0)),
        signal_sizes=read_only(np.where(sizes > 0.0, sizes, 1.0)),
        time=units.time,
        decisions=found.decisions,
    )


def _without_dynamics(rows: FloatArray, e: FloatArray) -> FloatArray:
    """Return combinations of equations that hold no derivative, ``rows E = 0``, without what rounding put into them.

    Nothing at all is left of them where E is regular: a reduction of many steps leaves more than the rounding of one.
    """
    left, values, _ = full_svd(e)
    rank = rank_from(values, expected=len(e)).rank
    if rank == len(e):
        return np.zeros_like(rows)
    span = left[:, :rank]
    return np.asarray(rows - (rows @ span) @ span.T)


def _told(matrix: FloatArray) -> FloatArray:
    """Return a matrix of the balanced plant, in which entries are near one, without what is only rounding."""
    size = ROTATION_ROUNDING * max(1.0, float(np.max(np.abs(matrix), initial=0.0)))
    return np.where(np.abs(matrix) > size, matrix, 0.0)


def unknowns_pencil(plant: DescriptorSystem, removed: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Return E and A of ``[A - sE, Bd, Bf; C, Dd, Df]`` with the faults ``removed`` beside the unknown inputs."""
    columns = list(removed)
    a = np.block([[plant.A, plant.Bd, plant.Bf[:, columns]], [plant.C, plant.Dd, plant.Df[:, columns]]])
    e = np.zeros_like(a)
    e[: plant.nx, : plant.nx] = plant.E
    return e, a


#: Plants with more unknowns are decided in floating point.
MOST_EXACT_UNKNOWNS = 70
#: Plants with more unknowns are not reduced exactly, as the numbers grow: their fault polynomials come from pencils.
MOST_REDUCED = 24


def dc_point(dt: float) -> complex:
    """Return the point at which signals are constant."""
    return 1.0 + 0.0j if dt > 0.0 else 0.0j


def others(plant: DescriptorSystem, fault: int) -> tuple[int, ...]:
    """Return the columns of all faults but one."""
    return tuple(j for j in range(plant.nf) if j != fault)


@dataclass(frozen=True, eq=False)
class Removal:
    """What is left of a plant without its unknown inputs and a set of faults: the same for every other fault."""

    source: DescriptorSystem
    removed: tuple[int, ...]
    #: Of this plant, by the faults among the unknowns.
    pencils: dict[tuple[int, ...], ExactPencil] = field(default_factory=dict, repr=False)

    @cached_property
    def plant(self) -> DecoupledPlant:
        """The decoupled plant with all other faults."""
        return decoupled(self.source, self.removed, self.kept)

    @cached_property
    def kept(self) -> list[int]:
        """The other faults."""
        gone = set(self.removed)
        return [j for j in range(self.source.nf) if j not in gone]

    @cached_property
    def traces(self) -> tuple[FloatArray, FloatArray]:
        """Sizes ``(len(kept),)`` of the faults' columns before the reduction, and of what is left, relative to them."""
        sizes = np.maximum(self.plant.fault_sizes, np.finfo(np.float64).tiny)
        return sizes, np.linalg.norm(np.vstack([self.plant.F, self.plant.G]) / sizes, axis=0)

    @cached_property
    def residual_orders(self) -> dict[int, int]:
        """Least order of a scalar residual that shows a fault, of those that leave a trace."""
        plant, (sizes, traces) = self.plant, self.traces
        places = [place for place in range(len(self.kept)) if traces[place] > TRACE_TOLERANCE]
        if plant.order == 0 or not places:
            return {self.kept[place]: 0 for place in places}
        inverse = np.linalg.inv(plant.E * plant.time)
        units = (sizes * traces)[places]
        known = plant.signals
        found = residual_orders(
            inverse @ plant.A,
            plant.C,
            inverse @ plant.F[:, places] / units,
            plant.G[:, places] / units,
            inverse @ known[: plant.order],
            known[plant.order :],
        )
        return {self.kept[place]: order for place, order in zip(places, found, strict=True) if order is not None}

    def pencil(self, *more: int) -> ExactPencil:
        """Return the pencil of the unknowns, with more faults among them."""
        gone = tuple(sorted((*self.removed, *more)))
        if gone not in self.pencils:
            self.pencils[gone] = ExactPencil.written(*unknowns_pencil(self.source, gone))
        return self.pencils[gone]

    @cached_property
    def reduction(self) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat]:
        """Of the plant reduced over the rational numbers: dynamics, outputs, the columns of faults, u and y in both."""
        plant = self.source
        e, a = (written_matrix(part) for part in unknowns_pencil(plant, self.removed))
        known = np.block([[plant.B, np.zeros((plant.nx, plant.ny))], [plant.D, -np.eye(plant.ny)]])
        right = written_matrix(np.hstack([np.vstack([plant.Bf, plant.Df]), known]))
        return _reduced(e, a, right)[:4]


@dataclass(frozen=True, eq=False)
class Question:
    """A fault of a plant, with the faults ``removed`` and every unknown input out of sight, in floating point."""

    removal: Removal
    number: int
    #: Whether it is decided over the rational numbers.
    exactly: ClassVar[bool] = False

    @property
    def source(self) -> DescriptorSystem:
        """The plant."""
        return self.removal.source

    @property
    def removed(self) -> tuple[int, ...]:
        """The faults that are out of sight."""
        return self.removal.removed

    @cached_property
    def plant(self) -> DecoupledPlant:
        """The decoupled plant, in floating point."""
        whole, place = self.removal.plant, [self.removal.kept.index(self.number)]
        return replace(
            whole,
            F=whole.F[:, place],
            G=whole.G[:, place],
            fault_sizes=whole.fault_sizes[place],
            faults=(whole.faults[place[0]],),
        )

    @cached_property
    def _scaled(self) -> tuple[FloatArray, FloatArray]:
        size = max(float(self.plant.fault_sizes[0]), np.finfo(np.float64).tiny)
        return self.plant.F / size, self.plant.G / size

    @cached_property
    def trace(self) -> float:
        """Size of what is left of the column, relative to before the reduction."""
        return float(np.linalg.norm(np.vstack(self._scaled)))

    @property
    def leaves_trace(self) -> bool:
        """Whether the fault shows in floating point."""
        return self.trace > TRACE_TOLERANCE

    @property
    def visible(self) -> bool:
        """Whether the outputs show the fault at all, free of what was removed."""
        return self.leaves_trace

    def shows_at(self, point: complex) -> bool:
        """Whether a fault ``exp(point t)`` (or ``point^k``) leaves a trace that the rest cannot imitate."""
        if not self.leaves_trace:
            return False
        plant, column = self.plant, np.vstack(self._scaled)[:, 0] / self.trace
        basis = np.linalg.qr(np.vstack([plant.A - point * plant.E, plant.C]))[0]
        rest = column - basis @ (basis.conj().T @ column)
        return float(np.linalg.norm(rest - basis @ (basis.conj().T @ rest))) > TRACE_TOLERANCE

    @property
    def shows_at_rest(self) -> bool:
        """Whether a constant fault leaves a constant trace."""
        return self.visible and self.shows_at(dc_point(self.source.dt))

    @property
    def estimable(self) -> bool:
        """Whether the fault's value can be estimated whatever its course is."""
        return self.visible and not self.blocking.size

    @cached_property
    def _pencil(self) -> tuple[FloatArray, FloatArray]:
        f, g = self._scaled
        plant, trace = self.plant, max(self.trace, np.finfo(np.float64).tiny)
        a = np.block([[plant.A, f / trace], [plant.C, g / trace]])
        e = np.zeros_like(a)
        e[: plant.order, : plant.order] = plant.E * plant.time
        return e, a

    @cached_property
    def zeros(self) -> ComplexArray:
        """Roots of the fault polynomial, 1/s (or dimensionless), with multiplicity."""
        if not self.leaves_trace:
            return np.zeros(0, dtype=np.complex128)
        return np.asarray(finite_values(left_part(*self._pencil)) * self.plant.time)

    @cached_property
    def blocking(self) -> ComplexArray:
        """Those on or outside the boundary of stability: a fault that follows one of them stays hidden."""
        if not self.zeros.size:
            return self.zeros
        e, a = self._pencil
        # In discrete time the boundary is a number, not a direction: the unit of s must not move it.
        unit = self.plant.time if self.source.dt > 0.0 else 1.0
        found = FiniteZeros(self.zeros / (self.plant.time / unit), a.shape[1], ())
        return np.asarray(self.zeros[np.array(are_outside(e / unit, a, found, self.source.dt), dtype=bool)])

    @cached_property
    def order(self) -> int:
        """Order of the decoupled plant."""
        return self.plant.order

    @cached_property
    def derivatives(self) -> int | None:
        """Derivatives of y and u (samples of delay) that an estimate needs; ``None`` where the fault has no effect on
        them."""
        f, g = self._scaled
        return _order_at_infinity(self.plant, f / self.trace, g / self.trace) if self.leaves_trace else None

    @cached_property
    def residual_order(self) -> int | None:
        """Least order of a scalar residual that shows the fault; ``None`` where nothing does."""
        return self.removal.residual_orders.get(self.number)

    @property
    def gap(self) -> float:
        """How clear the least clear decision was: kept over dropped; infinite for exact ones."""
        ranks = float("inf") if self.plant.thinnest is None else self.plant.thinnest.gap
        if self.trace == 0.0:
            return ranks
        return min(ranks, self.trace / TRACE_TOLERANCE if self.leaves_trace else TRACE_TOLERANCE / self.trace)

    @property
    def clear(self) -> bool:
        """Whether the gap is wide enough to trust the answer without a second look."""
        return self.gap >= CLEAR_GAP


@dataclass(frozen=True, eq=False)
class ExactQuestion(Question):
    """The same over the rational numbers: no tolerance, so no gap.

    ``reduced``: on the plant without its unknown inputs; otherwise by the fault polynomial alone, and orders are those
    of floating point.
    """

    reduced: bool = True
    exactly = True

    @cached_property
    def _parts(self) -> tuple[fmpq_mat, ...]:
        """A, C, F, G, K, L of ``z+ = A z + F f + K [u; y]``, ``0 = C z + G f + L [u; y]`` with (A, C) observable, over
        the rationals."""
        a, c, right, outputs = self.removal.reduction
        nf = self.source.nf
        rest = range(nf, right.ncols())
        parts = (picked_columns(part, of) for of in ([self.number], rest) for part in (right, outputs))
        return a, c, *parts

    @cached_property
    def order(self) -> int:
        """Order of the decoupled plant."""
        return int(self._parts[0].nrows()) if self.reduced else super().order

    @cached_property
    def polynomial(self) -> fmpz_poly:
        """The fault polynomial, with coprime integer coefficients; zero where the fault has no effect on the
        outputs."""
        if not self.reduced:
            # The zeros that the fault adds to those of the pencil of the unknowns.
            without, whole = self.removal.pencil(), self.removal.pencil(self.number)
            if whole.normal_rank == without.normal_rank:
                return fmpz_poly([])
            return primitive(fmpq_poly(whole.zero_polynomial) / fmpq_poly(without.zero_polynomial))
        A, C, F, G, *_ = self._parts
        if _is_zero(F) and _is_zero(G):
            return fmpz_poly([])
        n, p = self.order, C.nrows()
        e = blocks([[identity(n), zeros_matrix(n, 1)], [zeros_matrix(p, n), zeros_matrix(p, 1)]])
        return primitive(_reduced(e, blocks([[A, F], [C, G]]), zeros_matrix(n + p, 0))[4])

    @property
    def visible(self) -> bool:
        """Whether the outputs show the fault at all."""
        return not self.polynomial.is_zero()

    @cached_property
    def _roots(self) -> tuple[Root, ...]:
        return locate_roots(self.polynomial, discrete=self.source.dt > 0.0)

    @cached_property
    def zeros(self) -> ComplexArray:
        """The zeros with multiplicity, 1/s (or dimensionless)."""
        return _values(self._roots)

    @cached_property
    def blocking(self) -> ComplexArray:
        """Those on or outside the boundary of stability."""
        return _values([root for root in self._roots if root.side != "stable"])

    def shows_at(self, point: complex) -> bool:
        """Whether the fault polynomial has no root at a point, whose parts are taken as they are written."""
        real, imaginary = written_fraction(complex(point).real), written_fraction(complex(point).imag)
        factor = [real * real + imaginary * imaginary, -2 * real, Fraction(1)] if imaginary else [-real, Fraction(1)]
        at = fmpq_poly([fmpq(value.numerator, value.denominator) for value in factor])
        return self.visible and not (fmpq_poly(self.polynomial) % at).is_zero()

    @property
    def gap(self) -> float:
        """Infinite: nothing was rounded."""
        return float("inf")

    @cached_property
    def derivatives(self) -> int | None:
        """Derivatives of y and u (samples of delay) that an estimate needs."""
        if not self.reduced or not self.visible:
            return None if self.reduced else super().derivatives
        (A, C, F, G, K, L), n = self._parts, self.order
        rows = blocks([[C, G, L]])
        for _ in range(n):
            new = left_null_basis(picked_columns(rows, range(n, rows.ncols()))) * picked_columns(rows, range(n))
            if new.rank() == 0:
                break
            more = blocks([[rows], [blocks([[new * A, new * F, new * K]])]])
            if more.rank() == rows.rank():
                break
            # Every pass adds rows that repeat others: only what they span counts.
            rows = more if more.nrows() <= more.ncols() else row_basis(more)
        c, direct, vector, order = picked_columns(rows, range(n)), picked_columns(rows, [n]), F, 0
        while _is_zero(direct) and order <= n:
            direct, vector = c * vector, A * vector
            order += 1
        return order

    @cached_property
    def residual_order(self) -> int | None:
        """Least order of a scalar residual that shows the fault."""
        if not self.reduced:
            return super().residual_order
        return exact_residual_order(*self._parts) if self.visible else None


def decided_exactly(plant: DescriptorSystem) -> bool:
    """Whether a plant is small enough, and made of numbers as they were written."""
    matrices = (plant.E, plant.A, plant.C, plant.Bd, plant.Dd, plant.Bf, plant.Df)
    return plant.nx + plant.nd + plant.nf <= MOST_EXACT_UNKNOWNS and not any(map(holds_computed, matrices))


def question(plant: DescriptorSystem, removed: Sequence[int], number: int, exactly: bool | None = None) -> Question:
    """Return a question about a fault; exact (unless it is said) where the plant is decided exactly."""
    return Questions(plant, decided_exactly(plant) if exactly is None else exactly).of(removed, number)


@dataclass(frozen=True, eq=False)
class Questions:
    """Questions about the faults of one plant: what several of them rest on is computed once."""

    source: DescriptorSystem
    exactly: bool
    _removals: dict[tuple[int, ...], Removal] = field(default_factory=dict, repr=False)
    _pencils: dict[tuple[int, ...], ExactPencil] = field(default_factory=dict, repr=False)
    _asked: dict[tuple[tuple[int, ...], int], Question] = field(default_factory=dict, repr=False)

    def of(self, removed: Sequence[int], number: int) -> Question:
        """Return the question about a fault, with others removed."""
        gone = tuple(sorted(removed))
        if (gone, number) not in self._asked:
            if gone not in self._removals:
                self._removals[gone] = Removal(self.source, gone, self._pencils)
            removal, small = self._removals[gone], self.source.nx + self.source.ny <= MOST_REDUCED
            exact = ExactQuestion(removal, number, small) if self.exactly else None
            self._asked[gone, number] = exact or Question(removal, number)
        return self._asked[gone, number]


def _order_at_infinity(plant: DecoupledPlant, f: FloatArray, g: FloatArray) -> int:
    """Return the derivatives needed; rows without y, u are exact, and differentiating those costs nothing."""
    n = plant.order
    if n == 0:
        return 0
    inverse = np.linalg.inv(plant.E * plant.time)
    a, f, known = inverse @ plant.A, inverse @ f, inverse @ plant.signals[:n]
    rows = np.hstack([plant.C, g, plant.signals[n:]])
    independent = _rank(rows)
    for _ in range(n):
        full = np.linalg.norm(rows, 2)
        left, values, _ = np.linalg.svd(rows[:, n:])
        rank = rank_from(values, expected=len(rows), scale=float(full)).rank
        new = left[:, rank:].T @ rows[:, :n]
        if not new.size or np.linalg.norm(new) <= MARKOV_TOLERANCE * full:
            break
        rows = _compressed(np.vstack([rows, np.hstack([new @ a, new @ f, new @ known])]))
        before, independent = independent, _rank(rows)
        if independent == before:
            break
    c, direct, vector, order = rows[:, :n], rows[:, n : n + 1], f, 0
    size = max(float(np.linalg.norm(direct)), float(np.linalg.norm(c, 2) * np.linalg.norm(vector)))
    while np.linalg.norm(direct) <= MARKOV_TOLERANCE * size and order <= n:
        direct = c @ vector
        size = float(np.linalg.norm(c, 2) * np.linalg.norm(vector))
        vector = a @ vector
        order += 1
    return order


def _compressed(rows: FloatArray) -> FloatArray:
    """Return no more rows than columns, with the same singular values: a triangle of them where they are many."""
    return np.asarray(np.linalg.qr(rows, mode="r")) if rows.shape[0] > rows.shape[1] else rows


def _rank(matrix: FloatArray) -> int:
    values = np.linalg.svd(matrix, compute_uv=False)
    return rank_from(np.asarray(values), expected=min(matrix.shape), tolerance=RANK_TOLERANCE).rank


def _reduced(e: fmpq_mat, a: fmpq_mat, right: fmpq_mat) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat, fmpq_poly]:
    """Return A, C, the columns ``right`` beside both, and the polynomial of the finite zeros that were taken out."""
    while True:
        kernel = null_basis(e)
        if kernel.ncols() == 0:
            break
        kept = pivot_columns(e)
        rest = left_null_basis(a * kernel)
        e, a, right = rest * picked_columns(e, kept), rest * picked_columns(a, kept), rest * right
    rows = pivot_columns(e.transpose())
    free = left_null_basis(e)
    top, c, outputs = picked_rows(e, rows), free * a, free * right
    if not rows:
        return zeros_matrix(0, 0), zeros_matrix(c.nrows(), 0), zeros_matrix(0, right.ncols()), outputs, fmpq_poly([1])
    whole = top.solve(blocks([[picked_rows(a, rows), picked_rows(right, rows)]]))
    n = len(rows)
    a, right = picked_columns(whole, range(n)), picked_columns(whole, range(n, whole.ncols()))
    seen = row_basis(c)
    while True:
        more = row_basis(blocks([[seen], [seen * a]]))
        if more.nrows() == seen.nrows():
            break
        seen = more
    if seen.nrows() == n:
        return a, c, right, outputs, fmpq_poly([1])
    pivots = pivot_columns(seen)
    kept_a = picked_columns(seen * a, pivots)
    zeros = a.charpoly() / kept_a.charpoly() if pivots else a.charpoly()
    return kept_a, picked_columns(c, pivots), seen * right, outputs, fmpq_poly(zeros)


def _is_zero(matrix: fmpq_mat) -> bool:
    return all(value == 0 for value in matrix.entries())


def _values(roots: Sequence[Root]) -> ComplexArray:
    listed = [root.value for root in roots for _ in range(root.multiplicity)]
    return np.array(listed, dtype=np.complex128)


def exact_residual_order(A: fmpq_mat, C: fmpq_mat, F: fmpq_mat, G: fmpq_mat, K: fmpq_mat, L: fmpq_mat) -> int | None:
    """Return the least order for one fault, over the rational numbers; ``None`` where no equation shows it."""
    n, known, free = A.nrows(), K.ncols(), -1
    # Rows [w | z | f, f', ...] in echelon form: those without w come last, then those without z.
    rows = blocks([[L, C, G]])
    while True:
        # Equations of the fault alone, which a plant that is not regular may have.
        if _from_column(rows, known + n).nrows():
            return 0
        rows = _kept(rows, known + n)
        without = _from_column(rows, known)
        if without.nrows() <= free:
            break
        free = without.nrows()
        z, f = _split(without, known, n)
        rows = blocks([[rows, zeros_matrix(rows.nrows(), 1)], [z * K, z * A, z * F, f]])
    equations = picked_columns(rows, range(known, rows.ncols()))
    base = equations
    for order in range(n + 1):
        if _from_column(equations, n).nrows():
            return order
        z, f = _split(_kept(equations, n), 0, n)
        if not z.nrows():
            break
        equations = blocks([[z * A, z * F, f]])
        padding = zeros_matrix(base.nrows(), equations.ncols() - base.ncols())
        equations = blocks([[base, padding], [equations]])
    return None


def _split(rows: fmpq_mat, known: int, n: int) -> tuple[fmpq_mat, fmpq_mat]:
    return picked_columns(rows, range(known, known + n)), picked_columns(rows, range(known + n, rows.ncols()))


def _echelon(rows: fmpq_mat) -> list[list[fmpq]]:
    reduced, rank = rows.rref()
    return reduced.tolist()[:rank]


def _kept(rows: fmpq_mat, columns: int) -> fmpq_mat:
    """Return independent combinations of rows whose first columns are independent; what has none of them goes."""
    listed = [row for row in _echelon(rows) if any(value != 0 for value in row[:columns])]
    return fmpq_mat(len(listed), rows.ncols(), [value for row in listed for value in row])


def _from_column(rows: fmpq_mat, columns: int) -> fmpq_mat:
    """Return independent combinations of rows that are zero in the first columns."""
    listed = list(dropwhile(lambda row: any(value != 0 for value in row[:columns]), _echelon(rows)))
    return fmpq_mat(len(listed), rows.ncols(), [value for row in listed for value in row])


class _Rows(NamedTuple):
    """Equations ``0 = z_rows z + sum_k f_rows[:, k] s^k f``, one column of `f` for each fault."""

    z: FloatArray  # ``(r, n)``
    f: FloatArray  # ``(r, degree + 1, count)``

    def joined(self, more: _Rows) -> _Rows:
        degree = max(self.f.shape[1], more.f.shape[1])
        f = [np.pad(part.f, ((0, 0), (0, degree - part.f.shape[1]), (0, 0))) for part in (self, more)]
        return _Rows(np.vstack([self.z, more.z]), np.concatenate(f))

    def differentiated(self, A: FloatArray, F: FloatArray) -> _Rows:
        return _Rows(self.z @ A, np.concatenate([(self.z @ F)[:, None], self.f], axis=1))

    def combined(self, factors: FloatArray) -> _Rows:
        return _Rows(factors @ self.z, np.tensordot(factors, self.f, axes=1))


def residual_orders(
    A: FloatArray, C: FloatArray, F: FloatArray, G: FloatArray, K: FloatArray, L: FloatArray
) -> list[int | None]:
    """Return the least order for each fault, in floating point; ``None`` where no equation shows it.

    The columns of ``[F; G]`` and of ``[K; L]`` have entries near one, as A and C; rows of zeros are equations as well.
    """
    n, count = A.shape[0], F.shape[1]
    basis, (new, alone) = _Rows(np.zeros((0, n)), np.zeros((0, 1, count))), _of_degree_zero(A, C, F, G, K, L)
    found: list[int | None] = [0 if is_alone else None for is_alone in alone.tolist()]
    scale = largest_singular_value(C)
    for order in range(n + 1):
        new, hidden, terms = _beside(basis, new, scale)
        shown = _shown(hidden, terms)
        found = [order if seen and one is None else one for one, seen in zip(found, shown.tolist(), strict=True)]
        if not len(new.z) or all(one is not None for one in found):
            break
        basis, new, scale = basis.joined(new), new.differentiated(A, F), largest_singular_value(A)
    return found


def _shown(hidden: FloatArray, terms: FloatArray) -> NDArray[np.bool_]:
    """Return which faults stand in equations, of which these are the fault parts and the sizes of their terms."""
    return np.asarray(np.any(np.linalg.norm(hidden, axis=1) > TRACE_TOLERANCE * np.maximum(terms, 1.0), axis=0))


def _of_degree_zero(
    A: FloatArray, C: FloatArray, F: FloatArray, G: FloatArray, K: FloatArray, L: FloatArray
) -> tuple[_Rows, NDArray[np.bool_]]:
    """Return the equations in which no derivative of w stands, and which faults have equations without z and w, as a
    plant that is not regular may have them."""
    n, count = A.shape[0], F.shape[1]
    alone = np.zeros(count, dtype=bool)
    rows, w = _Rows(C, G[:, None]), L
    free = _Rows(np.zeros((0, n)), np.zeros((0, 1, count)))
    size = max(largest_singular_value(L), largest_singular_value(K))
    scale = largest_singular_value(C)
    for _ in range(n + 1):
        left, values, _ = full_svd(w)
        rank = int(np.count_nonzero(values > RANK_TOLERANCE * size))
        new, hidden, terms = _beside(free, rows.combined(left[:, rank:].T), scale)
        alone |= _shown(hidden, terms)
        rows, w = rows.combined(left[:, :rank].T), left[:, :rank].T @ w
        if not len(new.z):
            break
        # Their derivatives hold no derivative of w: they are of degree 0 as well.
        free, scale = free.joined(new), max(scale, largest_singular_value(A))
        rows, w = rows.joined(new.differentiated(A, F)), np.vstack([w, new.z @ K])
    return rows.joined(free), alone


def _beside(basis: _Rows, rows: _Rows, scale: float) -> tuple[_Rows, FloatArray, FloatArray]:
    """Return what rows add to an orthonormal basis, orthonormal; fault parts of what adds nothing, and their terms."""
    z, f = rows
    terms = np.linalg.norm(f, axis=(0, 1))
    for _ in range(2):
        share = z @ basis.z.T
        taken = _Rows(z, f).joined(basis.combined(-share))
        z, f = taken.z[: len(z)] + taken.z[len(z) :], taken.f[: len(z)] + taken.f[len(z) :]
        terms = terms + np.linalg.norm(np.tensordot(np.abs(share), np.abs(basis.f), axes=1), axis=(0, 1))
    left, values, right = np.linalg.svd(z, full_matrices=len(z) > z.shape[1])
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * scale))
    new = _Rows(right[:rank], np.tensordot(left[:, :rank].T / values[:rank, None], f, axes=1))
    return new, np.tensordot(left[:, rank:].T, f, axes=1), np.asarray(terms)


#: Plants with more states are not searched for pairs.
MOST_STATES_FOR_SENSOR_PAIRS = 24
#: Plants with more states are not searched for suggestions at all.
MOST_STATES_FOR_SENSORS = 120
#: Sets of sensors that are listed; the others are counted.
MOST_LISTED_CHOICES = 6


@dataclass(frozen=True, eq=False)
class Sensor:
    """A signal that could be measured: rows of C, D, Dd and Df."""

    name: str
    C: FloatArray
    D: FloatArray
    Dd: FloatArray
    Df: FloatArray
    deviation: float | None = None


def state_sensors(plant: DescriptorSystem, names: Sequence[str] | None = None) -> tuple[Sensor, ...]:
    """Return a sensor for each state that is not an output already."""
    measured = set(plant.output_names)
    chosen = [name for name in plant.state_names if name not in measured] if names is None else list(names)
    zero = (np.zeros(plant.nu), np.zeros(plant.nd), np.zeros(plant.nf))
    eye = np.eye(plant.nx)
    return tuple(Sensor(name, eye[plant.state_names.index(name)], *zero) for name in chosen)


def with_sensors(plant: DescriptorSystem, sensors: Sequence[Sensor]) -> DescriptorSystem:
    """Return the plant with more outputs; a stated deviation adds a noise of its own."""
    if not sensors:
        return plant

    def stacked(matrix: FloatArray, part: str) -> FloatArray:
        return np.vstack([matrix, *(getattr(sensor, part)[None, :] for sensor in sensors)])

    stated = [i for i, sensor in enumerate(sensors) if sensor.deviation is not None]
    noise = np.zeros((plant.ny + len(sensors), plant.nw + len(stated)))
    noise[: plant.ny, : plant.nw] = plant.Dw
    for column, i in enumerate(stated):
        noise[plant.ny + i, plant.nw + column] = float(sensors[i].deviation or 0.0)
    names = [*plant.noise_names, *(f"noise of {sensors[i].name}" for i in stated)]
    return plant.replace(
        C=stacked(plant.C, "C"),
        D=stacked(plant.D, "D"),
        Dd=stacked(plant.Dd, "Dd"),
        Df=stacked(plant.Df, "Df"),
        Bw=np.hstack([plant.Bw, np.zeros((plant.nx, len(stated)))]),
        Dw=noise,
        noise_names=names,
        output_names=[*plant.output_names, *(sensor.name for sensor in sensors)],
    )


def least_additions(
    plant: DescriptorSystem,
    sensors: Sequence[Sensor],
    reached: Callable[[DescriptorSystem], bool],
    *,
    most: tuple[int, int] = (MOST_STATES_FOR_SENSORS, MOST_STATES_FOR_SENSOR_PAIRS),
    promising: Callable[[NDArray[np.int64]], NDArray[np.bool_]] | None = None,
) -> tuple[tuple[str, ...], ...]:
    """Return all single sensors that do it, or else all pairs; none for plants of more states than ``most``.

    ``promising`` says of sets ``(N, size)`` of places which ones are to be asked about at all.
    """
    if plant.nx > most[0]:
        return ()
    for size in (1, 2) if plant.nx <= most[1] else (1,):
        sets = np.array(list(combinations(range(len(sensors)), size)), dtype=np.int64).reshape(-1, size)
        asked = sets if promising is None else sets[promising(sets)]
        sensor_sets = [[sensors[i] for i in chosen] for chosen in asked.tolist()]
        helping = [chosen for chosen in sensor_sets if reached(with_sensors(plant, chosen))]
        if helping:
            return tuple(tuple(sensor.name for sensor in chosen) for chosen in helping)
    return ()


def listed_sets(sets: Sequence[Sequence[str]]) -> str:
    """Return sensor sets as a text: ``theta l, or omega l with i``."""
    texts = [" with ".join(names) for names in sets[:MOST_LISTED_CHOICES]]
    more = len(sets) - MOST_LISTED_CHOICES
    return ", ".join(texts) + (f", or {more} others" if more > 0 else "")


#: A motion is stated where it cancels the fault to this, relative to the fault's own column.
EXACTNESS = 1e-8
#: Signals of a motion that are named; the others are counted.
MOST_NAMED_SIGNALS = 6


def hidden_motion(plant: DescriptorSystem, fault: int, point: complex, removed: Sequence[int]) -> str | None:
    """Return in words the amplitudes of states, unknown inputs and other faults with which a fault of 1 leaves every
    output at zero, least in balanced units; all go like ``exp(point t)``, or ``point^k``.  ``None`` where none do."""
    values = hiding_amplitudes(plant, fault, point, removed)
    if values is None:
        return None
    own = plant.fault_names[fault]
    names = (*plant.disturbance_names, *(plant.fault_names[j] for j in removed))
    inputs = [_signal(plant.dt, point, name, value) for name, value in values.items() if name in names]
    states = [f"{name} = {_amplitude(value)}" for name, value in values.items() if name not in names]
    more = len(states) - MOST_NAMED_SIGNALS
    rest = [*states[:MOST_NAMED_SIGNALS], *([f"{more} more states"] if more > 0 else [])]
    others = [*inputs, *([f"states {', '.join(rest)}"] if rest else [])]
    together = f"together with {' and '.join(others)}" if others else "from some initial state"
    return f"{_signal(plant.dt, point, own, 1.0)} is output-nulling {together}"


def hiding_amplitudes(
    plant: DescriptorSystem, fault: int, point: complex, removed: Sequence[int]
) -> dict[str, complex] | None:
    """Return these amplitudes by name, those of inputs first."""
    e, a = unknowns_pencil(plant, removed)
    found = _solved(a - point * e, -np.concatenate([plant.Bf[:, fault], plant.Df[:, fault]]))
    if found is None:
        return None
    names = (*plant.disturbance_names, *(plant.fault_names[j] for j in removed))
    return {**_named(names, found[plant.nx :]), **_named(plant.state_names, found[: plant.nx])}


def _signal(dt: float, point: complex, name: str, value: complex) -> str:
    size = _amplitude(value)
    if point == dc_point(dt):
        return f"a step of {size} in {name}"
    if dt > 0.0:
        return f"{name} = {size} * ({_amplitude(point)})^k"
    if point.real == 0.0:
        return f"a sinusoid of {size} at {abs(point.imag):.4g} rad/s in {name}"
    return f"{name} = {size} * exp({_amplitude(point)} t)"


def _solved(matrix: ComplexArray, right: ComplexArray) -> ComplexArray | None:
    """Return the solution with few entries: least squares, then those that are not needed left out one by one."""
    units = PencilUnits.of(np.zeros(matrix.shape), np.abs(matrix))
    work, goal = units.rows[:, None] * matrix * units.columns, units.rows * right
    reach = float(np.linalg.norm(goal))
    if reach == 0.0:
        return None

    def solve(kept: list[int]) -> tuple[ComplexArray, float]:
        part, *_ = np.linalg.lstsq(work[:, kept], goal, rcond=RANK_TOLERANCE)
        return np.asarray(part, dtype=np.complex128), float(np.linalg.norm(work[:, kept] @ part - goal)) / reach

    kept = list(range(matrix.shape[1]))
    part, miss = solve(kept)
    if miss > EXACTNESS:
        return None
    for index in sorted(kept, key=lambda j: abs(part[kept.index(j)]))[: len(kept) if len(kept) <= 40 else 0]:
        fewer = [j for j in kept if j != index]
        if solve(fewer)[1] <= EXACTNESS:
            kept = fewer
    part, _ = solve(kept)
    whole = np.zeros(matrix.shape[1], dtype=np.complex128)
    whole[kept] = part
    # What is only rounding in balanced units is nothing in those of the data.
    whole[np.abs(whole) <= RANK_TOLERANCE * float(np.max(np.abs(whole), initial=0.0))] = 0.0
    return np.asarray(units.columns * whole)


def _named(names: Sequence[str], values: ComplexArray) -> dict[str, complex]:
    return {name: complex(value) for name, value in zip(names, values, strict=True) if value != 0.0}


def _amplitude(value: complex) -> str:
    if abs(value.imag) <= EXACTNESS * abs(value):
        return f"{value.real:.3g}"
    return f"{value.real:.3g}{value.imag:+.3g}j"
