"""The numbers of a plant on which existence is decided: rational as written, or enclosed where it was sampled."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.origin import DECISIVE, origin_of

if TYPE_CHECKING:
    from flint import fmpq_mat

    from obsynth.proofs.enclosed_pencils import EnclosedPencil, Rows
    from obsynth.proofs.exact_pencils import ExactPencil

#: Plants of more states are decided in floating point.
EXACT_STATES = 64
SAMPLED_STATES = 24
#: Of computed data an exact answer says little more than floating point does, and takes longer.
COMPUTED_STATES = 24


@dataclass(frozen=True, eq=False)
class SystemFacts:
    """What was decided about a pencil ``[A - s E, B; C, D]``; ``exact`` or to hundreds of digits.

    Fields: normal_rank, columns: They are equal when no combination of inputs and initial states is hidden at all
    times; outside, zeros: Finite zeros on or outside the stability boundary, the most unstable first, and all of them;
    exact: Whether all was decided in rational arithmetic; computed: Whether some of the data were computed in floating
    point.
    """

    normal_rank: int
    columns: int
    outside: tuple[complex, ...]
    zeros: tuple[complex, ...]
    exact: bool
    computed: bool = False

    @property
    def full(self) -> bool:
        """Whether the normal rank is that of all columns."""
        return self.normal_rank == self.columns


class PlantNumbers(ABC):
    """Matrices of a plant, ranks and zeros of what is made of them."""

    exact: bool
    computed: bool
    discrete: bool
    kept: dict[object, Any]
    rational: Mapping[str, fmpq_mat]

    @abstractmethod
    def matrix(self, name: str) -> Any:
        """Return a matrix by its name."""

    @abstractmethod
    def zeros(self, rows: int, columns: int) -> Any:
        """Return a zero matrix."""

    @abstractmethod
    def blocks(self, parts: Sequence[Sequence[Any]]) -> Any:
        """Return a block matrix."""

    @abstractmethod
    def product(self, left: Any, right: Any) -> Any:
        """Return a product."""

    @abstractmethod
    def rank(self, matrix: Any) -> int:
        """Return the rank of a matrix."""

    @abstractmethod
    def picked(self, matrix: Any, columns: Sequence[int]) -> Any:
        """Return some columns."""

    @abstractmethod
    def decided_system(self, inputs: Any, direct: Any) -> SystemFacts:
        """Decide facts on ``[A - s E, inputs; C, direct]``."""

    def system(self, inputs: Any, direct: Any) -> SystemFacts:
        """Return facts on ``[A - s E, inputs; C, direct]``; zeros only where the normal rank is full."""
        key = ("system", str(inputs), str(direct))
        facts: SystemFacts = self.remembered(key, lambda: self.decided_system(inputs, direct))
        return facts

    def remembered(self, key: object, decide: Callable[[], Any]) -> Any:
        """Return what has been decided before under this key, or decide it."""
        if key not in self.kept:
            self.kept[key] = decide()
        return self.kept[key]

    @property
    @abstractmethod
    def regular_rank(self) -> int:
        """Normal rank of ``A - s E``."""

    @abstractmethod
    def with_matrices(self, changes: Mapping[str, Any], *, rational: Mapping[str, fmpq_mat]) -> PlantNumbers:
        """Return the same with some matrices replaced, and what is rational of those of a sampled plant."""

    @abstractmethod
    def as_own(self, matrix: fmpq_mat) -> Any:
        """Return a rational matrix as one of these numbers."""

    @abstractmethod
    def width(self, matrix: Any) -> int:
        """Return the number of columns."""

    def is_zero(self, matrix: Any) -> bool:
        """Whether all entries are zero."""
        return self.rank(matrix) == 0

    def independent_columns(self, matrix: Any, count: int) -> list[int]:
        """Return the columns, from the left, that are no combination of those before them."""
        kept: list[int] = []
        for column in range(count):
            if self.rank(self.picked(matrix, [*kept, column])) == len(kept) + 1:
                kept.append(column)
        return kept


@dataclass(frozen=True, eq=False)
class WrittenNumbers(PlantNumbers):
    """Rational matrices; ``computed`` where some were computed in floating point and are known to their last digit."""

    matrices: Mapping[str, fmpq_mat]
    discrete: bool
    exact: bool = True
    computed: bool = False
    kept: dict[object, Any] = field(default_factory=dict, repr=False)

    @property
    def rational(self) -> Mapping[str, fmpq_mat]:  # type: ignore[override]
        """All matrices."""
        return self.matrices

    def matrix(self, name: str) -> fmpq_mat:
        """Return a matrix by its name."""
        return self.matrices[name]

    @property
    def regular_rank(self) -> int:
        """Normal rank of ``A - s E``."""
        from obsynth.proofs.exact_pencils import ExactPencil

        pencil = ExactPencil(self.matrices["E"], self.matrices["A"])
        return int(self.remembered("normal rank", lambda: pencil.normal_rank))

    @property
    def index(self) -> int | None:
        """Index of ``A - s E``; ``None`` where it is not regular."""
        from obsynth.proofs.exact_pencils import ExactPencil

        return ExactPencil(self.matrices["E"], self.matrices["A"]).index

    def with_matrices(self, changes: Mapping[str, fmpq_mat], *, rational: Mapping[str, fmpq_mat]) -> WrittenNumbers:
        """Return the same with some matrices replaced."""
        return replace(self, matrices={**self.matrices, **changes}, kept={})

    def as_own(self, matrix: fmpq_mat) -> fmpq_mat:
        """Return a rational matrix as one of these numbers."""
        return matrix

    def width(self, matrix: fmpq_mat) -> int:
        """Return the number of columns."""
        return int(matrix.ncols())

    def zeros(self, rows: int, columns: int) -> fmpq_mat:
        """Return a zero matrix."""
        from obsynth.proofs.exact_pencils import zeros_matrix

        return zeros_matrix(rows, columns)

    def blocks(self, parts: Sequence[Sequence[fmpq_mat]]) -> fmpq_mat:
        """Return a block matrix."""
        from obsynth.proofs.exact_pencils import blocks

        return blocks([list(row) for row in parts])

    def product(self, left: fmpq_mat, right: fmpq_mat) -> fmpq_mat:
        """Return a product."""
        return left * right

    def rank(self, matrix: fmpq_mat) -> int:
        """Return the rank of a matrix."""
        return int(matrix.rank())

    def picked(self, matrix: fmpq_mat, columns: Sequence[int]) -> fmpq_mat:
        """Return some columns."""
        from flint import fmpq_mat

        rows = int(matrix.nrows())
        return fmpq_mat(rows, len(columns), [matrix[i, j] for i in range(rows) for j in columns])

    def pencil(self, inputs: fmpq_mat, direct: fmpq_mat) -> ExactPencil:
        """Return ``[A - s E, inputs; C, direct]``."""
        from obsynth.proofs.exact_pencils import system_pencil

        return system_pencil(self.matrices["E"], self.matrices["A"], inputs, self.matrices["C"], direct)

    def decided_system(self, inputs: fmpq_mat, direct: fmpq_mat) -> SystemFacts:
        """Decide facts on ``[A - s E, inputs; C, direct]``."""
        pencil = self.pencil(inputs, direct)
        rank, columns = pencil.normal_rank, pencil.shape[1]
        found = pencil.zeros(discrete=self.discrete).roots if rank == columns else ()
        values = tuple(root.value for root in found for _ in range(root.multiplicity))
        outside = tuple(root.value for root in found if root.side != "stable")
        return SystemFacts(rank, columns, outside, values, True, self.computed)


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

    def pencil(self, inputs: Rows, direct: Rows) -> EnclosedPencil:
        """Return ``[A - z, inputs; C, direct]``."""
        from obsynth.proofs.enclosed_pencils import EnclosedPencil
        from obsynth.proofs.exact_pencils import blocks, zeros_matrix

        whole = self.blocks([[self.matrices["A"], inputs], [self.matrices["C"], direct]])
        outputs, extra = len(whole) - self.states, len(whole[0]) - self.states
        rest = zeros_matrix(self.states, extra), zeros_matrix(outputs, self.states), zeros_matrix(outputs, extra)
        return EnclosedPencil(blocks([[self.rational["E"], rest[0]], [rest[1], rest[2]]]), whole, self.bits)

    def decided_system(self, inputs: Rows, direct: Rows) -> SystemFacts:
        """Decide facts on ``[A - z, inputs; C, direct]``."""
        pencil = self.pencil(inputs, direct)
        rank, columns = pencil.normal_rank, pencil.shape[1]
        values = tuple(sorted(pencil.zeros, key=abs, reverse=True)) if rank == columns else ()
        stable = rank < columns or pencil.stable
        outside = tuple(value for value in values if abs(value) >= 1.0) or values[:1]
        return SystemFacts(rank, columns, () if stable else outside, values, False, self.computed)


_EXACTLY: ContextVar[bool] = ContextVar("existence is decided exactly", default=True)


@contextmanager
def decided(*, exactly: bool) -> Iterator[None]:
    """Decide existence exactly, or in floating point: for what is only tried, such as sensors that might be added."""
    token = _EXACTLY.set(exactly)
    try:
        yield
    finally:
        _EXACTLY.reset(token)


def numbers_of(plant: DescriptorSystem) -> PlantNumbers | None:
    """Return the numbers on which existence is decided; ``None`` where it is decided in floating point."""
    return _numbers_of(_Content.of(plant)) if _EXACTLY.get() and plant.nx <= EXACT_STATES else None


@dataclass(frozen=True, eq=False)
class _Content:
    """A plant that equals another one with the same numbers: plants are made again, and decided once."""

    plant: DescriptorSystem
    key: tuple[object, ...]

    @classmethod
    def of(cls, plant: DescriptorSystem) -> _Content:
        plant = plant.dense()
        origin = origin_of(plant)
        numbers = (getattr(plant, name) for name in DECISIVE)
        made = None if origin is None else (origin.sample_time, origin.computed)
        return cls(plant, (plant.dt, made, *((matrix.shape, matrix.tobytes()) for matrix in numbers)))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Content) and self.key == other.key


# Conditions, synthesis and verification ask for the same plant's several times; plants never change.
@lru_cache(maxsize=8)
def _numbers_of(content: _Content) -> PlantNumbers | None:
    plant = content.plant
    from obsynth.proofs.written_numbers import computed_entries, rational_matrix, written_matrix

    origin = origin_of(plant)
    if origin is not None:
        states = len(origin.exact["A"])
        sizes = {"E": states, "A": states, "C": states, "Bf": plant.nf, "Df": plant.nf, "Bd": plant.nd, "Dd": plant.nd}
        exact = {name: rational_matrix(origin.exact[name], sizes[name]) for name in DECISIVE}
        if origin.sample_time is None:
            written = WrittenNumbers(exact, plant.is_discrete, computed=origin.computed)
            return written if states <= (COMPUTED_STATES if origin.computed else EXACT_STATES) else None
        sampled = sampled_numbers(exact, origin.sample_time) if states <= SAMPLED_STATES else None
        return None if sampled is None else replace(sampled, computed=origin.computed)
    computed = any(computed_entries(getattr(plant, name)) for name in DECISIVE)
    if computed and plant.nx > COMPUTED_STATES:
        return None
    matrices = {name: written_matrix(getattr(plant, name)) for name in DECISIVE}
    return WrittenNumbers(matrices, plant.is_discrete, computed=computed)


def sampled_numbers(exact: Mapping[str, fmpq_mat], sample_time: Any) -> SampledNumbers:
    """Return enclosures of a continuous plant with ``E = I``, sampled every so many seconds (a Fraction)."""
    import flint

    from obsynth.proofs.enclosed_pencils import bits_for, enclosed, exponential
    from obsynth.proofs.exact_pencils import blocks, zeros_matrix

    states, faults, unknown = (int(exact[name].ncols()) for name in ("A", "Bf", "Bd"))
    width = faults + unknown
    step = flint.fmpq(sample_time.numerator, sample_time.denominator)
    whole = blocks([
        [exact["A"], exact["Bf"], exact["Bd"]],
        [zeros_matrix(width, states), zeros_matrix(width, faults), zeros_matrix(width, unknown)],
    ]) if width else exact["A"]  # fmt: skip
    bits = bits_for(states)
    with flint.ctx.workprec(bits):
        rows = exponential(whole * step)[:states]
        held = {"A": (0, states), "Bf": (states, states + faults), "Bd": (states + faults, states + width)}
        matrices = {name: [row[start:end] for row in rows] for name, (start, end) in held.items()}
        matrices |= {name: enclosed(exact[name]) for name in ("E", "C", "Df", "Dd")}
    return SampledNumbers(matrices, {name: exact[name] for name in ("E", "C", "Df", "Dd")}, bits)
