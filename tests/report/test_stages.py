"""What a command says while it is at work: each stage as it begins, and again where one takes long."""

from __future__ import annotations

import time

import pytest

from obsynth.report.terminal import stages
from obsynth.report.terminal.stages import SHARE, SILENCE, Stages, progress, watched_stages


class Clock:
    """Seconds that a test sets, of the wall and of the processor."""

    def __init__(self) -> None:
        self.now = self.spent = 0.0

    def monotonic(self) -> float:
        return self.now

    def process_time(self) -> float:
        return self.spent

    def passes(self, seconds: float) -> None:
        self.now, self.spent = self.now + seconds, self.spent + seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(stages, "time", clock)
    return clock


def test_a_long_stage_is_told_again_with_its_time(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    told = Stages("check")
    clock.passes(SILENCE - 0.1)
    told.look()
    assert capsys.readouterr().err == ""
    clock.passes(0.2)
    told.look()
    told.look()
    assert capsys.readouterr().err == "[  5.1 s] check: 5 s so far\n"
    told.enter("choosing the gains")
    clock.passes(SILENCE)
    told.look()
    assert capsys.readouterr().err == "[ 10.1 s] choosing the gains: 5 s so far\n"


def test_lines_become_rarer(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    told = Stages("sweep")
    for _ in range(1000):
        clock.passes(1.0)
        told.look()
    seconds = [float(line[1:7]) for line in capsys.readouterr().err.splitlines()]
    assert seconds[:3] == [5.0, 10.0, 15.0]
    assert SHARE * seconds[-1] - 1.0 <= seconds[-1] - seconds[-2] <= SHARE * seconds[-1] + 1.0


def test_waiting_is_no_work(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    told = Stages("run")
    clock.now = 100.0
    told.look()
    assert capsys.readouterr().err == ""


def test_a_command_that_tells_nothing_is_watched(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(stages, "SILENCE", 0.05)
    monkeypatch.setattr(stages, "LOOK", 0.01)

    def work() -> None:
        end = time.process_time() + 0.5
        while time.process_time() < end:
            sum(range(1000))

    with watched_stages("check", quiet=True):
        work()
    assert capsys.readouterr().err == ""
    with watched_stages("check", quiet=False):
        work()
        assert "check: 0 s so far" in capsys.readouterr().err
        with progress(quiet=False) as report_stage:
            report_stage("reading")
            work()
    first, second, *_ = capsys.readouterr().err.splitlines()
    assert first.endswith("s] reading")
    assert second.endswith("s] reading: 0 s so far")
