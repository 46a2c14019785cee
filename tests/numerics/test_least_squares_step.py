"""The square-root step: against many digits, the textbook, a batch solution, and where a rank must be decided."""

from __future__ import annotations

from collections.abc import Iterator

import mpmath
import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from paper_filter import paper_gains

from obsynth.errors import PreconditionError, SpecError
from obsynth.numerics.ranks import covariance_factor
from obsynth.numerics.square_root_estimation import (
    LeastSquaresStep,
    least_squares_step,
    noise_triangle,
    projected_step,
    projection_of,
    rank_revealing_step,
)

#: Working digits of the reference: 50 are left after the worst cancellation below (sizes from 1e-32 to 1e20).
DIGITS = 120
STEPS = 12


class Case:
    """A time-invariant filter problem; the data are made of the matrices and a seed."""

    def __init__(self, E, A, C, Q, R, P0, steps: int = STEPS, seed: int = 0) -> None:
        self.E, self.A, self.C, self.Q, self.R, self.P0 = (np.array(m, dtype=float) for m in (E, A, C, Q, R, P0))
        rng = np.random.default_rng(seed)
        self.drive = rng.standard_normal((steps, len(self.A)))
        self.y = rng.standard_normal((steps, len(self.C)))

    @property
    def H(self) -> np.ndarray:
        return np.vstack([self.E, self.C])


