"""From a plant to a verified design: analysis, synthesis and verification in turn."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from inspect import signature
from types import MappingProxyType
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import Condition
from obsynth.analysis.existence.turning_filter import TURNING_CONDITION
from obsynth.errors import ObsynthError, PreconditionError, SolverError, SpecError, VerificationError
from obsynth.methods.method import Method, Synthesis, silent
from obsynth.methods.refusals import with_advice
from obsynth.methods.region_trials import region_condition
from obsynth.methods.registry import AUTO, REGISTRY, Plant, kind_conditions, kind_of, method_class, methods_for
from obsynth.methods.rounding import require_above_rounding
from obsynth.methods.verifying import verify
from obsynth.methods.working_plants import WorkingPlant, with_derivatives_as_inputs, working_plant
from obsynth.numerics.arguments import arguments_checked, field_types
from obsynth.numerics.libraries import failed_computations, failure_of, one_thread_if_small
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.plants.transformations.delays import continuous_with_delays, plant_and_recovery, sample_time_of_delays
from obsynth.plants.transformations.elimination import MANY_VARIABLES, eliminate_algebraic_states
from obsynth.plants.transformations.recovery import StateRecovery, Transformation, unchanged_states
from obsynth.plants.transformations.sampling import discretise
from obsynth.plants.uncertainty import UNCERTAIN_MATRICES
from obsynth.results.design import Certificate, ObserverDesign
from obsynth.results.plant_source import PlantSource, source_of
from obsynth.results.verification_report import MethodReports, VerificationReport, failed_rows
from obsynth.simulation.scenario import Scenario
from obsynth.verification.claims import before_the_mean
from obsynth.verification.constant_faults import CONSTANT_FAULT
from obsynth.verification.plant import condition_rows
from obsynth.verification.stored_numbers import StoredErrors

#: Two plants count as the same if the entries of each matrix agree to this share of its largest entry: an elimination
#: in other units, or a repeated sampling, differs by rounding.
SAME_PLANT = 1e-9

#: A larger steady_error_limit is suggested up to this share of a constant fault that estimates may miss.
LARGEST_STEADY_ERROR = 0.1
_CHANGED_BY_METHOD = "the method changed the plant by itself"
_ELIMINATE_FIRST = (
    " Eliminate algebraic states first (transform: eliminate_algebraic_states, obsynth.eliminate_algebraic_states)."
)


@arguments_checked
def design(
    plant: Plant | Transformation,
    method: str = AUTO,
    *,
    name: str = "design",
    recovery: StateRecovery | None = None,
    progress: Callable[[str], None] | None = None,
    scenario: Scenario | None = None,
    **options: Any,
) -> ObserverDesign:
    """Design an observer and verify what is shipped.

    Parameters
    ----------
    plant : DescriptorSystem, TimeVaryingDescriptorSystem, DAEModel or Transformation
        The plant, or the result of `discretise` or `eliminate_algebraic_states`, whose map back to the original states
        is kept.  Algebraic states of a plant with sparse matrices and 500 states or more are eliminated first.
    method : str, optional
        Method id; for its options see the function of the same name, such as `fault_estimation_filter`.  By default
        ``auto``: observers of all methods that exist and have the given options are designed, and the best one by
        closed-form figures (reach of a step, gain from the unknown inputs, noise against delay) is returned; the design
        names its method.
    name : str, optional
        Name of the design.
    recovery : StateRecovery, optional
        Map back to the states of the plant before its transformation, kept with the design.
    progress : callable, optional
        Called with a text at the start of each stage.
    scenario : Scenario, optional
        The expected operation of the plant: for guaranteed tests of plants with tolerances, and for ``auto``, which
        takes noise, sample time and sizes of faults from it.
    **options
        Options of the method.

    Returns
    -------
    ObserverDesign
        Verified: every check of its report holds.

    Raises
    ------
    SpecError
        Unknown method or option, or an option out of range.
    PreconditionError
        No such observer exists for this plant; the failing condition, mode and signals are named, and what to measure
        (or to leave out) so that one does.
    InfeasibleError
        A checked certificate proves that no observer meets the options.
    SolverError
        The solver gave no usable answer: the result is inconclusive.
    VerificationError
        Gains were found, but the shipped realisation fails a check.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]],
    ...     C=[[1, 0], [0, 1]],
    ...     Bf=[[1], [0]],
    ...     Bd=[[0], [1]],
    ...     dt=1.0,
    ...     sensor_noise={"y1": 0.1, "y2": 0.1},
    ... )
    >>> design = obsynth.design(plant)
    >>> design.method, design.report.passed
    ('ui-pi-observer', True)
    """
    report_stage = progress or silent
    own: Plant
    _require_sampled_delays(plant, method, options)
    notes = plant.notes if isinstance(plant, Transformation) else ()
    own, recovery = plant_and_recovery(plant, recovery)

    def made(
        plant: Plant | Transformation, method: str, options: Mapping[str, Any], *, advise: bool = False
    ) -> ObserverDesign:
        configured, way_back = method_class(method).of(options), recovery
        if isinstance(plant, Transformation):
            way_back = plant.recovery if recovery is None else recovery.then(plant.recovery)
            plant = plant.plant
        each = partial(_designed, name=name, recovery=way_back, progress=report_stage, advise=advise)
        uncertain = plant.uncertainty if isinstance(plant, DescriptorSystem) else None
        if configured.over_scenario and scenario is not None and uncertain is not None and uncertain.box.names:
            each = partial(each, more={"scenario": scenario})
        designed: ObserverDesign = each(plant, configured)
        return designed.replace(notes=(*notes, *designed.notes)) if notes else designed

    if method == AUTO:
        from obsynth.methods.automatic import automatic_design

        report_stage("designing by every method that exists")
        if kind_of(own) == "polytopic":
            *others, last = _for_region(own, options)
            for current in others:
                try:
                    return made(own, current, options, advise=True)
                except SolverError:
                    report_stage(f"{current} found no certificate: the next method that exists is designed")
            return made(own, last, options, advise=True)
        with failed_computations(), one_thread_if_small(own.nx):
            working = working_plant(own, recovery, report_stage, None)
            own, recovery = working.plant, working.recovery
            chosen = automatic_design(own, options, made, partial(made, advise=True), scenario)
            return chosen.replace(notes=(*working.notes, *chosen.notes)) if working.reduced else chosen
    return made(own, method, options, advise=True)


def _for_region(plant: Plant, options: Mapping[str, Any]) -> list[str]:
    """Return the methods that exist over the region of a polytopic plant with these options; if none does, one of them.

    There are several only for faults whose direction depends on the scheduling: although the first method exists, its
    design may find no certificate.
    """
    faulty = isinstance(plant, PolytopicSystem) and plant.nf > 0
    known = [method for method in methods_for("polytopic") if "faults" in method_class(method).purposes or not faulty]
    taking = [method for method in known if set(options) <= set(field_types(method_class(method)))]
    existing: list[str] = []
    for method in taking:
        conditions = method_class(method).of(options).existence(plant)
        if all(condition.holds for condition in conditions):
            existing.append(method)
            if not any(condition.name == TURNING_CONDITION for condition in conditions):
                break
    return existing or [(taking or known)[0]]


def _require_sampled_delays(plant: Any, method: str, options: Mapping[str, Any]) -> None:
    """Refuse a continuous plant with delays; the message names the methods that exist for the sampled plant."""
    own = plant.plant if isinstance(plant, Transformation) else plant
    if not isinstance(own, DescriptorSystem) or not own.delays or own.is_discrete:
        return
    try:
        sampled = discretise(plant, sample_time_of_delays(own))
        reports = check(sampled, {} if method == AUTO else {method: options})
    except (SpecError, PreconditionError, SolverError):
        raise continuous_with_delays(own) from None
    exist = [name for name, report in reports.items() if report.passed]
    if method in exist:
        tried = f" {method} exists for that."
    elif exist:
        tried = f" For that exist: {', '.join(exist)}."
    else:
        tried = " No method exists for that as it is, either: obsynth.check says why."
    raise continuous_with_delays(own, tried)


def _designed(
    plant: Plant,
    method: Method,
    *,
    name: str,
    recovery: StateRecovery | None,
    progress: Callable[[str], None],
    advise: bool,
    more: Mapping[str, Any] = MappingProxyType({}),
) -> ObserverDesign:
    """Return the verified design of one method.

    With ``advise`` an error says what would make a design possible.  ``more`` are further arguments of the synthesis.
    """
    for condition in kind_conditions(plant, type(method)):
        condition.require()
    with failed_computations(), one_thread_if_small(plant.nx):
        working = working_plant(plant, recovery, progress, method)
        try:
            return _designed_on(working, method, name=name, progress=progress, advise=advise, more=more)
        except (SolverError, VerificationError):
            other = with_derivatives_as_inputs(plant, recovery, method, working)
            if other is None:
                raise
            progress("taking derivatives of known inputs as inputs")
            with suppress(ObsynthError):
                return _designed_on(other, method, name=name, progress=progress, advise=False, more=more)
            raise


def _designed_on(
    working: WorkingPlant,
    method: Method,
    *,
    name: str,
    progress: Callable[[str], None],
    advise: bool,
    more: Mapping[str, Any],
) -> ObserverDesign:
    """Return the verified design for the plant as the method needs it."""
    plant, recovery, notes = working.plant, working.recovery, working.notes
    method = working.method or method
    try:
        synthesis = method.synthesise(plant, progress=progress, **more)
    except PreconditionError as error:
        if not isinstance(plant, DescriptorSystem) or not advise:
            raise
        progress("searching for sensors that would make it possible")
        sensors, done = working.sensors(), notes if working.reduced else ()
        raise with_advice(error, plant, method, sensors=sensors, notes=done) from None
    if notes:
        synthesis = replace(synthesis, notes=(*notes, *synthesis.notes))
    progress("verifying the shipped realisation")
    try:
        return verified(plant, method.id, synthesis, name=name, recovery=recovery)
    except VerificationError as error:
        report = error.report
        if not (advise and isinstance(report, VerificationReport) and _misses_constant_faults_alone(report)):
            raise
        progress("searching for a method that estimates constant faults of this plant")
        advice = [_right_at_constant_faults(plant, method, name, recovery)]
        enough = _error_that_is_reached(report[CONSTANT_FAULT].value)
        if enough is not None and "steady_error_limit" in synthesis.options:
            relaxed = replace(synthesis, options={**synthesis.options, "steady_error_limit": enough})
            with suppress(ObsynthError):
                verified(plant, method.id, relaxed, name=name, recovery=recovery)
                advice.append(f"With steady_error_limit={enough:g}, which was tried, these gains are verified.")
        raise VerificationError(" ".join([str(error), *advice]), report=report) from None


def _error_that_is_reached(missed: float) -> float | None:
    """Return the share of a constant fault that estimates miss, rounded up to two digits; ``None`` if it is too
    large."""
    if not missed <= LARGEST_STEADY_ERROR:
        return None
    digit = 10.0 ** (math.floor(math.log10(missed)) - 1)
    return float(f"{math.ceil(missed / digit) * digit:.2g}")


def _right_at_constant_faults(plant: Plant, method: Method, name: str, recovery: StateRecovery | None) -> str:
    """Return a sentence on another method that is verified for a plant, where rounding of the gains of ``method`` makes
    its estimates miss constant faults."""
    alternatives = [
        other for other in methods_for(kind_of(plant)) if "steady_error_limit" in field_types(method_class(other))
    ]
    limit = {name: value for name, value in method.as_given().items() if name == "steady_error_limit"}
    for other in (other for other in alternatives if other != method.id):
        known = method_class(other).of(limit)
        try:
            trial = _designed(plant, known, name=name, recovery=recovery, progress=silent, advise=False)
        except ObsynthError:
            continue
        if CONSTANT_FAULT in {row.name for row in trial.report.checks}:
            return f"{other} was tried with its defaults and is verified for this plant: design that."
    tried = ", ".join(other for other in alternatives if other != method.id)
    return f"No other method that estimates faults is verified for this plant with its defaults either ({tried})."


@arguments_checked
def check(plant: Plant | Transformation, options: Mapping[str, Mapping[str, Any]] | None = None) -> MethodReports:
    """Return, for every method, a report with a row for each of its existence conditions.

    Nothing is designed, except for a plant over a region (`PolytopicSystem`): if observers exist at its points, a small
    one is designed to find out whether one certificate is valid over the region.

    Parameters
    ----------
    plant : DescriptorSystem, TimeVaryingDescriptorSystem, PolytopicSystem, DAEModel or Transformation
        The plant.
    options : mapping, optional
        Options by method id, such as ``fault_model``; only those that the conditions depend on are used.  Options of
        ``auto`` apply to every method that has all of them.

    Returns
    -------
    dict of str to VerificationReport
        Reports by method id; an observer of the method can exist if ``passed`` is true.  As text, a line for each
        method says so, or names the first condition that fails.

    Raises
    ------
    SpecError
        The plant or an option is malformed.
    SolverError
        The numbers are beyond double precision.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(
    ...     A=[[0.9, 0.1], [0.0, 0.8]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0
    ... )
    >>> reports = obsynth.check(plant)
    >>> reports["ui-pi-observer"].passed, reports["guaranteed-test"].passed
    (True, False)
    """
    own: Plant
    own, _ = plant_and_recovery(plant)
    kind_of(own)
    try:
        with failed_computations(), one_thread_if_small(own.nx):
            if isinstance(own, DescriptorSystem) and own.nx >= MANY_VARIABLES:
                own = working_plant(own, None, silent, None).plant
            return _checked(own, options or {})
    except PreconditionError as error:
        # The sparse plant cannot be reduced, whatever the method.
        row = Condition(
            error.condition,
            "algebraic states that can be eliminated",
            False,
            np.nan,
            np.nan,
            "plant",
            str(error),
            signals=error.signals,
            of_the_method=error.condition == "index",
        )
        return MethodReports((method, VerificationReport.of(condition_rows((row,)))) for method in REGISTRY)


def _checked(plant: Plant, options: Mapping[str, Mapping[str, Any]]) -> MethodReports:
    reports = MethodReports()
    for method in REGISTRY:
        known = method_class(method)
        stated = options.get(method, known.placeholders)
        by_default = AUTO in options and set(options[AUTO]) <= set(field_types(known))
        conditions: Sequence[Condition]
        try:
            configured = known.of(options[AUTO] if by_default else stated)
            conditions = kind_conditions(plant, known)
            if not conditions:
                working = working_plant(plant, None, silent, configured)
                conditions = (*working.conditions(), *_existence(working.plant, configured))
                conditions = (*conditions, *_over_region(plant, configured, conditions))
        except SpecError as error:
            if not by_default:
                raise
            conditions = kind_conditions(plant, known) or (_not_stated(error, method),)
        reports[method] = VerificationReport.of(condition_rows(conditions))
    return reports


def _over_region(plant: Plant, method: Method, conditions: Sequence[Condition]) -> list[Condition]:
    """Return the condition that one certificate is valid over the region of a polytopic plant, if observers exist at
    its points."""
    if not isinstance(plant, PolytopicSystem) or not all(condition.holds for condition in conditions):
        return []
    each = partial(_designed, plant, method, name="design", recovery=None, progress=silent, advise=False)
    condition = region_condition(plant, method, each)
    return [] if condition is None else [condition]


def _not_stated(error: SpecError | PreconditionError, method: str) -> Condition:
    """Return the failed condition for data that a design needs and that neither the plant nor the options state."""
    signals, unclear = (error.signals, error.unclear) if isinstance(error, PreconditionError) else ((), False)
    claim, detail = "what a design needs is stated", str(error).removeprefix("Unclear: ")
    return Condition("stated", claim, False, np.nan, np.nan, method, detail, signals=signals, unclear=unclear or None)


def _existence(plant: Plant, method: Method) -> Sequence[Condition]:
    """Return a method's existence conditions; if they are satisfied, also a failed one for data that are not stated.

    If the conditions cannot be computed, the result is a condition that says so, since other methods go on.
    """
    try:
        conditions = method.existence(plant)
        if all(condition.holds for condition in conditions):
            try:
                method.require_stated(plant)
            except (SpecError, PreconditionError) as error:
                return (*conditions, _not_stated(error, method.id))
        return conditions
    except PreconditionError as error:
        name, message, signals, unclear = error.condition, str(error), error.signals, error.unclear
    except (SolverError, np.linalg.LinAlgError, ArithmeticError, ValueError, MemoryError) as error:
        failure = error if isinstance(error, SolverError) else failure_of(error)
        if failure is None:
            raise
        name, message, signals, unclear = "computed", str(failure), (), True
    claim = "conditions that can be decided"
    return (Condition(name, claim, False, np.nan, np.nan, method.id, message, signals=signals, unclear=unclear),)


def draft_of(
    plant: Plant, method: str, synthesis: Synthesis, *, name: str, recovery: StateRecovery | None = None
) -> ObserverDesign:
    """Return the design from a synthesis, without a report."""
    designed_for, source = plant, source_of(plant)
    if synthesis.plant is not None:
        if recovery is not None and isinstance(plant, DescriptorSystem) and synthesis.plant.nx > plant.nx:
            # States for estimated unknown inputs and noise come after the plant's own states.
            leading = np.eye(plant.nx, synthesis.plant.nx)
            recovery = recovery.then(unchanged_states(plant, plant, from_state=leading))
        plant = synthesis.plant
    if synthesis.transformation is not None:
        own = synthesis.transformation.recovery
        plant, recovery = synthesis.transformation.plant, own if recovery is None else recovery.then(own)
        source = source_of(plant)
    return ObserverDesign(
        name=name,
        method=method,
        plant=_with_tolerances_of(designed_for, plant),
        options=synthesis.options,
        gains=synthesis.gains,
        observer=synthesis.observer,
        certificate=synthesis.certificate,
        solver=synthesis.solver,
        notes=synthesis.notes,
        recovery=recovery,
        source=_source_of_recovery(source, recovery),
    )


def _source_of_recovery(source: PlantSource | None, recovery: StateRecovery | None) -> PlantSource | None:
    """Return the source whose states a recovery returns.

    The result is ``None`` if the recovery returns states of an earlier plant that is too large to be stored, so that
    the recovery cannot be computed again.
    """
    if source is None or recovery is None:
        return source
    try:
        known = source.derived.recovery.names
    except ObsynthError:
        return source
    return source if set(recovery.names) <= set(known) else None


def verified(
    plant: Plant, method: str, synthesis: Synthesis, *, name: str, recovery: StateRecovery | None = None
) -> ObserverDesign:
    """Return the design with its report."""
    draft = with_stored_errors(draft_of(plant, method, synthesis, name=name, recovery=recovery))
    linear = isinstance(draft.observer, LinearObserver) and isinstance(draft.plant, DescriptorSystem)
    # Checked first: with gains that hide a fault, the failing rows would depend on the rounding of this machine.
    notes = require_above_rounding(*draft.linear) if linear else ()
    report = verify(draft)
    if not report.passed:
        raise VerificationError(" ".join([_what_fails(report), *draft.notes]), report=report)
    uncertain = draft.plant.uncertainty if isinstance(draft.plant, DescriptorSystem) else None
    if uncertain is not None and uncertain.lost:
        notes = (
            *notes,
            f"The tolerances of the constants ({', '.join(uncertain.box.names)}) are not carried over: "
            f"{uncertain.lost}. The design is for the nominal plant, and thresholds and proofs over the box are "
            f"refused.{_ELIMINATE_FIRST if uncertain.lost == _CHANGED_BY_METHOD else ''}",
        )
    return draft.replace(report=report, notes=(*draft.notes, *notes))


def _what_fails(report: VerificationReport) -> str:
    """Return the beginning of a message on the rows that the gains fail, with the reason if it is known."""
    if _misses_constant_faults_alone(report):
        row = report[CONSTANT_FAULT]
        return (
            f"Gains were found, but in the end they may miss {row.value:.3g} of a constant fault, above "
            f"{row.bound:.3g} (steady_error_limit), {row.detail}. Nothing was shipped."
        )
    return (
        f"Gains were found, but the shipped realisation fails: {failed_rows(report)}. Nothing was shipped; "
        "the plant may be badly scaled, or the options may be at the limit of what is possible: relax them."
    )


def _misses_constant_faults_alone(report: VerificationReport) -> bool:
    return {row.name for row in report.failures} == {CONSTANT_FAULT}


@arguments_checked
def design_from_gains(
    plant: Plant | Transformation, method: str, *, name: str = "design from gains", **gains: Any
) -> ObserverDesign:
    """Make a design with its report from gains of a paper or of another program, even if checks fail.

    Parameters
    ----------
    plant : DescriptorSystem or Transformation
        As for the method's own function.
    method : str
        Method id.
    name : str, optional
        Name of the design.
    **gains
        In the letters of the method's paper.

        ``fault-estimation-filter``: ``T (nx, nx)``, ``N (nx, ny)``, ``L (nx, ny)``, ``W (nf, ny)`` of [Wang2015];
        ``gamma`` (dimensionless), the claimed bound on the l2 gain, needed if the plant has disturbances;
        ``indexes``, the detectability index of each fault (19), the number of samples by which its estimate lags.  By
        default they are computed from T, which then needs all of its digits: for an index above one, ``C T f_i`` must
        vanish, and with a rounded T it does not.

        ``pd-observer``: ``J, L (nx, ny)`` and ``M, N (nf, ny)`` of [Filasova], nx after elimination of algebraic
        states; ``adaptation_gain``, G ``(nf, nf)`` of (25), inside the loop; ``decay`` (1/seconds), the claimed rate.

        ``ui-pi-observer``: ``U (nx, nx)``, ``D (nx, ny)``, ``K (nx, ny)`` of (11), (12) and ``F (nw, ny)`` of (23) in
        [SharePasand]; ``fault_model`` as for `ui_pi_observer`.

    Returns
    -------
    ObserverDesign
        Its certificate is computed from the gains.  Its report may contain failed checks: see ``report.passed``, or
        call `obsynth.verify` with the number of printed digits.

    Raises
    ------
    SpecError
        A gain is missing, unknown or of the wrong shape, or the method has no gains that can be given.
    PreconditionError
        No such observer exists for this plant.

    References
    ----------
    .. [Wang2015] Fault estimation filter design for discrete-time descriptor systems, eq. (23).
    .. [Filasova] Application of descriptor approaches in design of PD observer-based actuator fault estimation,
       eqs. (4)-(6), (25).
    .. [SharePasand] Unknown Input-Proportional Integral Observer for Singular Systems, eqs. (4), (19)-(23).

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.DescriptorSystem(A=[[-1.0, 0.5], [0.0, -2.0]], C=[[1, 0], [0, 1]], Bf=[[1], [0]])
    >>> first = obsynth.pd_observer(plant, decay=2.0)
    >>> design = obsynth.design_from_gains(plant, "pd-observer", **first.gains)
    >>> design.report.passed
    True
    """
    own, recovery = plant_and_recovery(plant)
    known = method_class(method)
    for condition in kind_conditions(own, known):
        condition.require()
    try:
        signature(known.from_gains).bind(own, **gains)
    except TypeError:
        parameters = [
            part for part in signature(known.from_gains).parameters.values() if part.kind is part.KEYWORD_ONLY
        ]
        needed = ", ".join(part.name for part in parameters if part.default is part.empty)
        optional = ", ".join(part.name for part in parameters if part.default is not part.empty)
        wants = f"{needed or 'no gains: design it instead'}{f' (and {optional})' if optional else ''}"
        message = f"{method} is given by {wants}, not by {', '.join(gains) or 'nothing'}."
        raise SpecError(message, path="gains") from None
    draft = draft_of(own, method, known.from_gains(own, **gains), name=name, recovery=recovery)
    return draft.replace(report=verify(draft))


def _with_tolerances_of(original: Plant, shipped: Any) -> Any:
    """Return the shipped plant with the tolerances of the given one, or with the reason why it has none."""
    if not (isinstance(original, DescriptorSystem) and isinstance(shipped, DescriptorSystem)):
        return shipped
    uncertain = original.uncertainty
    if uncertain is None or (shipped.uncertainty is not None and not shipped.uncertainty.lost):
        return shipped
    if not uncertain.lost:
        try:
            same = eliminate_algebraic_states(original).plant
        except PreconditionError:
            same = original
        if same.state_names == shipped.state_names and same.dt == shipped.dt and agree(same, shipped):
            return shipped.replace(uncertainty=same.uncertainty)
    return shipped.replace(uncertainty=uncertain.left_behind(_CHANGED_BY_METHOD))


def agree(first: DescriptorSystem, second: DescriptorSystem) -> bool:
    """Whether the matrices of two plants are equal up to rounding."""
    pairs = [(getattr(first, name), getattr(second, name)) for name in UNCERTAIN_MATRICES]
    return all(
        a.shape == b.shape and bool(np.all(np.abs(a - b) <= SAME_PLANT * np.abs(a).max(initial=0.0))) for a, b in pairs
    )


def with_stored_errors(draft: ObserverDesign) -> ObserverDesign:
    """Return a linear design whose certificate also bounds the errors that rounding of its stored numbers adds."""
    method = method_class(draft.method)
    with np.errstate(all="ignore"):
        base = before_the_mean(draft)[0] if method.averaged else draft
        model = method.error_model(base)
        errors = None if model is None or not model.fits else StoredErrors.of(model)
    if errors is None:
        return draft
    old = draft.certificate
    return draft.replace(certificate=Certificate({**old.matrices, **errors.witnesses()}, old.claims))
