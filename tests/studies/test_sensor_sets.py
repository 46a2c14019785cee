"""Least sets of sensors: exact truths, a peer's answers, ranking by design, and advice at the end of refusals."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.analysis.diagnosis.candidate_sensors import state_sensors, with_sensors
from obsynth.analysis.diagnosis.fault_columns import DecoupledFault, Removal
from obsynth.analysis.diagnosis.sensor_search import SensorResponses
from obsynth.specs.loader import load_spec

DESIGNS = Path(__file__).parents[2] / "designs"
STRUCTURE = np.array([[1, 1, 0, 0, 1], [0, 1, 1, 1, 0], [0, 0, 1, 0, 1], [0, 0, 0, 1, 1], [0, 0, 0, 0, 1]])
FAULTS = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def one_encoder() -> obsynth.DescriptorSystem:
    return load_spec(DESIGNS / "motor" / "one_encoder.yaml").plant


def test_motor_needs_an_angle_not_a_speed() -> None:
    found = obsynth.sensor_sets(one_encoder(), goal="estimate")
    assert [entry.sensors for entry in found.sets] == [("theta l",)]
    assert found.exact
    shown = obsynth.sensor_sets(one_encoder(), goal="detect")
    assert {entry.sensors for entry in shown.sets} == {("theta l",), ("omega l",)}


def test_sets_of_equal_cost_are_ranked_by_the_error_after_design() -> None:
    plant = load_spec(DESIGNS / "bicycle" / "spec.yaml").transformation.source
    rest = [1, 2]
    fewer = plant.replace(
        C=plant.C[rest], D=None, Dd=None, Df=None, Dw=plant.Dw[rest], output_names=["r", "ay"], units={}
    )
    noise = {"vy": 0.05, "delta": 0.001, "Fyf": 50.0, "Fyr": 50.0}
    found = obsynth.sensor_sets(fewer, noise=noise, cost={"Fyf": 5.0, "Fyr": 5.0})
    assert {entry.sensors for entry in found.sets[:2]} == {("delta",), ("vy",)}
    assert found.sets[0].deviation < found.sets[1].deviation
    assert [entry.cost for entry in found.sets] == [1.0, 1.0, 5.0, 5.0]


@pytest.mark.long
def test_as_many_sets_as_the_structural_toolbox_finds() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import faultdiagnosistoolbox as fdt

        model = fdt.DiagnosisModel({"type": "MatrixStruc", "X": STRUCTURE.tolist(), "F": FAULTS.tolist(), "Z": []})
        theirs = {"detect": model.SensorPlacementDetectability()[0]}
        model.SensorLocationsWithFaults()
        theirs["isolate"] = model.SensorPlacementIsolability()[0]
        model.SensorLocationsWithFaults(model.x)
        theirs["isolate, sensors fail"] = model.SensorPlacementIsolability()[0]
    rng = np.random.default_rng(9)
    plant = obsynth.DescriptorSystem(
        np.zeros((5, 5)), STRUCTURE * rng.uniform(0.5, 2.0, (5, 5)), None, np.zeros((0, 5)),
        Bf=FAULTS * rng.uniform(0.5, 2.0, (5, 4)),
    )  # fmt: skip
    ours = {
        "detect": obsynth.sensor_sets(plant, goal="detect"),
        "isolate": obsynth.sensor_sets(plant, goal="isolate"),
        "isolate, sensors fail": obsynth.sensor_sets(plant, goal="isolate", may_fail=True, copies=2),
    }
    for name, expected in theirs.items():
        found = {tuple(sorted(entry.sensors)) for entry in ours[name].sets}
        assert found == {tuple(sorted(map(str, entry))) for entry in expected}
    assert (len(theirs["isolate"]), len(theirs["isolate, sensors fail"])) == (5, 9)
    assert any("from f2" in text for text in ours["isolate"].out_of_reach)


def test_greedy_is_not_what_is_returned() -> None:
    # y = (d1, d2, d1 + f): {1, 3} suffices, greedy by what each shows takes three.
    plant = obsynth.DescriptorSystem(
        np.zeros((3, 3)), -np.eye(3), None, np.zeros((0, 3)), Bf=[[0], [0], [1]], Bd=[[1, 0], [0, 1], [1, 0]],
    )  # fmt: skip
    found = obsynth.sensor_sets(plant, goal="estimate")
    assert [entry.sensors for entry in found.sets] == [("x1", "x3")]


def test_zeros_may_ask_for_more_sensors_than_ranks_do() -> None:
    rows = {"a": np.poly([1, 2]), "b": np.poly([2, 3]), "c": np.poly([1, 3])}
    a = np.array([[-3.0, -3.0, -1.0], [1, 0, 0], [0, 1, 0]])
    plant = obsynth.DescriptorSystem(None, a, None, np.zeros((0, 3)), Bf=[[1], [0], [0]])
    found = obsynth.sensor_sets(plant, goal="estimate", candidates=rows, largest=3)
    assert [entry.sensors for entry in found.sets] == [("a", "b", "c")]


def test_rank_answers_agree_with_the_decoupled_plant() -> None:
    rng = np.random.default_rng(4)
    n = 6
    plant = obsynth.DescriptorSystem(
        np.diag([1, 1, 1, 1, 0, 0]), rng.integers(-2, 3, (n, n)) - 3 * np.eye(n), None, np.zeros((0, n)),
        Bf=rng.integers(-1, 2, (n, 2)), Bd=rng.integers(-1, 2, (n, 1)),
    )  # fmt: skip
    sensors = state_sensors(plant)
    pairs = np.array(list(combinations(range(n), 2)))
    responses = SensorResponses.of(plant, sensors)
    assert responses is not None
    shown = responses.shows(pairs, 0, (1,))
    for pair, strength in zip(pairs, shown, strict=True):
        asked = DecoupledFault(Removal(with_sensors(plant, [sensors[i] for i in pair]), (1,)), 0)
        assert asked.visible == (strength > 0.0)


@pytest.mark.long
def test_rank_answers_on_a_network_agree_with_the_decoupled_plant(share: Callable[..., Any]) -> None:
    # Kundur's 196 variables: 80 random pairs of all 19,110, or a share of them. The count is that of exact arithmetic
    # modulo 2**31 - 1.
    plant = load_spec(DESIGNS / "kundur" / "spec_fault_filter.yaml").transformation.source.dense()
    bare = plant.replace(
        C=np.zeros((0, plant.nx)), D=None, Dd=None, Df=None, Dw=None, output_names=[], units={}, scales={},
        operating_point={},
    )  # fmt: skip
    sensors = state_sensors(bare)
    pairs = np.array(list(combinations(range(len(sensors)), 2)))
    responses = SensorResponses.of(bare, sensors)
    assert responses is not None
    shown = responses.shows(pairs, 0, ())
    assert np.count_nonzero(shown) == 14240
    assert not np.any((shown > 0.0) & (shown < 1e-4))
    for number in share(np.random.default_rng(80).choice(len(pairs), 80, replace=False)):
        chosen = with_sensors(bare, [sensors[i] for i in pairs[number]])
        assert DecoupledFault(Removal(chosen, ()), 0).visible == (shown[number] > 0.0)


def test_no_set_of_the_size_asked_for() -> None:
    rows = {"a": np.poly([1, 2]), "b": np.poly([2, 3]), "c": np.poly([1, 3])}
    a = np.array([[-3.0, -3.0, -1.0], [1, 0, 0], [0, 1, 0]])
    plant = obsynth.DescriptorSystem(None, a, None, np.zeros((0, 3)), Bf=[[1], [0], [0]])
    found = obsynth.sensor_sets(plant, goal="estimate", candidates=rows, largest=2)
    assert found.sets == ()
    assert found.exact
    assert found.notes == (
        "No set of at most 2 of 3 candidates reaches the goal: all were tried.",
        "One of 3 does: a, b, c.",
    )


def test_which_sensors_may_fail() -> None:
    found = obsynth.sensor_sets(load_spec(DESIGNS / "motor" / "spec.yaml").plant)
    assert found.sets[0].sensors == ()
    assert found.may_be_lost == ("i",)
    assert found.lost_without == {"theta m": ("torque",), "theta l": ("torque",), "i": ()}
    assert "If theta l fails, the goal is lost for torque." in str(found)


def test_which_sensor_is_needed_for_which_fault() -> None:
    # Two faults in two paths: each needs its own sensor, until a third one shows the sum.
    plant = obsynth.DescriptorSystem(
        None, np.diag([-1.0, -2.0]), None, [[1, 0], [0, 1]], Bf=np.eye(2), fault_names=["a", "b"],
    )  # fmt: skip
    assert obsynth.sensor_sets(plant).lost_without == {"y1": ("a",), "y2": ("b",)}
    assert obsynth.sensor_sets(plant, faults=["b"]).lost_without == {"y1": (), "y2": ("b",)}
    three = plant.replace(C=[[1, 0], [0, 1], [1, 1]], D=None, Dd=None, Df=None, Dw=None, output_names=None)
    assert obsynth.sensor_sets(three).may_be_lost == ("y1", "y2", "y3")


@pytest.mark.parametrize("method", ["functional-filter", "ui-pi-observer"])
def test_refusals_end_with_sensors_that_help(method: str) -> None:
    plant = obsynth.discretise(one_encoder(), 0.01).plant
    with pytest.raises(obsynth.PreconditionError) as caught:
        obsynth.design(plant, method)
    assert str(caught.value).endswith("Measure one of: theta l.")
    assert caught.value.add == (("theta l",),)
    equipped = with_sensors(plant, [s for s in state_sensors(plant) if s.name == "theta l"])
    assert obsynth.design(equipped.replace(Dw=1e-3 * np.eye(3), Bw=None, noise_names=None), method).report.passed


def test_refusals_end_with_what_to_leave_out() -> None:
    # The unknown input acts where the fault does, and every state is measured already.
    plant = obsynth.DescriptorSystem(None, [[0.5]], None, ["x1"], Bf=[[1.0]], Bd=[[1.0]], Dw=[[0.1]], dt=1.0)
    with pytest.raises(obsynth.PreconditionError, match=r"Leave out one of: unknown input d1\.$"):
        obsynth.design(plant, "functional-filter")


def test_bad_arguments() -> None:
    plant = one_encoder()
    with pytest.raises(obsynth.SpecError, match="use one of detect"):
        obsynth.sensor_sets(plant, goal="guess")
    with pytest.raises(obsynth.SpecError, match="no such state"):
        obsynth.sensor_sets(plant, candidates=["phi"])
    with pytest.raises(obsynth.SpecError, match="not a positive number"):
        obsynth.sensor_sets(plant, cost={"theta l": -1.0})
    with pytest.raises(obsynth.PreconditionError, match="is not possible"):
        obsynth.sensor_sets(plant, candidates=["omega m"])


@pytest.mark.parametrize(
    ("options", "text"),
    [({"candidates": {"s": ["a", "b"]}}, "s: give a row of 2 numbers"), ({"candidates": {"s": [1.0]}}, "s: give a row"),
     ({"candidates": {"s": [1.0, np.nan]}}, "s: give a row"), ({"copies": 0}, "copies is 0"),
     ({"most": "x"}, "most is 'x'"), ({"largest": 1.5}, "largest is 1.5"), ({"largest": -1}, "largest is -1")],
)  # fmt: skip
def test_malformed_candidates_and_numbers_are_told(options, text):
    plant = obsynth.DescriptorSystem(None, [[0.5, 0.1], [0, 0.7]], C=[[1, 0]], Bf=[[1], [0]], Bd=[[0], [1]], dt=1.0)
    with pytest.raises(obsynth.SpecError, match=text):
        obsynth.sensor_sets(plant, **options)
