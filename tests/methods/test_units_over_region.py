"""Filters over a region of plants whose signals are in other units: the same filters."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

#: Units of single signals lie between these powers of two.
MOST = 20.0


def plants(
    seed: int, *, states: int, outputs: int, disturbances: int = 1, noisy: bool = False
) -> tuple[obsynth.PolytopicSystem, ...]:
    """Return two vertices, with noise of the outputs as further disturbances: as drawn, and in other units."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(states, states))
    a *= 0.9 / np.max(np.abs(np.linalg.eigvals(a)))
    moves = 0.1 * rng.normal(size=(2, states, states))
    c, bf, bd = (rng.normal(size=shape) for shape in ((outputs, states), (states, 1), (states, disturbances)))
    dd = np.zeros((outputs, disturbances))
    if noisy:
        bd = np.hstack([bd, np.zeros((states, outputs))])
        dd = np.hstack([dd, 0.05 * np.eye(outputs)])

    def in_units(x: np.ndarray, y: np.ndarray, f: np.ndarray, d: np.ndarray) -> obsynth.PolytopicSystem:
        return obsynth.PolytopicSystem(
            [
                obsynth.DescriptorSystem(
                    A=(a + move) * x / x[:, None],
                    C=c * x / y[:, None],
                    Bf=bf * f / x[:, None],
                    Bd=bd * d / x[:, None],
                    Dd=dd * d / y[:, None],
                    dt=1.0,
                )
                for move in moves
            ]
        )

    sizes = (states, outputs, 1, 1 if noisy else disturbances)
    units = (np.exp2(np.round(rng.uniform(-MOST, MOST, size=size))) for size in sizes)
    return in_units(*map(np.ones, sizes)), in_units(*units)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_disturbance_that_can_be_decoupled_is_in_any_units(seed: int) -> None:
    """In the outputs' own units, gains were found that let the disturbances through, or that failed their checks."""
    for plant in plants(seed, states=3, outputs=3, disturbances=2):
        design = obsynth.fault_estimation_filter(plant)
        assert design.report.passed
        assert design.report["least gain"].kind == "equality"


@pytest.mark.parametrize("seed", [5, 9, 11])
def test_the_gain_is_that_of_the_plant_as_drawn(seed: int) -> None:
    given, other = plants(seed, states=4, outputs=2, noisy=True)
    scale = float(other.vertices[0].Dd[0, 1] / other.vertices[0].C[0, 0] / (other.vertices[0].Bf[0, 0]))
    scale *= float(given.vertices[0].Bf[0, 0] * given.vertices[0].C[0, 0] / given.vertices[0].Dd[0, 1])
    designs = [obsynth.fault_estimation_filter(plant) for plant in (given, other)]
    assert all(design.report.passed for design in designs)
    gains = [design.certificate.claims["gamma"] for design in designs]
    # The gain is in units of the fault by units of the disturbances, which all have the same one here.
    assert gains[1] == pytest.approx(gains[0] * scale, rel=0.02)
