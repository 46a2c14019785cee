"""A tank whose pump loses a share of its flow, which is estimated: a parameter that walks."""

from __future__ import annotations

import functools

import obsynth

DT = 0.1


@functools.cache
def pumped() -> obsynth.ObserverDesign:
    """Return the design."""
    model = obsynth.DAEModel(
        {"tank": "der(h) = 10 * (1 - f) * u - h"}, {"y": "h"}, states={"h": 0.0}, inputs={"u": 0.0},
        parameters={"f": 0.0},
    )  # fmt: skip
    return obsynth.dae_adaptive_observer(
        model, dt=DT, Q=[[1e-4]], R=[[0.01]], form="augmented-kalman", random_walk=[[1e-4]],
        initial_covariance=[[0.01]], initial_parameter_covariance=[[0.01]],
    )  # fmt: skip
