"""Single plants of a box: their matrices, what an observer follows of one, gains at vertices, effects like faults."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import ObsynthError, SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.ranks import DIRECTION_SHARE
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.constants import ConstantsBox
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.sampling import discretise
from obsynth.plants.transformations.uncertain_plant import AffinePlant, untouched_states
from obsynth.plants.uncertain_system import uncertain_system
from obsynth.plants.uncertainty import SAMPLED, UNCERTAIN_MATRICES, Uncertainty, as_written
from obsynth.results.design import ObserverDesign
from obsynth.verification.over_tolerances.error_structure import Tracking

#: Vertices beyond this number are drawn at random.
MOST_VERTICES = 32

#: Samples over which the gain at a vertex is summed up, at most.
MOST_GAIN_SAMPLES = 5_000

#: What is left of a response when its sum ends.
_GAIN_REMAINDER = 1e-6

#: Samples that are taken at once.
_GAIN_BLOCK = 50

#: A design without tolerances says this.
EXACT_MODEL = "assumes an exact model"

#: Two plants are the same where entries agree so well, relatively and around zero.
SAME_ENTRY, SAME_PLANT_ZERO = 1e-9, 1e-12


def plant_at(plant: DescriptorSystem, values: Mapping[str, float]) -> DescriptorSystem:
    """Return the plant for values of its constants: no family of matrices, and with the noise of the plant itself."""
    uncertain = plant.uncertainty
    if uncertain is None:
        return plant
    if uncertain.written is None:
        single = plant.replace(**uncertain.filled(as_written(plant, uncertain), values), uncertainty=None)
    else:
        bare = plant_as_written_at(plant, uncertain, values)
        for kind, size in uncertain.steps:
            bare = discretise(bare, size).plant if kind == SAMPLED else eliminate_algebraic_states(bare).plant
        single = plant.replace(**{name: getattr(bare, name) for name in UNCERTAIN_MATRICES}, uncertainty=None)
    # It is no family any more, but knows which of its inputs is one in every row, if one is.
    shift = uncertain.shift
    return single.replace(uncertainty=Uncertainty(ConstantsBox({}), {}, shift=shift)) if shift else single


def plant_as_written_at(
    plant: DescriptorSystem, uncertain: Uncertainty, values: Mapping[str, float]
) -> DescriptorSystem:
    """Return the plant as it was written, for values of its constants."""
    matrices: dict[str, Any] = uncertain.filled(as_written(plant, uncertain), values)
    return DescriptorSystem(**matrices, dt=0.0 if any(kind == SAMPLED for kind, _ in uncertain.steps) else plant.dt)


def drawn_points(count: int, runs: int, seed: int, *, vertices: float = 0.5) -> FloatArray:
    """Return points ``(runs, count)`` of the box: a share of them vertices, the others uniform inside."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(-1.0, 1.0, (runs, count))
    chosen = generator.random(runs) < vertices
    points[chosen] = generator.choice([-1.0, 1.0], (int(chosen.sum()), count))
    return points


def vertex_gains(
    design: ObserverDesign, plant: DescriptorSystem, affine: AffinePlant, tracking: Tracking
) -> dict[str, float]:
    """Return the largest peak (l1) gain from disturbances at the vertices; some drawn where there are too many."""
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
    """Return the peak gain of plant and error in series, without states that reach neither error nor outputs."""
    estimates = slice(observer.fault_rows.start, len(observer.Cz))
    try:
        smooth = eliminate_algebraic_states(plant).plant
    except ObsynthError:
        return np.full(len(observer.Cz) - observer.fault_rows.start, np.inf)
    back = 2.0 * np.eye(len(basis)) - basis
    into = observer.Az @ followed + observer.By @ smooth.C - followed @ smooth.A
    through = observer.Cz[estimates] @ followed + observer.Dy[estimates] @ smooth.C
    rows = np.vstack([back @ smooth.A, into, through])
    terms = np.concatenate(
        [
            np.abs(back @ smooth.A).sum(axis=1),
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
            [(back @ smooth.A @ basis)[np.ix_(states, states)], np.zeros((nx, nz))],
            [(into @ basis)[:, states], observer.Az],
        ]
    )
    b = np.vstack([(back @ smooth.Bd)[states], observer.By @ smooth.Dd - followed @ smooth.Bd])
    c = np.hstack([(through @ basis)[:, states], observer.Cz[estimates]])
    total = np.abs(observer.Dy[estimates] @ smooth.Dd).sum(axis=1)
    if np.max(np.abs(np.linalg.eigvals(a)), initial=0.0) >= 1.0:
        return np.full(len(c), np.inf)
    return np.asarray(total + _summed_response(a, b, c))


