"""Standard deviations of the estimates of a shipped functional filter: of noise alone, and of noise and walk."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from obsynth.methods.functional_filter.tracking import FunctionalErrors
from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.spectra import certain_noise_covariance
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem


def estimate_deviations(
    plant: DescriptorSystem, observer: LinearObserver, matrices: Mapping[str, FloatArray]
) -> FloatArray:
    """Return ``(faults estimated, 2)``: deviation of fhat under the stated noise, and of ``fhat - f`` with the walks.

    In continuous time for a sample time of 1 s (times its root for others), the direct part left out.
    """
    errors = FunctionalErrors.of(plant, observer, matrices["T"], matrices["T0"])
    rows = observer.fault_rows
    discrete = float(plant.dt > 0.0)
    noise = certain_noise_covariance(
        errors.A, errors.noise, errors.C[rows], discrete * errors.noise_output[rows], plant.dt
    )
    walk = _walk_covariance(plant, observer, matrices, errors)
    alone = np.maximum(np.diag(noise), 0.0)
    return np.asarray(np.sqrt(np.column_stack([alone, alone + np.maximum(np.diag(walk), 0.0)])))


def _walk_covariance(
    plant: DescriptorSystem, observer: LinearObserver, matrices: Mapping[str, FloatArray], errors: FunctionalErrors
) -> FloatArray:
    """Return the covariance of ``fhat(k) - f(k - delay)`` that the walks of the fault models cause."""
    phi, cw, drive, pi = (matrices[name] for name in ("Phi", "Cw", "walks", "tracking"))
    rows, count = observer.fault_rows, len(phi)
    # In coordinates around the motion that follows the models, only what drives them is left.
    lag = max((0, *observer.fault_delays))
    order = len(errors.A)
    a = np.zeros((order + lag * count, order + lag * count))
    b = np.zeros((len(a), drive.shape[1]))
    c = np.zeros((len(observer.fault_names), len(a)))
    a[:order, :order], b[:order] = errors.A, -pi @ drive
    for j in range(lag):
        place = slice(order + j * count, order + (j + 1) * count)
        if j == 0:
            b[place] = drive
        else:
            a[place, order + (j - 1) * count : order + j * count] = np.eye(count)
    c[:, :order] = errors.C[rows]
    for row, (name, delay) in enumerate(zip(observer.fault_names, observer.fault_delays, strict=True)):
        # w(k) = Phi^delay w(k - delay) + the steps since; the estimate is of the oldest of them.
        for j in range(delay):
            back = np.linalg.matrix_power(np.linalg.inv(phi), delay - j)
            c[row, order + j * count : order + (j + 1) * count] = cw[plant.fault_names.index(name)] @ back
    return certain_noise_covariance(a, b, c, np.zeros((len(c), drive.shape[1])), plant.dt)
