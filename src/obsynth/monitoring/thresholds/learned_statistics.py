"""Test statistics of residuals: Hotelling's T2, exponentially weighted means, likelihood ratios of steps and ramps.

An autoregression whitens the residuals (Alwan & Roberts 1988).  An alarm is raised by Hotelling's T2, by exponentially
weighted moving averages (MEWMA, Lowry et al. 1992) or by likelihood ratios of steps and ramps (Willsky & Jones 1976).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.autoregression import Autoregression

#: Ages in rows at which a step or a ramp is looked for.
AGES = (1, 2, 3, 5, 8, 12, 20, 32, 50, 80, 130, 200)

#: Weights of the newest row in the exponentially weighted moving averages.
FORGETTING = (0.3, 0.1)


@dataclass(frozen=True, eq=False)
class Statistics:
    """The statistics of whitened rows.

    These are T2, two MEWMA, and for each signature the largest likelihood ratio of a step and of a ramp.  Where faults
    are estimated, the likelihood ratio of a change of each fault and the square of its estimate come after them:
    `change_ratios` and `Scores.followed` compute these.

    Parameters
    ----------
    model : Autoregression
        The model that whitens the signals.
    signatures : FloatArray
        ``(s, m)``: the direction of each step, and of the ramp with the same direction, in the signals before they are
        whitened.
    signature_names : tuple of str
        What the step is a step of, such as a sensor.
    estimates : tuple of str, optional
        Names of the faults whose changes are tested.
    age_levels : FloatArray, optional
        ``(2 s, ages)``: numbers by which the likelihood ratios of steps, then of ramps, are divided; ones by default.
    bands : FloatArray, optional
        ``(s,)``: largest offset along each signature that must not raise an alarm.
    fault_bands : FloatArray, optional
        ``(nf,)``: the same for the faults.
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
        """Numbers by which likelihood ratios are divided, ``(2 s, ages)``."""
        return np.ones((2 * len(self.signature_names), len(AGES))) if self.age_levels is None else self.age_levels

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the statistics, in order."""
        means = (f"MEWMA {share:g}" for share in FORGETTING)
        likely = (f"GLR of a {shape} in {name}" for shape in ("step", "ramp") for name in self.signature_names)
        changes = (f"GLR of a change of {name}" for name in self.estimates)
        return ("T2", *means, *likely, *changes, *(f"square of {name}" for name in self.estimates))

    def responses(self) -> tuple[FloatArray, FloatArray]:
        """Return the responses of the whitened rows e to a step, then to a ramp, along each signature.

        The first p + 1 rows, p being the order of the autoregression, are ``(2 s, p + 1, m)``; after them the response
        grows in each row by ``(2 s, m)``.
        """
        gone = np.concatenate([np.zeros((1, *np.eye(self.model.channels).shape)), np.cumsum(self.model.A, axis=0)])
        remaining = self.signatures[:, None, :] - np.einsum("jab,sb->sja", gone, self.signatures)
        steps = np.asarray(remaining @ self.model.whitener.T)
        # A ramp is a sum of steps: one more begins in each row.
        return (
            np.concatenate([steps, np.cumsum(steps, axis=1)]),
            np.concatenate([np.zeros_like(steps[:, -1]), steps[:, -1]]),
        )

    def long_responses(self) -> FloatArray:
        """Return the same responses over ``max(AGES)`` rows of e, ``(2 s, rows, m)``."""
        shapes, slopes = self.responses()
        later = shapes[:, -1:] + np.arange(1, max(AGES))[:, None] * slopes[:, None, :]
        return np.concatenate([shapes, later], axis=1)[:, : max(AGES)]

    def offset_effects(self) -> FloatArray:
        """Return by how much an offset at the end of its band raises the root of a likelihood ratio.

        ``(2 s, ages)``: for steps, then ramps, of each age, before the division by the levels.
        """
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
        """Return matched filters for steps and ramps of each signature and age, ``(2 s, ages, rows, m)``.

        They weight the last ``max(AGES)`` rows of e, oldest first.  The squares of the weights of one filter add up to
        one divided by the level of its age.
        """
        long = self.long_responses()
        weights = np.zeros((len(long), len(AGES), max(AGES), self.model.channels))
        for i, age in enumerate(AGES):
            part = long[:, :age]
            size = np.sqrt(np.maximum(np.sum(part**2, axis=(1, 2)), SMALLEST))
            weights[:, i, max(AGES) - age :] = part / size[:, None, None]
        return np.asarray(weights / np.sqrt(self.levels_by_age)[:, :, None, None])

    def of_rows(self, e: FloatArray) -> FloatArray:
        """Return the statistics ``(k, runs, n)`` of whitened rows ``(runs, n, m)``, without those of estimates."""
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
    """Yield twice the log likelihood ratio ``(runs, n)`` of a step or a ramp, for each age up to the number of rows.

    Parameters
    ----------
    e : FloatArray
        Whitened rows ``(runs, n, m)``.
    shape : FloatArray
        The response ``(p + 1, m)`` in the first rows.
    slope : FloatArray
        ``(m,)``: by how much the response grows in each row after them.
    """
    runs, n, _ = e.shape
    last = len(shape) - 1
    # Running sums give the fit of a response that is a straight line from its first row on; ``early`` corrects it for
    # the rows in which the response is not yet that line.
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
    """Return the running sums ``(runs, n + 1)`` of values ``(runs, n)``; the first is zero."""
    return np.concatenate([np.zeros((len(values), 1)), np.cumsum(values, axis=1)], axis=1)
