"""Gains with all poles in a region (M. Chilali, P. Gahinet, IEEE TAC 41, 1996) and a small variance of estimates."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.conditions import lazy_cvxpy as cp
from obsynth.conditions import lmi
from obsynth.errors import SolverError
from obsynth.methods.engines.kalman_problem import KalmanProblem
from obsynth.numerics.arrays import SMALLEST, FloatArray, largest_singular_value
from obsynth.numerics.matrix_equations import continuous_lyapunov, discrete_lyapunov
from obsynth.numerics.regions import NamedRegion
from obsynth.numerics.spectra import eigenvalues

#: The inequalities use a region that is smaller by this share: a solution on its boundary is then inside the region.
INNER_SHARE = 1e-3

#: Weight of all states in the objective, relative to the estimates: without it some directions of P have no cost.
STATE_WEIGHT = 1e-3

#: The Lyapunov matrix is at least this multiple of the identity, in scaled states.
LEAST_LYAPUNOV = 1e-6

#: For plants with more states the inequality moves only those poles that a Kalman gain leaves outside the region.
MOST_MOVED_STATES = 20


def region_gain(problem: KalmanProblem, region: NamedRegion, *, solver: str) -> tuple[FloatArray, dict[str, Any]]:
    """Return K ``(n, ny)`` with the poles of ``F - K C`` in the region, and the solver's record.

    Among such gains K keeps the variance of the estimates small.  Above `MOST_MOVED_STATES` states a Kalman gain with
    the decay rate of the region is tried first; where it is enough, the record is empty.
    """
    n, dt = problem.F.shape[0], problem.dt
    if n == 0:
        return np.zeros((0, problem.C.shape[0])), {}
    # Each way finds gains for some plants for which the other fails.
    attempts = (
        [_by_moving_outer_poles, _by_inequality] if n > MOST_MOVED_STATES else [_by_inequality, _by_moving_outer_poles]
    )
    failures: list[SolverError] = []
    for attempt in attempts:
        try:
            gain, record = attempt(problem, region, solver=solver)
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
    raise failures[attempts.index(_by_inequality)]


def _by_moving_outer_poles(
    problem: KalmanProblem, region: NamedRegion, *, solver: str
) -> tuple[FloatArray, dict[str, Any]]:
    """Return a Kalman gain with the decay rate of the region, changed so that its outer poles move into the region.

    With ``F - K C = V diag(T1, T2) V^-1``, where T1 has the poles inside, adding ``V [0; K2]`` to the gain keeps T1
    and replaces T2 by ``T2 - K2 C V2``.
    """
    from scipy.linalg import schur, solve_sylvester

    gain = problem.gain((1.0 + INNER_SHARE) * region.decay)
    if gain is None:
        raise SolverError("The Riccati equation has no usable solution: give poles=, or a slower region.")
    inner = region.shrunk(0.5 * INNER_SHARE)
    triangular, turn, good = schur(
        problem.F - gain @ problem.C, output="real", sort=lambda re, im: inner.holds([complex(re, im)], problem.dt)
    )
    if good == len(triangular):
        return gain, {}
    first, mixed, second = triangular[:good, :good], triangular[:good, good:], triangular[good:, good:]
    apart = np.vstack([solve_sylvester(first, -second, -mixed), np.eye(len(second))])
    moved, rows = turn @ apart, turn[:, good:].T
    remaining = replace(
        problem,
        F=second,
        C=problem.C @ moved,
        B=rows @ (problem.B - gain @ problem.D),
        drive=rows @ problem.drive,
        estimates=problem.estimates @ moved,
    )
    more, record = _by_inequality(remaining, region, solver=solver)
    return np.asarray(gain + moved @ more), record


def _by_inequality(problem: KalmanProblem, region: NamedRegion, *, solver: str) -> tuple[FloatArray, dict[str, Any]]:
    """Return a gain from the matrix inequalities of the region with the least bound on the variance of estimates."""
    n, dt = problem.F.shape[0], problem.dt
    change = _scaling(problem, region)
    inverse = np.linalg.inv(change)
    f, c = inverse @ problem.F @ change, problem.C @ change
    estimates = problem.estimates @ change
    # The process noise `drive`, which makes a Kalman filter fast, is left out: here the region demands the speed.
    driving = inverse @ np.hstack([problem.B, np.zeros((n, problem.background.shape[1]))])
    direct = np.hstack([problem.D, problem.background])
    size = max(largest_singular_value(estimates), SMALLEST)
    weight = estimates.T @ estimates / size**2 + STATE_WEIGHT * np.eye(n)
    p, y = lmi.symmetric_variable(n), lmi.matrix_variable(n, c.shape[0])
    z = lmi.symmetric_variable(driving.shape[1])
    moved = p @ f - y @ c
    noise = p @ driving - y @ direct
    constraints = [
        lmi.at_least(p, LEAST_LYAPUNOV),
        lmi.at_least(lmi.symmetric_blocks([[z], [noise, p]])),
    ]
    if dt > 0.0:
        radius = float(np.exp(-region.decay * dt)) * (1.0 - INNER_SHARE * min(1.0, region.decay * dt))
        constraints += [
            lmi.at_least(lmi.symmetric_blocks([[p - weight], [moved, p]])),
            lmi.at_least(lmi.symmetric_blocks([[radius * p], [moved, radius * p]])),
        ]
    else:
        constraints.append(lmi.at_most(moved + moved.T + weight, 0.0))
        constraints += _continuous_region(region, p, moved)
    record = lmi.minimise(cp.trace(z), constraints, what="poles in a region", solver=solver)
    return np.asarray(change @ np.linalg.solve(lmi.value_of(p), lmi.value_of(y))), record


def _continuous_region(region: NamedRegion, p: Any, moved: Any) -> list[Any]:
    constraints = []
    if region.decay:
        constraints.append(lmi.at_most(moved + moved.T + 2.0 * region.decay * (1.0 + INNER_SHARE) * p, 0.0))
    if region.radius is not None:
        radius = region.radius * (1.0 - INNER_SHARE)
        constraints.append(lmi.at_least(lmi.symmetric_blocks([[radius * p], [moved, radius * p]])))
    if region.damping is not None:
        cosine = min(region.damping * (1.0 + INNER_SHARE), 1.0)
        sine = float(np.sqrt(1.0 - cosine**2))
        damped, turned = sine * (moved + moved.T), cosine * (moved.T - moved)
        constraints.append(lmi.at_most(lmi.symmetric_blocks([[damped], [turned, damped]]), 0.0))
    return constraints


def _scaling(problem: KalmanProblem, region: NamedRegion) -> FloatArray:
    """Return a change of state in which the error covariance of a Kalman filter of the same rate is the identity."""
    gain = problem.gain(region.decay)
    if gain is None:
        return np.eye(problem.F.shape[0])
    closed, driving = problem.F - gain @ problem.C, problem.B - gain @ problem.D
    noise = driving @ driving.T + problem.drive @ problem.drive.T
    noise = noise + gain @ problem.background @ problem.background.T @ gain.T
    with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):
        # A poor scaling is no error: the solver may still find a gain, and the poles are checked.
        if problem.dt > 0.0:
            radius = np.exp(-region.decay * problem.dt)
            covariance = discrete_lyapunov(closed / radius, noise)
        else:
            covariance = continuous_lyapunov(closed + region.decay * np.eye(len(closed)), -noise)
    if not np.all(np.isfinite(covariance)):
        return np.eye(len(closed))
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if values[-1] <= 0.0:
        return np.eye(len(closed))
    floor = float(np.finfo(np.float64).eps) * values[-1]
    return np.asarray(vectors * np.sqrt(np.maximum(values, floor)))
