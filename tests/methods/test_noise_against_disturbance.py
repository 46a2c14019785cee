"""Where gains can keep a disturbance out of the estimates, those chosen against the noise must not let it in."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth


@pytest.mark.one_in(6)
@pytest.mark.parametrize("noise", [1.0, 0.01])
@pytest.mark.parametrize("gamma", [None, 0.5, 0.01])
def test_a_disturbance_that_only_the_free_measurement_feels(gamma, noise):
    plant = obsynth.DescriptorSystem(
        None, [[0.98, 0.1], [0.0, 0.95]], C=np.eye(2), Bf=[[0.0], [1.0]], Bd=[[1.0], [0.0]], dt=1.0,
        Bw=np.zeros((2, 2)), Dw=noise * np.eye(2),
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(plant, gamma=gamma)
    assert design.report.passed
    assert design.certificate.claims["gamma"] <= (0.01 if gamma is None else gamma)
