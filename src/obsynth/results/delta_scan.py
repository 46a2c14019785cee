"""What a scan of delta shows: decay against gain against noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

from obsynth.numerics.arrays import FloatArray, read_only


@dataclass(frozen=True, eq=False)
class DeltaScan:
    """One entry per delta, measured on the true error system; NaN where no gains were found.

    Parameters
    ----------
    delta : FloatArray
        ``(k,)``, seconds.
    decay : FloatArray
        ``(k,)``, rate at which errors die out, 1/seconds: minus the spectral abscissa.
    gain : FloatArray
        ``(k,)``, spectral norm of ``[J L]``.
    rate_gain : FloatArray
        ``(k,)``, H-infinity norm from the rate of the fault to the fault error, seconds.
    noise_gain : FloatArray
        ``(k,)``, H-infinity norm from sensor noise to the fault error.
    fast_noise_gain : FloatArray
        ``(k,)``, the same at high frequencies alone.
    proportional_abscissa : FloatArray
        ``(k,)``, spectral abscissa of A - J C, the P part alone, 1/seconds.
    failures : tuple of str
        For each delta the reason why there are no gains, empty where there are.
    """

    delta: FloatArray
    decay: FloatArray
    gain: FloatArray
    rate_gain: FloatArray
    noise_gain: FloatArray
    fast_noise_gain: FloatArray
    proportional_abscissa: FloatArray
    failures: tuple[str, ...]

    def __post_init__(self) -> None:
        for field in fields(self)[:-1]:
            object.__setattr__(self, field.name, read_only(getattr(self, field.name)))

    def rows(self) -> Iterator[dict[str, float | str]]:
        """Yield one mapping per delta, by field name."""
        for i, failure in enumerate(self.failures):
            row: dict[str, float | str] = {name: float(getattr(self, name)[i]) for name in self.quantities()}
            yield {**row, "failure": failure}

    @classmethod
    def quantities(cls) -> tuple[str, ...]:
        """Return the names of the columns of numbers."""
        return tuple(field.name for field in fields(cls))[:-1]

    def as_dict(self) -> dict[str, Any]:
        """Return the scan as plain data."""
        numbers = {name: getattr(self, name).tolist() for name in self.quantities()}
        return {**numbers, "failures": list(self.failures)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> DeltaScan:
        """Return the scan that `as_dict` wrote.

        Parameters
        ----------
        data : mapping
            Every field by name.
        """
        return cls(**{**data, "failures": tuple(data["failures"])})