def reference(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """The filter by the block matrix [R H; H' 0] in many digits: the covariances may be singular."""
    with mpmath.workdps(DIGITS):
        m = {name: mpmath.matrix(getattr(case, name).tolist()) for name in ("A", "Q", "R", "H")}
        x, P = mpmath.zeros(m["A"].cols, 1), mpmath.matrix(case.P0.tolist())
        ne, rows, n = m["A"].rows, m["H"].rows, m["A"].cols
        for drive, y in zip(case.drive, case.y, strict=True):
            block = mpmath.zeros(rows + n)
            block[:ne, :ne] = m["A"] * P * m["A"].T + m["Q"]
            block[ne:rows, ne:rows] = m["R"]
            block[:rows, rows:], block[rows:, :rows] = m["H"], m["H"].T
            data = mpmath.zeros(rows, 1)
            data[:ne, 0] = m["A"] * x + mpmath.matrix(drive.tolist())
            data[ne:, 0] = mpmath.matrix(y.tolist())
            inverse = block ** (-1)
            x, P = inverse[rows:, :rows] * data, -inverse[rows:, rows:]
        return np.array(x.tolist(), dtype=float)[:, 0], np.array(P.tolist(), dtype=float)


def steps_of(case: Case) -> Iterator[LeastSquaresStep]:
    q, r = covariance_factor(case.Q, "Q"), covariance_factor(case.R, "R")
    x, factor = np.zeros(case.A.shape[1]), covariance_factor(case.P0, "P0")
    ne, ny, n = len(case.A), len(case.C), len(x)
    for drive, y in zip(case.drive, case.y, strict=True):
        noise = np.zeros((ne + ny, n + ne + ny))
        noise[:ne, :n], noise[:ne, n : n + ne], noise[ne:, n + ne :] = case.A @ factor, q, r
        data = np.concatenate([case.A @ x + drive, y])[:, None]
        found = least_squares_step(case.H, noise, data)
        if found is None:
            found = rank_revealing_step(case.H, noise, data, np.zeros((ne + ny, 0)))
        x, factor = found.estimate[:, 0], found.factor
        yield found


def square_root(case: Case) -> tuple[np.ndarray, np.ndarray]:
    *_, last = steps_of(case)
    return last.estimate[:, 0], last.factor @ last.factor.T


def as_printed(case: Case) -> tuple[np.ndarray, np.ndarray]:
    x, P = np.zeros(case.A.shape[1]), case.P0
    with np.errstate(all="ignore"):
        for drive, y in zip(case.drive, case.y, strict=True):
            L, K, P = paper_gains(case.E, case.A, case.C, case.Q, case.R, P)
            x = L @ (case.A @ x + drive) + K @ y
    return x, P


def error(found: tuple[np.ndarray, np.ndarray], exact: tuple[np.ndarray, np.ndarray]) -> float:
    """The larger relative error of estimate and covariance; what is no number counts as infinite."""
    worst = max(float(np.linalg.norm(a - b) / np.linalg.norm(b)) for a, b in zip(found, exact, strict=True))
    return worst if np.isfinite(worst) else np.inf


def error_as_printed(case: Case, exact: tuple[np.ndarray, np.ndarray]) -> float:
    try:
        found = as_printed(case)
    except np.linalg.LinAlgError:
        return np.inf
    return error(found, exact)


def nearly_singular(condition: float) -> Case:
    """H has singular values 1 and 1 / condition in directions of no particular kind."""
    rng = np.random.default_rng(7)
    left, _ = np.linalg.qr(rng.standard_normal((4, 3)))
    right, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    H = left @ np.diag([1.0, 0.7, 1.0 / condition]) @ right.T
    A = 0.5 * rng.standard_normal((3, 3)) @ right @ np.diag([1.0, 1.0, 1.0 / condition]) @ right.T
    return Case(H[:3], A, H[3:], np.diag([0.1, 0.2, 0.1]), [[0.05]], np.eye(3))


INDEX_ONE = {"E": np.diag([1.0, 1, 0]), "A": [[0.9, 0.1, 0.3], [0.0, 0.7, 0.2], [1.0, 0.4, -1.0]]}
TWICE = [[1.0, 0.2, 0.5], [1.0, 0.2, 0.5 + 1e-7]]
PLAIN_Q = np.diag([0.1, 0.2, 0.1])

#: Case -> tolerance (for a nearly singular H about eps cond^2, or below), and whether the printed form must be
#: worse than 1e-4 (or throw).
HARD = {
    "an easy one": (Case(**INDEX_ONE, C=[[1, 0, 0.3], [0, 1, 1]], Q=PLAIN_Q, R=np.eye(2), P0=np.eye(3)), 1e-14, False),
    "cond H = 1e4": (nearly_singular(1e4), 1e-8, False),
    "cond H = 1e6": (nearly_singular(1e6), 1e-7, True),
    "cond H = 1e8": (nearly_singular(1e8), 1e-5, True),
    "R = 1e-30": (
        Case(**INDEX_ONE, C=[[1, 0, 0.3], [0, 1, 1]], Q=PLAIN_Q, R=1e-30 * np.eye(2), P0=np.eye(3)), 1e-13, True,
    ),
    "R = 1e-12, near-redundant sensors": (
        Case(**INDEX_ONE, C=TWICE, Q=PLAIN_Q, R=1e-12 * np.eye(2), P0=np.eye(3)), 1e-8, False,
    ),
    "R = 1e-16, near-redundant sensors": (
        Case(**INDEX_ONE, C=[*TWICE, [0.3, 1, 0.1]], Q=PLAIN_Q, R=1e-16 * np.eye(3), P0=np.eye(3)), 1e-7, True,
    ),
    "algebraic row with 1e-32": (
        Case(**INDEX_ONE, C=[[1, 0, 0.3], [0, 1, 1]], Q=np.diag([0.1, 0.2, 1e-32]), R=np.eye(2), P0=np.eye(3)),
        1e-13, False,
    ),
    "P0 = 1e16": (
        Case(**INDEX_ONE, C=[[0.4, 0, 1]], Q=PLAIN_Q, R=[[0.1]], P0=1e16 * np.eye(3), steps=3), 1e-12, True,
    ),
    "P0 = 1e20": (
        Case(**INDEX_ONE, C=[[0.4, 0, 1]], Q=PLAIN_Q, R=[[0.1]], P0=1e20 * np.eye(3), steps=3), 1e-12, True,
    ),
    "singular Q and R": (
        Case(**INDEX_ONE, C=[[1, 0, 0.3], [0, 1, 1]], Q=np.diag([1.0, 1, 0]), R=np.diag([0.01, 0]), P0=np.eye(3)),
        1e-13, True,
    ),
    "a perfect constraint row": (
        Case(
            [[1, 0, 0], [0, 1, 0], [1, 1, 1]], [[0.9, 0.1, 0.3], [0, 0.7, 0.2], [0, 0, 0]], [[1, 0, 0.3]],
            np.diag([0.1, 0.2, 0]), [[0.05]], np.eye(3),
        ),
        1e-13, True,
    ),
    "rectangular E, coupled noise": (
        Case(
            [[1, 0, 0.2], [0, 1, 0.1]], [[0.9, 0.1, 0.3], [0, 0.7, 0.2]], [[1, 0, 1], [0.3, 0, 1]],
            [[0.3, 0.1], [0.1, 0.2]], [[0.5, -0.2], [-0.2, 0.4]], 2.0 * np.eye(3),
        ),
        1e-14, False,
    ),
}  # fmt: skip


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name", HARD)
def test_it_holds_where_the_printed_form_does_not(name: str) -> None:
    case, tolerance, printed_fails = HARD[name]
    exact = reference(case)
    assert error(square_root(case), exact) < tolerance
    assert (error_as_printed(case, exact) > 1e-4) == printed_fails


@pytest.mark.long
def test_stress_of_forty_systems() -> None:
    """Variances over twenty decades."""
    worst = 0.0
    for seed in range(40):
        rng = np.random.default_rng(1000 + seed)
        n, ny = 3, 2
        left, right = rng.standard_normal((n, n)), rng.standard_normal((n, n))
        variances = [np.diag(10.0 ** rng.uniform(-10, 10, size)) for size in (n, ny, n)]
        case = Case(
            left @ np.diag([1.0, 1, 0]) @ right, rng.standard_normal((n, n)), rng.standard_normal((ny, n)),
            *variances, steps=5, seed=seed,
        )  # fmt: skip
        worst = max(worst, error(square_root(case), reference(case)))
    assert worst < 1e-8


@pytest.mark.parametrize("n", [2, 5])
def test_with_e_the_identity_it_is_the_textbook_filter(n: int) -> None:
    """Estimate, covariance and normalised innovation, against filterpy and against the textbook written out here."""
    rng = np.random.default_rng(n)
    ny = n - 1
    A = 0.4 * rng.standard_normal((n, n))
    case = Case(
        np.eye(n), A, rng.standard_normal((ny, n)), np.diag(rng.uniform(0.1, 1, n)), np.diag(rng.uniform(0.1, 1, ny)),
        np.eye(n), steps=100,
    )  # fmt: skip
    theirs = KalmanFilter(dim_x=n, dim_z=ny, dim_u=n)
    theirs.x, theirs.P, theirs.F, theirs.H, theirs.Q, theirs.R, theirs.B = (
        np.zeros(n), np.eye(n), A, case.C, case.Q, case.R, np.eye(n),
    )  # fmt: skip
    x, P = np.zeros(n), np.eye(n)
    for k, found in enumerate(steps_of(case)):
        x, P = A @ x + case.drive[k], A @ P @ A.T + case.Q
        S = case.C @ P @ case.C.T + case.R
        gap, gain = case.y[k] - case.C @ x, np.linalg.solve(S, case.C @ P).T
        x, P, nis = x + gain @ gap, P - gain @ S @ gain.T, gap @ np.linalg.solve(S, gap)
        theirs.predict(u=case.drive[k])
        theirs.update(case.y[k])
        for other, covariance, normalised in ((x, P, nis), (theirs.x, theirs.P, theirs.mahalanobis**2)):
            np.testing.assert_allclose(found.estimate[:, 0], other, rtol=0, atol=1e-12)
            np.testing.assert_allclose(found.factor @ found.factor.T, covariance, rtol=0, atol=1e-12)
            assert float(found.innovation[:, 0] @ found.innovation[:, 0]) == pytest.approx(normalised, abs=1e-12)


def test_it_is_the_maximum_likelihood_solution_of_the_whole_record() -> None:
    """One dense weighted least-squares problem over x(0) ... x(N); its last block is the filter's estimate."""
    case = Case(**INDEX_ONE, C=[[1, 0, 0.3], [0, 1, 1]], Q=PLAIN_Q, R=np.diag([0.2, 0.5]), P0=np.diag([1.0, 2, 3]))
    n, ny = 3, 2
    rows = n + STEPS * (n + ny)
    M, b, weights = np.zeros((rows, n * (STEPS + 1))), np.zeros(rows), np.zeros(rows)
    M[:n, :n], weights[:n] = np.eye(n), np.diag(case.P0)
    for k in range(STEPS):
        r, now, after = n + k * (n + ny), slice(k * n, (k + 1) * n), slice((k + 1) * n, (k + 2) * n)
        M[r : r + n, after], M[r : r + n, now], b[r : r + n] = case.E, -case.A, case.drive[k]
        M[r + n : r + n + ny, after], b[r + n : r + n + ny] = case.C, case.y[k]
        weights[r : r + n + ny] = [*np.diag(case.Q), *np.diag(case.R)]
    scaled, *_ = np.linalg.lstsq(M / np.sqrt(weights)[:, None], b / np.sqrt(weights))
    covariance = np.linalg.inv(M.T @ (M / weights[:, None]))
    x, P = square_root(case)
    np.testing.assert_allclose(x, scaled[-n:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(P, covariance[-n:, -n:], rtol=0, atol=1e-12)


def test_both_steps_agree_where_both_apply() -> None:
    rng = np.random.default_rng(3)
    H, S, Y = rng.standard_normal((5, 3)), rng.standard_normal((5, 8)), rng.standard_normal((5, 2))
    fast, general = least_squares_step(H, S, Y), rank_revealing_step(H, S, Y, np.zeros((5, 0)))
    assert fast is not None
    np.testing.assert_allclose(general.estimate, fast.estimate, atol=1e-13)
    np.testing.assert_allclose(general.factor @ general.factor.T, fast.factor @ fast.factor.T, atol=1e-13)
    np.testing.assert_allclose(
        general.innovation.T @ general.innovation, fast.innovation.T @ fast.innovation, atol=1e-12
    )
    assert general.diffuse.shape == fast.diffuse.shape == (3, 0)


class TestRanks:
    """Where `least_squares_step` gives up and `rank_revealing_step` decides."""

    NONE = np.zeros((4, 0))

    def test_an_undetermined_direction_is_diffuse_and_comes_back(self) -> None:
        H, S = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 0], [1, 1, 0]]), np.diag([1.0, 1, 1, 1])
        data = np.array([[1.0], [2], [0.5], [3]])
        assert least_squares_step(H, S, data) is None
        found = rank_revealing_step(H, S, data, self.NONE)
        np.testing.assert_allclose(np.abs(found.diffuse[:, 0]), [0, 0, 1], atol=1e-15)
        assert found.estimate[2, 0] == 0.0
        assert len(found.innovation) == 2
        # The next equations know x3 again: x3 = delta, seen through A = I with noise.
        again = rank_revealing_step(np.eye(4)[:, :3], S, data, np.vstack([found.diffuse, [[1.0]]]))
        assert again.diffuse.shape == (3, 0)
        exact = np.linalg.inv(np.hstack([np.eye(4)[:, :3], -np.vstack([found.diffuse, [[1.0]]])])) @ data
        np.testing.assert_allclose(again.estimate, exact[:3], atol=1e-14)

    def test_earlier_unknowns_alone_leave_nothing_open(self) -> None:
        # Two earlier unknowns in one equation; the outputs determine x: what is left open in it is rounding.
        H, S = np.array([[1.0, 0.5], [0, 1], [1, 1]]), np.eye(3)
        unknown = np.array([[0.7, 0.1], [0, 0], [0, 0]])
        found = rank_revealing_step(H, S, np.array([[0.3], [1.0], [2.0]]), unknown)
        assert found.diffuse.shape == (2, 0)
        np.testing.assert_allclose(found.estimate[:, 0], [1.0, 1.0], atol=1e-14)

    def test_redundant_perfect_rows_are_dropped_when_they_agree(self) -> None:
        H = np.array([[1.0, 0], [0, 1], [1, 1], [2, 2]])
        S = np.diag([1.0, 1, 0, 0])
        agreeing, noisy = np.array([[0.2], [0.3], [1.0], [2.0]]), np.array([[0.2], [0.3], [1.0]])
        found = rank_revealing_step(H, S, agreeing, self.NONE)
        same = rank_revealing_step(H[:3], S[:3], noisy, np.zeros((3, 0)))
        np.testing.assert_allclose(found.estimate, same.estimate, atol=1e-15)
        np.testing.assert_allclose(np.sum(found.innovation**2), np.sum(same.innovation**2), atol=1e-15)
        assert found.estimate.sum() == pytest.approx(1.0, abs=1e-15)
        with pytest.raises(PreconditionError, match="contradict") as caught:
            rank_revealing_step(H, S, agreeing + np.diag([0, 0, 0, 0.1])[:, 3:], self.NONE)
        assert caught.value.condition == "consistent perfect constraints"

    def test_parameters_that_are_known_exactly_are_refused(self) -> None:
        H, S = np.array([[1.0, 0], [0, 1], [1, 1], [2, 2]]), np.diag([1.0, 1, 0, 0])
        both = np.array([[0.2, 0], [0.3, 0], [1.0, 0], [2.0, 1.0]])
        with pytest.raises(PreconditionError, match="determine the parameters exactly"):
            rank_revealing_step(H, S, both, self.NONE)


