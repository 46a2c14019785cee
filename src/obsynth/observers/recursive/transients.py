"""How long a recursive observer remembers its start."""

from __future__ import annotations

import math

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.recursive.gain_schedule import gain_steps
from obsynth.observers.recursive.observer import RecursiveObserver

#: Steps that are looked at where a model goes on for ever.
MOST_STEPS = 2_000
#: An error this far below the share that counts is gone.
GONE = 1e-4


def transient_steps(observer: RecursiveObserver, share: float) -> float:
    """Return the steps after which an error at the start has shrunk to a share of its largest, and stays there."""
    horizon = observer.plant.horizon
    steps = min(MOST_STEPS, MOST_STEPS if horizon is None else horizon)
    if observer.early_constraints and horizon is not None:
        steps = min(steps, max(horizon - 1, 1))
    errors: list[float] = []
    lessons: list[float] = []
    state = memory = np.zeros((0, 0))
    for gains in gain_steps(observer, steps):
        if not errors:
            state, memory = np.eye(gains.step.A.shape[1]), np.eye(len(gains.forget))
        state = gains.gain[:, : len(gains.step.A)] @ gains.step.A @ state
        memory = gains.forget @ memory
        errors.append(_size(state))
        lessons.append(_size(memory))
        if not (np.isfinite(errors[-1]) and np.isfinite(lessons[-1])):
            return math.inf
        # So far below that it will not come back: a plant that lasts for ever need not be followed to the end.
        if errors[-1] <= GONE * share * max(1.0, *errors) and lessons[-1] <= GONE * share * max(1.0, *lessons):
            break
    return max(_forgotten(errors, share), _forgotten(lessons, share))


def _size(product: FloatArray) -> float:
    return float(np.abs(product).max(initial=0.0))


def _forgotten(sizes: list[float], share: float) -> float:
    # What is compared is each product with its own largest size: units of the states do not decide.
    late = np.flatnonzero(np.array([1.0, *sizes]) > share * max([1.0, *sizes]))
    last = int(late[-1]) if late.size else -1
    return math.inf if last >= len(sizes) else float(last + 1)
