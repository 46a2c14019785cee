"""What the second stage asks of a filter, by its true gain, its true variance and its spectral radius."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from obsynth.methods.fault_estimation_filter.injection_problem import GainProblem, Injection
from obsynth.numerics.norms import spectral_radius


@dataclass(frozen=True, eq=False)
class Goal:
    """What a filter must meet, and what it shall cost little of.

    Fields: problem: In the original coordinates; gain: Bound on the true gain; slowest: Spectral radius above which a
    filter forgets too slowly; judged: Filters that were asked for before, by identity.
    """

    problem: GainProblem
    gain: float
    slowest: float
    judged: dict[int, tuple[Injection, bool]] = field(default_factory=dict, repr=False)

    @property
    def noisy(self) -> bool:
        """Whether noise is the cost, or the size of the gains."""
        return self.problem.states_noise

    def at(self, gain: float) -> Goal:
        """Return the goal at another level."""
        return replace(self, gain=gain, judged={})

    def met(self, injection: Injection) -> bool:
        """Return whether the true gain is within the level, and the weight within its limit."""
        # A filter is asked for more than once, and for many states each answer takes a Riccati equation.
        if id(injection) not in self.judged:
            self.judged[id(injection)] = (injection, _reaches(self.problem, injection, self.gain))
        return self.judged[id(injection)][1]

    def is_fast(self, injection: Injection) -> bool:
        """Return whether the filter forgets fast enough."""
        return radius(self.problem, injection) <= self.slowest

    def met_fast(self, injection: Injection) -> bool:
        """Return both."""
        return self.is_fast(injection) and self.met(injection)

    def cost(self, injection: Injection) -> float:
        """Return the variance under the noise, or the size of the gains."""
        if self.noisy:
            return self.problem.noise_variance(injection)
        return float(np.linalg.norm(np.vstack([injection.R, injection.V])))


def radius(problem: GainProblem, injection: Injection) -> float:
    """Return the spectral radius of the closed loop."""
    return spectral_radius(problem.closed_loop(injection)[0])


def _reaches(problem: GainProblem, injection: Injection, gain: float) -> bool:
    limit = problem.weight_limit
    if limit is not None and float(np.linalg.norm(limit.fixed + injection.V @ limit.free, 2)) > limit.bound:
        return False
    if problem.disturbances == 0:
        return radius(problem, injection) < 1.0
    return problem.reaches(injection, gain)
