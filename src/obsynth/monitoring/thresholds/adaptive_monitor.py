"""The adaptive threshold of a design with tolerances, and the statement of its guarantee."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError, SpecError
from obsynth.methods.tracking import structure_of, tracking_of
from obsynth.monitoring.thresholds.adaptive_rule import AdaptiveRule
from obsynth.monitoring.thresholds.monitor import BOUNDS_AND_HELD_INPUTS, HELD, Rule
from obsynth.monitoring.thresholds.residual_model import noisy_plant
from obsynth.monitoring.thresholds.rules import NormRule
from obsynth.monitoring.thresholds.sampled_errors import SAMPLING, sampled_problem
from obsynth.monitoring.thresholds.watched_rows import estimates_modelled_faults
from obsynth.numerics.arguments import is_finite_number, require_mapping
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.constants import shown
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.signal_names import require_known
from obsynth.plants.transformations.moving_disturbances import with_moving_disturbances
from obsynth.plants.transformations.uncertain_plant import AffinePlant, affine_plant
from obsynth.plants.uncertainty import SAMPLED
from obsynth.results.design import ObserverDesign
from obsynth.simulation.scenario import Scenario
from obsynth.simulation.signals import resolve
from obsynth.verification.assumptions import Assumptions
from obsynth.verification.over_tolerances.adaptive_bound import Start, adaptive_bound
from obsynth.verification.over_tolerances.adaptive_recursion import AdaptivePlan
from obsynth.verification.over_tolerances.error_structure import ErrorStructure, Tracking, error_structure
from obsynth.verification.over_tolerances.responses import loop_radius
from obsynth.verification.over_tolerances.stated_tolerances import EXACT_MODEL, with_tolerances
from obsynth.verification.over_tolerances.subdivision import index_one_on_box, values_at

#: Radii of a set are made larger by this share: more than the rounding of their sums.
RADIUS_OUTWARD = 1e-12

#: What a statement adds where no tolerance is known.
NO_TOLERANCE = f"; {EXACT_MODEL}"


def adaptive_plan(
    design: ObserverDesign,
    bounds: FloatArray,
    noise_bound: float,
    *,
    initial_error: float | None,
    initial_set: Mapping[str, Any] | None,
    observer_state: FloatArray | None = None,
    sample_time: float | None = None,
    disturbance: str = "any",
) -> tuple[AdaptivePlan, AdaptivePlan]:
    """Return the plans from the first start on and after a later one, over the plant's box, if there is a bound."""
    plant, observer = design.linear
    if plant.uncertainty is not None and plant.uncertainty.box.names:
        proof = index_one_on_box(plant)
        if proof.verdict == "refuted" and proof.at is not None:
            values = values_at(plant.uncertainty.box, proof.at)
            where = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
            raise PreconditionError(
                f"The plant is singular, or not of index 1, inside the box: at {where}. Give smaller tolerances.",
                condition="regularity",
            )
    if not plant.is_discrete:
        return _sampled_plan(design, bounds, noise_bound, initial_error, initial_set, observer_state, sample_time)
    affine = affine_plant(plant)
    tracking = tracking_of(design, affine)
    if disturbance == "any":
        affine = with_moving_disturbances(affine)
    varying = affine.box.variation == "varying"
    noise = noise_bound if plant.nw else 0.0
    sizes = np.where(np.isfinite(bounds), bounds, 0.0)
    structure = structure_of(design, affine, tracking, bounds=sizes, noise_bound=noise)
    _require_bounds(structure, affine, bounds, plant)
    z = np.zeros(observer.order) if observer_state is None else observer_state
    start = start_of(affine, tracking, initial_error, initial_set, z)
    later = Start(observer.order, norm=initial_error, state=z)
    reason, faults, same = "", None, False
    try:
        with_faults = structure_of(design, affine, tracking, bounds=sizes, noise_bound=noise, faults=True)
        same = affine.Bf.is_certain and affine.Df.is_certain
        faults = None if same else with_faults
    except PreconditionError as error:
        reason = str(error)

    def plan(begin: Start) -> AdaptivePlan:
        return AdaptivePlan(
            adaptive_bound(structure, observer, begin, varying=varying),
            None if faults is None else adaptive_bound(faults, observer, begin, varying=varying),
            same,
            reason,
            begin.norm is None,
            estimates_modelled_faults(design) or not observer.residual_names,
            affine.box.names,
            observer.fault_names,
            observer.residual_names,
        )

    return plan(start), plan(later)


