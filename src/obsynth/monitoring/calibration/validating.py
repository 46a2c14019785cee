"""Validation of a design by a log without faults: tests of its innovations, and variances that the log contradicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SolverError, SpecError
from obsynth.monitoring.calibration.diagnostics import (
    SIGNIFICANT,
    Consistency,
    SensorValidation,
    Validation,
    change_of_mean,
    consistency,
    largest_power,
    standing_out,
    whiteness,
    wrong_samples,
)
from obsynth.monitoring.calibration.explanations import Explanation, explanations, whitened
from obsynth.monitoring.calibration.integration_error import IntegrationError, integration_error
from obsynth.monitoring.calibration.linear_validation import (
    filter_of_linear_plant,
    is_linear,
    notes_on_disturbances,
    sentences_on_sizes,
    sentences_on_units,
)
from obsynth.monitoring.calibration.logs import LogData, RecordedLog, quantum, read_log
from obsynth.monitoring.calibration.maximum import Maximum, Objective, greatest_likelihood
from obsynth.monitoring.calibration.plants import NonlinearPlant
from obsynth.monitoring.calibration.problem import CalibrationProblem
from obsynth.monitoring.calibration.simulation_error import Fit
from obsynth.monitoring.calibration.step_graphs import sample_graphs
from obsynth.monitoring.calibration.variance_names import variance_names, with_letter
from obsynth.monitoring.calibration.walk_shares import (
    likeliest_shares,
    sentences_on_shares,
    shared_walk,
    stated_walk,
    with_walk,
)
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray, read_only
from obsynth.observers.changed_options import changed
from obsynth.observers.estimates import Estimates
from obsynth.observers.nonlinear.estimates import GatheredRows
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.estimates import recursive_estimates
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.dae import DAEModel
from obsynth.plants.transformations.noise_states import with_noise
from obsynth.results.design import ObserverDesign
from obsynth.results.number_texts import duration

#: A variance is reported if the log likelihood with the design's value is lower by so many nats than with the likeliest
#: one, the other variances being at their likeliest values.
CLEAR_NATS = 3.0

#: If another cause explains coloured innovations, variances are reported only if they raise the log likelihood by so
#: many times as much: one log hardly distinguishes process noise from coloured sensor noise.
CLEARLY_MORE = 1.25

#: Ratios of variances within this factor of one are not reported, since variances are not known more accurately.
REPORTED_SPREAD_RATIO = 1.5

#: A factor that differs from a whole number by less than this share is printed as a word, since it is an estimate.
WORD_SHARE = 0.25

#: A mean of innovations, or a parameter's deviation from its start, beyond so many standard deviations is reported.
OFFSET = 3.0

#: Least number of rows of a log.
LEAST_VALIDATED_ROWS = 20

#: Lower bound of the likeliest variance of a sensor, as a share of that in the design.
LEAST_RATIO = 1e-6


@dataclass(frozen=True, eq=False)
class RecordedInnovations:
    """The innovations of a run over a log, with its estimates."""

    innovations: FloatArray  # ``(n, ny)``
    deviations: FloatArray  # ``(n, ny)``: their standard deviations
    squares: float  # sum of the NIS
    degrees: int  # sum of its degrees of freedom
    estimates: Mapping[str, FloatArray]  # ``(n, 2)``: each parameter with its deviation
    states: FloatArray  # ``(n, nx)``

    @property
    def standardised(self) -> FloatArray:
        """Innovations in units of their deviations ``(n, ny)``, NaN where nothing was measured."""
        return np.asarray(self.innovations / self.deviations)

    @property
    def loss(self) -> float:
        """Negative log likelihood of each sensor's innovations, in nats, up to a constant."""
        losses = 0.5 * self.standardised**2 + np.log(self.deviations)
        return float(losses[np.isfinite(losses)].sum())


