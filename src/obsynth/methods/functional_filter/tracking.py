"""The error system of a functional filter: exact fault models, and deviations by noise and random walks."""

from __future__ import annotations

from collections.abc import Mapping

import flint
import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.proofs.covariances import certain_noise_covariance
from obsynth.proofs.extended_balls import arb_matrix
from obsynth.proofs.products import EXPONENTIAL_BITS, as_ball
from obsynth.verification.error_system import ErrorModel

#: Regulator equations of more unknowns are solved in double precision.
MOST_RATIONAL_UNKNOWNS = 100


def tracking_map(errors: ErrorModel, phi: FloatArray, cw: FloatArray) -> FloatArray:
    """Return Pi ``(nz, nw)``: where eps goes when every fault follows its model, ``Az Pi + b Cw = Pi Phi``."""
    from scipy.linalg import solve_sylvester

    driving = -errors.fault @ cw
    if not driving.size:
        return np.zeros(driving.shape)
    exact = _with_digits_to_spare(errors.Az, phi, driving) if driving.size <= MOST_RATIONAL_UNKNOWNS else None
    return np.asarray(solve_sylvester(errors.Az, -phi, -driving)) if exact is None else exact


def _with_digits_to_spare(a: FloatArray, phi: FloatArray, driving: FloatArray) -> FloatArray | None:
    """Return Pi to its last digit, however near a slow pole is to the fault model; ``None`` where it has one."""
    order, count = driving.shape
    dynamics, right = np.kron(a, np.eye(count)), np.kron(np.eye(order), phi.T)
    with flint.ctx.workprec(EXPONENTIAL_BITS):
        own, model, known = (arb_matrix(np.asarray(part)) for part in (dynamics, right, driving.reshape(-1, 1)))
        try:
            solution = (model - own).solve(known)
        except ZeroDivisionError:
            return None
    return as_ball(solution).midpoint.reshape(order, count)


def wanted_faults(
    plant: DescriptorSystem, observer: LinearObserver, matrices: Mapping[str, FloatArray], *, mean: int
) -> FloatArray:
    """Return what rows should make of the models' states ``(rows, nw)``: the fault with the claimed delay, or
    nothing."""
    phi, cw = matrices["Phi"], matrices["Cw"]
    rows = np.zeros((len(observer.Cz), len(phi)))
    for row, (name, delay) in enumerate(zip(observer.fault_names, observer.fault_delays, strict=True)):
        first = delay - (mean - 1) // 2
        back = np.linalg.inv(phi) if delay or mean > 1 else np.eye(len(phi))
        powers = [np.linalg.matrix_power(back, first + j) for j in range(mean)]
        rows[observer.fault_rows.start + row] = cw[plant.fault_names.index(name)] @ (
            sum(powers[1:], start=powers[0]) / mean
        )
    return rows


def estimate_deviations(
    plant: DescriptorSystem, observer: LinearObserver, matrices: Mapping[str, FloatArray]
) -> FloatArray:
    """Return deviations ``(faults, 2)`` of fhat under noise and of ``fhat - f`` with walks; dt = 0: per sqrt(s)."""
    errors = ErrorModel(plant, observer, matrices["T"], -matrices["T0"])
    rows = observer.fault_rows
    discrete = float(plant.dt > 0.0)
    noise = certain_noise_covariance(
        errors.Az, -errors.noise, observer.Cz[rows], discrete * errors.fault_output[3], plant.dt
    )
    walk = _walk_covariance(plant, observer, matrices, errors)
    alone = np.maximum(np.diag(noise), 0.0)
    return np.asarray(np.sqrt(np.column_stack([alone, alone + np.maximum(np.diag(walk), 0.0)])))


def _walk_covariance(
    plant: DescriptorSystem, observer: LinearObserver, matrices: Mapping[str, FloatArray], errors: ErrorModel
) -> FloatArray:
    """Return the covariance of ``fhat(k) - f(k - delay)`` that the walks of the fault models cause."""
    phi, cw, drive, pi = (matrices[name] for name in ("Phi", "Cw", "walks", "tracking"))
    rows, count = observer.fault_rows, len(phi)
    # In coordinates around the motion that follows the models, only what drives them is left.
    lag = max((0, *observer.fault_delays))
    order = observer.order
    a = np.zeros((order + lag * count, order + lag * count))
    b = np.zeros((len(a), drive.shape[1]))
    c = np.zeros((len(observer.fault_names), len(a)))
    a[:order, :order], b[:order] = observer.Az, -pi @ drive
    for j in range(lag):
        place = slice(order + j * count, order + (j + 1) * count)
        if j == 0:
            b[place] = drive
        else:
            a[place, order + (j - 1) * count : order + j * count] = np.eye(count)
    c[:, :order] = observer.Cz[rows]
    for row, (name, delay) in enumerate(zip(observer.fault_names, observer.fault_delays, strict=True)):
        # w(k) = Phi^delay w(k - delay) + the steps since; the estimate is of the oldest of them.
        for j in range(delay):
            back = np.linalg.matrix_power(np.linalg.inv(phi), delay - j)
            c[row, order + j * count : order + (j + 1) * count] = cw[plant.fault_names.index(name)] @ back
    return certain_noise_covariance(a, b, c, np.zeros((len(c), drive.shape[1])), plant.dt)
