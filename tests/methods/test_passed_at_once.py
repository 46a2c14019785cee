"""What drives a plant at once, in any coordinates and units: the part of filters that white noise must not pass."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.methods.optimal_filter.fault_maps import FaultMap
from obsynth.methods.optimal_filter.passed_at_once import _answer, _shown_at_once, with_digits_of, without_white_noise
from obsynth.methods.optimal_filter.realised_filter import RealisedFilter

NX, STILL = 4, 2


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("decades", [0.0, 5.0])
def test_what_drives_algebraic_states_moves_them_at_once(seed: int, decades: float) -> None:
    """With z = T x the plant is ``z1' = a z1 + ..., 0 = z2 + g2``, so that g moves the states by ``-T^-1 (0, g2)``."""
    rng = np.random.default_rng([seed, int(decades)])
    mixed, turned = (np.linalg.qr(rng.normal(size=(NX, NX)))[0] for _ in range(2))
    equations, states = (10.0 ** rng.uniform(-decades, decades, NX) for _ in range(2))
    E, A = np.diag([1.0] * STILL + [0.0] * STILL), np.eye(NX)
    A[:STILL, :STILL] = rng.normal(size=(STILL, STILL))
    plant = obsynth.DescriptorSystem(
        E=equations[:, None] * (mixed @ E @ turned) * states, A=equations[:, None] * (mixed @ A @ turned) * states,
        Bf=np.ones((NX, 1)), C=np.ones((1, NX)), dt=0.0,
    )  # fmt: skip
    at_once = (turned.T / states[:, None]) @ np.diag([0.0] * STILL + [1.0] * STILL) @ (mixed.T / equations)
    size = np.max(np.abs(states[:, None] * at_once * equations))
    np.testing.assert_allclose(states[:, None] * _answer(plant) * equations, states[:, None] * at_once * equations,
                               atol=1e-9 * size)  # fmt: skip


def test_filters_of_index_zero_pass_no_white_noise_either() -> None:
    """E is invertible and not the identity; what D leaves of the noise by rounding is taken off."""
    plant = obsynth.DescriptorSystem(
        E=[[2.0, 1.0], [0.0, 1.0]], A=-np.eye(2), Bf=[[1.0], [0.0]], Bw=[[0.0, 0.0], [1.0, 0.0]], C=np.eye(2),
        Dw=[[0.0, 1.0], [0.0, 0.0]], dt=0.0,
    )  # fmt: skip
    lag = (-np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1)))
    fault_map = FaultMap(None, lag, exact=False)
    d = np.array([[1e-12, 3.0]])
    stated = (np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), d)
    ((*_, corrected),) = without_white_noise(plant, fault_map, [stated])
    shown = np.hstack(_shown_at_once(plant))
    assert np.abs(corrected @ shown).max() == 0.0
    assert corrected[0, 1] == 3.0


def test_of_index_two_d_and_t0_pass_no_white_noise_but_by_rounding() -> None:
    """Rows whose parts by D and by T0 cancel keep their digits; those of rounding alone are zero."""
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 1.0, 0.0], k=1)[:3, :3], A=np.diag([-1.0, 1.0, 1.0]), Bf=np.zeros((3, 1)), C=np.eye(2, 3),
        Bw=[[0.0, 0.0], [0.0, 0.0], [2.0, 0.0]], Dw=[[3.0, 0.0], [0.0, 5.0]], dt=0.0,
    )  # fmt: skip
    # T0 E = 0 leaves of T0 the last equation: 0.7 3 - 1.05 2 = 0.
    t0 = np.array([[0.0, 0.0, 1.05], [0.0, 0.0, 1e-13]])
    stated = RealisedFilter(
        *(np.zeros(shape) for shape in ((0, 0), (0, 2), (2, 0))),
        D=np.array([[0.7 * (1.0 + 1e-11), 1e-12], [0.0, 1e-12]]),
        T=np.zeros((0, 3)),
        T0=t0,
        lag=0,
    )
    models = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((2, 0)), np.zeros((2, 1))
    follower = with_digits_of(plant, FaultMap(None, models, exact=False), stated)
    assert np.abs(follower.D @ plant.Dw - follower.T0 @ plant.Bw).max() < 1e-15
    assert follower.D[0, 0] == pytest.approx(0.7, rel=1e-10)
    assert not follower.D[1].any()
    assert not follower.T0[1].any()
    assert follower.D[0, 1] == 0.0


def test_of_index_two_rounding_in_a_coordinate_of_t0_passes_no_white_noise() -> None:
    """Where T0 is rounding, so are its coordinates that are small beside the others: what is left of them passed."""
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0, 1.0, 0.0], k=1)[:4, :4], A=np.eye(4), Bf=np.zeros((4, 1)), C=np.eye(1, 4),
        Bw=[[0.0], [2.0], [0.0], [3.0]], Dw=[[0.0]], dt=0.0,
    )  # fmt: skip
    assert not plant.E[[1, 3]].any()
    stated = RealisedFilter(
        *(np.zeros(shape) for shape in ((0, 0), (0, 1), (1, 0))),
        D=np.zeros((1, 1)),
        T=np.zeros((0, 4)),
        T0=np.array([[0.0, 1e-12, 0.0, 1e-28]]),
        lag=0,
    )
    models = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1))
    follower = with_digits_of(plant, FaultMap(None, models, exact=False), stated)
    assert not follower.T0.any()