def recorded_innovations(design: ObserverDesign, log: RecordedLog) -> RecordedInnovations:
    """Return the innovations of a design over a log."""
    observer = design.observer
    if isinstance(observer, (DAEObserver, RecursiveObserver)) and observer.sensors is not None:
        # In a recorded log, late samples are known at the times that they belong to.
        log = replace(log, y=observer.timing.in_order(log.y))
    if isinstance(observer, DAEObserver):
        estimates = _over(changed(observer, sensors=None), log)
        return _recorded(
            estimates, estimates.innovations, np.sqrt(np.einsum("kii->ki", estimates.innovation_covariances))
        )
    if isinstance(observer, RecursiveObserver):
        return _recursive(changed(observer, sensors=None), log, _operating_point(design))
    raise TypeError(f"{type(observer).__name__} has no innovations with a covariance")


def _integration_error(observer: object, log: RecordedLog, record: RecordedInnovations) -> IntegrationError | None:
    """Return the error of backward Euler along a log; ``None`` for observers without such steps."""
    if not (isinstance(observer, DAEObserver) and observer.integration == "backward-euler"):
        return None
    # In units of the innovations' deviations: R would be too small for sensors with coloured noise, since it is only
    # the white part.
    return integration_error(
        observer.model,
        record.states,
        log.u,
        np.array([columns[-1, 0] for columns in record.estimates.values()]),
        np.median(record.deviations, axis=0),
        observer.dt,
    )


def _over(observer: DAEObserver, log: RecordedLog) -> Estimates:
    """Return the estimates over a log; missing inputs are replaced as in a run."""
    u = log.measured_inputs
    if not np.isnan(u).any():
        return observer.run(log.y, u, progress=False)
    state, rows = observer.init(), GatheredRows(observer)
    for y_k, u_k in zip(log.y, u, strict=True):
        state, row = observer.accept(state, y_k, u_k)
        rows.add(row)
    return rows.estimates()


def _recursive(observer: RecursiveObserver, log: RecordedLog, point: Mapping[str, float]) -> RecordedInnovations:
    """Return the innovations of a recursive observer: at each sample a step without measurements gives the prediction,
    and a step with them the next state."""
    plant = observer.plant
    y, u = _deviating(observer, log, point)
    state, nothing = observer.init(), np.full(plant.ny, np.nan)
    e, deviations, rows = np.full(y.shape, np.nan), np.full(y.shape, np.nan), []
    for k in range(len(y)):
        if k:
            mean, covariance = observer.recursion.predicted(state, nothing, u[k])
            deviations[k] = np.sqrt(np.diag(covariance))
            e[k] = np.where(np.isfinite(deviations[k]), y[k] - mean, np.nan)
        state, row = observer.advance(state, y[k], u[k])
        rows.append(row)
    return _recorded(recursive_estimates(observer, rows), e, deviations)


def _deviating(
    observer: RecursiveObserver, log: RecordedLog, point: Mapping[str, float]
) -> tuple[FloatArray, FloatArray]:
    """Return the deviations of outputs and inputs of a log from the operating point."""
    y = log.y - np.array([point.get(name, 0.0) for name in observer.plant.output_names])
    u = log.measured_inputs - np.array([point.get(name, 0.0) for name in observer.plant.input_names])
    return y, u


def _operating_point(design: ObserverDesign) -> dict[str, float]:
    return dict(getattr(design.plant, "operating_point", {}))


def _recorded(run: Estimates, innovations: FloatArray, deviations: FloatArray) -> RecordedInnovations:
    columns = np.stack([run.parameters, run.parameter_deviations], axis=2)
    estimates = {name: read_only(columns[:, i]) for i, name in enumerate(run.parameter_names)}
    return RecordedInnovations(
        innovations, deviations, float(run.nis.sum()), int(run.nis_degrees.sum()), estimates, run.states
    )


