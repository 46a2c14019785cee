"""The assumptions of a statement in words that an auditor can sign: bounds, start, constants, log, gain set."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.constants import MOST_LISTED, ConstantsBox, deviations_told, shown, shown_bound
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.moving_disturbances import continuous_behind
from obsynth.plants.uncertainty import SAMPLED
from obsynth.results.gain_set_writing import digest_of, plain


@dataclass(frozen=True, eq=False)
class Assumptions:
    """Bounds of what is unknown: disturbances ``(nd,)``, noise in deviations, start or states, constants."""

    plant: DescriptorSystem
    bounds: FloatArray
    noise_bound: float
    initial_set: Mapping[str, Any] | None = None
    state_bounds: Mapping[str, Any] | None = None
    initial_error: float | None = None
    #: ``any``: disturbances move within their bounds between samples too; ``held``: they do not.
    disturbance: str = "any"
    #: Whether the plant's noise is left out, since a scenario has none.
    noise_left_out: bool = False
    #: Whether the noise of the plant is in units of its bounds, not of its deviations.
    noise_as_bounds: bool = False

    @property
    def moves(self) -> bool:
        """Whether disturbances are taken to move between the samples of a plant whose continuous one is known."""
        uncertain = self.plant.uncertainty
        sampled = uncertain is not None and any(kind == SAMPLED for kind, _ in uncertain.steps)
        known = self.plant.dt > 0.0 and self.plant.nd > 0 and (sampled or continuous_behind(self.plant) is not None)
        return self.disturbance == "any" and known

    @property
    def movement(self) -> str:
        """What is assumed of disturbances between samples, to be added to a sentence; empty where there are none."""
        if not self.plant.dt > 0.0 or not np.any(self.bounds[np.isfinite(self.bounds)]):
            return ""
        if self.moves:
            return ", and any course of disturbances within their bounds, between samples too"
        return ", and disturbances that are held between samples"

    @property
    def box(self) -> ConstantsBox | None:
        """The constants with tolerances; `None` where the model is taken as exact."""
        uncertain = self.plant.uncertainty
        return None if uncertain is None or not uncertain.box.names else uncertain.box

    def as_dict(self) -> dict[str, Any]:
        """Return everything that is assumed as plain data."""
        return {
            "disturbances between samples": "any" if self.moves else "held",
            "disturbances": dict(zip(self.plant.disturbance_names, map(float, self.bounds), strict=True)),
            "noise": float(self.noise_bound) if self.plant.nw else None,
            "start": None if self.initial_set is None else _listed(self.initial_set),
            "states": None if self.state_bounds is None else _listed(self.state_bounds),
            "constants": None if self.box is None else self.box.as_dict(),
        }

    @property
    def digest(self) -> str:
        """Sha256 of all assumptions."""
        return digest_of(plain(self.as_dict()))

    def parts(self) -> list[str]:
        """Return one phrase for each kind of bound."""
        phrases, plant = [], self.plant
        each = [
            f"{name} within {shown_bound(bound, plant.units.get(name, ''))}"
            for name, bound in zip(plant.disturbance_names, self.bounds, strict=True)
            if np.isfinite(bound)  # others reach nothing that is watched
        ]
        if each:
            phrases.append(_enough(each, "disturbances within their bounds"))
        if plant.nw:
            phrases.append(self._noise())
        elif self.noise_left_out:
            phrases.append("no noise, as the scenario has none")
        for ranges, what in ((self.initial_set, "a start"), (self.state_bounds, "states")):
            if ranges is not None:
                each = [f"{name} {_range(value, plant.units.get(name, ''))}" for name, value in ranges.items()]
                phrases.append(f"{what} with {_enough(each, 'each state within its bound')}")
        if self.initial_error is not None:
            size = shown(float(f"{self.initial_error:.6g}"))
            phrases.append(f"an observer's error at the start {f'within {size}' if self.initial_error else 'of zero'}")
        return phrases

    def _noise(self) -> str:
        """Return the phrase on the noise: the largest value at each sensor, where each has its own."""
        plant, times = self.plant, "its bounds" if self.noise_as_bounds else deviations_told(self.noise_bound)
        sizes = self.noise_bound * np.abs(plant.Dw).sum(axis=1)
        each = [
            f"{shown(float(f'{size:.6g}'), plant.units.get(name, ''))} at {name}"
            for name, size in zip(plant.output_names, sizes, strict=True)
            if size > 0.0
        ]
        process = bool(plant.Bw.any())
        if not each or len(each) > MOST_LISTED or process:
            return f"noise within {times}"
        return f"sensor noise within {times} ({', '.join(each)})"

    @property
    def bounds_phrase(self) -> str:
        """All bounds in one phrase; empty where there are none."""
        return _joined(self.parts())

    def phrase(self) -> str:
        """Return everything that is assumed in one phrase."""
        return _joined([*self.parts(), "an exact model" if self.box is None else self.box.phrase])


def _joined(parts: Sequence[str]) -> str:
    return f"{', '.join(parts[:-1])}, and {parts[-1]}" if len(parts) > 1 else "".join(parts)


def _range(value: Any, unit: str) -> str:
    if isinstance(value, (list, tuple, np.ndarray)):
        low, high = (float(end) for end in value)
        return f"at {shown(low, unit)}" if low == high else f"in {shown(low)} .. {shown(high, unit)}"
    return f"within {shown(value, unit)}"


def _listed(bounds: Mapping[str, Any]) -> dict[str, Any]:
    """Return bounds of states as plain data."""
    pairs = {
        name: [float(end) for end in value] if isinstance(value, (list, tuple, np.ndarray)) else float(value)
        for name, value in bounds.items()
    }
    return dict(sorted(pairs.items()))


def _enough(each: Sequence[str], otherwise: str) -> str:
    return ", ".join(each) if len(each) <= MOST_LISTED else f"{otherwise} ({len(each)})"


@dataclass(frozen=True)
class LogReference:
    """A log by its name and digest, and how its columns were read."""

    name: str
    sha256: str
    columns: tuple[tuple[str, str], ...] = ()
    scales: tuple[tuple[str, float], ...] = ()

    @classmethod
    def of(cls, path: Path, columns: Mapping[str, str] | None, scales: Mapping[str, float] | None) -> LogReference:
        """Return the log in a file."""
        return cls(
            path.name,
            file_digest(path),
            tuple(sorted((columns or {}).items())),
            tuple(sorted((name, float(value)) for name, value in (scales or {}).items())),
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, as `from_dict` reads it."""
        return {"name": self.name, "sha256": self.sha256, "columns": dict(self.columns), "scales": dict(self.scales)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> LogReference:
        """Return the log that `as_dict` described."""
        return cls(
            str(data["name"]),
            str(data["sha256"]),
            tuple(sorted(data["columns"].items())),
            tuple(sorted((name, float(value)) for name, value in data["scales"].items())),
        )


def file_digest(path: Path) -> str:
    """Return the sha256 of a file's bytes."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise SpecError(f"{path} cannot be read: {error.strerror}.", path=str(path)) from error
