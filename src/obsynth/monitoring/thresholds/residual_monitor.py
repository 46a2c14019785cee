"""From a design and a scenario to a monitor of the residual."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np

from obsynth.errors import SpecError
from obsynth.methods.guaranteed_test.method import is_guaranteed
from obsynth.monitoring.thresholds.adaptive_monitor import NO_TOLERANCE, noisy_design, over_box, tolerances_of
from obsynth.monitoring.thresholds.checked_options import checked_options
from obsynth.monitoring.thresholds.guaranteed import record_monitor
from obsynth.monitoring.thresholds.monitor import MONITOR_KINDS, Monitor, Rule, statement_of
from obsynth.monitoring.thresholds.options import DISTURBANCES, LINEAR_OPTIONS
from obsynth.monitoring.thresholds.residual_model import ResidualModel, residual_model
from obsynth.monitoring.thresholds.residual_norm_bounds import (
    norms_of_windows,
    paper_threshold,
    pointwise_threshold,
    scaled_inputs,
    window_threshold,
)
from obsynth.monitoring.thresholds.rules import NormRule, WhitenedRule
from obsynth.monitoring.thresholds.watched_rows import Watched, watched_by
from obsynth.monitoring.thresholds.whitening import settled, steady_mean, whitened
from obsynth.numerics.arguments import arguments_checked, chosen, real_number
from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.observers.nonlinear.region_observer import RegionObserver
from obsynth.observers.outliers import chi_square_limit
from obsynth.observers.scheduled.observer import ScheduledObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import index_of
from obsynth.results.design import ObserverDesign, require_verified
from obsynth.simulation.benches import Bench, make_bench
from obsynth.simulation.scenario import Scenario, observer_start
from obsynth.verification.assumptions import Assumptions

#: What rounding may add to a residual, relative to the terms it is made of.
RESIDUAL_ROUNDING_SHARE = 1e-10


@arguments_checked
def monitor(
    design: ObserverDesign,
    scenario: Scenario,
    kind: str = "pointwise",
    *,
    disturbance_bounds: Mapping[str, float] | None = None,
    noise_bound: float | None = None,
    initial_error: float | None = None,
    gamma: float | None = None,
    window: int | None = None,
    false_alarms: float | None = None,
    change: float | None = None,
    isolation_delay: int = 0,
    constants: Any = None,
    initial_set: Mapping[str, Any] | None = None,
    unverified: bool = False,
    disturbance: Literal["any", "held"] = "any",
) -> Monitor:
    """Return a threshold for the residual of a linear design, and the statistic it belongs to.

    Parameters
    ----------
    design : ObserverDesign
        Of a linear method, with residuals.
    scenario : Scenario
        Its length, sampling, inputs, start, disturbances and noise count; its faults do not.
    kind : {"pointwise", "paper", "window", "chi-square", "cusum"}, optional
        ``pointwise``: norm of the residual against its l1 (peak) bound, never passed without a fault.  ``paper``: the
        same norm against (66) with the norm of the power, which is not a pointwise bound.  ``window``: l2 norm over a
        window against the l2 gain and the energy of the error at its start.  ``chi-square``: a window of residuals in
        the metric of its covariance.  ``cusum``: cumulative sums of the whitened residual, for small changes.
    disturbance_bounds : mapping, optional
        Largest absolute value of disturbances by name; those of the scenario by default.
    noise_bound : float, optional
        Standard deviations that no component of the noise exceeds; needed by ``pointwise`` and ``window`` where the
        scenario has noise.
    initial_error : float, optional
        Bound on the norm of the observer's error at the start (``V E x - z``, with the tracking map V of the
        certificate); that of the scenario by default.
    gamma : float, optional
        For ``paper``: l2 gain from the disturbances to the residual; computed by default.
    window : int, optional
        Samples that ``window``, ``chi-square`` and ``cusum`` look back; 20 by default.
    false_alarms : float, optional
        For ``chi-square`` and ``cusum``: probability of a false alarm in a whole run, at most; 0.01 by default.
    change : float, optional
        For ``cusum``: shift it is tuned for, in standard deviations of the whitened residual; 1 by default.
    isolation_delay : int, optional
        Samples from an alarm to the comparison of the fault estimates, where these answer later than the residual.
    constants, initial_set : mapping, optional
        ``pointwise``, discrete designs: tolerances and the plant's start, as for `obsynth.online_monitor`.  With either
        of them the monitor adapts to the signals (see `obsynth.evaluate`); the start is the scenario's own by
        default.
    unverified : bool, optional
        Whether a design whose report fails is watched all the same; nothing is promised then.
    disturbance : {"any", "held"}, optional
        ``pointwise`` and ``window``: what disturbances do between the samples of a plant that was sampled from a
        continuous one: anything within their bounds, or nothing, which the statement then repeats.  Of a plant in
        discrete time they are held; for guaranteed tests an option of their design.

    Returns
    -------
    Monitor
        With a sentence that says what its threshold means.

    Raises
    ------
    SpecError
        A recursive design, an option out of range or one that does nothing for this kind, a signal without a bound (or
        without a covariance), or a record that is too short; the paper's threshold for a continuous design.
    VerificationError
        The report of the design fails.

    Notes
    -----
    Of a continuous design, the pointwise bound at the samples is for disturbances that may do anything within their
    bounds at all times, between samples too: it depends on the sample time, and all its terms are rounded outwards.
    What known inputs and the plant's start alone do to the sampled observer (which takes outputs as straight lines) is
    computed and added.  Plants of index 2 and more have no such bound.  Where the residual does not see the faults that
    are modelled (``ui-pi-observer``, ``functional-filter``), all kinds but ``paper`` are of the fault estimates:
    ``chi-square`` of the newest ones and of their means over the window.  The statistical kinds use disturbances that
    are held between samples, and exact covariances of the noise.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> design = obsynth.fault_estimation_filter(plant)
    >>> scenario = obsynth.Scenario(
    ...     horizon=30,
    ...     faults={"f1": obsynth.Step(size=1.0, start=10)},
    ...     disturbances={"d1": obsynth.Uniform(low=-0.1, high=0.1)},
    ... )
    >>> monitor = obsynth.monitor(design, scenario)
    >>> detection = monitor.watch(obsynth.simulate(design, scenario).estimates)
    >>> detection.fault, detection.time
    ('f1', 11.0)
    """
    require_verified(design, unverified=unverified)
    require_no_region(design, kind)
    chosen(kind, "kind", MONITOR_KINDS)
    options = {
        "disturbance_bounds": disturbance_bounds, "noise_bound": noise_bound, "initial_error": initial_error,
        "gamma": gamma, "window": window, "false_alarms": false_alarms, "change": change, "constants": constants,
        "initial_set": initial_set,
        "disturbance": None if chosen(disturbance, "disturbance", DISTURBANCES) == "any" else "held",
    }  # fmt: skip
    window, false_alarms, change = checked_options(LINEAR_OPTIONS, kind, options, isolation_delay)
    if is_guaranteed(design):
        return record_monitor(design, scenario, kind, options)
    design, adaptive = tolerances_of(design, constants, initial_set, initial_error)
    watched = watched_by(design, kind)
    model = residual_model(design, scenario, watched=watched)
    model = model.held() if disturbance == "held" else model
    start = 0.0 if adaptive else model.initial_error
    start = start if initial_error is None else float(initial_error)
    bounds, bench = bounds_of(design, model, disturbance_bounds), make_bench(design, scenario)
    observer = cast(LinearObserver, bench.observer)
    rows = watched.rows(observer)
    numbers: dict[str, Any] = {"window": window, "false_alarms": false_alarms, "change": change, "dt": bench.signals.dt}
    rule: Rule
    if kind in ("chi-square", "cusum"):
        rule = _whitened_rule(kind, model, start, watched=watched, **numbers)
    else:
        inputs = _ResidualInputs(design, scenario, model, bounds, noise_bound, start)
        rule = _norm_rule(kind, inputs, gamma, window, rows, bench.signals.dt)
    noisy = noisy_design(design, scenario)
    quiet = bool(design.linear[0].nw and not noisy.linear[0].nw)
    assumed = Assumptions(noisy.linear[0], bounds, noise_bound or 0.0, initial_error=start, noise_left_out=quiet)
    bounded = assumed if kind in ("pointwise", "window") else None
    statement = statement_of(kind, model, bounded, watched=watched, **numbers) + NO_TOLERANCE
    if adaptive:
        nominal = cast(NormRule, rule)
        rule, statement = over_box(
            noisy,
            nominal,
            bounds,
            noise_bound,
            initial_error,
            initial_set,
            scenario=scenario,
            disturbance=disturbance,
            noise_left_out=quiet,
        )
    return Monitor(
        kind,
        statement,
        rule,
        residuals=len(observer.residual_names),
        fault_names=design.linear[1].fault_names,
        fault_scales=model.fault_scales(),
        horizon=model.steps,
        dt=bench.signals.dt,
        floor=_floor(bench, design.linear[0], scenario, rows),
        isolation_delay=isolation_delay,
        watched=watched,
    )


def require_no_region(design: ObserverDesign, kind: str) -> None:
    """Raise `SpecError` for designs over a region, which have no such bound of their residuals."""
    if isinstance(design.observer, (RegionObserver, ScheduledObserver)):
        raise SpecError(
            f"Design {design.name!r} is over a region, where the monitor {kind!r} has no bound of the residual. Take "
            "pointwise on data (obsynth.online_monitor) for a scheduled design, or learn "
            "thresholds from rows without faults (kind 'learned' with normal=...).",
            path="kind",
        )


def _whitened_rule(
    kind: str,
    model: ResidualModel,
    start: float,
    *,
    watched: Watched,
    window: int,
    false_alarms: float,
    change: float,
    dt: float,
) -> WhitenedRule:
    """Return the rule of a statistical kind."""
    # A window that outlasts the scenario is refused before its covariance is factorised.
    first = settled(model, start, window)
    whitener, white = whitened(kind, model, window, watched)
    # Bonferroni's inequality over all looks (chi-square), or Ville's over all white sums.
    table, looks, degrees = np.full(model.steps, np.inf), model.steps - first, len(whitener)
    if kind == "chi-square":
        table[first:] = chi_square_limit(degrees, false_alarms / looks)
    else:
        # Two signs for each component; a sum may start at every look.
        sums = looks if white else looks * (looks + 1) / 2
        table[first:] = math.log(2 * degrees * sums / false_alarms)
    return WhitenedRule(
        whitener,
        steady_mean(model),
        window=window,
        change=None if kind == "chi-square" else float(change),
        false_alarms=false_alarms,
        dt=dt,
        white=white,
        table=table,
    )


@dataclass(frozen=True, eq=False)
class _ResidualInputs:
    """What acts on the residual of a design in a scenario: bounded disturbances, noise, and the error at the start."""

    design: ObserverDesign
    scenario: Scenario
    model: ResidualModel
    bounds: FloatArray  # ``(nd,)``: largest absolute values of the disturbances
    noise_bound: float | None  # in standard deviations
    start: float  # norm of the error of the state


def _norm_rule(
    kind: str, inputs: _ResidualInputs, gamma: float | None, window: int, rows: slice, dt: float
) -> NormRule:
    """Return the rule of a bound on the norm of the residual at each sample of the scenario."""
    threshold = _norm_threshold(kind, inputs, gamma, window)
    if inputs.model.continuous is not None:
        threshold = threshold + _straight_lines(inputs, kind, window, rows)
    return NormRule(threshold, np.inf, window=window if kind == "window" else 1, dt=dt)


def _norm_threshold(kind: str, inputs: _ResidualInputs, gamma: float | None, window: int) -> FloatArray:
    """Return the threshold of a norm at each sample, for what acts on the samples."""
    model = inputs.model
    if kind == "paper":
        return paper_threshold(model, inputs.bounds, inputs.start, gamma)
    scaled = scaled_inputs(model, inputs.bounds, inputs.noise_bound, inputs.design.linear[0])
    threshold = pointwise_threshold(model, scaled, inputs.start)
    return threshold if kind == "pointwise" else window_threshold(model, scaled, inputs.start, window)


def bounds_of(design: ObserverDesign, model: ResidualModel, stated: Mapping[str, float] | None) -> FloatArray:
    """Return the largest absolute value of each disturbance ``(nd,)``: the scenario's, or what is given."""
    return with_stated_bounds(model.bounds, design.linear[0].disturbance_names, stated)


