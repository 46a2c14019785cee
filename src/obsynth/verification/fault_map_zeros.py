"""Zeros of an exact fault map: the zeros of the faults that are not strictly stable.

Faults ``f exp(z t)`` (or ``f z^k``) in the direction of such a zero, with decoupled inputs and states that grow from
nothing, leave all outputs at zero.  Every causal filter then estimates nothing, and an exact fault map M has
``M(z) f = 0``.  Source: ours; compare A. Varga, *Solving Fault Diagnosis Problems*, 2017, section 3.5.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import flint
import numpy as np

from obsynth.errors import PreconditionError
from obsynth.numerics.arrays import ComplexArray, FloatArray, remembered
from obsynth.numerics.decoupling_windows import Model
from obsynth.numerics.invariant_zeros import (
    equilibrated_at,
    is_outside,
    smallest_part_first,
    system_pencil,
    system_zeros,
)
from obsynth.numerics.ranks import BOUNDARY_NEIGHBOURHOOD, NEGLIGIBLE_INPUT, RANK_TOLERANCE
from obsynth.numerics.spectra import pole_text
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.proofs.complex_balls import complex_matrix

#: A fault map vanishes at a zero where one of its own zeros is as near, relative to the zero: six digits that a user
#: writes are enough.  What does not vanish is above ``1 / (1 + k)`` for k lags, however far out the zero is.
VANISHING_SHARE = 1e-6
#: Relative accuracy of a simple zero that is computed; of one of multiplicity m the m-th root of it.
ZERO_ROUNDING = 1e-10
#: Digits, in bits, with which a fault map is computed: many lags of a zero far out are below double precision.
PRECISION_BITS = 256


class FaultZero(NamedTuple):
    """A zero that is not strictly stable, the faults ``(nf, k)`` that no output shows there, and its multiplicity."""

    value: complex
    faults: ComplexArray
    multiplicity: int


class MissedZero(NamedTuple):
    """What a fault map is at a zero, beside what it could be there: below `VANISHING_SHARE` it vanishes."""

    value: complex
    share: float


@remembered
def unstable_fault_zeros(plant: DescriptorSystem) -> tuple[FaultZero, ...]:
    """Return the zeros from faults and disturbances to the outputs that are not strictly stable and show in faults.

    Of a pair only the upper one is returned.
    """
    units = PlantUnits.of(plant).rounded()
    rows, outputs = units.rate * units.equations[:, None], units.outputs[:, None]
    E, A = units.equations[:, None] * plant.E * units.states, rows * plant.A * units.states
    hidden = np.hstack([units.faults, units.disturbances])
    B = rows * np.hstack([plant.Bf, plant.Bd]) * hidden
    D = outputs * np.hstack([plant.Df, plant.Dd]) * hidden
    wide_e, wide_a = system_pencil(E, A, B, outputs * plant.C * units.states, D)
    values = [complex(value) for value in system_zeros(wide_e, wide_a, nx=plant.nx).values]
    zeros: list[FaultZero] = []
    for value in values:
        if value.imag < 0.0 or not is_outside(value, plant.dt):
            continue
        faults = _directions(wide_e, wide_a, value, plant)
        if faults.shape[1]:
            near = BOUNDARY_NEIGHBOURHOOD * max(1.0, abs(value))
            count = sum(abs(value - other) <= near for other in values)
            zeros.append(FaultZero(value / units.rate, units.faults[:, None] * faults, count))
    return tuple(zeros)


def _directions(wide_e: FloatArray, wide_a: FloatArray, value: complex, plant: DescriptorSystem) -> ComplexArray:
    """Return the faults of a basis of the pencil's kernel, without those that are rounding."""
    pencil = equilibrated_at(wide_e, wide_a, value, nx=plant.nx)
    matrix = pencil.A - (value if value.imag else value.real) * pencil.E
    _, sizes, right = np.linalg.svd(matrix)
    rank = int(np.sum(sizes > RANK_TOLERANCE * sizes[0])) if sizes.size else 0
    own = slice(plant.nx, plant.nx + plant.nf)
    kernel = smallest_part_first(right[rank:].conj().T, own)
    faults = kernel[own, np.linalg.norm(kernel[own], axis=0) > NEGLIGIBLE_INPUT] * pencil.columns[own, None]
    largest = np.max(np.abs(faults), axis=0, initial=0.0)
    return np.asarray(np.where(np.abs(faults) > NEGLIGIBLE_INPUT * largest, faults, 0.0), dtype=np.complex128)


