"""The result of a calibration from a fit: tables by name, tests of the innovations, and sentences on both."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from obsynth.monitoring.calibration.diagnostics import (
    OUTLYING,
    SIGNIFICANT,
    Consistency,
    Whiteness,
    change_of_mean,
    consistency,
    mean_off,
    whiteness,
)
from obsynth.monitoring.calibration.innovations_fit import InnovationsFit
from obsynth.monitoring.calibration.integration_error import IntegrationError
from obsynth.monitoring.calibration.intervals import Side, covariance_of, quantile
from obsynth.monitoring.calibration.logs import EVEN, RecordedLog, listed_rows
from obsynth.monitoring.calibration.noise_states import PlantWithNoise, correlation_name
from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.monitoring.calibration.result import Calibration
from obsynth.monitoring.calibration.simulation_error import Fit, SimulationError, unexplained
from obsynth.monitoring.calibration.variance_names import variance_names
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.plants.calibrated_box import CalibratedBox
from obsynth.plants.dae_functions import BUTCHER
from obsynth.plants.noise import noise_state, noise_variance, offset_state

#: Constants whose correlation exceeds this are named together.
CORRELATED = 0.9

#: A sensor's variance below this multiple of its quantisation's is reported.
AT_QUANTISATION = 1.5

#: A timing that is better by this many nats is reported, even where it is not taken.
NOTED_NATS = 2.0

#: A variance of a sensor above this share of what its signal has stands for the signal.
SIGNAL_SHARE = 0.1

#: A constant within this share of the bounds' width from one of them is at it.
END_SHARE = 1e-6

#: Autocorrelations between which a search for coloured noise begins, and the share of R that it begins with.
FIRST_AUTOCORRELATIONS, COLOURED_SHARE = (0.3, 0.98), 0.7


def reported(
    problem: CalibrationProblem,
    start: Fit,
    fit: InnovationsFit | None,
    *,
    level: float,
    losses: Mapping[int, float],
    error: IntegrationError | None,
    digest: str,
) -> Calibration:
    """Return the calibration of a fit of innovations, or of a simulation where there is none."""
    result = fit if fit is not None else _of_simulation(problem, start, level)
    names, whitened = problem.names, result.whitened
    covariance = result.information.covariance
    deviations = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(deviations, deviations)
    colours = {name: whiteness(column) for name, column in zip(problem.output_names, whitened.T, strict=True)}
    change = change_of_mean(whitened)
    nis = consistency(float(np.nansum(whitened**2)), int(np.isfinite(problem.y).sum()))
    box = _box(
        names, result, level, digest, stands=all(colour.probability >= SIGNIFICANT for colour in colours.values())
    )
    Q = {name: float(value) for name, value in zip(problem.noisy, result.Q, strict=True)} if fit is not None else {}
    R = {name: float(value) for name, value in zip(problem.output_names, result.R, strict=True)}
    q, r = variance_names(problem.noisy, problem.output_names)
    limits = zip((*q, *r), (*result.limited_Q, *result.limited_R), strict=True)
    limited = [name for name, weak in limits if weak]
    row = None if change is None else problem.log.rows[0] + change
    at_end = tuple(name for name, is_at_end in zip(problem.unknown, result.at_bounds, strict=True) if is_at_end)
    verdict = [
        *problem.log.notes,
        *problem.plant.notes,
        *problem.notes,
        *_fitted(problem, box, result, at_end, correlation, limited, Q, R),
        *_misfits(problem, start, whitened, R),
        *_checked(nis, colours, row, fit is None),
        *_sentences_on_log(problem, R, losses, error),
    ]
    return Calibration(
        box.nominal,
        read_only(covariance),
        read_only(correlation),
        box,
        result.information.undetermined,
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
        -result.value,
        tuple(verdict),
        read_only(whitened),
        read_only(problem.y - result.innovations),
        read_only(np.sqrt(result.variances)),
        problem.log.described | {"digest": digest},
        {name: problem.plant.units.get(name, "1") for name in names},
        problem.output_names,
        *_noise_model(problem, result, Q, R),
        dict(zip(problem.plant.state_names, np.diag(problem.P0).tolist(), strict=True)),
        getattr(problem.plant, "inner", problem.plant).equation_names,
        _outlier_sizes(problem.log, np.sqrt(np.median(result.variances, axis=0))),
        _fitted_offsets(problem, result),
    )


def _box(names: Sequence[str], fit: InnovationsFit, level: float, digest: str, *, stands: bool) -> CalibratedBox:
    """Return the box of the constants of a fit."""
    nominal = {name: float(value) for name, value in zip(names, fit.t[: len(names)], strict=True)}
    sides = dict(zip(names, fit.sides[: len(names)], strict=True))
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
    problem: CalibrationProblem, fit: InnovationsFit, Q: dict[str, float], R: dict[str, float]
) -> tuple[dict[str, dict[str, float]], dict[str, float], dict[str, float]]:
    """Return coloured noise, deviations of offsets, and walks, in the terms of `with_noise`."""
    if not isinstance(problem.plant, PlantWithNoise) or not Q:
        return {}, {}, {}
    states, dt = problem.plant.states, problem.log.dt
    t = dict(zip(problem.unknown, fit.t.tolist(), strict=True))
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


def _fitted_offsets(problem: CalibrationProblem, fit: InnovationsFit) -> dict[str, tuple[float, float]]:
    """Return the offset of each sensor after the last row, and its deviation."""
    if not isinstance(problem.plant, PlantWithNoise) or fit.at_end is None:
        return {}
    end = dict(zip(problem.plant.state_names, np.transpose(fit.at_end).tolist(), strict=True))
    pairs = {name: end[offset_state(name)] for name in problem.plant.states.offsets}
    return {name: (value, deviation) for name, (value, deviation) in pairs.items()}


def _of_simulation(problem: CalibrationProblem, start: Fit, level: float) -> InnovationsFit:
    """Return what the fit of a simulation says, in the form of a fit of innovations; its boxes are Wald's."""
    error = SimulationError(problem)
    nt, scale = error.nt, error.scale
    inner = start.information
    marginal = inner[:nt, :nt] - inner[:nt, nt:] @ np.linalg.solve(inner[nt:, nt:], inner[nt:, :nt])
    constants = slice(None, len(problem.names))
    marginal = np.linalg.inv(np.linalg.inv(marginal)[constants, constants]) if problem.plant.bounds else marginal
    information = covariance_of(marginal, problem.widths[constants], problem.names)
    y = error.simulated(np.concatenate([start.t, start.x0]) / scale)[0]
    e = problem.y - y
    root = quantile(level, len(problem.names), problem.log.samples, len(problem.output_names))
    spread = root * np.sqrt(np.diag(information.covariance))
    sides = [
        (Side(max(t - half, low), t - half <= low), Side(min(t + half, high), t + half >= high))
        for t, half, low, high in zip(
            start.t[constants], spread, problem.low[constants], problem.high[constants], strict=True
        )
    ]
    ends = (start.t - problem.low < END_SHARE * problem.widths) | (problem.high - start.t < END_SHARE * problem.widths)
    variances = np.tile(start.deviations**2, (len(y), 1))
    nothing = np.zeros(len(problem.noisy))
    return InnovationsFit(
        t=start.t,
        value=start.cost,
        information=information,
        box=lambda: sides,
        Q=nothing,
        R=start.deviations**2,
        limited_Q=nothing.astype(bool),
        limited_R=np.zeros(len(problem.output_names), dtype=bool),
        at_bounds=ends,
        avoided=np.full(len(start.t) + len(nothing) + len(start.deviations), np.nan),
        whitened=e / start.deviations,
        innovations=e,
        variances=variances,
    )


