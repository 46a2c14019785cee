"""The residual weight of the fault-estimation filter: the paper's, in the plant's own coordinates, or a free one."""

from __future__ import annotations

import json

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


@pytest.mark.one_in(2)
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


def _left_inverses(plant: obsynth.DescriptorSystem, count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return Upsilon and some left inverses of it that are not its pseudoinverse."""
    upsilon = obsynth.conditions.wang2015(plant).data["Upsilon"]
    rng, (nf, ny) = np.random.default_rng(47), upsilon.T.shape
    free = np.linalg.svd(upsilon)[0][:, nf:].T
    return upsilon, [np.linalg.pinv(upsilon) + rng.normal(size=(nf, ny - nf)) @ free for _ in range(count)]


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", PLANTS)
def test_a_given_weight_is_kept_and_its_gain_is_that_of_the_inequality(name):
    plant = obsynth.DescriptorSystem(**PLANTS[name], dt=1.0)
    for weight in _left_inverses(plant, 2)[1]:
        ours = obsynth.fault_estimation_filter(plant, weight=weight)
        assert ours.report["gains: given W"].passed
        np.testing.assert_allclose(ours.gains["W"], weight, rtol=0, atol=1e-12)
        inequality = obsynth.conditions.wang2015(plant, W=weight)
        inequality.problem.solve(solver="CLARABEL")
        least = np.sqrt(inequality.variables["gamma_squared"].value)
        assert ours.certificate.claims["gamma_min"] == pytest.approx(least, rel=1e-5)


def test_a_given_weight_is_kept_where_the_inequality_has_something_else_in_it():
    plant = obsynth.DescriptorSystem(**PLANTS["Wang 2015"], dt=1.0)
    (weight,) = _left_inverses(plant, 1)[1]
    ours = obsynth.fault_estimation_filter(plant, weight=weight, decay=0.01)
    assert ours.report["gains: given W"].passed
    np.testing.assert_allclose(ours.gains["W"], weight, rtol=0, atol=1e-12)


def test_a_given_weight_may_be_short_of_its_last_digits():
    plant = obsynth.DescriptorSystem(**PLANTS["Wang 2015"], dt=1.0)
    upsilon, (weight,) = _left_inverses(plant, 1)
    ours = obsynth.fault_estimation_filter(plant, weight=np.round(weight, 10))
    assert ours.report.passed
    np.testing.assert_allclose(ours.gains["W"] @ upsilon, np.eye(2), rtol=0, atol=1e-14)


def test_a_given_weight_of_outputs_in_other_units():
    outputs = np.array([1e3, 1.0, 1e-6])[:, None] * np.array(PLANTS["Wang 2015"]["C"])
    plant = obsynth.DescriptorSystem(**{**PLANTS["Wang 2015"], "C": outputs}, dt=1.0)
    (weight,) = _left_inverses(plant, 1)[1]
    ours = obsynth.fault_estimation_filter(plant, weight=weight)
    np.testing.assert_allclose(ours.gains["W"], weight, rtol=1e-9)
    inequality = obsynth.conditions.wang2015(plant, W=weight, coordinates="balanced")
    inequality.problem.solve(solver="CLARABEL")
    least = np.sqrt(inequality.variables["gamma_squared"].value)
    assert ours.certificate.claims["gamma_min"] == pytest.approx(least, rel=1e-5)


def test_a_spec_may_state_the_weight_and_the_gain_set_keeps_it(tmp_path):
    plant = obsynth.DescriptorSystem(**PLANTS["three states"], dt=1.0)
    (weight,) = _left_inverses(plant, 1)[1]
    sections = {name: np.array(value).tolist() for name, value in PLANTS["three states"].items()}
    document = {
        "schema_version": 1,
        "name": "given",
        "plant": {"dt": 1.0, **sections},
        "method": {"id": "fault-estimation-filter", "options": {"weight": weight.tolist()}},
    }
    file = tmp_path / "spec.yaml"
    file.write_text(json.dumps(document), encoding="utf-8")
    spec = obsynth.load_spec(file)
    design = obsynth.design(spec.plant, spec.method, **spec.options)
    again = obsynth.load(design.save(tmp_path / "given.gains.json"))
    assert again.options["weight"] == weight.tolist()
    assert obsynth.verify(again)["gains: given W"].passed


@pytest.mark.one_in(6)
@pytest.mark.parametrize("stored", [[[1.0, 0.0, 0.0]], [["a"]], "W", [[None, 0.0, 0.0]], {}, 1.0])
def test_a_stored_weight_that_is_not_w_fails_its_row(stored):
    plant = obsynth.DescriptorSystem(**PLANTS["three states"], dt=1.0)
    design = obsynth.fault_estimation_filter(plant, weight=_left_inverses(plant, 1)[1][0])
    report = obsynth.verify(design.replace(options={**design.options, "weight": stored}))
    assert "gains: given W" in {check.name for check in report.failures}


@pytest.mark.parametrize(
    ("weight", "words"),
    [
        (1.01 * np.array([[0.0, 0.0, 0.5]]), "misses the identity"),
        (np.zeros((2, 3)), "2 by 3, but 1 by 3"),
        ("papers", "give 'paper', 'free' or a matrix"),
        (2.0, "give 'paper', 'free' or a matrix"),
        ([["a", 0, 0]], "give 'paper', 'free' or a matrix"),
        ([[np.nan, 0, 0]], "must be finite"),
    ],
)
def test_what_is_no_left_inverse_of_upsilon_is_refused(weight, words):
    plant = obsynth.DescriptorSystem(**PLANTS["three states"], dt=1.0)
    with pytest.raises(obsynth.SpecError, match=words):
        obsynth.fault_estimation_filter(plant, weight=weight)


def test_a_given_weight_has_no_limit_beside_it_and_needs_independent_outputs():
    plant = obsynth.DescriptorSystem(**PLANTS["three states"], dt=1.0)
    with pytest.raises(obsynth.SpecError, match="needs a free weight"):
        obsynth.fault_estimation_filter(plant, weight=[[0.0, 0.0, 0.5]], residual_weight_limit=3.0)
    twice = obsynth.DescriptorSystem(
        **{**PLANTS["three states"], "C": [*PLANTS["three states"]["C"], [0, 0, 1]]}, dt=1.0
    )
    with pytest.raises(obsynth.PreconditionError, match="A given W is for independent outputs"):
        obsynth.fault_estimation_filter(twice, weight=[[0.0, 0.0, 0.5, 0.0]])