class TestCovarianceFactor:
    @pytest.mark.parametrize(
        "covariance",
        [
            np.diag([1.0, 1e-30, 0.0]),
            [[1.0, 1e-15], [1e-15, 4e-30]],
            [[1.0, 1.0], [1.0, 1.0]],
            [[2.0, 0, 1], [0, 0, 0], [1, 0, 3]],
        ],
    )
    def test_every_variance_keeps_its_digits(self, covariance) -> None:
        given = np.array(covariance)
        factor = covariance_factor(given, "Q")
        np.testing.assert_allclose(factor @ factor.T, given, rtol=1e-15, atol=0)

    @pytest.mark.parametrize(
        ("covariance", "part"),
        [
            ([[1.0, 2.0], [2.0, 1.0]], "eigenvalue -1"),
            ([[1.0, 0.1], [0.2, 1.0]], r"not symmetric: entry \(1, 2\) is 0.1"),
            ([[-1.0, 0], [0, 1]], "negative variance"),
            ([[0.0, 0.1], [0.1, 1]], "a covariance with a signal that has none"),
            ([[1.0, 0.0]], "must be square"),
        ],
    )
    def test_what_is_no_covariance(self, covariance, part: str) -> None:
        with pytest.raises(SpecError, match=part) as caught:
            covariance_factor(np.array(covariance), "Q(3)")
        assert caught.value.path == "Q(3)"


