"""Courses and impulse responses of linear recursions: those of one step after the other, also where they overflow."""

from __future__ import annotations

import numpy as np
import pytest

from obsynth.numerics.linear_recursions import driven, impulse_responses


@pytest.mark.parametrize("steps", [1, 2, 255, 256, 257, 700])
@pytest.mark.parametrize("runs", [(), (3,)])
def test_blocks_are_steps_one_after_the_other(steps: int, runs: tuple[int, ...]) -> None:
    rng = np.random.default_rng(steps)
    a = rng.normal(size=(4, 4))
    a *= 0.99 / np.max(np.abs(np.linalg.eigvals(a)))
    start, drive = rng.normal(size=(*runs, 4)), rng.normal(size=(steps, *runs, 4))
    expected = [start]
    for row in drive[:-1]:
        expected.append(np.einsum("ij,...j->...i", a, expected[-1]) + row)
    np.testing.assert_allclose(driven(a, start, drive), expected, rtol=1e-11, atol=1e-11)


def test_states_that_grow_overflow_at_the_same_step() -> None:
    course = driven(np.array([[10.0]]), np.array([1.0]), np.zeros((700, 1)))
    assert np.flatnonzero(~np.isfinite(course))[0] == 309
    responses = impulse_responses(np.array([[10.0]]), np.eye(1), np.eye(1), 700)
    assert np.flatnonzero(~np.isfinite(responses))[0] == 309
    slow = driven(np.array([[1.5]]), np.array([1.0]), np.zeros((2000, 1)))
    assert np.flatnonzero(~np.isfinite(slow))[0] == 1751


@pytest.mark.parametrize("steps", [0, 1, 2, 255, 256, 300])
def test_impulse_responses_are_powers(steps: int) -> None:
    rng = np.random.default_rng(steps)
    a, b, c = 0.4 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=(1, 3))
    responses = impulse_responses(a, b, c, steps)
    assert responses.shape == (steps, 1, 2)
    for k, response in enumerate(responses):
        np.testing.assert_allclose(response, c @ np.linalg.matrix_power(a, k) @ b, rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize(("inputs", "outputs"), [(0, 2), (2, 0), (1, 1)])
def test_impulse_responses_of_no_signals_and_beside_a_mode_that_overflows(inputs: int, outputs: int) -> None:
    """A mode that no input reaches makes rows overflow, which it does not make of the responses."""
    a, b, c = np.diag([0.5, 1e3]), np.eye(2, inputs), np.ones((outputs, 2))
    responses = impulse_responses(a, b[:, :1] if inputs == 1 else 0.0 * b, c, 600)
    assert responses.shape == (600, outputs, inputs)
    assert np.all(np.isfinite(responses))
    if inputs == outputs == 1:
        np.testing.assert_allclose(responses[:, 0, 0], 0.5 ** np.arange(600), rtol=1e-12, atol=0.0)
