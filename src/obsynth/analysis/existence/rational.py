"""Numbers of a plant: what is asked of them, and rational ones as written."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from obsynth.numerics.ranks import RankDecision

if TYPE_CHECKING:
    from flint import fmpq_mat, fmpz_poly

    from obsynth.proofs.exact_pencils import ExactPencil

#: Degree of the minimal polynomial of an eigenvalue, times columns of the pencil, above which its rank there is left
#: to floating point.
MOST_EXACT_SIZE = 400


@dataclass(frozen=True, eq=False)
class SystemFacts:
    """What is known of ``[A - s E, B; C, D]``: from rational arithmetic (``exact``), to hundreds of digits, or not."""

    normal_rank: int
    columns: int
    outside: tuple[complex, ...]  # finite zeros that are not stable, the most unstable first
    zeros: tuple[complex, ...]
    exact: bool
    computed: bool = False  # whether some of the data were computed in floating point
    decisions: tuple[RankDecision, ...] = ()  # on the way, in floating point

    def timed(self, rate: float) -> SystemFacts:
        """Return the same with eigenvalues multiplied by a rate, for a plant in another unit of time."""
        zeros, outside = (tuple(value * rate for value in values) for values in (self.zeros, self.outside))
        return replace(self, zeros=zeros, outside=outside)

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
    def rows(self, matrix: Any, rows: Sequence[int]) -> Any:
        """Return some rows."""

    @abstractmethod
    def rank_at_root(self, inputs: Any, direct: Any, polynomial: fmpz_poly) -> int | None:
        """Return the rank of ``[A - s E, inputs; C, direct]`` at the roots of an irreducible polynomial.
        ``None``: left to floating point."""

    @abstractmethod
    def decided_system(self, inputs: Any, direct: Any) -> SystemFacts:
        """Decide facts on ``[A - s E, inputs; C, direct]``."""

    def columns(self, name: str, kept: Sequence[int] | None) -> Any:
        """Return a matrix by its name, or some of its columns."""
        return self.matrix(name) if kept is None else self.picked(self.matrix(name), kept)

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
        from obsynth.proofs.exact_arithmetic import zeros_matrix

        return zeros_matrix(rows, columns)

    def blocks(self, parts: Sequence[Sequence[fmpq_mat]]) -> fmpq_mat:
        """Return a block matrix."""
        from obsynth.proofs.exact_arithmetic import blocks

        return blocks([list(row) for row in parts])

    def product(self, left: fmpq_mat, right: fmpq_mat) -> fmpq_mat:
        """Return a product."""
        return left * right

    def rank(self, matrix: fmpq_mat) -> int:
        """Return the rank of a matrix."""
        return int(matrix.rank())

    def picked(self, matrix: fmpq_mat, columns: Sequence[int]) -> fmpq_mat:
        """Return some columns."""
        from obsynth.proofs.exact_arithmetic import picked_columns

        return picked_columns(matrix, columns)

    def rows(self, matrix: fmpq_mat, rows: Sequence[int]) -> fmpq_mat:
        """Return some rows."""
        from obsynth.proofs.exact_arithmetic import picked_rows

        return picked_rows(matrix, [int(row) for row in rows])

    def pencil(self, inputs: fmpq_mat, direct: fmpq_mat) -> ExactPencil:
        """Return ``[A - s E, inputs; C, direct]``."""
        from obsynth.proofs.exact_pencils import system_pencil

        return system_pencil(self.matrices["E"], self.matrices["A"], inputs, self.matrices["C"], direct)

    def rank_at_root(self, inputs: fmpq_mat, direct: fmpq_mat, polynomial: fmpz_poly) -> int | None:
        """Return the rank of ``[A - s E, inputs; C, direct]`` at the roots of an irreducible polynomial."""
        pencil = self.pencil(inputs, direct)
        if pencil.shape[1] * polynomial.degree() > MOST_EXACT_SIZE:
            return None
        return pencil.rank_at_root(polynomial)

    def decided_system(self, inputs: fmpq_mat, direct: fmpq_mat) -> SystemFacts:
        """Decide facts on ``[A - s E, inputs; C, direct]``."""
        pencil = self.pencil(inputs, direct)
        rank, columns = pencil.normal_rank, pencil.shape[1]
        found = pencil.zeros(discrete=self.discrete) if rank == columns else ()
        values = tuple(root.value for root in found for _ in range(root.multiplicity))
        outside = tuple(root.value for root in found if root.side != "stable")
        return SystemFacts(rank, columns, outside, values, True, self.computed)
