"""The interior-point method with a dense Schur complement, on programmes whose answers are known."""

from __future__ import annotations

import cvxpy
import numpy as np
import pytest
from scipy.optimize import linprog

from obsynth.errors import SolverError
from obsynth.methods.conic import interior_point, lmi
from obsynth.methods.conic.interior_point import NormalEquations, SemidefiniteBlock, solve_cone_programme


def symmetric(rng: np.random.Generator, order: int) -> np.ndarray:
    a = rng.standard_normal((order, order))
    return a + a.T


class TestBlock:
    def test_vectors_keep_inner_products(self) -> None:
        rng, block = np.random.default_rng(0), SemidefiniteBlock(5, 0)
        a, b = symmetric(rng, 5), symmetric(rng, 5)
        assert block.vector(a) @ block.vector(b) == pytest.approx(np.trace(a @ b))
        np.testing.assert_array_equal(block.matrix(block.vector(a)), block.matrix(block.vector(a)).T)
        np.testing.assert_allclose(block.matrix(block.vector(a)), a)

    @pytest.mark.parametrize("part", [1, 1 << 22])
    def test_the_scaling_makes_both_matrices_the_same_diagonal_one(
        self, monkeypatch: pytest.MonkeyPatch, part: int
    ) -> None:
        """Through two moves, the second given in the scaling of the first; columns in parts or at once."""
        monkeypatch.setattr("obsynth.methods.conic.interior_point.PART", part)
        rng, block = np.random.default_rng(1), SemidefiniteBlock(4, 0)
        s, z = (m @ m.T + 0.1 * np.eye(4) for m in rng.standard_normal((2, 4, 4)))
        block.move(block.vector(s), block.vector(z))
        np.testing.assert_allclose(np.array(block.points()), [block.vector(s), block.vector(z)], rtol=1e-12)
        np.testing.assert_allclose(block.scaled(block.vector(s)[None])[0], block.centre(), rtol=1e-10, atol=1e-12)
        ds = symmetric(rng, 4)
        scaled = block.scaled(np.array([block.vector(ds), block.vector(s)]))[0]
        step = 0.5 * block.longest_step(scaled)
        block.move(block.centre() + step * scaled, block.centre())
        np.testing.assert_allclose(block.points()[0], block.vector(s + step * ds), rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(block.points()[1], block.vector(z), rtol=1e-10, atol=1e-12)
        assert np.linalg.eigvalsh(s + 2.0 * step * ds)[0] == pytest.approx(0.0, abs=1e-10)

    def test_there_is_no_end_inside_the_cone(self) -> None:
        block = SemidefiniteBlock(3, 0)
        assert block.longest_step(block.vector(np.eye(3))) == np.inf

    def test_a_correction_solves_its_equation(self) -> None:
        rng, block = np.random.default_rng(2), SemidefiniteBlock(3, 0)
        block.move(block.vector(np.diag([1.0, 4.0, 9.0])), block.vector(np.eye(3)))
        ds, dz = symmetric(rng, 3), symmetric(rng, 3)
        q, centre = (
            block.matrix(v) for v in (block.corrected(block.vector(ds), block.vector(dz), 0.3), block.centre())
        )
        np.testing.assert_allclose(np.diag(centre), [3.0, 2.0, 1.0])
        np.testing.assert_allclose(0.5 * (centre @ q + q @ centre), 0.3 * np.eye(3) - 0.5 * (ds @ dz + dz @ ds))


class TestNormalEquations:
    def test_refinement_takes_the_shift_back(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("obsynth.methods.conic.interior_point.SHIFTS", (1e-5,))
        rng = np.random.default_rng(3)
        columns, wanted = rng.standard_normal((6, 40)) * np.logspace(0.0, 3.0, 6)[:, None], rng.standard_normal(6)
        found = NormalEquations(columns).solution(columns @ (columns.T @ wanted))
        np.testing.assert_allclose(found, wanted, rtol=1e-9)

    def test_what_rounding_made_singular_still_gets_through(self) -> None:
        rng = np.random.default_rng(4)
        columns = rng.standard_normal((3, 8))
        columns = np.vstack([columns, columns[0] + 1e-9 * columns[1]])
        right = columns @ rng.standard_normal(8)
        found = NormalEquations(columns).solution(right)
        np.testing.assert_allclose(columns @ (columns.T @ found), right, atol=1e-6)

    def test_what_is_not_finite_is_an_error(self) -> None:
        with pytest.raises(np.linalg.LinAlgError, match="not finite"):
            NormalEquations(np.array([[1.0, np.nan], [0.0, 1.0]]))


class TestSolutions:
    @pytest.mark.parametrize("seed", range(5))
    def test_linear_programmes(self, seed: int) -> None:
        """Blocks of order one, against the simplex method."""
        rng = np.random.default_rng([5, seed])
        a, x = rng.standard_normal((12, 4)), rng.standard_normal(4)
        b, c = a @ x + rng.uniform(size=12), -a.T @ rng.uniform(size=12)
        found = solve_cone_programme(c, a, b, [1] * 12)
        wanted = linprog(c, A_ub=a, b_ub=b, bounds=(None, None), method="highs-ds")
        assert found.status == "optimal"
        assert c @ found.x == pytest.approx(wanted.fun, rel=1e-6, abs=1e-6)
        np.testing.assert_allclose(a.T @ found.z, -c, atol=1e-5)
        assert np.min(found.z) > 0.0
        assert np.min(b - a @ found.x) > -1e-6

    @pytest.mark.parametrize("order", [1, 2, 7])
    def test_least_matrix_above_two(self, order: int) -> None:
        """``min tr X`` under ``X >= 0, X >= S``: the positive part of S."""
        s = symmetric(np.random.default_rng([6, order]), order)
        values, vectors = np.linalg.eigh(s)
        x = lmi.symmetric_variable(order)
        record = lmi.minimise(lmi.trace(x), [lmi.at_least(x), lmi.at_least(x - s)], what="X", solver="SCHUR")
        assert (record["solver"], record["status"]) == ("SCHUR", "optimal")
        assert 0 < record["iterations"] < 30
        np.testing.assert_allclose(lmi.value_of(x), (vectors * np.maximum(values, 0.0)) @ vectors.T, atol=1e-4)

    def test_lovasz_number_of_the_pentagon(self) -> None:
        """The square root of 5: ``min t``, ``t I + sum of free entries on the edges >= ones``."""
        t, entries = lmi.scalar_variable(), lmi.matrix_variable(1, 5)
        matrix = t * np.eye(5)
        for i in range(5):
            edge = np.zeros((5, 5))
            edge[i, (i + 1) % 5] = edge[(i + 1) % 5, i] = 1.0
            matrix = matrix + entries[0, i] * edge
        lmi.minimise(t, [lmi.at_least(matrix - np.ones((5, 5)))], what="theta", solver="SCHUR")
        assert float(lmi.value_of(t)) == pytest.approx(np.sqrt(5.0), rel=1e-6)

    def test_largest_eigenvalue_and_its_multiplier(self) -> None:
        """The multiplier of ``t I >= S`` is the projection on the eigenvector."""
        s, block = symmetric(np.random.default_rng(7), 6), SemidefiniteBlock(6, 0)
        values, vectors = np.linalg.eigh(s)
        found = solve_cone_programme(np.ones(1), -block.vector(np.eye(6))[:, None], block.vector(-s), [6])
        assert found.x[0] == pytest.approx(values[-1], rel=1e-6)
        np.testing.assert_allclose(block.matrix(found.z), np.outer(vectors[:, -1], vectors[:, -1]), atol=1e-5)

    def test_what_has_no_solution_is_infeasible(self) -> None:
        x = lmi.symmetric_variable(3)
        with pytest.raises(SolverError, match="'infeasible'"):
            lmi.minimise(lmi.trace(x), [lmi.at_least(x, 1.0), lmi.at_most(x, -1.0)], what="nothing", solver="SCHUR")

    def test_what_has_no_least_value_fails(self) -> None:
        x = lmi.symmetric_variable(2)
        with pytest.raises(SolverError, match="'failed'") as caught:
            lmi.minimise(lmi.trace(x), [lmi.at_most(x, 1.0)], what="nothing", solver="SCHUR")
        assert caught.value.record["iterations"] <= interior_point.MOST_ITERATIONS

    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_data_that_are_not_finite_are_an_error(self, value: float) -> None:
        with pytest.raises(np.linalg.LinAlgError):
            solve_cone_programme(np.ones(1), np.full((3, 1), value), np.ones(3), [2])


class TestLayer:
    def test_other_cones_are_refused(self) -> None:
        x = lmi.matrix_variable(2, 2)
        with pytest.raises(SolverError, match="only semidefinite blocks"):
            lmi.minimise(lmi.frobenius_norm(x - np.eye(2)), [lmi.at_least(x)], what="X", solver="SCHUR")

    def test_auto_takes_the_other_solver_where_ours_cannot(self) -> None:
        x = lmi.matrix_variable(2, 2)
        record = lmi.minimise(lmi.frobenius_norm(x - np.eye(2)), [lmi.at_least(x, 2.0)], what="X", solver="auto")
        np.testing.assert_allclose(lmi.value_of(x), 2.0 * np.eye(2), atol=1e-5)
        assert record["solver"] == "CLARABEL"
        assert record["tried_before"] == {"solver": "SCHUR", "status": "crashed"}

    def test_auto_does_not_ask_twice_for_what_has_no_solution(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delattr(cvxpy.Problem, "solve")
        x = lmi.symmetric_variable(2)
        with pytest.raises(SolverError, match="'infeasible'") as caught:
            lmi.minimise(lmi.trace(x), [lmi.at_least(x, 1.0), lmi.at_most(x, -1.0)], what="nothing", solver="auto")
        assert caught.value.record["solver"] == "SCHUR"

    def test_many_unknowns(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The other way of making cones gives the same answer."""
        s, answers = symmetric(np.random.default_rng(8), 4), []
        for most in (0, 500):
            monkeypatch.setattr(lmi, "MANY_UNKNOWNS", most)
            x = lmi.symmetric_variable(4)
            lmi.minimise(lmi.trace(x), [lmi.at_least(x), lmi.at_least(x - s)], what="X", solver="SCHUR")
            answers.append(lmi.value_of(x))
        np.testing.assert_allclose(*answers, atol=1e-8)
