"""Changes beside those that an alarm was named by: least squares over all, and alarms of their own."""

from __future__ import annotations

import math

import numpy as np
import pytest

from obsynth.monitoring.alarms.events import AlarmLog
from obsynth.monitoring.thresholds.alarm_ranking import NONE_OF_THESE, Ranking
from obsynth.monitoring.thresholds.earlier_changes import MOST_KEPT, EarlierChanges

BEGINS, CHANNELS, HYPOTHESES, ROWS = 4, 3, 2, 60


def followed(seed: int, *, named: bool) -> tuple[EarlierChanges, list[np.ndarray], list[np.ndarray], np.ndarray]:
    """Return changes after rows: the first begin is kept at row 10 (or nothing is named), the others begin later."""
    rng = np.random.default_rng(seed)
    white = [rng.standard_normal(CHANNELS) for _ in range(ROWS)]
    effects = [rng.standard_normal((BEGINS, CHANNELS, HYPOTHESES)) for _ in range(ROWS)]
    begun = np.array([0, 12, 20, 35])
    effects = [row * (k >= begun)[:, None, None] for k, row in enumerate(effects)]
    changes = EarlierChanges.none(BEGINS, CHANNELS, HYPOTHESES)
    for k in range(ROWS):
        if k == 10:
            changes = changes.kept(10.0)
            if named:
                first = np.array([row[0, :, 1] for row in effects[:10]]).ravel()
                score = float(first @ np.concatenate(white[:10]))
                changes = changes.with_change(0, 1, score, float(first @ first))
        changes = changes.moved(effects[k], 1.0 * (k >= begun), white[k])
    return changes, white, effects, begun


@pytest.mark.parametrize("named", [True, False])
def test_what_is_left_is_what_least_squares_over_all_gain(named: bool) -> None:
    changes, white, effects, begun = followed(3, named=named)
    y, all_effects = np.concatenate(white), np.array(effects)
    shift = np.vstack([np.eye(CHANNELS) * float(k >= 10) for k in range(ROWS)])
    before = np.column_stack([shift, *([all_effects[:, 0, :, 1].ravel()] if named else [])])

    def left_over(columns: np.ndarray) -> float:
        return float(np.sum((y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]) ** 2))

    score = np.einsum("kbmh,km->bh", all_effects, np.array(white))
    information = np.einsum("kbmh,kbmh->bh", all_effects, all_effects)
    sums = np.array([np.sum(white[first:], axis=0) for first in begun])
    scores, informations, sums_left = changes.beside(score, information, sums)
    for b in range(1, BEGINS):
        for h in range(HYPOTHESES):
            gain = left_over(before) - left_over(np.column_stack([before, all_effects[:, b, :, h].ravel()]))
            assert scores[b, h] ** 2 / informations[b, h] == pytest.approx(gain, rel=1e-9)
    fitted = (before @ np.linalg.lstsq(before, y, rcond=None)[0]).reshape(ROWS, CHANNELS)
    for b in range(1, BEGINS):
        assert sums_left[b] == pytest.approx((np.array(white) - fitted)[begun[b] :].sum(axis=0), abs=1e-9)
    assert changes.ratio == pytest.approx(float(y @ y) - left_over(before))


def test_an_effect_that_is_the_one_before_says_nothing() -> None:
    rng = np.random.default_rng(4)
    changes = EarlierChanges.none(2, CHANNELS, HYPOTHESES).kept(0.0).with_change(0, 1, 0.0, 0.0)
    information = np.zeros((2, HYPOTHESES))
    for _ in range(ROWS):
        effects = rng.standard_normal((2, CHANNELS, HYPOTHESES))
        effects[1, :, 0] = -2.0 * effects[0, :, 1]
        changes = changes.moved(effects, np.ones(2), rng.standard_normal(CHANNELS))
        information += np.einsum("bmh,bmh->bh", effects, effects)
    _, left, _ = changes.beside(np.zeros((2, HYPOTHESES)), information, np.zeros((2, CHANNELS)))
    assert left[1, 0] == 0.0
    assert left[1, 1] > 0.9 * information[1, 1]


