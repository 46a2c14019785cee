"""What a monitor saw in one record."""

from __future__ import annotations

from dataclasses import dataclass

from obsynth.numerics.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Detection:
    """What a monitor saw in one record.

    Parameters
    ----------
    kind, statement : str
        The monitor's, and what its threshold means.
    values, threshold : FloatArray
        ``(steps,)``.
    k : int or None
        First sample at which the threshold is passed.
    time : float or None, seconds
        The same.
    fault : str
        The isolated fault: largest estimate at (or a given number of samples after) the alarm, in its own deviations;
        of guaranteed tests the one that is there, or "one or another"; empty without an alarm.
    """

    kind: str
    statement: str
    values: FloatArray
    threshold: FloatArray
    k: int | None
    time: float | None
    fault: str