def noise_ratios(observer: DAEObserver, log: RecordedLog) -> tuple[Mapping[str, float], float, FloatArray]:
    """Return the likeliest variances on a log, with the parameters constant or as random walks.

    Returns
    -------
    tuple
        The ratio of the likeliest to the designed variance for each variance that the log contradicts; the increase of
        the log likelihood, in nats, by the likeliest variances; and the likeliest covariance of the parameters' random
        walk ``(nq, nq)``, at most the stated one.
    """
    model = observer.model
    held = model.replace(parameters=dict(zip(model.parameter_names, observer.initial_parameters, strict=True)))
    walk = observer.random_walk if stated_walk(observer).any() else np.zeros((model.nq, model.nq))
    walking = np.diag(walk) > 0.0
    if walking.any() and not held.is_data:
        # A model whose equations are functions cannot be extended by states.
        return {}, 0.0, walk
    designed_Q, designed_R = np.diag(observer.Q), np.diag(observer.R)
    noisy = tuple(name for name, variance in zip(model.equation_names, designed_Q, strict=True) if variance > 0.0)
    walks = dict(zip(np.array(model.parameter_names)[walking].tolist(), np.diag(walk)[walking].tolist(), strict=True))
    problem = _variance_problem(observer, log, held, noisy, walks)
    # Noise in the equation of a walking state acts during the whole step, hence the division by the squared step.
    designed = np.concatenate([designed_Q[designed_Q > 0.0], np.diag(walk)[walking] / log.dt**2, designed_R])
    fit = Fit(np.zeros(0), problem.x0, np.sqrt(designed_R), 0.0, np.zeros((0, 0)))
    objective = Objective(problem, fit)
    try:
        best = greatest_likelihood(objective, [fit], lambda text: None)
    except PreconditionError:
        # The likelihood cannot be computed: nothing is reported.
        return {}, 0.0, walk
    q, r = variance_names(model.equation_names, model.output_names)
    keys = dict(zip(model.equation_names, q, strict=True))
    names = (*(keys[name] for name in noisy), *walks, *r)
    walk_places = slice(len(noisy), len(noisy) + len(walks))
    ratios = {
        name: ratio
        for i, (name, variance) in enumerate(zip(names, designed, strict=True))
        if not walk_places.start <= i < walk_places.stop
        and (ratio := _contradicted_ratio(objective, best, i, float(variance))) is not None
    }
    shares = np.ones(model.nq)
    likeliest = np.exp(best.z[walk_places] - np.log(designed[walk_places]))
    shares[walking] = np.minimum(likeliest, 1.0)
    return ratios, objective(np.log(designed))[0] - best.value, shared_walk(walk, shares)


def _variance_problem(
    observer: DAEObserver, log: RecordedLog, held: DAEModel, noisy: tuple[str, ...], walks: Mapping[str, float]
) -> CalibrationProblem:
    """Return the problem of fitting the variances of a design alone.

    These are the variances of its noisy equations, of the walking parameters and of the sensors.  ``held`` is its model
    with the parameters at their start.
    """
    model, nothing = held, np.zeros(0)
    walking = [name in walks for name in model.parameter_names]
    extended: Any = with_noise(held, walks=walks)[0] if walks else held
    plant = NonlinearPlant(extended)
    across = np.zeros((model.nx, len(walks)))
    unsure = observer.initial_parameter_covariance[np.ix_(walking, walking)]
    return CalibrationProblem(
        plant=plant,
        log=log,
        u=log.u,
        unknown=(),
        nominal=nothing,
        low=nothing,
        high=nothing,
        prior_means=nothing,
        prior_weights=nothing,
        noisy=(*noisy, *walks),
        known_Q=np.full(len(noisy) + len(walks), np.nan),
        known_R=np.full(model.ny, np.nan),
        x0=np.concatenate([observer.initial_state, observer.initial_parameters[walking]]),
        P0=np.block([[observer.initial_covariance, across], [across.T, unsure]]),
        quanta=np.array([quantum(column) for column in log.y.T]),
        floors=LEAST_RATIO * np.diag(observer.R),
        graphs=sample_graphs(plant, (), log.dt, integration=observer.integration, substeps=1, samples=log.samples),
        integration=observer.integration,
        substeps=1,
    )


def _contradicted_ratio(objective: Objective, best: Maximum, i: int, variance: float) -> float | None:
    """Return the ratio of a likeliest to a designed variance if the log clearly contradicts the latter, else `None`."""
    ratio = float(np.exp(best.z[i]) / variance)
    if max(ratio, 1.0 / ratio) <= REPORTED_SPREAD_RATIO:
        return None
    z = best.z.copy()
    z[i] = np.log(variance)
    return ratio if objective(z)[0] - best.value > CLEAR_NATS else None


