"""Fault detectability indexes and matrix: bounded and relative in floating point, exact on the numbers as written.

Source: Wang 2015, Definitions 2 and 3, Theorem 2 (i). They are the same for every nonsingular T with ``T E + N C = I``.

Preparing a plant for the fault-estimation filter: sensor faults as states, units, T and N with ``T E + N C = I``.

Source: Wang 2015, eqs. (7), (16)-(17). Differences: ``S = [I, C']`` gives a singular T, which loses algebraic
equations, in 13 of 276 random systems: ours is nonsingular by construction. Feedthrough is exact in ``e = T E x - z``,
since ``N Dd d(k+1)`` drops out: ``e+ = (TA - L C) e + (T Bd - TA N Dd - L (I - C N) Dd) d``, ``r = W (C e + (I - C N)
Dd d)``.

When a fault-estimation filter exists: Wang et al. 2015, section 2 and Theorem 2 (i); the zero condition is ours.

A plant within rounding of the data for which two faults first reach the outputs in the same direction.

``C (TA)^k T`` does not depend on the faults, so one column of Bf is changed: by what makes its first visible vector a
combination of the others', and leaves what came before it invisible.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from flint import fmpq, fmpq_mat

from obsynth.analysis.conditions import Condition, up_to_failure
from obsynth.analysis.existence.named_pencils import (
    ROUNDING_LEVEL,
    WITNESS_DIGITS,
    EntryChange,
    Unclear,
    Witness,
    rational_matrices,
)
from obsynth.analysis.existence.statements import (
    DECIDER,
    Evaluator,
    FullRank,
    NoZeroOutside,
    PlantNumbers,
    SystemFacts,
    numbers_of,
    reconsidered,
    settled_rank,
)
from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.transformations.linear_plants import augment_faults
from obsynth.analysis.zeros import MOST_NAMES, Zero, hidden_faults, leading_names, regularity_of, zero_at
from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.arguments import FloatArray, largest_singular_value, remembered, require_shape
from obsynth.numerics.ranks import (
    CANCELLATION_TOLERANCE,
    DEAD_CHAIN_TOLERANCE,
    MARKOV_TOLERANCE,
    RANK_TOLERANCE,
    RankDecision,
    decide_rank,
)
from obsynth.numerics.scaling import Scaling, balance_system, power_of_two_below
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.exact_arithmetic import (
    blocks,
    identity,
    left_null_basis,
    picked_columns,
    pivot_columns,
    zeros_matrix,
)

#: Random choices of T after which none is taken to be nonsingular.
MOST_CHOICES = 20
#: Faults with at least this share of the largest in a dependence are named.
DEPENDENT_SHARE = 0.1
_PENCIL_SEED = 45


#: Indexes (``None``: the fault never reaches the outputs) and the rank of Upsilon (0 where one is missing).
ExactIndexes: TypeAlias = tuple[tuple[int | None, ...], int]


def numbers_with_fault_states(plant: DescriptorSystem, numbers: PlantNumbers | None) -> PlantNumbers | None:
    """Return the numbers of a plant with its sensor faults appended as algebraic states."""
    chosen = [int(j) for j in np.flatnonzero(np.any(plant.Df != 0.0, axis=0))]
    if numbers is None or not chosen:
        return numbers
    nx, nf, count = plant.nx, plant.nf, len(chosen)
    across, down, square = zeros_matrix(nx, count), zeros_matrix(count, nx), zeros_matrix(count, count)
    shown = picked_columns(identity(nf), chosen)
    rows = shown.transpose()
    kept = identity(nf) - shown * rows
    own = numbers.as_own
    changed: dict[str, Any] = {
        "E": blocks([[numbers.matrices["E"], own(across)], [own(down), own(square)]]),
        "A": blocks([[numbers.matrices["A"], own(across)], [own(down), own(-identity(count))]]),
        "Bf": blocks([[numbers.matrices["Bf"]], [own(rows)]]),
        "C": blocks([[numbers.matrices["C"], numbers.product(numbers.matrices["Df"], own(shown))]]),
        "Df": numbers.product(numbers.matrices["Df"], own(kept)),
    }
    e, c, df = (numbers.rational[name] for name in ("E", "C", "Df"))
    rational = {"E": blocks([[e, across], [down, square]]), "C": blocks([[c, df * shown]]), "Df": df * kept}
    return numbers.with_matrices(changed, rational=rational)


def exact_indexes(plant: DescriptorSystem) -> ExactIndexes | None:
    """Return them where ``rank [E; C]`` is full; ``None`` where that fails, or data were computed."""
    numbers = numbers_of(plant)
    if numbers is None or numbers.computed:
        return None  # a Markov parameter that is zero may have been computed as one that is not
    found: ExactIndexes | None = numbers.remembered("indexes", lambda: _decided_indexes(plant, numbers))
    return found


def _decided_indexes(plant: DescriptorSystem, known: PlantNumbers) -> ExactIndexes | None:
    numbers = numbers_with_fault_states(plant, known)
    if numbers is None:
        return None
    t = nonsingular_t(numbers)
    if t is None:
        return None
    left: Any = numbers.as_own(t)
    ta, c = numbers.product(left, numbers.matrices["A"]), numbers.matrices["C"]
    order, indexes, columns = int(t.ncols()), list[int | None](), list[Any]()
    for fault in range(plant.nf):
        vector = numbers.product(left, numbers.columns("Bf", [fault]))
        for step in range(1, order + 1):
            shown = numbers.product(c, vector)
            if numbers.rank(shown):
                indexes.append(step)
                columns.append(shown)
                break
            vector = numbers.product(ta, vector)
        else:
            indexes.append(None)
    rank = numbers.rank(blocks([columns])) if None not in indexes and columns else 0
    return tuple(indexes), rank


def nonsingular_t(numbers: PlantNumbers) -> fmpq_mat | None:
    """Return a rational nonsingular T with ``T E + N C = I``."""
    e, c = numbers.rational["E"], numbers.rational["C"]
    stacked, order = blocks([[e], [c]]), int(e.ncols())
    if stacked.rank() < order:
        return None
    inverse = (stacked.transpose() * stacked).solve(stacked.transpose())
    free, rng = left_null_basis(stacked), random.Random(_PENCIL_SEED)
    for size in range(MOST_CHOICES):
        mix = fmpq_mat(order, int(free.nrows()), [rng.randint(-size, size) for _ in range(order * int(free.nrows()))])
        both = inverse + mix * free
        t = picked_columns(both, range(order))
        if t.det() != 0:
            return t
    return None


#: A fault detectability matrix with a larger condition number is usable but noisy: a note says so.
WARN_DETECTABILITY_CONDITION = 1e4
#: Above this rounding of data and gains is as large as what distinguishes the faults.
REFUSE_CONDITION = 1e12


@dataclass(frozen=True, eq=False)
class FaultDetectability:
    """Indexes ``rho_i`` (``None``: no effect on the outputs) and matrices of ``(TA, C)`` for the fault directions
    ``TF``.

    ``Psi (nx, nf)``: columns ``(TA)^(rho_i - 1) T f_i``, else zero; ``Upsilon = C Psi``.
    """

    indexes: tuple[int | None, ...]
    Psi: FloatArray
    Upsilon: FloatArray
    rank: RankDecision
    condition_number: float  # of Upsilon with columns of unit length

    @property
    def finite(self) -> bool:
        """Whether every fault reaches the outputs."""
        return all(index is not None for index in self.indexes)

    def chain(self, ta: FloatArray, tf: FloatArray) -> list[FloatArray]:
        """Return the powers ``[TF, TA TF, ...]`` up to the largest index, one matrix ``(nx, nf)`` each."""
        powers = [tf]
        for _ in range(max((index or 1) for index in self.indexes) - 1):
            powers.append(ta @ powers[-1])
        return powers


def fault_detectability(
    ta: FloatArray,
    c: FloatArray,
    tf: FloatArray,
    *,
    plant: DescriptorSystem,
    scaling: Scaling | None = None,
    exact: ExactIndexes | None = None,
) -> FaultDetectability:
    """Return the detectability indexes (19) and matrices (20), with the exact ones where these are known.
    What shows is judged in units of the plant's own; ``scaling``: those of the matrices, if not the given ones."""
    if exact is None:
        units = PlantUnits.of(plant).rounded()
        states, outputs = units.states, units.outputs
        if scaling is not None:
            states, outputs = states / scaling.states, outputs / scaling.outputs
        own, shown, entering = ta * states / states[:, None], outputs[:, None] * c * states, tf / states[:, None]
        size = largest_singular_value(shown)
        found = [_first_visible(own, shown, entering[:, i], size) for i in range(tf.shape[1])]
        results = [(index, states * vector) for index, vector in found]
    else:
        results = [_at_index(ta, tf[:, i], index) for i, index in enumerate(exact[0])]
    psi = np.column_stack([vector for _, vector in results]) if results else np.zeros((ta.shape[0], 0))
    upsilon = c @ psi
    lengths = np.linalg.norm(upsilon, axis=0)
    unit = upsilon / np.where(lengths == 0.0, 1.0, lengths)
    values = np.linalg.svd(unit, compute_uv=False) if unit.size else np.ones(1)
    invertible = unit.shape[0] >= unit.shape[1] and values[-1] > 0.0
    condition = float(values[0] / values[-1]) if invertible else np.inf
    rank = decide_rank(unit, expected=tf.shape[1], tolerance=1.0 / REFUSE_CONDITION)
    rank = settled_rank(rank, None if exact is None else exact[1])
    return FaultDetectability(tuple(index for index, _ in results), psi, upsilon, rank, condition)


