"""What one machine ships another one verifies: other kernels round otherwise, and so do these tests on purpose."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import obsynth
from obsynth.methods.ui_pi_observer.assembly import KNOWN_POLES
from obsynth.numerics import logarithmic_balance
from obsynth.numerics.logarithmic_balance import LogBalance
from obsynth.numerics.spectra import rounding_of_eigenvalues
from obsynth.plants.transformations.elimination import dynamic_coordinates
from obsynth.proofs import contraction
from obsynth.proofs.balls import Ball
from obsynth.proofs.contraction import prove_contraction, proved_contractions
from obsynth.proofs.extended_balls import enclosed_eigenvalues, middle_of
from obsynth.proofs.peak_sums import REMAINDER_OF_SUM
from obsynth.verification import inequalities, stored_numbers

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks import kernels


def plants() -> Iterator[tuple[str, obsynth.DescriptorSystem]]:
    rng = np.random.default_rng(5)
    a = rng.standard_normal((4, 4))
    a *= 0.9 / np.max(np.abs(np.linalg.eigvals(a)))
    fields = {"C": rng.standard_normal((3, 4)), "B": rng.standard_normal((4, 1)), "Bf": rng.standard_normal((4, 1))}
    yield "sampled", obsynth.DescriptorSystem(None, a, dt=0.1, Bd=rng.standard_normal((4, 1)), **fields)
    yield "continuous", obsynth.DescriptorSystem(None, a - np.eye(4), Bd=rng.standard_normal((4, 1)), **fields)


METHODS = {"sampled": obsynth.fault_estimation_filter, "continuous": obsynth.ui_pi_observer}
PLANTS = dict(plants())


@pytest.mark.parametrize("time", PLANTS)
def test_bounds_are_found_again_with_another_factor_of_the_lyapunov_equation(
    time: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another machine's factor is off by rounding times its condition; nothing else may decide."""
    design = METHODS[time](PLANTS[time])
    shipped = design.certificate.matrices["state_error"]
    plain, rng = contraction._lyapunov_factor, np.random.default_rng(1)

    def otherwise(a: np.ndarray, rate: float, *, discrete: bool) -> np.ndarray | None:
        found = plain(a, rate, discrete=discrete)
        return None if found is None else found * (1.0 + 1e-14 * rng.standard_normal(found.shape))

    monkeypatch.setattr(contraction, "_lyapunov_factor", otherwise)
    # Equal numbers in a new object: nothing is remembered of the first time.
    again = obsynth.verify(design.replace(observer=replace(design.observer, Az=design.observer.Az.copy())))
    assert not [row.name for row in again.failures]
    row = again["stored numbers: states"]
    # The room is what rounding can do and where a sum may end, and not a share that somebody chose.
    assert 0.999 * row.bound / (1.0 + REMAINDER_OF_SUM) <= row.value <= row.bound
    assert np.all(np.isfinite(shipped))


