"""Filter models for the gains of a functional filter: noise, and groups of faults that share one filter."""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.analysis.existence.functional_filter import chosen_faults, residual_sets
from obsynth.methods.functional_filter.kalman_gain import FilterModel, filter_model
from obsynth.numerics.arrays import FloatArray
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import Exosystem
from obsynth.plants.noise import assumed_noise_names


def with_noise_of_gains(
    plant: DescriptorSystem, deviations: FloatArray | None, *, needed: bool
) -> tuple[DescriptorSystem, tuple[str, ...]]:
    """Return the plant with the noise that the gains are for, and a note where that is assumed.

    ``deviations (ny,)`` of the outputs take the place of what the plant states; where neither does and noise is
    ``needed``, they are one.
    """
    if deviations is None and (plant.nw or not needed):
        return plant, ()
    process = np.flatnonzero(plant.Bw.any(axis=0))
    named = [f"noise {name}" for name in plant.output_names]
    names = assumed_noise_names(plant.output_names) if deviations is None else named
    noisy = plant.replace(
        Bw=np.hstack([plant.Bw[:, process], np.zeros((plant.nx, plant.ny))]),
        Dw=np.hstack([plant.Dw[:, process] * 0.0, np.diag(np.ones(plant.ny) if deviations is None else deviations)]),
        noise_names=[*(plant.noise_names[i] for i in process), *names],
    )
    note = "No noise is stated: every sensor is assumed to have the standard deviation 1 in its own unit."
    return noisy, () if deviations is not None else (note,)


def filter_models(
    plant: DescriptorSystem, model: Exosystem, *, faults: Any, residuals: Any, joint: bool
) -> list[FilterModel]:
    """Return a filter model for each group of faults that one filter serves; the options are the method's."""
    groups = sets = residual_sets(residuals, plant)
    if groups is None:
        chosen = chosen_faults(faults, plant)
        groups = [chosen] if joint else [[fault] for fault in chosen]
    complements = ([j for j in range(plant.nf) if j not in group] for group in groups)
    return [
        filter_model(plant, model, removed=removed, faults=group if sets is None else ())
        for group, removed in zip(groups, complements, strict=True)
    ]
