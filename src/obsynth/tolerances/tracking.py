"""What an observer's state and outputs follow: the maps T and T0 of the identities, from a design."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import AffinePlant
from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.results.design import ObserverDesign

#: The identities of an observer of the nominal plant hold to this share of their terms.
IDENTITY_SHARE = 1e-7


class Tracking(NamedTuple):
    """``z`` follows ``T E x``, ``T (nz, nx)``; outputs use ``T0 (nx + nf + nr, nx)``: ``T0 (A x + B u + Bd d) = 0``."""

    T: FloatArray
    T0: FloatArray


def tracking_of(design: ObserverDesign, affine: AffinePlant) -> Tracking:
    """Return T and T0 of a linear design; `PreconditionError` where it estimates no full state, or they do not hold."""
    plant, observer = design.linear
    if any(observer.state_delays):
        raise PreconditionError(
            "The state estimate lags by some samples: what a tolerance does to newer states is not known from it, and "
            "no bound exists. Use a design whose estimate has no delay (detectability indexes of 1).",
            condition="full state estimate",
        )  # fmt: skip
    if observer.state_names != plant.state_names:
        raise PreconditionError(
            "The design does not estimate the full state, which a bound over tolerances needs.",
            condition="full state estimate",
        )
    given = design.certificate.matrices.get("tracking")
    if design.method == "pd-observer":
        t = np.eye(observer.order)[:, : plant.nx]
    elif given is not None:
        t = np.asarray(given[:, : plant.nx])
    else:
        t = _fitted(design)
    stored = design.certificate.matrices.get("algebraic")
    t0 = _algebraic_rows(observer, plant.E, t, affine) if stored is None else np.asarray(stored)
    return Tracking(t, t0)


def _fitted(design: ObserverDesign) -> FloatArray:
    """Return T by least squares from ``Az T E + By C = T A`` and ``Bu + By D = T B``."""
    plant, observer = design.linear
    n, nz = plant.nx, observer.order
    eye = np.eye(nz)
    left = [np.kron(observer.Az, plant.E.T) - np.kron(eye, plant.A.T), np.kron(eye, plant.B.T)]
    left.append(np.kron(observer.Cz[observer.state_rows], plant.E.T))
    shown = np.eye(n) - observer.Dy[observer.state_rows] @ plant.C
    right = [-(observer.By @ plant.C), observer.Bu + observer.By @ plant.D, shown]
    found = np.linalg.lstsq(np.vstack(left), np.concatenate([item.ravel() for item in right]), rcond=None)[0]
    return np.asarray(found.reshape(nz, n))


def _algebraic_rows(observer: LinearObserver, e: FloatArray, t: FloatArray, affine: AffinePlant) -> FloatArray:
    """Return T0: zero, unless the outputs use algebraic rows of the plant."""
    plant = affine.plant
    rows = len(observer.Cz)
    target = np.zeros((rows, plant.nx))
    target[observer.state_rows] = np.eye(plant.nx)
    missed = target - observer.Cz @ t @ e - observer.Dy @ plant.C
    size = np.abs(target) + np.abs(observer.Cz) @ np.abs(t @ e) + np.abs(observer.Dy) @ np.abs(plant.C)
    algebraic = ~e.any(axis=1)
    if not algebraic.any() or not np.any(np.abs(missed) > IDENTITY_SHARE * size.max(axis=1, keepdims=True)):
        return np.zeros((rows, plant.nx))
    found = np.zeros((rows, plant.nx))
    both = np.hstack([plant.A, plant.B])[algebraic]
    wanted = np.hstack([missed, -(observer.Du + observer.Dy @ plant.D)])
    found[:, algebraic] = np.linalg.lstsq(both.T, wanted.T, rcond=None)[0].T
    return found
