"""Gains that put all poles into a region (M. Chilali, P. Gahinet, IEEE TAC 41, 1996), with little noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from obsynth.conditions.atoms import region as region_of
from obsynth.errors import SolverError, SpecError
from obsynth.methods.conic import lmi
from obsynth.methods.placement.kalman import KalmanProblem
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import SMALLEST, FloatArray, largest_singular_value
from obsynth.numerics.regions import LMIRegion, disk, half_plane, sector
from obsynth.numerics.spectra import eigenvalues

#: The inequalities are asked for a region smaller by this share, so that a solution on its boundary still counts.
INNER_SHARE = 1e-3
#: Weight of the states beside the estimates in what is minimised, so that no direction is free.
STATE_WEIGHT = 1e-3
#: The matrix of the Lyapunov function stays above this multiple of the identity, in scaled states.
LEAST_LYAPUNOV = 1e-6
#: A sector of damping one is empty: that of so much is as good as the negative real axis.
LARGEST_DAMPING = 1.0 - 1e-12
#: Above this many states the inequality moves only those poles that a Kalman gain leaves outside the region.
MOST_MOVED_STATES = 20


@dataclass(frozen=True)
class Region:
    """Where all movable poles must lie; ``radius`` and ``damping`` in continuous time only."""

    decay: float = 0.0  # every mode decays at least as exp(-decay t)
    radius: float | None = None  # abs(s) <= radius
    damping: float | None = None  # least ratio, 0 to 1

    @classmethod
    def of(cls, data: Mapping[str, Any], dt: float) -> Region:
        """Return a checked region."""
        known = [field.name for field in fields(cls)]
        problems = [f"unknown key {key!r}; there are: {', '.join(known)}." for key in data if key not in known]
        for key, value in data.items():
            if key in known and (not is_finite_number(value) or value < 0.0 or (key != "decay" and value == 0.0)):
                problems.append(f"{key} is {value!r}: give a positive number.")
        if not problems:
            found = cls(**data)
            if found.damping is not None and found.damping >= 1.0:
                problems.append(f"damping is {found.damping}: give a ratio below 1.")
            if found.radius is not None and found.radius <= found.decay:
                problems.append(f"the region is empty: radius {found.radius} is not above decay {found.decay}.")
            if dt > 0.0 and (found.radius is not None or found.damping is not None):
                problems.append("radius and damping are for continuous time: give decay alone.")
        if problems or not data:
            raise SpecError(
                "Option region of ui-pi-observer:",
                path="method.options.region",
                problems=problems or ["give at least one of decay, radius, damping."],
            )
        return cls(**data)

    def in_time(self, unit: float) -> Region:
        """Return the region with rates per ``unit`` (seconds) instead of per second."""
        return replace(self, decay=unit * self.decay, radius=None if self.radius is None else unit * self.radius)

    def parts(self, dt: float, *, room: float = 0.0) -> list[LMIRegion]:
        """Return the regions whose intersection it is, each smaller by a share ``room``."""
        if dt > 0.0:
            return [disk(0.0, float(np.exp(-self.decay * dt)) * (1.0 - room * min(1.0, self.decay * dt)))]
        found = [half_plane((1.0 + room) * self.decay)] if self.decay else []
        if self.radius is not None:
            found.append(disk(0.0, (1.0 - room) * self.radius))
        if self.damping is not None:
            found.append(sector(min((1.0 + room) * self.damping, LARGEST_DAMPING)))
        return found

    def holds(self, values: Any, dt: float, *, room: float = 0.0) -> bool:
        """Whether all ``values`` lie in the region, smaller by a share ``room``, and are stable."""
        stable = [] if self.decay or dt > 0.0 else [half_plane(0.0)]
        return all(part.contains(values) for part in (*stable, *self.parts(dt, room=room)))


def region_gain(problem: KalmanProblem, region: Region, *, solver: str) -> tuple[FloatArray, dict[str, Any]]:
    """Return K ``(n, ny)`` with the poles of ``F - K C`` in the region and little noise, and the solver's record.

    Above `MOST_MOVED_STATES` states a Kalman gain of the region's rate comes first, and the record is empty where it
    is enough.
    """
    n, dt = problem.F.shape[0], problem.dt
    if n == 0:
        return np.zeros((0, problem.C.shape[0])), {}
    # What one way cannot find, the other may.
    ways = [_partly, _by_inequality] if n > MOST_MOVED_STATES else [_by_inequality, _partly]
    failures: list[SolverError] = []
    for way in ways:
        try:
            gain, record = way(problem, region, solver=solver)
        except SolverError as error:
            failures.append(error)
            continue
        if region.holds(eigenvalues(problem.F - gain @ problem.C), dt):
            return gain, record
        failures.append(
            SolverError(
                f"{solver} ended with poles outside the region: the result is inconclusive. Widen the region, or "
                "use decay= instead.",
                record=record,
            )
        )
    raise failures[ways.index(_by_inequality)]


def _partly(problem: KalmanProblem, region: Region, *, solver: str) -> tuple[FloatArray, dict[str, Any]]:
    """Move only those poles into the region that a Kalman gain of the same rate leaves outside.

    With ``F - K C = V diag(T1, T2) V^-1``, T1 inside, a gain ``V [0; K2]`` makes ``T2 - K2 C V2`` of T2.
    """
    from scipy.linalg import schur, solve_sylvester

    gain = problem.gain((1.0 + INNER_SHARE) * region.decay)
    if gain is None:
        raise SolverError("The Riccati equation has no usable solution: give poles=, or a slower region.")
    triangular, turn, good = schur(
        problem.F - gain @ problem.C,
        output="real",
        sort=lambda re, im: region.holds([complex(re, im)], problem.dt, room=0.5 * INNER_SHARE),
    )
    if good == len(triangular):
        return gain, {}
    first, mixed, second = triangular[:good, :good], triangular[:good, good:], triangular[good:, good:]
    apart = np.vstack([solve_sylvester(first, -second, -mixed), np.eye(len(second))])
    moved, rows = turn @ apart, turn[:, good:].T
    rest = replace(
        problem,
        F=second,
        C=problem.C @ moved,
        B=rows @ (problem.B - gain @ problem.D),
        drive=rows @ problem.drive,
        estimates=problem.estimates @ moved,
    )
    more, record = _by_inequality(rest, region, solver=solver)
    return np.asarray(gain + moved @ more), record


def _by_inequality(problem: KalmanProblem, region: Region, *, solver: str) -> tuple[FloatArray, dict[str, Any]]:
    n, dt = problem.F.shape[0], problem.dt
    # In states in which the errors of a Kalman filter of the same rate are alike.
    _, change = problem.solved(region.decay, np.eye(n))
    inverse = np.linalg.inv(change)
    f, c = inverse @ problem.F @ change, problem.C @ change
    estimates = problem.estimates @ change
    # The drive is left out: the region says how fast the poles must be, and less noise is what is left to ask for.
    entering = inverse @ np.hstack([problem.B, np.zeros((n, problem.background.shape[1]))])
    direct = np.hstack([problem.D, problem.background])
    size = max(largest_singular_value(estimates), SMALLEST)
    weight = estimates.T @ estimates / size**2 + STATE_WEIGHT * np.eye(n)
    p, y = lmi.symmetric_variable(n), lmi.matrix_variable(n, c.shape[0])
    z = lmi.symmetric_variable(entering.shape[1])
    moved = p @ f - y @ c
    noise = p @ entering - y @ direct
    constraints = [
        lmi.at_least(p, LEAST_LYAPUNOV),
        lmi.at_least(lmi.symmetric_blocks([[z], [noise, p]])),
    ]
    if dt > 0.0:
        constraints.append(lmi.at_least(lmi.symmetric_blocks([[p - weight], [moved, p]])))
    else:
        constraints.append(lmi.at_most(moved + moved.T + weight, 0.0))
    constraints += [region_of(f, p, part, Y=y, Cy=c, margin=0.0)[1] for part in region.parts(dt, room=INNER_SHARE)]
    record = lmi.minimise(lmi.trace(z), constraints, what="poles in a region", solver=solver)
    return np.asarray(change @ np.linalg.solve(lmi.value_of(p), lmi.value_of(y))), record
