"""The printed gain over disturbances of any time course, against disturbances that change many times in a sample."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import obsynth
from obsynth.numerics.arrays import FloatArray

STEP = 0.2
SMOOTH = obsynth.DescriptorSystem(
    A=[[-1.0, 2.0], [-2.0, -0.5]], C=np.eye(2), Bf=[[1.0], [0.0]], Bd=[[0.3, 0.0], [1.0, 0.5]]
)


def gain_of_pieces(design: obsynth.ObserverDesign, pieces: int) -> float:
    """Return the gain over disturbances that are constant in each of some pieces of a sample, each of its energy."""
    held = STEP / pieces
    n, nd = SMOOTH.nx, SMOOTH.nd
    whole = expm(np.block([[SMOOTH.A, SMOOTH.Bd], [np.zeros((nd, n + nd))]]) * held)
    onwards, into = whole[:n, :n], whole[:n, n:]
    columns = [np.linalg.matrix_power(onwards, pieces - 1 - k) @ into for k in range(pieces)]
    # In units of energy: a piece of size one has the energy of its length.
    lifted = np.hstack(columns) / np.sqrt(held)
    observer, T = design.observer, design.certificate.matrices["tracking"]
    into_error: FloatArray = T[:, :n] @ lifted
    rows = observer.Cz[observer.fault_rows]
    points = np.exp(1j * np.linspace(0.0, np.pi, 201))
    eye = np.eye(observer.order)
    return float(
        np.sqrt(STEP)
        * max(np.linalg.norm(rows @ np.linalg.solve(z * eye - observer.Az, into_error), 2) for z in points)
    )


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_the_gain_over_all_courses_is_the_limit_of_many_pieces(scale: float) -> None:
    plant = SMOOTH.replace(Bd=scale * SMOOTH.Bd)
    design = obsynth.fault_estimation_filter(obsynth.discretise(plant, STEP))
    printed = design.report["gain over all d(t)"].value
    held, few, many = (scale * gain_of_pieces(design, pieces) for pieces in (1, 4, 32))
    assert held <= few <= many <= printed * (1.0 + 1e-9)
    assert printed <= many * (1.0 + 1e-3)
