"""Least mean squares in continuous time where sensors have no noise: the white noise of the outputs is singular."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

import obsynth
from obsynth.methods.optimal_filter.error_channel import ErrorChannel
from obsynth.verification.error_system import ErrorModel

REFERENCE = (np.array([[-3.0]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]]))

#: Varga 2017, example 5.15: y = f / (s + 1) + w / (s + 2), to be matched 1 / (s + 3).
EXAMPLE = {"A": np.diag([-1.0, -2.0]), "Bf": [[1.0], [0.0]], "Bw": [[0.0], [1.0]], "C": [[1.0, 1.0]], "dt": 0.0}


def plant_of(seed: int) -> obsynth.DescriptorSystem:
    """Return a stable plant of which most sensors have no noise."""
    rng = np.random.default_rng([91, seed])
    n, ny, nw = (int(rng.integers(1, most)) for most in (5, 4, 4))

    def drawn(rows: int, columns: int) -> np.ndarray:
        return np.round(2.0 * rng.standard_normal((rows, columns))) / 2.0

    a = drawn(n, n) - 2.0 * np.eye(n)
    last = np.linalg.eigvals(a).real.max()
    a = a if last <= -0.2 else a - (0.5 + last) * np.eye(n)
    dw = drawn(ny, nw) * (rng.random((ny, 1)) < 0.4)
    return obsynth.DescriptorSystem(A=a, Bf=drawn(n, 1), Bw=drawn(n, nw), C=drawn(ny, n), Dw=dw, dt=0.0)


def least_with_noise(plant: obsynth.DescriptorSystem, noise: float) -> float:
    """Return the least root mean square with so much noise of its own on every sensor, by SciPy's Riccati equation."""
    ar, br, cr, _ = REFERENCE
    a = scipy.linalg.block_diag(plant.A, ar)
    b = np.block([[plant.Bf, plant.Bw], [br, np.zeros((1, plant.nw))]])
    c = np.hstack([plant.C, np.zeros((plant.ny, 1))])
    d = np.hstack([plant.Df, plant.Dw])
    covariance = scipy.linalg.solve_continuous_are(a.T, c.T, b @ b.T, d @ d.T + noise**2 * np.eye(plant.ny), s=b @ d.T)
    wanted = np.hstack([np.zeros((1, plant.nx)), cr])
    return float(np.sqrt((wanted @ covariance @ wanted.T).item()))


def deviation_of(design: obsynth.OptimalFilter, *, faults: float = 1.0) -> float:
    """Return the root mean square of the estimate less what it shall match, from plant and filter in series."""
    plant, filter_ = design.plant, design.observer
    ar, br, cr, dr = REFERENCE
    n, nz = plant.nx, filter_.order
    a = np.block(
        [
            [plant.A, np.zeros((n, nz + 1))],
            [filter_.By @ plant.C, filter_.Az, np.zeros((nz, 1))],
            [np.zeros((1, n + nz)), ar],
        ]
    )
    b = np.block(
        [
            [plant.Bf, plant.Bw],
            [filter_.By @ plant.Df, filter_.By @ plant.Dw],
            [br, np.zeros((1, plant.nw))],
        ]
    )
    rows = filter_.fault_rows
    c = np.hstack([filter_.Dy[rows] @ plant.C, filter_.Cz[rows], -cr])
    through = np.hstack([faults * (filter_.Dy[rows] @ plant.Df - dr), filter_.Dy[rows] @ plant.Dw])
    assert np.max(np.abs(through)) < 1e-9
    covariance = scipy.linalg.solve_continuous_lyapunov(a, -b @ b.T)
    return float(np.sqrt(max((c @ covariance @ c.T).item(), 0.0)))


def matched(plant: obsynth.DescriptorSystem) -> obsynth.OptimalFilter:
    return obsynth.optimal_filter(plant, reference=REFERENCE, exact=False, norm="h2")


