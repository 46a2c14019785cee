"""What drives the residuals of a detection filter: the error by itself, and what the stored numbers add to it."""

from __future__ import annotations

import numpy as np

from obsynth.methods.detection_filter.norm_proofs import Transfer, gain_is_proved
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import continuous_hinf_norm
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import UNDERFLOW, UNIT_ROUNDOFF, Ball, rounded_up
from obsynth.proofs.exact_arithmetic import nearest_doubles, stored_matrix

#: With more states what the stored numbers miss is enclosed, not computed exactly.
MOST_STATES = 64
#: A norm is proved to be at most so many times what was found for it.
ROOM = (2.0, 16.0, 1024.0)


def error_transfer(plant: DescriptorSystem, observer: LinearObserver, b: FloatArray, d: FloatArray) -> Transfer:
    """Return the transfer of a signal that enters by b and d to the residuals, if ``Az = A - By C, Cz = -Dy C``."""
    direct, out = Ball.exact(d), Ball.exact(observer.Dy)
    return Transfer(
        observer.Az, Ball.exact(b) - Ball.exact(observer.By) @ direct, out @ Ball.exact(plant.C), out @ direct
    )


def missed(plant: DescriptorSystem, observer: LinearObserver) -> tuple[Ball, Ball]:
    """Return ``K = Az + By C - A`` and ``J = Cz + Dy C``: zero but for the rounding of the stored numbers."""
    parts = observer.Az, observer.By, plant.A, observer.Cz, observer.Dy, plant.C
    if plant.nx > MOST_STATES:
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
    exact, order = Ball.exact, plant.nx
    moved = Transfer(plant.A, exact(b), exact(np.eye(order)), exact(np.zeros((order, b.shape[1]))))
    return _proved_norm(moved) * _proved_norm(Transfer(observer.Az, k, exact(observer.Cz), j))


def _proved_norm(transfer: Transfer) -> float:
    """Return a proved bound on an H-infinity norm, infinite where none is proved."""
    parts = transfer.dynamics, transfer.B, transfer.C, transfer.D
    a, b, c, d = (part.midpoint for part in parts)
    if not abscissa(a, 0.0) < 0.0 or not np.all(np.isfinite(b)):
        return np.inf
    found = max(float(continuous_hinf_norm(a, b, c, d).value), float(np.max(transfer.D.magnitude, initial=0.0)))
    if not np.isfinite(found) or found == 0.0:
        return np.inf
    # Near one: the proof squares what may be as small as rounding.
    unit = float(np.exp2(-np.round(np.log2(found))))
    scaled = Transfer(transfer.A, transfer.B, transfer.C.scaled(unit), transfer.D.scaled(unit))
    for room in ROOM:
        if gain_is_proved(scaled, room * found * unit):
            return room * found * (1.0 + 4.0 * UNIT_ROUNDOFF)
    return np.inf
