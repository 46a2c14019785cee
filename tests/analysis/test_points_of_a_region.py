"""Where a plant over a region has no observer: at a vertex, in the middle, or where an entry or a slope is zero."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth import DescriptorSystem, PolytopicSystem, PreconditionError, SolverError, SpecError


def hidden(coupling: Any, scheduling: dict[str, Any], growth: Any = 2, **changes: Any) -> PolytopicSystem:
    """Return a plant with a growing second state, which the output shows through ``coupling`` alone."""
    plant = {"A": [[0.5, coupling], [0, growth]], "C": [[1, 0]], "dt": 1.0, **changes}
    return PolytopicSystem(plant=plant, scheduling=scheduling)


@pytest.mark.parametrize(
    ("ends", "where"),
    [([0, 1], "vertex 1 (v = 0)"), ([-1, 1], "the middle of the region (v = 0)"), ([-1, 2], "v = 0, where an entry")],
)
@pytest.mark.parametrize(
    "method",
    [lambda plant: obsynth.descriptor_kalman(plant, Q=1.0, R=1.0), obsynth.ui_pi_observer],
    ids=["kalman", "pi"],
)
def test_a_mode_that_one_point_hides_is_named_with_the_point(
    method: Callable[[PolytopicSystem], Any], ends: list[float], where: str
) -> None:
    with pytest.raises(PreconditionError) as caught:
        method(hidden("v", {"v": ends}, Bf=[[1], [0]]))
    assert where in str(caught.value)
    assert "z = 2" in str(caught.value)
    assert str(caught.value).startswith("No observer of this kind exists")


@pytest.mark.long
def test_points_where_an_entry_vanishes_are_looked_at_along_each_parameter_and_between_vertices() -> None:
    with pytest.raises(PreconditionError, match=r"at v = 0, w = 0\.5"):
        obsynth.descriptor_kalman(hidden("v", {"v": [-1, 2], "w": [0, 1]}, "2 + w"), Q=1.0, R=1.0)
    for entries, where in (
        ((-1.0, 1.0, 4.0), r"at weight1 = 0\.5, weight2 = 0\.5"),
        ((-1.0, 4.0, 1.0), r"at weight1 = 0\.8, weight2 = 0\.2"),
    ):
        vertices = [DescriptorSystem(None, [[0.5, v], [0, 2]], C=[[1, 0]], dt=1.0) for v in entries]
        with pytest.raises(PreconditionError, match=where):
            obsynth.descriptor_kalman(PolytopicSystem(vertices), Q=1.0, R=1.0)
    # Without a change of sign, and where the hidden mode decays, there are filters.
    assert obsynth.descriptor_kalman(hidden("v", {"v": [1, 2]}), Q=1.0, R=1.0).report.passed
    assert obsynth.descriptor_kalman(hidden("v", {"v": [-1, 2]}, 0.5), Q=1.0, R=1.0).report.passed


def test_a_corner_of_a_hull_that_no_parameter_gives_proves_nothing_of_all_observers() -> None:
    # v ** 2 - v is at least 2 on [2, 4]; in the hull of v and v ** 2 it comes to zero.
    with pytest.raises((PreconditionError, SolverError)) as caught:
        obsynth.descriptor_kalman(hidden("v ** 2 - v", {"v": [2, 4]}), Q=1.0, R=1.0)
    assert "No observer of this kind exists" not in str(caught.value)


def test_a_fault_that_loses_its_effect_is_named_with_the_point() -> None:
    plant = {"A": [["a"]], "C": [[1]], "Bf": [["b"]], "dt": 1.0}
    with pytest.raises(PreconditionError, match=r"b = 0, where an entry vanishes.*act nowhere"):
        obsynth.fault_estimation_filter(PolytopicSystem(plant=plant, scheduling={"a": [-2, 2], "b": [-1, 2]}))


@pytest.mark.parametrize("method", [obsynth.ui_pi_observer, obsynth.fault_estimation_filter], ids=["pi", "filter"])
@pytest.mark.parametrize(
    ("effect", "where"), [([["v - 0.3"], ["w - 0.6"]], "v = 0.3, w = 0.6"), ([["v"], ["w - 0.6"]], "v = 0, w = 0.6")]
)
def test_a_fault_whose_entries_vanish_together_inside_or_on_an_edge_is_named(
    method: Callable[[PolytopicSystem], Any], effect: list[list[str]], where: str
) -> None:
    plant = {"A": [[0.9, "0.1 * w"], [0, "0.7 + 0.1 * v"]], "C": np.eye(2), "Bf": effect, "dt": 1.0}
    with pytest.raises(PreconditionError, match=f"at {where}, where the fault 'f1' vanishes"):
        method(PolytopicSystem(plant=plant, scheduling={"v": [0, 1], "w": [0, 1]}))


def test_an_entry_that_vanishes_in_a_corner_of_the_region_alone_is_looked_at() -> None:
    # v + w = 0.1 crosses no line through the middle of the square.
    with pytest.raises(PreconditionError, match=r"at v = 0\.05, w = 0\.05, where an entry vanishes"):
        obsynth.descriptor_kalman(hidden("v + w - 0.1", {"v": [0, 1], "w": [0, 1]}), Q=1.0, R=1.0)


def test_faults_that_meet_in_one_direction_are_refused_though_no_entry_vanishes() -> None:
    plant = {"A": [["a", 0], [0, 0.5]], "C": np.eye(2), "Bf": [[1, "c"], [1, 1]], "dt": 1.0}
    with pytest.raises(PreconditionError, match=r"'effectiveness' fails.*give a smaller region"):
        obsynth.fault_estimation_filter(PolytopicSystem(plant=plant, scheduling={"a": [-2, 2], "c": [0.5, 1.8]}))


def hidden_nonlinear(ends: list[float], *, kind: str = "state") -> Any:
    equations, outputs, states = {"b": "der(x) = f - x + w ** 2", "c": "der(w) = w"}, {"g": "x"}, {"x": 1.0, "w": 1.0}
    if kind == "algebraic":
        equations["c"] = "w ** 2 = 1 - x"
    model = obsynth.DAEModel(equations, outputs, states=states, parameters={"f": 0.0})
    return obsynth.region_observer(model, region={"w": ends}, sample_time=0.1, goal="decay")


@pytest.mark.long
def test_slopes_that_hide_a_mode_or_turn_algebraic_equations_are_named() -> None:
    with pytest.raises(PreconditionError, match=r"where a slope is zero.*'s0 \*\* 2\.0' by s0 is zero.*s0 = w in"):
        hidden_nonlinear([-1.0, 2.0])
    with pytest.raises(PreconditionError, match=r"index 1 over the region.*no longer determine w"):
        hidden_nonlinear([-1.0, 2.0], kind="algebraic")
    assert hidden_nonlinear([0.5, 2.0], kind="algebraic").report.passed


def test_malformed_entries_are_named_with_their_place() -> None:
    for entry, told, kind in (
        ("v > 0", r"^A\[1,2\]: 'v > 0' is not a valid", SpecError),
        ("v * 1e308 * 10", r"A\[1,2\] overflows at v = -1", PreconditionError),
        ("exp(1000 * v)", r"'exp\(1000 \* v\)' overflows", PreconditionError),
    ):
        with pytest.raises(kind, match=told):
            hidden(entry, {"v": [-1, 1]})


def test_a_decay_of_a_nonlinear_plant_needs_no_samples_and_the_rest_says_what_is_missing() -> None:
    model = obsynth.DAEModel({"b": "der(x) = f - x ** 3"}, {"g": "x"}, states={"x": 1.0}, parameters={"f": 0.0})
    problem = obsynth.conditions.region(model, {"x": [-1, 1]}, goal="decay", decay=0.5)
    problem.solve()
    assert float(np.asarray(problem.variables["room"].value)) > 1e-6
    with pytest.raises(SpecError, match="sample_time is missing"):
        obsynth.conditions.region(model, {"x": [-1, 1]}, noise={"g": 1.0, "f": 1.0})
    with pytest.raises(SpecError, match="noise must name signals"):
        obsynth.conditions.region(model, {"x": [-1, 1]}, sample_time=1.0)


@pytest.mark.long
def test_remedies_of_outputs_that_change_and_of_late_faults_work() -> None:
    changing = {"A": [["a"]], "C": [["1 + a"]], "Bf": [[1]], "dt": 1.0}
    with pytest.raises(PreconditionError, match=r"changing: C\. Divide a measurement by what scales its row"):
        obsynth.fault_estimation_filter(PolytopicSystem(plant=changing, scheduling={"a": [0.1, 0.5]}))
    quotient = PolytopicSystem(plant={**changing, "C": [[1]]}, scheduling={"a": [0.1, 0.5]})
    assert obsynth.fault_estimation_filter(quotient).report.passed
    late = hidden("v", {"v": [1, 2]}, 0.5, Bf=[[0], [1]])
    with pytest.raises(PreconditionError, match=r"later: f1.*ui-pi-observer does not need it"):
        obsynth.fault_estimation_filter(late)
    assert obsynth.ui_pi_observer(late).report.passed
