"""Responses of an error to its channels against sums worked by hand for one state."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.errors import PreconditionError
from obsynth.observers.linear.observer import LinearObserver
from obsynth.plants.transformations.uncertain_plant import affine_plant
from obsynth.proofs.affine import AffineMatrix
from obsynth.verification.over_tolerances.error_structure import ErrorStructure, Tracking, error_structure
from obsynth.verification.over_tolerances.responses import largest_factor, loop_radius, responses_of, ring_length
from obsynth.verification.over_tolerances.vertex_gains import _summed_response

#: What contraction of the ring and rounding may add to a sum, relatively.
SHARE = 1e-3


def one_state(pole: float, *, into: float = 0.0, same: float = 0.0, own: int = 1) -> ErrorStructure:
    """One eps, one e = eps + same * channel, one output; the first ``own`` of two channels are a constant's."""
    state = AffineMatrix(np.zeros((3, 1)), np.zeros((1, 3, 1)), np.zeros((3, 1)))
    return ErrorStructure(
        np.array([[pole]]), np.array([[1.0]]), np.array([[2.0]]), state, state, state, np.zeros(1), np.ones((2, 1)), 2,
        np.array([[into, 2.0 * into], [same, same], [0.25, 0.5]]), (0,) * own, np.zeros(1), np.eye(1), np.eye(1),
    )  # fmt: skip


@pytest.mark.parametrize("pole", [0.5, -0.5, 0.9])
@pytest.mark.parametrize("own", [0, 1, 2])
def test_the_loop_is_the_sum_of_all_samples(pole: float, own: int) -> None:
    """Two channels of b and 2 b on one eps: each adds |b| sum |a|^j, and both add up: 3 b / (1 - |a|) + 2 same."""
    found = responses_of(one_state(pole, into=0.1, same=0.05, own=own))
    each = 0.1 / (1.0 - abs(pole))
    exact = np.array([[each + 0.05, 2.0 * each + 0.05]] * 2)
    assert np.all(found.loop >= exact)
    assert found.loop == pytest.approx(exact, rel=SHARE)
    assert loop_radius(found) == pytest.approx(3.0 * each + 0.1, rel=SHARE)
    assert found.direct == pytest.approx(np.array([[0.25, 0.5]]))


def test_a_gain_is_the_sum_of_absolute_values() -> None:
    """From 3 at the input to 2 at the output of 0.5^j or (-0.5)^j: 6 / (1 - 0.5) = 12, and 0.25 directly."""
    left, right = np.array([[2.0]]), np.array([[3.0]])
    for pole in (0.5, -0.5):
        found = responses_of(one_state(pole))
        assert found.gain(left, right)[0, 0] >= 12.0
        assert found.gain(left, right)[0, 0] == pytest.approx(12.0, rel=SHARE)
        assert found.gain(left, right, np.array([[-0.25]]))[0, 0] == pytest.approx(12.25, rel=SHARE)
        assert found.absolute_gain(left, right)[0, 0] >= 12.0
        assert found.absolute_gain(left, right)[0, 0] == pytest.approx(12.0, rel=SHARE)


def test_what_is_older_than_the_ring_counts() -> None:
    """A ring of 8 samples decays from 0.5 to 0.4 %: without its tail the sum would be below the true one."""
    found = responses_of(one_state(0.5, into=0.25, own=2))
    assert found.length == 8
    within = 0.25 * (2.0 - 2.0**-7)
    assert found.kernels.sum(axis=0)[0, 0] == pytest.approx(within)
    assert found.loop[0, 0] >= 0.5 > 1.001 * within


def test_channels_that_share_one_take_the_largest_row() -> None:
    """Rows 1 and 3 of e in one channel: the third is what reaches it."""
    structure = one_state(0.5, into=0.1)
    together = ErrorStructure(**{**vars(structure), "channel_rows": np.array([[1.0], [1.0], [3.0]]), "single": 1,
                                 "effects": structure.effects})  # fmt: skip
    found = responses_of(together)
    assert found.loop == pytest.approx(np.array([[0.2, 0.4], [0.6, 1.2]]), rel=SHARE)


def test_the_largest_factor_is_where_the_loop_reaches_one() -> None:
    """The loop of a factor t is 3 (0.02 t) / (1 - 0.5) = 0.12 t: one at 8.333."""
    radius = loop_radius(responses_of(one_state(0.5, into=0.02)))
    assert radius == pytest.approx(0.12, rel=SHARE)
    found = largest_factor(lambda t: one_state(0.5, into=0.02 * t), radius)
    assert found == pytest.approx(25.0 / 3.0, rel=3.0 * SHARE)
    assert found <= 25.0 / 3.0


