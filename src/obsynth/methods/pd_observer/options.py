"""The options of the PD observer: what may be asked."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.method_spec import MethodOptions
from obsynth.numerics.arguments import NonNegative, Positive, WrittenAs
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.ranks import decide_rank

#: Engines for stability and a decay rate alone.
ENGINES_OF_STABILITY = ("reduced-lmi", "riccati")
#: Up to so many unknown states "auto" takes the first (a second or two); up to so many it tries the second where the
#: third does not serve.
MOST_STATES_FOR_LMI = 20
MOST_STATES_FOR_REDUCED_LMI = 50


@dataclass(frozen=True)
class PdOptions(MethodOptions):
    """Options of the method as asked for; see `obsynth.pd_observer`."""

    METHOD: ClassVar[str] = "pd-observer"

    theorem: Literal[1, 2] = 1
    delta: Positive | None = None
    decay: NonNegative | None = None
    disk: Annotated[Any, WrittenAs("pair")] = None
    gain_bound: Positive | None = None
    fault_rate_gain: Positive | None = None
    noise_gain: Positive | None = None
    adaptation_gain: Annotated[Any, WrittenAs("matrix")] = None
    adaptation_range: Annotated[Any, WrittenAs("pair")] = None
    delta_scan: Annotated[Any, WrittenAs("positive numbers")] = None
    engine: Literal["auto", "lmi", "reduced-lmi", "riccati"] = "auto"
    solver: Literal["CLARABEL", "SCS"] = "CLARABEL"

    def conflicts(self) -> Iterator[str]:
        """Yield a sentence for each rule across options, or for lists of numbers, that is broken."""
        if self.engine in ENGINES_OF_STABILITY and self.further:
            yield (
                f"engine {self.engine!r} gives stability and a decay rate alone: take engine 'lmi', or leave out "
                f"{', '.join(self.further)}."
            )
        yield from self._broken_lists()
        others = ("disk", "gain_bound", "fault_rate_gain", "noise_gain", "adaptation_gain")
        clash = [name for name in others if getattr(self, name) is not None]
        if self.adaptation_range is not None and clash:
            yield f"adaptation_range cannot be combined with {', '.join(clash)}."

    def _broken_lists(self) -> Iterator[str]:
        wanted = {"disk": 2, "adaptation_range": 2, "delta_scan": None}
        found = {name: _numbers(getattr(self, name), count) for name, count in wanted.items()}
        for name, numbers in found.items():
            if getattr(self, name) is not None and numbers is None:
                count = wanted[name] or "one number or more"
                yield f"{name} is {getattr(self, name)!r}: give a list of {count}{' numbers' if wanted[name] else ''}."
        disk, low_high, scanned = found["disk"], found["adaptation_range"], found["delta_scan"]
        if disk is not None and not disk[1] > max(-disk[0], 0.0):
            yield f"disk is {disk}: give [c, r] for |s + c| < r, with r > 0 and part of the disk left of the axis."
        if low_high is not None and not 0.0 < low_high[0] < low_high[1]:
            yield f"adaptation_range is {low_high}: give [low, high] with 0 < low < high."
        if scanned is not None and not all(value > 0.0 for value in scanned):
            yield f"delta_scan is {scanned}: give positive numbers of seconds."

    @property
    def further(self) -> tuple[str, ...]:
        """What is asked besides stability and a decay rate: the whole inequality alone can give it."""
        names = ("disk", "gain_bound", "fault_rate_gain", "noise_gain", "adaptation_range")
        return tuple(name for name in names if getattr(self, name) is not None)

    def engines_for(self, states: int) -> tuple[str, ...]:
        """Return the engine for this many unknown states (of plant and faults), and those to take if it fails."""
        if self.further or self.engine == "lmi" or (self.engine == "auto" and states <= MOST_STATES_FOR_LMI):
            return ("lmi",) if self.further else ("lmi", "riccati")
        if self.engine == "auto":
            return ("riccati", "reduced-lmi") if states <= MOST_STATES_FOR_REDUCED_LMI else ("riccati",)
        return (self.engine,) if self.engine == "riccati" else (self.engine, "riccati")

    @property
    def disk_numbers(self) -> tuple[float, float] | None:
        """Centre c and radius r as plain numbers."""
        return None if self.disk is None else (float(self.disk[0]), float(self.disk[1]))

    @property
    def range_numbers(self) -> tuple[float, float] | None:
        """Ends of the range of adaptation gains as plain numbers."""
        if self.adaptation_range is None:
            return None
        return float(self.adaptation_range[0]), float(self.adaptation_range[1])

    def gain_matrix(self, nf: int) -> FloatArray | None:
        """Return G ``(nf, nf)``, nonsingular; ``None`` when none is asked for."""
        return None if self.adaptation_gain is None else checked_adaptation_gain(self.adaptation_gain, nf)


def _numbers(value: Any, count: int | None) -> tuple[float, ...] | None:
    """Return a list of numbers as floats; ``None`` where it is none, or not of this length."""
    if value is None:
        return None
    try:
        row = as_matrix(np.atleast_2d(np.asarray(value)), "option")
    except (SpecError, ValueError):
        return None
    fits = row.shape[0] == 1 and row.size > 0 and (count is None or row.size == count)
    return tuple(map(float, row[0])) if fits else None


def checked_adaptation_gain(value: Any, nf: int) -> FloatArray:
    """Return G as a matrix ``(nf, nf)``; raise `SpecError` when it has another shape or is singular."""
    matrix = as_matrix(value, "adaptation_gain")
    if matrix.shape == (1, 1) and nf != 1:
        matrix = float(matrix[0, 0]) * np.eye(nf)
    if matrix.shape != (nf, nf) or not decide_rank(matrix, expected=nf).full:
        raise SpecError(
            f"adaptation_gain is {matrix.shape[0]} by {matrix.shape[1]}: give a nonsingular matrix {nf} by {nf}, or "
            "one number.",
            path="method.options.adaptation_gain",
        )
    return matrix
