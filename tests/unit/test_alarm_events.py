"""Alarms as events: the fault of an alarm is named where its estimate is not zero as well."""

from __future__ import annotations

from obsynth.data.alarm_events import AlarmLog, alarm_rows

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