def test_a_ring_is_as_short_as_its_contraction_allows() -> None:
    """0.5^8 and 0.9^64 are the first below 1 % at a power of two; an observer that keeps its error has none."""
    assert ring_length(np.array([[0.5]])) == 8
    assert ring_length(np.array([[0.9]])) == 64
    with pytest.raises(PreconditionError, match="decay too slowly"):
        ring_length(np.array([[1.0]]))


def watched(entry: str, nominal: float, low: float, high: float, *, gain: float) -> ErrorStructure:
    """``x+ = entry x + d + w``, ``y = x``, estimated by ``z+ = 0.2 z + gain y``, residual ``y - z``."""
    plant = obsynth.uncertain_system(
        {"A": [[entry]], "C": [[1.0]], "Bd": [[1.0]], "Bw": [[1.0]], "dt": 1.0},
        {"a": {"nominal": nominal, "range": [low, high]}},
    )
    observer = LinearObserver(
        [[0.2]], np.zeros((1, 0)), [[gain]], [[1.0], [-1.0]], np.zeros((2, 0)), [[0.0], [1.0]], 1.0, (),
        plant.output_names, plant.state_names, (), ("r1",), (0,), (),
    )  # fmt: skip
    tracking = Tracking(np.eye(1), np.zeros((2, 1)))
    return error_structure(observer, affine_plant(plant), tracking, np.array([0.25]), 3.0)


def test_a_constant_counts_by_its_farthest_value() -> None:
    """0.5 in 0.25 .. 1.25 is off by 0.75 at most, on one side: eps+ = 0.2 eps + (0.5 - a) x, a loop of 0.75 / 0.8."""
    found = watched("a", 0.5, 0.25, 1.25, gain=0.3)
    assert abs(found.effects[0, 0]) == pytest.approx(0.75)
    assert loop_radius(responses_of(found)) == pytest.approx(0.9375, rel=SHARE)
    assert found.bounds.tolist() == [0.25, 3.0]


def test_what_is_not_affine_counts_in_the_loop() -> None:
    """a squared, a within 0.5 of zero, is 0.25 at most: the loop is not below 0.25 / 0.8."""
    assert loop_radius(responses_of(watched("a * a", 0.0, -0.5, 0.5, gain=-0.2))) >= 0.3125


def test_an_observer_of_another_plant_has_no_bound() -> None:
    """A gain of 0.31 instead of 0.3 leaves 0.01 x at the nominal plant."""
    with pytest.raises(PreconditionError, match="identities do not hold on the nominal plant"):
        watched("a", 0.5, 0.25, 1.25, gain=0.31)


@pytest.mark.parametrize("varying", [False, True])
def test_a_late_fault_has_the_constants_of_its_own_sample(varying: bool) -> None:
    """``x+ = 0.5 x + b f``: y - 0.5 y(k - 1) is b f(k - 1), off by 0.2 of it by the earlier b in 0.8 .. 1.2."""
    plant = obsynth.uncertain_system(
        {"A": [[0.5]], "C": [[1.0]], "Bf": [["b"]], "dt": 1.0}, {"b": {"nominal": 1.0, "tolerance": "20 %"}}
    )
    observer = LinearObserver(
        [[0.0]], np.zeros((1, 0)), [[0.5]], [[0.0], [-1.0]], np.zeros((2, 0)), [[1.0], [1.0]], 1.0, (),
        plant.output_names, plant.state_names, plant.fault_names, (), (0,), (1,),
    )  # fmt: skip
    found = error_structure(
        observer, affine_plant(plant), Tracking(np.eye(1), np.zeros((2, 1))), np.zeros(0), 0.0, faults=True,
        varying=varying,
    )  # fmt: skip
    *now, earlier = np.abs(found.state.parts[:, 2, 1])
    assert earlier == pytest.approx(0.2)
    assert now == ([0.0] if varying else [])


@pytest.mark.parametrize("pole", [0.5, 0.99, -0.99])
def test_a_slow_response_is_summed_over_all_blocks(pole: float) -> None:
    found = _summed_response(np.array([[pole]]), np.array([[2.0, -1.0]]), np.array([[3.0]]))
    assert found[0] == pytest.approx(9.0 / (1.0 - abs(pole)), rel=1e-3)
