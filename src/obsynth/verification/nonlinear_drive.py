"""Input and output matrices of the error system of an observer over a region, from its options."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number, shown
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.suggestions import there_are
from obsynth.plants.operating_region import OperatingRegion
from obsynth.plants.transformations.nonlinear_terms import NonlinearTerms


def drive_of(
    terms: NonlinearTerms, noise: Mapping[str, Any] | None, sample_time: float
) -> tuple[FloatArray, FloatArray]:
    """Return B ``(n, p)`` and D ``(ny, p)`` of unit white noises, per root of a second.

    Raises
    ------
    SpecError
        A name is unknown, a size is not positive, or an output or a fault has none.
    """
    noise_sizes = _checked(noise, "noise")
    columns: list[FloatArray] = []
    n, ny = len(terms.names), len(terms.output_names)
    sizes: dict[str, float] = {}
    moving = terms.names[: terms.differential]
    for name, size in noise_sizes.items():
        state = name.removeprefix("der(").removesuffix(")").strip() if name.startswith("der(") else name
        if name in terms.output_names:
            sizes[name] = size
        elif state in moving:
            columns.append(size * np.eye(n + ny)[moving.index(state)])
        else:
            known = (*terms.output_names, *terms.faults, *(f"der({each})" for each in moving))
            raise SpecError(f"noise names {name!r}; {there_are(name, known)}", path=f"noise.{name}")
    missing = [name for name in terms.output_names if name not in sizes]
    missing += [name for name in terms.faults if name not in noise_sizes and f"der({name})" not in noise_sizes]
    if missing:
        raise SpecError(
            f"noise says nothing of {', '.join(map(repr, missing))}: give the standard deviation of a sample for each "
            "output, and for each fault how it drifts, in its unit per root of a second. Without these a gain of any "
            "size would be best.",
            path="noise",
        )
    # A sample's deviation held over the sample has this intensity.
    columns += [
        sizes[name] * np.sqrt(sample_time) * np.eye(n + ny)[n + place] for place, name in enumerate(terms.output_names)
    ]
    whole = np.array(columns).T.reshape(n + ny, len(columns))
    return whole[:n], whole[n:]


def wanted_of(terms: NonlinearTerms, region: OperatingRegion, wanted: Mapping[str, Any] | None) -> FloatArray:
    """Return the errors that count, each in units of its size: ``(q, n)``."""
    moving = terms.names[: terms.differential]
    if wanted is None:
        names = terms.faults or moving
        single = {
            each.combination.parts[0][0]: each.high - each.low
            for each in region.ranges
            if len(each.combination.parts) == 1
        }
        sizes = {name: 1.0 if len(names) == 1 else single.get(name, 1.0) for name in names}
    else:
        sizes = _checked(wanted, "wanted")
        unknown = [name for name in sizes if name not in moving]
        if unknown or not sizes:
            raise SpecError(
                f"wanted names {unknown[0]!r}" if unknown else "wanted is empty",
                path="wanted",
                problems=[f"differential states and faults are: {', '.join(moving)}."],
            )
    return np.array([np.eye(len(terms.names))[terms.names.index(name)] / size for name, size in sizes.items()])


def in_words(terms: NonlinearTerms, wanted: FloatArray) -> str:
    """Return the errors that count in words."""
    words = []
    for row in wanted:
        place = int(np.flatnonzero(row)[0])
        size = 1.0 / row[place]
        words.append(terms.names[place] if size == 1.0 else f"{terms.names[place]} / {size:.4g}")
    return ", ".join(words)


def _checked(sizes: Mapping[str, Any] | None, what: str) -> dict[str, float]:
    if not isinstance(sizes, Mapping) or not sizes:
        raise SpecError(f"{what} must name signals with their sizes, such as {{'gauge': 0.001}}.", path=what)
    for name, size in sizes.items():
        if not (is_finite_number(size) and size > 0.0):
            raise SpecError(f"{what} of {name!r} is {shown(size)}: give a positive number.", path=f"{what}.{name}")
    return {str(name): float(size) for name, size in sizes.items()}
