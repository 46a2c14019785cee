"""Robust stability and bounds of a design for every plant in the box of its constants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from obsynth.errors import PreconditionError
from obsynth.methods.tracking import structure_of, tracking_of
from obsynth.numerics.arguments import arguments_checked
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.constants import ConstantsBox
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.elimination import eliminate_algebraic_states
from obsynth.plants.transformations.uncertain_plant import (
    ROW_ROUNDING_SHARE,
    AffinePlant,
    affine_plant,
    moving_basis,
    moving_family,
    untouched_states,
)
from obsynth.plants.uncertainty import SAMPLED, as_written
from obsynth.proofs.affine import AffineMatrix
from obsynth.results.design import ObserverDesign
from obsynth.studies.robustness_result import Robustness
from obsynth.verification.over_tolerances.constants_like_faults import acting_like_faults
from obsynth.verification.over_tolerances.plants_of_the_box import plant_as_written_at
from obsynth.verification.over_tolerances.responses import (
    Responses,
    blame,
    blamed_rows,
    largest_factor,
    loop_radius,
    responses_of,
    same_sample_inverse,
)
from obsynth.verification.over_tolerances.stated_tolerances import EXACT_MODEL, with_tolerances
from obsynth.verification.over_tolerances.subdivision import (
    MOST_BOXES,
    BoxVerdict,
    index_one_on_box,
    proved_stable,
    values_at,
)
from obsynth.verification.over_tolerances.vertex_gains import vertex_gains

#: Boxes for stability after which it is left open where most states are algebraic: each elimination takes long.
FEW_BOXES = 40

#: What is reported of the loop where nothing is known of it.
_NO_LOOP: Mapping[str, Any] = {
    "loop_radius": None,
    "largest_factor": None,
    "blame": {},
    "rows": {},
    "error_per_unit": {},
    "vertex_gains": {},
    "reason": "",
}


@arguments_checked
def robustness(
    design: ObserverDesign, *, constants: Any = None, progress: Callable[[str], None] | None = None
) -> Robustness:
    """Return what a linear discrete-time design guarantees for every plant in the box of its constants.

    Parameters
    ----------
    design : ObserverDesign
        Linear; of a plant with tolerances (`obsynth.uncertain_system`, or ``constants`` in a spec).
    constants : mapping, ConstantsBox or DescriptorSystem, optional
        Tolerances instead of the plant's own, as `obsynth.uncertain_system` takes them.
    progress : callable, optional
        Called with a text before each step.

    Returns
    -------
    Robustness
        Print it for a dozen lines.

    Raises
    ------
    SpecError
        The design is not linear, or a tolerance is malformed.

    Notes
    -----
    The loop's radius is that of ``H = D0 + sum_j D_j``, what the error adds to itself through what is uncertain, with
    the tail of the sum proved.  Below 1 all bounds stay finite for ever (sufficient for constant and varying
    constants).  The largest tolerance is found by bisection, all matrices built anew.  Stability and regularity are
    proved by cutting the box; a point that refutes them is named.  Theory: M. Khammash and J. Pearson,
    "Performance robustness of discrete-time systems with structured uncertainty", IEEE TAC 36, 1991.

    Examples
    --------
    >>> import obsynth
    >>> plant = obsynth.uncertain_system(
    ...     {"A": [["a"]], "C": [[1]], "Bf": [[1]], "dt": 1.0}, {"a": {"nominal": 0.5, "tolerance": "5 %"}}
    ... )
    >>> margins = obsynth.robustness(obsynth.fault_estimation_filter(plant))
    >>> margins.stable
    'proved'
    """
    design, plant = with_tolerances(design, constants)
    report_stage = progress or (lambda text: None)
    uncertain = plant.uncertainty
    if uncertain is None or not uncertain.box.names:
        return _of_the_exact_model(ConstantsBox({}) if uncertain is None else uncertain.box)
    report_stage("regularity over the box")
    regular = index_one_on_box(plant)
    loop: dict[str, Any] = dict(_NO_LOOP)
    try:
        affine = affine_plant(plant)
        report_stage("stability over the box")
        stable, untouched = _stability(plant, affine)
        loop |= _loop(design, plant, affine, report_stage)
    except PreconditionError as error:
        stable, untouched = BoxVerdict("open", 0), ()
        loop["reason"] = str(error)
    broken = regular if regular.verdict == "refuted" else stable
    return Robustness(
        box=uncertain.box,
        assumes_exact_model=False,
        regular=regular.verdict,
        breaking={} if broken.at is None or broken.verdict != "refuted" else values_at(uncertain.box, broken.at),
        stable=stable.verdict,
        boxes=stable.boxes,
        sharing=acting_like_faults(plant),
        untouched=untouched,
        not_covered=uncertain.not_covered,
        design=design,
        **loop,
    )


def _of_the_exact_model(box: ConstantsBox) -> Robustness:
    """Return what is known where no constant has a tolerance: nothing about another plant."""
    return Robustness(
        box=box,
        assumes_exact_model=True,
        regular="open",
        breaking={},
        stable="open",
        boxes=0,
        **{**_NO_LOOP, "reason": EXACT_MODEL},
    )


def _loop(
    design: ObserverDesign, plant: DescriptorSystem, affine: AffinePlant, report_stage: Callable[[str], None]
) -> dict[str, Any]:
    """Return the fields of `Robustness` about what the error adds to itself; where one does not exist those before it
    stay, with the reason."""
    box = affine.box
    loop: dict[str, Any] = {}
    try:
        report_stage("loop over the box")
        tracking = tracking_of(design, affine)
        responses = responses_of(structure_of(design, affine, tracking))
        radius = loop["loop_radius"] = loop_radius(responses)
        try:
            same_sample_inverse(responses)
        except PreconditionError as error:
            # No bound holds at a sample; all else is reported.
            loop["reason"] = str(error)
        report_stage("largest tolerances")
        loop["largest_factor"] = largest_factor(
            lambda t: structure_of(design, affine_plant(plant, box.scaled(t)), tracking), radius
        )
        loop["blame"] = _named((*box.names, "remainders"), blame(responses))
        parts = (affine.E.parts, affine.A.parts)
        loop["rows"] = _named(plant.state_names, blamed_rows(responses, tracking.T, parts))
        loop["error_per_unit"] = _error_per_unit(design, responses, affine)
        report_stage("gains at the vertices")
        loop["vertex_gains"] = vertex_gains(design, plant, affine, tracking)
    except PreconditionError as error:
        loop["reason"] = str(error)
    return loop


def _named(names: tuple[str, ...], shares: FloatArray) -> dict[str, float]:
    return {name: float(share) for name, share in zip(names, shares, strict=True)}


def _stability(plant: DescriptorSystem, affine: AffinePlant) -> tuple[BoxVerdict, tuple[complex, ...]]:
    """Return whether the plant is stable on the box, but for modes that no constant touches, and these."""
    box, uncertain = affine.box, plant.uncertainty
    sampled = uncertain is not None and any(kind == SAMPLED for kind, _ in uncertain.steps)
    discrete = plant.is_discrete and not sampled
    basis = moving_basis(plant, box)
    family = moving_family(plant, box, basis)
    least = np.vstack([np.abs(family.center), family.spread + family.radius])
    size = family.magnitude.sum(axis=1)
    apart = untouched_states(least, np.concatenate([size, size]))
    values = np.linalg.eigvals(family.center[np.ix_(apart, apart)])
    outside = (
        np.abs(values) >= 1.0 - ROW_ROUNDING_SHARE if discrete else values.real >= -ROW_ROUNDING_SHARE * size.max()
    )
    lasting = tuple(complex(value) for value in values[outside])
    # Stable modes that no constant touches are stable everywhere.
    touched = [i for i in range(len(family.center)) if i not in apart]
    if not touched:
        return BoxVerdict("proved", 0), lasting
    back = 2.0 * np.eye(len(basis)) - basis

    def exactly(q: FloatArray) -> FloatArray:
        bare = plant if plant.uncertainty is None else plant_as_written_at(plant, plant.uncertainty, box.values(q))
        # Of the signals nothing is asked: without them the elimination has a tenth of the columns.
        moving = DescriptorSystem(E=bare.E, A=bare.A, C=np.zeros((1, bare.nx)), dt=bare.dt)
        reduced = eliminate_algebraic_states(moving).plant.A
        return np.asarray((back @ reduced @ basis)[np.ix_(touched, touched)])

    def build(lower: FloatArray, upper: FloatArray) -> AffineMatrix:
        return moving_family(plant, box.part(lower, upper), basis)[touched, touched]

    most = MOST_BOXES if uncertain is None or len(basis) * 4 > len(as_written(plant, uncertain)["A"]) else FEW_BOXES
    return proved_stable(build, affine.count, exactly, discrete=discrete, most=most), lasting


def _error_per_unit(design: ObserverDesign, responses: Responses, affine: AffinePlant) -> dict[str, dict[str, float]]:
    """Return by output: what one unit of each state and input adds, first order and remainders, for ever."""
    plant, observer = design.linear
    structure = responses.structure
    inner, _, outputs = structure.rows
    back = 2.0 * np.eye(plant.nx) - affine.coordinates
    total = np.zeros((len(structure.Co), plant.nx + plant.nu))
    for i in range(affine.count):
        part = np.hstack([structure.state.parts[i] @ back, structure.inputs.parts[i]])
        total += (1.0 + abs(structure.offsets[i])) * responses.gain(structure.Co, part[inner], part[outputs])
    remainder = np.hstack([structure.state.radius @ np.abs(back), structure.inputs.radius])
    total += responses.absolute_gain(structure.Co, remainder[inner]) + remainder[outputs]
    names = (*plant.state_names, *plant.input_names)
    return {
        label: _named(names, row)
        for label, row in zip(observer.row_names[len(observer.state_names) :], total, strict=True)
    }
