"""Fitting a model's constants and noise to a log: the public function, and the order in which it asks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.calibration.diagnostics import wrong_samples
from obsynth.calibration.innovations_fit import InnovationsFit, Timing, chosen_timing, innovations_fit
from obsynth.calibration.linear_plants import LinearPlant, plant_as_written
from obsynth.calibration.logs import LogData, read_log
from obsynth.calibration.plants import NonlinearPlant
from obsynth.calibration.problem import Problem, calibration_problem, require_variation
from obsynth.calibration.reporting import IntegrationError, integration_error, reported
from obsynth.calibration.result import Calibration
from obsynth.calibration.simulation_error import FIRST_ROWS, Fit, SimulationError, simulation_fits, with_seen_start
from obsynth.errors import SpecError
from obsynth.numerics.arguments import chosen, is_whole, whole_number
from obsynth.plants.dae.model import DAEModel
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem

METHODS = ("innovations", "simulation")
INTEGRATIONS = ("auto", "backward-euler", "radau")
#: Two sample times are the same within this share.
SAME_TIME = 1e-6


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
    method: str = "innovations",
    integration: str = "auto",
    substeps: int = 1,
    level: float = 0.95,
    starts: int = 3,
    seed: int = 0,
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
        is missing.  Single outputs a hundred times further off than the others count as missing, which is told.
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
        sizes, or as far as the log begins elsewhere (which is told); of linear plants, what alone would make outputs as
        large as they are.
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
        linear plants during the one that begins there.  ``"auto"`` takes 1 where the likelihood is clearly better: a
        log that writes what is sent at k.
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
       cannot tell from it.
    """
    chosen(method, "method", METHODS)
    chosen(integration, "integration", INTEGRATIONS)
    if not isinstance(level, (int, float)) or not 0.0 < level < 1.0:
        raise SpecError(f"level is {level!r}: give a probability, such as 0.95.", path="level")
    starts = whole_number(starts, "starts")
    if input_delay != "auto" and not is_whole(input_delay):
        raise SpecError(f"input_delay is {input_delay!r}: give whole rows, or 'auto'.", path="input_delay")
    note = progress or (lambda text: None)
    model = require_plant(model)
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
    whole = whole.without(wrong_samples(whole.y))
    whole = whole.shifted(input_delay) if isinstance(input_delay, int) else whole
    plant = NonlinearPlant(model) if isinstance(model, DAEModel) else LinearPlant(model, whole)
    problem = calibration_problem(
        plant,
        whole,
        unknown=unknown,
        priors=priors,
        noisy=noisy,
        Q=Q,
        R=R,
        initial_state=initial_state,
        initial_covariance=initial_covariance,
        substeps=substeps,
        integration=plant.integration(integration),
    )
    require_variation(problem)
    fits = simulation_fits(problem, starts, seed, note)
    if initial_covariance is None and (seen := with_seen_start(problem, fits[0])) is not problem:
        problem, fits = seen, simulation_fits(seen, 1, seed, note, start=fits[0].t)
    error = None
    if integration == "auto" and isinstance(plant, NonlinearPlant):
        error = _step_error(problem, plant, fits[0])
        if error is not None and error.matters:
            note("integrating by Radau")
            problem = problem.integrated("radau", substeps)
            fits = simulation_fits(problem, starts, seed, note)
    timing = Timing(input_delay if isinstance(input_delay, int) else 0, {})
    if method == "innovations" and input_delay == "auto" and model.input_names:
        problem, fits, timing = chosen_timing(problem, fits, seed, note)
    fit = None
    if method == "innovations":
        before = problem, error
        problem, fit, error = _innovations(problem, fits, level, note, error)
        if initial_covariance is None and fit is not None:
            seen = with_seen_start(before[0], fits[0], first=fit.whitened[:FIRST_ROWS])
            if seen is not before[0]:
                fits = simulation_fits(seen, 1, seed, note, start=fits[0].t)
                problem, fit, error = _innovations(seen, fits, level, note, before[1])
    return reported(problem, fits[0], fit, level=level, timing=timing, error=error, digest=digest)


def _step_error(problem: Problem, plant: NonlinearPlant, fit: Fit) -> IntegrationError | None:
    """Return what backward Euler errs along the best simulation."""
    states, theta = (
        SimulationError(problem).states(fit),
        np.array(plant.theta(problem.unknown, fit.t), dtype=np.float64),
    )
    return integration_error(plant.promoted(problem.unknown), states, problem.u, theta, fit.deviations, problem.log.dt)


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
    """Return a plant as written; of a transformation its source."""
    plant = plant_as_written(given)
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
