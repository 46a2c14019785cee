"""The numbers of a plant on which existence is decided: rational as written, or enclosed where it was sampled.

Numbers of a plant that was sampled: enclosed to hundreds of digits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

from obsynth.analysis.existence.rational import PlantNumbers, SystemFacts, WrittenNumbers
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exact_numbers import DECISIVE

if TYPE_CHECKING:
    from flint import fmpq_mat, fmpz_poly

    from obsynth.proofs.enclosed_pencils import EnclosedPencil, Rows


@dataclass(frozen=True, eq=False)
class SampledNumbers(PlantNumbers):
    """Enclosures of the matrices of a sampled plant; those that sampling leaves (``E, C, Df, Dd``) are rational too."""

    matrices: Mapping[str, Rows]
    rational: Mapping[str, fmpq_mat]
    bits: int
    discrete: bool = True
    exact: bool = False
    computed: bool = False
    kept: dict[object, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def states(self) -> int:
        """Number of states."""
        return len(self.matrices["A"])

    def matrix(self, name: str) -> Rows:
        """Return a matrix by its name."""
        return self.matrices[name]

    @property
    def regular_rank(self) -> int:
        """Normal rank of ``A - s E``."""
        return self.states

    def with_matrices(self, changes: Mapping[str, Rows], *, rational: Mapping[str, fmpq_mat]) -> SampledNumbers:
        """Return the same with some matrices replaced."""
        return replace(self, matrices={**self.matrices, **changes}, rational={**self.rational, **rational}, kept={})

    def as_own(self, matrix: fmpq_mat) -> Rows:
        """Return a rational matrix as one of these numbers."""
        import flint

        from obsynth.proofs.enclosed_pencils import enclosed

        with flint.ctx.workprec(self.bits):
            return enclosed(matrix)

    def width(self, matrix: Rows) -> int:
        """Return the number of columns."""
        return len(matrix[0]) if matrix else 0

    def zeros(self, rows: int, columns: int) -> Rows:
        """Return a zero matrix."""
        from flint import arb

        return [[arb(0)] * columns for _ in range(rows)]

    def blocks(self, parts: Sequence[Sequence[Rows]]) -> Rows:
        """Return a block matrix."""
        return [[value for part in row for value in part[i]] for row in parts for i in range(len(row[0]))]

    def product(self, left: Rows, right: Rows) -> Rows:
        """Return a product."""
        import flint

        if not right or not left:
            return [[] for _ in left]
        with flint.ctx.workprec(self.bits):
            columns = list(zip(*right, strict=True))
            return [
                [sum((a * b for a, b in zip(row, column, strict=True)), flint.arb(0)) for column in columns]
                for row in left
            ]

    def rank(self, matrix: Rows) -> int:
        """Return the rank of a matrix."""
        import flint

        from obsynth.proofs.enclosed_pencils import rank_to_digits

        with flint.ctx.workprec(self.bits):
            return rank_to_digits(matrix)

    def picked(self, matrix: Rows, columns: Sequence[int]) -> Rows:
        """Return some columns."""
        return [[row[j] for j in columns] for row in matrix]

    def rows(self, matrix: Rows, rows: Sequence[int]) -> Rows:
        """Return some rows."""
        return [matrix[i] for i in rows]

    def pencil(self, inputs: Rows, direct: Rows) -> EnclosedPencil:
        """Return ``[A - z, inputs; C, direct]``."""
        from obsynth.proofs.enclosed_pencils import EnclosedPencil
        from obsynth.proofs.exact_arithmetic import blocks, zeros_matrix

        whole = self.blocks([[self.matrices["A"], inputs], [self.matrices["C"], direct]])
        outputs, extra = len(whole) - self.states, len(whole[0]) - self.states
        rest = zeros_matrix(self.states, extra), zeros_matrix(outputs, self.states), zeros_matrix(outputs, extra)
        return EnclosedPencil(blocks([[self.rational["E"], rest[0]], [rest[1], rest[2]]]), whole, self.bits)

    def rank_at_root(self, inputs: Rows, direct: Rows, polynomial: fmpz_poly) -> int | None:
        """Return the rank of ``[A - z, inputs; C, direct]`` at the root of a linear polynomial."""
        from flint import arb, fmpq

        if polynomial.degree() > 1:
            return None
        return self.pencil(inputs, direct).rank_at(arb(fmpq(-polynomial[0], polynomial[1])))

    def decided_system(self, inputs: Rows, direct: Rows) -> SystemFacts:
        """Decide facts on ``[A - z, inputs; C, direct]``."""
        pencil = self.pencil(inputs, direct)
        rank, columns = pencil.normal_rank, pencil.shape[1]
        values = tuple(sorted(pencil.zeros, key=abs, reverse=True)) if rank == columns else ()
        stable = rank < columns or pencil.stable
        outside = tuple(value for value in values if abs(value) >= 1.0) or values[:1]
        return SystemFacts(rank, columns, () if stable else outside, values, False, self.computed)


def sampled_numbers(exact: Mapping[str, fmpq_mat], sample_time: Any) -> SampledNumbers:
    """Return enclosures of a continuous plant with ``E = I``, sampled every so many seconds (a Fraction)."""
    import flint

    from obsynth.proofs.enclosed_pencils import bits_for, enclosed, exponential
    from obsynth.proofs.exact_arithmetic import blocks, zeros_matrix

    states, faults, unknown = (int(exact[name].ncols()) for name in ("A", "Bf", "Bd"))
    width = faults + unknown
    step = flint.fmpq(sample_time.numerator, sample_time.denominator)
    whole = (
        blocks(
            [
                [exact["A"], exact["Bf"], exact["Bd"]],
                [zeros_matrix(width, states), zeros_matrix(width, faults), zeros_matrix(width, unknown)],
            ]
        )
        if width
        else exact["A"]
    )
    bits = bits_for(states)
    with flint.ctx.workprec(bits):
        rows = exponential(whole * step)[:states]
        held = {"A": (0, states), "Bf": (states, states + faults), "Bd": (states + faults, states + width)}
        matrices = {name: [row[start:end] for row in rows] for name, (start, end) in held.items()}
        matrices |= {name: enclosed(exact[name]) for name in ("E", "C", "Df", "Dd")}
    return SampledNumbers(matrices, {name: exact[name] for name in ("E", "C", "Df", "Dd")}, bits)


#: Plants of more states are decided in floating point.
EXACT_STATES = 64
SAMPLED_STATES = 24
#: Of computed data an exact answer says little more than floating point does, and takes longer.
COMPUTED_STATES = 24


def numbers_of(plant: DescriptorSystem) -> PlantNumbers | None:
    """Return the numbers on which existence is decided; ``None`` where it is decided in floating point."""
    return None if plant.nx > EXACT_STATES else _numbers_of(_Content.of(plant))


@dataclass(frozen=True, eq=False)
class _Content:
    """A plant that equals another one with the same numbers: plants are made again, and decided once."""

    plant: DescriptorSystem
    key: tuple[object, ...]

    @classmethod
    def of(cls, plant: DescriptorSystem) -> _Content:
        plant = plant.dense()
        numbers = (getattr(plant, name) for name in DECISIVE)
        made = None if plant.exact is None else plant.exact.content
        return cls(plant, (plant.dt, made, *((matrix.shape, matrix.tobytes()) for matrix in numbers)))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Content) and self.key == other.key


# Conditions, synthesis and verification ask for the same plant's several times; plants never change.
@lru_cache(maxsize=8)
def _numbers_of(content: _Content) -> PlantNumbers | None:
    plant = content.plant
    from obsynth.proofs.exact_arithmetic import holds_computed, rational_matrix, written_matrix

    if plant.exact is not None:
        known = plant.exact
        rows = known.matrices
        states = len(rows["A"])
        sizes = {"E": states, "A": states, "C": states, "Bf": plant.nf, "Df": plant.nf, "Bd": plant.nd, "Dd": plant.nd}
        exact = {name: rational_matrix(rows[name], sizes[name]) for name in DECISIVE}
        if known.sample_time is None:
            written = WrittenNumbers(exact, plant.is_discrete, computed=known.computed)
            return written if states <= (COMPUTED_STATES if known.computed else EXACT_STATES) else None
        sampled = sampled_numbers(exact, known.sample_time) if states <= SAMPLED_STATES else None
        return None if sampled is None else replace(sampled, computed=known.computed)
    computed = any(holds_computed(getattr(plant, name)) for name in DECISIVE)
    if computed and plant.nx > COMPUTED_STATES:
        return None
    matrices = {name: written_matrix(getattr(plant, name)) for name in DECISIVE}
    return WrittenNumbers(matrices, plant.is_discrete, computed=computed)
