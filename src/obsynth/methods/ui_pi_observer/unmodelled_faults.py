"""Response to faults outside the fault model: fhat/f, steady errors, and limits that hold for any gain.

For any fault, fhat = T(s) f once the initial-condition response has settled.  At a zero of (f, d) -> y outside the
region of stability T(s) f0 = 0 for every stable decoupled observer: a step is then first answered in the wrong
direction.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from obsynth.analysis.existence.augmented_pencils import number
from obsynth.numerics.arrays import ComplexArray, FloatArray, largest_singular_value
from obsynth.numerics.invariant_zeros import is_outside, system_pencil, system_zeros, zeros_with_directions
from obsynth.numerics.norms import balanced_realisation, response
from obsynth.numerics.ranks import NEGLIGIBLE_INPUT
from obsynth.numerics.spectra import boundary_points, decay_rates
from obsynth.observers.linear.modes import frequency_grid, is_stable, poles_of
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.faults import balanced_transition
from obsynth.plants.plant_units import PlantUnits
from obsynth.plants.signal_names import leading_names
from obsynth.results.checks import Check, information
from obsynth.verification.error_system import ErrorModel

#: A fault estimate counts as faithful up to the frequency where it misses by this share of the fault.
FAITHFUL = 0.1

#: A step counts as settled within this share, after this many time constants of the slowest pole.
SETTLING_BAND, SETTLING_TIME_CONSTANTS = 0.02, 4.0

#: Eigenvalues of a fault model closer to constant courses than this, relative to the model's size, are constants.
CONSTANT = 1e-9


def _system(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    errors = ErrorModel(plant, observer, tracking[:, : plant.nx])
    # In balanced states: units must not cost digits.
    return *balanced_realisation(errors.Az, errors.fault, -errors.fault_output[0]), errors.fault_output[1]


def tracking_response(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, points: ComplexArray
) -> ComplexArray:
    """Return ``fhat/f (k, nf, nf)`` at points of the boundary, of the error system: no mode of the plant is in it."""
    return response(*_system(plant, observer, tracking), points)


def steady_errors(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, phi: FloatArray, cw: FloatArray
) -> list[tuple[int, float]]:
    """Return for each fault the order of the least ``t^order / order!`` that its model does not hold, and the error
    ``fhat - f`` for it in the end, in units of that derivative."""
    a, b, c, d = _system(plant, observer, tracking)
    shift = np.eye(len(a)) if plant.dt > 0.0 else np.zeros_like(a)
    step = plant.dt if plant.dt > 0.0 else 1.0
    errors = []
    for fault in range(plant.nf):
        order = _constants(phi, cw[fault], shift=1.0 if plant.dt > 0.0 else 0.0)
        # T(s) = D + C (sI - A)^-1 B = D - C A^-1 B - C A^-2 B s - ...
        vector: FloatArray = b[:, fault]
        for _ in range(order + 1):
            vector = np.asarray(np.linalg.solve(a - shift, vector), dtype=np.float64)
        coefficient = -float(c[fault] @ vector) + (float(d[fault, fault]) - 1.0 if order == 0 else 0.0)
        errors.append((order, coefficient * step**order))
    return errors


def _constants(phi: FloatArray, row: FloatArray, *, shift: float) -> int:
    """Return how often 0 (1 in discrete time) is an eigenvalue of the part of ``phi`` that a fault is made of."""
    reached = row != 0.0
    for _ in range(len(row)):
        reached = reached | (np.any(phi[reached] != 0.0, axis=0) if reached.any() else reached)
    part = phi[np.ix_(reached, reached)]
    if not part.size:
        return 0
    balanced = balanced_transition(part)[0]
    reach = CONSTANT * largest_singular_value(balanced)
    return int(np.sum(np.abs(np.linalg.eigvals(balanced) - shift) <= reach))


def tracking_rows(
    plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray, phi: FloatArray, cw: FloatArray
) -> Iterator[Check]:
    """Yield what a user should know about faults outside the model; nothing here fails."""
    source = "recomputed from plant and realisation"
    if not is_stable(observer):
        return
    frequencies = frequency_grid(observer)
    gains = tracking_response(plant, observer, tracking, boundary_points(frequencies, plant.dt))
    errors = steady_errors(plant, observer, tracking, phi, cw)
    for fault, name in enumerate(plant.fault_names):
        own = gains[:, fault, fault]
        peak = int(np.argmax(np.abs(own)))
        missed = np.flatnonzero(np.abs(own - 1.0) > FAITHFUL)
        limit = frequencies[missed[0]] if missed.size else np.inf
        yield information(
            f"fhat/f[{name}]",
            f"frequency in rad/s up to which the estimate of an unmodelled sinusoid is wrong by {FAITHFUL:.0%} or less",
            float(limit),
            source=source,
            detail=f"largest |fhat/f| {abs(own[peak]):.3g} at {frequencies[peak]:.3g} rad/s; |fhat/f| = 1 is faithful",
        )
        order, error = errors[fault]
        unmodelled = {0: "a step of 1", 1: "a ramp of 1 per s"}.get(order, f"t^{order} / {order}!")
        yield information(
            f"steady error[{name}]",
            f"fhat - f in the end when the fault is {unmodelled}, one order above its model",
            error,
            source=source,
            detail=plant.units.get(name, ""),
        )
    yield from _limits(plant, observer, tracking)


def _limits(plant: DescriptorSystem, observer: LinearObserver, tracking: FloatArray) -> Iterator[Check]:
    """Yield a row for each zero of (f, d) -> y outside the region of stability: it limits every gain."""
    units = PlantUnits.of(plant).rounded()
    scaled = units.scaled_plant(plant)
    inputs, direct = np.hstack([scaled.Bf, scaled.Bd]), np.hstack([scaled.Df, scaled.Dd])
    padded, pencil = system_pencil(scaled.E, scaled.A, inputs, scaled.C, direct)
    if plant.nf == 0:
        return
    zeros = system_zeros(padded, pencil, nx=scaled.nx)
    if zeros.normal_rank < pencil.shape[1]:
        return
    slowest = float(np.min(decay_rates(poles_of(observer), plant.dt), initial=np.inf))

    def outside(value: complex) -> bool:
        return value.imag >= 0.0 and is_outside(value, plant.dt)

    for zero in zeros_with_directions(padded, pencil, zeros, nx=scaled.nx, selected=outside):
        if float(np.linalg.norm(zero.input_direction[: plant.nf])) <= NEGLIGIBLE_INPUT:
            continue
        fault, place = units.faults * zero.input_direction[: plant.nf], units.eigenvalue(zero.value)
        value = tracking_response(plant, observer, tracking, np.array([place]))[0] @ fault
        names = leading_names(np.abs(fault), plant.fault_names)
        yield information(
            f"limit at {number(place)}",
            f"at this zero of (f, d) -> y the estimate of {', '.join(names)} cannot follow, whatever the gains: "
            "|T(zero) f0| of this observer",
            float(np.linalg.norm(value) / np.linalg.norm(fault)),
            source="a zero outside the region of stability",
            detail=_undershoot(plant, place, slowest),
        )


def _undershoot(plant: DescriptorSystem, zero: complex, slowest: float) -> str:
    if plant.nf != 1 or zero.imag != 0.0 or not np.isfinite(slowest) or slowest <= 0.0:
        return ""
    rate = np.log(zero.real) / plant.dt if plant.dt > 0.0 and zero.real > 0.0 else zero.real
    if (plant.dt > 0.0 and zero.real <= 1.0) or rate <= 0.0:
        return ""
    settling = SETTLING_TIME_CONSTANTS / slowest
    least = (1.0 - SETTLING_BAND) / np.expm1(rate * settling)
    return (
        f"inverse response: a step fault that is settled to {SETTLING_BAND:.0%} after {settling:.3g} s first has at "
        f"least {least:.3g} of its size in the wrong direction"
    )
