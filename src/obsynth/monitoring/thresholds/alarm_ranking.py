"""The possible causes of an alarm, the most likely first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

#: Name of the cause of an alarm that no fault explains, and prefix of a faulty sensor before the name of its output.
NONE_OF_THESE, SENSOR = "none of these faults", "sensor "


class Ranking(NamedTuple):
    """The possible causes of an alarm, with their posterior shares."""

    shares: tuple[tuple[str, float], ...]  # names with their shares, the most likely first
    named: str  # the cause that the alarm is named by
    ties: tuple[str, ...] = ()  # causes that are as likely
    drifts: bool = False  # whether the named cause is a drift
    size: float = math.nan  # of a sensor's fault
    deviation: float = math.nan  # standard deviation of this size
    earlier: int = 0  # number of changes that were named before
    ratio: float = math.nan  # twice the log likelihood ratio after subtraction of the effects of earlier changes

    @property
    def is_sensor(self) -> bool:
        """Whether the alarm is named by a sensor."""
        return self.named.startswith(SENSOR)

    @property
    def candidates(self) -> str:
        """The named cause and those that are as likely, as a text."""
        return " or ".join((self.named, *self.ties))

    def called(self, faults: Sequence[str]) -> str:
        """Return the name of an alarm: empty if several ``faults`` of the plant are equally likely."""
        return "" if self.named in faults and any(name in faults for name in self.ties) else self.named

    def named_by(self, cause: str) -> Ranking:
        """Return the ranking named by another one of the equally likely causes."""
        return self._replace(named=cause, ties=tuple(name for name in (self.named, *self.ties) if name != cause))
