"""The public `calibrate`: fit the constants and the noise of a plant to a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.errors import SpecError
from obsynth.monitoring.calibration.diagnostics import wrong_samples
from obsynth.monitoring.calibration.fitting import Fitting
from obsynth.monitoring.calibration.linear_plant import LinearPlant
from obsynth.monitoring.calibration.logs import LogData, RecordedLog, read_log
from obsynth.monitoring.calibration.noise_states import NoiseStates, PlantWithNoise, stated_noise_states
from obsynth.monitoring.calibration.plants import NonlinearPlant
from obsynth.monitoring.calibration.problem import CalibrationProblem, calibration_problem, require_variation
from obsynth.monitoring.calibration.reporting import reported
from obsynth.monitoring.calibration.result import Calibration
from obsynth.numerics.arguments import Seed, arguments_checked, is_whole, whole_number
from obsynth.plants.dae import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.plants.transformations.delays import require_no_delays

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

    The first step is a least-squares fit of simulations.  The second maximises the likelihood of the innovations,

    .. math::
        -\log p = \tfrac12 \sum_k e_k^T S_k^{-1} e_k + \log\det 2 \pi S_k , \qquad
        S_k = H_k P_k^- H_k^T + R ,

    over constants, Q and R, by the recursion that the observers run, with exact gradients.

    Parameters
    ----------
    model : DAEModel, DescriptorSystem or TimeVaryingDescriptorSystem
        ``nx`` states, ``nu`` inputs, ``ny`` outputs.  Linear plants hold their constants in entries that are
        expressions (`obsynth.uncertain_system`, or texts of a time-varying plant); constant faults and parameters may
        be unknown too.  The log holds absolute values; the operating point is subtracted.  ``k`` is the row of the log.
    log : path, pandas.DataFrame or mapping
        CSV or Parquet file, or columns by name: ``time`` in seconds, every input and every output; NaN where an output
        is missing.  Single values of an output that are a hundred times further off than the others count as missing
        and are reported.
    unknown : mapping of str to (low, high)
        Constants and parameters to estimate, with finite bounds around their nominal values; none (``{}``)
        to estimate the noise alone.
    priors : mapping of str to (mean, deviation), optional
        Normal distributions of some of them, from other knowledge.
    noisy : list of str, optional
        Equations with process noise; all by default.
    R, Q : mapping of str to float, optional
        Known variances, by sensor and by noisy equation; the others are estimated.
    initial_state : array_like or mapping, optional
        ``(nx,)``, or values by name; by default nominal values, and zero for linear plants.
    initial_covariance : array_like or mapping, optional
        ``(nx, nx)``, one variance, or variances by name.  The default deviations are 10 % of the nominal sizes, or the
        distance of the first row from the initial state if that is larger (a note says so).  For linear plants each
        deviation alone explains the size of the outputs.
    rows : str, slice or pair, optional
        Rows without faults, as a slice of Python, such as ``"0:500"``; all by default.
    columns : mapping of str to str, optional
        Column of a signal, or of ``time``, where the names differ.
    scales : mapping of str to float, optional
        Factor of a column that converts it to the signal's unit.
    dt : float, optional
        Seconds between rows; the median of the stamps by default.
    input_delay : int or "auto", optional
        Rows by which the log's inputs act later than by convention: ``u(k)`` acts during the step that ends at k, and
        for linear plants during the step that begins there.  ``"auto"`` takes a delay if its likelihood is
        clearly better, such as 1 for a log that holds the command sent at k; up to 3 are tried, and more while the last
        one is the best.
    method : {"innovations", "simulation"}, optional
        ``"simulation"`` stops after the fit of simulations; its boxes are too small if the residuals are not white.
    integration : {"auto", "backward-euler", "radau"}, optional
        ``"auto"`` takes backward Euler unless its error in one step exceeds a quarter of a sensor's deviation, or exact
        steps would change a constant by half of its deviation.  Linear plants in continuous time take Radau, and
        discrete plants their own steps.
    substeps : int, optional
        Steps of the integration in each sample.
    level : float, optional
        Probability of the box, for all constants at once.
    starts : int, optional
        Number of fits of simulations: one from the nominal constants, the others from random ones.
    seed : int, optional
        Seed of the random ones.
    sensor_noise : mapping, optional
        ``{y: {"correlation": seconds or "unknown"}}``: outputs with coloured noise, as in `with_noise`, in addition to
        white noise, which is estimated.  ``{}``: all noise is white.  By default coloured noise is added, and reported,
        if the innovations are not white and it raises the likelihood enough.
    offset : mapping or list of str, optional
        Outputs with an unknown offset; ``{}``: there is none.  The default is that of ``sensor_noise``.
    walks : mapping or list of str, optional
        Unknown inputs, faults and parameters that are random walks; also inputs of a nonlinear plant that no log holds.
        The default for unknown inputs of linear plants is that of ``sensor_noise``.
    progress : callable, optional
        Called with the name of each stage.

    Returns
    -------
    Calibration
        Nominal values, box, undetermined directions, Q and R, checks of the innovations, and a verdict.

    Raises
    ------
    SpecError
        A name, a bound, an option or the log is wrong (``code`` for logs: ``irregular``, ``time``, ``nan``,
        ``too-short``).
    PreconditionError
        ``not-exciting``: no signal changes.  ``explains-nothing``: the model cannot follow the log, for example because
        a unit is wrong by a factor of 1000.  ``cannot-simulate``: it has no solution for the log's inputs.
        ``undetermined-step``: a step of a linear plant does not determine its state.

    References
    ----------
    .. [Ljung1999] L. Ljung, System Identification, 2nd ed., 1999, 7.2 and 10.1: prediction errors and their gradients.
    .. [Chung2013] Y. Chung et al., "A nondegenerate penalized likelihood estimator for variance parameters",
       Psychometrika 78, 2013: the penalty that keeps variances from zero; here only for variances that the log cannot
       distinguish from zero.

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
    ...     units={"level": "m", "inflow": "m/s", "c": "1/s", "gauge": "m"},
    ... )
    >>> k, rng = np.arange(80), np.random.default_rng(0)
    >>> inflow = 0.5 + 0.2 * np.sign(np.sin(0.1 * k))
    >>> level = [1.0]
    >>> for u in inflow[1:]:
    ...     level.append((level[-1] + u) / (1 + 0.5))  # backward Euler with c = 0.5
    >>> log = {"time": k, "inflow": inflow, "gauge": np.array(level) + 0.01 * rng.normal(size=80)}
    >>> calibration = obsynth.calibrate(tank, log, {"c": (0.1, 1.0)})
    >>> round(calibration.nominal["c"], 2)
    0.5
    """
    _require_numbers(level, input_delay)
    starts = whole_number(starts, "starts")
    note = progress or (lambda text: None)
    model = _loads_as_parameters(require_plant(model), walks)
    factors = dict(getattr(model, "scales", {})) | dict(scales or {})
    seconds = _sample_time(model, dt, substeps)
    read = read_log(
        log,
        model.input_names,
        model.output_names,
        rows=rows,
        columns=columns,
        scales=factors,
        dt=seconds,
        units=model.units,
    )
    record = _usable(read, input_delay)
    plant = NonlinearPlant(model) if isinstance(model, DAEModel) else LinearPlant(model, record)
    noise_model = stated_noise_states(sensor_noise, offset, walks, model.output_names)

    def problem_with(states: NoiseStates, log: RecordedLog) -> CalibrationProblem:
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

    require_variation(problem_with(noise_model, record))
    innovations = method == "innovations"
    fitting = Fitting(
        plant, problem_with, starts, seed, level, note, integration == "auto", initial_covariance is None, innovations
    )
    kinds = (("coloured", sensor_noise), ("offset", offset), ("walk", walks))
    fitted = fitting.in_stages(
        noise_model,
        record,
        search=innovations and input_delay == "auto" and bool(model.input_names),
        open_kinds=tuple(kind for kind, stated in kinds if stated is None),
    )
    return reported(
        fitted.problem,
        fitted.fits[0],
        fitted.fit,
        level=level,
        losses=fitted.losses,
        error=fitted.error,
        digest=read.digest,
    )


