"""PD observers with given gains, and checks of the gain G of the loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.analysis.existence.condition import require_all
from obsynth.analysis.existence.filasova import explicit_form, pd_observer_conditions
from obsynth.errors import SpecError
from obsynth.methods.method import Synthesis
from obsynth.methods.pd_observer.certificate import explicit_certificate
from obsynth.methods.pd_observer.realisation import realise_pd_observer, with_faults_as_states
from obsynth.numerics.arguments import require_shape
from obsynth.numerics.arrays import FloatArray, as_matrix
from obsynth.numerics.ranks import decide_rank
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.design import Certificate


def checked_adaptation_gain(value: Any, nf: int) -> FloatArray:
    """Return G as a matrix ``(nf, nf)``; raise `SpecError` when it has another shape or is singular."""
    matrix = as_matrix(value, "adaptation_gain")
    if matrix.shape == (1, 1) and nf != 1:
        matrix = float(matrix[0, 0]) * np.eye(nf)
    if matrix.shape != (nf, nf) or not decide_rank(matrix, expected=nf).full:
        raise SpecError(
            f"adaptation_gain is {matrix.shape[0]} by {matrix.shape[1]}: give a nonsingular matrix {nf} by {nf}, or "
            "one number.",
            path="method.options.adaptation_gain",
        )
    return matrix


def synthesis_from_gains(
    plant: DescriptorSystem, *, gains: Mapping[str, Any], adaptation_gain: Any, decay: float
) -> Synthesis:
    """Return the realisation and certificate of given gains; see `obsynth.design_from_gains`."""
    require_all(pd_observer_conditions(plant))
    form = explicit_form(plant)
    work = plant if form is None else form.plant
    matrices = {name: as_matrix(value, name) for name, value in gains.items()}
    for name, rows in (("J", work.nx), ("L", work.nx), ("M", work.nf), ("N", work.nf)):
        require_shape(matrices[name].shape, (rows, work.ny), name)
    if not (np.isfinite(decay) and decay >= 0.0):
        raise SpecError(f"decay is {decay}: give 0 or a positive number in 1/seconds.", path="decay")
    g = None if adaptation_gain is None else checked_adaptation_gain(adaptation_gain, work.nf)
    inner = np.eye(work.nf) if g is None else g
    pairs = (("J", "M"), ("L", "N"))
    gain_j, gain_l = (np.vstack([matrices[top], inner @ matrices[bottom]]) for top, bottom in pairs)
    observer = _realised(work, gain_j, gain_l)
    certificate = explicit_certificate(observer.Az, observer.Cz[: observer.order], decay=decay)
    if certificate is None:  # not stable, or too slow: the report will say so
        certificate = np.eye(observer.order), np.eye(observer.order), 1.0
    return Synthesis(
        {"from_gains": True, "decay": decay},
        matrices if g is None else {**matrices, "G": g},
        observer,
        Certificate(
            {"P1": certificate[0], "P3": certificate[1]},
            {"theorem": 1.0, "delta": certificate[2], "decay": float(decay)},
        ),
        {"runs": []},
        transformation=form,
    )


def _realised(plant: DescriptorSystem, gain_j: FloatArray, gain_l: FloatArray) -> LinearObserver:
    augmented = with_faults_as_states(plant)
    if not np.linalg.cond(np.eye(augmented.nx) + gain_l @ augmented.C) < 1.0 / np.finfo(np.float64).eps:
        raise SpecError(
            "I + L C is singular with these gains: the observer's equations do not determine its estimates.", path="L"
        )
    return realise_pd_observer(plant, augmented, gain_j, gain_l)
