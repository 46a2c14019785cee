"""Outliers: rules that reject samples far from their prediction, and limits of estimates by bounds of the states.

Beyond the limit a sensor is left out (``gate``) or taken at the limit (``huber``; Huber 1964, Masreliez 1975): the
limit of its prediction, and where this excludes no sample of a row, that of what its others say of it.  Where
the outliers of a log show how far off they are, what is nearer may be the onset of a fault, however many deviations it
is.  A projection brings the error nowhere further in its metric: the covariance stays an upper bound (Simon, Chia
2002).
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

#: Standard deviations: of a gate, so that no sample of a true model is left out in a million; and of Huber's weight.
LIMITS = {"gate": 6.0, "huber": 3.0}

#: What is larger has no square: it is no measurement, whatever the model says.
NO_SQUARE = 1e150

#: Samples of one sensor in a row that are left out where their sides change, or where its outliers are known to be far
#: off, so that two may come together; else the second on one side is believed. So are those that follow it there,
#: unless they are wild.
LONGEST_LEFT_OUT = 2

#: Share of its limit that the least size of a sensor's outliers must be so that of two in a row both are left out:
#: where what inputs may have been widens the limit beyond that, the second is believed.
FAR_OUT = 0.5

#: How many times further off than the one before it a sample may be that is believed for it: at the onset of a fault
#: that grows with the square of time the second is 4 times further off, and noise moves both.
COMPARABLE = 5.0

#: How many times further off than the limit a sample must be that nothing contradicts but the equations of the model;
#: and what rounding makes of a prediction without noise.
BLIND, PREDICTION_ROUNDING = 10.0, 1e-6

#: Samples whose squared innovations are summed up before a reset.
RESET_WINDOW = 20

State = TypeVar("State", bound=Any)

Row = TypeVar("Row", bound=Any)


def checked_limit(kind: str, limit: float | None) -> float:
    """Return the limit in standard deviations, infinite for ``none``."""
    if limit is None:
        return LIMITS.get(kind, float("inf"))
    return real_number(limit, "outlier_limit", "a positive number of standard deviations", above=0.0)


def checked_sizes(value: Any, names: Sequence[str]) -> FloatArray | None:
    """Return how far off a sample of each output must be at least to be an outlier ``(ny,)``, in units of the sensor,
    from these or from values by name; ``None`` where nothing is said."""
    if value is None:
        return None
    sizes = named_vector(value, names, np.zeros(len(names)), "outlier_sizes")
    for name, size in zip(names, sizes, strict=True):
        if size < 0.0:
            path = f"outlier_sizes.{name}"
            raise SpecError(f"{path} is {size:g}: give how far off an outlier is at least, in its unit.", path=path)
    return read_only(sizes)


def no_refusals(outputs: int) -> FloatArray:
    """Return the memory of outliers at a start, ``(4, ny)``: how many samples in a row of each sensor were far from
    their prediction, negative where the last was below it; how many were left out or pulled at all; and how far off, in
    units of the sensor and with its sign, the latest of those in a row was that was left out, and that was believed."""
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
    """Take a step; where its innovation is too long, ask each sensor and take the step again without the outliers:
    those further off than so many deviations, and than ``sizes (ny,)`` where these are known; where there are none, the
    one that the others of its row exclude most.
    ``predicted(state, received, u)``: mean ``(ny,)`` and covariance ``(ny, ny)`` of outputs from the samples that are
    received; ``predicted_outputs(state, u)``: of outputs that determine the state; these may be `BLIND` times further
    off.
    ``held (nu,)``, where inputs are missing: as they last were. What these exclude, by deviations alone, may be wrong,
    or the inputs have moved: it counts once the next sample goes on with it. So does what is as far off as outliers of
    its sensor are once inputs are known again, until a sample is nearer or goes on with those before."""
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
        # Beside a missing input nearer samples wait for the next one as well: no fault is reported in this row.
        least, u_taken = (least, u) if held is None else (np.zeros(len(y)), held)
        mean, usual, reach, far, apart = _judged(limit, least, predicted, state, y, u_taken)
        if wary is not None:
            # A second that is where the first was, and no further than it may be, goes on with it at once; so does one
            # that is where the others of its row say.
            again = (np.abs(y - mean) <= reach) & (np.abs(y - mean - state.refused[2]) <= least)
            wary &= np.isfinite(reach) & ~(again & (state.refused[2] != 0.0)) & ~(np.abs(apart) <= least)
            reach = np.where(wary, least, reach)
            far |= wary & (np.abs(y - mean) > reach)
    off, gone = np.where(far, y - mean, 0.0), far
    if kind == "gate":
        # A wrong sample stands alone; of a sensor, or a plant, that has moved the next is on the same side, as far off.
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
        # A sample that nothing predicts, and with which there is no step.
        gone = ~np.isnan(y)
        after, row = plain(state, np.full(len(y), np.nan), u)
    return after._replace(refused=_remembered(state.refused, y, far, gone, off)), row


def _wary(state: Any, sizes: FloatArray) -> BoolArray | None:
    """Return of which sensors with known outliers ``(ny,)`` a sample waits for the next whatever its deviation: what
    inputs may have been while they were missing makes it so large that an outlier would pass. `None`: of none."""
    if state.inputs[3].any():
        return np.asarray(sizes > 0.0)
    waiting = state.refused[2]
    return np.asarray((sizes > 0.0) & (waiting != 0.0)) if waiting.any() else None


def _follows(refused: FloatArray, off: FloatArray, far_outliers: BoolArray) -> BoolArray:
    """Return which samples ``off (ny,)`` their prediction go on with what was off before: with what was believed, or as
    far as the one that was left out: after `LONGEST_LEFT_OUT` of them, or on its side where the sensor's outliers are
    not ``known (ny,)`` to be further off than any sample."""
    row, _, left_out, believed = refused
    sizes, left_out_sizes = np.abs(off), np.abs(left_out)
    with np.errstate(over="ignore"):
        on = (off * np.sign(believed) > 0.0) & (sizes <= COMPARABLE * np.abs(believed))
        like = (left_out_sizes > 0.0) & (sizes <= COMPARABLE * left_out_sizes) & (left_out_sizes <= COMPARABLE * sizes)
    return np.asarray(
        on | like & ((~far_outliers & (off * np.sign(left_out) > 0.0)) | (np.abs(row) >= LONGEST_LEFT_OUT))
    )


def _remembered(refused: FloatArray, y: FloatArray, far: BoolArray, gone: BoolArray, off: FloatArray) -> FloatArray:
    """Return the memory of outliers after a sample, of which those that are ``far (ny,)`` are ``off`` by so much, and
    some are ``gone``: left out or pulled. A missing sample leaves it as it was."""
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
    """Return the mean of each output, how far from it a sample may be by its deviation and at all, which are further,
    and how far each is from what the others of its row say, NaN where they do not know it. Where the model alone
    predicts nothing of an output, or excludes no sample, the others of its row judge: what a fault may have done makes
    deviations large, but it moves all sensors together."""
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
        # Of those that accuse each other, the worst alone.
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
    """Return how far each sample ``(ny,)`` is from what all others of its row say of it, and the deviation of that,
    where they are ``off (ny,)`` their prediction by so much, with ``covariance (ny, ny)``; NaN of one that is missing,
    and of all where the covariance is singular."""
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
    """Return the point within bounds nearest to ``x`` in the metric of the covariance ``factor factor'``. The shortest
    e with ``low <= x + factor e <= high`` by nonnegative least squares (Lawson, Hanson, LDP), so that the covariance
    may be singular. The factor is ``(n, any)``."""
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
    # Without a rest no e keeps all of them: a state that is known exactly stands in the way.
    if distance > 0.0 and residual[-1] < 0.0:
        # The shortest e that reaches the ends that hold it, without the cancellation of the ratio of residuals.
        held = weights > 0.0
        moved = x + factor @ np.linalg.lstsq(sides[held], least[held], rcond=None)[0]
    return np.asarray(np.clip(moved, bounds[:, 0], bounds[:, 1]))


@lru_cache(maxsize=256)
def chi_square_limit(degrees: int, probability: float) -> float:
    """Return what a chi-square variable passes with a probability."""
    from scipy.special import chdtri

    return float(chdtri(degrees, probability))


def with_surprise(surprises: FloatArray, nis: float, degrees: int) -> FloatArray:
    """Return the latest normalised squares of innovations with their degrees of freedom ``(any, 2)``, this one last."""
    return np.vstack([surprises, [nis, float(degrees)]])[-RESET_WINDOW:]


def has_jumped(surprises: FloatArray, probability: float) -> bool:
    """Return whether the latest innovations are too large for what is known of the parameters."""
    total, degrees = surprises.sum(axis=0)
    return bool(degrees > 0) and bool(total > chi_square_limit(int(degrees), probability))
