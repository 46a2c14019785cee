"""Observers made from a linear one: sampled, or with means of its fault estimates; how long it remembers its start, and
at which frequencies to look at it.

Means of the last fault estimates of an observer: registers behind it, and the observer without them again.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arguments import arguments_checked, real_number
from obsynth.numerics.arrays import ComplexArray, FloatArray, read_only, remembered
from obsynth.numerics.continuous import first_order_hold
from obsynth.numerics.modal_response import Modes
from obsynth.numerics.spectra import abscissa, eigenvalues, speeds
from obsynth.observers.linear.observer import LinearObserver

#: From so many states on eigenvectors are worth to be found with the eigenvalues: more than one check wants them.
STATES_FOR_ALL_MODES = 200


#: The initial-condition response has settled when its slowest mode has decayed to this share.
SETTLED_TO = 0.02

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
    found = Modes.of(observer.Az)
    for part in found:
        part.setflags(write=False)
    return found


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


@arguments_checked
def sample_observer(observer: LinearObserver, dt: float) -> LinearObserver:
    r"""Sample a continuous-time observer by a first-order hold.

    Exact for known inputs and outputs that are linear between samples: with v = [u; y],

    .. math::
        z_{k+1} = \Phi z_k + \Gamma_0 v_k + \Gamma_1 (v_{k+1} - v_k), \qquad \xi_k = z_k - \Gamma_1 v_k

    and the state that is kept is :math:`\xi`, so that no sample is needed in advance.

    Parameters
    ----------
    observer : LinearObserver
        Continuous time (``dt == 0``).
    dt : float
        Seconds between samples, positive.

    Returns
    -------
    LinearObserver
        Of the same order and with the same signals; a start at rest means ``z(0) = Gamma_1 v(0)``.

    Raises
    ------
    SpecError
        The observer is discrete in time already, or ``dt`` is not positive and finite.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=[[1, 0], [0, 1]], Bf=[[1], [0]])
    >>> observer = obsynth.sample_observer(obsynth.pd_observer(plant, decay=2.0).observer, 0.01)
    >>> observer.dt, observer.order
    (0.01, 3)
    """
    if observer.dt > 0.0:
        raise SpecError(f"The observer is discrete in time already (dt = {observer.dt:g} s).", path="dt")
    real_number(dt, "dt", "the seconds between two samples, a positive number", above=0.0)
    inputs = len(observer.input_names)
    b, d = np.hstack([observer.Bu, observer.By]), np.hstack([observer.Du, observer.Dy])
    transition, constant, ramp = first_order_hold(observer.Az, b, dt)
    into, through = transition @ ramp + constant - ramp, d + observer.Cz @ ramp
    return replace(
        observer,
        Az=transition,
        Bu=into[:, :inputs],
        By=into[:, inputs:],
        Du=through[:, :inputs],
        Dy=through[:, inputs:],
        dt=dt,
    )


def averaged(observer: LinearObserver, mean: int) -> LinearObserver:
    """Return the observer whose fault estimates are means of its last ``mean`` ones."""
    rows, order, count = observer.fault_rows, observer.order, len(observer.fault_names)
    kept = (mean - 1) * count
    az, cz = np.zeros((order + kept,) * 2), np.zeros((len(observer.Cz), order + kept))
    az[:order, :order], cz[:, :order] = observer.Az, observer.Cz
    first = slice(order, order + count)
    az[first, :order] = observer.Cz[rows]
    for j in range(1, mean - 1):
        place = slice(order + j * count, order + (j + 1) * count)
        az[place, order + (j - 1) * count : order + j * count] = np.eye(count)
    cz[rows] = cz[rows] / mean
    for j in range(mean - 1):
        cz[rows, order + j * count : order + (j + 1) * count] = np.eye(count) / mean
    below = np.zeros((kept - count, 1))

    def widened(matrix: np.ndarray, direct: np.ndarray) -> np.ndarray:
        return np.vstack([matrix, direct[rows], np.repeat(below, matrix.shape[1], axis=1)])

    du, dy = observer.Du.copy(), observer.Dy.copy()
    du[rows], dy[rows] = du[rows] / mean, dy[rows] / mean
    return replace(
        observer,
        Az=az,
        Bu=widened(observer.Bu, observer.Du),
        By=widened(observer.By, observer.Dy),
        Cz=cz,
        Du=du,
        Dy=dy,
        fault_delays=tuple(delay + (mean - 1) // 2 for delay in observer.fault_delays),
    )


def unaveraged(observer: LinearObserver, mean: int) -> LinearObserver | None:
    """Return the observer that `averaged` was given; ``None`` where this is not exactly what it makes of one."""
    rows, count = observer.fault_rows, len(observer.fault_names)
    order = observer.order - (mean - 1) * count
    if order < 0 or not all(np.all(np.isfinite(part)) for part in (observer.Az, observer.Cz, observer.Du, observer.Dy)):
        return None
    first = slice(order, order + count)
    cz, du, dy = observer.Cz[:, :order].copy(), observer.Du.copy(), observer.Dy.copy()
    cz[rows], du[rows], dy[rows] = observer.Az[first, :order], observer.Bu[first], observer.By[first]
    earlier = tuple(delay - (mean - 1) // 2 for delay in observer.fault_delays)
    if min(earlier, default=0) < 0:
        return None
    base = replace(
        observer,
        Az=observer.Az[:order, :order],
        Bu=observer.Bu[:order],
        By=observer.By[:order],
        Cz=cz,
        Du=du,
        Dy=dy,
        fault_delays=earlier,
    )
    again = averaged(base, mean)
    same = all(np.array_equal(getattr(again, n), getattr(observer, n)) for n in ("Az", "Bu", "By", "Cz", "Du", "Dy"))
    return base if same else None


def transient(observer: LinearObserver) -> float:
    """Return the settling time of an observer in seconds: after it the slowest mode has decayed to `SETTLED_TO`."""
    if observer.order == 0:
        return 0.0
    slowest = abscissa(observer.Az, observer.dt)
    if observer.dt == 0.0:
        return math.log(SETTLED_TO) / slowest if slowest < 0.0 else math.inf
    if slowest >= 1.0:
        return math.inf
    samples = math.ceil(math.log(SETTLED_TO) / math.log(slowest)) if slowest > 0.0 else 0
    return observer.dt * (
        max(samples, _steps_remembered(observer.Az)) + max((*observer.state_delays, *observer.fault_delays), default=0)
    )


def _steps_remembered(Az: FloatArray) -> int:
    """Return the number of states; where these are registers that pass samples on, the longest chain of them."""
    if np.tril(Az).any():
        return len(Az)
    passes, reached, steps = Az != 0.0, np.ones(len(Az), dtype=bool), 0
    while reached.any():
        reached, steps = np.asarray(passes @ reached), steps + 1
    return steps


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
        found = np.einsum("ij,jk,ik->i", observer.Cz, covariance, observer.Cz) + (through**2).sum(axis=1)
    return np.where(np.isfinite(found), found, 0.0)


def checked_warm_up(asked: float | None, default: float) -> float:
    """Return the warm-up in seconds."""
    return default if asked is None else real_number(asked, "warm_up", "seconds, 0 or more", least=0.0)


def frequency_grid(observer: LinearObserver) -> FloatArray:
    """Return frequencies in rad/s around the poles of an observer, zero included; up to pi/dt in discrete time."""
    found = speeds(poles_of(observer), observer.dt) if observer.order else np.ones(1)
    alive = found[np.isfinite(found) & (found > 0.0)]
    low = float(np.min(alive, initial=1.0 if not alive.size else np.inf)) / GRID_REACH
    high = float(np.max(alive, initial=1.0 if not alive.size else 0.0)) * GRID_REACH
    if observer.dt > 0.0:
        high = np.pi / observer.dt
        low = min(low, high / GRID_REACH)
    return np.concatenate([[0.0], np.geomspace(low, high, RESPONSE_POINTS)])
