"""Bounds of the norm of a residual, or of a window of it: the paper's, and such as are never passed without a fault.

For records of known length, and of any length: a table for the start, and one number for ever after.

The covariance of a window of residuals, and what whitens it: only innovations are white as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.residual_model import ContinuousDesign, ResidualModel, schur_form
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.continuous import peak_gain
from obsynth.numerics.norms import hinf_norm, output_covariance, spectral_radius
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE
from obsynth.verification.responses import OUTWARD


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
    disturbances: Sequence[str],
    *,
    any_stamps: bool = False,
) -> ScaledInputs:
    """Return what drives the residual, with every input scaled to at most one in absolute value; ``bounds (nd,)``."""
    continuous = model.continuous
    between = None if continuous is None else continuous.between
    sampled = np.any(model.Bd != 0.0, axis=0) | np.any(model.Dd != 0.0, axis=0)
    reached = sampled if between is None else between.reached
    if np.any(lacking := reached & ~np.isfinite(bounds)):
        names = ", ".join(disturbances[int(i)] for i in np.flatnonzero(lacking))
        raise SpecError(
            f"No bound is given on {names} (a Gaussian disturbance has none): give disturbance_bounds (--disturbance), "
            "or use a statistical threshold.",
            path="disturbance_bounds",
        )
    if model.noisy and noise_bound is None:
        raise SpecError(
            "Gaussian noise has no pointwise bound: state noise_bound (--noise-bound), the number of standard "
            "deviations that yours never exceeds, or use a statistical threshold (chi-square or cusum).",
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
    return np.hypot(gain * float(np.linalg.norm(bounds)), float(np.linalg.norm(model.C, 2)) * decay * initial_error)


def pointwise_threshold(model: ResidualModel, inputs: ScaledInputs, initial_error: float) -> FloatArray:
    """Return what the norm of the residual never passes: exact initial-error term and l1 (peak) gains of each input.
    Larger by more than rounding of these sums and of the residual: noise may be at its bounds with the worst signs."""
    shown = [model.C @ power for power in model.powers()]
    start = np.array([np.linalg.norm(c, 2) for c in shown]) * initial_error
    start += np.array([_columns(c @ inputs.start) for c in shown])
    earlier = np.concatenate([[0.0], np.cumsum([_columns(c @ inputs.B) for c in shown])[:-1]])
    return np.asarray((start + earlier + _columns(inputs.D) + inputs.between) * OUTWARD)


def _columns(matrix: FloatArray) -> float:
    """Return the sum of the norms of columns."""
    return float(np.sum(np.linalg.norm(matrix, axis=0)))


def _energy_roots(model: ResidualModel, powers: list[FloatArray]) -> list[FloatArray]:
    """Return R with ``R'R = sum (C A^k)' C A^k`` for sums of one sample and more: what an error shows in these."""
    energy, roots = np.zeros_like(model.A), []
    for power in powers:
        shown = model.C @ power
        energy = energy + shown.T @ shown
        values, vectors = np.linalg.eigh((energy + energy.T) / 2.0)
        roots.append(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
    return roots


def _window_gain(model: ResidualModel, inputs: ScaledInputs) -> tuple[float, int]:
    """Return the l2 gain from the inputs to the residual, and how many of them there are."""
    count = int(np.sum(np.any(inputs.B != 0.0, axis=0) | np.any(inputs.D != 0.0, axis=0)))
    return hinf_norm(model.A, inputs.B, model.C, inputs.D).upper if count else 0.0, count


def window_threshold(model: ResidualModel, inputs: ScaledInputs, initial_error: float, window: int) -> FloatArray:
    """Return what the l2 norm of the residual over the last ``window`` samples never passes.
    Inputs: l2 gain times ``sqrt(window m)``; the error at the start: the root of its energy.  Or the pointwise bounds
    summed up in squares, where less, and for what moves between samples."""
    one_by_one = pointwise_threshold(model, inputs, initial_error)
    summed = np.array([np.linalg.norm(one_by_one[max(k - window + 1, 0) : k + 1]) for k in range(model.steps)])
    if model.continuous is not None or model.sampled is not None:
        return summed
    powers, (gain, count) = model.powers(), _window_gain(model, inputs)
    roots = _energy_roots(model, powers[:window])
    full = roots[-1]
    gathered = np.cumsum([0.0, *(_columns(full @ power @ inputs.B) for power in powers)])
    bound = np.empty(model.steps)
    for k in range(model.steps):
        length, begin = min(window, k + 1), max(k - window + 1, 0)
        # Before the window is full it begins with the record.
        left = roots[k] if k + 1 <= window else full @ powers[begin]
        bound[k] = gain * np.sqrt(length * count) + float(np.linalg.norm(left, 2)) * initial_error + gathered[begin]
    return np.asarray(np.minimum(bound, summed))


#: What is left of an error after the table.
LEFT_AFTER_TABLE = 1e-3
#: Longest table, and most numbers in its powers.
LONGEST_TABLE, MOST_NUMBERS = 16_384, 20_000_000


class UnlimitedHorizonBound(NamedTuple):
    """A bound by the number of samples since the start: a table, and a limit for every later one."""

    table: FloatArray
    limit: float


def samples_of(transition: FloatArray, window: int) -> int:
    """Return how many samples a table of ``transition (n, n)`` needs until `LEFT_AFTER_TABLE` of a start is left."""
    # Entries that cancel hide the eigenvalues in the powers of a matrix, but not in those of its Schur form.
    power, count = schur_form(transition)[0], 1
    while len(power) and not np.linalg.norm(power, 2) <= LEFT_AFTER_TABLE:
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
    left = float(np.linalg.norm(last, 2)) if last.size else 0.0
    shown = [float(np.linalg.norm(model.C @ power, 2)) for power in powers]
    # Of k = m N + j samples, m N shrink by left^m: inputs of that age, and the start, add no more than this.
    aged = _columns(last @ inputs.B) * sum(shown) / (1.0 - left)
    bare = pointwise_threshold(model, inputs, 0.0)
    pointwise = float(bare[-1] - inputs.between[-1]) + inputs.limit + shown[-1] * _columns(inputs.B) + aged
    begins = initial_error + _columns(inputs.start)
    start = max(shown) * left * begins
    if kind == "pointwise":
        return UnlimitedHorizonBound(_start_added(model, bare, initial_error) * OUTWARD, (pointwise + start) * OUTWARD)
    table = window_threshold(model, inputs, initial_error, window)
    # No window has more energy than its samples one by one; for a sampled plant its own bound may be smaller.
    # Such a window may begin in the table, where more is left of the start.
    start = max(max(shown[-window:]), max(shown) * left) * begins
    limit = float(np.sqrt(window)) * (pointwise + start) * OUTWARD
    if model.continuous is None and model.sampled is None:
        limit = min(limit, _window_limit(model, inputs, (initial_error, left, last), window))
    return UnlimitedHorizonBound(table, limit)


def _window_limit(
    model: ResidualModel, inputs: ScaledInputs, start_of: tuple[float, float, FloatArray], window: int
) -> float:
    """Return the l2 bound of a window that begins after the table, see `window_threshold`."""
    (initial_error, left, last), (gain, count) = start_of, _window_gain(model, inputs)
    powers = model.powers()
    full = _energy_roots(model, powers[:window])[-1]
    sizes = [float(np.linalg.norm(full @ power, 2)) for power in powers]
    gathered = sum(_columns(full @ power @ inputs.B) for power in powers)
    aged = _columns(last @ inputs.B) * sum(sizes) / (1.0 - left)
    start = max(max(sizes) * left, max(sizes[-window:])) * initial_error
    return gain * float(np.sqrt(window * count)) + gathered + aged + start


def unlimited_paper(
    model: ResidualModel, bounds: FloatArray, initial_error: float, gamma: float | None
) -> UnlimitedHorizonBound:
    """Return (66) of Wang et al. 2015 for records of any length."""
    table = paper_threshold(model, bounds, initial_error, gamma)
    return UnlimitedHorizonBound(table, float(table[-1]))


def _start_added(model: ResidualModel, bare: FloatArray, initial_error: float) -> FloatArray:
    """Return the bound with the start's; of a continuous design one that holds until the next sample."""
    if model.continuous is None or not initial_error:
        return bare + np.array([np.linalg.norm(model.C @ power, 2) for power in model.powers()]) * initial_error
    from scipy.linalg import solve_continuous_lyapunov

    # In the norm of a Lyapunov function a free motion never grows.
    a = model.errors.Az
    root = np.linalg.cholesky(solve_continuous_lyapunov(a.T, -np.eye(len(a)))).T
    seen = float(np.linalg.norm(np.linalg.solve(root.T, model.C.T), 2))
    return bare + np.array([seen * np.linalg.norm(root @ power, 2) for power in model.powers()]) * initial_error


