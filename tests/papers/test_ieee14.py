"""A real network: torques of both generators of the IEEE 14-bus system, whatever the loads at buses 4 and 9 do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.analysis.zeros import fault_zeros
from obsynth.numerics.norms import spectral_radius
from obsynth.numerics.pencils import reduced, structure_of_reduced
from obsynth.simulation.linear import simulate_plant
from obsynth.specs.documents import read_yaml
from obsynth.specs.loader import load_spec
from obsynth.specs.matrix_files import read_matrix_market

FOLDER = Path(__file__).parents[2] / "designs" / "ieee14"
EXPECTED = read_yaml(FOLDER / "expected.yaml")
SPEC = load_spec(FOLDER / "spec.yaml")
PLANT = SPEC.plant


@pytest.fixture(scope="module")
def design() -> obsynth.ObserverDesign:
    return obsynth.design(PLANT, SPEC.method, name=SPEC.name, **SPEC.options)


@pytest.fixture(scope="module")
def by_default() -> obsynth.ObserverDesign:
    return obsynth.fault_estimation_filter(PLANT)


def test_the_plant_is_what_the_notes_say() -> None:
    e, a = (read_matrix_market(FOLDER / f"{name}.mtx", maximum_entries=277**2) for name in "EA")
    expected = EXPECTED["plant"]
    assert (len(e), int(np.sum(~e.any(axis=1)))) == (expected["variables"], expected["algebraic"])
    structure = structure_of_reduced(e.shape, reduced(e, a))
    assert (len(structure.finite_eigenvalues), structure.index) == (expected["finite_eigenvalues"], 1)
    assert np.max(structure.finite_eigenvalues.real) == pytest.approx(expected["largest_real_part"], abs=1e-9)
    assert (PLANT.nx, PLANT.ny, PLANT.nf, PLANT.nd) == (62, expected["outputs"], 2, 2)
    zeros = [abs(zero.value) for zero in fault_zeros(PLANT)[0]]
    assert max(zeros) == pytest.approx(EXPECTED["shipped"]["largest_fault_zero"], abs=1e-5)


@pytest.mark.parametrize("name", ["shipped", "by_default"])
def test_what_is_shipped(name: str, design: obsynth.ObserverDesign, by_default: obsynth.ObserverDesign) -> None:
    found, expected = {"shipped": design, "by_default": by_default}[name], EXPECTED[name]
    assert found.report.passed
    assert obsynth.verify(found).passed
    assert found.report["LMI"].kind == "proved"
    assert found.solver["engine"] == "riccati"
    assert found.certificate.claims["gamma"] == pytest.approx(expected["gamma"], rel=1e-3)
    noise = [found.report[f"noise in fhat[{fault}]"].value for fault in PLANT.fault_names]
    np.testing.assert_allclose(noise, expected["deviations"], atol=5.1e-5)
    assert spectral_radius(found.observer.Az) == pytest.approx(expected["spectral_radius"], abs=1e-4)
    assert found.observer.fault_delays == (EXPECTED["shipped"]["fault_delay"],) * 2


def scenario(steps: int = 1000) -> tuple[np.ndarray, np.ndarray]:
    """Return torques and loads of the spec's scenario."""
    time = PLANT.dt * np.arange(steps)
    torques, loads = np.zeros((steps, 2)), np.zeros((steps, 2))
    torques[time >= 5.0, 1] = 0.1
    loads[:, 0] = np.clip(0.02 * (time - 8.0), 0.0, 0.1)
    loads[time >= 15.0, 1] = 0.05
    return torques, loads


def errors(found: obsynth.ObserverDesign, torques: np.ndarray, loads: np.ndarray) -> np.ndarray:
    """Return fhat(k) - f(k - 1) without noise."""
    run = simulate_plant(PLANT, steps=len(torques), f=torques, d=loads)
    return found.observer.run(run.outputs, np.zeros((len(torques), 0))).faults[1:] - torques[:-1]


def test_torques_are_followed_whatever_the_loads_do(
    design: obsynth.ObserverDesign, by_default: obsynth.ObserverDesign
) -> None:
    torques, loads = scenario()
    expected = EXPECTED["loads_below_rounding"]
    for found in (design, by_default):
        assert np.max(np.abs(errors(found, torques, np.zeros_like(loads)))) < 1e-8
        # The proved gain bounds the energy of what the loads leave.
        assert np.linalg.norm(errors(found, torques, loads)) <= found.certificate.claims["gamma"] * np.linalg.norm(
            loads
        )
    assert np.max(np.abs(errors(design, torques, loads))) < expected["shipped"]
    np.testing.assert_allclose(
        np.max(np.abs(errors(by_default, torques, loads)), axis=0), expected["by_default"], rtol=0.02
    )
