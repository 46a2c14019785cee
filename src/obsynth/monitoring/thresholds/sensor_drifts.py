"""Allowed slow drifts of sensors: their effect on statistics, whether the logs show any or not.

A log without faults holds one drift of each sensor, or none; a later one may have another.  Each sensor may be off by
so many deviations of its noise, slowly.  What that does to a linear observer's rows is a matrix, its steady state;
other observers run again, with the offset added to each output in turn.  Their differences are linear to first order.
Each sensor by itself: what each does along a direction adds up in squares, as drifts of sensors are independent.
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

#: An observer runs again over so many rows of a log: an offset has settled in the first half of them.
DRIFT_ROWS = 3_000

#: What a drift that nobody allows for does is judged over so many rows, and to this share of its size.
LIMIT_ROWS, LIMIT_SHARE = 1_000, 0.01

#: Effects change with the inputs: this share of the rows has smaller ones.
EFFECT_SHARE = 0.95

#: The deviation of normal noise in its median absolute value, and the variance of third differences in that of samples.
MEDIAN_DEVIATIONS, THIRD_DIFFERENCES = 1.4826, 20.0


class SensorDrifts(NamedTuple):
    """What offsets of each sensor do, once they have settled: differences to the rows without them; of some sensors
    nothing is known."""

    watched: FloatArray  # ``(ny, n, m)``: of fault estimates and residuals; NaN where nothing is known
    away: FloatArray  # ``(ny, n, nf)``: of scores of changes of the faults; no rows where there are no scores
    information: FloatArray  # ``(ny, n, nf)``: how much these rows say of each fault alone
    theta: FloatArray  # ``(ny, n, nf)``: of the faults' estimates beside the scores
    offsets: FloatArray  # ``(ny,)``: zero where no noise of a sensor is known

    def sensors_without(self) -> NDArray[np.bool_]:
        """Return the sensors for which there is no room ``(ny,)``: those without noise, and those whose offset leaves
        no row known."""
        known = np.isfinite(self.watched).any(axis=(1, 2))
        return np.asarray((self.offsets == 0.0) | ~known)

    def white_means(self, statistics: Statistics, columns: list[int]) -> FloatArray:
        """Return means of the effects on whitened rows, over as many rows as statistics look back: ``(ny, k, m)``."""
        model = replace(statistics.model, offset=np.zeros(statistics.model.channels))
        white = model.whitened(self.watched[:, :, columns])[:, model.order :]
        known = np.asarray(np.isfinite(white).all(axis=2), dtype=bool)[:, :, None]
        counts = _window_sums(known.astype(np.float64))
        return np.asarray(_window_sums(np.where(known, white, 0.0)) / np.maximum(counts, 1.0))

    def bands(self, statistics: Statistics, means: FloatArray) -> FloatArray:
        """Return offsets along each signature that are as large as these are there ``(s,)``."""
        lasting = statistics.responses()[0][: len(statistics.signature_names), -1]
        along = np.abs(means @ lasting.T) / np.maximum(np.sum(lasting**2, axis=1), np.finfo(float).tiny)
        return _together(along)

    def fault_bands(self) -> FloatArray:
        """Return changes of each fault that are as large as these are there ``(nf,)``."""
        power = _window_sums(self.information)
        with np.errstate(divide="ignore", invalid="ignore"):
            changes = np.where(power > 0.0, np.abs(_window_sums(self.away)) / power, 0.0)
        return np.maximum(_together(changes), _together(np.abs(self.theta)))


def with_room_for_drifts(
    statistics: Statistics, levels: FloatArray, drifts: SensorDrifts, columns: list[int], size: float
) -> tuple[Statistics, FloatArray]:
    """Return statistics in which no drift alarms, and levels ``(k,)`` of T2 and MEWMA with room for what these add,
    where they have room for offsets of a ``size`` already; ``columns``: which are watched."""
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
    """Return the least share ``(ny,)`` of the offset of each sensor that, without noise, passes a level of a statistic
    for as long as it lasts; infinite where ``most`` of these offsets passes none."""
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
    """Return the deviation of the noise of each sensor ``(ny,)`` in the plant's units: as it is stated, or else as
    ``outputs (n, ny)`` of a log have it, by differences in which slow changes are no more."""
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
    """Return the deviation of noise in samples ``(n,)`` by their third differences; zero where most of these vanish, as
    those of a coarse, slow or stuck sensor."""
    third = np.diff(column, n=3)
    third = third[np.isfinite(third)]
    if not third.size:
        return 0.0
    return MEDIAN_DEVIATIONS * float(np.median(np.abs(third))) / float(np.sqrt(THIRD_DIFFERENCES))


def linear_drifts(observer: LinearObserver, offsets: FloatArray) -> SensorDrifts:
    """Return what offsets ``(ny,)`` of each sensor do to a linear observer in the steady state; refuse one that has
    none."""
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
    """Return what offsets ``(ny,)`` of each sensor do, by runs: ``run`` with what is added to the outputs ``(ny,)``
    returns rows ``watched`` and ``scores``."""
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
    """Return sums over as many rows as statistics look back, of ``(ny, n, k)``; over all where there are fewer."""
    sums = np.cumsum(values, axis=1)
    length = min(max(AGES), values.shape[1])
    before = np.concatenate([np.zeros_like(sums[:, :1]), sums[:, :-length]], axis=1)
    return np.asarray(sums[:, length - 1 :] - before)


def _together(effects: FloatArray) -> FloatArray:
    """Return how large effects ``(ny, n, k)`` are in most rows, those of all sensors together: ``(k,)``."""
    if not effects.shape[1]:
        return np.zeros(effects.shape[2])
    return np.asarray(np.linalg.norm(np.quantile(effects, EFFECT_SHARE, axis=1), axis=0))
