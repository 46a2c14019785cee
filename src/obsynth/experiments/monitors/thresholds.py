"""Thresholds for the norm of a residual: the paper's, one that is never passed without a fault, one for a window."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.between_samples import BetweenSamples
from obsynth.experiments.monitors.residual_model import ResidualModel
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import hinf_norm
from obsynth.numerics.peak_gain import peak_gain


class ScaledInputs(NamedTuple):
    """What drives a residual, each input scaled to at most one in absolute value.

    Fields: B, D: Inputs that change from sample to sample, ``(n, m)`` and ``(nr, m)``; between: ``(steps,)``: what
    signals that may do anything between samples add to the norm of the residual, at most; limit: The same at any later
    sample; start: ``(n, any)``: inputs of the first sample alone, straight to the error.
    """

    B: FloatArray
    D: FloatArray
    between: FloatArray
    limit: float
    start: FloatArray


def scaled_inputs(
    model: ResidualModel, bounds: FloatArray, noise_bound: float | None, *, any_stamps: bool = False
) -> ScaledInputs:
    """Return what drives the residual, with every input scaled to at most one in absolute value.

    Shapes: ``bounds (nd,)``.
    """
    between = None if model.continuous is None else model.continuous.between
    sampled = np.any(model.Bd != 0.0, axis=0) | np.any(model.Dd != 0.0, axis=0)
    reached = sampled if between is None else between.reached
    if np.any(reached & ~np.isfinite(bounds)):
        raise SpecError(
            "A disturbance has no bound (a Gaussian one has none): give disturbance_bounds (--disturbance), or use "
            "a statistical threshold.", path="disturbance_bounds",
        )  # fmt: skip
    if model.noisy and noise_bound is None:
        raise SpecError(
            "Gaussian noise has no pointwise bound: say by noise_bound (--noise-bound) how many standard deviations "
            "yours never exceeds, or use a statistical threshold (chi-square or cusum).", path="noise_bound",
        )  # fmt: skip
    sizes = np.where(reached, bounds, 0.0)
    factor = 0.0 if noise_bound is None else noise_bound
    nothing = np.zeros(model.steps)
    if model.sampled is not None:
        table, limits = model.sampled.of_disturbances(sizes, model.steps)
        none = np.zeros((len(model.A), 0))
        return ScaledInputs(factor * model.Bw, factor * model.Dw, table, float(np.sum(limits)), none)
    if between is None or model.continuous is None or model.flow is None:
        return ScaledInputs(
            np.hstack([model.Bd * sizes, factor * model.Bw]), np.hstack([model.Dd * sizes, factor * model.Dw]), nothing,
            0.0, np.zeros((len(model.A), 0)),
        )  # fmt: skip
    count = 0 if model.sensor_noise is None else model.sensor_noise[0].shape[1]
    process = factor * model.continuous.gathered_noise(between.plant)
    if any_stamps:
        return _at_any_stamps(model, between, sizes, factor)
    table, limits = between.of_disturbances(sizes, model.steps)
    noise, noise_limits = between.of_process_noise(process, model.steps)
    start = np.zeros((len(model.A), 0)) if model.start_noise is None else factor * model.start_noise
    limit = float(np.sum(limits) + np.sum(noise_limits))
    return ScaledInputs(factor * model.Bw[:, :count], factor * model.Dw[:, :count], table + noise, limit, start)


def _at_any_stamps(model: ResidualModel, between: BetweenSamples, sizes: FloatArray, factor: float) -> ScaledInputs:
    """Return what drives the residual of a continuous design whose samples may be at any stamps, none further apart."""
    (a, driven), count = model.flow or (model.A, model.Bd), 0
    total = float(np.sum(peak_gain(a, driven * sizes, model.C) + np.linalg.norm(model.Dd * sizes, axis=0)))
    if model.continuous is not None:
        total += between.at_any_stamps(sizes, model.continuous.observer)
    if model.sensor_noise is not None:
        into, direct = model.sensor_noise
        count = into.shape[1]
        total += factor * float(np.sum(peak_gain(a, into, model.C) + np.linalg.norm(direct, axis=0)))
    b, d = factor * model.Bw[:, count:], factor * model.Dw[:, count:]
    return ScaledInputs(b, d, np.full(model.steps, total), total, np.zeros((len(a), 0)))


def paper_threshold(model: ResidualModel, bounds: FloatArray, initial_error: float, gamma: float | None) -> FloatArray:
    """Return (66) of Wang et al. 2015 with the norm of the power where the paper has the power of the norm.

    Shapes: ``bounds (nd,)``.
    """
    if model.flow is not None:
        raise SpecError("Eq. (66) is for discrete designs: use pointwise, or sample the plant first.",
                        path="kind")  # fmt: skip
    if not np.isfinite(bounds).all():
        raise SpecError("The paper's threshold needs a bound of each disturbance.", path="disturbance_bounds")
    gain = hinf_norm(model.A, model.Bd, model.C, model.Dd).upper if gamma is None else gamma
    decay = np.array([np.linalg.norm(power, 2) for power in model.powers()])
    return np.hypot(gain * float(np.linalg.norm(bounds)), float(np.linalg.norm(model.C, 2)) * decay * initial_error)


def pointwise_threshold(model: ResidualModel, inputs: ScaledInputs, initial_error: float) -> FloatArray:
    """Return what the norm of the residual never passes: exact initial-error term and l1 (peak) gains of each input."""
    powers = model.powers()
    start = np.array([np.linalg.norm(model.C @ power, 2) for power in powers]) * initial_error
    start += np.array([np.sum(np.linalg.norm(model.C @ power @ inputs.start, axis=0)) for power in powers])
    gathered = np.array([np.sum(np.linalg.norm(model.C @ power @ inputs.B, axis=0)) for power in powers])
    earlier = np.concatenate([[0.0], np.cumsum(gathered)[:-1]])
    return np.asarray(start + earlier + np.sum(np.linalg.norm(inputs.D, axis=0)) + inputs.between)


def window_threshold(model: ResidualModel, inputs: ScaledInputs, initial_error: float, window: int) -> FloatArray:
    """Return what the l2 norm of the residual over the last ``window`` samples never passes.

    The inputs give at most their l2 gain times ``sqrt(window m)``; the error at the window's start gives the square
    root of its energy, bounded as the pointwise bound is.  No window has more than the pointwise bounds of its samples,
    summed up in squares: that is used where it is less, and for continuous designs, whose disturbances may do anything
    between samples.
    """
    one_by_one = pointwise_threshold(model, inputs, initial_error)
    summed = np.array([np.linalg.norm(one_by_one[max(k - window + 1, 0) : k + 1]) for k in range(model.steps)])
    if model.flow is not None or model.sampled is not None:
        return summed
    B, D = inputs.B, inputs.D
    powers = model.powers()
    count = int(np.sum(np.any(B != 0.0, axis=0) | np.any(D != 0.0, axis=0)))
    gain = hinf_norm(model.A, B, model.C, D).upper if count else 0.0
    bound = np.empty(model.steps)
    energy = np.zeros_like(model.A)
    roots = []
    for power in powers[:window]:
        shown = model.C @ power
        energy = energy + shown.T @ shown
        values, vectors = np.linalg.eigh((energy + energy.T) / 2.0)
        roots.append(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
    for k in range(model.steps):
        length = min(window, k + 1)
        bound[k] = gain * np.sqrt(length * count) + (
            0.0 if k + 1 > window else float(np.linalg.norm(roots[length - 1], 2)) * initial_error
        )
    full = roots[-1]
    gathered = np.cumsum([0.0, *(np.sum(np.linalg.norm(full @ power @ B, axis=0)) for power in powers)])
    for k in range(window, model.steps):
        begin = k - window + 1
        bound[k] += float(np.linalg.norm(full @ powers[begin], 2)) * initial_error + gathered[begin]
    return np.asarray(np.minimum(bound, summed))
