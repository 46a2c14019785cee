"""Delays that the first responses exclude, against windows of every length."""

import numpy as np
import pytest

from obsynth.errors import PreconditionError
from obsynth.numerics import decoupling_windows
from obsynth.numerics.decoupling_windows import Channels, estimation_problem


def late_plant(seed):
    """Return a plant of six states, three outputs, a fault that shows after some samples, and one at once; how late."""
    rng = np.random.default_rng([52, seed])
    late = 1 + seed % 4
    chain = np.eye(late + 2, k=-1) + np.diag(rng.uniform(-0.5, 0.5, late + 2))
    a = np.zeros((late + 4, late + 4))
    a[: late + 2, : late + 2], a[late + 2 :, late + 2 :] = chain, np.diag([0.3, 0.6])
    bf, bd = np.zeros((late + 4, 2)), np.zeros((late + 4, 1))
    bf[2, 0], bf[late + 2, 1], bd[late + 3] = 1.0, 1.0, 1.0
    c = np.zeros((3, late + 4))
    c[0, late + 1], c[1, late + 2], c[2, late + 3] = 1.0, 1.0, 1.0
    turn = np.linalg.qr(rng.normal(size=a.shape))[0]
    c = rng.normal(size=(3, 3)) @ c
    none, empty = np.zeros((3, 0)), np.zeros((len(a), 0))
    return Channels(
        np.eye(len(a)), turn @ a @ turn.T, c @ turn.T, empty, none, turn @ bf, np.zeros((3, 2)), turn @ bd,
        np.zeros((3, 1)), np.zeros((len(a), 3)), np.eye(3), 0.1,
    ), late  # fmt: skip


@pytest.mark.parametrize("seed", range(8))
def test_first_responses_exclude_no_delay_that_a_window_has(seed) -> None:
    plant, late = late_plant(seed)
    for delay in range(late + 2):
        if delay >= late:
            brief, thorough = (estimation_problem(plant, delay=delay, brief=brief) for brief in (True, False))
            assert np.array_equal(brief.A, thorough.A)
            assert np.array_equal(brief.F, thorough.F)
            continue
        for brief in (True, False):
            with pytest.raises(PreconditionError) as refused:
                estimation_problem(plant, delay=delay, brief=brief)
            assert refused.value.condition == "delay"
            assert ("shortest delays" in str(refused.value)) is not brief


def test_no_window_is_tried_for_a_delay_that_the_first_responses_exclude(monkeypatch) -> None:
    plant, _ = late_plant(3)
    monkeypatch.setattr(decoupling_windows, "_tried_window", lambda *_: pytest.fail("a window was tried"))
    with pytest.raises(PreconditionError, match="does not show in the outputs within its delay"):
        estimation_problem(plant, delay=0, brief=True)
