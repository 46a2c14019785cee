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


@pytest.mark.parametrize("name", PLANTS)
def test_by_default_the_free_weight_is_taken_where_it_lowers_gamma_and_both_gains_are_told(name):
    plant = obsynth.DescriptorSystem(**PLANTS[name], dt=1.0)
    by_default, paper, free = (
        obsynth.fault_estimation_filter(plant, **options) for options in ({}, {"weight": "paper"}, {"weight": "free"})
    )
    assert by_default.report.passed
    assert by_default.options["weight"] == "free"
    assert by_default.certificate.claims["gamma"] == free.certificate.claims["gamma"]
    assert by_default.certificate.claims["gamma"] < 0.75 * paper.certificate.claims["gamma"]
    assert "with the paper's W; the free W is taken" in by_default.notes[0]


def test_where_a_free_weight_buys_little_the_paper_s_is_taken():
    plant = obsynth.DescriptorSystem(A=0.5 * np.eye(2), C=np.eye(2), Bf=[[1], [0]], Bd=[[1], [0]], dt=1.0)
    found = obsynth.fault_estimation_filter(plant)
    assert found.report.passed
    assert found.options["weight"] == "paper"
    assert "the paper's W is taken" in found.notes[0]
    np.testing.assert_allclose(found.gains["W"], np.linalg.pinv(found.gains["Upsilon"]), atol=1e-12)


def test_bisection_and_the_paper_s_s_imply_the_paper_s_weight():
    plant = obsynth.DescriptorSystem(**PLANTS["Wang 2015"], dt=1.0)
    found = obsynth.fault_estimation_filter(plant, gamma_search="bisection")
    assert found.options["weight"] == "paper"
    assert found.certificate.claims["gamma_min"] == pytest.approx(1.4647, abs=1e-3)


def test_another_weight_than_the_paper_s_fails_its_row():
    plant = obsynth.DescriptorSystem(**PLANTS["three states"], dt=1.0)
    free = obsynth.fault_estimation_filter(plant, weight="free")
    report = obsynth.verify(free.replace(options={**free.options, "weight": "paper"}))
    assert "gains: paper's W" in {check.name for check in report.failures}
