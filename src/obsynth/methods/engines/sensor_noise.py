"""Standard deviations of fault estimates, by sensor noise alone and by all stated noise."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from obsynth.numerics.arrays import FloatArray
from obsynth.numerics.matrix_equations import continuous_lyapunov, discrete_lyapunov
from obsynth.numerics.scaling import balanced_matrix
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits
from obsynth.verification.error_system import ErrorModel


def fault_deviation(plant: DescriptorSystem, observer: LinearObserver) -> float:
    """Return the largest standard deviation of a fault estimate, in units in which the faults act alike; infinite for
    an observer that is not stable.  Without stated noise every output has a deviation of one, in units that suit the
    plant; of continuous time noise that passes at once counts alone."""
    noise = plant.Dw if plant.Dw.any() else np.diag(1.0 / PlantUnits.of(plant).outputs)
    rows, scale = observer.fault_rows, _inverse_sizes(plant, observer.fault_names)
    output_map, direct = scale * observer.Cz[rows], scale * observer.Dy[rows] @ noise
    if not observer.dt and direct.any() and _is_stable(observer.Az, observer.dt):
        return _largest(np.sum(direct * direct, axis=1))
    return stationary_deviation(observer.Az, observer.By @ noise, output_map, direct, observer.dt)


def error_deviation(model: ErrorModel, lag: float | None = None) -> float:
    """Return the largest deviation of a fault estimate's error under the noise that the plant states, in units in which
    faults act alike; of continuous time behind a ``lag`` (rate, 1/s), where what passes at once has a deviation too."""
    dt = model.observer.dt
    c, _, _, direct = model.fault_output
    scale = _inverse_sizes(model.plant, model.observer.fault_names)
    a, b, c, d = model.Az, model.noise, -scale * c, scale * direct
    if not dt and lag is not None:
        a, b, c, d = _behind_lag(a, b, c, d, lag)
    return stationary_deviation(a, b, c, d, dt)


def _inverse_sizes(plant: DescriptorSystem, fault_names: Sequence[str]) -> FloatArray:
    """Return what makes faults ``(nf, 1)`` act alike."""
    sizes = PlantUnits.of(plant).faults[[plant.fault_names.index(name) for name in fault_names]]
    return np.asarray(1.0 / np.where(sizes > 0.0, sizes, 1.0)[:, None])


def stationary_deviation(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, dt: float) -> float:
    """Return the largest deviation of an output under white noise; infinite where it has none."""
    if not len(c):
        return 0.0
    if not _is_stable(a, dt) or (not dt and d.any()):
        return np.inf
    variances = np.sum(d * d, axis=1)
    if len(a):
        a, factors = balanced_matrix(a)
        b, c = b / factors[:, None], c * factors
        try:
            with warnings.catch_warnings(action="error"):
                spread = discrete_lyapunov(a, b @ b.T) if dt else continuous_lyapunov(a, -b @ b.T)
        except RuntimeWarning:
            return np.inf  # a pole on the boundary within rounding
        variances = variances + np.diag(c @ spread @ c.T)
    return _largest(variances)


def _is_stable(a: FloatArray, dt: float) -> bool:
    poles = np.linalg.eigvals(a) if len(a) else np.zeros(0)
    return bool(np.all(np.abs(poles) < 1.0) if dt else np.all(poles.real < 0.0))


def _largest(variances: FloatArray) -> float:
    return float(np.sqrt(np.max(np.maximum(variances, 0.0), initial=0.0)))


def _behind_lag(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, lag: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    rows = len(c)
    return (
        np.block([[a, np.zeros((len(a), rows))], [lag * c, -lag * np.eye(rows)]]),
        np.vstack([b, lag * d]),
        np.hstack([np.zeros((rows, len(a))), np.eye(rows)]),
        np.zeros_like(d),
    )
