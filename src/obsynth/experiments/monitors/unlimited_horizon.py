"""Bounds on a residual for records of any length: a table for the start, and one number for ever after."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.residual_model import ResidualModel
from obsynth.experiments.monitors.thresholds import ScaledInputs, paper_threshold, pointwise_threshold, window_threshold
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import hinf_norm

#: What is left of an error after the table.
LEFT = 1e-3
#: Longest table, and most numbers in its powers.
MOST_SAMPLES, MOST_NUMBERS = 16_384, 20_000_000


class UnlimitedHorizonBound(NamedTuple):
    """A bound by the number of samples since the start.

    Fields: table: At samples 0, 1, ; limit: At every later one.
    """

    table: FloatArray
    limit: float


def samples_of(transition: FloatArray, window: int) -> int:
    """Return how many samples a table needs until an error at the start has shrunk to `LEFT`.

    Shapes: ``transition (n, n)``.
    """
    power, count = transition, 1
    while len(power) and not np.linalg.norm(power, 2) <= LEFT:
        power, count = power @ power, 2 * count
        if count > MOST_SAMPLES or count * power.size > MOST_NUMBERS:
            raise SpecError(
                "The observer forgets too slowly at this sampling for a bound for ever: use a statistical monitor, or "
                "obsynth.monitor for a record of known length.", path="monitor",
            )  # fmt: skip
    return max(count, 1) + window


def unlimited_bound(
    kind: str, model: ResidualModel, inputs: ScaledInputs, initial_error: float, window: int
) -> UnlimitedHorizonBound:
    """Return the pointwise or window bound for records of any length."""
    powers = model.powers()
    last = powers[-1] @ model.A
    left = float(np.linalg.norm(last, 2)) if last.size else 0.0
    shown = [float(np.linalg.norm(model.C @ power, 2)) for power in powers]
    # Of k = m N + j samples, m N shrink by left^m: inputs of that age, and the start, add no more than this.
    aged = float(np.sum(np.linalg.norm(last @ inputs.B, axis=0))) * sum(shown) / (1.0 - left)
    bare = pointwise_threshold(model, inputs, 0.0)
    pointwise = (
        float(bare[-1] - inputs.between[-1])
        + inputs.limit
        + shown[-1] * float(np.sum(np.linalg.norm(inputs.B, axis=0)))
        + aged
    )
    begins = initial_error + float(np.sum(np.linalg.norm(inputs.start, axis=0)))
    start = max(shown) * left * begins
    if kind == "pointwise":
        return UnlimitedHorizonBound(_start_added(model, bare, initial_error), pointwise + start)
    table = window_threshold(model, inputs, initial_error, window)
    # No window has more energy than its samples one by one; for a sampled plant its own bound may be smaller.
    # Such a window may begin in the table, where more is left of the start.
    start = max(max(shown[-window:]), max(shown) * left) * begins
    limit = float(np.sqrt(window)) * (pointwise + start)
    if model.flow is None and model.sampled is None:
        limit = min(limit, _window_limit(model, inputs, (initial_error, left, last), window))
    return UnlimitedHorizonBound(table, limit)


def _window_limit(
    model: ResidualModel, inputs: ScaledInputs, start_of: tuple[float, float, FloatArray], window: int
) -> float:
    """Return the l2 bound of a window that begins after the table, see `window_threshold`."""
    initial_error, left, last = start_of
    powers = model.powers()
    energy = sum((model.C @ power).T @ (model.C @ power) for power in powers[:window])
    values, vectors = np.linalg.eigh(energy)
    full = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    sizes = [float(np.linalg.norm(full @ power, 2)) for power in powers]
    gathered = sum(float(np.sum(np.linalg.norm(full @ power @ inputs.B, axis=0))) for power in powers)
    aged = float(np.sum(np.linalg.norm(last @ inputs.B, axis=0))) * sum(sizes) / (1.0 - left)
    count = int(np.sum(np.any(inputs.B != 0.0, axis=0) | np.any(inputs.D != 0.0, axis=0)))
    gain = hinf_norm(model.A, inputs.B, model.C, inputs.D).upper if count else 0.0
    start = max(max(sizes) * left, max(sizes[-window:])) * initial_error
    return gain * float(np.sqrt(window * count)) + gathered + aged + start


def unlimited_paper(
    model: ResidualModel, bounds: FloatArray, initial_error: float, gamma: float | None
) -> UnlimitedHorizonBound:
    """Return (66) of Wang et al. 2015 for records of any length.

    Shapes: ``bounds (nd,)``.
    """
    table = paper_threshold(model, bounds, initial_error, gamma)
    return UnlimitedHorizonBound(table, float(table[-1]))


def _start_added(model: ResidualModel, bare: FloatArray, initial_error: float) -> FloatArray:
    """Return the bound with the start's; of a continuous design one that holds until the next sample."""
    if model.flow is None or not initial_error:
        return bare + np.array([np.linalg.norm(model.C @ power, 2) for power in model.powers()]) * initial_error
    from scipy.linalg import solve_continuous_lyapunov

    # In the norm of a Lyapunov function a free motion never grows.
    a = model.flow[0]
    root = np.linalg.cholesky(solve_continuous_lyapunov(a.T, -np.eye(len(a)))).T
    seen = float(np.linalg.norm(np.linalg.solve(root.T, model.C.T), 2))
    return bare + np.array([seen * np.linalg.norm(root @ power, 2) for power in model.powers()]) * initial_error
