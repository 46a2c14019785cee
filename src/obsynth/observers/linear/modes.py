"""Modes of a linear observer: poles, settling time, frequencies that matter, variances of its rows."""

from __future__ import annotations

import math

import numpy as np

from obsynth.numerics.arguments import real_number
from obsynth.numerics.arrays import ComplexArray, FloatArray, read_only, remembered
from obsynth.numerics.continuous import first_order_hold
from obsynth.numerics.modal_response import Modes
from obsynth.numerics.spectra import abscissa, eigenvalues, speeds
from obsynth.observers.linear.observer import LinearObserver

#: From so many states on eigenvectors are worth to be found with the eigenvalues: more than one check wants them.
STATES_FOR_ALL_MODES = 200

#: The initial-condition response has settled when its slowest mode has decayed to this share.
SETTLED_TO = 0.02

#: Steps in which an initial-condition response is followed: when it has settled is known to a thousandth of the
#: settling time of the slowest mode, more than is printed.
REST_STEPS = 1000

#: Waiting for that ends with a sample that rounding, of this share of dt, calls earlier.
SETTLING_SLACK = 1e-6

#: Squarings after which powers of a stable matrix are below rounding, whatever its modes.
MOST_SQUARINGS = 64

#: Frequencies of the grid, and how far it reaches beyond the slowest and the fastest pole of the observer.
RESPONSE_POINTS = 61

GRID_REACH = 30.0


@remembered
def modes_of(observer: LinearObserver) -> Modes:
    """Return the modes of a shipped ``Az``."""
    modes = Modes.of(observer.Az)
    for part in modes:
        part.setflags(write=False)
    return modes


@remembered
def poles_of(observer: LinearObserver) -> ComplexArray:
    """Return the eigenvalues of a shipped ``Az``."""
    if observer.order >= STATES_FOR_ALL_MODES:
        return modes_of(observer).values
    return read_only(eigenvalues(observer.Az), np.complex128)


def is_stable(observer: LinearObserver) -> bool:
    """Whether computed poles lie strictly inside the region of stability."""
    if not np.all(np.isfinite(observer.Az)):
        return False
    poles = poles_of(observer)
    return bool(np.all(np.abs(poles) < 1.0) if observer.dt > 0.0 else np.all(poles.real < 0.0))


def transient(observer: LinearObserver) -> float:
    """Return the settling time of an observer in seconds: after it the slowest mode has decayed to `SETTLED_TO` in the
    estimates, which are as late as their delays."""
    return settling_of_modes(observer) + observer.dt * max((*observer.state_delays, *observer.fault_delays), default=0)


def settling_of_modes(observer: LinearObserver) -> float:
    """Return after how many seconds the slowest mode has decayed to `SETTLED_TO`."""
    if observer.order == 0:
        return 0.0
    slowest = abscissa(observer.Az, observer.dt)
    if observer.dt == 0.0:
        return math.log(SETTLED_TO) / slowest if slowest < 0.0 else math.inf
    if slowest >= 1.0:
        return math.inf
    samples = math.ceil(math.log(SETTLED_TO) / math.log(slowest)) if slowest > 0.0 else 0
    return observer.dt * max(samples, _steps_remembered(observer.Az))


def _steps_remembered(Az: FloatArray) -> int:
    """Return the number of states; where these are registers that pass samples on, the longest chain of them."""
    if np.tril(Az).any():
        return len(Az)
    passes, reached, steps = Az != 0.0, np.ones(len(Az), dtype=bool), 0
    while reached.any():
        reached, steps = np.asarray(passes @ reached), steps + 1
    return steps


def settling_from_rest(observer: LinearObserver, v: FloatArray, deviations: FloatArray) -> float:
    """Return after how many seconds fault estimates and residuals of an observer that starts at zero are as if it had
    started at rest.

    Where inputs and outputs ``v (nu + ny,)`` are constant, the difference is the response to that initial condition: it
    has settled when it is, in every row, below ``deviations (rows,)`` of noise, or below `SETTLED_TO` of its largest
    value.  Infinite where the observer has no state of rest.
    """
    rows = observer.Cz[len(observer.state_names) :]
    late = observer.dt * max((*observer.state_delays, *observer.fault_delays), default=0)
    if not (observer.order and len(rows)):
        return late
    at_rest = np.eye(observer.order) * (observer.dt > 0.0) - observer.Az
    try:
        z = np.linalg.solve(at_rest, np.hstack([observer.Bu, observer.By]) @ v)
    except np.linalg.LinAlgError:
        return math.inf
    longest = settling_of_modes(observer)
    if not (np.isfinite(z).all() and math.isfinite(longest)):
        return math.inf
    step = longest / REST_STEPS
    if observer.dt > 0.0:
        samples = max(1, math.ceil(step / observer.dt))
        step, transition = samples * observer.dt, np.linalg.matrix_power(observer.Az, samples)
    else:
        transition = first_order_hold(observer.Az, np.zeros((observer.order, 1)), step)[0]
    responses = [rows @ z]
    for _ in range(REST_STEPS):
        z = transition @ z
        responses.append(rows @ z)
    sizes = np.abs(responses)
    over = (sizes > np.maximum(deviations, SETTLED_TO * sizes.max(axis=0))).any(axis=1)
    return late + step * (int(np.flatnonzero(over)[-1]) + 1 if over.any() else 0)


def noise_variances(observer: LinearObserver, noise: FloatArray) -> FloatArray:
    """Return stationary variances of the rows ``(rows,)`` of a sampled observer whose outputs have white noise
    ``noise (ny, any)`` of unit covariance; zero where there is none, or where they have no limit."""
    into, through = observer.By @ noise, observer.Dy @ noise
    covariance, power = into @ into.T, observer.Az
    with np.errstate(all="ignore"):
        for _ in range(MOST_SQUARINGS):
            more = power @ covariance @ power.T
            if not np.abs(more).max(initial=0.0) > np.finfo(float).eps * np.abs(covariance).max(initial=0.0):
                break
            covariance, power = covariance + more, power @ power
        variances = np.einsum("ij,jk,ik->i", observer.Cz, covariance, observer.Cz) + (through**2).sum(axis=1)
    return np.where(np.isfinite(variances), variances, 0.0)


def checked_warm_up(stated: float | None, default: float) -> float:
    """Return the warm-up in seconds."""
    return default if stated is None else real_number(stated, "warm_up", "seconds, 0 or more", least=0.0)


def frequency_grid(observer: LinearObserver) -> FloatArray:
    """Return frequencies in rad/s around the poles of an observer, zero included; up to pi/dt in discrete time."""
    frequencies = speeds(poles_of(observer), observer.dt) if observer.order else np.ones(1)
    alive = frequencies[np.isfinite(frequencies) & (frequencies > 0.0)]
    low = float(np.min(alive, initial=1.0 if not alive.size else np.inf)) / GRID_REACH
    high = float(np.max(alive, initial=1.0 if not alive.size else 0.0)) * GRID_REACH
    if observer.dt > 0.0:
        high = np.pi / observer.dt
        low = min(low, high / GRID_REACH)
    return np.concatenate([[0.0], np.geomspace(low, high, RESPONSE_POINTS)])
