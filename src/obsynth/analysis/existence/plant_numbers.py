"""Exact or enclosed numbers of a plant, on which existence is decided: rational, or balls for a sampled plant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import flint
from flint import arb_mat, fmpq_mat, fmpz_poly

from obsynth.numerics.ranks import RankDecision
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.exact_numbers import DECISIVE
from obsynth.proofs.enclosed_pencils import EnclosedPencil, bits_for, exponential, rank_to_digits
from obsynth.proofs.exact_doubles import holds_computed, written_matrix
from obsynth.proofs.exact_pencils import ExactPencil, system_pencil
from obsynth.proofs.rational_matrices import (
    blocks,
    picked_columns,
    picked_rows,
    rank_of,
    rational_matrix,
    zeros_matrix,
)

#: Degree of the minimal polynomial of an eigenvalue times columns of the pencil.  Above it the rank at the eigenvalue
#: is decided in floating point.
MOST_EXACT_SIZE = 400

#: Plants with more states are decided in floating point.
EXACT_STATES = 64

#: The same limit for plants that were sampled, whose matrix exponential is enclosed.
SAMPLED_STATES = 24

#: The same limit for computed data, where an exact answer says little more than floating point and takes longer.
COMPUTED_STATES = 24


@dataclass(frozen=True, eq=False)
class SystemFacts:
    """Normal rank and zeros of ``[A - s E, B; C, D]``: rational where ``exact``, else from enclosures or floats."""

    normal_rank: int
    columns: int
    outside: tuple[complex, ...]  # finite zeros that are not stable, the most unstable first
    zeros: tuple[complex, ...]
    exact: bool
    computed: bool = False  # whether some of the data were computed in floating point
    decisions: tuple[RankDecision, ...] = ()  # those in floating point that the facts rest on

    def timed(self, rate: float) -> SystemFacts:
        """Return the facts in another unit of time: zeros are multiplied by ``rate``."""
        zeros, outside = (tuple(value * rate for value in values) for values in (self.zeros, self.outside))
        return replace(self, zeros=zeros, outside=outside)

    @property
    def full(self) -> bool:
        """Whether the normal column rank is full."""
        return self.normal_rank == self.columns


@dataclass(frozen=True, eq=False)
class PlantNumbers:
    """Matrices of a plant as rational numbers or balls, with ranks and zeros of pencils made of them.

    A plant with stated numbers has rational ``matrices``.  A plant that was sampled has enclosures with ``bits`` bits;
    the matrices that sampling does not change (``E, C, Df, Dd``) are also in ``rational``.  ``computed`` is set where
    some numbers are results of floating point, known only to their last digit.
    """

    matrices: Mapping[str, Any]
    rational: Mapping[str, fmpq_mat]
    discrete: bool
    computed: bool = False
    bits: int | None = None
    cache: dict[object, Any] = field(default_factory=dict, repr=False)

    @property
    def exact(self) -> bool:
        """Whether all matrices are rational."""
        return self.bits is None

    def _with_many_bits(self) -> Any:
        """Return a context in which flint computes with as many bits as the enclosures have."""
        return flint.ctx.workprec(self.bits or flint.ctx.prec)

    def zeros(self, rows: int, columns: int) -> Any:
        """Return a zero matrix of this kind of number."""
        return zeros_matrix(rows, columns) if self.exact else arb_mat(rows, columns)

    def as_own(self, matrix: fmpq_mat) -> Any:
        """Return a rational matrix in this kind of number."""
        with self._with_many_bits():
            return matrix if self.exact else arb_mat(matrix)

    def product(self, first: Any, second: Any) -> Any:
        """Return the product of two matrices."""
        with self._with_many_bits():
            return first * second

    def rank(self, matrix: Any) -> int:
        """Return the rank of a matrix; for enclosures, to their working digits."""
        with self._with_many_bits():
            return rank_of(matrix) if self.exact else rank_to_digits(matrix.tolist())

    def columns(self, name: str, columns: Sequence[int] | None) -> Any:
        """Return the matrix of this name, or some of its columns."""
        return self.matrices[name] if columns is None else picked_columns(self.matrices[name], columns)

    def with_matrices(self, changes: Mapping[str, Any], *, rational: Mapping[str, fmpq_mat]) -> PlantNumbers:
        """Return the numbers with some matrices replaced; ``rational``: their rational forms, for a sampled plant."""
        own = {**self.rational, **(changes if self.exact else rational)}
        return replace(self, matrices={**self.matrices, **changes}, rational=own, cache={})

    @property
    def regular_rank(self) -> int:
        """Normal rank of ``A - s E``."""
        if not self.exact:
            return int(self.matrices["A"].nrows())
        pencil = ExactPencil(self.matrices["E"], self.matrices["A"])
        return int(self.remembered("normal rank", lambda: pencil.normal_rank))

    def pencil(self, inputs: Any, direct: Any) -> ExactPencil | EnclosedPencil:
        """Return ``[A - s E, inputs; C, direct]``."""
        e, a, c = self.rational["E"], self.matrices["A"], self.matrices["C"]
        if self.bits is None:
            return system_pencil(e, a, inputs, c, direct)
        matrix = blocks([[a, inputs], [c, direct]])
        nx, ny, width = int(a.nrows()), int(c.nrows()), int(inputs.ncols())
        padded_e = blocks([[e, zeros_matrix(nx, width)], [zeros_matrix(ny, nx), zeros_matrix(ny, width)]])
        return EnclosedPencil(padded_e, matrix.tolist(), self.bits)

    def rank_at_root(self, inputs: Any, direct: Any, polynomial: fmpz_poly) -> int | None:
        """Return the rank of ``[A - s E, inputs; C, direct]`` at the roots of an irreducible polynomial.

        ``None`` where the decision would be too expensive, and floating point has to make it.
        """
        pencil, degree = self.pencil(inputs, direct), int(polynomial.degree())
        if isinstance(pencil, ExactPencil):
            return None if pencil.shape[1] * degree > MOST_EXACT_SIZE else pencil.rank_at_root(polynomial)
        return None if degree > 1 else pencil.rank_at(flint.arb(flint.fmpq(-polynomial[0], polynomial[1])))

    def system(self, inputs: Any, direct: Any) -> SystemFacts:
        """Return rank and zeros of ``[A - s E, inputs; C, direct]``; zeros only where the normal rank is full."""
        key = ("system", str(inputs.tolist()), str(direct.tolist()))
        facts: SystemFacts = self.remembered(key, lambda: self._decided(self.pencil(inputs, direct)))
        return facts

    def _decided(self, pencil: ExactPencil | EnclosedPencil) -> SystemFacts:
        rank, columns = pencil.normal_rank, pencil.shape[1]
        if isinstance(pencil, ExactPencil):
            roots = pencil.zeros(discrete=self.discrete) if rank == columns else ()
            values = tuple(root.value for root in roots for _ in range(root.multiplicity))
            outside = tuple(root.value for root in roots if root.side != "stable")
            return SystemFacts(rank, columns, outside, values, True, self.computed)
        values = tuple(sorted(pencil.zeros, key=abs, reverse=True)) if rank == columns else ()
        stable = rank < columns or pencil.stable
        outside = tuple(value for value in values if abs(value) >= 1.0) or values[:1]
        return SystemFacts(rank, columns, () if stable else outside, values, False, self.computed)

    def remembered(self, key: object, decide: Callable[[], Any]) -> Any:
        """Return the cached value of a key; ``decide`` computes it at the first call."""
        if key not in self.cache:
            self.cache[key] = decide()
        return self.cache[key]


def sampled_numbers(exact: Mapping[str, fmpq_mat], sample_time: Any, *, computed: bool = False) -> PlantNumbers:
    """Return enclosures of a continuous plant with ``E = I`` after zero-order hold with a rational ``sample_time``."""
    states, faults, unknown = (int(exact[name].ncols()) for name in ("A", "Bf", "Bd"))
    width = faults + unknown
    step = flint.fmpq(sample_time.numerator, sample_time.denominator)
    below = [zeros_matrix(width, count) for count in (states, faults, unknown)]
    block = blocks([[exact["A"], exact["Bf"], exact["Bd"]], below]) if width else exact["A"]
    unchanged = {name: exact[name] for name in ("E", "C", "Df", "Dd")}
    bits = bits_for(states)
    with flint.ctx.workprec(bits):
        rows = picked_rows(exponential(block * step), range(states))
        ranges = {"A": (0, states), "Bf": (states, states + faults), "Bd": (states + faults, states + width)}
        matrices: dict[str, Any] = {name: picked_columns(rows, range(*ends)) for name, ends in ranges.items()}
        matrices |= {name: arb_mat(matrix) for name, matrix in unchanged.items()}
    return PlantNumbers(matrices, unchanged, discrete=True, computed=computed, bits=bits)


def numbers_of(plant: DescriptorSystem) -> PlantNumbers | None:
    """Return the numbers on which existence is decided; ``None`` where it is decided in floating point."""
    return None if plant.nx > EXACT_STATES else _numbers_of(_Content.of(plant))


@dataclass(frozen=True, eq=False)
class _Content:
    """A cache key: two plants with the same numbers are equal, so that equal plants are decided once."""

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


# Conditions, synthesis and verification ask for the numbers of the same plant several times; plants never change.
@lru_cache(maxsize=8)
def _numbers_of(content: _Content) -> PlantNumbers | None:
    plant = content.plant
    if plant.exact is not None:
        known = plant.exact
        rows = known.matrices
        states = len(rows["A"])
        sizes = {"E": states, "A": states, "C": states, "Bf": plant.nf, "Df": plant.nf, "Bd": plant.nd, "Dd": plant.nd}
        exact = {name: rational_matrix(rows[name], sizes[name]) for name in DECISIVE}
        if known.sample_time is None:
            written = PlantNumbers(exact, exact, plant.is_discrete, known.computed)
            return written if states <= (COMPUTED_STATES if known.computed else EXACT_STATES) else None
        few = states <= SAMPLED_STATES
        return sampled_numbers(exact, known.sample_time, computed=known.computed) if few else None
    computed = any(holds_computed(getattr(plant, name)) for name in DECISIVE)
    if computed and plant.nx > COMPUTED_STATES:
        return None
    matrices = {name: written_matrix(getattr(plant, name)) for name in DECISIVE}
    return PlantNumbers(matrices, matrices, plant.is_discrete, computed)
