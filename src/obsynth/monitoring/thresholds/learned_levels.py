"""Alarm levels from rows without faults, by a bootstrap.

Levels are found for the statistics of whitened rows (`learned_statistics`) and, where the design models faults as
random walks, for the likelihood ratios of a change of each fault (`parameter_scores`).  The bootstrap draws streams of
rows in blocks from the whitened rows (Politis & Romano 1994); the largest of them are drawn from a generalised Pareto
tail.  From each stream all that was estimated from the log is estimated again.  In this way the levels take into
account how little a short log says: the rate of alarms holds in the share `SURE_STREAMS` of the streams (after Gandy &
Kvaloy 2013).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.thresholds.learned_statistics import AGES, FORGETTING, Statistics, likelihood_ratios
from obsynth.monitoring.thresholds.parameter_scores import ScoreModel, Scores, change_ratios
from obsynth.monitoring.thresholds.slow_offsets import offset_bound
from obsynth.numerics.arrays import SMALLEST, FloatArray, read_only
from obsynth.numerics.autoregression import Autoregression, fitted_autoregression

#: An alarm ends after this many consecutive rows below the level.
HOLD = 20

#: Exponent between one level for all ages (0) and a level for each age at which all have the same rate (1).  In noise
#: with heavy tails, old steps need a lower level than new ones, because a single wrong row resembles a new step.
#: Measured in 30 logs of 2,000 rows, as ratios to the delay with exponent 0.  With 1: a step of a third of a deviation,
#: .44 (t noise of 5 degrees of freedom) to .95 (ARMA); a step of one deviation of a resonance, 1.16; of three
#: deviations in three signals, 1.22.  With 1/2: .73 to .98, 1.05 and 1.03.
OWN_LEVEL_SHARE = 0.5

#: Number of streams from which the levels of ages are found, and least number of rows for each alarm in them, in
#: multiples of the oldest age: the likelihood ratio of an old step stays above its level for about as long as its age.
AGE_STREAMS, AGES_APART = 8, 5

#: Rows at the start of a stream that do not count, since the statistics have not settled.
SETTLING = 100

#: Number of streams of the bootstrap, and the share of them in which the rate must hold.
STREAMS, SURE_STREAMS = 24, 0.8

#: Least and largest number of rows of a stream, and how many times the rows of one alarm it has otherwise.
LEAST_STREAM_ROWS, MOST_STREAM_ROWS, ROWS_PER_ALARM = 4_000, 20_000, 4

#: Rows until the simulated streams are stationary.
BURN_IN_ROWS = 200

#: Share of the radii to which the Pareto tail is fitted, their least number, and bounds of the shape parameter.  With a
#: smaller lower bound, thresholds from logs of 500 white rows alarmed 2.7 times too often.
TAIL_SHARE, LEAST_TAIL, SHAPES = 0.1, 20, (-0.05, 0.4)

#: Plotting position of the probability-weighted moments, and the shape below which the tail is exponential.
POSITION, NO_SHAPE = 0.35, 1e-6

#: Factors, tried in turn, by which the alarms of one statistic are rarer than those of all statistics together.
RARER = (1.4, 2.0, 2.8, 4.0, 5.6, 8.0)

#: A log with this many times the rows between two alarms gives the levels directly, by order statistics.  With 20
#: alarms in its second half, the rate exceeds 1.5 times the stated one in 2 % of logs.
CONFORMAL = 40

#: The variance of the residuals counts as correlated where the autocorrelation of their sizes, averaged over this many
#: lags, exceeds the second number and is this many standard deviations from zero.  The average was at most .03 in 120
#: logs of t noise of 5 degrees of freedom (500 to 2,000 rows), at most .05 in 32 logs of a linear design, and .06 to
#: .15 in nine of ten logs of noise whose variance is an autoregression with the coefficient .95.
SIZE_LAGS, SIZE_AUTOCORRELATION, CHANCE_DEVIATIONS = 10, 0.055, 3.1

#: Large residuals then come in groups, and levels are learned for alarms that are rarer by this factor.  Measured for
#: two kinds of such noise, 25 logs of 2,000 rows each, one alarm in 1,000 rows: without the factor the rates were .98
#: and 1.10 times the stated one, and 20 % and 8 % of the logs exceeded 1.5 times; with it .76 and .87 times, and 8 %.
RARER_WHERE_SIZES_LAST = 1.5

#: Number of rows that a log must have, in multiples of the rows over which the whitening model remembers one row.
MEMORIES = 100.0

#: The same for fault estimates, whose usual size is estimated again from each stream.  The rate exceeded 1.5 times the
#: stated one in 4 to 7 % of logs of 14 to 28 times their memory, and in 17 % of logs of 6 times.
MEMORIES_OF_ESTIMATES = 12.0

#: A rate counts as observed when the streams hold this many alarms; lower rates are extrapolated.
OBSERVED = 10.0


def _levels_by_age(parts: Sequence[tuple[Statistics, FloatArray]], every: float) -> FloatArray:
    """Return the numbers ``(2 s, ages)`` by which likelihood ratios are divided; their mean over ages is one.

    ``parts``: the statistics of each normal stream, and its whitened rows ``(1, n, m)``.
    """
    rate = min(max(every * RARER[0], AGES_APART * max(AGES)), sum(e.shape[1] - SETTLING for _, e in parts) / OBSERVED)
    by_age = []
    for i in range(2 * len(parts[0][0].signature_names)):
        runs = [list(likelihood_ratios(e, *(part[i] for part in judged.responses()))) for judged, e in parts]
        own = [level_of(np.concatenate(ages), rate) for ages in zip(*runs, strict=True)]
        # Streams that are too short for an age: it takes the level of the oldest age that they are long enough for.
        by_age.append(own + own[-1:] * (len(AGES) - len(own)))
    levels = np.maximum(by_age, SMALLEST) ** OWN_LEVEL_SHARE
    return read_only(levels / levels.mean(axis=1, keepdims=True))


def count_alarms(values: FloatArray, level: float) -> int:
    """Return how many alarms there are in streams ``(runs, n)``: rows above the level after `HOLD` rows below."""
    return len(_begins(np.flatnonzero(_apart(values) > level)))


def _apart(values: FloatArray) -> FloatArray:
    """Return all streams in one row, without their first `SETTLING` rows; what is put between them separates alarms."""
    runs = np.atleast_2d(values)[:, SETTLING:]
    return np.hstack([runs, np.full((len(runs), HOLD + 1), -np.inf)]).ravel()


def _begins(places: NDArray[np.int64]) -> NDArray[np.int64]:
    return places[np.diff(places, prepend=-np.inf) > HOLD]


def level_of(values: FloatArray, every: float) -> float:
    """Return the level with one alarm per ``every`` rows in streams ``(runs, n)``; the largest value where the rows are
    too few."""
    return _Ordered(values, every).level(every)


class _Ordered:
    """Streams ``(runs, n)`` in one row, and the places of their highest values in descending order.

    Only so many values are sorted as levels need that give one alarm per ``every`` rows or fewer.
    """

    def __init__(self, values: FloatArray, every: float) -> None:
        self.streams = _apart(values)
        self.rows = int(np.atleast_2d(values)[:, SETTLING:].size)
        below, count = -self.streams, self._looked_at(every)
        # Descending order; of equal values the first comes first.  Sorting all of them would take long.  NaN fails the
        # comparison, so that it is among the places, and sorts last.
        places = np.flatnonzero(~(below > np.partition(below, count - 1)[count - 1]))
        self.order = places[np.argsort(below[places], kind="stable")][:count]

    def _looked_at(self, every: float) -> int:
        return max(min(int(4 * HOLD * (self.rows / every)), self.rows), 1)

    def level(self, every: float) -> float:
        """Return the level with one alarm per ``every`` rows; the largest value where the rows are too few."""
        allowed, order = self.rows / every, self.order[: self._looked_at(every)]
        if allowed < 1.0:
            return float(self.streams[order[0]])

        def alarms(count: int) -> int:
            return len(_begins(np.sort(order[:count])))

        # Bisection for the first count of rows above the level with too many alarms: the number of alarms nearly always
        # grows with the number of rows above the level.
        low, high = int(allowed), int(allowed)
        while high < len(order) and alarms(high) <= allowed:
            low, high = high, min(len(order), int(1.2 * high) + 1)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if alarms(middle) <= allowed else (low, middle)
        return float(self.streams[order[high - 1]])


class Tail(NamedTuple):
    """A generalised Pareto tail above ``begin``."""

    begin: float
    scale: float
    shape: float

    @classmethod
    def of(cls, radii: FloatArray) -> Tail:
        """Return the tail of radii ``(n,)``, by weighted moments."""
        ordered = np.sort(radii)
        count = min(max(LEAST_TAIL, int(TAIL_SHARE * len(ordered))), len(ordered) - 1)
        begin = float(ordered[-count - 1])
        above = ordered[-count:] - begin
        mean = float(above.mean())
        weighted = float((above * (1.0 - (np.arange(1, count + 1) - POSITION) / count)).mean())
        shape = 2.0 - mean / (mean - 2.0 * weighted) if mean > 2.0 * weighted else SHAPES[1]
        shape = float(np.clip(shape, *SHAPES))
        return cls(begin, mean * (1.0 - shape), shape)

    def drawn(self, uniform: FloatArray) -> FloatArray:
        """Return radii above ``begin`` from numbers between 0 and 1."""
        if abs(self.shape) < NO_SHAPE:
            return np.asarray(self.begin - self.scale * np.log(uniform))
        return np.asarray(self.begin + self.scale * (uniform**-self.shape - 1.0) / self.shape)


def drawn_places(n: int, runs: int, rows: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the places ``(runs, rows)`` of rows that a stationary bootstrap draws in blocks from ``n`` rows."""
    new = rng.random((runs, rows)) < n ** (-1.0 / 3.0)
    new[:, 0] = True
    begun = np.maximum.accumulate(np.where(new, np.arange(rows), 0), axis=1)
    first = np.take_along_axis(rng.integers(0, n, (runs, rows)), begun, axis=1)
    return np.asarray((first + np.arange(rows) - begun) % n)


