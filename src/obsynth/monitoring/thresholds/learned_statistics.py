"""Statistics of rows: Hotelling's T2, exponentially weighted means, and likelihood ratios of steps and ramps.

Residuals are whitened by their autoregression (Alwan & Roberts 1988).  Watched are Hotelling's T2, exponentially
weighted means (MEWMA, Lowry et al. 1992) and likelihood ratios of steps and ramps (Willsky & Jones 1976).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.autoregression import Autoregression

#: Ages of a step, in rows, and how far the exponentially weighted means look back.
AGES = (1, 2, 3, 5, 8, 12, 20, 32, 50, 80, 130, 200)

FORGETTING = (0.3, 0.1)


@dataclass(frozen=True, eq=False)
class Statistics:
    """What is computed of whitened rows: T2, two MEWMA, and for each signature the largest likelihood ratios of a step
    and of a ramp; beside these those of a change of each fault of ``estimates``, and the square of its estimate, of
    which `change_ratios` and `Scores.followed` are apart.

    ``signatures (s, m)``: directions of a step, and of a ramp, in the signals as they are; ``signature_names``: of
    what they are steps;
    ``age_levels (2 s, ages)``: what likelihood ratios of steps, then ramps, of each age are divided by, by default one;
    ``bands (s,)``: offsets along each signature that alarm nothing, and ``fault_bands (nf,)`` those of the faults.
    """

    model: Autoregression
    signatures: FloatArray
    signature_names: tuple[str, ...]
    estimates: tuple[str, ...] = ()
    age_levels: FloatArray | None = None
    bands: FloatArray | None = None
    fault_bands: FloatArray | None = None

    @property
    def levels_by_age(self) -> FloatArray:
        """What likelihood ratios are divided by, ``(2 s, ages)``."""
        return np.ones((2 * len(self.signature_names), len(AGES))) if self.age_levels is None else self.age_levels

    @property
    def names(self) -> tuple[str, ...]:
        """Of the statistics, in order."""
        means = (f"MEWMA {share:g}" for share in FORGETTING)
        likely = (f"GLR of a {shape} in {name}" for shape in ("step", "ramp") for name in self.signature_names)
        changes = (f"GLR of a change of {name}" for name in self.estimates)
        return ("T2", *means, *likely, *changes, *(f"square of {name}" for name in self.estimates))

    def responses(self) -> tuple[FloatArray, FloatArray]:
        """Return what steps, then ramps, of each signature do to e: their first p + 1 rows ``(2 s, p + 1, m)``, and
        what each row after that adds ``(2 s, m)``."""
        gone = np.concatenate([np.zeros((1, *np.eye(self.model.channels).shape)), np.cumsum(self.model.A, axis=0)])
        remaining = self.signatures[:, None, :] - np.einsum("jab,sb->sja", gone, self.signatures)
        steps = np.asarray(remaining @ self.model.whitener.T)
        # A ramp is a sum of steps, of which one more begins in each row.
        return (
            np.concatenate([steps, np.cumsum(steps, axis=1)]),
            np.concatenate([np.zeros_like(steps[:, -1]), steps[:, -1]]),
        )

    def long_responses(self) -> FloatArray:
        """Return what steps, then ramps, of each signature do to ``max(AGES)`` rows of e, ``(2 s, rows, m)``."""
        shapes, slopes = self.responses()
        later = shapes[:, -1:] + np.arange(1, max(AGES))[:, None] * slopes[:, None, :]
        return np.concatenate([shapes, later], axis=1)[:, : max(AGES)]

    def offset_effects(self) -> FloatArray:
        """Return what offsets at the ends of `bands` do to the roots of likelihood ratios of steps, then ramps, of each
        age, before these are divided by their levels: ``(2 s, ages)``."""
        if self.bands is None:
            return np.zeros((2 * len(self.signature_names), len(AGES)))
        lasting = np.tile(self.responses()[0][: len(self.signature_names), -1] * self.bands[:, None], (2, 1))
        long = self.long_responses()
        sums, powers = (
            np.cumsum(np.einsum("srm,sm->sr", long, lasting), axis=1),
            np.cumsum(np.sum(long**2, axis=2), axis=1),
        )
        ages = np.array(AGES) - 1
        return np.asarray(np.abs(sums[:, ages]) / np.sqrt(np.maximum(powers[:, ages], SMALLEST)))

    def templates(self) -> FloatArray:
        """Return weights of the last ``max(AGES)`` rows of e, oldest first, for steps and ramps of each signature and
        age, of which the squares add up to one over the level of this age: ``(2 s, ages, rows, m)``."""
        long = self.long_responses()
        weights = np.zeros((len(long), len(AGES), max(AGES), self.model.channels))
        for i, age in enumerate(AGES):
            part = long[:, :age]
            size = np.sqrt(np.maximum(np.sum(part**2, axis=(1, 2)), SMALLEST))
            weights[:, i, max(AGES) - age :] = part / size[:, None, None]
        return np.asarray(weights / np.sqrt(self.levels_by_age)[:, :, None, None])

    def of_rows(self, e: FloatArray) -> FloatArray:
        """Return the statistics of white rows ``(runs, n, m)``: all but those of estimates, ``(k, runs, n)``."""
        from scipy.signal import lfilter

        statistics = [np.sum(e**2, axis=-1)]
        for share in FORGETTING:
            smooth = lfilter([share], [1.0, share - 1.0], e, axis=1)
            statistics.append((2.0 - share) / share * np.sum(smooth**2, axis=-1))
        parts = (*self.responses(), self.levels_by_age, self.offset_effects())
        for shape, slope, levels, effects in zip(*parts, strict=True):
            largest = np.zeros(e.shape[:2])
            for ratio, level, effect in zip(likelihood_ratios(e, shape, slope), levels, effects, strict=False):
                far = ratio if effect == 0.0 else np.maximum(np.sqrt(ratio) - effect, 0.0) ** 2
                np.maximum(largest, far / level, out=largest)
            statistics.append(largest)
        return np.array(statistics)


def likelihood_ratios(e: FloatArray, shape: FloatArray, slope: FloatArray) -> Iterator[FloatArray]:
    """Yield twice the log likelihood ratio ``(runs, n)`` of a step or ramp of each age that the rows are long enough
    for, whose response is ``shape (p + 1, m)`` and grows by ``slope (m,)`` in each row after these."""
    runs, n, _ = e.shape
    last = len(shape) - 1
    # As if it had been straight from its first row on, by running sums; then what its first rows are besides.
    straight = shape[-1] + (np.arange(last + 1) - last)[:, None] * slope
    flat, rising = _sums(e @ straight[0]), _sums(e @ slope)
    weighted = _sums((e @ slope) * np.arange(n))
    early, begun = np.zeros((runs, n)), 0
    extra = [e @ (shape[j] - straight[j]) for j in range(last)]
    rows = [shape[j] if j <= last else shape[-1] + (j - last) * slope for j in range(max(AGES))]
    power = np.cumsum([float(row @ row) for row in rows])
    for age in AGES:
        if age > n:
            break
        for j in range(begun, min(age, last)):
            early[:, : n - j] += extra[j][:, j:]
        begun = max(begun, min(age, last))
        fit = flat[:, age:] - flat[:, :-age] + early[:, : n - age + 1]
        if slope.any():
            fit += weighted[:, age:] - weighted[:, :-age]
            fit -= np.arange(n - age + 1) * (rising[:, age:] - rising[:, :-age])
        ratio = np.zeros((runs, n))
        ratio[:, age - 1 :] = fit**2 / max(power[age - 1], SMALLEST)
        yield ratio


def _sums(values: FloatArray) -> FloatArray:
    """Return the running sums ``(runs, n + 1)`` of values ``(runs, n)``, from nothing."""
    return np.concatenate([np.zeros((len(values), 1)), np.cumsum(values, axis=1)], axis=1)
