"""Invariant zeros from the faults of a plant to its outputs, its unstable poles, and faults without effect."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from obsynth.numerics.invariant_zeros import Zero, are_outside, smallest_part_first, system_pencil, zeros_of_system
from obsynth.numerics.pencil_points import GENERIC_POINTS
from obsynth.numerics.pencils import FiniteZeros
from obsynth.numerics.scaling import equilibrate_pencil
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.pencil import in_own_units, structure_of
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.signal_names import leading_names

#: A fault zero of a sampled plant with a modulus above this makes errors of a fault estimate decay slowly.
SLOW_ZERO_RADIUS = 0.98


def sampling_zero_warnings(plant: DescriptorSystem, inside: Sequence[complex] | None = None) -> tuple[str, ...]:
    """Return a warning for each fault zero just inside the unit circle: errors decay in ``dt / -ln abs(z)`` seconds.

    ``inside``: the fault zeros inside the unit circle, where the caller has them.
    """
    if not plant.is_discrete:
        return ()
    if inside is None:
        zeros, outside = fault_zeros(plant)
        inside = [zero.value for zero in zeros if not any(zero is other for other in outside)]
    texts = [
        f"Fault zero at {pole_text(value, 6, pair=True)} (modulus {abs(value):.6g}): errors of a fault estimate decay "
        f"there with a time constant of {-plant.dt / math.log(abs(value)):.3g} s. Sample more slowly, or measure a "
        "signal nearer to the fault."
        for value in sorted(inside, key=lambda value: (value.real, value.imag))
        if value.imag >= 0.0 and SLOW_ZERO_RADIUS < abs(value) < 1.0
    ]
    return tuple(dict.fromkeys(texts))


def unstable_poles(plant: DescriptorSystem) -> tuple[complex, ...]:
    """Return the finite eigenvalues of a plant that are not strictly stable."""
    structure, rate = structure_of(plant), PlantUnits.of(plant).rounded().rate
    poles = FiniteZeros(rate * structure.finite_eigenvalues, structure.normal_rank, structure.decisions)
    marked = zip(structure.finite_eigenvalues, are_outside(*in_own_units(plant), poles, plant.dt), strict=True)
    return tuple(complex(value) for value, out in marked if out)


def fault_zeros(plant: DescriptorSystem) -> tuple[tuple[Zero, ...], tuple[Zero, ...]]:
    """Return the invariant zeros from the faults of ``plant`` to its outputs, and those not strictly stable."""
    plant = plant.dense()
    return zeros_of_system(plant.E, plant.A, plant.Bf, plant.C, plant.Df, dt=plant.dt)[1:]


def hidden_faults(plant: DescriptorSystem, *, missing: int) -> tuple[str, ...]:
    """Return the faults of which some combination has no effect on the outputs.

    ``missing``: the rank that the system matrix lacks at almost every point.
    """
    pencil = equilibrate_pencil(*system_pencil(plant.E, plant.A, plant.Bf, plant.C, plant.Df))
    kernels = []
    for point in GENERIC_POINTS:
        _, singular_values, right = np.linalg.svd(pencil.A - point * pencil.E)
        kernels.append((float(singular_values[plant.nx + plant.nf - missing - 1]), right[-missing:].T))
    _, kernel = max(kernels, key=lambda pair: pair[0])
    ordered = smallest_part_first(kernel, slice(plant.nx, None))
    return leading_names(np.linalg.norm(ordered[plant.nx :], axis=1), plant.fault_names)
