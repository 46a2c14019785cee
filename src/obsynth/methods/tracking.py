"""Tracked states: the states of the plant that a linear observer follows, for any method with an error model."""

from __future__ import annotations

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.methods.registry import error_model
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.transformations.uncertain_plant import AffinePlant
from obsynth.results.design import ObserverDesign
from obsynth.verification.error_system import IDENTITY_SHARE
from obsynth.verification.over_tolerances.error_structure import ErrorStructure, Tracking, error_structure


def tracking_of(design: ObserverDesign, affine: AffinePlant) -> Tracking:
    """Return T and T0 of a linear design; `PreconditionError` where it estimates no full state, or they do not hold."""
    plant, observer = design.linear
    if any(observer.state_delays):
        raise PreconditionError(
            "The state estimate has a delay: it does not determine the effect of a tolerance, or of a start "
            "(initial_set), on newer states, so that no bound exists. Use a design whose estimate has no delay "
            "(detectability indexes of 1), or state neither.",
            condition="full state estimate",
        )
    if observer.state_names != plant.state_names:
        raise PreconditionError(
            "The design does not estimate the full state, which a bound over tolerances, or from a start "
            "(initial_set), needs: take a fault-estimation-filter or a ui-pi-observer, or state neither.",
            condition="full state estimate",
        )
    model = error_model(design)
    t0 = _algebraic_rows(observer, plant.E, model.own, affine) if model.T0 is None else model.T0[:, : plant.nx]
    return Tracking(model.own, t0)


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
    multipliers = np.zeros((rows, plant.nx))
    coefficients = np.hstack([plant.A, plant.B])[algebraic]
    gaps = np.hstack([missed, -(observer.Du + observer.Dy @ plant.D)])
    multipliers[:, algebraic] = np.linalg.lstsq(coefficients.T, gaps.T, rcond=None)[0].T
    return multipliers


def structure_of(
    design: ObserverDesign,
    affine: AffinePlant,
    tracking: Tracking,
    *,
    bounds: FloatArray | None = None,
    noise_bound: float = 0.0,
    faults: bool = False,
    states: bool = False,
) -> ErrorStructure:
    """Return the error system of a discrete design over its box; ``bounds (nd,)`` of the disturbances of the plant."""
    plant, observer = design.linear
    if not plant.is_discrete:
        raise PreconditionError(
            "The design is continuous in time: bounds over tolerances are for sampled designs. Sample the plant first "
            "(transform: sample_time, or obsynth.discretise), or give online_monitor the sample time of its data.",
            condition="discrete time",
        )
    sizes = affine.disturbance_bounds(np.zeros(plant.nd) if bounds is None else bounds)
    return error_structure(
        observer,
        affine,
        tracking,
        sizes,
        noise_bound,
        faults=faults,
        states=states,
        varying=affine.box.variation == "varying",
    )