def _summed_response(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Return the sums of ``abs(c a^k b)`` over k and the columns, until little of ``a^k b`` is left."""
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


def acting_like_faults(plant: DescriptorSystem) -> tuple[str, ...]:
    """Return the constants with tolerances that act where a fault does, from the plant as written."""
    uncertain = plant.uncertainty
    if uncertain is None or not plant.nf:
        return ()
    numbers = as_written(plant, uncertain)
    affine = uncertain.affine(numbers, uncertain.box)
    faults = np.vstack([numbers["Bf"], numbers["Df"]])
    names = []
    for i, name in enumerate(uncertain.box.names):
        # What multiplies the same signal stands in one column: derivative of the state, state, u, f, d.
        zero = np.zeros((plant.ny, len(numbers["A"])))
        above = [affine[key].parts[i] for key in ("E", "A", "B", "Bf", "Bd")]
        below = [zero, *(affine[key].parts[i] for key in ("C", "D", "Df", "Dd"))]
        directions = _range(np.vstack([np.hstack(above), np.hstack(below)]))
        both = np.hstack([faults / np.linalg.norm(faults, axis=0), directions])
        if np.linalg.matrix_rank(both, tol=DIRECTION_SHARE) < both.shape[1]:
            names.append(name)
    return tuple(names)


def _range(effects: FloatArray) -> FloatArray:
    """Return unit columns that span what a constant does to equations and outputs."""
    left_vectors, values, _ = np.linalg.svd(effects)
    return np.asarray(
        left_vectors[:, : int(np.sum(values > DIRECTION_SHARE * max(values[0], np.finfo(np.float64).tiny)))]
    )


def with_tolerances(design: ObserverDesign, constants: Any) -> tuple[ObserverDesign, DescriptorSystem]:
    """Return a linear design and its plant with the tolerances that are asked for."""
    plant, _ = design.linear
    if constants is None:
        return design, plant
    if isinstance(constants, DescriptorSystem):
        changed = _with_tolerances_of(plant, constants)
    else:
        changed = uncertain_system(plant, constants.box if isinstance(constants, Uncertainty) else constants)
    return design.replace(plant=changed), changed


def _with_tolerances_of(plant: DescriptorSystem, source: DescriptorSystem) -> DescriptorSystem:
    """Return a plant with the tolerances of one that is the same but for these."""
    same = all(
        getattr(plant, name).shape == getattr(source, name).shape
        and np.allclose(getattr(plant, name), getattr(source, name), rtol=SAME_ENTRY, atol=SAME_PLANT_ZERO)
        for name in ("E", "A", "B", "C", "D", "Bd", "Dd", "Bf", "Df")
    )
    own, other = plant.uncertainty, source.uncertainty
    if not same and own is not None and other is not None and own.written is not None:
        # The design is for a plant that was made from the one that is given.
        before = as_written(source, other)
        if dict(own.entries) == dict(other.entries) and all(
            np.array_equal(own.written[name], before[name]) for name in own.written
        ):
            return plant.replace(uncertainty=own.with_box(other.box))
    if not same or plant.dt != source.dt:
        raise SpecError("constants is another plant than the design's: its nominal matrices differ.", path="constants")
    return plant.replace(uncertainty=source.uncertainty)
