"""What ``print`` shows of a result: what a reader wants to know, not arrays and dictionaries."""

from __future__ import annotations

import copy
import pickle
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import obsynth

SPEC = obsynth.load_spec(Path(__file__).parents[2] / "designs/wang2015/spec.yaml")


@cache
def design() -> obsynth.ObserverDesign:
    return obsynth.fault_estimation_filter(SPEC.plant, weight="paper")


@cache
def simulation() -> Any:
    return obsynth.simulate(design(), SPEC.scenario)


def log() -> pd.DataFrame:
    run = simulation()
    signals = dict(zip((*run.input_names, *run.output_names), np.hstack([run.inputs, run.outputs]).T, strict=True))
    return pd.DataFrame({"time": run.time, **signals})


def noisy_log() -> pd.DataFrame:
    quiet = log().iloc[:80]
    rows = pd.concat([quiet] * 5, ignore_index=True)
    rows["time"] = np.arange(len(rows), dtype=float)
    rows[list(SPEC.plant.output_names)] = np.random.default_rng(0).normal(size=(len(rows), 3))
    return rows


#: What makes each result, and what its text says.
RESULTS: dict[str, tuple[Callable[[], Any], tuple[str, ...]]] = {
    "spec": (lambda: SPEC, ("wang2015", "fault-estimation-filter", "300 s")),
    "design": (design, ("Verified: all", "gamma = 1.538", "actuator 2")),
    "certificate": (lambda: design().certificate, ("gamma = 1.53795", "P_factor (4, 4)")),
    "observer": (lambda: design().observer, ("order 4", "2 inputs and 3 outputs")),
    "estimates": (lambda: simulation().estimates, ("301 samples", "x4, actuator 1, actuator 2")),
    "estimates of a sample": (
        lambda: design().observer.step(design().observer.init(), [1.0, 0.0, 0.0], [0.0, 0.0])[1],
        ("x1 = ", "actuator 2 = "),
    ),
    "recursive observer": (
        lambda: obsynth.descriptor_kalman(SPEC.plant).observer,
        ("RecursiveObserver", "nx="),
    ),
    "simulation": (simulation, ("301 samples, 300 s", "actuator 1", "RMSE", "x4")),
    "evaluation": (
        lambda: obsynth.evaluate(design(), SPEC.scenario, runs=2, monitor=obsynth.monitor(design(), SPEC.scenario)),
        ("2 runs", "false alarms", "detection delay", "actuator 1"),
    ),
    "structure": (lambda: obsynth.analyse_structure(SPEC.plant), ("regular, index 1", "rank 3 of 4", "0.9448")),
    "check": (
        lambda: obsynth.check(SPEC.plant),
        ("fault-estimation-filter: all conditions hold", "pd-observer: continuous only", "for other kinds of plants"),
    ),
    "elimination": (
        lambda: obsynth.eliminate_algebraic_states(SPEC.plant),
        ("eliminated 1 algebraic state;", "nx=3"),
    ),
    "run": (
        lambda: obsynth.run_on_data(design(), log(), thresholds={"fhat[actuator 1]": 0.8}),
        ("First alarm 81 s (threshold of fhat[actuator 1])", "Estimates of 301 rows"),
    ),
    "thresholds": (
        lambda: obsynth.learn_thresholds(design(), noisy_log()),
        ("Monitored: ", "one false alarm per 1000 rows"),
    ),
}


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", RESULTS)
def test_the_text_of_a_result_is_for_readers(name: str) -> None:
    make, words = RESULTS[name]
    result = make()
    text = str(result)
    for word in words:
        assert word.casefold() in text.casefold()
    for inside in ("array(", "mappingproxy", "RankDecision", "Interval(", " at 0x"):
        assert inside not in text


def test_reports_by_method_are_a_dictionary() -> None:
    reports = obsynth.check(SPEC.plant)
    assert isinstance(reports, dict)
    assert reports["ui-pi-observer"].passed
    assert dict(copy.deepcopy(reports)) == dict(pickle.loads(pickle.dumps(reports)))


