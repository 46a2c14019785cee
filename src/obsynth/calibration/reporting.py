"""From a fit to a calibration: tables by name, checks of the innovations, and a sentence for each thing found.

How a model is to be integrated on a log: what a step of backward Euler errs, against the noise of the sensors.

What a calibration found, frozen, with a table for people and plain data for programs.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from obsynth.calibration.diagnostics import (
    SIGNIFICANT,
    STANDS_OUT,
    Consistency,
    Whiteness,
    change_of_mean,
    consistency,
    mean_off,
    whiteness,
)
from obsynth.calibration.fits import Fit, InnovationsFit, Side, SimulationError, covariance_of, quantile, unexplained
from obsynth.calibration.logs import EVEN, Log, told_rows
from obsynth.calibration.plants import PlantWithNoise, correlation_name
from obsynth.calibration.problem import Problem
from obsynth.errors import SolverError
from obsynth.numerics.arguments import SMALLEST, FloatArray, read_only
from obsynth.observers.running import BAND_WIDTH
from obsynth.plants.constants import CalibratedBox
from obsynth.plants.dae import BUTCHER, DAEFunctions, DAEModel, ImplicitStep
from obsynth.plants.noise_model import noise_state, noise_variance, offset_state
from obsynth.plotting.panels import BAND_STYLE, WIDTH, new_figure, tidy

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
        Equations and sensors whose variance is such a limit.
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

    def __str__(self) -> str:
        rows = f"rows {self.log['rows'][0]}:{self.log['rows'][1]}"
        what = "1 constant" if len(self.nominal) == 1 else f"{len(self.nominal)} constants"
        lines = [
            f"Calibration of {what} from {self.log['source'] or 'a log'}, {rows} ("
            f"{100 * self.box.level:g} % box, all at once{'' if self.box.stands else '; it DOES NOT STAND'})"
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
        told = {
            name: f"{name} {'<= ' if name in self.upper_limits else ''}{value:.3g}"
            for name, value in (*self.Q.items(), *self.R.items())
        }
        if self.Q:
            lines.append("  Q per step: " + ", ".join(told[name] for name in self.Q))
        lines.append("  R: " + ", ".join(told[name] for name in self.R))
        for name, noise in self.sensor_noise.items():
            lines.append(
                f"  coloured noise of {name}: deviation {noise['deviation']:.3g}, correlation "
                f"{noise['correlation']:.3g} s"
            )
        for name in self.offset:
            value, deviation = self.found_offsets.get(name, (0.0, np.inf))
            known = f"{value:.3g}, deviation {deviation:.3g}" if np.isfinite(deviation) else "unknown"
            lines.append(f"  offset of {name}: {known}")
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
                    "open": [side for other, side in self.box.open_sides if other == name],
                    "unit": self.units.get(name, "1"),
                }
                for name, value in self.nominal.items()
            },
            "level": self.box.level,
            "stands": self.box.stands,
            "sensor_noise": {name: dict(item) for name, item in self.sensor_noise.items()},
            "offset": dict(self.offset),
            "found_offsets": {name: list(found) for name, found in self.found_offsets.items()},
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
            "whiteness": {name: vars(found) for name, found in self.whiteness.items()},
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


def _boxes(panel: Axes, found: Calibration) -> None:
    """Draw boxes relative to their nominal values, so that constants of all sizes stand side by side."""
    opened = set(found.box.open_sides)
    for i, (name, value) in enumerate(found.nominal.items()):
        size = abs(value) or max(abs(found.box.low[name]), abs(found.box.high[name]), SMALLEST)
        low, high = (found.box.low[name] - value) / size * 100.0, (found.box.high[name] - value) / size * 100.0
        panel.plot([low, high], [i, i], color="0.5", linewidth=3.0, solid_capstyle="butt")
        for side, end in (("low", low), ("high", high)):
            marker = ("<" if side == "low" else ">") if (name, side) in opened else "|"
            panel.plot([end], [i], color="black", marker=marker, markersize=9, linestyle="none")
        panel.plot([0.0], [i], color="black", marker="o", markersize=4)
    panel.set_yticks(
        range(len(found.nominal)), [f"{name} = {value:.4g}" for name, value in found.nominal.items()], parse_math=False
    )
    panel.set_ylim(len(found.nominal) - 0.5, -0.5)
    panel.set_xlabel("per cent of the value")
    panel.set_title(f"{100 * found.box.level:g} % box, all at once (arrows: open)", fontsize=10, loc="left")
    tidy(panel)


#: A step whose error in an output exceeds this share of the sensor's deviation is not exact enough.
TOLERATED = 0.25
#: Samples at which both methods are compared: half of them spread over the record, half before the largest changes of
#: the inputs, as inputs that are held change in rows that an even spread may miss.
COMPARED = 100


@dataclass(frozen=True)
class IntegrationError:
    """Largest difference of one step of backward Euler from Radau, in deviations of a sensor, and where it is."""

    largest: float
    sensor: str
    row: int
    moved: float = 0.0  # by how much it moves a constant, in deviations of that, where it was asked

    @property
    def matters(self) -> bool:
        """Whether backward Euler is not exact enough."""
        return not self.largest <= TOLERATED


def _compared(u: FloatArray) -> NDArray[np.int64]:
    """Return the samples of inputs ``(n, nu)`` from which steps are compared."""
    steps = max(len(u) - 1, 1)
    if steps <= COMPARED:
        return np.arange(steps)
    spread = np.linspace(0, steps - 1, COMPARED // 2).astype(np.int64)
    changes, sizes = np.abs(np.nan_to_num(np.diff(u, axis=0))), np.nanstd(u, axis=0)
    largest = np.max(changes / np.where(sizes > 0.0, sizes, 1.0), axis=1, initial=0.0)
    return np.union1d(spread, np.argsort(-largest, kind="stable")[: COMPARED // 2])


def integration_error(
    model: DAEModel, states: FloatArray, u: FloatArray, theta: FloatArray, deviations: FloatArray, dt: float
) -> IntegrationError | None:
    """Compare one step from each state ``(n, nx)``, where Radau has a solution, with the input that leads on."""
    steps = [ImplicitStep(DAEFunctions(model, method), dt) for method in ("backward-euler", "radau")]
    worst = IntegrationError(0.0, model.output_names[0], 0)
    for k in _compared(u[: len(states)]):
        after = min(k + 1, len(u) - 1)
        try:
            seen = [
                step.functions.outputs(step.solve(states[k], u[after], theta, before=u[k], k=int(k)).x, theta)[0]
                for step in steps
            ]
        except SolverError:
            return None
        errors = np.abs(seen[0] - seen[1]) / deviations
        i = int(np.argmax(errors))
        if not errors[i] <= worst.largest:
            worst = IntegrationError(float(errors[i]), model.output_names[i], int(after))
    return worst


#: Constants whose correlation exceeds this are named together.
CORRELATED = 0.9
#: A sensor's variance below this multiple of its quantisation's is told.
AT_QUANTISATION = 1.5
#: A timing that is better by this many nats is told, even where it is not taken.
NOTED_NATS = 2.0
#: A variance of a sensor above this share of what its signal has stands for the signal.
SIGNAL_SHARE = 0.1
#: A constant within this share of the bounds' width from one of them is at it.
END_SHARE = 1e-6


def reported(
    problem: Problem,
    start: Fit,
    fit: InnovationsFit | None,
    *,
    level: float,
    losses: Mapping[int, float],
    error: IntegrationError | None,
    digest: str,
) -> Calibration:
    """Return the calibration of a fit of innovations, or of a simulation where there is none."""
    found = fit if fit is not None else _of_simulation(problem, start, level)
    names, whitened = problem.names, found.whitened
    covariance = found.information.covariance
    deviations = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(deviations, deviations)
    colours = {name: whiteness(column) for name, column in zip(problem.output_names, whitened.T, strict=True)}
    change = change_of_mean(whitened)
    nis = consistency(float(np.nansum(whitened**2)), int(np.isfinite(problem.y).sum()))
    box = _box(
        names, found, level, digest, stands=all(colour.probability >= SIGNIFICANT for colour in colours.values())
    )
    Q = {name: float(value) for name, value in zip(problem.noisy, found.Q, strict=True)} if fit is not None else {}
    R = {name: float(value) for name, value in zip(problem.output_names, found.R, strict=True)}
    noises = zip((*problem.noisy, *problem.output_names), (*found.limited_Q, *found.limited_R), strict=True)
    limited = [name for name, weak in noises if weak]
    row = None if change is None else problem.log.rows[0] + change
    at_end = tuple(name for name, there in zip(problem.unknown, found.at_bounds, strict=True) if there)
    verdict = [
        *problem.log.notes,
        *problem.plant.notes,
        *problem.notes,
        *_fitted(problem, box, found, at_end, correlation, limited, Q, R),
        *_misfits(problem, start, whitened, R),
        *_checked(nis, colours, row, fit is None),
        *_told(problem, R, losses, error),
    ]
    return Calibration(
        box.nominal,
        read_only(covariance),
        read_only(correlation),
        box,
        found.information.undetermined,
        Q,
        R,
        tuple(limited),
        nis,
        colours,
        row,
        problem.log.input_delay,
        dict(losses),
        dict(zip(problem.output_names, problem.quanta.tolist(), strict=True)),
        at_end,
        problem.integration,
        problem.substeps,
        "innovations" if fit is not None else "simulation",
        -found.value,
        tuple(verdict),
        read_only(whitened),
        read_only(problem.y - found.innovations),
        read_only(np.sqrt(found.variances)),
        problem.log.described | {"digest": digest},
        {name: problem.plant.units.get(name, "1") for name in names},
        problem.output_names,
        *_noise_model(problem, found, Q, R),
        dict(zip(problem.plant.state_names, np.diag(problem.P0).tolist(), strict=True)),
        getattr(problem.plant, "inner", problem.plant).equation_names,
        _outlier_sizes(problem.log, np.sqrt(np.median(found.variances, axis=0))),
        _found_offsets(problem, found),
    )


def _box(names: Sequence[str], found: InnovationsFit, level: float, digest: str, *, stands: bool) -> CalibratedBox:
    """Return the box of the constants of a fit."""
    nominal = {name: float(value) for name, value in zip(names, found.t[: len(names)], strict=True)}
    sides = dict(zip(names, found.sides[: len(names)], strict=True))
    return CalibratedBox(
        nominal,
        {name: min(pair[0].value, nominal[name]) for name, pair in sides.items()},
        {name: max(pair[1].value, nominal[name]) for name, pair in sides.items()},
        tuple(
            (name, side)
            for name, pair in sides.items()
            for side, end in zip(("low", "high"), pair, strict=True)
            if end.is_open
        ),
        level,
        digest,
        stands=stands,
    )


def _noise_model(
    problem: Problem, found: InnovationsFit, Q: dict[str, float], R: dict[str, float]
) -> tuple[dict[str, dict[str, float]], dict[str, float], dict[str, float]]:
    """Return coloured noise, deviations of offsets, and walks, in the terms of `with_noise`."""
    if not isinstance(problem.plant, PlantWithNoise) or not Q:
        return {}, {}, {}
    states, dt = problem.plant.states, problem.log.dt
    t = dict(zip(problem.unknown, found.t.tolist(), strict=True))
    sensors = {}
    for name, value in states.correlations.items():
        time = float(np.exp(t[correlation_name(name)])) if value is None else value
        variance = noise_variance(Q[noise_state(name)], time, dt, problem.integration)
        sensors[name] = {"deviation": variance**0.5, "correlation": time, "white": R[name] ** 0.5}
    spread = dict(zip(problem.plant.state_names, np.sqrt(np.diag(problem.P0)).tolist(), strict=True))
    offsets = {name: spread[offset_state(name)] for name in states.offsets}
    # Continuous plants: what is added to the rate of a load during a step, as a walk over one second.
    step = dt**0.5 if problem.integration in BUTCHER else 1.0
    return sensors, offsets, {name: step * Q[name] ** 0.5 for name in states.loads}


def _found_offsets(problem: Problem, found: InnovationsFit) -> dict[str, tuple[float, float]]:
    """Return the offset of each sensor after the last row, and its deviation."""
    if not isinstance(problem.plant, PlantWithNoise) or found.at_end is None:
        return {}
    end = dict(zip(problem.plant.state_names, np.transpose(found.at_end).tolist(), strict=True))
    pairs = {name: end[offset_state(name)] for name in problem.plant.states.offsets}
    return {name: (value, deviation) for name, (value, deviation) in pairs.items()}


def _of_simulation(problem: Problem, start: Fit, level: float) -> InnovationsFit:
    """Return what the fit of a simulation says, in the form of a fit of innovations; its boxes are Wald's."""
    error = SimulationError(problem)
    nt, scale = error.nt, error.scale
    inner = start.information
    found = inner[:nt, :nt] - inner[:nt, nt:] @ np.linalg.solve(inner[nt:, nt:], inner[nt:, :nt])
    kept = slice(None, len(problem.names))
    found = np.linalg.inv(np.linalg.inv(found)[kept, kept]) if problem.plant.bounds else found
    information = covariance_of(found, problem.widths[kept], problem.names)
    y = error.simulated(np.concatenate([start.t, start.x0]) / scale)[0]
    e = problem.y - y
    root = quantile(level, len(problem.names), problem.log.samples, len(problem.output_names))
    spread = root * np.sqrt(np.diag(information.covariance))
    sides = [
        (Side(max(t - half, low), t - half <= low), Side(min(t + half, high), t + half >= high))
        for t, half, low, high in zip(start.t[kept], spread, problem.low[kept], problem.high[kept], strict=True)
    ]
    ends = (start.t - problem.low < END_SHARE * problem.widths) | (problem.high - start.t < END_SHARE * problem.widths)
    variances = np.tile(start.deviations**2, (len(y), 1))
    nothing = np.zeros(len(problem.noisy))
    return InnovationsFit(
        start.t,
        start.cost,
        information,
        sides,
        nothing,
        start.deviations**2,
        nothing.astype(bool),
        np.zeros(len(problem.output_names), dtype=bool),
        ends,
        e / start.deviations,
        e,
        variances,
    )