def missed_zeros(
    plant: DescriptorSystem, *, reference: Model | None, delays: tuple[int, ...] | None
) -> tuple[MissedZero, ...]:
    """Return what an exact fault map, a reference model or delays of each fault, is at each unstable zero of faults.

    Each row is judged beside ``abs(M) abs(f)`` and how much that changes over the size of the zero.
    """
    # Those of delays are at zero.
    poles = np.zeros(1) if reference is None else np.linalg.eigvals(reference[0])
    missed = []
    for zero in unstable_fault_zeros(plant):
        if reference is None:
            value, slope = _delayed(zero.value, delays or (0,) * plant.nf)
        else:
            value, slope = _modelled(zero.value, reference)
        distance = float(np.min(np.abs(zero.value - poles))) if poles.size else 0.0
        rounding = float(ZERO_ROUNDING ** (1.0 / zero.multiplicity)) / VANISHING_SHARE
        scale = max(abs(zero.value), rounding * (abs(zero.value) + distance))
        missing = np.abs(value @ zero.faults)
        possible = (np.abs(value) + scale * np.abs(slope)) @ np.abs(zero.faults)
        shares = np.divide(missing, possible, out=np.zeros_like(missing), where=possible > 0.0)
        missed.append(MissedZero(zero.value, float(np.max(shares, initial=0.0))))
    return tuple(missed)


def _delayed(point: complex, delays: tuple[int, ...]) -> tuple[ComplexArray, ComplexArray]:
    """Return ``z^-L`` of each fault and its derivative."""
    late = np.array(delays)
    value = np.diag(point ** (-late.astype(np.float64)))
    return value, -late / point * value


def _modelled(point: complex, model: Model) -> tuple[ComplexArray, ComplexArray]:
    """Return ``C (z I - A)^-1 B + D`` and its derivative, with many digits."""
    a, b, c, d = model
    if not len(a):
        return d.astype(np.complex128), np.zeros(d.shape, dtype=np.complex128)
    with flint.ctx.workprec(PRECISION_BITS):
        inner = complex_matrix(point * np.eye(len(a))) - complex_matrix(a)
        once = inner.solve(complex_matrix(b))
        value, slope = complex_matrix(c) * once + complex_matrix(d), complex_matrix(c) * inner.solve(once)
        return _numbers(value), -_numbers(slope)


def _numbers(matrix: Any) -> ComplexArray:
    values = [complex(entry.mid()) for entry in matrix.entries()]
    return np.array(values, dtype=np.complex128).reshape(matrix.nrows(), matrix.ncols())


def require_vanishing(plant: DescriptorSystem, *, reference: Model | None, delays: tuple[int, ...] | None) -> None:
    """Raise `PreconditionError` where an exact fault map does not vanish at an unstable zero of the faults."""
    missed = missed_zeros(plant, reference=reference, delays=delays)
    worst = [zero for zero in missed if not zero.share <= VANISHING_SHARE]
    if not worst:
        return
    place = ", ".join(pole_text(zero.value, 6, pair=True) for zero in worst)
    remedy = "" if reference is not None else ", with whatever delay"
    raise PreconditionError(
        "The transfer from the faults to the outputs has a zero that is not strictly stable, at "
        f"{place}, where the fault map is not zero: no stable filter has this fault map{remedy}. Give a reference "
        "model that is zero there for these faults, set exact to False, or measure more.",
        condition="fault map",
    )