def _at_index(ta: FloatArray, direction: FloatArray, index: int | None) -> tuple[int | None, FloatArray]:
    """Return the vector ``(TA)^(index - 1) direction``."""
    if index is None:
        return None, np.zeros_like(direction)
    for _ in range(index - 1):
        direction = ta @ direction
    return index, direction


def _first_visible(ta: FloatArray, c: FloatArray, direction: FloatArray, size: float) -> tuple[int | None, FloatArray]:
    """Return the index of one fault and the vector that shows; by Cayley-Hamilton nx steps suffice."""
    growth: float | None = None
    vector, bound = direction, float(np.linalg.norm(direction))
    for step in range(1, ta.shape[0] + 1):
        length = float(np.linalg.norm(vector))
        if length <= DEAD_CHAIN_TOLERANCE * bound or length == 0.0:
            break
        if float(np.linalg.norm(c @ vector)) > MARKOV_TOLERANCE * size * length:
            return step, vector
        growth = max(largest_singular_value(ta), 1.0) if growth is None else growth
        vector, bound = ta @ vector, bound * growth
    return None, np.zeros_like(direction)


def detectability_conditions(
    detectability: FaultDetectability, fault_names: tuple[str, ...], output_scales: FloatArray
) -> tuple[Condition, ...]:
    """Return the conditions on indexes and matrix; ``output_scales (ny,)`` give norms in the user's units."""
    hidden = tuple(name for name, index in zip(fault_names, detectability.indexes, strict=True) if index is None)
    largest = max((index for index in detectability.indexes if index is not None), default=0)
    finite = Condition(
        "finite detectability indexes",
        "every fault reaches the outputs",
        not hidden,
        float(largest),
        float(detectability.Psi.shape[0]),
        "Wang 2015, eq. (19)",
        f"fault {', '.join(map(repr, hidden))} reaches no output: measure something that it acts on."
        if hidden
        else f"indexes {', '.join(map(str, detectability.indexes))}",
        signals=hidden,
    )
    if hidden:
        return (finite,)
    rank, user_units = detectability.rank, detectability.Upsilon / output_scales[:, None]
    # Where the rank was decided exactly, nearness to losing it has been judged with it.
    usable = rank.full and (rank.means == "exact" or detectability.condition_number <= REFUSE_CONDITION)
    mixed = () if usable else _dependent_faults(detectability.Upsilon, fault_names)
    independent = Condition(
        "rank Upsilon",
        "the first responses of the outputs to the faults are linearly independent (rank Upsilon = nf)",
        usable,
        detectability.condition_number,
        REFUSE_CONDITION,
        "Wang 2015, Theorem 2 (i)",
        f"{rank.describe()}, condition number {_told(detectability.condition_number)}, "
        f"||Upsilon|| = {largest_singular_value(user_units):.3g}"
        + (
            f"; {_names(mixed)} cannot be distinguished at first sight. Leave one out, or measure more."
            if mixed
            else "."
        ),
        signals=mixed,
    )
    return finite, independent


