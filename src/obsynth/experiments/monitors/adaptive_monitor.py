"""From a design with tolerances to an adaptive threshold, and the sentence that says what it promises."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import AffinePlant, affine_plant
from obsynth.errors import PreconditionError, SpecError
from obsynth.experiments.monitors.adaptive_bound import Start, adaptive_bound
from obsynth.experiments.monitors.adaptive_rule import AdaptivePlan
from obsynth.experiments.monitors.adaptive_sampling import PIECES, SAMPLING, sampled_problem
from obsynth.experiments.monitors.residual_model import watches_estimates
from obsynth.numerics.arguments import is_finite_number, require_mapping
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.uncertainty import SAMPLED
from obsynth.results.design import ObserverDesign
from obsynth.tolerances.error_structure import ErrorStructure, error_structure
from obsynth.tolerances.exact_plant import Tracking, tracking_of
from obsynth.tolerances.responses import loop_radius
from obsynth.tolerances.result import EXACT_MODEL
from obsynth.tolerances.robustness import structure_of, with_tolerances
from obsynth.tolerances.subdivision import index_one_on_box, values_at

#: Radii of a set are made larger by this share: more than the rounding of their sums.
OUTWARD = 1e-12
#: What a statement adds where no tolerance is known.
EXACT = f"; {EXACT_MODEL}"


def adaptive_plan(
    design: ObserverDesign, bounds: FloatArray, noise_bound: float, *, initial_error: float | None,
    initial_set: Mapping[str, Any] | None, observer_state: FloatArray | None = None, sample_time: float | None = None,
) -> tuple[AdaptivePlan, AdaptivePlan]:  # fmt: skip
    """Return the plans from the first start on and after a later one, over the plant's box, if there is a bound."""
    plant, observer = design.linear
    _require_regular(plant)
    if not plant.is_discrete:
        return _sampled_plan(design, bounds, noise_bound, initial_error, initial_set, observer_state, sample_time)
    affine = affine_plant(plant)
    tracking = tracking_of(design, affine)
    varying = affine.box.variation == "varying"
    noise = noise_bound if plant.nw else 0.0
    sizes = np.where(np.isfinite(bounds), bounds, 0.0)
    structure = structure_of(design, affine, tracking, bounds=sizes, noise_bound=noise)
    _require_bounds(structure, bounds)
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
            None if faults is None else adaptive_bound(faults, observer, begin, varying=varying), same, reason,
            begin.norm is None, watches_estimates(design), affine.box.names, observer.fault_names,
            observer.residual_names,
        )  # fmt: skip

    return plan(start), plan(later)


def _sampled_plan(
    design: ObserverDesign, bounds: FloatArray, noise_bound: float, initial_error: float | None,
    initial_set: Mapping[str, Any] | None, observer_state: FloatArray | None, sample_time: float | None,
) -> tuple[AdaptivePlan, AdaptivePlan]:  # fmt: skip
    """Return the plans of a continuous design, whose observer runs on samples."""
    plant, observer = design.linear
    if sample_time is None:
        raise SpecError("A continuous design needs the sample_time of its data.", path="sample_time")
    noise = noise_bound if plant.nw else 0.0
    problem = sampled_problem(design, sample_time, np.where(np.isfinite(bounds), bounds, 0.0), noise)
    structure = error_structure(
        problem.observer, problem.affine, problem.tracking, problem.bounds, noise, reading=problem.reading
    )
    _require_bounds(structure, np.tile(bounds, PIECES + 1))
    z = np.zeros(observer.order) if observer_state is None else observer_state
    box = None if initial_set is None else initial_box(plant, initial_set)
    stated = Start(observer.order, norm=initial_error, state=z)
    why = "the fault is estimated through the dynamics of a continuous design, which a change of it takes time to pass"

    def plan(begin: Start) -> AdaptivePlan:
        bound = adaptive_bound(structure, problem.observer, begin, varying=False)
        return AdaptivePlan(
            replace(bound, first=problem.first), None, False, why, True, watches_estimates(design),
            (*problem.affine.box.names, SAMPLING), observer.fault_names, observer.residual_names, sample_time,
        )  # fmt: skip

    return plan(problem.start(stated, box)), plan(problem.start(stated, None))


def _require_bounds(structure: ErrorStructure, bounds: FloatArray) -> None:
    """Raise `SpecError` where a disturbance without a bound reaches the error."""
    reached = structure.disturbances.magnitude.max(axis=0, initial=0.0)[: len(bounds)] > 0.0
    if np.any(reached & ~np.isfinite(bounds)):
        raise SpecError("A disturbance has no bound: give disturbance_bounds (--disturbance).",
                        path="disturbance_bounds")  # fmt: skip


