"""The numbers of a plant on which existence is decided: rational as written, or enclosed where it was sampled."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache

from obsynth.analysis.existence.rational import PlantNumbers, WrittenNumbers
from obsynth.analysis.existence.sampled import sampled_numbers
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.origin import DECISIVE, origin_of

#: Plants of more states are decided in floating point.
EXACT_STATES = 64
SAMPLED_STATES = 24
#: Of computed data an exact answer says little more than floating point does, and takes longer.
COMPUTED_STATES = 24

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
