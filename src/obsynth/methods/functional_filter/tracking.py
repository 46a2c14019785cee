"""The error system of a functional filter, and what its estimates make of faults that follow their models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem


@dataclass(frozen=True, eq=False)
class FunctionalErrors:
    """``eps+ = A eps + fault f + noise w``, rows ``C eps + fault_output f + noise_output w``: no x, u or d."""

    A: FloatArray
    C: FloatArray
    fault: FloatArray
    fault_output: FloatArray
    noise: FloatArray
    noise_output: FloatArray

    @classmethod
    def of(cls, plant: DescriptorSystem, observer: LinearObserver, t: FloatArray, t0: FloatArray) -> FunctionalErrors:
        """Return the system; T ``(nz, nx)``, T0 ``(rows, nx)``."""
        return cls(
            observer.Az, observer.Cz, observer.By @ plant.Df - t @ plant.Bf, observer.Dy @ plant.Df - t0 @ plant.Bf,
            observer.By @ plant.Dw - t @ plant.Bw, observer.Dy @ plant.Dw - t0 @ plant.Bw,
        )  # fmt: skip


def tracking_map(
    plant: DescriptorSystem, observer: LinearObserver, t: FloatArray, phi: FloatArray, cw: FloatArray
) -> FloatArray:
    """Return Pi ``(nz, nw)``: where eps goes when every fault follows its model, ``Az Pi + b Cw = Pi Phi``."""
    from scipy.linalg import solve_sylvester

    entering = (observer.By @ plant.Df - t @ plant.Bf) @ cw
    if not entering.size:
        return np.zeros(entering.shape)
    return np.asarray(solve_sylvester(observer.Az, -phi, -entering))


def wanted_faults(
    plant: DescriptorSystem, observer: LinearObserver, matrices: Mapping[str, FloatArray], *, mean: int
) -> FloatArray:
    """Return what each row should make of the models' states ``(rows, nw)``: the fault as late as claimed, or nothing.

    A mean of ``mean`` values is the mean of the fault's own values: for a step, the fault.
    """
    phi, cw = matrices["Phi"], matrices["Cw"]
    rows = np.zeros((len(observer.Cz), len(phi)))
    for row, (name, delay) in enumerate(zip(observer.fault_names, observer.fault_delays, strict=True)):
        first = delay - (mean - 1) // 2
        back = np.linalg.inv(phi) if delay or mean > 1 else np.eye(len(phi))
        powers = [np.linalg.matrix_power(back, first + j) for j in range(mean)]
        rows[row] = cw[plant.fault_names.index(name)] @ (sum(powers[1:], start=powers[0]) / mean)
    return rows
