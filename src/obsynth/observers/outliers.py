"""Outliers: rules that reject samples far from their prediction, and limits of estimates by bounds of the states.

A sample beyond a limit is rejected (``gate``) or replaced by the limit (``huber``; Huber 1964, Masreliez 1975).  The
limit is a number of standard deviations of the sample's prediction.  If no sample of a row exceeds it, each sample is
also compared with its prediction from the other samples of the row.  Where the least size of a sensor's outliers is
known, smaller deviations are not rejected: they may be the onset of a fault.  Projection onto bounds increases no error
in the metric of the covariance, which therefore stays an upper bound (Simon, Chia 2002).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SolverError, SpecError
from obsynth.numerics.arguments import real_number
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.records import named_bounds, named_vector

BoolArray = NDArray[np.bool_]

Outliers = Literal["none", "gate", "huber"]

#: Default limits in standard deviations.  With that of the gate a true model rejects less than one sample in a million.
LIMITS = {"gate": 6.0, "huber": 3.0}

#: A larger number is no measurement, since its square overflows.
NO_SQUARE = 1e150

#: Most consecutive samples of a sensor that are rejected if their deviations change sign, or if the sensor's outliers
#: are known to be large.  Otherwise the second sample on the same side is accepted, and so are the following ones of
#: comparable size.
LONGEST_LEFT_OUT = 2

#: Outliers of a sensor count as large if their least size is at least this share of the limit.  Missing inputs widen
#: the limit; the second of two consecutive samples is then accepted.
FAR_OUT = 0.5

#: Largest ratio of consecutive deviations for which the second sample confirms the first.  At the onset of a fault that
#: grows with the square of time the ratio is 4, and noise changes both.
COMPARABLE = 5.0

#: Multiple of the limit that a sample has to exceed if only the model's equations contradict it, and the relative
#: rounding error of a prediction without noise.
BLIND, PREDICTION_ROUNDING = 10.0, 1e-6

#: Number of samples whose squared innovations are summed for the decision on a reset.
RESET_WINDOW = 20

State = TypeVar("State", bound=Any)

Row = TypeVar("Row", bound=Any)


def checked_limit(kind: str, limit: float | None) -> float:
    """Return the limit in standard deviations, infinite for ``none``."""
    if limit is None:
        return LIMITS.get(kind, float("inf"))
    return real_number(limit, "outlier_limit", "a positive number of standard deviations", above=0.0)


def checked_sizes(value: Any, names: Sequence[str]) -> FloatArray | None:
    """Return the least deviation of an outlier of each output ``(ny,)`` in the sensor's unit, checked.

    ``value`` is an array, or a mapping by name; ``None`` for no stated sizes.
    """
    if value is None:
        return None
    sizes = named_vector(value, names, np.zeros(len(names)), "outlier_sizes")
    for name, size in zip(names, sizes, strict=True):
        if size < 0.0:
            path = f"outlier_sizes.{name}"
            raise SpecError(f"{path} is {size:g}: give how far off an outlier is at least, in its unit.", path=path)
    return read_only(sizes)


def no_refusals(outputs: int) -> FloatArray:
    """Return the memory of outliers before the first sample, ``(4, ny)``.

    Its rows are, for each sensor: the number of consecutive samples far from their prediction, negative if the last one
    was below; the total number of rejected or limited samples; and the deviations of the last rejected and the last
    accepted one of those consecutive samples.
    """
    return np.zeros((4, outputs))


def robust_advance(
    kind: str,
    limit: float,
    sizes: FloatArray | None,
    plain: Callable[[State, FloatArray, FloatArray], tuple[State, Row]],
    predicted: Callable[[State, FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
    state: State,
    y: FloatArray,
    u: FloatArray,
    *,
    predicted_outputs: Callable[[State, FloatArray], tuple[FloatArray, FloatArray]] | None = None,
    held: FloatArray | None = None,
) -> tuple[State, Row]:
    """Return the state and the row after a step that rejects or limits outliers.

    A plain step comes first.  If its normalised innovation exceeds the limit, each sample is tested, and the step is
    repeated without the outliers: samples with a deviation above ``limit`` standard deviations and above ``sizes``.  If
    there are none, the sample that the others of its row contradict most is the outlier.

    Parameters
    ----------
    kind : {"none", "gate", "huber"}
        What happens to outliers.
    limit : float
        Limit in standard deviations.
    sizes : FloatArray or None
        Least sizes of outliers ``(ny,)`` where they are known.
    plain : callable
        The step ``(state, y, u)`` without any rule; NaN marks a missing sample.
    predicted : callable
        ``(state, received, u)`` to mean ``(ny,)`` and covariance ``(ny, ny)`` of the outputs, given received samples.
    state : State
        The state before the step, with the memory `no_refusals` in ``refused``.
    y, u : FloatArray
        Outputs ``(ny,)`` and known inputs ``(nu,)``.
    predicted_outputs : callable, optional
        ``(state, u)`` to mean and covariance of outputs that determine the state; these are outliers only beyond
        `BLIND` times the limit.
    held : FloatArray, optional
        Last values ``(nu,)`` of inputs that are missing now.  Deviating samples may then be right, since the inputs may
        have moved: they are accepted if the next sample confirms them.  Once the inputs are known again, the same holds
        for deviations as large as a sensor's outliers, until a sample deviates less or confirms the ones before.
    """
    failed, mean, usual, reach, far = False, y, y, y, np.zeros(len(y), dtype=bool)
    least = np.zeros(len(y)) if sizes is None else sizes
    wary = None if sizes is None or kind != "gate" or held is not None else _wary(state, sizes)
    try:
        with np.errstate(all="ignore"):
            after, row = plain(state, y, u)
            passes = float(row.nis) <= limit**2 and held is None and wary is None
            if passes and predicted_outputs is not None:
                mean, covariance = predicted_outputs(state, u)
                usual = limit * np.sqrt(np.diag(covariance))
                reach = np.maximum(usual, least)
                far = np.abs(y - mean) > BLIND * reach + PREDICTION_ROUNDING * (np.abs(y) + np.abs(mean).max())
        if passes and not far.any():
            return after._replace(refused=_remembered(state.refused, y, far, far, y)), row
    except (SolverError, np.linalg.LinAlgError, ValueError):
        failed = True
    if not far.any():
        # With a missing input smaller deviations also wait for the next sample, so that this row reports no fault.
        least, u_taken = (least, u) if held is None else (np.zeros(len(y)), held)
        mean, usual, reach, far, apart = _judged(limit, least, predicted, state, y, u_taken)
        if wary is not None:
            # A second sample that repeats the first within the limit confirms it at once, and so does one that agrees
            # with the other samples of its row.
            again = (np.abs(y - mean) <= reach) & (np.abs(y - mean - state.refused[2]) <= least)
            wary &= np.isfinite(reach) & ~(again & (state.refused[2] != 0.0)) & ~(np.abs(apart) <= least)
            reach = np.where(wary, least, reach)
            far |= wary & (np.abs(y - mean) > reach)
    off, gone = np.where(far, y - mean, 0.0), far
    if kind == "gate":
        # An outlier is isolated; after a change of sensor or plant the next sample deviates as much to the same side.
        far_outliers = np.zeros(len(y), dtype=bool) if sizes is None else sizes > FAR_OUT * usual
        gone = far & (~_follows(state.refused, off, far_outliers) | (np.abs(y) > NO_SQUARE))
        received = np.where(gone, np.nan, y)
    else:
        pulled = mean + reach * np.sign(y - mean)
        received = np.where(gone, np.where(np.isfinite(pulled), pulled, np.nan), y)
    try:
        if failed or gone.any():
            after, row = plain(state, received, u)
    except (SolverError, np.linalg.LinAlgError, ValueError):
        # There is no step with these samples: take the step without any.
        gone = ~np.isnan(y)
        after, row = plain(state, np.full(len(y), np.nan), u)
    return after._replace(refused=_remembered(state.refused, y, far, gone, off)), row


def _wary(state: Any, sizes: FloatArray) -> BoolArray | None:
    """Return the sensors ``(ny,)`` whose deviating samples need confirmation by the next one, or `None` for none.

    After missing inputs the standard deviations are so large that an outlier would pass the limit.  Sensors with known
    sizes of outliers then wait for the next sample.
    """
    if state.inputs[3].any():
        return np.asarray(sizes > 0.0)
    waiting = state.refused[2]
    return np.asarray((sizes > 0.0) & (waiting != 0.0)) if waiting.any() else None


def _follows(refused: FloatArray, off: FloatArray, far_outliers: BoolArray) -> BoolArray:
    """Return which samples, with deviations ``off (ny,)``, confirm earlier deviating ones.

    A sample confirms an accepted one if it is on the same side with a comparable deviation.  It confirms a rejected one
    if the deviations are comparable, and either they are on the same side, for sensors without ``far_outliers``, or
    `LONGEST_LEFT_OUT` samples were rejected.
    """
    row, _, left_out, believed = refused
    sizes, left_out_sizes = np.abs(off), np.abs(left_out)
    with np.errstate(over="ignore"):
        on = (off * np.sign(believed) > 0.0) & (sizes <= COMPARABLE * np.abs(believed))
        like = (left_out_sizes > 0.0) & (sizes <= COMPARABLE * left_out_sizes) & (left_out_sizes <= COMPARABLE * sizes)
    return np.asarray(
        on | like & ((~far_outliers & (off * np.sign(left_out) > 0.0)) | (np.abs(row) >= LONGEST_LEFT_OUT))
    )


def _remembered(refused: FloatArray, y: FloatArray, far: BoolArray, gone: BoolArray, off: FloatArray) -> FloatArray:
    """Return the memory of outliers after a row of samples; a missing sample does not change it.

    ``far (ny,)`` are the samples that deviate, ``off (ny,)`` their deviations, and ``gone (ny,)`` the rejected or
    limited ones.
    """
    row, total, left_out, believed = refused
    counts = np.where(far, np.where(off < 0.0, -1.0, 1.0) * (np.abs(row) + 1.0), 0.0)
    after = np.stack([counts, total + gone, *(np.where(far, np.where(chosen, off, old), 0.0)
                      for chosen, old in ((gone, left_out), (~gone, believed)))])  # fmt: skip
    return np.where(np.isnan(y) & np.array([[True], [False], [True], [True]]), refused, after)


def _judged(
    limit: float,
    least: FloatArray,
    predicted: Callable[[State, FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
    state: State,
    y: FloatArray,
    u: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, FloatArray]:
    """Return predictions and limits of all outputs, which samples exceed them, and deviations from the others.

    The five arrays ``(ny,)`` are: the predicted mean; the limit by standard deviations; the limit with known sizes of
    outliers; whether the sample exceeds it; and the deviation from the prediction by the other samples of the row, NaN
    where there is none.  The other samples decide where the model predicts nothing of an output or no sample exceeds
    its limit: possible faults make standard deviations large, but they move all sensors together.
    """
    with np.errstate(all="ignore"):
        mean, covariance = predicted(state, np.full(len(y), np.nan), u)
        usual = limit * np.sqrt(np.diag(covariance))
        reach = np.maximum(usual, least)
        far = (np.abs(y - mean) > reach) | (np.abs(y) > NO_SQUARE)
        ratios, unknown = np.zeros(len(y)), np.isinf(usual)
        for i in np.flatnonzero(unknown & ~np.isnan(y) & ~far):
            other_outputs = np.where(far | (np.arange(len(y)) == i), np.nan, y)
            try:
                means, spread = predicted(state, other_outputs, u)
            except (SolverError, np.linalg.LinAlgError, ValueError):
                continue
            mean[i], reach[i] = means[i], max(limit * np.sqrt(spread[i, i]), least[i])
            ratios[i] = np.abs(y[i] - means[i]) / reach[i]
        # Samples may contradict each other: only the worst one is an outlier.
        worst = int(np.argmax(ratios))
        far[worst] |= bool(ratios[worst] > 1.0)
        apart = np.full(len(y), np.nan)
        if not unknown.any():
            apart, deviation = beside_others(y - mean, covariance)
            worst = int(np.argmax(np.nan_to_num(np.abs(apart) / deviation)))
            if not far.any() and np.abs(apart[worst]) > max(limit * deviation[worst], least[worst]):
                mean[worst], usual[worst], far[worst] = y[worst] - apart[worst], limit * deviation[worst], True
                reach[worst] = max(usual[worst], least[worst])
    return mean, usual, reach, far, apart


def beside_others(off: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the deviation of each sample ``(ny,)`` from its prediction by the other samples, with standard deviations.

    ``off (ny,)`` are the deviations from the model's prediction and ``covariance (ny, ny)`` is their covariance.  NaN
    for a missing sample, and for all where the covariance is singular.
    """
    distances = np.full((2, len(off)), np.nan)
    measured = np.flatnonzero(~np.isnan(off))
    sizes = np.sqrt(np.diag(covariance)[measured])
    try:
        inverse = np.linalg.inv(covariance[np.ix_(measured, measured)] / np.outer(sizes, sizes))
    except np.linalg.LinAlgError:
        return distances[0], distances[1]
    own = np.diag(inverse)
    distances[:, measured] = sizes * (inverse @ (off[measured] / sizes)) / own, sizes / np.sqrt(own)
    return distances[0], distances[1]