def _require_regular(plant: DescriptorSystem) -> None:
    """Refuse a box with a plant that is singular, or not of index 1."""
    uncertain = plant.uncertainty
    if uncertain is None or not uncertain.box.names:
        return
    found = index_one_on_box(plant)
    if found.verdict == "refuted" and found.at is not None:
        where = ", ".join(f"{name} = {value:.6g}" for name, value in values_at(uncertain.box, found.at).items())
        raise PreconditionError(
            f"The plant is singular, or not of index 1, inside the box: at {where}. Give smaller tolerances.",
            condition="regularity",
        )


def start_of(
    affine: AffinePlant, tracking: Tracking, initial_error: float | None, initial_set: Mapping[str, Any] | None,
    z: FloatArray,
) -> Start:  # fmt: skip
    """Return what is known of eps at the start, ``z - T E(q) x`` for x in a box."""
    plant = affine.plant
    if initial_set is None:
        return Start(len(z), norm=initial_error, state=z)
    center, radius = initial_box(plant, initial_set)
    back = 2.0 * np.eye(plant.nx) - affine.coordinates
    followed = affine.E.after(tracking.T) @ back
    offset = followed.center @ center
    size = np.abs(followed.center) @ radius + (followed.spread + followed.radius) @ (np.abs(center) + radius)
    return Start(len(z), center=z - offset, radius=size * (1.0 + OUTWARD), state=z)


def initial_box(plant: DescriptorSystem, given: Mapping[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return middle and half width ``(nx,)`` of the plant's start; states that E does not see need no entry."""
    require_mapping(given, "initial_set")
    center, radius = np.zeros(plant.nx), np.zeros(plant.nx)
    needed = np.abs(plant.E).max(axis=0, initial=0.0) > 0.0
    unknown = sorted(set(given) - set(plant.state_names))
    if unknown:
        raise SpecError(f"initial_set has the unknown state {unknown[0]!r}; there are {', '.join(plant.state_names)}.",
                        path="initial_set")  # fmt: skip
    for i, name in enumerate(plant.state_names):
        if name not in given:
            if needed[i]:
                raise SpecError(f"initial_set has no entry for the state {name!r}: give a bound, or [low, high].",
                                path="initial_set")  # fmt: skip
            continue
        value = given[name]
        ends = list(value) if isinstance(value, (list, tuple, np.ndarray)) else [value]
        if len(ends) == 1 and is_finite_number(value):
            ends = [-value, value]
        if len(ends) != 2 or not all(map(is_finite_number, ends)) or not ends[0] <= ends[1]:
            raise SpecError(f"initial_set of {name!r} is {value!r}: give a bound of its absolute value, or "
                            "[low, high].", path="initial_set")  # fmt: skip
        low, high = map(float, ends)
        center[i], radius[i] = (low + high) / 2.0, (high - low) / 2.0
    return center, radius


def adaptive_statement(plan: AdaptivePlan, design: ObserverDesign) -> str:
    """Return what an alarm proves, and what bounds may do in the long run."""
    uncertain = design.linear[0].uncertainty
    box = None if uncertain is None or not uncertain.box.names else uncertain.box
    outside = "a model that is not exact" if box is None else box.sentence
    text = (
        "never passed without a fault since the start while constants, disturbances, noise and the start keep their "
        f"bounds: an alarm is a fault, or {outside}; a fault that passes it need not last: an interval that excludes "
        "zero says that it does"
    )
    if box is None:
        return text + EXACT
    steps = () if uncertain is None else uncertain.steps
    sampled = any(kind == SAMPLED for kind, _ in steps)
    kept = "constants stay the same" if box.variation == "constant" else (
        "constants may change at each sample (where the state does not jump)" if sampled else
        "constants may change at each sample (the value at k + 1 multiplies x(k+1))"
    )  # fmt: skip
    radius = loop_radius(plan.bound.responses)
    ever = "" if radius < 1.0 else (
        f"; the loop through the tolerances has radius {radius:.3g}: the threshold holds at each sample, but may grow"
    )  # fmt: skip
    held = "; inputs and disturbances are held between samples" if sampled else ""
    if plan.sample_time is not None:
        held = "; known inputs are held between rows, which are the sample time apart, disturbances may move in between"
    missing = "" if plan.intervals or not plan.fault_names else f"; no guaranteed interval of faults: {plan.reason}"
    linear = "" if uncertain is None or not uncertain.not_covered else f"; {uncertain.not_covered}"
    return f"{text}; {kept}{held}{ever}{missing}{linear}"


def tolerances_of(
    design: ObserverDesign, kind: str, constants: Any, initial_set: Mapping[str, Any] | None,
    initial_error: float | None,
) -> tuple[ObserverDesign, bool]:  # fmt: skip
    """Return the design with the tolerances asked for, and whether its threshold adapts to the signals."""
    asked = [name for name, given in (("constants", constants), ("initial_set", initial_set)) if given is not None]
    if asked and kind != "pointwise":
        raise SpecError(f"{asked[0]} is for the pointwise monitor.", path=asked[0])
    if initial_set is not None and initial_error is not None:
        raise SpecError("Give initial_set or initial_error, not both.", path="initial_set")
    return with_tolerances(design, constants)[0], bool(asked)