def _fitted(
    problem: Problem,
    box: CalibratedBox,
    fit: InnovationsFit,
    at_end: tuple[str, ...],
    correlation: FloatArray,
    limited: list[str],
    Q: dict[str, float],
    R: dict[str, float],
) -> list[str]:
    found = []
    for direction in fit.information.undetermined:
        told = ", ".join(f"{name} {share:+.2g}" for name, share in direction.items())
        found.append(
            f"This log does not determine the direction ({told}), in widths of the bounds: excite it, state a prior, "
            "or fix one of them."
        )
    found += [
        f"The box of {name} is open on its {side} side: the bound limits it there, the log does not."
        for name, side in box.open_sides
    ]
    found += [f"{name} is at a bound: widen it if the constant may lie beyond." for name in at_end]
    free = [
        i
        for i, name in enumerate(problem.names)
        if not any(name in direction for direction in fit.information.undetermined)
    ]
    found += [
        f"{problem.unknown[i]} and {problem.unknown[j]} are correlated by {correlation[i, j]:+.2f}: their "
        "combination is known better than either."
        for i, j in itertools.combinations(free, 2)
        if abs(correlation[i, j]) > CORRELATED
    ]
    values = {**Q, **R}
    if not box.stands:
        found.append(
            f"The box does not stand: its {100 * box.level:g} % are those of white innovations, which these are not."
        )
    return found + [
        f"The variance of {name} cannot be distinguished from zero: its upper limit {values[name]:.3g} is used."
        for name in limited
    ]