@pytest.mark.parametrize("time", PLANTS)
def test_bounds_are_found_again_whatever_the_contraction_was(time: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of poles of 8e-3 a factor was 5 % another on another machine, a thousand times what its condition says."""
    design = METHODS[time](PLANTS[time])
    plain, rng = contraction._summed_factor, np.random.default_rng(2)

    def otherwise(a: np.ndarray, rate: float, *, discrete: bool) -> np.ndarray | None:
        found = plain(a, rate, discrete=discrete)
        return None if found is None else np.triu(found * (1.0 + 0.05 * rng.uniform(size=found.shape)))

    monkeypatch.setattr(contraction, "_summed_factor", otherwise)
    again = obsynth.verify(design.replace(observer=replace(design.observer, Az=design.observer.Az.copy())))
    assert not [row.name for row in again.failures]


@pytest.mark.parametrize("time", PLANTS)
def test_bounds_hold_by_any_contraction_where_rounding_decides_which_is_proved(
    time: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a triple pole beside one 2,800 times faster one machine proved the first rate, and another the third alone."""
    for name, value in (("MOST_ROOM", 0.0), ("OWN_SUMS_UP_TO", 0)):
        monkeypatch.setattr(stored_numbers, name, value)
    design = METHODS[time](PLANTS[time])
    monkeypatch.setattr(contraction, "TRIED_RATES", (0.8,))
    again = obsynth.verify(design.replace(observer=replace(design.observer, Az=design.observer.Az.copy())))
    assert not [row.name for row in again.failures]


def test_every_contraction_that_is_proved_counts() -> None:
    """Which rate is proved first may hang on rounding: a bound by any of them is one."""
    matrix = np.array([[0.5, 1.0], [0.0, 0.6]])
    found = list(proved_contractions(matrix, discrete=True))
    first = prove_contraction(matrix, discrete=True)
    assert first is not None
    assert len(found) == len(contraction.TRIED_RATES)
    assert found[0].rate == first.rate
    assert 0.0 < first.roundings < 1e-8


def test_what_the_entries_leave_open_is_no_rounding() -> None:
    """Scaled equations times inversely scaled states fit as well: without exact residuals rounding over the ridge."""
    rng = np.random.default_rng(3)
    matrix = 10.0 ** rng.uniform(-3.0, 3.0, (6, 6))
    problems = [LogBalance(12), LogBalance(12)]
    problems[0].add(matrix, range(6), range(6, 12))
    # The same in another order: other roundings.
    problems[1].add(matrix[::-1, ::-1], range(6), range(6, 12))
    first, other = (problem.solve() for problem in problems)
    turned = np.concatenate([other[:6][::-1], other[6:][::-1]])
    # Three corrections leave 1e-15 of the exponents, which are about ten.
    np.testing.assert_allclose(first, turned, rtol=0, atol=1e-12)


@pytest.mark.parametrize("weight", [1.0, 3e7])
def test_exponents_are_found_where_weights_are_large(weight: float) -> None:
    """A dense E of 800 states weighs 640,000: rounding of it was as large as what makes the exponents unique."""
    rng = np.random.default_rng(0)
    matrix, left, right = rng.normal(size=(40, 40)), 10.0 ** rng.uniform(-6, 6, 40), 10.0 ** rng.uniform(-6, 6, 40)
    sizes = []
    for given in (matrix, left[:, None] * matrix * right):
        problem = LogBalance(80)
        problem.add(given, range(40), range(40, 80), weight=weight)
        exponents = problem.solve()
        sizes.append(np.log2(np.abs(given)) + exponents[:40, None] + exponents[40:])
    assert np.sqrt(np.mean(sizes[0] ** 2)) < 3.0
    # A ridge of 1e-11, over weights of one, moves exponents of about 20 by this.
    np.testing.assert_allclose(*sizes, rtol=0, atol=2e-10)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="OpenBLAS's kernels of x86-64")
@pytest.mark.long
def test_a_gain_set_that_one_processor_made_another_verifies(capfd: pytest.CaptureFixture[str]) -> None:
    """Of the network floating point has eliminated the algebraic states, before it was sampled."""
    assert kernels.compare_designs(("Haswell", "Nehalem"), ["sharepasand/spec", "ieee14/spec"]) == 0
    assert "2 plants, 4 gain sets, 4 verifications: 0 differences" in capfd.readouterr().out


