"""Levels of alarms from rows without faults: a bootstrap of all that is estimated.

Beside the statistics of whitened rows (`learned_statistics`) stand, where fault estimates follow from a walk of theirs,
likelihood ratios of changes of each (`parameter_scores`).  The bootstrap makes streams from blocks of the whitened rows
(Politis & Romano 1994) whose largest follow a generalised Pareto tail; from each it fits everything again, so that the
uncertainty of a short log is in the levels, which hold in `SURE_STREAMS` of the streams (after Gandy & Kvaloy 2013).
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

#: An alarm ends when so many rows in a row were below the level.
HOLD = 20

#: How far the level of each age is its own at one rate for all of them (one), or the same for all (zero).  In noise of
#: heavy tails old steps need a lower level than new ones, which one wrong row makes likely.  With 1, 30 logs of 2,000
#: rows told a third of a deviation after .44 (5 degrees of freedom) to .95 (ARMA) times the rows, but a deviation of a
#: resonance after 1.16, and three deviations in three signals after 1.22 times; so .73 to .98, 1.05 and 1.03 times.
OWN_LEVEL_SHARE = 0.5

#: Streams from which that is found, and how many times the oldest age there are rows for each alarm in them at least:
#: ratios of old steps stay above their level for as long.
AGE_STREAMS, AGES_APART = 8, 5

#: Rows at the begin of a stream in which the statistics are not those of a long one.
SETTLING = 100

#: Streams of the bootstrap, their share in which the rate is to hold, and the rows that each is judged on.
STREAMS, SURE_STREAMS = 24, 0.8

LEAST_STREAM_ROWS, MOST_STREAM_ROWS, ROWS_PER_ALARM = 4_000, 20_000, 4

#: Rows until the simulated streams are stationary.
BURN_IN_ROWS = 200

#: Share of the radii that follow the Pareto tail, least number of them, and bounds of its shape: with a lighter tail
#: than the least, logs of 500 white rows rang 2.7 times too often.
TAIL_SHARE, LEAST_TAIL, SHAPES = 0.1, 20, (-0.05, 0.4)

#: A plotting position of weighted moments, and a shape that is an exponential one.
POSITION, NO_SHAPE = 0.35, 1e-6

#: How many times rarer than all together each statistic may ring, tried in turn.
RARER = (1.4, 2.0, 2.8, 4.0, 5.6, 8.0)

#: So many times the rows of a rate show it themselves: with 20 alarms in their second half, 1.5 times the rate is
#: passed in 2 % of logs.
CONFORMAL = 40

#: The size of the residuals follows itself where its autocorrelation is above the second number on average of so many
#: lags, and by so many deviations of chance: of 120 logs of noise of 5 degrees of freedom (500 to 2,000 rows) it is .03
#: at most, of 32 of a linear design .05, and of noise whose variance follows itself by .95 .06 to .15 in nine of ten.
SIZE_LAGS, SIZE_AUTOCORRELATION, CHANCE_DEVIATIONS = 10, 0.055, 3.1

#: Large ones come together then: levels are learned for alarms that are so many times as rare.  Of 25 logs each of such
#: noise (2,000 rows, one alarm in 1,000) rates were .98 and 1.10 times the stated ones without this, .76 and .87 with
#: it, and 20 % and 8 % of the logs were above 1.5 times, or 8 %.
RARER_WHERE_SIZES_LAST = 1.5

#: Rows that are needed, of each that one row is remembered for.
MEMORIES = 100.0

#: The same of estimates, whose usual size each stream finds again: with 14 to 28 times what they remember 1.5 times the
#: rate was passed in 4 to 7 % of logs, with 6 times in 17 %.
MEMORIES_OF_ESTIMATES = 12.0

#: A rate counts as observed when so many alarms of it are in the streams; rarer ones are extrapolated.
OBSERVED = 10.0


def _levels_by_age(parts: Sequence[tuple[Statistics, FloatArray]], every: float) -> FloatArray:
    """Return what likelihood ratios of each age are to be divided by, ``(2 s, ages)``, of mean one over ages, from
    normal streams: statistics and white rows ``(1, n, m)`` of each."""
    rate = min(max(every * RARER[0], AGES_APART * max(AGES)), sum(e.shape[1] - SETTLING for _, e in parts) / OBSERVED)
    by_age = []
    for i in range(2 * len(parts[0][0].signature_names)):
        runs = [list(likelihood_ratios(e, *(part[i] for part in judged.responses()))) for judged, e in parts]
        own = [level_of(np.concatenate(ages), rate) for ages in zip(*runs, strict=True)]
        # Ages for which the streams are too short are as the oldest of them.
        by_age.append(own + own[-1:] * (len(AGES) - len(own)))
    levels = np.maximum(by_age, SMALLEST) ** OWN_LEVEL_SHARE
    return read_only(levels / levels.mean(axis=1, keepdims=True))


def count_alarms(values: FloatArray, level: float) -> int:
    """Return how many alarms there are in streams ``(runs, n)``: rows above the level after `HOLD` rows below."""
    return len(_begins(np.flatnonzero(_apart(values) > level)))


def _apart(values: FloatArray) -> FloatArray:
    """Return streams in one, with rows between them that part their alarms; `SETTLING` rows are left out."""
    runs = np.atleast_2d(values)[:, SETTLING:]
    return np.hstack([runs, np.full((len(runs), HOLD + 1), -np.inf)]).ravel()


def _begins(places: NDArray[np.int64]) -> NDArray[np.int64]:
    return places[np.diff(places, prepend=-np.inf) > HOLD]


def level_of(values: FloatArray, every: float) -> float:
    """Return the level with one alarm per ``every`` rows in streams ``(runs, n)``; the largest value where these are
    too few."""
    return _Ordered(values, every).level(every)


class _Ordered:
    """Streams ``(runs, n)`` in one, with the places of their highest values in order: for levels of alarms that are as
    rare as ``every`` or rarer."""

    def __init__(self, values: FloatArray, every: float) -> None:
        self.streams = _apart(values)
        self.rows = int(np.atleast_2d(values)[:, SETTLING:].size)
        below, count = -self.streams, self._looked_at(every)
        # The highest first; of equal ones the first comes first.  Only these need an order: the others are many.  What
        # is no number is no less than any, and comes last.
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

        # The first descent of the level at which there are too many: alarms grow nearly always with the rows above.
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
        """Return radii above the begin from numbers between 0 and 1."""
        if abs(self.shape) < NO_SHAPE:
            return np.asarray(self.begin - self.scale * np.log(uniform))
        return np.asarray(self.begin + self.scale * (uniform**-self.shape - 1.0) / self.shape)


def drawn_places(n: int, runs: int, rows: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return places ``(runs, rows)`` in ``n`` rows, of blocks of these."""
    new = rng.random((runs, rows)) < n ** (-1.0 / 3.0)
    new[:, 0] = True
    begun = np.maximum.accumulate(np.where(new, np.arange(rows), 0), axis=1)
    first = np.take_along_axis(rng.integers(0, n, (runs, rows)), begun, axis=1)
    return np.asarray((first + np.arange(rows) - begun) % n)


