"""One direction of each point proves what all signals of all points prove, and the direction is true whatever it is."""

from __future__ import annotations

import flint
import numpy as np
import pytest

import obsynth
from obsynth.verification import invisible_faults
from obsynth.verification.invisible_faults import PRECISION_BITS, proved_least, proved_limit
from obsynth.verification.seen_outputs import Setting, seen_plant

LAG = (np.array([[-2.0]]), np.array([[2.0]]), np.array([[1.0]]), np.array([[0.0]]))
#: What each problem is: sampling, settings, points that are invisible, and last samples.
PROBLEMS = {
    "delay": (1.0, Setting((1,), (), True), [1.4, -2.0, 1.2 + 0.5j], 4),
    "matching": (1.0, Setting((), ((0.3 * LAG[0], *LAG[1:]),), False), [1.7, 1.1 - 0.6j], 3),
    "continuous": (0.0, Setting((), (LAG,), True), [0.7, 0.4 + 1.5j], 0),
}


def problem(name: str, seed: int) -> tuple[obsynth.DescriptorSystem, list[complex], int, Setting]:
    dt, setting, points, samples = PROBLEMS[name]
    rng = np.random.default_rng([473, seed])
    plant = obsynth.DescriptorSystem(
        A=rng.normal(size=(4, 4)), C=rng.normal(size=(2, 4)), Bf=rng.normal(size=(4, 1)),
        Bw=np.hstack([rng.normal(size=(4, 3)), np.zeros((4, 2))]), Dw=np.hstack([np.zeros((2, 3)), np.eye(2)]), dt=dt,
    )  # fmt: skip
    return seen_plant(plant, ()), [complex(point) for point in points], samples, setting


def of_all_signals(plant: obsynth.DescriptorSystem, points: list[complex], samples: int, setting: Setting) -> float:
    with flint.ctx.workprec(PRECISION_BITS[0]):
        return invisible_faults._Trajectories(plant, points, samples, setting).bound(None)


@pytest.mark.one_in(6)
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_worst_directions_prove_what_all_signals_prove(name: str, seed: int) -> None:
    plant, points, samples, setting = problem(name, seed)
    few = invisible_faults._of_worst_directions(plant, points, samples, setting, np.inf, 0.0)
    assert few == pytest.approx(of_all_signals(plant, points, samples, setting), rel=1e-9)


@pytest.mark.parametrize("name", PROBLEMS)
def test_directions_that_are_wrong_prove_less(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever double precision says, the signals are enclosed: no direction proves more than the worst one."""
    plant, points, samples, setting = problem(name, 0)
    right, most = invisible_faults._directions, of_all_signals(plant, points, samples, setting)
    rng = np.random.default_rng(5)

    def wrong(*arguments: object) -> object:
        found = right(*arguments)
        moved = {point: free + rng.normal(size=len(free)) for point, free in found.of_points.items()}
        return found._replace(of_points=moved, of_samples=0.0 * found.of_samples + 1.0, ratio=0.0)

    monkeypatch.setattr(invisible_faults, "_directions", wrong)
    bound = invisible_faults._of_worst_directions(plant, points, samples, setting, np.inf, 0.0)
    assert bound is None or bound <= most * (1.0 + 1e-12)
    # What falls short is proved with all signals.
    assert proved_least(plant, points, samples, setting, level=0.999 * most) >= 0.999 * most


@pytest.mark.parametrize("name", PROBLEMS)
def test_points_inside_prove_nothing(name: str) -> None:
    """What grows into the past has no energy: with such a point the sums that a proof takes for energies are none."""
    plant, points, samples, setting = problem(name, 0)
    assert proved_least(plant, points, samples, setting, level=1.0, enough=0.0) is not None
    edge, inside = (1.0, 0.8 + 0.3j) if plant.dt > 0.0 else (1j, -0.5 + 0.2j)
    for wrong in (edge, inside, complex(np.nan), 0.0):
        for listed in ([wrong], [*points, wrong], [wrong, *points]):
            assert proved_least(plant, [complex(p) for p in listed], samples, setting, level=1.0, enough=0.0) is None
        assert proved_limit(plant, complex(wrong), setting) is None
