"""Fitting a model's constants and noise to a log: the public function, and the order in which it asks.

Several wrong samples of one sensor in a row: far from their prediction, and gone when they are over.

What happened in the plant is seen by other sensors, or goes on.  Once wrong samples are hidden, the next one is where
it was predicted; then they count as not measured, as single ones do.  Left in a log, three of them made coloured noise
look white, or of twice its size.

Which states for coloured noise, offsets and loads the innovations of a log ask for, chosen by likelihood.

One state at a time is added, that which gains most: its nats less half a logarithm of the number of samples for each
number that it adds (Schwarz 1978).  An offset is integrated out, which counts it already.

From a fit to a calibration: tables by name, checks of the innovations, and a sentence for each thing found.

How a model is to be integrated on a log: what a step of backward Euler errs, against the noise of the sensors.

What a calibration found, frozen, with a table for people and plain data for programs.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.analysis.dae_structure import identifiability
from obsynth.analysis.transformations.noise import with_noise
from obsynth.calibration.diagnostics import (
    LEAST_DIAGNOSED_ROWS,
    LEAST_EXPLANATION,
    MOST_OUTLIERS,
    SIGNIFICANT,
    STANDS_OUT,
    BoolArray,
    Consistency,
    Whiteness,
    change_of_mean,
    consistency,
    mean_off,
    regression_gain,
    standing_out,
    usual_size,
    whiteness,
    wrong_samples,
)
from obsynth.calibration.fits import (
    FIRST_ROWS,
    Fit,
    InnovationsFit,
    Objective,
    Side,
    SimulationError,
    chosen_timing,
    covariance_of,
    innovations_fit,
    quantile,
    simulation_fits,
    unexplained,
    with_seen_start,
)
from obsynth.calibration.logs import EVEN, Log, LogData, read_log, told_rows
from obsynth.calibration.problem import (
    IMPOSSIBLE,
    CalibrationPlant,
    Likelihood,
    LinearPlant,
    NoiseStates,
    NonlinearPlant,
    PlantWithNoise,
    Problem,
    asked_states,
    calibration_problem,
    correlation_name,
    require_variation,
)
from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.methods.dae_adaptive_observer.conditions import NOMINAL_SAMPLES
from obsynth.numerics.arguments import SMALLEST, FloatArray, Seed, arguments_checked, is_whole, read_only, whole_number
from obsynth.observers.running import BAND_WIDTH
from obsynth.plants.constants import CalibratedBox
from obsynth.plants.dae import BUTCHER, DAEFunctions, DAEModel, ImplicitStep
from obsynth.plants.descriptor import DescriptorSystem, TimeVaryingDescriptorSystem
from obsynth.plants.noise_model import noise_state, noise_variance, offset_state, process_variance
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

    def __repr__(self) -> str:
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


#: Autocorrelations between which a search for coloured noise begins, and the share of R that it begins with.
FIRST_KEPT, COLOURED_SHARE = (0.3, 0.98), 0.7
#: Numbers that a state adds: the variance and correlation of coloured noise, the variance of a walk.
ADDED_NUMBERS = {"coloured": 2, "offset": 0, "walk": 1}
#: Nats above which a state is taken.  An offset that is not taken spoils constants, and one too many only widens boxes.
LEAST_NATS = {"coloured": LEAST_EXPLANATION, "offset": 1.0, "walk": LEAST_EXPLANATION}
#: Nats that an offset explains beside constants, variances as they are, before it is tried; and by how much constants
#: are moved to see what they explain, in widths of their bounds.
ASKING, SMALL_MOVE = 2.0, 1e-4


def proposed_states(
    problem: Problem,
    fit: InnovationsFit,
    asked: NoiseStates,
    kinds: Sequence[str],
    problem_with: Callable[[NoiseStates], Problem],
    note: Callable[[str], object],
) -> tuple[NoiseStates, list[str]]:
    """Return the states asked for with those that the innovations ask for, and a sentence for each of these."""
    states, told = asked, list[str]()
    asking = _asking(problem, fit)
    value, known = fit.value, _Known.of(problem, fit)
    while True:
        found = []
        for kind, name, tried in _candidates(states, kinds, problem.output_names, problem.plant.unknown_inputs):
            if (kind, name) not in asking:
                continue
            note(f"{kind} of {name}")
            reached, place = known.best(_like(problem, problem_with(tried)))
            gain = value - reached - 0.5 * ADDED_NUMBERS[kind] * np.log(problem.log.samples)
            least = LEAST_NATS[kind]
            if kind == "offset" and least < gain < LEAST_EXPLANATION and hidden_faults(problem, fit, tried):
                least = LEAST_EXPLANATION
            found.append((gain - least, kind, name, tried, reached, place))
        if not found:
            break
        gain, kind, name, tried, reached, place = max(found, key=lambda item: item[0])
        if not gain > 0.0:
            break
        hidden = hidden_faults(problem, fit, tried) if kind == "offset" else ()
        least = LEAST_EXPLANATION if hidden else LEAST_NATS[kind]
        told.append(_STATE_SENTENCES[kind].format(name=name, gain=gain + least))
        if hidden:
            told.append(_OFFSET_HIDES.format(name=name, faults=" and ".join(hidden)))
        states, value, known = tried, reached, place
    return states, told


_STATE_SENTENCES = {
    "coloured": "The noise of {name} is coloured: the model has a state for it (better by {gain:.3g} nats).",
    "offset": "The sensor {name} has an offset: the model has a state for it (better by {gain:.3g} nats).",
    "walk": "The unknown input {name} is taken as a random walk (better by {gain:.3g} nats).",
}


_OFFSET_HIDES = (
    "At constant inputs {faults} cannot be distinguished from the offset of {name}: a design for both may be "
    "refused. If the sensor has no offset, state this (offset: {{}} in calibrate)."
)


def hidden_faults(problem: Problem, fit: InnovationsFit, states: NoiseStates) -> tuple[str, ...]:
    """Return the faults of a nonlinear plant that the outputs determine at nominal constant inputs, but not beside the
    offsets of sensors."""
    inner = problem.plant.inner if isinstance(problem.plant, PlantWithNoise) else problem.plant
    if not isinstance(inner, NonlinearPlant) or not inner.model.nq:
        return ()
    model, found = inner.model, []
    u = np.tile(model.nominal_input, (NOMINAL_SAMPLES, 1))
    for plant in (model, cast(DAEModel, with_noise(model, offset=states.offsets)[0])):
        try:
            told = identifiability(plant, u, dt=problem.log.dt, R=np.diag(fit.R), method=problem.integration)
        except SolverError:
            return ()
        found.append(told.unidentifiable)
    return tuple(name for name in model.parameter_names if name in found[1] and name not in found[0])


def _asking(problem: Problem, fit: InnovationsFit) -> set[tuple[str, str]]:
    """Return kinds and names that innovations ask for: coloured noise of a sensor where those of one are not white or
    an equation has process noise, which may stand for it; offsets that explain more of them than constants can; unknown
    inputs."""
    found = {("walk", name) for name in problem.plant.unknown_inputs}
    names, ny = problem.output_names, len(problem.output_names)
    coloured = [whiteness(column).probability < SIGNIFICANT for column in fit.whitened.T]
    # Process noise that stands for coloured noise whitens that sensor: the next one pays for it, or none does.
    # A mean is no colour, but a bias.
    hidden = any(coloured) or not np.all(fit.limited_Q)
    found |= {
        ("coloured", name)
        for name, own, column in zip(names, coloured, fit.whitened.T, strict=True)
        if own or (hidden and not mean_off(column))
    }
    v = fit.v
    before = _whitened(problem, v, problem.y)
    moves = [
        (_whitened(problem, v + step, problem.y) - before) / SMALL_MOVE
        for step in SMALL_MOVE * np.hstack([np.diag(problem.widths), np.zeros((len(fit.t), len(v) - len(fit.t)))])
    ]
    deviations = np.sqrt(np.nanmean(fit.innovations**2, axis=0))
    for j, name in enumerate(names):
        offset = deviations[j] * (np.arange(ny) == j)
        effect = _whitened(problem, v, problem.y - offset) - before
        if regression_gain(before.ravel(), [move.ravel() for move in moves], effect.ravel()) > ASKING:
            found.add(("offset", name))
    return found


def _whitened(problem: Problem, v: FloatArray, y: FloatArray) -> FloatArray:
    """Return whitened innovations ``(n, ny)`` of other measurements, NaN where nothing was measured."""
    return Likelihood(problem, y).innovations(v)[0]


def _candidates(
    states: NoiseStates, kinds: Sequence[str], outputs: Sequence[str], unknown_inputs: Sequence[str]
) -> Iterator[tuple[str, str, NoiseStates]]:
    for name in outputs:
        if "coloured" in kinds and name not in states.correlations:
            yield "coloured", name, replace(states, correlations={**states.correlations, name: None})
        if "offset" in kinds and name not in states.offsets:
            yield "offset", name, replace(states, offsets=(*states.offsets, name))
    for name in unknown_inputs:
        if "walk" in kinds and name not in states.loads:
            yield "walk", name, replace(states, loads=(*states.loads, name))


def _like(problem: Problem, new: Problem) -> Problem:
    """Return a problem with the steps, the inputs and the start of another one, as far as it goes."""
    if (new.integration, new.substeps) != (problem.integration, problem.substeps):
        new = new.integrated(problem.integration, problem.substeps)
    own = len(problem.plant.state_names)
    places = [new.plant.state_names.index(name) for name in problem.plant.state_names]
    P0 = new.P0.copy()
    P0[np.ix_(places, places)] = problem.P0[:own, :own]
    return new.with_start(P0)


class _Known:
    """What a fit found, by name, from which a search with one more state begins."""

    def __init__(self, t: dict[str, float], variances: dict[str, float], kept: dict[str, float], R: FloatArray) -> None:
        self.t, self.variances, self.kept, self.R = t, variances, kept, R

    @classmethod
    def of(cls, problem: Problem, fit: InnovationsFit) -> _Known:
        """Return what a fit found; ``kept``: how much of an innovation of each sensor its next one keeps."""
        columns = zip(problem.output_names, fit.whitened.T, strict=True)
        kept = {name: whiteness(column).first for name, column in columns}
        both = (*problem.noisy, *problem.output_names)
        variances = dict(zip(both, (*fit.Q.tolist(), *fit.R.tolist()), strict=True))
        spread = np.nanmean(fit.innovations**2, axis=0)
        return cls(dict(zip(problem.unknown, fit.t.tolist(), strict=True)), variances, kept, spread)

    def best(self, problem: Problem) -> tuple[float, _Known]:
        """Return the least negative log likelihood with another model, and what it found."""
        plant = problem.plant
        nominal = {name: float(value) for name, value in zip(problem.unknown, problem.nominal, strict=True)}
        best, value = None, np.inf
        for longer in (1.0, 5.0):
            t, variances = nominal | self.t, dict(self.variances)
            for j, name in enumerate(problem.output_names):
                if correlation_name(name) in self.t or noise_state(name) not in problem.noisy:
                    continue
                time = -longer * problem.log.dt / float(np.log(np.clip(self.kept[name], *FIRST_KEPT)))
                if correlation_name(name) in problem.unknown:
                    t[correlation_name(name)] = float(np.log(time))
                variances[noise_state(name)] = process_variance(
                    COLOURED_SHARE * self.R[j], time, problem.log.dt, problem.integration
                )
                variances[name] = (1.0 - COLOURED_SHARE) * variances[name]
            start = np.clip([t[name] for name in problem.unknown], problem.low, problem.high)
            fit = Fit(start, problem.x0, np.sqrt(self.R), 0.0, np.zeros((0, 0)))
            objective = Objective(problem, fit)
            full = objective.full(objective.start(start))
            for i, name in enumerate((*problem.noisy, *problem.output_names)):
                if variances.get(name, 0.0) > 0.0:
                    full[objective.nt + i] = np.log(variances[name])
            full[: objective.nt] /= problem.widths
            reached, z = objective.descent(full[objective.free])
            if reached < value and reached < IMPOSSIBLE:
                value, best = reached, (objective, z)
            if not isinstance(plant, PlantWithNoise) or not plant.bounds:
                break
        if best is None:
            return np.inf, self
        objective, z = best
        Q, R = objective.noise(z)
        found = dict(zip((*problem.noisy, *problem.output_names), (*Q.tolist(), *R.tolist()), strict=True))
        return value, _Known(
            dict(zip(problem.unknown, objective.constants(z).tolist(), strict=True)), found, self.kept, self.R
        )


#: Wrong samples in a row at most, and how many after them must be where they are predicted.
LONGEST_RUN, RETURNED = 5, 3


def wrong_runs(problem: Problem, fit: InnovationsFit) -> BoolArray:
    """Return which measurements ``(n, ny)`` stand out with others of the same sensor beside them, are not seen by
    another sensor, and leave the next samples where these are predicted without them."""
    found = np.zeros(problem.y.shape, dtype=bool)
    seen = np.isfinite(problem.y)
    enough = seen.sum(axis=0) >= LEAST_DIAGNOSED_ROWS
    usual = np.array([usual_size(e) if many else np.inf for e, many in zip(fit.whitened.T, enough, strict=True)])
    far = seen & (np.abs(fit.whitened) > STANDS_OUT * usual)
    for i in range(far.shape[1]):
        for first, last in _groups(far[:, i]):
            if np.delete(far[first : last + 1], i, axis=1).any():
                continue
            end = _end(problem, fit, usual[i], i, first, last)
            if end is not None:
                found[first : end + 1, i] = seen[first : end + 1, i]
    return np.asarray(found & (found.sum(axis=0) <= MOST_OUTLIERS * seen.sum(axis=0)))


def _groups(far: BoolArray) -> list[tuple[int, int]]:
    """Return first and last row of what stands out together, of no more than a run and the sample after it; single ones
    are none."""
    found: list[tuple[int, int]] = []
    for row in np.flatnonzero(far).tolist():
        if found and row - found[-1][1] <= LONGEST_RUN:
            found[-1] = (found[-1][0], row)
        else:
            found.append((row, row))
    return [(first, last) for first, last in found if 0 < last - first <= LONGEST_RUN]


def _end(problem: Problem, fit: InnovationsFit, usual: float, output: int, first: int, last: int) -> int | None:
    """Return the first row to which samples must be hidden so that those after it are where they are predicted; `None`
    where there is none."""
    for end in range(first, min(last, first + LONGEST_RUN - 1) + 1):
        y = problem.y.copy()
        y[first : end + 1, output] = np.nan
        after = np.flatnonzero(np.isfinite(y[end + 1 :, output]))[:RETURNED] + end + 1
        if len(after) == RETURNED and (np.abs(_whitened(problem, fit.v, y)[after, output]) <= STANDS_OUT * usual).all():
            return end
    return None


#: How often samples that stand out are left out: each time the others are known better.
OUTLIER_ROUNDS = 3
#: What is said of an offset without which the model follows nothing.
OFFSET_TAKEN = "Without an offset of the sensor {} the model does not follow the log: it has a state for it."
#: Two sample times are the same within this share.
SAME_TIME = 1e-6


@arguments_checked
def calibrate(
    model: DAEModel | DescriptorSystem | TimeVaryingDescriptorSystem,
    log: LogData,
    unknown: Mapping[str, Sequence[float]],
    *,
    priors: Mapping[str, Sequence[float]] | None = None,
    noisy: Sequence[str] | None = None,
    R: Mapping[str, float | None] | None = None,
    Q: Mapping[str, float | None] | None = None,
    initial_state: ArrayLike | Mapping[str, float] | None = None,
    initial_covariance: ArrayLike | Mapping[str, float] | None = None,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    dt: float | None = None,
    input_delay: int | str = "auto",
    method: Literal["innovations", "simulation"] = "innovations",
    integration: Literal["auto", "backward-euler", "radau"] = "auto",
    substeps: int = 1,
    level: float = 0.95,
    starts: int = 3,
    seed: Seed = 0,
    sensor_noise: Mapping[str, Any] | None = None,
    offset: Mapping[str, Any] | Sequence[str] | None = None,
    walks: Mapping[str, Any] | Sequence[str] | None = None,
    progress: Callable[[str], object] | None = None,
) -> Calibration:
    r"""Fit constants and noise covariances of a plant to a log of rows without faults.

    The start is a least-squares fit of simulations.  Then the likelihood of the innovations is made greatest,

    .. math::
        -\log p = \tfrac12 \sum_k e_k^T S_k^{-1} e_k + \log\det 2 \pi S_k , \qquad
        S_k = H_k P_k^- H_k^T + R ,

    over constants, Q and R, by the recursion that the observers run, with exact gradients.

    Parameters
    ----------
    model : DAEModel, DescriptorSystem or TimeVaryingDescriptorSystem
        ``nx`` states, ``nu`` inputs, ``ny`` outputs.  Linear plants hold their constants in entries that are
        expressions (`obsynth.uncertain_system`, or texts of a time-varying plant); constant faults and parameters may
        be unknown too.  Their signals are deviations from the operating point, of which logs know nothing; ``k`` is
        the row of the log.
    log : path, pandas.DataFrame or mapping
        CSV or Parquet file, or columns by name: ``time`` in seconds, every input and every output; NaN where an output
        is missing.  Single outputs a hundred times further off than the others count as missing, and are reported.
    unknown : mapping of str to (low, high)
        Constants and parameters that are to be found, with finite bounds around their nominal values; none (``{}``)
        to find the noise alone.
    priors : mapping of str to (mean, deviation), optional
        What is known of them besides, as normal distributions.
    noisy : list of str, optional
        Equations to whose right sides noise is added in each step; all by default.
    R, Q : mapping of str to float, optional
        Variances that are known, by sensor and by noisy equation; the others are found.
    initial_state : array_like or mapping, optional
        ``(nx,)``, or values by name; by default nominal values, of linear plants zero.
    initial_covariance : array_like or mapping, optional
        ``(nx, nx)``, one variance, or variances by name.  By default deviations are 10 % of the nominal
        sizes, or as far as the log begins elsewhere (a note says so); of linear plants, what alone would make outputs
        as large as they are.
    rows : str, slice or pair, optional
        ``"a:b"``: the rows that are free of faults, as Python counts; all by default.
    columns : mapping of str to str, optional
        Column of a signal, or of ``time``, where the names differ.
    scales : mapping of str to float, optional
        What a column is multiplied by to be in the signal's unit.
    dt : float, optional
        Seconds between rows; the median of the stamps by default.
    input_delay : int or "auto", optional
        Rows by which the log's inputs act later than the convention says: ``u(k)`` during the step that ends at k, of
        linear plants during the one that begins there.  ``"auto"`` takes the delay of which the likelihood is clearly
        better, such as 1 of a log that writes what is sent at k: up to 3 are tried, and more while the last is best.
    method : {"innovations", "simulation"}, optional
        The second one stops at the fit of simulations, whose boxes are too small where its residuals are not white.
    integration : {"auto", "backward-euler", "radau"}, optional
        ``"auto"`` takes backward Euler unless its error of one step exceeds a quarter of a sensor's deviation, or exact
        steps would move a constant by half of its deviation; for linear plants in continuous time Radau.  Discrete
        plants are stepped as they are.
    substeps : int, optional
        Steps in a sample.
    level : float, optional
        Probability of the box, for all constants at once.
    starts : int, optional
        Fits of simulations, from the nominal constants and from random ones.
    seed : int, optional
        Of those.
    sensor_noise : mapping, optional
        ``{y: {"correlation": seconds or "unknown"}}``: outputs whose noise is coloured, as in `with_noise`; white
        noise is found beside it.  ``{}`` says that all noise is white.  By default coloured noise is taken where the
        innovations ask for it and the likelihood says so, and is reported.
    offset : mapping or list of str, optional
        Outputs with an offset that is not known; ``{}`` says that there is none.  By default as for ``sensor_noise``.
    walks : mapping or list of str, optional
        Unknown inputs, faults and parameters that walk at random; inputs of a nonlinear plant that no log holds.
        Unknown inputs of linear plants by default as for ``sensor_noise``.
    progress : callable, optional
        Called with the name of each stage.

    Returns
    -------
    Calibration
        Nominal values, box, undetermined directions, Q and R, checks of the innovations, and a verdict.

    Raises
    ------
    SpecError
        A name, a bound or an option is wrong; or the log is (``code``: ``irregular``, ``time``, ``nan``,
        ``too-short``).
    PreconditionError
        ``not-exciting``: nothing moves.  ``explains-nothing``: the model cannot follow the log, for example as units
        are off by 1000.  ``cannot-simulate``: it has no solution along the log's inputs.  ``undetermined-step``: a
        step of a linear plant does not determine its state.

    References
    ----------
    .. [Ljung1999] L. Ljung, System Identification, 2nd ed., 1999, 7.2 and 10.1: prediction errors and their gradients.
    .. [Chung2013] Y. Chung et al., "A nondegenerate penalized likelihood estimator for variance parameters",
       Psychometrika 78, 2013: the weight that keeps variances from zero, which we give only to those that the log
       cannot distinguish from it.
    """
    if not isinstance(level, (int, float)) or not 0.0 < level < 1.0:
        raise SpecError(f"level is {level!r}: give a probability, such as 0.95.", path="level")
    starts = whole_number(starts, "starts")
    if input_delay != "auto" and not is_whole(input_delay):
        raise SpecError(f"input_delay is {input_delay!r}: give whole rows, or 'auto'.", path="input_delay")
    note = progress or (lambda text: None)
    model = _loads_as_parameters(require_plant(model), walks)
    factors = dict(getattr(model, "scales", {})) | dict(scales or {})
    whole = read_log(
        log,
        model.input_names,
        model.output_names,
        rows=rows,
        columns=columns,
        scales=factors,
        dt=_sample_time(model, dt, substeps),
    )
    digest = whole.digest
    whole = whole.unstuck()
    whole = whole.without(wrong_samples(whole.y))
    whole = whole.shifted(input_delay) if isinstance(input_delay, int) else whole
    plant = NonlinearPlant(model) if isinstance(model, DAEModel) else LinearPlant(model, whole)
    asked = asked_states(sensor_noise, offset, walks, model.output_names)

    def problem_with(states: NoiseStates, log: Log) -> Problem:
        extended = PlantWithNoise(plant, states, log) if states else plant
        own = noisy
        if isinstance(extended, PlantWithNoise):
            own = (*(plant.equation_names if noisy is None else noisy), *extended.noisy)
        return calibration_problem(
            extended,
            log,
            unknown=unknown,
            priors=priors,
            noisy=own,
            Q=Q,
            R=R,
            initial_state=_by_name(initial_state, plant.state_names),
            initial_covariance=_by_name(initial_covariance, plant.state_names),
            substeps=substeps,
            integration=plant.integration(integration),
        )

    require_variation(problem_with(asked, whole))
    innovations = method == "innovations"
    fitting = _Fitting(
        plant, problem_with, starts, seed, level, note, integration == "auto", initial_covariance is None, innovations
    )
    search = innovations and input_delay == "auto" and bool(model.input_names)
    found, asked, told = fitting.first_fit(asked, whole, search=search, may_take_offsets=offset is None)
    found = fitting.without_outliers(found)
    kinds = (("coloured", sensor_noise), ("offset", offset), ("walk", walks))
    open_kinds = tuple(kind for kind, given in kinds if given is None)
    if found.fit is not None and open_kinds:
        found = fitting.with_proposals(found, found.fit, asked, open_kinds, told)
    return reported(
        found.problem, found.fits[0], found.fit, level=level, losses=found.losses, error=found.error, digest=digest
    )


def _loads_as_parameters(model: Any, walks: Mapping[str, Any] | Sequence[str] | None) -> Any:
    """Return a nonlinear plant whose inputs that walk are parameters: no log holds them."""
    loads = [name for name in walks or () if isinstance(model, DAEModel) and name in model.inputs]
    if not loads:
        return model
    inputs = {name: value for name, value in model.inputs.items() if name not in loads}
    return model.replace(inputs=inputs, parameters={**model.parameters, **{name: model.inputs[name] for name in loads}})


def _by_name(value: Any, names: Sequence[str]) -> Any:
    """Return what is said of the plant's own states by their names, where it is an array: others may follow."""
    if value is None or isinstance(value, Mapping) or np.ndim(value) == 0:
        return value
    array = np.asarray(value, dtype=np.float64)
    if array.shape == (len(names),):
        return dict(zip(names, array.tolist(), strict=True))
    if array.shape == (len(names), len(names)) and not np.any(array - np.diag(np.diag(array))):
        return dict(zip(names, np.diag(array).tolist(), strict=True))
    return value


