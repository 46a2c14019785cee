"""A realised filter that reads y alone, with the matrices T and T0 that relate its state to that of the plant."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.verification.error_system import ErrorModel


class RealisedFilter(NamedTuple):
    """A filter ``z+ = A z + B y`` with the outputs ``C z + D y``, and the matrices T and T0 of its error system.

    ``xa`` is the plant's state stacked with its last ``lag`` values. While only u acts on the plant, ``z = T E xa`` and
    the outputs are zero: ``A T E + B C = T Aa``, ``C T E + D C = T0 Aa`` and ``T0 E = 0``. The same holds with ``Bd``
    in place of the columns of u. Some states may be copies of modes of the plant.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    T: FloatArray
    T0: FloatArray
    lag: int
    undriven: int = 0  # number of last states that copy modes which no known input drives
    later: int = 0  # T and T0 belong to the filter with this delay in samples; the states of the delay come last


def behind_delay(observer: LinearObserver, samples: int) -> LinearObserver:
    """Return an observer with outputs delayed by this number of samples; the states of the delay come last."""
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
    """Return the observer without the delay that `behind_delay` added."""
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


def error_model_of(plant: DescriptorSystem, observer: LinearObserver, found: RealisedFilter) -> ErrorModel:
    """Return the error system of a shipped observer; outputs that depend on later inputs are delayed first."""
    whole = behind_delay(observer, found.later)
    return ErrorModel(plant, whole, found.T, -found.T0, lag=found.lag, decoupled=True, later=found.later)
