"""Fault models of a certificate compared with those of the options."""

from __future__ import annotations

import numpy as np

from obsynth.errors import SpecError
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import exosystem
from obsynth.plants.polytopic import PolytopicSystem
from obsynth.proofs.balls import UNIT_ROUNDOFF
from obsynth.results.checks import Check, upper_bound_check
from obsynth.results.design import ObserverDesign
from obsynth.verification.identities import EQUALITY_TOLERANCE

#: Exponentials of another machine may be away by so many roundings of the largest entry of a row.
ENTRY_ROUNDINGS = 32.0


def fault_model_row(plant: DescriptorSystem | PolytopicSystem, design: ObserverDesign) -> Check:
    """Return the row on Phi and Cw: they are those of the option ``fault_model``, steps where it is left out."""
    matrices, options = design.certificate.matrices, design.options
    difference, detail = np.inf, ""
    try:
        named = options.get("fault_model")
        model = exosystem("step" if named is None else named, plant.fault_names, plant.dt)
        words = options.get("fault_model_in_words")
        if words is not None and words != dict(zip(plant.fault_names, model.descriptions, strict=True)):
            detail = "fault_model_in_words is not fault_model"
        else:
            pairs = (matrices["Phi"], model.Phi), (matrices["Cw"], model.Cw)
            difference = max(_difference(*pair) for pair in pairs)
    except (SpecError, TypeError, ValueError, AttributeError) as error:
        detail = str(error)
    return upper_bound_check(
        "model of faults",
        "Phi and Cw are those of the fault model that the options name: relative difference",
        difference,
        EQUALITY_TOLERANCE,
        source="options",
        kind="equality",
        detail=detail,
    )


def _difference(shipped: FloatArray, named: FloatArray) -> float:
    """Return how far two matrices are apart, as a share of the larger of two entries at the same place.

    What rounding of a row may be, as where a cosine is zero, is no difference."""
    if shipped.shape != named.shape:
        return np.inf
    sizes = np.maximum(np.abs(shipped), np.abs(named))
    rounding = ENTRY_ROUNDINGS * UNIT_ROUNDOFF * np.max(sizes, axis=1, keepdims=True, initial=0.0)
    apart = np.maximum(np.abs(shipped - named) - rounding, 0.0)
    return float(np.max(np.divide(apart, sizes, out=np.zeros(apart.shape), where=sizes > 0.0), initial=0.0))
