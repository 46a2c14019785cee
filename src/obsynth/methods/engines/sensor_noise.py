"""The deviation of fault estimates under the noise of the sensors alone."""

from __future__ import annotations

import warnings

import numpy as np

from obsynth.numerics.matrix_equations import continuous_lyapunov, discrete_lyapunov
from obsynth.numerics.scaling import balanced_matrix
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.plants.plant_units import PlantUnits


def fault_deviation(plant: DescriptorSystem, observer: LinearObserver) -> float:
    """Return the largest standard deviation of a fault estimate, in units in which the faults act alike; infinite for
    an observer that is not stable.  Without stated noise every output has a deviation of one, in units that suit the
    plant."""
    own = PlantUnits.of(plant)
    noise = plant.Dw if plant.Dw.any() else np.diag(1.0 / own.outputs)
    rows, into = observer.fault_rows, observer.By @ noise
    places = [plant.fault_names.index(name) for name in observer.fault_names]
    sizes = own.faults[places]
    scale = 1.0 / np.where(sizes > 0.0, sizes, 1.0)[:, None]
    output_map, direct = scale * observer.Cz[rows], scale * observer.Dy[rows] @ noise
    if not len(output_map):
        return 0.0
    poles = np.linalg.eigvals(observer.Az) if len(observer.Az) else np.zeros(0)
    stable = np.all(np.abs(poles) < 1.0) if observer.dt else np.all(poles.real < 0.0)
    if not stable or (not observer.dt and direct.any()):
        return np.inf if not stable else float(np.max(np.linalg.norm(direct, axis=1)))
    if not len(poles):
        return float(np.max(np.linalg.norm(direct, axis=1)))
    a, factors = balanced_matrix(observer.Az)
    output_map, into = output_map * factors, into / factors[:, None]
    try:
        with warnings.catch_warnings(action="error"):
            spread = discrete_lyapunov(a, into @ into.T) if observer.dt else continuous_lyapunov(a, -into @ into.T)
    except RuntimeWarning:
        return np.inf  # a pole on the boundary within rounding
    variances = np.diag(output_map @ spread @ output_map.T) + np.sum(direct * direct, axis=1)
    return float(np.sqrt(np.max(np.maximum(variances, 0.0))))
