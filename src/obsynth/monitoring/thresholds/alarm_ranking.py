"""The hypotheses on an alarm, the most likely first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

#: What an alarm is called that no effect of a fault explains, and one by a sensor, before the name of its output.
NONE_OF_THESE, SENSOR = "none of these faults", "sensor "


class Ranking(NamedTuple):
    """What an alarm may be, the most likely first: names and posterior shares; the one that it is called by, and those
    that are as likely; whether that one drifts, and for a sensor how far off it is, with its deviation; how many other
    changes came before it, and twice its log likelihood ratio where the effects of these are subtracted."""

    shares: tuple[tuple[str, float], ...]
    named: str
    ties: tuple[str, ...] = ()
    drifts: bool = False
    size: float = math.nan
    deviation: float = math.nan
    earlier: int = 0
    ratio: float = math.nan

    @property
    def is_sensor(self) -> bool:
        """Whether it is called by a sensor."""
        return self.named.startswith(SENSOR)

    @property
    def candidates(self) -> str:
        """All that is as likely, faults of the plant first."""
        return " or ".join((self.named, *self.ties))

    def called(self, faults: Sequence[str]) -> str:
        """Return the name of an alarm: empty where several ``faults`` of the plant are as likely."""
        return "" if self.named in faults and any(name in faults for name in self.ties) else self.named