def _told(condition_number: float) -> str:
    """Return the number to the digits that are not rounding: none beyond what a double holds."""
    most = 1.0 / CANCELLATION_TOLERANCE
    return f"{condition_number:.3g}" if condition_number < most else f"above {most:.0e}"


def _names(faults: tuple[str, ...]) -> str:
    return f"the faults {', '.join(map(repr, faults))}"


def _dependent_faults(upsilon: FloatArray, names: tuple[str, ...]) -> tuple[str, ...]:
    lengths = np.linalg.norm(upsilon, axis=0)
    direction = np.abs(np.linalg.svd(upsilon / lengths)[2][-1])
    return tuple(
        name for name, size in zip(names, direction, strict=True) if size > DEPENDENT_SHARE * np.max(direction)
    )


def restricted_equivalent(e: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ``T (nx, nx)``, nonsingular, and ``N (nx, ny)`` with ``T E + N C = I``.

    ``W = E'E + C'C``, ``T = W^-1 E' + K Q U'``, ``N = W^-1 C'``: U spans null E', K spans ``C'C ker E``, Q is the
    orthogonal polar factor of ``K'U``.
    """
    stacked = np.vstack([e, c])
    # W^-1 [E' C'] is the pseudo-inverse; by QR, and one refinement, it is accurate where forming W is not.
    q, r = np.linalg.qr(stacked)
    solved = np.linalg.solve(r, q.T)
    solved = solved + (np.eye(e.shape[1]) - solved @ stacked) @ solved
    t, n = solved[:, : e.shape[0]], solved[:, e.shape[0] :]
    left, values, right = np.linalg.svd(e)
    rank = int(np.sum(values > RANK_TOLERANCE * values[0])) if values[0] > 0.0 else 0
    if rank == e.shape[0]:
        return t, n
    left_null, null = left[:, rank:], right[rank:].T
    k = np.linalg.qr(c.T @ (c @ null))[0]
    u, _, v = np.linalg.svd(k.T @ left_null)
    return t + k @ (u @ v) @ left_null.T, n


def restricted_equivalent_from(e: FloatArray, c: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return T and N by the paper's general solution (16)-(17) with its free matrix ``S (nx, nx + ny)``."""
    nx, ny = e.shape[0], c.shape[0]
    require_shape(s.shape, (nx, nx + ny), "S")
    stacked = np.vstack([e, c])
    # Of full column rank: its columns may be scaled, so that states in small units are not taken for zero.
    units = np.exp2(np.round(np.log2(np.linalg.norm(stacked, axis=0))))
    pseudo = np.linalg.pinv(stacked / units) / units[:, None]
    m = pseudo + s @ (np.eye(nx + ny) - stacked @ pseudo)
    t, n = m[:, :nx], m[:, nx:]
    rank = decide_rank(t, expected=nx)
    if not rank.full:
        raise SpecError(
            f"This S makes T singular ({rank.describe()}), which discards algebraic equations: choose another S, or "
            "leave it out for a T that is nonsingular by construction.",
            path="S",
        )
    return t, n


#: Units are kept while the condition numbers of ``[E; C]`` and T are below this.
MOST_CONDITION = 256.0


@dataclass(frozen=True, eq=False)
class PreparedPlant:
    """A plant in the form the theory works on: ``plant`` has sensor faults as states, and is not balanced.

    The rest is in the coordinates of ``scaling``: T, N, TA, C, and disturbance and noise as they enter the error
    system (``Bd``, ``Bw``) and the innovation (``Dd``, ``Dw``).
    """

    plant: DescriptorSystem
    scaling: Scaling
    T: FloatArray
    N: FloatArray
    TA: FloatArray
    C: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    detectability: FaultDetectability


def with_sensor_faults_as_states(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant with every fault that reaches an output directly appended as an algebraic state."""
    direct = tuple(name for name, column in zip(plant.fault_names, plant.Df.T, strict=True) if np.any(column != 0.0))
    return augment_faults(plant, direct).plant if direct else plant


def _units(work: DescriptorSystem) -> Iterator[Scaling]:
    """Yield units to try in turn: balanced, natural, and balanced with the rows of E of one size.

    The last where A is far larger than E: T would lose an equation scaled by A beside an output of the same state.
    """
    balanced = balance_system(work.E, work.A, inputs=[work.Bf], outputs=[work.C])
    yield balanced
    units = PlantUnits.of(work).rounded()
    yield Scaling(units.equations, units.states, units.outputs)
    sizes = np.linalg.norm(balanced.scale_dynamics(work.E), axis=1)
    yield replace(balanced, equations=balanced.equations / power_of_two_below(np.where(sizes > 0.0, sizes, 1.0)))


def _equivalent(work: DescriptorSystem) -> tuple[Scaling, FloatArray, FloatArray]:
    """Return units in which ``[E; C]`` and T are well conditioned, or as well as can be had, with T and N in them."""
    tried, least = list[tuple[float, tuple[Scaling, FloatArray, FloatArray]]](), np.inf
    for scaling in _units(work):
        if any(_are_same(scaling, known[0]) for _, known in tried):
            continue
        e, c = scaling.scale_dynamics(work.E), scaling.scale_output(work.C)
        condition = float(np.linalg.cond(np.vstack([e, c])))
        if condition >= least:
            continue  # whatever T is
        t, n = restricted_equivalent(e, c)
        condition = max(condition, float(np.linalg.cond(t)))
        tried.append((condition, (scaling, t, n)))
        least = min(least, condition)
        if condition <= MOST_CONDITION:
            break
    return min(tried, key=lambda entry: entry[0])[1]


def _are_same(one: Scaling, other: Scaling) -> bool:
    pairs = (one.equations, other.equations), (one.states, other.states), (one.outputs, other.outputs)
    return all(np.array_equal(*pair) for pair in pairs)


def prepare(plant: DescriptorSystem, s: FloatArray | None = None, *, exactly: bool = True) -> PreparedPlant:
    """Return the prepared plant, with T from ``s (na, na + ny)`` where given; the rank conditions must hold."""
    work = with_sensor_faults_as_states(plant)
    scaling, t, n = _equivalent(work)
    a, c = scaling.scale_dynamics(work.A), scaling.scale_output(work.C)
    if s is not None:
        # S is meant for the plant as given; what it makes is then moved to the balanced coordinates, exactly.
        t, n = restricted_equivalent_from(work.E, work.C, s)
        t, n = t / scaling.states[:, None] / scaling.equations, n / scaling.states[:, None] / scaling.outputs
    ta, tf = t @ a, t @ scaling.scale_input(work.Bf)
    shown = np.eye(work.ny) - c @ n

    def error_input(b: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        direct = scaling.scale_feedthrough(d)
        return t @ scaling.scale_input(b) - ta @ (n @ direct), shown @ direct

    found = fault_detectability(ta, c, tf, plant=work, scaling=scaling, exact=exact_indexes(plant) if exactly else None)
    bd, dd = error_input(work.Bd, work.Dd)
    bw, dw = error_input(work.Bw, work.Dw)
    return PreparedPlant(work, scaling, t, n, ta, c, bd, dd, bw, dw, found)


def index_doubt(judge: Evaluator, detectability: FaultDetectability) -> Unclear | None:
    """Return why the rank of Upsilon is unclear; ``None`` where it is not."""
    if not detectability.finite or not _is_in_doubt(judge, detectability):
        return None
    plant, units, best = judge.plant, judge.units, None
    lengths = np.linalg.norm(detectability.Upsilon, axis=0)
    direction = np.linalg.svd(detectability.Upsilon / lengths)[2][-1] / lengths
    direction = direction / direction[int(np.argmax(np.abs(direction)))]
    for digits in WITNESS_DIGITS:
        found = _changed(plant, units, detectability.indexes, np.round(direction, digits))
        if found is not None and (best is None or found.size < best.size):
            best = found
        if best is not None and best.size <= ROUNDING_LEVEL:
            break
    size = 0.0 if best is None else best.size
    return Unclear(max(ROUNDING_LEVEL, size), best, f"has rank Upsilon = {detectability.rank.expected - 1}", DECIDER)


def _is_in_doubt(judge: Evaluator, detectability: FaultDetectability) -> bool:
    """Whether the faults can be distinguished on paper, but not in numbers."""
    rank = detectability.rank
    if rank.full or rank.means != "tolerance":
        return rank.means == "unclear" or (
            rank.means == "tolerance" and detectability.condition_number > REFUSE_CONDITION
        )
    # Of computed data only floating point has spoken: what they were rounded to may say otherwise.
    if judge.numbers is None:
        return False
    found = _exact(judge.plant)
    if found is None:
        return False
    a, c, faults, _ = found
    columns = [c * _moved(a, faults, fault, index) for fault, index in enumerate(detectability.indexes)]
    return int(blocks([columns]).rank()) == rank.expected


def _exact(plant: DescriptorSystem) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat] | None:
    """Return ``T A``, C, ``T Bf`` and T of the plant as written, with its sensor faults as states."""
    plant = Witness((), 0.0).plant(plant)
    numbers = numbers_with_fault_states(plant, numbers_of(plant))
    t = nonsingular_t(numbers) if numbers is not None and numbers.exact else None
    if t is None or numbers is None:
        return None
    return t * numbers.matrices["A"], numbers.matrices["C"], t * numbers.matrices["Bf"], t


def _moved(a: fmpq_mat, faults: fmpq_mat, fault: int, index: int | None) -> fmpq_mat:
    """Return the vector of a fault that becomes visible."""
    vector = picked_columns(faults, [fault])
    for _ in range(int(index or 1) - 1):
        vector = a * vector
    return vector


def _changed(
    plant: DescriptorSystem, units: PlantUnits, indexes: tuple[int | None, ...], direction: np.ndarray
) -> Witness | None:
    """Return the changes of the column of the fault whose share of the direction is one, where there are any."""
    found, chosen = _exact(plant), int(np.argmax(np.abs(direction)))
    if found is None:
        return None
    a, c, faults, t = found
    # Of shares that rounding has made alike another one may be the first of the largest, with the other sign.
    shares = [_scalar(Fraction(float(share)) / Fraction(float(direction[chosen]))) for share in direction]
    parts = [c * _moved(a, faults, fault, index) * shares[fault] for fault, index in enumerate(indexes)]
    rest, maps, through = sum(parts[1:], start=parts[0]), list["fmpq_mat"](), t
    for _ in range(int(indexes[chosen] or 1)):
        maps.append(c * through)
        through = a * through
    order = np.argsort(-units.equations[: plant.nx], kind="stable")[::-1]
    solved = _solution(maps, rest, [int(i) for i in order])
    if solved is None:
        return None
    exact = rational_matrices(plant)["Bf"]
    changes = tuple(
        EntryChange("Bf", i, chosen, exact[i, chosen], exact[i, chosen] - delta) for i, delta in solved if delta
    )
    scale = units.equations * units.faults[chosen]
    size = max((float(scale[c.row] * abs(float(c.after - c.before))) for c in changes), default=0.0)
    return Witness(changes, size) if changes else None


def _solution(maps: list[fmpq_mat], rest: fmpq_mat, order: list[int]) -> list[tuple[int, Fraction]] | None:
    """Return delta with ``maps[-1] delta = rest``, and zero for all maps before it, on few equations in this order."""
    whole = blocks([[part] for part in maps])
    picked = picked_columns(whole, order)
    right = blocks([[zeros_matrix(int(whole.nrows()) - int(rest.nrows()), 1)], [rest]])
    pivots = pivot_columns(picked)
    basis = picked_columns(picked, pivots)
    if not pivots or blocks([[basis, right]]).rank() > len(pivots):
        return None
    found = (basis.transpose() * basis).solve(basis.transpose() * right)
    return [(order[j], Fraction(int(found[k, 0].p), int(found[k, 0].q))) for k, j in enumerate(pivots)]


def _scalar(value: Fraction) -> fmpq_mat:
    return fmpq_mat(1, 1, [fmpq(value.numerator, value.denominator)])


_fault_zeros = partial(
    Condition,
    name="fault zeros",
    claim="every invariant zero from the faults to the outputs strictly inside the unit circle",
    bound=1.0,
    source="never stated in Wang 2015: detectability of (A1, C1)",
)


@remembered
def _decided(_plant: DescriptorSystem) -> dict[bool, tuple[Condition, ...]]:
    """Return the cache of the conditions of a plant, decided exactly or not: synthesis and verification use it."""
    return {}


def fault_filter_conditions(plant: DescriptorSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
    """Return the existence conditions of the fault-estimation filter, in order; the list ends at the first failure."""
    return _decided(plant).get(exactly) or examine_fault_filter(plant, exactly=exactly)[0]


def examine_fault_filter(
    plant: DescriptorSystem, *, exactly: bool = True
) -> tuple[tuple[Condition, ...], PreparedPlant | None]:
    """Return the existence conditions, and the prepared plant on which the last of them were decided."""
    found = reconsidered(Evaluator(plant.dense(), exactly), _examined, lambda found: found[0])
    _decided(plant)[exactly] = found[0]
    return found


def _examined(judge: Evaluator) -> tuple[tuple[Condition, ...], PreparedPlant | None]:
    prepared = list[PreparedPlant]()
    found = up_to_failure(_in_order(judge, prepared))
    return found, prepared[0] if prepared else None


def _in_order(judge: Evaluator, made: list[PreparedPlant]) -> Iterator[Condition]:
    """Yield the conditions, each group examined when it is asked for; the prepared plant is appended to ``made``."""
    plant = judge.plant
    yield from _form_conditions(judge)
    yield from _rank_conditions(judge)
    prepared = prepare(plant, exactly=judge.exactly)
    made.append(prepared)
    *first, last = detectability_conditions(prepared.detectability, plant.fault_names, prepared.scaling.outputs)
    yield from first
    doubt = None if last.holds else index_doubt(judge, prepared.detectability)
    yield last if doubt is None else last.in_doubt(doubt, plant)
    yield _zero_condition(judge)


def _form_conditions(judge: Evaluator) -> list[Condition]:
    plant, numbers = judge.plant, judge.numbers
    if numbers is not None:
        normal_rank = numbers.regular_rank
        regular = normal_rank == plant.nx
    else:
        regular, normal_rank = regularity_of(plant)
    return [
        Condition(
            "discrete time",
            "a discrete-time plant (dt > 0)",
            plant.is_discrete,
            plant.dt,
            0.0,
            "Wang 2015, eq. (1)",
            ""
            if plant.is_discrete
            else "a continuous plant. Sample it first (transform: {sample_time: ...} in "
            "a spec, obsynth.discretise in Python).",
        ),
        Condition(
            "faults",
            "at least one fault",
            plant.nf > 0,
            float(plant.nf),
            1.0,
            "Wang 2015, eq. (1)",
            "" if plant.nf else "none. Name the fault to estimate in Bf or Df.",
        ),
        Condition(
            "regularity",
            "a regular pencil (det(A - zE) not identically zero)",
            regular,
            float(normal_rank),
            float(plant.nx),
            "definition of a descriptor plant",
            f"normal rank {normal_rank} of {plant.nx}"
            + ("" if regular else ": the equations do not determine the states. Add what is missing."),
        ),
    ]


def _rank_conditions(judge: Evaluator) -> Iterator[Condition]:
    plant, source = judge.plant, "Wang 2015, below eq. (1)"
    enough = plant.nf <= plant.ny
    yield Condition(
        "nf <= ny",
        "no more faults than outputs (nf <= ny)",
        enough,
        float(plant.nf),
        float(plant.ny),
        source,
        "" if enough else f"{plant.nf} faults and {plant.ny} output(s). Measure more, or leave a fault out.",
        signals=() if enough else plant.fault_names,
    )
    alike = "some faults act nowhere, or in the same direction as others, and cannot be distinguished."
    acting = FullRank([["Bf"], ["Df"]])
    yield judge.full_rank("rank F", acting, lambda _: (alike, _dependent_columns(plant)), source=source)
    try:
        work = with_sensor_faults_as_states(plant)
    except PreconditionError as error:
        yield Condition(
            error.condition,
            "sensor faults can be distinguished from the states",
            False,
            np.nan,
            np.nan,
            "Wang 2015, eq. (2), with the fault as a state",
            str(error),
            signals=error.signals,
        )
        return
    # Sensor faults are states then, and their columns of Df stand beside C.
    direct = {"Df": np.flatnonzero(plant.Df.any(axis=0)).tolist()}
    outputs, states = FullRank([["C", "Df"]], direct, of_rows=True), FullRank([["E", None], ["C", "Df"]], direct)

    def repeated(matrix: FloatArray) -> tuple[str, tuple[str, ...]]:
        names = leading_names(np.linalg.svd(work.C)[0][:, -1], plant.output_names, most=MOST_NAMES)
        return "some outputs repeat others: leave them out.", names

    def unknown(matrix: FloatArray) -> tuple[str, tuple[str, ...]]:
        names = leading_names(np.linalg.svd(matrix)[2][-1], work.state_names, most=MOST_NAMES)
        told = (
            "not every state is either dynamic or measured. Measure more, or eliminate the algebraic states first "
            "(transform: {eliminate_algebraic_states: true} in a spec)."
        )
        return told, names

    yield judge.full_rank("rank C", outputs, repeated, source=source)
    yield judge.full_rank("rank [E; C]", states, unknown, source="Wang 2015, eq. (2)")


def _zero_condition(judge: Evaluator) -> Condition:
    plant = judge.plant

    def holding(facts: SystemFacts) -> Condition:
        largest = max((abs(value) for value in facts.zeros), default=0.0)
        largest_one = f", largest modulus {largest:.6g}" if facts.zeros else ""
        return _fault_zeros(holds=True, value=largest, detail=f"{len(facts.zeros)} zero(s){largest_one}")

    def lost(facts: SystemFacts) -> Condition:
        if not facts.full:
            names = hidden_faults(plant, missing=facts.columns - facts.normal_rank)
            detail = (
                f"faults {', '.join(map(repr, names))} are together output-nulling: they have no effect on the outputs."
            )
            return _fault_zeros(holds=False, value=np.inf, detail=detail, signals=names)
        point = max(facts.outside, key=abs)
        return _zero_failure(plant, zero_at(plant.E, plant.A, point, plant.Bf, plant.C, plant.Df))

    return judge.no_zero_outside(NoZeroOutside("Bf"), holding=holding, lost=lost, what="filter")


def _zero_failure(plant: DescriptorSystem, zero: Zero) -> Condition:
    value = pole_text(zero.value, 6)
    if zero.is_unobservable_mode:
        signals = leading_names(np.abs(zero.state_direction), plant.state_names, most=MOST_NAMES)
        detail = (
            f"the mode z = {value} (states {', '.join(map(repr, signals))}) is undetectable: no output responds to "
            "it, and it does not decay. Measure something that it moves."
        )
    else:
        signals = leading_names(np.abs(zero.input_direction), plant.fault_names, most=MOST_NAMES)
        detail = (
            f"at the zero z = {value} the fault {', '.join(map(repr, signals))} is output-nulling along z^k: it has "
            "no effect on the outputs, so no filter can estimate it. Measure another signal."
        )
    return _fault_zeros(holds=False, value=abs(zero.value), detail=detail, mode=zero.value, signals=signals)


def _dependent_columns(plant: DescriptorSystem) -> tuple[str, ...]:
    columns = np.vstack([plant.Bf, plant.Df])
    lengths = np.linalg.norm(columns, axis=0)
    if np.any(lengths == 0.0):
        return tuple(name for name, length in zip(plant.fault_names, lengths, strict=True) if length == 0.0)
    return leading_names(np.linalg.svd(columns / lengths)[2][-1], plant.fault_names, most=MOST_NAMES)
