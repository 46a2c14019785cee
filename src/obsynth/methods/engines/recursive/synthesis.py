"""Shared steps of recursive methods: stated noise, printed gains, claims, notes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.kalman import WithoutUnknownInputs, with_stated_noise, without_unknown_inputs
from obsynth.analysis.existence.recursive import detectability_condition
from obsynth.analysis.existence.shared_noise import SharedNoise, shared_noise
from obsynth.analysis.time_varying import WARN_MARKOV_CONDITION, HorizonRanks, as_time_varying, horizon_ranks
from obsynth.errors import PreconditionError, counted
from obsynth.methods.method import Method, Synthesis
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.ranks import covariance_factor, decide_rank
from obsynth.observers.recursive.gain_schedule_summary import (
    CLEARLY_STABLE,
    STEPS_TO_CONTRACT,
    GainScheduleSummary,
    shared_summary,
)
from obsynth.observers.recursive.observer import RecursiveObserver
from obsynth.observers.recursive.options import has_text, observer_from_options, plain_options
from obsynth.observers.recursive.steady_filter import forgets_its_start, reached_condition
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import FAR_UNITS, PlantUnits
from obsynth.plants.signal_names import leading_names
from obsynth.plants.time_varying import TimeVaryingDescriptorSystem
from obsynth.results.design import Certificate

#: Information on the parameters in a window below this share of their prior's is as good as none.
LOST_EXCITATION = 1.0
#: Of plants of more states gains are formed only where it is not sure that errors decay: of 196 states it takes two
#: seconds.
MOST_STATES_TO_FORM_GAINS = 60


def synthesise(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem, method: Method, *, progress: Callable[[str], None]
) -> Synthesis:
    """Put the observer together; see `obsynth.descriptor_kalman` and `obsynth.adaptive_observer`."""
    progress("checking the existence conditions along the horizon")
    require_all(method.existence(plant))
    options = method.as_given()
    shared = shared_noise(plant, Q=options["Q"], R=options["R"])
    if shared is None or not isinstance(plant, DescriptorSystem):
        return _with_independent_noises(plant, options, progress=progress)
    units = PlantUnits.of(plant)
    if options["initial_covariance"] is None and units.spread > FAR_UNITS:
        options["initial_covariance"] = np.diag(units.rounded().states ** 2)
    options |= _of_first_state(shared, options)
    synthesis = _with_independent_noises(shared.plant, options, progress=progress)
    return replace(synthesis, notes=(shared.note, *synthesis.notes))


def require_gains(plant: DescriptorSystem | TimeVaryingDescriptorSystem, method: Method) -> None:
    """Raise `PreconditionError` where the noise as stated allows no gains, or none with which errors decay.

    Gains are formed where some equation or output has no noise; where all have, the conditions of existence decide, and
    so they do of a plant of many states whose errors decay for sure.
    """
    options = method.as_given()
    if shared_noise(plant, Q=options["Q"], R=options["R"]) is None:
        options = with_stated_noise(plant, options)
        if all(options[name] is None or _is_definite(options[name]) for name in ("Q", "R")):
            return
        if plant.nx > MOST_STATES_TO_FORM_GAINS and _errors_decay(plant, options):
            return
    synthesise(plant, method, progress=lambda _: None)


def _errors_decay(plant: DescriptorSystem | TimeVaryingDescriptorSystem, options: Mapping[str, Any]) -> bool:
    """Whether errors of the states decay wherever the conditions of existence hold, with noise in every output.

    They do where no mode is known exactly at first, like 1/k at the slowest, whatever Q is (de Souza, Gevers and
    Goodwin 1986); or where the plant decays by itself, without unknown inputs.
    """
    if options["early_constraints"] or not isinstance(plant, DescriptorSystem) or not decide_rank(plant.E).full:
        return False
    if options["R"] is not None and not _is_definite(options["R"]):
        return False
    if options["initial_covariance"] is None or _is_definite(options["initial_covariance"]):
        return True
    motion = np.asarray(np.linalg.solve(plant.E, plant.A), dtype=np.float64)
    return not plant.nd and spectral_radius(motion) < CLEARLY_STABLE


def _is_definite(covariance: Any) -> bool:
    """Whether a stated covariance is constant and nonsingular."""
    if callable(covariance) or isinstance(covariance, Mapping) or has_text(covariance):
        return False
    matrix = np.asarray(covariance)
    if matrix.dtype.kind not in "if" or matrix.ndim not in (0, 2):
        return False
    return decide_rank(np.atleast_2d(matrix.astype(np.float64))).full


def _with_independent_noises(
    plant: DescriptorSystem | TimeVaryingDescriptorSystem,
    stated: Mapping[str, Any],
    *,
    progress: Callable[[str], None],
) -> Synthesis:
    """Put the observer together for a plant of which no noise drives equations and outputs at once."""
    options = with_stated_noise(plant, stated)
    if options.get("guard", "") is None:
        options["guard"] = "none" if options["form"] == "literal" else "regularise"
    progress("computing the gains")
    missing = [name for name in ("Q", "R") if options[name] is None]
    far = isinstance(plant, DescriptorSystem) and PlantUnits.of(plant).spread > FAR_UNITS
    if isinstance(plant, DescriptorSystem) and far:
        options |= _identities(PlantUnits.of(plant).rounded(), options)
    if not isinstance(plant, DescriptorSystem) or not plant.nd:
        return _of_varying(as_time_varying(plant), options, missing=missing, own_units=far)
    reduced = without_unknown_inputs(plant)
    options |= _of_first_state(reduced, options)
    if reduced.outputs_alone:
        missing = [name for name in missing if name != "Q"]
        options["Q"] = 0.0
    if options["Q"] is not None:
        options["Q"] = reduced.process_covariance(options["Q"])
    synthesis = _of_varying(reduced.plant, options, missing=missing, own_units=far)
    return replace(synthesis, notes=(reduced.note, *synthesis.notes))


def _of_first_state(extended: SharedNoise | WithoutUnknownInputs, options: Mapping[str, Any]) -> dict[str, FloatArray]:
    """Return what is stated of the first state for a plant that has more states than are written."""
    return {
        "initial_state": extended.initial_state(options["initial_state"]),
        "initial_covariance": extended.initial_covariance(options["initial_covariance"]),
    }


def _of_varying(
    plant: TimeVaryingDescriptorSystem, options: Mapping[str, Any], *, missing: Sequence[str], own_units: bool
) -> Synthesis:
    """Return observer, gains, claims and notes; ``missing``: covariances of noise that were not stated."""
    observer = observer_from_options(plant, options)
    ranks = horizon_ranks(plant, early=observer.early_constraints)
    facts = shared_summary(observer)
    contracts = _contracts(facts) and not facts.settles
    if missing and not own_units and not contracts and plant.ne == plant.nx and _has_steady_state(observer):
        still = DescriptorSystem(
            plant.E.at(1), plant.A.at(0), C=plant.C.at(1), Bf=plant.Phi.at(0), Df=plant.Psi.at(0), dt=plant.dt or 1.0
        )
        options, own_units = {**options, **_identities(PlantUnits.of(still).rounded(), options)}, True
        observer = observer_from_options(plant, options)
        facts = shared_summary(observer)
    _require_contraction(observer, facts, () if own_units else missing)
    claims = {
        "condition": ranks.condition,
        "condition_k": float(ranks.condition_k),
        "residual_directions": float(ranks.directions),
        "contraction": facts.contraction,
        "steps": float(facts.steps),
    }
    if observer.adaptation is not None:
        claims |= {"excitation": facts.excitation, "excitation_k": float(facts.excitation_k)}
    resolved = {**options, "Q": observer.Q, "R": observer.R}
    # By the names of the plant that is filtered, as they were understood.
    resolved |= {
        "outlier_sizes": observer.outlier_sizes,
        "sensors": observer.sensors,
        "state_bounds": observer.state_bounds,
    }
    return Synthesis(
        plain_options(resolved),
        {"L": facts.L, "K": facts.K},
        observer,
        Certificate({}, claims),
        notes=tuple(_notes(observer, ranks, facts, missing, own_units=own_units)),
        plant=plant,
    )


def _contracts(facts: GainScheduleSummary) -> bool:
    """Whether errors decay along the horizon, or the horizon is too short to tell."""
    return facts.steps < STEPS_TO_CONTRACT or facts.contraction < 1.0


def _identities(units: PlantUnits, options: Mapping[str, Any]) -> dict[str, FloatArray]:
    """Return the covariances that are not given as identities in units in which a plant is near one."""
    deviations = {"Q": 1.0 / units.equations, "R": 1.0 / units.outputs, "initial_covariance": units.states}
    deviations["initial_parameter_covariance"] = units.faults
    return {name: np.diag(size**2) for name, size in deviations.items() if name in options and options[name] is None}


def _has_steady_state(observer: RecursiveObserver) -> bool:
    """Whether a time-invariant plant is detectable, and Q or the first covariance reaches its modes: then its
    initial-condition response decays."""
    if not (observer.plant.is_time_invariant and observer.Q.is_constant and observer.R.is_constant):
        return False
    roots = covariance_factor(observer.Q.at(0), "Q"), covariance_factor(observer.R.at(0), "R")
    if not (detectability_condition(observer.plant).holds and reached_condition(observer.plant, *roots).holds):
        return False
    return forgets_its_start(observer)


def _require_contraction(observer: RecursiveObserver, facts: GainScheduleSummary, identity: Sequence[str]) -> None:
    """Raise `PreconditionError` where errors do not decay along the horizon."""
    if _contracts(facts):
        return
    names = leading_names(facts.survivors, observer.state_names)
    factor = (
        f"keeps the mean factor {facts.contraction:.6g} per step"
        if facts.contraction < float("inf")
        else "grows without bound"
    )
    if _has_steady_state(observer):
        assumed = f" {' and '.join(identity)} taken as the identity weigh this plant in its units." if identity else ""
        short = (
            "the horizon is too short to decide whether errors decay fast enough"
            if observer.plant.horizon
            else "errors decay too slowly for double precision to tell how fast"
        )
        raise PreconditionError(
            f"Unclear: {short}. The outputs observe every state, and with these Q and R the errors decay in the end; "
            f"but over {facts.steps} steps the product of L_k A_k {factor}, in {', '.join(map(repr, names))}.{assumed} "
            "State Q and R in the units of equations and outputs, or take units in which entries are near one.",
            condition="contraction",
            signals=names,
            unclear=True,
        )
    raise PreconditionError(
        f"Errors do not decay: over {facts.steps} steps the product of L_k A_k {factor}, in "
        f"{', '.join(map(repr, names))}. Either these states are unobservable: measure more, or leave them out; or Q "
        "and initial_covariance claim that they are known exactly: give them a variance.",
        condition="contraction",
        signals=names,
    )


def _notes(
    observer: RecursiveObserver,
    ranks: HorizonRanks,
    facts: GainScheduleSummary,
    missing: Sequence[str],
    *,
    own_units: bool,
) -> Iterator[str]:
    if missing:
        units = ", in units in which the plant is near one (those given are far from these)"
        yield (
            f"No noise is stated: {' and '.join(missing)} taken as the identity{units if own_units else ''}, which "
            "sets gains and deviations."
        )
    if ranks.condition > WARN_MARKOV_CONDITION:
        yield (
            f"H_k has the condition number {ranks.condition:.3g} at k = {ranks.condition_k}: about "
            f"{np.log10(ranks.condition):.0f} digits of the estimate are lost there."
        )
    if observer.plant.is_time_invariant and observer.Q.is_constant and observer.R.is_constant:
        roots = covariance_factor(observer.Q.at(0), "Q"), covariance_factor(observer.R.at(0), "R")
        reached = reached_condition(observer.plant, *roots)
        if not reached.holds:
            yield f"The filter has no steady state: {reached.detail}"
    adaptation = observer.adaptation
    if adaptation is None:
        return
    if adaptation.window > facts.steps:
        yield (
            f"The window of {adaptation.window} samples is longer than the {facts.steps} steps of the horizon: "
            "excitation is not watched."
        )
    prior = float(np.linalg.eigvalsh(np.linalg.inv(adaptation.initial_covariance))[0])
    if facts.excitation < LOST_EXCITATION * prior:
        yield (
            f"The parameters are poorly excited in the window that ends at k = {facts.excitation_k} (information "
            f"{facts.excitation:.3g}, the prior has {prior:.3g}): the values reported there are the prior ones"
            + (
                "."
                if adaptation.form == "random-walk" or adaptation.guard != "none"
                else ", and without a guard S winds up."
            )
        )
    if adaptation.form == "literal" and ranks.directions < observer.plant.ny:
        yield (
            f"The literal form (18) uses {counted(ranks.directions, 'residual direction')} of "
            f"{counted(observer.plant.ny, 'output')}; the innovation form uses all parity directions."
        )