def test_a_textbook_example_has_the_value_of_its_spectral_factors() -> None:
    design = matched(obsynth.DescriptorSystem(**EXAMPLE))
    # ||Mr||^2 - ||[Mr Gf~ / Go~]+||^2 with Go = (sqrt 5 + s sqrt 2) / ((s + 1) (s + 2)).
    value = np.sqrt((1.0 - 25.0 / (np.sqrt(5.0) + 3.0 * np.sqrt(2.0)) ** 2) / 6.0)
    claims = design.certificate.claims
    assert claims["deviation"] == pytest.approx(value, rel=1e-9)
    assert claims["least_deviation"] == pytest.approx(value, rel=1e-9)
    assert deviation_of(design) == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("seed", [0, 4, 8, 10, 12, 38])
def test_the_least_mean_square_is_the_limit_of_less_and_less_noise(seed: int) -> None:
    plant = plant_of(seed)
    design = matched(plant)
    claims = design.certificate.claims
    some, little = (least_with_noise(plant, noise) for noise in (1e-3, 1e-5))
    assert claims["least_deviation"] <= little * (1.0 + 1e-6)
    assert claims["least_deviation"] >= little - 0.2 * (some - little) - 1e-6
    assert claims["least_deviation"] <= claims["deviation"] <= 1.01 * claims["least_deviation"] + 1e-6
    assert deviation_of(design) == pytest.approx(claims["deviation"], rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("seed", [144, 164])
def test_a_least_mean_square_that_is_not_reached_is_approached(seed: int) -> None:
    design = matched(plant_of(seed))
    claims = design.certificate.claims
    assert claims["least_deviation"] == 0.0
    assert 0.0 < claims["deviation"] < least_with_noise(plant_of(seed), 1e-3)
    assert design.solver["added_noise"] > 0.0


@pytest.mark.parametrize("seed", [4, 39, 53])
def test_an_exact_fault_map_has_the_least_mean_square_of_sensors_without_noise(seed: int) -> None:
    design = obsynth.optimal_filter(plant_of(seed), reference=REFERENCE, norm="h2")
    claims = design.certificate.claims
    assert claims["deviation"] == claims["least_deviation"]
    assert deviation_of(design, faults=0.0) == pytest.approx(claims["deviation"], rel=1e-6)


@pytest.mark.parametrize("seed", [15, 43, 55, 59])
def test_sensors_without_noise_that_follow_from_others_change_nothing(seed: int) -> None:
    design = obsynth.optimal_filter(plant_of(seed), reference=REFERENCE, norm="h2")
    claims = design.certificate.claims
    assert claims["deviation"] == claims["least_deviation"]
    assert np.max(np.abs(design.observer.By), initial=0.0) < 1e3


def test_noise_that_is_read_by_rounding_only_has_its_own_mean_square() -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.0]], Bf=[[2.0]], Bw=[[0.0]], C=[[-1.0], [0.5], [-0.5]], Dw=[[0.0], [-0.5], [0.0]], dt=0.0
    )
    claims = obsynth.optimal_filter(plant, norm="h2", reference={"bandwidth": 1.0, "order": 2}).certificate.claims
    assert claims["least_deviation"] == 0.0
    assert claims["deviation"] < 1e-9


def test_outputs_that_show_derivatives_of_white_noise_have_the_least_mean_square_of_their_lags() -> None:
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0]),
        A=[[-1.5, 2.0], [-1.0, 0.0]],
        Bf=[[1.0], [0.5]],
        Bw=[[0.5], [1.0]],
        C=[[0.5, -1.0]],
        dt=0.0,
    )
    lagged = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0, 1.0]),
        A=[[-1.5, 2.0, 0.0], [-1.0, 0.0, 0.0], [0.5, -1.0, -1.0]],
        Bf=[[1.0], [0.5], [0.0]],
        Bw=[[0.5], [1.0], [0.0]],
        C=[[0.0, 0.0, 1.0]],
        dt=0.0,
    )
    own, behind = matched(plant).certificate.claims, matched(lagged).certificate.claims
    assert own["deviation"] == pytest.approx(own["least_deviation"], rel=1e-9)
    assert own["least_deviation"] == pytest.approx(behind["least_deviation"], rel=1e-9)
    assert own["least_deviation"] < 0.99 / np.sqrt(6.0)  # that of the estimate zero