def _sampled_plan(
    design: ObserverDesign,
    bounds: FloatArray,
    noise_bound: float,
    initial_error: float | None,
    initial_set: Mapping[str, Any] | None,
    observer_state: FloatArray | None,
    sample_time: float | None,
) -> tuple[AdaptivePlan, AdaptivePlan]:
    """Return the plans of a continuous design, whose observer runs on samples."""
    plant, observer = design.linear
    if sample_time is None:
        raise SpecError("A continuous design needs the sample_time of its data.", path="sample_time")
    noise = noise_bound if plant.nw else 0.0
    problem = sampled_problem(design, sample_time, np.where(np.isfinite(bounds), bounds, 0.0), noise)
    structure = error_structure(
        problem.observer, problem.affine, problem.tracking, problem.bounds, noise, reading=problem.reading
    )
    _require_bounds(structure, problem.affine, bounds, plant)
    z = np.zeros(observer.order) if observer_state is None else observer_state
    box = None if initial_set is None else initial_box(plant, initial_set)
    stated = Start(observer.order, norm=initial_error, state=z)
    why = "the fault is estimated through the dynamics of a continuous design, which a change of it takes time to pass"

    def plan(begin: Start) -> AdaptivePlan:
        bound = adaptive_bound(structure, problem.observer, begin, varying=False)
        return AdaptivePlan(
            bound=replace(bound, first=problem.first),
            faults=None,
            same=False,
            reason=why,
            start_beyond_nominal=True,
            estimates=estimates_modelled_faults(design),
            names=(*problem.affine.box.names, SAMPLING),
            fault_names=observer.fault_names,
            residual_names=observer.residual_names,
            sample_time=sample_time,
        )

    return plan(problem.start(stated, box)), plan(problem.start(stated, None))


def _require_bounds(
    structure: ErrorStructure, affine: AffinePlant, bounds: FloatArray, plant: DescriptorSystem
) -> None:
    """Raise `SpecError` where a disturbance without a bound reaches the error."""
    reaches_error = structure.disturbances.magnitude.max(axis=0, initial=0.0) > 0.0
    lacking = []
    for i in np.flatnonzero(~np.isfinite(bounds)).tolist():
        # The columns that this disturbance alone would move.
        own = affine.disturbance_bounds(np.eye(1, plant.nd, i).ravel()) > 0.0
        if (reaches_error[: len(own)] & own).any():
            lacking.append(i)
    if lacking:
        names = ", ".join(plant.disturbance_names[i] for i in lacking)
        raise SpecError(
            f"No bound is given on {names}: give disturbance_bounds (--disturbance).", path="disturbance_bounds"
        )


def start_of(
    affine: AffinePlant,
    tracking: Tracking,
    initial_error: float | None,
    initial_set: Mapping[str, Any] | None,
    z: FloatArray,
) -> Start:
    """Return what is known of eps at the start, ``z - T E(q) x`` for x in a box."""
    plant = affine.plant
    if initial_set is None:
        return Start(len(z), norm=initial_error, state=z)
    center, radius = initial_box(plant, initial_set)
    back = 2.0 * np.eye(plant.nx) - affine.coordinates
    followed = affine.E.after(tracking.T) @ back
    offset = followed.center @ center
    size = np.abs(followed.center) @ radius + (followed.spread + followed.radius) @ (np.abs(center) + radius)
    return Start(len(z), center=z - offset, radius=size * (1.0 + RADIUS_OUTWARD), state=z)


