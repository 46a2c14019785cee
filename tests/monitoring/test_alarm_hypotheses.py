"""What an alarm may be: faults of the plant, faults of sensors, none of these; simulated apart from obsynth."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import obsynth
from obsynth.cli.main import main
from obsynth.errors import SpecError
from obsynth.monitoring.alarms.events import SHELVED_AFTER, AlarmLog, alarm_rows
from obsynth.monitoring.thresholds.alarm_ranking import NONE_OF_THESE
from obsynth.monitoring.thresholds.earlier_changes import LOOKED_FOR
from obsynth.monitoring.thresholds.hypotheses import Explanation, Hypothesis, ranked, ranked_changes

ROWS, BEGIN = 900, 500


def room_log(seed: int, *, air=0.0, wall=0.0, lost=0.0, drift=0.0, later=0, air_later=0.0) -> pd.DataFrame:
    """Return rows of a room with a heavy wall, in fourths of a sample: what is off from `BEGIN` on, in K and W; the
    heater, and one thermometer, so many rows ``later``."""
    rng = np.random.default_rng(seed)
    valve, out = np.repeat(rng.uniform(0.3, 0.7, 18), 50), np.repeat(rng.uniform(2.0, 8.0, 5), 200)
    x, rows = np.array([20.0, 15.0]), []
    for k in range(ROWS):
        faulty, faulty_later = float(k >= BEGIN), float(k >= BEGIN + later)
        for _ in range(4):
            between = 150.0 * (x[1] - x[0])
            heat = 4000.0 * valve[k] - lost * faulty_later
            x = x + 15.0 * np.array([(heat + between + 40.0 * (out[k] - x[0])) / 2e5,
                                     (80.0 * (out[k] - x[1]) - between) / 2e6])  # fmt: skip
        shown = x + 0.05 * rng.standard_normal(2) + faulty * np.array([air + drift * (k - BEGIN), wall])
        shown[0] += air_later * faulty_later
        rows.append([60.0 * k, valve[k], out[k], *shown])
    return pd.DataFrame(rows, columns=["time", "valve", "out", "Tair", "Twall"])


@pytest.fixture(scope="module")
def room():
    """Return a design without faults of sensors, and thresholds of two normal logs."""
    model = obsynth.DAEModel(
        {"air": "2e5 * der(a) = 4000 * valve - lost + 150 * (w - a) + 40 * (out - a)",
         "wall": "2e6 * der(w) = 150 * (a - w) + 80 * (out - w)"},
        {"Tair": "a", "Twall": "w"}, states={"a": 20.0, "w": 15.0}, inputs={"valve": 0.5, "out": 5.0},
        parameters={"lost": 0.0},
    )  # fmt: skip
    design = obsynth.dae_adaptive_observer(
        model, dt=60.0, Q={"air": 10.0, "wall": 10.0}, R={"Tair": 0.0025, "Twall": 0.0025}, form="augmented-kalman",
        random_walk={"lost": 25.0}, initial_parameter_covariance={"lost": 1e4}, outliers="gate",
    )  # fmt: skip
    return design, obsynth.learn_thresholds(design, [room_log(1), room_log(2)])


def event_of(design, learned, log, **options):
    """Return the first alarm after the begin."""
    monitor = obsynth.online_monitor(design, "learned", normal=learned, **options)
    run = obsynth.run_on_data(design, log, monitor=monitor)
    return next(event for event in run.events if event.last_row > BEGIN)


@pytest.mark.long
def test_a_replaced_sensor_is_no_fault_of_the_heater(room):
    event = event_of(*room, room_log(9, air=2.0))
    assert (event.fault, event.ties) == ("sensor Tair", ())
    assert event.low < 2.0 < event.high
    assert event.high - event.low < 0.3
    assert dict(event.shares)["sensor Tair"] > 0.99
    assert sum(share for _, share in event.shares) == pytest.approx(1.0)


@pytest.mark.long
def test_without_faults_of_sensors_it_is_named_as_before(room):
    assert event_of(*room, room_log(9, air=2.0), sensor_faults=False).fault == "lost"


@pytest.mark.long
def test_each_is_named_right(room):
    assert event_of(*room, room_log(9, wall=1.0)).fault == "sensor Twall"
    event = event_of(*room, room_log(9, lost=400.0))
    assert (event.fault, event.clear) == ("lost", True)


@pytest.mark.long
@pytest.mark.parametrize("later", [40, 120])
def test_a_fault_that_comes_while_an_alarm_stands_has_an_alarm_of_its_own(room, later: int):
    """The effect of the first was in its rows, and it kept that name."""
    design, learned = room
    monitor = obsynth.online_monitor(design, "learned", normal=learned)
    for log, names in (
        (room_log(9, wall=1.0, lost=800.0, later=later), ["sensor Twall", "lost"]),
        (room_log(9, wall=1.0, air_later=2.0, later=later), ["sensor Twall", "sensor Tair"]),
    ):
        events = obsynth.run_on_data(design, log, monitor=monitor).events
        found = [event for event in events if event.last_row > BEGIN]
        assert [event.fault for event in found] == names
        assert 0 <= found[1].first_row - 1 - (BEGIN + later) <= 20


@pytest.mark.long
def test_a_sensor_that_drifts_is_told_to_drift_and_its_tie_is_told(room):
    event = event_of(*room, room_log(9, drift=0.005))
    # The heater's fault takes what both sensors have in common: how they differ is all that is seen.
    assert "sensor Tair" in (event.fault, *event.ties)
    assert event.drifts
    assert "drifts" in alarm_rows([event], str)[0][1][alarm_rows([event], str)[0][0].index("fault")]


@pytest.mark.long
def test_a_run_that_is_resumed_says_the_same(room, tmp_path: Path):
    design, learned = room
    log = room_log(9, air=0.5)
    monitor = obsynth.online_monitor(design, "learned", normal=learned)
    whole = obsynth.run_on_data(design, log, monitor=monitor).table
    parts = [
        obsynth.run_on_data(design, part, monitor=monitor, state=tmp_path / "s.json").table
        for part in (log[: BEGIN + 7], log[BEGIN + 7 :])
    ]
    assert list(pd.concat(parts)["alarm"]) == list(whole["alarm"])
    assert "learned: sensor Tair" in set(whole["alarm"])
    without = obsynth.online_monitor(design, "learned", normal=learned, sensor_faults=False)
    with pytest.raises(SpecError, match="monitor had other options"):
        obsynth.run_on_data(design, log, monitor=without, state=tmp_path / "s.json")


@pytest.mark.long
def test_a_command_ranks_sensors_unless_it_is_told_not_to(room, tmp_path: Path, capsys):
    design, learned = room
    design.save(tmp_path / "g.json")
    learned.save(tmp_path / "t.json")
    room_log(9, air=2.0).to_csv(tmp_path / "log.csv", index=False)
    given = ["run", "--gains", str(tmp_path / "g.json"), "--data", str(tmp_path / "log.csv"), "--monitor", "learned",
             "--normal", str(tmp_path / "t.json"), "--out", str(tmp_path / "o.csv"), "--force"]  # fmt: skip
    assert main(given) == 0
    assert "sensor Tair" in capsys.readouterr().out
    assert main([*given, "--no-sensor-faults"]) == 0
    told = capsys.readouterr().out
    assert "lost" in told
    assert "sensor Tair" not in told
    assert main(["run", "--gains", given[2], "--data", given[4], "--no-sensor-faults", "--out", given[-2], "--force"])
    assert "--no-sensor-faults is for a monitor" in capsys.readouterr().err


@pytest.fixture(scope="module")
def linear():
    """Return a linear design with one estimate of a fault, and its plant in numbers."""
    A = np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.1], [0.05, 0.0, 0.85]])
    plant = obsynth.DescriptorSystem(
        A=A, B=[[1.0], [0.5], [0.0]], C=np.eye(3), Bf=[[1], [0], [0]], dt=1.0, fault_names=["leak"],
        sensor_noise={"y1": 0.05, "y2": 0.05, "y3": 0.05},
    )  # fmt: skip

    def log(seed, sensor=None, size=0.0, leak=0.0):
        rng = np.random.default_rng(seed)
        x, rows, u = np.zeros(3), [], np.repeat(rng.uniform(-1.0, 1.0, ROWS // 30), 30)
        for k in range(ROWS):
            y = x + 0.05 * rng.standard_normal(3)
            if k >= BEGIN and sensor is not None:
                y[sensor] += size
            rows.append([k, u[k], *y])
            x = A @ x + np.array([1.0, 0.5, 0.0]) * u[k] + 0.002 * rng.standard_normal(3)
            x[0] += leak * (k >= BEGIN)
        return pd.DataFrame(rows, columns=["time", "u1", "y1", "y2", "y3"])

    design = obsynth.fault_estimation_filter(plant)
    return design, obsynth.learn_thresholds(design, [log(1), log(2)]), log


@pytest.mark.long
def test_sensors_of_linear_designs_are_ranked_by_their_dynamics(linear):
    design, learned, log = linear
    event = event_of(design, learned, log(9, sensor=0, size=0.5))
    assert (event.fault, event.ties) == ("sensor y1", ())
    assert event.low < 0.5 < event.high
    # On one estimate a sensor that is slow to act looks like the leak, which comes first.
    event = event_of(design, learned, log(9, leak=0.3))
    assert event.fault == "leak"
    assert "sensor y1" not in event.ties


@pytest.mark.long
def test_sensors_of_designs_that_expect_a_course_of_the_faults_are_ranked_too(linear):
    """A PI observer follows a fault that stays, and an offset of a sensor until its estimates are moved."""
    filter_of_plant, _, log = linear
    design = obsynth.ui_pi_observer(filter_of_plant.plant)
    learned = obsynth.learn_thresholds(design, [log(1), log(2)])
    for sensor, name in enumerate(design.plant.output_names):
        event = event_of(design, learned, log(9, sensor=sensor, size=0.5))
        assert f"sensor {name}" in (event.fault, *event.ties)
    assert event_of(design, learned, log(9, leak=0.3)).fault == "leak"
    assert event_of(design, learned, log(9, sensor=1, size=0.5)).fault == "sensor y2"
    assert event_of(design, learned, log(9, sensor=1, size=0.5), sensor_faults=False).fault == "leak"


JUMPS = tuple(Hypothesis(name, name.startswith("sensor"), False) for name in ("leak", "worn", "sensor y"))


def ranking(*ratios, shift=0.0, hypotheses=JUMPS):
    """Return the ranking of what hypotheses explain."""
    values = np.array(ratios, dtype=float)
    return ranked(hypotheses, Explanation(values, np.full(len(values), 2.0), np.full(len(values), 0.1), shift))


def test_faults_of_the_plant_come_first_where_shares_do_not_decide():
    found = ranking(40.0, 5.0, 45.0)
    assert (found.named, found.ties) == ("leak", ("sensor y",))
    assert found.shares[0][0] == "sensor y"
    assert ranking(30.0, 5.0, 45.0).named == "sensor y"
    assert ranking(45.0, 43.0, 3.0).called(("leak", "worn")) == ""


def test_residuals_that_have_overflowed_are_ranked_as_nothing():
    assert ranking(np.inf, 5.0, 3.0) is None
    assert ranking(45.0, np.nan, 3.0) is None
    assert ranking(45.0, 5.0, 3.0, shift=np.inf) is None


def test_what_nothing_explains_is_none_of_these_faults():
    assert ranking(4.0, 5.0, 3.0, shift=10.0) is None
    found = ranking(30.0, 5.0, 3.0, shift=200.0)
    assert (found.named, found.ties) == (NONE_OF_THESE, ())
    assert ranking(150.0, 5.0, 3.0, shift=200.0).named == "leak"


def test_a_sensor_whose_fault_the_plant_has_is_told_once():
    found = ranking(60.0, 5.0, 60.0)
    assert (found.named, found.ties) == ("leak", ())
    assert "sensor y" not in dict(found.shares)


def test_an_unexplained_alarm_is_shelved_until_a_fault_explains_it():
    events, unknown = AlarmLog(["time"]), ranking(30.0, 5.0, 3.0, shift=200.0)
    for row in range(1, SHELVED_AFTER + 1):
        events.advance(0)
        events.take("learned", unknown.named, 2.0, 10.0 * row, row, [0.0], ranking=unknown)
    assert math.isnan(events.shelved_since("learned"))
    events.advance(0)
    events.take("learned", unknown.named, 2.0, 2010.0, 201, [0.0], ranking=unknown)
    assert events.shelved_since("learned") == 10.0
    (event,) = events.events()
    table = alarm_rows([event], lambda time: f"{time:g} s")[0]
    assert "shelved: unexplained offset since 10 s" in table[1][table[0].index("fault")]
    assert not event.clear
    known = ranking(90.0, 5.0, 3.0)
    events.advance(0)
    events.take("learned", known.named, 1.5, 2020.0, 202, [0.0], ranking=known)
    (event,) = events.events()
    assert (event.fault, math.isnan(event.shelved)) == ("leak", True)


def test_an_alarm_that_goes_on_under_another_name_says_so():
    """A long alarm was listed as two of different faults: that the first one still stands was nowhere said."""
    events, first, later = AlarmLog(["time"]), ranking(90.0, 5.0, 3.0), ranking(5.0, 3.0, 90.0)
    for row in range(1, 91):
        events.advance(0 if row != 61 else 30)
        named = first if row <= 20 else later._replace(earlier=1, ratio=90.0)
        named = named if row <= 40 else first._replace(earlier=2, ratio=90.0)
        events.take("learned", named.named, 2.0, 10.0 * row, row, [0.0], ranking=named)
    assert [event.fault for event in events.events()] == ["leak", "sensor y", "leak", "leak"]
    table = alarm_rows(events.events(), str)[0]
    names = [row[table[0].index("fault")] for row in table[1:]]
    assert names == ["leak", "sensor y; the alarm of leak still stands", "leak; the alarm of leak still stands", "leak"]
    assert [event.as_dict()["while_standing"] for event in events.events()] == ["", "leak", "leak", ""]


def alarm_of(*rankings):
    """Return the one alarm of rows with these rankings, each at less evidence than the one before."""
    events = AlarmLog(["time"])
    for row, ranked_row in enumerate(rankings, 1):
        events.advance(0)
        called = ranked_row.called(("leak", "worn"))
        events.take("learned", called, 10.0 / row, 10.0 * row, row, [0.0], distinguished=bool(called),
                    ranking=ranked_row)  # fmt: skip
    (event,) = events.events()
    return event


def test_what_was_as_likely_in_the_first_row_is_told_apart_by_later_rows():
    """The jump of a sensor was called by the fault of the plant that explained the first row as well, as evidence is
    largest there."""
    tied, told = ranking(40.0, 5.0, 45.0), ranking(40.0, 5.0, 90.0)
    event = alarm_of(tied, tied, told, told)
    assert (event.fault, event.ties, event.evidence) == ("sensor y", (), 10.0)
    assert alarm_of(tied, told, tied).fault == "sensor y"
    # One fault of several that are left is none.
    both = ranking(45.0, 44.0, 43.0)
    assert alarm_of(both, ranking(45.0, 44.0, 3.0)).fault == ""
    assert alarm_of(both, ranking(45.0, 60.0, 58.0)).candidates == ("worn", "sensor y")


def test_more_rows_correct_the_name_that_the_first_one_gave():
    """One row said that a fault of the plant was certain, all later ones a sensor; its evidence was the largest."""
    first, later = ranking(90.0, 5.0, 3.0), ranking(40.0, 5.0, 300.0)
    event = alarm_of(first, later, later)
    assert (event.fault, event.ties, event.evidence) == ("sensor y", (), 10.0)
    # What does not decide takes no name away, nor what comes once begins are no longer looked for.
    assert alarm_of(first, ranking(40.0, 5.0, 45.0)).fault == "leak"
    assert alarm_of(first, ranking(30.0, 5.0, 3.0, shift=200.0)).fault == "leak"
    assert alarm_of(*[first] * LOOKED_FOR, later).fault == "leak"


def test_another_order_of_the_faults_changes_no_answer():
    """Of those that were exactly alike the first in order was named."""
    faults, passed = ("worn", "pump", "leak"), np.ones(3, dtype=bool)
    values = {"worn": 30.0, "pump": 30.0, "leak": 30.0}
    found = {
        ranked_changes(order, np.array([[values[name] for name in order]]), passed)
        for order in itertools.permutations(faults)
    }
    assert len(found) == 1
    ratios = dict(zip(JUMPS, (45.0, 45.0, 44.0), strict=True))
    jumps = {ranking(*(ratios[jump] for jump in order), hypotheses=order) for order in itertools.permutations(JUMPS)}
    assert len({(found.shares, found.named, found.ties) for found in jumps}) == 1


def test_slow_changes_that_estimates_follow_are_ranked_by_their_own_likelihoods():
    """Residuals of half a leak return to zero while the estimate follows it: the alarm had no name and no list."""
    faults, passed = ("leak", "pump", "worn"), np.array([True, True, False])
    found = ranked_changes(faults, np.array([[3.0, 2.0, 1.0], [30.0, 28.0, 2.0]]), passed)
    assert found is not None
    assert (found.named, found.ties, found.called(faults)) == ("leak", ("pump",), "")
    assert [name for name, _ in found.shares][:2] == ["leak", "pump"]
    assert sum(share for _, share in found.shares) == pytest.approx(1.0)
    alone = ranked_changes(faults, np.array([[90.0, 28.0, 2.0]]), passed)
    assert alone is not None
    assert (alone.called(faults), alone.ties) == ("leak", ())
    assert ranked_changes(faults, np.array([[90.0, 28.0, 2.0]]), ~np.ones(3, dtype=bool)) is None
    assert ranked_changes(faults, np.array([[np.inf, 28.0, 2.0]]), passed) is None
