"""Guaranteed bounds on the norm of a residual, or of a window of it, beside (66) of Wang et al. 2015.

For records of known length, and of any length: a table for the start, and one limit for all later samples.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.residual_model import ContinuousDesign, ResidualModel, schur_form
from obsynth.numerics.arrays import FloatArray, largest_singular_value, sums_of_column_norms
from obsynth.numerics.continuous import peak_gain
from obsynth.numerics.matrix_equations import continuous_lyapunov
from obsynth.numerics.norms import hinf_norm, state_units
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.noise import is_noise_assumed
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.verification.over_tolerances.responses import OUTWARD

#: Share of an initial error that remains after the table: it then decides nothing, and the table stays short.
REMAINDER_AFTER_TABLE = 1e-3

#: Longest table, and most numbers in its powers.
LONGEST_TABLE, MOST_NUMBERS = 16_384, 20_000_000

#: A bound by the number of samples since the start: a table, and a limit for every later one.
UnlimitedHorizonBound: TypeAlias = tuple[FloatArray, float]


class ScaledInputs(NamedTuple):
    """What drives a residual, each input scaled to at most one: ``B (n, m)``, ``D (nr, m)`` from sample to sample."""

    B: FloatArray
    D: FloatArray
    between: FloatArray  # ``(steps,)``: what signals that do anything between samples add to the norm
    limit: float  # what they add later, at most
    start: FloatArray  # ``(n, any)``: inputs of the first sample alone, straight to the error


def scaled_inputs(
    model: ResidualModel,
    bounds: FloatArray,
    noise_bound: float | None,
    plant: DescriptorSystem | PolytopicSystem,
    *,
    any_stamps: bool = False,
) -> ScaledInputs:
    """Return what drives the residual, with every input scaled to at most one in absolute value; ``bounds (nd,)``."""
    continuous = model.continuous
    between = None if continuous is None else continuous.between
    sampled = np.any(model.Bd != 0.0, axis=0) | np.any(model.Dd != 0.0, axis=0)
    reached = sampled if between is None else between.reached
    if np.any(lacking := reached & ~np.isfinite(bounds)):
        names = ", ".join(plant.disturbance_names[int(i)] for i in np.flatnonzero(lacking))
        raise SpecError(
            f"No bound is given on {names} (a Gaussian disturbance has none): give disturbance_bounds (--disturbance), "
            "or use a statistical threshold.",
            path="disturbance_bounds",
        )
    if model.noisy and noise_bound is None:
        assumed = (
            "No noise is stated, and one of deviation 1 is assumed on every sensor: state that of your sensors "
            "(sensor_noise of the plant). "
        )
        raise SpecError(
            f"{assumed if is_noise_assumed(plant.noise_names) else ''}Gaussian noise has no pointwise "
            "bound: state noise_bound (--noise-bound), the number of standard deviations that yours never exceeds, or "
            "use a statistical threshold (chi-square or cusum).",
            path="noise_bound",
        )
    sizes = np.where(reached, bounds, 0.0)
    factor = 0.0 if noise_bound is None else noise_bound
    none = np.zeros((len(model.A), 0))
    if model.sampled is not None:
        table, limits = model.sampled.of_disturbances(sizes, model.steps)
        return ScaledInputs(factor * model.Bw, factor * model.Dw, table, float(np.sum(limits)), none)
    if between is None or continuous is None:
        b, d = np.hstack([model.Bd * sizes, factor * model.Bw]), np.hstack([model.Dd * sizes, factor * model.Dw])
        return ScaledInputs(b, d, np.zeros(model.steps), 0.0, none)
    if any_stamps:
        return _at_any_stamps(model, continuous, sizes, factor)
    count = int(continuous.sensors.sum())
    process = factor * continuous.gathered_noise(between.plant)
    table, limits = between.of_disturbances(sizes, model.steps)
    noise, noise_limits = between.of_process_noise(process, model.steps)
    limit, start = float(np.sum(limits) + np.sum(noise_limits)), factor * continuous.start_noise
    return ScaledInputs(factor * model.Bw[:, :count], factor * model.Dw[:, :count], table + noise, limit, start)


def _at_any_stamps(
    model: ResidualModel, continuous: ContinuousDesign, sizes: FloatArray, factor: float
) -> ScaledInputs:
    """Return what drives the residual of a continuous design whose samples may be at any stamps, none further apart."""
    a, driven, (into, direct) = model.errors.Az, model.errors.disturbance, continuous.sensor_noise
    total = float(np.sum(peak_gain(a, driven * sizes, model.C) + np.linalg.norm(model.Dd * sizes, axis=0)))
    total += continuous.between.at_any_stamps(sizes, continuous.observer)
    total += factor * float(np.sum(peak_gain(a, into, model.C) + np.linalg.norm(direct, axis=0)))
    b, d = factor * model.Bw[:, into.shape[1] :], factor * model.Dw[:, into.shape[1] :]
    return ScaledInputs(b, d, np.full(model.steps, total), total, np.zeros((len(a), 0)))


def paper_threshold(model: ResidualModel, bounds: FloatArray, initial_error: float, gamma: float | None) -> FloatArray:
    """Return (66) of Wang et al. 2015 with the norm of the power where the paper has the power of the norm."""
    if model.continuous is not None:
        raise SpecError("Eq. (66) is for discrete designs: use pointwise, or sample the plant first.", path="kind")
    if not np.isfinite(bounds).all():
        raise SpecError("The paper's threshold needs a bound of each disturbance.", path="disturbance_bounds")
    gain = hinf_norm(model.A, model.Bd, model.C, model.Dd).upper if gamma is None else gamma
    decay = np.array([np.linalg.norm(power, 2) for power in model.powers()])
    return np.hypot(gain * float(np.linalg.norm(bounds)), largest_singular_value(model.C) * decay * initial_error)


def pointwise_threshold(model: ResidualModel, inputs: ScaledInputs, initial_error: float) -> FloatArray:
    """Return what the norm of the residual never passes: exact initial-error term and l1 (peak) gains of each input.
    Larger by more than rounding of these sums and of the residual: noise may be at its bounds with the worst signs."""
    powers = model.powers()
    responses = [model.C @ power for power in powers]
    start = np.array([np.linalg.norm(c, 2) for c in responses]) * initial_error
    start += np.array([_columns(c @ inputs.start) for c in responses])
    start += _remainder_of_powers(model, powers, np.hstack([inputs.start, initial_error * np.eye(len(model.A))]))
    per_sample = np.array([_columns(c @ inputs.B) for c in responses]) + _remainder_of_powers(model, powers, inputs.B)
    earlier = np.concatenate([[0.0], np.cumsum(per_sample)[:-1]])
    return np.asarray((start + earlier + _columns(inputs.D) + inputs.between) * OUTWARD)


def _remainder_of_powers(model: ResidualModel, powers: list[FloatArray], columns: FloatArray) -> FloatArray:
    """Return what rounding of the powers may hide of columns ``(n, m)`` at each sample, to the first order.

    Where entries of A cancel, powers keep half of their digits.  What ``C A^k`` misses by from one sample to the next
    is found, and moves on by A as everything does.
    """
    if not columns.any():
        return np.zeros(len(powers))
    # In these units what is added up has one size.
    units = state_units(model.A, columns, model.C)
    a, responses = model.A * units / units[:, None], [model.C @ power * units for power in powers]
    share = len(a) * np.finfo(float).eps
    missed = [
        np.linalg.norm(after - before @ a) + share * np.linalg.norm(np.abs(before) @ np.abs(a))
        for before, after in itertools.pairwise(responses)
    ]
    sizes = [_columns(power @ columns / units[:, None]) for power in powers[:-1]]
    return np.concatenate([[0.0], np.convolve(missed, sizes)[: len(missed)]]) if missed else np.zeros(1)


def _columns(matrix: FloatArray) -> float:
    """Return the sum of the norms of columns."""
    return float(sums_of_column_norms(matrix))


def _stacked_norms(responses: list[FloatArray], window: int) -> FloatArray:
    """Return the spectral norm of every ``window`` successive matrices ``(nr, n)``, one above the other."""
    rows = np.array(responses)
    squares = rows.transpose(0, 2, 1) @ rows
    count = len(squares) - window + 1
    # Added up anew for each window: late ones are far smaller than those before.
    energy = np.sum([squares[j : j + count] for j in range(window)], axis=0)
    return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(energy)[:, -1], 0.0))) if rows.size else np.zeros(count)


def _windowed_sums(values: FloatArray, window: int) -> FloatArray:
    """Return the sum of every ``window`` successive values."""
    return np.asarray(np.sum(sliding_window_view(values, window), axis=-1))


def norms_of_windows(values: FloatArray, window: int) -> FloatArray:
    """Return the norm of the last ``window`` values at each of them, of fewer at the start."""
    return np.array([np.linalg.norm(values[max(k - window + 1, 0) : k + 1]) for k in range(len(values))])


def _stacked_columns(responses: list[FloatArray], hidden: FloatArray, window: int) -> FloatArray:
    """Return the sum of the norms of the columns of every ``window`` successive matrices, one above the other; what
    rounding hides of each, ``hidden``, is added."""
    columns = np.array([np.linalg.norm(part, axis=0) for part in responses])
    norms = np.linalg.norm(sliding_window_view(columns, window, axis=0), axis=-1)
    return np.asarray(np.sum(norms, axis=-1) + _windowed_sums(hidden, window))


def _window_gain(model: ResidualModel, inputs: ScaledInputs) -> tuple[float, int]:
    """Return the l2 gain from the inputs to the residual, and how many of them there are."""
    count = int(np.sum(np.any(inputs.B != 0.0, axis=0) | np.any(inputs.D != 0.0, axis=0)))
    return hinf_norm(model.A, inputs.B, model.C, inputs.D).upper if count else 0.0, count


def window_threshold(model: ResidualModel, inputs: ScaledInputs, initial_error: float, window: int) -> FloatArray:
    """Return what the l2 norm of the residual over the last ``window`` samples never passes.
    Inputs: l2 gain times ``sqrt(window m)``; the error at the start: the root of its energy.  Or the pointwise bounds
    summed up in squares, where less, and for what moves between samples."""
    summed = norms_of_windows(pointwise_threshold(model, inputs, initial_error), window)
    if model.continuous is not None or model.sampled is not None:
        return summed
    powers, (gain, count) = model.powers(), _window_gain(model, inputs)
    responses = [model.C @ power for power in powers]
    # Before the window is full it begins with the record.
    before, length = [np.zeros_like(model.C)] * (window - 1), np.minimum(np.arange(model.steps) + 1, window)
    hidden = _remainder_of_powers(model, powers, initial_error * np.eye(len(model.A)))
    start = _stacked_norms(before + responses, window) * initial_error
    start += _windowed_sums(np.concatenate([np.zeros(window - 1), hidden]), window)
    earlier = np.zeros(model.steps)
    if window < model.steps:
        hidden_inputs = _remainder_of_powers(model, powers, inputs.B)
        gathered = np.cumsum(_stacked_columns([part @ inputs.B for part in responses], hidden_inputs, window))
        earlier[window:] = gathered[: model.steps - window]
    bound = (gain * np.sqrt(length * count) + start + earlier) * OUTWARD
    return np.asarray(np.minimum(bound, summed))


def samples_of(transition: FloatArray, window: int) -> int:
    """Return the length of a table of ``transition (n, n)``, after which `REMAINDER_AFTER_TABLE` of a start is left."""
    # Entries that cancel hide the eigenvalues in the powers of a matrix, but not in those of its Schur form.
    power, count = schur_form(transition)[0], 1
    while len(power) and not np.linalg.norm(power, 2) <= REMAINDER_AFTER_TABLE:
        power, count = np.triu(power @ power), 2 * count
        if count > LONGEST_TABLE or count * power.size > MOST_NUMBERS or not np.isfinite(power).all():
            raise SpecError(
                "Errors of the observer decay too slowly at this sampling for a bound for ever: use a statistical "
                "monitor, or obsynth.monitor for a record of known length.",
                path="monitor",
            )
    return max(count, 1) + window


def unlimited_bound(
    kind: str, model: ResidualModel, inputs: ScaledInputs, initial_error: float, window: int
) -> UnlimitedHorizonBound:
    """Return the pointwise or window bound for records of any length."""
    powers = model.powers()
    last = powers[-1] @ model.A
    contraction = largest_singular_value(last)
    gains = [largest_singular_value(model.C @ power) for power in powers]
    # Of k = m N + j samples, m N shrink by left^m: inputs of that age, and the start, add no more than this.
    aged = _columns(last @ inputs.B) * sum(gains) / (1.0 - contraction)
    if not np.isfinite(inputs.limit):
        # What outputs do between stamps that may be anywhere has no bound.
        return np.full(model.steps, np.inf), np.inf
    bare = pointwise_threshold(model, inputs, 0.0)
    pointwise = float(bare[-1] - inputs.between[-1]) + inputs.limit + gains[-1] * _columns(inputs.B) + aged
    begins = initial_error + _columns(inputs.start)
    start = max(gains) * contraction * begins
    if kind == "pointwise":
        return _start_added(model, bare, initial_error) * OUTWARD, (pointwise + start) * OUTWARD
    table = window_threshold(model, inputs, initial_error, window)
    # No window has more energy than its samples one by one; for a sampled plant its own bound may be smaller.
    # Such a window may begin in the table, where more is left of the start.
    start = max(max(gains[-window:]), max(gains) * contraction) * begins
    limit = float(np.sqrt(window)) * (pointwise + start) * OUTWARD
    if model.continuous is None and model.sampled is None:
        limit = min(limit, _window_limit(model, inputs, (initial_error, contraction, last), window))
    return table, limit


def _window_limit(
    model: ResidualModel, inputs: ScaledInputs, start_of: tuple[float, float, FloatArray], window: int
) -> float:
    """Return the l2 bound of a window that begins after the table, see `window_threshold`."""
    (initial_error, contraction, last), (gain, count) = start_of, _window_gain(model, inputs)
    # A window that begins with the table's last sample ends after it.
    longer = replace(model, steps=model.steps + window - 1)
    powers = longer.powers()
    responses = [model.C @ power for power in powers]
    hidden = _windowed_sums(_remainder_of_powers(longer, powers, np.eye(len(model.A))), window)
    sizes = _stacked_norms(responses, window) + hidden
    remainder_of_inputs = _remainder_of_powers(longer, powers, inputs.B)
    gathered = float(np.sum(_stacked_columns([part @ inputs.B for part in responses], remainder_of_inputs, window)))
    aged = _columns(last @ inputs.B) * float(np.sum(sizes)) / (1.0 - contraction)
    start = float(max(np.max(sizes) * contraction, np.max(sizes[-window:]))) * initial_error
    return (gain * float(np.sqrt(window * count)) + gathered + aged + start) * OUTWARD


def unlimited_paper(
    model: ResidualModel, bounds: FloatArray, initial_error: float, gamma: float | None
) -> UnlimitedHorizonBound:
    """Return (66) of Wang et al. 2015 for records of any length."""
    table = paper_threshold(model, bounds, initial_error, gamma)
    return table, float(table[-1])


def _start_added(model: ResidualModel, bare: FloatArray, initial_error: float) -> FloatArray:
    """Return the bound with the start's; of a continuous design one that holds until the next sample."""
    if model.continuous is None or not initial_error:
        return bare + np.array([np.linalg.norm(model.C @ power, 2) for power in model.powers()]) * initial_error

    # In the norm of a Lyapunov function a free motion never grows.
    a = model.errors.Az
    root = np.linalg.cholesky(continuous_lyapunov(a.T, -np.eye(len(a)))).T
    reading_gain = largest_singular_value(np.linalg.solve(root.T, model.C.T))
    return bare + np.array([reading_gain * np.linalg.norm(root @ power, 2) for power in model.powers()]) * initial_error
