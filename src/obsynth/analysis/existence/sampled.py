"""Numbers of a plant that was sampled: enclosed to hundreds of digits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from obsynth.analysis.existence.rational import PlantNumbers, SystemFacts

if TYPE_CHECKING:
    from flint import fmpq_mat

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

    def pencil(self, inputs: Rows, direct: Rows) -> EnclosedPencil:
        """Return ``[A - z, inputs; C, direct]``."""
        from obsynth.proofs.enclosed_pencils import EnclosedPencil
        from obsynth.proofs.exact_arithmetic import blocks, zeros_matrix

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


def sampled_numbers(exact: Mapping[str, fmpq_mat], sample_time: Any) -> SampledNumbers:
    """Return enclosures of a continuous plant with ``E = I``, sampled every so many seconds (a Fraction)."""
    import flint

    from obsynth.proofs.enclosed_pencils import bits_for, enclosed, exponential
    from obsynth.proofs.exact_arithmetic import blocks, zeros_matrix

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