def drawn_rows(e: FloatArray, places: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
    """Return the whitened rows ``e (n, m)`` at places ``(runs, rows)``; the sizes of the largest are drawn from their
    tail."""
    rows, radii = e[places], np.linalg.norm(e, axis=1)
    tail = Tail.of(radii)
    far = radii[places] > tail.begin
    # Numbers in (0, 1], since zero would give an infinite radius.
    longer = tail.drawn(1.0 - rng.random(int(far.sum())))
    rows[far] *= (longer / radii[places][far])[:, None]
    return np.asarray(rows)


def is_conformal(rows: int, every: float) -> bool:
    """Whether a log of this many rows gives the levels directly, without a bootstrap."""
    return rows >= CONFORMAL * every


def conformal_levels(
    x: FloatArray, every: float, statistics: Statistics, scores: Scores | None = None, logs: Sequence[slice] = ()
) -> tuple[Statistics, FloatArray]:
    """Return statistics fitted to the first half of the rows ``x (n, m)``, and levels ``(k,)`` from the second half.

    Alarms in the second half are as exchangeable with later alarms as blocks of rows are (split conformal prediction,
    Papadopoulos et al. 2002).  ``scores``: information of the rows on the faults, whose usual values are those of the
    first half.
    """
    half = len(x) // 2
    model = fitted_autoregression(x[:half])
    fitted = replace(statistics, model=model)
    rng, e = np.random.default_rng(0), model.whitened(x[:half])
    e = e[np.isfinite(e).all(axis=1)]
    whites = drawn_rows(e, drawn_places(len(e), AGE_STREAMS, LEAST_STREAM_ROWS, rng), rng)
    fitted = replace(fitted, age_levels=_levels_by_age([(fitted, white[None]) for white in whites], every))
    usual = None if scores is None else _usual(scores.chosen(slice(half)))
    runs = normal_statistics(x, fitted, scores, usual)[:, None]
    first, second = (np.moveaxis(part, 1, 0) for part in (runs[..., :half], runs[..., half:]))
    own, _ = _union(first, every, half - SETTLING)
    union = (second / own[None, :, None]).max(axis=1)
    rows = int(np.asarray(np.isfinite(x[half + SETTLING :]).all(axis=1)).sum())
    levels = _of_deviations(own, usual) * exchangeable_level(union, rows, every)
    if len(logs) < 2:
        # Offsets of one log that last for many of its rows have raised these levels already.
        return fitted, read_only(levels)
    return with_bands(fitted, x, scores, logs), with_room_for_offsets(levels, fitted, x, logs)


def _of_faults(scores: Scores, centre: FloatArray, sizes: FloatArray, bands: FloatArray | None = None) -> FloatArray:
    """Return ``(2 nf, n)``: for each fault the change ratio and the square of its estimate in units of ``sizes``.

    The change ratio is twice the largest log likelihood ratio of a change away from ``centre`` by more than the fault's
    band.
    """
    changes = change_ratios(scores.away(centre), np.einsum("kii->ki", scores.information), AGES, bands)
    squares = scores.followed(centre, 0.0 if bands is None else bands).T ** 2
    return np.concatenate([changes, np.nan_to_num(squares / sizes[:, None])])


def _usual(scores: Scores) -> tuple[FloatArray, FloatArray]:
    """Return the usual values of the faults in normal rows, and the mean squares of estimates about them ``(nf,)``."""
    centre = scores.centre()
    return centre, np.nanmean(scores.followed(centre) ** 2, axis=0)


def learned_levels(
    x: FloatArray,
    every: float,
    statistics: Statistics,
    seed: int = 0,
    scores: Scores | None = None,
    logs: Sequence[slice] = (),
) -> tuple[Statistics, FloatArray, bool]:
    """Return statistics with levels by age, levels ``(k,)``, and whether the levels are extrapolated.

    Parameters
    ----------
    x : FloatArray
        Rows without faults ``(n, m)``.
    every : float
        Mean number of rows between alarms.
    statistics : Statistics
        The statistics, with the whitening model of these rows.
    seed : int, optional
        Of the bootstrap.
    scores : Scores, optional
        Information of the rows on the faults.
    logs : sequence of slice, optional
        Rows of each log.
    """
    rows = int(np.clip(ROWS_PER_ALARM * every, LEAST_STREAM_ROWS, MOST_STREAM_ROWS))
    statistics, runs = _bootstrap(x, every, statistics, rows, np.random.default_rng(seed), scores)
    total = runs[:, 0, SETTLING:].size
    seen_rate = min(every, total / OBSERVED)
    own, union = _union(runs, seen_rate, total)
    level = level_of(union, seen_rate)
    # The alarms of one stream alone cannot be as rare as those of all streams together.
    shown_rate = min(seen_rate, rows / ROWS_PER_ALARM)
    of_streams = np.array([level_of(stream, shown_rate) for stream in union])
    sure = max(1.0, float(np.quantile(of_streams, SURE_STREAMS)) / level_of(union, shown_rate))
    if every > seen_rate:
        # Extrapolation: the level rises by the same amount for each factor between rates.
        before = level_of(union, seen_rate / OBSERVED)
        level += max(level - before, 0.0) * float(np.log(every / seen_rate) / np.log(OBSERVED))
    usual = None if scores is None else _usual(scores)
    statistics = with_bands(statistics, x, scores, logs)
    levels = with_room_for_offsets(_of_deviations(own, usual) * level * sure, statistics, x, logs)
    return statistics, levels, every > seen_rate


def _bootstrap(
    x: FloatArray,
    every: float,
    statistics: Statistics,
    rows: int,
    rng: np.random.Generator,
    scores: Scores | None,
) -> tuple[Statistics, FloatArray]:
    """Return statistics with levels by age, and their values ``(STREAMS, k, rows)`` in streams of the bootstrap.

    Each stream is as long as the log and ``rows`` longer: all that is estimated is estimated from its first part, and
    the values are those of the rest.
    """
    model, n = statistics.model, len(x)
    beside = None if scores is None else ScoreModel.of(scores)
    parts = [model.whitened(x), *(() if beside is None else beside.whites)]
    complete = np.asarray(np.isfinite(np.hstack(parts)).all(axis=1))
    complete[: max(model.order, *(() if beside is None else (beside.model.order, beside.followed.order)), 0)] = False
    e, *beside_whites = [part[complete] - part[complete].mean(axis=0) for part in parts]
    # Residuals and scores of a row are drawn together, since they are dependent.
    places = drawn_places(len(e), STREAMS, BURN_IN_ROWS + n + rows, rng)
    streams = model.simulated(drawn_rows(e, places, rng))
    of_faults = None
    if beside is not None:
        of_faults = beside.drawn(
            [drawn_rows(part, places, rng) for part in beside_whites], np.flatnonzero(complete)[places]
        )
    complete = np.asarray(np.isfinite(x).all(axis=1))
    normal = np.arange(BURN_IN_ROWS, BURN_IN_ROWS + n)[complete]
    parts = []
    for stream in streams:
        rows_again = np.where(complete[:, None], stream[BURN_IN_ROWS : BURN_IN_ROWS + n], np.nan)
        again = fitted_autoregression(rows_again, order=model.order)
        parts.append((replace(statistics, model=again, estimates=()), again.whitened(stream[None, -rows:])))
    by_age = _levels_by_age(parts[:AGE_STREAMS], every)
    statistics, values_of_streams = replace(statistics, age_levels=by_age), []
    for i, (judged, e) in enumerate(parts):
        values = replace(judged, age_levels=by_age).of_rows(e)[:, 0]
        if of_faults is not None:
            score, information, followed = (part[i] for part in of_faults)
            drawn = Scores(score, information, followed, np.ones_like(followed))
            centre = drawn.chosen(normal).centre()
            # Estimates are filtered, so that their centre is not that of the scores.
            drawn = replace(drawn, theta=followed - followed[normal].mean(axis=0) + centre)
            sizes = np.mean(drawn.chosen(normal).followed(centre) ** 2, axis=0)
            values = np.concatenate([values, _of_faults(drawn.chosen(slice(-rows, None)), centre, sizes)])
        values_of_streams.append(values)
    return statistics, np.array(values_of_streams)


def exchangeable_level(values: FloatArray, rows: int, every: float) -> float:
    """Return the level that normal values pass one time fewer than a rate of one alarm per ``every`` rows allows.

    Then the mean rate in later rows is at most the stated one, since their alarms are exchangeable with these.  Where
    the allowed number is not whole, the level is interpolated between those of the two whole numbers next to it; the
    mean rate stays at most as stated for uniform to heavy tails.

    Parameters
    ----------
    values : FloatArray
        The largest statistic of normal rows ``(runs, n)``.
    rows : int
        How many of these rows are complete.
    every : float
        Mean number of rows between alarms.
    """
    allowed = max(rows / every - 1.0, 0.0)
    alarms_allowed, size = int(allowed), values[:, SETTLING:].size
    # Half an alarm more, since rounding of the two quotients may give less than the whole number.
    higher, lower = (level_of(values, size / (count + 0.5)) for count in (alarms_allowed, alarms_allowed + 1))
    return higher - (allowed - alarms_allowed) * (higher - lower)


def normal_statistics(
    x: FloatArray, statistics: Statistics, scores: Scores | None, usual: tuple[FloatArray, FloatArray] | None
) -> FloatArray:
    """Return the statistics ``(k, n)`` of rows ``(n, m)`` without faults, in the order of the log.

    ``usual``: the usual values of the faults and the mean squares in which squares of estimates are measured.
    """
    # A missing row adds no evidence.
    values = statistics.of_rows(np.nan_to_num(statistics.model.whitened(x[None])))[:, 0]
    if scores is None or usual is None:
        return values
    return np.concatenate([values, _of_faults(scores, *usual, statistics.fault_bands)])


def _of_deviations(own: FloatArray, usual: tuple[FloatArray, FloatArray] | None) -> FloatArray:
    """Return levels; those of squares of estimates in units of the deviations that the observer states."""
    if usual is not None:
        sizes = usual[1]
        own = np.concatenate([own[: -len(sizes)], own[-len(sizes) :] * sizes])
    return read_only(own)


def _union(runs: FloatArray, every: float, total: int) -> tuple[FloatArray, FloatArray]:
    """Return a level for each statistic, and the largest statistic in units of its level ``(runs, n)``.

    All statistics have one rate: the highest in `RARER` with which all of them together keep one alarm per ``every``.
    """
    own, union = np.ones(runs.shape[1]), runs[:, 0]
    ordered = [_Ordered(runs[:, i], every * RARER[0]) for i in range(runs.shape[1])]
    for rarer in RARER:
        own = np.array([streams.level(every * rarer) for streams in ordered])
        union = (runs / own[None, :, None]).max(axis=1)
        if count_alarms(union, 1.0) <= total / every:
            break
    return own, union


def lasting_sizes(white: FloatArray) -> float:
    """Return the mean autocorrelation of the sizes of whitened rows ``(n, m)``.

    Rows with NaN are left out.  The result is zero where it is small or may be chance.
    """
    sizes = np.sum(white**2, axis=1)
    scores = normal_scores(sizes[np.isfinite(sizes)])
    products = [float(scores[lag:] @ scores[:-lag]) for lag in range(1, SIZE_LAGS + 1)]
    autocorrelation = float(np.mean(products)) / max(float(scores @ scores), SMALLEST)
    return (
        autocorrelation
        if autocorrelation > max(SIZE_AUTOCORRELATION, CHANCE_DEVIATIONS / float(np.sqrt(SIZE_LAGS * len(scores))))
        else 0.0
    )


def normal_scores(values: FloatArray) -> FloatArray:
    """Return the normal scores of the ranks of values ``(n,)``, on which outliers and the distribution have no
    effect."""
    from scipy.special import ndtri
    from scipy.stats import rankdata

    return np.asarray(ndtri((rankdata(values) - 0.5) / len(values)))


def rows_needed(model: Autoregression, every: float, scores: Scores | None = None) -> int:
    """Return how many rows without faults a rate of one alarm per ``every`` rows needs.

    These are the largest of: the rows between two alarms; `MEMORIES` times the memory of the whitening model; 50 for
    each of its coefficients; with ``scores``, `MEMORIES` times their memory, counted in rows that inform on a fault,
    and `MEMORIES_OF_ESTIMATES` times the memory of the estimates.
    """
    m = model.channels
    needed = [every, MEMORIES * model.longest_gain, 50.0 * m * (1 + m * model.order)]
    if scores is not None:
        own = np.einsum("kii->ki", scores.information)
        # The effective share of rows that inform: 1 / n where a single row holds all information on a fault.
        share = float((own.sum(axis=0) ** 2 / (own**2).sum(axis=0)).min()) / len(own)
        beside = ScoreModel.of(scores)
        needed += [MEMORIES * beside.model.longest_gain / share, MEMORIES_OF_ESTIMATES * beside.followed.longest_gain]
    return int(np.ceil(max(needed)))


def with_bands(statistics: Statistics, x: FloatArray, scores: Scores | None, logs: Sequence[slice]) -> Statistics:
    """Return statistics with bands for all offsets that the logs ``x (n, m)`` do not exclude, so that none alarms."""
    logs = logs or (slice(None),)
    e = statistics.model.whitened(x)
    complete = np.asarray(np.isfinite(e).all(axis=1))
    lasting = statistics.responses()[0][: len(statistics.signature_names), -1]
    powers = np.sum(lasting**2, axis=1)
    values = np.where(complete[:, None], np.nan_to_num(e) @ lasting.T, 0.0)
    bands = [
        offset_bound(column, np.asarray(complete * power), logs) for column, power in zip(values.T, powers, strict=True)
    ]
    of_faults = None
    if scores is not None:
        away, own = scores.away(scores.centre()), np.einsum("kii->ki", scores.information)
        of_faults = read_only(np.array([offset_bound(*pair, logs) for pair in zip(away.T, own.T, strict=True)]))
    return replace(statistics, bands=read_only(np.array(bands)), fault_bands=of_faults)


def with_room_for_offsets(
    levels: FloatArray, statistics: Statistics, x: FloatArray, logs: Sequence[slice]
) -> FloatArray:
    """Return levels in which those of T2 and MEWMA are raised by what offsets add to these statistics."""
    size = offset_size(statistics, x, logs)
    gains = np.sqrt([1.0, *((2.0 - share) / share for share in FORGETTING)])
    raised = levels.copy()
    raised[: len(gains)] = (np.sqrt(raised[: len(gains)]) + gains * size) ** 2
    return read_only(raised)


def offset_size(statistics: Statistics, x: FloatArray, logs: Sequence[slice]) -> float:
    """Return the norm of the largest offset of the whitened rows that the logs ``x (n, m)`` do not exclude."""
    e = statistics.model.whitened(x)
    complete = np.asarray(np.isfinite(e).all(axis=1))
    logs = logs or (slice(None),)
    white = np.where(complete[:, None], np.nan_to_num(e), 0.0)
    return float(np.linalg.norm([offset_bound(column, complete.astype(np.float64), logs) for column in white.T]))