@pytest.mark.one_in(6)
@pytest.mark.parametrize("directions", [6, 4])
@pytest.mark.parametrize("seed", range(6))
def test_priors_far_from_each_other_keep_the_digits_of_accurate_sensors(seed: int, directions: int) -> None:
    """States known to 1e-6 and to 3e8 at first, equations without noise, four sensors of 1e-4: parity is all prior but
    for one part in 1e12. With four directions some equations have no noise of their own."""
    rng = np.random.default_rng([52, seed])
    A, C = rng.standard_normal((6, 6)), rng.standard_normal((4, 6))
    prior = np.diag(10.0 ** rng.uniform(-6.0, 8.5, 6))
    prior[:, directions:] = 0.0
    case = Case(np.eye(6), A, C, np.zeros((6, 6)), 1e-8 * np.eye(4), prior**2, steps=1, seed=seed)
    mean, covariance = reference(case)
    S = np.zeros((10, 10))
    S[:6, :6], S[6:, 6:] = A @ np.sqrt(case.P0), 1e-4 * np.eye(4)
    data = np.concatenate([case.drive[0], case.y[0]])[:, None]
    found = rank_revealing_step(case.H, S, data, np.zeros((10, 0)))
    deviations = np.sqrt(np.diag(covariance))
    # So many deviations are the data away from the model, or its gains are off by one part in as many.
    far = max(1.0, float(np.max(np.abs(mean) / deviations)))
    assert np.max(np.abs(found.estimate[:, 0] - mean) / deviations) < 1e-11 * far
    gap = found.factor @ found.factor.T - covariance
    assert np.max(np.abs(gap) / np.outer(deviations, deviations)) < 1e-9