def drawn_rows(e: FloatArray, places: NDArray[np.int64], rng: np.random.Generator) -> FloatArray:
    """Return the white rows ``(n, m)`` at places ``(runs, rows)``, the largest drawn from their tail."""
    rows, radii = e[places], np.linalg.norm(e, axis=1)
    tail = Tail.of(radii)
    far = radii[places] > tail.begin
    # Numbers in (0, 1]: zero would be infinitely far.
    longer = tail.drawn(1.0 - rng.random(int(far.sum())))
    rows[far] *= (longer / radii[places][far])[:, None]
    return np.asarray(rows)


def is_conformal(rows: int, every: float) -> bool:
    """Whether so many rows show the rate themselves, so that no bootstrap has to."""
    return rows >= CONFORMAL * every


def conformal_levels(
    x: FloatArray, every: float, statistics: Statistics, scores: Scores | None = None, logs: Sequence[slice] = ()
) -> tuple[Statistics, FloatArray]:
    """Return statistics fitted to the first half of rows ``(n, m)``, and their levels ``(k,)`` from the second;
    ``scores``: what these rows say of faults, which are where the first half has them.

    Alarms in the second half are as exchangeable with later ones as blocks of rows are (split conformal: Papadopoulos
    et al. 2002).
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
        # Where many rows of one log lie elsewhere, they have raised these levels already.
        return fitted, read_only(levels)
    return with_bands(fitted, x, scores, logs), with_room_for_offsets(levels, fitted, x, logs)


def _of_faults(scores: Scores, centre: FloatArray, sizes: FloatArray, bands: FloatArray | None = None) -> FloatArray:
    """Return twice the largest log likelihood ratios of changes of each fault from there by more than ``bands (nf,)``,
    and the squares of estimates in units of what is usual, ``(2 nf, n)``."""
    changes = change_ratios(scores.away(centre), np.einsum("kii->ki", scores.information), AGES, bands)
    squares = scores.followed(centre, 0.0 if bands is None else bands).T ** 2
    return np.concatenate([changes, np.nan_to_num(squares / sizes[:, None])])


def _usual(scores: Scores) -> tuple[FloatArray, FloatArray]:
    """Return where normal rows have the faults, and the usual squares of estimates from there ``(nf,)``."""
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
    """Return statistics with levels by age, the levels ``(k,)`` for one alarm per ``every`` rows from rows ``(n, m)``
    without faults, and whether they are extrapolated; ``scores``: what these rows say of faults."""
    rng = np.random.default_rng(seed)
    model, n = statistics.model, len(x)
    rows = int(np.clip(ROWS_PER_ALARM * every, LEAST_STREAM_ROWS, MOST_STREAM_ROWS))
    beside = None if scores is None else ScoreModel.of(scores)
    parts = [model.whitened(x), *(() if beside is None else beside.whites)]
    complete = np.asarray(np.isfinite(np.hstack(parts)).all(axis=1))
    complete[: max(model.order, *(() if beside is None else (beside.model.order, beside.followed.order)), 0)] = False
    e, *beside_whites = [part[complete] - part[complete].mean(axis=0) for part in parts]
    # What is drawn together happened together.
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
            # Estimates follow from what samples before them said, and have a centre of their own.
            drawn = replace(drawn, theta=followed - followed[normal].mean(axis=0) + centre)
            sizes = np.mean(drawn.chosen(normal).followed(centre) ** 2, axis=0)
            values = np.concatenate([values, _of_faults(drawn.chosen(slice(-rows, None)), centre, sizes)])
        values_of_streams.append(values)
    runs = np.array(values_of_streams)
    total = runs[:, 0, SETTLING:].size
    seen_rate = min(every, total / OBSERVED)
    own, union = _union(runs, seen_rate, total)
    level = level_of(union, seen_rate)
    # One stream alone shows less rare alarms than all of them.
    shown_rate = min(seen_rate, rows / ROWS_PER_ALARM)
    of_streams = np.array([level_of(stream, shown_rate) for stream in union])
    sure = max(1.0, float(np.quantile(of_streams, SURE_STREAMS)) / level_of(union, shown_rate))
    if every > seen_rate:
        # Beyond what the streams show, levels rise by the same amount for each factor between rates.
        before = level_of(union, seen_rate / OBSERVED)
        level += max(level - before, 0.0) * float(np.log(every / seen_rate) / np.log(OBSERVED))
    usual = None if scores is None else _usual(scores)
    statistics = with_bands(statistics, x, scores, logs)
    levels = with_room_for_offsets(_of_deviations(own, usual) * level * sure, statistics, x, logs)
    return statistics, levels, every > seen_rate


def exchangeable_level(values: FloatArray, rows: int, every: float) -> float:
    """Return the level in normal ``values (runs, n)``, of so many ``rows`` that say something, with one alarm fewer
    than a rate of one in ``every`` allows: then the mean rate of later rows is at most that, as their alarms are
    exchangeable with these.

    Where less than a whole alarm is allowed beside the others, the level is as much nearer to that of one more: as a
    share of what is between them, this leaves the mean at most as stated for tails from even to heavy ones.
    """
    allowed = max(rows / every - 1.0, 0.0)
    alarms_allowed, size = int(allowed), values[:, SETTLING:].size
    # Halves, as a quotient of a quotient may be less than the whole number.
    higher, lower = (level_of(values, size / (count + 0.5)) for count in (alarms_allowed, alarms_allowed + 1))
    return higher - (allowed - alarms_allowed) * (higher - lower)


def normal_statistics(
    x: FloatArray, statistics: Statistics, scores: Scores | None, usual: tuple[FloatArray, FloatArray] | None
) -> FloatArray:
    """Return the statistics of rows ``(n, m)`` without faults as they came, ``(k, n)``, of faults in units of what is
    ``usual``."""
    # A row that is missing adds no evidence.
    values = statistics.of_rows(np.nan_to_num(statistics.model.whitened(x[None])))[:, 0]
    if scores is None or usual is None:
        return values
    return np.concatenate([values, _of_faults(scores, *usual, statistics.fault_bands)])


def _of_deviations(own: FloatArray, usual: tuple[FloatArray, FloatArray] | None) -> FloatArray:
    """Return levels of which those of squares of estimates are in units of the observer's own deviations."""
    if usual is not None:
        sizes = usual[1]
        own = np.concatenate([own[: -len(sizes)], own[-len(sizes) :] * sizes])
    return read_only(own)


