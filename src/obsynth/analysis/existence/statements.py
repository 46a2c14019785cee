"""Statements about a plant and their evaluation: false (exactly), true with a distance from false, or unclear.

It is unclear where that distance is no more than what rounding of the data or of any gains can bridge.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from obsynth.analysis.existence.condition import Condition, rank_condition
from obsynth.analysis.existence.distance import (
    ROUNDING_LEVEL,
    distance_to_loss,
    least_share,
    relative_singular_values,
    zeros_at_rounding_level,
)
from obsynth.analysis.existence.named_pencils import NamedPencil, named_pencil
from obsynth.analysis.existence.plant_numbers import PlantNumbers, SystemFacts, numbers_of
from obsynth.analysis.existence.witnesses import Unclear
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.invariant_zeros import are_outside, is_outside, system_zeros
from obsynth.numerics.pencils import finite_zeros
from obsynth.numerics.ranks import NAMED_SHARE, RANK_TOLERANCE, RankDecision, decide_rank, rank_in_any_units
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.plant_units import PlantUnits, sized_plant
from obsynth.proofs.balls import UNIT_ROUNDOFF
from obsynth.proofs.rational_matrices import blocks, picked_rows

#: What decides what rounding of the data leaves open.
DECIDER = "Data with more digits, or an output that is more sensitive to it, would decide it."

#: Computed data hold more than one rounding: below this distance a zero of theirs is one.
COMPUTED = 1e-12

#: Rounding scatters a multiple zero by up to this, relative to its size or one.
SCATTER = 1e-2

#: Shares that differ by less than this, relative to them, are the same but for rounding.
SAME_SHARE = 1e-6

Decided = TypeVar("Decided")


def settled_rank(decision: RankDecision, exact_rank: int | None, share: float = np.inf) -> RankDecision:
    """Return a rank decision with the exact rank in place of that by a tolerance, or unclear.
    ``share``: the least singular value beside the terms that the entries are sums of, where those are known."""
    if exact_rank is None:
        return decision
    if exact_rank < decision.expected:
        return replace(decision, rank=exact_rank, means="exact")
    values = decision.singular_values
    needed = decision.expected - 1
    enough = decision.expected == 0 or (
        len(values) > needed and values[needed] > ROUNDING_LEVEL * values[0] and share > ROUNDING_LEVEL
    )
    if enough:
        return replace(decision, rank=decision.expected, means="exact", share=share)
    return replace(decision, rank=min(decision.rank, decision.expected - 1), means="unclear", share=share)


@dataclass(frozen=True)
class ZeroVerdict:
    """What is known of the zeros of a pencil outside the region of stability."""

    answer: str  # no, yes or unclear
    facts: SystemFacts
    # Unless the answer is no: the least singular value found, relative to the largest, and where.
    least: float = 0.0
    point: complex | None = None

    @property
    def means(self) -> str:
        """How it was decided, in words."""
        return (
            "exactly, on the numbers as written" if self.facts.exact else "to hundreds of digits of the sampled plant"
        )


def zero_verdict(
    facts: SystemFacts, E: FloatArray, A: FloatArray, *, nx: int, discrete: bool, sizes: FloatArray | None = None
) -> ZeroVerdict:
    """Return the answer for the pencil ``A - s E (m, n)`` of which the facts are known; ``sizes`` of the terms of A."""
    facts = believed(facts, E, A, nx=nx)
    if not facts.full or facts.outside:
        return ZeroVerdict("no", facts)
    distance = distance_to_loss(E, A, nx=nx, discrete=discrete, zeros=facts.zeros, sizes=sizes)
    lost = _lost_in_computing(facts, E, A, nx=nx, discrete=discrete)
    least, point = min(distance, lost or distance, key=itemgetter(0))
    return ZeroVerdict("unclear" if least <= ROUNDING_LEVEL or lost else "yes", facts, least, point)


def _lost_in_computing(
    facts: SystemFacts, E: FloatArray, A: FloatArray, *, nx: int, discrete: bool
) -> tuple[float, complex] | None:
    """Return a zero on or outside the boundary that computed data have but for their rounding, after what they lack to
    have it; ``None`` without one."""
    if not facts.computed:
        return None
    dt = 1.0 if discrete else 0.0
    values = [*facts.zeros, *map(complex, system_zeros(E, A, nx=nx).values)]
    outside = [value for value in values if is_outside(value, dt)]
    candidates = zip(map(float, relative_singular_values(E, A, outside, nx=nx)), outside, strict=True)
    best = min(candidates, key=itemgetter(0), default=None)
    return best if best is not None and best[0] <= COMPUTED else None


def believed(facts: SystemFacts, E: FloatArray, A: FloatArray, *, nx: int) -> SystemFacts:
    """Return the facts without zeros that rounding of computed data has brought in from infinity."""
    if not facts.computed or not facts.zeros:
        return facts
    computed = system_zeros(E, A, nx=nx).values

    def near(value: complex) -> bool:
        return bool(np.any(np.abs(computed - value) <= SCATTER * max(1.0, abs(value))))

    zeros, outside = (tuple(filter(near, values)) for values in (facts.zeros, facts.outside))
    return replace(facts, zeros=zeros, outside=outside)


@dataclass(frozen=True)
class FullRank:
    """Blocks, the plant's matrices by name (``None``: zero), make up a matrix of full column rank."""

    blocks: Sequence[Sequence[str | None]]
    columns: Mapping[str, Sequence[int]] = field(default_factory=dict)  # columns of a matrix that are taken
    last_rows: Sequence[int] | None = None  # those that are taken of the last row of blocks
    of_rows: bool = False  # full row rank instead
    rank: int | None = None  # what is to be had, where that is less


