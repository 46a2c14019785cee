"""Exact numbers behind matrices that were rounded when they were made, and the plant that they come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Any, Protocol, TypeAlias

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.sparse import same_matrix


class Written(Protocol):
    """A linear plant: its matrices by name, and the seconds between its samples."""

    @property
    def dt(self) -> float:
        """Sample time in s, zero for a plant in continuous time."""


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

    def require_of(self, plant: Written) -> None:
        """Raise `SpecError` where these are not the numbers behind the matrices of a plant."""
        for name in DECISIVE:
            rows, matrix = self.matrices[name], getattr(plant, name)
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

    found = fmpq(text)
    return Fraction(int(found.p), int(found.q))


def note_source(source: Written, new: Written, *, sample_time: float | None = None) -> None:
    """Note on a plant that elimination or sampling has just made which plant, as written, it comes from."""
    if new is source:
        return
    written, earlier = getattr(source, "_made_from", (source, None))
    if earlier is None or sample_time is None:
        object.__setattr__(new, "_made_from", (written, earlier if sample_time is None else sample_time))


def carry_source(old: Written, new: Written) -> None:
    """Note on a changed plant which plant, as written, the old one comes from, if nothing has changed that matters."""
    made = getattr(old, "_made_from", None)
    unchanged = old.dt == new.dt and all(
        same_matrix(getattr(old, name), getattr(new, name)) for name in (*DECISIVE, "B", "D")
    )
    if made is not None and unchanged:
        written, time = made
        if not (
            same_matrix(getattr(old, "Bw", None), getattr(new, "Bw", None))
            and same_matrix(getattr(old, "Dw", None), getattr(new, "Dw", None))
        ):
            # The noise was stated anew since: that of the plant as written says nothing about it.
            written = written.replace(Bw=None, Dw=None, noise_names=None)
        object.__setattr__(new, "_made_from", (written, time))
