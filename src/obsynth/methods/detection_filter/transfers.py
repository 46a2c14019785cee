"""What drives the residuals of a detection filter: the error by itself, and what the stored numbers add to it."""

from __future__ import annotations

import numpy as np

from obsynth.methods.detection_filter.norm_proofs import Transfer
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import UNDERFLOW, UNIT_ROUNDOFF, Ball, rounded_up
from obsynth.proofs.contraction import prove_contraction
from obsynth.proofs.exact_arithmetic import nearest_doubles, stored_matrix
from obsynth.verification.error_system import contraction_of

#: With more states what the stored numbers miss is enclosed, not computed exactly.
MOST_EXACT_STATES = 64


def error_transfer(plant: DescriptorSystem, observer: LinearObserver, b: FloatArray, d: FloatArray) -> Transfer:
    """Return the transfer of a signal that enters by b and d to the residuals, if ``Az = A - By C, Cz = -Dy C``."""
    direct, out = Ball.exact(d), Ball.exact(observer.Dy)
    return Transfer(
        observer.Az, Ball.exact(b) - Ball.exact(observer.By) @ direct, out @ Ball.exact(plant.C), out @ direct
    )


def missed(plant: DescriptorSystem, observer: LinearObserver) -> tuple[Ball, Ball]:
    """Return ``K = Az + By C - A`` and ``J = Cz + Dy C``: zero but for the rounding of the stored numbers."""
    parts = observer.Az, observer.By, plant.A, observer.Cz, observer.Dy, plant.C
    if plant.nx > MOST_EXACT_STATES:
        az, by, a, cz, dy, c = (Ball.exact(part) for part in parts)
        return az + by @ c - a, cz + dy @ c
    stored = [stored_matrix(part) for part in parts]
    k, j = stored[0] + stored[1] * stored[5] - stored[2], stored[3] + stored[4] * stored[5]
    return _enclosed(nearest_doubles(k)), _enclosed(nearest_doubles(j))


def _enclosed(rounded: FloatArray) -> Ball:
    """Return what holds a matrix each entry of which was rounded once; exact zeros stay so."""
    radius = rounded_up(np.abs(rounded) * (2.0 * UNIT_ROUNDOFF), 1) + UNDERFLOW
    return Ball(rounded, np.where(rounded == 0.0, 0.0, radius))


def added_gain(plant: DescriptorSystem, observer: LinearObserver, b: FloatArray, d: FloatArray) -> float:
    """Return a proved bound on what the stored numbers add to the transfer of a signal; infinite where none is proved.

    The plant's state x moves z - x by K and the residuals by J: ``(Cz (s - Az)^-1 K + J) (s - A)^-1 b``.
    """
    k, j = missed(plant, observer)
    if not any(part.midpoint.any() or part.radius.any() for part in (k, j)):
        return 0.0
    own, plant_itself = contraction_of(observer), prove_contraction(plant.A, discrete=False)
    if own is None or plant_itself is None:
        return np.inf
    # Sums over time of absolute responses bound every entry of a transfer on the axis.
    moved = plant_itself.gain(np.eye(plant.nx), b)
    shown = rounded_up(own.gain(observer.Cz, k.midpoint, k.radius) + j.magnitude, 2)
    return Ball.exact(moved).frobenius_norm * Ball.exact(shown).frobenius_norm * (1.0 + 4.0 * UNIT_ROUNDOFF)