#: The initial-condition response has settled when its effect on the residual is below this share of the residual's
#: deviation.
START_EFFECT_SHARE = 0.05
#: A disturbance that moves the residual by less than this share of its noise is decoupled, but for rounding.
NOTHING_FELT = 1e-6
#: Whitened residuals count as white when their correlations sum up to no more than this.
WHITE_CORRELATIONS = 0.01
#: What may be left of a correlation, relative to where it began, when its sum ends; and after how many samples at most.
CORRELATION_LEFT, MOST_LAGS = 1e-9, 200_000


def window_covariance(model: ResidualModel, window: int) -> FloatArray:
    """Return the covariance ``(window nr, window nr)`` of consecutive residuals in steady state, oldest first."""
    reached = _felt(model)
    if any(bool(hit) and not calm for hit, calm in zip(reached, model.steady, strict=True)):
        raise SpecError(
            "A disturbance that reaches the residual has a part that is not random or does not last: its covariance "
            "is not known. Use pointwise or window.",
            path="disturbances",
        )
    b, d, spread = _driving(model)
    lagged = [model.C @ spread @ model.C.T + d @ d.T]
    ahead = model.A @ spread @ model.C.T + b @ d.T
    for _ in range(window - 1):
        lagged.append(model.C @ ahead)
        ahead = model.A @ ahead
    if not np.max(np.abs(lagged[0]), initial=0.0) > 0.0:
        raise SpecError("No noise reaches the residual: any threshold would be one on rounding errors.", path="noise")
    return np.block([[lagged[i - j] if i >= j else lagged[j - i].T for j in range(window)] for i in range(window)])


