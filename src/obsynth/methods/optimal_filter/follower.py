"""Filters that read y alone, with matrices T and T0 that relate the filter's state to that of the plant."""

from __future__ import annotations

from typing import NamedTuple

from obsynth.numerics.arrays import FloatArray


class Followed(NamedTuple):
    """A filter ``z+ = A z + B y``, rows ``C z + D y``, copies of modes included, with T and T0.

    Where u alone acts on the plant, ``z = T E xa``, xa the state with its last ``lag`` ones, and the rows are zero:
    ``A T E + B C = T Aa``, ``C T E + D C = T0 Aa``, ``T0 E = 0``; with ``Bd`` in place of u's columns likewise.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    T: FloatArray
    T0: FloatArray
    lag: int
    undriven: int = 0  # so many last states are copies of modes that no known input drives
