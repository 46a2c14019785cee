"""The faults that a functional filter is asked for, from the names given."""

from __future__ import annotations

from typing import Any

from obsynth.errors import SpecError
from obsynth.methods.method import OPTIONS_PATH
from obsynth.plants.descriptor import DescriptorSystem


def chosen_faults(faults: Any, plant: DescriptorSystem) -> list[int]:
    """Return the columns of the faults to estimate."""
    names = plant.fault_names if faults is None else faults
    listed = [names] if isinstance(names, str) else list(names)
    unknown = [name for name in listed if name not in plant.fault_names]
    if unknown or len(set(listed)) < len(listed):
        what = f"{', '.join(map(repr, unknown))}: no such fault" if unknown else "a fault is named twice"
        there = ", ".join(plant.fault_names) or "none"
        raise SpecError(f"{what}; there are: {there}.", path=f"{OPTIONS_PATH}.faults")
    return sorted(plant.fault_names.index(name) for name in listed)


def residual_sets(residuals: Any, plant: DescriptorSystem) -> list[list[int]] | None:
    """Return the sets of faults that residuals are to see; ``None`` where estimates are asked for."""
    if residuals is None:
        return None
    everything = list(range(plant.nf))
    if residuals == "detect":
        return [everything]
    if residuals == "isolate":
        return [[i] for i in everything]
    given = [residuals] if isinstance(residuals, str) else list(residuals)
    sets = [[entry] if isinstance(entry, str) else list(entry) for entry in given]
    unknown = sorted({str(name) for entry in sets for name in entry if name not in plant.fault_names})
    if unknown or not all(sets):
        raise SpecError(
            f"residuals is {residuals!r}: give detect, isolate, or lists of faults to see; there are: "
            f"{', '.join(plant.fault_names) or 'none'}.",
            path=f"{OPTIONS_PATH}.residuals",
        )
    return [sorted(plant.fault_names.index(name) for name in entry) for entry in sets]