def _union(runs: FloatArray, every: float, total: int) -> tuple[FloatArray, FloatArray]:
    """Return levels of each statistic at one rarer rate, the least rare with which all together keep theirs, and the
    largest statistic in units of its level ``(runs, n)``."""
    own, union = np.ones(runs.shape[1]), runs[:, 0]
    ordered = [_Ordered(runs[:, i], every * RARER[0]) for i in range(runs.shape[1])]
    for rarer in RARER:
        own = np.array([streams.level(every * rarer) for streams in ordered])
        union = (runs / own[None, :, None]).max(axis=1)
        if count_alarms(union, 1.0) <= total / every:
            break
    return own, union


def lasting_sizes(white: FloatArray) -> float:
    """Return the mean autocorrelation of the size of white rows ``(n, m)``, NaN left out, and zero where it may be
    chance or is small."""
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
    """Return the normal scores of ranks ``(n,)``: neither the distribution nor single values decide then."""
    from scipy.special import ndtri
    from scipy.stats import rankdata

    return np.asarray(ndtri((rankdata(values) - 0.5) / len(values)))


def rows_needed(model: Autoregression, every: float, scores: Scores | None = None) -> int:
    """Return how many rows without faults a rate of one alarm per ``every`` rows needs: as many as between alarms, a
    hundred times what the residuals remember, and enough for every coefficient; of what they say of faults (``scores``)
    a hundred times what that remembers, in rows that say as much as most of it comes from, and twelve times what the
    estimates remember."""
    m = model.channels
    needed = [every, MEMORIES * model.longest_gain, 50.0 * m * (1 + m * model.order)]
    if scores is not None:
        own = np.einsum("kii->ki", scores.information)
        # Of n rows of which one alone tells of a fault, one counts.
        share = float((own.sum(axis=0) ** 2 / (own**2).sum(axis=0)).min()) / len(own)
        beside = ScoreModel.of(scores)
        needed += [MEMORIES * beside.model.longest_gain / share, MEMORIES_OF_ESTIMATES * beside.followed.longest_gain]
    return int(np.ceil(max(needed)))


def with_bands(statistics: Statistics, x: FloatArray, scores: Scores | None, logs: Sequence[slice]) -> Statistics:
    """Return statistics in which no offset alarms that the logs, of rows ``(n, m)``, do not exclude."""
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
    """Return levels of T2 and MEWMA raised by what offsets add to them."""
    size = offset_size(statistics, x, logs)
    gains = np.sqrt([1.0, *((2.0 - share) / share for share in FORGETTING)])
    raised = levels.copy()
    raised[: len(gains)] = (np.sqrt(raised[: len(gains)]) + gains * size) ** 2
    return read_only(raised)


def offset_size(statistics: Statistics, x: FloatArray, logs: Sequence[slice]) -> float:
    """Return how long offsets of the whitened rows are that the logs, of rows ``(n, m)``, do not exclude."""
    e = statistics.model.whitened(x)
    complete = np.asarray(np.isfinite(e).all(axis=1))
    logs = logs or (slice(None),)
    white = np.where(complete[:, None], np.nan_to_num(e), 0.0)
    return float(np.linalg.norm([offset_bound(column, complete.astype(np.float64), logs) for column in white.T]))
