"""Levels with as few alarms as were asked for, and the rows that alarms are told to be in, counted one by one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from test_exact_tests import log, run, test_of

import obsynth
from obsynth.monitoring.alarms.events import AlarmLog
from obsynth.monitoring.thresholds.learned_levels import (
    HOLD,
    SETTLING,
    count_alarms,
    drawn_places,
    exchangeable_level,
    level_of,
)

#: 95 % of a normal distribution.
BAND_WIDTH = 1.96
test_of.__test__ = False  # type: ignore[attr-defined]


def counted(values: np.ndarray, level: float) -> int:
    """Return the alarms of streams, row by row: one begins above the level after `HOLD` rows that were not."""
    found = 0
    for stream in values[:, SETTLING:]:
        quiet = HOLD
        for value in stream:
            if value > level:
                found += quiet >= HOLD
                quiet = 0
            else:
                quiet += 1
    return found


@pytest.mark.parametrize("seed", range(5))
def test_alarms_are_counted_row_by_row(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((3, 400))
    for level in (0.0, 1.0, 1.5, 2.0, 2.5, 10.0):
        assert count_alarms(values, level) == counted(values, level)


@pytest.mark.parametrize("allowed", [0.3, 0.99, 1.0, 1.5, 2.0, 3.0, 7.2])
@pytest.mark.parametrize("seed", range(4))
def test_a_level_has_as_many_alarms_as_allowed_and_the_next_lower_one_more(seed: int, allowed: float) -> None:
    values = np.random.default_rng([9, seed]).standard_normal((2, 900))
    rows = values[:, SETTLING:].size
    level = level_of(values, rows / allowed)
    assert counted(values, level) <= allowed
    assert counted(values, np.nextafter(level, -np.inf)) > allowed
    assert level in values[:, SETTLING:]


@pytest.mark.parametrize("seed", range(4))
def test_an_exchangeable_level_has_one_alarm_fewer_than_the_rate_allows(seed: int) -> None:
    values = np.random.default_rng([10, seed]).standard_normal((1, 1100))
    rows = values[:, SETTLING:].size
    previous = np.inf
    for allowed in (1.0, 1.5, 2.0, 2.5, 3.0, 4.0):
        level = exchangeable_level(values, rows, rows / allowed)
        assert counted(values, level) <= np.ceil(allowed - 1.0)
        assert level <= previous
        previous = level
    whole = [exchangeable_level(values, rows, rows / count) for count in (2.0, 3.0)]
    assert exchangeable_level(values, rows, rows / 2.25) == pytest.approx(0.75 * whole[0] + 0.25 * whole[1], rel=1e-12)
    assert counted(values, np.nextafter(whole[0], -np.inf)) == 2


def test_fewer_rows_than_a_rate_asks_for_leave_the_largest_value() -> None:
    values = np.random.default_rng(1).standard_normal((1, 300))
    assert level_of(values, 1e6) == values[:, SETTLING:].max()
    assert exchangeable_level(values, 200, 1e6) == values[:, SETTLING:].max()


def test_rows_are_drawn_from_all_places() -> None:
    places = drawn_places(50, 4, 300, np.random.default_rng(0))
    assert places.shape[0] == 4
    assert places.min() == 0
    assert places.max() == 49


def events_by_hand(over: list[int], evidence: dict[int, float]) -> list[tuple[int, int, int, float]]:
    """Return first row, last row, count and largest evidence of rows that are less than HOLD + 1 apart."""
    found: list[list[int]] = []
    for row in over:
        if found and row - found[-1][-1] <= HOLD:
            found[-1].append(row)
        else:
            found.append([row])
    return [(rows[0], rows[-1], len(rows), max(evidence[row] for row in rows)) for rows in found]


@pytest.mark.parametrize("seed", range(12))
def test_events_are_rows_less_than_a_hold_apart(seed: int) -> None:
    rng = np.random.default_rng([11, seed])
    events, over, evidence, place = AlarmLog(["fhat[f]", "sd fhat[f]"]), [], {}, 0
    for _ in range(300):
        missing = int(rng.integers(0, 4)) if rng.random() < 0.05 else 0
        events.advance(missing)
        place += missing + 1
        if rng.random() < 0.06:
            evidence[place] = float(rng.uniform(1.0, 3.0))
            over.append(place)
            events.take("pointwise", "f", evidence[place], 0.1 * place, place, [place, 0.5])
    found = [(one.first_row, one.last_row, one.rows, one.evidence) for one in events.events()]
    assert found == events_by_hand(over, evidence)
    for one in events.events():
        assert (one.start, one.end) == (pytest.approx(0.1 * one.first_row), pytest.approx(0.1 * one.last_row))
        best = next(row for row in over if one.first_row <= row <= one.last_row and evidence[row] == one.evidence)
        assert one.size == best
        assert (one.low, one.high) == (pytest.approx(best - BAND_WIDTH * 0.5), pytest.approx(best + BAND_WIDTH * 0.5))


def test_a_fault_is_named_by_the_row_that_distinguishes_best() -> None:
    events = AlarmLog(["fhat[a]", "fhat[b]"])
    rows: list[tuple[str, float, bool]] = [("", 3.0, False), ("a", 1.5, True), ("b", 2.0, True), ("a", 1.9, True)]
    for row, (fault, evidence, distinguished) in enumerate(rows, start=1):
        events.advance(0)
        events.take("learned", fault, evidence, float(row), row, [10.0 + row, 20.0 + row], distinguished=distinguished)
    (one,) = events.events()
    assert (one.fault, one.size, one.evidence, one.distinguished) == ("b", 23.0, 3.0, True)


def table_rows(found: Any) -> np.ndarray:
    table = found.table
    statistic, threshold = (table[name].to_numpy(dtype=float) for name in ("statistic", "threshold"))
    return np.flatnonzero(statistic > threshold) + 1


@pytest.mark.parametrize("seed", [1, 2])
def test_the_rows_of_an_alarm_are_those_of_the_log(seed: int) -> None:
    """First and last row are numbers of rows of the data, from 1, and their times are those of these rows."""
    data = log(3.0 * test_of().threshold, seed=seed)
    found = run(data)
    (event,) = found.events
    over = table_rows(found)
    assert (event.first_row, event.last_row, event.rows) == (over[0], over[-1], len(over))
    times = data["time"].to_numpy()
    assert (event.start, event.end) == (times[over[0] - 1], times[over[-1] - 1])


def test_an_alarm_is_proved_for_the_row_that_is_named() -> None:
    """The samples of the proof are those up to the row, and the row before, without the jump, has no proof."""
    data = log(0.0, seed=4)
    jumped = data.copy()
    names = list(test_of().linear[0].output_names)
    jumped.loc[29:, names[0]] += 50.0
    proof = obsynth.prove_alarm(test_of(), jumped, 30)
    assert proof.proved
    assert proof.row == 30
    assert proof.statement.startswith("Proved: rows 23 to 30 of a record")
    kept = pd.DataFrame(np.asarray(proof.certificate["y"]["data"]).reshape(proof.certificate["y"]["shape"]))
    assert np.allclose(kept.to_numpy(), jumped[names].to_numpy()[22:30])
    assert not obsynth.prove_alarm(test_of(), jumped, 29).proved