def _fitted(
    problem: CalibrationProblem,
    box: CalibratedBox,
    fit: InnovationsFit,
    at_end: tuple[str, ...],
    correlation: FloatArray,
    limited: list[str],
    Q: dict[str, float],
    R: dict[str, float],
) -> list[str]:
    sentences = []
    for direction in fit.information.undetermined:
        listed = ", ".join(f"{name} {share:+.2g}" for name, share in direction.items())
        sentences.append(
            f"This log does not determine the direction ({listed}), in widths of the bounds: excite it, state a prior, "
            "or fix one of them."
        )
    sentences += [
        f"The box of {name} is open on its {side} side: the bound limits it there, the log does not."
        for name, side in box.open_sides
    ]
    sentences += [f"{name} is at a bound: widen it if the constant may lie beyond." for name in at_end]
    free = [
        i
        for i, name in enumerate(problem.names)
        if not any(name in direction for direction in fit.information.undetermined)
    ]
    sentences += [
        f"{problem.unknown[i]} and {problem.unknown[j]} are correlated by {correlation[i, j]:+.2f}: their "
        "combination is known better than either."
        for i, j in itertools.combinations(free, 2)
        if abs(correlation[i, j]) > CORRELATED
    ]
    q, r = variance_names(tuple(Q), tuple(R))
    values = dict(zip((*q, *r), (*Q.values(), *R.values()), strict=True))
    if not box.stands:
        sentences.append(
            f"The box is not valid: its {100 * box.level:g} % are those of white innovations, which these are not."
        )
    return sentences + [
        f"The variance of {name} cannot be distinguished from zero: its upper limit {values[name]:.3g} is used."
        for name in limited
    ]


