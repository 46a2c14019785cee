"""What depends on an observer and an interval alone: its first-order hold."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import TypeAlias

from obsynth.numerics.arrays import FloatArray

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
