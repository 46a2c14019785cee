"""The options of the functional filter, checked before anything is computed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from annotated_types import Ge

from obsynth.errors import SpecError
from obsynth.methods.method_spec import MethodOptions
from obsynth.numerics.arguments import FewSamples, NonNegative, WrittenAs, is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem

_PATH = "method.options"


@dataclass(frozen=True)
class FunctionalFilterOptions(MethodOptions):
    """Options of the method as asked for; see `obsynth.functional_filter`."""

    METHOD: ClassVar[str] = "functional-filter"

    faults: Annotated[Any, WrittenAs("texts")] = None
    joint: bool = False
    fault_model: Annotated[Any, WrittenAs("fault model")] = "step"
    fault_rate: Annotated[Any, WrittenAs("named numbers")] = None
    delay: FewSamples = 0
    mean: Annotated[FewSamples, Ge(1)] = 1
    decay: NonNegative | None = None
    poles: Annotated[Any, WrittenAs("pole sets")] = None
    noise: Annotated[Any, WrittenAs("named numbers")] = None
    residuals: Annotated[Any, WrittenAs("fault sets")] = None

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        if self.poles is not None:
            given = [name for name in ("fault_rate", "decay", "noise") if getattr(self, name) is not None]
            given += ["delay"] if self.delay else []
            if given:
                yield f"{', '.join(given)} choose gains, and so do poles: give one."
        if self.residuals is not None:
            given = [name for name in ("faults", "fault_rate") if getattr(self, name) is not None]
            late = [name for name, default in (("delay", 0), ("mean", 1)) if getattr(self, name) != default]
            if given or late or self.joint:
                listed = [*given, *late, *(["joint"] if self.joint else [])]
                yield f"{', '.join(listed)} are about estimates: leave them out where only residuals are asked for."

    def chosen_faults(self, plant: DescriptorSystem) -> list[int]:
        """Return the columns of the faults to estimate."""
        names = plant.fault_names if self.faults is None else self.faults
        listed = [names] if isinstance(names, str) else list(names)
        unknown = [name for name in listed if name not in plant.fault_names]
        if unknown or len(set(listed)) < len(listed):
            what = f"{', '.join(map(repr, unknown))}: no such fault" if unknown else "a fault is named twice"
            there = ", ".join(plant.fault_names) or "none"
            raise SpecError(f"{what}; there are: {there}.", path=f"{_PATH}.faults")
        return sorted(plant.fault_names.index(name) for name in listed)

    def rates(self, plant: DescriptorSystem) -> FloatArray | None:
        """Return the walk of each fault of the plant ``(nf,)``, or ``None`` for the default; faults left out get 0."""
        if self.fault_rate is None:
            return None
        return _by_name(self.fault_rate, plant.fault_names, "fault_rate", missing=0.0)

    def sensor_noise(self, plant: DescriptorSystem) -> FloatArray | None:
        """Return the deviation of each output ``(ny,)``, or ``None`` for what the plant states."""
        if self.noise is None:
            return None
        return _by_name(self.noise, plant.output_names, "noise", missing=None)

    def residual_sets(self, plant: DescriptorSystem) -> list[list[int]] | None:
        """Return the sets of faults that residuals are to see; ``None`` where estimates are asked for."""
        if self.residuals is None:
            return None
        everything = list(range(plant.nf))
        if self.residuals == "detect":
            return [everything]
        if self.residuals == "isolate":
            return [[i] for i in everything]
        given = [self.residuals] if isinstance(self.residuals, str) else list(self.residuals)
        sets = [[entry] if isinstance(entry, str) else list(entry) for entry in given]
        unknown = sorted({str(name) for entry in sets for name in entry if name not in plant.fault_names})
        if unknown or not all(sets):
            raise SpecError(
                f"residuals is {self.residuals!r}: give detect, isolate, or lists of faults to see; there are: "
                f"{', '.join(plant.fault_names) or 'none'}.",
                path=f"{_PATH}.residuals",
            )
        return [sorted(plant.fault_names.index(name) for name in entry) for entry in sets]


def _by_name(given: Any, names: Sequence[str], option: str, *, missing: float | None) -> FloatArray:
    """Return a number for each name, from one number or a mapping."""
    path = f"{_PATH}.{option}"
    if isinstance(given, Mapping):
        unknown = [name for name in given if name not in names]
        lacking = [name for name in names if name not in given]
        if unknown or (lacking and missing is None):
            raise SpecError(f"{option} must name {', '.join(names)}: unknown {unknown}, missing {lacking}.", path=path)
        values = [given.get(name, missing) for name in names]
    else:
        values = [given] * len(names)
    if not all(is_finite_number(value) and value >= 0.0 for value in values) or not any(values):
        raise SpecError(f"{option} is {given!r}: give positive numbers, one for all or by name.", path=path)
    return np.array(values, dtype=np.float64)