def _outlier_sizes(log: Log, deviations: FloatArray) -> dict[str, float]:
    """Return how far off an outlier of each output is at least, for innovations of ``deviations (ny,)``.

    One more outlier is nearer than all of n with the probability 1 / (n + 1): the size stands that share of the way, on
    a logarithmic scale, from the least of them to what no sample of the model reaches.
    """
    found = {}
    for name, sizes, deviation in zip(log.output_names, log.outliers, deviations, strict=False):
        if len(sizes):
            usual, least, share = STANDS_OUT * float(deviation), float(sizes.min()), 1.0 / (len(sizes) + 1)
            found[name] = usual**share * least ** (1.0 - share)
    return found


def _misfits(problem: Problem, start: Fit, whitened: FloatArray, R: dict[str, float]) -> list[str]:
    """Return sentences about sensors that the model does not follow, their mean, and single samples that stand out."""
    found = []
    for name in unexplained(problem, start.deviations):
        signal = float(np.nanvar(problem.y[:, problem.output_names.index(name)]))
        found.append(
            f"The best simulation explains almost nothing of {name}: "
            + (
                "its sign, its unit or its equation is wrong, and its R is the variance of the signal itself."
                if R[name] > SIGNAL_SHARE * signal
                else "noise of the equations drives it more than the inputs do."
            )
        )
    for name, column in zip(problem.output_names, whitened.T, strict=True):
        mean = mean_off(column)
        if mean:
            found.append(
                f"The innovations of {name} have the mean {mean:+.2f} deviations: a bias of the sensor, or an "
                "offset that the model lacks."
            )
        rows = problem.log.rows[0] + np.flatnonzero(np.abs(np.nan_to_num(column)) > STANDS_OUT)
        if len(rows):
            found.append(
                f"Samples of {name} stand out by more than {STANDS_OUT:g} deviations (row {told_rows(rows)}): "
                "if they are outliers, mark them as missing."
            )
    return found


