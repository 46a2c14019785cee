"""Peak gains from disturbances to the estimates of a linear observer, for plants at the vertices of a box."""

from __future__ import annotations

import itertools

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.uncertain_plant import AffinePlant, untouched_states
from obsynth.results.design import ObserverDesign
from obsynth.verification.over_tolerances.error_structure import Tracking
from obsynth.verification.over_tolerances.plants_of_the_box import plant_at

#: A box with more vertices is represented by this number of random ones.
MOST_VERTICES = 32

#: Most samples over which a response is summed.
MOST_GAIN_SAMPLES = 5_000

#: The sum of a response ends when its states have decayed to this share of the first.
_GAIN_REMAINDER = 1e-6

#: Number of samples of a response that are computed at once.
_GAIN_BLOCK = 50


def vertex_gains(
    design: ObserverDesign, plant: DescriptorSystem, affine: AffinePlant, tracking: Tracking
) -> dict[str, float]:
    """Return for each estimate the largest peak (l1) gain from disturbances at the vertices of the box.

    Where there are more than `MOST_VERTICES` vertices, random ones represent them.
    """
    observer, uncertain = design.linear[1], plant.uncertainty
    labels = observer.row_names[len(observer.state_names) :]
    if uncertain is None or not plant.nd or not labels:
        return {}
    count = len(uncertain.box.names)
    corners = (
        np.array(list(itertools.product((-1.0, 1.0), repeat=count)))
        if 2**count <= MOST_VERTICES
        else (np.random.default_rng(0).choice([-1.0, 1.0], (MOST_VERTICES, count)))
    )
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
    """Return the peak gains of plant and error system in series, without states that affect no estimate."""
    estimates = slice(observer.fault_rows.start, len(observer.Cz))
    try:
        smooth = eliminate_algebraic_states(plant).plant
    except ObsynthError:
        return np.full(len(observer.Cz) - observer.fault_rows.start, np.inf)
    inverse = 2.0 * np.eye(len(basis)) - basis
    into = observer.Az @ followed + observer.By @ smooth.C - followed @ smooth.A
    through = observer.Cz[estimates] @ followed + observer.Dy[estimates] @ smooth.C
    rows = np.vstack([inverse @ smooth.A, into, through])
    terms = np.concatenate(
        [
            np.abs(inverse @ smooth.A).sum(axis=1),
            (np.abs(observer.Az @ followed) + np.abs(observer.By) @ np.abs(smooth.C)).sum(axis=1),
            (np.abs(observer.Cz[estimates]) @ np.abs(followed) + np.abs(observer.Dy[estimates]) @ np.abs(smooth.C)).sum(
                axis=1
            ),
        ]
    )
    apart = untouched_states(rows @ basis, terms)
    states = [i for i in range(smooth.nx) if i not in apart]
    nx, nz = len(states), observer.order
    a = np.block(
        [
            [(inverse @ smooth.A @ basis)[np.ix_(states, states)], np.zeros((nx, nz))],
            [(into @ basis)[:, states], observer.Az],
        ]
    )
    b = np.vstack([(inverse @ smooth.Bd)[states], observer.By @ smooth.Dd - followed @ smooth.Bd])
    c = np.hstack([(through @ basis)[:, states], observer.Cz[estimates]])
    total = np.abs(observer.Dy[estimates] @ smooth.Dd).sum(axis=1)
    if np.max(np.abs(np.linalg.eigvals(a)), initial=0.0) >= 1.0:
        return np.full(len(c), np.inf)
    return np.asarray(total + _summed_response(a, b, c))


def _summed_response(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return the sums of ``abs(c a^k b)`` over k and the columns of b, until ``a^k b`` has decayed."""
    powers = [np.eye(len(a))]
    while len(powers) <= _GAIN_BLOCK:
        powers.append(a @ powers[-1])
    block, onwards = np.array(powers[:-1]), powers[-1]
    column, negligible, total = b, _GAIN_REMAINDER * float(np.abs(b).max(initial=0.0)), np.zeros(len(c))
    for _ in range(0, MOST_GAIN_SAMPLES, _GAIN_BLOCK):
        moved = block @ column
        sizes = np.abs(moved).max(axis=(1, 2), initial=0.0)
        total = total + np.abs(c @ moved[: max(int(np.argmax(np.append(sizes <= negligible, True))), 1)]).sum(
            axis=(0, 2)
        )
        if np.any(sizes <= negligible):
            break
        column = onwards @ column
    return total
