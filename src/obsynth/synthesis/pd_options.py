"""The options of the PD observer: what may be asked, and which of it is proved impossible before a solver runs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from obsynth.analysis.pd_augmentation import with_sensor_noise
from obsynth.analysis.structure import analyse_structure
from obsynth.errors import InfeasibleError, SpecError
from obsynth.models.descriptor import DescriptorSystem
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.ranks import NEGLIGIBLE_MODE, decide_rank
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.synthesis.lmi import SOLVER_SETTINGS

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


#: Damping ratio from which a mode dies out by itself.
WELL_DAMPED = 0.5
#: Well-damped modes this many times faster than the plant's pace are none of the observer's business.
FAR_BEYOND = 100.0


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


def fastest_mode(a: FloatArray) -> float:
    """Return the largest modulus of an eigenvalue that an observer has to follow, 1/seconds.

    A well-damped mode far beyond all others (that of a sensor, say) is left aside: it dies out by itself.  1 for a
    plant of integrators, which has no time scale.
    """
    from scipy.linalg import matrix_balance

    balanced = matrix_balance(a, permute=False)[0]
    modes = np.linalg.eigvals(balanced)
    sizes = np.abs(modes)
    if not np.max(sizes) > NEGLIGIBLE_MODE * float(np.linalg.norm(balanced, 2)):
        return 1.0
    damped = modes.real < -WELL_DAMPED * sizes
    # What is not damped sets the pace; where all is damped or at rest, the slowest mode does.
    pace = float(np.max(sizes[~damped], initial=0.0))
    if pace <= NEGLIGIBLE_MODE * float(np.max(sizes)):
        pace = float(np.min(sizes[damped]))
    return float(np.max(sizes[(sizes <= FAR_BEYOND * pace) | ~damped]))


def default_delta(plant: DescriptorSystem, asked: PdOptions, decay: float) -> float:
    """Return the delta to use, in seconds: as asked, or the inverse of the plant's fastest mode where that serves."""
    if asked.delta is not None:
        return float(asked.delta)
    if asked.disk_numbers is not None:
        centre, radius = asked.disk_numbers
        return 1.0 / centre if centre > 0.0 else 2.0 / (centre + radius)
    delta = 1.0 / fastest_mode(plant.A)
    limit = theorem_2_limit(plant, decay) if asked.theorem == 2 else math.inf
    return min(delta, 0.5 * limit)


def theorem_2_limit(plant: DescriptorSystem, decay: float) -> float:
    """Return the delta from which Theorem 2 has no solution: the least ``4 |sigma| / w^2`` of an unobservable pair."""
    pairs = [mode for mode in analyse_structure(plant).unobservable_modes if mode.imag > 0.0]
    return min((4.0 * abs(mode.real + decay) / mode.imag**2 for mode in pairs), default=math.inf)


def require_possible(plant: DescriptorSystem, asked: PdOptions, *, delta: float, decay: float) -> None:
    """Refuse what no gains, or no solution of these inequalities, can give.

    Raises
    ------
    InfeasibleError
        With the number that decides.
    """
    hidden = analyse_structure(plant).unobservable_modes
    slowest = max((mode.real for mode in hidden), default=-math.inf)
    if -slowest <= decay:
        raise InfeasibleError(
            f"No observer reaches a decay rate of {decay:.6g} 1/s: the mode with real part {slowest:.6g} never shows "
            "in the outputs and keeps its own pace. Ask for less, or measure something it moves.",
            necessary=True,
        )
    if asked.disk_numbers is not None:
        _require_disk(asked.disk_numbers, hidden, delta)
    limit = theorem_2_limit(plant, decay) if asked.theorem == 2 else math.inf
    if delta >= limit:
        raise InfeasibleError(
            f"Theorem 2 has no solution with delta = {delta:.6g} s: an unobservable pair of modes needs delta < "
            f"4 |sigma| / w^2 = {limit:.6g} s. Lower delta, or use theorem 1, which does not depend on it.",
            necessary=False,
            lower_bound=None,
        )
    if asked.noise_gain is not None:
        least = least_noise_gain(plant)
        if asked.noise_gain <= least:
            raise InfeasibleError(
                f"No observer has a noise gain of {asked.noise_gain:.6g}: already at standstill the fault has to be "
                f"read from the outputs, which multiplies errors by {least:.6g} or more. Raise noise_gain.",
                necessary=True,
                lower_bound=least,
            )


def _require_disk(disk: tuple[float, float], hidden: tuple[complex, ...], delta: float) -> None:
    centre, radius = disk
    outside = [mode for mode in hidden if abs(mode + centre) >= radius]
    if outside:
        raise InfeasibleError(
            f"No observer has all its eigenvalues within {radius:.6g} of {-centre:.6g}: the mode {outside[0]:.6g} "
            "never shows in the outputs and stays where it is.",
            necessary=True,
        )
    if abs(-1.0 / delta + centre) >= radius:
        raise InfeasibleError(
            f"The inequality for the disk has no solution with delta = {delta:.6g} s: -1/delta must lie inside the "
            f"disk. Leave delta out, or take {1.0 / centre if centre > 0.0 else 2.0 / (centre + radius):.6g} s.",
            necessary=False,
        )


def least_noise_gain(plant: DescriptorSystem) -> float:
    """Return a lower bound on the gain from constant sensor noise to the fault estimate, for any unbiased observer.

    At standstill every pair ``A x + Bf f = 0`` must be read correctly from ``C x + Df f``; the least linear map that
    does so is taken.  Zero where sensor noise alone does not reach every output.
    """
    noisy = with_sensor_noise(plant)
    noise = noisy.Dw[:, ~np.any(noisy.Bw != 0.0, axis=0)]
    if not decide_rank(noise, expected=plant.ny).full:
        return 0.0
    equations = np.hstack([plant.A, plant.Bf])
    scaled = equilibrate_pencil(np.zeros_like(equations), equations)
    rank = decide_rank(scaled.A, equilibrated=False).rank
    still = scaled.columns[:, None] * np.linalg.svd(scaled.A)[2][rank:].T
    seen, faults = np.hstack([plant.C, plant.Df]) @ still, still[plant.nx :]
    return float(np.linalg.norm(faults @ np.linalg.pinv(np.linalg.pinv(noise) @ seen), 2)) if still.size else 0.0