def test_begins_that_take_the_place_of_others_share_nothing_and_no_more_are_kept_than_there_is_room_for() -> None:
    changes, *_ = followed(5, named=True)
    again = changes.with_begin(2)
    assert not again.shared[2].any()
    assert not again.sums[2].any()
    assert again.shared[1].any()
    for place in range(1, 5):
        changes = changes.kept(20.0).with_change(place % BEGINS, 0, 1.0, 2.0)
    assert changes.changes == MOST_KEPT
    assert changes.number == 5
    fresh = changes._replace(number=0, changes=0).kept(30.0)
    assert not fresh.information.any()


def test_what_errors_of_the_model_leave_is_no_change() -> None:
    changes, *_ = followed(6, named=True)
    later = Ranking((("leak", 0.9),), "leak")
    assert changes.distinguishes(later, 20.0, {"worn"})
    assert not changes.distinguishes(later, 17.0, {"worn"})
    assert not changes.distinguishes(later, 20.0, {"leak"})
    assert not changes.distinguishes(later._replace(named="worn", ties=("leak",)), 20.0, {"leak"})
    assert not changes.distinguishes(later._replace(named=NONE_OF_THESE), 20.0, {"worn"})
    strong = changes._replace(score=300.0 * changes.score)
    assert not strong.distinguishes(later, 0.015 * strong.ratio, {"worn"})
    assert strong.distinguishes(later, 0.025 * strong.ratio, {"worn"})


def test_a_fault_that_comes_again_after_its_alarm_ended_is_a_later_change() -> None:
    """Else another cause that the first row alone made likelier kept the name, whatever the rows after it said."""
    changes, *_ = followed(6, named=True)
    again = Ranking((("sensor T", 1.0),), "sensor T")
    assert not changes.distinguishes(again, 4000.0, {"sensor T"})
    ended = changes._replace(is_over=1)
    assert ended.distinguishes(again, 4000.0, {"sensor T"})
    assert not ended.distinguishes(again, 17.0, {"sensor T"})
    assert not ended.distinguishes(again._replace(named=NONE_OF_THESE), 4000.0, {"sensor T"})


def test_a_change_that_came_later_has_an_alarm_of_its_own_and_is_named_where_it_is_largest() -> None:
    log = AlarmLog(["time"])

    def take(row: int, evidence: float, name: str, earlier: int = 0, ratio: float = math.nan) -> None:
        log.advance(0)
        ranking = Ranking(((name, 1.0),), name, earlier=earlier, ratio=ratio)
        log.take("learned", name, evidence, float(row), row, [0.0], ranking=ranking)

    take(1, 9.0, "leak")
    take(2, 5.0, "leak")
    take(3, 4.0, "worn", 1, 20.0)
    take(4, 3.0, "scaled", 1, 60.0)
    # Neither what the first one is called, nor more of all changes together, names the second.
    take(5, 8.0, "leak")
    take(6, 8.5, "worn", 1, 30.0)
    take(7, 1.5, "leak", 2, 25.0)
    found = [(event.fault, event.first_row, event.last_row) for event in log.events()]
    assert found == [("leak", 1, 2), ("scaled", 3, 6), ("leak", 7, 7)]


def test_a_new_alarm_is_named_by_what_is_found_beside_the_one_before() -> None:
    """It begins with the name of what was there before, and is no third alarm once it has its own."""
    log = AlarmLog(["time"])
    for row, name, ratio in ((1, "leak", math.nan), (2, "leak", math.nan), (3, "worn", 20.0), (4, "leak", math.nan)):
        log.advance(0)
        ranking = Ranking(((name, 1.0),), name, earlier=1, ratio=ratio)
        log.take("learned", name, 10.0 - row, float(row), row, [0.0], ranking=ranking)
    (event,) = log.events()
    assert (event.fault, event.rows) == ("worn", 4)
