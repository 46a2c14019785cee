"""An equation 0 = 0 in a descriptor plant changes no estimate, and takes no filter away."""

from __future__ import annotations

import numpy as np
import pytest

import obsynth
from obsynth.numerics.square_root_estimation import rank_revealing_step

#: The second equation says nothing; the outputs and the first one tell both states.
PLANT = obsynth.DescriptorSystem(
    E=[[0.0, 1.0], [0.0, 0.0]], A=[[0.5, 0.25], [0.0, 0.0]], C=[[-1.0, 1.0]], Bf=np.zeros((2, 0)), Dw=[[0.1]], dt=1.0
)  # fmt: skip


def test_a_step_with_rows_of_zeros_is_the_one_without() -> None:
    rng = np.random.default_rng(20261129)
    for _ in range(20):
        H, S, Y = rng.standard_normal((7, 3)), rng.standard_normal((7, 5)), rng.standard_normal((7, 1))
        S[:2] = 0.0
        rows = np.sort(rng.permutation(10)[:7])
        larger = [np.zeros((10, part.shape[1])) for part in (H, S, Y)]
        for whole, part in zip(larger, (H, S, Y), strict=True):
            whole[rows] = part
        plain = rank_revealing_step(H, S, Y, np.zeros((7, 0)))
        padded = rank_revealing_step(*larger, np.zeros((10, 0)))
        np.testing.assert_allclose(padded.estimate, plain.estimate, rtol=1e-9)
        np.testing.assert_allclose(padded.factor @ padded.factor.T, plain.factor @ plain.factor.T, rtol=1e-9)


def test_a_row_of_zeros_whose_data_are_not_zero_contradicts() -> None:
    H, S, Y = np.array([[1.0], [0.0]]), np.array([[1.0], [0.0]]), np.array([[1.0], [0.5]])
    with pytest.raises(obsynth.PreconditionError, match="contradict"):
        rank_revealing_step(H, S, Y, np.zeros((2, 0)))


def test_a_filter_beside_such_an_equation_is_the_least_squares_solution_of_the_record() -> None:
    design = obsynth.descriptor_kalman(PLANT)
    assert design.report.passed
    y = np.random.default_rng(3).standard_normal((5, 1))
    estimates = design.observer.run(y).states[-1]
    # Unknowns: both states of each sample; outputs count from the second sample on, the start by its covariance.
    rows, data, constraints = [np.eye(2, 10)], [np.zeros(2)], []
    for k in range(1, 5):
        row = np.zeros((1, 10))
        row[0, 2 * k : 2 * k + 2] = [-10.0, 10.0]
        rows.append(row)
        data.append(10.0 * y[k])
        equation = np.zeros((1, 10))
        equation[0, 2 * k + 1], equation[0, 2 * k - 2 : 2 * k] = 1.0, [-0.5, -0.25]
        constraints.append(equation)
    free = np.linalg.svd(np.vstack(constraints))[2][4:].T
    solution = free @ np.linalg.lstsq(np.vstack(rows) @ free, np.concatenate(data), rcond=None)[0]
    np.testing.assert_allclose(estimates, solution[-2:], rtol=1e-9)