@arguments_checked
def validate(
    design: ObserverDesign,
    log: LogData,
    *,
    rows: str | slice | Sequence[int] | None = None,
    columns: Mapping[str, str] | None = None,
    scales: Mapping[str, float] | None = None,
    progress: Callable[[str], object] | None = None,
) -> Validation:
    """Test whether a log without faults agrees with a design.

    Parameters
    ----------
    design : ObserverDesign
        A recursive or nonlinear design, which predicts its outputs with a covariance.  For a linear design, the plant
        is compared with the log by the Kalman filter for the plant's stated noise, without faults, from any initial
        state, and with arbitrary unknown disturbances.
    log : path, pandas.DataFrame or mapping
        CSV or Parquet file, or columns by name: ``time`` in seconds, inputs and outputs.
    rows : str, slice or pair, optional
        The rows without faults, such as ``"a:b"``, counted as in Python; all by default.
    columns : mapping of str to str, optional
        Column of a signal, or of ``time``, where the names differ.
    scales : mapping of str to float, optional
        Factor of each column; those of the plant by default.
    progress : callable, optional
        Called with a text at each stage.

    Returns
    -------
    Validation
        NIS per degree of freedom, mean and whiteness of each sensor's innovations, variances that the log contradicts,
        and a verdict with what to change, including signals that are likely in another unit.

    Raises
    ------
    SpecError
        The design has no innovations with a covariance, its plant states no noise, a name is unknown, or the log cannot
        be used.
    SolverError
        A step of a nonlinear plant has no solution along the log.

    Examples
    --------
    >>> import pandas as pd
    >>> import obsynth
    >>> plant = obsynth.TimeVaryingDescriptorSystem(
    ...     E=None,
    ...     A=[["0.9 + 0.05 * sin(k)"]],
    ...     C=[[1.0]],
    ...     Phi=[[1.0]],
    ...     dt=1.0,
    ...     horizon=100,
    ...     parameter_names=["leak"],
    ... )
    >>> design = obsynth.adaptive_observer(plant, Q=1e-4, R=1e-2, forgetting=0.95)
    >>> log = obsynth.simulate(design, obsynth.Scenario(horizon=99, noise=1.0)).outputs
    >>> validation = obsynth.validate(design, pd.DataFrame({"time": range(len(log)), "y1": log[:, 0]}))
    >>> validation.passed
    True
    """
    note = progress or (lambda text: None)
    stated, linear = design, is_linear(design)
    record_log = _usable_log(design, log, rows=rows, columns=columns, scales=scales)
    note(f"innovations of {record_log.samples} rows")
    whole_walk = None
    if linear:
        design, record_log, whole_walk = _of_linear_plant(design, record_log)
    whole_walk = whole_walk or recorded_innovations(design, record_log)
    design, record, walk_notes = _as_far_as_it_walks(design, record_log, whole_walk, note)
    far_off, near = _far(whole_walk.estimates, design, record_log.samples)
    sensors = _sensors(record, design.plant.output_names)
    total, white = consistency(record.squares, record.degrees), _white(sensors)
    place = change_of_mean(record.standardised if white else whitened(record.standardised))
    change = None if place is None else record_log.rows[0] + place
    ratios, explained = _contradicted(design, record_log, record, sensors, total, note)
    sentences = _sentences(sensors, ratios, change, far_off, record_log.dt, coloured=explained is not None)
    if explained is not None:
        sentences.append(_explained(explained, linear=linear))
    if linear:
        sentences += sentences_on_sizes(sensors, total, explained or ())
    # If a signal is in another unit, other statements on the innovations have no meaning.
    sentences = sentences_on_units(design, record_log) or sentences
    passed = total.holds and not sentences
    if not (passed or total.holds or ratios) and explained is None:
        far = "small" if total.value > total.high else "large"
        noise = "The stated noise is altogether" if linear else "Q and R together are"
        sentences.append(f"{noise} too {far}: the innovations are {np.sqrt(total.value):.2g} times what is expected.")
    error = _integration_error(design.observer, record_log, record)
    if error is not None and error.matters:
        sentences.append(
            f"A step of backward Euler has an error of up to {error.largest:.2g} deviations of "
            f"{error.sensor} (row {record_log.rows[0] + error.row}), which moves estimates of "
            "parameters: integration: radau has no such error."
        )
    if passed:
        sentences.append("The innovations are as the design expects them: white, without offset, of the stated size.")
    return Validation(
        passed,
        design.name,
        total,
        sensors,
        ratios,
        change,
        (*record_log.notes, *walk_notes, *near, *notes_on_disturbances(stated, sensors), *sentences),
        read_only(record.innovations),
        read_only(record.deviations),
        read_only(np.array(record_log.y)),
        read_only(record_log.y - record.innovations),
        whole_walk.estimates,
        record_log.described,
    )


