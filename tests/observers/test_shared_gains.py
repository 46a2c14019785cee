"""The gains of a recursive observer follow from it alone: those who look at them share one computation."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import obsynth
from obsynth.errors import PreconditionError
from obsynth.observers.recursive import gain_schedule, gain_schedule_summary
from obsynth.observers.recursive.gain_schedule import GainStep, gain_steps, shared_gains


def plant(slow: float) -> obsynth.DescriptorSystem:
    """Return a plant of order two whose slow state no other test has."""
    return obsynth.DescriptorSystem(
        A=[[slow, 0.1], [0.0, 0.5]], C=[[1, 0], [0, 1]], Bf=[[1], [0]], dt=1.0, sensor_noise={"y1": 0.1, "y2": 0.2}
    )


def equal(first: GainStep, second: GainStep) -> bool:
    """Whether two steps hold the same numbers, bit for bit."""
    return all(np.array_equal(one, other) for one, other in zip(first[1:], second[1:], strict=True))


def test_design_and_verification_take_each_step_once(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[int] = []

    def counted(*arguments: object, **options: object):
        for step in gain_steps(*arguments, **options):
            taken.append(1)
            yield step

    monkeypatch.setattr(gain_schedule, "gain_steps", counted)
    design = obsynth.descriptor_kalman(plant(0.815), Q=0.01)
    assert design.report.passed
    assert len(taken) == design.certificate.claims["steps"]
    # Another observer shares nothing with it, though its numbers are the same.
    again = obsynth.verify(design.replace(observer=obsynth.descriptor_kalman(plant(0.815), Q=0.01).observer))
    assert again.passed
    assert len(taken) == 2 * design.certificate.claims["steps"]


def test_their_summary_is_taken_once_however_many_numbers_they_are(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    observers: list[object] = []

    def counted(observer, **options):
        observers.append(observer)
        return summary(observer, **options)

    summary = gain_schedule_summary.gain_schedule_summary
    monkeypatch.setattr(gain_schedule, "MOST_KEPT_GAINS", 0)
    monkeypatch.setattr(gain_schedule_summary, "gain_schedule_summary", counted)
    design = obsynth.descriptor_kalman(plant(0.845), Q=0.01)
    assert design.report.passed
    assert observers == [design.observer]
    # Stored and loaded it is another observer, whose gains nobody has looked at.
    loaded = obsynth.load(design.save(tmp_path / "gains.json"))
    assert obsynth.verify(loaded).passed
    assert observers == [design.observer, loaded.observer]


def test_from_several_threads_they_are_those_of_one() -> None:
    observer = obsynth.descriptor_kalman(plant(0.825), Q=0.01).observer
    gain_schedule._computed_gains.cache_clear()
    expected = list(gain_steps(observer, 60))
    with ThreadPoolExecutor(4) as pool:
        for steps in pool.map(lambda count: list(shared_gains(observer, count)), (60, 20, 60, 40)):
            assert all(map(equal, steps, expected))


def test_after_an_error_they_begin_where_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    observer = obsynth.descriptor_kalman(plant(0.835), Q=0.01).observer
    gain_schedule._computed_gains.cache_clear()
    expected = list(gain_steps(observer, 9))

    def interrupted(*arguments: object, **options: object):
        for count, step in enumerate(gain_steps(*arguments, **options)):
            if count == 5:
                raise PreconditionError("The errors outgrow double precision.", condition="bounded errors")
            yield step

    with monkeypatch.context() as patched:
        patched.setattr(gain_schedule, "gain_steps", interrupted)
        for _ in range(2):
            with pytest.raises(PreconditionError, match="outgrow"):
                list(shared_gains(observer, 9))
    steps = list(shared_gains(observer, 9))
    assert len(steps) == 9
    assert all(map(equal, steps, expected))
