"""Lyapunov's and Riccati's equations: the right solutions, and the same bits whichever way matrices lie in memory."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from obsynth.numerics import matrix_equations
from obsynth.numerics.matrix_equations import (
    continuous_lyapunov,
    continuous_riccati,
    continuous_solution,
    discrete_lyapunov,
    discrete_riccati,
)

SOURCE = Path(matrix_equations.__file__).parents[1]
#: Sixteen digits, less what equations of random matrices of norm one cost.
DIGITS = 1e-12


#: States from which the kernels of some processors add up products in blocks.
MANY = 33


def problem(seed: int, size: int = 6) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(size, size)), rng.normal(size=(size, 2))
    a *= 0.8 / np.max(np.abs(np.linalg.eigvals(a)))
    return {"a": a, "b": b, "q": b @ b.T + np.eye(size), "s": 0.1 * rng.normal(size=(size, 2))}


def solutions(a: np.ndarray, b: np.ndarray, q: np.ndarray, s: np.ndarray) -> dict[str, np.ndarray]:
    one = np.eye(2)
    return {
        "continuous Lyapunov": continuous_lyapunov(a - np.eye(len(a)), -q),
        "discrete Lyapunov": discrete_lyapunov(a, q),
        "continuous Riccati": continuous_riccati(a, b, q, one, s=s),
        "discrete Riccati": discrete_riccati(a, b, q, one, s=s),
    }


@pytest.mark.parametrize("seed", range(4))
def test_the_order_in_memory_changes_no_bit(seed: int) -> None:
    given = problem(seed, MANY)
    by_rows, by_columns = (
        solutions(**{name: np.array(matrix, order=order) for name, matrix in given.items()}) for order in ("C", "F")
    )
    for name, found in by_rows.items():
        np.testing.assert_array_equal(found, by_columns[name], err_msg=name)


@pytest.mark.parametrize("seed", range(8))
def test_solutions_solve_their_equations(seed: int) -> None:
    given, one = problem(seed), np.eye(2)
    a, b, q, s = (given[name] for name in "abqs")
    found = solutions(**given)
    slow, x = a - np.eye(6), found["continuous Lyapunov"]
    left = [slow @ x + x @ slow.T + q]
    x = found["discrete Lyapunov"]
    left.append(a @ x @ a.T + q - x)
    x = found["continuous Riccati"]
    left.append(a.T @ x + x @ a - (x @ b + s) @ (x @ b + s).T + q)
    x = found["discrete Riccati"]
    driven = a.T @ x @ b + s
    left.append(a.T @ x @ a - x - driven @ np.linalg.solve(one + b.T @ x @ b, driven.T) + q)
    for rest, (name, solution) in zip(left, found.items(), strict=True):
        assert np.linalg.norm(rest) <= DIGITS * (1.0 + np.linalg.norm(solution)) ** 2, name


def test_nothing_else_calls_the_library() -> None:
    calls = re.compile(r"solve_(continuous|discrete)_(lyapunov|are)")
    found = {file.name for file in SOURCE.rglob("*.py") if calls.search(file.read_text(encoding="utf-8"))}
    assert found == {"matrix_equations.py"}


@pytest.mark.parametrize("decades", [2.0, 9.0, 12.0])
def test_units_of_the_outputs_change_no_covariance(decades: float) -> None:
    """A weight over decades is no singular one: it only has rows in several units."""
    rng = np.random.default_rng(52)
    a, c, process = rng.normal(size=(4, 4)), rng.normal(size=(3, 4)), np.eye(4)
    cross = 0.1 * rng.normal(size=(4, 3))
    expected = continuous_solution(a, c, process, np.eye(3), cross)
    units = 10.0 ** np.array([-decades, 0.0, decades])
    found = continuous_solution(a, units[:, None] * c, process, np.diag(units**2), cross * units)
    assert expected is not None
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_an_equation_that_is_nearly_singular_warns_no_user() -> None:
    # SciPy perturbs it, and says so: designs and comparisons of random plants printed that warning.
    a = np.diag([1.0, -1.0 - 1e-16])
    assert continuous_lyapunov(a, -np.ones((2, 2))).shape == (2, 2)
    assert discrete_lyapunov(np.diag([1.0 - 1e-16, 0.5]), np.eye(2), method="bilinear").shape == (2, 2)
