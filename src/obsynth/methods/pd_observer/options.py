"""The options of the PD observer: what may be asked."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.conic.lmi import SOLVER_SETTINGS
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.ranks import decide_rank

#: How gains are found: from the whole inequality, from the smaller one without the gains, or in closed form.
ENGINES = ("auto", "lmi", "reduced-lmi", "riccati")
ENGINES_OF_STABILITY = ("reduced-lmi", "riccati")
#: Up to so many unknown states "auto" takes the first (a second or two); up to so many it tries the second where the
#: third does not serve.
MOST_STATES_FOR_LMI = 20
MOST_STATES_FOR_REDUCED_LMI = 50


@dataclass(frozen=True)
class PdOptions:
    """Options of the method as asked for; see `obsynth.pd_observer`."""

    theorem: int = 1
    delta: float | None = None
    decay: float | None = None
    disk: Any = None
    gain_bound: float | None = None
    fault_rate_gain: float | None = None
    noise_gain: float | None = None
    adaptation_gain: Any = None
    adaptation_range: Any = None
    delta_scan: Any = None
    engine: str = "auto"
    solver: str = "CLARABEL"
    problems: list[str] = field(default_factory=list, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.theorem not in (1, 2) or isinstance(self.theorem, bool):
            self.problems.append(f"theorem is {self.theorem!r}: use 1 or 2.")
        for name in ("delta", "gain_bound", "fault_rate_gain", "noise_gain"):
            self._require_positive(name)
        if self.decay is not None and not (_is_number(self.decay) and self.decay >= 0.0):
            self.problems.append(f"decay is {self.decay}: give 0 or a positive number in 1/seconds.")
        if self.solver not in SOLVER_SETTINGS:
            self.problems.append(f"solver is {self.solver!r}: use one of {', '.join(SOLVER_SETTINGS)}.")
        if self.engine not in ENGINES:
            self.problems.append(f"engine is {self.engine!r}: use one of {', '.join(ENGINES)}.")
        elif self.engine in ENGINES_OF_STABILITY and self.further:
            self.problems.append(
                f"engine {self.engine!r} gives stability and a decay rate alone: take engine 'lmi', or leave out "
                f"{', '.join(self.further)}."
            )
        disk = self._numbers("disk", 2)
        if disk is not None and not disk[1] > max(-disk[0], 0.0):
            self.problems.append(
                f"disk is {disk}: give [c, r] for |s + c| < r, with r > 0 and part of the disk left of the axis."
            )
        low_high = self._numbers("adaptation_range", 2)
        if low_high is not None and not 0.0 < low_high[0] < low_high[1]:
            self.problems.append(f"adaptation_range is {low_high}: give [low, high] with 0 < low < high.")
        scanned = self._numbers("delta_scan", None)
        if scanned is not None and not all(value > 0.0 for value in scanned):
            self.problems.append(f"delta_scan is {scanned}: give positive numbers of seconds.")
        others = ("disk", "gain_bound", "fault_rate_gain", "noise_gain", "adaptation_gain")
        clash = [name for name in others if getattr(self, name) is not None]
        if low_high is not None and clash:
            self.problems.append(f"adaptation_range cannot be combined with {', '.join(clash)}.")
        if self.problems:
            raise SpecError("Options of pd-observer:", path="method.options", problems=self.problems)

    def _require_positive(self, name: str) -> None:
        value = getattr(self, name)
        if value is not None and not (_is_number(value) and value > 0.0):
            self.problems.append(f"{name} is {value}: give a positive number.")

    def _numbers(self, name: str, count: int | None) -> tuple[float, ...] | None:
        """Return an option that is a list of numbers; note what is wrong with it."""
        value = getattr(self, name)
        if value is None:
            return None
        wanted = f"{count} numbers" if count else "one number or more"
        try:
            row = as_matrix(np.atleast_2d(np.asarray(value)), name)
        except (SpecError, ValueError):
            self.problems.append(f"{name} is {value!r}: give a list of {wanted}.")
            return None
        if row.shape[0] != 1 or row.size == 0 or (count is not None and row.size != count):
            self.problems.append(f"{name} is {value!r}: give a list of {wanted}.")
            return None
        return tuple(map(float, row[0]))

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


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float, np.floating, np.integer)) and bool(np.isfinite(value))


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
