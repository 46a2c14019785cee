"""The covariance of a window of residuals, and what whitens it: only innovations are white as they are."""

from __future__ import annotations

import numpy as np

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.residual_model import ResidualModel
from obsynth.monitoring.thresholds.watched_rows import Watched
from obsynth.numerics.arrays import FloatArray, largest_singular_value
from obsynth.numerics.norms import output_covariance, spectral_radius
from obsynth.numerics.ranks import CANCELLATION_TOLERANCE

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

    def size(b: FloatArray, d: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.abs(np.diag(output_covariance(model.A, b, model.C, d)))))

    # By more than rounding: from most observers some are decoupled.
    noise, sizes = size(model.Bw, model.Dw), np.where(np.isfinite(model.bounds), model.bounds, 1.0)
    reached = [
        bool(np.any(size(model.Bd[:, [j]] * largest, model.Dd[:, [j]] * largest) > NOTHING_FELT * noise))
        for j, largest in enumerate(sizes)
    ]
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


def whitener_of(covariance: FloatArray) -> FloatArray:
    """Return ``Wh (rank, n)`` with ``Wh S Wh' = I`` for ``S (n, n)``; directions without any variance are left out."""
    units = _deviations(covariance)
    sizes, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0 / np.outer(units, units))
    significant = sizes > CANCELLATION_TOLERANCE * max(float(sizes[-1]), np.finfo(np.float64).tiny)
    return np.asarray((vectors[:, significant] / np.sqrt(sizes[significant])).T / units)


def _deviations(covariance: FloatArray) -> FloatArray:
    """Return the deviation of each component ``(n,)``, one where it has none: whether a direction has a variance is no
    question of units."""
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return np.where(deviations > 0.0, deviations, 1.0)


def innovation_whitener(covariance: FloatArray, count: int) -> FloatArray:
    """Return ``Wh (m, n)``: the newest ``count`` residuals less their prediction from the others, white."""
    old = len(covariance) - count
    past = whitener_of(covariance[:old, :old]) if old else np.zeros((0, 0))
    predict = covariance[old:, :old] @ past.T @ past
    error = np.hstack([-predict, np.eye(count)])
    innovation_covariance = error @ covariance @ error.T
    units = _deviations(covariance)[old:]
    sizes, vectors = np.linalg.eigh((innovation_covariance + innovation_covariance.T) / 2.0 / np.outer(units, units))
    significant = sizes > CANCELLATION_TOLERANCE
    if not significant.any():
        raise SpecError("The newest residual is determined by the older ones: it has no innovation.", path="window")
    return np.asarray((vectors[:, significant] / np.sqrt(sizes[significant])).T / units @ error)


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
    reading, driven = np.zeros((len(whitener), n)), np.zeros((n, len(whitener)))
    for newest, oldest in zip(reversed(blocks), blocks, strict=True):
        reading = reading @ model.A + newest @ model.C
        driven = model.A @ driven + ahead @ oldest.T
    negligible = CORRELATION_LEFT * float(np.linalg.norm(driven))
    for _ in range(MOST_LAGS):
        total += largest_singular_value(reading @ driven)
        driven = model.A @ driven
        if float(np.linalg.norm(driven)) <= negligible:
            return total
    raise SpecError("The residual is correlated for too long to be whitened: use chi-square.", path="kind")


def cusum_whitener(model: ResidualModel, window: int) -> tuple[FloatArray, bool]:
    """Return what cumulative sums add up, n samples of no more variance than n, and whether it is white."""
    whitener = innovation_whitener(window_covariance(model, window), len(model.C))
    correlations = correlation_left(model, window, whitener)
    return whitener / np.sqrt(1.0 + 2.0 * correlations), correlations <= WHITE_CORRELATIONS


def whitened(kind: str, model: ResidualModel, window: int, watched: Watched) -> tuple[FloatArray, bool]:
    """Return the whitener of ``chi-square`` or ``cusum``, and whether what it makes is white."""
    if kind == "cusum":
        return cusum_whitener(model, window)
    covariance = window_covariance(model, window)
    if watched is Watched.RESIDUALS:
        return whitener_of(covariance), True
    # An observer's estimates hardly change from row to row, and those of a fault that stays do not: the newest ones
    # tell a large fault at once, their means a small one, where a whole window has many degrees that tell neither.
    newest, mean = np.eye(window)[-1:], np.full((1, window), 1.0 / window)
    looked_at = np.kron(np.vstack([newest, mean]), np.eye(len(model.C)))
    return whitener_of(looked_at @ covariance @ looked_at.T) @ looked_at, True


def steady_mean(model: ResidualModel) -> FloatArray:
    """Return the mean ``(nr,)`` of the residual in steady state."""
    state = np.linalg.solve(np.eye(len(model.A)) - model.A, model.Bd @ model.means)
    return np.asarray(model.C @ state + model.Dd @ model.means)


def settled(model: ResidualModel, initial_error: float, window: int) -> int:
    """Return the first sample whose window is free of the start."""
    deviations = np.sqrt(np.diag(window_covariance(model, 1)))
    reading = model.C / np.where(deviations > 0.0, deviations, np.inf)[:, None]
    # The covariance and the mean have to settle as well, from a start of about the size of their own states.
    spread = _driving(model)[2]
    mean = np.linalg.norm(np.linalg.solve(np.eye(len(model.A)) - model.A, model.Bd @ model.means))
    size = initial_error + float(np.sqrt(np.trace(spread))) + float(mean)
    effects = np.array([np.linalg.norm(reading @ power, 2) for power in model.powers()]) * size
    late = np.flatnonzero(effects > START_EFFECT_SHARE)
    first = (int(late[-1]) + 1 if late.size else 0) + window - 1
    if spectral_radius(model.A) >= 1.0 or first >= model.steps:
        raise SpecError(
            f"The initial-condition response has not settled, or fills the window, at the end of {model.steps} "
            "samples: a "
            "statistical threshold needs a longer horizon.",
            path="horizon",
        )
    return first
