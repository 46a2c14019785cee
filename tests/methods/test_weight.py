"""The residual weight of the fault-estimation filter: the paper's, in the plant's own coordinates, or a free one."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth

PLANTS = {
    "three states": {
        "A": [[0, -0.3, -0.2], [0.1, 0.4, 0.3], [-0.2, 0.4, -0.4]],
        "C": [[-2, 2, -2], [2, 0, 0], [0, 0, 1]],
        "Bf": [[1], [0], [2]],
        "Bd": [[0], [-2], [-1]],
    },
    "Wang 2015": {
        "E": np.diag([1.0, 1, 1, 0]),
        "A": [[0.9, 0.005, -0.095, 0], [0.005, 0.995, 0.0997, 0], [0.095, -0.0997, 0.99, 0], [1, 0, 1, 1]],
        "C": [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "Bf": [[0.1, 0], [1, 1], [-0.1, 1], [-1, 0]],
        "Bd": [[1], [1], [1], [0]],
    },
}


@pytest.mark.parametrize("name", PLANTS)
def test_the_paper_s_weight_is_the_pseudoinverse_and_its_gain_that_of_the_inequality(name):
    plant = obsynth.DescriptorSystem(**PLANTS[name], dt=1.0)
    found = obsynth.fault_estimation_filter(plant, weight="paper", engine="lmi")
    assert found.report.passed
    np.testing.assert_allclose(found.gains["W"], np.linalg.pinv(found.gains["Upsilon"]), atol=1e-12)
    paper = obsynth.conditions.wang2015(plant)
    paper.problem.solve(solver="CLARABEL")
    printed = np.sqrt(paper.variables["gamma_squared"].value)
    assert found.certificate.claims["gamma_min"] == pytest.approx(printed, rel=1e-6)


def test_a_free_weight_removes_a_disturbance_that_the_paper_s_does_not():
    plant = obsynth.DescriptorSystem(**PLANTS["three states"], dt=1.0)
    free = obsynth.fault_estimation_filter(plant, weight="free")
    assert free.report.passed
    assert free.certificate.claims["gamma"] < 0.01


def test_two_words_on_the_weight_are_one_too_many():
    plant = obsynth.DescriptorSystem(**PLANTS["three states"], dt=1.0)
    with pytest.raises(obsynth.SpecError, match="both say what W is"):
        obsynth.fault_estimation_filter(plant, weight="free", free_residual_weight=True)