def initial_box(plant: DescriptorSystem, initial_set: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return middle and half width ``(nx,)`` of the plant's start; states that E does not see need no entry."""
    require_mapping(initial_set, "initial_set")
    center, radius = np.zeros(plant.nx), np.zeros(plant.nx)
    needed = np.abs(plant.E).max(axis=0, initial=0.0) > 0.0
    require_known(initial_set, plant.state_names, what="initial_set", kind="state")
    for i, name in enumerate(plant.state_names):
        if name not in initial_set:
            if needed[i]:
                raise SpecError(
                    f"initial_set has no entry for the state {name!r}: give a bound, or [low, high].",
                    path="initial_set",
                )
            continue
        value = initial_set[name]
        ends = list(value) if isinstance(value, (list, tuple, np.ndarray)) else [value]
        if len(ends) == 1 and is_finite_number(value):
            ends = [-value, value]
        if len(ends) != 2 or not all(map(is_finite_number, ends)) or not ends[0] <= ends[1]:
            raise SpecError(
                f"initial_set of {name!r} is {value!r}: give a bound of its absolute value, or [low, high].",
                path="initial_set",
            )
        low, high = map(float, ends)
        center[i], radius[i] = (low + high) / 2.0, (high - low) / 2.0
    return center, radius


def adaptive_statement(plan: AdaptivePlan, assumed: Assumptions) -> str:
    """Return what an alarm proves, what it rests on, and what bounds may do in the long run."""
    uncertain, box = assumed.plant.uncertainty, assumed.box
    assumptions = assumed.bounds_phrase if box is None else assumed.phrase()
    outside = "" if box is None else f": an alarm is a fault, or {box.sentence}"
    text = f"never passed without a fault{f', with {assumptions}' if assumptions else ''}{outside}"
    held = ""
    if assumed.plant.is_discrete and assumed.plant.nd:
        held = BOUNDS_AND_HELD_INPUTS.format(dt=shown(assumed.plant.dt)) if assumed.moves else HELD
    if box is None:
        return text + held + NO_TOLERANCE
    steps = () if uncertain is None else uncertain.steps
    sampled = any(kind == SAMPLED for kind, _ in steps)
    motion = ""
    if box.variation != "constant":
        motion = "; the state does not jump" if sampled else "; the value at k + 1 multiplies x(k+1)"
    radius = loop_radius(plan.bound.responses)
    ever = "" if radius < 1.0 else (f"; it holds at each sample, but may grow (loop radius {radius:.3g})")
    if plan.sample_time is not None:
        apart = shown(plan.sample_time)
        held = f"; known inputs are held between rows, {apart} s apart, disturbances may move in between"
    why = (plan.reason[:1].lower() + plan.reason[1:]).partition(": ")[0].rstrip(".")
    missing = "" if plan.intervals or not plan.fault_names else f"; no guaranteed interval of faults: {why}"
    linear = "" if uncertain is None or not uncertain.not_covered else f"; {uncertain.not_covered}"
    return f"{text}{motion}{held}{ever}{missing}{linear}"


def tolerances_of(
    design: ObserverDesign,
    constants: Any,
    initial_set: Mapping[str, Any] | None,
    initial_error: float | None,
) -> tuple[ObserverDesign, bool]:
    """Return the design with the tolerances asked for, and whether its threshold adapts to the signals."""
    adapts = constants is not None or initial_set is not None
    if initial_set is not None and initial_error is not None:
        raise SpecError("Give initial_set or initial_error, not both.", path="initial_set")
    return with_tolerances(design, constants)[0], adapts


def noisy_design(design: ObserverDesign, scenario: Scenario | None) -> ObserverDesign:
    """Return a design whose plant has the noise of a scenario; tolerances stay."""
    if scenario is None:
        return design
    plant, _ = design.linear
    noise = noisy_plant(plant, scenario, resolve(plant, scenario))
    acting = noise.Bw.any(axis=0) | noise.Dw.any(axis=0)
    return design.replace(plant=noise.replace(Bw=noise.Bw[:, acting], Dw=noise.Dw[:, acting], noise_names=None))


def over_box(
    noisy: ObserverDesign,
    nominal: NormRule | None,
    bounds: FloatArray,
    noise_bound: float | None,
    initial_error: float | None,
    initial_set: Mapping[str, Any] | None,
    *,
    sample_time: float | None = None,
    scenario: Scenario | None = None,
    disturbance: str = "any",
    noise_left_out: bool = False,
    noise_as_bounds: bool = False,
) -> tuple[Rule, str]:
    """Return the pointwise rule over the box of the plant of a design with the noise that is bounded, and what it
    promises: for a record of a scenario, from its start unless one is given, or for data, which may have gaps."""
    plant, _ = noisy.linear
    state = None
    if scenario is not None:
        if not plant.is_discrete and scenario.inputs:
            raise PreconditionError(
                "The design is continuous in time, and the inputs of a scenario move between its samples: thresholds "
                "over tolerances need inputs that are held. Sample the plant first (transform: sample_time).",
                condition="discrete time",
            )
        state = None if scenario.observer_state is None else np.array(scenario.observer_state)
        sample_time = None if plant.is_discrete else scenario.sample_time
        if initial_set is None and initial_error is None:
            initial_set = {name: (scenario.initial_state.get(name, 0.0),) * 2 for name in plant.state_names}
    first, later = adaptive_plan(
        noisy,
        bounds,
        noise_bound or 0.0,
        initial_error=initial_error,
        initial_set=initial_set,
        observer_state=state,
        sample_time=sample_time,
        disturbance=disturbance,
    )
    assumed = Assumptions(
        plant,
        bounds,
        noise_bound or 0.0,
        initial_set,
        initial_error=initial_error,
        disturbance=disturbance,
        noise_left_out=noise_left_out,
        noise_as_bounds=noise_as_bounds,
    )
    rule = AdaptiveRule(first, later if scenario is None else first, nominal)
    return rule, adaptive_statement(first, assumed)
