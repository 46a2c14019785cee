"""What a plant was made from: exact numbers behind matrices that were rounded when they were made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Protocol, TypeVar

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.sparse import same_matrix


class Written(Protocol):
    """A linear plant: its matrices by name, and the seconds between its samples."""

    @property
    def dt(self) -> float:
        """Sample time in s, zero for a plant in continuous time."""


Plant = TypeVar("Plant", bound=Written)

#: The matrices on which existence depends.
DECISIVE = ("E", "A", "Bf", "Bd", "C", "Df", "Dd")


@dataclass(frozen=True, eq=False)
class PlantOrigin:
    """Rational matrices (`DECISIVE`) of a plant in some coordinates, or of the continuous plant that was sampled."""

    exact: Mapping[str, tuple[tuple[Fraction, ...], ...]]
    sample_time: Fraction | None = None
    computed: bool = False  # some were computed in floating point
    sizes: Mapping[str, FloatArray] | None = None  # of the terms of entries, to which rounding is relative
    states: int = 0  # of the plant as written, 0 where unknown
    uncleaned: Mapping[str, tuple[tuple[Fraction, ...], ...]] | None = None


def origin_of(plant: Written) -> PlantOrigin | None:
    """Return what a plant was made from, where that is known and its matrices have not been changed since."""
    return getattr(plant, "_origin", None)


def with_origin(plant: Plant, origin: PlantOrigin | None) -> Plant:
    """Note on a plant that was just made what it was made from, and return it."""
    object.__setattr__(plant, "_origin", origin)
    return plant


def note_source(source: Written, new: Written, *, sample_time: float | None = None) -> None:
    """Note on a plant that elimination or sampling has just made which plant, as written, it comes from."""
    if new is source:
        return
    written, earlier = getattr(source, "_made_from", (source, None))
    if earlier is None or sample_time is None:
        object.__setattr__(new, "_made_from", (written, earlier if sample_time is None else sample_time))


def carry_origin(old: Written, new: Plant) -> Plant:
    """Note on a changed plant what the old one was made from, if nothing has changed that matters."""
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
    origin = origin_of(old)
    same = origin is not None and old.dt == new.dt
    if same and all(same_matrix(getattr(old, name), getattr(new, name)) for name in DECISIVE):
        return with_origin(new, origin)
    return new
