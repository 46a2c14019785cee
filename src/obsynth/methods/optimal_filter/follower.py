"""Filters that read y alone, with matrices T and T0 that relate the filter's state to that of the plant."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.verification.error_system import ErrorModel


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
    later: int = 0  # T and T0 are of the filter behind so many samples of delay, whose states are the last ones


def behind_delay(observer: LinearObserver, samples: int) -> LinearObserver:
    """Return an observer whose rows come so many samples later, as states at the end of its own."""
    for _ in range(samples):
        rows, order = observer.Cz.shape
        observer = replace(
            observer,
            Az=np.block([[observer.Az, np.zeros((order, rows))], [observer.Cz, np.zeros((rows, rows))]]),
            Bu=np.vstack([observer.Bu, observer.Du]),
            By=np.vstack([observer.By, observer.Dy]),
            Cz=np.hstack([np.zeros((rows, order)), np.eye(rows)]),
            Du=np.zeros_like(observer.Du),
            Dy=np.zeros_like(observer.Dy),
        )
    return observer


def before_delay(observer: LinearObserver, samples: int) -> LinearObserver:
    """Return the observer that another one delays by so many samples: see `behind_delay`."""
    for _ in range(samples):
        own = observer.order - len(observer.Cz)
        observer = replace(
            observer,
            Az=observer.Az[:own, :own],
            Bu=observer.Bu[:own],
            By=observer.By[:own],
            Cz=observer.Az[own:, :own],
            Du=observer.Bu[own:],
            Dy=observer.By[own:],
        )
    return observer


def error_model_of(plant: DescriptorSystem, observer: LinearObserver, found: Followed) -> ErrorModel:
    """Return what a shipped observer follows: of outputs that show inputs of later samples, by rows that are later."""
    whole = behind_delay(observer, found.later)
    return ErrorModel(plant, whole, found.T, -found.T0, lag=found.lag, decoupled=True, later=found.later)