@pytest.mark.parametrize("seed", [6, 8, 10])
def test_the_step_without_decisions_keeps_them_too(seed: int) -> None:
    rng = np.random.default_rng([52, seed])
    A, C = rng.standard_normal((6, 6)), rng.standard_normal((4, 6))
    prior = np.diag(10.0 ** rng.uniform(-6.0, 7.0, 6))
    case = Case(np.eye(6), A, C, np.zeros((6, 6)), 1e-8 * np.eye(4), prior**2, steps=1, seed=seed)
    mean, covariance = reference(case)
    S = np.zeros((10, 10))
    S[:6, :6], S[6:, 6:] = A @ prior, 1e-4 * np.eye(4)
    data = np.concatenate([case.drive[0], case.y[0]])[:, None]
    projection, deviations = projection_of(case.H), np.sqrt(np.diag(covariance))
    assert projection is not None
    # Larger plants keep the noise of the step as a triangle.
    known = S.copy()
    known[:6, :6] = 0.0
    rotated = projection.rotation @ np.vstack([S[:6], np.zeros((4, 10))])
    triangle = noise_triangle((projection.rotation @ known).T)
    for found in (
        least_squares_step(case.H, S, data),
        projected_step(projection, rotated.T.copy(order="F"), projection.rotation @ data, known=triangle),
    ):
        assert found is not None
        gap = np.abs(found.estimate[:, 0] - mean) / deviations
        assert np.max(gap) < 1e-12 * max(1.0, float(np.max(np.abs(mean) / deviations)))


@pytest.mark.parametrize("parity", [0, 7])
def test_noise_that_stays_may_be_a_triangle(parity) -> None:
    rng = np.random.default_rng(parity)
    n, rows = 40, 40 + parity
    projection = projection_of(rng.standard_normal((rows, n)))
    assert projection is not None
    moving, staying = rng.standard_normal((n, rows)), rng.standard_normal((25, rows))
    data = rng.standard_normal((rows, 3))
    whole = np.zeros((n + 25, rows))
    whole[:n], whole[n:] = moving, staying
    expected = projected_step(projection, whole, data)
    found = projected_step(projection, moving, data, known=noise_triangle(staying))
    assert expected is not None
    assert found is not None
    np.testing.assert_allclose(found.estimate, expected.estimate, atol=1e-9)
    np.testing.assert_allclose(found.factor @ found.factor.T, expected.factor @ expected.factor.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.abs(found.innovation), np.abs(expected.innovation), atol=1e-9)
