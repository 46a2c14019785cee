"""What disturbances make of the estimates at the vertices of a box: peak gains of plant and error in series."""

from __future__ import annotations

import itertools

import numpy as np

from obsynth.analysis.transformations.elimination import eliminate_algebraic_states
from obsynth.analysis.transformations.uncertain_plant import AffinePlant, untouched_states
from obsynth.errors import ObsynthError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign
from obsynth.tolerances.exact_plant import plant_at
from obsynth.tolerances.tracking import Tracking

#: Vertices beyond this number are drawn at random.
MOST_VERTICES = 32
#: Samples over which the gain at a vertex is summed up, at most.
MOST_GAIN_SAMPLES = 5_000
#: What is left of a response when its sum ends.
_GAIN_LEFT = 1e-6


def vertex_gains(
    design: ObserverDesign, plant: DescriptorSystem, affine: AffinePlant, tracking: Tracking
) -> dict[str, float]:
    """Return the largest peak (l1) gain from disturbances at the vertices; some drawn where there are too many."""
    observer, uncertain = design.linear[1], plant.uncertainty
    labels = labels_of(observer)
    if uncertain is None or not plant.nd or not labels:
        return {}
    count = len(uncertain.box.names)
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=count))) if 2**count <= MOST_VERTICES else (
        np.random.default_rng(0).choice([-1.0, 1.0], (MOST_VERTICES, count))
    )  # fmt: skip
    followed, basis = tracking.T, affine.coordinates
    nominal = eliminate_algebraic_states(plant)
    if plant.nx != nominal.plant.nx:
        followed, basis = followed @ plant.E @ nominal.recovery.from_state, np.eye(nominal.plant.nx)
    worst = np.zeros(len(labels))
    for corner in corners:
        at = plant_at(plant, uncertain.box.values(corner))
        worst = np.maximum(worst, _peak_gain(observer, at, followed, basis))
    return {label: float(gain) for label, gain in zip(labels, worst, strict=True)}


def _peak_gain(
    observer: LinearObserver, plant: DescriptorSystem, followed: FloatArray, basis: FloatArray
) -> FloatArray:
    """Return the peak gain of plant and error in series, without states that reach neither error nor outputs."""
    shown = slice(observer.fault_rows.start, len(observer.Cz))
    try:
        smooth = eliminate_algebraic_states(plant).plant
    except ObsynthError:
        return np.full(len(observer.Cz) - observer.fault_rows.start, np.inf)
    back = 2.0 * np.eye(len(basis)) - basis
    into = observer.Az @ followed + observer.By @ smooth.C - followed @ smooth.A
    through = observer.Cz[shown] @ followed + observer.Dy[shown] @ smooth.C
    seen = np.vstack([back @ smooth.A, into, through])
    terms = np.concatenate([
        np.abs(back @ smooth.A).sum(axis=1),
        (np.abs(observer.Az @ followed) + np.abs(observer.By) @ np.abs(smooth.C)).sum(axis=1),
        (np.abs(observer.Cz[shown]) @ np.abs(followed) + np.abs(observer.Dy[shown]) @ np.abs(smooth.C)).sum(axis=1),
    ])  # fmt: skip
    apart = untouched_states(seen @ basis, terms)
    kept = [i for i in range(smooth.nx) if i not in apart]
    nx, nz = len(kept), observer.order
    a = np.block([[(back @ smooth.A @ basis)[np.ix_(kept, kept)], np.zeros((nx, nz))],
                  [(into @ basis)[:, kept], observer.Az]])  # fmt: skip
    b = np.vstack([(back @ smooth.Bd)[kept], observer.By @ smooth.Dd - followed @ smooth.Bd])
    c = np.hstack([(through @ basis)[:, kept], observer.Cz[shown]])
    total = np.abs(observer.Dy[shown] @ smooth.Dd).sum(axis=1)
    if np.max(np.abs(np.linalg.eigvals(a)), initial=0.0) >= 1.0:
        return np.full(len(c), np.inf)
    column, size = b, float(np.abs(b).max(initial=0.0))
    for _ in range(MOST_GAIN_SAMPLES):
        total = total + np.abs(c @ column).sum(axis=1)
        column = a @ column
        if np.abs(column).max(initial=0.0) <= _GAIN_LEFT * size:
            break
    return np.asarray(total)


def labels_of(observer: LinearObserver) -> tuple[str, ...]:
    """Return what fault estimates and residuals are called in tables."""
    return (*(f"fhat[{name}]" for name in observer.fault_names), *(f"r[{name}]" for name in observer.residual_names))