PLANT = obsynth.DescriptorSystem(A=[[0, 1], [-2, -3]], C=[[1, 0]], B=[[0], [1]], Bf=[[0], [1]])

#: What a user of another library writes -> what the message says.
ELSEWHERE = {
    "design.L": r"write design.gains\['L'\]",
    "design.gamma": r"write design.certificate.claims\['gamma'\]",
    "design.poles": r"write design.to_control\(\).poles\(\)",
    "design.simulate": r"write obsynth.simulate\(design, scenario\)",
    "design.observers": "Did you mean 'observer'",
    "plant.poles": r"write obsynth.analyse_structure\(plant\)",
    "plant.c2d": r"write obsynth.discretise\(plant, sample_time\)",
    "plant.Ts": "write plant.dt",
    "plant.states": "write plant.state_names",
    "sampled.dt": r"write transformation\.plant\.dt",
    "sampled.descriptions": "Did you mean 'description'",
    "obsynth.kalman": "Did you mean 'descriptor_kalman'",
    "obsynth.ss": "Did you mean 'DescriptorSystem'",
    "obsynth.lmi": "Did you mean 'conditions'",
    "obsynth.transform": "Did you mean 'discretise'",
    "conditions.filasova_theorem": r"Did you mean 'filasova_theorem[12]'",
}


@pytest.mark.parametrize("written", ELSEWHERE)
def test_an_attribute_of_another_library_is_answered_with_ours(written: str) -> None:
    owner, name = written.split(".")
    of = {"design": design(), "plant": PLANT, "obsynth": obsynth, "conditions": obsynth.conditions}.get(owner)
    of = obsynth.discretise(PLANT, 0.1) if owner == "sampled" else of
    with pytest.raises(AttributeError, match=ELSEWHERE[written]) as raised:
        getattr(of, name)
    if of in (obsynth, obsynth.conditions):
        assert "".join(traceback.format_exception_only(raised.value)).count("Did you mean") == 1


def test_a_scenario_shows_what_is_stated() -> None:
    scenario = obsynth.Scenario(horizon=10.0, faults={"pump": obsynth.Step(size=1.0, start=3.0)}, seed=4)
    assert repr(scenario) == ("Scenario(horizon=10.0, faults={'pump': (Step(start=3.0, end=inf, size=1.0),)}, seed=4)")
    assert repr(obsynth.Scenario(horizon=10.0, noise=0.0)) == "Scenario(horizon=10.0)"


def test_what_a_message_points_to_exists() -> None:
    """Every hint is an expression that runs but for its arguments."""
    from obsynth.plants.other_names import ELSEWHERE as OF_PLANTS
    from obsynth.results.design import ELSEWHERE as OF_DESIGNS

    known = {"obsynth": obsynth, "plant": PLANT, "design": design()}
    for hint in {*OF_PLANTS.values(), *OF_DESIGNS.values()}:
        for text in hint.split(" or "):
            path = text.partition("(")[0].split(".")
            value: Any = known.get(path[0], print)
            for part in path[1:]:
                value = getattr(value, part)
    for name in obsynth._OTHER_NAMES.values():
        value = obsynth
        for part in name.split("."):
            value = getattr(value, part)
        assert callable(value) or name in ("conditions", "plotting")


def test_plants_and_designs_are_copied_and_sent_to_other_processes(tmp_path: Path) -> None:
    saved = design().save(tmp_path / "a.json").read_bytes()
    for same in (copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))):
        plant, again = same(PLANT), same(design())
        np.testing.assert_array_equal(plant.A, PLANT.A)
        assert again.save(tmp_path / "b.json").read_bytes() == saved
        assert obsynth.verify(again).passed
        for array in (plant.A, again.gains["L"], again.observer.Az, again.certificate.matrices["tracking"]):
            with pytest.raises(ValueError, match="read-only"):
                array[0, 0] = 7.0


def test_nothing_else_is_asked_of_plants_and_designs() -> None:
    assert not hasattr(PLANT, "__array__")
    assert not hasattr(design(), "_repr_png_")
