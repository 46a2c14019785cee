"""Alarms as events: the fault of an alarm is named where its estimate is not zero as well."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from obsynth.monitoring.alarms.events import (
    NAMED_BY_THE_FIRST,
    NOT_VALID,
    AlarmEvent,
    AlarmLog,
    alarm_notes,
    alarm_rows,
    rows_in_alarm,
    time_in_alarm,
)
from obsynth.monitoring.thresholds.alarm_ranking import Ranking
from obsynth.monitoring.thresholds.monitor import NOT_DISTINGUISHED, Monitor, Rule, RuleOutput, Sample

COLUMNS = ("fhat[leak]", "fhat[clog]", "sd fhat[leak]", "sd fhat[clog]")


def events(leak: float, clog: float):
    log = AlarmLog(COLUMNS)
    log.take("nis", "leak", 1.1, 10.0, 11, (leak, clog, 0.1, 0.1))
    log.take("nis", "clog", 1.6, 12.0, 13, (leak, clog, 0.1, 0.1))
    return log.events()


def test_a_fault_whose_interval_holds_zero_is_told_as_unclear() -> None:
    for clog, told in ((0.5, "clog"), (-0.5, "clog"), (0.1, "clog (unclear)")):
        (found,) = events(0.0, clog)
        assert found.clear == (told == "clog")
        heading, row = alarm_rows([found], str)[0]
        assert dict(zip(heading, row, strict=True))["fault"] == told


def test_without_a_fault_or_an_interval_nothing_is_unclear() -> None:
    log = AlarmLog(())
    log.take("nis", "", 1.1, 10.0, 11, ())
    log.take("chi-square", "leak", 1.1, 10.0, 11, ())
    nameless, unknown = log.events() if log.events()[0].by == "nis" else log.events()[::-1]
    assert not nameless.clear
    assert unknown.clear
    rows = alarm_rows([nameless, unknown], str)[0]
    assert [row[rows[0].index("fault")] for row in rows[1:]] == ["", "leak"]


def test_an_interval_that_its_own_alarm_contradicts_is_told_as_not_valid() -> None:
    # Innovations above their threshold contradict the covariances that the deviations come from; levels do not, and
    # guaranteed intervals rest on bounds.
    log = AlarmLog((*COLUMNS, "lowest clog", "highest clog"))
    row = (0.5, 0.5, 0.1, 0.1, 0.3, 0.7)
    for by, fault in (
        ("nis", "leak"),
        ("learned", "leak"),
        ("fhat[leak]", "leak"),
        ("pointwise", "clog"),
        ("cusum", ""),
    ):
        log.take(by, fault, 2.0, 10.0, 11, row)
    events = {event.by: event for event in log.events()}
    valid = {"nis": False, "learned": False, "fhat[leak]": True, "pointwise": True, "cusum": False}
    assert {by: event.valid for by, event in events.items()} == valid
    assert all(event.as_dict()["interval_valid"] == valid[by] for by, event in events.items())
    heading, *told = alarm_rows(list(events.values()), str)[0]
    marked = {row[0] for row in told if row[heading.index("interval")].endswith(" (not valid)")}
    assert marked == {"nis", "learned"}
    assert alarm_notes([events["nis"]]) == [NOT_VALID]
    assert alarm_notes([events["fhat[leak]"], events["pointwise"], events["cusum"]]) == []


def test_the_share_of_time_in_alarm_is_told_beside_the_events():
    one = AlarmEvent("nis", "", 0.0, 9.0, 1, 10, 7, math.nan, math.nan, math.nan, 2.0)
    both = (one, replace(one, first_row=41, last_row=41, rows=1), replace(one, by="fhat[f]", rows=3))
    assert rows_in_alarm(both) == {"nis": 8, "fhat[f]": 3}
    assert time_in_alarm(both, 80) == [
        "In alarm by nis: 8 of 80 rows (10 %), 2 alarms, the longest 10 rows from first to last.",
        "In alarm by fhat[f]: 3 of 80 rows (3.75 %), 1 alarm, 10 rows from first to last.",
    ]
    assert time_in_alarm((), 80) == []


class Ranked(Rule):
    """A rule that alarms and does not tell the faults apart, or names one, with a ranking beside it."""

    def __init__(self, ranking: Ranking | None, fault: int = NOT_DISTINGUISHED) -> None:
        self.ranking, self.fault = ranking, fault

    def init(self) -> None:
        return None

    def step(self, state: None, sample: Sample) -> tuple[None, RuleOutput]:
        return None, RuleOutput(2.0, 1.0, self.fault, (), self.ranking)

    def restart(self, state: None, skipped: int = 0) -> None:
        return None

    def options(self) -> None:
        return None


@pytest.mark.parametrize(
    ("ties", "named", "shown"),
    [((), "leak", "leak"), (("clog", "sensor L1"), "", "leak or clog or sensor L1 (not distinguished yet)")],
)
def test_shares_name_a_fault_where_they_suffice_and_else_all_that_are_as_likely(
    ties: tuple[str, ...], named: str, shown: str
) -> None:
    shares = (("leak", 0.4), *((name, 0.3) for name in ties), ("none of these faults", 0.0))
    monitor = Monitor("learned", "", Ranked(Ranking(shares, "leak", ties)), 1, ("leak", "clog"), np.ones(2))
    _, output = monitor.step(monitor.init(), Sample(0.0, np.ones(1), np.ones(2), None))
    assert output.fault == named
    log = AlarmLog(COLUMNS)
    log.take("learned", output.fault, 2.0, 0.0, 1, (0.5, 0.0, 0.1, 0.1), distinguished=bool(output.fault),
             ranking=output.ranking)  # fmt: skip
    heading, row = alarm_rows(log.events(), str)[0]
    assert dict(zip(heading, row, strict=True))["fault"] == shown


def test_a_fault_that_the_rule_names_is_as_likely_as_others_and_not_as_itself() -> None:
    """The alarm of a clog said "as likely as: clog", and the leak was not shown."""
    shares = (("leak", 0.5), ("clog", 0.5), ("none of these faults", 0.0))
    rule = Ranked(Ranking(shares, "leak", ("clog",)), 1)
    monitor = Monitor("learned", "", rule, 1, ("leak", "clog"), np.ones(2))
    _, output = monitor.step(monitor.init(), Sample(0.0, np.ones(1), np.ones(2), None))
    log = AlarmLog(COLUMNS)
    log.take("learned", output.fault, 2.0, 0.0, 1, (0.5, 0.0, 0.1, 0.1), ranking=output.ranking)
    (event,) = log.events()
    assert (event.fault, event.ties) == ("clog", ("leak",))
    heading, row = alarm_rows(log.events(), str)[0]
    assert dict(zip(heading, row, strict=True))["fault"] == "clog or leak"


def test_a_long_alarm_says_that_later_faults_may_have_no_name() -> None:
    log = AlarmLog(())
    ranking = Ranking((("lost", 0.9), ("leak", 0.1)), "lost")
    for row in range(1, 260):
        log.advance(0)
        log.take("learned", "lost", 2.0, float(row), row, (), ranking=ranking)
        assert (NAMED_BY_THE_FIRST in alarm_notes(log.events())) == (row > 200)
