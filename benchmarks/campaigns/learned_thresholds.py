"""Thresholds learned from rows without faults: false alarms on 40,000 fresh rows, and delays.

Rates: white, coloured, heavy-tailed and correlated streams, with an offset, of 500 to 10,000 rows, for one alarm in 200
and in 1,000 rows; where the rows are too few by the rule that users are told, the row says so.  The mean is that of the
factor between the rate found and the stated one.  Delays: of 39 steps (in deviations of the signal) and ramps (a
deviation in 100 rows), learned from 2,000 rows for one alarm in 1,000, a miss counts 750 rows; the mean is that of the
factor between the mean delay and the one that `REFERENCE` holds.
"""

from __future__ import annotations

import numpy as np
from benchmarks.campaigns.frame import Outcome
from scipy.signal import lfilter

from obsynth.monitoring.thresholds.learned_levels import (
    conformal_levels,
    count_alarms,
    is_conformal,
    learned_levels,
    rows_needed,
)
from obsynth.monitoring.thresholds.learned_statistics import Statistics
from obsynth.numerics.autoregression import fitted_autoregression

LIMIT = 120.0  # s
FRESH = 40_000
#: Factors on the stated rate: counted up to these; where the rows suffice, more than the last is wrong.
STATED, HIGH, WRONG = 1.0, 1.5, 4.0
#: Signals, memory, degrees of freedom of the noise (0: Gaussian), correlation.
STREAMS = {
    "white": (1, 0.0, 0, 0.0),
    "AR .5": (1, 0.5, 0, 0.0),
    "AR .9": (1, 0.9, 0, 0.0),
    "AR .9, t4": (1, 0.9, 4, 0.0),
    "t5": (1, 0.0, 5, 0.0),
    "2 signals, AR .7": (2, 0.7, 0, 0.6),
    "3 signals, AR .8": (3, 0.8, 0, 0.3),
    "5 signals, AR .5": (5, 0.5, 0, 0.6),
    "ARMA": (1, 0.6, -1, 0.0),
}
#: Rows without faults, and rows per alarm.
ASKED = ((500, 200.0), (500, 1000.0), (2000, 200.0), (2000, 1000.0), (10_000, 200.0), (10_000, 1000.0))
ROUNDS = 5
RATES = ROUNDS * len(ASKED) * len(STREAMS)
#: Streams of delays: coefficients of what they remember ``(m, m)`` a row, of their noise, and its degrees of freedom.
DELAYED = {
    "resonance": ([[[1.6]], [[-0.8]]], 0.0, 0),
    "ARMA": ([[[0.9]]], 0.8, 0),
    "t5": ([[[0.0]]], 0.0, 5),
    "3 coupled signals": ([[[0.8, 0.1, 0.0], [0.0, 0.7, 0.2], [0.1, 0.0, 0.8]]], 0.0, 0),
}
#: Sizes of a step in deviations; 0 is the ramp.
SIZES = (1.0 / 3.0, 1.0, 3.0, 0.0)
LOGS = 3
CASES = RATES + LOGS * len(DELAYED) * len(SIZES)
NORMAL, EVERY, STEPS, LASTING, RAMP = 2_000, 1_000.0, 39, 750, 0.01
#: Mean delays in rows, by stream, size and log, of the same method without ramps (its levels bootstrapped in the same
#: way by a program of its own), on the same rows.  A share of a row is added to both, so that delays of none compare.
REFERENCE = {
    "resonance": [[178.87, 179.97, 307.62], [9.28, 6.69, 5.72], [0.0, 0.0, 0.0], [83.79, 94.31, 86.44]],
    "ARMA": [[595.64, 661.92, 667.67], [5.03, 0.67, 5.64], [0.0, 0.0, 0.0], [162.59, 266.23, 191.38]],
    "t5": [[396.67, 149.92, 357.41], [27.1, 19.87, 15.69], [2.23, 2.74, 2.26], [87.03, 85.33, 72.82]],
    "3 coupled signals": [
        [491.95, 561.67, 436.97],
        [60.21, 99.21, 71.85],
        [0.95, 0.13, 0.38],
        [127.92, 118.36, 118.97],
    ],
}
SHARE = 1.0
#: A delay of one log may be so many times that of the reference; of all of a kind, at most 1.1 times.
LATE = 1.5


