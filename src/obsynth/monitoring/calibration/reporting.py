"""The result of a calibration, made from a fit: values by name, tests of the innovations, and a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from obsynth.monitoring.calibration.diagnostics import (
    OUTLYING,
    SIGNIFICANT,
    Consistency,
    Whiteness,
    change_of_mean,
    consistency,
    whiteness,
)
from obsynth.monitoring.calibration.innovations_fit import InnovationsFit
from obsynth.monitoring.calibration.integration_error import IntegrationError
from obsynth.monitoring.calibration.intervals import Side, covariance_of, quantile
from obsynth.monitoring.calibration.logs import RecordedLog
from obsynth.monitoring.calibration.noise_states import PlantWithNoise, correlation_name
from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.monitoring.calibration.result import Calibration
from obsynth.monitoring.calibration.simulation_error import Fit, SimulationError
from obsynth.monitoring.calibration.variance_names import variance_names
from obsynth.monitoring.calibration.verdict import on_constants, on_innovations, on_log, on_misfits
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.plants.calibrated_box import CalibratedBox
from obsynth.plants.dae_functions import BUTCHER
from obsynth.plants.noise import noise_state, noise_variance, offset_state

#: A constant within this share of the bounds' width from one of them is at it.
END_SHARE = 1e-6


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
    correlation = _correlation(covariance)
    nis, colours, row = _tests_of_innovations(problem, whitened)
    box = _box(
        names, result, level, digest, stands=all(colour.probability >= SIGNIFICANT for colour in colours.values())
    )
    Q = {name: float(value) for name, value in zip(problem.noisy, result.Q, strict=True)} if fit is not None else {}
    R = {name: float(value) for name, value in zip(problem.output_names, result.R, strict=True)}
    limited = _limited_variances(problem, result)
    at_end = tuple(name for name, is_at_end in zip(problem.unknown, result.at_bounds, strict=True) if is_at_end)
    verdict = (
        *problem.log.notes,
        *problem.plant.notes,
        *problem.notes,
        *on_constants(problem, box, result, at_end, correlation, limited, Q, R),
        *on_misfits(problem, start, whitened, R),
        *on_innovations(nis, colours, row, fit is None),
        *on_log(problem, R, losses, error),
    )
    sensor_noise, offset, walks = _noise_model(problem, result, Q, R)
    return Calibration(
        nominal=box.nominal,
        covariance=read_only(covariance),
        correlation=read_only(correlation),
        box=box,
        undetermined=result.information.undetermined,
        Q=Q,
        R=R,
        upper_limits=tuple(limited),
        nis=nis,
        whiteness=colours,
        change=row,
        input_delay=problem.log.input_delay,
        timing=dict(losses),
        quanta=dict(zip(problem.output_names, problem.quanta.tolist(), strict=True)),
        at_bounds=at_end,
        integration=problem.integration,
        substeps=problem.substeps,
        method="innovations" if fit is not None else "simulation",
        log_likelihood=-result.value,
        verdict=verdict,
        innovations=read_only(whitened),
        predictions=read_only(problem.y - result.innovations),
        # Of a log without noise they are rounding, on either side of zero.
        deviations=read_only(np.sqrt(np.maximum(result.variances, 0.0))),
        log=problem.log.described | {"digest": digest},
        units={name: problem.plant.units.get(name, "1") for name in names},
        output_names=problem.output_names,
        sensor_noise=sensor_noise,
        offset=offset,
        walks=walks,
        initial_covariance=dict(zip(problem.plant.state_names, np.diag(problem.P0).tolist(), strict=True)),
        own_equations=getattr(problem.plant, "inner", problem.plant).equation_names,
        outlier_sizes=_outlier_sizes(problem.log, np.sqrt(np.median(result.variances, axis=0))),
        found_offsets=_fitted_offsets(problem, result),
    )


def _correlation(covariance: FloatArray) -> FloatArray:
    """Return the correlation matrix of a covariance."""
    deviations = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(deviations, deviations))


def _limited_variances(problem: CalibrationProblem, fit: InnovationsFit) -> list[str]:
    """Return the variances of which the log gives an upper limit only, by name."""
    q, r = variance_names(problem.noisy, problem.output_names)
    limits = zip((*q, *r), (*fit.limited_Q, *fit.limited_R), strict=True)
    return [name for name, is_limited in limits if is_limited]


def _tests_of_innovations(
    problem: CalibrationProblem, whitened: FloatArray
) -> tuple[Consistency, dict[str, Whiteness], int | None]:
    """Return size and whiteness of innovations ``(n, ny)``, and the row of the log where their mean changes."""
    nis = consistency(float(np.nansum(whitened**2)), int(np.isfinite(problem.y).sum()))
    colours = {name: whiteness(column) for name, column in zip(problem.output_names, whitened.T, strict=True)}
    change = change_of_mean(whitened)
    return nis, colours, None if change is None else problem.log.rows[0] + change


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
    """Return the fit of a simulation in the form of a fit of innovations; its boxes are Wald intervals."""
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


def _outlier_sizes(log: RecordedLog, deviations: FloatArray) -> dict[str, float]:
    """Return the least size of an outlier of each output, for innovations of ``deviations (ny,)``.

    A further outlier is smaller than all n known ones with the probability 1 / (n + 1).  On a logarithmic scale the
    result lies that share of the way from the smallest known one to the largest sample that the model explains.
    """
    by_output = {}
    for name, sizes, deviation in zip(log.output_names, log.outliers, deviations, strict=False):
        if len(sizes):
            usual, least, share = OUTLYING * float(deviation), float(sizes.min()), 1.0 / (len(sizes) + 1)
            by_output[name] = usual**share * least ** (1.0 - share)
    return by_output
