"""Optimal filters against gains that are known in closed form, and simulated fault maps."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth


def plant(**matrices):
    return obsynth.DescriptorSystem(**({"dt": 1.0} | matrices))


WANG = {
    "E": np.diag([1.0, 1, 1, 0]),
    "A": [[0.9, 0.005, -0.095, 0], [0.005, 0.995, 0.0997, 0], [0.095, -0.0997, 0.99, 0], [1, 0, 1, 1]],
    "C": [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    "Bf": [[0.1, 0], [1, 1], [-0.1, 1], [-1, 0]],
    "Bd": [[1], [1], [1], [0]],
}
# y1 = f + z/(z - 1/2) w, y2 = (1 - 2/z) w: a zero outside the circle halves the least gain with each sample.
ZERO_OUTSIDE = {
    "A": [[0.5, 0], [0, 0]],
    "Bf": [[0], [0]],
    "Bw": [[0.5], [1]],
    "C": [[1, 0], [0, -2]],
    "Df": [[1], [0]],
    "Dw": [[1], [1]],
}
# y1 = f + x, y2 = x + v, x a random walk.
WALK = {"A": [[1.0]], "Bf": [[0]], "Bw": [[1, 0]], "C": [[1], [1]], "Df": [[1], [0]], "Dw": [[0, 0], [0, 1]]}
GOLDEN = (1.0 + np.sqrt(5.0)) / 2.0


@pytest.mark.parametrize(
    ("matrices", "delay", "truth"),
    [
        (WANG, 1, 1.0),
        *((ZERO_OUTSIDE, delay, 4.0 / 3.0 / 2.0**delay) for delay in (0, 1, 2, 6)),
        ({"A": [[2.0]], "Bf": [[1]], "Bw": [[1, 0]], "C": [[1]], "Dw": [[0, 1]]}, 1, np.sqrt(10.0)),
        (WALK, 0, 1.0),
    ],
)
def test_the_least_gain_of_a_delay(matrices, delay, truth):
    found = obsynth.optimal_filter(plant(**matrices), delay=delay)
    assert found.gain == pytest.approx(truth, rel=2e-8)
    assert found.least == pytest.approx(truth, rel=2e-8)
    assert found.least <= found.gain


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_the_least_h2_norm(delay):
    truth = np.sqrt(GOLDEN - sum((2.0 - GOLDEN) ** (2 * i) for i in range(delay + 1)))
    assert obsynth.optimal_filter(plant(**WALK), delay=delay, norm="h2").gain == pytest.approx(truth, rel=1e-10)


@pytest.mark.parametrize("share", [0.5, 1.0, 3.0])
def test_matching_in_continuous_time(share):
    """C04 of FDITOOLS: least distance of 1/(s + 1) from what the outputs allow."""
    c = {1.0: [[-1, -5]], 3.0: [[1, -7]], 0.5: [[-1.5, -4.5]]}[share]
    own = plant(A=[[0, 1], [-2, -3]], Bf=[[0], [1]], C=c, Df=[[1]], dt=0.0)
    found = obsynth.optimal_filter(own, reference={"bandwidth": 1.0}, exact=False)
    truth = (1.0 + np.sqrt(1.0 + 8.0 / (1.0 + share))) / 4.0
    assert found.gain == pytest.approx(truth, rel=2e-8)
    assert found.least == pytest.approx(truth, rel=2e-8)


def test_a_delay_is_chosen_and_its_alternatives_are_shown():
    found = obsynth.optimal_filter(plant(**WANG))
    assert found.delay == 2
    assert [row.delay for row in found.trade_off] == [1, 2]
    assert found.gain < 1e-8 * found.trade_off[0].gain
    assert "With delay 1: 1" in str(found)


def test_faults_come_through_with_the_delay_and_disturbances_within_the_gain():
    """The filter runs on records of the paper's plant, whose recursion is written out here."""
    rng = np.random.default_rng(5)
    faults, noise = rng.normal(size=(200, 2)), rng.normal(size=(200, 1))

    def outputs(f, d):
        a, bf, bd = (np.array(WANG[name], dtype=float) for name in ("A", "Bf", "Bd"))
        x, y = np.zeros(4), np.zeros((len(f), 3))
        for k in range(len(f)):
            x[3] = -(x[0] + x[2] + bf[3] @ f[k])
            y[k] = x[1:4]
            x[:3] = a[:3] @ x + bf[:3] @ f[k] + bd[:3] @ d[k]
        return y

    known = np.zeros((200, 0))
    one = obsynth.optimal_filter(plant(**WANG), delay=1)
    clean = one.observer.run(outputs(faults, 0.0 * noise), known).faults
    np.testing.assert_allclose(clean[20:], faults[19:-1], atol=1e-9)
    disturbed = one.observer.run(outputs(0.0 * faults, noise), known).faults
    assert np.linalg.norm(disturbed) <= one.gain * np.linalg.norm(noise)
    two = obsynth.optimal_filter(plant(**WANG), delay=2)
    both = two.observer.run(outputs(faults, noise), known).faults
    np.testing.assert_allclose(both[20:], faults[18:-2], atol=1e-8)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"delay": -1}, "whole number of samples"),
        ({"delay": 1.5}, "whole number of samples"),
        ({"norm": "l1"}, "hinf"),
        ({"decoupled": ["nobody"]}, "names of disturbances"),
        ({"reference": ([[2.0]], [[1.0]], [[1.0]], [[0.0]])}, "Shapes of reference"),
        ({"reference": ([[2.0]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]])}, "not stable"),
        ({"reference": {"width": 1.0}}, "bandwidth"),
        ({"exact": False}, "reference"),
    ],
)
def test_malformed_options_are_refused_by_name(options, words):
    with pytest.raises(obsynth.SpecError, match=words):
        obsynth.optimal_filter(plant(**WANG), **options)


def test_what_does_not_exist_is_refused():
    with pytest.raises(obsynth.PreconditionError, match="exact fault map with delay 0"):
        obsynth.optimal_filter(plant(**WANG), delay=0)
    unseen = plant(A=[[0.0]], Bf=[[1]], Bw=[[0]], C=[[-2]], Df=[[1]], Dw=[[1]])
    with pytest.raises(obsynth.PreconditionError, match="stable"):
        obsynth.optimal_filter(unseen, delay=3)
