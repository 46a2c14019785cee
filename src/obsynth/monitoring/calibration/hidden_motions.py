"""Lasting motions of a plant that no output shows: a Kalman filter for its innovations does without them.

A motion ``x_k = z^k v`` with ``A v - z E v`` in the range of Bd, and ``C v`` in that of Dd, is one that unknown
disturbances hide.  Whoever estimates states is refused by it; innovations do not depend on it.  In the coordinates
``x = x' + v t``, where one entry of ``x'`` is zero, the others follow equations of their own.
"""

from __future__ import annotations

import numpy as np

from obsynth.errors import ObsynthError, PreconditionError
from obsynth.methods.functions import descriptor_kalman
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.invariant_zeros import zero_at
from obsynth.numerics.observable_part import SAME_MODE
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE
from obsynth.numerics.sparse import dense
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.recovery import with_states
from obsynth.results.design import ObserverDesign

_INPUTS = ("B", "Bf", "Bd", "Bw")


def kalman_filter_of_what_shows(plant: DescriptorSystem, *, name: str) -> ObserverDesign:
    """Return the Kalman filter of a sampled plant, without lasting motions that no output shows.

    Parameters
    ----------
    plant : DescriptorSystem
        On samples, with the noise of its sensors.
    name : str
        Of the design.

    Raises
    ------
    PreconditionError
        Where no filter exists for another reason.
    """
    try:
        return descriptor_kalman(plant, outliers="gate", name=name)
    except PreconditionError as error:
        smaller = _without_motion(plant, error)
        if smaller is None:
            raise
    return kalman_filter_of_what_shows(smaller, name=name)


def _without_motion(plant: DescriptorSystem, refusal: PreconditionError) -> DescriptorSystem | None:
    """Return the plant without the motion at the mode of a refusal; `None` where that is the reason of none."""
    if refusal.condition != "detectability" or refusal.mode is None or plant.nx < 2:
        return None
    mode = complex(refusal.mode)
    # Rounding splits a double mode into a pair.
    is_real = abs(mode.imag) <= SAME_MODE * max(1.0, abs(mode))
    E, A, Bd = dense(plant.E), dense(plant.A), dense(plant.Bd)
    try:
        direction = zero_at(E, A, mode.real if is_real else mode, Bd, plant.C, plant.Dd).state_direction
    except ObsynthError:
        return None
    largest = direction[np.argmax(np.abs(direction))]
    direction = direction * (abs(largest) / largest) if largest else direction
    parts = [direction.real] if is_real else [direction.real, direction.imag]
    motion: FloatArray = np.column_stack(parts)
    left, others = _quotient(E @ motion), _quotient(motion)
    if left is None or others is None or len(parts) >= plant.nx:
        return None
    (rows, _), (columns, kept) = left, others
    changes = {field: rows @ dense(getattr(plant, field)) for field in _INPUTS}
    # In x' the entries that are left out are zero: these columns of E and A go.
    made = with_states(
        plant,
        [plant.state_names[i] for i in kept],
        E=rows @ E[:, kept],
        A=rows @ A[:, kept],
        C=plant.C[:, kept],
        **changes,
    )
    point = columns @ np.array([plant.operating_point.get(state, 0.0) for state in plant.state_names])
    moved = {made.state_names[i]: float(value) for i, value in enumerate(point) if value}
    return made.replace(operating_point={**made.operating_point, **moved}, uncertainty=None)


def _quotient(motion: FloatArray) -> tuple[FloatArray, list[int]] | None:
    """Return the matrix that removes ``motion (n, m)`` by its largest entries, and the rows that are kept; `None` where
    the motion vanishes."""
    size = float(np.max(np.abs(motion), initial=0.0))
    if not size:
        return None
    pivots: list[int] = []
    rest = motion / size
    for column in range(motion.shape[1]):
        pivot = int(np.argmax(np.abs(rest[:, column])))
        if abs(rest[pivot, column]) <= CANCELLATION_TOLERANCE:
            return None
        pivots.append(pivot)
        rest = rest - np.outer(rest[:, column] / rest[pivot, column], rest[pivot]) * (np.arange(rest.shape[1]) > column)
    kept = [i for i in range(len(motion)) if i not in pivots]
    removing = np.eye(len(motion))
    removing[:, pivots] -= motion @ np.linalg.inv(motion[pivots])
    return removing[kept], kept
