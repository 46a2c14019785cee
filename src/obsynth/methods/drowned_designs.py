"""Designs that are right on paper and useless in numbers: rounding of the data is as large as what a unit fault does.

With ``y = G f`` the response of the outputs to one fault, an estimate is ``(Cz (s - Az)^-1 By + Dy) G f``, and outputs
that are right to their last digit change it by up to ``u (|Cz| |(s - Az)^-1| |By| + |Dy|) |G| |f|``, u the unit
roundoff, whatever the units.  The observer's own numbers, right to their last digit, change it by up to
``u (|Cz| |(s - Az)^-1| (|Az| |z| + |By| |y|) + |Cz| |z| + |Dy| |y|)``, z its state, which is said where it matters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import ComplexArray, FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.balls import UNIT_ROUNDOFF

#: Share of a unit fault that rounding of the outputs may be of its estimate.
MOST = 0.1
#: Share of a unit fault from which on rounding of the observer's own numbers is told.
TOLD = 1e-6
#: Observers of more states are not examined: their certificates bound what rounding of their numbers does.
MOST_STATES = 150
#: Points at which that is judged, in continuous time in units of the plant's own rate.
POINTS = (0.0, 1e-2, 1e-1, 1.0)

_Shares: TypeAlias = Callable[[DescriptorSystem, LinearObserver, complex], FloatArray | None]


def require_above_rounding(plant: DescriptorSystem, observer: LinearObserver) -> None:
    """Raise `PreconditionError` (unclear) where rounding of the outputs drowns the estimate of a unit fault."""
    least = _least(plant, observer, _shares)
    if least is None:
        return
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


def rounding_notes(plant: DescriptorSystem, observer: LinearObserver) -> tuple[str, ...]:
    """Return what rounding of the observer's own numbers may do to an estimate, where that matters."""
    found = _least(plant, observer, own_shares)
    return () if found is None else tuple(
        f"The numbers of the observer cancel each other: their last digits alone may move the estimate of {name!r} by"
        f" {share:.2g} of the fault, and by more at some frequencies. State the noise of the sensors, or ask for a"
        " larger gamma."
        for name, share in zip(plant.fault_names, found, strict=True) if share >= TOLD
    )  # fmt: skip


def _least(plant: DescriptorSystem, observer: LinearObserver, shares_at: _Shares) -> FloatArray | None:
    """Return the least share of each fault over the points; ``None`` where it is not examined."""
    if not plant.nf or observer.order > MOST_STATES or plant.is_sparse or len(observer.fault_names) != plant.nf:
        return None
    with np.errstate(all="ignore"):
        shares = [share for point in _points(plant) if (share := shares_at(plant, observer, point)) is not None]
    return np.asarray(np.min(shares, axis=0)) if shares else None


def _points(plant: DescriptorSystem) -> list[complex]:
    if plant.is_discrete:
        return [complex(np.exp(1j * point)) for point in POINTS]
    sizes = np.linalg.norm(plant.E), np.linalg.norm(plant.A)
    rate = float(sizes[1] / sizes[0]) if all(sizes) else 1.0
    return [complex(0.0, rate * point) for point in POINTS]


def _responses(
    plant: DescriptorSystem, observer: LinearObserver, point: complex
) -> tuple[ComplexArray, ComplexArray] | None:
    """Return the outputs for each fault and the observer's resolvent at one point; ``None`` at a pole of either."""
    try:
        states = np.linalg.solve(point * plant.E - plant.A, plant.Bf)
        resolvent = np.linalg.inv(point * np.eye(observer.order) - observer.Az)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(plant.C @ states + plant.Df, dtype=np.complex128), np.asarray(resolvent)


def own_shares(plant: DescriptorSystem, observer: LinearObserver, point: complex) -> FloatArray | None:
    """Return the share of each fault that rounding of the observer's own numbers may be at one point."""
    found = _responses(plant, observer, point)
    if found is None:
        return None
    outputs, resolvent = found
    state, seen, rows = np.abs(resolvent @ observer.By @ outputs), np.abs(outputs), observer.fault_rows
    moved = np.abs(resolvent) @ (np.abs(observer.Az) @ state + np.abs(observer.By) @ seen)
    shares = UNIT_ROUNDOFF * np.diag(np.abs(observer.Cz[rows]) @ (moved + state) + np.abs(observer.Dy[rows]) @ seen)
    return np.asarray(shares) if np.all(np.isfinite(shares)) else None


def _shares(plant: DescriptorSystem, observer: LinearObserver, point: complex) -> FloatArray | None:
    """Return the share of each fault that rounding of the outputs may be at one point; ``None`` at a pole of either."""
    responses = _responses(plant, observer, point)
    if responses is None:
        return None
    outputs, resolvent = np.abs(responses[0]), responses[1]
    rows = observer.fault_rows
    sizes = np.abs(observer.Cz[rows]) @ (np.abs(resolvent) @ (np.abs(observer.By) @ outputs))
    found = UNIT_ROUNDOFF * np.diag(sizes + np.abs(observer.Dy[rows]) @ outputs)
    return np.asarray(found) if np.all(np.isfinite(found)) else None
