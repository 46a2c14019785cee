"""Rows on what a gain set stores more than once: tolerances and names, against the plant as written and the design."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from obsynth.analysis.transformations.uncertain_plant import affine_plant
from obsynth.errors import ObsynthError
from obsynth.numerics.sparse import dense, same_matrix
from obsynth.plants.descriptor import SIGNAL_NAMES, DescriptorSystem
from obsynth.plants.uncertainty import ELIMINATED, SAMPLED, UNCERTAIN_MATRICES, Uncertainty, as_written
from obsynth.results.checks import Check, information, nothing_wrong, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.results.plant_source import PlantSource

#: The middle plant of the family and the plant of the design differ by rounding: this share of their largest entries.
FAMILY_TOLERANCE = 1e-9
_SOURCE = "the gain set: what is stored twice is compared"


def tolerance_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the rows on the tolerances of a linear plant: they are those of the plant that the design is for."""
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
        source=_SOURCE,
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
        # No bound over the box exists: who asks for one is told so.  The nominal plant alone is compared.
        missed, detail = 0.0, f"no family over the box: {error}"
    yield upper_bound_check(
        "tolerances of the plant",
        "eliminated and sampled over the box, the plant as written contains the plant of the design",
        missed,
        FAMILY_TOLERANCE,
        source=_SOURCE,
        kind="equality",
        detail=detail,
    )


def _not_nominal(plant: DescriptorSystem, uncertain: Uncertainty) -> Iterator[str]:
    """Yield matrices whose entries are not what their texts say at the nominal values."""
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
    """Yield what differs between tolerances and the plant as written beside them."""
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
    """Return by how much the nominal plant of the family differs from the plant, beyond the family's remainders."""
    box = uncertain.box
    alone = {name: replace(item, low=item.nominal, high=item.nominal) for name, item in box.constants.items()}
    family = affine_plant(plant, replace(box, constants=alone))
    worst = 0.0
    if len(family.coordinates) != plant.nx:
        return float("inf")
    for name in UNCERTAIN_MATRICES:
        found, stored = family.matrices[name], np.asarray(dense(getattr(plant, name)))
        wanted = stored @ family.coordinates if name in ("E", "A", "C") else stored
        if wanted.shape != found.center.shape:
            return float("inf")
        if not wanted.size:
            continue
        missed = np.maximum(np.abs(wanted - found.center) - found.radius, 0.0)
        size = np.maximum(np.abs(wanted), np.abs(found.center))
        scale = np.minimum(size.max(axis=1, keepdims=True), size.max(axis=0, keepdims=True))
        worst = max(worst, float(np.max(missed / np.where(scale > 0.0, scale, 1.0))))
    return worst if np.isfinite(worst) else float("nan")


#: What both plants say of the signals that neither elimination nor sampling touches.
_KEPT_NAMES = tuple(name for name in SIGNAL_NAMES if name not in ("state_names", "noise_names"))


def stored_twice_rows(design: ObserverDesign) -> Iterator[Check]:
    """Yield the row on names, units and operating points that plant, observer and plant as written all hold."""
    plant, observer, source = design.plant, design.observer, design.source
    if not isinstance(plant, DescriptorSystem):
        return
    wrong = [
        f"{name} of the observer"
        for name in ("input_names", "output_names")
        if tuple(getattr(observer, name)) != tuple(getattr(plant, name))
    ]
    if source is not None:
        wrong += [f"{name} as written" for name in _KEPT_NAMES if getattr(source.plant, name) != getattr(plant, name)]
        signals = {name for field in _KEPT_NAMES for name in getattr(plant, field)}
        for label in ("units", "scales", "operating_point"):
            one, other = getattr(source.plant, label), getattr(plant, label)
            if any(one.get(name) != other.get(name) for name in signals):
                wrong.append(f"{label} as written")
        if plant.dt != (source.plant.dt if source.sample_time is None else source.sample_time):
            wrong.append("sample time")
        wrong += _noise_of(source, plant)
    if source is None and not wrong:
        return
    yield nothing_wrong(
        "stored twice",
        "names, units, operating point, sample time and noise agree wherever they are stored",
        wrong,
        source=_SOURCE,
    )


def _noise_of(source: PlantSource, plant: DescriptorSystem) -> list[str]:
    """Return covariances of the noise that do not follow from the plant as written: factors are not unique."""
    try:
        made = source.derived.plant
    except ObsynthError:
        return ["plant as written"]
    if not source.plant.nw and plant.nw:
        return []  # stated for the plant of the design
    if made.nx != plant.nx or made.ny != plant.ny:
        return ["size of the plant as written"]
    one, other = (np.vstack([item.Bw, item.Dw]) for item in (made, plant))
    first, second = one @ one.T, other @ other.T
    size = np.sqrt(np.maximum(np.diag(first), np.diag(second)))
    missed = np.abs(first - second) > FAMILY_TOLERANCE * np.outer(size, size)
    return ["covariance of the noise"] if missed.any() else []
