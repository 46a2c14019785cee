"""The numbers of a plant on which existence is decided: rational as written, or enclosed where it was sampled."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeVar

import numpy as np

from obsynth.analysis.existence.rational import PlantNumbers, WrittenNumbers
from obsynth.analysis.existence.sampled import sampled_numbers
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.origin import DECISIVE, origin_of

#: Plants of more states are decided in floating point.
EXACT_STATES = 64
SAMPLED_STATES = 24
#: Of computed data an exact answer says little more than floating point does, and takes longer.
COMPUTED_STATES = 24

Found = TypeVar("Found")

_EXACTLY: ContextVar[bool] = ContextVar("existence is decided exactly", default=True)


@contextmanager
def decided(*, exactly: bool) -> Iterator[None]:
    """Decide existence exactly, or in floating point: for what is only tried, such as sensors that might be added."""
    token = _EXACTLY.set(exactly)
    try:
        yield
    finally:
        _EXACTLY.reset(token)


def decides_exactly() -> bool:
    """Whether existence is decided exactly where that can be done."""
    return _EXACTLY.get()


#: Whether numbers are asked for as they were before what elimination left by rounding was set to zero, and for which
#: plants that was done.
_UNCLEANED: ContextVar[bool] = ContextVar("numbers are not cleaned", default=False)
_CLEANED: ContextVar[list[DescriptorSystem] | None] = ContextVar("plants whose numbers were cleaned", default=None)


def reconsidered(
    decide: Callable[[], Found], refused: Callable[[Found], bool], doubted: Callable[[Found], bool]
) -> Found:
    """Return a decision; a refusal that rests on what was taken for rounding gives way to the doubt without that."""
    cleaned: list[DescriptorSystem] = []
    token = _CLEANED.set(cleaned)
    try:
        found = decide()
    finally:
        _CLEANED.reset(token)
    if not cleaned or not refused(found):
        return found
    again = _UNCLEANED.set(True)
    try:
        other = decide()
    finally:
        _UNCLEANED.reset(again)
    return other if doubted(other) else found


def uncleaned() -> bool:
    """Whether numbers are asked for as they were before any were taken for rounding."""
    return _UNCLEANED.get()


def numbers_of(plant: DescriptorSystem) -> PlantNumbers | None:
    """Return the numbers on which existence is decided; ``None`` where it is decided in floating point."""
    if not _EXACTLY.get() or plant.nx > EXACT_STATES:
        return None
    origin, cleaned = origin_of(plant), _CLEANED.get()
    if cleaned is not None and origin is not None and origin.uncleaned is not None:
        cleaned.append(plant)
    return _numbers_of(_Content.of(plant), _UNCLEANED.get())


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
def _numbers_of(content: _Content, uncleaned: bool) -> PlantNumbers | None:
    plant = content.plant
    from obsynth.proofs.exact_arithmetic import is_computed, rational_matrix, written_matrix

    origin = origin_of(plant)
    if origin is not None:
        rows = origin.uncleaned if uncleaned and origin.uncleaned is not None else origin.exact
        states = len(rows["A"])
        sizes = {"E": states, "A": states, "C": states, "Bf": plant.nf, "Df": plant.nf, "Bd": plant.nd, "Dd": plant.nd}
        exact = {name: rational_matrix(rows[name], sizes[name]) for name in DECISIVE}
        if origin.sample_time is None:
            written = WrittenNumbers(exact, plant.is_discrete, computed=origin.computed)
            return written if states <= (COMPUTED_STATES if origin.computed else EXACT_STATES) else None
        sampled = sampled_numbers(exact, origin.sample_time) if states <= SAMPLED_STATES else None
        return None if sampled is None else replace(sampled, computed=origin.computed)
    computed = any(map(is_computed, (value for name in DECISIVE for value in np.ravel(getattr(plant, name)).tolist())))
    if computed and plant.nx > COMPUTED_STATES:
        return None
    matrices = {name: written_matrix(getattr(plant, name)) for name in DECISIVE}
    return WrittenNumbers(matrices, plant.is_discrete, computed=computed)
