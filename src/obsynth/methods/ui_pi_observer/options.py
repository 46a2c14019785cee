"""The options of the unknown-input PI observer, checked before anything is computed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.method_spec import MethodOptions
from obsynth.methods.placement.region import Region
from obsynth.methods.ui_pi_observer.placement_problem import NoiseWeights
from obsynth.numerics.arguments import NonNegative, Positive, WrittenAs, problem_with
from obsynth.numerics.arrays import ComplexArray
from obsynth.numerics.spectra import decay_rates
from obsynth.plants.fault_models import Exosystem

#: Poles given as numbers count as a conjugate pair when they agree to this, relative to their size.
PAIR_TOLERANCE = 1e-9
_PATH = "method.options"


@dataclass(frozen=True)
class UiPiOptions(MethodOptions):
    """Options of the method as asked for; see `obsynth.ui_pi_observer`."""

    METHOD: ClassVar[str] = "ui-pi-observer"

    fault_model: Annotated[Any, WrittenAs("fault model")] = "step"
    poles: Annotated[Any, WrittenAs("poles")] = None
    decay: NonNegative | None = None
    region: Annotated[Any, WrittenAs("pole region")] = None
    noise: Annotated[Any, WrittenAs("noise weights")] = None
    objective: Literal["conditioning", "gain"] = "conditioning"
    joint: bool = False
    E_sharp: Annotated[Any, WrittenAs("matrix")] = None
    C_sharp: Annotated[Any, WrittenAs("matrix")] = None
    G: Annotated[Any, WrittenAs("matrix")] = None
    solver: Literal["CLARABEL", "SCS"] = "CLARABEL"

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options that is broken."""
        ways = [name for name in ("poles", "decay", "region") if getattr(self, name) is not None]
        if len(ways) > 1:
            yield f"{' and '.join(ways)} are given: use one of them."
        if self.poles is not None and self.noise is not None:
            yield "noise weights do not act on given poles: leave one of the two out."
        given = [getattr(self, name) is not None for name in ("E_sharp", "C_sharp", "G")]
        if any(given) and not all(given):
            yield "E_sharp, C_sharp and G come together: give all three, or none."
        if any(given) and self.joint:
            yield "joint designs what E_sharp, C_sharp and G would fix: leave one of the two out."

    def given_decoupling(self) -> dict[str, Any] | None:
        """Return the paper's matrices, or ``None`` for our own decoupling."""
        if self.G is None:
            return None
        return {"E_sharp": self.E_sharp, "C_sharp": self.C_sharp, "G": self.G}

    def checked_region(self, dt: float) -> Region | None:
        """Return the region asked for."""
        if self.region is None:
            return None
        if not isinstance(self.region, Mapping):
            raise SpecError(f"region is {self.region!r}: give decay, radius, damping by name.", path=f"{_PATH}.region")
        return Region.of({key: value for key, value in self.region.items() if value is not None}, dt)

    def checked_noise(self, output_names: Sequence[str]) -> NoiseWeights:
        """Return the noise weights asked for."""
        if self.noise is None:
            return NoiseWeights()
        if not isinstance(self.noise, Mapping):
            message = f"noise is {self.noise!r}: give measurement, process, fault by name."
            raise SpecError(message, path=f"{_PATH}.noise")
        given = {key: value for key, value in self.noise.items() if value is not None}
        problems = [f"unknown key {key!r}." for key in given if key not in ("measurement", "process", "fault")]
        sizes = {key: given[key] for key in ("process", "fault") if key in given}
        problems += [text for key, size in sizes.items() if (text := problem_with(size, key, Positive))]
        measurement = given.get("measurement")
        if isinstance(measurement, (list, tuple, np.ndarray)):
            if np.shape(measurement) != (len(output_names),):
                problems.append(f"measurement has shape {np.shape(measurement)}: give one number for each output.")
                measurement = None
            else:
                measurement = given["measurement"] = dict(zip(output_names, measurement, strict=True))
        if isinstance(measurement, Mapping):
            missing = [name for name in output_names if name not in measurement]
            unknown = [name for name in measurement if name not in output_names]
            if missing or unknown:
                problems.append(f"measurement must name each output once: missing {missing}, unknown {unknown}.")
            values = list(measurement.values())
        else:
            values = [] if measurement is None else [measurement]
        if any(problem_with(value, "measurement", Positive) for value in values):
            problems.append("measurement must be positive standard deviations: one number, a list, or by output.")
        if problems:
            raise SpecError("Option noise of ui-pi-observer:", path=f"{_PATH}.noise", problems=problems)
        return NoiseWeights(**given)

    def slowest_asked(self, dt: float) -> float | None:
        """Return the least rate of decay that was asked for, in 1/s."""
        if self.decay is not None:
            return self.decay
        if isinstance(self.region, Mapping):
            return float(self.region.get("decay") or 0.0)
        if self.poles is not None:
            return float(np.min(decay_rates([_as_complex(pole) for pole in self.poles], dt), initial=np.inf))
        return None

    def resolved(self, model: Exosystem, fault_names: Sequence[str]) -> dict[str, Any]:
        """Return the options as plain data, for the gain set."""
        listed = None if self.poles is None else [_as_complex(pole) for pole in self.poles]
        return {
            "fault_model": None,
            "fault_model_in_words": dict(zip(fault_names, model.descriptions, strict=True)),
            **self.as_plain(),
            "poles": None if listed is None else [[pole.real, pole.imag] for pole in listed],
        }


