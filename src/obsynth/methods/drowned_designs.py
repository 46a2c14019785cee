"""Designs that are right on paper and useless in numbers: rounding of the data is as large as what a unit fault does.

With ``y = G f`` the response of the outputs to one fault, an estimate is ``(Cz (s - Az)^-1 By + Dy) G f``, and outputs
that are right to their last digit change it by up to ``u (|Cz| |(s - Az)^-1| |By| + |Dy|) |G| |f|``, u the unit
roundoff, whatever the units.
"""

from __future__ import annotations

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import UNIT_ROUNDOFF

#: Share of a unit fault that rounding of the outputs may be of its estimate.
MOST = 0.1
#: Observers of more states are not examined: their certificates bound what rounding of their numbers does.
MOST_STATES = 150
#: Points at which that is judged, in continuous time in units of the plant's own rate.
POINTS = (0.0, 1e-2, 1e-1, 1.0)


def require_above_rounding(plant: DescriptorSystem, observer: LinearObserver) -> None:
    """Raise `PreconditionError` (unclear) where rounding of the outputs drowns the estimate of a unit fault."""
    if not plant.nf or observer.order > MOST_STATES or plant.is_sparse or len(observer.fault_names) != plant.nf:
        return
    with np.errstate(all="ignore"):
        shares = [share for point in _points(plant) if (share := _shares(plant, observer, point)) is not None]
    if not shares:
        return
    least = np.min(shares, axis=0)
    worst = int(np.argmax(least))
    if least[worst] >= MOST:
        raise PreconditionError(
            "Unclear: gains were found and proved, but they are so large that rounding of the outputs to double "
            f"precision alone moves the estimate of {plant.fault_names[worst]!r} by {least[worst]:.2g} of the fault at "
            "every frequency tried: the data are too close to those of a plant without an observer. An output in which "
            "the fault shows more would decide it.",
            condition="gains against rounding",
            signals=(plant.fault_names[worst],),
        )


def _points(plant: DescriptorSystem) -> list[complex]:
    if plant.is_discrete:
        return [complex(np.exp(1j * point)) for point in POINTS]
    sizes = np.linalg.norm(plant.E), np.linalg.norm(plant.A)
    rate = float(sizes[1] / sizes[0]) if all(sizes) else 1.0
    return [complex(0.0, rate * point) for point in POINTS]


def _shares(plant: DescriptorSystem, observer: LinearObserver, point: complex) -> FloatArray | None:
    """Return the share of each fault that rounding may be at one point; ``None`` at a pole of either."""
    try:
        states = np.linalg.solve(point * plant.E - plant.A, plant.Bf)
        resolvent = np.linalg.inv(point * np.eye(observer.order) - observer.Az)
    except np.linalg.LinAlgError:
        return None
    outputs = np.abs(plant.C @ states + plant.Df)
    rows = observer.fault_rows
    sizes = np.abs(observer.Cz[rows]) @ (np.abs(resolvent) @ (np.abs(observer.By) @ outputs))
    found = UNIT_ROUNDOFF * np.diag(sizes + np.abs(observer.Dy[rows]) @ outputs)
    return np.asarray(found) if np.all(np.isfinite(found)) else None