@dataclass(frozen=True, eq=False)
class _Found:
    """A problem as it was fitted at last, with its fits, what backward Euler errs, and what each delay of the inputs
    loses in nats, where it was searched for."""

    problem: Problem
    fits: list[Fit]
    fit: InnovationsFit | None
    error: IntegrationError | None
    losses: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Fitting:
    """How a problem is fitted: simulations first, steps that are exact enough, timing, then the innovations."""

    plant: CalibrationPlant
    problem_with: Callable[[NoiseStates, Log], Problem]
    starts: int
    seed: int
    level: float
    note: Callable[[str], object]
    choose_steps: bool
    widen_start: bool
    innovations: bool

    def fitted(self, problem: Problem, *, search: bool) -> _Found:
        """Return the fit of a problem; the delay of the inputs is searched for where asked."""
        fits = simulation_fits(problem, self.starts, self.seed, self.note)
        if self.widen_start and (seen := with_seen_start(problem, fits[0])) is not problem:
            problem, fits = seen, simulation_fits(seen, 1, self.seed, self.note, start=fits[0].t)
        error = None
        if self.choose_steps and isinstance(self.plant, NonlinearPlant):
            names, start = problem.names, fits[0]
            states = SimulationError(problem).states(start)[:, : len(self.plant.state_names)]
            theta = np.array(self.plant.theta(names, start.t), dtype=np.float64)
            error = integration_error(
                self.plant.promoted(names), states, problem.u, theta, start.deviations, problem.log.dt
            )
            if error is not None and error.matters:
                self.note("integrating by Radau")
                problem = problem.integrated("radau", problem.substeps)
                fits = simulation_fits(problem, self.starts, self.seed, self.note)
        losses: Mapping[int, float] = {}
        if search:
            problem, fits, losses = chosen_timing(problem, fits, self.seed, self.note, any_start=self.widen_start)
        fit = None
        if self.innovations:
            before = problem, error
            problem, fit, error = _innovations(problem, fits, self.level, self.note, error)
            if self.widen_start and fit is not None:
                seen = with_seen_start(before[0], fits[0], first=fit.whitened[:FIRST_ROWS])
                if seen is not before[0]:
                    fits = simulation_fits(seen, 1, self.seed, self.note, start=fits[0].t)
                    problem, fit, error = _innovations(seen, fits, self.level, self.note, before[1])
        return _Found(problem, fits, fit, error, losses)

    def first_fit(
        self, asked: NoiseStates, log: Log, *, search: bool, may_take_offsets: bool
    ) -> tuple[_Found, NoiseStates, list[str]]:
        """Return the fit with the states that were asked for; and with those, and a sentence for each, the offsets of
        sensors that it takes where without them the model explains nothing."""
        try:
            return self.fitted(self.problem_with(asked, log), search=search), asked, []
        except PreconditionError as error:
            # An offset as large as what a sensor does looks like a model that explains nothing.
            if not may_take_offsets or not self.innovations or error.condition != "explains-nothing":
                raise
            asked = replace(asked, offsets=log.output_names)
            try:
                found = self.fitted(self.problem_with(asked, log), search=search)
            except PreconditionError:
                raise error from None
        told = [OFFSET_TAKEN.format(name) for name in log.output_names]
        return replace(found, problem=found.problem.with_notes(*told)), asked, told

    def with_proposals(
        self, found: _Found, fit: InnovationsFit, asked: NoiseStates, kinds: tuple[str, ...], before: list[str]
    ) -> _Found:
        """Return the fit with states of some kinds where its innovations ask for them; ``before``: what is told of
        those that it has."""
        log = found.problem.log
        states, told = proposed_states(
            found.problem, fit, asked, kinds, lambda states: self.problem_with(states, log), self.note
        )
        if not told:
            return found
        again = self.fitted(self.problem_with(states, log), search=False)
        # What is white beside coloured noise is less than both: more samples stand out.
        problem = again.problem.with_notes(*before, *told)
        return self.without_outliers(replace(again, problem=problem, losses=found.losses))

    def without_outliers(self, found: _Found) -> _Found:
        """Return the fit again without samples that stand out alone or a few in a row: they would make R a multiple of
        what it is."""
        for _ in range(OUTLIER_ROUNDS):
            if found.fit is None:
                break
            problem = found.problem
            alone = standing_out(found.fit.whitened)
            wrong = alone | wrong_runs(problem, found.fit)
            off = np.abs(found.fit.innovations).T
            if not wrong.any():
                break
            self.note("without samples that stand out")
            names, log = problem.output_names, problem.log
            told = [
                f"Samples of {name} stand out by more than {STANDS_OUT:g} deviations (row "
                f"{told_rows(log.rows[0] + np.flatnonzero(wrong[:, i]))}): they count as not measured."
                for i, name in enumerate(names)
                if wrong[:, i].any()
            ]
            kept = replace(
                log,
                y=read_only(np.where(wrong, np.nan, problem.y)),
                notes=(*log.notes, *told),
                outliers=tuple(
                    np.concatenate([before, off[i, alone[:, i]]])
                    for i, before in enumerate(log.outliers or [np.zeros(0)] * len(names))
                ),
            )
            fits = simulation_fits(problem.with_log(kept), 1, self.seed, self.note, start=found.fit.t)
            again = _innovations(problem.with_log(kept), fits, self.level, self.note, found.error)
            found = _Found(again[0], fits, *again[1:], found.losses)
        return found