def _outlier_sizes(log: RecordedLog, deviations: FloatArray) -> dict[str, float]:
    """Return how far off an outlier of each output is at least, for innovations of ``deviations (ny,)``.

    One more outlier is nearer than all of n with the probability 1 / (n + 1): the size stands that share of the way, on
    a logarithmic scale, from the least of them to what no sample of the model reaches.
    """
    by_output = {}
    for name, sizes, deviation in zip(log.output_names, log.outliers, deviations, strict=False):
        if len(sizes):
            usual, least, share = OUTLYING * float(deviation), float(sizes.min()), 1.0 / (len(sizes) + 1)
            by_output[name] = usual**share * least ** (1.0 - share)
    return by_output


def _misfits(problem: CalibrationProblem, start: Fit, whitened: FloatArray, R: dict[str, float]) -> list[str]:
    """Return sentences about sensors that the model does not follow, their mean, and single samples that stand out."""
    sentences = []
    for name in unexplained(problem, start.deviations):
        signal = float(np.nanvar(problem.y[:, problem.output_names.index(name)]))
        sentences.append(
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
            sentences.append(
                f"The innovations of {name} have the mean {mean:+.2f} deviations: a bias of the sensor, or an "
                "offset that the model lacks."
            )
        rows = problem.log.rows[0] + np.flatnonzero(np.abs(np.nan_to_num(column)) > OUTLYING)
        if len(rows):
            sentences.append(
                f"Samples of {name} stand out by more than {OUTLYING:g} deviations (row {listed_rows(rows)}): "
                "if they are outliers, mark them as missing."
            )
    return sentences


def _checked(nis: Consistency, colours: dict[str, Whiteness], row: int | None, simulated: bool) -> list[str]:
    sentences = [
        f"The innovations of {name} are not white (p = {test.probability:.2g}, first autocorrelation "
        f"{test.first:+.2f}): a signal that acts on {name} is not in the model."
        for name, test in colours.items()
        if test.probability < SIGNIFICANT
    ]
    if simulated and sentences:
        sentences.append(
            "The residuals of a simulation that are not white make boxes too small: use method='innovations'."
        )
    if not simulated and not nis.holds:
        sentences.append(f"NIS per degree of freedom is {nis.value:.2f}, outside {nis.low:.2f} to {nis.high:.2f}.")
    if row is not None:
        sentences.append(
            f"These rows are not homogeneous: the mean of the innovations changes at row {row}. If a fault "
            "begins there, end the rows before it."
        )
    return sentences


def _sentences_on_log(
    problem: CalibrationProblem, R: dict[str, float], losses: Mapping[int, float], error: IntegrationError | None
) -> list[str]:
    sentences, delay = list[str](), problem.log.input_delay
    for name, step in zip(problem.output_names, problem.quanta, strict=True):
        if step > 0.0 and R[name] < AT_QUANTISATION * step**2 / EVEN:
            sentences.append(
                f"The noise of {name} is at its quantisation ({step:.3g} / sqrt 12): its R is at least that of the "
                "quantisation."
            )
    if delay and losses:
        rows = "1 row" if delay == 1 else f"{delay} rows"
        gained = losses[0] - losses[delay]
        sentences.append(f"The inputs act {rows} later than the log states: better by {gained:.1f} nats.")
    lost = losses.get(delay, 0.0)
    if lost > NOTED_NATS:
        least = min(losses, key=lambda rows: losses[rows])
        sentences.append(
            f"Inputs that act {least:+d} {'row' if abs(least) == 1 else 'rows'} later would be better by {lost:.1f} "
            "nats: see input_delay."
        )
    if error is not None:
        used = "Radau" if problem.integration == "radau" else "backward Euler"
        movement = f" and moves a constant by {error.moved:.2g} of its own" if error.moved else ""
        sentences.append(
            f"A step of backward Euler has an error of at most {error.largest:.2g} deviations of "
            f"{error.sensor}{movement}: "
            f"{used} is used."
        )
    return sentences