def _usable_log(
    design: ObserverDesign,
    log: LogData,
    *,
    rows: str | slice | Sequence[int] | None,
    columns: Mapping[str, str] | None,
    scales: Mapping[str, float] | None,
) -> RecordedLog:
    """Return the log without clearly wrong samples; raise `SpecError` if the design or the log cannot be used."""
    if not (states_innovations(design) or is_linear(design)):
        raise SpecError(
            f"The method {design.method} states no covariance of its residual with which a log could be compared: "
            "validate a recursive, nonlinear or linear design of the plant, or run the log with a monitor.",
            path="design",
        )
    plant = design.linear[0] if is_linear(design) else design.plant
    factors = dict(getattr(plant, "scales", {})) | dict(scales or {})
    record = read_log(
        log,
        plant.input_names,
        plant.output_names,
        rows=rows,
        columns=columns,
        scales=factors,
        dt=design.observer.dt or None,
        units=plant.units,
    )
    if record.samples < LEAST_VALIDATED_ROWS:
        raise SpecError(
            f"The log has {record.samples} rows here: at least {LEAST_VALIDATED_ROWS} are needed.",
            path="rows",
            code="too-short",
        )
    return record.shifted(design.input_delay).without(wrong_samples(record.y))


def _of_linear_plant(
    design: ObserverDesign, log: RecordedLog
) -> tuple[ObserverDesign, RecordedLog, RecordedInnovations | None]:
    """Return the Kalman filter for the plant of a linear design, the log without the samples that it excludes, and the
    innovations of its run if it excludes none."""
    made = filter_of_linear_plant(design, log, lambda tried: _states(tried, log))
    run = recorded_innovations(made, log)
    wrong = standing_out(run.standardised)
    return (made, log.without(wrong), None) if wrong.any() else (made, log, run)


def _states(design: ObserverDesign, log: RecordedLog) -> FloatArray:
    """Return the estimates of the states ``(n, nx)`` along a log."""
    observer = design.observer
    if not isinstance(observer, RecursiveObserver):
        raise TypeError(f"{type(observer).__name__} is no recursion")
    state, rows = observer.init(), []
    # Step by step, since `run` does not accept missing inputs.
    for y_k, u_k in zip(*_deviating(observer, log, _operating_point(design)), strict=True):
        state, row = observer.advance(state, y_k, u_k)
        rows.append(row)
    return recursive_estimates(observer, rows).states


def _contradicted(
    design: ObserverDesign,
    log: RecordedLog,
    record: RecordedInnovations,
    sensors: Mapping[str, SensorValidation],
    total: Consistency,
    note: Callable[[str], object],
) -> tuple[Mapping[str, float], tuple[Explanation, ...] | None]:
    """Return the variances that a log contradicts, and the possible causes of innovations that stay coloured.

    The causes are ``None`` if the innovations are white, with the variances of the design or with the likeliest ones.
    """
    white, observer = _white(sensors), design.observer
    # If the innovations are as expected, no variance is reported.
    if total.holds and white and all(item.nis.holds for item in sensors.values()):
        return {}, None
    likeliest_noise = None
    if isinstance(observer, DAEObserver):
        note("variances that the log makes likeliest")
        # Samples that the observer excludes as outliers are not used to estimate the noise.
        passed_by_gate = replace(log, y=read_only(np.where(np.isfinite(record.innovations), log.y, np.nan)))
        likeliest_noise = noise_ratios(observer, passed_by_gate)
    ratios: Mapping[str, float] = {} if likeliest_noise is None else likeliest_noise[0]
    if white:
        return ratios, None
    other_causes = _explanations(design, log, record, note)
    if likeliest_noise is None or not ratios or not isinstance(observer, DAEObserver):
        return ratios, other_causes
    # Wrong variances make innovations coloured as well.  They are reported if the innovations with the likeliest
    # variances are white, and if no other cause explains clearly more.
    _, gain, walk = likeliest_noise
    likeliest = recorded_innovations(design.replace(observer=_with_variances(observer, ratios, walk)), log)
    rival = CLEARLY_MORE * other_causes[0][1] if other_causes else 0.0
    if not _white(_sensors(likeliest, design.plant.output_names)) or rival > gain:
        return {}, other_causes
    return ratios, None


