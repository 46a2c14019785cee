"""The result of a calibration, frozen, with a table for people and plain data for programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from obsynth.monitoring.calibration.diagnostics import Consistency, Whiteness
from obsynth.monitoring.calibration.variance_names import limited_names
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.observers.estimates import BAND_WIDTH
from obsynth.plants.calibrated_box import CalibratedBox
from obsynth.report.plots.panels import BAND_STYLE, WIDTH, new_figure, tidy
from obsynth.results.number_texts import duration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Calibration:
    """Constants, noise and verdict that a log gives a model.

    Parameters
    ----------
    nominal : mapping of str to float
        The likeliest value of each unknown constant, in its unit.
    covariance, correlation : FloatArray
        ``(nt, nt)``, in the order of ``nominal``; what the log does not determine counts as the width of its bounds.
    box : CalibratedBox
        Simultaneous ranges by profile likelihood.
    undetermined : tuple of mapping
        Directions that the log does not determine: constants with their shares, in widths of their bounds.
    Q, R : mapping of str to float
        Variances to design with, by equation (per step) and by sensor; an upper limit where the log cannot tell a
        variance from zero.
    upper_limits : tuple of str
        Equations and sensors whose variance is such a limit; ``"Q of NAME"`` and ``"R of NAME"`` where an equation and
        a sensor share a name.
    nis : Consistency
        Normalised innovations squared per degree of freedom, with its 95 % interval.
    whiteness : mapping of str to Whiteness
        By sensor.
    change : int or None
        Row of the log at which the mean of the innovations changes: the rows are then not free of faults.
    input_delay : int
        Rows by which the inputs were taken later than the log writes them.
    timing : mapping of int to float
        Loss of log likelihood with the inputs later by that many rows, in nats; the best has zero.
    quanta : mapping of str to float
        Resolution of each sensor; zero where none shows.
    at_bounds : tuple of str
        Constants at an end of their bounds.
    integration : str
        How the model was integrated, ``substeps`` to a sample.
    substeps : int
        Steps in a sample.
    method : str
        ``"innovations"`` or ``"simulation"``.
    log_likelihood : float
        Of the log, in nats.
    verdict : tuple of str
        A sentence for each thing that was found.
    innovations : FloatArray
        ``(n, ny)`` whitened, NaN where nothing was measured.
    predictions : FloatArray
        ``(n, ny)`` before each measurement.
    deviations : FloatArray
        ``(n, ny)`` of the innovations, in units of the sensors.
    log : mapping
        ``source``, ``rows``, ``digest``, ``samples`` and ``dt`` of the log.
    units : mapping of str to str
        By constant, where the model says one.
    output_names : tuple of str
        The sensors.
    sensor_noise, offset, walks : mapping
        The noise model as `with_noise` takes it: what was stated and what the innovations asked for, with the numbers
        that were found; empty where all noise is white.
    initial_covariance : mapping of str to float
        Variances of the first states that were used.
    own_equations : tuple of str
        The equations of the plant as written: without those of noise, offsets and walks.
    outlier_sizes : mapping
        How far from its prediction an outlier of each output is at least, in its unit, as the outliers of this log say;
        nothing of outputs without any. What is nearer may be the onset of a fault.
    found_offsets : mapping of str to (float, float)
        Offset of each sensor that has one, as it is at the end of the log, and its standard deviation.

    Examples
    --------
    >>> import obsynth
    >>> import numpy as np
    >>> tank = obsynth.DAEModel(
    ...     {"balance": "der(level) = inflow - c * level"},
    ...     {"gauge": "level"},
    ...     states={"level": 1.0},
    ...     inputs={"inflow": 0.5},
    ...     constants={"c": 0.4},
    ... )
    >>> k, rng = np.arange(80), np.random.default_rng(0)
    >>> inflow = 0.5 + 0.2 * np.sign(np.sin(0.1 * k))
    >>> level = [1.0]
    >>> for u in inflow[1:]:
    ...     level.append((level[-1] + u) / (1 + 0.5))  # backward Euler with c = 0.5
    >>> log = {"time": k, "inflow": inflow, "gauge": np.array(level) + 0.01 * rng.normal(size=80)}
    >>> calibration = obsynth.calibrate(tank, log, {"c": (0.1, 1.0)})
    >>> round(calibration.nominal["c"], 2), calibration.at_bounds
    (0.5, ())
    """

    nominal: Mapping[str, float]
    covariance: FloatArray
    correlation: FloatArray
    box: CalibratedBox
    undetermined: tuple[Mapping[str, float], ...]
    Q: Mapping[str, float]
    R: Mapping[str, float]
    upper_limits: tuple[str, ...]
    nis: Consistency
    whiteness: Mapping[str, Whiteness]
    change: int | None
    input_delay: int
    timing: Mapping[int, float]
    quanta: Mapping[str, float]
    at_bounds: tuple[str, ...]
    integration: str
    substeps: int
    method: str
    log_likelihood: float
    verdict: tuple[str, ...]
    innovations: FloatArray
    predictions: FloatArray
    deviations: FloatArray
    log: Mapping[str, Any]
    units: Mapping[str, str]
    output_names: tuple[str, ...]
    sensor_noise: Mapping[str, Any] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)
    walks: Mapping[str, float] = field(default_factory=dict)
    initial_covariance: Mapping[str, float] = field(default_factory=dict)
    own_equations: tuple[str, ...] = ()
    outlier_sizes: Mapping[str, float] = field(default_factory=dict)
    found_offsets: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The constants, in order."""
        return tuple(self.nominal)

    @property
    def fault_free(self) -> bool:
        """Whether the rows look as if one model held in all of them."""
        return self.change is None

    def __repr__(self) -> str:
        rows = f"rows {self.log['rows'][0]}:{self.log['rows'][1]}"
        noun = "1 constant" if len(self.nominal) == 1 else f"{len(self.nominal)} constants"
        lines = [
            f"Calibration of {noun} from {self.log['source'] or 'a log'}, {rows} ("
            f"{100 * self.box.level:g} % box, all at once{'' if self.box.stands else '; it is not valid'})"
        ]
        if not self.nominal:
            lines = [f"Calibration of the noise from {self.log['source'] or 'a log'}, {rows}"]
        width = max((len(name) for name in self.nominal), default=0)
        marks = set(self.box.open_sides)
        for name, value in self.nominal.items():
            ends = [
                f"{'open ' if (name, side) in marks else ''}{getattr(self.box, side)[name]:.5g}"
                for side in ("low", "high")
            ]
            unit = "" if self.units.get(name, "1") == "1" else f" {self.units[name]}"
            lines.append(f"  {name:<{width}}  {value:.5g}  [{ends[0]}, {ends[1]}]{unit}")
        for heading, letter, variances, other_variances in (
            ("Q per step", "Q", self.Q, self.R),
            ("R", "R", self.R, self.Q),
        ):
            limited = limited_names(self.upper_limits, letter, variances, other_variances)
            sizes = [f"{name} {'<= ' if name in limited else ''}{value:.3g}" for name, value in variances.items()]
            if sizes:
                lines.append(f"  {heading}: " + ", ".join(sizes))
        for name, noise in self.sensor_noise.items():
            lines.append(
                f"  coloured noise of {name}: deviation {noise['deviation']:.3g}, correlation "
                f"{duration(noise['correlation'])}"
            )
        for name in self.offset:
            value, deviation = self.found_offsets.get(name, (0.0, np.inf))
            offset_text = f"{value:.3g}, deviation {deviation:.3g}" if np.isfinite(deviation) else "unknown"
            lines.append(f"  offset of {name}: {offset_text}")
        lines += [f"  walk of {name}: {step:.3g} per root of a second" for name, step in self.walks.items()]
        lines.append(
            f"  NIS per degree of freedom {self.nis.value:.2f} (95 %: {self.nis.low:.2f} to {self.nis.high:.2f})"
        )
        return "\n".join([*lines, *(f"  - {sentence}" for sentence in self.verdict)])

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the records as plain data."""
        return {
            "constants": {
                name: {
                    "nominal": value,
                    "range": [self.box.low[name], self.box.high[name]],
                    "open": [side for constant, side in self.box.open_sides if constant == name],
                    "unit": self.units.get(name, "1"),
                }
                for name, value in self.nominal.items()
            },
            "level": self.box.level,
            "stands": self.box.stands,
            "sensor_noise": {name: dict(item) for name, item in self.sensor_noise.items()},
            "offset": dict(self.offset),
            "found_offsets": {name: list(entry) for name, entry in self.found_offsets.items()},
            "walks": dict(self.walks),
            "initial_covariance": dict(self.initial_covariance),
            "outlier_sizes": dict(self.outlier_sizes),
            "covariance": self.covariance.tolist(),
            "correlation": self.correlation.tolist(),
            "undetermined": [dict(direction) for direction in self.undetermined],
            "Q": dict(self.Q),
            "R": dict(self.R),
            "upper_limits": list(self.upper_limits),
            "nis": vars(self.nis) | {"holds": self.nis.holds},
            "whiteness": {name: vars(entry) for name, entry in self.whiteness.items()},
            "change": self.change,
            "input_delay": self.input_delay,
            "timing": {str(rows): loss for rows, loss in self.timing.items()},
            "quanta": dict(self.quanta),
            "at_bounds": list(self.at_bounds),
            "integration": self.integration,
            "substeps": self.substeps,
            "method": self.method,
            "log_likelihood": self.log_likelihood,
            "log": dict(self.log),
            "verdict": list(self.verdict),
        }

    def plot(self) -> Figure:
        """Return a picture: each constant in its box, and the innovations of each sensor in deviations."""
        heights = [0.6 + 0.35 * len(self.names), *[1.7] * len(self.output_names)]
        figure, panels = new_figure(len(heights), size=(WIDTH, 0.5 + sum(heights)), heights=heights)
        _boxes(panels[0], self)
        time = self.log["rows"][0] + np.arange(len(self.innovations))
        for panel, name, column in zip(panels[1:], self.output_names, self.innovations.T, strict=True):
            panel.axhspan(-BAND_WIDTH, BAND_WIDTH, **BAND_STYLE)
            panel.plot(time, column, color="black", linewidth=0.8, marker=".", markersize=3)
            panel.set_ylabel(f"{name}\n(deviations)")
            tidy(panel)
            if self.change is not None:
                panel.axvline(self.change, color="tab:red", linestyle="--", linewidth=1.2)
        panels[1].set_title("Innovations; 95 % lie in the band", fontsize=10, loc="left")
        panels[-1].set_xlabel("row of the log")
        return figure


def _boxes(panel: Axes, calibration: Calibration) -> None:
    """Draw boxes relative to their nominal values, so that constants of all sizes stand side by side."""
    opened = set(calibration.box.open_sides)
    for i, (name, value) in enumerate(calibration.nominal.items()):
        size = abs(value) or max(abs(calibration.box.low[name]), abs(calibration.box.high[name]), SMALLEST)
        low, high = (
            (calibration.box.low[name] - value) / size * 100.0,
            (calibration.box.high[name] - value) / size * 100.0,
        )
        panel.plot([low, high], [i, i], color="0.5", linewidth=3.0, solid_capstyle="butt")
        for side, end in (("low", low), ("high", high)):
            marker = ("<" if side == "low" else ">") if (name, side) in opened else "|"
            panel.plot([end], [i], color="black", marker=marker, markersize=9, linestyle="none")
        panel.plot([0.0], [i], color="black", marker="o", markersize=4)
    panel.set_yticks(
        range(len(calibration.nominal)),
        [f"{name} = {value:.4g}" for name, value in calibration.nominal.items()],
        parse_math=False,
    )
    panel.set_ylim(len(calibration.nominal) - 0.5, -0.5)
    panel.set_xlabel("per cent of the value")
    panel.set_title(f"{100 * calibration.box.level:g} % box, all at once (arrows: open)", fontsize=10, loc="left")
    tidy(panel)
