"""Hypotheses on an alarm: a fault of the plant, a fault of a sensor, or neither, ranked by posterior shares.

Each hypothesis is a jump, or a straight drift, of one fault or of one sensor's offset. Twice the log likelihood ratio
that it reaches, at its likeliest begin, is compared with those of the others (Willsky & Jones 1976); all are equally
likely before. Beside them stands a shift of the residuals in whatever direction: it explains all that lasts, so that
where no effect of a fault comes near to it, the alarm is none of these faults.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from obsynth.monitoring.thresholds.alarm_ranking import NONE_OF_THESE, SENSOR, Ranking
from obsynth.monitoring.thresholds.parameter_scores import DISTINGUISHED, MODEL_SHARE
from obsynth.numerics.arrays import FloatArray

#: Twice the log likelihood ratio below which nothing is ranked: twice what tells two hypotheses apart.
LEAST_RATIO = 2.0 * DISTINGUISHED

#: Share of what a shift in any direction explains that the effect of a fault explains at least: effects are those of
#: the model, and one whose direction is off by less than 45 degrees explains half.
EXPLAINED_SHARE = 0.5

#: Two effects that explain the same to this share are one: the fault of a sensor that the plant has already.
SAME_EFFECT = 1e-6


class Hypothesis(NamedTuple):
    """A jump of a fault or of a sensor's offset, or its drift."""

    name: str  # of the fault, or `SENSOR` and the output
    is_sensor: bool
    is_drift: bool


class Explanation(NamedTuple):
    """What hypotheses explain ``(h,)``: twice the log likelihood ratios, sizes and their deviations; and how much a
    shift in any of so many directions does."""

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
    """Return the ranking of what hypotheses explain; `None` where none of them, and no shift, explains anything, or
    residuals have overflowed.

    Where shares do not decide, the faults of the plant come first, and the others are ties.
    """
    if not (np.isfinite(explanation.ratios).all() and np.isfinite(explanation.shift)):
        return None
    best = dict[str, int]()
    drifts = set[str]()
    for i, hypothesis in enumerate(hypotheses):
        ratio, before = explanation.ratios[i], best.get(hypothesis.name)
        # A jump is what is usual: a drift is told where it explains clearly more.
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
    """Return the ranking of slow changes of faults, of which nothing is seen in the residuals that the estimates
    follow: by twice the log likelihood ratios ``(ages, nf)`` of a change of each, at the likeliest age; `None` where no
    fault has ``passed (nf,)`` a level by itself."""
    of_age = ratios[int(np.argmax(ratios.max(axis=1)))]
    if not (passed.any() and np.isfinite(of_age).all()):
        return None
    by_name = dict(zip(faults, of_age.tolist(), strict=True))
    shares, (named, *ties) = _shares_and_nearest({**by_name, NONE_OF_THESE: EXPLAINED_SHARE * float(of_age.max())})
    return Ranking(shares, named, tuple(ties))


def _shares_and_nearest(ratios: Mapping[str, float]) -> tuple[tuple[tuple[str, float], ...], list[str]]:
    """Return posterior shares by what hypotheses explain, the largest first; and those that are as likely as the best,
    faults of the plant first."""
    most = max(ratios.values())
    scale = ratio_scale(most)
    weights = {name: float(np.exp(-0.5 * (most - value) / scale)) for name, value in ratios.items()}
    total = sum(weights.values())
    # Of those that are exactly alike the order says nothing: names decide, so that another order changes no answer.
    shares = sorted(
        ((name, weight / total) for name, weight in weights.items()),
        key=lambda hypothesis: (-hypothesis[1], hypothesis[0]),
    )
    near = [name for name, _ in shares if most - ratios[name] <= DISTINGUISHED * scale]
    near.sort(key=lambda name: (name == NONE_OF_THESE, name.startswith(SENSOR)))
    return tuple(shares), near


def ratio_scale(ratio: float) -> float:
    """Return by how much differences of ratios count less, as effects are those of a model that is not exact."""
    return max(1.0, MODEL_SHARE * ratio / DISTINGUISHED)
