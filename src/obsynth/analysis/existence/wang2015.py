"""Existence conditions of a fault-estimation filter: Wang et al. 2015, Theorem 2 (i), and a zero condition of ours."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from functools import partial
from typing import TypeAlias

import numpy as np
from flint import fmpq, fmpq_mat

from obsynth.analysis.existence.condition import Condition, up_to_failure
from obsynth.analysis.existence.detectability_indexes import (
    REFUSE_CONDITION,
    FaultDetectability,
    detectability_conditions,
    nonsingular_t,
    numbers_with_fault_states,
)
from obsynth.analysis.existence.distance import ROUNDING_LEVEL
from obsynth.analysis.existence.named_pencils import WITNESS_DIGITS
from obsynth.analysis.existence.plant_numbers import SystemFacts, numbers_of
from obsynth.analysis.existence.restricted_equivalent import PreparedPlant, prepare, with_sensor_faults_as_states
from obsynth.analysis.existence.statements import DECIDER, Evaluator, FullRank, NoZeroOutside, reconsidered
from obsynth.analysis.existence.witnesses import EntryChange, Unclear, Witness, rational_matrices
from obsynth.analysis.zeros import hidden_faults
from obsynth.errors import PreconditionError, counted
from obsynth.numerics.arrays import FloatArray, remembered
from obsynth.numerics.invariant_zeros import Zero, zero_at
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import regularity_of
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.signal_names import MOST_NAMES, leading_names
from obsynth.plants.transformations.redundant_outputs import merged_outputs
from obsynth.proofs.rational_matrices import blocks, picked_columns, pivot_columns, zeros_matrix

#: Conditions in order, the prepared plant on which the last were decided, and the fault zeros where they were reached.
_Examination: TypeAlias = tuple[tuple[Condition, ...], PreparedPlant | None, tuple[complex, ...] | None]

_fault_zeros = partial(
    Condition,
    name="fault zeros",
    claim="every invariant zero from the faults to the outputs strictly inside the unit circle",
    bound=1.0,
    source="never stated in Wang 2015: detectability of (A1, C1)",
)


def index_doubt(judge: Evaluator, detectability: FaultDetectability) -> Unclear | None:
    """Return why the rank of Upsilon is unclear; ``None`` where it is not."""
    if not detectability.finite or not _is_in_doubt(judge, detectability):
        return None
    plant, units, best = judge.plant, judge.units, None
    lengths = np.linalg.norm(detectability.Upsilon, axis=0)
    direction = np.linalg.svd(detectability.Upsilon / lengths)[2][-1] / lengths
    direction = direction / direction[int(np.argmax(np.abs(direction)))]
    for digits in WITNESS_DIGITS:
        witness = _column_changes(plant, units, detectability.indexes, np.round(direction, digits))
        if witness is not None and (best is None or witness.size < best.size):
            best = witness
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
    exact = _exact_matrices(judge.plant)
    if exact is None:
        return False
    a, c, faults, _ = exact
    columns = [c * _visible_direction(a, faults, fault, index) for fault, index in enumerate(detectability.indexes)]
    return int(blocks([columns]).rank()) == rank.expected


def _exact_matrices(plant: DescriptorSystem) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat, fmpq_mat] | None:
    """Return ``T A``, C, ``T Bf`` and T of the plant as written, with its sensor faults as states."""
    plant = Witness((), 0.0).plant(plant)
    numbers = numbers_with_fault_states(plant, numbers_of(plant))
    t = nonsingular_t(numbers) if numbers is not None and numbers.exact else None
    if t is None or numbers is None:
        return None
    return t * numbers.matrices["A"], numbers.matrices["C"], t * numbers.matrices["Bf"], t


def _visible_direction(a: fmpq_mat, faults: fmpq_mat, fault: int, index: int | None) -> fmpq_mat:
    """Return the vector of a fault that becomes visible."""
    vector = picked_columns(faults, [fault])
    for _ in range(int(index or 1) - 1):
        vector = a * vector
    return vector


def _column_changes(
    plant: DescriptorSystem, units: PlantUnits, indexes: tuple[int | None, ...], direction: np.ndarray
) -> Witness | None:
    """Return the changes of the column of the fault whose share of the direction is one, where there are any."""
    numbers, chosen = _exact_matrices(plant), int(np.argmax(np.abs(direction)))
    if numbers is None:
        return None
    a, c, faults, t = numbers
    # Of shares that rounding has made alike another one may be the first of the largest, with the other sign.
    shares = [_scalar(Fraction(float(share)) / Fraction(float(direction[chosen]))) for share in direction]
    parts = [c * _visible_direction(a, faults, fault, index) * shares[fault] for fault, index in enumerate(indexes)]
    residual, maps, through = sum(parts[1:], start=parts[0]), list["fmpq_mat"](), t
    for _ in range(int(indexes[chosen] or 1)):
        maps.append(c * through)
        through = a * through
    order = np.argsort(-units.equations[: plant.nx], kind="stable")[::-1]
    solved = _solution(maps, residual, [int(i) for i in order])
    if solved is None:
        return None
    exact = rational_matrices(plant)["Bf"]
    changes = tuple(
        EntryChange("Bf", i, chosen, exact[i, chosen], exact[i, chosen] - delta) for i, delta in solved if delta
    )
    scale = units.equations * units.faults[chosen]
    size = max((float(scale[c.row] * abs(float(c.after - c.before))) for c in changes), default=0.0)
    return Witness(changes, size) if changes else None


def _solution(maps: list[fmpq_mat], residual: fmpq_mat, order: list[int]) -> list[tuple[int, Fraction]] | None:
    """Return delta with ``maps[-1] delta = rest``, and zero for all maps before it, on few equations in this order."""
    stacked = blocks([[part] for part in maps])
    picked = picked_columns(stacked, order)
    right = blocks([[zeros_matrix(int(stacked.nrows()) - int(residual.nrows()), 1)], [residual]])
    pivots = pivot_columns(picked)
    basis = picked_columns(picked, pivots)
    if not pivots or blocks([[basis, right]]).rank() > len(pivots):
        return None
    solution = (basis.transpose() * basis).solve(basis.transpose() * right)
    return [(order[j], Fraction(int(solution[k, 0].p), int(solution[k, 0].q))) for k, j in enumerate(pivots)]


def _scalar(value: Fraction) -> fmpq_mat:
    return fmpq_mat(1, 1, [fmpq(value.numerator, value.denominator)])


@remembered
def _condition_cache(_plant: DescriptorSystem) -> dict[bool, tuple[Condition, ...]]:
    """Return the cache of the conditions of a plant, decided exactly or not: synthesis and verification use it."""
    return {}


@remembered
def _fault_zero_cache(_plant: DescriptorSystem) -> dict[bool, tuple[complex, ...]]:
    """Return the cache of the fault zeros of a plant, decided exactly or not: notes use what existence computed."""
    return {}


def known_fault_zeros(plant: DescriptorSystem, *, exactly: bool = True) -> tuple[complex, ...] | None:
    """Return the zeros from the faults on which the last condition was decided; ``None`` where it was not."""
    return _fault_zero_cache(plant).get(exactly)


def fault_filter_conditions(plant: DescriptorSystem, *, exactly: bool = True) -> tuple[Condition, ...]:
    """Return the existence conditions of the fault-estimation filter, in order; the list ends at the first failure."""
    return _condition_cache(plant).get(exactly) or examine_fault_filter(plant, exactly=exactly)[0]


def examine_fault_filter(
    plant: DescriptorSystem, *, exactly: bool = True
) -> tuple[tuple[Condition, ...], PreparedPlant | None]:
    """Return the existence conditions, and the prepared plant on which the last of them were decided."""
    dense = plant.dense()
    merged = merged_outputs(dense)
    result = _decide(dense if merged is None else merged.plant, exactly)
    if merged is not None and not merged.exact and not result[0][-1].holds:
        # The outputs as written show more than the merged ones, by their rounding: that is unclear, not a refusal.
        result = _decide(dense, exactly)
    conditions, prepared, zeros = result
    _condition_cache(plant)[exactly] = conditions
    if zeros is not None:
        _fault_zero_cache(plant)[exactly] = zeros
    return conditions, prepared


def _decide(plant: DescriptorSystem, exactly: bool) -> _Examination:
    return reconsidered(Evaluator(plant, exactly), _examined, lambda result: result[0])


def _examined(judge: Evaluator) -> _Examination:
    prepared, zeros = list[PreparedPlant](), list[tuple[complex, ...]]()
    conditions = up_to_failure(_in_order(judge, prepared, zeros))
    return conditions, prepared[0] if prepared else None, zeros[0] if zeros else None


def _in_order(judge: Evaluator, made: list[PreparedPlant], zeros: list[tuple[complex, ...]]) -> Iterator[Condition]:
    """Yield the conditions, each group examined when it is asked for; the prepared plant is appended to ``made``, and
    the fault zeros to ``zeros``."""
    plant = judge.plant
    yield from _form_conditions(judge)
    yield from _rank_conditions(judge)
    prepared = prepare(plant, exactly=judge.exactly)
    made.append(prepared)
    *first, last = detectability_conditions(prepared.detectability, plant.fault_names, prepared.scaling.outputs)
    yield from first
    doubt = None if last.holds else index_doubt(judge, prepared.detectability)
    yield last if doubt is None else last.in_doubt(doubt, plant)
    yield _zero_condition(judge, zeros)


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
            of_the_method=True,
        ),
        Condition(
            "faults",
            "at least one fault",
            plant.nf > 0,
            float(plant.nf),
            1.0,
            "Wang 2015, eq. (1)",
            "" if plant.nf else "none. Name the fault to estimate in Bf or Df.",
            of_the_method=True,
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
            # A rank in floating point is no proof that there is nothing.
            unclear=True if numbers is None and not regular else None,
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
        ""
        if enough
        else f"{counted(plant.nf, 'fault')} and {counted(plant.ny, 'output')}. Measure more, or leave a fault out.",
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
    # Sensor faults are states then, and their columns of Df stand beside C.  An output that shows disturbances alone
    # repeats no other one: it measures these.
    direct = {"Df": np.flatnonzero(plant.Df.any(axis=0)).tolist()}
    outputs, states = FullRank([["C", "Df", "Dd"]], direct, of_rows=True), FullRank([["E", None], ["C", "Df"]], direct)

    def repeated(matrix: FloatArray) -> tuple[str, tuple[str, ...]]:
        names = leading_names(np.linalg.svd(matrix)[0][:, -1], plant.output_names, most=MOST_NAMES)
        return "some outputs repeat others: leave them out.", names

    def unknown(matrix: FloatArray) -> tuple[str, tuple[str, ...]]:
        names = leading_names(np.linalg.svd(matrix)[2][-1], work.state_names, most=MOST_NAMES)
        text = (
            "not every state is either dynamic or measured. Measure more, or eliminate the algebraic states first "
            "(transform: {eliminate_algebraic_states: true} in a spec)."
        )
        return text, names

    yield judge.full_rank("rank [C Dd]", outputs, repeated, source=source)
    yield judge.full_rank("rank [E; C]", states, unknown, source="Wang 2015, eq. (2)")


def _zero_condition(judge: Evaluator, zeros: list[tuple[complex, ...]]) -> Condition:
    plant = judge.plant

    def holding(facts: SystemFacts) -> Condition:
        zeros.append(facts.zeros)
        largest = max((abs(value) for value in facts.zeros), default=0.0)
        largest_one = f", largest modulus {largest:.6g}" if facts.zeros else ""
        return _fault_zeros(holds=True, value=largest, detail=f"{counted(len(facts.zeros), 'zero')}{largest_one}")

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
        states = f"state{'' if len(signals) == 1 else 's'} {', '.join(map(repr, signals))}"
        detail = (
            f"the mode z = {value} ({states}) is undetectable: no output responds to "
            "it, and it does not decay. Measure something that it moves."
        )
    else:
        signals = leading_names(np.abs(zero.input_direction), plant.fault_names, most=MOST_NAMES)
        alone, named = len(signals) == 1, ", ".join(map(repr, signals))
        detail = (
            f"at the zero z = {value} {'the fault' if alone else 'a combination of the faults'} {named} is "
            "output-nulling along z^k: it has no effect on the outputs, so no filter can estimate "
            f"{'it' if alone else 'them'}. Measure another signal."
        )
    return _fault_zeros(holds=False, value=abs(zero.value), detail=detail, mode=zero.value, signals=signals)


def _dependent_columns(plant: DescriptorSystem) -> tuple[str, ...]:
    columns = np.vstack([plant.Bf, plant.Df])
    lengths = np.linalg.norm(columns, axis=0)
    if np.any(lengths == 0.0):
        return tuple(name for name, length in zip(plant.fault_names, lengths, strict=True) if length == 0.0)
    return leading_names(np.linalg.svd(columns / lengths)[2][-1], plant.fault_names, most=MOST_NAMES)
