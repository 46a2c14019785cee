"""A scan of delta: the same requirements solved for several values, measured on the true error system."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from obsynth.errors import InfeasibleError, SolverError
from obsynth.methods.pd_observer.checks.error_system import PdErrorSystem
from obsynth.methods.pd_observer.gain_search import gains_for
from obsynth.methods.pd_observer.gains import PdGains
from obsynth.methods.pd_observer.options import PdOptions
from obsynth.methods.pd_observer.realisation import with_faults_as_states, with_sensor_noise
from obsynth.numerics.continuous import spectral_abscissa
from obsynth.plants.descriptor import DescriptorSystem
from obsynth.results.delta_scan import DeltaScan


def scan_delta(plant: DescriptorSystem, asked: PdOptions, deltas: NDArray[np.float64], *, decay: float) -> DeltaScan:
    """Return what each delta gives; where it gives nothing, the reason."""
    columns = [_measured(plant, asked, float(delta), decay) for delta in deltas]
    numbers = np.array([numbers for numbers, _ in columns], dtype=np.float64).reshape(len(columns), -1)
    measured = dict(zip(DeltaScan.quantities(), (np.asarray(deltas, dtype=np.float64), *numbers.T), strict=True))
    return DeltaScan.from_dict({**measured, "failures": [text for _, text in columns]})


def _measured(plant: DescriptorSystem, asked: PdOptions, delta: float, decay: float) -> tuple[list[float], str]:
    try:
        gains = gains_for(plant, replace(asked, delta=delta, decay=decay), decay=decay)
    except (InfeasibleError, SolverError) as error:
        return [float("nan")] * (len(DeltaScan.quantities()) - 1), str(error)
    return _quantities(plant, gains), ""


def _quantities(plant: DescriptorSystem, gains: PdGains) -> list[float]:
    errors = PdErrorSystem.of(with_faults_as_states(with_sensor_noise(plant)), gains.observer, plant.nx)
    return [
        -gains.abscissa,
        gains.size,
        errors.fault_norm(errors.rate).value,
        errors.fault_norm(errors.noise).value,
        float(np.linalg.norm(errors.noise[1][plant.nx :], 2)),
        spectral_abscissa(plant.A - gains.J[: plant.nx] @ plant.C),
    ]
