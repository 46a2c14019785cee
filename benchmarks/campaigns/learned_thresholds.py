"""Thresholds learned from rows without faults: the rate of false alarms on 40,000 fresh rows, against the stated one.

White, coloured, heavy-tailed and correlated streams, with an offset, of 500 and 2,000 rows, for one alarm in 200 and in
1,000 rows; where the rows are too few by the rule that users are told, the row says so.
"""

from __future__ import annotations

import numpy as np
from benchmarks.campaigns.frame import Outcome
from scipy.signal import lfilter

from obsynth.experiments.monitors.learned_levels import Statistics, count_alarms, learned_levels, rows_needed
from obsynth.numerics.autoregression import fitted_autoregression

CASES = 180
LIMIT = 60.0  # s
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


def case(seed: int) -> Outcome:
    """Learn thresholds from a drawn log, and count alarms on fresh rows."""
    name = list(STREAMS)[seed % len(STREAMS)]
    rows, every = ((500, 200.0), (500, 1000.0), (2000, 200.0), (2000, 1000.0))[seed // len(STREAMS) % 4]
    rng = np.random.default_rng(seed)
    normal, fresh = drawn(name, rows, rng), drawn(name, FRESH, rng)
    model = fitted_autoregression(normal)
    signatures = np.eye(normal.shape[1])
    statistics = Statistics.of(model, signatures, tuple(f"signal {i}" for i in range(len(signatures))))
    levels = learned_levels(normal, every, statistics, seed)
    largest = (statistics.of_rows(model.whitened(fresh)[None]) / levels.own[:, None, None]).max(axis=0)
    factor = every * count_alarms(largest, levels.factor) / FRESH
    enough = rows >= rows_needed(model, every)
    kind = f"{rows} rows, one in {every:g}, {'enough' if enough else 'told that they are too few'}"
    found = "at most as stated" if factor <= STATED else "up to 1.5 times" if factor <= HIGH else "above 1.5 times"
    wrong = f"{name}: {factor:.2f} times the stated rate" if enough and factor > WRONG else ""
    return Outcome(kind, found, wrong)


def drawn(name: str, rows: int, rng: np.random.Generator) -> np.ndarray:
    """Return fault-free rows ``(rows, m)``."""
    m, memory, freedom, correlation = STREAMS[name]
    noise = rng.standard_t(freedom, (rows + 300, m)) if freedom > 0 else rng.standard_normal((rows + 300, m))
    noise = noise @ np.linalg.cholesky((1.0 - correlation) * np.eye(m) + correlation).T
    return lfilter([1.0, 0.8] if freedom < 0 else [1.0], [1.0, -memory], noise, axis=0)[300:] + 3.0
