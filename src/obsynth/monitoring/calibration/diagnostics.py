"""Tests of whitened innovations: size, whiteness and mean; and whether a log agrees with a design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.observers.estimates import BAND_WIDTH
from obsynth.report.plots.panels import (
    BAND_STYLE,
    ESTIMATE_STYLE,
    RESIDUAL_STYLE,
    TRUE_STYLE,
    WIDTH,
    legend_above,
    new_figure,
    tidy,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


BoolArray = NDArray[np.bool_]

#: Lags of the whiteness test, and their least number of rows each.
WHITENESS_LAGS, ROWS_PER_LAG = 10, 5

#: Rows of each part of a log whose periodograms are averaged, at most and at least, and how many parts there are at
#: least: with fewer rows, or parts, the largest power of white noise is at any period.
LONGEST_SPECTRUM, LEAST_SPECTRUM, SPECTRUM_PARTS = 256, 16, 4

#: Probability of the interval of a mean square.
INTERVAL = 0.95

#: A test fails below this probability.
SIGNIFICANT = 0.01

#: A change of the mean is reported above this confidence, shared by all rows at which it may be.
CHANGE_CONFIDENCE = 0.999

#: Rows at both ends between which a change is looked for, and how many there must be at all.
CHANGE_MARGIN, LEAST_DIAGNOSED_ROWS = 5, 20

#: The mean of whitened innovations is reported where it is this many of its deviations from zero.
MEAN_LIMIT = 4.0

#: A whitened innovation of this size stands out.
OUTLYING = 6.0

#: The standard deviation of a normal distribution over its median of absolute values; the largest share of samples that
#: are wrong, of a sensor that is right.
NORMAL_OF_MEDIAN, MOST_OUTLIERS = 1.4826, 0.03

#: The least usual size, in deviations: values that rest on a quantum have a median of zero.
LEAST_USUAL = 0.3

#: A value is no measurement if it is further from the median than this multiple of what 90 % of the others are, alone
#: or in pairs, between values that are not; what 90 % are counts as this share of the median at least.
FAR_OFF, OTHERS, LEAST_SPREAD, LONGEST_SPIKE = 100.0, 0.9, 1e-3, 2


@dataclass(frozen=True)
class Whiteness:
    """Ljung and Box: statistic, its probability for white noise, and the first autocorrelation."""

    statistic: float
    probability: float
    first: float


@dataclass(frozen=True)
class Consistency:
    """Normalised innovations squared per degree of freedom, with the interval of ``level`` for a true model."""

    value: float
    low: float
    high: float
    samples: int

    @property
    def holds(self) -> bool:
        """Whether the value is in its interval."""
        return self.low <= self.value <= self.high


def consistency(squares: float, count: int) -> Consistency:
    """Return a sum of squares of whitened innovations over their number, with its chi-square interval of 95 %."""
    from scipy.stats import chi2

    if not count:
        return Consistency(float("nan"), 0.0, float("inf"), 0)
    share = (1.0 - INTERVAL) / 2.0
    low, high = chi2.ppf([share, 1.0 - share], count) / count
    return Consistency(squares / count, float(low), float(high), count)


def whiteness(column: FloatArray) -> Whiteness:
    """Return the test of Ljung and Box of a column, NaN left out."""
    from scipy.stats import chi2

    e = column[np.isfinite(column)]
    n = len(e)
    lags = max(1, min(WHITENESS_LAGS, n // ROWS_PER_LAG))
    e = e - (e.mean() if n else 0.0)
    power = float(e @ e)
    if n <= lags + 1 or power == 0.0:
        return Whiteness(0.0, 1.0, 0.0)
    r = np.array([float(e[lag:] @ e[:-lag]) / power for lag in range(1, lags + 1)])
    statistic = float(n * (n + 2.0) * (r**2 / (n - np.arange(1, lags + 1))).sum())
    return Whiteness(statistic, float(chi2.sf(statistic, lags)), float(r[0]))


def largest_power(column: FloatArray) -> tuple[float, float]:
    """Return at which period in rows the power of a column is largest, and how many times its mean over all frequencies
    it is there; zeros where there are too few rows. Values that are NaN count as the mean."""
    from scipy.signal import welch

    measured = np.isfinite(column)
    length = min(LONGEST_SPECTRUM, len(column) // SPECTRUM_PARTS)
    if length < LEAST_SPECTRUM or not measured.any() or not np.ptp(column[measured]) > 0.0:
        return 0.0, 0.0
    e = np.where(measured, column - column[measured].mean(), 0.0)
    frequencies, power = welch(e, nperseg=length, detrend=False)
    own = slice(1, None)
    place = int(np.argmax(power[own]))
    return float(1.0 / frequencies[own][place]), float(power[own][place] / power[own].mean())


def change_of_mean(whitened: FloatArray) -> int | None:
    """Return the row where the mean of whitened innovations ``(n, ny)`` changes: the likeliest split, or none."""
    from scipy.stats import chi2

    w = np.nan_to_num(whitened)
    n, m = w.shape
    # Where a variance is wrong, that is another sentence: the mean is judged by what each column really does.
    w = w / np.maximum(np.sqrt((w**2).mean(axis=0)), 1.0)
    if n < LEAST_DIAGNOSED_ROWS:
        return None
    total = np.cumsum(w, axis=0)
    k = np.arange(CHANGE_MARGIN, n - CHANGE_MARGIN)
    before, after = total[k - 1] / k[:, None], (total[-1] - total[k - 1]) / (n - k)[:, None]
    statistic = ((before - after) ** 2).sum(axis=1) * k * (n - k) / n
    limit = chi2.ppf(1.0 - (1.0 - CHANGE_CONFIDENCE) / n, m)
    return int(k[int(np.argmax(statistic))]) if statistic.max() > limit else None


def mean_off(column: FloatArray) -> float:
    """Return the mean of a whitened column where it is no chance, else zero."""
    e = column[np.isfinite(column)]
    mean, spread = float(e.mean()) if len(e) else 0.0, float(e.std()) if len(e) else 0.0
    return mean if abs(mean) * np.sqrt(len(e)) > MEAN_LIMIT * max(spread, SMALLEST) else 0.0


def wrong_samples(y: FloatArray) -> BoolArray:
    """Return which single values of outputs ``(n, ny)`` are far from all others of their sensor, as truth values."""
    wrong = np.zeros(y.shape, dtype=bool)
    for i, column in enumerate(y.T):
        measured = np.isfinite(column)
        if measured.sum() < LEAST_DIAGNOSED_ROWS:
            continue
        middle = float(np.median(column[measured]))
        away = np.abs(column - middle)
        spread = max(float(np.quantile(away[measured], OTHERS)), LEAST_SPREAD * abs(middle))
        far = measured & (away > FAR_OFF * spread)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], far, [False]]).astype(np.int64)))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            if spread > 0.0 and begin > 0 and end < len(column) and end - begin <= LONGEST_SPIKE:
                wrong[begin:end, i] = True
    return wrong


def usual_size(column: FloatArray) -> float:
    """Return the deviation of most of a column ``(n,)``, NaN left out."""
    return max(NORMAL_OF_MEDIAN * float(np.median(np.abs(column[np.isfinite(column)]))), LEAST_USUAL)


def standing_out(whitened: FloatArray) -> BoolArray:
    """Return which single whitened innovations ``(n, ny)`` stand out of what most of their sensor are.

    Those whose neighbours stand out too are no wrong samples, but something that happened; unless there are two, and
    the second is what a filter of coloured noise makes of the sample after a wrong one: less, to the other side.
    """
    outliers = np.zeros(whitened.shape, dtype=bool)
    for i, column in enumerate(whitened.T):
        measured = np.isfinite(column)
        if measured.sum() < LEAST_DIAGNOSED_ROWS:
            continue
        far = measured & (np.abs(column) > OUTLYING * usual_size(column))
        beside = np.concatenate([[False], far[:-1]]) | np.concatenate([far[1:], [False]])
        alone = far & (~beside | _answered(column, far))
        if alone.sum() <= MOST_OUTLIERS * measured.sum():
            outliers[alone, i] = True
    return outliers


def _answered(column: FloatArray, far: BoolArray) -> BoolArray:
    """Return which of two far innovations ``(n,)`` are followed by a smaller one to the other side, and by no third."""
    after = np.where(np.append(far[1:], False), np.append(column[1:], 0.0), 0.0)
    pair = np.append(far[1:], False) & ~np.concatenate([[False], far[:-1]]) & ~np.append(far[2:], [False, False])
    return np.asarray(far & pair & (after * column < 0.0) & (np.abs(after) < np.abs(column)))


@dataclass(frozen=True)
class SensorValidation:
    """What the innovations of one sensor say."""

    nis: Consistency  # mean square in units of the expected variance, with its 95 % interval
    mean: float  # of the innovations, in standard deviations of such a mean for white ones; beyond 3 it is an offset
    whiteness: Whiteness  # test of Ljung and Box
    power: tuple[float, float] = (0.0, 0.0)  # the period in rows with the largest power, and its multiple of the mean


@dataclass(frozen=True, eq=False)
class Validation:
    """Whether a log agrees with a design.

    Parameters
    ----------
    passed : bool
        Whether every check holds.
    name : str
        Of the design.
    nis : Consistency
        Normalised innovations squared per degree of freedom, with its 95 % interval.
    sensors : mapping of str to SensorValidation
        By output.
    ratios : mapping of str to float
        Likeliest variance on this log over that of the design, by noisy equation and by sensor (``"Q of NAME"`` and
        ``"R of NAME"`` where both have the same name), where the log distinguishes them clearly.
    change : int or None
        Row of the log at which the mean of the innovations changes.
    verdict : tuple of str
        A sentence for each thing that was found, with what to change.
    innovations, deviations, measured, predicted : FloatArray
        ``(n, ny)``, in units of the outputs; NaN where nothing was measured.
    estimates : mapping of str to FloatArray
        ``(n, 2)``: each estimated parameter with its standard deviation.
    log : mapping
        ``source``, ``rows``, ``digest``, ``samples`` and ``dt``.

    Examples
    --------
    >>> import obsynth
    >>> import pandas as pd
    >>> plant = obsynth.TimeVaryingDescriptorSystem(
    ...     E=None, A=[[0.9]], C=[[1.0]], Phi=[[1.0]], dt=1.0, horizon=50, parameter_names=["leak"]
    ... )
    >>> design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.95)
    >>> log = obsynth.simulate(design, obsynth.Scenario(horizon=49, noise=1.0)).outputs
    >>> validation = obsynth.validate(design, pd.DataFrame({"time": range(len(log)), "y1": log[:, 0]}))
    >>> validation.passed, validation.change
    (True, None)
    """

    passed: bool
    name: str
    nis: Consistency
    sensors: Mapping[str, SensorValidation]
    ratios: Mapping[str, float]
    change: int | None
    verdict: tuple[str, ...]
    innovations: FloatArray
    deviations: FloatArray
    measured: FloatArray
    predicted: FloatArray
    estimates: Mapping[str, FloatArray]
    log: Mapping[str, Any]

    def __repr__(self) -> str:
        rows = f"rows {self.log['rows'][0]}:{self.log['rows'][1]}"
        state = "agrees" if self.passed else "DOES NOT AGREE"
        lines = [f"{self.log['source'] or 'The log'}, {rows}, {state} with the design {self.name!r}."]
        nis = self.nis
        lines.append(f"  NIS per degree of freedom {nis.value:.3g} (95 %: {nis.low:.2f} to {nis.high:.2f})")
        width = max(len(name) for name in self.sensors)
        lines.append(f"  {'':<{width}}  mean square  mean (deviations)  white (p)")
        for name, sensor in self.sensors.items():
            lines.append(
                f"  {name:<{width}}  {sensor.nis.value:<11.3g}  {sensor.mean:<+17.2g}  "
                f"{sensor.whiteness.probability:.2g}"
                if sensor.nis.samples
                else f"  {name:<{width}}  not predicted in any row"
            )
        return "\n".join([*lines, *(f"  - {sentence}" for sentence in self.verdict)])

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the records as plain data."""
        return {
            "passed": self.passed,
            "name": self.name,
            "nis": vars(self.nis) | {"holds": self.nis.holds},
            "sensors": {
                name: {
                    "nis": vars(sensor.nis) | {"holds": sensor.nis.holds},
                    "mean": sensor.mean,
                    "whiteness": vars(sensor.whiteness),
                    "largest_power": {"period": sensor.power[0], "multiple": sensor.power[1]},
                }
                for name, sensor in self.sensors.items()
            },
            "ratios": dict(self.ratios),
            "change": self.change,
            "verdict": list(self.verdict),
            "log": dict(self.log),
        }

    def plot(self) -> Figure:
        """Return a picture: measured and predicted signals, innovations in their band, estimates."""
        count = 2 * len(self.sensors) + len(self.estimates)
        figure, panels = new_figure(count, size=(WIDTH, 0.6 + 1.5 * count))
        draw_validation(self, panels)
        return figure


