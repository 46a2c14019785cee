"""A box of constants that a log allows, with its level: what tolerances take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from obsynth.errors import SpecError


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
    """

    nominal: Mapping[str, float]
    low: Mapping[str, float]
    high: Mapping[str, float]
    open_sides: tuple[tuple[str, str], ...]
    level: float
    digest: str
    source: str = "calibrated"

    def __post_init__(self) -> None:
        for field in ("nominal", "low", "high"):
            object.__setattr__(self, field, MappingProxyType(dict(getattr(self, field))))

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
            A side is open: a tolerance without an end bounds nothing.
        """
        if self.open_sides:
            name, side = self.open_sides[0]
            raise SpecError(
                f"The box of {name!r} has an open {side} side: the log bounds nothing there. State its range, or take "
                "a log that moves it.", path=f"constants.{name}",
            )  # fmt: skip
        return {name: {"nominal": value, "range": [self.low[name], self.high[name]]}
                for name, value in self.nominal.items()}  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "nominal": dict(self.nominal), "low": dict(self.low), "high": dict(self.high),
            "open_sides": [list(side) for side in self.open_sides], "level": self.level, "digest": self.digest,
            "source": self.source,
        }  # fmt: skip
