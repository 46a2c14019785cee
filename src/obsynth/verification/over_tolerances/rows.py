"""Checks of the tolerances in a gain set: they are those of the plant as written and of the design's plant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.errors import ObsynthError
from obsynth.numerics.sparse import dense, same_matrix
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.transformations.uncertain_plant import affine_plant
from obsynth.plants.uncertainty import ELIMINATED, SAMPLED, UNCERTAIN_MATRICES, Uncertainty, as_written
from obsynth.results.checks import Check, information, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.results.plant_source import PlantSource
from obsynth.verification.plant import FAMILY_TOLERANCE, STORED_TWICE, relative_difference


def tolerance_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the checks that the stored tolerances belong to the plant that the design is for."""
    plant, source = design.plant, design.source
    uncertain = plant.uncertainty if isinstance(plant, DescriptorSystem) else None
    if not isinstance(plant, DescriptorSystem) or uncertain is None:
        return
    if uncertain.lost:
        yield information(
            "tolerances",
            f"not carried over ({uncertain.lost}): the design is for the nominal plant, and whatever would use them "
            "refuses",
            np.nan,
            source="the plant",
            status="assumed",
        )
        return
    wrong = [*_not_nominal(plant, uncertain), *(_not_of(uncertain, source) if source is not None else ())]
    if any(kind not in (ELIMINATED, SAMPLED) for kind, _ in uncertain.steps):
        wrong.append("steps")
    yield nothing_wrong(
        "tolerances as written",
        "the entries at nominal values are those of the plant as written, and the steps since "
        "are those of the design's plant",
        wrong,
        source=STORED_TWICE,
    )
    if wrong:
        return
    if uncertain.box.source == "calibrated":
        yield information(
            "calibration", f"the box is the {uncertain.box.origin}, of the calibration file "
            f"{uncertain.box.calibration[:12] or 'that is not named'}: assumed, unless it is given (--calibration)",
            np.nan, source="the plant", status="assumed",
        )  # fmt: skip
    try:
        missed = _family_difference(plant, uncertain)
        detail = ""
    except ObsynthError as error:
        # No bound over the box exists, and a request for one raises an error.  The nominal plant was compared above.
        missed, detail = 0.0, f"no family over the box: {error}"
    yield upper_bound_check(
        "tolerances of the plant",
        "eliminated and sampled over the box, the plant as written contains the plant of the design",
        missed,
        FAMILY_TOLERANCE,
        source=STORED_TWICE,
        kind="equality",
        detail=detail,
    )


def _not_nominal(plant: DescriptorSystem, uncertain: Uncertainty) -> Iterator[str]:
    """Yield the matrices whose entries differ from their expressions at the nominal values."""
    written = as_written(plant, uncertain)
    values = {name: item.nominal for name, item in uncertain.box.constants.items()}
    try:
        filled = uncertain.filled(written, values)
    except (IndexError, ArithmeticError, ValueError, ObsynthError):
        yield "entries"
        return
    for name in UNCERTAIN_MATRICES:
        if not same_matrix(filled[name], written[name]):
            yield f"{name} at nominal values"
    if (uncertain.written is None) != (not uncertain.steps):
        yield "steps"


def _not_of(uncertain: Uncertainty, source: PlantSource) -> Iterator[str]:
    """Yield the names of what differs between the tolerances and the stored plant as written."""
    sampled = [size for kind, size in uncertain.steps if kind == SAMPLED]
    if uncertain.written is None:
        return
    for name in UNCERTAIN_MATRICES:
        if not np.array_equal(
            np.asarray(dense(uncertain.written[name])), np.asarray(dense(getattr(source.plant, name)))
        ):
            yield f"{name} as written"
    if sampled != ([] if source.sample_time is None else [source.sample_time]):
        yield "sample time"


def _family_difference(plant: DescriptorSystem, uncertain: Uncertainty) -> float:
    """Return the difference between the plant and the nominal plant of its family, beyond the family's remainders."""
    box = uncertain.box
    alone = {name: replace(item, low=item.nominal, high=item.nominal) for name, item in box.constants.items()}
    family = affine_plant(plant, replace(box, constants=alone))
    if len(family.coordinates) != plant.nx:
        return float("inf")
    differences = []
    for name in UNCERTAIN_MATRICES:
        stored, middle = np.asarray(dense(getattr(plant, name))), family.matrices[name]
        expected = stored @ family.coordinates if name in ("E", "A", "C") else stored
        differences.append(relative_difference(expected, middle.center, middle.radius))
    return float(np.max(differences))
