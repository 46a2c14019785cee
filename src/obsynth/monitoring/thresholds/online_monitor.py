"""From a design to a monitor for data of any length."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.monitoring.thresholds.adaptive_monitor import NO_TOLERANCE, noisy_design, over_box, tolerances_of
from obsynth.monitoring.thresholds.checked_options import checked_options
from obsynth.monitoring.thresholds.continuous_region_bounds import continuous_region_bound
from obsynth.monitoring.thresholds.gap_growth import GapGrowth, gap_growth
from obsynth.monitoring.thresholds.guaranteed import data_monitor
from obsynth.monitoring.thresholds.learned import LearnedThresholds, load_thresholds
from obsynth.monitoring.thresholds.learned_rule import learned_monitor
from obsynth.monitoring.thresholds.learning import learn_thresholds
from obsynth.monitoring.thresholds.monitor import MONITOR_KINDS, STATEMENTS, Monitor, Rule, statement_of
from obsynth.monitoring.thresholds.options import DISTURBANCES, LINEAR_OPTIONS, PARAMETER_OPTIONS
from obsynth.monitoring.thresholds.parameter_rule import parameter_monitor
from obsynth.monitoring.thresholds.region_bounds import region_bound
from obsynth.monitoring.thresholds.residual_model import (
    ResidualModel,
    largest_disturbances,
    residual_model,
)
from obsynth.monitoring.thresholds.residual_monitor import RESIDUAL_ROUNDING_SHARE, bounds_of, require_no_region
from obsynth.monitoring.thresholds.residual_norm_bounds import (
    samples_of,
    scaled_inputs,
    unlimited_bound,
    unlimited_paper,
)
from obsynth.monitoring.thresholds.rules import ANY_LENGTH, NormRule, WhitenedRule
from obsynth.monitoring.thresholds.watched_rows import Watched, watched_by
from obsynth.monitoring.thresholds.whitening import steady_mean, whitened
from obsynth.numerics.arguments import arguments_checked, chosen, is_finite_number
from obsynth.numerics.arrays import SMALLEST, FloatArray
from obsynth.numerics.continuous import first_order_hold
from obsynth.numerics.suggestions import suggestion
from obsynth.observers.nonlinear.observer import DAEObserver
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.constants import shown
from obsynth.plants.noise import is_noise_assumed, require_noise
from obsynth.results.design import ObserverDesign, require_verified
from obsynth.simulation.scenario import Scenario
from obsynth.verification.assumptions import Assumptions
from obsynth.verification.error_system import ErrorModel

_AFTER_WARM_UP = "; it holds once the initial-condition response has settled (the warm-up)"

_AFTER_A_GAP = " (after a gap likewise)"

_FROM_THE_FIRST = "; from the first row on; after gaps, once settled"

_AFTER_OUT = _AFTER_WARM_UP + " (after a gap, and after rows outside the region, likewise)"

_FROM_THE_FIRST_INSIDE = "; from the first row on; after gaps, and after rows outside the region, once settled"

#: A note of every monitor whose noise is none that somebody stated.
NOISE_ASSUMED = "; noise of deviation 1 is assumed on every sensor, as none is stated"

#: Of a design over a region in continuous time.
_MOVING = (
    ", for every course of {names} in the region; disturbances move within their bounds between rows, known inputs and "
    "{names} stay between their values at both; the threshold follows the rows, as what a step from one to the next "
    "misses of the plant's motion does"
)

_GROWS = "; after missing outputs it is larger by the possible error of the plant's model"

_WAITS = "; until the effect of a gap has settled nothing is decided, as {reason}"

_NOT_CLOSER = "; rows are no closer than {dt} s"

_JITTERING = "; stamps that jitter by up to a fifth of the interval are taken as regular"

_UNEVEN = "; while rows are not equally far apart there is no bound"

_REGULAR = "; no row is further than {dt} s from the last"


@arguments_checked
def online_monitor(
    design: ObserverDesign,
    kind: str | LearnedThresholds = "pointwise",
    *,
    scenario: Scenario | None = None,
    disturbance_bounds: Mapping[str, float] | None = None,
    noise_bound: float | None = None,
    initial_error: float | None = None,
    gamma: float | None = None,
    window: int | None = None,
    false_alarms: float | None = None,
    change: float | None = None,
    nominal: Mapping[str, float] | None = None,
    sample_time: float | None = None,
    constants: Any = None,
    initial_set: Mapping[str, Any] | None = None,
    normal: Any = None,
    unverified: bool = False,
    disturbance: Literal["any", "held"] = "any",
    sensor_faults: bool = True,
) -> Monitor:
    """Return a monitor for measured data, for `run_on_data`: its threshold holds however long the data are.

    Parameters
    ----------
    design : ObserverDesign
        Of any method.  Linear ones are monitored by their residual, recursive ones by their parameters and innovations,
        nonlinear ones likewise (to first order, as their covariances).
    kind : {"pointwise", "paper", "window", "chi-square", "cusum", "nis", "learned"}, optional
        The first three for linear designs, as for `obsynth.monitor`; ``nis`` for the others (all that the model does
        not explain), where ``chi-square`` is on the parameters against their nominal values.  ``learned``, for every
        design: from rows without faults, whatever the model assumes of noise.  Thresholds that were learned may stand
        here themselves: `online_monitor(design, thresholds)`.
    scenario : Scenario, optional
        Linear designs: whose disturbances and noise are those to be expected; its length, start, inputs and faults do
        not count.  Without one, the noise is the plant's own, once, and disturbances need bounds.
    disturbance_bounds, noise_bound, gamma
        As for `obsynth.monitor`.
    initial_error : float, optional
        Bound on the norm of the observer's error at the start, and after each gap; without one the bounds hold once its
        effect has settled.
    window : int, optional
        Samples that ``window``, ``chi-square`` and ``cusum`` of linear designs look back; 20 by default.
    false_alarms : float, optional
        For the statistical kinds: probability of a false alarm in a whole run, at most, however long it is; 0.01 by
        default.
    change : float, optional
        For ``cusum``: shift it is tuned for, in standard deviations of the whitened residual (linear designs), or in
        parameter units; 1 by default.
    nominal : mapping, optional
        Nominal value of parameters by name; those at the observer's start by default.
    sample_time : float, optional, seconds
        Continuous designs: between the rows of the data; the scenario's by default.
    constants : mapping, ConstantsBox, Uncertainty or DescriptorSystem, optional
        ``pointwise``, linear designs: tolerances as `obsynth.uncertain_system` takes them; those of the
        design's plant by ``plant.uncertainty``.  The threshold adapts to the signals and holds for every plant within
        them; without, it assumes an exact model (but ``obsynth run`` takes the plant's own).  Continuous designs need
        rows ``sample_time`` apart and known inputs that are held between them.  Columns of `run_on_data` tell
        thresholds, guaranteed intervals of faults, and shares of the constants.
    initial_set : mapping, optional
        ``pointwise``, linear designs: bounds of the plant's states at the first row (deviations), each a
        number or ``[low, high]``; the threshold then holds from the first row on, for the plant's own tolerances where
        no others are given.
    normal : LearnedThresholds, path or pandas.DataFrame, optional
        ``learned``: from `obsynth.learn_thresholds`, the file in which they were saved (``.json``), or a log without
        faults, whose rate is one false alarm per 1,000 rows.
    unverified : bool, optional
        Whether a design whose report fails is watched all the same; nothing is promised then.
    disturbance : {"any", "held"}, optional
        ``pointwise`` and ``window``: what disturbances do between the samples of a plant that was sampled from a
        continuous one: anything within their bounds, or nothing, which the statement then repeats.  Of a plant in
        discrete time they are held; for guaranteed tests an option of their design.
    sensor_faults : bool, optional
        ``learned``: whether an alarm may be a fault of any measured output (``sensor NAME``), or none of these faults,
        beside those of the design: all are ranked by posterior shares, of linear designs and of the nonlinear form
        ``augmented-kalman``.  Other designs, and exported code, name the faults of the design alone.

    Returns
    -------
    Monitor
        With a sentence that says what its threshold means.

    Raises
    ------
    SpecError
        The kind does not go with the design, an option is out of range or does nothing for this kind, or a signal has
        no bound or covariance.
    PreconditionError
        No bound exists over the tolerances: the message says why.
    VerificationError
        The report of the design fails.

    Examples
    --------
    >>> import obsynth
    >>> import numpy as np
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> monitor = obsynth.online_monitor(design, disturbance_bounds={"d1": 0.1}, initial_error=0.0)
    >>> monitor.kind
    'pointwise'
    """
    require_verified(design, unverified=unverified)
    if isinstance(kind, LearnedThresholds):
        if normal is not None:
            raise SpecError("The thresholds stand in the place of kind: leave normal out.", path="normal")
        kind, normal = "learned", kind
    recursive = isinstance(design.observer, (RecursiveObserver, DAEObserver))
    options = {
        "scenario": scenario, "disturbance_bounds": disturbance_bounds, "noise_bound": noise_bound,
        "initial_error": initial_error, "gamma": gamma, "window": window, "false_alarms": false_alarms,
        "change": change, "sample_time": sample_time, "constants": constants, "initial_set": initial_set,
        "normal": normal, "sensor_faults": None if sensor_faults else False,
        "disturbance": None if chosen(disturbance, "disturbance", DISTURBANCES) == "any" else "held",
    }  # fmt: skip
    window, false_alarms, change = checked_options(PARAMETER_OPTIONS if recursive else LINEAR_OPTIONS, kind, options)
    if kind == "learned":
        return _learned(design, normal, sensor_faults=sensor_faults)
    if isinstance(design.observer, (RecursiveObserver, DAEObserver)):
        return parameter_monitor(design.observer, kind, nominal or {}, change, false_alarms)
    if isinstance(design.observer, ScheduledObserver) and kind == "pointwise":
        return _over_region(design, options)
    require_no_region(design, kind)
    _require_linear_kind(kind, nominal)
    if is_guaranteed(design):
        return data_monitor(design, kind, options)
    return _of_linear_design(
        design, kind, {**options, "window": window, "false_alarms": false_alarms, "change": change}
    )


def _of_linear_design(design: ObserverDesign, kind: str, options: Mapping[str, Any]) -> Monitor:
    """Return the monitor of a linear design, for tolerances where the plant or the options have any."""
    scenario, noise_bound, initial_error = options["scenario"], options["noise_bound"], options["initial_error"]
    disturbance = options["disturbance"] or "any"
    design, adaptive = tolerances_of(design, options["constants"], options["initial_set"], initial_error)
    watched = watched_by(design, kind)
    model, dt = _endless_model(design, scenario, options["window"], options["sample_time"], watched=watched)
    model = model.held() if disturbance == "held" else model
    require_noise(noise_bound, noisy=model.noisy)
    bounds = _known_bounds(design, model, options["disturbance_bounds"], scenario)
    noisy = noisy_design(design, scenario)
    limited = kind in ("pointwise", "window")

    def made(statement: str, rule: Rule) -> Monitor:
        return Monitor(
            kind,
            statement + (NOISE_ASSUMED if is_noise_assumed(noisy.linear[0].noise_names) else ""),
            rule,
            residuals=len(design.linear[1].residual_names),
            fault_names=design.linear[1].fault_names,
            fault_scales=model.fault_scales(),
            watched=watched,
        )

    numbers = {"window": options["window"], "false_alarms": options["false_alarms"], "change": options["change"]}
    rule: Rule
    if limited or kind == "paper":
        start = 0.0 if initial_error is None else float(initial_error)
        norm, limit = _norm_rule(
            design, kind, model, bounds, noise_bound, start, options["gamma"], options["window"], dt, watched
        )
        if adaptive:
            initial_set = options["initial_set"]
            rule, promise = over_box(
                noisy, norm, bounds, noise_bound, initial_error, initial_set, sample_time=dt, disturbance=disturbance
            )
            first = _AFTER_WARM_UP if initial_error is None else _AFTER_A_GAP
            return made(promise + (first if initial_set is None else _FROM_THE_FIRST), rule)
        _require_above_rounding(kind, limit, model, bounds)
        gaps = gap_growth(model, bounds, noise_bound) if kind == "pointwise" else ""
        rule = norm.over_gaps(gaps) if isinstance(gaps, GapGrowth) else norm
        ending = _ending(kind, model, norm, limit, gaps, dt, from_the_first=initial_error is not None)
    else:
        rule = _whitened(kind, model, bounds if scenario is None else None, watched, **numbers, dt=dt)
        ending = ANY_LENGTH + (_JITTERING if model.continuous is not None else "")
    assumed = Assumptions(noisy.linear[0], bounds, noise_bound or 0.0, initial_error=initial_error) if limited else None
    return made(statement_of(kind, model, assumed, watched=watched, **numbers, dt=dt) + ending + NO_TOLERANCE, rule)


def _over_region(design: ObserverDesign, options: Mapping[str, Any]) -> Monitor:
    """Return the monitor of a scheduled design, whose bound holds for every course of its parameters."""
    unsupported = ("scenario", "gamma", "sample_time", "constants", "initial_set")
    if stated := [name for name in unsupported if options[name] is not None]:
        raise SpecError(
            f"{stated[0]} is not for designs over a region: give disturbance_bounds, noise_bound and initial_error.",
            path=stated[0],
        )
    if design.scheduled[0].is_discrete:
        return _over_sampled_region(design, options)
    return _over_continuous_region(design, options)


def _over_continuous_region(design: ObserverDesign, options: Mapping[str, Any]) -> Monitor:
    noise_bound, start = options["noise_bound"], options["initial_error"]
    found = continuous_region_bound(design, options["disturbance_bounds"], noise_bound, start)
    _require_above("pointwise", found.limit, found.errors, found.C, found.bounds)
    plant, observer = design.scheduled
    first, names = plant.vertices[0], ", ".join(plant.scheduling.names)
    assumed = Assumptions(first, found.bounds, noise_bound or 0.0, initial_error=start).bounds_phrase
    return Monitor(
        "pointwise",
        f"{STATEMENTS['pointwise']}{f', with {assumed}' if assumed else ''}{_MOVING.format(names=names)}"
        + (_AFTER_OUT if start is None else _FROM_THE_FIRST_INSIDE)
        + (NOISE_ASSUMED if is_noise_assumed(first.noise_names) else "")
        + NO_TOLERANCE,
        found.rule,
        residuals=len(observer.residual_names),
        fault_names=observer.fault_names,
        fault_scales=found.fault_scales,
    )


def _over_sampled_region(design: ObserverDesign, options: Mapping[str, Any]) -> Monitor:
    noise_bound, start = options["noise_bound"], options["initial_error"]
    (table, limit), model, bounds = region_bound(design, options["disturbance_bounds"], noise_bound, start)
    require_noise(noise_bound, noisy=model.noisy)
    _require_above_rounding("pointwise", limit, model, bounds)
    plant, observer = design.scheduled
    assumed = Assumptions(plant.vertices[0], bounds, noise_bound or 0.0, initial_error=start)
    return Monitor(
        "pointwise",
        statement_of("pointwise", model, assumed, watched=Watched.RESIDUALS)
        + f", for every course of {', '.join(plant.scheduling.names)} in the region"
        + (_AFTER_OUT if start is None else _FROM_THE_FIRST_INSIDE)
        + (NOISE_ASSUMED if is_noise_assumed(plant.vertices[0].noise_names) else "")
        + NO_TOLERANCE,
        NormRule(table, limit, window=1, dt=plant.dt),
        residuals=len(observer.residual_names),
        fault_names=observer.fault_names,
        fault_scales=model.fault_scales(),
    )


def _learned(design: ObserverDesign, normal: Any, *, sensor_faults: bool) -> Monitor:
    """Return the monitor of thresholds that were learned, or are to be."""
    if normal is None:
        raise SpecError(
            "learned needs rows without faults: give a log, or what obsynth thresholds wrote (normal, --normal).",
            path="normal",
        )
    if isinstance(normal, (str, Path)) and Path(normal).suffix.lower() == ".json":
        normal = load_thresholds(normal)
    if not isinstance(normal, LearnedThresholds):
        try:
            normal = learn_thresholds(design, normal)
        except SpecError as error:
            if not (error.path or "").startswith("columns."):
                raise
            raise SpecError(
                f"{error} A monitor takes no such option for its rows without faults: learn from them first "
                "(obsynth thresholds, obsynth.learn_thresholds), and give the result (normal, --normal).",
                path=error.path,
            ) from error
    return learned_monitor(design, normal, sensor_faults=sensor_faults)


def _require_linear_kind(kind: str, nominal: Mapping[str, float] | None) -> None:
    if kind not in MONITOR_KINDS:
        hint = " glr is a decision on parameters, which a linear design has none of: cusum is nearest to it."
        raise SpecError(
            f"The monitor {kind!r} is not for this design: use one of {', '.join(MONITOR_KINDS)}, learned."
            f"{hint if kind == 'glr' else suggestion(kind, (*MONITOR_KINDS, 'learned'))}",
            path="kind",
        )
    if nominal:
        raise SpecError("nominal is for recursive designs, which estimate parameters.", path="nominal")


def _require_above_rounding(kind: str, limit: float, model: ResidualModel, bounds: FloatArray) -> None:
    """Refuse a bound that rounding of what it is made of would pass: of disturbances that cancel."""
    _require_above(kind, limit, model.errors, model.C, bounds)


def _require_above(kind: str, limit: float, errors: ErrorModel, C: FloatArray, bounds: FloatArray) -> None:
    # They come by the states, of which a row may show others than those that they enter.
    into_error = np.abs(errors.own) @ np.abs(errors.plant.Bd) @ np.where(np.isfinite(bounds), bounds, 0.0)
    size = float(np.linalg.norm(C, 2) * np.linalg.norm(into_error))
    # Of nothing at all, what is left is what zero is rounded up to.
    if not limit > max(RESIDUAL_ROUNDING_SHARE * size, SMALLEST):
        raise SpecError(
            "As stated, no disturbance reaches the residual, and (66) bounds nothing else: use pointwise, which bounds "
            "noise too, or give a threshold yourself (thresholds)."
            if kind == "paper"
            else "As stated, no disturbance and no noise reaches the residual: its bound would be zero but for "
            "rounding, which exceeds it. State noise (noise_bound, sensor_noise of the plant), or give a threshold "
            "yourself (thresholds).",
            path="kind" if kind == "paper" else "noise_bound",
        )


def _norm_rule(
    design: ObserverDesign,
    kind: str,
    model: ResidualModel,
    bounds: FloatArray,
    noise_bound: float | None,
    start: float,
    gamma: float | None,
    window: int,
    dt: float,
    watched: Watched,
) -> tuple[NormRule, float]:
    """Return the rule of a bound on the norm of the residual, or of the fault estimates, and the bound in the end."""
    irregular = None
    if kind == "paper":
        table, limit = unlimited_paper(model, bounds, start, gamma)
    else:
        plant = design.linear[0]
        table, limit = unlimited_bound(kind, model, scaled_inputs(model, bounds, noise_bound, plant), start, window)
        if model.continuous is not None:
            inputs = scaled_inputs(model, bounds, noise_bound, plant, any_stamps=True)
            irregular = unlimited_bound(kind, model, inputs, start, window)
    driven = None
    if kind != "paper" and model.continuous is not None and design.linear[0].nu:
        driven = model.continuous.between.input_response(model.continuous.observer)
    rule = NormRule(
        table,
        limit,
        window=window if kind == "window" else 1,
        dt=dt,
        irregular=irregular,
        watched=None if watched is Watched.RESIDUALS else watched.rows(design.linear[1]),
        driven=driven,
    )
    return rule, limit


def _known_bounds(
    design: ObserverDesign, model: ResidualModel, stated: Mapping[str, float] | None, scenario: Scenario | None
) -> FloatArray:
    """Return the largest absolute value of each disturbance ``(nd,)``: infinite where nothing states it."""
    bounds = bounds_of(design, model, stated)
    if scenario is not None:
        return bounds
    is_stated = [name in (stated or {}) for name in design.linear[0].disturbance_names]
    return np.where(np.array(is_stated, dtype=bool), bounds, np.inf)


def _ending(
    kind: str,
    model: ResidualModel,
    norm: NormRule,
    limit: float,
    gaps: GapGrowth | str,
    dt: float,
    *,
    from_the_first: bool,
) -> str:
    """Return the end of the statement of a bound: from when it holds, for which stamps, and what happens in gaps."""
    ending = (_AFTER_A_GAP if from_the_first else _AFTER_WARM_UP) + _more_words(kind, model, limit, dt)
    ending += _UNEVEN * bool(norm.irregular is not None and np.isinf(norm.irregular[1]))
    return ending + (_WAITS.format(reason=gaps) if isinstance(gaps, str) and gaps else _GROWS * bool(gaps))


def _more_words(kind: str, model: ResidualModel, limit: float, dt: float) -> str:
    """Return what else the sentence of a bound must say."""
    if kind == "paper" or model.continuous is None:
        return ""
    # The noise of the plant itself is what is gathered between samples: the closer they are, the less, but in all the
    # more of it that is of one sign.
    is_gathered = bool(model.Bw[:, model.continuous.sensors.sum() :].any())
    return (
        _NOT_CLOSER.format(dt=shown(dt)) * is_gathered
        + _REGULAR.format(dt=shown(dt))
        + model.continuous.between.lasting_words(limit)
    )


def _endless_model(
    design: ObserverDesign, scenario: Scenario | None, window: int, sample_time: float | None, *, watched: Watched
) -> tuple[ResidualModel, float]:
    """Return a model with as many samples as an error at the start needs to decay, and their distance."""
    plant, observer = design.linear
    if plant.is_discrete and sample_time is not None:
        raise SpecError("sample_time is for continuous designs: this one is sampled already.", path="sample_time")
    stated_time = sample_time if sample_time is not None or scenario is None else scenario.sample_time
    dt = plant.dt if plant.is_discrete else stated_time
    if dt is None or not (is_finite_number(dt) and dt > 0.0):
        raise SpecError(
            "A continuous design needs the sample_time of its data, in seconds, for a threshold.", path="sample_time"
        )
    transition = observer.Az if plant.is_discrete else first_order_hold(observer.Az, observer.By, dt)[0]
    steps = samples_of(transition, window)
    expected = Scenario(horizon=dt, noise=1.0 if plant.nw else 0.0) if scenario is None else scenario
    expected = expected.replace(
        horizon=(steps - 0.5) * dt,
        sample_time=None if plant.is_discrete else dt,
        inputs={},
        faults={},
        sensors={},
        initial_state={},
        observer_state=None,
        stabilise=False,
    )
    model = residual_model(design, expected, endless=True, watched=watched)
    if scenario is None:
        return model, dt
    return replace(model, bounds=largest_disturbances(scenario, plant.disturbance_names, dt)), dt


def _whitened(
    kind: str,
    model: ResidualModel,
    unknown: FloatArray | None,
    watched: Watched,
    *,
    window: int,
    change: float,
    false_alarms: float,
    dt: float,
) -> WhitenedRule:
    reached = model.Bd.any(axis=0) | model.Dd.any(axis=0)
    if unknown is not None and reached.any():
        raise SpecError(
            f"{kind} needs to know what disturbances are to be expected: give a scenario (a spec with one, --system), "
            "or use pointwise with disturbance bounds.",
            path="disturbances",
        )
    whitener, white = whitened(kind, model, window, watched)
    return WhitenedRule(
        whitener,
        steady_mean(model),
        window=window,
        change=None if kind == "chi-square" else change,
        false_alarms=false_alarms,
        dt=dt,
        white=white,
        watched=None if watched is Watched.RESIDUALS else watched.rows(model.errors.observer),
    )