def _as_far_as_it_walks(
    design: ObserverDesign, log: RecordedLog, record: RecordedInnovations, note: Callable[[str], object]
) -> tuple[ObserverDesign, RecordedInnovations, list[str]]:
    """Return the design with the likeliest part of its parameters' random walks, its innovations, and sentences on it.

    ``record`` has the innovations with the whole stated walks.
    """
    observer = design.observer
    walk = stated_walk(observer)
    if not walk.any() or not isinstance(observer, (DAEObserver, RecursiveObserver)):
        return design, record, []
    runs = {walk.tobytes(): (design, record)}

    def loss(tried: FloatArray) -> float:
        if tried.tobytes() not in runs:
            another = design.replace(observer=with_walk(observer, tried))
            runs[tried.tobytes()] = another, recorded_innovations(another, log)
        return runs[tried.tobytes()][1].loss

    note("how far parameters walk in this log")
    shares = likeliest_shares(walk, loss)
    return *runs[shared_walk(walk, shares).tobytes()], sentences_on_shares(design.observer.fault_names, walk, shares)


def states_innovations(design: ObserverDesign) -> bool:
    """Whether a design predicts its outputs with a covariance, which a log could contradict."""
    return isinstance(design.observer, (DAEObserver, RecursiveObserver))


def _sensors(record: RecordedInnovations, names: Sequence[str]) -> dict[str, SensorValidation]:
    by_sensor = {}
    for name, column in zip(names, record.standardised.T, strict=True):
        measured = np.isfinite(column)
        count = int(measured.sum())
        mean = float(column[measured].mean() * np.sqrt(count)) if count else 0.0
        by_sensor[name] = SensorValidation(
            consistency(float((column[measured] ** 2).sum()), count), mean, whiteness(column), largest_power(column)
        )
    return by_sensor


def _sentences(
    sensors: Mapping[str, SensorValidation],
    ratios: Mapping[str, float],
    change: int | None,
    far: Mapping[str, float],
    dt: float,
    *,
    coloured: bool,
) -> list[str]:
    sentences = []
    for name, ratio in ratios.items():
        size, factor = "small" if ratio > 1.0 else "large", max(ratio, 1.0 / ratio)
        sentences.append(f"{with_letter(name, sensors)} is {_times(factor)} too {size}.")
    for name, sensor in sensors.items():
        if abs(sensor.mean) > OFFSET:
            sentences.append(
                f"The innovations of {name} have an offset of {sensor.mean:+.1f} deviations of their mean: a "
                "constant or an offset of the sensor is wrong."
            )
        if sensor.whiteness.probability < SIGNIFICANT:
            sentences.append(
                f"The innovations of {name} are not white (p = {sensor.whiteness.probability:.2g}, first "
                f"autocorrelation {sensor.whiteness.first:+.2f}{_spectrum(sensor, dt)}): "
                + ("coloured noise or a model error." if coloured else "Q against R is wrong.")
            )
    if change is not None:
        sentences.append(
            f"The mean of the innovations changes at row {change}: these rows are not free of faults"
            + (", or something that is not in the model changes there." if coloured else ".")
        )
    for name, deviation in far.items():
        sentences.append(
            f"The estimate of {name} ends {deviation:.1f} deviations from its nominal value: a constant is "
            f"wrong, {'coloured noise acts on it, ' if coloured else ''}or the rows are not free of faults."
        )
    return sentences


def _spectrum(sensor: SensorValidation, dt: float) -> str:
    """Return a text on the periods with the largest power of the innovations; empty if the log is too short."""
    rows, multiple = sensor.power
    period = duration(rows * dt, digits=2)
    return f", {multiple:.2g} times their mean power at periods of about {period}" if rows else ""