def test_a_mean_square_that_has_lost_its_digits_is_none() -> None:
    design = matched(obsynth.DescriptorSystem(**EXAMPLE))
    observer = obsynth.LinearObserver.from_dict(
        {
            **design.observer.as_dict(),
            "Az": [[-2.12975633e17, -1.50161882e17, 0.576561668], [0.0, -1.5, 0.5], [0.0, 0.5, -1.5]],
            "By": [[-1.69352829e17], [0.0], [0.0]],
            "Bu": [[], [], []],
            "Cz": [[0.825109985, -0.346117782, -1.0331281e-17]],
            "Dy": [[0.0]],
        }
    )
    T = np.array([[-0.29661771, -0.29661771], [-0.70710678, -0.70710678], [-0.70710678, 0.70710678]])
    model = ErrorModel(design.plant, observer, T, np.zeros((1, 2)), decoupled=True)
    assert np.isnan(ErrorChannel(model, REFERENCE).deviation(0.0))


@pytest.mark.parametrize("order", [1, 2])
def test_where_no_output_shows_the_faults_the_estimate_is_zero(order: int) -> None:
    plant = obsynth.DescriptorSystem(
        A=[[0.0]],
        Bf=[[0.0]],
        Bw=[[2.5, 1.0, -0.5]],
        C=[[0.5], [0.5], [-1.0]],
        Dw=[[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [1.5, 1.0, -0.5]],
        dt=0.0,
    )
    design = obsynth.optimal_filter(plant, norm="h2", exact=False, reference={"bandwidth": 2.0, "order": order})
    claims = design.certificate.claims
    # The mean square of the reference model alone: 2 / (s + 2), or its square.
    assert claims["least_deviation"] == claims["deviation"] == pytest.approx(1.0 / np.sqrt(order), rel=1e-12)
    assert design.observer.order == 0
    assert not design.observer.Dy.any()


def test_outputs_that_are_read_at_once_by_rounding_pass_no_white_noise() -> None:
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 1.0, 0.0]),
        A=[[0.5, 0.5, 0.0], [0.5, 0.0, 0.0], [0.0, -1.0, 1.5]],
        B=[[1.5], [0.0], [-0.5]],
        Bf=[[2.5], [0.0], [0.0]],
        Bw=[[1.0], [-1.0], [1.5]],
        C=[[-1.0, -1.5, -1.0], [-1.0, 0.5, 1.0], [-1.0, 2.0, -0.5]],
        Dw=[[0.0], [-1.5], [0.0]],
        dt=0.0,
    )
    design = obsynth.optimal_filter(plant, norm="h2", exact=False, reference={"bandwidth": 2.0, "order": 2})
    claims = design.certificate.claims
    assert claims["least_deviation"] == 0.0
    assert claims["deviation"] <= 1e-3
    assert design.report.passed


def test_outputs_whose_algebraic_parts_cancel_in_the_filter_pass_no_white_noise() -> None:
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0, 1.0]),
        A=[[-0.5, -0.5, -1.5], [0.0, -1.0, 1.5], [-1.0, -1.5, -1.0]],
        Bf=[[-1.0, 1.0], [-1.0, 1.0], [1.5, -1.0]],
        Bw=[[0.0, 0.0, 0.5], [-1.0, 0.0, 0.0], [-1.5, -2.0, 1.0]],
        C=[[-0.5, 1.0, -0.5], [0.5, 1.5, 0.0]],
        dt=0.0,
    )
    design = obsynth.optimal_filter(plant, norm="h2", exact=False, reference={"bandwidth": 2.0})
    assert design.report.passed
    assert design.certificate.claims["deviation"] == pytest.approx(1.22255095, rel=1e-8)


def test_a_least_mean_square_that_is_rounding_is_zero() -> None:
    plant = obsynth.DescriptorSystem(
        E=np.diag([1.0, 0.0, 1.0]),
        A=[[-1.5, -1.5, -0.5], [-0.5, -1.0, 0.0], [-2.0, -0.5, -1.0]],
        Bf=[[-0.5], [1.0], [1.5]],
        Bw=[[1.0], [-1.0], [0.5]],
        C=[[0.5, 1.0, 0.5], [-1.0, 1.0, 1.0], [1.5, -0.5, -2.0]],
        Dw=[[0.0], [1.0], [0.0]],
        dt=0.0,
    )
    claims = obsynth.optimal_filter(plant, norm="h2", reference={"bandwidth": 1.0, "order": 2}).certificate.claims
    assert claims["least_deviation"] == 0.0
    assert claims["deviation"] < 1e-6