def draw_validation(validation: Validation, panels: Sequence[Axes]) -> None:
    """Draw signal and innovation of each sensor, then each estimate, on a panel each."""
    names, time = list(validation.sensors), validation.log["rows"][0] + np.arange(len(validation.innovations))
    for i, name in enumerate(names):
        signals, errors = panels[2 * i], panels[2 * i + 1]
        signals.plot(time, validation.measured[:, i], label="measured", **TRUE_STYLE)
        signals.plot(time, validation.predicted[:, i], label="predicted", **ESTIMATE_STYLE)
        signals.set_ylabel(name)
        legend_above(signals)
        band = BAND_WIDTH * validation.deviations[:, i]
        errors.fill_between(time, -band, band, **BAND_STYLE)
        errors.plot(time, validation.innovations[:, i], color="black", linewidth=0.8, marker=".", markersize=3)
        if validation.sensors[name].nis.samples:
            # The band of an unknown start would leave the innovations a line.
            reach = 1.1 * max(np.nanmax(np.abs(validation.innovations[:, i]), initial=0.0), np.nanmedian(band))
            errors.set_ylim(-reach, reach)
        else:
            errors.text(0.5, 0.5, "not predicted in any row", transform=errors.transAxes, ha="center", va="center")
        errors.set_ylabel(f"innovation\nof {name}")
    for panel, (name, columns) in zip(panels[2 * len(names) :], validation.estimates.items(), strict=True):
        value, band = columns[:, 0], BAND_WIDTH * columns[:, 1]
        panel.fill_between(time, value - band, value + band, **BAND_STYLE)
        panel.plot(time, value, **RESIDUAL_STYLE)
        panel.set_ylabel(name)
    for panel in panels:
        tidy(panel)
    panels[-1].set_xlabel("row of the log")