def _driving(model: ResidualModel) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what random disturbances and noise do to error and residual, and the covariance of the error."""
    b = np.hstack([model.Bd * model.deviations, model.Bw])
    d = np.hstack([model.Dd * model.deviations, model.Dw])
    return b, d, output_covariance(model.A, b, np.eye(len(model.A)), np.zeros((len(model.A), b.shape[1])))


def _felt(model: ResidualModel) -> list[bool]:
    """Return which disturbances reach the residual by more than rounding: from most observers some are decoupled."""

    def size(b: FloatArray, d: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.abs(np.diag(output_covariance(model.A, b, model.C, d)))))

    noise, sizes = size(model.Bw, model.Dw), np.where(np.isfinite(model.bounds), model.bounds, 1.0)
    return [
        bool(np.any(size(model.Bd[:, [j]] * largest, model.Dd[:, [j]] * largest) > NOTHING_FELT * noise))
        for j, largest in enumerate(sizes)
    ]


def whitener_of(covariance: FloatArray) -> FloatArray:
    """Return ``Wh (rank, n)`` with ``Wh S Wh' = I`` for ``S (n, n)``; directions without any variance are left out."""
    sizes, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
    kept = sizes > CANCELLATION_TOLERANCE * max(float(sizes[-1]), np.finfo(np.float64).tiny)
    return np.asarray((vectors[:, kept] / np.sqrt(sizes[kept])).T)


