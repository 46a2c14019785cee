"""Whether the data begin near the operating point."""

from __future__ import annotations

import numpy as np

from obsynth.data.signals import Signals
from obsynth.numerics.arrays import FloatArray

#: Seconds of data that are compared with the operating point.
FIRST = 1.0
#: A signal is far from its operating point when its mean differs by this share of it.
FAR = 0.2


class OperatingPointCheck:
    """Gathers the first second of data.

    Fields: signals: With the operating point.
    """

    def __init__(self, signals: Signals) -> None:
        self._signals = signals
        self._begin: float | None = None
        self._sum, self._count = np.zeros(len(signals.names)), np.zeros(len(signals.names))

    def take(self, time: float, deviations: FloatArray) -> None:
        """Take one row: seconds, and deviations ``(nu + ny,)`` of which some may be missing."""
        self._begin = time if self._begin is None else self._begin
        if time - self._begin <= FIRST:
            known = np.isfinite(deviations)
            self._sum[known] += deviations[known]
            self._count[known] += 1.0

    def warnings(self) -> tuple[str, ...]:
        """Return a text for each signal with a stated operating point, not zero, that begins far from it."""
        texts = []
        for i, name in enumerate(self._signals.names):
            point = self._signals.point.get(name, 0.0)
            if point == 0.0 or self._count[i] == 0.0:
                continue
            away = self._sum[i] / self._count[i]
            if abs(away) > FAR * abs(point):
                texts.append(
                    f"{name} begins at {point + away:.6g}, far from its operating point {point:.6g}: the linear model "
                    "may not hold there, or the data are deviations already, or in another unit."
                )
        return tuple(texts)