@dataclass(frozen=True)
class NoZeroOutside:
    """``[A - s E, inputs; C, direct]`` keeps full column rank on and outside the boundary of stability."""

    inputs: Literal["", "Bf", "Bd"] = ""
    columns: Sequence[int] | None = None  # columns of these that are taken

    @property
    def at_zero(self) -> FullRank:
        """That it has full column rank at s = 0."""
        if not self.inputs:
            return FullRank([["A"], ["C"]])
        beside = (self.inputs, f"D{self.inputs[1:]}")
        columns = {} if self.columns is None else dict.fromkeys(beside, self.columns)
        return FullRank([["A", beside[0]], ["C", beside[1]]], columns)


@dataclass(frozen=True, eq=False)
class Evaluator:
    """Decides statements about one plant in rational arithmetic, in enclosures or in floating point, and says why."""

    plant: DescriptorSystem
    exactly: bool = True
    model: Exosystem | None = None  # that the faults follow, which has a say in the units

    @cached_property
    def numbers(self) -> PlantNumbers | None:
        """The numbers on which it is decided; ``None`` in floating point."""
        return numbers_of(self.plant) if self.exactly else None

    @cached_property
    def units(self) -> PlantUnits:
        """Units of the plant's own, as powers of two: what is exact in the data, such as a zero at 0, stays exact."""
        return PlantUnits.of(self.plant, self.model).rounded()

    @cached_property
    def natural(self) -> DescriptorSystem:
        """The plant in these units."""
        return self.units.scaled_plant(self.plant)

    @cached_property
    def independent_disturbances(self) -> list[int]:
        """The unknown inputs that are no combinations of those before them."""
        independent = list[int]()
        for column in range(self.plant.nd):
            statement = FullRank([["Bd"], ["Dd"]], {name: [*independent, column] for name in ("Bd", "Dd")})
            if self.rank_itself(statement) == len(independent) + 1:
                independent.append(column)
        return independent

    @cached_property
    def terms(self) -> DescriptorSystem | None:
        """The plant with the sizes of the terms of its entries in their place; ``None`` where there are none."""
        return sized_plant(self.plant)

    def _sizes(self, statement: FullRank) -> tuple[list[int], list[int]]:
        """Return the heights of the rows of blocks, and their widths."""
        names = [next(name for name in row if name) for row in statement.blocks]
        columns = [next(row[j] or "" for row in statement.blocks if row[j]) for j in range(len(statement.blocks[0]))]
        widths = [
            len(statement.columns[name]) if name in statement.columns else getattr(self.plant, name).shape[1]
            for name in columns
        ]
        return [getattr(self.plant, name).shape[0] for name in names], widths

    def arranged(self, statement: FullRank, plant: DescriptorSystem) -> FloatArray:
        """Return the blocks of a plant of the same size as a matrix."""

        def block(name: str | None, height: int, width: int) -> FloatArray:
            if name is None:
                return np.zeros((height, width))
            matrix: FloatArray = getattr(plant, name)
            return matrix[:, list(statement.columns[name])] if name in statement.columns else matrix

        heights, widths = self._sizes(statement)
        rows = [
            np.hstack([block(name, height, width) for name, width in zip(row, widths, strict=True)])
            for row, height in zip(statement.blocks, heights, strict=True)
        ]
        rows[-1] = rows[-1] if statement.last_rows is None else rows[-1][list(statement.last_rows)]
        return np.vstack(rows)

    def exact_rank(self, statement: FullRank) -> int | None:
        """Return the rank on the numbers as written; ``None`` in floating point."""
        numbers = self.numbers
        if numbers is None:
            return None

        def block(name: str | None, height: int, width: int) -> Any:
            if name is None:
                return numbers.zeros(height, width)
            return numbers.columns(name, statement.columns.get(name))

        heights, widths = self._sizes(statement)
        rows = [
            [block(name, height, width) for name, width in zip(row, widths, strict=True)]
            for row, height in zip(statement.blocks, heights, strict=True)
        ]
        if statement.last_rows is not None:
            rows[-1] = [picked_rows(part, statement.last_rows) for part in rows[-1]]
        return numbers.rank(blocks(rows))

    def rank_itself(self, statement: FullRank) -> int:
        """Return the rank that blocks have."""
        exact = self.exact_rank(statement)
        return decide_rank(self.arranged(statement, self.natural)).rank if exact is None else exact

    def rank(self, statement: FullRank, known: RankDecision | None = None) -> RankDecision:
        """Decide a rank; ``known``: what a tolerance says of it, where that was asked already."""
        matrix, exact = self.arranged(statement, self.natural), self.exact_rank(statement)
        expected = matrix.shape[0 if statement.of_rows else 1] if statement.rank is None else statement.rank
        if exact is None:
            return known or rank_in_any_units(matrix, self.arranged(statement, self.plant), expected=expected)
        share = np.inf
        if self.terms is not None and not statement.of_rows:
            share = least_share(matrix, self.arranged(statement, self.units.scaled_plant(self.terms)), rank=expected)
        return settled_rank(known or decide_rank(matrix, expected=expected), exact, share)

    def full_rank(
        self,
        name: str,
        statement: FullRank,
        failure: Callable[[FloatArray], tuple[str, tuple[str, ...]]],
        *,
        source: str,
    ) -> Condition:
        """Return the condition that a rank is full; ``failure(matrix)`` says what to do, and which signals it is."""
        decision = self.rank(statement)
        remedy, signals = ("", ()) if decision.full else failure(self.arranged(statement, self.natural))
        condition = rank_condition(name, decision, remedy, source=source, signals=signals)
        return (
            condition.in_doubt(self.rank_doubt(statement, decision), self.plant)
            if decision.means == "unclear"
            else condition
        )

    def rank_doubt(self, statement: FullRank, decision: RankDecision, point: complex | None = None) -> Unclear:
        """Return why a rank is unclear, with ``A - point E`` for A."""
        named = self.named(statement)
        if statement.last_rows is not None:
            before = sum(self._sizes(statement)[0][:-1])
            named = named.with_rows([*range(before), *(before + int(row) for row in statement.last_rows)])
        other = f"has rank {decision.expected - 1}"
        return self.doubt(named.transposed if statement.of_rows else named, other, point=point)

    def named(self, statement: FullRank) -> NamedPencil:
        """Return the blocks as a pencil of which each entry is known by its name."""
        return named_pencil(self.plant, self.units, statement.blocks, taken_columns=statement.columns)

    def doubt(
        self,
        named: NamedPencil,
        other: str,
        *,
        point: complex | None = None,
        tolerance: float = ROUNDING_LEVEL,
        decider: str = DECIDER,
        moving: bool = False,
        last: bool = False,
    ) -> Unclear:
        """Return why an answer is unclear: a plant within the tolerance, which is never less than that needs, ``other``
        than this one loses rank. The point may be ``moving``; ``last``: the last column depends on the others."""
        witness = named.witness(tolerance, point, dt=self.plant.dt if moving else None, last=last)
        return Unclear(max(tolerance, 0.0 if witness is None else witness.size), witness, other, decider)

    def pencil(self, statement: NoZeroOutside) -> tuple[FloatArray, FloatArray]:
        """Return the two matrices of a pencil ``A - s E``."""
        matrix = self.arranged(statement.at_zero, self.plant)
        moving = np.zeros_like(matrix)
        moving[: self.plant.nx, : self.plant.nx] = self.plant.E
        return moving, matrix

    def _in_own_units(
        self, statement: NoZeroOutside, moving: FloatArray, matrix: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return a pencil in units of the plant's own, time among them: no answer may hang on those of the data."""
        scales = {"Bf": self.units.faults, "Bd": self.units.disturbances, "": np.zeros(0)}[statement.inputs]
        scales = scales if statement.columns is None else scales[list(statement.columns)]
        rate = np.concatenate([np.full(self.plant.nx, self.units.rate), np.ones(self.plant.ny)])[:, None]
        own = self.units.scaled_pencil(moving, matrix, scales)
        return own[0], rate * own[1]

    def own_pencil(self, statement: NoZeroOutside) -> tuple[FloatArray, FloatArray]:
        """Return the two matrices of a pencil ``A - s E`` in units of the plant's own."""
        return self._in_own_units(statement, *self.pencil(statement))

    def floating_facts(self, statement: NoZeroOutside) -> SystemFacts:
        """Return the facts on a pencil by floating point."""
        pencil = self.own_pencil(statement)
        zeros = system_zeros(*pencil, nx=self.plant.nx) if statement.inputs else finite_zeros(*pencil)
        values = tuple(complex(value) for value in zeros.values)
        marked = zip(values, are_outside(*pencil, zeros, self.plant.dt), strict=True)
        outside = tuple(value for value, out in marked if out)
        facts = SystemFacts(zeros.normal_rank, pencil[1].shape[1], outside, values, False, decisions=zeros.decisions)
        return facts.timed(1.0 / self.units.rate)

    def facts(self, statement: NoZeroOutside) -> SystemFacts:
        """Return the facts on a pencil."""
        numbers, plant = self.numbers, self.plant
        if numbers is None:
            return self.floating_facts(statement)
        if not statement.inputs:
            return numbers.system(numbers.zeros(plant.nx, 0), numbers.zeros(plant.ny, 0))
        return numbers.system(*(numbers.columns(str(row[1]), statement.columns) for row in statement.at_zero.blocks))

    def verdict(self, statement: NoZeroOutside) -> ZeroVerdict:
        """Decide where the zeros of a pencil are."""
        facts, pencil = self.facts(statement), self.own_pencil(statement)
        if self.numbers is None:
            return ZeroVerdict("no" if facts.outside or not facts.full else "yes", facts)
        sizes = None
        if self.terms is not None:
            sizes = self._in_own_units(statement, pencil[0], self.arranged(statement.at_zero, self.terms))[1]
        discrete = self.plant.is_discrete
        scaled = zero_verdict(facts.timed(self.units.rate), *pencil, nx=self.plant.nx, discrete=discrete, sizes=sizes)
        point = None if scaled.point is None else self.units.eigenvalue(scaled.point)
        return replace(scaled, facts=scaled.facts.timed(1.0 / self.units.rate), point=point)

    def no_zero_outside(
        self,
        statement: NoZeroOutside,
        *,
        holding: Callable[[SystemFacts], Condition],
        lost: Callable[[SystemFacts], Condition],
        what: str,
    ) -> Condition:
        """Return the condition that a pencil has no zero outside: where it holds, and what hides where it does not.
        ``what`` would exist."""
        verdict = self.verdict(statement)
        facts, point = verdict.facts, verdict.point
        if verdict.answer == "no" and not facts.outside and self._has_full_rank(statement):
            detail = (
                f"rank [A - s E; C] is {facts.normal_rank} of {facts.columns} in double precision at every s, though "
                "E is the identity: entries of this plant are too many decades apart to decide."
            )
            return replace(holding(facts), holds=False, value=float(facts.normal_rank), detail=detail, unclear=True)
        if verdict.answer == "no":
            condition = lost(facts)
            gain = (
                "" if condition.mode is None or self.numbers is None else self._needed_gain(statement, condition.mode)
            )
            return replace(condition, detail=f"{condition.detail} {gain}".rstrip())
        condition = holding(facts)
        if point is None:
            return condition
        if verdict.answer == "yes":
            least = f"least singular value {verdict.least:.2g} of the scaled pencil outside (near {pole_text(point)})"
            return replace(condition, detail=f"{condition.detail}; {least}, {verdict.means}")
        detail = (
            f"{'An' if what[0] in 'aeiou' else 'A'} {what} exists for the numbers as written ({verdict.means}), but "
            f"the least singular value of the scaled pencil outside is {verdict.least:.1g}: rounding of the data, or "
            "of any gains, is as large."
        )
        apparent = self.floating_facts(statement).outside or (() if statement.inputs else (point,))
        condition = replace(condition, holds=False, detail=detail)
        if apparent:
            condition = lost(replace(facts, outside=apparent))
            condition = replace(condition, detail=f"{detail} In floating point, {condition.detail}")
        return condition.in_doubt(self._zero_doubt(statement, point, verdict.least, what), self.plant)

    def _has_full_rank(self, statement: NoZeroOutside) -> bool:
        """Whether a pencil ``[A - s E; C]`` has full column rank at almost every point for its E."""
        return not statement.inputs and np.array_equal(self.plant.E, np.eye(self.plant.nx))

    def _zero_doubt(self, statement: NoZeroOutside, point: complex, least: float, what: str) -> Unclear:
        """Return why it is unclear whether a pencil has a zero outside."""
        return self.doubt(
            self.named(statement.at_zero),
            f"has a zero at {pole_text(point, 6)}, and no {what}",
            point=point,
            tolerance=max(ROUNDING_LEVEL, least),
            moving=True,
        )

    def _needed_gain(self, statement: NoZeroOutside, point: complex) -> str:
        """Return which gain any observer would need, were the last digits of data off that hide something only
        exactly.  Empty where no digits would help: with as many inputs as outputs a zero stays."""
        plant, units, inputs = self.plant, self.units, statement.inputs
        input_matrix = getattr(plant, inputs) if inputs else np.zeros((plant.nx, 0))
        direct = getattr(plant, f"D{inputs[1:]}") if inputs else np.zeros((plant.ny, 0))
        if plant.ny <= input_matrix.shape[1]:
            return ""
        scales = {"Bf": units.faults, "Bd": units.disturbances, "": np.zeros(0)}[inputs]
        columns = np.concatenate([units.states, scales])
        rows = np.concatenate([units.equations, units.outputs])[:, None]
        pencil = np.block([[plant.A - point * plant.E, input_matrix], [plant.C, direct]])
        scaled = np.linalg.svd(rows * pencil * columns)[2][-1].conj()
        scaled = np.where(np.abs(scaled) > RANK_TOLERANCE, scaled, 0.0)
        signals = np.abs(columns * scaled)
        terms = np.max(np.abs(np.hstack([plant.C, direct])) * signals, axis=1, initial=0.0)
        names = (*plant.state_names, *({"Bf": plant.fault_names, "Bd": plant.disturbance_names}.get(inputs, ())))
        # What a fault moves is asked for by the fault; a mode by the state that moves most.
        faults = np.arange(len(signals)) >= plant.nx if inputs == "Bf" else np.zeros(len(signals), dtype=bool)
        shares = np.abs(scaled) * (faults if np.any(np.abs(scaled[faults]) > NAMED_SHARE) else ~faults)
        signal, output = _first_of_the_largest(shares), _first_of_the_largest(terms)
        if terms[output] == 0.0:
            return "No output depends on it: more digits of the data would not help."
        gain = signals[signal] / (UNIT_ROUNDOFF * terms[output])
        return (
            "This holds exactly, on the numbers as written: if their last digits are wrong, every observer needs a "
            f"gain of about {gain:.0e} from {plant.output_names[output]!r} to {names[signal]!r}."
        )

    def hidden_modes(self) -> SystemFacts:
        """Return the facts on ``[A - s E; C]``, with the modes that only rounding of the data lets show."""
        statement, nx = NoZeroOutside(), self.plant.nx
        floating, pencil, rate = self.floating_facts(statement), self.own_pencil(statement), self.units.rate
        if self.numbers is None:
            return floating
        floating = floating.timed(rate)
        exact = believed(self.facts(statement).timed(rate), *pencil, nx=nx)
        nearly = zeros_at_rounding_level(*pencil, floating.zeros, exact.zeros, nx=nx)
        modes = sorted((*exact.zeros, *nearly), key=lambda value: (value.real, value.imag))
        undetectable = (*exact.outside, *(value for value in nearly if value in floating.outside))
        return replace(exact, zeros=tuple(modes), outside=undetectable).timed(1.0 / rate)


def _first_of_the_largest(shares: NDArray[Any]) -> int:
    """Return the first place of a largest share: which of two equal ones is larger would hang on rounding."""
    return int(np.argmax(shares >= (1.0 - SAME_SHARE) * np.max(shares)))


def reconsidered(
    judge: Evaluator, decide: Callable[[Evaluator], Decided], conditions_of: Callable[[Decided], Sequence[Condition]]
) -> Decided:
    """Return a decision; a refusal that rests on numbers taken for rounding gives way to the doubt without that."""
    decision, exact = decide(judge), judge.plant.exact
    if judge.numbers is None or exact is None or exact.uncleaned is None:
        return decision
    if all(condition.holds or condition.unclear for condition in conditions_of(decision)):
        return decision
    other = decide(replace(judge, plant=judge.plant.replace(exact=exact.before_cleaning())))
    failed = [condition for condition in conditions_of(other) if not condition.holds]
    return other if failed and all(condition.unclear for condition in failed) else decision