def checked_state_bounds(value: Any, names: Sequence[str]) -> FloatArray | None:
    """Return lower and upper bounds ``(nx, 2)`` from rows or from pairs by name; ``None`` where there are none."""
    bounds = named_bounds(value, names, "state_bounds")
    return read_only(bounds) if np.isfinite(bounds).any() else None


def projected(x: FloatArray, factor: FloatArray, bounds: FloatArray) -> FloatArray:
    """Return the point within bounds nearest to ``x`` in the metric of the covariance ``factor factor'``.

    It is ``x + factor e`` with the shortest e within the bounds, by nonnegative least squares (Lawson, Hanson, LDP), so
    that the covariance may be singular; ``factor (n, any)``.
    """
    if ((bounds[:, 0] <= x) & (x <= bounds[:, 1])).all():
        return x
    from scipy.optimize import nnls

    deviations = np.sqrt(np.einsum("ij,ij->i", factor, factor))
    moving = deviations > 0.0
    rows, gaps = [], []
    for sign, ends in ((1.0, bounds[:, 0]), (-1.0, -bounds[:, 1])):
        used = moving & np.isfinite(ends)
        rows.append(sign * factor[used] / deviations[used, None])
        gaps.append((ends[used] - sign * x[used]) / deviations[used])
    sides, least = np.vstack(rows), np.concatenate(gaps)
    target = np.zeros(factor.shape[1] + 1)
    target[-1] = 1.0
    weights, distance = nnls(np.vstack((sides.T, least)), target)
    residual = np.vstack((sides.T, least)) @ weights - target
    moved = x
    # A residual of zero means that no e keeps all bounds, because of a state that is known exactly.
    if distance > 0.0 and residual[-1] < 0.0:
        # Solve for the shortest e with the active bounds: the ratio of residuals would suffer from cancellation.
        held = weights > 0.0
        moved = x + factor @ np.linalg.lstsq(sides[held], least[held], rcond=None)[0]
    return np.asarray(np.clip(moved, bounds[:, 0], bounds[:, 1]))


@lru_cache(maxsize=256)
def chi_square_limit(degrees: int, probability: float) -> float:
    """Return the value that a chi-square variable exceeds with the given probability."""
    from scipy.special import chdtri

    return float(chdtri(degrees, probability))


def with_surprise(surprises: FloatArray, nis: float, degrees: int) -> FloatArray:
    """Return the last normalised squares of innovations with their degrees of freedom ``(any, 2)``, with this one."""
    return np.vstack([surprises, [nis, float(degrees)]])[-RESET_WINDOW:]


def has_jumped(surprises: FloatArray, probability: float) -> bool:
    """Whether the last innovations are too large for the present covariance of the parameters."""
    total, degrees = surprises.sum(axis=0)
    return bool(degrees > 0) and bool(total > chi_square_limit(int(degrees), probability))
