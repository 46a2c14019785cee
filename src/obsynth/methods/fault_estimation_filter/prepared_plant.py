"""Preparing a plant for the fault-estimation filter.

Source: Wang, Rodrigues, Theilliol, Shen 2015.  Differences: feedthrough, which the paper does not have.  Sensor
faults become algebraic states.  Disturbances and noise in the outputs enter through the error coordinate
``e = T E x - z`` instead of ``x - xhat``: the future sample ``N Dd d(k+1)`` then drops out, and the error system

    e(k+1) = (TA - L C) e + (T Bd - TA N Dd - L (I - C N) Dd) d,   residual = W (C e + (I - C N) Dd d)

is exact, where treating d(k) and d(k+1) as independent would be conservative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.analysis.plant_units import PlantUnits
from obsynth.analysis.transformations import augment_faults
from obsynth.methods.fault_estimation_filter.detectability_indexes import (
    FaultDetectability,
    fault_detectability,
)
from obsynth.methods.fault_estimation_filter.exact_indexes import exact_indexes
from obsynth.methods.fault_estimation_filter.restricted_equivalent import (
    restricted_equivalent,
    restricted_equivalent_from,
)
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.scaling import Scaling, balance_system
from obsynth.plants.descriptor import DescriptorSystem

#: Balanced units are kept while the condition number of ``[E; C]`` is below this.
MOST_CONDITION = 256.0


@dataclass(frozen=True, eq=False)
class PreparedPlant:
    """A plant in the form the filter's theory works on: sensor faults as states, balanced, ``T E + N C = I``.

    Fields: plant: With sensor faults appended as algebraic states; not balanced; scaling: Power-of-two factors of the
    balanced coordinates, in which everything below is given; T, N: ``(na, na)`` and ``(na, ny)``, na states after
    appending; TA, C, TF: ``(na, na)``, ``(ny, na)``, ``(na, nf)``; Bd, Dd: Disturbance in the error system ``(na, nd)``
    and in the innovation ``(ny, nd)``; Bw, Dw: Noise likewise, ``(na, nw)`` and ``(ny, nw)``; detectability: Indexes,
    Psi and Upsilon.
    """

    plant: DescriptorSystem
    scaling: Scaling
    T: FloatArray
    N: FloatArray
    TA: FloatArray
    C: FloatArray
    TF: FloatArray
    Bd: FloatArray
    Dd: FloatArray
    Bw: FloatArray
    Dw: FloatArray
    detectability: FaultDetectability


def with_sensor_faults_as_states(plant: DescriptorSystem) -> DescriptorSystem:
    """Return the plant with every fault that reaches an output directly appended as an algebraic state."""
    direct = tuple(name for name, column in zip(plant.fault_names, plant.Df.T, strict=True) if np.any(column != 0.0))
    return augment_faults(plant, direct).plant if direct else plant


def _scaling(work: DescriptorSystem) -> Scaling:
    """Return balanced units, or the natural ones where balancing leaves ``[E; C]``, on which T and N rest, worse."""
    balanced = balance_system(work.E, work.A, inputs=[work.Bf], outputs=[work.C])
    if _condition(work, balanced) <= MOST_CONDITION:
        return balanced
    units = PlantUnits.of(work).rounded()
    natural = Scaling(units.equations, units.states, units.outputs)
    return min(natural, balanced, key=lambda scaling: _condition(work, scaling))


def _condition(work: DescriptorSystem, scaling: Scaling) -> float:
    return float(np.linalg.cond(np.vstack([scaling.scale_dynamics(work.E), scaling.scale_output(work.C)])))


def prepare(plant: DescriptorSystem, s: FloatArray | None = None) -> PreparedPlant:
    """Return the prepared plant; the rank conditions must hold.

    Shapes: ``s (na, na + ny)``.
    """
    work = with_sensor_faults_as_states(plant)
    scaling = _scaling(work)
    a, c = scaling.scale_dynamics(work.A), scaling.scale_output(work.C)
    if s is None:
        t, n = restricted_equivalent(scaling.scale_dynamics(work.E), c)
    else:
        # S is meant for the plant as given; what it makes is then moved to the balanced coordinates, exactly.
        t, n = restricted_equivalent_from(work.E, work.C, s)
        t, n = t / scaling.states[:, None] / scaling.equations, n / scaling.states[:, None] / scaling.outputs
    ta, tf = t @ a, t @ scaling.scale_input(work.Bf)
    shown = np.eye(work.ny) - c @ n

    def error_input(b: FloatArray, d: FloatArray) -> tuple[FloatArray, FloatArray]:
        direct = scaling.scale_feedthrough(d)
        return t @ scaling.scale_input(b) - ta @ (n @ direct), shown @ direct

    found = fault_detectability(ta, c, tf, exact=exact_indexes(plant))
    bd, dd = error_input(work.Bd, work.Dd)
    bw, dw = error_input(work.Bw, work.Dw)
    return PreparedPlant(work, scaling, t, n, ta, c, tf, bd, dd, bw, dw, found)