def with_stated_bounds(bounds: FloatArray, names: Sequence[str], stated: Mapping[str, float] | None) -> FloatArray:
    """Return bounds of disturbances ``(nd,)`` with those that are stated by name in their places."""
    bounds = bounds.copy()
    for name, value in (stated or {}).items():
        place = index_of(name, names, what="disturbance_bounds")
        bounds[place] = real_number(
            value, f"The bound of {name!r}", "a number, 0 or more", least=0.0, path="disturbance_bounds"
        )
    return bounds


def _floor(bench: Bench, plant: DescriptorSystem, scenario: Scenario, rows: slice) -> float:
    """Return what rounding may add to the norm of the residual, from the size of what it is made of."""
    runs, observer = bench.run([scenario.seed]), cast(LinearObserver, bench.observer)
    # Of an unknown input that no output shows, the outputs themselves are rounding of what the states add up to.
    outputs = np.abs(runs.outputs) + np.abs(runs.states) @ np.abs(plant.C).T
    size = outputs @ np.abs(observer.Dy[rows]).T + np.abs(runs.inputs) @ np.abs(observer.Du[rows]).T
    # Where no output enters directly, its rounding comes by the states.
    state = observer.init(observer_start(scenario, observer.order))
    for k, (y, u) in enumerate(zip(runs.outputs[:, 0], runs.inputs[:, 0], strict=True)):
        size[k] += np.abs(observer.Cz[rows]) @ (np.abs(state.z) + np.abs(observer.By) @ outputs[max(k - 1, 0), 0])
        state, _ = observer.advance(state, y, u)
    return RESIDUAL_ROUNDING_SHARE * float(np.max(np.linalg.norm(size, axis=2)))


def _straight_lines(inputs: _ResidualInputs, kind: str, window: int, rows: slice) -> FloatArray:
    """Return what straight lines between samples add to a norm of the residual: known inputs and start alone."""
    model, scenario = inputs.model, inputs.scenario
    if kind not in ("pointwise", "window"):
        return np.zeros(model.steps)
    calm = scenario.replace(faults={}, sensors={}, disturbances={}, noise=0.0, sensor_noise={})
    bench = make_bench(inputs.design, calm)
    residuals = bench.run([scenario.seed]).rows[:, 0, rows]
    sizes = np.array(
        [
            np.linalg.norm(residual - model.C @ power @ model.start)
            for residual, power in zip(residuals, model.powers(), strict=True)
        ]
    )
    return sizes if kind == "pointwise" else norms_of_windows(sizes, window)