def _white(sensors: Mapping[str, SensorValidation]) -> bool:
    return all(sensor.whiteness.probability >= SIGNIFICANT for sensor in sensors.values())


def _with_variances(observer: DAEObserver, ratios: Mapping[str, float], walk: FloatArray) -> DAEObserver:
    """Return the observer with its variances multiplied by the reported ratios, and with another random walk."""
    names = variance_names(observer.model.equation_names, observer.model.output_names)
    q, r = ([ratios.get(name, 1.0) for name in part] for part in names)
    Q, R = np.diag(np.diag(observer.Q) * q), np.diag(np.diag(observer.R) * r)
    return replace(observer, Q=Q, R=R, random_walk=walk)


def _explanations(
    design: ObserverDesign, log: RecordedLog, record: RecordedInnovations, note: Callable[[str], object]
) -> tuple[Explanation, ...]:
    """Return the possible causes of coloured innovations other than wrong variances."""
    observer, constants = design.observer, dict[str, float]()
    if isinstance(observer, DAEObserver):
        constants = {name: float(value) for name, value in observer.model.constants.items()}

    def with_constant(name: str, value: float) -> FloatArray:
        note(f"innovations with another value of {name}")
        nonlinear: Any = observer  # no other observer has constants
        model = nonlinear.model.replace(constants={**nonlinear.model.constants, name: value})
        try:
            rerun = recorded_innovations(design.replace(observer=replace(nonlinear, model=model)), log)
        except SolverError:
            return np.full(record.innovations.shape, np.nan)
        return np.asarray(rerun.innovations / record.deviations)

    def with_later_input(i: int, rows: int) -> FloatArray:
        note(f"innovations with {design.plant.input_names[i]} {abs(rows)} row {'later' if rows > 0 else 'earlier'}")
        u = np.array(log.u)
        u[:, i] = log.shifted(rows).u[:, i]
        return np.asarray(recorded_innovations(design, replace(log, u=u)).innovations / record.deviations)

    return explanations(
        record.standardised,
        log.u,
        design.plant.output_names,
        design.plant.input_names,
        dt=log.dt,
        constants=constants,
        with_constant=with_constant,
        with_later_input=with_later_input if isinstance(observer, RecursiveObserver) else None,
    )


def _explained(causes: Sequence[Explanation], *, linear: bool) -> str:
    if not causes:
        return "No single offset, correlated noise, delay of an input or constant explains that: plot the residuals."
    listed = "; ".join(f"{text} ({gain:.3g} nats)" for text, gain in causes)
    noise = (
        "Judge the stated noise again once that is corrected."
        if linear
        else "The factors of Q and R have no meaning until that is corrected."
    )
    return f"What explains it best, by likelihood: {listed}. {noise}"


def _far(
    estimates: Mapping[str, FloatArray], design: ObserverDesign, samples: int
) -> tuple[dict[str, float], list[str]]:
    """Return the parameters whose estimates end too far from their start, and notes on others.

    The distances are in standard deviations.  The notes are on estimates that end far from their start, but not further
    than the parameter may walk.
    """
    observer, walk = design.observer, stated_walk(design.observer)
    start = dict(zip(observer.fault_names, getattr(observer, "initial_parameters", ()), strict=False))
    variances = np.diag(walk) if walk.size else np.zeros(len(start))
    walked = dict(zip(start, np.sqrt(samples * variances), strict=True))
    off_start, notes = {}, []
    for name, columns in estimates.items():
        value, deviation = columns[-1]
        if name not in start or not deviation > 0.0 or not abs(value - start[name]) > OFFSET * deviation:
            continue
        off = float(abs(value - start[name]) / deviation)
        if abs(value - start[name]) > OFFSET * np.hypot(deviation, walked[name]):
            off_start[name] = off
        else:
            notes.append(
                f"The estimate of {name} ends {off:.1f} deviations from its nominal value, no further than it may "
                "walk: if it is a fault, these rows are not free of it."
            )
    return off_start, notes


def _times(factor: float) -> str:
    if factor > 1000.0:
        return "more than a thousand times"
    words = {2: "two", 3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight", 9: "nine", 10: "ten"}
    near = round(factor)
    return f"{words[near]} times" if near in words and abs(factor - near) < WORD_SHARE * near else f"{factor:.3g} times"
