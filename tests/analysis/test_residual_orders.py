"""Least residual orders against a search over all polynomial equations of bounded degree, and the whole bank."""

from __future__ import annotations

import numpy as np
import pytest
from flint import fmpq_mat

import obsynth
from obsynth.analysis.diagnosis.exact_fault_columns import decoupled_fault
from obsynth.analysis.diagnosis.residual_orders import exact_residual_order


def least_order(plant: obsynth.DescriptorSystem, removed: tuple[int, ...], fault: int) -> int | None:
    """Search N(s) of degree 2 nx + 2 with N P = 0: the least degree of N [B, 0; D, -I] among those with N f != 0."""
    nx, ny, top = plant.nx, plant.ny, 2 * plant.nx + 2
    kept = list(removed)
    a = np.block([[plant.A, plant.Bd, plant.Bf[:, kept]], [plant.C, plant.Dd, plant.Df[:, kept]]])
    e = np.zeros_like(a)
    e[:nx, :nx] = plant.E
    known = np.block([[plant.B, np.zeros((nx, ny))], [plant.D, -np.eye(ny)]])
    column = np.vstack([plant.Bf, plant.Df])[:, [fault]]

    def coefficients(constant: np.ndarray, linear: np.ndarray) -> np.ndarray:
        """Return the matrix whose product with [N_0 .. N_top] holds the coefficients of N (constant - s linear)."""
        m, n = constant.shape
        out = np.zeros((m * (top + 1), n * (top + 2)))
        for k in range(top + 1):
            out[k * m : (k + 1) * m, k * n : (k + 1) * n] += constant
            out[k * m : (k + 1) * m, (k + 1) * n : (k + 2) * n] -= linear
        return out

    def exact_rank(matrix: np.ndarray) -> int:
        return int(fmpq_mat(*matrix.shape, [int(value) for value in matrix.ravel()]).rank()) if matrix.size else 0

    null = coefficients(a, e)
    shown = coefficients(column, np.zeros_like(column))
    signals = coefficients(known, np.zeros_like(known))
    width = known.shape[1]
    for order in range(nx + 1):
        bound = np.hstack([null, signals[:, (order + 1) * width :]])
        # Some N shows the fault exactly where its columns are no combination of the bound ones.
        if exact_rank(np.hstack([bound, shown])) > exact_rank(bound):
            return order
    return None


def random_plant(rng: np.random.Generator, *, regular: bool = True) -> obsynth.DescriptorSystem:
    def sparse(rows: int, columns: int, share: float = 0.5) -> np.ndarray:
        return np.array(rng.integers(-3, 4, (rows, columns)) * (rng.random((rows, columns)) < share), dtype=float)

    while True:
        n, ny, nd, nf = (int(rng.integers(low, high)) for low, high in ((1, 6), (1, 4), (0, 2), (1, 3)))
        e, a = sparse(n, n), sparse(n, n)
        if rng.random() < 0.4:
            e = np.eye(n)
        if (abs(np.linalg.det(a - 0.7310585 * e)) > 1e-6) == regular:
            break
    return obsynth.DescriptorSystem(
        e, a, sparse(n, 1), sparse(ny, n), Bf=sparse(n, nf), Df=sparse(ny, nf, 0.2), Bd=sparse(n, nd),
        dt=float(rng.integers(0, 2)),
    )  # fmt: skip


