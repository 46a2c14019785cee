"""What a design does, computed without its report: trajectories of any regular plant, and transfer functions.

A descriptor plant may be unstable and of any index, so it is not stepped: all its equations over the horizon are
solved at once, and of all solutions the one closest to a random signal is taken.  It is bounded, has a random initial
state, and fits the inputs, faults and disturbances exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import solveh_banded

import obsynth

Array = np.ndarray[Any, np.dtype[Any]]


@dataclass(frozen=True)
class Record:
    """A trajectory: one row per sample."""

    x: Array
    y: Array
    u: Array
    f: Array
    d: Array


def fault_signals(rng: np.random.Generator, steps: int, count: int) -> Array:
    """Return constants, steps and sinusoids of random size in turn ``(steps, count)``."""
    time = np.arange(steps)
    kinds = [
        lambda: rng.normal() * np.ones(steps),
        lambda: rng.normal() * (time >= rng.integers(1, max(2, steps // 2))),
        lambda: rng.normal() * np.sin(rng.uniform(0.05, 3.0) * time + rng.uniform(0.0, 6.0)),
    ]
    first = int(rng.integers(3))
    columns = [kinds[(first + i) % 3]() for i in range(count)]
    return np.column_stack(columns) if columns else np.zeros((steps, 0))


def trajectory(plant: obsynth.DescriptorSystem, rng: np.random.Generator, u: Array, f: Array, d: Array) -> Record:
    """Return a bounded trajectory under the given signals, one row per sample.

    Parameters
    ----------
    plant : obsynth.DescriptorSystem
        Regular, discrete time.
    rng : numpy.random.Generator
        Decides what the inputs leave open, the initial state above all.
    u, f, d : ndarray
        ``(steps, *)``.
    """
    steps, nx = len(f), plant.nx
    e, a = plant.E, plant.A
    drive = u @ plant.B.T + f @ plant.Bf.T + d @ plant.Bd.T
    sizes = 1.0 / np.max(np.abs(np.hstack([e, a])), axis=1)
    e, a, drive = sizes[:, None] * e, sizes[:, None] * a, drive * sizes
    # Equation k: E x(k+1) - A x(k) = drive(k); the matrix M of all of them has full row rank for a regular pencil.
    bands = np.zeros((2 * nx, (steps - 1) * nx))
    diagonal, below = e @ e.T + a @ a.T, -a @ e.T
    for i in range(nx):
        for j in range(nx):
            if i >= j:
                bands[i - j, j::nx] = diagonal[i, j]
            bands[nx + i - j, j : (steps - 2) * nx : nx] = below[i, j]
    x = rng.normal(size=(steps, nx))
    for _ in range(4):  # the first projection, then refinements
        miss = drive[:-1] - (x[1:] @ e.T - x[:-1] @ a.T)
        multipliers = solveh_banded(bands, miss.ravel(), lower=True).reshape(steps - 1, nx)
        x[1:] += multipliers @ e
        x[:-1] -= multipliers @ a
    y = x @ plant.C.T + u @ plant.D.T + f @ plant.Df.T + d @ plant.Dd.T
    return Record(x, y, u, f, d)


def matched_start(design: obsynth.ObserverDesign, record: Record, k: int) -> Array:
    """Return the observer state at sample ``k`` for which its error is zero, from the certificate's tracking map."""
    lag = design.observer.state_delays[0]
    past = [record.x[k - age] for age in range(1, lag + 1)]
    return design.certificate.matrices["tracking"] @ np.concatenate([design.plant.E @ record.x[k], *past])


def transfer(design: obsynth.ObserverDesign, z: complex) -> dict[str, Array]:
    """Return the transfer functions at ``z`` of plant and observer in series, by input, and what passes through them.

    Keys ``"u"``, ``"f"``, ``"d"``: ``(nx + nf, *)`` from that input to ``[xhat; fhat]``; ``"xu"``, ``"xf"``, ``"xd"``:
    ``(nx, *)`` from it to the true states; ``"size"``: the size of the terms that were summed up.
    """
    plant, observer = design.plant, design.observer
    inputs = np.hstack([plant.B, plant.Bf, plant.Bd])
    states = np.linalg.solve(z * plant.E - plant.A, inputs.astype(complex))
    outputs = plant.C @ states + np.hstack([plant.D, plant.Df, plant.Dd])
    filtered = np.linalg.solve(z * np.eye(observer.order) - observer.Az, np.hstack([observer.Bu, observer.By]))
    rows = slice(0, plant.nx + plant.nf)
    response = observer.Cz[rows] @ filtered + np.hstack([observer.Du, observer.Dy])[rows]
    known = np.vstack([np.eye(plant.nu, inputs.shape[1]), outputs])
    total = response @ known
    cuts = [plant.nu, plant.nu + plant.nf]
    names = dict(zip(("u", "f", "d"), np.split(total, cuts, axis=1), strict=True))
    names |= dict(zip(("xu", "xf", "xd"), np.split(states, cuts, axis=1), strict=True))
    return names | {"size": np.abs(response) @ np.abs(known)}
