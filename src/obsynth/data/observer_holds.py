"""What depends on an observer and an interval alone: its first-order hold, and how long it remembers its start."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeAlias

from obsynth.errors import SpecError
from obsynth.numerics.arguments import is_finite_number
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.spectra import abscissa
from obsynth.observers.linear.observer import LinearObserver

#: The start counts as forgotten when the slowest part of it has shrunk to this share.
FORGOTTEN = 0.02
#: How many lengths of an interval are kept discretised.
KEPT_INTERVALS = 64

Hold: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]


class KeptHolds:
    """First-order holds of one system by the length of the interval; those used last are kept.

    Fields: compute: Takes seconds, returns ``Phi, Gamma_0, Gamma_1``.
    """

    def __init__(self, compute: Callable[[float], Hold]) -> None:
        self._compute = compute
        self._kept: OrderedDict[float, Hold] = OrderedDict()

    def at(self, seconds: float) -> Hold:
        """Return the hold over an interval of ``seconds``."""
        if seconds not in self._kept:
            self._kept[seconds] = self._compute(seconds)
            if len(self._kept) > KEPT_INTERVALS:
                self._kept.popitem(last=False)
        self._kept.move_to_end(seconds)
        return self._kept[seconds]


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