def _checked(nis: Consistency, colours: dict[str, Whiteness], row: int | None, simulated: bool) -> list[str]:
    found = [
        f"The innovations of {name} are not white (p = {test.probability:.2g}, first autocorrelation "
        f"{test.first:+.2f}): a signal that acts on {name} is not in the model."
        for name, test in colours.items()
        if test.probability < SIGNIFICANT
    ]
    if simulated and found:
        found.append("The residuals of a simulation that are not white make boxes too small: use method='innovations'.")
    if not simulated and not nis.holds:
        found.append(f"NIS per degree of freedom is {nis.value:.2f}, outside {nis.low:.2f} to {nis.high:.2f}.")
    if row is not None:
        found.append(
            f"These rows are not homogeneous: the mean of the innovations changes at row {row}. If a fault "
            "begins there, end the rows before it."
        )
    return found


def _told(
    problem: Problem, R: dict[str, float], losses: Mapping[int, float], error: IntegrationError | None
) -> list[str]:
    found, delay = list[str](), problem.log.input_delay
    for name, step in zip(problem.output_names, problem.quanta, strict=True):
        if step > 0.0 and R[name] < AT_QUANTISATION * step**2 / EVEN:
            found.append(
                f"The noise of {name} is at its quantisation ({step:.3g} / sqrt 12): its R is at least that of the "
                "quantisation."
            )
    if delay and losses:
        rows = "1 row" if delay == 1 else f"{delay} rows"
        gained = losses[0] - losses[delay]
        found.append(f"The inputs act {rows} later than the log states: better by {gained:.1f} nats.")
    lost = losses.get(delay, 0.0)
    if lost > NOTED_NATS:
        least = min(losses, key=lambda rows: losses[rows])
        found.append(f"Inputs that act {least:+d} row(s) later would be better by {lost:.1f} nats: see input_delay.")
    if error is not None:
        used = "Radau" if problem.integration == "radau" else "backward Euler"
        told = f" and moves a constant by {error.moved:.2g} of its own" if error.moved else ""
        found.append(
            f"A step of backward Euler has an error of at most {error.largest:.2g} deviations of {error.sensor}{told}: "
            f"{used} is used."
        )
    return found