def case(seed: int) -> Outcome:
    """Learn thresholds from a drawn log, and count alarms on fresh rows, or rows until a fault is told."""
    if seed >= RATES:
        return delayed(seed - RATES)
    name = list(STREAMS)[seed % len(STREAMS)]
    rows, every = ASKED[seed // len(STREAMS) % len(ASKED)]
    rng = np.random.default_rng(seed)
    normal, fresh = drawn(name, rows, rng), drawn(name, FRESH, rng)
    statistics, levels = learned(normal, every, seed)
    largest = ratios(statistics, levels, fresh)
    factor = every * count_alarms(largest, 1.0) / FRESH
    enough = rows >= rows_needed(statistics.model, every)
    kind = f"{rows} rows, one in {every:g}, {'enough' if enough else 'told that they are too few'}"
    found = "at most as stated" if factor <= STATED else "up to 1.5 times" if factor <= HIGH else "above 1.5 times"
    wrong = f"{name}: {factor:.2f} times the stated rate" if enough and factor > WRONG else ""
    return Outcome(kind, found, wrong, factor)


def learned(normal: np.ndarray, every: float, seed: int) -> tuple[Statistics, np.ndarray]:
    """Return statistics and levels as `obsynth.learn_thresholds` takes them."""
    signatures = np.diag(normal.std(axis=0))
    told = tuple(f"signal {i}" for i in range(len(signatures)))
    statistics = Statistics(fitted_autoregression(normal), signatures, told)
    if is_conformal(len(normal), every):
        return conformal_levels(normal, every, statistics)
    return learned_levels(normal, every, statistics, seed)[:2]


def ratios(statistics: Statistics, levels: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the largest statistic of rows ``(n, m)`` in units of its level."""
    found = statistics.of_rows(statistics.model.whitened(x)[None])[:, 0]
    return np.asarray((found / levels[:, None]).max(axis=0))


def drawn(name: str, rows: int, rng: np.random.Generator) -> np.ndarray:
    """Return fault-free rows ``(rows, m)``."""
    m, memory, freedom, correlation = STREAMS[name]
    noise = rng.standard_t(freedom, (rows + 300, m)) if freedom > 0 else rng.standard_normal((rows + 300, m))
    noise = noise @ np.linalg.cholesky((1.0 - correlation) * np.eye(m) + correlation).T
    return lfilter([1.0, 0.8] if freedom < 0 else [1.0], [1.0, -memory], noise, axis=0)[300:] + 3.0


def faulty(number: int) -> tuple[str, int, int, np.ndarray, np.ndarray]:
    """Return stream, size and log of a case of delays, its normal rows, and rows of which every second piece of
    `LASTING` has a fault in its first signal."""
    name = list(DELAYED)[number // (LOGS * len(SIZES))]
    size, log = number // LOGS % len(SIZES), number % LOGS
    coefficients, moving, freedom = DELAYED[name]
    m, rng = len(coefficients[0]), np.random.default_rng([number, RATES])
    rows = NORMAL + 2 * STEPS * LASTING + 300
    noise = rng.standard_t(freedom, (rows, m)) if freedom else rng.standard_normal((rows, m))
    noise[1:] += moving * noise[:-1]
    x = np.zeros_like(noise)
    for k in range(rows):
        x[k] = noise[k] + sum(np.asarray(a) @ x[k - i] for i, a in enumerate(coefficients, 1) if k >= i)
    x = x[300:] / x[300:].std(axis=0)
    course = np.tile(np.repeat([0.0, 1.0], LASTING), STEPS)
    ramp = np.tile(np.concatenate([np.zeros(LASTING), RAMP * np.arange(1, LASTING + 1)]), STEPS)
    fault = x[NORMAL:].copy()
    fault[:, 0] += SIZES[size] * course if SIZES[size] else ramp
    return name, size, log, x[:NORMAL], fault


def mean_delay(above: np.ndarray) -> float:
    """Return the mean of rows until a row is above its level after a fault begins; `LASTING` where none is."""
    pieces = above.reshape(STEPS, 2, LASTING)[:, 1]
    return float(np.where(pieces.any(axis=1), pieces.argmax(axis=1), LASTING).mean())


def delayed(number: int) -> Outcome:
    """Measure the mean delay of faults."""
    name, size, log, normal, rows = faulty(number)
    delay = mean_delay(ratios(*learned(normal, EVERY, number), rows) > 1.0)
    factor = (delay + SHARE) / (REFERENCE[name][size][log] + SHARE)
    told = f"a step of {SIZES[size]:.2g}" if SIZES[size] else "a ramp"
    found = "no later" if factor <= 1.0 else "up to 1.1 times" if factor <= 1.1 else "later"
    wrong = f"{delay:.4g} rows, {factor:.2f} times the reference's" if factor > LATE else ""
    return Outcome(f"delay of {told}, {name}", found, wrong, factor)
