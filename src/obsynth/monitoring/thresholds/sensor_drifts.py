"""Allowed slow drifts of sensors and their effects on statistics, whether or not the logs show such drifts.

A log without faults contains one drift of each sensor, or none; a later log may contain another.  Each sensor is
allowed an offset of so many deviations of its noise that develops slowly.  The effect on a linear observer is given by
its steady-state gains.  Other observers are run again with the offset added to each output in turn; the differences
between the runs are linear in the offset to first order.  The drifts of sensors are independent, so that squares of
their effects are added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import SpecError
from obsynth.monitoring.thresholds.learned_statistics import AGES, FORGETTING, Statistics
from obsynth.monitoring.thresholds.parameter_scores import Scores, beyond
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.numerics.autoregression import MOST_ORDER
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import ObserverDesign

#: Number of rows of a log over which an observer is run again; its response to an offset settles in the first half.
DRIFT_ROWS = 3_000

#: Number of such rows where the smallest drift with an alarm is computed, and the relative accuracy of that drift.
LIMIT_ROWS, LIMIT_SHARE = 1_000, 0.01

#: Effects of an offset depend on the inputs; this quantile over the rows is used.
EFFECT_SHARE = 0.95

#: Ratio of the deviation of normal noise to its median absolute value, and of the variance of third differences of
#: white noise to its own.
MEDIAN_DEVIATIONS, THIRD_DIFFERENCES = 1.4826, 20.0


class SensorDrifts(NamedTuple):
    """Settled effects of an offset of each sensor: the differences from rows without it."""

    watched: FloatArray  # ``(ny, n, m)``: in fault estimates and residuals; NaN where unknown
    away: FloatArray  # ``(ny, n, nf)``: in the scores of changes of the faults; no rows without scores
    information: FloatArray  # ``(ny, n, nf)``: information of these rows on each fault alone
    theta: FloatArray  # ``(ny, n, nf)``: in the fault estimates that belong to the scores
    offsets: FloatArray  # ``(ny,)``: the offsets; zero for sensors whose noise is unknown

    def sensors_without(self) -> NDArray[np.bool_]:
        """Return the sensors for which no drift can be allowed ``(ny,)``: those without noise, and those whose offset
        leaves no row known."""
        known = np.isfinite(self.watched).any(axis=(1, 2))
        return np.asarray((self.offsets == 0.0) | ~known)

    def white_means(self, statistics: Statistics, columns: list[int]) -> FloatArray:
        """Return means of the effects on whitened rows, over the memory of the statistics: ``(ny, k, m)``."""
        model = replace(statistics.model, offset=np.zeros(statistics.model.channels))
        white = model.whitened(self.watched[:, :, columns])[:, model.order :]
        known = np.asarray(np.isfinite(white).all(axis=2), dtype=bool)[:, :, None]
        counts = _window_sums(known.astype(np.float64))
        return np.asarray(_window_sums(np.where(known, white, 0.0)) / np.maximum(counts, 1.0))

    def bands(self, statistics: Statistics, means: FloatArray) -> FloatArray:
        """Return the sizes of the offsets along each signature ``(s,)``."""
        lasting = statistics.responses()[0][: len(statistics.signature_names), -1]
        along = np.abs(means @ lasting.T) / np.maximum(np.sum(lasting**2, axis=1), np.finfo(float).tiny)
        return _together(along)

    def fault_bands(self) -> FloatArray:
        """Return the sizes of the changes of each fault that correspond to the offsets ``(nf,)``."""
        power = _window_sums(self.information)
        with np.errstate(divide="ignore", invalid="ignore"):
            changes = np.where(power > 0.0, np.abs(_window_sums(self.away)) / power, 0.0)
        return np.maximum(_together(changes), _together(np.abs(self.theta)))


def with_room_for_drifts(
    statistics: Statistics, levels: FloatArray, drifts: SensorDrifts, columns: list[int], size: float
) -> tuple[Statistics, FloatArray]:
    """Return statistics with bands for the drifts, and levels ``(k,)``; those of T2 and MEWMA are raised.

    The levels already allow for offsets of a ``size``.  ``columns`` are the watched ones.
    """
    means = drifts.white_means(statistics, columns)
    bands, of_faults = drifts.bands(statistics, means), statistics.fault_bands
    if statistics.bands is not None:
        bands = np.maximum(bands, statistics.bands)
    if statistics.estimates and drifts.away.shape[2]:
        changes = drifts.fault_bands()
        of_faults = read_only(changes if of_faults is None else np.maximum(changes, of_faults))
    added = float(_together(np.linalg.norm(means, axis=2)[:, :, None])[0])
    gains = np.sqrt([1.0, *((2.0 - share) / share for share in FORGETTING)])
    raised = levels.copy()
    raised[: len(gains)] = (np.sqrt(raised[: len(gains)]) + gains * max(added - size, 0.0)) ** 2
    return replace(statistics, bands=read_only(bands), fault_bands=of_faults), read_only(raised)


def drift_limits(
    statistics: Statistics, levels: FloatArray, drifts: SensorDrifts, columns: list[int], *, most: float = 1.0
) -> FloatArray:
    """Return the least multiple ``(ny,)`` of the offset of each sensor that exceeds a level as long as it lasts.

    Noise is left out.  The result is infinite for sensors whose offset times ``most`` exceeds no level.
    """
    white = np.median(drifts.white_means(statistics, columns), axis=1)
    rows = np.repeat(white[:, None], max(AGES), axis=1)
    faults = len(statistics.estimates) if drifts.away.size else 0
    count, bands = len(levels) - 2 * len(statistics.estimates), statistics.fault_bands
    if faults:
        power, away = (np.median(_window_sums(part), axis=1) for part in (drifts.information, drifts.away))

    def passed(shares: FloatArray) -> NDArray[np.bool_]:
        values = (statistics.of_rows(shares[:, None, None] * rows)[:, :, -1] / levels[:count, None]).max(axis=0)
        if faults:
            far = beyond(shares[:, None] * away, power * (0.0 if bands is None else bands))
            ratios = far**2 / np.maximum(power, np.finfo(float).tiny)
            values = np.maximum(values, (ratios / levels[count : count + faults]).max(axis=1))
        return np.asarray(values > 1.0)

    low, high = np.zeros(len(white)), np.full(len(white), most)
    whole = passed(high)
    while (high - low).max(initial=0.0) > LIMIT_SHARE:
        middle = (low + high) / 2.0
        above = passed(middle)
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.where(whole & ~drifts.sensors_without(), high, np.inf)


def sensor_deviations(design: ObserverDesign, outputs: FloatArray) -> FloatArray:
    """Return the standard deviation of the noise of each sensor ``(ny,)`` in the plant's units.

    It is the stated one, or else it is estimated from ``outputs (n, ny)`` of a log by differences, in which slow
    changes vanish.
    """
    observer, plant = design.observer, design.plant
    stated = np.zeros(outputs.shape[1])
    if isinstance(observer, DAEObserver):
        stated = np.sqrt(np.diag(observer.R))
    elif isinstance(plant, DescriptorSystem):
        own = dict(zip(plant.output_names, np.linalg.norm(np.atleast_2d(plant.dense().Dw), axis=1), strict=True))
        names = getattr(observer, "output_names", plant.output_names)
        stated = np.array([own.get(name, 0.0) for name in names])
    learned = np.array([_third_difference_deviation(column) for column in outputs.T])
    return np.asarray(np.where(stated > 0.0, stated, learned))


def _third_difference_deviation(column: FloatArray) -> float:
    """Return the deviation of the noise in samples ``(n,)`` from their third differences; zero if most of these vanish,
    as for a coarse, slow or stuck sensor."""
    third = np.diff(column, n=3)
    third = third[np.isfinite(third)]
    if not third.size:
        return 0.0
    return MEDIAN_DEVIATIONS * float(np.median(np.abs(third))) / float(np.sqrt(THIRD_DIFFERENCES))


def linear_drifts(observer: LinearObserver, offsets: FloatArray) -> SensorDrifts:
    """Return the steady-state effects of offsets ``(ny,)`` of each sensor on a linear observer; raise `SpecError` if
    there is no steady state."""
    held = (np.eye(observer.order) if observer.dt > 0.0 else np.zeros_like(observer.Az)) - observer.Az
    try:
        gains = observer.Dy + observer.Cz @ np.linalg.solve(held, observer.By)
        rows = np.concatenate([gains[observer.fault_rows], gains[observer.residual_rows]]) * offsets
    except np.linalg.LinAlgError:
        rows = np.full((1, len(offsets)), np.nan)
    if not np.isfinite(rows).all():
        raise SpecError(
            "The design integrates a measurement: what an offset of a sensor does to it never settles, and no room for "
            "a drift is enough. Leave sensor_drift at 0.",
            path="sensor_drift",
        )
    steady = np.repeat(rows.T[:, None], max(AGES) + MOST_ORDER, axis=1)
    nothing = np.zeros((len(offsets), 0, 0))
    return SensorDrifts(steady, nothing, nothing, nothing, offsets)


def drifts_by_runs(run: Callable[[FloatArray], Any], offsets: FloatArray) -> SensorDrifts:
    """Return the effects of offsets ``(ny,)`` of each sensor by runs.

    ``run`` takes the numbers that are added to the outputs ``(ny,)``, and returns rows ``watched`` and ``scores``.
    """
    usual = run(np.zeros_like(offsets))
    half = len(usual.watched) // 2
    centre = usual.scores.centre() if usual.scores is not None and usual.scores.determine else None
    parts = []
    for one in np.diag(offsets):
        other = run(one)
        watched = (other.watched - usual.watched)[half:]
        if centre is None or usual.scores is None or other.scores is None:
            nothing = np.zeros((len(watched), 0))
            parts.append((watched, nothing, nothing, nothing))
            continue
        first, second = usual.scores.chosen(slice(half, None)), other.scores.chosen(slice(half, None))
        parts.append((watched, *_of_scores(first, second, centre)))
    watched, away, information, theta = (np.array(column) for column in zip(*parts, strict=True))
    return SensorDrifts(watched, away, information, theta, offsets)


def _of_scores(usual: Scores, other: Scores, centre: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    own = np.einsum("kii->ki", usual.information)
    return other.away(centre) - usual.away(centre), own, np.nan_to_num(other.theta - usual.theta)


def _window_sums(values: FloatArray) -> FloatArray:
    """Return sums of ``(ny, n, k)`` over windows of the memory of the statistics; over all rows if there are fewer."""
    sums = np.cumsum(values, axis=1)
    length = min(max(AGES), values.shape[1])
    before = np.concatenate([np.zeros_like(sums[:, :1]), sums[:, :-length]], axis=1)
    return np.asarray(sums[:, length - 1 :] - before)


def _together(effects: FloatArray) -> FloatArray:
    """Return the sizes ``(k,)`` of effects ``(ny, n, k)``: a quantile over rows, and the norm over sensors."""
    if not effects.shape[1]:
        return np.zeros(effects.shape[2])
    return np.asarray(np.linalg.norm(np.quantile(effects, EFFECT_SHARE, axis=1), axis=0))
