r"""Decoupling of a shipped observer, measured as a transfer function from the plant itself, without its tracking map.

At each frequency the trajectories ``(x, d) e^{st}`` of the plant are the null space of ``[sE - A, -Bd]``, whether the
plant is regular or not.  Through ``y = C x + Dd d`` and the realisation they give estimates, whose errors must vanish.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.unknown_inputs import balanced, balancing
from obsynth.models.descriptor import DescriptorSystem
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import RANK_TOLERANCE
from obsynth.numerics.spectra import boundary_points, eigenvalues, speeds
from obsynth.observers.linear import LinearObserver

#: Frequencies of the grid, and how far it reaches beyond the slowest and the fastest pole of the observer.
GRID_POINTS = 61
GRID_REACH = 30.0
#: A signal below this share of what a trajectory of unit size could make of it is held not to be moved.
UNMOVED = 1e-4


@dataclass(frozen=True)
class DecouplingNorm:
    """The largest gain found from the unknown inputs to the errors of the estimates.

    Parameters
    ----------
    relative : float
        Largest error of an estimate, relative to the terms it is computed from.
    fault_gain : float
        Largest error of a fault estimate for unit size of the trajectory ``(x, d)`` in balanced units.
    frequency : float
        Where, rad/s.
    """

    relative: float
    fault_gain: float
    frequency: float


def frequency_grid(observer: LinearObserver) -> FloatArray:
    """Return frequencies in rad/s around the poles of an observer, zero included; up to pi/dt in discrete time."""
    found = speeds(eigenvalues(observer.Az), observer.dt) if observer.order else np.ones(1)
    alive = found[np.isfinite(found) & (found > 0.0)]
    low = float(np.min(alive, initial=1.0 if not alive.size else np.inf)) / GRID_REACH
    high = float(np.max(alive, initial=1.0 if not alive.size else 0.0)) * GRID_REACH
    if observer.dt > 0.0:
        high = np.pi / observer.dt
        low = min(low, high / GRID_REACH)
    return np.concatenate([[0.0], np.geomspace(low, high, GRID_POINTS)])


def decoupling_norm(plant: DescriptorSystem, observer: LinearObserver) -> DecouplingNorm:
    """Return how much of any unknown input reaches the estimates of state, fault and residual.

    Parameters
    ----------
    plant : DescriptorSystem
        The plant, regular or not.
    observer : LinearObserver
        What is shipped.
    """
    scaling = balancing(plant)
    scaled = balanced(plant, scaling)
    frequencies = frequency_grid(observer)
    worst = DecouplingNorm(0.0, 0.0, 0.0)
    if not all(np.all(np.isfinite(part)) for part in (observer.Az, observer.By, observer.Cz, observer.Dy)):
        return DecouplingNorm(float("nan"), float("nan"), float("nan"))
    # Outputs of the balanced plant are those of the plant times powers of two.
    by, dy = observer.By / scaling.outputs, observer.Dy / scaling.outputs
    # Bhat = Ahat D + K may cancel: what it is formed of says how well it can be known.
    formed = np.abs(by) + np.abs(observer.Az[:, : plant.nx]) @ np.abs(dy[: plant.nx])
    for frequency, point in zip(frequencies, boundary_points(frequencies, plant.dt), strict=True):
        _, values, right = np.linalg.svd(np.hstack([point * scaled.E - scaled.A, -scaled.Bd]))
        rank = int(np.sum(values > RANK_TOLERANCE * values[0]))
        trajectories = right[rank:].conj().T
        if trajectories.shape[1] == 0:
            continue
        x, d = trajectories[: plant.nx], trajectories[plant.nx :]
        y = scaled.C @ x + scaled.Dd @ d
        try:
            resolvent = np.linalg.inv(point * np.eye(observer.order) - observer.Az)
        except np.linalg.LinAlgError:
            return DecouplingNorm(float("inf"), float("inf"), float(frequency))
        error = observer.Cz @ (resolvent @ (by @ y)) + dy @ y
        error[: plant.nx] -= scaling.states[:, None] * x
        terms = np.abs(scaled.C) @ np.abs(x) + np.abs(scaled.Dd) @ np.abs(d)
        size = np.abs(observer.Cz) @ (np.abs(resolvent) @ (formed @ terms)) + np.abs(dy) @ terms
        size[: plant.nx] += scaling.states[:, None] * np.abs(x)
        # A signal that a trajectory does not move is rounding: it is judged by what trajectories of its size could do.
        unit = np.sum(np.abs(scaled.C), axis=1) + np.sum(np.abs(scaled.Dd), axis=1)
        possible = np.abs(observer.Cz) @ (np.abs(resolvent) @ (formed @ unit)) + np.abs(dy) @ unit
        possible[: plant.nx] += scaling.states
        rows = np.maximum(np.max(size, axis=1), UNMOVED * possible)
        relative = float(np.max(np.max(np.abs(error), axis=1) / np.where(rows > 0.0, rows, 1.0), initial=0.0))
        fault = float(np.max(np.linalg.norm(error[observer.fault_rows], axis=1), initial=0.0))
        if not relative <= worst.relative:
            worst = DecouplingNorm(relative, max(fault, worst.fault_gain), float(frequency))
        elif fault > worst.fault_gain:
            worst = DecouplingNorm(worst.relative, fault, worst.frequency)
    return worst