def checked_poles(
    given: Any, count: int, fixed: ComplexArray, dt: float, *, of: str = "ui-pi-observer"
) -> list[complex]:
    """Return the wanted poles, in exact conjugate pairs; ``of``: what they are for, in messages."""
    listed = [_as_complex(pole) for pole in given]
    problems = []
    if len(listed) != count:
        kept = ", ".join(f"{complex(value):.6g}" for value in fixed)
        besides = f" (fixed, not to be listed: {kept})" if kept else ""
        problems.append(f"{len(listed)} are given, but {count} can be placed{besides}.")
    rates = decay_rates(listed, dt)
    unstable = [pole for pole, rate in zip(listed, rates, strict=True) if not rate > 0.0]
    if unstable:
        where = "inside the unit circle" if dt > 0.0 else "in the left half plane"
        problems.append(f"{', '.join(f'{pole:.6g}' for pole in unstable)} would not be stable: give poles {where}.")
    upper = [pole for pole in listed if pole.imag > 0.0]
    lower = [pole for pole in listed if pole.imag < 0.0]
    lonely = []
    for pole in upper:
        partner = next((p for p in lower if abs(p - pole.conjugate()) <= PAIR_TOLERANCE * abs(pole)), None)
        if partner is None:
            lonely.append(pole)
        else:
            lower.remove(partner)
    lonely += lower
    if lonely:
        problems.append(f"{', '.join(f'{pole:.6g}' for pole in lonely)} lack their conjugates.")
    if problems:
        raise SpecError(f"Option poles of {of}:", path=f"{_PATH}.poles", problems=problems)
    real = [pole for pole in listed if pole.imag == 0.0]
    return [*real, *(p for pole in upper for p in (pole, pole.conjugate()))]


def _as_complex(pole: Any) -> complex:
    try:
        value = complex(*pole) if isinstance(pole, (list, tuple, np.ndarray)) and len(pole) == 2 else complex(pole)
    except (TypeError, ValueError):
        raise SpecError(f"{pole!r} is no pole: give a number, or [re, im].", path=f"{_PATH}.poles") from None
    if isinstance(pole, (bool, str)) or not np.isfinite(value):
        raise SpecError(f"{pole!r} is no pole: give a finite number, or [re, im].", path=f"{_PATH}.poles")
    return value
