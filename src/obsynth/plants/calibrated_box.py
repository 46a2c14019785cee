"""Calibrated boxes: ranges of constants that a log allows at a confidence level, for use as tolerances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from obsynth.errors import SpecError
from obsynth.numerics.arrays import freeze


def not_valid(level: float) -> str:
    """Return why a calibrated box whose innovations are not white gives no tolerances, and what to do."""
    return (
        f"The box is not valid: the innovations of the calibration are not white, so {100.0 * level:g} % is not its "
        "level. Mend the model or its noise, or state ranges of your own (constants: {name: {nominal, range}})."
    )


@dataclass(frozen=True)
class CalibratedBox:
    """Ranges of constants that a log allows, all at once, with a stated probability.

    Parameters
    ----------
    nominal, low, high : mapping of str to float
        By constant, in its unit; an open side is at the bound that was given for the search.
    open_sides : tuple of (str, str)
        Constants and sides (``"low"``, ``"high"``) at which the log bounds nothing.
    level : float
        Probability that the box holds all true constants, over logs like this one.
    digest : str
        SHA-256 of the log that was used.
    source : str
        ``"calibrated"``.
    stands : bool
        Whether the innovations are white: else the level is not that of the box, which a verdict says.

    Examples
    --------
    >>> box = CalibratedBox(
    ...     nominal={"c": 0.5}, low={"c": 0.48}, high={"c": 0.52}, open_sides=(), level=0.95, digest="0" * 64
    ... )
    >>> box.low["c"] <= 0.5 <= box.high["c"]
    True
    """

    nominal: Mapping[str, float]
    low: Mapping[str, float]
    high: Mapping[str, float]
    open_sides: tuple[tuple[str, str], ...]
    level: float
    digest: str
    source: str = "calibrated"
    stands: bool = True

    def __post_init__(self) -> None:
        freeze(self, "nominal", "low", "high")

    def holds(self, values: Mapping[str, float]) -> bool:
        """Return whether given values of all constants are inside.

        Parameters
        ----------
        values : mapping of str to float
            By constant; others are not looked at.
        """
        return all(self.low[name] <= values[name] <= self.high[name] for name in self.nominal)

    def constants(self) -> dict[str, dict[str, Any]]:
        """Return the box as tolerances take it: ``{name: {nominal, range}}``.

        Raises
        ------
        SpecError
            A side is open: a tolerance without an end bounds nothing.  Or the box is not valid.
        """
        if not self.stands:
            raise SpecError(not_valid(self.level), path="constants")
        if self.open_sides:
            name, side = self.open_sides[0]
            raise SpecError(
                f"The box of {name!r} has an open {side} side: the log does not bound it there. State its range, or "
                "take a log that excites it.",
                path=f"constants.{name}",
            )
        return {
            name: {"nominal": value, "range": [self.low[name], self.high[name]]} for name, value in self.nominal.items()
        }

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "nominal": dict(self.nominal),
            "low": dict(self.low),
            "high": dict(self.high),
            "open_sides": [list(side) for side in self.open_sides],
            "level": self.level,
            "digest": self.digest,
            "source": self.source,
            "stands": self.stands,
        }