@pytest.mark.parametrize("spread", [0.0, 30.0])
def test_many_states_are_contracted_by_products_alone(spread: float, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    n = contraction.STATES_FOR_DOUBLED_SUMS
    a = 0.85 * rng.normal(size=(n, n)) / np.sqrt(n)
    units = np.exp2(rng.uniform(-spread, spread, n))
    monkeypatch.setattr("scipy.linalg.solve_discrete_lyapunov", lambda *_: pytest.fail("by Schur vectors"))
    found = contraction.prove_contraction(a * units / units[:, None], discrete=True)
    assert found is not None
    assert np.max(np.abs(np.linalg.eigvals(a))) < found.rate < 1.0


def test_the_root_of_a_sum_of_powers_is_triangular_and_none_where_powers_grow() -> None:
    found = contraction._root_of_sum(0.5 * np.eye(5))
    assert found is not None
    assert np.allclose(found, np.eye(5) / np.sqrt(0.75), rtol=1e-14, atol=0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        assert contraction._root_of_sum(2.0 * np.eye(5)) is None
    rng = np.random.default_rng(6)
    a = 0.2 * rng.normal(size=(7, 7))
    root = contraction._root_of_sum(a)
    assert root is not None
    assert np.array_equal(root, np.triu(root))
    p = root.T @ root
    assert np.allclose(p - a.T @ p @ a, np.eye(7), rtol=0.0, atol=1e-13)


def test_an_inequality_is_proved_once_for_the_same_numbers_and_again_for_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    design = obsynth.fault_estimation_filter(PLANTS["sampled"], weight="paper")
    plain, tried = inequalities.prove_positive_definite, []
    monkeypatch.setattr(inequalities, "prove_positive_definite", lambda given: tried.append(given) or plain(given))

    def lmi(changed: obsynth.ObserverDesign) -> tuple[int, bool]:
        tried.clear()
        row = obsynth.verify(changed)["LMI"]
        return len(tried), row.passed

    assert lmi(design) == (0, True)
    # Equal numbers in another observer, and the same observer beside another factor or another gain.
    assert lmi(design.replace(observer=replace(design.observer, Az=design.observer.Az.copy()))) == (1, True)
    old = design.certificate
    factor = old.matrices["P_factor"]
    for changed in (2.0 * factor, factor + np.triu(np.full(factor.shape, 0.1 * np.max(np.abs(factor))))):
        known = obsynth.Certificate({**old.matrices, "P_factor": changed}, old.claims)
        assert lmi(design.replace(certificate=known))[0] == 1
    gain = obsynth.Certificate(old.matrices, {**old.claims, "gamma": 0.5 * old.claims["gamma"]})
    assert lmi(design.replace(certificate=gain)) == (1, False)
    # What was not proved is not remembered.
    assert lmi(design.replace(certificate=gain)) == (1, False)


def test_many_exponents_are_the_same_by_cholesky_and_by_pivots(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(11)
    n = logarithmic_balance.MANY_UNKNOWNS // 2 + 10
    a = rng.standard_normal((n, n)) * np.exp2(rng.uniform(-20, 20, n)) * np.exp2(rng.uniform(-20, 20, n))[:, None]
    a[rng.random((n, n)) < 0.9] = 0.0
    plain, failed = logarithmic_balance.lapack.dpotrf, []

    def watched(*given: Any, **named: Any) -> Any:
        found = plain(*given, **named)
        failed.append(found[1])
        return found

    monkeypatch.setattr(logarithmic_balance.lapack, "dpotrf", watched)
    found = logarithmic_balance.balance_by_least_squares(np.eye(n), a)
    assert failed == [0]
    monkeypatch.setattr(logarithmic_balance, "MANY_UNKNOWNS", 10**9)
    again = logarithmic_balance.balance_by_least_squares(np.eye(n), a)
    assert failed == [0]
    assert np.array_equal(found.equations, again.equations)
    assert np.array_equal(found.states, again.states)


@pytest.mark.parametrize("discrete", [True, False])
@pytest.mark.parametrize("scatter", [1e-8, -1e-8, 2e-9])
def test_the_rate_of_a_contraction_does_not_hang_on_how_a_multiple_pole_scatters(
    scatter: float, discrete: bool
) -> None:
    # Of a rate halfway from a pole of 1.3e-8 on one machine, bounds were found 2e-10 larger on another: not verified.
    matrix = np.array([[0.3, 1.0, 0.0], [0.0, 0.3, 1.0], [0.0, 0.0, 0.3]]) - (0.0 if discrete else np.eye(3))
    poles = np.diag(matrix).astype(complex)
    here, there = (
        next(proved_contractions(matrix, discrete=discrete, poles=found)) for found in (poles, poles + scatter)
    )
    assert here.rate == there.rate
    np.testing.assert_array_equal(here.Q, there.Q)


def test_states_of_an_elimination_hold_no_rounding() -> None:
    # Of a basis with entries of 2e-16 a plant was made that another machine found 2 % off in these.
    e = np.zeros((5, 5))
    e[:3, :3], e[[0, 2], 4] = np.eye(3), -1.0
    a = np.array([[-1, 2, 0, 1, 0], [0, -3, 1, 0, 2], [1, 0, -2, 0, 1], [0, 1, 1, 2, 1], [1, 0, 2, 1, 3]], dtype=float)
    basis = dynamic_coordinates(obsynth.DescriptorSystem(e, a, C=np.eye(2, 5)))
    assert basis is not None
    assert np.min(np.abs(basis[basis != 0.0])) > 0.1


@pytest.mark.parametrize("turned", range(3))
def test_states_of_an_elimination_do_not_hang_on_how_singular_vectors_are_turned(
    turned: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Equal singular values: any vectors of their space, of any sign, are right, and each machine has its own.
    e = np.zeros((5, 5))
    e[:3, :3], e[0, 4] = np.eye(3), 1.0
    a = np.array([[-1, 2, 0, 1, 0], [0, -3, 1, 0, 2], [1, 0, -2, 0, 1], [0, 1, 1, 2, 1], [1, 0, 2, 1, 3]], dtype=float)
    plain = obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(e, a, C=np.eye(2, 5))).plant
    svd = np.linalg.svd

    def otherwise(matrix: np.ndarray, *given: Any, **named: Any) -> Any:
        found = svd(matrix, *given, **named)
        if not isinstance(found, tuple):
            return found
        left, values, right = found
        turn = np.linalg.qr(np.random.default_rng(turned).standard_normal((3, 3)))[0]
        if right.shape == (5, 5):
            right = np.vstack([turn @ right[:3], right[3:]])
        return left, values, right

    monkeypatch.setattr(np.linalg, "svd", otherwise)
    again = obsynth.eliminate_algebraic_states(obsynth.DescriptorSystem(e, a, C=np.eye(2, 5))).plant
    assert again.state_names[0] == "xi 1"
    for name in ("A", "C"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(again, name))


def test_sampling_leaves_nothing_where_nothing_is() -> None:
    # A fault that moves two of three states was left with 7e-13 in the third, and with 9e-13 on another machine.
    a, b = np.array([[0.0, 0.0, -2.8], [2.8, 0.0, -4.0], [0.0, 0.0, 0.0]]), np.array([[-5.8e3], [1.2e4], [0.0]])
    plant = obsynth.DescriptorSystem(None, a, C=np.eye(3), Bf=b)
    few = obsynth.discretise(plant, 0.5).plant
    # With many states by a library: the same pattern.
    many = obsynth.DescriptorSystem(None, np.kron(np.eye(12), a), C=np.eye(36), Bf=np.tile(b, (12, 1)))
    for sampled in (few, obsynth.discretise(many, 0.5).plant):
        assert not sampled.Bf[2::3].any()
        np.testing.assert_array_equal(sampled.A[2::3] != 0.0, np.eye(sampled.nx)[2::3] != 0.0)
    t = 0.5
    wanted = np.array([[1.0, 0.0, -2.8 * t], [2.8 * t, 1.0, -4.0 * t - 2.8**2 * t**2 / 2.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(few.A, wanted, rtol=4e-16, atol=0.0)


#: Ahat of a UI-PI observer of a random plant: eigenvectors that nearly coincide (condition 2.8e8), poles -.085 to -2.6.
NEARLY_DEFECTIVE = np.array([
    [263774.73911251506, -22342020.275202632, 13923394.06998052, 182108.14628100855],
    [8290.803491496486, -702245.9912898951, 437636.9595185154, 5723.569098334252],
    [8306.628052921707, -703588.7472811849, 438474.65471950674, 5734.345876469068],
    [-4.7798725891514655, 318.55799424353467, -166.17041576504408, -8.662796324496068],
])  # fmt: skip


@pytest.mark.parametrize("discrete", [False, True])
def test_a_contraction_is_found_where_double_precision_loses_it(discrete: bool) -> None:
    """Haswell's kernels proved none where Nehalem's did: what one processor claimed the other called not proved."""
    # A quarter of a second by Euler's rule, the same to the last digit on every machine.
    matrix = np.eye(4) + 0.25 * NEARLY_DEFECTIVE if discrete else NEARLY_DEFECTIVE
    poles = np.array([middle_of(ball) for ball in enclosed_eigenvalues(matrix) or ()])
    slowest = float(np.max(np.abs(poles)) if discrete else -np.max(poles.real))
    rate, faster = (0.5 + 0.5 * slowest, 0.99 * slowest) if discrete else (0.5 * slowest, 1.01 * slowest)
    factor = contraction._precise_factor(matrix, rate, discrete=discrete)
    assert factor is not None
    assert contraction._proved(Ball.of(matrix), factor, rate, discrete=discrete) is not None
    # No norm contracts faster than the slowest pole.
    assert contraction._precise_factor(matrix, faster, discrete=discrete) is None
    assert len(list(proved_contractions(matrix, discrete=discrete, poles=poles))) == len(contraction.TRIED_RATES)


@pytest.mark.parametrize(("length", "growth"), [(2, 1e3), (3, 1e2)])
def test_a_contraction_is_found_though_errors_grow_before_they_decay(length: int, growth: float) -> None:
    """Solved for the rate itself, the inequality holds by 1e-12 of P: less than its rounding of 2e-10 or more."""
    rng = np.random.default_rng(0)
    poles = rng.uniform(0.5, 0.99, 24)
    coupling = np.where(np.arange(1, 24) % length, growth * rng.uniform(0.5, 1.0, 23), 0.0)
    turn = np.linalg.qr(rng.standard_normal((24, 24)))[0]
    matrix = turn @ (np.diag(poles) + np.diag(coupling, 1)) @ turn.T
    rate = 0.5 + 0.5 * float(np.max(poles))
    found = contraction.prove_contraction(matrix, discrete=True, rate=rate)
    assert found is not None
    assert found.rate == rate
    # From one norm to the other and back no more is gained than the condition of Q; the errors do grow.
    powers = [float(np.linalg.norm(np.linalg.matrix_power(matrix, k), 2)) for k in range(0, 400, 20)]
    condition = float(np.linalg.norm(found.Q, 2) * np.linalg.norm(found.inverse, 2)) / (1.0 - found.defect)
    assert max(powers) > growth
    assert all(power <= condition * rate**k for power, k in zip(powers, range(0, 400, 20), strict=True))
    assert contraction.prove_contraction(matrix, discrete=True, rate=0.9 * float(np.max(poles))) is None


@pytest.mark.parametrize("discrete", [False, True])
def test_filters_that_do_not_touch_contract_beside_each_other(discrete: bool) -> None:
    rng = np.random.default_rng(3)
    matrix = 0.04 * rng.standard_normal((102, 102)) - (0.0 if discrete else np.eye(102))
    owner = rng.integers(0, 3, 102)
    matrix[owner[:, None] != owner[None, :]] = 0.0
    found = contraction.prove_contraction(matrix, discrete=discrete)
    assert found is not None
    assert np.array_equal(found.Q != 0.0, np.triu(owner[:, None] == owner[None, :]))
    # The whole norm stands by itself, and its distance from the inverse is within what is stated.
    assert contraction._proved(Ball.of(matrix), found.Q, found.rate, discrete=discrete) is not None
    assert np.linalg.norm(found.Q @ found.inverse - np.eye(102), 2) <= found.defect
    # What may be coupled, by a radius alone, is one part; a part that grows leaves nothing proved.
    radius = np.zeros_like(matrix)
    radius[np.flatnonzero(owner == 0)[0], np.flatnonzero(owner == 1)[0]] = 1e-12
    assert len(contraction._separate_parts(Ball(matrix, radius))) == 2
    growing = matrix + np.diag(np.where(owner == 2, 1.5, 0.0))
    rate = 0.99 if discrete else 0.01
    assert contraction.prove_contraction(growing, discrete=discrete, rate=rate) is None


def test_poles_that_rounding_moves_are_told() -> None:
    assert rounding_of_eigenvalues(np.diag([-1.0, -2.0])) <= 1e-15
    assert rounding_of_eigenvalues(NEARLY_DEFECTIVE) > KNOWN_POLES
    assert rounding_of_eigenvalues(np.array([[0.0, 1.0], [0.0, 0.0]])) == np.inf
    assert rounding_of_eigenvalues(np.zeros((0, 0))) == 0.0