@pytest.mark.parametrize("regular", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_least_order_is_that_of_a_minimal_polynomial_basis(seed: int, *, regular: bool) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(8):
        plant = random_plant(rng, regular=regular)
        for fault in range(plant.nf):
            removed = tuple(j for j in range(plant.nf) if j != fault) if rng.random() < 0.5 else ()
            truth = least_order(plant, removed, fault)
            exact, rounded = (decoupled_fault(plant, removed, fault, way) for way in (True, False))
            assert (exact.visible, exact.residual_order) == (truth is not None, truth)
            assert (rounded.visible, rounded.residual_order) == (truth is not None, truth)
            # The same equations in other units are no numbers as somebody wrote them.
            other = plant.replace(**{name: 0.1 * getattr(plant, name) for name in ("E", "A", "B", "Bd", "Bf")})
            assert decoupled_fault(other, removed, fault, False).residual_order == truth


def mixed_biases(count: int) -> obsynth.DescriptorSystem:
    mixing = np.random.default_rng(1).integers(-1, 2, (3, count)).astype(float)
    return obsynth.DescriptorSystem(
        None, [[-1.0]], None, [[1.0], [0.0], [0.0]], Df=mixing, Bf=np.zeros((1, count)), dt=0.0
    )


def test_bank_above_six_faults_is_whole_when_asked_and_says_so_otherwise() -> None:
    plant = mixed_biases(7)
    part = obsynth.diagnose(plant, suggest=False)
    whole = obsynth.diagnose(plant, suggest=False, whole_bank=True)
    assert any("others may exist" in text for text in part.warnings)
    assert not any("others may exist" in text for text in whole.warnings)
    # N Df with N = [-C, 1 + s] of three outputs: sets of columns that another set's span does not hold (flats).
    rows = np.vstack([7.3 * plant.Df[0], plant.Df[1:]])
    rank = np.linalg.matrix_rank
    flats = [
        chosen
        for chosen in (tuple(j for j in range(7) if code >> j & 1) for code in range(127))
        if all(rank(rows[:, [*chosen, j]]) > rank(rows[:, list(chosen)]) for j in range(7) if j not in chosen)
    ]
    sees = {tuple(plant.fault_names[j] for j in range(7) if j not in chosen) for chosen in flats}
    assert {residual.sees for residual in whole.bank} == sees
    assert {residual.sees for residual in part.bank} < sees


def test_whole_bank_has_a_limit() -> None:
    with pytest.raises(obsynth.SpecError, match="13 faults: the whole bank"):
        obsynth.diagnose(mixed_biases(13), suggest=False, whole_bank=True)


@pytest.mark.parametrize("exactly", [True, False])
def test_derivatives_of_exact_constraints_cost_no_order(exactly: bool) -> None:
    # 0 = x1 and its derivatives: y = x2 = -f; y = x3 = -f after two of them; and y = x2 = -f' of 0 = x1 + f.
    plants = [
        obsynth.DescriptorSystem([[1, 0], [0, 0]], [[0, 1], [1, 0]], None, [[0, 1]], Bf=[[1], [0]]),
        obsynth.DescriptorSystem(
            np.diag([1.0, 1.0, 0.0]), [[0, 1, 0], [0, 0, 1], [1, 0, 0]], None, [[0, 0, 1]], Bf=[[0], [1], [0]]
        ),
        obsynth.DescriptorSystem([[1, 0], [0, 0]], [[0, 1], [1, 0]], None, [[0, 1]], Bf=[[0], [1]]),
    ]
    for plant in plants:
        assert least_order(plant, (), 0) == 0
        assert decoupled_fault(plant, (), 0, exactly).residual_order == 0


@pytest.mark.parametrize("exactly", [True, False])
def test_an_equation_of_the_fault_alone_is_a_residual_of_order_zero(exactly: bool) -> None:
    # 0 = -f1: the equations of a plant that is not regular may say so, of a plant with and without dynamics.
    plants = [
        obsynth.DescriptorSystem(np.zeros((2, 2)), [[0, 0], [-2, 0]], None, [[-2, 0]], Bf=[[-2, 0], [0, 0]]),
        obsynth.DescriptorSystem(
            np.diag([1.0, 0.0]), [[-1, 0], [0, 0]], None, [[1, 0]], Bf=[[1, 0], [-1, 0]], fault_names=["a", "b"]
        ),
    ]
    for plant in plants:
        assert least_order(plant, (), 0) == 0
        assert decoupled_fault(plant, (), 0, exactly).residual_order == 0
        assert decoupled_fault(plant, (), 1, exactly).residual_order is None


def test_a_residual_that_sees_two_faults_has_the_larger_of_their_orders() -> None:
    # y1 = a at once, y2 = x2 behind two states shows b: order 2.
    plant = obsynth.DescriptorSystem(
        None, [[0, 0], [1, 0]], None, [[0, 0], [0, 1]], Bf=[[0, 1], [0, 0]], Df=[[1, 0], [0, 0]],
        fault_names=["a", "b"],
    )  # fmt: skip
    orders = {one.sees: one.order for one in obsynth.diagnose(plant, suggest=False).bank}
    assert orders == {("a",): 0, ("b",): 2, ("a", "b"): 2}


def test_orders_that_follow_by_hand_where_a_fault_acts_at_once_and_later() -> None:
    """Shifted by hand: ``0 = -z2 - f, z2+ = 0``, which says ``0 = f+`` without w, and ``0 = z2 - f - w2, z2+ = z2 + z3,
    z3+ = w2 - w1``."""

    def order(*matrices: list[list[int]]) -> int | None:
        return exact_residual_order(*(fmpq_mat(matrix) for matrix in matrices))

    column, none = [[0], [0], [1]], [[0]]
    assert order([[0, 1, 0], [0, 0, 0], [0, 1, 0]], [[0, -1, 0]], column, [[-1]], [[1], [0], [0]], none) == 0
    known = [[1, -1], [0, 0], [-1, 1]]
    assert order([[0, 0, 1], [0, 1, 1], [0, 0, 0]], [[0, 1, 0]], [[-1], [0], [0]], [[-1]], known, [[0, -1]]) == 2
