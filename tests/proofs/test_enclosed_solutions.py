"""Balls around solutions of large equations: they hold the exact solution, as closely as the digits that are asked."""

from __future__ import annotations

import flint
import numpy as np
import pytest

from obsynth.proofs.balls import Ball
from obsynth.proofs.complex_balls import complex_matrix, real_matrix
from obsynth.proofs.enclosed_solutions import ROWS_OF_REFINEMENT, enclosed_solution

#: In bits: of the balls, and of the solution with which they are compared.
BITS, MORE_BITS = 256, 2000


@pytest.mark.parametrize("is_complex", [False, True], ids=["real", "complex"])
@pytest.mark.parametrize("condition", [1e2, 1e9, 1e18])
def test_balls_hold_the_solution_and_are_small(condition: float, is_complex: bool) -> None:
    rng = np.random.default_rng([47, int(np.log10(condition)), is_complex])
    count = 2 * ROWS_OF_REFINEMENT
    left, right = (np.linalg.qr(rng.normal(size=(count, count)))[0] for _ in range(2))
    matrix = left * np.geomspace(1.0, 1.0 / condition, count) @ right
    turned = matrix + 1j * rng.normal(size=(count, count)) / condition if is_complex else matrix
    sides = rng.normal(size=(count, 2))
    nearby = [Ball.exact(turned.real), Ball.exact(turned.imag)] if is_complex else [Ball.exact(matrix)]

    def equations() -> tuple[object, object]:
        if is_complex:
            return complex_matrix(turned), complex_matrix(sides + 0j)
        return real_matrix(matrix), real_matrix(sides)

    with flint.ctx.workprec(MORE_BITS):
        exact, given = equations()
        expected = exact.solve(given)
    with flint.ctx.workprec(BITS):
        solution = enclosed_solution(*equations(), nearby)
        largest = max(abs(entry).abs_upper() for entry in solution.entries())
        for found, true in zip(solution.entries(), expected.entries(), strict=True):
            assert found.contains(true)
            assert found.rad() < 2.0 ** (70 - BITS) * condition * largest


def test_a_matrix_beside_the_equations_proves_nothing_of_them() -> None:
    """The balls are as wide as the one that is given beside is uncertain: here it is another matrix altogether."""
    rng = np.random.default_rng(48)
    count = 2 * ROWS_OF_REFINEMENT
    matrix = np.eye(count) + 0.01 * rng.normal(size=(count, count))
    wide = Ball(np.eye(count), np.full((count, count), 2.0))
    solution = enclosed_solution(real_matrix(matrix), real_matrix(np.ones((count, 1))), [wide])
    expected = np.linalg.solve(matrix, np.ones(count))
    assert all(abs(float(x.mid()) - y) < 1e-10 for x, y in zip(solution.entries(), expected, strict=True))


def test_singular_equations_raise() -> None:
    singular = np.ones((2 * ROWS_OF_REFINEMENT, 2 * ROWS_OF_REFINEMENT))
    with pytest.raises(ZeroDivisionError):
        enclosed_solution(real_matrix(singular), real_matrix(singular[:, :1]), [Ball.exact(singular)])
