"""Banks of structured residuals: which sets of faults residuals can see while they are blind to all others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

from obsynth.analysis.diagnosis.columns import Question
from obsynth.plants.descriptor import DescriptorSystem

#: With more faults only residuals that are blind to one fault, or see one fault, are looked for.
MOST_FAULTS = 6


@dataclass(frozen=True)
class StructuredResidual:
    """A residual that can be had: it sees some faults, and neither the others nor any unknown input.

    Parameters
    ----------
    sees : tuple of str
        Faults that leave a trace in it.
    blind_to : tuple of str
        The others.
    at_rest : tuple of str
        Those of `sees` whose constant values it keeps seeing.
    order : int or None
        Least order of a filter with one residual that sees them all; ``None`` where it is beyond what is computed.
    """

    sees: tuple[str, ...]
    blind_to: tuple[str, ...]
    at_rest: tuple[str, ...]
    order: int | None


def residual_bank(plant: DescriptorSystem, exactly: bool) -> tuple[StructuredResidual, ...]:
    """Return every structured residual that exists, those that see least first."""
    found = []
    rest = 1.0 if plant.dt > 0.0 else 0.0
    for removed in _sets(plant.nf):
        kept = [i for i in range(plant.nf) if i not in removed]
        asked = [Question(plant, tuple(removed), i, exactly) for i in kept]
        if not all(question.visible for question in asked):
            continue
        orders = [question.residual_order for question in asked]
        known = [order for order in orders if order is not None]
        found.append(
            StructuredResidual(
                tuple(plant.fault_names[i] for i in kept),
                tuple(plant.fault_names[i] for i in removed),
                tuple(plant.fault_names[q.number] for q in asked if q.shows_at(rest)),
                max(known) if len(known) == len(orders) else None,
            )
        )
    return tuple(sorted(found, key=lambda residual: len(residual.sees)))


def _sets(count: int) -> Iterator[Sequence[int]]:
    """Yield the sets of faults to be blind to."""
    if count == 0:
        return
    if count <= MOST_FAULTS:
        for size in range(count):
            yield from combinations(range(count), size)
        return
    yield ()
    for i in range(count):
        yield (i,)
        yield tuple(j for j in range(count) if j != i)
