"""The matrices of a plant as rational numbers: as written, or computed from these by exact arithmetic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import require_kind
from obsynth.numerics.arrays import FloatArray

#: The matrices on which existence depends.
DECISIVE = ("E", "A", "Bf", "Bd", "C", "Df", "Dd")

#: Rational matrices by name.
RationalRows: TypeAlias = Mapping[str, tuple[tuple[Fraction, ...], ...]]


@dataclass(frozen=True, eq=False)
class ExactNumbers:
    """Rational matrices (`DECISIVE`) of a plant, or of the continuous plant that was sampled."""

    matrices: RationalRows
    sample_time: Fraction | None = None
    own: bool = True  # in the states of the plant; otherwise in other coordinates of them
    computed: bool = False  # some were computed in floating point
    sizes: Mapping[str, FloatArray] | None = None  # of the terms of entries, to which rounding is relative
    states: int = 0  # of the plant as written, 0 where unknown
    # Before what elimination of computed data may have left by rounding was set to zero.
    uncleaned: RationalRows | None = None

    @cached_property
    def content(self) -> tuple[object, ...]:
        """What tells these numbers from others: their hash stands for the rational ones."""
        return self.sample_time, self.computed, hash(tuple(self.matrices[name] for name in DECISIVE))

    def before_cleaning(self) -> ExactNumbers:
        """Return the numbers before any were taken for rounding."""
        return self if self.uncleaned is None else replace(self, matrices=self.uncleaned, uncleaned=None)

    def require_of(self, matrices: Mapping[str, FloatArray]) -> None:
        """Raise `SpecError` where these are not the numbers behind the matrices of a plant, by name."""
        for name in DECISIVE:
            rows, matrix = self.matrices[name], matrices[name]
            if (len(rows), *{len(row) for row in rows}) not in (matrix.shape, matrix.shape[:1]):
                raise SpecError(f"exact has another size of {name} than the plant: leave it out.", path="exact")
            rounded = [value.numerator / value.denominator for row in rows for value in row]
            if self.own and self.sample_time is None and rounded != np.ravel(matrix).tolist():
                raise SpecError(f"exact does not round to {name} of the plant: leave it out.", path="exact")

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers as data, rational ones as text."""
        return {
            "matrices": _texts(self.matrices),
            "sample_time": None if self.sample_time is None else _text(self.sample_time),
            "own": self.own,
            "computed": self.computed,
            "sizes": None if self.sizes is None else dict(self.sizes),
            "states": self.states,
            "uncleaned": None if self.uncleaned is None else _texts(self.uncleaned),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ExactNumbers:
        """Return the numbers that `as_dict` described."""
        time, sizes, uncleaned = data["sample_time"], data["sizes"], data["uncleaned"]
        return cls(
            _fractions(data["matrices"]),
            None if time is None else _fraction(time),
            bool(data["own"]),
            bool(data["computed"]),
            None if sizes is None else {name: np.asarray(sizes[name], dtype=np.float64) for name in sizes},
            int(data["states"]),
            None if uncleaned is None else _fractions(uncleaned),
        )


def exact_numbers(data: Any) -> ExactNumbers | None:
    """Return what `ExactNumbers.as_dict` described; `None` and exact numbers stay as they are."""
    if data is None or isinstance(data, ExactNumbers):
        return data
    require_kind(data, Mapping, "exact", "what the exact numbers of a plant are as data (as_dict)")
    missing = [field.name for field in fields(ExactNumbers) if field.name not in data]
    if missing:
        raise SpecError(f"exact has no {missing[0]!r}: give what as_dict() returns, or leave it out.", path="exact")
    return ExactNumbers.from_dict(data)


def _texts(matrices: RationalRows) -> dict[str, list[list[str]]]:
    return {name: [[_text(value) for value in row] for row in rows] for name, rows in matrices.items()}


def _fractions(matrices: Mapping[str, Sequence[Sequence[str]]]) -> RationalRows:
    return {name: tuple(tuple(map(_fraction, row)) for row in matrices[name]) for name in DECISIVE}


def _text(value: Fraction) -> str:
    from flint import fmpq

    # Python refuses to write out integers of thousands of digits.
    return str(fmpq(value.numerator, value.denominator))


def _fraction(text: str) -> Fraction:
    from flint import fmpq

    rational = fmpq(text)
    return Fraction(int(rational.p), int(rational.q))