def _innovations(
    problem: Problem, fits: list[Fit], level: float, note: Callable[[str], object], error: IntegrationError | None
) -> tuple[Problem, InnovationsFit | None, IntegrationError | None]:
    """Return the fit, with the steps that it needs: errors of single steps that are small may move constants still."""
    chosen = error is not None and not error.matters
    exact = problem.integrated("radau", problem.substeps) if chosen else None
    fit, moved = innovations_fit(problem, fits, level, note, exact=exact)
    if error is None or exact is None:
        return problem, fit, error
    if fit is None:
        note("integrating by Radau")
        problem, (fit, _) = exact, innovations_fit(exact, fits, level, note)
    return problem, fit, replace(error, moved=moved)


def require_plant(given: Any) -> DAEModel | DescriptorSystem | TimeVaryingDescriptorSystem:
    """Return the plant whose matrices hold the constants: that before elimination and sampling, if there were any."""
    plant = getattr(given, "source", given)
    uncertainty = getattr(plant, "uncertainty", None)
    if uncertainty is not None and uncertainty.steps:
        made = getattr(plant, "_made_from", None)
        if made is None:
            raise SpecError(
                "Elimination or sampling has mixed the constants of this plant: give the plant as it was written.",
                path="model",
            )
        plant = made[0]
    if not isinstance(plant, (DAEModel, DescriptorSystem, TimeVaryingDescriptorSystem)):
        raise SpecError(
            f"model is {type(given).__name__}: give a DAEModel, a DescriptorSystem or a TimeVaryingDescriptorSystem.",
            path="model",
        )
    return plant


def _sample_time(model: Any, dt: float | None, substeps: int) -> float | None:
    """Return the time between rows: that of a discrete plant is its own."""
    own = 0.0 if isinstance(model, DAEModel) else float(model.dt)
    if not own:
        return dt
    if dt is not None and abs(dt - own) > SAME_TIME * own:
        raise SpecError(f"dt is {dt:g} s, but a step of this plant takes {own:g} s: leave dt out.", path="dt")
    if substeps != 1:
        raise SpecError(
            "substeps divides the steps of continuous plants, and this one is discrete: leave it out.", path="substeps"
        )
    return own
