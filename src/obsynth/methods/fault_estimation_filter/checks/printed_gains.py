"""What the rounding of printed gains can do to each identity.

A gain printed to k decimals is off by up to half a unit of the k-th.  The identities are polynomials in the entries
of T, N, L and W, and vanish at the gains before rounding; to first order an identity at the printed gains is
therefore at most half a unit times the sum, over all entries of the gains, of the sizes of their cofactors.  Each
cofactor times half a unit is found by moving its entry by as much, either way, and forming the filter again.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from obsynth.methods.fault_estimation_filter.checks.faults import fault_identities, step_key
from obsynth.methods.fault_estimation_filter.checks.gains import gain_identities
from obsynth.methods.fault_estimation_filter.checks.realisation import Equations, filter_of
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import Scaling
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.verification.error_system import ErrorSystem
from obsynth.verification.identities import tracking_identities

#: The gains that are printed; Psi, Upsilon and R follow from them.
PRINTED = "TNLW"


def printed_allowances(
    plant: DescriptorSystem,
    work: DescriptorSystem,
    observer: LinearObserver,
    gains: Mapping[str, FloatArray],
    scaling: Scaling,
    digits: int,
) -> dict[str, FloatArray]:
    """Return, by identity, what the rounding of the gains can add to each of its entries, to first order."""
    half_a_unit = 0.5 * 10.0**-digits
    equations = Equations.of(plant, work, observer.fault_delays)

    def totals(letter: str = "", move: FloatArray | None = None) -> dict[str, FloatArray]:
        moved = dict(gains) if move is None else {**gains, letter: gains[letter] + move}
        return _totals(plant, work, filter_of(observer, equations.realised(moved)), moved, equations, scaling)

    centre = totals()
    found = {name: np.zeros_like(total) for name, total in centre.items()}
    for letter in PRINTED:
        for index in np.ndindex(gains[letter].shape):
            move = np.zeros_like(gains[letter])
            move[index] = half_a_unit
            more, less = totals(letter, move), totals(letter, -move)
            for name, middle in centre.items():
                found[name] += np.maximum(np.abs(more[name] - middle), np.abs(less[name] - middle))
    return found


def _totals(
    plant: DescriptorSystem,
    work: DescriptorSystem,
    observer: LinearObserver,
    gains: Mapping[str, FloatArray],
    equations: Equations,
    scaling: Scaling,
) -> dict[str, FloatArray]:
    tracking = equations.tracking(gains["T"])
    lag = tracking.shape[1] // plant.nx - 1
    errors = ErrorSystem.of(plant, observer, tracking, lag)
    found = {**tracking_identities(plant, observer, tracking, lag), **gain_identities(work, gains, equations, scaling)}
    for name, steps in fault_identities(errors, observer.fault_delays).items():
        found |= {step_key(name, step): identity for step, identity in enumerate(steps)}
    return {name: identity.total for name, identity in found.items()}
