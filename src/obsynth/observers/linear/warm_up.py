"""How long a linear observer remembers its start, and the warm-up that follows from it."""

from __future__ import annotations

import math

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver

#: The start counts as forgotten when the slowest part of it has shrunk to this share.
FORGOTTEN = 0.02


def transient(observer: LinearObserver) -> float:
    """Return the seconds after which an observer has forgotten its start: the slowest mode at `FORGOTTEN`."""
    if observer.order == 0:
        return 0.0
    slowest = abscissa(observer.Az, observer.dt)
    if observer.dt == 0.0:
        return math.log(FORGOTTEN) / slowest if slowest < 0.0 else math.inf
    if slowest >= 1.0:
        return math.inf
    samples = math.ceil(math.log(FORGOTTEN) / math.log(slowest)) if slowest > 0.0 else 0
    return observer.dt * (
        max(samples, observer.order) + max((*observer.state_delays, *observer.fault_delays), default=0)
    )


def checked_warm_up(asked: float | None, default: float) -> float:
    """Return the warm-up in seconds."""
    if asked is None:
        return default
    if not (is_finite_number(asked) and asked >= 0.0):
        raise SpecError(f"warm_up is {asked!r}: give seconds, 0 or more.", path="warm_up")
    return float(asked)
