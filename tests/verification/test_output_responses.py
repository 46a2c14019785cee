"""`fault_response` against sinusoids that are simulated, for every linear method that estimates faults."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

PLANT = obsynth.DescriptorSystem(
    A=[[-1.0, 0.5], [0.2, -2.0]], B=[[1.0], [0.0]], C=np.eye(2), Bf=[[1.0], [0.3]], Bd=[[0.0], [1.0]]
)

DISCRETE = {
    "fault-estimation-filter": {},
    "functional-filter": {},
    "optimal-filter": {"delay": 1},
    "ui-pi-observer": {"decay": 0.8},
}

CONTINUOUS = {"pd-observer": {}, "functional-filter": {}, "ui-pi-observer": {"decay": 2.0}}


def amplitude_in_a_run(design: obsynth.ObserverDesign, frequency: float) -> complex:
    """Return the fitted ``fhat/f`` of a long run with a sinusoidal fault, sample by sample."""
    plant, observer = design.plant, design.observer
    steps = np.arange(4000)
    fault = np.sin(frequency * plant.dt * steps)
    x, z, estimates = np.zeros(plant.nx), np.zeros(len(observer.Az)), []
    for f in fault:
        y = plant.C @ x + plant.Df[:, 0] * f
        estimates.append((observer.Cz @ z + observer.Dy @ y)[observer.fault_rows][0])
        z = observer.Az @ z + observer.By @ y
        x = np.linalg.solve(plant.E, plant.A @ x + plant.Bf[:, 0] * f)
    late = steps >= 2000
    angles = frequency * plant.dt * steps[late]
    inner, outer = np.linalg.lstsq(
        np.column_stack([np.sin(angles), np.cos(angles)]), np.array(estimates)[late], rcond=None
    )[0]
    return complex(inner, outer)


@pytest.mark.parametrize("method", DISCRETE)
def test_the_response_is_what_a_sinusoidal_fault_looks_like(method: str) -> None:
    plant = obsynth.discretise(PLANT, 0.1).plant
    design = obsynth.design(plant, method, **DISCRETE[method])
    for frequency in (0.7, 3.1):
        (response,) = obsynth.fault_response(design, frequency)
        np.testing.assert_allclose(response, [[amplitude_in_a_run(design, frequency)]], rtol=1e-6)


@pytest.mark.parametrize("method", CONTINUOUS)
def test_a_continuous_design_shows_all_of_a_constant_fault(method: str) -> None:
    design = obsynth.design(PLANT, method, **CONTINUOUS[method])
    np.testing.assert_allclose(obsynth.fault_response(design, [0.0]), [[[1.0]]], atol=1e-6)


@pytest.mark.parametrize("dt", [0.0, 0.1])
@pytest.mark.parametrize("method", ["ui-pi-observer", "functional-filter"])
def test_at_the_integrator_of_a_plant_the_response_is_its_limit(method: str, dt: float) -> None:
    # Position and speed of a mass: a constant force moves it without end, and its estimate is the force.
    plant = obsynth.DescriptorSystem(A=[[0.0, 1.0], [0.0, 0.0]], B=[[0.0], [1.0]], C=[[1.0, 0.0]], Bf=[[0.0], [1.0]])
    design = obsynth.design(obsynth.discretise(plant, dt).plant if dt else plant, method)
    at_rest, slow = obsynth.fault_response(design, [0.0, 1e-4])
    np.testing.assert_allclose(at_rest, [[1.0]], atol=1e-6)
    np.testing.assert_allclose(slow, at_rest, atol=1e-2)


def test_what_has_no_response_is_refused() -> None:
    plant = obsynth.discretise(PLANT, 0.1).plant
    with pytest.raises(obsynth.SpecError, match="finite numbers, in rad/s"):
        obsynth.fault_response(obsynth.functional_filter(plant), [1.0, np.nan])
    with pytest.raises(obsynth.SpecError, match="no linear time-invariant observer"):
        obsynth.fault_response(obsynth.descriptor_kalman(plant), 1.0)
    residuals = obsynth.detection_filter(PLANT.replace(Dw=0.1 * np.eye(2)))
    with pytest.raises(obsynth.SpecError, match="estimates no faults"):
        obsynth.fault_response(residuals, 1.0)