def innovation_whitener(covariance: FloatArray, count: int) -> FloatArray:
    """Return ``Wh (m, n)``: the newest ``count`` residuals less their prediction from the others, white."""
    old = len(covariance) - count
    past = whitener_of(covariance[:old, :old]) if old else np.zeros((0, 0))
    predict = covariance[old:, :old] @ past.T @ past
    error = np.hstack([-predict, np.eye(count)])
    left = error @ covariance @ error.T
    sizes, vectors = np.linalg.eigh((left + left.T) / 2.0)
    kept = sizes > CANCELLATION_TOLERANCE * float(np.max(np.abs(np.diag(covariance))))
    if not kept.any():
        raise SpecError("The newest residual is determined by the older ones: it has no innovation.", path="window")
    return np.asarray((vectors[:, kept] / np.sqrt(sizes[kept])).T @ error)


def correlation_left(model: ResidualModel, window: int, whitener: FloatArray) -> float:
    """Return the norms of all correlations, at every lag, that residuals whitened by a window still have, summed up."""
    count, n = len(model.C), len(model.A)
    covariance = window_covariance(model, 2 * window)
    span = window * count
    near = (whitener @ covariance[j * count : j * count + span, :span] @ whitener.T for j in range(1, window))
    total = float(sum(np.linalg.norm(part, 2) for part in near))
    # Later ones are P A^k Q, k = 0, 1, ...
    b, d, spread = _driving(model)
    ahead = model.A @ spread @ model.C.T + b @ d.T
    blocks = [whitener[:, i * count : (i + 1) * count] for i in range(window)]
    shown, driven = np.zeros((len(whitener), n)), np.zeros((n, len(whitener)))
    for newest, oldest in zip(reversed(blocks), blocks, strict=True):
        shown = shown @ model.A + newest @ model.C
        driven = model.A @ driven + ahead @ oldest.T
    left = CORRELATION_LEFT * float(np.linalg.norm(driven))
    for _ in range(MOST_LAGS):
        total += float(np.linalg.norm(shown @ driven, 2))
        driven = model.A @ driven
        if float(np.linalg.norm(driven)) <= left:
            return total
    raise SpecError("The residual is correlated for too long to be whitened: use chi-square.", path="kind")


def cusum_whitener(model: ResidualModel, window: int) -> tuple[FloatArray, bool]:
    """Return what cumulative sums add up, n samples of no more variance than n, and whether it is white."""
    whitener = innovation_whitener(window_covariance(model, window), len(model.C))
    left = correlation_left(model, window, whitener)
    return whitener / np.sqrt(1.0 + 2.0 * left), left <= WHITE_CORRELATIONS


def whitened(kind: str, model: ResidualModel, window: int) -> tuple[FloatArray, bool]:
    """Return the whitener of ``chi-square`` or ``cusum``, and whether what it makes is white."""
    if kind == "chi-square":
        return whitener_of(window_covariance(model, window)), True
    return cusum_whitener(model, window)


def steady_mean(model: ResidualModel) -> FloatArray:
    """Return the mean ``(nr,)`` of the residual in steady state."""
    state = np.linalg.solve(np.eye(len(model.A)) - model.A, model.Bd @ model.means)
    return np.asarray(model.C @ state + model.Dd @ model.means)


def settled(model: ResidualModel, initial_error: float, window: int) -> int:
    """Return the first sample whose window is free of the start."""
    deviation = float(np.sqrt(np.max(np.diag(window_covariance(model, 1)))))
    # The covariance and the mean have to settle as well, from a start of about the size of their own states.
    spread = _driving(model)[2]
    mean = np.linalg.norm(np.linalg.solve(np.eye(len(model.A)) - model.A, model.Bd @ model.means))
    size = initial_error + float(np.sqrt(np.trace(spread))) + float(mean)
    effects = np.array([np.linalg.norm(model.C @ power, 2) for power in model.powers()]) * size
    late = np.flatnonzero(effects > START_EFFECT_SHARE * deviation)
    first = (int(late[-1]) + 1 if late.size else 0) + window - 1
    if spectral_radius(model.A) >= 1.0 or first >= model.steps:
        raise SpecError(
            f"The initial-condition response has not settled, or fills the window, at the end of {model.steps} "
            "samples: a "
            "statistical threshold needs a longer horizon.",
            path="horizon",
        )
    return first
