"""From a design to a monitor for data of any length."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.errors import SpecError
from obsynth.experiments.monitors.adaptive_monitor import EXACT, adaptive_plan, adaptive_statement, tolerances_of
from obsynth.experiments.monitors.adaptive_records_monitor import noisy_design
from obsynth.experiments.monitors.adaptive_rule import AdaptiveRule
from obsynth.experiments.monitors.monitor import KINDS, statement_of
from obsynth.experiments.monitors.online import OnlineMonitor, Rule
from obsynth.experiments.monitors.parameter_rules import PARAMETER_KINDS, ParameterRule
from obsynth.experiments.monitors.residual_model import ResidualModel, residual_model, watches_estimates
from obsynth.experiments.monitors.residual_monitor import bounds_of, require_options
from obsynth.experiments.monitors.residual_rules import NormRule, WhitenedRule
from obsynth.experiments.monitors.thresholds import samples_of, scaled_inputs, unlimited_bound, unlimited_paper
from obsynth.experiments.monitors.whitening import cusum_whitener, steady_mean, whitener_of, window_covariance
from obsynth.numerics.arguments import is_finite_number, require_kind, require_mapping
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.holds import first_order_hold
from obsynth.observers.dae.observer import DAEObserver
from obsynth.observers.decisions import WALKING_FORMS
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.plants.names import index_of
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario

_FORGOTTEN = ", once the error at the start, which is not stated, is forgotten (else give a longer warm-up)"
_AFTER_A_GAP = " (after a gap, too, while the error there is no larger than stated for the start)"
_NOT_CLOSER = "; rows must not be closer than the stated sample time, as noise drives the plant itself"
_REGULAR = ", for rows that are the stated sample time apart (none further apart, where they are not regular)"
_ANY_LENGTH = " (the run may have any length)"
_PARAMETER_STATEMENTS = {
    "chi-square": "distance of the parameters from their nominal values in the metric of their covariance: passed in a "
    "run without a change with at most the stated probability, for Gaussian noise as stated",
    "cusum": "cumulative sum of the whitened innovation for a change of the stated size: passed in a run without a "
    "change with at most the stated probability, for Gaussian noise as stated",
    "nis": "squared innovations of 20 samples: passed in a run that the model explains with at most the stated "
    "probability, for Gaussian noise as stated",
}


def online_monitor(
    design: ObserverDesign,
    kind: str = "pointwise",
    *,
    scenario: Scenario | None = None,
    disturbance_bounds: Mapping[str, float] | None = None,
    noise_bound: float | None = None,
    initial_error: float | None = None,
    gamma: float | None = None,
    window: int = 20,
    false_alarms: float = 0.01,
    change: float = 1.0,
    nominal: Mapping[str, float] | None = None,
    sample_time: float | None = None,
    constants: Any = None,
    initial_set: Mapping[str, Any] | None = None,
) -> OnlineMonitor:
    """Return a monitor for measured data, for `run_on_data`: its threshold holds however long the data are.

    Parameters
    ----------
    design : ObserverDesign
        Of any method.  Linear ones are watched by their residual, recursive ones by their parameters and innovations,
        nonlinear ones likewise (to first order, as their covariances).
    kind : {"pointwise", "paper", "window", "chi-square", "cusum", "nis"}, optional
        The first three for linear designs, as for `obsynth.monitor`; ``nis`` for the others (all that the model does
        not explain), where ``chi-square`` is on the parameters against their nominal values.
    scenario : Scenario, optional
        Linear designs: whose disturbances and noise are those to be expected; its length, start, inputs and faults do
        not count.  Without one, the noise is the plant's own, once, and disturbances need bounds.
    disturbance_bounds, noise_bound, gamma
        As for `obsynth.monitor`.
    initial_error : float, optional
        Bound on the norm of the observer's error at the start, and after each gap; without one the bounds hold once it
        is forgotten.
    window : int, optional
        Samples that ``window``, ``chi-square`` and ``cusum`` of linear designs look back.
    false_alarms : float, optional
        For the statistical kinds: probability of a false alarm in a whole run, at most, however long it is.
    change : float, optional
        For ``cusum``: shift it is tuned for, in standard deviations of the whitened residual (linear designs), or in
        parameter units.
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

    Returns
    -------
    OnlineMonitor
        With a sentence that says what its threshold means.

    Raises
    ------
    SpecError
        The kind does not go with the design, an option is out of range, or a signal has no bound or covariance.
    PreconditionError
        No bound exists over the tolerances: the message says why.
    """
    require_kind(design, ObserverDesign, "design", "an ObserverDesign, such as obsynth.load(path)")
    if scenario is not None:
        require_kind(scenario, Scenario, "scenario", "an obsynth.Scenario")
    for name, given in (("disturbance_bounds", disturbance_bounds), ("nominal", nominal)):
        require_mapping(given, name)
    require_options(noise_bound, initial_error, gamma, window, false_alarms, change, 0)
    if isinstance(design.observer, (RecursiveObserver, DAEObserver)):
        return _of_parameters(design.observer, kind, nominal or {}, change, false_alarms)
    if kind not in KINDS:
        hint = " glr is a decision on parameters, which a linear design has none of: cusum is nearest to it."
        raise SpecError(
            f"kind is {kind!r}: for this design use one of {', '.join(KINDS)}.{hint if kind == 'glr' else ''}",
            path="kind",
        )
    if nominal:
        raise SpecError("nominal is for recursive designs, which estimate parameters.", path="nominal")
    design, adaptive = tolerances_of(design, kind, constants, initial_set, initial_error)
    estimates = watches_estimates(design) and kind in ("pointwise", "window")
    model, dt = _endless_model(design, scenario, window, sample_time, estimates=estimates)
    bounds = bounds_of(design, model, disturbance_bounds)
    if scenario is None:
        stated = [name in (disturbance_bounds or {}) for name in design.linear[0].disturbance_names]
        bounds = np.where(np.array(stated, dtype=bool), bounds, np.inf)
    start = 0.0 if initial_error is None else float(initial_error)
    rule: Rule
    irregular = None
    if kind in ("pointwise", "window", "paper"):
        if kind == "paper":
            table, limit = unlimited_paper(model, bounds, start, gamma)
        else:
            table, limit = unlimited_bound(kind, model, scaled_inputs(model, bounds, noise_bound), start, window)
            if model.flow is not None:
                inputs = scaled_inputs(model, bounds, noise_bound, any_stamps=True)
                irregular = unlimited_bound(kind, model, inputs, start, window)
        if not limit > 0.0:
            raise SpecError(
                "As stated, no disturbance and no noise reaches the residual: its bound would be zero, which rounding "
                "passes. State noise (noise_bound, sensor_noise of the plant), or give a level of your own "
                "(thresholds).",
                path="noise_bound",
            )  # fmt: skip
        watched, driven = None, None
        if estimates:
            watched = design.linear[1].fault_rows
        if kind != "paper" and model.continuous is not None and design.linear[0].nu:
            driven = model.continuous.between.input_response(model.continuous.observer)
        norm = NormRule(
            table, limit, window=window if kind == "window" else 1, dt=dt, irregular=irregular, watched=watched,
            driven=driven,
        )  # fmt: skip
        if adaptive:
            return _adaptive(design, scenario, norm, model, bounds, noise_bound, initial_error, initial_set, dt)
        rule = norm
        ending = _FORGOTTEN if initial_error is None else _AFTER_A_GAP
    else:
        rule = _whitened(kind, model, bounds if scenario is None else None, window, change, false_alarms, dt)
        ending = _ANY_LENGTH
    if kind in ("pointwise", "window") and model.sensor_noise is not None:
        # The noise of the plant itself is what is gathered between samples: the closer they are, the less, but in all
        # the more of it that is of one sign.
        ending += _NOT_CLOSER if model.Bw[:, model.sensor_noise[0].shape[1] :].any() else ""
    if kind in ("pointwise", "window") and model.continuous is not None:
        ending += _REGULAR + model.continuous.between.lasting_words(limit)
    promised = statement_of(
        kind, continuous=model.flow is not None, sampled=model.sampled is not None, estimates=estimates
    )
    statement = promised + ending + EXACT
    return OnlineMonitor(
        kind, statement, rule, residuals=len(design.linear[1].residual_names), fault_names=design.linear[1].fault_names,
        fault_scales=model.fault_scales(),
    )  # fmt: skip


def _adaptive(
    design: ObserverDesign, scenario: Scenario | None, norm: NormRule, model: ResidualModel, bounds: FloatArray,
    noise_bound: float | None, initial_error: float | None, initial_set: Mapping[str, Any] | None, dt: float,
) -> OnlineMonitor:  # fmt: skip
    """Return the monitor whose threshold holds for every plant within its tolerances."""
    first, later = adaptive_plan(
        noisy_design(design, scenario),
        bounds,
        noise_bound or 0.0,
        initial_error=initial_error,
        initial_set=initial_set,
        sample_time=dt,
    )
    start = _FORGOTTEN if initial_error is None and initial_set is None else _AFTER_A_GAP if initial_set is None else (
        "; it holds from the first row on, and after a gap once the error there is forgotten"
    )  # fmt: skip
    return OnlineMonitor(
        "pointwise", adaptive_statement(first, design) + start, AdaptiveRule(first, later, norm),
        residuals=len(model.C), fault_names=design.linear[1].fault_names, fault_scales=model.fault_scales(),
    )  # fmt: skip


def _endless_model(
    design: ObserverDesign, scenario: Scenario | None, window: int, sample_time: float | None, *, estimates: bool
) -> tuple[ResidualModel, float]:
    """Return a model with as many samples as an error at the start needs to be forgotten, and their distance."""
    plant, observer = design.linear
    if plant.is_discrete and sample_time is not None:
        raise SpecError("sample_time is for continuous designs: this one is sampled already.", path="sample_time")
    asked = sample_time if sample_time is not None or scenario is None else scenario.sample_time
    dt = plant.dt if plant.is_discrete else asked
    if dt is None or not (is_finite_number(dt) and dt > 0.0):
        raise SpecError("A continuous design needs the sample_time of its data, in seconds, for a threshold.",
                        path="sample_time")  # fmt: skip
    transition = observer.Az if plant.is_discrete else first_order_hold(observer.Az, observer.By, dt)[0]
    steps = samples_of(transition, window)
    expected = Scenario(horizon=dt, noise=1.0 if plant.nw else 0.0) if scenario is None else scenario
    expected = expected.replace(
        horizon=(steps - 0.5) * dt, sample_time=None if plant.is_discrete else dt, inputs={}, faults={}, sensors={},
        initial_state={}, observer_state=None, stabilise=False,
    )  # fmt: skip
    return residual_model(design, expected, endless=True, estimates=estimates), dt


def _whitened(
    kind: str, model: ResidualModel, unknown: FloatArray | None, window: int, change: float, false_alarms: float,
    dt: float,
) -> WhitenedRule:  # fmt: skip
    reached = model.Bd.any(axis=0) | model.Dd.any(axis=0)
    if unknown is not None and reached.any():
        raise SpecError(
            f"{kind} needs to know what disturbances are to be expected: give a scenario (a spec with one), or use "
            "pointwise with disturbance bounds.", path="disturbances",
        )  # fmt: skip
    white = True
    if kind == "chi-square":
        whitener = whitener_of(window_covariance(model, window))
    else:
        whitener, white = cusum_whitener(model, window)
    return WhitenedRule(
        whitener, steady_mean(model), window=window, change=None if kind == "chi-square" else change,
        false_alarms=false_alarms, dt=dt, white=white,
    )  # fmt: skip


def _whole_record(observer: RecursiveObserver | DAEObserver) -> str:
    """Return why a likelihood ratio is not among the monitors, and what to use instead."""
    why = " glr compares every time at which a change may have begun, which takes a whole record"
    if isinstance(observer, DAEObserver):
        return f"{why}, and regressors, which a nonlinear design does not have: chi-square, cusum or nis serve here."
    if observer.adaptation is None or observer.adaptation.form == "random-walk":
        return f"{why}, and regressors, which this design does not have: chi-square or nis serve here."
    return f"{why}: obsynth.decide(..., statistic='glr') has it for recorded estimates; row by row, use cusum."


def _of_parameters(
    observer: RecursiveObserver | DAEObserver, kind: str, nominal: Mapping[str, float], change: float,
    false_alarms: float,
) -> OnlineMonitor:  # fmt: skip
    if kind not in PARAMETER_KINDS:
        hint = _whole_record(observer) if kind == "glr" else ""
        raise SpecError(
            f"kind is {kind!r}: for a recursive or nonlinear design use one of {', '.join(PARAMETER_KINDS)}.{hint}",
            path="kind",
        )
    names = observer.fault_names
    if isinstance(observer, DAEObserver):
        start, residuals, form = observer.initial_parameters, observer.model.ny, observer.form
    else:
        adaptation, plant = observer.adaptation, observer.plant
        start = np.zeros(0) if adaptation is None else adaptation.initial_parameters
        residuals, form = plant.ne + plant.ny - plant.nx, "" if adaptation is None else adaptation.form
    theta = np.array(start, dtype=np.float64)
    for name, value in nominal.items():
        place = index_of(name, names, what="nominal")
        if not is_finite_number(value):
            raise SpecError(f"The nominal value of {name!r} is {value!r}: give a finite number.", path="nominal")
        theta[place] = float(value)
    if kind != "nis" and not len(theta):
        raise SpecError(f"{kind} watches parameters, and this design estimates none: use nis.", path="kind")
    if kind == "cusum" and form in WALKING_FORMS:
        raise SpecError(f"cusum needs regressors, which a {form} design does not have: use chi-square or nis.",
                        path="kind")  # fmt: skip
    rule = ParameterRule(kind, theta, np.full(len(theta), float(change)), false_alarms)
    return OnlineMonitor(
        kind, _PARAMETER_STATEMENTS[kind] + _ANY_LENGTH, rule, residuals=residuals, fault_names=names,
        fault_scales=np.ones(len(names)),
    )  # fmt: skip
