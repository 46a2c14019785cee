"""Rows about the plant itself: information for the reader, and the existence conditions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from obsynth.analysis.conditions import Condition
from obsynth.analysis.zeros import are_outside
from obsynth.numerics.pencils import FiniteZeros, PencilStructure, pencil_structure
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.checks import Check, information

#: Imaginary parts below this are not shown.
SHOWN_AS_REAL = 1e-12
#: Eigenvalues that are listed; the others are counted.
MOST_SHOWN = 6


def plant_information(plant: DescriptorSystem, structure: PencilStructure | None = None) -> Iterator[Check]:
    """Yield rows on regularity, index, eigenvalues and stability of the plant; they inform and never fail."""
    structure = pencil_structure(plant.E, plant.A) if structure is None else structure
    source = "the plant"
    yield information("plant: regular", "det(A - zE) is not identically zero", float(structure.regular), source=source)
    if not structure.regular:
        return
    yield information(
        "plant: index", "index of the pencil (0: E nonsingular)", float(structure.index or 0), source=source
    )
    count = len(structure.finite_eigenvalues)
    yield information(
        "plant: finite eigenvalues",
        "number of dynamic modes",
        float(count),
        source=source,
        detail=_eigenvalue_text(structure.finite_eigenvalues),
    )
    yield information(
        "plant: infinite eigenvalues",
        "number of infinite eigenvalues",
        float(sum(structure.infinite_block_sizes)),
        source=source,
        detail=f"block sizes {list(structure.infinite_block_sizes)}" if structure.infinite_block_sizes else "",
    )
    poles = FiniteZeros(structure.finite_eigenvalues, structure.normal_rank, structure.decisions)
    stable = not any(are_outside(plant.E, plant.A, poles, plant.dt))
    admissible = stable and (structure.index or 0) <= 1
    verdict = "admissible" if admissible else "not admissible: an observer may exist all the same"
    yield information(
        "plant: admissible",
        "regular, impulse-free and stable",
        float(admissible),
        source=source,
        detail=verdict,
    )


def _eigenvalue_text(values: Iterable[complex]) -> str:
    listed = sorted((complex(value) for value in values), key=abs, reverse=True)
    shown = [
        f"{v.real:.4g}" if abs(v.imag) < SHOWN_AS_REAL else f"{v.real:.4g}{v.imag:+.4g}j" for v in listed[:MOST_SHOWN]
    ]
    return ", ".join(shown) + (f", and {len(listed) - MOST_SHOWN} more" if len(listed) > MOST_SHOWN else "")


def condition_rows(conditions: Iterable[Condition]) -> Iterator[Check]:
    """Yield one row per existence condition."""
    for condition in conditions:
        yield Check(
            f"exists: {condition.name}",
            condition.claim,
            condition.value,
            condition.bound,
            abs(condition.bound - condition.value),
            condition.holds,
            condition.source,
            "condition",
            f"Unclear: {condition.detail}" if condition.unclear else condition.detail,
        )