def _require_numbers(level: Any, input_delay: Any) -> None:
    """Raise `SpecError` where the level is no probability, or the delay of the inputs no whole number of rows."""
    if not isinstance(level, (int, float)) or not 0.0 < level < 1.0:
        raise SpecError(f"level is {level!r}: give a probability, such as 0.95.", path="level")
    if input_delay != "auto" and not is_whole(input_delay):
        raise SpecError(f"input_delay is {input_delay!r}: give whole rows, or 'auto'.", path="input_delay")


def _usable(record: RecordedLog, input_delay: int | str) -> RecordedLog:
    """Return the log without wrong samples and those of stuck sensors, with its inputs shifted by a known delay."""
    record = record.unstuck()
    record = record.without(wrong_samples(record.y))
    return record.shifted(input_delay) if isinstance(input_delay, int) else record


def _loads_as_parameters(model: Any, walks: Mapping[str, Any] | Sequence[str] | None) -> Any:
    """Return a nonlinear plant in which inputs that are random walks are parameters: no log holds them."""
    loads = [name for name in walks or () if isinstance(model, DAEModel) and name in model.inputs]
    if not loads:
        return model
    inputs = {name: value for name, value in model.inputs.items() if name not in loads}
    return model.replace(inputs=inputs, parameters={**model.parameters, **{name: model.inputs[name] for name in loads}})


def _by_name(value: Any, names: Sequence[str]) -> Any:
    """Return values of the plant's own states by name instead of as an array: states of noise may follow them."""
    if value is None or isinstance(value, Mapping) or np.ndim(value) == 0:
        return value
    array = np.asarray(value, dtype=np.float64)
    if array.shape == (len(names),):
        return dict(zip(names, array.tolist(), strict=True))
    if array.shape == (len(names), len(names)) and not np.any(array - np.diag(np.diag(array))):
        return dict(zip(names, np.diag(array).tolist(), strict=True))
    return value


def require_plant(model: Any) -> DAEModel | DescriptorSystem | TimeVaryingDescriptorSystem:
    """Return the plant as it was written, before elimination and sampling: its matrices hold the constants."""
    plant = getattr(model, "source", model)
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
            f"model is {type(model).__name__}: give a DAEModel, a DescriptorSystem or a TimeVaryingDescriptorSystem.",
            path="model",
        )
    require_no_delays(plant, "A calibration")
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
