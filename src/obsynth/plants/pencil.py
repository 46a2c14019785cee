"""The pencil ``A - z E`` of a plant: regularity, index and finite eigenvalues, in units of the plant's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from obsynth.numerics.arrays import ComplexArray, FloatArray, read_only, remembered
from obsynth.numerics.pencils import (
    PencilStructure,
    finite_zeros,
    is_regular,
    reduced,
    structure_of_reduced,
    with_nonsingular_e,
)
from obsynth.numerics.staircase import Deflation, normal_rank_of
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.proofs.nonsingular import is_proved_nonsingular


@remembered
def _reduced(plant: DescriptorSystem) -> tuple[Deflation, Deflation]:
    # With a nonsingular E every pencil is regular and of index 0: no rank beside fast rates of A may say otherwise.
    return (with_nonsingular_e if is_proved_nonsingular(plant.E) else reduced)(*in_own_units(plant))


def in_own_units(plant: DescriptorSystem) -> tuple[FloatArray, FloatArray]:
    """Return E and A in units of the plant's own, powers of two: no rank may hang on those of the data."""
    units = PlantUnits.of(plant).rounded()
    moving, whole = (units.equations[:, None] * matrix * units.states for matrix in (plant.E, plant.A))
    return moving, units.rate * whole


def regularity_of(plant: DescriptorSystem) -> tuple[bool, int]:
    """Return whether a plant's pencil ``A - z E`` is regular, and its normal rank, without eigenvalues."""
    right_deflation, left_deflation = _reduced(plant)
    return is_regular(plant.E.shape, right_deflation), normal_rank_of(right_deflation, left_deflation)


@remembered
def structure_of(plant: DescriptorSystem) -> PencilStructure:
    """Return the structure of a plant's pencil ``A - z E``, which methods and verification ask for again and again."""
    structure = structure_of_reduced(plant.E.shape, _reduced(plant))
    values = PlantUnits.of(plant).rounded().eigenvalues(structure.finite_eigenvalues)
    return replace(structure, finite_eigenvalues=read_only(values, np.complex128))


@remembered
def shown_modes(plant: DescriptorSystem) -> ComplexArray:
    """Return the finite modes of a plant without those that no output shows, such as that of a state beside it."""
    return read_only(without_hidden(plant, structure_of(plant).finite_eigenvalues), np.complex128)


def without_hidden(plant: DescriptorSystem, modes: ComplexArray) -> ComplexArray:
    """Return the finite modes ``(n,)`` of a plant, in whatever order, without those that no output shows."""
    for value in _hidden_modes(plant)[: len(modes)]:
        modes = np.delete(modes, np.argmin(np.abs(modes - value)))
    return modes


@remembered
def _hidden_modes(plant: DescriptorSystem) -> ComplexArray:
    units, (moving, whole) = PlantUnits.of(plant).rounded(), in_own_units(plant)
    outputs = units.outputs[:, None] * plant.C * units.states
    hidden = finite_zeros(np.vstack([moving, np.zeros_like(outputs)]), np.vstack([whole, outputs])).values
    return read_only(units.eigenvalues(hidden), np.complex128)
