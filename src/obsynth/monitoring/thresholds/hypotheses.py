"""Hypotheses on the cause of an alarm: a fault of the plant, a fault of a sensor, or neither, with posterior shares.

A hypothesis is a jump or a linear drift of one fault, or of the offset of one sensor.  For each, the log likelihood
ratio is maximised over the time at which it began (Willsky & Jones 1976); prior probabilities are equal.  One further
hypothesis, a shift of the residuals in any direction, explains every lasting change.  If no fault explains nearly as
much as that shift, the alarm is reported as none of these faults.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.thresholds.alarm_ranking import NONE_OF_THESE, SENSOR, Ranking
from obsynth.monitoring.thresholds.parameter_scores import DISTINGUISHED, MODEL_SHARE
from obsynth.numerics.arrays import FloatArray

#: Twice the log likelihood ratio below which no cause is named: twice the difference that distinguishes two hypotheses.
LEAST_RATIO = 2.0 * DISTINGUISHED

#: Least share of what a shift in any direction explains that a fault must explain.  The effect of the fault is computed
#: from the model; an effect whose direction is wrong by 45 degrees explains half.
EXPLAINED_SHARE = 0.5

#: Relative difference below which the effects of a fault and of a sensor's offset are the same: the plant already has
#: that sensor's fault.
SAME_EFFECT = 1e-6


class Hypothesis(NamedTuple):
    """A jump of a fault or of a sensor's offset, or its drift."""

    name: str  # of the fault, or `SENSOR` and the output
    is_sensor: bool
    is_drift: bool


class Explanation(NamedTuple):
    """Twice the log likelihood ratio of each hypothesis, its size and the deviation of that, all ``(h,)``; and twice
    the log likelihood ratio of a shift in any direction."""

    ratios: FloatArray
    sizes: FloatArray
    deviations: FloatArray
    shift: float


def hypotheses_of(faults: Sequence[str], outputs: Sequence[str]) -> tuple[Hypothesis, ...]:
    """Return jumps of faults, then drifts of these, then jumps and drifts of sensors."""
    return tuple(
        Hypothesis(name, is_sensor, is_drift)
        for is_sensor, names in ((False, faults), (True, [SENSOR + name for name in outputs]))
        for is_drift in (False, True)
        for name in names
    )


def ranked(hypotheses: Sequence[Hypothesis], explanation: Explanation) -> Ranking | None:
    """Return the ranking of the hypotheses; `None` where neither they nor a shift explain enough, or residuals
    overflow.

    Hypotheses that the shares do not distinguish are ties, with the faults of the plant first.
    """
    if not (np.isfinite(explanation.ratios).all() and np.isfinite(explanation.shift)):
        return None
    best = dict[str, int]()
    drifts = set[str]()
    for i, hypothesis in enumerate(hypotheses):
        ratio, before = explanation.ratios[i], best.get(hypothesis.name)
        # Jumps are more usual: a drift is named only where it explains clearly more.
        if before is None or ratio > explanation.ratios[before] + DISTINGUISHED * ratio_scale(ratio):
            best[hypothesis.name] = i
            (drifts.add if hypothesis.is_drift else drifts.discard)(hypothesis.name)
    ratios = {name: float(explanation.ratios[i]) for name, i in best.items()}
    for name, value in list(ratios.items()):
        if name.startswith(SENSOR) and any(
            abs(value - other_value) <= SAME_EFFECT * value
            for other_name, other_value in ratios.items()
            if not other_name.startswith(SENSOR)
        ):
            del ratios[name]
    ratios[NONE_OF_THESE] = EXPLAINED_SHARE * explanation.shift
    if not max(ratios.values()) >= LEAST_RATIO:
        return None
    shares, (named, *ties) = _shares_and_nearest(ratios)
    size = deviation = np.nan
    if named.startswith(SENSOR):
        size, deviation = float(explanation.sizes[best[named]]), float(explanation.deviations[best[named]])
    return Ranking(shares, named, tuple(ties), named in drifts, size, deviation)


def ranked_changes(faults: Sequence[str], ratios: FloatArray, passed: NDArray[np.bool_]) -> Ranking | None:
    """Return the ranking of slow changes of faults, which the estimates follow so that no residual shows them.

    Parameters
    ----------
    faults : sequence of str
        Names of the faults.
    ratios : FloatArray
        Twice the log likelihood ratios ``(ages, nf)`` of a change of each fault; those of the likeliest age are ranked.
    passed : array of bool
        ``(nf,)``: which faults have passed their own level.  The result is `None` where none has.
    """
    of_age = ratios[int(np.argmax(ratios.max(axis=1)))]
    if not (passed.any() and np.isfinite(of_age).all()):
        return None
    by_name = dict(zip(faults, of_age.tolist(), strict=True))
    shares, (named, *ties) = _shares_and_nearest({**by_name, NONE_OF_THESE: EXPLAINED_SHARE * float(of_age.max())})
    return Ranking(shares, named, tuple(ties))


def _shares_and_nearest(ratios: Mapping[str, float]) -> tuple[tuple[tuple[str, float], ...], list[str]]:
    """Return the posterior shares, the largest first; and the hypotheses that these do not distinguish from the best,
    faults of the plant first."""
    most = max(ratios.values())
    scale = ratio_scale(most)
    weights = {name: float(np.exp(-0.5 * (most - value) / scale)) for name, value in ratios.items()}
    total = sum(weights.values())
    # Equal shares are ordered by name, so that the order of the faults in the plant changes no answer.
    shares = sorted(
        ((name, weight / total) for name, weight in weights.items()),
        key=lambda hypothesis: (-hypothesis[1], hypothesis[0]),
    )
    near = [name for name, _ in shares if most - ratios[name] <= DISTINGUISHED * scale]
    near.sort(key=lambda name: (name == NONE_OF_THESE, name.startswith(SENSOR)))
    return tuple(shares), near


def ratio_scale(ratio: float) -> float:
    """Return the divisor of differences between ratios that allows for effects of an inexact model."""
    return max(1.0, MODEL_SHARE * ratio / DISTINGUISHED)
