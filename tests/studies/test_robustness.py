"""What a design promises over its box: largest tolerances, regularity, stability, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from uncertain_plants import drive, two_masses, wang

import obsynth
from obsynth.errors import PreconditionError
from obsynth.plants.transformations.uncertain_plant import affine_plant
from obsynth.verification.over_tolerances.subdivision import index_one_on_box


@pytest.mark.long
def test_largest_tolerances_are_those_of_the_audit() -> None:
    found = obsynth.robustness(obsynth.fault_estimation_filter(drive()))
    assert found.loop_radius == pytest.approx(0.136, abs=1e-3)
    assert found.largest_tolerance == pytest.approx(0.27, abs=5e-3)
    assert (found.regular, found.stable) == ("proved", "proved")
    assert found.finite_for_ever
    assert sum(found.blame.values()) == pytest.approx(1.0)
    assert "27" in str(found) or "26.7" in str(found)
    assert found.vertex_gains["fhat[motor]"] > 0.5


def test_a_design_without_tolerances_says_so() -> None:
    found = obsynth.robustness(obsynth.fault_estimation_filter(wang().replace(uncertainty=None)))
    assert found.assumes_exact_model
    assert str(found) == "model: assumes an exact model"


@pytest.mark.long
def test_constants_may_be_given_to_the_design() -> None:
    design = obsynth.fault_estimation_filter(wang().replace(uncertainty=None))
    found = obsynth.robustness(design, constants={"A": "1 %"})
    assert len(found.blame) == 13
    assert 0.0 < found.loop_radius < 0.106


def test_rows_of_e_are_compressed_before_index_one_is_judged() -> None:
    plant = obsynth.uncertain_system(
        {"E": [["m", "m"], ["m", "m"]], "A": [[1, 0], [0, 2]], "C": [[1, 0]], "dt": 1.0},
        {"m": {"nominal": 1.0, "tolerance": "5 %"}},
    )
    assert index_one_on_box(plant).verdict == "proved"


def test_a_row_that_becomes_dynamic_is_refused() -> None:
    plant = obsynth.uncertain_system(
        {"E": [[1, 0], [0, "e"]], "A": [[0.5, 0], [1, 1]], "C": [[1, 0]], "dt": 1.0},
        {"e": {"nominal": 0.0, "range": [0.0, 0.1]}},
    )
    with pytest.raises(PreconditionError, match="derivative into an algebraic"):
        index_one_on_box(plant)


def test_a_singular_matrix_in_the_box_names_the_value() -> None:
    plant = obsynth.uncertain_system(
        {"E": [[1, 0], [0, 0]], "A": [[0.5, 1], [1, "g"]], "C": [[1, 0], [0, 1]], "Bf": [[1], [0]], "dt": 1.0},
        {"g": {"nominal": 0.5, "range": [-0.5, 1.0]}},
    )
    found = index_one_on_box(plant)
    assert found.verdict == "refuted"
    assert plant.uncertainty.box.values(found.at)["g"] <= 0.0


def test_an_unstable_corner_is_named() -> None:
    plant = obsynth.uncertain_system(
        {"E": None, "A": [["a"]], "Bf": [[1]], "C": [[1]], "dt": 1.0}, {"a": {"nominal": 0.9, "range": [0.8, 1.1]}}
    )
    found = obsynth.robustness(obsynth.fault_estimation_filter(plant))
    assert found.stable == "refuted"
    assert found.breaking["a"] >= 1.0


def test_untouched_directions_stay_untouched_through_sampling() -> None:
    """Two masses in absolute positions: no constant acts on the position of both, however far they drift."""
    family = affine_plant(two_masses())
    assert not np.array_equal(family.coordinates, np.eye(4))
    both = np.linalg.solve(family.coordinates, [1.0, 1.0, 0.0, 0.0])
    assert np.abs(family.A.parts @ both).max() < 1e-14
    assert (family.A.radius @ np.abs(both)).max() < 1e-13


def test_a_tolerance_of_a_sensor_alone_leaves_the_plant_stable() -> None:
    plant = obsynth.uncertain_system(
        {"A": [[0.5, 0.1], [0.0, 0.3]], "C": [["c", 0], [0, 1]], "Bf": [[1], [0]], "dt": 1.0},
        {"c": {"nominal": 1.0, "tolerance": "5 %"}},
    )
    found = obsynth.robustness(obsynth.fault_estimation_filter(plant))
    assert (found.regular, found.stable, found.untouched, found.reason) == ("proved", "proved", (), "")
    assert found.finite_for_ever


def test_a_loop_at_one_sample_that_does_not_contract_leaves_no_bound() -> None:
    plant = obsynth.uncertain_system(
        {"A": [[0.5, 0.1], [0.0, 0.3]], "C": [["c", 0], [0, 1]], "Bf": [[1], [0]], "dt": 1.0},
        {"c": {"nominal": 1.0, "range": [0.2, 2.5]}},
    )
    design = obsynth.fault_estimation_filter(plant)
    found = obsynth.robustness(design)
    assert "same sample has radius 1.5" in dict(found.facts())["bounds"]
    assert "may grow" not in str(found)
    assert found.largest_factor == pytest.approx(1.0 / 1.5, rel=2e-3)
    with pytest.raises(PreconditionError, match=r"same sample has radius 1\.5"):
        obsynth.online_monitor(design, constants=plant, initial_set={"x1": 1.0, "x2": 1.0})


def test_a_radius_above_one_is_no_refusal() -> None:
    plant = obsynth.uncertain_system(
        {"A": [["a", 0.1], [0.2, 0.3]], "C": [[1, 0]], "Bf": [[1], [0]], "dt": 1.0},
        {"a": {"nominal": 0.5, "range": [-0.9, 2.5]}},
    )
    design = obsynth.ui_pi_observer(plant)
    monitor = obsynth.online_monitor(design, constants=plant, initial_set={"x1": 1.0, "x2": 1.0})
    assert "holds at each sample, but may grow" in monitor.statement
    found = obsynth.robustness(design)
    assert found.loop_radius > 1.0
    assert "largest tolerances" in dict(found.facts())
    assert "main contributors" in dict(found.facts())


def test_what_a_remainder_does_to_an_output_at_once_counts() -> None:
    """c * c in 0 .. 0.25 beside 1 is all remainder: fhat = y - 0.5 y(k - 1) is off by 0.25 + 0.5 * 0.25 of x."""
    plant = obsynth.uncertain_system(
        {"A": [[0.5]], "C": [["1 + c * c"]], "Bf": [[1.0]], "dt": 1.0}, {"c": {"nominal": 0.0, "range": [-0.5, 0.5]}}
    )
    found = obsynth.robustness(obsynth.fault_estimation_filter(plant))
    assert found.error_per_unit["fhat[f1]"]["x1"] >= 0.375
    assert found.error_per_unit["fhat[f1]"]["x1"] == pytest.approx(0.375, rel=1e-9)


def test_an_estimate_of_the_full_state_without_delay_is_needed() -> None:
    """The fault reaches the output two samples later: a filter of states that lag has no bound over tolerances."""
    plant = obsynth.uncertain_system(
        {"A": [["0.5 * p", 0.0], [1.0, 0.3]], "C": [[0.0, 1.0]], "Bf": [[1.0], [0.0]], "dt": 1.0},
        {"p": {"nominal": 1.0, "tolerance": "5 %"}},
    )
    late = obsynth.robustness(obsynth.fault_estimation_filter(plant))
    assert (late.loop_radius, late.finite_for_ever) == (None, False)
    assert "has a delay" in late.reason
    assert "does not estimate the full state" in obsynth.robustness(obsynth.functional_filter(plant)).reason
    with pytest.raises(PreconditionError, match="has a delay"):
        obsynth.online_monitor(late.design, initial_set={"x1": 1.0, "x2": 1.0})


def test_the_largest_common_tolerance_is_told_where_all_are_the_same_share() -> None:
    plant = obsynth.uncertain_system(
        {"A": [["0.5 * p", 0.1], [0.0, "0.3 * q"]], "C": np.eye(2), "Bf": [[1.0], [0.0]], "dt": 1.0},
        {"p": {"nominal": 1.0, "tolerance": "5 %"}, "q": {"nominal": 1.0, "tolerance": "5 %"}},
    )
    design = obsynth.fault_estimation_filter(plant)
    same = obsynth.robustness(design)
    assert same.largest_tolerance == pytest.approx(0.05 * same.largest_factor)
    assert obsynth.robustness(design, constants={"q": {"tolerance": "10 %"}}).largest_tolerance is None


def test_what_breaks_regularity_is_named_although_stability_is_not_decided() -> None:
    plant = obsynth.uncertain_system(
        {"E": [[1, 0], [0, 0]], "A": [[0.5, 0.1], [1.0, "g"]], "C": np.eye(2), "Bf": [[1], [0]], "dt": 1.0},
        {"g": {"nominal": 1.0, "range": [-0.5, 1.5]}},
    )
    found = obsynth.robustness(obsynth.fault_estimation_filter(plant))
    assert (found.regular, found.stable) == ("refuted", "open")
    assert found.breaking["g"] == pytest.approx(0.0, abs=0.1)


def test_an_integrator_that_no_constant_touches_is_told_and_a_stable_mode_is_not() -> None:
    plant = obsynth.uncertain_system(
        {"A": np.diag([1.0, 0.7, 0.5]).tolist(), "B": [[0], [0], ["g"]], "C": np.eye(3), "Bf": [[1], [0], [0]],
         "dt": 1.0},
        {"g": {"nominal": 1.0, "tolerance": "5 %"}},
    )  # fmt: skip
    assert obsynth.robustness(obsynth.fault_estimation_filter(plant)).untouched == (1.0,)


def test_gains_at_the_vertices_are_those_of_responses_to_pulses() -> None:
    """The disturbance is in the sensor too, and the gain is largest where the constant is smallest."""
    plant = obsynth.uncertain_system(
        {"A": [["p", 0.1], [0.2, 0.3]], "C": np.eye(2), "Bf": [[1], [0]], "Bd": [[0], [1]], "Dd": [[0.3], [0]],
         "dt": 1.0},
        {"p": {"nominal": 0.5, "range": [0.2, 0.6]}},
    )  # fmt: skip
    design = obsynth.fault_estimation_filter(plant)
    observer = design.observer
    gains = []
    for p in (0.2, 0.6):
        x, y = np.zeros(2), np.zeros((300, 2))
        A = plant.A + np.array([[p - 0.5, 0.0], [0.0, 0.0]])
        for k in range(300):
            d = float(k == 0)
            y[k] = x + plant.Dd[:, 0] * d
            x = A @ x + plant.Bd[:, 0] * d
        gains.append(np.abs(observer.run(y).faults[:, 0]).sum())
    assert gains[0] > 1.01 * gains[1]
    assert obsynth.robustness(design).vertex_gains["fhat[f1]"] == pytest.approx(gains[0], rel=1e-4)
